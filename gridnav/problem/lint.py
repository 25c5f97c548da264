"""Proof that a reward is sane: no behaviour that avoids the goal may earn as much as reaching it.

On the grid the proof is exact: the best goal-avoiding return is the solution of the same Markov decision process with
the moves into the goal forbidden. Robots are tried with scripted behaviours, in ``gridnav.experiment.robot_lint``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gridnav.problem.geodesic import cell_distances
from gridnav.problem.grid_mdp import GridMDP, MoveTable
from gridnav.problem.layout import Layout
from gridnav.problem.reward import Reward, Transition, total
from gridnav.problem.task import Task
from gridnav.problem.types import Cell, InputError


@dataclass(frozen=True)
class Finding:
    """The best that avoiding the goal earns, against reaching it, from the start where it does best."""

    world: str
    """The environment's name."""
    behaviour: str
    """What avoids the goal: a loop of cells, or a scripted behaviour."""
    start: Cell
    """Start cell (row, column)."""
    goal: Cell
    """Goal cell (row, column)."""
    avoiding_return: float
    """Discounted return of never reaching the goal."""
    reaching_return: float
    """Discounted return of the best way to the goal."""

    @property
    def is_sane(self) -> bool:
        """Reaching the goal pays more."""
        return self.avoiding_return < self.reaching_return

    def __str__(self) -> str:
        """One line for people."""
        verdict = "ok  " if self.is_sane else "FAIL"
        return (
            f"{verdict} {self.world}: {self.behaviour} from {self.start}, goal {self.goal}: avoiding the goal earns "
            f"{self.avoiding_return:.3f}, reaching it {self.reaching_return:.3f}"
        )


