"""DQN: returns and targets by hand, what it learns, exact resumption, and that nothing goes wrong silently."""

from __future__ import annotations

import random
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gridnav.agents.base import read_state, write_state
from gridnav.agents.dqn import (
    DQN_PRESETS,
    Batch,
    DQNAgent,
    DQNConfig,
    Learner,
    OneHotLinear,
    QNetwork,
    Replay,
    td_targets,
)
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from torch import nn

from gridnav import Layout, Task
from gridnav.agents import Progress
from gridnav.envs import GridWorldVectorEnv
from gridnav.problem.grid_mdp import MoveTable
from gridnav.problem.types import NonFiniteError, State

SMALL = DQNConfig(
    num_envs=8,
    gamma=0.9,
    steps=4_000,
    hidden=(32,),
    replay_size=2_000,
    batch_size=64,
    warm_up=100,
    target_every=20,
)
LAYOUT = "S...\n.##.\n...#\n#.GG\n"


class Steady(VectorEnv[Any, Any, Any]):
    """Every step pays 1, ends its episode and leads from state 0 to state 1; the next episode begins in state 0.

    The step number ``wrong_at`` hands out ``wrong`` as the environment 1's reward or observation.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self,
        *,
        terminates: bool = True,
        features: bool = False,
        wrong: str = "reward",
        value: float = 1.0,
        wrong_at: int = -1,
    ) -> None:
        self.num_envs, self.terminates, self.features = 4, terminates, features
        self.wrong, self.value, self.wrong_at = wrong, value, wrong_at
        self.single_observation_space = Box(-1.0, 1.0, (2,), np.float32) if features else Discrete(2)
        self.single_action_space = Discrete(2)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.n_steps = 0

    def _states(self, number: int) -> Any:
        if not self.features:
            return np.full(self.num_envs, number)
        return np.eye(2, dtype=np.float32)[np.full(self.num_envs, number)]

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        return self._states(0), {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        self.n_steps += 1
        n, everywhere = self.num_envs, np.ones(self.num_envs, dtype=bool)
        observations, reached, rewards = self._states(0), self._states(1), np.ones(n)
        if self.n_steps == self.wrong_at:
            {"reward": rewards, "observation": observations, "final": reached}[self.wrong][1] = self.value
        final_obs = np.full(n, None, dtype=object)
        final_obs[:] = list(reached)
        info = {
            "final_obs": final_obs,
            "_final_obs": everywhere,
            "final_info": {"is_success": np.full(n, self.terminates), "collisions": np.zeros(n)},
            "_final_info": everywhere,
        }
        return observations, rewards, np.full(n, self.terminates), np.full(n, not self.terminates), info


def agent_for(env: VectorEnv[Any, Any, Any], config: DQNConfig = SMALL) -> DQNAgent:
    """A new agent for the spaces of an environment."""
    return DQNAgent(env.single_observation_space, env.single_action_space, config)


def small_world(**options: Any) -> GridWorldVectorEnv:
    """Eight robots on 4 x 4 cells."""
    return GridWorldVectorEnv(SMALL.num_envs, layout=LAYOUT, max_episode_steps=30, **options)


def same_bits(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """Whether two dictionaries hold the same arrays."""
    return {name: (a.dtype, a.tobytes()) for name, a in one.items()} == {
        name: (a.dtype, a.tobytes()) for name, a in other.items()
    }


# ---- Returns -----------------------------------------------------------------------------------


def replay_of(rewards: list[float], *, n_rows: int, terminated: int = -1, truncated: int = -1) -> Replay:
    """One environment that walks from state t to t + 1 at time t, or to state 50 where an episode ends."""
    replay = Replay(n_rows, 1, Discrete(100))
    for t, reward in enumerate(rewards):
        ends = np.array([t == terminated]), np.array([t == truncated])
        reached = 50 if t in (terminated, truncated) else t + 1
        replay.add(np.array([t]), np.array([t % 4]), np.array([reward]), np.array([reached]), *ends)
    return replay


def returns(replay: Replay, age: int, *, n_step: int = 3) -> tuple[int, float, float, int]:
    """First state, return, discount of what follows, and the state reached, with gamma 0.5."""
    batch = replay.returns(np.array([age]), np.array([0]), n_step, 0.5)
    assert int(batch.actions) == int(batch.observations) % 4
    return int(batch.observations), float(batch.returns), float(batch.discounts), int(batch.reached)


def test_a_return_sums_n_discounted_rewards_and_bootstraps_with_gamma_to_the_n() -> None:
    replay = replay_of([1.0, 2.0, 4.0, 8.0, 16.0], n_rows=5)

    # By hand: 1 + 0.5*2 + 0.25*4 = 3 and 2 + 0.5*4 + 0.25*8 = 6; then 0.5**3 times the value of the state reached.
    assert returns(replay, 0) == (0, 3.0, 0.125, 3)
    assert returns(replay, 1) == (1, 6.0, 0.125, 4)
    assert returns(replay, 1, n_step=1) == (1, 2.0, 0.5, 2)


def test_a_return_ends_with_a_terminated_episode_and_nothing_follows() -> None:
    replay = replay_of([1.0, 2.0, 4.0, 8.0, 16.0], n_rows=5, terminated=1)

    assert returns(replay, 0) == (0, 2.0, 0.0, 50)  # 1 + 0.5*2
    assert returns(replay, 1) == (1, 2.0, 0.0, 50)
    assert returns(replay, 2) == (2, 12.0, 0.125, 5)  # 4 + 0.5*8 + 0.25*16: the next episode is whole


def test_a_return_bootstraps_at_a_truncation_from_the_state_that_was_reached() -> None:
    replay = replay_of([1.0, 2.0, 4.0, 8.0, 16.0], n_rows=5, truncated=1)

    assert returns(replay, 0) == (0, 2.0, 0.25, 50)  # two rewards, so gamma squared
    assert returns(replay, 1) == (1, 2.0, 0.5, 50)


def test_a_termination_outweighs_a_truncation_in_the_same_step() -> None:
    assert returns(replay_of([1.0, 2.0], n_rows=2, terminated=0, truncated=0), 0) == (0, 1.0, 0.0, 50)


def test_no_return_runs_from_the_newest_row_into_the_oldest() -> None:
    # Seven steps in five rows: the rows hold the times 5, 6, 2, 3, 4.
    replay = replay_of([1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0], n_rows=5)

    assert returns(replay, 0) == (2, 12.0, 0.125, 5)  # the oldest: 4 + 0.5*8 + 0.25*16
    assert returns(replay, 2) == (4, 48.0, 0.125, 7)  # 16 + 0.5*32 + 0.25*64, across the end of the arrays
    assert returns(replay, 3) == (5, 64.0, 0.25, 7)  # 32 + 0.5*64: two steps are all there are
    assert returns(replay, 4) == (6, 64.0, 0.5, 7)


def test_a_buffer_that_is_not_full_ends_where_it_is_filled() -> None:
    replay = replay_of([1.0, 2.0], n_rows=5)

    assert returns(replay, 0) == (0, 2.0, 0.25, 2)
    assert returns(replay, 1) == (1, 2.0, 0.5, 2)


def test_environments_do_not_mix() -> None:
    replay = Replay(3, 2, Box(-1.0, 1.0, (2,)))
    for t in range(3):
        observations = np.array([[t, 0.0], [t, 1.0]], dtype=np.float32)
        ends = np.array([False, t == 1]), np.zeros(2, dtype=bool)
        replay.add(observations, np.array([0, 1]), np.array([1.0, 10.0]), observations + 0.5, *ends)

    batch = replay.returns(np.array([0, 0]), np.array([0, 1]), 3, 0.5)

    # By hand: 1 + 0.5 + 0.25, and 10 + 5 up to the end of the second environment's episode.
    assert batch.returns.tolist() == [1.75, 15.0]
    assert batch.discounts.tolist() == [0.125, 0.0]
    assert batch.observations.tolist() == [[0.0, 0.0], [0.0, 1.0]]
    assert batch.reached.tolist() == [[2.5, 0.5], [1.5, 1.5]]


def test_batches_are_drawn_from_all_transitions_alike() -> None:
    replay = replay_of([float(t) for t in range(8)], n_rows=5)

    batch = replay.sample(np.random.default_rng(0), 5_000, 1, 0.5)

    # By hand: five states, a fifth of 5,000 each; the standard deviation is sqrt(5000*0.2*0.8) = 28.
    counts = np.bincount(batch.observations.numpy(), minlength=8)
    assert counts[:3].tolist() == [0, 0, 0]
    assert np.abs(counts[3:] - 1000).max() < 5 * 28


# ---- Network and targets -----------------------------------------------------------------------


def network_of(table: list[list[float]]) -> QNetwork:
    """A network whose action values are the table's rows."""
    network = QNetwork(Discrete(len(table)), len(table[0]), (len(table),), dueling=False)
    with torch.no_grad():
        network.body[0].weight.copy_(torch.eye(len(table)))  # type: ignore[operator]
        network.body[0].bias.zero_()  # type: ignore[operator]
        network.head.weight.copy_(torch.tensor(table).T)
        network.head.bias.zero_()
    return network


