"""What the agents with a table share: greedy actions, and the table as a file."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from gridnav.problem.types import FloatArray, State

from .base import Agent


class TabularAgent(Agent):
    """Takes the action of highest value.

    Args:
        action_values: Value of each action in each observation, shape ``(n_observations, n_actions)``.
    """

    def __init__(self, action_values: FloatArray) -> None:
        self.action_values = action_values

    def act(self, observations: NDArray[Any]) -> NDArray[Any]:
        """Greedy actions, shape ``(n,)``; ties go to the lower number."""
        return self.action_values[observations].argmax(axis=1)

    def values(self, observations: NDArray[Any]) -> NDArray[Any]:
        """The values of the best actions, shape ``(n,)``."""
        return self.action_values[observations].max(axis=1)

    def state(self) -> State:
        """The table; nothing else."""
        return State({"action_values": self.action_values}, {})

    @classmethod
    def from_state(cls, state: State) -> Self:
        """An agent with this table.

        Raises:
            ValueError: When it is no table of numbers.
        """
        table = np.asarray(state.arrays["action_values"], dtype=np.float64)
        if table.ndim != 2 or not np.isfinite(table).all():
            raise ValueError(f"action_values of shape {table.shape} must be a table of finite numbers")
        agent = cls.__new__(cls)
        TabularAgent.__init__(agent, table)
        return agent
