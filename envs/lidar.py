"""Batched ray casting against a layout."""

from __future__ import annotations

import numba
import numpy as np

from gridnav.problem.layout import Layout
from gridnav.problem.robot import Robot
from gridnav.problem.types import BoolArray, FloatArray


def scan(poses: FloatArray, layout: Layout, robot: Robot) -> FloatArray:
    """Range of every beam of every robot, from its lidar to the nearest wall.

    The walls are whole cells, so a ray walks the grid from cell border to cell border (Amanatides and Woo 1987): exact,
    and its cost does not grow with the number of walls.

    Args:
        poses: x and y in metres and heading in radians, world frame, shape ``(n, 3)``.
        layout: The maze; its outer edge is a wall too.
        robot: Gives beams, range and where the lidar stands.

    Returns:
        Shape ``(n, n_beams)``, metres, at most the lidar's range. A lidar inside a wall reads 0.
    """
    ranges = np.empty((len(poses), robot.n_beams))
    angles = robot.beam_angles_rad
    _cast(poses, angles, robot.lidar_offset_m, layout.walls, layout.cell_size_m, robot.lidar_range_m, ranges)
    return ranges


@numba.njit(cache=True)
def _cast(
    poses: FloatArray,
    angles: FloatArray,
    offset: float,
    walls: BoolArray,
    cell: float,
    longest: float,
    ranges: FloatArray,
) -> None:
    n_rows, n_cols = walls.shape
    for i in range(len(poses)):
        heading = poses[i, 2]
        # In cells from here on; rows are counted from below.
        x = (poses[i, 0] + offset * np.cos(heading)) / cell
        y = (poses[i, 1] + offset * np.sin(heading)) / cell
        for k in range(len(angles)):
            dx, dy = np.cos(heading + angles[k]), np.sin(heading + angles[k])
            col, row = int(np.floor(x)), int(np.floor(y))
            step_col, step_row = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
            # Lengths along the ray to the next border and between borders; a ray along an axis never crosses the other.
            per_col = abs(1.0 / dx) if dx != 0.0 else np.inf
            per_row = abs(1.0 / dy) if dy != 0.0 else np.inf
            next_col = (col + (dx > 0) - x) / dx if dx != 0.0 else np.inf
            next_row = (row + (dy > 0) - y) / dy if dy != 0.0 else np.inf
            length = 0.0
            while length * cell < longest:
                if not (0 <= col < n_cols and 0 <= row < n_rows) or walls[n_rows - 1 - row, col]:
                    break
                if next_col < next_row:
                    length = next_col
                    next_col += per_col
                    col += step_col
                else:
                    length = next_row
                    next_row += per_row
                    row += step_row
            ranges[i, k] = min(length * cell, longest)
