"""Unicycle: a differential drive without inertia, motors or slip."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from gymnasium.vector import AutoresetMode

from gridnav.problem.geodesic import clearance
from gridnav.problem.types import AnyArray, BoolArray, FloatArray, IntArray

from .draws import COLUMN, NOMINAL, wheel_factors
from .imperfections import n_remembered
from .painter import Painter
from .randomization import PARAMETERS
from .robot_world import GRAZING, SAME_WALL, RobotEnv, RobotVectorEnv

DRIVE = tuple(name for name, parameter in PARAMETERS.items() if parameter.acts_on == "drive")
"""Quantities that a robot without motors knows."""
SUBSTEP_S = 0.01
"""Where a wall is near, contact is looked for this often: a robot at full speed moves 2 mm in it."""


class UnicycleVectorEnv(RobotVectorEnv):
    """``num_envs`` kinematic robots, stepped as arrays; see ``UnicycleEnv`` for the page of the environment."""

    metadata: dict[str, Any] = {
        "render_modes": ["rgb_array", "human"],
        "render_fps": 5,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }
    world = "Unicycle"

    def __init__(self, num_envs: int = 1, **shared: Any) -> None:
        self._painter: Painter | None = None
        super().__init__(num_envs, **shared)

    def _roll(self, actions: FloatArray) -> None:
        robot, (wheels, turn_factor) = self.robot, self._rolling(actions)
        _roll(
            self._pose,
            wheels,
            turn_factor,
            robot.max_speed_m_s,
            robot.max_turn_rad_s,
            self.control_period_s,
            robot.radius_m,
            self.task.on_collision == "slide",
            self.layout.walls,
            self.layout.cell_size_m,
            self.release_m,
            self._contact,
            self._contact_is_inner,
            self._travelled_m,
            self._begins,
            self._presses,
            self._speed,
        )

    def _use_layout(self) -> None:
        super()._use_layout()
        # Wheel fractions, the newest first.
        self._told: FloatArray = np.zeros((n_remembered(self.control_period_s), self.num_envs, 2))

    def _place(self, ids: IntArray) -> None:
        super()._place(ids)
        self._told[:, ids] = 0.0

    def _imperfections(self) -> dict[str, AnyArray]:
        return super()._imperfections() | {"told": self._told}

    def _rolling(self, actions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What the wheels do, as fractions of the nominal robot's maximum, and the factor on how they turn it.

        A delayed command begins within a period: the wheels turn at the mean of what they are told during it.
        """
        wheels, draws = self._wheel_fractions(actions), self._draws
        ones = np.ones(self.num_envs)
        if self._commands.is_active:
            self._told[1:] = self._told[:-1]
            self._told[0] = wheels
            back = np.clip(
                self._commands.delays_s(self._steps) / self.control_period_s, 0.0, len(self._told) - 1.000001
            )
            newer, ids = back.astype(np.int64), np.arange(self.num_envs)
            late = (back - newer)[:, None]
            wheels = (1.0 - late) * self._told[newer, ids] + late * self._told[newer + 1, ids]
        if not draws.varies(*DRIVE):
            return wheels, ones
        # The battery bounds the wheels' speed.
        fastest = draws["battery_v"][:, None] / NOMINAL[COLUMN["battery_v"]]
        radius = wheel_factors(draws["wheel_radius_ratio"]) * draws["wheel_radius"][:, None]
        return np.clip(wheels, -fastest, fastest) * radius, 1.0 / draws["wheel_separation"]

    def render(self) -> tuple[Any, ...] | None:
        """A picture per environment; the window of ``human`` shows the first."""
        if self.render_mode is None:
            return None
        self._painter = self._painter or Painter(fps=self.metadata["render_fps"])
        if self.render_mode == "human":
            self._painter.show(self.layout, self._pose[0], self._start[0], self._goal[0], self.robot.radius_m)
            return None
        return tuple(
            self._painter.picture(self.layout, pose, start, goal, self.robot.radius_m)
            for pose, start, goal in zip(self._pose, self._start, self._goal, strict=True)
        )

    def close_extras(self, **kwargs: Any) -> None:
        """Close the window."""
        if self._painter is not None:
            self._painter.close()
            self._painter = None


