"""Where episodes start and end, and what a collision does."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numba
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
    """A robot that drives into a wall is stopped and can only turn or back off, or slides on, or the episode ends.

    A contact is counted and charged in all three: once, and again for every cell-time of pressing, or of scraping along
    at less than 15 degrees, which is not stopped; sliding, in every step of it. A grid robot stays in its cell under
    ``stop`` and ``slide``.
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

    def goal_ranks(self, layout: Layout) -> IntArray:
        """Place of each cell among the goals, -1 where it is none, shape ``(n_rows, n_cols)``."""
        goals = self.goal_cells(layout)
        ranks = np.full(layout.walls.shape, -1)
        ranks[tuple(goals.T)] = np.arange(len(goals))
        return ranks

    def sample(self, layout: Layout, uniforms: FloatArray) -> tuple[IntArray, IntArray, FloatArray]:
        """Starts, goals and headings of episodes; see ``EpisodeSampler.sample``."""
        return EpisodeSampler(self, layout).sample(uniforms)


class EpisodeSampler:
    """Draws where the episodes of a task start and end.

    Args:
        task: The task.
        layout: The maze.
    """

    def __init__(self, task: Task, layout: Layout) -> None:
        self._starts, self._goals = task.start_cells(layout), task.goal_cells(layout)
        if len(self._goals) == 1:  # a start that leaves no goal to go to is none
            self._starts = self._starts[(self._starts != self._goals[0]).any(axis=1)]
        self._goal_ranks = task.goal_ranks(layout)

    def sample(self, uniforms: FloatArray) -> tuple[IntArray, IntArray, FloatArray]:
        """Starts, goals and headings of episodes.

        Args:
            uniforms: Numbers in [0, 1) from one generator, shape ``(n, DRAWS_PER_EPISODE)``.

        Returns:
            Start cells ``(n, 2)``, goal cells ``(n, 2)``, never the start, and headings ``(n,)`` in radians.
        """
        n = len(uniforms)
        starts, goals, headings = np.empty((n, 2), dtype=np.int64), np.empty((n, 2), dtype=np.int64), np.empty(n)
        _sample(uniforms, self._starts, self._goals, self._goal_ranks, starts, goals, headings)
        return starts, goals, headings


@numba.njit(cache=True)
def _sample(
    uniforms: FloatArray,
    start_cells: IntArray,
    goal_cells: IntArray,
    goal_ranks: IntArray,
    starts: IntArray,
    goals: IntArray,
    headings: FloatArray,
) -> None:
    for i in range(len(uniforms)):
        # Start: uniform over the start cells.
        row, col = start_cells[int(uniforms[i, 0] * len(start_cells))]
        # Goal: uniform over the goal cells that are not the start.
        own = goal_ranks[row, col]
        choices = len(goal_cells) - (1 if own >= 0 else 0)
        drawn = int(uniforms[i, 1] * choices)
        starts[i, 0], starts[i, 1] = row, col
        goals[i] = goal_cells[drawn + 1 if 0 <= own <= drawn else drawn]
        # Heading: uniform over the circle.
        headings[i] = (2.0 * uniforms[i, 2] - 1.0) * np.pi


NAMED_TASKS = {
    "default": Task(),
    "any": Task(starts="any", goals="any"),
    "fragile": Task(on_collision="end"),
}
