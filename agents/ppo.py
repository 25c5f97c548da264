"""PPO: a thin adapter to stable-baselines3.

The algorithm is theirs (Schulman et al. 2017; https://stable-baselines3.readthedocs.io). Ours are the adapter from a
Gymnasium vector environment to their ``VecEnv``, the preset, the stopping rule, and files that never run code.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
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
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.vec_env import VecEnv
from torch.distributions import Normal, kl_divergence

from gridnav.problem.types import InputError, State

from .base import Agent, EpisodeWindow, FrameStack, OnCut, OnProgress, Policy, Progress, check_finite, reached
from .hyper_parameters import check_numbers
from .torch_state import guard_gradients, load_optimizer_arrays, optimizer_arrays

POSE = (27, 28, 29, 30)
"""Where the robots' feature vector holds position and heading in the maze."""
LONGEST_STACK = 32
"""Observations that a network can see."""
INPUTS = ("features_extractor.seen", "features_extractor.is_length")
"""Ends of the names of what says how inputs are looked at."""
ACTOR = ("mlp_extractor.policy_net", "action_net", "log_std")
"""Beginnings of the names of the parameters that decide on actions; the value network has layers of its own."""


@dataclass(frozen=True)
class PPOConfig:
    """Hyper-parameters; the defaults solve DiffDrive on ``classic``.

    Environments, rollout, batch, epochs and network were chosen by measurement, see docs/speed.md.
    """

    seed: int = 0
    """Of weights, exploration and batches."""
    steps: int = 480_000
    """Environment steps of a training of the usual length."""
    num_envs: int = 256
    """Environments stepped together."""
    n_steps: int = 16
    """Steps of each environment per rollout."""
    batch_size: int = 512
    """Transitions per gradient step."""
    n_epochs: int = 6
    """Passes over a rollout."""
    learning_rate: float = 3e-3
    """Adam's step size at the beginning."""
    learning_rate_power: float = 2.0
    """Over the planned steps the step size falls by this power of a line from 1 to a tenth: by 2 to a hundredth. Larger
    late steps make a policy that touches walls of one that does not, and back; smaller ones learn no large task."""
    gamma: float = 0.99
    """Discount per control period."""
    gae_lambda: float = 0.95
    """Decay of the generalised advantage estimate."""
    ent_coef: float = 0.0
    """Weight of the entropy bonus."""
    initial_forward: float = 0.5
    """Mean of the untrained policy's first command, the forward speed. Robots may drive backwards as well, and a policy
    that learns both for one place stands still between them."""
    log_std_init: float = -0.5
    """Logarithm of the policy's first standard deviation, as fraction of full speed."""
    log_std_final: float = -2.0
    """In the second half of the planned steps its upper bound falls linearly to this, so that what is trained is what
    acts greedily."""
    hidden: tuple[int, ...] = (128, 128)
    """Units of the hidden layers (tanh) of policy and value network."""
    ignored: tuple[int, ...] = ()
    """Numbers of the observation that the networks never see, such as ``POSE``, lest they learn a maze by heart."""
    stack_size: int = 1
    """Observations that the networks see, the last ones. Where commands take effect late and scans arrive late, one
    observation does not say what the robot is about to do."""
    reward_scale: float = 1.0
    """Factor on the rewards the learner sees: it keeps the value network's gradient from crowding out the policy's."""
    exploring_starts: float = 0.3
    """Share of the training episodes that begin anywhere, half of them at the nearest wall, and not where the task
    says: a policy that explores less and less gets to know fewer and fewer ways to be stuck, and none out of them."""
    critic_only_steps: int = 0
    """Environment steps at the beginning in which the value network alone learns: a policy that comes from elsewhere
    would be spoilt by the advantages of one that knows nothing of it."""
    teacher_weight: float = 1.0
    """Weight of the divergence from the teacher, where there is one, at the beginning (Schmitt et al. 2018)."""
    teacher_share: float = 0.25
    """Share of the planned steps over which that weight falls linearly to 0."""
    target_success: float | None = None
    """Training stops once this share of the last 400 episodes arrived; never before its steps are used up if none."""

    n_validations: int = 6
    """Policies of the last quarter of a training that are compared; the best one is kept. The greedy policies of one
    training differ from rollout to rollout: seed 19 had 100, 85 and 93 % success within 100 000 steps."""
    validation_episodes: int = 128
    """Episodes of each comparison."""

    def __post_init__(self) -> None:
        check_numbers(self)
        if not all(isinstance(units, int) and units >= 1 for units in self.hidden):
            raise InputError(f"hidden {self.hidden!r:.60} of PPOConfig must be whole numbers of at least 1")
        if not all(isinstance(number, int) and number >= 0 for number in self.ignored):
            raise InputError(f"ignored {self.ignored!r:.60} of PPOConfig must be whole numbers of at least 0")
        if not 1 <= self.stack_size <= LONGEST_STACK:
            raise InputError(f"stack_size {self.stack_size} of PPOConfig is outside 1 to {LONGEST_STACK}")
        if self.batch_size < 2 or self.num_envs * self.n_steps < 2:  # advantages are normalised over a batch
            raise InputError(f"batch_size {self.batch_size} of PPOConfig must be at least 2, and so must a rollout")