class UnicycleEnv(RobotEnv[UnicycleVectorEnv]):
    """A round robot with two wheels that follow their commands at once.

    ## Action space

    ``Box(-1, 1, (2,))``: forward and turning speed as fractions of the robot's maxima (0.197 m/s and 2.46 rad/s). Each
    wheel is clipped to its own maximum.

    ## Observation space

    ``Box`` of 35 numbers, the feature vector of ``gridnav.envs.observation``: 24 lidar beams, goal distance and
    bearing, position, heading, speed and last action.

    ## Reward

    See ``gridnav.Reward``; a control period of 0.2 s is 0.079 cell-times.

    ## Episode start and end

    The task draws start, goal and heading; the robot starts at a cell's centre, but for ``exploring_starts``.
    ``terminated`` within 0.15 m of the goal's centre; a wall refuses commands into it, but for those at less than 15
    degrees, until the robot has turned or backed off. ``truncated`` after ``max_episode_steps`` (500 with ``gym.make``:
    100 s).

    Args:
        shared: ``layout``, ``task``, ``reward``, ``render_mode``, ``control_period_s``, ``exploring_starts``,
            ``randomization`` (what it says of motors, masses and floors does not concern this robot) and
            ``max_episode_steps``, see ``RobotVectorEnv`` and ``NavigationVectorEnv``.
    """

    metadata: dict[str, Any] = {
        "render_modes": UnicycleVectorEnv.metadata["render_modes"],
        "render_fps": UnicycleVectorEnv.metadata["render_fps"],
    }

    def __init__(self, **shared: Any) -> None:
        super().__init__(UnicycleVectorEnv(1, autoreset=False, **shared))


# Not cached on disk: numba would not notice a change of `clearance`, which it compiles in from another file.
@numba.njit(cache=False)
def _roll(
    poses: FloatArray,
    wheels: FloatArray,
    turn_factor: FloatArray,
    max_speed: float,
    max_turn: float,
    period: float,
    radius: float,
    slides: bool,
    walls: BoolArray,
    cell: float,
    release: float,
    contact: FloatArray,
    contact_is_inner: BoolArray,
    travelled: FloatArray,
    begins: BoolArray,
    presses: BoolArray,
    speeds: FloatArray,
) -> None:
    """Constant-twist arcs (Siegwart et al. 2011, section 3.2.3), without their forward part at a wall."""
    n_substeps = int(np.ceil(period / SUBSTEP_S - 1e-9))
    for i in range(len(poses)):
        x, y, heading = poses[i]
        travelled[i], begins[i], presses[i] = 0.0, False, False
        forward, turning = (wheels[i, 0] + wheels[i, 1]) / 2, (wheels[i, 1] - wheels[i, 0]) / 2 * turn_factor[i]
        speed, turn = forward * max_speed, turning * max_turn
        # Far from walls one arc does; near them, short ones that look for contact.
        gap, _, _, _ = clearance(x, y, walls, cell)
        n = 1 if gap - radius > abs(speed) * period + release else n_substeps
        dt = period / n
        for _ in range(n):
            turned = turn * dt
            # sin(a)/a of half the angle turned: chord over arc, 1 for a straight line.
            chord = speed * dt * (np.sin(turned / 2) / (turned / 2) if abs(turned) > 1e-12 else 1.0)
            to_x, to_y = x + chord * np.cos(heading + turned / 2), y + chord * np.sin(heading + turned / 2)
            way = abs(speed) * dt
            gap, ux, uy, inner = clearance(to_x, to_y, walls, cell)
            into = (to_x - x) * ux + (to_y - y) * uy
            if gap < radius and into > 0.0:
                if slides or contact[i, 0] * ux + contact[i, 1] * uy <= SAME_WALL:
                    begins[i] = True
                contact[i, 0], contact[i, 1] = ux, uy
                contact_is_inner[i] = inner
                presses[i] = not slides
                goes_on = slides or into <= GRAZING * abs(chord)
                if goes_on:
                    to_x, to_y = to_x + ux * (gap - radius), to_y + uy * (gap - radius)
                if not goes_on or clearance(to_x, to_y, walls, cell)[0] < radius - 1e-6:  # a second wall
                    to_x, to_y = x, y
                way = np.hypot(to_x - x, to_y - y)
            elif gap > radius + release:
                contact[i, 0] = contact[i, 1] = 0.0
            travelled[i] += way
            x, y, heading = to_x, to_y, heading + turned
        poses[i, 0], poses[i, 1], poses[i, 2] = x, y, (heading + np.pi) % (2 * np.pi) - np.pi
        speeds[i, 0] = np.copysign(travelled[i], forward) / (period * max_speed)
        speeds[i, 1] = turning
