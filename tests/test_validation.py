"""Of a training's late policies the best is kept, and judging them changes nothing else."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from gridnav.agents import PPOAgent, PPOConfig
from gridnav.envs import NavigationVectorEnv
from gridnav.experiment.evaluation import EVALUATION_SEED
from gridnav.experiment.training import Budget, make_validation
from gridnav.experiment.validation import VALIDATION_SEED, Validation
from gridnav.experiment.worlds import Problem
from gridnav.problem.types import InputError

STRAIGHT = Problem.load("S...G", "default", "default")
SMALL = PPOConfig(hidden=(4,), num_envs=2, n_steps=8, batch_size=16)


@pytest.fixture
def worlds() -> Iterator[NavigationVectorEnv]:
    worlds = STRAIGHT.worlds("Unicycle", 8)
    worlds.max_episode_steps = 60
    yield worlds
    worlds.close()


def agent_that_drives(worlds: NavigationVectorEnv, forward: float, config: PPOConfig = SMALL) -> PPOAgent:
    """A policy of one command."""
    agent = PPOAgent(worlds.single_observation_space, worlds.single_action_space, config)
    set_command(agent, forward)
    return agent


def set_command(agent: PPOAgent, forward: float) -> None:
    with torch.no_grad():
        for name in ("action_net.weight", "action_net.bias"):
            agent.policy.get_parameter(name).zero_()
        agent.policy.get_parameter("action_net.bias")[0] = forward


def command(agent: Any, worlds: NavigationVectorEnv) -> NDArray[Any]:
    return np.asarray(agent.act(worlds.reset(seed=0)[0])[0])


def test_the_best_policy_is_kept_and_not_the_last(worlds: NavigationVectorEnv) -> None:
    agent = agent_that_drives(worlds, 0.0)
    validation = Validation(agent, worlds, 1000, 3)
    returns = []
    for forward in (0.0, 1.0, -0.25):  # stands, drives until it meets something, backs off
        set_command(agent, forward)
        returns.append(validation.judge()["validation_return"])
    best = int(np.argmax(returns))
    assert len(set(returns)) == 3, "the policies are worth the same: the test shows nothing"
    kept = command(validation.best(), worlds)
    assert kept[0] == pytest.approx((0.0, 1.0, -0.25)[best])
    assert command(agent, worlds)[0] == pytest.approx(-0.25), "who learns was changed"


def test_of_two_equal_ones_the_later_is_kept(worlds: NavigationVectorEnv) -> None:
    agent = agent_that_drives(worlds, 0.0)
    validation = Validation(agent, worlds, 1000, 2)
    first = validation.judge()["validation_return"]
    with torch.no_grad():
        agent.policy.get_parameter("log_std").fill_(-3.0)  # changes no greedy action
    assert validation.judge()["validation_return"] == first
    assert validation.state().arrays["log_std"][0] == pytest.approx(-3.0)  # type: ignore[union-attr]


def test_policies_are_due_at_equal_distances_in_the_last_quarter(worlds: NavigationVectorEnv) -> None:
    agent = agent_that_drives(worlds, 0.0)
    validation = Validation(agent, worlds, 1000, 5)
    due = []
    for steps in range(0, 1001, 10):
        if validation.is_due(steps):
            validation.judge()
            due.append(steps)
    assert due == [800, 850, 900, 950], "and the last is judged when training is over"


def test_it_goes_on_after_a_cut_where_it_was(worlds: NavigationVectorEnv) -> None:
    agent = agent_that_drives(worlds, 1.0)
    whole = Validation(agent, worlds, 1000, 5)
    assert whole.state() is None
    whole.judge()
    halves = Validation(agent, worlds, 1000, 5, whole.state())
    for forward in (0.0, -1.0):
        set_command(agent, forward)
        assert whole.judge() == halves.judge()
        assert whole.is_due(850) == halves.is_due(850)
        assert whole.is_due(900) == halves.is_due(900)
        assert (command(whole.best(), worlds) == command(halves.best(), worlds)).all()


def test_judging_draws_nothing_from_the_streams_of_training(worlds: NavigationVectorEnv) -> None:
    agent = agent_that_drives(worlds, 0.5)
    validation = Validation(agent, worlds, 1000, 5)
    before = torch.get_rng_state(), np.random.get_state()[1].copy()  # type: ignore[index]  # noqa: NPY002
    validation.judge()
    assert torch.equal(torch.get_rng_state(), before[0])
    assert (np.random.get_state()[1] == before[1]).all()  # type: ignore[index]  # noqa: NPY002


def test_its_episodes_are_not_those_of_the_evaluation() -> None:
    assert abs(VALIDATION_SEED - EVALUATION_SEED) > 1000, "an evaluation takes a seed for each of its layouts"


@pytest.mark.parametrize(
    ("layout", "share", "is_judged"),
    [("classic", 1.0, True), ("classic", 0.2, False), ("random", 1.0, False)],
)
def test_short_trainings_and_families_of_layouts_are_not_judged(layout: str, share: float, is_judged: bool) -> None:
    problem = Problem.load(layout, "default", "default")
    agent = agent_that_drives(STRAIGHT.worlds("Unicycle", 1), 0.0)
    validation = make_validation(problem, agent, "Unicycle", 1000, Budget(share, 10), None)
    assert (validation is not None) == is_judged


def test_a_best_policy_that_is_none_is_refused(worlds: NavigationVectorEnv) -> None:
    agent = agent_that_drives(worlds, 0.0)
    validation = Validation(agent, worlds, 1000, 5)
    validation.judge()
    state = validation.state()
    assert state is not None
    del state.arrays["log_std"]
    with pytest.raises((RuntimeError, InputError), match="log_std"):
        Validation(agent, worlds, 1000, 5, state)
