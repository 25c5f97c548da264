"""DiffDrive: a MuJoCo robot with wheels that roll and slip, motors, contacts and lidar."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import mujoco
import numba
import numpy as np
from gymnasium.vector import AutoresetMode
from mujoco.batch import Batch

from gridnav.problem.geodesic import clearances
from gridnav.problem.robot import BURGER, Robot
from gridnav.problem.types import BoolArray, FloatArray, InputError, IntArray, State

from . import gl
from .mjcf import build_spec
from .physics import LONGEST_DELAY_S, Physics
from .robot_world import GRAZING, SAME_WALL, RobotEnv, RobotVectorEnv

TIMESTEP_S = 0.025
"""By measurement, see docs/speed.md: 10 ms is four times as accurate and takes more than twice as long."""
BUMPER_PERIOD_S = 0.1
"""The bumper is answered to no less often than this: TurtleBot3's navigation steers at 10 Hz (T move_base)."""
CONTACT_MARGIN_M = 0.003
"""A bumper this close to a wall that it met still touches it: soft contacts push a sliding robot out a little."""
INTO_WALL = 1e-3
"""Forward command times the cosine of the angle to a wall from which on a command drives into it."""
CAME_M = 0.001
"""Towards a wall between two looks, from which on a robot has driven into it whatever its command was."""
LIDAR: dict[str, Any] = {"n_beams": 1, "lidar_range_m": 1.0, "lidar_offset_m": 0.0}
CAMERAS = ("above", "chase", "onboard")
log = logging.getLogger("gridnav")
EditModel = Callable[[mujoco.MjSpec], None]


