"""Nothing silent: a NaN or infinity stops training before it reaches the weights, and says where it came up."""

from __future__ import annotations

import itertools
import json
import re
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import VectorEnv, VectorWrapper

from gridnav.agents import Agent, QLearning, QLearningConfig
from gridnav.cli import main
from gridnav.experiment.checkpoint import load_checkpoint
from gridnav.problem.reward import Reward, Transition
from gridnav.problem.types import FloatArray, NonFiniteError

EPISODE = 5
"""Steps after which every episode is truncated."""


class Poisoned(VectorWrapper):
    """An environment that hands out one number that is none.

    Args:
        env: Otherwise this one.
        where: ``reward``, ``observation``, ``final``, ``first`` (of the next episode) or ``reset``.
        at: In which vector step.
        value: The number.
    """

    def __init__(self, env: Any, where: str, at: int, value: float) -> None:
        super().__init__(env)
        self.where, self.at, self.value = where, at, value
        self.ill = env.num_envs - 1
        """The environment that does it."""
        self.taken = 0

    def reset(self, **options: Any) -> Any:
        observations, info = self.env.reset(**options)
        if self.where == "reset":
            observations[self.ill, 2] = self.value
        return observations, info

    def step(self, actions: Any) -> Any:
        observations, rewards, terminated, truncated, info = self.env.step(actions)
        self.taken += 1
        if self.taken == self.at:
            if self.where == "reward":
                rewards[self.ill] = self.value
            elif self.where in ("observation", "first"):
                observations[self.ill, 2] = self.value
            elif self.where == "final":
                info["final_obs"][self.ill][2] = self.value
        return observations, rewards, terminated, truncated, info


def make(kind: str, num_envs: int) -> tuple[Agent, VectorEnv[Any, Any, Any]]:
    """An agent that updates early, and where it learns."""
    world, options = {
        "q-learning": ("GridWorld", {}),
        "dqn": ("GridWorld", {"observation": "features"}),
        "ppo": ("Unicycle", {}),
    }[kind]
    env: Any = gym.make_vec(f"gridnav/{world}-v0", num_envs=num_envs, max_episode_steps=EPISODE, **options)
    spaces = env.single_observation_space, env.single_action_space
    if kind == "q-learning":
        return QLearning(*spaces, QLearningConfig(num_envs=num_envs)), env
    from gridnav.agents import DQNAgent, DQNConfig, PPOAgent, PPOConfig  # torch takes seconds to import

    if kind == "dqn":
        return DQNAgent(*spaces, DQNConfig(num_envs=num_envs, hidden=(8,), batch_size=8, warm_up=1)), env
    return PPOAgent(*spaces, PPOConfig(num_envs=num_envs, hidden=(8,), n_steps=3, batch_size=3, n_epochs=1)), env


def weights(agent: Agent) -> dict[str, bytes]:
    return {name: array.tobytes() for name, array in agent.state().arrays.items()}


def stop(agent: Agent, env: Any, on_first_cut: Callable[[], object] = lambda: None) -> str:
    """The message that training stops with; the weights are those before the step or update that did it."""
    before: list[dict[str, bytes]] = []

    def on_cut(state: Callable[[], Any]) -> None:
        if not before:
            on_first_cut()
        before.append(weights(agent))

    start = weights(agent)
    with pytest.raises(NonFiniteError) as caught:
        agent.learn(env, steps=1_000 * env.num_envs, on_cut=on_cut)
    assert weights(agent) == (before[-1] if before else start)
    message = str(caught.value)
    assert message.isprintable()
    assert len(message) <= 200
    assert "the weights were not touched by it" in message
    return message


@pytest.mark.parametrize("num_envs", [1, 4])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
@pytest.mark.parametrize(
    ("kind", "where", "at", "field"),
    [
        ("q-learning", "reward", 8, "reward"),
        ("dqn", "reward", 8, "reward"),
        ("dqn", "observation", 8, "observation[2]"),
        ("dqn", "final", 10, "observation[2]"),
        ("dqn", "first", 10, "next_observation[2]"),
        ("dqn", "reset", 0, "observation[2]"),
        ("ppo", "reward", 8, "reward"),
        ("ppo", "observation", 8, "observation[2]"),
        ("ppo", "final", 10, "observation[2]"),
        ("ppo", "first", 10, "first_observation[2]"),
        ("ppo", "reset", 0, "observation[2]"),
    ],
)
def test_what_the_environment_hands_out_is_looked_at_before_it_is_learnt_from(
    kind: str, where: str, at: int, field: str, value: float, num_envs: int
) -> None:
    agent, env = make(kind, num_envs)

    message = stop(agent, Poisoned(env, where, at, value))

    # By hand: `at` vector steps of `num_envs` environments, of which the last one does it.
    assert message.startswith(f"training stopped at step {at * num_envs}: {field} of environment {num_envs - 1} is ")
    assert f" is {value}; " in message


