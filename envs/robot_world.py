"""What the two robot worlds share: continuous commands, metres, one control period per step."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numba
import numpy as np
from gymnasium.spaces import Box

from gridnav.problem.geodesic import Geodesic, clearances
from gridnav.problem.layout import Layout
from gridnav.problem.types import AnyArray, BoolArray, FloatArray, InputError, IntArray, State

from .draws import HIGHEST, LOWEST, Draws
from .imperfections import Commands, Senses
from .navigation import NavigationVectorEnv, as_array, checked_num_envs
from .observation import FeatureVector
from .randomization import Randomization
from .single import NavigationEnv, VectorWorld

RELEASE_M = 0.02
"""A contact is over once the bumper is this far from the wall; until then it counts as one, and pressing counts again.

A robot that meets a wall at full speed bounces off by up to 11 mm. In narrow corridors it is less, see ``release_m``.
"""
GRAZING = float(np.sin(np.deg2rad(15.0)))
"""Sine of the angle to a wall up to which a robot is not stopped there but scrapes along, as a round bumper does.

Were it stopped at any angle, a robot that brushes a corner would stand still with its way ahead open. Nothing is gained
by scraping: it is counted and charged as pressing is.
"""
EXPLORING_DRAWS = 5
"""Uniform numbers that say whether and where an episode begins anywhere."""
STAND_OFF_M = 0.003
"""Gap that a robot which begins at a wall has to it."""
SAME_WALL = 0.7
"""Cosine of the angle up to which two directions of contact mean one wall: another wall is another collision."""


class RobotVectorEnv(NavigationVectorEnv):
    """``num_envs`` robots that take a forward and a turning command per control period.

    A robot whose bumper meets a wall is stopped: it can turn and back off, and commands into the wall are refused, but
    for those that only graze it. The contact is counted once, and again for every cell-time that the robot keeps
    pressing or scraping, as the grid counts every bump. Where the task lets robots slide, nothing is refused and every
    period with a contact is charged.

    Args:
        num_envs: Robots in the batch.
        control_period_s: Time between two commands, seconds; 0.2 s is one turn of the lidar (5 Hz).
        exploring_starts: Share of the episodes that begin anywhere, half of them at the nearest wall, whatever the task
            says; for training: a robot that is never put there does not learn how to get away from a wall.
        randomization: A preset's name, JSON or a ``Randomization``: what varies of robot, senses and maze.
        shared: See ``NavigationVectorEnv``.
    """

    STATE = (*NavigationVectorEnv.STATE, "contact", "contact_is_inner", "pressed_s", "begins", "presses")

    def __init__(
        self,
        num_envs: int = 1,
        *,
        control_period_s: float = 0.2,
        exploring_starts: float = 0.0,
        randomization: str | Randomization = "none",
        **shared: Any,
    ) -> None:
        if not 0.01 <= control_period_s <= 1.0:
            raise InputError(f"control_period_s {control_period_s} is outside 0.01 to 1 s")
        if not 0.0 <= exploring_starts <= 1.0:
            raise InputError(f"exploring_starts {exploring_starts} is outside 0 to 1")
        self.control_period_s = float(control_period_s)
        self.exploring_starts = float(exploring_starts)
        self.randomization = Randomization.load(randomization)
        self._draws = Draws(self.randomization, checked_num_envs(num_envs))
        self._n_layouts = 0
        super().__init__(num_envs, **shared)
        self._draws.use(self.generators)

    @property
    def step_duration(self) -> float:
        """Cell-times per control period; a cell-time is a cell at the robot's top speed."""
        return self.control_period_s * self.robot.max_speed_m_s / self.layout.cell_size_m

    @property
    def curriculum_strength(self) -> float | None:
        """See ``NavigationVectorEnv.curriculum_strength``."""
        return self._draws.curriculum.strength if self.randomization.curriculum else None

    def follow_curriculum(self, leader: NavigationVectorEnv) -> None:
        """See ``NavigationVectorEnv.follow_curriculum``."""
        assert isinstance(leader, RobotVectorEnv)
        self._draws.curriculum.follow(leader._draws.curriculum)

    def _spaces(self) -> tuple[gym.Space[Any], gym.Space[Any]]:
        largest = replace(self.layout, cell_size_m=self.layout.cell_size_m * self.randomization.cell_size.high)
        return FeatureVector(largest, self.robot).space, Box(-1.0, 1.0, (2,), np.float32)

    @property
    def release_m(self) -> float:
        """``RELEASE_M``, or half of what a robot in the middle of a corridor has on each side."""
        return min(RELEASE_M, (self.layout.cell_size_m / 2 - self.robot.radius_m) / 2)

    def _use_layout(self) -> None:
        super()._use_layout()
        self._geodesic = Geodesic(self.layout, self.robot.radius_m)
        n = self.num_envs
        self._commands = Commands(self._draws, self.robot, n, self.control_period_s)
        self._senses = Senses(self._draws, self.robot, n, self.control_period_s, self.layout.size_m)
        self._goal_number = np.zeros(n, dtype=np.int64)
        # Direction of the wall that the bumper met last and has not left, zero without one.
        self._contact: FloatArray = np.zeros((n, 2))
        self._contact_is_inner = np.zeros(n, dtype=bool)
        self._pressed_s: FloatArray = np.zeros(n)
        # Of the last step: a contact began (or, sliding, went on), and the robot pressed on the wall or scraped along.
        self._begins, self._presses = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)

    def _place(self, ids: IntArray) -> None:
        if self.exploring_starts and "start" not in self._fixed:
            self._explore(ids)
        self._goal_number[ids] = self._geodesic.goal_numbers(self._goal[ids])
        self._contact[ids] = 0.0
        self._pressed_s[ids] = 0.0
        self._commands.begin(ids)
        self._senses.begin(ids, self._pose, self._goal_w, self._lidar)
        metres = self._geodesic.distances(self._pose[ids], self._goal_number[ids])
        self._transition.next_distance[ids] = metres / self.layout.cell_size_m

    def _explore(self, ids: IntArray) -> None:
        """Put some of the robots whose episodes begin somewhere else; headings and goals stay."""
        draws = self._streams.draw(ids, EXPLORING_DRAWS)
        cells = np.argwhere(self.layout.reachable)
        # Cell: uniform over those that the starts reach. Place: uniform within it.
        cells = cells[(draws[:, 1] * len(cells)).astype(np.int64)]
        # Whether: with the probability asked for, unless the goal is there.
        moves = (draws[:, 0] < self.exploring_starts) & (cells != self._goal[ids]).any(axis=1)
        ids, cells, draws = ids[moves], cells[moves], draws[moves]
        points = self.layout.to_metres(cells) + (draws[:, 2:4] - 0.5) * self.layout.cell_size_m
        nearest = self.robot.radius_m + STAND_OFF_M
        # At the nearest wall: one half of them, where there is one within a cell.
        gap, direction, _ = clearances(points, self.layout)
        is_near = gap < self.layout.cell_size_m  # farther walls are not looked for
        points += np.where((draws[:, 4] < 0.5) & is_near, gap - nearest, 0.0)[:, None] * direction
        for _ in range(3):  # off one wall, off the other one in a corner, and off the first again
            gap, direction, _ = clearances(points, self.layout)
            points -= np.maximum(nearest - gap, 0.0)[:, None] * direction
        gap, _, _ = clearances(points, self.layout)
        fits = (gap >= self.robot.radius_m)[:, None]  # else the cell is narrow, and its middle must do
        self._start[ids] = self._cell[ids] = np.where(fits, self.layout.to_cell(points), cells)
        self._pose[ids, :2] = np.where(fits, points, self.layout.to_metres(cells))

    def _begin(self, ids: IntArray) -> None:
        if self.randomization.curriculum:
            step = self._transition
            is_over = (self._steps > 0) & (step.terminal | step.time_up | self._failed)
            self._draws.curriculum.note(ids, is_over[ids], step.at_goal[ids])
        self._draws.draw(ids)
        super()._begin(ids)

    def _vary(self, layout: Layout, fixed: dict[str, Any]) -> Layout:
        """The layout of the next episodes: as it is, or with other walls and another size."""
        varied, draws = self.randomization, self._draws
        if not varied.acts_on("layout"):
            return layout
        if varied.curriculum:
            varied = varied.scaled(draws.curriculum.strength)
        self._n_layouts += 1
        kept = [(int(fixed[end][0]), int(fixed[end][1])) for end in ("start", "goal") if end in fixed]
        rng = np.random.default_rng([int(draws.keys[0]), self._n_layouts])
        # Walls: uniform over the whole numbers in the range. Size: by its law.
        n_walls = int(rng.integers(round(varied.obstacles_moved.low), round(varied.obstacles_moved.high) + 1))
        draws["cell_size"][:] = size = varied.cell_size.at(rng.uniform())
        moved = layout.with_moved_walls(n_walls, rng, kept=kept)
        draws["obstacles_moved"][:] = (moved.walls & ~layout.walls).sum()
        return replace(moved, cell_size_m=layout.cell_size_m * size)

    def use_generators(self, generators: list[np.random.Generator]) -> None:
        """Draw from these generators, one per environment; see ``NavigationVectorEnv.use_generators``."""
        if any(new is not old for new, old in zip(generators, self._streams.generators, strict=True)):
            self._draws.use(generators)
            self._n_layouts = 0
        super().use_generators(generators)

    def _observe(self, ids: IntArray | None = None) -> AnyArray:
        senses = self._senses
        if not senses.is_active:
            return super()._observe(ids)
        state = (senses.poses, senses.ranges_m, senses.goals_w, self._speed, self._last_action)
        return self._features.observe(*(state if ids is None else (part[ids] for part in state)))

    def _info(self, terms: dict[str, FloatArray]) -> dict[str, Any]:
        info = super()._info(terms)
        if self._draws.names:
            info["randomization"] = self._draws.info()
        return info

    def get_state(self) -> State:
        """Everything that decides what comes next; see ``NavigationVectorEnv.get_state``."""
        arrays, values = super().get_state()
        own = {f"imperfections.{name}": array.copy() for name, array in self._imperfections().items()}
        return State(arrays | own, values | {"n_layouts": self._n_layouts})

    def set_state(self, state: State) -> None:
        """Go on where an environment that was made alike was; see ``NavigationVectorEnv.set_state``."""
        for name, own in self._imperfections().items():
            stored = state.arrays.get(f"imperfections.{name}")
            if stored is None or stored.shape != own.shape or stored.dtype != own.dtype:
                raise InputError(f"{name} of the state does not fit the randomization of these environments")
        drawn = state.arrays["imperfections.drawn"]
        if not ((drawn >= LOWEST) & (drawn <= HIGHEST)).all():  # compiled loops trust it
            raise InputError("what the state has drawn is outside what a randomization may draw")
        super().set_state(state)
        for name, own in self._imperfections().items():
            own[:] = state.arrays[f"imperfections.{name}"]
        self._n_layouts = int(state.values["n_layouts"])

    def _imperfections(self) -> dict[str, AnyArray]:
        """Arrays of what was drawn, of commands under way and of what the senses remember."""
        return {**self._draws.arrays(), **self._commands.arrays(), **self._senses.arrays()}

    def _wheel_fractions(self, actions: FloatArray) -> FloatArray:
        """Wheel speeds that the motors are told in this period, shape ``(n, 2)``."""
        return self._commands.moving(self.robot.wheel_fractions(self._commands.pass_on(actions, self._steps)))

    def _drive(self, actions: AnyArray) -> None:
        self._roll(actions)
        self._senses.advance(self._pose, self._steps + 1, self._lidar)
        self._last_action[:] = actions
        step = self._transition
        _judge(
            self.layout.walls.shape,
            self.layout.cell_size_m,
            self.task.goal_radius_m,
            self.control_period_s,
            self.layout.cell_size_m / self.robot.max_speed_m_s,
            self._pose,
            self._goal_w,
            self._goal,
            self._geodesic.distances(self._pose, self._goal_number),
            self._begins,
            self._presses,
            self._contact_is_inner,
            self._failed,
            self._pressed_s,
            self._travelled_m,
            self._cell,
            step.hit,
            step.hit_inner_wall,
            step.at_goal,
            step.next_distance,
            step.manhattan,
        )

    @abstractmethod
    def _roll(self, actions: FloatArray) -> None:
        """Drive for one control period.

        Writes pose, speed, ``self._travelled_m``, ``self._begins``, ``self._presses`` and, where they change,
        ``self._contact``, ``self._contact_is_inner`` and ``self._failed``.
        """

    def _valid(self, actions: AnyArray) -> AnyArray:
        array = as_array(actions)
        if array.shape != (self.num_envs, 2) or array.dtype.kind not in "fiu":
            raise InputError(
                f"action of shape {array.shape} and type {array.dtype} must be two numbers per robot: forward and turn"
            )
        if not np.isfinite(array).all():
            raise InputError(f"action {array[~np.isfinite(array).all(axis=1)][0].tolist()} must be finite numbers")
        # Beyond the box a command means full speed: a robot's firmware clips it too.
        return np.minimum(np.maximum(array.astype(np.float64, order="C"), -1.0), 1.0)


