"""An environment's state: what was saved in mid-episode goes on equally, bit for bit, in every world."""

from __future__ import annotations

import json
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import gridnav  # noqa: F401, registers the worlds
from gridnav.problem.layout import Layout
from gridnav.problem.types import InputError, State

WORLDS = ("GridWorld", "Unicycle", "DiffDrive")


def make(world: str, num_envs: int = 7, **options: Any) -> Any:
    """Short episodes, so that many end while we look."""
    return gym.make_vec(f"gridnav/{world}-v0", num_envs=num_envs, max_episode_steps=30, **options)


def actions_of(env: Any, seed: int, n_steps: int) -> list[Any]:
    space = env.action_space
    space.seed(seed)
    return [space.sample() for _ in range(n_steps)]


def through_files(state: State) -> State:
    """The state as a checkpoint gives it back."""
    return State(dict(state.arrays), json.loads(json.dumps(state.values)))


def assert_equal(one: Any, other: Any) -> None:
    """Equal to the last bit, in nested dictionaries and arrays of objects too."""
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            assert_equal(one[key], other[key])
    elif isinstance(one, tuple) or (isinstance(one, np.ndarray) and one.dtype == object):
        for a, b in zip(one, other, strict=True):
            assert_equal(a, b)
    else:
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("world", WORLDS)
def test_a_fresh_environment_goes_on_where_another_was(world: str) -> None:
    first = make(world)
    first.reset(seed=3)
    # Full speed ahead: robots meet walls, so that contacts are part of what is saved.
    for action in actions_of(first, 1, 47):
        first.step(action if world == "GridWorld" else np.abs(action))
    saved = through_files(first.get_state())

    other = make(world)
    other.set_state(saved)

    for action in actions_of(first, 2, 80):
        for a, b in zip(first.step(action), other.step(action), strict=True):
            assert_equal(a, b)


@pytest.mark.parametrize("world", WORLDS)
def test_a_single_environment_goes_on_too_and_resets_alike(world: str) -> None:
    first = gym.make(f"gridnav/{world}-v0", max_episode_steps=1000)
    first.reset(seed=5)
    for action in actions_of(first, 1, 10):
        first.step(action)
    saved = through_files(first.unwrapped.get_state())  # type: ignore[attr-defined]

    other = gym.make(f"gridnav/{world}-v0", max_episode_steps=1000)
    other.reset(seed=99)
    other.unwrapped.set_state(saved)  # type: ignore[attr-defined]

    for action in actions_of(first, 2, 10):
        for a, b in zip(first.step(action), other.step(action), strict=True):
            assert_equal(a, b)
    assert_equal(first.reset(), other.reset())


def test_options_and_layout_of_the_reset_are_part_of_the_state() -> None:
    layout = Layout.random(n_rows=10, n_cols=10, density=0.15, seed=1)
    first, other = make("Unicycle"), make("Unicycle")
    first.reset(seed=0, options={"layout": layout, "goal": tuple(layout.goal_cells[-1].tolist())})
    other.set_state(through_files(first.get_state()))

    assert other.layout == first.layout
    for action in actions_of(first, 2, 70):  # over the end of episodes, which keep the goal
        for a, b in zip(first.step(action), other.step(action), strict=True):
            assert_equal(a, b)


def test_taking_the_state_changes_nothing_and_shares_no_memory() -> None:
    env = make("DiffDrive", 2)
    env.reset(seed=0)
    state = env.get_state()
    before = {name: array.copy() for name, array in state.arrays.items()}

    for action in actions_of(env, 0, 5):
        env.step(action)

    assert_equal(state.arrays, before)


@pytest.mark.parametrize(("world", "num_envs"), [("Unicycle", 7), ("DiffDrive", 6), ("GridWorld", 7)])
def test_the_state_of_another_environment_is_refused(world: str, num_envs: int) -> None:
    saved = make(world, num_envs).get_state()

    with pytest.raises(InputError, match="not that of 7 environments of DiffDrive"):
        make("DiffDrive").set_state(saved)
