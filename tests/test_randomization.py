"""What varies of robots, senses and mazes: ranges as data, draws of their own, and what each quantity does."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from command_line import run_cli
from test_env_state import assert_equal, through_files

import gridnav  # noqa: F401, registers the worlds
from gridnav.agents import Agent
from gridnav.envs import (
    PARAMETERS,
    RANDOMIZATION_PRESETS,
    LayoutMix,
    NavigationVectorEnv,
    Randomization,
    Range,
)
from gridnav.envs.draws import NAMES, STEP, WINDOW, Curriculum, Draws
from gridnav.problem.layout import NAMED_LAYOUTS, Layout
from gridnav.problem.types import FloatArray, InputError, State

WORLDS = ("Unicycle", "DiffDrive")
MAZES = Randomization.load({"preset": "burger", "obstacles_moved": [0, 6], "cell_size": [0.9, 1.1]})


def make(world: str, randomization: Any, num_envs: int = 1, **options: Any) -> Any:
    options = {"layout": "open", "max_episode_steps": -1} | options
    return gym.make_vec(f"gridnav/{world}-v0", num_envs=num_envs, randomization=randomization, **options)


def bold_actions(n_steps: int, n: int, seed: int = 0) -> FloatArray:
    """Mostly ahead, so that robots meet walls."""
    actions = np.random.default_rng(seed).uniform(-1.0, 1.0, (n_steps, n, 2))
    actions[..., 0] = np.abs(actions[..., 0])
    return actions


# ---- Ranges as data ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("burgr", "unknown randomization 'burgr': the presets are none, burger"),
        ({"preset": []}, r"unknown randomization \[\]: the presets are none, burger"),
        ({"weel_radius": [0.9, 1.1]}, "no quantity 'weel_radius' can be randomised: did you mean wheel_radius?"),
        ({"wheel_radius": [1.1, 0.9]}, r"wheel_radius \[1.1, 0.9\] is reversed: the first number must be the lower"),
        ({"payload_kg": [-1, 1]}, "payload_kg -1 is outside 0 to 10 kg"),
        ({"payload_kg": 500}, "payload_kg 500 is outside 0 to 10 kg: is it in grams"),
        ({"command_delay_s": [0, 50]}, "command_delay_s 50 is outside 0 to 0.4 s: is it in milliseconds. .* 0.05"),
        ({"floor_tilt_rad": 5}, "floor_tilt_rad 5 is outside 0 to 0.2 rad: is it in degrees. Then write 0.0873"),
        ({"heading_drift_rad_s": 2}, "outside -0.2 to 0.2 rad/s: is it in degrees per second. Then write 0.0349"),
        ({"lidar_bias_m": 15}, "lidar_bias_m 15 is outside -0.2 to 0.2 m: is it in centimetres. Then write 0.15"),
        ({"wheel_radius": 102}, "wheel_radius 102 is outside 0.8 to 1.2 x: is it in percent. Then write 1.02"),
        ({"lidar_dropout": 5}, "lidar_dropout 5 is outside 0 to 0.9: is it in percent. Then write 0.05"),
        ({"push_speed_m_s": 50}, "push_speed_m_s 50 is outside 0 to 1 m/s: is it in centimetres per second"),
        ({"battery_v": 11100}, "battery_v 11100 is outside 6.5 to 12.6 V: is it in millivolts. Then write 11.1"),
        ({"battery_v": 230}, "battery_v 230 is outside 6.5 to 12.6 V$"),
        ({"battery_v": "full"}, 'battery_v "full" must be a number'),
        ({"battery_v": [9, 10, 11]}, "battery_v cannot follow the law 11: log is for positive numbers"),
        ({"battery_v": [9]}, r"battery_v \[9\] must be a number, \[low, high\] or with"),
        ({"battery_v": True}, "battery_v true must be a number"),
        ({"battery_v": 10**400}, r"battery_v 1e\+99 is outside"),
        ({"lidar_bias_m": [0.1, 0.2, "log"]}, "lidar_bias_m cannot follow the law 'log'"),
        ({"curriculum": "yes"}, "curriculum 'yes' of a randomization must be true or false"),
        ('{"battery_v": NaN}', "is not valid JSON: NaN is no JSON number"),
        ('{"battery_v": 9, "battery_v": 10}', "is not valid JSON: it holds a key twice"),
        ("{]", "is not valid JSON"),
        ("missing.json", "'missing.json' cannot be read: No such file"),
    ],
)
def test_what_is_not_possible_is_refused_in_one_line_that_says_what_to_do(source: Any, message: str) -> None:
    with pytest.raises(InputError, match=message) as refusal:
        Randomization.load(source)

    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("given", ["burgr", '{"command_delay_s": [0, 50]}', '{"wheel_radius": [1.1, 0.9]}'])
def test_the_command_line_says_it_in_one_line_and_writes_nothing(
    given: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = run_cli("train", "--agent", "ppo", "--randomization", given, "--run-dir", str(tmp_path / "run"))

    assert code == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_a_file_changes_a_preset_and_comes_back_from_its_own_json(tmp_path: Path) -> None:
    (tmp_path / "mine.json").write_text('{"preset": "burger", "battery_v": [8, 9], "yaw_inertia": 1}', encoding="utf-8")

    mine = Randomization.load(str(tmp_path / "mine.json"))

    assert mine.battery_v == Range(8.0, 9.0)
    assert mine.wheel_radius == RANDOMIZATION_PRESETS["burger"].wheel_radius
    assert "yaw_inertia" not in mine.names
    for one in (mine, *RANDOMIZATION_PRESETS.values()):
        assert Randomization.load(json.dumps(one.to_json())) == one
        assert hash(one) == hash(Randomization.load(one.to_json()))


def test_ranges_are_drawn_together_around_the_nominal_value_and_blown_up_within_what_is_possible() -> None:
    ranges = Randomization.load({"battery_v": [9, 12], "yaw_inertia": [0.25, 16, "log"], "command_delay_s": [0.1, 0.3]})

    half, twice = ranges.scaled(0.5), ranges.scaled(2.0)

    # By hand: 11.1 - 2.1/2 = 10.05 and 11.1 + 0.9/2 = 11.55; by factors sqrt(0.25) = 0.5 and sqrt(16) = 4.
    assert (half.battery_v.low, half.battery_v.high) == pytest.approx((10.05, 11.55))
    assert (half.yaw_inertia.low, half.yaw_inertia.high) == pytest.approx((0.5, 4.0))
    # 0.1 * 2 and 0.3 * 2 = 0.6, of which 0.4 is possible; 0.25^2 = 0.0625 and 256, of which 0.1 and 30 are.
    assert (twice.command_delay_s.low, twice.command_delay_s.high) == pytest.approx((0.2, 0.4))
    assert (twice.yaw_inertia.low, twice.yaw_inertia.high) == pytest.approx((0.1, 30.0))
    assert ranges.scaled(0.0) == Randomization()
    assert ranges.without("battery_v", "yaw_inertia") == ranges.only("command_delay_s")
    with pytest.raises(InputError, match="strength 11 of a randomization is outside 0 to 10"):
        ranges.scaled(11)


# ---- Draws ---------------------------------------------------------------------------------------


def draws_of(randomization: Randomization, seed: int = 0, n: int = 50, episodes: int = 3) -> Draws:
    draws = Draws(randomization, n)
    draws.use([np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(n)])
    for _ in range(episodes):
        draws.draw(np.arange(n))
    return draws


@pytest.mark.parametrize("name", ["wheel_radius", "yaw_inertia", "lidar_noise_m"])
def test_switching_a_quantity_off_changes_no_draw_of_another_one(name: str) -> None:
    burger = RANDOMIZATION_PRESETS["burger"]
    all_of_them, others = draws_of(burger), draws_of(burger.without(name))
    counts = np.arange(50)

    for other in burger.names:
        if other != name:
            np.testing.assert_array_equal(all_of_them[other], others[other])
    np.testing.assert_array_equal(
        all_of_them.normals("position_noise_m", counts, 2), others.normals("position_noise_m", counts, 2)
    )
    assert (others[name] == PARAMETERS[name].nominal).all()
    assert len(np.unique(all_of_them[name])) == 50


def test_draws_depend_on_the_seed_and_the_episode_and_on_no_other_environment() -> None:
    burger = RANDOMIZATION_PRESETS["burger"]
    one, same, alone = draws_of(burger), draws_of(burger), draws_of(burger)
    other_seed, next_episode = draws_of(burger, seed=1), draws_of(burger, episodes=4)
    same.draw(np.arange(10, 50))

    np.testing.assert_array_equal(one.values, alone.values)
    np.testing.assert_array_equal(one.values[:10], same.values[:10])
    for different in (other_seed, next_episode):
        assert (one["battery_v"] != different["battery_v"]).all()


def test_draws_follow_their_laws_and_fill_their_ranges() -> None:
    ranges = Randomization.load({"battery_v": [9, 12], "yaw_inertia": [0.5, 8, "log"], "lidar_noise_m": [0, 0.3]})
    drawn = draws_of(ranges, n=20_000)

    # Uniform: mean 10.5 and standard deviation 3 / sqrt(12); four standard errors are 0.03 V.
    assert drawn["battery_v"].mean() == pytest.approx(10.5, abs=0.025)
    assert drawn["battery_v"].std() == pytest.approx(3 / np.sqrt(12), rel=0.02)
    # Log: half of them below the geometric mean, sqrt(0.5 * 8) = 2.
    assert (drawn["yaw_inertia"] < 2.0).mean() == pytest.approx(0.5, abs=0.015)
    assert 0.5 <= drawn["yaw_inertia"].min() < 0.502 and 7.98 < drawn["yaw_inertia"].max() <= 8.0
    # The size of a noise says nothing of its first values: the correlation of 20 000 pairs is within 4 / sqrt(20 000).
    first = drawn.normals("lidar_noise_m", np.zeros(20_000, dtype=np.int64), 1)[:, 0]
    assert abs(np.corrcoef(np.abs(first), drawn["lidar_noise_m"])[0, 1]) < 0.03
    assert (first.mean(), first.std()) == pytest.approx((0.0, 1.0), abs=0.03)


@pytest.mark.parametrize("world", WORLDS)
def test_environments_differ_without_a_seed_too(world: str) -> None:
    batteries = [make(world, "burger", 3).reset()[1]["randomization"]["battery_v"] for _ in range(2)]

    assert len(np.unique(batteries)) == 6


# ---- The curriculum ------------------------------------------------------------------------------


def play_window(draws: Draws, success: float) -> None:
    """Episodes of all environments, until those that count are over, with this share of successes among them."""
    ids = np.arange(len(draws.keys))
    draws.draw(ids)
    for _ in range(100):
        before = draws.curriculum.state.copy()
        counted = draws.curriculum.is_sample.cumsum() + before[2]
        draws.curriculum.note(ids, np.ones(len(ids), dtype=bool), counted <= success * WINDOW)
        if draws.curriculum.state[2] < before[2] or not draws.curriculum.state[1:].any():
            return
        draws.draw(ids)
    pytest.fail("the curriculum never decided")


def test_the_curriculum_widens_with_success_narrows_without_and_rests_between() -> None:
    draws = draws_of(RANDOMIZATION_PRESETS["curriculum"], n=30, episodes=0)
    strengths = []
    for success in (0.95, 0.95, 0.7, 0.3, 0.95, 0.0, 0.0, 0.0):
        play_window(draws, success)
        strengths.append(draws.curriculum.strength)

    # By hand: up, up, stays, down, up, down, down, and not below 0.
    np.testing.assert_allclose(strengths, np.array([1, 2, 2, 1, 2, 1, 0, 0]) * STEP)


def test_the_curriculum_waits_for_the_slow_episodes_and_does_not_count_what_was_cut() -> None:
    """The first to end are the good ones: would they decide, ranges would widen where one robot in three is lost."""
    curriculum = Curriculum.begin(2 * WINDOW)
    everyone, over = np.arange(2 * WINDOW), np.ones(WINDOW, dtype=bool)
    curriculum.state[1], curriculum.is_sample[:WINDOW] = WINDOW, True
    fast, slow = everyone[: WINDOW * 2 // 3], everyone[WINDOW * 2 // 3 : WINDOW]

    curriculum.note(fast, over[: len(fast)], over[: len(fast)])
    assert curriculum.state.tolist() == [0.0, WINDOW, len(fast), len(fast)]
    curriculum.note(slow[:10], ~over[:10], over[:10])  # the robots are put into another maze
    assert curriculum.state.tolist() == [0.0, WINDOW - 10, len(fast), len(fast)]
    keys = np.arange(1000, dtype=np.uint64)[everyone]
    curriculum.strength_for(everyone[WINDOW:], keys[WINDOW:], np.ones(WINDOW, dtype=np.int64))
    assert curriculum.is_sample[WINDOW:].sum() == 10  # as many take their place, and no more
    curriculum.note(slow[10:], over[: len(slow) - 10], ~over[: len(slow) - 10])
    curriculum.note(everyone[WINDOW:], over, ~over)

    assert curriculum.state.tolist() == [0.0, 0, 0, 0]  # two of three arrived: neither wider nor narrower


def test_the_curriculum_begins_with_the_nominal_robot_and_stays_within_its_ranges() -> None:
    wide = RANDOMIZATION_PRESETS["curriculum"]
    draws = draws_of(wide, n=2000, episodes=1)
    nominal = [PARAMETERS[name].nominal for name in wide.names]
    np.testing.assert_allclose(np.stack([draws[name] for name in wide.names], axis=1), np.tile(nominal, (2000, 1)))

    draws.curriculum.state[0] = 1.0
    draws.draw(np.arange(2000))

    for name in wide.names:
        ends = (getattr(wide, name).low, getattr(wide, name).high, PARAMETERS[name].nominal)
        assert min(ends) <= draws[name].min() and draws[name].max() <= max(ends), name
    # Half of the episodes at full strength, the others anywhere below: a few quantities lie where only these can.
    assert (draws["command_delay_s"] > 0.5 * wide.command_delay_s.high).mean() > 0.25
    assert (draws["command_delay_s"] < wide.command_delay_s.low).mean() > 0.02


@pytest.mark.parametrize("world", WORLDS)
def test_an_environment_tells_its_curriculum_which_episodes_arrived(world: str) -> None:
    env = make(world, "curriculum", 8, max_episode_steps=4)
    env.reset(seed=0)
    sampled = env._draws.curriculum.is_sample.sum()
    for actions in bold_actions(4, 8):
        env.step(actions)

    began, ended, arrived = env._draws.curriculum.state[1:]
    assert (ended, arrived) == (sampled, 0)
    assert began == ended + env._draws.curriculum.is_sample.sum()
