"""Deep Q-learning, in one file read top to bottom: presets, network, replay buffer, update, agent.

The algorithm is that of Mnih et al. (2015, doi:10.1038/nature14236), with double targets (van Hasselt, Guez and Silver
2016), a dueling network (Wang et al. 2016) and n-step returns (Hessel et al. 2018) as switches. Deviations:

- Mnih: many environments are stepped together, and ``updates_per_step`` updates follow each vector step. Adam instead
  of RMSProp, the gradient's norm is bounded and not each error, no frames, no convolutions, no reward clipping.
- Van Hasselt: none in the target; the schedules are ours.
- Wang: each stream is one linear layer on a shared body, and the gradient that enters the body is not rescaled.
- Hessel: n-step returns alone, uncorrected for exploration as theirs are. They are formed when a batch is drawn: a
  return ends with its episode, and near the newest transition it is shorter than ``n_step``.
- All: a truncated episode goes on beyond its last state, so its return bootstraps there; a terminated one's does not.
- The tutorial, whose numbers the preset ``tutorial`` has: it treats a timeout as an end and has one environment of its
  own kind; here truncation bootstraps, and the one-hot state is an index into the first layer's weights.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any, Literal, NamedTuple, Self

import gymnasium as gym
import numpy as np
import torch
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from gridnav.problem.types import AnyArray, BoolArray, FloatArray, InputError, IntArray, NonFiniteError, State

from .base import Agent, EpisodeWindow, OnCut, OnProgress, Progress, check_finite, reached
from .hyper_parameters import EpsilonGreedyConfig
from .torch_state import load_optimizer_arrays, optimizer_arrays

REPORTS = 50
"""Progress reports per training."""

LOSSES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {"huber": F.huber_loss, "mse": F.mse_loss}
"""By name: Huber's is quadratic for errors up to 1 and linear beyond."""

OWN_STREAMS = 0x44514E
"""Sets the streams of exploration and batches apart from those of the environments, which the seed alone spawns."""


@dataclass(frozen=True)
class DQNConfig(EpsilonGreedyConfig):
    """Hyper-parameters; the defaults solve GridWorld on ``classic``."""

    num_envs: int = 32
    """Environments stepped together."""
    learning_rate: float = 3e-3
    """Adam's step size at the beginning."""
    learning_rate_end: float | None = 1e-4
    """If given, the step size falls linearly to this over the planned steps, or episodes where these are limited."""
    epsilon_end: float = 0.05
    """Probability of a random action at the end; it falls linearly over the planned steps."""
    exploring_starts: bool = True
    """What is learnt is to be right everywhere, not only on the ways that the task asks for."""
    steps: int = 80_000
    """Environment steps of a training of the usual length."""
    hidden: tuple[int, ...] = (128, 128)
    """Units of the hidden layers (ReLU)."""
    double: bool = True
    """The network chooses the next action and the target network values it; otherwise the target network does both."""
    dueling: bool = True
    """The network sums a state's value and its actions' advantages."""
    n_step: int = 2
    """Rewards that a return sums before it bootstraps."""
    loss: Literal["huber", "mse"] = "huber"
    """Of the temporal-difference errors."""
    replay_size: int = 100_000
    """Transitions kept, at least one vector step's."""
    batch_size: int = 256
    """Transitions per update."""
    warm_up: int = 1_000
    """Transitions before the first update."""
    updates_per_step: int = 1
    """Gradient updates after each vector step."""
    target_every: int = 20
    """Updates between copies of the network to the target network."""
    max_grad_norm: float = 10.0
    """Longer gradients are scaled down to this Euclidean norm."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.hidden or not all(isinstance(units, int) and units >= 1 for units in self.hidden):
            raise InputError(f"hidden {self.hidden!r:.60} of DQNConfig must be one or more whole numbers of at least 1")
        if self.loss not in LOSSES:
            raise InputError(f"loss {self.loss!r:.60} of DQNConfig is none of {', '.join(LOSSES)}")


DQN_PRESETS: dict[str, DQNConfig] = {
    "default": DQNConfig(),
    "plain": DQNConfig(double=False, dueling=False),
    "double": DQNConfig(dueling=False),
    "dueling": DQNConfig(double=False),
    "features": DQNConfig(learning_rate=1e-3, learning_rate_end=None, target_every=50, steps=96_000),
    "tutorial": DQNConfig(
        num_envs=1,
        learning_rate=1e-3,
        learning_rate_end=None,
        gamma=0.99,
        epsilon_start=1.0,
        epsilon_end=0.01,
        epsilon_decay=0.99,
        episodes=500,
        exploring_starts=False,
        steps=50_000,
        hidden=(128, 128, 128),
        double=False,
        dueling=False,
        n_step=1,
        loss="mse",
        replay_size=10_000,
        batch_size=64,
        warm_up=64,
        updates_per_step=1,
        target_every=10,
        max_grad_norm=1.0,
    ),
    "cell": DQNConfig(
        num_envs=8,
        learning_rate=5e-3,
        learning_rate_end=1e-4,
        gamma=0.9,
        epsilon_end=0.01,
        epsilon_decay=0.99,
        episodes=500,
        exploring_starts=False,
        steps=50_000,
        hidden=(128,),
        dueling=False,
        loss="mse",
        replay_size=2_000,
        batch_size=128,
        warm_up=500,
        updates_per_step=2,
        target_every=30,
    ),
}
"""By name: what is in ``default`` switched off, other observations, and ``tutorial``, the tutorial's own agent."""


