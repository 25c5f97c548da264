"""What the agents with a table share: greedy actions, and the table as a file."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from gridnav.problem.types import FloatArray

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

    def state(self) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """The table; nothing else."""
        return {"action_values": self.action_values}, {}

    @classmethod
    def from_state(cls, arrays: dict[str, NDArray[Any]], values: dict[str, Any]) -> Self:
        """An agent with this table."""
        agent = cls.__new__(cls)
        TabularAgent.__init__(agent, np.asarray(arrays["action_values"], dtype=np.float64))
        return agent