def test_the_double_target_takes_the_choice_of_the_one_and_the_value_of_the_other() -> None:
    network, target_network = network_of([[1.0, 5.0], [7.0, 3.0]]), network_of([[20.0, 10.0], [40.0, 60.0]])
    zeros = torch.zeros(3, dtype=torch.int64)
    batch = Batch(zeros, zeros, torch.tensor([1.0, 1.0, 1.0]), torch.tensor([0.5, 0.5, 0.0]), torch.tensor([0, 1, 1]))

    # By hand: the network prefers action 1 in state 0 and action 0 in state 1, valued 10 and 40 by the target network,
    # which by itself would take 20 and 60. The third episode terminated.
    assert td_targets(network, target_network, batch, double=True).tolist() == [6.0, 21.0, 1.0]
    assert td_targets(network, target_network, batch, double=False).tolist() == [11.0, 31.0, 1.0]


def test_dueling_advantages_have_no_mean() -> None:
    network = QNetwork(Box(-1.0, 1.0, (3,)), 4, (8,), dueling=True)
    with torch.no_grad():
        network.head.weight.zero_()
        network.head.bias.copy_(torch.tensor([7.0, 1.0, 2.0, 3.0, 6.0]))

    # By hand: value 7, advantages 1, 2, 3, 6 less their mean 3.
    assert network(torch.zeros(1, 3)).tolist() == [[5.0, 6.0, 7.0, 10.0]]


