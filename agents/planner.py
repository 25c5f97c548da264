"""Value iteration: the oracle of the grid."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from gymnasium.vector import VectorEnv

from gridnav.problem.grid_mdp import GridMDP
from gridnav.problem.layout import Layout
from gridnav.problem.reward import Reward
from gridnav.problem.task import Task
from gridnav.problem.types import State

from .base import OnCut, OnProgress
from .tabular import TabularAgent


class Planner(TabularAgent):
    """Knows the maze and the reward, and solves them; its table is that of ``cell_goal`` observations."""

    kind = "plan"

    @classmethod
    def solve(
        cls, layout: Layout, task: Task, reward: Reward, *, gamma: float | None = None, slip: float = 0.0
    ) -> Self:
        """The optimal table for every cell and every goal of the task.

        Args:
            layout: The maze.
            task: Gives the goals and what a collision does.
            reward: What is maximised.
            gamma: Discount per move, the reward's own by default.
            slip: Probability that a move goes sideways.
        """
        goals = [(int(row), int(col)) for row, col in task.goal_cells(layout)]
        tables = [GridMDP.of(layout, goal, reward, task, gamma=gamma, slip=slip).solve() for goal in goals]
        return cls(np.stack(tables, axis=1).reshape(-1, 4))

    def learn(
        self,
        env: VectorEnv[Any, Any, Any],
        *,
        steps: int,
        on_progress: OnProgress | None = None,
        on_cut: OnCut | None = None,
        resume: State | None = None,
    ) -> None:
        """Nothing to learn: the plan is optimal already."""