def _dtype(observation_space: gym.Space[Any]) -> type:
    """Of observations in the replay buffer and in the network."""
    return np.int64 if isinstance(observation_space, Discrete) else np.float32


class OneHotLinear(nn.Module):
    """``nn.Linear`` on one-hot vectors without making them: the same function, and the same first weights.

    Args:
        n: Length of the vectors.
        units: Outputs.
    """

    def __init__(self, n: int, units: int) -> None:
        super().__init__()
        linear = nn.Linear(n, units)
        self.weight = nn.Parameter(linear.weight.detach().T.contiguous())
        self.bias = linear.bias

    def forward(self, numbers: Tensor) -> Tensor:
        """Outputs ``(n, units)`` for the places of the ones, shape ``(n,)``."""
        return F.embedding(numbers, self.weight) + self.bias


class QNetwork(nn.Module):
    """Observations to action values.

    Args:
        observation_space: ``Discrete``, seen as a one-hot vector, or a ``Box`` of one axis.
        n_actions: Number of actions.
        hidden: Units of the hidden layers.
        dueling: Sum a value and advantages without their mean (Wang et al. 2016, equation 9).
    """

    def __init__(
        self, observation_space: Discrete[Any] | Box, n_actions: int, hidden: tuple[int, ...], *, dueling: bool
    ) -> None:
        super().__init__()
        if isinstance(observation_space, Discrete):
            first: nn.Module = OneHotLinear(int(observation_space.n), hidden[0])
        else:
            first = nn.Linear(observation_space.shape[0], hidden[0])
        layers = [first, nn.ReLU()]
        for n_inputs, units in pairwise(hidden):
            layers += [nn.Linear(n_inputs, units), nn.ReLU()]
        self.body = nn.Sequential(*layers)
        self.dueling = dueling
        self.head = nn.Linear(hidden[-1], n_actions + dueling)

    def forward(self, observations: Tensor) -> Tensor:
        """Action values, shape ``(n, n_actions)``."""
        outputs: Tensor = self.head(self.body(observations))
        if not self.dueling:
            return outputs
        value, advantages = outputs[:, :1], outputs[:, 1:]
        return value + advantages - advantages.mean(dim=1, keepdim=True)


class Batch(NamedTuple):
    """Returns of up to n steps, each field of shape ``(n,)`` or ``(n, ...)``."""

    observations: Tensor
    """Where they begin."""
    actions: Tensor
    """What was done there."""
    returns: Tensor
    """Discounted sums of the rewards from there on."""
    discounts: Tensor
    """Discount of the value of the state reached: gamma to the number of rewards, 0 where the episode terminated."""
    reached: Tensor
    """The state where the sums end."""


