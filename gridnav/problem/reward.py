"""One reward for all worlds: pure terms on arrays and their sum.

Lengths are in cells and times in cell-times (the time to cross a cell at the reference speed), so that a grid move and
the same way driven by a robot earn about the same. With ``dc`` cells travelled, ``dt`` cell-times passed and ``D`` the
distance to the goal in cells::

    r = goal - collision_cost*hit - distance_cost*dc - time_cost*dt + progress*(gamma^dt * phi(s') - phi(s)),  phi = -D

phi is 0 in terminal states and never zeroed at a truncation (Ng, Harada and Russell 1999; Grzes 2017).
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import ClassVar

import numba
import numpy as np

from gridnav.problem.types import BoolArray, FloatArray, InputError

TERM_NAMES = ("goal", "collision", "distance", "time", "progress")


@dataclass(frozen=True)
class Transition:
    """What the reward looks at: one step of ``n`` worlds, each field of shape ``(n,)``."""

    travelled: FloatArray
    """Cells travelled."""
    duration: FloatArray
    """Cell-times passed."""
    distance: FloatArray
    """Shortest way to the goal before the step, cells."""
    next_distance: FloatArray
    """The same after the step, cells, whether or not the state is terminal."""
    manhattan: FloatArray
    """Rows plus columns between the cell after the step and the goal."""
    at_goal: BoolArray
    """The goal was reached."""
    hit: BoolArray
    """A wall was touched or bumped into."""
    hit_inner_wall: BoolArray
    """It was a wall of the layout, not the outer one."""
    terminal: BoolArray
    """The state after the step is final: the goal, or a collision that ends the episode."""
    time_up: BoolArray
    """The time limit was reached with this step."""


@dataclass(frozen=True)
class Reward:
    """Weights of the reward's terms; the class is the default reward itself.

    Idling must not pay: standing still at distance D earns ``progress*D*(1 - gamma)`` and costs ``time_cost`` per
    cell-time, so the time cost has to exceed the former for every D of the layout (up to 66 cells with the defaults).
    Where a collision ends the episode, its cost must outweigh ``progress*D``, which the vanishing potential pays there:
    the preset ``fragile`` is for such tasks. ``gridnav lint-reward`` checks both.
    """

    goal: float = 10.0
    """Paid once at the goal."""
    collision_cost: float = 3.0
    """Charged for every collision; with 1, a learnt robot touched walls in up to a third of its drives."""
    distance_cost: float = 0.05
    """Charged per cell travelled."""
    time_cost: float = 0.2
    """Charged per cell-time."""
    progress: float = 1.0
    """Weight of the potential-based progress, reward per cell."""
    gamma: float = 0.997
    """Discount per cell-time, in (0, 1]; learners that follow it discount a step by ``gamma**dt``."""

    PRESETS: ClassVar[dict[str, Reward]] = {}

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
                raise InputError(f"reward {item.name} {value!r:.60} must be a finite number")
        if not 0.0 < self.gamma <= 1.0:
            raise InputError(f"reward gamma {self.gamma} is outside (0, 1]: it is the discount per cell-time")

    @classmethod
    def preset(cls, name: str) -> Reward:
        """The named reward.

        ``default``; ``fragile`` for tasks where a collision ends the episode; ``seed``, the tutorial's reward of the
        10 x 10 grid.

        Raises:
            InputError: When no preset has that name.
        """
        if not isinstance(name, str) or name not in cls.PRESETS:
            raise InputError(f"unknown reward {name!r:.60}: the presets are {', '.join(cls.PRESETS)}")
        return cls.PRESETS[name]

    @classmethod
    def load(cls, source: str | Reward) -> Reward:
        """A reward from a preset's name or itself."""
        return source if isinstance(source, Reward) else cls.preset(source)

    def terms(self, step: Transition) -> dict[str, FloatArray]:
        """Each term's share of the reward, by the names of ``TERM_NAMES``, shape ``(n,)`` each.

        Progress is potential-based, so it leaves the optimal policy as it was (Ng, Harada and Russell 1999, Theorem 1);
        phi is 0 in terminal states, as the theorem asks.
        """
        shares = np.empty((len(TERM_NAMES), len(step.travelled)))
        _terms(
            float(self.goal),
            float(self.collision_cost),
            float(self.distance_cost),
            float(self.time_cost),
            float(self.progress),
            float(self.gamma),
            step.travelled,
            step.duration,
            step.distance,
            step.next_distance,
            step.at_goal,
            step.hit,
            step.terminal,
            shares,
        )
        return dict(zip(TERM_NAMES, shares, strict=True))

    def potential(self, distance: FloatArray) -> FloatArray:
        """What shaping adds to a state's value, negated: add it to learnt values to get those of the unshaped reward.

        Args:
            distance: Shortest way to the goal, cells, any shape.
        """
        return -self.progress * distance


