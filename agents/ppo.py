"""PPO: a thin adapter to stable-baselines3.

The algorithm is theirs (Schulman et al. 2017; https://stable-baselines3.readthedocs.io). Ours are the adapter from a
Gymnasium vector environment to their ``VecEnv``, the preset, the stopping rule, and files that never run code.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Self

import gymnasium as gym
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv

from .base import Agent, EpisodeWindow, OnProgress, Progress


@dataclass(frozen=True)
class PPOConfig:
    """Hyper-parameters; the defaults solve DiffDrive on ``classic``.

    Environments, rollout, batch, epochs and network were chosen by measurement, see docs/speed.md.
    """

    seed: int = 0
    """Of weights, exploration and batches."""
    num_envs: int = 256
    """Environments stepped together."""
    n_steps: int = 16
    """Steps of each environment per rollout."""
    batch_size: int = 512
    """Transitions per gradient step."""
    n_epochs: int = 6
    """Passes over a rollout."""
    learning_rate: float = 1e-3
    """Adam's step size at the beginning; it falls linearly to a tenth over the planned steps."""
    gamma: float = 0.99
    """Discount per control period."""
    gae_lambda: float = 0.95
    """Decay of the generalised advantage estimate."""
    ent_coef: float = 0.0
    """Weight of the entropy bonus."""
    log_std_init: float = -0.5
    """Logarithm of the policy's first standard deviation, as fraction of full speed."""
    log_std_final: float = -1.5
    """In the second half of the planned steps its upper bound falls linearly to this, so that what is trained is what
    acts greedily."""
    hidden: tuple[int, ...] = (64, 64)
    """Units of the hidden layers (tanh) of policy and value network."""
    reward_scale: float = 1.0
    """Factor on the rewards the learner sees: it keeps the value network's gradient from crowding out the policy's."""
    target_success: float | None = None
    """Training stops once this share of the last 400 episodes arrived; never before its steps are used up if none."""