class Replay:
    """The last transitions of every environment, as arrays ``[time, environment]`` written round and round.

    Args:
        n_rows: Vector steps kept.
        num_envs: Environments.
        observation_space: Of one environment.
    """

    def __init__(self, n_rows: int, num_envs: int, observation_space: Discrete[Any] | Box) -> None:
        shape = n_rows, num_envs
        self.observations: AnyArray = np.zeros(
            (*shape, *(observation_space.shape or ())), dtype=_dtype(observation_space)
        )
        self.actions: IntArray = np.zeros(shape, dtype=np.int64)
        self.rewards: FloatArray = np.zeros(shape)
        self.reached: AnyArray = np.zeros_like(self.observations)
        self.terminated, self.truncated = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
        self.n_added = 0

    @property
    def n_filled(self) -> int:
        """Rows that hold transitions."""
        return min(self.n_added, len(self.rewards))

    def add(
        self,
        observations: AnyArray,
        actions: AnyArray,
        rewards: FloatArray,
        reached: AnyArray,
        terminated: BoolArray,
        truncated: BoolArray,
    ) -> None:
        """Write one vector step over the oldest row."""
        row = self.n_added % len(self.rewards)
        self.observations[row], self.actions[row], self.rewards[row] = observations, actions, rewards
        self.reached[row], self.terminated[row], self.truncated[row] = reached, terminated, truncated
        self.n_added += 1

    def sample(self, rng: np.random.Generator, batch_size: int, n_step: int, gamma: float) -> Batch:
        """Returns that begin at random transitions."""
        # Beginnings: uniform over all transitions kept.
        ages = rng.integers(self.n_filled * self.rewards.shape[1], size=batch_size)
        return self.returns(*np.divmod(ages, self.rewards.shape[1]), n_step, gamma)

    def returns(self, ages: IntArray, envs: IntArray, n_step: int, gamma: float) -> Batch:
        """Returns that begin where it is said.

        Args:
            ages: Rows from the oldest one, shape ``(n,)``.
            envs: Environments, shape ``(n,)``.
            n_step: Rewards at most.
            gamma: Discount per step.
        """
        n_rows, num_envs = self.rewards.shape
        steps = np.arange(n_step)
        offsets = ages[:, None] + steps
        # Places in the flattened arrays, shape (n, n_step).
        places = (self.n_added - self.n_filled + offsets) % n_rows * num_envs + envs[:, None]
        ends = self.terminated.take(places) | self.truncated.take(places)
        # What follows the newest row is the oldest one, which is another story.
        ends |= offsets >= self.n_filled - 1
        counts = np.ones(ends.shape, dtype=bool)
        np.logical_not(np.logical_or.accumulate(ends[:, :-1], axis=1), out=counts[:, 1:])
        lengths = counts.sum(axis=1)
        returns = (self.rewards.take(places) * counts) @ gamma**steps
        first, last = places[:, 0], places[np.arange(len(places)), lengths - 1]
        discounts = np.where(self.terminated.take(last), 0.0, gamma**lengths)
        return Batch(
            torch.from_numpy(self._observations(self.observations, first)),
            torch.from_numpy(self.actions.take(first)),
            torch.from_numpy(returns).float(),
            torch.from_numpy(discounts).float(),
            torch.from_numpy(self._observations(self.reached, last)),
        )

    def _observations(self, array: AnyArray, places: IntArray) -> AnyArray:
        return array.reshape(-1, *array.shape[2:])[places]

    def state(self) -> State:
        """A copy of the rows that hold transitions."""
        arrays = {name: getattr(self, name)[: self.n_filled].copy() for name in REPLAY_ARRAYS}
        return State(arrays, {"n_added": self.n_added})

    def restore(self, state: State) -> None:
        """Hold what ``state`` held."""
        self.n_added = state.values["n_added"]
        for name in REPLAY_ARRAYS:
            getattr(self, name)[: self.n_filled] = state.arrays[name]


REPLAY_ARRAYS = ("observations", "actions", "rewards", "reached", "terminated", "truncated")


def td_targets(network: QNetwork, target_network: QNetwork, batch: Batch, *, double: bool) -> Tensor:
    """Returns plus the discounted value of the states where they end, shape ``(n,)``.

    With ``double`` the network chooses the action that the target network values (van Hasselt et al. 2016, equation 4);
    without, the target network does both (Mnih et al. 2015).
    """
    with torch.no_grad():
        values = target_network(batch.reached)
        chosen = (network(batch.reached) if double else values).argmax(dim=1, keepdim=True)
        return batch.returns + batch.discounts * values.gather(1, chosen).squeeze(1)


