"""The grid as a Markov decision process in tables: moves, rewards, exact solution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_array, eye_array
from scipy.sparse.linalg import spsolve

from gridnav.problem.geodesic import cell_distances
from gridnav.problem.layout import Layout
from gridnav.problem.reward import Reward, Transition, total
from gridnav.problem.task import Task
from gridnav.problem.types import BoolArray, Cell, FloatArray, IntArray

MOVES = np.array([(-1, 0), (1, 0), (0, -1), (0, 1)])
"""Row and column step of the actions 0 up, 1 down, 2 left, 3 right."""
MOVE_HEADINGS_RAD = np.array([np.pi / 2, -np.pi / 2, np.pi, 0.0])
"""Heading of each move in the world frame (x right, y up)."""
SIDEWAYS = np.array([(2, 3), (2, 3), (0, 1), (0, 1)])
"""The two moves at right angles to each move: where a slip leads."""


@dataclass(frozen=True)
class MoveTable:
    """Where each move leads from each cell; cells are numbered row by row."""

    next_cell: IntArray
    """Cell after the move, the same cell on a bump, shape ``(n_cells, 4)``."""
    hit: BoolArray
    """The move bumps into a wall or off the edge, shape ``(n_cells, 4)``."""
    hit_inner_wall: BoolArray
    """It bumps into a wall cell, shape ``(n_cells, 4)``."""

    @classmethod
    def of(cls, layout: Layout) -> MoveTable:
        """The table of a layout."""
        rows, cols = np.divmod(np.arange(layout.n_cells), layout.n_cols)
        to_row, to_col = rows[:, None] + MOVES[:, 0], cols[:, None] + MOVES[:, 1]
        inside = (to_row >= 0) & (to_row < layout.n_rows) & (to_col >= 0) & (to_col < layout.n_cols)
        to_cell = np.where(inside, to_row * layout.n_cols + to_col, 0)
        wall = inside & layout.walls.ravel()[to_cell]
        hit = ~inside | wall
        return cls(np.where(hit, np.arange(layout.n_cells)[:, None], to_cell), hit, wall)


@dataclass(frozen=True)
class GridMDP:
    """One goal of one layout under one reward, with a discount."""

    next_cell: IntArray
    """Shape ``(n_cells, 4)``."""
    reward: FloatArray
    """Of each move, shape ``(n_cells, 4)``."""
    terminal: BoolArray
    """The move ends the episode, shape ``(n_cells, 4)``."""
    gamma: float
    """Discount per move."""
    slip: float = 0.0
    """Probability that a move goes to one of its two sides instead."""

    @classmethod
    def of(
        cls, layout: Layout, goal: Cell, reward: Reward, task: Task, *, gamma: float | None = None, slip: float = 0.0
    ) -> GridMDP:
        """The tables of a goal; ``gamma`` defaults to the reward's own."""
        table = MoveTable.of(layout)
        distance = cell_distances(layout, goal).ravel()
        # Walls and cut-off cells are never entered; any finite number keeps the arithmetic clean.
        distance = np.where(np.isfinite(distance), distance, 0.0)
        rows, cols = np.divmod(np.arange(layout.n_cells), layout.n_cols)
        manhattan = (np.abs(rows - goal[0]) + np.abs(cols - goal[1])).astype(np.float64)
        n, next_cell = layout.n_cells * 4, table.next_cell.ravel()
        at_goal = next_cell == goal[0] * layout.n_cols + goal[1]
        hit = table.hit.ravel()
        terminal = at_goal | (hit if task.on_collision == "end" else False)
        step = Transition(
            travelled=(~hit).astype(np.float64),
            duration=np.ones(n),
            distance=np.repeat(distance, 4),
            next_distance=distance[next_cell],
            manhattan=manhattan[next_cell],
            at_goal=at_goal,
            hit=hit,
            hit_inner_wall=table.hit_inner_wall.ravel(),
            terminal=terminal,
            time_up=np.zeros(n, dtype=bool),
        )
        shape = table.next_cell.shape
        rewards = total(reward.terms(step)).reshape(shape)
        return cls(table.next_cell, rewards, terminal.reshape(shape), reward.gamma if gamma is None else gamma, slip)

    def action_values(self, values: FloatArray) -> FloatArray:
        """One Bellman backup: values of cells ``(n_cells,)`` to values of moves ``(n_cells, 4)``."""
        straight = self.reward + self.gamma * np.where(self.terminal, 0.0, values[self.next_cell])
        if self.slip == 0.0:
            return straight
        return (1.0 - self.slip) * straight + self.slip * straight[:, SIDEWAYS].mean(axis=2)

    def solve(self, *, forbidden: BoolArray | None = None, tolerance: float = 1e-10) -> FloatArray:
        """Value iteration, with the greedy policy's values solved for once it has settled.

        Sweeps alone (Sutton and Barto 2018, section 4.4) find the policy soon and its values late where it never ends;
        the jump makes it modified policy iteration (Puterman 1994, section 6.5). The result is exact to ``tolerance``.

        Args:
            forbidden: Moves that may not be chosen, shape ``(n_cells, 4)``.
            tolerance: Largest change of a value in the last sweep.

        Returns:
            Optimal action values, shape ``(n_cells, 4)``.
        """
        penalty = np.where(forbidden, -np.inf, 0.0) if forbidden is not None else 0.0
        values: FloatArray = np.zeros(len(self.next_cell))
        policy = np.full(len(self.next_cell), -1)
        while True:
            action_values = self.action_values(values) + penalty
            new_values, new_policy = action_values.max(axis=1), action_values.argmax(axis=1)
            if np.max(np.abs(new_values - values)) < tolerance:
                return action_values
            settled = np.array_equal(policy, new_policy) and self.gamma < 1.0
            values, policy = self._values_of(new_policy) if settled else new_values, new_policy

    def _values_of(self, policy: IntArray) -> FloatArray:
        """Values of cells under fixed moves, ``v = r + gamma * P v`` solved for ``v``, shape ``(n_cells,)``."""
        cells = np.arange(len(policy))
        outcomes = [(policy, 1.0 - self.slip), *((SIDEWAYS[policy, side], self.slip / 2) for side in (0, 1))]
        matrix = eye_array(len(policy), format="csc")
        for moves, probability in outcomes:
            weights = self.gamma * probability * ~self.terminal[cells, moves]
            matrix = matrix - csc_array((weights, (cells, self.next_cell[cells, moves])), shape=matrix.shape)
        rewards = sum(probability * self.reward[cells, moves] for moves, probability in outcomes)
        return np.asarray(spsolve(matrix, rewards))