class PPOAgent(Agent):
    """A Gaussian policy over continuous commands.

    Args:
        observation_space: A ``Box``.
        action_space: A ``Box``.
        config: Hyper-parameters.
    """

    kind = "ppo"

    def __init__(self, observation_space: gym.Space[Any], action_space: gym.Space[Any], config: PPOConfig) -> None:
        if not isinstance(observation_space, Box) or not isinstance(action_space, Box):
            raise ValueError("PPO here needs Box spaces: take gridnav/Unicycle-v0 or gridnav/DiffDrive-v0")
        self.config = config
        self._observation_space, self._action_space = observation_space, action_space
        # Two threads on these small networks are slower than one, and the thread count is part of the seed.
        torch.set_num_threads(1)
        torch.manual_seed(config.seed)
        self.policy = ActorCriticPolicy(
            observation_space,
            action_space,
            lr_schedule=lambda _: config.learning_rate,
            net_arch=list(config.hidden),
            log_std_init=config.log_std_init,
        )

    def act(self, observations: NDArray[Any]) -> NDArray[Any]:
        """The policy's mean commands, clipped to the action space."""
        return self.policy.predict(observations, deterministic=True)[0]

    def learn(self, env: VectorEnv[Any, Any, Any], *, steps: int, on_progress: OnProgress | None = None) -> None:
        """Improve the policy, from the weights it has."""
        config = self.config
        adapter = Sb3VecEnv(env, config.reward_scale)
        model = PPO(
            "MlpPolicy",
            adapter,
            seed=config.seed,
            n_steps=config.n_steps,
            batch_size=config.batch_size,
            n_epochs=config.n_epochs,
            learning_rate=LinearSchedule(config.learning_rate, config.learning_rate / 10, 1.0),
            gamma=config.gamma,
            gae_lambda=config.gae_lambda,
            ent_coef=config.ent_coef,
            policy_kwargs={
                "net_arch": list(config.hidden),
                "log_std_init": config.log_std_init,
                # Adam in one call for all weights; the epsilon is stable-baselines3's own.
                "optimizer_kwargs": {"eps": 1e-5, "fused": True},
            },
            device="cpu",
        )
        model.policy.load_state_dict(self.policy.state_dict())
        model.set_logger(Logger(folder=None, output_formats=[]))
        try:
            model.learn(steps, callback=_Reporter(adapter, steps, config, on_progress))
        finally:
            # What was learnt before an interrupt counts too.
            self.policy.load_state_dict(model.policy.state_dict())

    def state(self) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Weights; spaces and hyper-parameters."""
        arrays = {name: tensor.numpy() for name, tensor in self.policy.state_dict().items()}
        spaces = {"observation_space": self._observation_space, "action_space": self._action_space}
        return arrays, {
            "config": asdict(self.config),
            **{name: {"low": space.low.tolist(), "high": space.high.tolist()} for name, space in spaces.items()},
        }

    @classmethod
    def from_state(cls, arrays: dict[str, NDArray[Any]], values: dict[str, Any]) -> Self:
        """An agent with these weights."""
        observation_space, action_space = (
            Box(np.array(values[name]["low"], np.float32), np.array(values[name]["high"], np.float32))
            for name in ("observation_space", "action_space")
        )
        config = PPOConfig(**{**values["config"], "hidden": tuple(values["config"]["hidden"])})
        agent = cls(observation_space, action_space, config)
        agent.policy.load_state_dict({name: torch.from_numpy(array.copy()) for name, array in arrays.items()})
        return agent


class Sb3VecEnv(VecEnv):
    """A Gymnasium vector environment with same-step autoreset, as stable-baselines3 wants to see it.

    Only environments whose episode ended get an info of their own: the others share one empty dictionary, which saves
    building ``num_envs`` dictionaries a step.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any], reward_scale: float = 1.0) -> None:
        self.env = env
        self._reward_scale = reward_scale
        self.window = EpisodeWindow()
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> NDArray[Any]:
        """Start all episodes, with the seed that ``seed`` was given."""
        observations, _ = self.env.reset(seed=self._seeds[0])
        self._reset_seeds()
        return observations

    def step_async(self, actions: NDArray[Any]) -> None:
        """Keep the actions until ``step_wait``."""
        self._actions = actions

    def step_wait(self) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], list[dict[str, Any]]]:
        """Step; the observation that ended an episode goes to ``terminal_observation``."""
        observations, rewards, terminated, truncated, info = self.env.step(self._actions)
        self.window.add(info)
        dones = terminated | truncated
        infos: list[dict[str, Any]] = [_NOTHING] * self.num_envs
        for i in np.flatnonzero(dones):
            infos[i] = {
                "terminal_observation": info["final_obs"][i],
                # A time limit is no end of the task: PPO bootstraps there.
                "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
            }
        return observations, (self._reward_scale * rewards).astype(np.float32), dones, infos

    def close(self) -> None:
        """Leave the environment open: who made it closes it."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The vector environment's attribute, once per environment."""
        return [getattr(self.env, attr_name)] * len(self._indices(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Not offered: the environments of a batch share their attributes."""
        raise NotImplementedError("the environments of a batch share their attributes")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Not offered: the environments of a batch have no methods of their own."""
        raise NotImplementedError("the environments of a batch have no methods of their own")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """No environment of a batch is wrapped."""
        return [False] * len(self._indices(indices))

    def _indices(self, indices: int | Sequence[int] | None) -> list[int]:
        return list(self._get_indices(indices))


_NOTHING: dict[str, Any] = {}


class _Reporter(BaseCallback):
    """Between rollouts: reports, narrows exploration, and stops at the success that is asked for."""

    def __init__(self, adapter: Sb3VecEnv, total_steps: int, config: PPOConfig, on_progress: OnProgress | None) -> None:
        super().__init__()
        self._window = adapter.window
        self._total_steps, self._config, self._on_progress = total_steps, config, on_progress

    def _on_step(self) -> bool:
        target = self._config.target_success
        if target is None or not self._window.is_full:
            return True
        return self._window.metrics["success_rate"] < target

    def _on_rollout_start(self) -> None:
        self._cap_exploration()
        self._report()

    def _cap_exploration(self) -> None:
        first, last = self._config.log_std_init, self._config.log_std_final
        share = min(1.0, max(0.0, 2.0 * self.num_timesteps / self._total_steps - 1.0))
        cap = first + (last - first) * share
        log_std = self.model.policy.log_std
        assert isinstance(log_std, torch.Tensor)
        with torch.no_grad():
            log_std.clamp_(max=cap)

    def _report(self) -> None:
        if self._on_progress is None or self.num_timesteps == 0:
            return
        values = self.logger.name_to_value
        metrics = self._window.metrics | {
            name.split("/")[1]: float(values[name])
            for name in ("train/approx_kl", "train/explained_variance", "train/std", "train/value_loss")
            if name in values
        }
        self._on_progress(Progress(self.num_timesteps, self._total_steps, metrics))

    def _on_training_end(self) -> None:
        self._report()
