"""GridWorld: moves between cells."""

from __future__ import annotations

from typing import Any, Literal

import gymnasium as gym
import numba
import numpy as np
from gymnasium.spaces import Discrete
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from gridnav.problem.geodesic import cell_distances
from gridnav.problem.grid_mdp import MOVE_HEADINGS_RAD, SIDEWAYS, MoveTable
from gridnav.problem.layout import Layout
from gridnav.problem.types import AnyArray, BoolArray, FloatArray, InputError, IntArray

from .navigation import NavigationVectorEnv, as_array
from .painter import Painter
from .single import NavigationEnv

ObservationMode = Literal["cell_goal", "cell", "features"]
OBSERVATION_MODES = ("cell_goal", "cell", "features")


class GridWorldVectorEnv(NavigationVectorEnv):
    """``num_envs`` robots on the grid, stepped as arrays; see ``GridWorldEnv`` for the page of the environment."""

    metadata: dict[str, Any] = {
        "render_modes": ["ansi", "rgb_array", "human"],
        "render_fps": 10,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }
    world = "GridWorld"

    def __init__(
        self, num_envs: int = 1, *, observation: ObservationMode = "cell_goal", slip: float = 0.0, **shared: Any
    ) -> None:
        if observation not in OBSERVATION_MODES:
            raise InputError(f"observation {observation!r} is none of {', '.join(OBSERVATION_MODES)}")
        if not 0.0 <= slip <= 1.0:
            raise InputError(f"slip {slip} is outside [0, 1]: it is the probability of going sideways")
        self.observation, self.slip = observation, float(slip)
        self._painter: Painter | None = None
        super().__init__(num_envs, **shared)

    @property
    def step_duration(self) -> float:
        """A move takes one cell-time."""
        return 1.0

    def _spaces(self) -> tuple[gym.Space[Any], gym.Space[Any]]:
        spaces: dict[str, gym.Space[Any]] = {
            "cell_goal": Discrete(self.layout.n_cells * len(self.goal_cells)),
            "cell": Discrete(self.layout.n_cells),
            "features": self._features.space,
        }
        return spaces[self.observation], Discrete(4)

    def _use_layout(self) -> None:
        super()._use_layout()
        self._table = MoveTable.of(self.layout)
        self._cells = np.stack(np.divmod(np.arange(self.layout.n_cells), self.layout.n_cols), axis=1)
        self._centres = self.layout.to_metres(self._cells)
        self._position = np.zeros(self.num_envs, dtype=np.int64)  # number of the cell, row by row
        self._n_goals = len(self.goal_cells)
        # Moves from all cells to each goal met so far, and which row of them is a cell's (-1 for none).
        self._moves_to_goal: NDArray[np.uint16] = np.empty((0, self.layout.n_cells), dtype=np.uint16)
        self._row_of_cell = np.full(self.layout.n_cells, -1)
        # Each robot's goal: number of its cell, row among the moves, and place among the goals.
        self._goal_number, self._goal_row, self._goal_place = (np.zeros(self.num_envs, np.int64) for _ in range(3))

    def _numbers(self, cells: IntArray) -> IntArray:
        return cells[..., 0] * self.layout.n_cols + cells[..., 1]

    def _checked_options(self, options: dict[str, Any] | None) -> tuple[dict[str, Any], Layout]:
        fixed, layout = super()._checked_options(options)
        goals = self.task.goal_cells(layout)
        if self.observation == "cell_goal":
            if "goal" in fixed and not (goals == fixed["goal"]).all(axis=1).any():
                raise InputError(
                    f"reset option goal {tuple(fixed['goal'].tolist())} is no goal of this task, which cell_goal "
                    'observations cannot name: use task="any" or another observation'
                )
            if len(goals) != len(self.goal_cells):
                raise InputError(
                    f"reset option layout has {len(goals)} goals, the environment {len(self.goal_cells)}: cell_goal "
                    "observations need the same number"
                )
        return fixed, layout

    def _place(self, ids: IntArray) -> None:
        goals = self._numbers(self._goal[ids])
        rows = self._row_of_cell[goals]
        if rows.min() < 0:
            self._add_goals(np.unique(goals[rows < 0]))
        _place(
            ids,
            self._cell,
            goals,
            self.layout.n_cols,
            self._row_of_cell,
            self.goal_ranks.ravel(),
            self._moves_to_goal,
            self._position,
            self._goal_number,
            self._goal_row,
            self._goal_place,
            self._transition.next_distance,
        )

    def _add_goals(self, goals: IntArray) -> None:
        """Work out the moves from all cells to further goals, given by their cells' numbers."""
        cells = [divmod(int(goal), self.layout.n_cols) for goal in goals]
        moves = np.stack([cell_distances(self.layout, cell).ravel() for cell in cells])
        moves[~np.isfinite(moves)] = 0.0  # walls: nobody is ever there
        self._row_of_cell[goals] = len(self._moves_to_goal) + np.arange(len(goals))
        self._moves_to_goal = np.concatenate([self._moves_to_goal, moves.astype(np.uint16)])

    def _valid(self, actions: AnyArray) -> AnyArray:
        array = as_array(actions)
        if array.shape != (self.num_envs,) or array.dtype.kind not in "iu":
            raise InputError(
                f"action {_short(actions)} must be a whole number per environment, 0 up, 1 down, 2 left or 3 right"
            )
        if (array >> 2).any():  # other bits than the two of a move
            wrong = array[(array < 0) | (array > 3)][0]
            raise InputError(f"action {wrong} is outside Discrete(4): 0 up, 1 down, 2 left, 3 right")
        return array.astype(np.int64)

    def _drive(self, actions: AnyArray) -> None:
        if self.slip > 0.0:
            # Slip: with probability `slip` the move goes to one of its two sides, each as likely.
            draws = self._streams.draw(np.arange(self.num_envs), 2)
            side = SIDEWAYS[actions, (draws[:, 1] < 0.5).astype(np.int64)]
            actions = np.where(draws[:, 0] < self.slip, side, actions)
        step = self._transition
        _move(
            actions,
            self._table.next_cell,
            self._table.hit_inner_wall,
            MOVE_HEADINGS_RAD,
            self._cells,
            self._centres,
            self._moves_to_goal,
            self._goal_number,
            self._goal_row,
            self._goal,
            self.layout.cell_size_m,
            self._position,
            self._cell,
            self._pose,
            self._travelled_m,
            step.hit,
            step.hit_inner_wall,
            step.at_goal,
            step.next_distance,
            step.manhattan,
        )
        if self.observation == "features":
            self._speed[:, 0] = ~step.hit
            self._last_action[:, 0] = 1.0

    def _observe(self, ids: IntArray | None = None) -> AnyArray:
        if self.observation == "features":
            return super()._observe(ids)
        position, place = self._position, self._goal_place
        if ids is not None:
            position, place = position[ids], place[ids]
        return position.copy() if self.observation == "cell" else position * self._n_goals + place

    def render(self) -> tuple[Any, ...] | None:
        """A picture or text per environment, as ``render_mode`` says; the window of ``human`` shows the first."""
        if self.render_mode is None:
            return None
        if self.render_mode == "ansi":
            return tuple(self._text(i) for i in range(self.num_envs))
        self._painter = self._painter or Painter(fps=self.metadata["render_fps"])
        if self.render_mode == "human":
            self._painter.show(self.layout, self._pose[0], self._start[0], self._goal[0], self.layout.cell_size_m * 0.3)
            return None
        return tuple(
            self._painter.picture(self.layout, pose, start, goal, self.layout.cell_size_m * 0.3)
            for pose, start, goal in zip(self._pose, self._start, self._goal, strict=True)
        )

    def _text(self, i: int) -> str:
        """The maze with the robot R and the goal G; the robot at its goal is an asterisk."""
        grid = np.where(self.layout.walls, "#", ".")
        cell, goal = tuple(self._cell[i]), tuple(self._goal[i])
        grid[goal] = "G"
        grid[cell] = "*" if cell == goal else "R"
        return "\n".join("".join(row) for row in grid) + "\n"

    def close_extras(self, **kwargs: Any) -> None:
        """Close the window."""
        if self._painter is not None:
            self._painter.close()
            self._painter = None


