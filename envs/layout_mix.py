"""Robots in many layouts at once: several vector environments side by side as one, whose layouts change."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from gridnav.problem.layout import Layout
from gridnav.problem.types import AnyArray, BoolArray, FloatArray, InputError, State

from .navigation import NavigationVectorEnv

DrawLayout = Callable[[np.random.Generator], Layout]


class LayoutMix(VectorEnv[AnyArray, AnyArray, AnyArray]):
    """For training that is to work in layouts it never saw.

    The robots of one group share a layout. After ``renew_steps`` steps a group gets another one: its episodes are
    truncated, which learners do not take for an end, and the next ones start there. The groups take turns.

    Args:
        make: Makes a group: given a layout and a number of robots.
        num_envs: Robots in all, a multiple of ``n_groups``.
        draw: A layout from a generator; all of one size.
        n_groups: Layouts at one time.
        renew_steps: Steps that a group spends in a layout.
    """

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self,
        make: Callable[[Layout, int], NavigationVectorEnv],
        num_envs: int,
        draw: DrawLayout,
        *,
        n_groups: int = 32,
        renew_steps: int = 500,
    ) -> None:
        if num_envs % n_groups:
            raise InputError(f"num_envs {num_envs} must be a multiple of the {n_groups} layouts")
        self.num_envs, self._draw, self._renew_steps = num_envs, draw, renew_steps
        self._layout_rng = np.random.default_rng(0)
        self._size = num_envs // n_groups
        self.groups = [make(draw(self._layout_rng), self._size) for _ in range(n_groups)]
        self._age = np.zeros(n_groups, dtype=np.int64)
        first = self.groups[0]
        # One group's robots end too few episodes for a decision.
        for group in self.groups[1:]:
            group.follow_curriculum(first)
        self.single_observation_space, self.single_action_space = (
            first.single_observation_space,
            first.single_action_space,
        )
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[AnyArray, dict[str, Any]]:
        """Start an episode in every environment, with layouts drawn anew where a seed is given."""
        seeds: list[Any] = [None] * len(self.groups)
        if seed is not None:
            own, *children = np.random.SeedSequence(seed).spawn(1 + len(self.groups))
            self._layout_rng = np.random.default_rng(own)
            seeds = [int(child.generate_state(1, np.uint64)[0]) for child in children]
        # The first layouts are left at different times, so that every step's work is about the same.
        self._age = np.arange(len(self.groups)) * self._renew_steps // len(self.groups)
        parts = [group.reset(seed=s, options=self._new_layout()) for group, s in zip(self.groups, seeds, strict=True)]
        observations, infos = zip(*parts, strict=True)
        return np.concatenate(observations), _joined(infos)

    def step(self, actions: AnyArray) -> tuple[AnyArray, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Step every group, and move those whose time has come to another layout."""
        parts = [
            group.step(part)
            for group, part in zip(self.groups, np.split(np.asarray(actions), len(self.groups)), strict=True)
        ]
        self._age += 1
        for i in np.flatnonzero(self._age >= self._renew_steps).tolist():
            parts[i] = self._moved(i, *parts[i])
        observations, rewards, terminated, truncated, infos = zip(*parts, strict=True)
        flags = np.concatenate(terminated), np.concatenate(truncated)
        return np.concatenate(observations), np.concatenate(rewards), *flags, _joined(infos)

    @property
    def curriculum_strength(self) -> float | None:
        """See ``NavigationVectorEnv.curriculum_strength``; all groups have the same one."""
        return self.groups[0].curriculum_strength

    def _new_layout(self) -> dict[str, Any]:
        return {"layout": self._draw(self._layout_rng)}

    def _moved(
        self,
        i: int,
        observations: AnyArray,
        rewards: FloatArray,
        terminated: BoolArray,
        truncated: BoolArray,
        info: dict[str, Any],
    ) -> tuple[AnyArray, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """A group's step whose episodes were all cut short, and the first observations in its next layout."""
        group, self._age[i] = self.groups[i], 0
        final_obs = info.get("final_obs", np.empty(self._size, dtype=object))
        for k in np.flatnonzero(~(terminated | truncated)):
            final_obs[k] = observations[k].copy()
        # Only episodes that ended by themselves count: those that were cut are no failures.
        mask = info.get("_final_info", np.zeros(self._size, dtype=bool))
        final_info = info.get("final_info", info)
        first, first_info = group.reset(options=self._new_layout())
        first_info |= {"final_obs": final_obs, "_final_obs": np.ones(self._size, dtype=bool)}
        first_info |= {"final_info": final_info, "_final_info": mask}
        return first, rewards, terminated, truncated | ~terminated, first_info

    def get_state(self) -> State:
        """Everything that decides what comes next."""
        arrays, values = {"age": self._age.copy()}, []
        for i, group in enumerate(self.groups):
            state = group.get_state()
            arrays |= {f"{i}.{name}": array for name, array in state.arrays.items()}
            values.append(state.values)
        return State(arrays, {"groups": values, "layouts": self._layout_rng.bit_generator.state})

    def set_state(self, state: State) -> None:
        """Go on where an environment that was made alike was.

        Raises:
            InputError: When the state is that of another kind or number of environments.
        """
        if len(state.values.get("groups", ())) != len(self.groups):
            raise InputError(f"the state is not that of {len(self.groups)} groups of environments")
        self._age[:] = state.arrays["age"]
        self._layout_rng.bit_generator.state = state.values["layouts"]
        for i, (group, values) in enumerate(zip(self.groups, state.values["groups"], strict=True)):
            own = {name.removeprefix(f"{i}."): a for name, a in state.arrays.items() if name.startswith(f"{i}.")}
            group.set_state(State(own, values))

    def close_extras(self, **kwargs: Any) -> None:
        """Release what the groups hold."""
        for group in self.groups:
            group.close()


def _joined(infos: tuple[dict[str, Any], ...]) -> dict[str, Any]:
    """The groups' infos as one; what only some have is filled, and marked as Gymnasium does."""
    joined: dict[str, Any] = {}
    for key in dict.fromkeys(key for info in infos for key in info):
        if key == "final_info":
            joined[key] = _joined(tuple(info.get(key, info) for info in infos))
        elif key in ("reward_terms", "randomization"):
            joined[key] = {name: np.concatenate([info[key][name] for info in infos]) for name in infos[0][key]}
        else:
            n = len(infos[0]["pose"])
            joined[key] = np.concatenate([info.get(key, _nothing(key, n)) for info in infos])
    return joined


def _nothing(key: str, n: int) -> AnyArray:
    return np.empty(n, dtype=object) if key == "final_obs" else np.zeros(n, dtype=bool)
