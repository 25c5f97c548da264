"""DiffDrive: a MuJoCo robot with wheels that roll and slip, motors, contacts and lidar."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from gymnasium.vector import AutoresetMode
from mujoco.batch import Batch

from gridnav.problem.geodesic import clearances
from gridnav.problem.types import AnyArray, BoolArray, FloatArray, InputError, IntArray

from . import gl
from .mjcf import build_model
from .navigation import Motion
from .robot_world import RELEASE_M, SAME_WALL, RobotEnv, RobotVectorEnv, towards

BUMPER_PERIOD_S = 0.05
"""The bumper is looked at this often: the Burger publishes its sensors at 20 Hz."""
CONTACT_MARGIN_M = 0.003
"""A bumper this close to a wall after a contact still counts as pressed: soft contacts push the robot out a little."""
CAMERAS = ("above", "chase", "onboard")


class DiffDriveVectorEnv(RobotVectorEnv):
    """``num_envs`` MuJoCo robots on MuJoCo's own thread pool; see ``DiffDriveEnv`` for the page of the environment.

    Args:
        num_envs: Robots in the batch.
        n_threads: Threads of the physics, 0 for all cores. The trajectories do not depend on it.
        camera: The camera of ``rgb_array``: ``above``, ``chase`` or ``onboard``.
        width: Of the picture, pixels.
        height: Of the picture, pixels.
        shared: See ``RobotVectorEnv``.
    """

    metadata: dict[str, Any] = {
        "render_modes": ["rgb_array"],
        "render_fps": 5,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }
    world = "DiffDrive"

    def __init__(
        self,
        num_envs: int = 1,
        *,
        n_threads: int = 0,
        camera: str = "above",
        width: int = 480,
        height: int = 480,
        **shared: Any,
    ) -> None:
        if camera not in CAMERAS:
            raise InputError(f"camera {camera!r} is none of {', '.join(CAMERAS)}")
        self._n_threads = n_threads
        self._camera, self._picture_size = camera, (width, height)
        self._renderer: mujoco.Renderer | None = None
        super().__init__(num_envs, **shared)

    def _use_layout(self) -> None:
        super()._use_layout()
        self.model = build_model(self.layout, goal_radius_m=self.task.goal_radius_m)
        timestep = self.model.opt.timestep
        n_substeps = round(self.control_period_s / timestep)
        if not np.isclose(n_substeps * timestep, self.control_period_s):
            raise InputError(
                f"control_period_s {self.control_period_s} is no multiple of the physics timestep of {timestep} s"
            )
        per_look = max(1, round(BUMPER_PERIOD_S / timestep))
        self._looks = [min(per_look, n_substeps - done) for done in range(0, n_substeps, per_look)]
        self._batch = Batch(self.model, self.num_envs, nthread=self._n_threads)
        self._qpos, self._qvel, self._ctrl = (self._batch.bind(name) for name in ("qpos", "qvel", "ctrl"))
        self._close_renderer()

    def _place(self, ids: IntArray) -> None:
        super()._place(ids)
        self._rest(ids)

    def _rest(self, ids: IntArray) -> None:
        """Clear everything that the engine knows of robots and stand them at ``self._pose``."""
        self._batch.reset(ids)
        half = self._pose[ids, 2] / 2
        self._qpos[ids, :2] = self._pose[ids, :2]
        self._qpos[ids, 3] = np.cos(half)
        self._qpos[ids, 4:6] = 0.0
        self._qpos[ids, 6] = np.sin(half)

    def _drive(self, actions: AnyArray) -> Motion:
        wheels = self.robot.wheel_fractions(actions)
        forward = wheels.mean(axis=1)
        n, stops = self.num_envs, self.task.on_collision != "slide"
        travelled = np.zeros(n)
        begins, refused = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
        position = self._qpos[:, :2].copy()
        gap, direction, inner = clearances(position, self.layout)
        with np.errstate(invalid="ignore", over="ignore"):  # a robot whose physics diverges is dealt with below
            for n_substeps in self._looks:
                into = towards(direction, _headings(self._qpos), forward)
                refuse = stops & self._knows(direction) & into & (gap < self.robot.radius_m + CONTACT_MARGIN_M)
                refused |= refuse
                allowed = wheels - np.where(refuse, forward, 0.0)[:, None]
                self._ctrl[:] = allowed * self.robot.max_wheel_speed_rad_s
                self._batch.step(nstep=n_substeps)
                gap, direction, inner = clearances(self._qpos[:, :2], self.layout)
                touches = (gap < self.robot.radius_m) & towards(direction, _headings(self._qpos), forward)
                begins |= touches & ~self._knows(direction) if stops else touches
                self._contact[touches], self._contact_is_inner[touches] = direction[touches], inner[touches]
                self._contact[gap > self.robot.radius_m + RELEASE_M] = 0.0
                travelled += np.hypot(*(self._qpos[:, :2] - position).T)
                position[:] = self._qpos[:, :2]
        failed = self._diverged()
        if failed.any():
            # Back to the last good pose, so that what is observed stays finite.
            self._rest(np.flatnonzero(failed))
        self._sense()
        self._last_action = actions
        return self._motion(travelled, begins, refused, failed)

    def _knows(self, direction: FloatArray) -> BoolArray:
        """Whether the nearest wall is the one that the bumper already met."""
        known: BoolArray = (self._contact * direction).sum(axis=1) > SAME_WALL
        return known

    def _sense(self) -> None:
        heading = _headings(self._qpos)
        self._pose = np.column_stack([self._qpos[:, :2], heading])
        forward = self._qvel[:, 0] * np.cos(heading) + self._qvel[:, 1] * np.sin(heading)
        # A free joint's angular velocity is in the body frame; its z axis is the robot's.
        turn = self._qvel[:, 5]
        self._speed = np.column_stack([forward / self.robot.max_speed_m_s, turn / self.robot.max_turn_rad_s])

    def _diverged(self) -> BoolArray:
        """Non-finite states, and warnings of the engine, which stay counted until the environment's next reset."""
        finite = np.isfinite(self._qpos).all(axis=1) & np.isfinite(self._qvel).all(axis=1)
        diverged: BoolArray = ~finite | (self._batch.warning[:, :, 1] > 0).any(axis=1)
        return diverged

    def render(self) -> tuple[Any, ...] | None:
        """A picture per environment, shape ``(height, width, 3)``, from the chosen camera.

        Raises:
            gl.RenderingError: When no GL back end works; the message says what to install.
        """
        if self.render_mode is None:
            return None
        if self._renderer is None:
            width, height = self._picture_size
            self._renderer = gl.make_renderer(self.model, width, height)
            self._scene_data = mujoco.MjData(self.model)
        pictures = []
        for i in range(self.num_envs):
            self._scene_data.qpos[:] = self._qpos[i]
            self._scene_data.mocap_pos[0] = [*self._goal_w[i], 0.002]
            mujoco.mj_forward(self.model, self._scene_data)
            self._renderer.update_scene(self._scene_data, camera=self._camera)
            pictures.append(self._renderer.render())
        return tuple(pictures)

    def close_extras(self, **kwargs: Any) -> None:
        """Release the graphics context."""
        self._close_renderer()

    def _close_renderer(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


class DiffDriveEnv(RobotEnv[DiffDriveVectorEnv]):
    """A TurtleBot3 Burger in MuJoCo: free body, two driven wheels, a caster, a round bumper and a planar lidar.

    ## Action space

    ``Box(-1, 1, (2,))``: forward and turning speed as fractions of the robot's maxima (0.197 m/s and 2.46 rad/s, the
    motors' no-load speeds; friction takes about 9 % at full speed). The command is held for one control period.

    ## Observation space

    ``Box`` of 35 numbers, the feature vector of ``gridnav.envs.observation``: 24 lidar beams, goal distance and
    bearing, position, heading, speed and last action.

    ## Reward

    See ``gridnav.Reward``; a control period of 0.2 s is 0.079 cell-times.

    ## Episode start and end

    The task draws start, goal and heading; the robot starts at rest at a cell's centre. ``terminated`` within 0.15 m of
    the goal's centre, or when the physics diverges (``info["physics_error"]``); a wall refuses commands into
    it until the robot has turned or backed off. ``truncated`` after ``max_episode_steps`` (500 with
    ``gym.make``: 100 s).

    Args:
        shared: ``layout``, ``task``, ``reward``, ``render_mode``, ``control_period_s``, ``camera``, ``width``,
            ``height`` and ``max_episode_steps``, see ``DiffDriveVectorEnv``.
    """

    metadata: dict[str, Any] = {
        "render_modes": DiffDriveVectorEnv.metadata["render_modes"],
        "render_fps": DiffDriveVectorEnv.metadata["render_fps"],
    }

    def __init__(self, **shared: Any) -> None:
        # One robot gives a second thread nothing to do.
        super().__init__(DiffDriveVectorEnv(1, n_threads=1, autoreset=False, **shared))

    @property
    def model(self) -> mujoco.MjModel:
        """The compiled model of the current layout."""
        return self.worlds.model


def _headings(qpos: FloatArray) -> FloatArray:
    """Yaw of free joints, radians in (-pi, pi], shape ``(n,)``; MuJoCo's quaternions are w, x, y, z."""
    w, x, y, z = qpos[:, 3:7].T
    headings: FloatArray = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return headings