def total(terms: dict[str, FloatArray]) -> FloatArray:
    """The reward: the sum of its terms, shape ``(n,)``."""
    first, *others = terms.values()
    rewards = first.astype(np.float64)
    for share in others:
        rewards += share
    return rewards


@numba.njit(cache=True)
def _terms(
    goal: float,
    collision_cost: float,
    distance_cost: float,
    time_cost: float,
    progress: float,
    gamma: float,
    travelled: FloatArray,
    duration: FloatArray,
    distance: FloatArray,
    next_distance: FloatArray,
    at_goal: BoolArray,
    hit: BoolArray,
    terminal: BoolArray,
    shares: FloatArray,
) -> None:
    # One loop per term, so that each compiles to vector instructions.
    n = len(travelled)
    for i in range(n):
        shares[0, i] = goal * at_goal[i]
    for i in range(n):
        shares[1, i] = -collision_cost * hit[i]
    for i in range(n):
        shares[2, i] = -distance_cost * travelled[i]
    for i in range(n):
        shares[3, i] = -time_cost * duration[i]
    # Powers are dear, so gamma^dt is worked out once where all steps last equally long, as those of a batch do.
    discounts = shares[4]
    lasting, equally = duration[0], True
    for i in range(n):
        equally &= duration[i] == lasting
    discounts[:] = gamma**lasting
    if not equally:
        discounts[:] = gamma**duration
    for i in range(n):
        phi, next_phi = -distance[i], -next_distance[i] * (1.0 - terminal[i])
        shares[4, i] = progress * (discounts[i] * next_phi - phi)


@dataclass(frozen=True)
class TutorialReward(Reward):
    """The reward of the tutorial's 10 x 10 grid, for comparison.

    Every move -0.1 plus closeness 0.1*(20 - d)/20 with d the Manhattan distance after it; into a wall cell -1; goal
    +10; the move that ends the time -1 whatever else it did. On a robot the ordinary part is paid per cell-time.
    """

    goal: float = 10.0
    """Paid instead of the ordinary reward at the goal."""
    collision_cost: float = 1.0
    """Charged instead of the ordinary reward for a move into a wall of the layout."""
    distance_cost: float = 0.0
    """Not part of this reward."""
    time_cost: float = 0.1
    """Charged per move."""
    progress: float = 0.1
    """Paid per move for closeness, in full at the goal and nothing 20 cells away."""
    gamma: float = 0.99
    """The tutorial's default discount per move."""

    def terms(self, step: Transition) -> dict[str, FloatArray]:
        """Each term's share of the reward, by the names of ``TERM_NAMES``, shape ``(n,)`` each."""
        ordinary = ~(step.at_goal | step.hit_inner_wall | step.time_up)
        closeness = self.progress * (20.0 - step.manhattan) / 20.0
        return {
            "goal": self.goal * (step.at_goal & ~step.time_up),
            "collision": -self.collision_cost * (step.hit_inner_wall & ~step.time_up),
            "distance": np.zeros_like(step.travelled),
            "time": np.where(step.time_up, -1.0, -self.time_cost * step.duration * ordinary),
            "progress": closeness * step.duration * ordinary,
        }

    def potential(self, distance: FloatArray) -> FloatArray:
        """Zero: closeness is paid as such and is no potential."""
        return np.zeros_like(distance)


Reward.PRESETS.update(default=Reward(), fragile=Reward(collision_cost=70.0), seed=TutorialReward())