def test_an_index_into_the_first_layer_is_a_linear_layer_on_a_one_hot_vector() -> None:
    torch.manual_seed(3)
    indexed = OneHotLinear(5, 7)
    torch.manual_seed(3)
    linear = nn.Linear(5, 7)
    numbers = torch.tensor([4, 0, 4, 2])

    torch.testing.assert_close(indexed(numbers), linear(nn.functional.one_hot(numbers, 5).float()))


def test_huber_bounds_the_gradient_of_a_large_error_and_mse_does_not() -> None:
    batch = Batch(torch.tensor([0]), torch.tensor([0]), torch.tensor([10.0]), torch.tensor([0.0]), torch.tensor([0]))
    norms = {}
    for loss in ("huber", "mse"):
        config = replace(SMALL, loss=loss, double=False, dueling=False)  # type: ignore[arg-type]
        norms[loss] = Learner(network_of([[0.0, 0.0]]), config).update(batch, 0)

    # By hand, error 10: Huber 10 - 0.5 with slope 1, mean square 100 with slope 20. The value is w*x + b with x = 1
    # and w = 0, so the slope goes into w and b alike: a norm of slope*sqrt(2).
    assert norms["huber"]["loss"] == pytest.approx(9.5)
    assert norms["mse"]["loss"] == pytest.approx(100.0)
    assert norms["huber"]["gradient_norm"] == pytest.approx(1.0 * 2**0.5)
    assert norms["mse"]["gradient_norm"] == pytest.approx(20.0 * 2**0.5)


def test_the_target_network_follows_every_so_many_updates() -> None:
    learner = Learner(network_of([[0.0, 0.0]]), replace(SMALL, target_every=3))
    batch = Batch(torch.tensor([0]), torch.tensor([0]), torch.tensor([1.0]), torch.tensor([0.0]), torch.tensor([0]))
    equal = []
    for _ in range(6):
        learner.update(batch, 0)
        equal.append(torch.equal(learner.network.head.weight, learner.target_network.head.weight))

    assert equal == [False, False, True, False, False, True]


def test_the_step_size_falls_over_the_planned_steps_or_episodes() -> None:
    config = replace(SMALL, learning_rate=0.5, learning_rate_end=0.1)

    # By hand: a quarter of the way from 0.5 to 0.1.
    assert config.rate(0.25, 40) == pytest.approx(0.4)
    assert replace(config, episodes=80).rate(0.25, 40) == pytest.approx(0.3)  # half of the episodes
    assert replace(config, episodes=80).rate(0.25, 90) == pytest.approx(0.1)  # never below the end
    assert replace(config, learning_rate_end=None).rate(0.25, 40) == 0.5