class DiffDriveVectorEnv(RobotVectorEnv):
    """``num_envs`` MuJoCo robots on MuJoCo's own thread pool; see ``DiffDriveEnv`` for the page of the environment.

    Args:
        num_envs: Robots in the batch.
        robot: The Burger, whose lidar may have other numbers.
        timestep_s: Longest timestep of the physics, seconds; a whole number of timesteps makes a control period.
        n_threads: Threads of the physics, 0 for all cores. The trajectories do not depend on it.
        edit_model: Changes the model's specification before it is compiled; joints may come after the robot's own.
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
        robot: Robot = BURGER,
        timestep_s: float = TIMESTEP_S,
        n_threads: int = 0,
        edit_model: EditModel | None = None,
        camera: str = "above",
        width: int = 480,
        height: int = 480,
        **shared: Any,
    ) -> None:
        if camera not in CAMERAS:
            raise InputError(f"camera {camera!r} is none of {', '.join(CAMERAS)}")
        if not 0.0005 <= timestep_s <= TIMESTEP_S:
            raise InputError(f"timestep_s {timestep_s} is outside 0.0005 to {TIMESTEP_S} s")
        if replace(robot, **LIDAR) != replace(BURGER, **LIDAR):
            raise InputError(f"{robot} is no Burger: the compiled model is, so only the lidar's numbers may differ")
        self._timestep_s, self._n_threads = float(timestep_s), n_threads
        self._edit_model = edit_model
        self._camera, self._picture_size = camera, (width, height)
        self._renderer: mujoco.Renderer | None = None
        super().__init__(num_envs, robot=robot, **shared)

    def _use_layout(self) -> None:
        super()._use_layout()
        n_substeps = int(np.ceil(self.control_period_s / self._timestep_s - 1e-9))
        timestep_s = self.control_period_s / n_substeps
        is_late = not {"command_delay_s", "command_jitter_s"}.isdisjoint(self.randomization.names)
        n_kept = int(np.ceil(LONGEST_DELAY_S / timestep_s)) + 2 if is_late else 0
        spec = build_spec(self.layout, goal_radius_m=self.task.goal_radius_m, n_kept_commands=n_kept)
        spec.option.timestep = timestep_s
        if self._edit_model is not None:
            self._edit_model(spec)
        self.model = spec.compile()
        _hush()
        per_look = max(1, int(BUMPER_PERIOD_S / self.model.opt.timestep + 1e-9))
        # How many substeps are made at once between two looks.
        self._looks = [min(per_look, n_substeps - done) for done in range(0, n_substeps, per_look)]
        self._batch = Batch(self.model, self.num_envs, nthread=self._n_threads)
        self._physics = Physics(self._batch, self.model, self._draws)
        self._is_late = is_late
        # Motors follow within 10 ms, so where nothing varies a command says where a robot goes. Commands that are late,
        # pushes and slopes drive robots into walls that nobody told them to.
        self._goes_astray = bool(self.randomization.names)
        self._qpos, self._qvel, self._ctrl = (self._batch.bind(name) for name in ("qpos", "qvel", "ctrl"))
        self._close_renderer()

    def _place(self, ids: IntArray) -> None:
        super()._place(ids)
        self._physics.apply(ids)
        self._rest(ids)

    def _rest(self, ids: IntArray) -> None:
        """Clear everything that the engine knows of robots and stand them at ``self._pose``."""
        self._batch.reset(ids)
        half = self._pose[ids, 2] / 2
        self._qpos[ids, :2] = self._pose[ids, :2]
        self._qpos[ids, 3] = np.cos(half)
        self._qpos[ids, 4:6] = 0.0
        self._qpos[ids, 6] = np.sin(half)

    def _roll(self, actions: FloatArray) -> None:
        wheels, position = self._wheel_fractions(actions), np.empty((self.num_envs, 2))
        delays_s = self._commands.delays_s(self._steps) if self._is_late else None
        self._physics.begin_period(self._steps, self.control_period_s, delays_s, self._qvel)
        ids = np.flatnonzero(~self._parked) if self._parked.any() else None
        for n_substeps in [0, *self._looks]:
            if n_substeps:
                self._batch.step(ids, nstep=n_substeps)
            gap, direction, inner = clearances(self._qpos, self.layout)
            _bump(
                n_substeps == 0,
                self.task.on_collision != "slide",
                CAME_M if self._goes_astray else np.inf,
                SAME_WALL,
                GRAZING,
                self.release_m,
                self.robot.radius_m,
                self.robot.max_wheel_speed_rad_s,
                self._qpos,
                wheels,
                gap,
                direction,
                inner,
                position,
                self._contact,
                self._contact_is_inner,
                self._travelled_m,
                self._begins,
                self._presses,
                self._ctrl,
            )
        n_failed = _sense(
            self.robot.max_speed_m_s,
            self.robot.max_turn_rad_s,
            self._qpos,
            self._qvel,
            self._batch.warning,
            self._pose,
            self._speed,
            self._failed,
        )
        if n_failed:
            # Back to the last good pose, so that what is observed stays finite.
            self._rest(np.flatnonzero(self._failed))

    @property
    def lean_rad(self) -> FloatArray:
        """Angle between each robot's own up and the world's, radians, shape ``(n,)``."""
        _, _, _, _, x, y, _ = self._qpos[:, :7].T
        return np.arccos(np.clip(1.0 - 2.0 * (x**2 + y**2), -1.0, 1.0))

    def get_state(self) -> State:
        """Everything that decides what comes next, the engine's own state included."""
        arrays, values = super().get_state()
        return State(arrays | {"physics": np.array(self._batch.state)}, values)

    def set_state(self, state: State) -> None:
        """Go on where an environment that was made alike was: what follows is equal bit for bit.

        Raises:
            InputError: When the state is that of another kind or number of environments.
        """
        if "physics" not in state.arrays or state.arrays["physics"].shape != self._batch.state.shape:
            raise InputError(f"the state is not that of {self.num_envs} environments of {self.world}")
        super().set_state(state)
        self._physics.apply(np.arange(self.num_envs))
        self._batch.state[:] = state.arrays["physics"]

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

    The task draws start, goal and heading; the robot starts at rest at a cell's centre, but for ``exploring_starts``.
    ``terminated`` within 0.15 m of the goal's centre, or when the physics diverges (``info["physics_error"]``); a wall
    refuses commands into it, but for those at less than 15 degrees, until the robot has turned or backed off.
    ``truncated`` after ``max_episode_steps`` (500 with ``gym.make``: 100 s).

    ## Physics

    MuJoCo steps of 25 ms (``timestep_s``), eight to a control period; the bumper is looked at after every 0.1 s.

    Args:
        shared: ``layout``, ``task``, ``reward``, ``render_mode``, ``control_period_s``, ``exploring_starts``,
            ``randomization``, ``timestep_s``, ``robot``, ``camera``, ``width``, ``height`` and ``max_episode_steps``,
            see ``DiffDriveVectorEnv``.
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


