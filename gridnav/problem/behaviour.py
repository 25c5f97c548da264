"""What a robot does instead of arriving: turning in place, hugging walls, loitering at the goal, dithering.

A learner that fails mostly fails in one of these ways, each with its own cause (a reward that pays for turning, a
robot that dares not leave a wall, a goal that pays less than being near it, values that disagree about the way). Each
is looked for in a sliding window; all lengths are measured in cells and cell-times, so that they mean the same in
every world, robot and size of maze.
"""

from __future__ import annotations

import numpy as np

from gridnav.problem.geodesic import clearances
from gridnav.problem.layout import Layout
from gridnav.problem.metrics import Trace, heading_changes
from gridnav.problem.robot import Robot
from gridnav.problem.types import AnyArray, BoolArray, FloatArray

BEHAVIOURS = ("rotate-in-place", "wall-hugging", "goal-loitering", "dithering")

WINDOW_CELL_TIMES = 4.0
"""Length of the window: 10 s for a Burger in cells of 0.5 m. At full speed it turns four times in it or drives 2 m."""
LASTING_CELL_TIMES = 8.0
"""What takes less of an episode is no behaviour: a plan may waver once, a stuck robot does until the end."""
FULL_TURN_RAD = 2.0 * np.pi
"""No way needs so much in one window: a U-turn is half of it."""
TO_AND_FRO = 0.25
"""Displacement over distance driven below which a way leads nowhere: around the end of a wall it is 0.35 or more."""
ONE_WAY = 0.5
"""Share of the turning that is left after left and right cancel, above which a robot turns one way."""
AT_WALL_M = 0.03
"""Gap between bumper and wall below which a robot is at the wall: it bounces off by up to 11 mm."""
AT_WALL_SHARE = 0.75
"""Of a window, at a wall; on the grid, of the moves that bump."""
NEAR_GOAL_CELLS = 1.5
"""The eight cells around the goal; from here arriving takes a cell-time and a half and a turn, never a window."""


def diagnose(trace: Trace, *, goal_w: FloatArray, layout: Layout, robot: Robot) -> dict[str, float]:
    """Share of an episode's time spent in each of ``BEHAVIOURS``; they may overlap.

    A moment counts when a window around it shows the behaviour:

    * rotate-in-place: turned by a full turn or more, mostly one way, about a point under the robot (the distance
      driven over the angle turned is no more than its radius). Robots only.
    * wall-hugging: at a wall for three quarters of the window, and either bumping into it twice or displaced by less
      than a cell: to glide along a wall towards the goal is none. On the grid: three of four moves bump.
    * goal-loitering: within 1.5 cells of the goal all the time.
    * dithering: driven a cell or more, and displaced by a quarter of that at most (to and fro, or in loops of up to
      0.8 cells radius); or turned in place as above, but left and right.

    Args:
        trace: Of one episode.
        goal_w: The goal's centre, metres, world frame, shape ``(2,)``.
        layout: The maze.
        robot: Gives the radius and, by its speed, the cell-time.

    Returns:
        Shares by name, 0 for what did not last for ``LASTING_CELL_TIMES``.
    """
    n_steps = len(trace.actions)
    steps_per_cell_time = layout.cell_size_m / robot.max_speed_m_s / (trace.time_s[-1] / n_steps) if n_steps else 1.0
    window = max(1, round(WINDOW_CELL_TIMES * steps_per_cell_time))
    lasting = max(window, LASTING_CELL_TIMES * steps_per_cell_time - 0.5)  # half a step for rounding
    if n_steps < lasting:
        return dict.fromkeys(BEHAVIOURS, 0.0)
    shown = _shown(trace, window, goal_w, layout, robot)
    n_covered = {name: _n_covered(shown[name], window) for name in BEHAVIOURS}
    return {name: n / n_steps if n >= lasting else 0.0 for name, n in n_covered.items()}


def _shown(trace: Trace, window: int, goal_w: FloatArray, layout: Layout, robot: Robot) -> dict[str, BoolArray]:
    """Whether each window of steps shows each behaviour, shape ``(n_steps - window + 1,)``."""
    cell, positions = layout.cell_size_m, trace.poses[:, :2]
    driven = _sums(np.hypot(*np.diff(positions, axis=0).T), window)
    displaced = np.hypot(*(positions[window:] - positions[:-window]).T)
    near_goal = np.hypot(*(positions[1:] - goal_w).T) <= NEAR_GOAL_CELLS * cell
    is_lost = (driven >= cell) & (displaced <= TO_AND_FRO * driven)
    bumps = _sums(trace.hits, window)
    if trace.is_on_grid:
        is_turning, is_one_way = np.zeros_like(is_lost), is_lost
        is_hugging = bumps >= AT_WALL_SHARE * window
    else:
        turns = heading_changes(trace)
        turned, one_way = _sums(np.abs(turns), window), np.abs(_sums(turns, window))
        is_turning = (turned >= FULL_TURN_RAD) & (driven <= robot.radius_m * turned)
        is_one_way = one_way >= ONE_WAY * turned
        # In narrow corridors the middle must not count as being at a wall.
        reach = min(AT_WALL_M, (cell / 2 - robot.radius_m) / 2)
        at_wall = clearances(positions[1:], layout)[0] <= robot.radius_m + reach
        is_hugging = (_sums(at_wall, window) >= AT_WALL_SHARE * window) & ((bumps >= 2) | (displaced < cell))
    return {
        "rotate-in-place": is_turning & is_one_way,
        "wall-hugging": is_hugging,
        "goal-loitering": _sums(near_goal, window) == window,
        "dithering": is_lost | (is_turning & ~is_one_way),
    }


def _sums(values: AnyArray, window: int) -> AnyArray:
    """Sum of the values in each window."""
    total = np.concatenate([[0], np.cumsum(values)])
    return total[window:] - total[:-window]


def _n_covered(shown: BoolArray, window: int) -> int:
    """How many steps lie in a window that shows the behaviour."""
    return int((np.convolve(shown, np.ones(window)) > 0.5).sum()) if shown.any() else 0