class Learner:
    """What training adds to the network: its target, Adam, and the update.

    Args:
        network: It is trained in place.
        config: Hyper-parameters.
    """

    def __init__(self, network: QNetwork, config: DQNConfig) -> None:
        self.network, self.config = network, config
        self.target_network = copy.deepcopy(network).requires_grad_(False)
        self.optimizer = torch.optim.Adam(network.parameters(), lr=config.learning_rate, fused=True)
        self.n_updates = 0

    @property
    def step_size(self) -> float:
        """Adam's step size."""
        return float(self.optimizer.param_groups[0]["lr"])

    @step_size.setter
    def step_size(self, value: float) -> None:
        self.optimizer.param_groups[0]["lr"] = value

    def update(self, batch: Batch, steps: int) -> dict[str, float]:
        """One step of Adam towards the batch's targets; ``loss``, mean action value ``q`` and ``gradient_norm``.

        Args:
            batch: Transitions.
            steps: Environment steps taken, for the message.

        Raises:
            NonFiniteError: When loss or gradient is not finite; the weights were not touched then.
        """
        config = self.config
        targets = td_targets(self.network, self.target_network, batch, double=config.double)
        q = self.network(batch.observations).gather(1, batch.actions[:, None]).squeeze(1)
        loss = LOSSES[config.loss](q, targets)
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), config.max_grad_norm)
        metrics = {"loss": loss.item(), "q": q.detach().mean().item(), "gradient_norm": norm.item()}
        if not np.isfinite([*metrics.values()]).all():
            what = ", ".join(f"{name} is {value:g}" for name, value in metrics.items())
            raise NonFiniteError(f"training stopped at step {steps}: {what}; the weights were not touched by it")
        self.optimizer.step()
        self.n_updates += 1
        if self.n_updates % config.target_every == 0:
            self.target_network.load_state_dict(self.network.state_dict())
        return metrics

    def state(self) -> State:
        """A copy of all but the network's weights: the target network's, ``target.*``, and Adam's, ``optimizer.*``."""
        target = {f"target.{name}": tensor.numpy().copy() for name, tensor in self.target_network.state_dict().items()}
        return State(target | optimizer_arrays(self.optimizer), {"n_updates": self.n_updates})

    def restore(self, state: State) -> None:
        """Go on from what ``state`` held."""
        target = {name: torch.from_numpy(array.copy()) for name, array in _below("target", state.arrays).items()}
        self.target_network.load_state_dict(target)
        load_optimizer_arrays(self.optimizer, state.arrays)
        self.n_updates = state.values["n_updates"]


def _below(prefix: str, items: dict[str, Any]) -> dict[str, Any]:
    """What is called ``prefix.name``, by ``name``."""
    return {name.removeprefix(f"{prefix}."): item for name, item in items.items() if name.startswith(f"{prefix}.")}


