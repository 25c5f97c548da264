"""What lies between a policy and its robot: commands that are late, lost or coarse, and senses that err.

Plain arithmetic on arrays of all environments; what is not randomised costs nothing.
"""

from __future__ import annotations

import numpy as np

from gridnav.problem.robot import Robot
from gridnav.problem.types import AnyArray, BoolArray, FloatArray, IntArray

from .draws import EVERYONE, Draws, Ids
from .lidar import Lidar

WATCHDOG_S = 0.5
"""Without a command for so long the firmware stops the robot (ROBOTIS-GIT/OpenCR ``turtlebot3.cpp``)."""
TURN_S = 0.2
"""Of the lidar: 5 turns a second (LDS-01)."""
REMEMBERED_S = 1.0
"""What the longest delays come to: a command's with jitter is 0.6 s, a scan's with its period and turn 1 s."""


MOST_SCANS_BEFORE = 1000
"""Scans before an episode's first moment that may arrive in it: their numbers must not be negative."""


def n_remembered(period_s: float) -> int:
    """Poses or commands, the present one among them, that delays reach back into."""
    return int(np.ceil(REMEMBERED_S / period_s - 1e-9)) + 2


class Commands:
    """What reaches the motors of ``n`` robots."""

    def __init__(self, draws: Draws, robot: Robot, n: int, period_s: float) -> None:
        self._draws, self._period_s = draws, period_s
        self._maxima = np.array([robot.max_speed_m_s, robot.max_turn_rad_s])
        self._max_speed_m_s = robot.max_speed_m_s
        self._in_force: FloatArray = np.zeros((n, 2))
        self._to_lose, self._silent_s = np.zeros(n, dtype=np.int64), np.zeros(n)
        self.is_active = draws.randomization.acts_on("command")

    def begin(self, ids: IntArray) -> None:
        """A new episode of these robots."""
        self._in_force[ids], self._to_lose[ids], self._silent_s[ids] = 0.0, 0, 0.0

    def pass_on(self, actions: FloatArray, steps: IntArray) -> FloatArray:
        """What is in force in this control period, as fractions of the maxima, shape ``(n, 2)``."""
        if not self.is_active:
            return actions
        draws = self._draws
        if not draws.varies("command_loss"):
            return self._quantised(actions)
        # Whether losses begin: with the probability drawn for the episode.
        begins = draws.shares("command_loss", steps, 1)[:, 0] < draws["command_loss"]
        begins &= self._to_lose == 0
        self._to_lose[begins] = np.rint(draws["command_loss_length"][begins]).astype(np.int64)
        is_lost = self._to_lose > 0
        self._to_lose[is_lost] -= 1
        arrived = ~is_lost
        self._in_force[arrived] = self._quantised(actions)[arrived]
        self._silent_s[:] = np.where(is_lost, self._silent_s + self._period_s, 0.0)
        return np.where(self._silent_s[:, None] >= WATCHDOG_S - 1e-9, 0.0, self._in_force)

    def _quantised(self, actions: FloatArray) -> FloatArray:
        if not self._draws.varies("command_quantum"):
            return actions
        steps = self._draws["command_quantum"][:, None] / self._maxima
        safe = np.where(steps > 0.0, steps, 1.0)
        return np.clip(np.where(steps > 0.0, np.rint(actions / safe) * safe, actions), -1.0, 1.0)

    def moving(self, wheels: FloatArray) -> FloatArray:
        """Wheel speeds as fractions of the maximum, without those in the deadband, shape ``(n, 2)``."""
        if not self._draws.varies("command_deadband_m_s"):
            return wheels
        dead = np.abs(wheels) * self._max_speed_m_s < self._draws["command_deadband_m_s"][:, None]
        return np.where(dead, 0.0, wheels)

    def delays_s(self, steps: IntArray) -> FloatArray:
        """Delay of this period's command, jitter included, shape ``(n,)``."""
        draws = self._draws
        if not draws.varies("command_jitter_s"):
            return draws["command_delay_s"]
        # Jitter: uniform between none and the largest of the episode.
        return draws["command_delay_s"] + draws.shares("command_jitter_s", steps, 1)[:, 0] * draws["command_jitter_s"]

    def arrays(self) -> dict[str, AnyArray]:
        """Everything that decides what comes next, by name; the arrays themselves."""
        return {"in_force": self._in_force, "to_lose": self._to_lose, "silent_s": self._silent_s}