@pytest.mark.parametrize("kind", ["dqn", "ppo"])
def test_a_reward_too_large_for_the_networks_numbers_stops_training_too(kind: str) -> None:
    """1e300 is finite in double precision and infinite in single precision."""
    agent, env = make(kind, 1)

    message = stop(agent, Poisoned(env, "reward", 2, 1e300))

    assert re.search("(reward|loss|gradient).* is inf", message)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("kind", ["dqn", "ppo"])
def test_a_gradient_that_is_no_number_does_not_reach_the_weights(kind: str, value: float) -> None:
    agent, env = make(kind, 4)

    def poison() -> None:
        network: Any = agent.network if kind == "dqn" else agent.policy  # type: ignore[attr-defined]
        next(p for p in network.parameters() if p.ndim == 2).register_hook(lambda gradient: gradient * value)

    message = stop(agent, env, on_first_cut=poison)

    assert "gradient" in message


def test_a_table_that_overflows_is_stopped() -> None:
    agent, env = make("q-learning", 4)
    agent.action_values[:] = 1e308  # type: ignore[attr-defined]
    # Every other column of cells; the eight goals of a cell follow one another.
    agent.action_values[np.arange(800) // 8 % 2 == 0] = -1e308  # type: ignore[attr-defined]

    assert "td_error of environment" in stop(agent, env)


class Failing(Reward):
    """NaN from the 300th step on, for the second robot."""

    def terms(self, step: Transition) -> dict[str, FloatArray]:
        terms = super().terms(step)
        if next(COUNT) >= 300:
            terms["time"][1] = np.nan
        return terms


COUNT = itertools.count()


def test_the_command_line_says_where_it_stopped_and_keeps_the_last_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(Reward.PRESETS, "failing", Failing())
    before = signal.getsignal(signal.SIGTERM)
    arguments = ["train", "--reward", "failing", "--checkpoint-s", "1", "--set", "num_envs=16"]

    with pytest.raises(SystemExit) as leaving:
        main([*arguments, "--run-dir", str(tmp_path / "run")])
    signal.signal(signal.SIGTERM, before)

    assert leaving.value.code == 4
    told = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("training")]
    # By hand: step 300 counts from 0, so it is the 301st of 16 environments.
    (line,) = [line for line in told if line]
    assert line.startswith(f"gridnav: training stopped at step {301 * 16}: reward of environment 1 is nan")
    last = load_checkpoint(tmp_path / "run" / "checkpoints", "q-learning")
    assert last is not None
    assert last.training is not None
    assert last.training.values["batch"] <= 300
    assert np.isfinite(last.agent.action_values).all()  # type: ignore[attr-defined]
    rows = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert all(row["steps"] <= 300 * 16 for row in rows)


def test_diverged_physics_is_counted_in_the_metrics() -> None:
    """It ends the episode and not the training: what is observed stays finite."""
    agent, env = make("ppo", 4)
    diff_drive: Any = gym.make_vec("gridnav/DiffDrive-v0", num_envs=4, max_episode_steps=EPISODE)
    counted: list[float] = []

    class Exploding(VectorWrapper):
        taken = 0

        def step(self, actions: Any) -> Any:
            self.taken += 1
            if self.taken in (2, 7):
                diff_drive._qvel[self.taken % 4] = 1e12
            return self.env.step(actions)

    from gridnav.agents import PPOAgent, PPOConfig

    config = PPOConfig(num_envs=4, hidden=(8,), n_steps=3, batch_size=3, n_epochs=1)
    agent = PPOAgent(env.single_observation_space, env.single_action_space, config)
    agent.learn(
        Exploding(diff_drive),
        steps=12 * 4,
        on_progress=lambda progress: counted.append(progress.metrics["physics_errors"]),
    )

    # By hand: rollouts of three steps; one diverges in the second step and one in the seventh.
    assert counted == [1.0, 1.0, 2.0, 2.0]