class GridWorldEnv(NavigationEnv[GridWorldVectorEnv]):
    """A robot that moves from cell to cell towards a goal.

    ## Action space

    ``Discrete(4)``: 0 up, 1 down, 2 left, 3 right. A move into a wall or off the edge leaves the robot where it is and
    counts as a collision. With ``slip`` a move goes to one of its two sides with that probability.

    ## Observation space

    | observation | space |
    | --- | --- |
    | ``cell_goal`` (default) | ``Discrete(cells x goals)``: cell * n_goals + goal; goals as in ``goal_cells`` |
    | ``cell`` | ``Discrete(cells)``: the robot's cell alone, which does not say where the goal is |
    | ``features`` | ``Box``: the feature vector of the robot worlds, with the lidar at the cell's centre |

    ## Reward

    See ``gridnav.Reward``; one move takes one cell-time.

    ## Episode start and end

    The task draws start and goal. ``terminated`` at the goal (and at a collision, where the task says so);
    ``truncated`` after ``max_episode_steps`` (100 with ``gym.make``).

    Args:
        observation: One of the three above.
        slip: Probability that a move goes sideways.
        shared: ``layout``, ``task``, ``reward``, ``render_mode`` and ``max_episode_steps``, see
            ``NavigationVectorEnv``.
    """

    metadata: dict[str, Any] = {
        "render_modes": GridWorldVectorEnv.metadata["render_modes"],
        "render_fps": GridWorldVectorEnv.metadata["render_fps"],
    }

    def __init__(self, *, observation: ObservationMode = "cell_goal", slip: float = 0.0, **shared: Any) -> None:
        super().__init__(GridWorldVectorEnv(1, observation=observation, slip=slip, autoreset=False, **shared))


