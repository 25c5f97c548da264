"""Several layouts side by side: each group is its own environment, and moves on without telling lies about ends."""

from __future__ import annotations

import json
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import gridnav  # noqa: F401, registers the worlds
from gridnav.envs import LayoutMix, NavigationVectorEnv
from gridnav.problem.layout import Layout
from gridnav.problem.types import InputError, State

RENEW = 12
"""Steps in a layout; episodes are truncated after 7."""


def draw(rng: np.random.Generator) -> Layout:
    return Layout.random(n_rows=6, n_cols=6, density=0.15, seed=int(rng.integers(1000)))


def make(world: str, layout: Layout, n: int) -> NavigationVectorEnv:
    env = gym.make_vec(f"gridnav/{world}-v0", num_envs=n, layout=layout, max_episode_steps=7)
    assert isinstance(env, NavigationVectorEnv)
    return env


def mix(world: str = "GridWorld", num_envs: int = 6, n_groups: int = 3) -> LayoutMix:
    return LayoutMix(lambda layout, n: make(world, layout, n), num_envs, draw, n_groups=n_groups, renew_steps=RENEW)


def actions_of(env: LayoutMix, n_steps: int) -> list[Any]:
    env.action_space.seed(0)
    return [env.action_space.sample() for _ in range(n_steps)]


def through_files(state: State) -> State:
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


@pytest.mark.parametrize("world", ["GridWorld", "Unicycle"])
def test_groups_play_different_layouts_as_if_each_were_alone_until_it_is_renewed(world: str) -> None:
    env = mix(world)
    observations, _ = env.reset(seed=5)
    assert len({group.layout.to_text() for group in env.groups}) == 3
    alone = []
    for group in env.groups:
        twin = make(world, group.layout, 2)
        twin.set_state(group.get_state())
        alone.append(twin)
    np.testing.assert_array_equal(observations[2:4], env.groups[1]._observe())

    # By hand: the groups begin 0, 4 and 8 steps old, so they are renewed with steps 12, 8 and 4.
    renewals = [12, 8, 4]
    for step, actions in enumerate(actions_of(env, 12), start=1):
        observations, rewards, terminated, truncated, info = env.step(actions)
        for g, (twin, renewal) in enumerate(zip(alone, renewals, strict=True)):
            ids = slice(2 * g, 2 * g + 2)
            if step > renewal:
                continue
            own_observations, own_rewards, own_terminated, own_truncated, own_info = twin.step(actions[ids])
            np.testing.assert_array_equal(rewards[ids], own_rewards)
            np.testing.assert_array_equal(terminated[ids], own_terminated)
            if step < renewal:
                np.testing.assert_array_equal(observations[ids], own_observations)
                np.testing.assert_array_equal(truncated[ids], own_truncated)
                np.testing.assert_array_equal(info["pose"][ids], own_info["pose"])


@pytest.mark.parametrize("world", ["GridWorld", "Unicycle"])
def test_a_renewal_truncates_and_shows_what_was_last_seen_in_the_old_layout(world: str) -> None:
    env = mix(world, num_envs=8, n_groups=1)
    env.reset(seed=1)
    twin, before = make(world, env.groups[0].layout, 8), env.groups[0].layout
    twin.set_state(env.groups[0].get_state())
    *ordinary, last = actions_of(env, RENEW)
    for actions in ordinary:
        env.step(actions)
        twin.step(actions)

    observations, _, terminated, truncated, info = env.step(last)
    own_observations, _, own_terminated, own_truncated, own_info = twin.step(last)

    assert env.groups[0].layout != before
    np.testing.assert_array_equal(observations, env.groups[0]._observe())
    # Every episode ends; what was reached terminated, and what was cut short is no end of the task.
    np.testing.assert_array_equal(terminated, own_terminated)
    np.testing.assert_array_equal(truncated, own_truncated | ~own_terminated)
    assert info["_final_obs"].all()
    ended = own_terminated | own_truncated
    for i in range(8):
        seen = own_info["final_obs"][i] if ended[i] else own_observations[i]
        np.testing.assert_array_equal(info["final_obs"][i], seen)
    # Episodes that were cut count neither as successes nor as failures.
    np.testing.assert_array_equal(info["_final_info"], ended)
    assert not ended.all()
    for key in ("is_success", "collisions", "pose"):
        expected = own_info["final_info"][key] if ended.any() else own_info[key]
        np.testing.assert_array_equal(info["final_info"][key], expected)
    assert (info["elapsed_s"] == 0.0).all()


def test_every_robot_of_every_group_counts_in_the_joined_infos() -> None:
    """Groups without an ended episode fill what only the others have."""
    env = mix()
    env.reset(seed=3)
    for actions in actions_of(env, 60):
        observations, _, terminated, truncated, info = env.step(actions)
        ended = terminated | truncated
        assert ("final_obs" in info) == ended.any()
        if ended.any():
            np.testing.assert_array_equal(info["_final_obs"], ended)
            assert [one is not None for one in info["final_obs"]] == ended.tolist()
            assert not (info["_final_info"] & ~ended).any()
            assert len(info["final_info"]["is_success"]) == len(info["final_info"]["pose"]) == 6
        assert len(observations) == len(info["pose"]) == len(info["reward_terms"]["goal"]) == 6


@pytest.mark.parametrize("world", ["GridWorld", "Unicycle", "DiffDrive"])
def test_a_fresh_mix_goes_on_where_another_was(world: str) -> None:
    first = mix(world)
    first.reset(seed=3)
    steps = actions_of(first, 50)
    for actions in steps[:17]:
        first.step(actions)
    saved = through_files(first.get_state())

    other = mix(world)
    other.set_state(saved)

    for actions in steps[17:]:  # over renewals of every group
        for a, b in zip(first.step(actions), other.step(actions), strict=True):
            assert_equal(a, b)
    assert [g.layout for g in first.groups] == [g.layout for g in other.groups]


def test_the_seed_decides_all_layouts_and_episodes() -> None:
    def course(seed: int) -> tuple[list[str], list[Any]]:
        env = mix()
        seen: list[Any] = [env.reset(seed=seed)[0]]
        layouts = [group.layout.to_text() for group in env.groups]
        for actions in actions_of(env, 30):
            seen.append(env.step(actions)[0])
            layouts += [group.layout.to_text() for group in env.groups]
        return layouts, seen

    once, again, other = course(1), course(1), course(2)

    assert once[0] == again[0]
    np.testing.assert_array_equal(once[1], again[1])
    assert once[0] != other[0]
    assert len(set(once[0])) > 3


def test_groups_share_no_random_stream() -> None:
    env = mix(num_envs=9)
    env.reset(seed=0)

    states = [g.bit_generator.state["state"]["state"] for group in env.groups for g in group.generators]

    assert len(set(states)) == 9


@pytest.mark.parametrize(
    "other",
    [
        lambda: mix(num_envs=8, n_groups=2).get_state(),
        lambda: mix(num_envs=3).get_state(),
        lambda: mix("Unicycle").get_state(),
        lambda: make("DiffDrive", draw(np.random.default_rng(0)), 6).get_state(),
        lambda: State({}, {}),
    ],
)
def test_the_state_of_another_environment_is_refused(other: Any) -> None:
    saved = other()

    with pytest.raises(InputError, match="the state is not that of"):
        mix("DiffDrive").set_state(saved)


def test_robots_that_cannot_be_shared_out_evenly_are_refused() -> None:
    with pytest.raises(InputError, match="num_envs 7 must be a multiple of the 3 layouts"):
        mix(num_envs=7)
