"""GridMoves: four grid moves on a continuous robot, driven by a waypoint controller."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Discrete
from gymnasium.utils import RecordConstructorArgs

from gridnav.problem.grid_mdp import MOVE_HEADINGS_RAD, MOVES
from gridnav.problem.layout import Layout
from gridnav.problem.robot import Robot
from gridnav.problem.types import BoolArray, FloatArray, InputError, IntArray

from .navigation import as_array

ARRIVED_M = 0.04
"""A move is over this close to the cell's centre: what the robot drives in one control period."""
FACING_RAD = 0.35
"""Further off the target's direction than this, the robot turns in place before it drives."""
STALLED_STEPS = 5
"""Control periods without motion after which a move counts as blocked."""
TURNING_RAD, SLOWING_RAD = 0.6, 0.8
"""How far off the target's direction a robot that glides turns at three quarters of its most and drives at a third."""
CUT_CELLS = 0.7
"""How far off the line of its way a robot is led straight onto it: half a cell is the farthest that it can be, so it
turns a corner from the border of the corner's cell on, without a step that a network could not learn."""


def steer(poses: FloatArray, targets_w: FloatArray, robot: Robot, period_s: float) -> FloatArray:
    """Turn towards a point, then drive to it, correcting the heading on the way.

    Args:
        poses: x and y in metres and heading in radians, world frame, shape ``(n, 3)``.
        targets_w: Metres, world frame, shape ``(n, 2)``.
        robot: Gives the maximum speeds.
        period_s: Control period, seconds.

    Returns:
        Forward and turning speed as fractions of the maxima, shape ``(n, 2)``.
    """
    distance_m, error = _towards(poses, targets_w)
    # What would close each gap within the period; half speed when turning keeps the wheels from slipping.
    turn = np.clip(error / (period_s * robot.max_turn_rad_s), -0.5, 0.5)
    forward = np.clip(distance_m / (period_s * robot.max_speed_m_s), 0.0, 1.0)
    facing = np.abs(error) < FACING_RAD
    # The faster wheel has no more than full speed to give to both.
    forward = np.where(facing, np.minimum(forward, 1.0 - np.abs(turn)), 0.0)
    return np.stack([forward, turn], axis=1)


def glide(poses: FloatArray, targets_w: FloatArray, robot: Robot, period_s: float) -> FloatArray:
    """``steer`` without its corners: the farther off the target's direction, the slower, and no step anywhere.

    Such commands are what a network can learn by heart.

    Args:
        poses: x and y in metres and heading in radians, world frame, shape ``(n, 3)``.
        targets_w: Metres, world frame, shape ``(n, 2)``.
        robot: Gives the maximum speeds.
        period_s: Control period, seconds.

    Returns:
        Forward and turning speed as fractions of the maxima, shape ``(n, 2)``.
    """
    distance_m, error = _towards(poses, targets_w)
    turn = 0.5 * np.tanh(error / TURNING_RAD)
    near = np.clip(distance_m / (period_s * robot.max_speed_m_s), 0.0, 1.0)
    forward = near * (1.0 - np.abs(turn)) * np.exp(-((error / SLOWING_RAD) ** 2))
    return np.stack([forward, turn], axis=1)


