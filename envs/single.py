"""The single form of every world: its vector form with a batch of one, without the batch axis."""

from __future__ import annotations

import inspect
from typing import Any, Generic, TypeVar

import gymnasium as gym

from gridnav.problem.layout import Layout
from gridnav.problem.reward import Reward
from gridnav.problem.task import Task
from gridnav.problem.types import AnyArray, State

from .navigation import NavigationVectorEnv, as_array
from .observation import FeatureVector

VectorWorld = TypeVar("VectorWorld", bound=NavigationVectorEnv)


class NavigationEnv(gym.Env[Any, Any], Generic[VectorWorld]):
    """One robot: the world's vector form with a batch of one, without its batch axis."""

    def __init__(self, world: VectorWorld) -> None:
        self.worlds = world
        """The vector form with a batch of one."""
        self.observation_space = world.single_observation_space
        self.action_space = world.single_action_space
        self.render_mode = world.render_mode

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode; see ``NavigationVectorEnv.reset``."""
        self.worlds._checked_options(options)  # before the seed changes anything
        super().reset(seed=seed)
        limit = _time_limit_around(self)
        if limit is not None:
            self.worlds.max_episode_steps = limit
        self.worlds.use_generators([self.np_random])
        observations, info = self.worlds.reset(options=options)
        if self.render_mode == "human":  # Gymnasium's convention: the window needs no call
            self.render()
        return _one(observations), _one_info(info)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Drive for one step; see ``NavigationVectorEnv.step``."""
        observations, rewards, terminated, truncated, info = self.worlds.step(as_array(action)[None])
        if self.render_mode == "human":
            self.render()
        return _one(observations), float(rewards[0]), bool(terminated[0]), bool(truncated[0]), _one_info(info)

    def get_state(self) -> State:
        """Everything that decides what comes next; see ``NavigationVectorEnv.get_state``."""
        return self.worlds.get_state()

    def set_state(self, state: State) -> None:
        """Go on where another environment was; see ``NavigationVectorEnv.set_state``."""
        self.worlds.set_state(state)
        self.np_random = self.worlds.generators[0]  # later resets draw from it

    def render(self) -> Any:
        """A picture of the world in the form of ``render_mode``."""
        pictures = self.worlds.render()
        return pictures[0] if pictures else None

    def close(self) -> None:
        """Release windows and graphics."""
        self.worlds.close()

    @property
    def features(self) -> FeatureVector:
        """Names, units and bounds of the shared feature vector."""
        return self.worlds.features

    @property
    def layout(self) -> Layout:
        """The maze of the current episode."""
        return self.worlds.layout

    @property
    def task(self) -> Task:
        """The task."""
        return self.worlds.task

    @property
    def reward(self) -> Reward:
        """The reward."""
        return self.worlds.reward


def _time_limit_around(env: gym.Env[Any, Any]) -> int | None:
    """The limit of Gymnasium's ``TimeLimit`` around an environment that is being reset, or none.

    ``gym.make`` keeps the limit to the wrapper and tells the environment nothing, but a reward may look at the last
    move. The wrapper is found where it stands: among the callers of ``reset``.
    """
    frame = inspect.currentframe()
    while frame is not None:
        caller = frame.f_locals.get("self")
        if isinstance(caller, gym.wrappers.TimeLimit) and caller.unwrapped is env:
            return caller._max_episode_steps
        frame = frame.f_back
    return None


def _one(observations: AnyArray) -> Any:
    # A Discrete observation is a plain integer, as Gymnasium's own environments return it.
    return observations[0] if observations.ndim > 1 else int(observations[0])


def _one_info(info: dict[str, Any]) -> dict[str, Any]:
    """The first environment's entries as Python values: numbers, a cell tuple, a pose array."""
    one: dict[str, Any] = {}
    for key, value in info.items():
        if key in ("reward_terms", "randomization"):
            one[key] = {name: share.item() for name, share in value.items()}
        elif key == "cell":
            one[key] = tuple(value[0].tolist())
        elif key == "pose":
            one[key] = value[0]  # of a fresh array
        elif not key.startswith("_"):
            one[key] = value.item()
    return one
