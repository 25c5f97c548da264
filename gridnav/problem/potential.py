"""Values of cells as a potential of places: interpolated among cells that are connected, and never through a wall."""

from __future__ import annotations

import numpy as np

from gridnav.problem.layout import Layout
from gridnav.problem.types import FloatArray, IntArray


class CellPotential:
    """A continuous function of the place that takes the cells' values at their centres.

    Between four centres it is bilinear in those of them that the place's own cell is connected with by moves among the
    four; a wall has no value, and what lies behind it none that counts here. Continuous wherever a robot can pass.

    Args:
        layout: The maze.
        values: Of each goal and cell, shape ``(n_goals, n_rows, n_cols)``; those of walls do not matter.
    """

    def __init__(self, layout: Layout, values: FloatArray) -> None:
        self._layout = layout
        # A frame of walls: every place then lies between four centres.
        self._free = np.pad(~layout.walls, 1)
        self._values = np.pad(np.where(layout.walls, 0.0, values), ((0, 0), (1, 1), (1, 1)))

    def __call__(self, points_w: FloatArray, goals: IntArray) -> FloatArray:
        """The potential of places.

        Args:
            points_w: x and y in metres, world frame, outside the walls, shape ``(n, 2)``; more columns do not matter.
            goals: Number of each one's goal, shape ``(n,)``.

        Returns:
            Shape ``(n,)``, in the values' unit.
        """
        size, n_rows = self._layout.cell_size_m, self._layout.n_rows
        own = self._layout.to_cell(points_w[:, :2])
        # Place relative to the own cell's centre, in cells: rows count downwards.
        down = n_rows - points_w[:, 1] / size - own[:, 0] - 0.5
        right = points_w[:, 0] / size - own[:, 1] - 0.5
        row, col = own[:, 0] + 1, own[:, 1] + 1  # in the frame
        other_row, other_col = row + np.where(down < 0, -1, 1), col + np.where(right < 0, -1, 1)
        beside, below = self._free[row, other_col], self._free[other_row, col]
        across = self._free[other_row, other_col] & (beside | below)
        down, right = np.clip(np.abs(down), 0.0, 0.5), np.clip(np.abs(right), 0.0, 0.5)
        cells = ((row, col), (row, other_col), (other_row, col), (other_row, other_col))
        weights = np.stack(
            [
                (1.0 - down) * (1.0 - right),
                (1.0 - down) * right * beside,
                down * (1.0 - right) * below,
                down * right * across,
            ]
        )
        values = np.stack([self._values[goals, r, c] for r, c in cells])
        return (weights * values).sum(axis=0) / weights.sum(axis=0)
