"""What the two robot worlds share: continuous commands, metres, one control period per step."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box

from gridnav.problem.geodesic import Geodesic
from gridnav.problem.types import AnyArray, BoolArray, FloatArray, InputError, IntArray

from .navigation import Motion, NavigationEnv, NavigationVectorEnv, VectorWorld, as_array

RELEASE_M = 0.01
"""A contact is over once the bumper is this far from the wall: until then it is counted and charged once."""
SAME_WALL = 0.7
"""Cosine of the angle up to which two directions of contact mean one wall: another wall is another collision."""


class RobotVectorEnv(NavigationVectorEnv):
    """``num_envs`` robots that take a forward and a turning command per control period.

    A robot whose bumper meets a wall is stopped: it can turn and back off, and commands into the wall are refused. The
    contact is counted once, and again for every cell-time that the robot keeps pressing, as the grid counts every bump.
    Where the task lets robots slide, nothing is refused and every period with a contact is charged.

    Args:
        num_envs: Robots in the batch.
        control_period_s: Time between two commands, seconds; 0.2 s is one turn of the lidar (5 Hz).
        shared: See ``NavigationVectorEnv``.
    """

    def __init__(self, num_envs: int = 1, *, control_period_s: float = 0.2, **shared: Any) -> None:
        if not 0.01 <= control_period_s <= 1.0:
            raise InputError(f"control_period_s {control_period_s} is outside 0.01 to 1 s")
        self.control_period_s = float(control_period_s)
        super().__init__(num_envs, **shared)

    @property
    def step_duration(self) -> float:
        """Cell-times per control period; a cell-time is a cell at the robot's top speed."""
        return self.control_period_s * self.robot.max_speed_m_s / self.layout.cell_size_m

    def _spaces(self) -> tuple[gym.Space[Any], gym.Space[Any]]:
        return self._features.space, Box(-1.0, 1.0, (2,), np.float32)

    def _use_layout(self) -> None:
        super()._use_layout()
        self._geodesic = Geodesic(self.layout, self.robot.radius_m)
        self._goal_number = np.zeros(self.num_envs, dtype=np.int64)
        # Direction of the wall that the bumper met last and has not left, zero without one.
        self._contact: FloatArray = np.zeros((self.num_envs, 2))
        self._contact_is_inner = np.zeros(self.num_envs, dtype=bool)
        self._pressed_s: FloatArray = np.zeros(self.num_envs)

    def _place(self, ids: IntArray) -> None:
        for i in ids:
            row, col = self._goal[i].tolist()
            self._goal_number[i] = self._geodesic.goal_number((row, col))
        self._contact[ids] = 0.0
        self._pressed_s[ids] = 0.0

    def _motion(self, travelled: FloatArray, begins: BoolArray, refused: BoolArray, failed: BoolArray) -> Motion:
        """What a period did, with another collision for every cell-time of pressing against a wall.

        Args:
            travelled: Metres, shape ``(n,)``.
            begins: A contact began (or, sliding, went on), shape ``(n,)``.
            refused: A command into the wall was refused, shape ``(n,)``.
            failed: The physics diverged, shape ``(n,)``.
        """
        self._pressed_s = np.where(refused & ~begins, self._pressed_s + self.control_period_s, 0.0)
        again = self._pressed_s >= self.layout.cell_size_m / self.robot.max_speed_m_s
        self._pressed_s[again] = 0.0
        hit = (begins | again) & ~failed
        return Motion(np.where(failed, 0.0, travelled), hit, hit & self._contact_is_inner, failed)

    def _distances(self, ids: IntArray | slice) -> FloatArray:
        return self._geodesic.distances(self._pose[ids, :2], self._goal_number[ids]) / self.layout.cell_size_m

    def _arrived(self) -> BoolArray:
        gap = self._pose[:, :2] - self._goal_w
        arrived: BoolArray = np.hypot(gap[:, 0], gap[:, 1]) <= self.task.goal_radius_m
        return arrived

    def _valid(self, actions: AnyArray) -> AnyArray:
        array = as_array(actions)
        if array.shape != (self.num_envs, 2) or array.dtype.kind not in "fiu":
            raise InputError(
                f"action of shape {array.shape} and type {array.dtype} must be two numbers per robot: forward and turn"
            )
        if not np.isfinite(array).all():
            raise InputError(f"action {array[~np.isfinite(array).all(axis=1)][0].tolist()} must be finite numbers")
        # Beyond the box a command means full speed: a robot's firmware clips it too.
        return np.clip(array.astype(np.float64), -1.0, 1.0)


class RobotEnv(NavigationEnv[VectorWorld]):
    """One robot of a ``RobotVectorEnv``."""

    worlds: Any

    @property
    def control_period_s(self) -> float:
        """Time between two commands, seconds."""
        return float(self.worlds.control_period_s)


def towards(direction: FloatArray, headings: FloatArray, forward: FloatArray) -> BoolArray:
    """Whether commands drive into what lies in a direction.

    Args:
        direction: Unit vectors, world frame, shape ``(n, 2)``.
        headings: Radians, shape ``(n,)``.
        forward: Forward commands, negative for backwards, shape ``(n,)``.
    """
    along = forward * (direction[:, 0] * np.cos(headings) + direction[:, 1] * np.sin(headings))
    into: BoolArray = along > 1e-3
    return into
