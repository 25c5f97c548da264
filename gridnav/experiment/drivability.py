"""Can the robots that a randomization draws drive at all? Some fall over when they stop, some slip where they stand.

Such a robot tells little about a policy: presets and realities are chosen so that few are drawn.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gridnav.envs import PARAMETERS, DiffDriveVectorEnv, Randomization
from gridnav.experiment.worlds import Problem
from gridnav.problem.types import BoolArray

FLOOR = "\n".join([".........G", *["." * 10] * 2, *["...SSSS..."] * 4, *["." * 10] * 3])
"""Robots start in the middle, from where no square reaches a wall; the goal is in a corner, where none leads."""
SIDE = ((1.0, 0.0, 15), (0.0, 0.0, 3), (0.0, 0.5, 6), (0.0, 0.0, 2))
"""Forward and turning command and control periods of a square's side: 3 s straight on at full speed, a hard stop, about
80 degrees to the left, a stop."""
SIDES = 8
"""Twice around, so that every robot goes up its slope."""
LEAST_SHARE = 0.2
"""Of the way and the turn that a command asks for: a robot that does less has not followed it."""
FALLEN_RAD = np.pi / 4
"""A robot that leans further has fallen: nothing but wheels and caster stands on the floor."""


@dataclass(frozen=True)
class Drivability:
    """What became of robots that were told to drive squares on an open floor, shape ``(n_robots,)`` each."""

    falls: BoolArray
    """It lay on its nose, side or back after a control period."""
    stays: BoolArray
    """Upright, and once at least it hardly moved ahead or hardly turned when told to: wheels slip or stand."""

    @property
    def driving_share(self) -> float:
        """Of the robots that can drive."""
        return float(1.0 - (self.falls | self.stays).mean())


def try_driving(randomization: Randomization, n_robots: int, *, seed: int = 0, **options: Any) -> Drivability:
    """Drive squares with the robots that are drawn; commands arrive at once, and nobody needs to see anything.

    Args:
        randomization: What varies; of a curriculum the whole ranges.
        n_robots: How many are drawn.
        seed: Of what is drawn, and of where they begin.
        options: For the environments: how the model differs, for example.
    """
    bodies = [name for name in randomization.names if PARAMETERS[name].acts_on in ("physics", "drive")]
    problem = replace(Problem.load(FLOOR, "default", "default"), randomization=randomization.only(*bodies))
    # Without autoreset a robot whose physics fails stays where it is, and is seen to.
    worlds = problem.for_evaluation.worlds("DiffDrive", n_robots, autoreset=False, **options)
    assert isinstance(worlds, DiffDriveVectorEnv)
    _, info = worlds.reset(seed=seed)
    now, falls, stays = info["pose"], np.zeros(n_robots, dtype=bool), np.zeros(n_robots, dtype=bool)
    for forward, turn, periods in SIDE * SIDES:
        begun, turned_rad, command = now, np.zeros(n_robots), np.tile(np.array([forward, turn]), (n_robots, 1))
        for _ in range(periods):
            *_, info = worlds.step(command)
            before, now = now, info["pose"]
            turned_rad += (now[:, 2] - before[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
            falls |= worlds.lean_rad > FALLEN_RAD
        (x, y, _), heading = (now - begun).T, begun[:, 2]
        ahead_m = x * np.cos(heading) + y * np.sin(heading)
        least_s = LEAST_SHARE * periods * worlds.control_period_s
        if forward:
            stays |= ahead_m < forward * worlds.robot.max_speed_m_s * least_s
        if turn:
            stays |= turned_rad < turn * worlds.robot.max_turn_rad_s * least_s
    worlds.close()
    return Drivability(falls, stays & ~falls)
