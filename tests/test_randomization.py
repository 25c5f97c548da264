"""What varies of robots, senses and mazes: ranges as data, draws of their own, and what each quantity does."""

from __future__ import annotations

import itertools
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from command_line import run_cli
from gridnav.envs.draws import NAMES, STEP, WINDOW, Curriculum, Draws
from test_env_state import assert_equal, through_files

import gridnav  # noqa: F401, registers the worlds
from gridnav.agents import Planner, Progress
from gridnav.envs import (
    PARAMETERS,
    RANDOMIZATION_PRESETS,
    LayoutMix,
    NavigationVectorEnv,
    Randomization,
    Range,
)
from gridnav.experiment.drivability import try_driving
from gridnav.experiment.evaluation import EVALUATION_SEED, evaluate_in
from gridnav.experiment.results import open_log
from gridnav.experiment.rollouts import Rollouts, load_rollouts, save_rollouts
from gridnav.experiment.run_directory import RunDirectory
from gridnav.experiment.training import Budget, Choice, Job, Workshop
from gridnav.experiment.worlds import Problem
from gridnav.problem.layout import NAMED_LAYOUTS, Layout
from gridnav.problem.types import FloatArray, InputError, State

ROOT = Path(__file__).resolve().parents[1]
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


def test_the_grid_has_nothing_that_varies(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = run_cli("train", "--agent", "q-learning", "--randomization", "burger", "--run-dir", str(tmp_path / "run"))

    assert code == 2
    assert "--randomization varies robots, and the grid has none" in capsys.readouterr().err
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
    assert 0.5 <= drawn["yaw_inertia"].min() < 0.502
    assert 7.98 < drawn["yaw_inertia"].max() <= 8.0
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
        _, _, ended, _, decisions = draws.curriculum.state
        counted = (draws.curriculum.counts_for == decisions).cumsum() + ended
        draws.curriculum.note(ids, np.ones(len(ids), dtype=bool), counted <= success * WINDOW)
        if draws.curriculum.state[4] > decisions:
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
    curriculum.state[1], curriculum.counts_for[:WINDOW] = WINDOW, 0
    fast, slow = everyone[: WINDOW * 2 // 3], everyone[WINDOW * 2 // 3 : WINDOW]

    curriculum.note(fast, over[: len(fast)], over[: len(fast)])
    assert curriculum.state.tolist() == [0.0, WINDOW, len(fast), len(fast), 0]
    curriculum.note(slow[:10], ~over[:10], over[:10])  # the robots are put into another maze
    assert curriculum.state.tolist() == [0.0, WINDOW - 10, len(fast), len(fast), 0]
    keys = np.arange(1000, dtype=np.uint64)[everyone]
    curriculum.strength_for(everyone[WINDOW:], keys[WINDOW:], np.ones(WINDOW, dtype=np.int64))
    assert (curriculum.counts_for[WINDOW:] == 0).sum() == 10  # as many take their place, and no more
    curriculum.note(slow[10:], over[: len(slow) - 10], ~over[: len(slow) - 10])
    curriculum.note(everyone[WINDOW:], over, ~over)

    assert curriculum.state.tolist() == [0.0, 0, 0, 0, 1]  # two of three arrived: neither wider nor narrower


@pytest.mark.parametrize(("arrives", "settled", "change"), [(True, 102, STEP), (False, 49, -STEP)])
def test_the_curriculum_decides_once_the_episodes_under_way_cannot_change_it(
    arrives: bool, settled: int, change: float
) -> None:
    """By hand: 102 arrivals are 85 % of 120 whatever the others do, 49 failures leave less than 60 %."""
    curriculum = Curriculum.begin(WINDOW)
    everyone, alike = np.arange(WINDOW), np.ones(WINDOW, dtype=bool)
    curriculum.state[:2], curriculum.counts_for[:] = (0.5, WINDOW), 0

    curriculum.note(everyone[: settled - 1], alike[: settled - 1], alike[: settled - 1] & arrives)
    assert curriculum.strength == 0.5
    curriculum.note(everyone[settled - 1 : settled], alike[:1], alike[:1] & arrives)

    assert curriculum.state.tolist() == [0.5 + change, 0, 0, 0, 1]
    curriculum.note(everyone[settled:], alike[settled:], alike[settled:])
    assert curriculum.state[2] == 0  # what was under way says nothing of the new strength


def test_the_curriculum_begins_with_the_nominal_robot_and_stays_within_its_ranges() -> None:
    wide = RANDOMIZATION_PRESETS["curriculum"]
    draws = draws_of(wide, n=2000, episodes=1)
    nominal = [PARAMETERS[name].nominal for name in wide.names]
    np.testing.assert_allclose(np.stack([draws[name] for name in wide.names], axis=1), np.tile(nominal, (2000, 1)))

    draws.curriculum.state[0] = 1.0
    draws.draw(np.arange(2000))

    for name in wide.names:
        ends = (getattr(wide, name).low, getattr(wide, name).high, PARAMETERS[name].nominal)
        assert min(ends) <= draws[name].min(), name
        assert draws[name].max() <= max(ends), name
    # Half of the episodes at full strength, the others anywhere below: a few quantities lie where only these can.
    assert (draws["command_delay_s"] > 0.5 * wide.command_delay_s.high).mean() > 0.25
    assert (draws["command_delay_s"] < wide.command_delay_s.low).mean() > 0.02


@pytest.mark.parametrize("world", WORLDS)
def test_an_environment_tells_its_curriculum_which_episodes_arrived(world: str) -> None:
    env = make(world, "curriculum", 8, max_episode_steps=4)
    env.reset(seed=0)
    sampled = (env._draws.curriculum.counts_for == 0).sum()
    for actions in bold_actions(4, 8):
        env.step(actions)

    began, ended, arrived = env._draws.curriculum.state[1:4]
    assert (ended, arrived) == (sampled, 0)
    assert began == ended + (env._draws.curriculum.counts_for == 0).sum()


def test_groups_in_mazes_of_their_own_share_a_curriculum_that_begins_anew_with_a_seed() -> None:
    def worlds(layout: Layout, n: int) -> NavigationVectorEnv:
        env = make("Unicycle", "curriculum", n, layout=layout, max_episode_steps=3)
        assert isinstance(env, NavigationVectorEnv)
        return env

    mix = LayoutMix(worlds, 40, lambda rng: Layout.load("open"), n_groups=20, renew_steps=100)
    mix.reset(seed=0)
    for _ in range(40):
        mix.step(np.zeros((40, 2)))
    first = mix.groups[0]._draws.curriculum  # type: ignore[attr-defined]

    # By hand: nobody moves, all fail, and every three steps about 20 count; of a group alone it would be 13 in all.
    assert first.state[4] >= 2
    assert mix.curriculum_strength == 0.0
    first.state[0] = 0.4
    assert {group.curriculum_strength for group in mix.groups} == {0.4}
    mix.reset(seed=1)
    assert mix.curriculum_strength == 0.0
    assert first.state[1] > 0


# ---- Scalar and vector, states -------------------------------------------------------------------


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("randomization", ["burger", MAZES], ids=["burger", "mazes"])
def test_single_environments_are_the_batch_bit_for_bit(world: str, randomization: Any) -> None:
    """But for the maze, which a batch shares: there the batch is of one."""
    n, n_steps, limit = (4, 210, 60) if randomization == "burger" else (1, 130, 60)
    batch = make(world, randomization, n, layout="classic", max_episode_steps=limit)
    observations, info = batch.reset(seed=list(range(n)))
    singles = [
        gym.make(f"gridnav/{world}-v0", randomization=randomization, max_episode_steps=limit, disable_env_checker=True)
        for _ in range(n)
    ]
    for i, single in enumerate(singles):
        observation, own_info = single.reset(seed=i)
        np.testing.assert_array_equal(observation, observations[i])
        assert all(type(value) is float for value in own_info["randomization"].values())
        assert own_info["randomization"] == {name: drawn[i] for name, drawn in info["randomization"].items()}

    for actions in bold_actions(n_steps, n):
        observations, rewards, terminated, truncated, info = batch.step(actions)
        reached = info.get("final_info", info)
        for i, single in enumerate(singles):
            observation, reward, own_terminated, own_truncated, own_info = single.step(actions[i])
            assert (reward, own_terminated, own_truncated) == (rewards[i], terminated[i], truncated[i])
            np.testing.assert_array_equal(own_info["pose"], reached["pose"][i])
            assert own_info["randomization"] == {name: drawn[i] for name, drawn in reached["randomization"].items()}
            if own_terminated or own_truncated:
                np.testing.assert_array_equal(observation, info["final_obs"][i])
                if randomization != "burger":
                    continue  # the next reset gives it another maze, and the batch keeps its own
                observation, _ = single.reset()
            np.testing.assert_array_equal(observation, observations[i])
        if randomization != "burger" and (terminated | truncated).any():
            return


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("randomization", ["burger", "curriculum", MAZES], ids=["burger", "curriculum", "mazes"])
def test_an_environment_goes_on_from_the_middle_of_an_episode_bit_for_bit(world: str, randomization: Any) -> None:
    options = {"num_envs": 5, "layout": "classic", "max_episode_steps": 30}
    first, other = make(world, randomization, **options), make(world, randomization, **options)
    first.reset(seed=3)
    for actions in bold_actions(47, 5, seed=1):
        first.step(actions)

    other.set_state(through_files(first.get_state()))

    assert other.layout == first.layout
    for actions in bold_actions(50, 5, seed=2):
        for a, b in zip(first.step(actions), other.step(actions), strict=True):
            assert_equal(a, b)
    assert_equal(first.reset(), other.reset())
    assert other.layout == first.layout


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("randomization", ["curriculum", MAZES], ids=["curriculum", "mazes"])
def test_a_mix_of_layouts_goes_on_from_the_middle_bit_for_bit(world: str, randomization: Any) -> None:
    def mix() -> LayoutMix:
        def worlds(layout: Layout, n: int) -> NavigationVectorEnv:
            env = make(world, randomization, n, layout=layout, max_episode_steps=7)
            assert isinstance(env, NavigationVectorEnv)
            return env

        return LayoutMix(worlds, 6, lambda rng: Layout.load("classic"), n_groups=3, renew_steps=12)

    first, other = mix(), mix()
    first.reset(seed=3)
    for actions in bold_actions(17, 6, seed=1):
        first.step(actions)

    other.set_state(through_files(first.get_state()))

    for actions in bold_actions(30, 6, seed=2):
        for a, b in zip(first.step(actions), other.step(actions), strict=True):
            assert_equal(a, b)


def test_a_state_with_numbers_that_nothing_draws_is_refused() -> None:
    env = make("Unicycle", "burger", 2)
    env.reset(seed=0)
    arrays, values = env.get_state()

    for wrong in (np.nan, np.inf, 1e9):
        drawn = arrays["imperfections.drawn"].copy()
        drawn[1, NAMES.index("lidar_delay_s")] = wrong
        with pytest.raises(InputError, match="outside what a randomization may draw"):
            env.set_state(State(arrays | {"imperfections.drawn": drawn}, values))
    with pytest.raises(InputError, match=r"cells of 99\.0 m in the state are none of 0\.5 m"):
        env.set_state(State(arrays, {**values, "cell_size_m": 99.0}))
    with pytest.raises(InputError, match="does not fit the randomization"):
        make("Unicycle", "burger", 2, control_period_s=0.1).set_state(State(arrays, values))


# ---- What every world keeps to -------------------------------------------------------------------


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("randomization", ["wide", Randomization.load("burger").scaled(3.0)], ids=["wide", "thrice"])
def test_observations_stay_within_their_space_and_the_physics_holds(world: str, randomization: Any) -> None:
    env = make(world, randomization, 16, layout="classic", max_episode_steps=60)
    observations, info = env.reset(seed=0)
    collisions = 0
    for actions in bold_actions(150, 16):
        observations, _, _, _, info = env.step(actions)
        assert env.observation_space.contains(observations)
        reached = info.get("final_info", info)
        assert "physics_error" not in reached
        collisions += reached["collision"].sum()
    assert collisions > 5


@pytest.mark.parametrize("world", WORLDS)
def test_without_a_randomization_nothing_is_said_of_one(world: str) -> None:
    env = make(world, "none")
    _, info = env.reset(seed=0)

    assert "randomization" not in info


# ---- Physics -------------------------------------------------------------------------------------


def mean_speeds(world: str, action: tuple[float, float], **values: float) -> tuple[float, float]:
    """Forward speed in m/s and turning speed in rad/s, means over 6 s after 2 s of starting."""
    env = make(world, Randomization.fixed(**values))
    env.reset(seed=0, options={"start": (5, 2), "goal": (0, 0), "heading_rad": 0.0})
    way_m, headings = 0.0, []
    for step in range(40):
        *_, info = env.step(np.array([action]))
        headings.append(info["pose"][0, 2])
        if step == 9:
            way_m = -info["path_length_m"][0]
    way_m += info["path_length_m"][0]
    turned = np.unwrap(headings)
    return way_m / 6.0, float(turned[-1] - turned[9]) / 6.0


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize(
    ("name", "value", "forward", "turning"),
    [
        ("wheel_radius", 1.02, 1.02, 1.02),  # v = omega r
        ("wheel_radius", 0.9, 0.9, 0.9),
        ("wheel_separation", 1.1, 1.0, 1 / 1.1),  # turn = (v_right - v_left) / b
        ("wheel_separation", 0.9, 1.0, 1 / 0.9),
        # No-load speed follows the voltage, U / K; friction takes its torque from both: 0.162 m/s at 9 V and 0.197 m/s
        # at 11.1 V without friction.
        ("battery_v", 9.0, 9.0 / 11.1, 9.0 / 11.1),
    ],
)
def test_both_worlds_drive_and_turn_by_the_wheels_that_were_drawn(
    world: str, name: str, value: float, forward: float, turning: float
) -> None:
    nominal_forward, _ = mean_speeds(world, (1.0, 0.0))
    _, nominal_turn = mean_speeds(world, (0.0, 1.0))

    assert mean_speeds(world, (1.0, 0.0), **{name: value})[0] / nominal_forward == pytest.approx(forward, rel=0.012)
    assert mean_speeds(world, (0.0, 1.0), **{name: value})[1] / nominal_turn == pytest.approx(turning, rel=0.012)


def loaded_speed_m_s(volts: float = 11.1, torque: float = 1.0, damping: float = 0.02, stiction: float = 0.01) -> float:
    """Speed of a wheel's rim where motor and friction balance: K U / R - stiction = (K^2 / R + damping) omega."""
    k = 11.1 / 5.969  # V s / rad, and stall torque 1.4 N m = K U / R at 11.1 V
    resistance = k * 11.1 / (1.4 * torque)
    return 0.033 * (k * volts / resistance - stiction) / (k * k / resistance + damping)


@pytest.mark.parametrize(
    ("values", "left_m_s", "right_m_s"),
    [
        ({}, loaded_speed_m_s(), loaded_speed_m_s()),
        ({"battery_v": 9.0}, loaded_speed_m_s(9.0), loaded_speed_m_s(9.0)),
        ({"wheel_damping": 0.05}, loaded_speed_m_s(damping=0.05), loaded_speed_m_s(damping=0.05)),
        ({"wheel_stiction_n_m": 0.1}, loaded_speed_m_s(stiction=0.1), loaded_speed_m_s(stiction=0.1)),
        ({"motor_left": 0.7}, loaded_speed_m_s(torque=0.7), loaded_speed_m_s()),
        ({"motor_right": 0.7}, loaded_speed_m_s(), loaded_speed_m_s(torque=0.7)),
        # In 5 s, the middle of what is looked at, a battery that loses 3 V in 100 s has lost 0.15 V.
        ({"battery_sag_v": 3.0}, loaded_speed_m_s(10.95), loaded_speed_m_s(10.95)),
    ],
)
def test_top_speed_is_where_motor_and_friction_balance(
    values: dict[str, float], left_m_s: float, right_m_s: float
) -> None:
    forward, turn = mean_speeds("DiffDrive", (1.0, 0.0), **values)

    assert forward == pytest.approx((left_m_s + right_m_s) / 2, rel=0.02)
    assert turn == pytest.approx((right_m_s - left_m_s) / 0.16, abs=0.006)


@pytest.mark.parametrize("world", WORLDS)
def test_a_larger_right_wheel_turns_the_robot_left(world: str) -> None:
    forward, turn = mean_speeds(world, (1.0, 0.0), wheel_radius_ratio=1.02)

    # Radii 2/2.02 and 2.04/2.02 of the nominal one differ by 0.0198; what is 0.16 m apart turns by it. In MuJoCo the
    # caster, which is dragged sideways, holds against it.
    assert 0.7 * forward * 0.0198 / 0.16 < turn < 1.02 * forward * 0.0198 / 0.16


def wheel_speeds(n_periods: int, fraction: float, **values: float) -> FloatArray:
    """Speed of the left wheel after every 10 ms of a command, rad/s, with 1 ms of physics."""
    env = make("DiffDrive", Randomization.fixed(**values), control_period_s=0.01, timestep_s=0.001)
    env.reset(seed=0, options={"start": (5, 2), "goal": (0, 0), "heading_rad": 0.0})
    speeds = []
    for _ in range(n_periods):
        env.step(np.array([[fraction, 0.0]]))
        speeds.append(env._qvel[0, 6])
    return np.array(speeds)


@pytest.mark.parametrize("lag_s", [0.05, 0.1, 0.3])
def test_motors_reach_63_percent_of_a_small_step_after_their_lag(lag_s: float) -> None:
    n_periods = round(lag_s / 0.01)
    final = wheel_speeds(8 * n_periods, 0.1, motor_lag_s=lag_s)[-1]

    assert wheel_speeds(n_periods, 0.1, motor_lag_s=lag_s)[-1] / final == pytest.approx(1 - np.exp(-1), rel=0.03)


@pytest.mark.parametrize("delay_s", [0.0, 0.05, 0.1, 0.25, 0.4])
def test_a_delayed_command_moves_the_wheels_so_much_later(delay_s: float) -> None:
    moving = np.abs(wheel_speeds(45, 0.5, command_delay_s=delay_s)) > 0.05

    assert np.argmax(moving) == round(delay_s / 0.01)  # the period that begins then


@pytest.mark.parametrize("delay_s", [0.0, 0.05, 0.1, 0.25, 0.4])
def test_a_unicycle_stands_still_for_the_delay_too(delay_s: float) -> None:
    env = make("Unicycle", Randomization.fixed(command_delay_s=delay_s))
    env.reset(seed=0, options={"start": (5, 2), "goal": (0, 0), "heading_rad": 0.0})
    for _ in range(5):
        *_, info = env.step(np.array([[1.0, 0.0]]))

    # One second less the delay, at 5.969 rad/s on a wheel of 0.033 m.
    assert info["path_length_m"][0] == pytest.approx((1.0 - delay_s) * 5.969 * 0.033)


@pytest.mark.parametrize("world", WORLDS)
def test_a_stop_that_comes_too_late_is_a_collision(world: str) -> None:
    """A robot drives into a wall by its motion, whatever the policy wants by then."""
    env = make(world, Randomization.fixed(command_delay_s=0.25))
    _, info = env.reset(seed=0, options={"start": (0, 0), "goal": (9, 9), "heading_rad": np.pi / 2})
    while info["pose"][0, 1] < env.layout.size_m[1] - env.robot.radius_m - 0.042:
        *_, info = env.step(np.array([[1.0, 0.0]]))
    assert info["collisions"][0] == 0

    # By hand: in 0.25 s a robot drives 4 to 5 cm, and the wall is 4.2 cm away at most.
    for _ in range(5):
        *_, info = env.step(np.zeros((1, 2)))

    assert info["collisions"][0] == 1


def test_the_floor_leaves_the_casters_friction_as_it_is_drawn() -> None:
    """MuJoCo takes the larger of two frictions."""
    env = make("DiffDrive", "none")

    assert env.model.geom("floor").friction[0] <= PARAMETERS["caster_friction"].lowest


@pytest.mark.parametrize("world", WORLDS)
def test_wheels_do_not_move_for_commands_in_the_deadband(world: str) -> None:
    # By hand: a fifth of the top speed is 0.039 m/s, three tenths 0.059.
    assert mean_speeds(world, (0.2, 0.0), command_deadband_m_s=0.05)[0] < 0.001
    assert mean_speeds(world, (0.3, 0.0), command_deadband_m_s=0.05)[0] > 0.05


def test_a_robot_on_a_slope_slides_down_where_its_wheels_have_no_hold() -> None:
    slope = Randomization.fixed(floor_tilt_rad=0.1, wheel_friction=0.05, caster_friction=0.02)
    env = make("DiffDrive", slope, 8)
    poses = [env.reset(seed=0, options={"start": (5, 5), "goal": (0, 0)})[1]["pose"]]
    for _ in range(5):
        poses.append(env.step(np.zeros((8, 2)))[-1]["pose"])

    gravity = env._physics._field("opt.gravity")
    np.testing.assert_allclose(np.linalg.norm(gravity, axis=1), 9.81)
    np.testing.assert_allclose(np.arccos(-gravity[:, 2] / 9.81), 0.1)
    assert len(np.unique(np.round(gravity[:, 0], 6))) == 8  # every episode its own direction
    moved = poses[-1][:, :2] - poses[0][:, :2]
    down = gravity[:, :2] / np.linalg.norm(gravity[:, :2], axis=1, keepdims=True)
    # Between g (sin 0.1 - 0.05) and g (sin 0.1 - 0.02), over half the square of a second: 0.24 to 0.39 m.
    along = (moved * down).sum(axis=1)
    assert (along > 0.2).all()
    assert (along < 0.4).all()

    held = make("DiffDrive", Randomization.fixed(floor_tilt_rad=0.1), 8)
    before = held.reset(seed=0, options={"start": (5, 5), "goal": (0, 0)})[1]["pose"]
    for _ in range(5):
        after = held.step(np.zeros((8, 2)))[-1]["pose"]
    assert np.linalg.norm(after[:, :2] - before[:, :2], axis=1).max() < 0.03


def test_masses_inertias_and_centres_are_those_drawn() -> None:
    values = {"mass": 1.2, "payload_kg": 1.0, "yaw_inertia": 5.0, "centre_x_m": 0.02, "centre_z_m": -0.03}
    env = make("DiffDrive", Randomization.fixed(**values))
    env.reset(seed=0)
    model, field = env.model, env._physics._field
    base = model.body("base").id

    # By hand: 0.945 * 1.2 + 1 = 2.134 kg, 2.2582 times as much; z has five times that inertia.
    assert field("body_mass")[0, base] == pytest.approx(2.134)
    np.testing.assert_allclose(
        field("body_inertia")[0, base] / model.body_inertia[base], [2.258201, 2.258201, 11.291005], rtol=1e-6
    )
    np.testing.assert_allclose(field("body_ipos")[0, base], [-0.01, 0.0, 0.017])


def test_a_robot_with_more_yaw_inertia_takes_longer_to_turn() -> None:
    def turned(inertia: float) -> float:
        env = make("DiffDrive", Randomization.fixed(yaw_inertia=inertia))
        env.reset(seed=0, options={"start": (5, 2), "goal": (0, 0), "heading_rad": 0.0})
        return float(env.step(np.array([[0.0, 1.0]]))[-1]["pose"][0, 2])

    assert turned(30.0) < 0.9 * turned(1.0)


@pytest.mark.parametrize(("preset", "least"), [("none", 1.0), ("burger", 0.99), ("wide", 0.97)])
def test_nearly_all_robots_of_a_preset_can_drive(preset: str, least: float) -> None:
    assert try_driving(Randomization.load(preset), 256).driving_share >= least


def test_a_robot_whose_weight_lies_on_the_axle_falls() -> None:
    assert try_driving(Randomization.fixed(centre_x_m=0.03), 1).falls.all()


@pytest.mark.parametrize(
    "body",
    [
        # By hand, in shares of the weight: wheels that carry 1 - 0.064 / 0.081 = 0.21 hold 0.05, which the slope takes;
        # those that carry 0.26 hold 0.05, and the caster takes 0.74 * 0.3 = 0.22.
        {"centre_x_m": -0.034, "wheel_friction": 0.25, "floor_tilt_rad": 0.05},
        {"centre_x_m": -0.03, "wheel_friction": 0.2, "caster_friction": 0.3},
    ],
)
def test_a_robot_whose_wheels_have_no_hold_stays_where_it_is(body: dict[str, float]) -> None:
    assert try_driving(Randomization.fixed(**body), 8).stays.all()


def test_of_a_curriculum_the_whole_ranges_are_tried() -> None:
    nose = {"centre_x_m": [0.02, 0.04]}  # at strength 0 nobody would fall
    whole, begun = (try_driving(Randomization.load(nose | {"curriculum": one}), 16) for one in (False, True))

    np.testing.assert_array_equal(whole.stays, begun.stays)
    np.testing.assert_array_equal(whole.falls, begun.falls)
    assert whole.falls.any()


def test_wide_is_burger_half_as_wide_again_but_for_the_centre_of_mass_along_the_robot() -> None:
    burger, wide = RANDOMIZATION_PRESETS["burger"], RANDOMIZATION_PRESETS["wide"]

    assert wide.without("centre_x_m") == burger.scaled(1.5).without("centre_x_m")
    assert wide.centre_x_m == burger.centre_x_m


def test_pushes_come_at_their_intervals_and_are_as_strong_as_drawn() -> None:
    env = make("DiffDrive", Randomization.fixed(push_speed_m_s=0.3, push_turn_rad_s=2.0, push_interval_s=1.0), 64)
    env.reset(seed=0)
    pushed_at, velocities = [], np.zeros((64, 8))
    for step in range(16):
        velocities[:] = 0.0
        env._physics.begin_period(np.full(64, step), 0.2, None, velocities)
        if velocities.any():
            pushed_at.append(step)
            np.testing.assert_allclose(np.hypot(velocities[:, 0], velocities[:, 1]), 0.3)
            assert np.abs(velocities[:, 5]).max() <= 2.0 < 2.1 * np.abs(velocities[:, 5]).max()
            # Any direction: the mean of 64 of them is within 4 / sqrt(64) of nothing.
            assert np.abs(velocities[:, [0, 1, 5]].mean(axis=0) / [0.3, 0.3, 2.0]).max() < 0.4

    assert pushed_at == [5, 10, 15]  # seconds 1, 2 and 3
    poses = [env.reset(seed=0, options={"heading_rad": 0.0})[1]["pose"]]
    for _ in range(6):
        poses.append(env.step(np.zeros((64, 2)))[-1]["pose"])
    way = np.linalg.norm(np.diff(poses, axis=0)[..., :2], axis=-1).mean(axis=1)
    assert way[5] > 5 * way[:5].max()  # what drives through the sixth period was pushed


def test_what_is_drawn_for_many_episodes_does_not_add_up() -> None:
    env = make("DiffDrive", "burger", 4, layout="classic")
    for _ in range(20):
        env.reset()
        env.step(np.ones((4, 2)))

    env._draws.values[:] = [PARAMETERS[name].nominal for name in NAMES]
    env._physics.apply(np.arange(4))
    env._physics.begin_period(np.zeros(4, dtype=np.int64), 0.2, np.zeros(4), np.zeros((4, 8)))

    assert len(env._physics._fields) > 10
    for name, values in env._physics._fields.items():
        part, _, rest = name.partition(".")
        nominal = getattr(env.model.opt, rest) if rest else getattr(env.model, part)
        np.testing.assert_allclose(values, np.broadcast_to(nominal, values.shape), rtol=1e-12, err_msg=name)


# ---- Commands ------------------------------------------------------------------------------------


def passed_on(n_steps: int, n: int, **values: float) -> tuple[FloatArray, FloatArray]:
    """Commands of robots, all of them different, and what was in force, shape ``(n_steps, n, 2)`` each."""
    env = make("Unicycle", Randomization.fixed(**values), n)
    env.reset(seed=0)
    told = np.random.default_rng(0).uniform(0.3, 1.0, (n_steps, n, 2))
    return told, np.array([env._commands.pass_on(told[k], np.full(n, k)).copy() for k in range(n_steps)])


def test_commands_are_lost_as_often_as_drawn_and_the_one_before_stays_in_force() -> None:
    told, in_force = passed_on(100, 100, command_loss=0.2)
    lost = (in_force != told).any(axis=2)

    # 10 000 commands: a share of 0.2 within four standard errors, 4 sqrt(0.2 * 0.8 / 10 000).
    assert lost.mean() == pytest.approx(0.2, abs=0.016)
    once = lost[2:] & ~lost[1:-1]
    np.testing.assert_array_equal(in_force[2:][once], told[1:-1][once])


def test_lost_commands_come_in_rows_and_after_half_a_second_of_silence_the_robot_stops() -> None:
    told, in_force = passed_on(100, 100, command_loss=0.05, command_loss_length=4.0)
    lost = (in_force != told).any(axis=2)

    begins = np.argwhere(lost[1:90] & ~lost[:89])
    for step, robot in begins[:50] + np.array([1, 0]):
        assert lost[step : step + 4, robot].all()
        # After 0.2 and 0.4 s of silence the last command is in force, after 0.6 and 0.8 s none.
        np.testing.assert_array_equal(in_force[step : step + 2, robot], told[[step - 1] * 2, robot])
        assert (in_force[step + 2 : step + 4, robot] == 0.0).all()


def test_commands_are_passed_on_in_steps() -> None:
    _, in_force = passed_on(20, 10, command_quantum=0.02)

    steps = in_force * [5.969 * 0.033, 2 * 5.969 * 0.033 / 0.16] / 0.02  # 0.02 m/s and 0.02 rad/s
    is_full = in_force == 1.0
    np.testing.assert_allclose(steps[~is_full], np.rint(steps[~is_full]), atol=1e-9)
    assert len(np.unique(np.rint(steps[..., 0]))) > 5


def test_jitter_adds_up_to_its_length_to_the_delay() -> None:
    env = make("Unicycle", Randomization.fixed(command_delay_s=0.1, command_jitter_s=0.06), 500)
    env.reset(seed=0)
    delays = env._commands.delays_s(np.zeros(500, dtype=np.int64))

    # Uniform from 0.1 to 0.16: mean 0.13 within four standard errors, 4 * 0.06 / sqrt(12 * 500).
    assert 0.1 <= delays.min() < 0.101
    assert 0.159 < delays.max() < 0.16
    assert delays.mean() == pytest.approx(0.13, abs=0.0031)
    assert (delays != env._commands.delays_s(np.ones(500, dtype=np.int64))).all()


# ---- Senses --------------------------------------------------------------------------------------


def sensing(n: int = 1, **values: float) -> Any:
    """Unicycles at one place of ``classic``, whose senses vary."""
    env = make("Unicycle", Randomization.fixed(**values), n, layout="classic")
    env.reset(seed=0, options={"start": (0, 0), "goal": (9, 9), "heading_rad": -0.3})
    return env


def test_ranges_are_scaled_and_shifted_but_for_those_that_find_nothing() -> None:
    env = sensing(lidar_scale=1.1, lidar_bias_m=-0.1)
    true = env.scan()[0]

    found = true < 3.5
    assert found.any()
    assert not found.all()
    np.testing.assert_allclose(env._senses.ranges_m[0][found], np.minimum(1.1 * true[found] - 0.1, 3.5))
    assert (env._senses.ranges_m[0][~found] == 3.5).all()


def test_the_noise_of_a_range_grows_with_it() -> None:
    env = sensing(4000, lidar_noise_m=0.01, lidar_noise=0.03)
    true = env.scan()[0]
    beams = (true > 0.2) & (true < 3.0)  # neither end of the scale cuts the noise

    error = env._senses.ranges_m[:, beams] - true[beams]

    # 4000 robots give a standard deviation to within four times 1 / sqrt(8000).
    np.testing.assert_allclose(error.std(axis=0), 0.01 + 0.03 * true[beams], rtol=0.05)
    assert np.abs(error.mean(axis=0) / (0.01 + 0.03 * true[beams])).max() < 0.07
    assert np.abs(np.corrcoef(error.T) - np.eye(beams.sum())).max() < 0.08  # each beam errs by itself


def test_beams_drop_out_as_often_as_drawn_and_dark_ones_side_by_side_for_the_whole_episode() -> None:
    env = sensing(1000, lidar_dropout=0.1)
    found = env.scan() < 3.5
    first = env._senses.ranges_m == 3.5
    env.step(np.zeros((1000, 2)))
    assert first[found].mean() == pytest.approx(0.1, abs=0.01)
    assert ((env._senses.ranges_m == 3.5) & first)[found].mean() == pytest.approx(0.01, abs=0.003)

    env = sensing(50, lidar_dark_beams=3.0)
    dark = env._senses._is_dark.copy()
    for _ in range(3):
        np.testing.assert_array_equal(env._senses.ranges_m, np.where(dark, 3.5, env.scan()))
        env.step(np.zeros((50, 2)))
    assert (dark.sum(axis=1) == 3).all()
    assert ((dark & ~np.roll(dark, 1, axis=1)).sum(axis=1) == 1).all()  # one row of them, on the circle
    assert len(np.unique(dark.argmax(axis=1))) > 10


def test_a_lidar_turned_by_one_beam_counter_clockwise_sees_with_each_beam_what_the_next_one_should() -> None:
    env = sensing(lidar_yaw_rad=2 * np.pi / 24)

    np.testing.assert_allclose(env._senses.ranges_m[0], np.roll(env.scan()[0], -1))


def driven(n_steps: int, action: tuple[float, float], **values: float) -> tuple[Any, FloatArray]:
    """Robots after some steps, and their poses so far, the present one last."""
    env = sensing(**values)
    poses = [env._pose.copy()]
    for _ in range(n_steps):
        poses.append(env.step(np.array([action]))[-1]["pose"])
    return env, np.array(poses)[:, 0]


def test_a_late_scan_is_that_of_where_the_robot_was() -> None:
    whole, poses = driven(6, (0.8, 0.3), lidar_delay_s=0.4)
    np.testing.assert_allclose(whole._senses.ranges_m[0], whole.scan(poses[-3:-2])[0])

    half, poses = driven(6, (0.8, 0.3), lidar_delay_s=0.1)
    between = (poses[-1:] + poses[-2:-1]) / 2
    np.testing.assert_allclose(half._senses.ranges_m[0], half.scan(between)[0])

    _, still = driven(1, (0.8, 0.3), lidar_delay_s=0.4)
    at_first, _ = driven(1, (0.8, 0.3), lidar_delay_s=0.4)
    np.testing.assert_allclose(at_first._senses.ranges_m[0], at_first.scan(still[:1])[0])  # it stood still before


def test_the_beams_of_a_turn_are_taken_one_after_the_other_counter_clockwise() -> None:
    env, poses = driven(5, (0.0, 1.0), lidar_skew=1.0)
    turn_rad_s = (poses[-1, 2] - poses[-2, 2]) / 0.2

    for beam in range(24):
        # By hand: beam 0 was taken 0.2 s ago, beam 12 0.1 s ago, and the last one 0.2 / 24 s ago.
        pose = poses[-1:] - [0.0, 0.0, turn_rad_s * 0.2 * (24 - beam) / 24]
        assert env._senses.ranges_m[0, beam] == pytest.approx(env.scan(pose)[0, beam])


def test_a_slow_lidar_gives_each_scan_as_often_as_it_must() -> None:
    env = sensing(lidar_period_s=0.4, lidar_noise_m=0.02)
    scans = []
    for _ in range(6):
        env.step(np.array([[0.8, 0.3]]))
        scans.append(env._senses.ranges_m[0].copy())

    # Scans are taken at 0, 0.4, 0.8, 1.2 s; at 0.2, 0.4, ... 1.2 s the last of them is seen, noise and all.
    same = [np.allclose(one, other, atol=1e-9) for one, other in itertools.pairwise(scans)]
    assert same == [False, True, False, True, False]


def test_a_slow_and_late_lidar_shows_the_newest_scan_that_has_arrived() -> None:
    env, poses = driven(6, (0.8, 0.3), lidar_period_s=0.4, lidar_delay_s=0.3)

    # At 1.2 s what was taken at 0.8 s has arrived, at 1.1 s, and what is taken now has not.
    np.testing.assert_allclose(env._senses.ranges_m[0], env.scan(poses[4:5])[0])


def test_a_drifting_heading_bends_the_estimated_way_to_its_own_side() -> None:
    env, poses = driven(20, (1.0, 0.0), heading_drift_rad_s=0.1, localization_s=1000.0)
    estimated = env._senses.poses[0]

    # By hand: 4 s of 0.1 rad/s, counter-clockwise; on 0.79 m the estimate ends to the left by about half of that angle.
    assert estimated[2] - poses[-1, 2] == pytest.approx(0.4, abs=0.002)
    ahead, left = np.array([np.cos(0.3), -np.sin(0.3)]), np.array([np.sin(0.3), np.cos(0.3)])
    off = estimated[:2] - poses[-1, :2]
    way_m = (poses[-1, :2] - poses[0, :2]) @ ahead
    assert off @ left == pytest.approx(way_m * 0.2, rel=0.07)
    assert off @ ahead == pytest.approx(-way_m * 0.4**2 / 6, rel=0.15)


def test_localisation_pulls_the_estimate_back_to_the_truth() -> None:
    env, poses = driven(80, (0.0, 0.5), heading_drift_rad_s=0.1, localization_s=2.0)

    # By hand: an error e becomes (e + 0.1 * 0.2) exp(-0.1), which rests at 0.02 / (exp(0.1) - 1) = 0.1902 rad.
    error = (env._senses.poses[0, 2] - poses[-1, 2] + np.pi) % (2 * np.pi) - np.pi
    assert error == pytest.approx(0.02 / (np.exp(0.1) - 1), rel=1e-3)


def test_a_wrong_odometer_takes_the_way_for_longer() -> None:
    env, poses = driven(20, (1.0, 0.0), odometry_scale=1.1, localization_s=1000.0)

    way = poses[-1, :2] - poses[0, :2]
    np.testing.assert_allclose(env._senses.poses[0, :2] - poses[0, :2], 1.1 * way, rtol=1e-3)


def test_noise_of_the_position_is_new_at_every_step_and_that_of_the_goal_lasts_for_the_episode() -> None:
    env = sensing(2000, position_noise_m=0.02, goal_noise_m=0.03)
    noise, goals = [], []
    for _ in range(2):
        noise.append(env._senses.poses[:, :2] - env._pose[:, :2])
        goals.append(env._senses.goals_w.copy())
        env.step(np.zeros((2000, 2)))

    np.testing.assert_allclose(np.std(noise), 0.02, rtol=0.04)
    assert np.abs(np.mean(noise[0] * noise[1])) < 0.02**2 * 0.07
    np.testing.assert_array_equal(goals[0], goals[1])
    np.testing.assert_allclose((goals[0] - env._goal_w).std(), 0.03, rtol=0.06)


def test_estimates_never_leave_the_maze() -> None:
    env = sensing(500, position_noise_m=0.5, goal_noise_m=0.5)
    for points in (env._senses.poses[:, :2], env._senses.goals_w):
        assert (points >= 0.0).all()
        assert (points <= 5.0).all()


@pytest.mark.parametrize("period_s", [0.05, 0.2, 0.5])
def test_the_longest_delays_are_remembered_whatever_the_control_period(period_s: float) -> None:
    worst = Randomization.fixed(lidar_delay_s=0.4, lidar_period_s=0.4, lidar_skew=1.0)
    env = make("Unicycle", worst, control_period_s=period_s)
    ages_s, _ = env._senses._scan_times(slice(None), np.arange(1000, 1001))

    assert ages_s.max() / period_s < env._senses._past.shape[1] - 1


# ---- Mazes ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMED_LAYOUTS)
def test_moved_walls_are_as_many_and_shut_no_goal_off(name: str) -> None:
    layout, rng = Layout.load(name), np.random.default_rng(0)
    n_moved = []
    for _ in range(20):
        varied = layout.with_moved_walls(5, rng)  # a layout that shuts a goal off cannot be made
        assert varied.walls.sum() == layout.walls.sum()
        if (layout.starts != ~layout.walls).any():
            np.testing.assert_array_equal(varied.starts, layout.starts)
        if (layout.goals != ~layout.walls).any():
            np.testing.assert_array_equal(varied.goals, layout.goals)
        assert (varied.reachable == ~varied.walls).all() or not (layout.reachable == ~layout.walls).all()
        n_moved.append(int((varied.walls & ~layout.walls).sum()))

    assert max(n_moved) <= 5
    assert name == "open" or max(n_moved) >= 3


def test_moved_walls_separate_no_start_from_its_goal_where_a_part_was_shut_off_before() -> None:
    """Two regions may become two others: what counts is that start and goal stay in the same one."""
    layout = Layout.from_text("S..G\n####\n....\n....")
    for seed in range(50):
        layout.with_moved_walls(4, np.random.default_rng(seed))


def test_the_cells_that_a_reset_names_stay_free() -> None:
    env = make("Unicycle", Randomization.fixed(obstacles_moved=12.0), layout="four-rooms")
    layouts = set()
    for seed in range(20):
        env.reset(seed=seed, options={"start": (2, 2), "goal": (8, 8)})
        layouts.add(env.layout)
        assert env.start_and_goal(0) == ((2, 2), (8, 8))
        assert env.layout.reachable[8, 8]

    assert len(layouts) == 20


def test_info_tells_how_the_maze_of_the_batch_varies_and_a_curriculum_begins_with_the_one_there_is() -> None:
    mazes = {"obstacles_moved": [1, 6], "cell_size": [0.9, 1.1]}
    env = make("Unicycle", Randomization.load(mazes), 3, layout="classic")
    for seed in range(5):
        _, info = env.reset(seed=seed)
        moved = (env.layout.walls & ~Layout.load("classic").walls).sum()
        np.testing.assert_array_equal(info["randomization"]["obstacles_moved"], [moved] * 3)
        np.testing.assert_allclose(info["randomization"]["cell_size"], [env.layout.cell_size_m / 0.5] * 3)

    env = make("Unicycle", Randomization.load({**mazes, "curriculum": True}), 3, layout="classic")
    env.reset(seed=0)
    assert env.layout == Layout.load("classic")


@pytest.mark.parametrize("world", WORLDS)
def test_the_size_of_cells_changes_the_maze_and_nothing_else(world: str) -> None:
    env = make(world, Randomization.fixed(cell_size=1.2), layout="classic")
    observation, info = env.reset(seed=0, options={"start": (0, 0), "goal": (9, 9), "heading_rad": 0.0})

    # By hand: cells of 0.6 m; the start's centre is at (0.3, 5.7) m. A cell-time is 1.2 times as long.
    assert env.layout.cell_size_m == pytest.approx(0.6)
    np.testing.assert_allclose(info["pose"][0], [0.3, 5.7, 0.0])
    assert env.observation_space.contains(observation)
    assert env.step_s == pytest.approx(0.2)
    assert env.step_duration == pytest.approx(0.2 * 5.969 * 0.033 / 0.6)


# ---- From training to files ----------------------------------------------------------------------


def plan_of(problem: Problem) -> Planner:
    return Planner.solve(problem.layout, problem.task, problem.reward)


def test_every_evaluated_episode_says_what_it_drew_and_keeps_it_in_its_files(tmp_path: Path) -> None:
    problem = Problem.load("S...\n....\n...G", "default", "default", "burger")
    episodes = evaluate_in(problem, plan_of(problem), "Unicycle", 3)
    env = problem.worlds("Unicycle", 3)
    _, info = env.reset(seed=EVALUATION_SEED)

    for i, episode in enumerate(episodes):
        assert episode.randomization == {name: drawn[i] for name, drawn in info["randomization"].items()}
        assert episode.randomization.keys() == set(problem.randomization.names)
    save_rollouts(tmp_path, Rollouts("ahead", "Unicycle", "nobody", {"custom": problem.layout}, episodes))
    loaded = load_rollouts(tmp_path, "ahead")
    assert [one.randomization for one in loaded.episodes] == [one.randomization for one in episodes]

    rows = json.loads((tmp_path / "ahead.json").read_text(encoding="utf-8"))
    for hostile in ({"battery_v": "full"}, {"battery_v": True}, {"battery_v": None}, [["battery_v", 9.0]], "battery"):
        changed = json.loads(json.dumps(rows))
        changed["rows"][1]["randomization"] = hostile
        (tmp_path / "ahead.json").write_text(json.dumps(changed), encoding="utf-8")
        with pytest.raises(InputError, match="are damaged"):
            load_rollouts(tmp_path, "ahead")


def test_evaluation_leaves_the_maze_as_it_is_and_takes_the_whole_ranges_of_a_curriculum() -> None:
    problem = Problem.load("classic", "default", "default", '{"preset": "curriculum", "obstacles_moved": [1, 5]}')

    evaluated = problem.for_evaluation.randomization

    assert evaluated == RANDOMIZATION_PRESETS["wide"]
    assert isinstance(problem.training_worlds("Unicycle", 32), LayoutMix)


def test_a_training_with_a_curriculum_that_breaks_off_goes_on_bit_for_bit(tmp_path: Path) -> None:
    """Its strength, its counts, what was drawn and what is under way to the motors are in the checkpoints."""
    changes = {
        "num_envs": "8", "steps": "6400", "hidden": "[16]", "n_steps": "8", "batch_size": "32", "n_validations": "4",
        "validation_episodes": "2",
    }  # fmt: skip

    def train(path: Path, *, crash_at: int = 0, begins: bool = True) -> RunDirectory:
        if begins:
            with RunDirectory.create(path, "train", {}) as run:
                pass
        run, reports = RunDirectory.open(path), iter(range(1, 1000))

        def on_progress(progress: Progress) -> None:
            if next(reports) == crash_at:
                raise KeyboardInterrupt

        problem = Problem.load("S...\n.#..\n...G", "default", "default", "curriculum")
        with open_log(run) as log:
            workshop = Workshop(Job(problem, Budget(0.1, 2), 0, run, lambda name: on_progress, checkpoint_s=0.0), log)
            workshop.train("ppo", "ppo", "Unicycle", choice=Choice(changes=changes))
        return run

    whole = train(tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path / "broken", crash_at=5)
    broken = train(tmp_path / "broken", begins=False)

    names = {str(part.relative_to(whole.path)) for part in whole.checkpoints.glob("*/*.safetensors")}
    assert names
    for name in names | {"metrics.jsonl"}:
        assert (whole.path / name).read_bytes() == (broken.path / name).read_bytes(), name
    rows = [json.loads(line) for line in (whole.path / "metrics.jsonl").read_text(encoding="utf-8").splitlines()]
    assert all(0.0 <= row["curriculum_strength"] <= 1.0 for row in rows if "success_rate" in row)


# ---- Documentation -------------------------------------------------------------------------------


def test_the_documented_table_of_quantities_is_that_of_the_code() -> None:
    result = subprocess.run(
        [sys.executable, str(ROOT / "scripts" / "quantities.py")],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    page = (ROOT / "docs" / "randomization.md").read_text(encoding="utf-8")

    assert [line.split("`")[1] for line in result.stdout.splitlines()[2:]] == list(PARAMETERS)
    assert result.stdout in page, "renew the table: python scripts/quantities.py"