class DQNAgent(Agent):
    """Takes the action that a network values most.

    Args:
        observation_space: ``Discrete`` from 0, or a ``Box`` of one axis.
        action_space: ``Discrete`` from 0.
        config: Hyper-parameters.
    """

    kind = "dqn"

    def __init__(self, observation_space: gym.Space[Any], action_space: gym.Space[Any], config: DQNConfig) -> None:
        if not isinstance(action_space, Discrete) or action_space.start != 0:
            raise ValueError(f"DQN needs actions Discrete from 0, not {action_space}: take gridnav/GridWorld-v0")
        numbered = isinstance(observation_space, Discrete) and observation_space.start == 0
        if not numbered and not (isinstance(observation_space, Box) and len(observation_space.shape) == 1):
            raise ValueError(f"DQN needs observations Discrete from 0 or a Box of one axis, not {observation_space}")
        assert isinstance(observation_space, Discrete | Box)
        self.config = config
        self._observation_space, self._n_actions = observation_space, int(action_space.n)
        # Two threads on these small networks are slower than one, and the thread count is part of the seed.
        torch.set_num_threads(1)
        with torch.random.fork_rng(devices=()):
            torch.manual_seed(config.seed)
            self.network = QNetwork(observation_space, self._n_actions, config.hidden, dueling=config.dueling)

    @property
    def planned_steps(self) -> int:
        """Environment steps of a training of the usual length."""
        return self.config.steps

    def act(self, observations: NDArray[Any]) -> NDArray[Any]:
        """Greedy actions, shape ``(n,)``; ties go to the lower number."""
        return self.action_values(observations).argmax(axis=1)

    def values(self, observations: NDArray[Any]) -> NDArray[Any]:
        """The values of the best actions, shape ``(n,)``."""
        return self.action_values(observations).max(axis=1)

    def action_values(self, observations: NDArray[Any]) -> NDArray[np.float32]:
        """What the network expects of each action, shape ``(n, n_actions)``."""
        with torch.inference_mode():
            tensor = torch.from_numpy(np.asarray(observations, dtype=_dtype(self._observation_space)))
            return self.network(tensor).numpy()

    def learn(
        self,
        env: VectorEnv[Any, Any, Any],
        *,
        steps: int,
        on_progress: OnProgress | None = None,
        on_cut: OnCut | None = None,
        resume: State | None = None,
    ) -> None:
        """Updates from replayed transitions, from the weights it has."""
        config, n = self.config, env.num_envs
        streams = np.random.SeedSequence([config.seed, OWN_STREAMS]).spawn(2)
        exploring, drawing = (np.random.default_rng(stream) for stream in streams)
        replay = Replay(max(1, config.replay_size // n), n, self._observation_space)
        learner = Learner(self.network, config)
        n_batches = max(1, steps // n)
        if resume is None:
            first, window = 0, EpisodeWindow()
            observations, _ = env.reset(seed=config.seed)
            check_finite(0, observation=observations)
        else:
            values = resume.values
            first, window = values["batch"], EpisodeWindow.from_state(values["window"])
            exploring.bit_generator.state, drawing.bit_generator.state = values["exploring"], values["drawing"]
            replay.restore(State(_below("replay", resume.arrays), values["replay"]))
            learner.restore(State(resume.arrays, values["learner"]))
            observations = resume.arrays["observations"]

        def state() -> State:
            kept, learnt = replay.state(), learner.state()
            arrays = {f"replay.{name}": array for name, array in kept.arrays.items()} | learnt.arrays
            values = {
                "batch": batch,
                "window": window.state(),
                "exploring": exploring.bit_generator.state,
                "drawing": drawing.bit_generator.state,
                "replay": kept.values,
                "learner": learnt.values,
            }
            return State(arrays | {"observations": observations.copy()}, values)

        learning = {name: float("nan") for name in ("loss", "q", "gradient_norm")}
        for batch in range(first, n_batches):
            if on_cut:
                on_cut(state)
            taken = (batch + 1) * n
            epsilon = config.epsilon(batch / n_batches, window.episodes)
            # Exploration: with probability epsilon a move uniform over all moves.
            explores = exploring.random(n) < epsilon
            actions = np.where(explores, exploring.integers(self._n_actions, size=n), self.act(observations))
            next_observations, rewards, terminated, truncated, info = env.step(actions)
            led_to = reached(next_observations, info)
            check_finite(taken, reward=rewards, observation=led_to, next_observation=next_observations)
            replay.add(observations, actions, rewards, led_to, terminated, truncated)
            if replay.n_added * n >= config.warm_up:
                learner.step_size = config.rate(batch / n_batches, window.episodes)
                for _ in range(config.updates_per_step):
                    drawn = replay.sample(drawing, config.batch_size, config.n_step, config.gamma)
                    learning = learner.update(drawn, taken)

            window.add(info)
            observations = next_observations
            is_last = batch + 1 == n_batches or config.is_over(window.episodes)
            if on_progress and ((batch + 1) % max(1, n_batches // REPORTS) == 0 or is_last):
                on_progress(Progress(taken, n_batches * n, window.metrics | {"epsilon": epsilon} | learning))
            if is_last:
                break

    def state(self) -> State:
        """A copy of the weights; the sizes of the spaces, and the hyper-parameters."""
        space = self._observation_space
        values = {
            "observations": int(space.n) if isinstance(space, Discrete) else list(space.shape),
            "actions": self._n_actions,
            "config": asdict(self.config),
        }
        return State({name: tensor.numpy().copy() for name, tensor in self.network.state_dict().items()}, values)

    @classmethod
    def from_state(cls, state: State) -> Self:
        """An agent with these weights.

        Raises:
            ValueError: When they are not finite or not those of such a network.
        """
        values = state.values
        for name, array in state.arrays.items():
            if not np.isfinite(array).all():
                raise ValueError(f"weights {name} must be finite numbers")
        sizes = values["observations"]
        space: gym.Space[Any] = Discrete(sizes) if isinstance(sizes, int) else Box(-np.inf, np.inf, tuple(sizes))
        config = DQNConfig(**{**values["config"], "hidden": tuple(values["config"]["hidden"])})
        agent = cls(space, Discrete(values["actions"]), config)
        try:
            agent.network.load_state_dict({name: torch.from_numpy(array) for name, array in state.arrays.items()})
        except RuntimeError as error:
            raise ValueError(f"weights do not fit the network: {' '.join(str(error).split())}") from error
        return agent