def test_the_preset_tutorial_is_the_tutorials_agent() -> None:
    config = DQN_PRESETS["tutorial"]
    numbers = asdict(config)

    expected = {
        "num_envs": 1,
        "learning_rate": 1e-3,
        "learning_rate_end": None,
        "gamma": 0.99,
        "epsilon_start": 1.0,
        "epsilon_end": 0.01,
        "epsilon_decay": 0.99,
        "episodes": 500,
        "steps": 500 * 100,
        "hidden": (128, 128, 128),
        "double": False,
        "dueling": False,
        "n_step": 1,
        "loss": "mse",
        "replay_size": 10_000,
        "batch_size": 64,
        "updates_per_step": 1,
        "target_every": 10,
        "max_grad_norm": 1.0,
    }
    assert {name: numbers[name] for name in expected} == expected
    agent = DQNAgent(Discrete(100), Discrete(4), config)
    assert agent.planned_steps == 50_000
    # By hand: 100*128 + 128, twice 128*128 + 128, and 128*4 + 4.
    assert sum(p.numel() for p in agent.network.parameters()) == 12_928 + 2 * 16_512 + 516
    assert [type(layer) for layer in agent.network.body] == [
        OneHotLinear, nn.ReLU, nn.Linear, nn.ReLU, nn.Linear, nn.ReLU
    ]  # fmt: skip


# ---- Learning ----------------------------------------------------------------------------------


@pytest.mark.parametrize("features", [False, True])
@pytest.mark.parametrize("terminates", [False, True])
def test_learning_bootstraps_at_a_truncation_and_nowhere_behind_a_termination(features: bool, terminates: bool) -> None:
    env = Steady(terminates=terminates, features=features)
    agent = agent_for(env, replace(SMALL, learning_rate=1e-2, target_every=1, n_step=3))

    agent.learn(env, steps=1_200)

    states = torch.eye(2) if features else torch.arange(2)
    first, reached = agent.network(states).detach().max(dim=1).values.tolist()
    # The reward is 1 and gamma 0.9; the next episode's state, which is state 0 again, must not count.
    assert first == pytest.approx(1.0 if terminates else 1.0 + 0.9 * reached, abs=0.02)


def success(agent: DQNAgent, layout: Layout) -> float:
    """Share of all pairs of a free cell and a goal between which the greedy moves arrive (``cell_goal``)."""
    goals = layout.goal_cells
    cells = np.flatnonzero(layout.reachable.ravel())
    cell, goal = (axis.ravel() for axis in np.meshgrid(cells, np.arange(len(goals))))
    numbers = goals[:, 0] * layout.n_cols + goals[:, 1]
    for _ in range(layout.n_cells):
        moved = MoveTable.of(layout).next_cell[cell, agent.act(cell * len(goals) + goal)]
        cell = np.where(cell == numbers[goal], cell, moved)
    return float((cell == numbers[goal]).mean())


@pytest.mark.parametrize("changes", [{}, {"double": False, "dueling": False, "n_step": 1, "loss": "mse"}])
def test_dqn_learns_the_way_from_every_cell_to_every_goal(changes: dict[str, Any]) -> None:
    env = small_world(task=Task(starts="any"))
    agent = agent_for(env, replace(SMALL, learning_rate=3e-3, **changes))
    assert success(agent, env.layout) < 1.0

    agent.learn(env, steps=8_000)

    assert success(agent, env.layout) == 1.0


def test_dqn_learns_from_features() -> None:
    env = small_world(observation="features")
    agent = agent_for(env, replace(SMALL, hidden=(64, 64)))

    agent.learn(env, steps=12_000)

    observations, _ = env.reset(seed=99)
    arrived = np.zeros(env.num_envs, dtype=bool)
    for _ in range(29):
        observations, _, terminated, _, _ = env.step(agent.act(observations))
        arrived |= terminated
    assert arrived.all()


def test_training_reports_what_it_measures() -> None:
    reports: list[Progress] = []
    env = small_world()

    agent_for(env).learn(env, steps=1_600, on_progress=reports.append)

    # By hand: 200 vector steps, a report every 200/50 = 4 of them.
    assert [report.steps for report in reports] == list(range(32, 1_601, 32))
    assert {report.total_steps for report in reports} == {1_600}
    assert {"success_rate", "episodes", "epsilon", "loss", "q", "gradient_norm"} <= reports[-1].metrics.keys()
    assert np.isnan(reports[0].metrics["loss"])  # 32 transitions are fewer than warm_up
    assert reports[-1].metrics["loss"] > 0.0
    # By hand: from 1 to 0.05 over 200 vector steps; the last one is at 199/200.
    assert reports[-1].metrics["epsilon"] == pytest.approx(1.0 - 0.95 * 199 / 200)