PPO_PRESETS: dict[str, PPOConfig] = {
    "default": PPOConfig(),
    # A policy that has learnt explores little: the step size of a beginner would throw it far off.
    "warm": PPOConfig(learning_rate=5e-4),
    "any": PPOConfig(
        steps=2_700_000, learning_rate_power=1.0, hidden=(64, 64), log_std_final=-3.0, validation_episodes=256
    ),
    "layouts": PPOConfig(steps=1_500_000, hidden=(64, 64), ignored=POSE),
    # Twice the default's steps: a world that varies has more to learn.
    "randomized": PPOConfig(steps=960_000, stack_size=3),
}
"""By what they were made for: DiffDrive on ``classic``, the same with a network that learnt elsewhere, any start to
any goal, layouts never seen in training, where no pose is worth knowing, and robots that vary; docs/ppo.md has what
each reached."""


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
        if config.ignored and max(config.ignored) >= observation_space.shape[0]:
            raise InputError(
                f"ignored {max(config.ignored)} must be below {observation_space.shape[0]}, the observation's length"
            )
        self.config = config
        self.teacher: PPOAgent | None = None
        """Whose policy it is drawn to while it learns, if anybody's; no part of its state."""
        self.observation_space, self.action_space = observation_space, action_space
        # Two threads on these small networks are slower than one, and the thread count is part of the seed.
        torch.set_num_threads(1)
        torch.manual_seed(config.seed)
        self.policy = ActorCriticPolicy(
            _stacked(observation_space, config.stack_size),
            action_space,
            lr_schedule=lambda _: config.learning_rate,
            **_policy_options(config, observation_space),
        )
        with torch.no_grad():
            self.policy.get_parameter("action_net.bias")[0] = config.initial_forward

    def act(self, observations: NDArray[Any]) -> NDArray[Any]:
        """The policy's mean commands, clipped to the action space.

        Args:
            observations: The last one of each robot, as if it had always been there, or all that is stacked.
        """
        return self.policy.predict(self._stack(observations), deterministic=True)[0]

    def begin(self) -> Policy:
        """The same with a memory of the observations before."""
        if self.config.stack_size == 1:
            return self.act
        stack = FrameStack(self.config.stack_size)

        def act(observations: NDArray[Any]) -> NDArray[Any]:
            return self.act(stack.push(observations) if len(stack.frames) else stack.begin(observations))

        return act

    def values(self, observations: NDArray[Any]) -> NDArray[Any]:
        """What the value network expects, in the reward's own unit, shape ``(n,)``; see ``act`` for observations."""
        with torch.no_grad():
            values = self.policy.predict_values(torch.as_tensor(self._stack(observations))).numpy().ravel()
        return values / self.config.reward_scale

    def _stack(self, observations: NDArray[Any]) -> NDArray[Any]:
        size = self.config.stack_size
        is_one = size > 1 and observations.shape[1] == self.observation_space.shape[0]
        return FrameStack(size).begin(observations) if is_one else observations

    def take_weights(self, source: PPOAgent) -> None:
        """Begin with the networks of another agent; where this one sees more observations, those count for nothing yet.

        Raises:
            InputError: When the networks are of another size.
        """
        theirs = source.policy.state_dict()
        own = self.policy.state_dict()
        for name, weights in own.items():
            given = theirs.get(name, torch.empty(0))
            if given.shape == weights.shape:
                own[name] = given.clone()
            elif name.endswith(INPUTS):
                continue  # what the inputs are is said by the space
            elif given.dim() == 2 and len(given) == len(weights) and given.shape[1] < weights.shape[1]:
                own[name] = torch.nn.functional.pad(given, (0, weights.shape[1] - given.shape[1]))
            else:
                raise InputError(f"{name} of shape {tuple(given.shape)} cannot be carried to {tuple(weights.shape)}")
        self.policy.load_state_dict(own)

    @property
    def planned_steps(self) -> int:
        """Environment steps of a training of the usual length."""
        return self.config.steps

    def learn(
        self,
        env: VectorEnv[Any, Any, Any],
        *,
        steps: int,
        on_progress: OnProgress | None = None,
        on_cut: OnCut | None = None,
        resume: State | None = None,
    ) -> None:
        """Improve the policy, from the weights it has; see ``Agent.learn``."""
        config = self.config
        adapter = Sb3VecEnv(env, config.reward_scale, config.stack_size)
        model = PPO(
            TaughtPolicy if self.teacher else ActorCriticPolicy,
            adapter,
            seed=config.seed,
            n_steps=config.n_steps,
            batch_size=config.batch_size,
            n_epochs=config.n_epochs,
            # `left` is the share of the planned steps that is to come, below 0 where the last rollout goes beyond.
            learning_rate=lambda left: config.learning_rate * (0.1 + 0.9 * max(left, 0)) ** config.learning_rate_power,
            gamma=config.gamma,
            gae_lambda=config.gae_lambda,
            ent_coef=1.0 if self.teacher else config.ent_coef,
            # Adam in one call for all weights; the epsilon is stable-baselines3's own.
            policy_kwargs={
                **_policy_options(config, self.observation_space),
                "optimizer_kwargs": {"eps": 1e-5, "fused": True},
            },
            device="cpu",
        )
        model.policy.load_state_dict(self.policy.state_dict())
        self.policy = model.policy  # what is learnt before an interrupt counts too
        if isinstance(self.policy, TaughtPolicy) and self.teacher is not None:
            self.policy.teach, self.policy.entropy_weight = partial(gaussian, self.teacher.policy), config.ent_coef
        model.set_logger(Logger(folder=None, output_formats=[]))
        guard_gradients(model.policy.optimizer, lambda: model.num_timesteps)
        between = _BetweenRollouts(adapter, steps, config, on_progress, on_cut)
        if resume is None:
            model.learn(steps, callback=between)
        else:
            _go_on(model, adapter, resume)
            model.learn(steps - model.num_timesteps, callback=between, reset_num_timesteps=False)

    def state(self) -> State:
        """Weights; spaces and hyper-parameters."""
        arrays = {name: tensor.numpy().copy() for name, tensor in self.policy.state_dict().items()}
        spaces = {"observation_space": self.observation_space, "action_space": self.action_space}
        bounds = {name: {"low": space.low.tolist(), "high": space.high.tolist()} for name, space in spaces.items()}
        return State(arrays, {"config": asdict(self.config), **bounds})

    @classmethod
    def from_state(cls, state: State) -> Self:
        """An agent with these weights.

        Raises:
            ValueError: When a weight is not finite.
        """
        arrays, values = state
        observation_space, action_space = (
            Box(np.array(values[name]["low"], np.float32), np.array(values[name]["high"], np.float32))
            for name in ("observation_space", "action_space")
        )
        tuples = {name: tuple(values["config"][name]) for name in ("hidden", "ignored")}
        config = PPOConfig(**{**values["config"], **tuples})
        agent = cls(observation_space, action_space, config)
        if not all(np.isfinite(array).all() for array in arrays.values()):
            raise ValueError("the weights must be finite numbers")
        agent.policy.load_state_dict({name: torch.from_numpy(array.copy()) for name, array in arrays.items()})
        return agent


