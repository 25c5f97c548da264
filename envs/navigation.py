"""What all worlds share: episodes, reward, info and autoreset, written once on arrays.

A world is a ``NavigationVectorEnv`` that says how its robots are placed, driven and observed. Its single environment is
a ``NavigationEnv`` around the same world with a batch of one, so that scalar and vector agree bit for bit.
"""

from __future__ import annotations

import numbers
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numba
import numpy as np
from gymnasium.vector import VectorEnv
from gymnasium.vector.utils import batch_space

from gridnav.problem.layout import Layout
from gridnav.problem.reward import TERM_NAMES, Reward, Transition, TutorialReward, total
from gridnav.problem.robot import BURGER, Robot
from gridnav.problem.task import DRAWS_PER_EPISODE, EpisodeSampler, Task
from gridnav.problem.types import AnyArray, BoolArray, Cell, FloatArray, InputError, IntArray, State

from .lidar import Lidar
from .observation import FeatureVector
from .random_streams import RandomStreams

MAX_ENVS = 1_000_000
"""A robot takes some kilobytes: beyond this a batch no longer fits a laptop."""
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
    STATE: ClassVar[tuple[str, ...]] = (
        "pose",
        "cell",
        "speed",
        "last_action",
        "start",
        "goal",
        "goal_w",
        "shortest_path_m",
        "steps",
        "collisions",
        "path_length_m",
        "travelled_m",
        "failed",
    )
    """Arrays of the batch that decide what comes next, without their underscore; worlds add theirs."""

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
        self.num_envs = checked_num_envs(num_envs)
        if max_episode_steps == -1:  # Gymnasium's word for no limit
            max_episode_steps = None
        if max_episode_steps is not None and max_episode_steps < 1:
            raise InputError(f"max_episode_steps {max_episode_steps} must be at least 1")
        modes = self.metadata["render_modes"]
        if render_mode is not None and render_mode not in modes:
            raise InputError(f"render_mode {render_mode!r} is none of {', '.join(modes)}")
        self.robot = robot
        self.task, self.reward = Task.load(task), Reward.load(reward)
        self.max_episode_steps = max_episode_steps
        self.render_mode = render_mode
        self._autoreset = autoreset
        self._streams = RandomStreams([np.random.default_rng() for _ in range(self.num_envs)])

        n = self.num_envs
        # Where each robot is, and what its episode asks for.
        self._pose: FloatArray = np.zeros((n, 3))
        self._cell = np.zeros((n, 2), dtype=np.int64)
        self._speed: FloatArray = np.zeros((n, 2))
        self._last_action: FloatArray = np.zeros((n, 2))
        self._start, self._goal = np.zeros((n, 2), dtype=np.int64), np.zeros((n, 2), dtype=np.int64)
        self._goal_w: FloatArray = np.zeros((n, 2))
        self._shortest_path_m: FloatArray = np.zeros(n)
        # What the episode came to so far.
        self._steps, self._collisions = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
        self._path_length_m: FloatArray = np.zeros(n)
        # What the last step did; every step writes these arrays anew.
        self._travelled_m: FloatArray = np.zeros(n)
        self._failed = np.zeros(n, dtype=bool)
        self._transition = _still(n)
        self._fixed: dict[str, Any] = {}
        self._has_reset = False
        self._parked = np.zeros(n, dtype=bool)

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

    def _vary(self, layout: Layout, fixed: dict[str, Any]) -> Layout:
        """The layout of the episodes that a reset begins, with what its options fix; worlds may change it."""
        return layout

    def _use_layout(self) -> None:
        """Build what depends on ``self.layout``; worlds add their own."""
        self._features = FeatureVector(self.layout, self.robot)
        self._lidar = Lidar(self.layout, self.robot)
        self._sampler = EpisodeSampler(self.task, self.layout)
        self.goal_ranks = self.task.goal_ranks(self.layout)
        """Place of each cell among ``goal_cells``, -1 where it is none, shape ``(n_rows, n_cols)``."""
        self._transition.duration[:] = self.step_duration

    @abstractmethod
    def _place(self, ids: IntArray) -> None:
        """Put robots at rest where ``self._pose`` says, shape of ids ``(m,)``, and write their distance to the goal.

        The distance, in cells, is ``self._transition.next_distance``.
        """

    @abstractmethod
    def _drive(self, actions: AnyArray) -> None:
        """Move every robot for one step.

        Writes pose, cell, speed, last action, ``self._travelled_m`` and ``self._failed`` (the physics diverged; the
        pose is then the last good one), and of the transition ``hit``, ``hit_inner_wall``, ``at_goal``,
        ``next_distance`` and ``manhattan``.
        """

    @abstractmethod
    def _valid(self, actions: AnyArray) -> AnyArray:
        """The actions as an array of the batch's shape; ValueError that names the action otherwise."""

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
        self._parked = np.zeros(self.num_envs, dtype=bool)
        if seed is not None:
            self.use_generators(self._generators(seed))
        layout = self._vary(layout, fixed)
        if layout != self.layout:
            self.layout = layout
            self._use_layout()
        self._fixed = fixed
        self._begin(np.arange(self.num_envs))
        self._has_reset = True
        return self._observe(), self._info({name: np.zeros(self.num_envs) for name in TERM_NAMES})

    def step(self, actions: AnyArray) -> tuple[AnyArray, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Drive every robot for one step.

        Raises:
            InputError: When an action has the wrong shape, type or, for moves, range; nothing has changed then.
            ResetNeeded: Before the first reset.
        """
        if not self._has_reset:
            raise gym.error.ResetNeeded("call reset() before the first step()")
        valid = self._valid(actions)
        self._transition.distance[:] = self._transition.next_distance
        self._drive(valid)
        terminated, truncated, n_ended = self._count()
        terms = self.reward.terms(self._transition)
        if type(self.reward).terms not in OWN_TERMS:  # a user's reward may hand out what it was given
            terms = {name: np.array(share) for name, share in terms.items()}
        observations, info = self._observe(), self._info(terms)
        if n_ended and self._autoreset:
            info = self._next_episodes(np.flatnonzero(terminated | truncated), observations, info)
        return observations, total(terms), terminated, truncated, info

    def get_state(self) -> State:
        """Everything that decides what comes next, random streams and physics included."""
        arrays = {name: getattr(self, f"_{name}").copy() for name in self.STATE}
        arrays |= {f"transition.{f.name}": getattr(self._transition, f.name).copy() for f in fields(Transition)}
        streams = self._streams.state()
        arrays |= {f"streams.{name}": array for name, array in streams.arrays.items()}
        fixed = {name: value if np.isscalar(value) else value.tolist() for name, value in self._fixed.items()}
        layout = None if self.layout == self._own_layout else self.layout.to_text()
        values = {
            "fixed": fixed,
            "layout": layout,
            "cell_size_m": self.layout.cell_size_m,
            "has_reset": self._has_reset,
        }
        return State(arrays, values | streams.values)

    def set_state(self, state: State) -> None:
        """Go on where an environment that was made alike was: what follows is equal bit for bit.

        Raises:
            InputError: When the state is that of another kind or number of environments.
        """
        arrays, values = state
        poses = arrays.get("pose")
        if poses is None or poses.shape != self._pose.shape or not set(self.STATE) <= arrays.keys():
            raise InputError(f"the state is not that of {self.num_envs} environments of {self.world}")
        layout = self._own_layout
        if values["layout"] is not None:  # a text, never a path: the state may come from a file of somebody else
            layout = Layout.from_text(values["layout"], cell_size_m=layout.cell_size_m)
        fixed, layout = self._checked_options({**values["fixed"], "layout": layout})
        cell_size_m = float(values["cell_size_m"])
        if not 0.5 <= cell_size_m / layout.cell_size_m <= 2.0:
            raise InputError(f"cells of {cell_size_m} m in the state are none of {layout.cell_size_m} m")
        layout = replace(layout, cell_size_m=cell_size_m)
        self._check_state(arrays, layout)
        if layout != self.layout:
            self.layout = layout
            self._use_layout()
        self._fixed = fixed
        self._goal[:] = arrays["goal"]
        self._cell[:] = arrays["cell"]
        self._pose[:] = arrays["pose"]
        self._place(np.arange(self.num_envs))  # what follows from the above, such as the goals' numbers
        for name in self.STATE:
            getattr(self, f"_{name}")[:] = arrays[name]
        for field in fields(Transition):
            getattr(self._transition, field.name)[:] = arrays[f"transition.{field.name}"]
        streams = {
            name.removeprefix("streams."): array for name, array in arrays.items() if name.startswith("streams.")
        }
        self._streams.set_state(State(streams, values))
        self._parked = np.zeros(self.num_envs, dtype=bool)
        self._has_reset = values["has_reset"]

    def _check_state(self, arrays: dict[str, AnyArray], layout: Layout) -> None:
        """InputError where arrays are not the batch's: compiled loops trust that cells and poses lie in the layout."""
        for name in self.STATE:
            own, array = getattr(self, f"_{name}"), arrays[name]
            if array.shape != own.shape or array.dtype != own.dtype:
                raise InputError(f"{name} of the state has shape {array.shape} and type {array.dtype}: it is no {name}")
        for name in ("cell", "start", "goal"):
            if (arrays[name] < 0).any() or (arrays[name] >= layout.walls.shape).any():
                raise InputError(f"{name} of the state lies outside its layout")
        poses, corner = arrays["pose"], np.array([layout.n_cols, layout.n_rows]) * layout.cell_size_m
        if not np.isfinite(poses).all() or (poses[:, :2] < 0.0).any() or (poses[:, :2] > corner).any():
            raise InputError("pose of the state lies outside its layout")

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

    @property
    def curriculum_strength(self) -> float | None:
        """How much of its ranges a curriculum draws from at present, in [0, 1]; None without one."""
        return None

    def follow_curriculum(self, leader: NavigationVectorEnv) -> None:
        """Share the curriculum of other environments, which reset first; nothing to do where there is none."""

    def start_and_goal(self, i: int) -> tuple[Cell, Cell]:
        """Start and goal cell of environment ``i``'s current episode."""
        (row, col), (goal_row, goal_col) = self._start[i].tolist(), self._goal[i].tolist()
        return (row, col), (goal_row, goal_col)

    @property
    def goal_cells(self) -> IntArray:
        """Goals an episode may have, (row, column), shape ``(n_goals, 2)``, in the order of ``cell_goal``."""
        return self.task.goal_cells(self.layout)

    def park(self, parked: BoolArray) -> None:
        """Say whom nobody looks at until the next reset, shape ``(n,)``: a world may spare itself what they do.

        What becomes of the others is the same to the last bit.
        """
        self._parked = parked.copy()

    def cell_goal(self, cells: IntArray, goals: IntArray) -> IntArray:
        """What robots on the grid would observe there.

        Args:
            cells: Where they are, (row, column), shape ``(n, 2)``.
            goals: Where they are to go, shape ``(n, 2)``, see ``rank_of``.

        Returns:
            ``cell * n_goals + goal``, shape ``(n,)``.
        """
        numbers = cells[:, 0] * self.layout.n_cols + cells[:, 1]
        return numbers * len(self.goal_cells) + self.rank_of(goals)

    def rank_of(self, goals: IntArray) -> IntArray:
        """Place of each goal cell, shape ``(n, 2)``, among ``goal_cells``; 0 for what is no goal of the task."""
        ranks: IntArray = np.maximum(self.goal_ranks[tuple(goals.T)], 0)
        return ranks

    # ---- Episodes ----------------------------------------------------------------------------

    def _begin(self, ids: IntArray) -> None:
        """Start the next episode of the given environments; the others are not touched."""
        starts, goals, headings = self._sampler.sample(self._streams.draw(ids, DRAWS_PER_EPISODE))
        if self._fixed:
            starts, goals, headings = self._as_fixed(starts, goals, headings)
        _begin(
            ids,
            starts,
            goals,
            headings,
            self.layout.n_rows,
            self.layout.cell_size_m,
            self._start,
            self._goal,
            self._goal_w,
            self._cell,
            self._pose,
            self._speed,
            self._last_action,
            self._steps,
            self._collisions,
            self._path_length_m,
            self._failed,
            self._transition.hit,
            self._transition.at_goal,
        )
        self._place(ids)
        self._shortest_path_m[ids] = self._transition.next_distance[ids] * self.layout.cell_size_m

    def _as_fixed(
        self, starts: IntArray, goals: IntArray, headings: FloatArray
    ) -> tuple[IntArray, IntArray, FloatArray]:
        """What was drawn, with what the reset's options fix."""
        fixed = self._fixed
        goals = np.broadcast_to(fixed.get("goal", goals), goals.shape).copy()
        if "start" in fixed:
            starts = np.broadcast_to(fixed["start"], starts.shape).copy()
        elif "goal" in fixed:
            starts = self._other_start(starts, goals)
        if "start" in fixed and "goal" not in fixed:
            goals = self._other_goal(starts, goals)
        return starts, goals, np.broadcast_to(fixed.get("heading_rad", headings), headings.shape).astype(np.float64)

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

    def _count(self) -> tuple[BoolArray, BoolArray, int]:
        """Count the step into the episodes; which of them it terminated, which it truncated, and how many it ended."""
        step = self._transition
        terminated, truncated = np.empty(self.num_envs, dtype=bool), np.empty(self.num_envs, dtype=bool)
        n_ended = _count(
            self.task.on_collision == "end",
            self.max_episode_steps or NO_LIMIT,
            self.layout.cell_size_m,
            self._travelled_m,
            self._failed,
            step.hit,
            step.at_goal,
            self._steps,
            self._collisions,
            self._path_length_m,
            step.travelled,
            step.terminal,
            step.time_up,
            terminated,
            truncated,
        )
        return terminated, truncated, n_ended

    def _next_episodes(self, ended: IntArray, observations: AnyArray, info: dict[str, Any]) -> dict[str, Any]:
        """Autoreset in the same step: what ended goes to ``final_obs`` and ``final_info``.

        Writes the first observations of the next episodes into ``observations`` and returns their info.
        """
        mask = np.zeros(self.num_envs, dtype=bool)
        mask[ended] = True
        final_obs = np.empty(self.num_envs, dtype=object)  # filled with None
        if observations.ndim == 1:
            final_obs[ended] = observations[ended]
        else:
            for i in ended:
                final_obs[i] = observations[i].copy()
        self._begin(ended)
        observations[ended] = self._observe(ended)
        terms = {name: share.copy() for name, share in info["reward_terms"].items()}
        for share in terms.values():
            share[ended] = 0.0
        return self._info(terms) | {
            "final_obs": final_obs,
            "_final_obs": mask,
            "final_info": info,
            "_final_info": mask.copy(),
        }

    # ---- What agents and people see ----------------------------------------------------------

    def _observe(self, ids: IntArray | None = None) -> AnyArray:
        """Observations of the given robots (all by default), a fresh array; the shared feature vector by default."""
        state = (self._pose, self._goal_w, self._speed, self._last_action)
        pose, goal_w, speed, last_action = state if ids is None else (part[ids] for part in state)
        return self._features.observe(pose, self._lidar.scan(pose), goal_w, speed, last_action)

    def scan(self, poses: FloatArray | None = None) -> FloatArray:
        """Lidar ranges where the robots are, or at other poses of shape ``(n, 3)``; metres, shape ``(n, n_beams)``."""
        return self._lidar.scan(self._pose if poses is None else poses)

    @property
    def cells(self) -> IntArray:
        """Where the robots are, (row, column), shape ``(num_envs, 2)``; a copy."""
        return self._cell.copy()

    def _info(self, terms: dict[str, FloatArray]) -> dict[str, Any]:
        """The contract's keys, each a fresh array with a leading batch axis; the terms become part of it."""
        info: dict[str, Any] = {
            "is_success": self._transition.at_goal.copy(),
            "collision": self._transition.hit.copy(),
            "collisions": self._collisions.copy(),
            "path_length_m": self._path_length_m.copy(),
            "shortest_path_m": self._shortest_path_m.copy(),
            "elapsed_s": self._steps * self.step_s,
            "cell": self._cell.copy(),
            "pose": self._pose.copy(),
            "reward_terms": terms,
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

    @property
    def generators(self) -> list[np.random.Generator]:
        """What the environments draw from, one each."""
        return self._streams.generators

    def _generators(self, seed: int | Sequence[int]) -> list[np.random.Generator]:
        if isinstance(seed, int | np.integer):
            # Spawned, not seed + i: environment i of one run shares no stream with environment j of another.
            return [np.random.default_rng(child) for child in np.random.SeedSequence(int(seed)).spawn(self.num_envs)]
        if len(seed) != self.num_envs:
            raise InputError(f"{len(seed)} seeds were given for {self.num_envs} environments: give one each")
        return [np.random.default_rng(one) for one in seed]


NO_LIMIT = np.iinfo(np.int64).max
OWN_TERMS = {Reward.terms, TutorialReward.terms}
"""Rewards whose terms are fresh arrays."""


def _still(n: int) -> Transition:
    """A transition of ``n`` worlds in which nothing happens."""
    lengths: Any = [np.zeros(n) for _ in range(5)]
    facts: Any = [np.zeros(n, dtype=bool) for _ in range(5)]
    return Transition(*lengths, *facts)


@numba.njit(cache=True)
def _count(
    ends_at_hit: bool,
    max_steps: int,
    cell_size_m: float,
    travelled_m: FloatArray,
    failed: BoolArray,
    hit: BoolArray,
    at_goal: BoolArray,
    steps: IntArray,
    collisions: IntArray,
    path_length_m: FloatArray,
    travelled: FloatArray,
    terminal: BoolArray,
    time_up: BoolArray,
    terminated: BoolArray,
    truncated: BoolArray,
) -> int:
    # One loop per array, so that each compiles to vector instructions.
    n = len(steps)
    for i in range(n):
        steps[i] += 1
    for i in range(n):
        collisions[i] += hit[i]
    for i in range(n):
        path_length_m[i] += travelled_m[i]
    for i in range(n):
        travelled[i] = travelled_m[i] / cell_size_m
    for i in range(n):
        at_goal[i] &= not failed[i]
        # A failure of the physics ends the episode, but is no final state of the task: that must not pay.
        terminal[i] = at_goal[i] | (ends_at_hit & hit[i])
        terminated[i] = terminal[i] | failed[i]
    for i in range(n):
        time_up[i] = steps[i] >= max_steps
    n_ended = 0
    for i in range(n):
        truncated[i] = time_up[i]
        n_ended += terminated[i] | truncated[i]
    return n_ended


@numba.njit(cache=True)
def _begin(
    ids: IntArray,
    starts: IntArray,
    goals: IntArray,
    headings: FloatArray,
    n_rows: int,
    cell_size_m: float,
    start: IntArray,
    goal: IntArray,
    goal_w: FloatArray,
    cell: IntArray,
    pose: FloatArray,
    speed: FloatArray,
    last_action: FloatArray,
    steps: IntArray,
    collisions: IntArray,
    path_length_m: FloatArray,
    failed: BoolArray,
    hit: BoolArray,
    at_goal: BoolArray,
) -> None:
    for k in range(len(ids)):
        i = ids[k]
        for axis in range(2):
            start[i, axis] = cell[i, axis] = starts[k, axis]
            goal[i, axis] = goals[k, axis]
            speed[i, axis] = last_action[i, axis] = 0.0
        # Cell centres, as in `Layout.to_metres`.
        pose[i, 0], pose[i, 1] = (starts[k, 1] + 0.5) * cell_size_m, (n_rows - starts[k, 0] - 0.5) * cell_size_m
        goal_w[i, 0], goal_w[i, 1] = (goals[k, 1] + 0.5) * cell_size_m, (n_rows - goals[k, 0] - 0.5) * cell_size_m
        pose[i, 2] = headings[k]
        steps[i] = collisions[i] = 0
        path_length_m[i] = 0.0
        failed[i] = hit[i] = at_goal[i] = False


def checked_num_envs(num_envs: Any) -> int:
    """The number of environments; InputError if it is none."""
    if isinstance(num_envs, bool) or not isinstance(num_envs, int | np.integer) or not 1 <= num_envs <= MAX_ENVS:
        raise InputError(f"num_envs {num_envs!r} must be a whole number from 1 to {MAX_ENVS}")
    return int(num_envs)


def as_array(action: Any) -> AnyArray:
    """Actions as an array; InputError for what has no shape, such as rows of several lengths."""
    try:
        return np.asarray(action)
    except (ValueError, TypeError):
        raise InputError(f"action {action!r} is not an array of numbers") from None


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