def test_training_ends_with_the_last_episode_it_may_have() -> None:
    reports: list[Progress] = []
    env = Steady()  # four episodes a step

    agent_for(env, replace(SMALL, episodes=9)).learn(env, steps=400, on_progress=reports.append)

    assert (reports[-1].steps, reports[-1].metrics["episodes"]) == (12, 12.0)


def test_a_seed_decides_everything_and_no_global_random_state_does() -> None:
    def learnt(seed: int) -> dict[str, Any]:
        env = small_world()
        agent = agent_for(env, replace(SMALL, seed=seed))
        agent.learn(env, steps=1_200)
        return agent.state().arrays

    random.seed(1)
    np.random.seed(1)  # noqa: NPY002
    torch.manual_seed(1)
    before = random.getstate(), np.random.get_state()[1].tolist(), torch.get_rng_state().tolist()  # type: ignore[index,union-attr]  # noqa: NPY002
    once = learnt(3)
    after = random.getstate(), np.random.get_state()[1].tolist(), torch.get_rng_state().tolist()  # type: ignore[index,union-attr]  # noqa: NPY002
    np.random.seed(2)  # noqa: NPY002
    torch.manual_seed(2)

    assert before == after
    assert same_bits(once, learnt(3))
    assert not same_bits(once, learnt(4))


# ---- Resuming ----------------------------------------------------------------------------------


class CutError(Exception):
    """Ends a training."""


@pytest.mark.parametrize(
    ("observation", "cut_at"),
    # Before warm-up, after it, with the replay buffer full, before the last step.
    [("cell_goal", 0), ("cell_goal", 5), ("cell_goal", 60), ("cell_goal", 119), ("features", 60)],
)
def test_a_training_cut_in_two_is_the_same_bit_for_bit(observation: str, cut_at: int, tmp_path: Path) -> None:
    config = replace(SMALL, replay_size=400, learning_rate_end=1e-4)
    whole_env = small_world(observation=observation)
    whole, whole_reports = agent_for(whole_env, config), list[Progress]()
    whole_end: list[State] = []
    whole.learn(whole_env, steps=960, on_progress=whole_reports.append, on_cut=lambda s: whole_end.append(s()))

    env, reports, calls = small_world(observation=observation), list[Progress](), 0

    def cut(make_state: Any) -> None:
        nonlocal calls
        calls += 1
        if calls == cut_at + 1:
            write_state(make_state(), tmp_path, "training")
            agent.save(tmp_path)
            raise CutError

    agent = agent_for(env, config)
    with pytest.raises(CutError):
        agent.learn(env, steps=960, on_progress=reports.append, on_cut=cut)
    second, end = DQNAgent.load(tmp_path), list[State]()
    resume = read_state(tmp_path, "training")
    second.learn(env, steps=960, on_progress=reports.append, on_cut=lambda s: end.append(s()), resume=resume)

    assert same_bits(second.state().arrays, whole.state().arrays)
    assert repr(reports) == repr(whole_reports)  # as text, where NaN equals NaN
    # At the last cut: target network, Adam, replay buffer, generators and counters.
    assert same_bits(end[-1].arrays, whole_end[-1].arrays)
    assert end[-1].values == whole_end[-1].values
    assert len(whole_end) == 120
    assert len(end) == 120 - cut_at


def test_a_state_does_not_change_while_training_goes_on() -> None:
    env, states, copies = small_world(), [], []
    agent = agent_for(env)

    def cut(make_state: Any) -> None:
        if not states and env._steps.any():
            states.append(make_state())
            copies.append({name: array.copy() for name, array in states[0].arrays.items()})

    agent.learn(env, steps=1_600, on_cut=cut)

    assert same_bits(states[0].arrays, copies[0])