def lint_grid(reward: Reward, layout: Layout, task: Task, *, gamma: float | None = None) -> Finding:
    """Compare the best goal-avoiding return with the best return, over all starts and goals of the task.

    Args:
        reward: The reward to judge.
        layout: The maze.
        task: Gives starts, goals and what a collision does.
        gamma: Discount per move, the reward's own by default; below 1, since returns are compared over all time.

    Returns:
        The start and goal where avoiding comes closest to, or gets past, reaching.
    """
    gamma = reward.gamma if gamma is None else gamma
    if not 0.0 < gamma < 1.0:
        raise InputError(f"gamma {gamma} is outside (0, 1): the lint compares discounted returns over all time")
    worst: tuple[float, Finding] | None = None
    for goal in map(tuple, task.goal_cells(layout).tolist()):
        mdp = GridMDP.of(layout, goal, reward, task, gamma=gamma)
        into_goal = mdp.next_cell == goal[0] * layout.n_cols + goal[1]
        best = mdp.solve().max(axis=1)
        # A cell whose every move enters the goal cannot avoid it and proves nothing.
        avoiding = mdp.solve(forbidden=into_goal)
        starts = [row * layout.n_cols + col for row, col in task.start_cells(layout).tolist() if (row, col) != goal]
        margins = best[starts] - avoiding[starts].max(axis=1)
        margins[~np.isfinite(margins)] = np.inf
        if margins.min(initial=np.inf) < (worst[0] if worst else np.inf):
            start = starts[int(margins.argmin())]
            # Where avoiding is the best policy of all, the optimum itself never arrives: both returns are equal.
            finding = Finding(
                world="GridWorld",
                behaviour=_loop(mdp, avoiding.argmax(axis=1), start, layout.n_cols),
                start=(start // layout.n_cols, start % layout.n_cols),
                goal=goal,
                avoiding_return=float(avoiding[start].max()),
                reaching_return=float(best[start])
                if margins.min() > 1e-6
                else _return_of_shortest(mdp, start, goal, layout),
            )
            worst = float(margins.min()), finding
    if worst is None:
        raise InputError("this layout leaves no way to avoid the goal, so there is nothing to compare")
    return worst[1]


def lint_idling(reward: Reward, layout: Layout, task: Task) -> Finding:
    """Whether standing still earns anything, at the cell where it earns most.

    A learner that sees a fraction of the way ahead settles for what pays at once, so idling must cost at every
    distance, also where the goal would pay more.

    Returns:
        The cell and goal where idling forever does best; sane when it costs there.
    """
    best: Finding | None = None
    for goal in map(tuple, task.goal_cells(layout).tolist()):
        cells = np.argwhere(layout.reachable)
        distance = cell_distances(layout, goal)[tuple(cells.T)]
        n, nothing = len(cells), np.zeros(len(cells), dtype=bool)
        step = Transition(
            travelled=np.zeros(n),
            duration=np.ones(n),
            distance=distance,
            next_distance=distance,
            manhattan=np.abs(cells - goal).sum(axis=1).astype(np.float64),
            at_goal=nothing,
            hit=nothing,
            hit_inner_wall=nothing,
            terminal=nothing,
            time_up=nothing,
        )
        earned = np.where(distance > 0, total(reward.terms(step)), -np.inf)
        i = int(earned.argmax())
        if best is None or earned[i] > best.avoiding_return:
            cell = (int(cells[i][0]), int(cells[i][1]))
            best = Finding("all worlds", "standing still for one cell-time", cell, goal, float(earned[i]), 0.0)
    assert best is not None, "a layout has at least one goal"
    return best


def lint_crashing(reward: Reward, layout: Layout, task: Task) -> Finding | None:
    """Whether a collision that ends the episode pays at once; none where the task lets episodes go on.

    There the potential drops to 0, which pays ``progress*D``. Over a whole episode every end is paid the same, but a
    learner that sees a fraction of the way ahead would crash for it.

    Returns:
        The cell and goal where crashing earns most at once; sane when it costs there.
    """
    if task.on_collision != "end":
        return None
    worst: Finding | None = None
    for goal in map(tuple, task.goal_cells(layout).tolist()):
        mdp = GridMDP.of(layout, goal, reward, task)
        crashes = MoveTable.of(layout).hit & layout.reachable.ravel()[:, None]
        crashes[goal[0] * layout.n_cols + goal[1]] = False
        earned = np.where(crashes, mdp.reward, -np.inf).max(axis=1)
        cell = int(earned.argmax())
        if worst is None or earned[cell] > worst.avoiding_return:
            at = (cell // layout.n_cols, cell % layout.n_cols)
            worst = Finding("all worlds", "ending the episode by a collision", at, goal, float(earned[cell]), 0.0)
    return worst


def _loop(mdp: GridMDP, policy: np.ndarray, start: int, n_cols: int) -> str:
    """The cells that the policy ends up repeating, in words."""
    seen: list[int] = []
    cell = start
    while cell not in seen:
        seen.append(cell)
        if mdp.terminal[cell, policy[cell]]:
            return f"ending the episode by a collision at cell {(cell // n_cols, cell % n_cols)}"
        cell = int(mdp.next_cell[cell, policy[cell]])
    cells = [(c // n_cols, c % n_cols) for c in seen[seen.index(cell) :]]
    if len(cells) == 1:
        return f"bumping at cell {cells[0]} forever"
    return "looping over cells " + " ".join(map(str, cells))


def _return_of_shortest(mdp: GridMDP, start: int, goal: Cell, layout: Layout) -> float:
    """Best discounted return among the policies that do arrive: maximise over the number of moves."""
    target = goal[0] * layout.n_cols + goal[1]
    n_moves = 4 * layout.n_cells
    values = np.full(len(mdp.next_cell), -np.inf)
    best = -np.inf
    for _ in range(n_moves):
        arrives = mdp.next_cell == target
        action_values = np.where(arrives, mdp.reward, mdp.reward + mdp.gamma * values[mdp.next_cell])
        action_values[mdp.terminal & ~arrives] = -np.inf
        values = action_values.max(axis=1)
        best = max(best, float(values[start]))
    return best