def _towards(poses: FloatArray, targets_w: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distance to each target in metres, and its direction off the heading in radians, in [-pi, pi)."""
    gap = targets_w - poses[:, :2]
    error = np.arctan2(gap[:, 1], gap[:, 0]) - poses[:, 2]
    return np.hypot(gap[:, 0], gap[:, 1]), (error + np.pi) % (2.0 * np.pi) - np.pi


def lead(poses: FloatArray, moves: IntArray, layout: Layout) -> FloatArray:
    """Where to steer for on the way of a grid move, from the pose alone and not from what was begun earlier.

    The way is the line through the cell's centre along the move. A robot on it is led a cell ahead, one that is off by
    ``CUT_CELLS`` or more straight onto it, and the point slides ahead in between.

    Args:
        poses: x and y in metres and heading in radians, world frame, shape ``(n, 3)``.
        moves: Of each robot's cell, 0 up, 1 down, 2 left, 3 right, shape ``(n,)``.
        layout: The maze.

    Returns:
        Metres, world frame, shape ``(n, 2)``.
    """
    centres = layout.to_metres(layout.to_cell(poses[:, :2]))
    headings = MOVE_HEADINGS_RAD[moves]
    ways = np.stack([np.cos(headings), np.sin(headings)], axis=1)
    offsets = poses[:, :2] - centres
    along = (offsets * ways).sum(axis=1, keepdims=True)
    aside = np.hypot(*(offsets - along * ways).T)[:, None]
    ahead = layout.cell_size_m * np.clip(1.0 - aside / (CUT_CELLS * layout.cell_size_m), 0.0, 1.0)
    return centres + (along + ahead) * ways


class MoveDriver:
    """Grid moves under way on ``n`` robots.

    Args:
        layout: The maze.
        robot: The robot.
        period_s: Control period, seconds.
        n: Robots.
    """

    def __init__(self, layout: Layout, robot: Robot, period_s: float, n: int) -> None:
        self._layout, self._robot, self._period_s = layout, robot, period_s
        self._targets_w = np.zeros((n, 2))
        self._last_w = np.full((n, 2), np.inf)
        self._still = np.zeros(n, dtype=np.int64)

    def begin(self, ids: IntArray, poses: FloatArray, moves: IntArray) -> None:
        """Send robots to the centre of the cell beside theirs, or against the wall that is there.

        Args:
            ids: The robots, shape ``(m,)``.
            poses: Their poses, shape ``(m, 3)``.
            moves: 0 up, 1 down, 2 left, 3 right, shape ``(m,)``.
        """
        cells = self._layout.to_cell(poses[:, :2]) + MOVES[moves]
        self._targets_w[ids] = self._layout.to_metres(cells)
        self._last_w[ids] = np.inf
        self._still[ids] = 0

    def commands(self, poses: FloatArray) -> FloatArray:
        """Forward and turning commands of all robots, shape ``(n, 2)``, for poses of shape ``(n, 3)``."""
        return steer(poses, self._targets_w, self._robot, self._period_s)

    def finished(self, poses: FloatArray) -> BoolArray:
        """Whether each robot has arrived or is blocked, shape ``(n,)``; to be asked once per control period."""
        gap = self._targets_w - poses[:, :2]
        forward = self.commands(poses)[:, 0] > 0.0
        moved = np.hypot(*(poses[:, :2] - self._last_w).T) > 0.002
        self._still = np.where(forward & ~moved, self._still + 1, 0)
        self._last_w = poses[:, :2].copy()
        over: BoolArray = (np.hypot(gap[:, 0], gap[:, 1]) < ARRIVED_M) | (self._still >= STALLED_STEPS)
        return over


class GridMoves(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Lets an agent of the grid drive a continuous robot: one step is a whole move to the next cell.

    A move ends at the next cell's centre, at a collision, or with the episode. It is a step of a semi-Markov decision
    process (Sutton, Precup and Singh 1999): the reward is the discounted sum of the move's rewards,
    ``info["discount"]`` the discount of the whole move, and ``info["duration_s"]`` its time in seconds.

    Args:
        env: ``gridnav/Unicycle-v0`` or ``gridnav/DiffDrive-v0``.
        observation: ``cell_goal`` (default), ``cell`` as in GridWorld, or ``features``.
    """

    def __init__(self, env: gym.Env[Any, Any], *, observation: str = "cell_goal") -> None:
        RecordConstructorArgs.__init__(self, observation=observation)
        gym.Wrapper.__init__(self, env)
        if observation not in ("cell_goal", "cell", "features"):
            raise InputError(f"observation {observation!r} is none of cell_goal, cell, features")
        robot_env: Any = env.unwrapped
        self._robot_env = robot_env
        self._mode = observation
        layout: Layout = robot_env.layout
        sizes = {"cell_goal": layout.n_cells * len(robot_env.worlds.goal_cells), "cell": layout.n_cells}
        self.observation_space = env.observation_space if observation == "features" else Discrete(sizes[observation])
        self.action_space = Discrete(4)
        self._pose = np.zeros((1, 3))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode; see ``NavigationVectorEnv.reset``."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._pose = info["pose"][None]
        return self._observe(observation, info), info | {"duration_s": 0.0, "discount": 1.0}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Drive one whole move.

        Raises:
            InputError: When the action is not in ``Discrete(4)``.
        """
        move = as_array(action)
        if move.shape != () or move.dtype.kind not in "iu" or not 0 <= move <= 3:
            raise InputError(f"action {action!r} is outside Discrete(4): 0 up, 1 down, 2 left, 3 right")
        robot = self._robot_env
        gamma: float = robot.worlds.step_gamma
        driver = MoveDriver(robot.layout, robot.worlds.robot, robot.control_period_s, 1)
        driver.begin(np.array([0]), self._pose, move[None])
        reward, discount, steps, over = 0.0, 1.0, 0, False
        while not over:
            command = driver.commands(self._pose)[0].astype(np.float32)
            observation, step_reward, terminated, truncated, info = self.env.step(command)
            reward += discount * float(step_reward)
            discount *= gamma
            steps += 1
            self._pose = info["pose"][None]
            over = terminated or truncated or info["collision"] or bool(driver.finished(self._pose)[0])
        duration = {"duration_s": steps * robot.control_period_s, "discount": discount}
        return self._observe(observation, info), reward, terminated, truncated, info | duration

    def _observe(self, observation: Any, info: dict[str, Any]) -> Any:
        if self._mode == "features":
            return observation
        worlds = self._robot_env.worlds
        if self._mode == "cell":
            row, col = info["cell"]
            return row * worlds.layout.n_cols + col
        if worlds.goal_ranks[tuple(worlds._goal[0])] < 0:
            raise InputError(
                f"goal {tuple(worlds._goal[0].tolist())} is no goal of this task, which cell_goal observations cannot "
                'name: use task="any" or observation="features"'
            )
        return int(worlds.cell_goal(worlds._cell, worlds._goal)[0])
