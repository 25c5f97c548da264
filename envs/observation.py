"""The shared feature vector: the same named slices, units and bounds in every world."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from gridnav.problem.layout import Layout
from gridnav.problem.robot import Robot
from gridnav.problem.types import FloatArray


@dataclass(frozen=True)
class Feature:
    """One named slice of the feature vector."""

    name: str
    size: int
    unit: str
    low: float
    high: float
    meaning: str


class FeatureVector:
    """What a robot senses, as one float32 vector of dimensionless numbers.

    Lengths are divided by the lidar's range, speeds by the robot's maxima, positions by half the maze, so that the
    numbers are near [-1, 1] and mean the same in every world.

    Args:
        layout: The maze; bounds depend on its size alone.
        robot: The robot that senses.
    """

    def __init__(self, layout: Layout, robot: Robot) -> None:
        self._layout, self._robot = layout, robot
        farthest = float(np.hypot(*layout.size_m)) / robot.lidar_range_m
        self.features = (
            Feature("lidar", robot.n_beams, "lidar range", 0.0, 1.0, "ranges, beam 0 ahead, counter-clockwise"),
            Feature("goal_distance", 1, "lidar range", 0.0, farthest, "straight line to the goal"),
            Feature("goal_bearing", 2, "1", -1.0, 1.0, "cosine and sine of the goal's direction, robot frame"),
            Feature("position", 2, "half the maze", -1.0, 1.0, "x and y from the maze's centre, world frame"),
            Feature("heading", 2, "1", -1.0, 1.0, "cosine and sine of the heading, world frame"),
            Feature("speed", 2, "maximum speed", -1.5, 1.5, "forward and turning speed, robot frame"),
            Feature("last_action", 2, "maximum speed", -1.0, 1.0, "forward and turning command of the last step"),
        )
        ends = np.cumsum([feature.size for feature in self.features]).tolist()
        self.slices = {f.name: slice(end - f.size, end) for f, end in zip(self.features, ends, strict=True)}

        width, height = layout.size_m
        self._scales = (width / 2, height / 2, robot.lidar_range_m)

    @property
    def space(self) -> Box:
        """Bounds of the vector, shape ``(35,)`` with 24 beams."""
        low = np.concatenate([np.full(f.size, f.low) for f in self.features])
        high = np.concatenate([np.full(f.size, f.high) for f in self.features])
        return Box(low.astype(np.float32), high.astype(np.float32))

    def observe(
        self, poses: FloatArray, ranges_m: FloatArray, goals_w: FloatArray, speeds: FloatArray, last_actions: FloatArray
    ) -> NDArray[np.float32]:
        """Feature vectors of ``n`` robots.

        Args:
            poses: x and y in metres and heading in radians, world frame, shape ``(n, 3)``.
            ranges_m: Lidar ranges, shape ``(n, n_beams)``.
            goals_w: Goal centres in metres, world frame, shape ``(n, 2)``.
            speeds: Forward and turning speed as fractions of the maxima, robot frame, shape ``(n, 2)``.
            last_actions: Last command, same unit, shape ``(n, 2)``.

        Returns:
            Shape ``(n, 35)`` with 24 beams; a fresh array.
        """
        observations = np.empty((len(poses), self.slices["last_action"].stop), dtype=np.float32)
        _fill(poses, ranges_m, goals_w, speeds, last_actions, *self._scales, observations)
        return observations

    def poses_and_goals(self, observations: NDArray[np.float32]) -> tuple[FloatArray, FloatArray]:
        """Poses and goal centres that feature vectors stand for, for controllers that steer by them.

        Args:
            observations: Shape ``(n, 35)`` with 24 beams.

        Returns:
            Poses ``(n, 3)`` (metres, metres, radians) and goals ``(n, 2)`` in metres, world frame.
        """
        part = {name: observations[:, where].astype(np.float64) for name, where in self.slices.items()}
        position = (part["position"] + 1.0) * np.asarray(self._layout.size_m) / 2
        heading = np.arctan2(part["heading"][:, 1], part["heading"][:, 0])
        bearing = np.arctan2(part["goal_bearing"][:, 1], part["goal_bearing"][:, 0]) + heading
        distance = part["goal_distance"] * self._robot.lidar_range_m
        goals = position + distance * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
        return np.column_stack([position, heading]), goals


@numba.njit(cache=True)
def _fill(
    poses: FloatArray,
    ranges_m: FloatArray,
    goals_w: FloatArray,
    speeds: FloatArray,
    last_actions: FloatArray,
    half_width: float,
    half_height: float,
    lidar_range: float,
    out: NDArray[np.float32],
) -> None:
    """The slices in the order of ``FeatureVector.features``."""
    n_beams = ranges_m.shape[1]
    for i in range(len(poses)):
        x, y, heading = poses[i, 0], poses[i, 1], poses[i, 2]
        dx, dy = goals_w[i, 0] - x, goals_w[i, 1] - y
        bearing = np.arctan2(dy, dx) - heading
        for k in range(n_beams):
            out[i, k] = ranges_m[i, k] / lidar_range
        out[i, n_beams] = np.hypot(dx, dy) / lidar_range
        out[i, n_beams + 1], out[i, n_beams + 2] = np.cos(bearing), np.sin(bearing)
        out[i, n_beams + 3], out[i, n_beams + 4] = x / half_width - 1.0, y / half_height - 1.0
        out[i, n_beams + 5], out[i, n_beams + 6] = np.cos(heading), np.sin(heading)
        for k in range(2):
            out[i, n_beams + 7 + k] = min(max(speeds[i, k], -1.5), 1.5)
            out[i, n_beams + 9 + k] = last_actions[i, k]
