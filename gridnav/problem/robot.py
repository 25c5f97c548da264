"""The robot as numbers: a TurtleBot3 Burger, with the source of each number."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from gridnav.problem.types import FloatArray, InputError

LIDAR_HEIGHT_M = 0.182
"""Of the scan plane of a TurtleBot3 Burger above the floor (ROBOTIS-GIT/turtlebot3, ``burger.urdf``)."""


@dataclass(frozen=True)
class Robot:
    """A differential drive with a round bumper and a planar lidar.

    The defaults are those of the TurtleBot3 Burger. ``T`` is ROBOTIS-GIT/turtlebot3, ``O`` is
    ROBOTIS-GIT/OpenCR, ``M`` is the e-manual of ROBOTIS.
    """

    radius_m: float = 0.105
    """Bumper radius around the axle's centre, metres (O ``turtlebot3_burger.h``)."""
    wheel_radius_m: float = 0.033
    """Metres (T ``burger.yaml``, ``turtlebot3_burger.urdf``; O agrees)."""
    wheel_separation_m: float = 0.160
    """Distance between the wheels' contact points, metres (same sources)."""
    max_wheel_speed_rad_s: float = 5.969
    """No-load speed of the XL430-W250 at 11.1 V: 57 rpm (M ``xl430-w250``)."""
    lidar_offset_m: float = -0.032
    """The lidar stands this far ahead of the axle (negative: behind), metres (T URDF, ``base_scan``)."""
    lidar_range_m: float = 3.5
    """Longest range of the LDS-01, metres (M appendix LDS-01)."""
    n_beams: int = 24
    """Beams of a scan, evenly spaced over 360 degrees, the first ahead, counter-clockwise."""

    def __post_init__(self) -> None:
        for name in ("radius_m", "wheel_radius_m", "wheel_separation_m", "max_wheel_speed_rad_s", "lidar_range_m"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise InputError(f"robot {name} {getattr(self, name)} must be a positive number")
        if not abs(self.lidar_offset_m) <= self.radius_m:
            raise InputError(
                f"robot lidar_offset_m {self.lidar_offset_m} must lie within the radius of {self.radius_m} m"
            )
        if isinstance(self.n_beams, bool) or not isinstance(self.n_beams, int) or not 1 <= self.n_beams <= 360:
            raise InputError(f"robot n_beams {self.n_beams} must be a whole number from 1 to 360")

    @property
    def max_speed_m_s(self) -> float:
        """Forward speed with both wheels at their maximum: 0.197 m/s for the Burger."""
        return self.max_wheel_speed_rad_s * self.wheel_radius_m

    @property
    def max_turn_rad_s(self) -> float:
        """Turning speed with the wheels at opposite maxima: 2.46 rad/s for the Burger."""
        return 2.0 * self.max_speed_m_s / self.wheel_separation_m

    @property
    def beam_angles_rad(self) -> FloatArray:
        """Direction of each beam in the robot frame, shape ``(n_beams,)``."""
        return np.arange(self.n_beams) * (2.0 * np.pi / self.n_beams)

    def wheel_turns(self, ahead_m: FloatArray, turned_rad: FloatArray | float) -> FloatArray:
        """How far the wheels roll for a motion without slip.

        Args:
            ahead_m: Way of the axle's centre, shape ``(n,)``, metres.
            turned_rad: Change of heading, counter-clockwise, radians.

        Returns:
            Left and right wheel, radians, shape ``(n, 2)``.
        """
        aside_m = turned_rad * self.wheel_separation_m / 2
        return np.column_stack([ahead_m - aside_m, ahead_m + aside_m]) / self.wheel_radius_m

    def wheel_fractions(self, actions: FloatArray) -> FloatArray:
        """Wheel speeds for a forward and a turning command.

        The firmware clips each wheel by itself (O ``turtlebot3_motor_driver``), so a full-speed
        command with a turn slows the inner wheel and cannot speed up the outer one.

        Args:
            actions: Forward and turning speed as fractions of the maxima, shape ``(n, 2)``.

        Returns:
            Left and right wheel speed as fractions of the maximum, shape ``(n, 2)``, in [-1, 1].
        """
        wheels = np.empty((len(actions), 2))
        _wheel_fractions(actions, wheels)
        return wheels


@numba.njit(cache=True)
def _wheel_fractions(actions: FloatArray, wheels: FloatArray) -> None:
    for i in range(len(actions)):
        forward, turn = actions[i, 0], actions[i, 1]
        wheels[i, 0] = min(max(forward - turn, -1.0), 1.0)
        wheels[i, 1] = min(max(forward + turn, -1.0), 1.0)


BURGER = Robot()
