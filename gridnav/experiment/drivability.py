"""Can the robots that a randomization draws drive at all? Some fall over when they stop, some slip where they stand.

What no command can move says nothing of a policy: presets and realities are chosen so that such robots are rare.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from gridnav.envs import PARAMETERS, DiffDriveVectorEnv, Randomization
from gridnav.experiment.worlds import Problem
from gridnav.problem.types import BoolArray

FLOOR, MIDDLE, CORNER = "open", (5, 5), (0, 9)
SIDE = ((1.0, 0.0, 15), (0.0, 0.0, 3), (0.0, 0.5, 6), (0.0, 0.0, 2))
"""Forward and turning command and control periods of a square's side: 3 s straight on at full speed, a hard stop, about
80 degrees to the left, a stop."""
SIDES = 8
"""Twice around, so that every robot goes up its slope."""
LEAST = 0.2
"""Of what a command asks for: who drives or turns less slips where it stands."""
LEANING_RAD = np.pi / 4
"""Who leans further has fallen: nothing but wheels and caster stands on the floor."""


@dataclass(frozen=True)
class Drivability:
    """What became of robots that were told to drive squares on an open floor, shape ``(n,)`` each."""

    falls: BoolArray
    """It lay on its nose, side or back after a control period."""
    slips: BoolArray
    """It stood, and hardly moved or hardly turned when it was told to, once at least."""

    @property
    def share(self) -> float:
        """Of the robots that can drive."""
        return float(1.0 - (self.falls | self.slips).mean())


def try_driving(randomization: Randomization, n: int, *, seed: int = 0, **options: Any) -> Drivability:
    """Drive squares with the robots that are drawn; commands arrive at once, and nobody needs to see anything.

    Args:
        randomization: What varies.
        n: How many robots.
        seed: Of what is drawn.
        options: For the environments: how the model differs, for example.
    """
    bodies = [name for name in randomization.names if PARAMETERS[name].acts_on in ("physics", "drive")]
    problem = Problem.load(FLOOR, "default", "default")
    worlds = problem.worlds("DiffDrive", n, randomization=randomization.only(*bodies), **options)
    assert isinstance(worlds, DiffDriveVectorEnv)
    _, info = worlds.reset(seed=seed, options={"start": MIDDLE, "goal": CORNER, "heading_rad": 0.0})
    now, falls, slips = info["pose"], np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
    for forward, turn, periods in SIDE * SIDES:
        begun, turned, command = now, np.zeros(n), np.tile(np.array([forward, turn]), (n, 1))
        for _ in range(periods):
            *_, info = worlds.step(command)
            before, now = now, info["pose"]
            turned += (now[:, 2] - before[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
            falls |= worlds.lean_rad > LEANING_RAD
        least_s = LEAST * periods * worlds.control_period_s
        slips |= np.hypot(*(now - begun)[:, :2].T) < forward * worlds.robot.max_speed_m_s * least_s
        slips |= np.abs(turned) < turn * worlds.robot.max_turn_rad_s * least_s
    worlds.close()
    return Drivability(falls, slips & ~falls)