@numba.njit(cache=True)
def _place(
    ids: IntArray,
    cell: IntArray,
    goals: IntArray,
    n_cols: int,
    row_of_cell: IntArray,
    goal_rank: IntArray,
    moves_to_goal: NDArray[np.uint16],
    position: IntArray,
    goal_number: IntArray,
    goal_row: IntArray,
    goal_place: IntArray,
    next_distance: FloatArray,
) -> None:
    for k in range(len(ids)):
        i, goal = ids[k], goals[k]
        position[i] = cell[i, 0] * n_cols + cell[i, 1]
        goal_number[i], goal_row[i], goal_place[i] = goal, row_of_cell[goal], goal_rank[goal]
        next_distance[i] = moves_to_goal[goal_row[i], position[i]]


@numba.njit(cache=True)
def _move(
    actions: IntArray,
    next_cell: IntArray,
    bumps_inner_wall: BoolArray,
    headings: FloatArray,
    cells: IntArray,
    centres: FloatArray,
    moves_to_goal: NDArray[np.uint16],
    goal_number: IntArray,
    goal_row: IntArray,
    goal: IntArray,
    cell_size_m: float,
    position: IntArray,
    cell: IntArray,
    pose: FloatArray,
    travelled_m: FloatArray,
    hit: BoolArray,
    hit_inner_wall: BoolArray,
    at_goal: BoolArray,
    next_distance: FloatArray,
    manhattan: FloatArray,
) -> None:
    for i in range(len(position)):
        before, action = np.uint64(position[i]), np.uint64(actions[i])  # unsigned: no check for negative indices
        now = np.uint64(next_cell[before, action])
        position[i], hit[i] = now, now == before
        hit_inner_wall[i] = bumps_inner_wall[before, action]
        travelled_m[i] = 0.0 if now == before else cell_size_m
        cell[i, 0], cell[i, 1] = cells[now, 0], cells[now, 1]
        pose[i, 0], pose[i, 1], pose[i, 2] = centres[now, 0], centres[now, 1], headings[action]
        next_distance[i] = moves_to_goal[np.uint64(goal_row[i]), now]
        manhattan[i] = abs(cell[i, 0] - goal[i, 0]) + abs(cell[i, 1] - goal[i, 1])
        at_goal[i] = now == np.uint64(goal_number[i])


def _short(value: Any) -> str:
    text = repr(value).replace("\n", " ")
    return text if len(text) <= 60 else text[:57] + "..."