def _hush() -> None:
    """Send MuJoCo's warnings to the log, unless somebody listens already.

    Else it prints them and writes ``MUJOCO_LOG.TXT`` where the user happens to be. Diverged physics is in ``info``.
    """
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(log.info)


# `clearances` is called beforehand and constants of other files are passed in: what is compiled and kept on disk does
# not notice when another file changes.
@numba.njit(cache=True)
def _bump(
    is_first: bool,
    stops: bool,
    came: float,
    same_wall: float,
    grazing: float,
    release: float,
    radius: float,
    max_wheel_speed: float,
    qpos: FloatArray,
    wheels: FloatArray,
    gap: FloatArray,
    direction: FloatArray,
    inner: BoolArray,
    position: FloatArray,
    contact: FloatArray,
    contact_is_inner: BoolArray,
    travelled: FloatArray,
    begins: BoolArray,
    presses: BoolArray,
    ctrl: FloatArray,
) -> None:
    """Note the contacts of the way since the last look, none at the first, and refuse what drives on into a wall."""
    for i in range(len(qpos)):
        forward = (wheels[i, 0] + wheels[i, 1]) / 2
        ahead_x, ahead_y = _ahead(qpos, i)
        towards = direction[i, 0] * ahead_x + direction[i, 1] * ahead_y
        into = forward * towards > INTO_WALL
        x, y = qpos[i, 0], qpos[i, 1]
        if is_first:
            travelled[i], begins[i], presses[i] = 0.0, False, False
        else:
            moved_x, moved_y = x - position[i, 0], y - position[i, 1]
            travelled[i] += np.sqrt(moved_x**2 + moved_y**2)
            known = _along(contact, direction, i) > same_wall
            comes = into or moved_x * direction[i, 0] + moved_y * direction[i, 1] > came
            if comes and gap[i] < radius + (CONTACT_MARGIN_M if known else 0.0):
                begins[i] |= not (stops and known)
                contact[i] = direction[i]
                contact_is_inner[i] = inner[i]
            if gap[i] > radius + release:
                contact[i] = 0.0
        position[i, 0], position[i, 1] = x, y
        meets = stops and into and _along(contact, direction, i) > same_wall
        refuse = meets and abs(towards) > grazing
        presses[i] |= refuse or (meets and gap[i] < radius + CONTACT_MARGIN_M)
        for side in range(2):
            ctrl[i, side] = (wheels[i, side] - (forward if refuse else 0.0)) * max_wheel_speed


@numba.njit(cache=True)
def _along(contact: FloatArray, direction: FloatArray, i: int) -> float:
    """Cosine of the angle between the wall that the bumper met and the nearest one, 0 without a contact."""
    return contact[i, 0] * direction[i, 0] + contact[i, 1] * direction[i, 1]


@numba.njit(cache=True)
def _sense(
    max_speed: float,
    max_turn: float,
    qpos: FloatArray,
    qvel: FloatArray,
    warning: IntArray,
    pose: FloatArray,
    speed: FloatArray,
    failed: BoolArray,
) -> int:
    """Poses and speeds of the robots whose physics holds; the others keep their last pose, at rest.

    The engine's warnings stay counted until the environment's next reset.

    Returns:
        How many robots' physics diverged.
    """
    n_failed = 0
    for i in range(len(qpos)):
        failed[i] = not np.isfinite(qpos[i]).all() or not np.isfinite(qvel[i]).all() or (warning[i, :, 1] > 0).any()
        if failed[i]:
            speed[i] = 0.0
            n_failed += 1
            continue
        ahead_x, ahead_y = _ahead(qpos, i)
        pose[i, 0], pose[i, 1], pose[i, 2] = qpos[i, 0], qpos[i, 1], np.arctan2(ahead_y, ahead_x)
        speed[i, 0] = (qvel[i, 0] * ahead_x + qvel[i, 1] * ahead_y) / max_speed
        # A free joint's angular velocity is in the body frame; its z axis is the robot's.
        speed[i, 1] = qvel[i, 5] / max_turn
    return n_failed


@numba.njit(cache=True)
def _ahead(qpos: FloatArray, i: int) -> tuple[float, float]:
    """Where a free joint's x axis points, on the floor; MuJoCo's quaternions are w, x, y, z."""
    w, x, y, z = qpos[i, 3], qpos[i, 4], qpos[i, 5], qpos[i, 6]
    return 1.0 - 2.0 * (y * y + z * z), 2.0 * (w * z + x * y)
