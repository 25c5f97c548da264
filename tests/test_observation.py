"""The feature vector: the same in all worlds, within its bounds, and invertible."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from gridnav import Layout
from gridnav.envs import FeatureVector
from gridnav.problem.robot import BURGER

CLASSIC = Layout.load("classic")
FEATURES = FeatureVector(CLASSIC, BURGER)
ROBOTS = ["gridnav/DiffDrive-v0", "gridnav/Unicycle-v0"]
WORLDS = [*ROBOTS, "gridnav/GridWorld-v0"]


def make(world: str, n: int, **arguments: Any) -> Any:
    """A vector environment that observes features."""
    if world == "gridnav/GridWorld-v0":
        arguments["observation"] = "features"
    return gym.make_vec(world, num_envs=n, **arguments)


def roam(world: str, steps: int, n: int, **arguments: Any) -> tuple[Any, np.ndarray]:
    """Observations of robots that drive at random, shape ``(steps * n, size)``."""
    env = make(world, n, **arguments)
    seen = [env.reset(seed=0)[0]]
    rng = np.random.default_rng(0)
    commands = np.zeros((n, 2), np.float32)
    for step in range(steps):
        if world == "gridnav/GridWorld-v0":
            commands = rng.integers(4, size=n)
        elif step % 5 == 0:
            commands = rng.choice([-1.0, -0.5, 0.0, 0.5, 1.0, 1.0], (n, 2)).astype(np.float32)
        observations, _, _, _, info = env.step(commands)
        seen.append(observations)
        seen += [last[None] for last in info.get("final_obs", ()) if last is not None]
    return env, np.concatenate(seen)


def test_slices_are_named_in_order_without_gaps() -> None:
    assert FEATURES.slices == {
        "lidar": slice(0, 24),
        "goal_distance": slice(24, 25),
        "goal_bearing": slice(25, 27),
        "position": slice(27, 29),
        "heading": slice(29, 31),
        "speed": slice(31, 33),
        "last_action": slice(33, 35),
    }
    assert [feature.name for feature in FEATURES.features] == list(FEATURES.slices)
    assert all(feature.unit and feature.meaning for feature in FEATURES.features)


@pytest.mark.parametrize("n_beams", [1, 24, 360])
def test_bounds_follow_the_number_of_beams(n_beams: int) -> None:
    features = FeatureVector(CLASSIC, replace(BURGER, n_beams=n_beams))

    assert features.space.shape == (n_beams + 11,)
    np.testing.assert_array_equal(features.space.low[:n_beams], 0.0)
    np.testing.assert_array_equal(features.space.high[:n_beams], 1.0)


def test_all_worlds_have_the_same_slices_shape_and_bounds() -> None:
    envs = [make(world, 2) for world in WORLDS]

    for env in envs[1:]:
        assert env.features.slices == envs[0].features.slices
        assert env.features.features == envs[0].features.features
        assert env.single_observation_space == envs[0].single_observation_space


def test_all_worlds_observe_the_same_start_alike() -> None:
    """Same seed, same layout, same task: the same episode, seen at rest from the same place."""
    seen = [make(world, 8).reset(seed=3, options={"heading_rad": 0.7})[0] for world in WORLDS]

    np.testing.assert_array_equal(seen[0], seen[1])
    np.testing.assert_array_equal(seen[0], seen[2])


def test_a_feature_vector_is_worked_out_by_hand() -> None:
    """At (1.25, 2.5) facing up, the goal one metre to the left, in a maze of 5 x 5 m."""
    observation = FEATURES.observe(
        np.array([[1.25, 2.5, np.pi / 2]]),
        np.full((1, 24), 1.75),
        np.array([[0.25, 2.5]]),
        np.array([[0.5, -2.0]]),
        np.array([[1.0, -0.25]]),
    )

    part = {name: observation[0, where] for name, where in FEATURES.slices.items()}
    np.testing.assert_allclose(part["lidar"], 0.5)
    np.testing.assert_allclose(part["goal_distance"], [1.0 / 3.5], rtol=1e-6)
    np.testing.assert_allclose(part["goal_bearing"], [0.0, 1.0], atol=1e-6)  # 90 degrees to the left
    np.testing.assert_allclose(part["position"], [-0.5, 0.0], atol=1e-6)
    np.testing.assert_allclose(part["heading"], [0.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(part["speed"], [0.5, -1.5])  # clipped to its bounds
    np.testing.assert_allclose(part["last_action"], [1.0, -0.25])
    assert observation.dtype == np.float32


@pytest.mark.parametrize("name", ["classic", "four-rooms", "corridors"])
def test_poses_and_goals_are_recovered_from_observations(name: str) -> None:
    layout = Layout.load(name)
    features = FeatureVector(layout, BURGER)
    rng = np.random.default_rng(0)
    n = 500
    poses = np.column_stack([rng.uniform(0, layout.size_m, (n, 2)), rng.uniform(-np.pi, np.pi, n)])
    goals = rng.uniform(0, layout.size_m, (n, 2))

    observations = features.observe(poses, np.ones((n, 24)), goals, np.zeros((n, 2)), np.zeros((n, 2)))
    back, back_goals = features.poses_and_goals(observations)

    # float32 has 24 bits: 6e-8 of a few metres.
    np.testing.assert_allclose(back, poses, atol=3e-6)
    np.testing.assert_allclose(back_goals, goals, atol=5e-6)


@pytest.mark.parametrize("world", ROBOTS)
def test_poses_and_goals_are_those_of_the_driving_robot(world: str) -> None:
    env = make(world, 4)
    env.reset(seed=0)
    for _ in range(20):
        observations, *_, info = env.step(np.tile(np.float32([0.8, 0.3]), (4, 1)))

    poses, goals = env.features.poses_and_goals(observations)

    np.testing.assert_allclose(poses, info["pose"], atol=5e-6)
    np.testing.assert_allclose(goals, env.layout.to_metres(env._goal), atol=5e-6)


@pytest.mark.parametrize("world", WORLDS)
def test_bounds_hold_over_random_driving(world: str) -> None:
    env, seen = roam(world, 200, 16, task="any", max_episode_steps=100)
    space = env.single_observation_space

    assert np.isfinite(seen).all()
    # Each element by itself, so that a failure names it.
    low, high = seen.min(axis=0), seen.max(axis=0)
    assert np.flatnonzero(low < space.low).tolist() == []
    assert np.flatnonzero(high > space.high).tolist() == []


@pytest.mark.parametrize("world", ROBOTS)
def test_no_element_is_constant_over_random_driving(world: str) -> None:
    _, seen = roam(world, 150, 16, task="any", max_episode_steps=100)

    spread = seen.max(axis=0) - seen.min(axis=0)
    assert np.flatnonzero(spread < 0.2).tolist() == []


def test_on_the_grid_only_what_a_move_does_not_have_is_constant() -> None:
    """A move knows no turning: turning speed and turning command are always zero there."""
    env, seen = roam("gridnav/GridWorld-v0", 150, 16, task="any", max_episode_steps=100)

    constant = np.flatnonzero(np.ptp(seen, axis=0) < 1e-6)
    slices = env.features.slices
    assert constant.tolist() == [slices["speed"].start + 1, slices["last_action"].start + 1]


@pytest.mark.parametrize("world", ROBOTS)
def test_speed_and_last_action_say_what_the_robot_did(world: str) -> None:
    env = make(world, 1, layout="open", task="any")
    env.reset(seed=0, options={"start": (5, 5), "goal": (0, 0), "heading_rad": 0.0})
    for _ in range(5):
        observation, *_ = env.step(np.float32([[0.5, -0.25]]))

    speed, last = (observation[0, env.features.slices[name]] for name in ("speed", "last_action"))
    np.testing.assert_array_equal(last, np.float32([0.5, -0.25]))
    # The Unicycle is exact; the motors of the DiffDrive lose up to a tenth to friction.
    np.testing.assert_allclose(speed, [0.5, -0.25], rtol=1e-5 if world.endswith("Unicycle-v0") else 0.1)


@pytest.mark.parametrize("world", WORLDS)
def test_an_observation_does_not_depend_on_where_in_the_batch_the_robot_is(world: str) -> None:
    options = {"start": (0, 0), "goal": (9, 9), "heading_rad": 0.4}

    many, _ = make(world, 5).reset(seed=0, options=options)
    one, _ = make(world, 1).reset(seed=0, options=options)

    np.testing.assert_array_equal(many, np.repeat(one, 5, axis=0))