def _stacked(space: Box, size: int) -> Box:
    """Bounds of so many observations."""
    return space if size == 1 else Box(np.tile(space.low, size), np.tile(space.high, size), dtype=np.float32)


def _policy_options(config: PPOConfig, space: Box) -> dict[str, Any]:
    ignored = [number + place * space.shape[0] for place in range(config.stack_size) for number in config.ignored]
    return {
        "net_arch": list(config.hidden),
        "log_std_init": config.log_std_init,
        "features_extractor_class": Inputs,
        "features_extractor_kwargs": {"ignored": ignored},
    }


def gaussian(policy: ActorCriticPolicy, observations: PyTorchObs) -> Normal:
    """A policy's actions for observations, each number on its own, shape ``(n, n_actions)``."""
    distribution = policy.get_distribution(observations).distribution
    assert isinstance(distribution, Normal)
    return distribution


class TaughtPolicy(ActorCriticPolicy):
    """A policy that is drawn to a teacher's while it learns: kickstarting (Schmitt et al. 2018, arXiv 1803.03835).

    Stable-baselines3 adds what ``evaluate_actions`` calls entropy to the objective, with a weight that is 1 here: so it
    is the entropy with its own weight, less the divergence from the teacher with the teacher's.
    """

    teach: Callable[[PyTorchObs], Normal]
    """The teacher's actions for observations."""
    teacher_weight = 0.0
    """Of the divergence, now."""
    entropy_weight = 0.0

    def evaluate_actions(
        self, obs: PyTorchObs, actions: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Values, log-probabilities of the actions, and what is added to the objective, shape ``(n, ...)`` each."""
        values, log_prob, entropy = super().evaluate_actions(obs, actions)
        assert entropy is not None
        bonus = self.entropy_weight * entropy
        if self.teacher_weight > 0.0:
            with torch.no_grad():
                teacher = self.teach(obs)
            divergence = kl_divergence(gaussian(self, obs), teacher).sum(dim=1)
            bonus = bonus - self.teacher_weight * divergence
        return values, log_prob, bonus


class Inputs(BaseFeaturesExtractor):
    """What the networks make of an observation before their first layer.

    Numbers that cannot be negative are lengths, and near things matter more than far ones: x becomes x / (x + NEAR),
    so that a centimetre beside a wall counts ten times one in the open. Ignored numbers become 0.
    """

    NEAR = 1 / 7
    """As a fraction of the lidar's range (3.5 m): half a metre."""

    seen: torch.Tensor
    is_length: torch.Tensor

    def __init__(self, observation_space: Box, ignored: Sequence[int] = ()) -> None:
        super().__init__(observation_space, features_dim=int(np.prod(observation_space.shape)))
        seen = torch.ones(self.features_dim)
        seen[list(ignored)] = 0.0
        self.register_buffer("seen", seen)
        self.register_buffer("is_length", torch.from_numpy(observation_space.low.ravel() == 0.0))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Inputs of the first layer, shape ``(n, n_numbers)``."""
        near = observations / (observations.abs() + self.NEAR)
        return torch.where(self.is_length, near, observations) * self.seen


def _state_of(model: PPO, adapter: Sb3VecEnv) -> State:
    """Everything that decides what comes next, beside the weights and the environment.

    Stable-baselines3 draws actions from torch's global stream and batches from NumPy's.
    """
    _, keys, position, has_gauss, gauss = np.random.get_state(legacy=True)  # noqa: NPY002
    assert isinstance(model._last_obs, np.ndarray)  # all that is stacked
    assert model._last_episode_starts is not None
    arrays = optimizer_arrays(model.policy.optimizer) | {
        "last_observations": model._last_obs.copy(),
        "last_episode_starts": model._last_episode_starts.copy(),
        "torch_stream": torch.get_rng_state().numpy().copy(),
        "numpy_stream": np.asarray(keys).copy(),
    }
    values = {
        "num_timesteps": model.num_timesteps,
        "n_updates": model._n_updates,
        "numpy_stream": [int(position), int(has_gauss), float(gauss)],
        "window": adapter.window.state(),
        "log": {name: float(value) for name, value in model.logger.name_to_value.items() if name in _REPORTED},
    }
    return State(arrays, values)


def _go_on(model: PPO, adapter: Sb3VecEnv, state: State) -> None:
    """Bring a model that was made alike to where ``_state_of`` looked; the streams last, for making a model draws."""
    arrays, values = state
    load_optimizer_arrays(model.policy.optimizer, arrays)
    model.num_timesteps, model._n_updates = values["num_timesteps"], values["n_updates"]
    adapter.window, adapter.steps = EpisodeWindow.from_state(values["window"]), values["num_timesteps"]
    model._last_obs, model._last_episode_starts = arrays["last_observations"], arrays["last_episode_starts"]
    adapter.remember(arrays["last_observations"])
    for name, value in values["log"].items():
        model.logger.record(name, value)
    torch.set_rng_state(torch.from_numpy(arrays["torch_stream"].copy()))
    np.random.set_state(("MT19937", arrays["numpy_stream"], *values["numpy_stream"]))  # noqa: NPY002


class Sb3VecEnv(VecEnv):
    """A Gymnasium vector environment with same-step autoreset, as stable-baselines3 wants to see it.

    Only environments whose episode ended get an info of their own: the others share one empty dictionary, which saves
    building ``num_envs`` dictionaries a step.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any], reward_scale: float = 1.0, stack_size: int = 1) -> None:
        self.env = env
        self._stack = FrameStack(stack_size)
        self._reward_scale = reward_scale
        self.window = EpisodeWindow()
        self.steps = 0
        assert isinstance(env.single_observation_space, Box)
        super().__init__(env.num_envs, _stacked(env.single_observation_space, stack_size), env.single_action_space)

    def remember(self, seen: NDArray[Any]) -> None:
        """Go on with what was seen last, shape ``(n, stack_size * n_numbers)``."""
        self._stack.frames = seen.reshape(len(seen), self._stack.size, -1).copy()

    def reset(self) -> NDArray[Any]:
        """Start all episodes, with the seed that ``seed`` was given."""
        observations, _ = self.env.reset(seed=self._seeds[0])
        check_finite(self.steps, observation=observations)
        self._reset_seeds()
        return self._stack.begin(observations)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Keep the actions until ``step_wait``."""
        self._actions = actions

    def step_wait(self) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], list[dict[str, Any]]]:
        """Step; the observation that ended an episode goes to ``terminal_observation``."""
        observations, rewards, terminated, truncated, info = self.env.step(self._actions)
        self.window.add(info)
        self.steps += self.num_envs
        with np.errstate(over="ignore"):  # the next line says so, and where
            scaled = (self._reward_scale * rewards).astype(np.float32)
        check_finite(self.steps, reward=scaled, observation=reached(observations, info), first_observation=observations)
        dones = terminated | truncated
        infos: list[dict[str, Any]] = [_NOTHING] * self.num_envs
        for i in np.flatnonzero(dones):
            before = self._stack.frames[i, :-1].ravel()
            infos[i] = {
                "terminal_observation": np.concatenate([info["final_obs"][i], before]),
                # A time limit is no end of the task: PPO bootstraps there.
                "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
            }
        return self._stack.push(observations, dones), scaled, dones, infos

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


_REPORTED = ("train/approx_kl", "train/explained_variance", "train/learning_rate", "train/std", "train/value_loss")
"""What stable-baselines3 logs of an update that goes into the metrics."""


class _BetweenRollouts(BaseCallback):
    """Reports, narrows exploration, lets training be cut, and stops at the success that is asked for."""

    def __init__(
        self,
        adapter: Sb3VecEnv,
        total_steps: int,
        config: PPOConfig,
        on_progress: OnProgress | None,
        on_cut: OnCut | None,
    ) -> None:
        super().__init__()
        self._adapter, self._total_steps, self._config = adapter, total_steps, config
        self._on_progress, self._on_cut = on_progress, on_cut

    def _on_training_start(self) -> None:
        self._reported = self.model.num_timesteps  # nothing yet, or what was reported before the cut

    def _on_step(self) -> bool:
        target, window = self._config.target_success, self._adapter.window
        return target is None or not window.is_full or window.metrics["success_rate"] < target

    def _on_rollout_start(self) -> None:
        self._cap_exploration()
        self._weigh_the_teacher()
        self._hold_the_actor()
        self._report()
        if self._on_cut is not None:
            assert isinstance(self.model, PPO)
            model = self.model
            self._on_cut(lambda: _state_of(model, self._adapter))

    def _cap_exploration(self) -> None:
        first, last = self._config.log_std_init, self._config.log_std_final
        share = min(1.0, max(0.0, 2.0 * self.model.num_timesteps / self._total_steps - 1.0))
        cap = first + (last - first) * share
        log_std = self.model.policy.log_std
        assert isinstance(log_std, torch.Tensor)
        with torch.no_grad():
            log_std.clamp_(max=cap)

    def _weigh_the_teacher(self) -> None:
        policy, config = self.model.policy, self._config
        if isinstance(policy, TaughtPolicy):
            share = self.model.num_timesteps / max(1.0, config.teacher_share * self._total_steps)
            policy.teacher_weight = config.teacher_weight * max(0.0, 1.0 - share)

    def _hold_the_actor(self) -> None:
        if not self._config.critic_only_steps:
            return
        policy = self.model.policy
        assert isinstance(policy, ActorCriticPolicy)
        learns = self.model.num_timesteps >= self._config.critic_only_steps
        for name, parameter in policy.named_parameters():
            if name.startswith(ACTOR):
                parameter.requires_grad_(learns)

    def _report(self) -> None:
        steps, values = self.model.num_timesteps, self.logger.name_to_value
        if self._on_progress is None or steps == self._reported:
            return
        self._reported = steps
        train = {name.split("/")[1]: float(values[name]) for name in _REPORTED if name in values}
        self._on_progress(Progress(steps, self._total_steps, self._adapter.window.metrics | train))

    def _on_training_end(self) -> None:
        self._report()
