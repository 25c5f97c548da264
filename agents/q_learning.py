"""Tabular Q-learning (Watkins 1989; Sutton and Barto 2018, section 6.5), on many environments at once."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Self

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Discrete
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from .base import EpisodeWindow, OnProgress, Progress
from .tabular import TabularAgent

REPORTS = 50
"""Progress reports per training."""


@dataclass(frozen=True)
class QLearningConfig:
    """Hyper-parameters; the defaults solve ``classic`` from every start to every goal."""

    seed: int = 0
    """Of exploration and of the environments."""
    num_envs: int = 512
    """Environments stepped together."""
    learning_rate: float = 0.5
    """Share of the temporal-difference error that a visit corrects; lower it when moves slip."""
    gamma: float = 0.99
    """Discount per move."""
    epsilon_start: float = 1.0
    """Probability of a random move at the beginning."""
    epsilon_end: float = 0.1
    """The same at the end; it falls linearly."""


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

    def learn(self, env: VectorEnv[Any, Any, Any], *, steps: int, on_progress: OnProgress | None = None) -> None:
        """One-step updates on whole batches of transitions.

        Where two environments make the same transition in one step, it is corrected once.
        """
        config, q, n = self.config, self.action_values, env.num_envs
        rng = np.random.default_rng(config.seed)
        window = EpisodeWindow()
        n_batches = max(1, steps // n)
        observations, _ = env.reset(seed=config.seed)
        for batch in range(n_batches):
            epsilon = config.epsilon_start + (config.epsilon_end - config.epsilon_start) * batch / n_batches
            # Exploration: with probability epsilon a move uniform over all moves.
            explores = rng.random(n) < epsilon
            actions = np.where(explores, rng.integers(q.shape[1], size=n), self.act(observations))
            next_observations, rewards, terminated, _, info = env.step(actions)

            # A truncated episode goes on beyond its last state, a terminated one does not.
            reached = _reached(next_observations, info)
            bootstrap = np.where(terminated, 0.0, q[reached].max(axis=1))
            errors = rewards + config.gamma * bootstrap - q[observations, actions]
            q[observations, actions] += config.learning_rate * errors

            window.add(info)
            observations = next_observations
            if on_progress and ((batch + 1) % max(1, n_batches // REPORTS) == 0 or batch + 1 == n_batches):
                metrics = window.metrics | {"epsilon": epsilon, "td_error": float(np.abs(errors).mean())}
                on_progress(Progress((batch + 1) * n, n_batches * n, metrics))

    def state(self) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """The table; the hyper-parameters."""
        return {"action_values": self.action_values}, {"config": asdict(self.config)}

    @classmethod
    def from_state(cls, arrays: dict[str, NDArray[Any]], values: dict[str, Any]) -> Self:
        """An agent with this table."""
        agent = super().from_state(arrays, values)
        agent.config = QLearningConfig(**values["config"])
        return agent


def _reached(next_observations: NDArray[Any], info: dict[str, Any]) -> NDArray[Any]:
    """The state that each step led to: where an episode ended, its last state and not the next one's first."""
    if "final_obs" not in info:
        return next_observations
    reached, ended = next_observations.copy(), info["_final_obs"]
    reached[ended] = np.stack(info["final_obs"][ended])
    return reached
