"""What a learner gets from another one through its environment: a potential that pays, and commands to correct."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv, VectorWrapper

from gridnav.problem.types import AnyArray, BoolArray, FloatArray, InputError, State

Step = tuple[AnyArray, FloatArray, BoolArray, BoolArray, dict[str, Any]]


class WrappedWorlds(VectorWrapper[AnyArray, AnyArray, AnyArray, AnyArray, AnyArray]):
    """Worlds in a wrapper that knows what its robots observed last, after a cut too."""

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        super().__init__(env)
        self._worlds: Any = env
        shape = (env.num_envs, *(env.single_observation_space.shape or ()))
        self._observations: AnyArray = np.zeros(shape, env.single_observation_space.dtype)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[AnyArray, dict[str, Any]]:
        """Start an episode in every environment."""
        observations, info = self.env.reset(seed=seed, options=options)
        self._observations = observations.copy()
        return observations, info

    def get_state(self) -> State:
        """Everything that decides what comes next."""
        arrays, values = self._worlds.get_state()
        return State(arrays | {"last_observations": self._observations.copy()}, values)

    def set_state(self, state: State) -> None:
        """Go on where an environment that was made alike was.

        Raises:
            InputError: When the state is that of another kind or number of environments.
        """
        arrays = dict(state.arrays)
        last = arrays.pop("last_observations")
        if last.shape != self._observations.shape or last.dtype != self._observations.dtype:
            raise InputError(f"last_observations of the state has shape {last.shape} and type {last.dtype}")
        self._worlds.set_state(State(arrays, state.values))
        self._observations = last.copy()


class PotentialShaping(WrappedWorlds):
    """Adds ``gamma * phi(s') - phi(s)`` to the reward, which leaves a learner with that discount its optimal policy.

    ``phi(s')`` is 0 where the task is over and never zeroed where time is (Ng, Harada and Russell 1999; Grzes 2017).
    The share is ``info["reward_terms"]["potential"]``.

    Args:
        env: The worlds, with autoreset in the same step.
        potential: Of each observation, shape ``(n,)`` for observations of shape ``(n, ...)``.
        gamma: The learner's discount per step.
    """

    def __init__(
        self, env: VectorEnv[Any, Any, Any], potential: Callable[[AnyArray], FloatArray], gamma: float
    ) -> None:
        super().__init__(env)
        self._potential, self._gamma = potential, gamma

    def step(self, actions: AnyArray) -> Step:
        """Step; the potential of where the episodes were led counts, not that of where the next ones begin."""
        before = self._potential(self._observations)
        observations, rewards, terminated, truncated, info = self.env.step(actions)
        ended = terminated | truncated
        led_to, final = observations, info.get("final_info", info)
        if ended.any():
            led_to = observations.copy()
            led_to[ended] = np.stack(info["final_obs"][ended])
        # Where the physics failed the episode is over, but not the task.
        is_over = terminated & ~np.asarray(final.get("physics_error", False))
        shares = self._gamma * np.where(is_over, 0.0, self._potential(led_to)) - before
        final["reward_terms"]["potential"] = shares
        info["reward_terms"]["potential"] = np.where(ended & (final is not info), 0.0, shares)
        self._observations = observations.copy()
        return observations, rewards + shares, terminated, truncated, info


class Corrected(WrappedWorlds):
    """Actions are corrections, a share of which is added to the commands of somebody who drives by observations.

    Args:
        env: The worlds.
        commands: For observations of shape ``(n, ...)``, shape ``(n, 2)``.
        share: Of a correction that is added.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any], commands: Callable[[AnyArray], AnyArray], share: float) -> None:
        super().__init__(env)
        self._commands, self._share = commands, share

    def step(self, actions: AnyArray) -> Step:
        """Step with the corrected commands, clipped to the action space."""
        corrected = np.clip(self._commands(self._observations) + self._share * actions, -1.0, 1.0)
        observations, rewards, terminated, truncated, info = self.env.step(corrected.astype(np.float32))
        self._observations = observations.copy()
        return observations, rewards, terminated, truncated, info