class Senses:
    """What ``n`` robots take their surroundings for: pose, goal and scan as they are observed."""

    def __init__(self, draws: Draws, robot: Robot, n: int, period_s: float, size_m: tuple[float, float]) -> None:
        self._draws, self._period_s, self._range_m = draws, period_s, robot.lidar_range_m
        self._n_beams, self._size_m = robot.n_beams, np.array(size_m)
        self._past: FloatArray = np.zeros((n, n_remembered(period_s), 3))  # true poses, the present one first
        self._error: FloatArray = np.zeros((n, 3))
        self._is_dark = np.zeros((n, robot.n_beams), dtype=bool)
        self.poses: FloatArray = np.zeros((n, 3))
        """Estimated, as in ``NavigationVectorEnv``, shape ``(n, 3)``."""
        self.goals_w: FloatArray = np.zeros((n, 2))
        """Where the goals are thought to be, metres, shape ``(n, 2)``."""
        self.ranges_m: FloatArray = np.zeros((n, robot.n_beams))
        """What the lidars say, shape ``(n, n_beams)``."""
        self.is_active = draws.randomization.acts_on("sense")

    def begin(self, ids: IntArray, poses: FloatArray, goals_w: FloatArray, lidar: Lidar) -> None:
        """A new episode of these robots, which stand still; poses and goals are those of all robots."""
        if not self.is_active:
            return
        none, draws = np.zeros(len(ids), dtype=np.int64), self._draws
        self._past[ids] = poses[ids, None]
        self._error[ids] = 0.0
        # Where the goal is thought to be: normal around the truth.
        offset = draws.normals("goal_noise_m", none, 2, ids) * draws["goal_noise_m"][ids, None]
        self.goals_w[ids] = self._in_maze(goals_w[ids] + offset)
        self._is_dark[ids] = self._dark_beams(ids, none)
        self._look(ids, none, lidar)

    def advance(self, poses: FloatArray, steps: IntArray, lidar: Lidar) -> None:
        """A control period has passed, the ``steps``-th of each episode; poses are the true ones."""
        if not self.is_active:
            return
        self._drift(poses)
        self._past[:, 1:] = self._past[:, :-1]
        self._past[:, 0] = poses
        self._look(EVERYONE, steps, lidar)

    def _drift(self, poses: FloatArray) -> None:
        """Dead reckoning with a wrong heading and a wrong scale, pulled back to the truth by a scan matcher."""
        draws, error = self._draws, self._error
        if not draws.varies("heading_drift_rad_s", "odometry_scale"):
            return
        moved = poses[:, :2] - self._past[:, 0, :2]
        cos, sin = np.cos(error[:, 2]), np.sin(error[:, 2])
        turned = np.stack([cos * moved[:, 0] - sin * moved[:, 1], sin * moved[:, 0] + cos * moved[:, 1]], axis=1)
        error[:, :2] += turned * draws["odometry_scale"][:, None] - moved
        error[:, 2] += draws["heading_drift_rad_s"] * self._period_s
        error *= np.exp(-self._period_s / draws["localization_s"])[:, None]

    def _look(self, ids: Ids, steps: IntArray, lidar: Lidar) -> None:
        """What these robots observe, after so many steps of their episodes."""
        draws, estimated = self._draws, self._past[ids, 0] + self._error[ids]
        if draws.varies("position_noise_m"):
            estimated[:, :2] += draws.normals("position_noise_m", steps, 2, ids) * draws["position_noise_m"][ids, None]
        estimated[:, :2] = self._in_maze(estimated[:, :2])
        self.poses[ids] = estimated
        ages_s, scans = self._scan_times(ids, steps)
        ages = np.clip(ages_s / self._period_s, 0.0, self._past.shape[1] - 1.000001)
        ranges = lidar.sweep(self._past[ids], ages, draws["lidar_yaw_rad"][ids])
        self.ranges_m[ids] = self._misread(ranges, ids, scans)

    def _in_maze(self, points_w: FloatArray) -> FloatArray:
        """Estimates that lie outside the maze are its nearest edge: nobody is thought to be out there."""
        return np.clip(points_w, 0.0, self._size_m)

    def _scan_times(self, ids: Ids, steps: IntArray) -> tuple[FloatArray, IntArray]:
        """Age of each beam of these robots, seconds, shape ``(m, n_beams)``, and the scan's number, shape ``(m,)``."""
        draws = self._draws
        now, delay = steps * self._period_s, draws["lidar_delay_s"][ids]
        ages_s, number = delay, steps
        if draws.varies("lidar_period_s"):
            period = draws["lidar_period_s"][ids]
            regular = np.where(period > 0.0, period, 1.0)
            latest = np.floor((now - delay) / regular + 1e-9)
            ages_s = np.where(period > 0.0, now - latest * regular, delay)
            number = np.where(period > 0.0, latest + MOST_SCANS_BEFORE, steps).astype(np.int64)
        # A lidar turns counter-clockwise, as beams are counted: the last one of a turn is the youngest.
        within = draws["lidar_skew"][ids, None] * TURN_S * (1.0 - np.arange(self._n_beams) / self._n_beams)
        return ages_s[:, None] + within, number

    def _misread(self, ranges: FloatArray, ids: Ids, scans: IntArray) -> FloatArray:
        """Ranges of these robots as their lidars report them, shape ``(m, n_beams)``."""
        draws, n = self._draws, self._n_beams
        missed = self._is_dark[ids] | (ranges >= self._range_m)
        read = ranges * draws["lidar_scale"][ids, None] + draws["lidar_bias_m"][ids, None]
        if draws.varies("lidar_noise_m", "lidar_noise"):
            spread = draws["lidar_noise_m"][ids, None] + draws["lidar_noise"][ids, None] * ranges
            read += spread * draws.normals("lidar_noise_m", scans, n, ids)
        if draws.varies("lidar_dropout"):
            missed |= draws.shares("lidar_dropout", scans, n, ids) < draws["lidar_dropout"][ids, None]
        return np.clip(np.where(missed, self._range_m, read), 0.0, self._range_m)

    def _dark_beams(self, ids: IntArray, none: IntArray) -> BoolArray:
        """Which beams of these robots never find anything, shape ``(len(ids), n_beams)``."""
        # The first of them: uniform.
        first = np.floor(self._draws.shares("lidar_dark_beams", none, 1, ids) * self._n_beams)
        behind = (np.arange(self._n_beams) - first) % self._n_beams
        dark: BoolArray = behind < np.rint(self._draws["lidar_dark_beams"])[ids, None]
        return dark

    def arrays(self) -> dict[str, AnyArray]:
        """Everything that decides what comes next, by name; the arrays themselves."""
        return {"past": self._past, "error": self._error, "sensed_goals_w": self.goals_w, "is_dark": self._is_dark}
