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
from safetensors import SafetensorError
from safetensors.numpy import load_file, save

from gridnav.problem.strict_json import read_object
from gridnav.problem.types import NonFiniteError, State

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
OnCut = Callable[[Callable[[], State]], None]
"""Called wherever training may be cut in two, with what makes the state of training there. It may raise to end it."""


Policy = Callable[[NDArray[Any]], NDArray[Any]]
"""Observations of a batch to its actions."""


class FrameStack:
    """The last observations of every robot of a batch, the newest first: what an agent sees that remembers.

    Before an episode's first observation there was always the same one.

    Args:
        size: Observations of each robot.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self.frames: NDArray[Any] = np.empty((0, size, 0))
        """Shape ``(n, size, n_numbers)``."""

    def begin(self, observations: NDArray[Any]) -> NDArray[Any]:
        """Forget all, where episodes begin with observations of shape ``(n, n_numbers)``; gives what is seen."""
        self.frames = np.repeat(observations[:, None], self.size, axis=1)
        return self.seen

    def push(self, observations: NDArray[Any], begun: NDArray[np.bool_] | None = None) -> NDArray[Any]:
        """Remember what is observed one step later; ``begun`` names the robots whose next episode begins with it."""
        self.frames = np.concatenate([observations[:, None], self.frames[:, :-1]], axis=1)
        if begun is not None and begun.any():
            self.frames[begun] = observations[begun, None]
        return self.seen

    @property
    def seen(self) -> NDArray[Any]:
        """All that is remembered, shape ``(n, size * n_numbers)``."""
        return self.frames.reshape(len(self.frames), -1)


class Agent(ABC):
    """Knows Gymnasium spaces, never a world; observations and actions carry a leading batch axis."""

    kind: ClassVar[str]
    """Name on the command line and in files."""

    @abstractmethod
    def act(self, observations: NDArray[Any]) -> NDArray[Any]:
        """Greedy actions for a batch of observations, shape ``(n, ...)`` both."""

    def begin(self) -> Policy:
        """What acts in the episodes of a batch from their beginning on, asked once a step; it may remember."""
        return self.act

    @abstractmethod
    def values(self, observations: NDArray[Any]) -> NDArray[Any]:
        """What the agent expects to earn from each observation on, discounted, shape ``(n,)``."""

    @abstractmethod
    def learn(
        self,
        env: VectorEnv[Any, Any, Any],
        *,
        steps: int,
        on_progress: OnProgress | None = None,
        on_cut: OnCut | None = None,
        resume: State | None = None,
    ) -> None:
        """Learn from at most ``steps`` environment steps of an environment that resets itself in the same step.

        Args:
            env: Where.
            steps: In all, those before a cut included.
            on_progress: Told of steps and metrics once in a while.
            on_cut: Called between two steps (PPO: two rollouts).
            resume: What ``on_cut`` was given. The agent and the environment must be as they were then; what follows
                is what would have followed, bit for bit, on one torch thread.

        Raises:
            NonFiniteError: When a NaN or infinity came up, before it reached the weights.
        """

    @abstractmethod
    def state(self) -> State:
        """What ``from_state`` makes an agent from that acts equally."""

    @classmethod
    @abstractmethod
    def from_state(cls, state: State) -> Self:
        """The agent that ``state`` described.

        Raises:
            ValueError: When it describes none.
        """

    def save(self, directory: Path) -> None:
        """Write ``agent.safetensors`` and ``agent.json`` into a directory that exists."""
        arrays, values = self.state()
        write_state(State(arrays, {"kind": self.kind, **values}), directory, "agent")

    @classmethod
    def load(cls, directory: Path) -> Self:
        """Read what ``save`` wrote; nothing in the files is run.

        Raises:
            ValueError: When the files hold another kind of agent, or none.
        """
        state = read_state(directory, "agent")
        kind = state.values.pop("kind", None)
        if kind != cls.kind:
            raise ValueError(f"{directory.name} holds an agent of kind {kind!r:.60}, not {cls.kind!r}")
        try:
            return cls.from_state(state)
        except (KeyError, TypeError, RuntimeError) as error:  # RuntimeError: torch's word for weights that do not fit
            raise ValueError(f"{directory.name} does not hold what an agent of kind {cls.kind!r} is made of") from error


def write_state(state: State, directory: Path, name: str) -> None:
    """Write ``name.safetensors`` and ``name.json`` into a directory that exists."""
    # Not `save_file`: a full disk is an OSError here.
    # Not `ascontiguousarray`: it makes one number a list of one.
    content = save({key: np.asarray(array, order="C") for key, array in state.arrays.items()})
    (directory / f"{name}.safetensors").write_bytes(content)
    (directory / f"{name}.json").write_text(json.dumps(state.values, allow_nan=False), encoding="utf-8")


def read_state(directory: Path, name: str) -> State:
    """Read what ``write_state`` wrote.

    Raises:
        ValueError: When a file is not what it should be.
    """
    try:
        arrays = load_file(directory / f"{name}.safetensors")
    except SafetensorError as error:
        raise ValueError(f"{name}.safetensors is damaged: {error}") from None
    try:
        return State(arrays, read_object(directory / f"{name}.json"))
    except ValueError as error:
        raise ValueError(f"{name}.json is damaged: {error}") from None


def reached(next_observations: NDArray[Any], info: dict[str, Any]) -> NDArray[Any]:
    """The state that each step led to: where an episode ended, its last state and not the next one's first."""
    if "final_obs" not in info:
        return next_observations
    observations, ended = next_observations.copy(), info["_final_obs"]
    observations[ended] = np.stack(info["final_obs"][ended])
    return observations


