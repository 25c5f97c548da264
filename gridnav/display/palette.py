"""The colours of all pictures, told apart by colour-blind readers too.

Okabe and Ito, "Color Universal Design", 2008; its yellow is left out, it vanishes on white.
"""

from __future__ import annotations

BLUE, ORANGE, GREEN = "#0072B2", "#E69F00", "#009E73"
VERMILLION, PURPLE, SKY = "#D55E00", "#CC79A7", "#56B4E9"
SERIES = (BLUE, ORANGE, GREEN, PURPLE, VERMILLION, SKY)
"""Colours of curves that stand side by side, in this order."""

WALL, FLOOR, INK = "#5B6470", "#F4F5F7", "#1F2933"
GRID_LINE = "#E4E7EB"
START, GOAL, COLLISION = SKY, GREEN, VERMILLION
ARRIVED, MISSED = BLUE, VERMILLION
"""Ways that reached the goal, and those that did not."""
ROBOT, ACTION = INK, ORANGE
"""The robot's body, and the arrow of what it does."""
SLOW, FAST = ORANGE, BLUE
"""Ends of the scale that shows a robot's speed."""
REWARD_TERMS = {"goal": GREEN, "collision": VERMILLION, "distance": SKY, "time": ORANGE, "progress": BLUE}
"""Each reward term is the same colour in all pictures."""
