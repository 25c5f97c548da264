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

    def sweep(self, past: FloatArray, ages: FloatArray, yaws_rad: FloatArray) -> FloatArray:
        """The same where the robot moves while the lidar turns, and its scans are late.

        Args:
            past: Poses of the robot as in ``scan``, the present one first, the others a period apart, ``(n, m, 3)``.
            ages: Of each beam, in periods, from 0 to less than m - 1, shape ``(n, n_beams)``; between two poses the
                robot moved along a straight line.
            yaws_rad: How far each lidar is turned on its robot, shape ``(n,)``.
        """
        robot, ranges = self._robot, np.empty(ages.shape)
        offset, longest = robot.lidar_offset_m, robot.lidar_range_m
        _sweep(past, ages, yaws_rad, self._directions, offset, self._walls, self._cell_size_m, longest, ranges)
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
    for i in range(len(poses)):
        ahead_x, ahead_y = np.cos(poses[i, 2]), np.sin(poses[i, 2])
        # In cells of the bordered maze from here on; rows are counted from below.
        x = (poses[i, 0] + offset * ahead_x) / cell + 1.0
        y = (poses[i, 1] + offset * ahead_y) / cell + 1.0
        for k in range(len(directions)):
            dx = ahead_x * directions[k, 0] - ahead_y * directions[k, 1]
            dy = ahead_x * directions[k, 1] + ahead_y * directions[k, 0]
            ranges[i, k] = min(_walk(x, y, dx, dy, walls) * cell, longest)


@numba.njit(cache=True)
def _sweep(
    past: FloatArray,
    ages: FloatArray,
    yaws: FloatArray,
    directions: FloatArray,
    offset: float,
    walls: BoolArray,
    cell: float,
    longest: float,
    ranges: FloatArray,
) -> None:
    for i in range(len(past)):
        cos_yaw, sin_yaw = np.cos(yaws[i]), np.sin(yaws[i])
        for k in range(len(directions)):
            newer = int(ages[i, k])
            share = ages[i, k] - newer
            later, earlier = past[i, newer], past[i, newer + 1]
            turned = (earlier[2] - later[2] + np.pi) % (2.0 * np.pi) - np.pi
            heading = later[2] + share * turned
            ahead_x, ahead_y = np.cos(heading), np.sin(heading)
            x = (later[0] + share * (earlier[0] - later[0]) + offset * ahead_x) / cell + 1.0
            y = (later[1] + share * (earlier[1] - later[1]) + offset * ahead_y) / cell + 1.0
            ahead_x, ahead_y = ahead_x * cos_yaw - ahead_y * sin_yaw, ahead_x * sin_yaw + ahead_y * cos_yaw
            dx = ahead_x * directions[k, 0] - ahead_y * directions[k, 1]
            dy = ahead_x * directions[k, 1] + ahead_y * directions[k, 0]
            ranges[i, k] = min(_walk(x, y, dx, dy, walls) * cell, longest)


@numba.njit(cache=True)
def _walk(x: float, y: float, dx: float, dy: float, walls: BoolArray) -> float:
    """Length in cells from a point to the first wall in a direction of length 1; 0 outside the bordered maze."""
    n_rows, n_cols = walls.shape
    col, row = int(np.floor(x)), int(np.floor(y))
    if not (0 <= col < n_cols and 0 <= row < n_rows):
        return 0.0
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
    return length
