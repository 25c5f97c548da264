"""What all worlds share: episodes, reward, info and autoreset, written once on arrays.

A world is a ``NavigationVectorEnv`` that says how its robots are placed, driven and observed. Its single environment is
a ``NavigationEnv`` around the same world with a batch of one, so that scalar and vector agree bit for bit.
"""

from __future__ import annotations

import inspect
import numbers
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv
from gymnasium.vector.utils import batch_space

from gridnav.problem.layout import Layout
from gridnav.problem.reward import TERM_NAMES, Reward, Transition, total
from gridnav.problem.robot import BURGER, Robot
from gridnav.problem.task import DRAWS_PER_EPISODE, Task
from gridnav.problem.types import AnyArray, BoolArray, Cell, FloatArray, InputError, IntArray

from .lidar import scan
from .observation import FeatureVector

OPTIONS = ("start", "goal", "heading_rad", "layout")
INFO_KEYS = (
    "is_success",
    "collision",
    "collisions",
    "path_length_m",
    "shortest_path_m",
    "elapsed_s",
    "cell",
    "pose",
    "reward_terms",
)


@dataclass(frozen=True)
class Motion:
    """What one step did to ``n`` robots; each field of shape ``(n,)``."""

    travelled_m: FloatArray
    """Length driven, metres."""
    hit: BoolArray
    """A wall was touched."""
    hit_inner_wall: BoolArray
    """It was a wall of the layout, not the outer one."""
    failed: BoolArray
    """The physics diverged; the pose is the last good one."""