# ---- Nothing silent ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("wrong", "value", "message"),
    [
        # Step 50 of four environments.
        ("reward", np.nan, "step 200: reward of environment 1 is nan"),
        ("reward", np.inf, "step 200: reward of environment 1 is inf"),
        ("observation", np.nan, r"step 200: next_observation\[0\] of environment 1 is nan"),
        ("final", -np.inf, r"step 200: observation\[0\] of environment 1 is -inf"),
        # Finite as the environment counts, and too large for the network.
        ("reward", 1e300, r"step \d+: loss is inf, q is .*, gradient_norm is .*; the weights were not touched"),
    ],
)
def test_a_number_that_is_not_finite_stops_training_before_the_weights(wrong: str, value: float, message: str) -> None:
    env = Steady(features=True, wrong=wrong, value=value, wrong_at=50)
    agent, weights = agent_for(env), []

    with pytest.raises(NonFiniteError, match=message):
        agent.learn(env, steps=4_000, on_cut=lambda _: weights.append(agent.state().arrays))

    assert same_bits(agent.state().arrays, weights[-1])
    assert not same_bits(weights[-1], weights[0])
    assert all(np.isfinite(array).all() for array in agent.state().arrays.values())


def test_a_gradient_that_is_not_finite_leaves_weights_and_adam_as_they_were() -> None:
    learner = Learner(network_of([[1.0, 2.0]]), SMALL)
    fine = Batch(torch.tensor([0]), torch.tensor([0]), torch.tensor([1.5]), torch.tensor([0.0]), torch.tensor([0]))
    learner.update(fine, 0)
    before = learner.state().arrays, [p.detach().numpy().copy() for p in learner.network.parameters()]

    with pytest.raises(NonFiniteError, match="training stopped at step 640: loss is nan"):
        learner.update(fine._replace(returns=torch.tensor([torch.nan])), 640)

    assert same_bits(learner.state().arrays, before[0])
    for parameter, old in zip(learner.network.parameters(), before[1], strict=True):
        np.testing.assert_array_equal(parameter.detach().numpy(), old)


@pytest.mark.parametrize(
    ("spaces", "message"),
    [
        ((Discrete(9), Box(-1, 1, (2,))), r"actions Discrete from 0, not Box.*take gridnav/GridWorld-v0"),
        ((Discrete(9), Discrete(4, start=1)), "actions Discrete from 0"),
        ((Discrete(9, start=1), Discrete(4)), "observations Discrete from 0 or a Box of one axis, not Discrete"),
        ((Box(0, 1, (8, 8)), Discrete(4)), "observations Discrete from 0 or a Box of one axis, not Box"),
    ],
)
def test_dqn_refuses_spaces_it_cannot_handle(spaces: tuple[gym.Space[Any], gym.Space[Any]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DQNAgent(*spaces, SMALL)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"n_step": 0}, "n_step 0 of DQNConfig must be at least 1"),
        ({"gamma": 1.5}, r"gamma 1.5 of DQNConfig must be in \[0, 1\]"),
        ({"hidden": ()}, r"hidden \(\) of DQNConfig must be one or more whole numbers"),
        ({"hidden": (64, 0)}, r"hidden \(64, 0\) of DQNConfig"),
        ({"loss": "mae"}, "loss 'mae' of DQNConfig is none of huber, mse"),
        ({"learning_rate": float("nan")}, "learning_rate nan of DQNConfig must be a finite number"),
    ],
)
def test_wrong_hyper_parameters_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DQNConfig(**changes)


# ---- Files -------------------------------------------------------------------------------------


@pytest.mark.parametrize("observation", ["cell_goal", "features"])
def test_agents_come_back_from_their_files_unchanged(observation: str, tmp_path: Path) -> None:
    env = small_world(observation=observation)
    agent = agent_for(env)
    agent.learn(env, steps=800)
    agent.save(tmp_path)

    loaded = DQNAgent.load(tmp_path)

    observations, _ = env.reset(seed=1)
    assert loaded.config == agent.config
    assert same_bits(loaded.state().arrays, agent.state().arrays)
    np.testing.assert_array_equal(loaded.act(observations), agent.act(observations))


def test_weights_that_are_not_those_of_the_network_are_refused() -> None:
    state = DQNAgent(Discrete(9), Discrete(4), SMALL).state()
    bias = state.arrays["head.bias"]

    with pytest.raises(ValueError, match=r"weights head\.bias must be finite"):
        DQNAgent.from_state(State(state.arrays | {"head.bias": np.full_like(bias, np.nan)}, state.values))
    with pytest.raises(ValueError, match=r"weights do not fit the network.*size mismatch for head\.bias"):
        DQNAgent.from_state(State(state.arrays | {"head.bias": bias[1:]}, state.values))
    with pytest.raises(ValueError, match=r"weights do not fit the network.*Missing key"):
        DQNAgent.from_state(State({"head.bias": bias}, state.values))