class RobotEnv(NavigationEnv[VectorWorld]):
    """One robot of a ``RobotVectorEnv``."""

    worlds: Any

    @property
    def control_period_s(self) -> float:
        """Time between two commands, seconds."""
        return float(self.worlds.control_period_s)


@numba.njit(cache=True)
def _judge(
    shape: tuple[int, int],
    cell_size_m: float,
    goal_radius_m: float,
    period_s: float,
    cell_time_s: float,
    pose: FloatArray,
    goal_w: FloatArray,
    goal: IntArray,
    to_goal_m: FloatArray,
    begins: BoolArray,
    presses: BoolArray,
    contact_is_inner: BoolArray,
    failed: BoolArray,
    pressed_s: FloatArray,
    travelled_m: FloatArray,
    cell: IntArray,
    hit: BoolArray,
    hit_inner_wall: BoolArray,
    at_goal: BoolArray,
    next_distance: FloatArray,
    manhattan: FloatArray,
) -> None:
    """What a period came to: collisions, one more for every cell-time of pressing, the cell, and arrival."""
    n_rows, n_cols = shape
    for i in range(len(pose)):
        pressed_s[i] = pressed_s[i] + period_s if presses[i] and not begins[i] else 0.0
        again = pressed_s[i] >= cell_time_s
        if again:
            pressed_s[i] = 0.0
        hit[i] = (begins[i] or again) and not failed[i]
        hit_inner_wall[i] = hit[i] and contact_is_inner[i]
        if failed[i]:
            travelled_m[i] = 0.0
        row = n_rows - 1 - int(np.floor(pose[i, 1] / cell_size_m))
        col = int(np.floor(pose[i, 0] / cell_size_m))
        cell[i, 0], cell[i, 1] = min(max(row, 0), n_rows - 1), min(max(col, 0), n_cols - 1)
        next_distance[i] = to_goal_m[i] / cell_size_m
        manhattan[i] = abs(cell[i, 0] - goal[i, 0]) + abs(cell[i, 1] - goal[i, 1])
        at_goal[i] = np.hypot(pose[i, 0] - goal_w[i, 0], pose[i, 1] - goal_w[i, 1]) <= goal_radius_m