class NavigationVectorEnv(VectorEnv[AnyArray, AnyArray, AnyArray]):
    """``num_envs`` robots that play one layout, task and reward; autoreset in the same step.

    Args:
        num_envs: Robots in the batch.
        layout: A name, a path to a text file, a text, or a ``Layout``.
        task: A name or a ``Task``.
        reward: A preset's name or a ``Reward``.
        max_episode_steps: Steps after which an episode is truncated; none without it.
        render_mode: How ``render`` shows the worlds.
        robot: Its numbers; DiffDrive's model is always that of the Burger.
        autoreset: Start the next episode in the step that ends one. Off for the single environment.
    """

    world: ClassVar[str]
    """Name of the world, as in the environment's id."""

    def __init__(
        self,
        num_envs: int = 1,
        *,
        layout: str | Path | Layout = "classic",
        task: str | Task = "default",
        reward: str | Reward = "default",
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        robot: Robot = BURGER,
        autoreset: bool = True,
    ) -> None:
        if isinstance(num_envs, bool) or not isinstance(num_envs, int | np.integer) or num_envs < 1:
            raise InputError(f"num_envs {num_envs!r} must be a whole number of at least 1")
        if max_episode_steps == -1:  # Gymnasium's word for no limit
            max_episode_steps = None
        if max_episode_steps is not None and max_episode_steps < 1:
            raise InputError(f"max_episode_steps {max_episode_steps} must be at least 1")
        modes = self.metadata["render_modes"]
        if render_mode is not None and render_mode not in modes:
            raise InputError(f"render_mode {render_mode!r} is none of {', '.join(modes)}")
        self.num_envs = int(num_envs)
        self.robot = robot
        self.task, self.reward = Task.load(task), Reward.load(reward)
        self.max_episode_steps = max_episode_steps
        self.render_mode = render_mode
        self._autoreset = autoreset
        self._streams = RandomStreams([np.random.default_rng() for _ in range(self.num_envs)])

        n = self.num_envs
        self._pose: FloatArray = np.zeros((n, 3))
        self._start, self._goal = np.zeros((n, 2), dtype=np.int64), np.zeros((n, 2), dtype=np.int64)
        self._goal_w = np.zeros((n, 2))
        self._distance: FloatArray = np.zeros(n)
        self._shortest_path_m: FloatArray = np.zeros(n)
        self._steps, self._collisions = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
        self._hit, self._at_goal, self._failed = (np.zeros(n, dtype=bool) for _ in range(3))
        self._path_length_m: FloatArray = np.zeros(n)
        self._last_action: FloatArray = np.zeros((n, 2))
        self._speed: FloatArray = np.zeros((n, 2))
        self._fixed: dict[str, Any] = {}
        self._has_reset = False

        self.layout = self._own_layout = Layout.load(layout)
        self._use_layout()
        self.single_observation_space, self.single_action_space = self._spaces()
        self.observation_space = batch_space(self.single_observation_space, n)
        self.action_space = batch_space(self.single_action_space, n)

    # ---- What a world says -------------------------------------------------------------------

    @property
    @abstractmethod
    def step_duration(self) -> float:
        """Cell-times that one step takes."""

    @abstractmethod
    def _spaces(self) -> tuple[gym.Space[Any], gym.Space[Any]]:
        """Observation and action space of one robot."""

    def _use_layout(self) -> None:
        """Build what depends on ``self.layout``; worlds add their own."""
        self._features = FeatureVector(self.layout, self.robot)

    @abstractmethod
    def _place(self, ids: IntArray) -> None:
        """Put robots at rest where ``self._pose`` says, shape of ids ``(m,)``."""

    @abstractmethod
    def _drive(self, actions: AnyArray) -> Motion:
        """Move every robot for one step and update pose, speed and last action."""

    @abstractmethod
    def _valid(self, actions: AnyArray) -> AnyArray:
        """The actions as an array of the batch's shape; ValueError that names the action otherwise."""

    @abstractmethod
    def _distances(self, ids: IntArray | slice) -> FloatArray:
        """Shortest way from where robots are to their goals, cells."""

    @abstractmethod
    def _arrived(self) -> BoolArray:
        """Whether each robot is at its goal."""

    # ---- Gymnasium ---------------------------------------------------------------------------

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[AnyArray, dict[str, Any]]:
        """Start an episode in every environment.

        Args:
            seed: One number, from which every environment gets a stream of its own, or one per environment.
            options: ``start`` and ``goal`` cells (row, column), ``heading_rad`` and ``layout``, for all environments
                and for the episodes that follow until the next reset.

        Raises:
            InputError: When an option breaks a rule; nothing has changed then.
        """
        fixed, layout = self._checked_options(options)
        if seed is not None:
            self.use_generators(self._generators(seed))
        if layout != self.layout:
            self.layout = layout
            self._use_layout()
        self._fixed = fixed
        ids = np.arange(self.num_envs)
        self._begin(ids)
        self._has_reset = True
        return self._observe(ids), self._info(_zero_terms(self.num_envs))

    def step(self, actions: AnyArray) -> tuple[AnyArray, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Drive every robot for one step.

        Raises:
            InputError: When an action has the wrong shape, type or, for moves, range; nothing has changed then.
            ResetNeeded: Before the first reset.
        """
        if not self._has_reset:
            raise gym.error.ResetNeeded("call reset() before the first step()")
        motion = self._drive(self._valid(actions))

        self._steps += 1
        self._hit, self._failed = motion.hit, motion.failed
        self._collisions += motion.hit
        self._path_length_m += motion.travelled_m
        self._at_goal = self._arrived() & ~motion.failed
        ends = motion.hit if self.task.on_collision == "end" else False
        terminated = self._at_goal | motion.failed | ends
        truncated = np.full(self.num_envs, False)
        if self.max_episode_steps is not None:
            truncated = self._steps >= self.max_episode_steps

        distance, self._distance = self._distance, self._distances(slice(None))
        terms = self.reward.terms(
            Transition(
                travelled=motion.travelled_m / self.layout.cell_size_m,
                duration=np.full(self.num_envs, self.step_duration),
                distance=distance,
                next_distance=self._distance,
                manhattan=np.abs(self._cell() - self._goal).sum(axis=1).astype(np.float64),
                at_goal=self._at_goal,
                hit=motion.hit,
                hit_inner_wall=motion.hit_inner_wall,
                terminal=self._at_goal | ends,  # not a failure of the physics: that must not pay
                time_up=truncated,
            )
        )
        observations, info = self._observe(np.arange(self.num_envs)), self._info(terms)
        if self._autoreset:
            ended = np.flatnonzero(terminated | truncated)
            if ended.size:
                observations, info = self._next_episodes(ended, observations, info)
        return observations, total(terms), terminated, truncated, info

    @property
    def features(self) -> FeatureVector:
        """Names, units and bounds of the shared feature vector."""
        return self._features

    @property
    def step_s(self) -> float:
        """Seconds that one step takes: a cell-time is a cell at the robot's top speed."""
        return self.step_duration * self.layout.cell_size_m / self.robot.max_speed_m_s

    @property
    def step_gamma(self) -> float:
        """Discount of one step that matches the reward's discount per cell-time."""
        return float(self.reward.gamma**self.step_duration)

    def start_and_goal(self, i: int) -> tuple[Cell, Cell]:
        """Start and goal cell of environment ``i``'s current episode."""
        (row, col), (goal_row, goal_col) = self._start[i].tolist(), self._goal[i].tolist()
        return (row, col), (goal_row, goal_col)

    @property
    def goal_cells(self) -> IntArray:
        """Goals an episode may have, (row, column), shape ``(n_goals, 2)``, in the order of ``cell_goal``."""
        return self.task.goal_cells(self.layout)

    # ---- Episodes ----------------------------------------------------------------------------

    def _begin(self, ids: IntArray) -> None:
        """Start the next episode of the given environments; the others are not touched."""
        starts, goals, headings = self.task.sample(self.layout, self._streams.draw(ids, DRAWS_PER_EPISODE))
        goals = np.broadcast_to(self._fixed.get("goal", goals), goals.shape)
        if "start" in self._fixed:
            starts = np.broadcast_to(self._fixed["start"], starts.shape)
        elif "goal" in self._fixed:
            starts = self._other_start(starts, goals)
        if "start" in self._fixed and "goal" not in self._fixed:
            goals = self._other_goal(starts, goals)
        self._start[ids], self._goal[ids] = starts, goals
        self._goal_w[ids] = self.layout.to_metres(goals)
        self._pose[ids, :2] = self.layout.to_metres(starts)
        self._pose[ids, 2] = self._fixed.get("heading_rad", headings)
        self._steps[ids] = self._collisions[ids] = 0
        self._hit[ids] = self._at_goal[ids] = self._failed[ids] = False
        self._path_length_m[ids] = 0.0
        self._last_action[ids] = self._speed[ids] = 0.0
        self._place(ids)
        self._distance[ids] = self._distances(ids)
        self._shortest_path_m[ids] = self._distance[ids] * self.layout.cell_size_m

    def _other_start(self, starts: IntArray, goals: IntArray) -> IntArray:
        """The drawn starts, moved to the task's next start cell where the fixed goal took theirs."""
        cells = self.task.start_cells(self.layout)
        cells = cells[(cells != goals[0]).any(axis=1)]
        return np.where((starts == goals).all(axis=1, keepdims=True), cells[0], starts)

    def _other_goal(self, starts: IntArray, goals: IntArray) -> IntArray:
        """The drawn goals, moved to the task's next goal cell where the fixed start took theirs."""
        cells = self.goal_cells
        cells = cells[(cells != starts[0]).any(axis=1)]
        return np.where((starts == goals).all(axis=1, keepdims=True), cells[0], goals)

    def _next_episodes(
        self, ended: IntArray, observations: AnyArray, info: dict[str, Any]
    ) -> tuple[AnyArray, dict[str, Any]]:
        """Autoreset in the same step: what ended goes to ``final_obs`` and ``final_info``."""
        mask = np.zeros(self.num_envs, dtype=bool)
        mask[ended] = True
        final_obs = np.full(self.num_envs, None, dtype=object)
        for i in ended:
            final_obs[i] = observations[i].copy()
        self._begin(ended)
        observations = observations.copy()
        observations[ended] = self._observe(ended)
        terms = {name: np.where(mask, 0.0, values) for name, values in info["reward_terms"].items()}
        return observations, self._info(terms) | {
            "final_obs": final_obs,
            "_final_obs": mask,
            "final_info": info,
            "_final_info": mask.copy(),
        }

    # ---- What agents and people see ----------------------------------------------------------

    def _observe(self, ids: IntArray) -> AnyArray:
        """Observations of the given robots, a fresh array; the shared feature vector by default."""
        return self._features.observe(
            self._pose[ids], self.scan(ids), self._goal_w[ids], self._speed[ids], self._last_action[ids]
        )

    def scan(self, ids: IntArray | None = None) -> FloatArray:
        """Lidar ranges of the given robots (all by default), shape ``(m, n_beams)``, metres."""
        return scan(self._pose if ids is None else self._pose[ids], self.layout, self.robot)

    def _cell(self) -> IntArray:
        return self.layout.to_cell(self._pose[:, :2])

    def _info(self, terms: dict[str, FloatArray]) -> dict[str, Any]:
        """The contract's keys, each a fresh array with a leading batch axis."""
        info: dict[str, Any] = {
            "is_success": self._at_goal.copy(),
            "collision": self._hit.copy(),
            "collisions": self._collisions.copy(),
            "path_length_m": self._path_length_m.copy(),
            "shortest_path_m": self._shortest_path_m.copy(),
            "elapsed_s": self._steps * self.step_s,
            "cell": self._cell(),
            "pose": self._pose.copy(),
            "reward_terms": {name: terms[name].copy() for name in TERM_NAMES},
        }
        if self._failed.any():
            info["physics_error"] = self._failed.copy()
            info["_physics_error"] = self._failed.copy()
        return info

    # ---- Options and seeds -------------------------------------------------------------------

    def _checked_options(self, options: dict[str, Any] | None) -> tuple[dict[str, Any], Layout]:
        """The options that fix a start state, and the layout to play; InputError otherwise."""
        options = dict(options or {})
        for key in options:
            if key not in OPTIONS:
                raise InputError(f"unknown reset option {key!r}: the options are {', '.join(OPTIONS)}")
        layout = own = self._own_layout
        if options.get("layout") is not None:
            layout = Layout.load(options["layout"], cell_size_m=own.cell_size_m)
            if layout.walls.shape != own.walls.shape or layout.cell_size_m != own.cell_size_m:
                raise InputError(
                    f"reset option layout has {layout.n_rows} x {layout.n_cols} cells of {layout.cell_size_m} m, the "
                    f"environment {own.n_rows} x {own.n_cols} of {own.cell_size_m} m: make a new environment for "
                    "another size"
                )
        fixed: dict[str, Any] = {}
        for key in ("start", "goal"):
            if options.get(key) is not None:
                fixed[key] = np.array(_free_cell(options[key], key, layout))
        if "start" in fixed and "goal" in fixed and (fixed["start"] == fixed["goal"]).all():
            raise InputError(f"reset options start and goal are both {options['start']}: they must differ")
        for key, others in (("start", self.task.goal_cells(layout)), ("goal", self.task.start_cells(layout))):
            if key in fixed and len(fixed) == 1 and (others == fixed[key]).all():
                what = "goal" if key == "start" else "start"
                raise InputError(f"reset option {key} {options[key]} is the only {what} of this task: give both")
        heading = options.get("heading_rad")
        if heading is not None:
            if isinstance(heading, bool) or not isinstance(heading, numbers.Real) or not np.isfinite(float(heading)):
                raise InputError(f"reset option heading_rad {heading!r} must be a finite number of radians")
            turned = float(heading)
            fixed["heading_rad"] = turned if abs(turned) <= np.pi else (turned + np.pi) % (2 * np.pi) - np.pi
        return fixed, layout

    def use_generators(self, generators: list[np.random.Generator]) -> None:
        """Draw from these generators, one per environment; streams that already do go on where they are."""
        if any(new is not old for new, old in zip(generators, self._streams.generators, strict=True)):
            self._streams = RandomStreams(generators)

    def _generators(self, seed: int | Sequence[int]) -> list[np.random.Generator]:
        if isinstance(seed, int | np.integer):
            # Spawned, not seed + i: environment i of one run shares no stream with environment j of another.
            return [np.random.default_rng(child) for child in np.random.SeedSequence(int(seed)).spawn(self.num_envs)]
        if len(seed) != self.num_envs:
            raise InputError(f"{len(seed)} seeds were given for {self.num_envs} environments: give one each")
        return [np.random.default_rng(one) for one in seed]


class RandomStreams:
    """One stream of uniform numbers per environment, drawn in blocks so that a batch costs no Python loop.

    Environment i sees the numbers its generator would give one by one, whatever the others do.
    """

    BLOCK = 64

    def __init__(self, generators: list[np.random.Generator]) -> None:
        self.generators = generators
        self._block = np.empty((len(generators), self.BLOCK))
        self._next = np.full(len(generators), self.BLOCK)

    def draw(self, ids: IntArray, n: int) -> FloatArray:
        """The next ``n`` numbers in [0, 1) of the given streams, shape ``(len(ids), n)``."""
        for i in ids[self._next[ids] + n > self.BLOCK]:
            unused = self._block[i, self._next[i] :]
            fresh = self.generators[i].random(self.BLOCK - unused.size)
            self._block[i] = np.concatenate([unused, fresh])
            self._next[i] = 0
        columns = self._next[ids][:, None] + np.arange(n)
        self._next[ids] += n
        return self._block[ids[:, None], columns]


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


def as_array(action: Any) -> AnyArray:
    """Actions as an array; InputError for what has no shape, such as rows of several lengths."""
    try:
        return np.asarray(action)
    except (ValueError, TypeError):
        raise InputError(f"action {action!r} is not an array of numbers") from None


def _one(observations: AnyArray) -> Any:
    # A Discrete observation is a plain integer, as Gymnasium's own environments return it.
    return observations[0].copy() if observations.ndim > 1 else int(observations[0])


def _one_info(info: dict[str, Any]) -> dict[str, Any]:
    """The first environment's entries as Python values: numbers, a cell tuple, a pose array."""
    one: dict[str, Any] = {}
    for key, value in info.items():
        if key.startswith("_"):
            continue
        if isinstance(value, dict):
            one[key] = _one_info(value)
        elif value.ndim == 1:
            one[key] = value[0].item()
        else:
            one[key] = tuple(value[0].tolist()) if key == "cell" else value[0].copy()
    return one


def _zero_terms(n: int) -> dict[str, FloatArray]:
    return {name: np.zeros(n) for name in TERM_NAMES}


def _free_cell(value: Any, key: str, layout: Layout) -> Cell:
    try:
        row, col = (int(number) for number in value)
        whole = (row, col) == tuple(value)
    except (TypeError, ValueError):
        whole = False
    if not whole:
        raise InputError(f"reset option {key} {value!r} must be a cell (row, column) of whole numbers")
    if not layout.is_free((row, col)):
        raise InputError(
            f"reset option {key} ({row}, {col}) is no free cell of layout {layout.name} "
            f"({layout.n_rows} rows, {layout.n_cols} columns): choose one that is not a wall"
        )
    if not layout.reachable[row, col]:
        raise InputError(f"reset option {key} ({row}, {col}) cannot be reached from the starts of layout {layout.name}")
    return row, col
