"""Tabular Q-learning (Watkins 1989; Sutton and Barto 2018, section 6.5), on many environments at once."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Self

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Discrete
from gymnasium.vector import VectorEnv

from gridnav.problem.types import State

from .base import EpisodeWindow, OnCut, OnProgress, Progress, check_finite, reached
from .hyper_parameters import EpsilonGreedyConfig
from .tabular import TabularAgent

REPORTS = 50
"""Progress reports per training."""


@dataclass(frozen=True)
class QLearningConfig(EpsilonGreedyConfig):
    """Hyper-parameters; the defaults solve ``classic`` from every start to every goal."""

    num_envs: int = 512
    """Environments stepped together."""
    learning_rate: float = 0.5
    """Share of the temporal-difference error that a visit corrects; lower it when moves slip."""
    gamma: float = 0.997
    """Discount per move; that of the default reward."""
    exploring_starts: bool = True
    """What is learnt is to be right everywhere, not only on the ways that the task asks for."""
    visits: int = 190
    """Environment steps per entry of the table in a training of the usual length."""


Q_LEARNING_PRESETS: dict[str, QLearningConfig] = {
    "default": QLearningConfig(),
    "tutorial": QLearningConfig(
        num_envs=1,
        learning_rate=0.1,
        gamma=0.95,
        epsilon_end=0.01,
        epsilon_decay=0.99,
        episodes=500,
        exploring_starts=False,
        visits=125,
    ),
    "cell": QLearningConfig(
        num_envs=2,
        learning_rate=0.135,
        learning_rate_end=0.001,
        gamma=0.81,
        epsilon_end=0.05,
        epsilon_decay=0.98,
        episodes=500,
        exploring_starts=False,
        visits=125,
    ),
}
"""By name; ``tutorial`` is the tutorial's agent: 500 episodes of at most 100 moves."""


class QLearning(TabularAgent):
    """Learns a table of action values from transitions.

    Args:
        observation_space: ``Discrete``.
        action_space: ``Discrete``.
        config: Hyper-parameters.
    """

    kind = "q-learning"

    def __init__(
        self, observation_space: gym.Space[Any], action_space: gym.Space[Any], config: QLearningConfig
    ) -> None:
        if not isinstance(observation_space, Discrete) or not isinstance(action_space, Discrete):
            raise ValueError("Q-learning needs Discrete spaces: take gridnav/GridWorld-v0 with cell_goal or cell")
        super().__init__(np.zeros((int(observation_space.n), int(action_space.n))))
        self.config = config

    @property
    def planned_steps(self) -> int:
        """Environment steps of a training of the usual length."""
        return self.config.visits * self.action_values.size

    def learn(
        self,
        env: VectorEnv[Any, Any, Any],
        *,
        steps: int,
        on_progress: OnProgress | None = None,
        on_cut: OnCut | None = None,
        resume: State | None = None,
    ) -> None:
        """One-step updates on whole batches of transitions.

        Where two environments make the same transition in one step, it is corrected once.
        """
        config, q, n = self.config, self.action_values, env.num_envs
        rng = np.random.default_rng(config.seed)
        n_batches = max(1, steps // n)
        if resume is None:
            first, window = 0, EpisodeWindow()
            observations, _ = env.reset(seed=config.seed)
        else:
            first, window = resume.values["batch"], EpisodeWindow.from_state(resume.values["window"])
            rng.bit_generator.state = resume.values["rng"]
            observations = resume.arrays["observations"]

        def state() -> State:
            values = {"batch": batch, "rng": rng.bit_generator.state, "window": window.state()}
            return State({"observations": observations}, values)

        for batch in range(first, n_batches):
            if on_cut:
                on_cut(state)
            epsilon = config.epsilon(batch / n_batches, window.episodes)
            # Exploration: with probability epsilon a move uniform over all moves.
            explores = rng.random(n) < epsilon
            actions = np.where(explores, rng.integers(q.shape[1], size=n), self.act(observations))
            next_observations, rewards, terminated, _, info = env.step(actions)
            # A truncated episode goes on beyond its last state, a terminated one does not.
            bootstrap = np.where(terminated, 0.0, q[reached(next_observations, info)].max(axis=1))
            with np.errstate(over="ignore", invalid="ignore"):  # the next line says so, and where
                errors = rewards + config.gamma * bootstrap - q[observations, actions]
            check_finite((batch + 1) * n, reward=rewards, td_error=errors)
            q[observations, actions] += config.rate(batch / n_batches, window.episodes) * errors

            window.add(info)
            observations = next_observations
            is_last = batch + 1 == n_batches or config.is_over(window.episodes)
            if on_progress and ((batch + 1) % max(1, n_batches // REPORTS) == 0 or is_last):
                metrics = window.metrics | {"epsilon": epsilon, "td_error": float(np.abs(errors).mean())}
                on_progress(Progress((batch + 1) * n, n_batches * n, metrics))
            if is_last:
                break

    def state(self) -> State:
        """The table; the hyper-parameters."""
        return State({"action_values": self.action_values}, {"config": asdict(self.config)})

    @classmethod
    def from_state(cls, state: State) -> Self:
        """An agent with this table."""
        agent = super().from_state(state)
        agent.config = QLearningConfig(**state.values["config"])
        return agent
