"""What an agent is: it acts, learns, saves and loads."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from safetensors.numpy import load_file, save_file

WEIGHTS_FILE, AGENT_FILE = "weights.safetensors", "agent.json"
SUCCESS_WINDOW = 400
"""Training episodes over which the success rate is averaged."""


@dataclass(frozen=True)
class Progress:
    """Where training stands, reported once in a while."""

    steps: int
    """Environment steps taken."""
    total_steps: int
    """Environment steps planned."""
    metrics: dict[str, float]
    """What the learner measures, by name; ``success_rate`` is over the last episodes."""


OnProgress = Callable[[Progress], None]


class Agent(ABC):
    """Knows Gymnasium spaces, never a world; observations and actions carry a leading batch axis."""

    kind: ClassVar[str]
    """Name on the command line and in files."""
    files: ClassVar[tuple[str, ...]] = (WEIGHTS_FILE, AGENT_FILE)
    """What ``save`` writes."""

    @abstractmethod
    def act(self, observations: NDArray[Any]) -> NDArray[Any]:
        """Greedy actions for a batch of observations, shape ``(n, ...)`` both."""

    @abstractmethod
    def learn(self, env: VectorEnv[Any, Any, Any], *, steps: int, on_progress: OnProgress | None = None) -> None:
        """Learn from at most ``steps`` environment steps of an environment that resets itself in the same step."""

    @abstractmethod
    def state(self) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Arrays and JSON values from which ``from_state`` makes an agent that acts equally."""

    @classmethod
    @abstractmethod
    def from_state(cls, arrays: dict[str, NDArray[Any]], values: dict[str, Any]) -> Self:
        """The agent that ``state`` described."""

    def save(self, directory: Path) -> None:
        """Write ``weights.safetensors`` and ``agent.json`` into a directory that exists."""
        arrays, values = self.state()
        save_file({name: np.ascontiguousarray(array) for name, array in arrays.items()}, directory / WEIGHTS_FILE)
        text = json.dumps({"kind": self.kind, **values}, indent=2)
        (directory / AGENT_FILE).write_text(text, encoding="utf-8")

    @classmethod
    def load(cls, directory: Path) -> Self:
        """Read what ``save`` wrote; nothing in the files is run.

        Raises:
            ValueError: When the files hold another kind of agent.
        """
        values = json.loads((directory / AGENT_FILE).read_text(encoding="utf-8"))
        kind = values.pop("kind", None)
        if kind != cls.kind:
            raise ValueError(f"{directory} holds an agent of kind {kind!r}, not {cls.kind!r}")
        return cls.from_state(load_file(directory / WEIGHTS_FILE), values)


class EpisodeWindow:
    """Success and collisions of the last training episodes.

    Success ends an episode and failure takes until the time limit, so the first episodes to end are the good ones: the
    rates are not known before every environment has ended one.
    """

    def __init__(self) -> None:
        self._in_first: NDArray[np.bool_] | None = None  # environments that have not ended an episode yet
        self._successes: deque[float] = deque(maxlen=SUCCESS_WINDOW)
        self._collisions: deque[float] = deque(maxlen=SUCCESS_WINDOW)
        self.episodes = 0

    def add(self, info: dict[str, Any]) -> None:
        """Take note of the episodes that a vector step ended, from ``final_info``."""
        if "final_info" not in info:
            return
        ended = info["_final_info"]
        self._in_first = ~ended if self._in_first is None else self._in_first & ~ended
        self._successes.extend(info["final_info"]["is_success"][ended].tolist())
        self._collisions.extend((info["final_info"]["collisions"][ended] > 0).tolist())
        self.episodes += int(ended.sum())

    @property
    def is_full(self) -> bool:
        """As many episodes were seen as the window holds, and the rates are known."""
        return len(self._successes) == SUCCESS_WINDOW and self._is_fair

    @property
    def metrics(self) -> dict[str, float]:
        """``success_rate``, ``collision_rate`` and the ``episodes`` so far; rates are NaN while they are not known."""
        if not self._is_fair:
            return {"success_rate": float("nan"), "collision_rate": float("nan"), "episodes": float(self.episodes)}
        return {
            "success_rate": float(np.mean(self._successes)),
            "collision_rate": float(np.mean(self._collisions)),
            "episodes": float(self.episodes),
        }

    @property
    def _is_fair(self) -> bool:
        """Every environment has ended an episode."""
        return self._in_first is not None and not self._in_first.any()
