"""Batched ray casting against a layout."""

from __future__ import annotations

import numba
import numpy as np

from gridnav.problem.layout import Layout
from gridnav.problem.robot import Robot
from gridnav.problem.types import BoolArray, FloatArray


class Lidar:
    """A robot's lidar in a layout.

    The walls are whole cells, so a beam walks the grid from cell border to cell border (Amanatides and Woo 1987):
    exact, and its cost does not grow with the number of walls.

    Args:
        layout: The maze; its outer edge is a wall too.
        robot: Gives beams, range and where the lidar stands.
    """

    def __init__(self, layout: Layout, robot: Robot) -> None:
        self._robot, self._cell_size_m = robot, layout.cell_size_m
        angles = robot.beam_angles_rad
        self._directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        # A border of walls: a beam that leaves the maze meets it without being asked where it is.
        self._walls = np.pad(layout.walls, 1, constant_values=True)

    def scan(self, poses: FloatArray) -> FloatArray:
        """Range of every beam of every robot, from its lidar to the nearest wall.

        Args:
            poses: x and y in metres and heading in radians, world frame, shape ``(n, 3)``.

        Returns:
            Shape ``(n, n_beams)``, metres, at most the lidar's range. A lidar inside a wall reads 0.
        """
        robot, ranges = self._robot, np.empty((len(poses), len(self._directions)))
        _cast(
            poses, self._directions, robot.lidar_offset_m, self._walls, self._cell_size_m, robot.lidar_range_m, ranges
        )
        return ranges


def scan(poses: FloatArray, layout: Layout, robot: Robot) -> FloatArray:
    """``Lidar.scan`` of one batch."""
    return Lidar(layout, robot).scan(poses)


@numba.njit(cache=True)
def _cast(
    poses: FloatArray,
    directions: FloatArray,
    offset: float,
    walls: BoolArray,
    cell: float,
    longest: float,
    ranges: FloatArray,
) -> None:
    n_rows, n_cols = walls.shape
    for i in range(len(poses)):
        ahead_x, ahead_y = np.cos(poses[i, 2]), np.sin(poses[i, 2])
        # In cells of the bordered maze from here on; rows are counted from below.
        x = (poses[i, 0] + offset * ahead_x) / cell + 1.0
        y = (poses[i, 1] + offset * ahead_y) / cell + 1.0
        own_col, own_row = int(np.floor(x)), int(np.floor(y))
        inside = 0 <= own_col < n_cols and 0 <= own_row < n_rows
        for k in range(len(directions)):
            if not inside:
                ranges[i, k] = 0.0
                continue
            dx = ahead_x * directions[k, 0] - ahead_y * directions[k, 1]
            dy = ahead_x * directions[k, 1] + ahead_y * directions[k, 0]
            col, row = own_col, own_row
            step_col, step_row = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
            # Lengths along the ray between borders and to the next one; a ray along an axis never crosses the other.
            per_col = abs(1.0 / dx) if dx != 0.0 else np.inf
            per_row = abs(1.0 / dy) if dy != 0.0 else np.inf
            next_col = ((col + 1 - x) if dx > 0 else (x - col)) * per_col if dx != 0.0 else np.inf
            next_row = ((row + 1 - y) if dy > 0 else (y - row)) * per_row if dy != 0.0 else np.inf
            length = 0.0
            while not walls[n_rows - 1 - row, col]:
                if next_col < next_row:
                    length = next_col
                    next_col += per_col
                    col += step_col
                else:
                    length = next_row
                    next_row += per_row
                    row += step_row
            ranges[i, k] = min(length * cell, longest)