def check_finite(steps: int, **batches: NDArray[Any]) -> None:
    """Stop training where an environment handed out a NaN or infinity.

    Args:
        steps: Environment steps taken so far.
        batches: Arrays with a leading batch axis, by the name they have in the message.

    Raises:
        NonFiniteError: When one of them is not finite.
    """
    for name, batch in batches.items():
        if batch.dtype.kind != "f" or np.isfinite(batch).all():
            continue
        i, *place = np.argwhere(~np.isfinite(batch))[0].tolist()
        field = f"{name}[{place[0]}]" if place else name
        raise NonFiniteError(
            f"training stopped at step {steps}: {field} of environment {i} is {batch[(i, *place)]}; the weights were "
            "not touched by it"
        )


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
        self.physics_errors = 0

    def add(self, info: dict[str, Any]) -> None:
        """Take note of the episodes that a vector step ended, from ``final_info``."""
        if "final_info" not in info:
            return
        ended = info["_final_info"]
        self._in_first = ~ended if self._in_first is None else self._in_first & ~ended
        self._successes.extend(info["final_info"]["is_success"][ended].tolist())
        self._collisions.extend((info["final_info"]["collisions"][ended] > 0).tolist())
        self.episodes += int(ended.sum())
        if "physics_error" in info["final_info"]:
            self.physics_errors += int((info["final_info"]["physics_error"] & ended).sum())

    def state(self) -> dict[str, Any]:
        """Everything the window holds, fit for JSON."""
        return {
            "in_first": None if self._in_first is None else self._in_first.tolist(),
            "successes": list(self._successes),
            "collisions": list(self._collisions),
            "episodes": self.episodes,
            "physics_errors": self.physics_errors,
        }

    @classmethod
    def from_state(cls, values: dict[str, Any]) -> Self:
        """The window that ``state`` described."""
        window = cls()
        window._in_first = None if values["in_first"] is None else np.array(values["in_first"], dtype=bool)
        window._successes.extend(values["successes"])
        window._collisions.extend(values["collisions"])
        window.episodes, window.physics_errors = values["episodes"], values["physics_errors"]
        return window

    @property
    def is_full(self) -> bool:
        """As many episodes were seen as the window holds, and the rates are known."""
        return len(self._successes) == SUCCESS_WINDOW and self._is_fair

    @property
    def metrics(self) -> dict[str, float]:
        """``success_rate``, ``collision_rate``, and ``episodes`` and ``physics_errors`` so far.

        The rates are NaN while they are not known.
        """
        rates = {"success_rate": self._successes, "collision_rate": self._collisions}
        return {name: float(np.mean(ends)) if self._is_fair else float("nan") for name, ends in rates.items()} | {
            "episodes": float(self.episodes),
            "physics_errors": float(self.physics_errors),
        }

    @property
    def _is_fair(self) -> bool:
        """Every environment has ended an episode."""
        return self._in_first is not None and not self._in_first.any()
