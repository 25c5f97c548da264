"""An agent's values and policy on the cells of a maze, as pictures and recordings draw them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gridnav.problem.grid_mdp import MOVE_HEADINGS_RAD
from gridnav.problem.robot import BURGER, Robot
from gridnav.problem.types import FloatArray


@dataclass(frozen=True)
class PolicyMap:
    """Values and directions of the cells for one goal, arrays of shape ``(n_rows, n_cols)``."""

    values: FloatArray
    """Expected discounted reward; NaN where unknown."""
    directions_rad: FloatArray
    """Where the policy heads, world frame (x right, y up); NaN where nowhere."""
    speeds: FloatArray
    """Shares of full speed, in [0, 1]."""


def best_moves(action_values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """What the best move from each cell is worth, and where it heads.

    Args:
        action_values: Of the moves up, down, left, right, shape ``(n_cells, 4)``.

    Returns:
        Values, and directions in radians, NaN where all four are worth the same; shape ``(n_cells,)`` both.
    """
    best = action_values.max(axis=1)
    prefers = best > action_values.min(axis=1)
    return best, np.where(prefers, MOVE_HEADINGS_RAD[action_values.argmax(axis=1)], np.nan)


def command_motion(
    commands: FloatArray, headings_rad: FloatArray | float, *, seconds: float = 1.0, robot: Robot = BURGER
) -> tuple[FloatArray, FloatArray]:
    """Where a robot gets by a command: the arrows of a robot's policy.

    Held for a while, a command drives an arc; its chord points half of the turn away from the heading.

    Args:
        commands: Forward and turning command as fractions of the maxima, shape ``(..., 2)``.
        headings_rad: Where the robot looks, world frame, one for all or shape ``(...)``.
        seconds: How long the command is held.
        robot: Gives the maximum speeds, and clips each wheel at its own.

    Returns:
        Direction of the way from here to there, radians in the world frame, and the speed as a share of the maximum,
        in [0, 1], shape ``(...)`` both. Turning in place has no speed, and the direction is the limit of slow driving.
    """
    left, right = np.moveaxis(robot.wheel_fractions(commands.reshape(-1, 2)).reshape(commands.shape), -1, 0)
    forward, turn = (left + right) / 2, (right - left) / 2
    directions_rad = headings_rad + turn * robot.max_turn_rad_s * seconds / 2
    return np.where(forward < 0, directions_rad + np.pi, directions_rad), np.abs(forward)
