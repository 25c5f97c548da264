"""Where episodes start and end, and what a collision does."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from gridnav.problem.layout import Layout
from gridnav.problem.types import FloatArray, InputError, IntArray

DRAWS_PER_EPISODE = 3
"""Uniform numbers that ``Task.sample`` turns into one episode's start, goal and heading."""


@dataclass(frozen=True)
class Task:
    """What one episode asks for, in every world.

    The time limit is Gymnasium's ``max_episode_steps``; it truncates and is no part of the task.
    """

    starts: Literal["layout", "any"] = "layout"
    """Start cells: those of the layout, or every free cell that they reach."""
    goals: Literal["layout", "any"] = "layout"
    """Goal cells: those of the layout, or every free cell that the starts reach."""
    on_collision: Literal["stop", "slide", "end"] = "stop"
    """A robot that touches a wall is stopped and can only turn or back off, or slides on, or the episode ends.

    A contact is counted and charged in all three: once, and again for every cell-time of pressing; sliding, in every
    step of it. A grid robot stays in its cell under ``stop`` and ``slide``.
    """
    goal_radius_m: float = 0.15
    """A robot arrives when its axle's centre is this close to the goal cell's centre, metres."""

    def __post_init__(self) -> None:
        allowed = {"starts": ("layout", "any"), "goals": ("layout", "any"), "on_collision": ("stop", "slide", "end")}
        for name, values in allowed.items():
            if getattr(self, name) not in values:
                raise InputError(f"task {name} {getattr(self, name)!r:.60} is none of {', '.join(values)}")
        if not 0 < self.goal_radius_m < np.inf:
            raise InputError(f"task goal_radius_m {self.goal_radius_m} must be a positive number of metres")

    @classmethod
    def load(cls, source: str | Task) -> Task:
        """A task from its name or itself.

        Raises:
            InputError: When no task has that name.
        """
        if isinstance(source, Task):
            return source
        if not isinstance(source, str) or source not in NAMED_TASKS:
            raise InputError(f"unknown task {source!r:.60}: the named tasks are {', '.join(NAMED_TASKS)}")
        return NAMED_TASKS[source]

    def start_cells(self, layout: Layout) -> IntArray:
        """Cells where an episode may start, (row, column), shape ``(n_starts, 2)``."""
        return np.argwhere(layout.reachable) if self.starts == "any" else layout.start_cells

    def goal_cells(self, layout: Layout) -> IntArray:
        """Cells where an episode may end, (row, column), shape ``(n_goals, 2)``."""
        return np.argwhere(layout.reachable) if self.goals == "any" else layout.goal_cells

    def sample(self, layout: Layout, uniforms: FloatArray) -> tuple[IntArray, IntArray, FloatArray]:
        """Starts, goals and headings of episodes.

        Args:
            layout: The maze.
            uniforms: Numbers in [0, 1) from one generator, shape ``(n, DRAWS_PER_EPISODE)``.

        Returns:
            Start cells ``(n, 2)``, goal cells ``(n, 2)``, never the start, and headings ``(n,)`` in radians.
        """
        starts, goals = self.start_cells(layout), self.goal_cells(layout)
        # Start: uniform over the start cells that leave a goal to go to.
        if len(goals) == 1:
            starts = starts[(starts != goals[0]).any(axis=1)]
        start = starts[(uniforms[:, 0] * len(starts)).astype(np.int64)]
        # Goal: uniform over the goal cells that are not the start.
        number = np.full((layout.n_rows, layout.n_cols), len(goals))
        number[tuple(goals.T)] = np.arange(len(goals))
        own = number[tuple(start.T)]
        choices = len(goals) - (own < len(goals))
        drawn = (uniforms[:, 1] * choices).astype(np.int64)
        goal = goals[drawn + (drawn >= own)]
        # Heading: uniform over the circle.
        return start, goal, (2.0 * uniforms[:, 2] - 1.0) * np.pi


NAMED_TASKS = {
    "default": Task(),
    "any": Task(starts="any", goals="any"),
    "fragile": Task(on_collision="end"),
}
