"""Training episodes that begin anywhere, half of them at a wall."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

import gridnav  # noqa: F401, registers the worlds
from gridnav.problem.geodesic import clearances
from gridnav.problem.types import InputError


@pytest.mark.parametrize("world", ["Unicycle", "DiffDrive"])
def test_exploring_starts_are_anywhere_half_of_them_at_a_wall_and_never_in_one(world: str) -> None:
    worlds = gym.make_vec(f"gridnav/{world}-v0", num_envs=2000, exploring_starts=0.5)
    _, info = worlds.reset(seed=0)
    layout, robot = worlds.layout, worlds.robot  # type: ignore[attr-defined]
    gap, _, _ = clearances(info["pose"], layout)
    worlds.close()

    assert gap.min() >= robot.radius_m
    # By hand: a quarter of all is put at a wall, and of the others that explore a few happen to stand there.
    assert 0.2 < (gap < robot.radius_m + 0.004).mean() < 0.3
    # By hand: the goal's cell excepted, half of them are spread over all rows; the starts are in the first three.
    assert 0.3 < (info["cell"][:, 0] > 2).mean() < 0.42
    np.testing.assert_array_equal(layout.to_cell(info["pose"][:, :2]), info["cell"])
    assert not layout.walls[tuple(info["cell"].T)].any()


@pytest.mark.parametrize("world", ["Unicycle", "DiffDrive"])
def test_exploring_starts_leave_what_a_reset_fixes(world: str) -> None:
    env = gym.make(f"gridnav/{world}-v0", exploring_starts=1.0)
    _, info = env.reset(seed=0, options={"start": (0, 0), "goal": (9, 9), "heading_rad": 0.0})
    env.close()
    np.testing.assert_allclose(info["pose"], [0.25, 4.75, 0.0])


def test_a_share_of_exploring_starts_beyond_one_is_refused() -> None:
    with pytest.raises(InputError, match=r"exploring_starts 1\.5 is outside 0 to 1"):
        gym.make_vec("gridnav/Unicycle-v0", num_envs=2, exploring_starts=1.5)
