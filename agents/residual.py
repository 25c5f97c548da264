"""Residual PPO: a network that corrects somebody else's commands (Silver et al. 2018, arXiv 1812.06298)."""

from __future__ import annotations

from typing import Any, Self

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray

from gridnav.problem.types import FloatArray, State

from .ppo import PPOAgent, PPOConfig

RESIDUAL_SHARE = 0.5
"""Of a full command: the most that a correction comes to."""
TABLE = "action_values"


class ResidualAgent(PPOAgent):
    """Its actions are corrections: ``RESIDUAL_SHARE`` of them is added to what a table of the grid has the robot do.

    How commands are made of the table's moves is no matter of an agent, see ``policy_for``. The untrained policy
    corrects nothing.

    Args:
        observation_space: A ``Box``.
        action_space: A ``Box``.
        config: Hyper-parameters; ``initial_forward`` does not count.
        action_values: The table, shape ``(n_observations, n_moves)``.
    """

    kind = "residual"

    def __init__(
        self,
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
        config: PPOConfig,
        action_values: FloatArray | None = None,
    ) -> None:
        super().__init__(observation_space, action_space, config)
        self.action_values: FloatArray = np.zeros((1, 4)) if action_values is None else action_values
        with torch.no_grad():
            for name in ("action_net.weight", "action_net.bias"):
                self.policy.get_parameter(name).zero_()

    def moves(self, observations: NDArray[Any]) -> NDArray[Any]:
        """The table's greedy moves for ``cell_goal`` observations, shape ``(n,)``."""
        return self.action_values[observations].argmax(axis=1)

    def state(self) -> State:
        """Weights and the table; spaces and hyper-parameters."""
        arrays, values = super().state()
        return State(arrays | {TABLE: self.action_values}, values)

    @classmethod
    def from_state(cls, state: State) -> Self:
        """An agent with these weights and this table.

        Raises:
            ValueError: When a number is not finite, or the table is none.
        """
        arrays = dict(state.arrays)
        table = np.asarray(arrays.pop(TABLE), dtype=np.float64)
        if table.ndim != 2 or not np.isfinite(table).all():
            raise ValueError(f"{TABLE} of shape {table.shape} must be a table of finite numbers")
        agent = super().from_state(State(arrays, state.values))
        agent.action_values = table
        return agent
