"""Transfer arms: each begins as it says, and what it carries over stays what it was after a cut."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_line import run_cli
from hypothesis import given
from hypothesis import strategies as st

from gridnav import Layout
from gridnav.agents import Agent, Demonstrations, Planner, PPOAgent, PPOConfig, Progress, ResidualAgent, clone
from gridnav.envs import Corrected, NavigationVectorEnv, PotentialShaping
from gridnav.experiment.arms import ARMS, cell_values, choose_arms, potential_of
from gridnav.experiment.checkpoint import load_checkpoint
from gridnav.experiment.demonstrations import demonstrate, discounted_returns
from gridnav.experiment.evaluation import evaluate, follow, policy_for
from gridnav.experiment.greedy_curve import SUCCESS, GreedyCurve, curve_points
from gridnav.experiment.results import open_log
from gridnav.experiment.run_directory import RunDirectory, read_rows
from gridnav.experiment.training import Budget, Choice, Job, Trained, Workshop
from gridnav.experiment.worlds import Problem
from gridnav.problem.metrics import summarise
from gridnav.problem.potential import CellPotential
from gridnav.problem.types import InputError

CORNER = Problem.load("S...\n.##.\n...G", "default", "default")
SMALL = PPOConfig(hidden=(16,), num_envs=8, n_steps=8, batch_size=32)


def planner(problem: Problem) -> Planner:
    return Planner.solve(problem.layout, problem.task, problem.reward)


# ---- The driver without a memory -------------------------------------------------------------------


@pytest.mark.parametrize("world", ["Unicycle", "DiffDrive"])
def test_a_plan_followed_without_a_memory_arrives_everywhere_and_touches_nothing(world: str) -> None:
    problem = Problem.load("classic", "any", "default")
    worlds = problem.worlds(world, 30)

    summary = summarise(evaluate(follow(planner(problem).act, worlds), worlds))
    worlds.close()

    assert (summary.success_rate, summary.collision_rate) == (1.0, 0.0)


# ---- The potential ---------------------------------------------------------------------------------

# Two rooms that meet at a corner point only, beside a way round.
DIAGONAL = Layout.from_text("S.#\n..#\n##.\nG..".replace("##.", "#.."))
WALLED = Layout.from_text("S#G\n.#.\n...")


def test_a_potential_takes_the_cells_values_at_their_centres_and_lies_between_them_on_the_way() -> None:
    values = np.arange(9.0).reshape(1, 3, 3)
    potential = CellPotential(WALLED, values)
    centres = WALLED.to_metres(np.argwhere(~WALLED.walls))
    np.testing.assert_allclose(potential(centres, np.zeros(len(centres), int)), values[0][~WALLED.walls])
    # By hand: a quarter of the way from cell 7 to cell 8 in the lowest row.
    assert potential(np.array([[0.75 + 0.125, 0.25]]), np.array([0]))[0] == pytest.approx(7.25)


def test_nothing_leaks_through_a_wall() -> None:
    """Cells behind the wall may be worth whatever they like: on this side of it nothing changes."""
    here = np.array([[0.49, 1.3], [0.4, 0.9], [0.25, 0.7]])  # in the first column, beside the wall
    values = np.zeros((1, 3, 3))
    before = CellPotential(WALLED, values)(here, np.zeros(3, int))
    values[0, :, 1:] = 1000.0
    values[0, 2, 1] = 0.0  # under the wall's end, which the first column is connected with
    np.testing.assert_array_equal(CellPotential(WALLED, values)(here, np.zeros(3, int)), before)


def test_cells_that_touch_at_a_corner_are_not_connected() -> None:
    layout = Layout.from_text("S#.\n.#.\n..G".replace("S#.", "S..").replace(".#.", ".#."))
    values = np.zeros((1, 3, 3))
    values[0, 2, 1] = 8.0  # below the wall; cell (1, 0) is its diagonal neighbour's neighbour
    # In cell (1, 2), its lower left corner: (1, 1) is a wall, (2, 2) free, and (2, 1) connected through it.
    place = np.array([[1.05, 0.55]])
    # By hand: 0.45 cells... left 0.4 and down 0.4: weights .36 own, .24 below, .16 across, of .76 in all.
    assert CellPotential(layout, values)(place, np.array([0]))[0] == pytest.approx(8.0 * 0.16 / 0.76)
    split = Layout.from_text("S.#\n.#.\n...")
    lone = np.zeros((1, 3, 3))
    lone[0, 0, 1] = 8.0
    # Cell (1, 2) touches (0, 1) in its upper left corner, both others being walls.
    assert CellPotential(split, lone)(np.array([[1.05, 0.95]]), np.array([0]))[0] == 0.0


@given(x=st.floats(0.0, 1.4999), y=st.floats(0.0, 1.4999), angle=st.floats(0.0, 6.2))
def test_a_potential_has_no_steps_where_a_robot_can_pass(x: float, y: float, angle: float) -> None:
    potential = CellPotential(WALLED, np.arange(9.0).reshape(1, 3, 3) ** 2)
    near = np.array([[x, y], [x + 1e-6 * np.cos(angle), y + 1e-6 * np.sin(angle)]])
    near = np.clip(near, 0.0, 1.4999)
    cells = WALLED.to_cell(near)
    if WALLED.walls[tuple(cells.T)].any():
        return
    first, second = potential(near, np.zeros(2, int))
    assert first == pytest.approx(second, abs=1e-3)


def shaped_worlds(gamma: float, n: int = 6, limit: int = 150) -> tuple[NavigationVectorEnv, PotentialShaping, Any]:
    worlds = CORNER.worlds("Unicycle", n)
    worlds.max_episode_steps = limit
    potential = potential_of(worlds, cell_values(CORNER, planner(CORNER)))
    return worlds, PotentialShaping(worlds, potential, gamma), potential


def test_shaping_pays_for_the_end_points_and_not_for_the_route() -> None:
    """Over an episode the discounted shares add up to what its ends are worth, also where its time was up."""
    gamma, n = 0.97, 6
    worlds, shaped, potential = shaped_worlds(gamma, n)
    policies = follow(planner(CORNER).act, worlds)
    observations, _ = shaped.reset(seed=4)
    first = potential(observations)
    sums, discounts, seen = np.zeros(n), np.ones(n), np.zeros(n, dtype=bool)
    last = np.full(n, np.nan)
    drives = np.array([True, False] * 3)  # the others stand still until their time is up
    while not seen.all():
        actions = np.where(drives[:, None], policies(observations), 0.0).astype(np.float32)
        observations, _, terminated, truncated, info = shaped.step(actions)
        final = info.get("final_info", info)
        sums += np.where(seen, 0.0, discounts * final["reward_terms"]["potential"])
        discounts *= gamma
        for i in np.flatnonzero((terminated | truncated) & ~seen):
            last[i] = 0.0 if terminated[i] else discounts[i] * potential(info["final_obs"][i][None])[0]
            seen[i] = True
    shaped.close()

    assert np.isfinite(last).all()
    assert (last[1::2] > 0.0).all(), "nobody's time was up: the test shows nothing"
    assert (last[::2] == 0.0).all(), "nobody arrived: the test shows nothing"
    np.testing.assert_allclose(sums, last - first, atol=1e-4)  # positions are of single precision


def test_the_share_is_part_of_the_reward_and_the_next_episode_begins_without_one() -> None:
    _, shaped, _ = shaped_worlds(0.99, limit=40)
    plain = CORNER.worlds("Unicycle", 6)
    plain.max_episode_steps = 40
    shaped.reset(seed=1)
    plain.reset(seed=1)
    actions = np.full((6, 2), 0.3, dtype=np.float32)
    for _ in range(40):
        _, rewards, _, _, info = shaped.step(actions)
        _, before, *_ = plain.step(actions)
        share = info.get("final_info", info)["reward_terms"]["potential"]
        np.testing.assert_allclose(rewards, before + share)
    assert "final_info" in info
    assert (info["reward_terms"]["potential"][info["_final_info"]] == 0.0).all()


# ---- Cloning ---------------------------------------------------------------------------------------


def test_returns_are_summed_to_the_end_of_the_task_and_unknown_without_one() -> None:
    rewards = np.array([[1.0, 1.0], [2.0, 2.0], [4.0, 4.0], [8.0, 8.0]])
    terminated = np.array([[0, 0], [0, 0], [1, 0], [0, 0]], dtype=bool)
    truncated = np.array([[0, 0], [0, 1], [0, 0], [0, 0]], dtype=bool)

    returns = discounted_returns(rewards, terminated, truncated, 0.5)

    # By hand: 4, 2 + 2, 1 + 2; the second robot's time was up, and nobody's last episode was seen to its end.
    np.testing.assert_array_equal(returns, [[3.0, np.nan], [4.0, np.nan], [4.0, np.nan], [np.nan, np.nan]])


def test_a_network_learns_by_heart_what_it_is_shown() -> None:
    rng = np.random.default_rng(0)
    worlds = CORNER.worlds("Unicycle", 1)
    agent = PPOAgent(worlds.single_observation_space, worlds.single_action_space, SMALL)
    observations = rng.uniform(-1, 1, (20_000, 35)).astype(np.float32)
    actions = np.stack([0.5 * observations[:, 30], -0.3 * observations[:, 29]], axis=1)
    returns = np.where(rng.random(20_000) < 0.5, 4.0 * observations[:, 28], np.nan)

    metrics = clone(agent, Demonstrations(observations, actions, returns))

    # By hand: without having learnt anything the error is that of uniform numbers, 0.58 times 0.5 and 0.3: about 0.24.
    assert metrics["action_error"] < 0.05
    assert metrics["explained_returns"] > 0.9
    assert np.corrcoef(agent.act(observations)[:, 0], actions[:, 0])[0, 1] > 0.95
    assert np.corrcoef(agent.values(observations), observations[:, 28])[0, 1] > 0.95
    assert agent.policy.state_dict()["log_std"].tolist() == [-0.5, -0.5], "how sure one may be was not shown"


def test_demonstrations_cost_what_they_say_and_are_the_seeds_own() -> None:
    one, again, other = (
        demonstrate(CORNER, planner(CORNER), "Unicycle", gamma=0.99, seed=seed, steps=3) for seed in (1, 1, 2)
    )
    assert one.observations.shape == (256 * 3, 35)
    np.testing.assert_array_equal(one.observations, again.observations)
    assert (one.observations != other.observations).any()


# ---- Learning with help ----------------------------------------------------------------------------


def corridor_agent(**changes: Any) -> tuple[PPOAgent, NavigationVectorEnv]:
    config = PPOConfig(**{"hidden": (16,), "num_envs": 8, "n_steps": 8, "batch_size": 32, **changes})
    worlds = CORNER.worlds("Unicycle", 8)
    return PPOAgent(worlds.single_observation_space, worlds.single_action_space, config), worlds


def test_a_critic_can_learn_alone_for_a_while() -> None:
    agent, worlds = corridor_agent(critic_only_steps=128)
    before = {name: tensor.clone() for name, tensor in agent.policy.state_dict().items()}
    agent.learn(worlds, steps=128)
    after = agent.policy.state_dict()
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert {name.split(".")[0] for name in changed} == {"mlp_extractor", "value_net"}
    assert not any("policy_net" in name for name in changed)
    agent.learn(worlds, steps=192)
    assert not torch.equal(before["action_net.weight"], agent.policy.state_dict()["action_net.weight"])


def test_a_teacher_draws_the_policy_to_itself_and_lets_go() -> None:
    gaps = {}
    for weight in (0.0, 30.0):
        agent, worlds = corridor_agent(teacher_weight=weight, teacher_share=1.0, seed=3, initial_forward=0.0)
        teacher, _ = corridor_agent(initial_forward=0.9, seed=4)
        agent.teacher = teacher
        agent.learn(worlds, steps=1280)
        observations, _ = worlds.reset(seed=0)
        gaps[weight] = float(np.abs(agent.act(observations)[:, 0] - teacher.act(observations)[:, 0]).mean())
        policy: Any = agent.policy
        # By hand: the last of 20 rollouts begins at 19/20 of the steps, when a twentieth of the weight is left.
        assert policy.teacher_weight == pytest.approx(weight / 20)
    assert gaps[30.0] < 0.5 * gaps[0.0]


def test_a_residual_policy_begins_as_what_it_corrects_and_is_saved_with_it(tmp_path: Path) -> None:
    worlds = CORNER.worlds("Unicycle", 5)
    table = planner(CORNER)
    spaces = worlds.single_observation_space, worlds.single_action_space
    agent = ResidualAgent(*spaces, SMALL, table.action_values)
    observations, _ = worlds.reset(seed=0)
    commands = follow(table.act, worlds)(observations)
    np.testing.assert_array_equal(policy_for(agent, worlds)(observations), commands)

    with torch.no_grad():
        agent.policy.get_parameter("action_net.bias")[:] = torch.tensor([0.4, -2.0])
    agent.save(tmp_path)
    loaded = ResidualAgent.load(tmp_path)

    # By hand: half of 0.4 is added, and half of -1, for an action is clipped before it counts; so is the sum.
    expected = np.clip(commands + np.array([0.2, -0.5], dtype=np.float32), -1.0, 1.0)
    np.testing.assert_allclose(policy_for(loaded, worlds)(observations), expected, atol=1e-6)
    corrected = Corrected(worlds, follow(loaded.moves, worlds), 0.5)
    corrected.reset(seed=0)
    there, *_ = corrected.step(loaded.act(observations))
    worlds.reset(seed=0)
    here, *_ = worlds.step(expected)
    np.testing.assert_allclose(there, here, atol=1e-6)


def test_a_residual_agent_without_a_table_is_none(tmp_path: Path) -> None:
    worlds = CORNER.worlds("Unicycle", 1)
    agent = ResidualAgent(worlds.single_observation_space, worlds.single_action_space, SMALL, np.full((2, 4), np.nan))
    agent.save(tmp_path)
    with pytest.raises(ValueError, match="table of finite numbers"):
        ResidualAgent.load(tmp_path)


# ---- Curves, cuts and commands -----------------------------------------------------------------------


def test_a_curve_has_its_two_ends_and_is_dense_at_first() -> None:
    assert curve_points(480_000)[:9] == [0, 8_000, 16_000, 32_000, 48_000, 64_000, 96_000, 128_000, 160_000]
    assert curve_points(480_000)[-2:] == [448_000, 480_000]
    assert curve_points(20_000) == [0, 8_000, 16_000, 20_000]
    assert len(curve_points(2_700_000)) < 25


def test_a_curve_says_how_many_arrive() -> None:
    worlds = CORNER.worlds("Unicycle", 10)
    metrics = GreedyCurve(worlds, 1000).measure(planner(CORNER))
    assert metrics == {SUCCESS: 1.0, "greedy_collision_rate": 0.0}
    agent, _ = corridor_agent(initial_forward=-1.0)  # backs into the first wall
    worlds.max_episode_steps = 60
    assert GreedyCurve(worlds, 1000).measure(agent)[SUCCESS] < 1.0


class Crash(BaseException):
    """What ends a training without a chance to say goodbye."""


CHANGES = {"num_envs": "8", "steps": "640", "hidden": "[16]", "n_steps": "8", "batch_size": "32", "n_validations": "0"}


def sources_of(name: str, stack_size: int) -> list[Trained]:
    """What an arm builds on, made quickly: a plan, and networks that know nothing."""
    worlds = CORNER.worlds("Unicycle", 1)
    spaces = worlds.single_observation_space, worlds.single_action_space
    network = PPOAgent(*spaces, PPOConfig(hidden=(16,), seed=9, stack_size=stack_size))
    agents: dict[str, Agent] = {"q-learning": planner(CORNER), "ppo-unicycle": network, "cloned": network}
    return [Trained(source, agents[source], 1, 1.0) for source in ARMS[name].sources]


def train_arm(
    run: RunDirectory, name: str, *, crash_at: int = 0, with_curve: bool = True, stack_size: int = 1
) -> Trained:
    reports = itertools.count(1)

    def on_stage(words: str) -> Callable[[Progress], None]:
        def on_progress(progress: Progress) -> None:
            if next(reports) == crash_at:
                raise Crash

        return on_progress

    prepare = ARMS[name].prepare
    assert prepare is not None
    carry = prepare(CORNER, sources_of(name, stack_size))
    with open_log(run) as log:
        workshop = Workshop(Job(CORNER, Budget(1.0, 2), 0, run, on_stage, checkpoint_s=0.0), log)
        choice = Choice(changes={**CHANGES, "stack_size": str(stack_size)})
        return workshop.train(name, "ppo", "Unicycle", carry=carry, choice=choice, with_curve=with_curve)


def new_run(path: Path) -> RunDirectory:
    with RunDirectory.create(path, "ladder", {}) as run:
        return run


@pytest.mark.parametrize("name", ["scratch", "potential", "clone", "kickstart", "weights", "residual"])
def test_every_arm_can_learn_with_a_memory(name: str, tmp_path: Path) -> None:
    trained = train_arm(new_run(tmp_path / "run"), name, stack_size=3)

    assert trained.agent.config.stack_size == 3  # type: ignore[attr-defined]
    worlds = CORNER.worlds("Unicycle", 2)
    assert len(evaluate(policy_for(trained.agent, worlds), worlds)) == 2


@pytest.mark.parametrize("name", ["potential", "clone", "kickstart", "residual"])
def test_an_arm_goes_on_after_a_kill_as_if_nothing_had_happened(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)
    whole, cut = new_run(tmp_path / "whole"), new_run(tmp_path / "cut")
    with_curve = name == "clone"
    expected = train_arm(whole, name, with_curve=with_curve).agent.state()
    for crash_at in (4, 3):
        with pytest.raises(Crash):
            train_arm(cut, name, crash_at=crash_at, with_curve=with_curve)
    arrays, values = train_arm(cut, name, with_curve=with_curve).agent.state()

    assert values == expected.values
    for key, array in expected.arrays.items():
        np.testing.assert_array_equal(arrays[key], array, err_msg=key)
    assert (cut.path / "metrics.jsonl").read_bytes() == (whole.path / "metrics.jsonl").read_bytes()
    checkpoint = load_checkpoint(cut.checkpoints, name)
    assert checkpoint is not None
    assert checkpoint.agent.kind == ("residual" if name == "residual" else "ppo")


def test_a_curve_changes_nothing_in_what_is_trained(tmp_path: Path) -> None:
    looked, alone = new_run(tmp_path / "looked"), new_run(tmp_path / "alone")
    one = train_arm(looked, "scratch").agent.state().arrays
    other = train_arm(alone, "scratch", with_curve=False).agent.state().arrays
    for key, array in one.items():
        np.testing.assert_array_equal(array, other[key], err_msg=key)
    rows = read_rows(looked.path / "metrics.jsonl")
    assert [row["steps"] for row in rows if SUCCESS in row] == [0, 640]


@pytest.mark.parametrize(
    ("names", "words"),
    [("scratch,clon", "did you mean clone"), ("", "did you mean"), ("clone,clone", "named twice")],
)
def test_wrong_arms_are_refused(names: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        choose_arms(names)


def test_arms_are_refused_where_the_maze_varies(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = tmp_path / "run"
    arguments = ("ladder", "--arms", "scratch", "--randomization", '{"obstacles_moved": [0, 3]}', "--run-dir", str(run))
    assert run_cli(*arguments) == 2
    assert "varies the maze" in capsys.readouterr().err
    assert not run.exists()


def test_an_unknown_arm_ends_the_command_with_one_line_and_nothing_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_cli("ladder", "--arms", "scratch,wieghts", "--run-dir", str(tmp_path / "run")) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "did you mean weights" in error
    assert not (tmp_path / "run").exists()
