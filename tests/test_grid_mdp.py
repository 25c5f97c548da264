"""The grid in tables: moves by hand, values by hand and by brute force, and the same numbers as the environment."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from gridnav import Layout, Reward, Task
from gridnav.envs import GridWorldVectorEnv
from gridnav.problem.grid_mdp import MOVE_HEADINGS_RAD, MOVES, GridMDP, MoveTable
from gridnav.problem.types import FloatArray

REWARD = Reward(goal=10.0, collision_cost=3.0, distance_cost=0.1, time_cost=0.2, progress=0.0, gamma=0.9)
CORRIDOR = Layout.from_text("S.G\n")
UP, DOWN, LEFT, RIGHT = range(4)


def test_moves_lead_to_the_cell_beside_or_bump() -> None:
    table = MoveTable.of(Layout.from_text("S#\n.G\n"))

    # By hand, cells 0 1 / 2 3 with a wall at 1; up, down, left, right.
    assert table.next_cell[[0, 2, 3]].tolist() == [[0, 2, 0, 0], [0, 2, 2, 3], [3, 3, 2, 3]]
    assert table.hit[[0, 2, 3]].tolist() == [
        [True, False, True, True],
        [False, True, True, False],
        [True, True, False, True],
    ]
    inner = np.argwhere(table.hit_inner_wall[[0, 2, 3]]).tolist()
    assert inner == [[0, RIGHT], [2, UP]], "into the wall cell; every other bump is off the edge"


def test_a_move_goes_the_way_that_its_heading_points() -> None:
    """Rows grow downwards and y upwards: the tutorial's pictures mixed them up."""
    layout = Layout.load("open")
    for move, heading in zip(MOVES, MOVE_HEADINGS_RAD, strict=True):
        before, after = layout.to_metres(np.array([5, 5])), layout.to_metres(np.array([5, 5]) + move)
        np.testing.assert_allclose(after - before, 0.5 * np.array([np.cos(heading), np.sin(heading)]), atol=1e-12)


def test_values_along_a_corridor() -> None:
    mdp = GridMDP.of(CORRIDOR, (0, 2), REWARD, Task())

    action_values = mdp.solve()

    # By hand: a step costs 0.3, the goal pays 10, a bump costs 3.2. From 1: 10 - 0.3 = 9.7. From 0: -0.3 + 0.9 * 9.7 =
    # 8.43. Bumping at 0: -3.2 + 0.9 * 8.43 = 4.387. Back from 1: -0.3 + 0.9 * 8.43 = 7.287.
    assert action_values[0] == pytest.approx([4.387, 4.387, 4.387, 8.43])
    assert action_values[1, LEFT] == pytest.approx(7.287)
    assert action_values[1, RIGHT] == pytest.approx(9.7)


def test_a_slip_goes_to_either_side_with_half_its_probability() -> None:
    mdp = GridMDP.of(CORRIDOR, (0, 2), REWARD, Task(), slip=0.2)

    backed_up = mdp.action_values(np.array([1.0, 2.0, 0.0]))

    # By hand, from 1: right pays 9.7 for good; up and down bump and stay: -3.2 + 0.9 * 2 = -1.4; left pays
    # -0.3 + 0.9 = 0.6.
    assert backed_up[1, RIGHT] == pytest.approx(0.8 * 9.7 + 0.2 * -1.4)
    assert backed_up[1, UP] == pytest.approx(0.8 * -1.4 + 0.1 * 0.6 + 0.1 * 9.7)


def test_a_collision_is_final_only_where_the_task_says_so() -> None:
    values = np.array([100.0, 100.0, 0.0])

    stop, end = (
        GridMDP.of(CORRIDOR, (0, 2), REWARD, Task(on_collision=on_collision)).action_values(values)
        for on_collision in ("stop", "end")
    )

    assert stop[0, UP] == pytest.approx(-3.2 + 0.9 * 100)
    assert end[0, UP] == pytest.approx(-3.2)
    assert stop[0, RIGHT] == end[0, RIGHT]


def test_a_forbidden_move_is_not_chosen() -> None:
    mdp = GridMDP.of(CORRIDOR, (0, 2), REWARD, Task())

    action_values = mdp.solve(forbidden=mdp.next_cell == 2)

    # By hand: without the goal the cheapest is to walk to and fro forever: -0.3 / (1 - 0.9) = -3.
    assert action_values[1, RIGHT] == -np.inf
    assert action_values[:2].max(axis=1) == pytest.approx([-3.0, -3.0])


def test_the_discount_is_the_rewards_own_unless_another_is_given() -> None:
    assert GridMDP.of(CORRIDOR, (0, 2), REWARD, Task()).gamma == 0.9
    assert GridMDP.of(CORRIDOR, (0, 2), REWARD, Task(), gamma=0.5).gamma == 0.5


def best_by_brute_force(mdp: GridMDP) -> FloatArray:
    """The best value of each cell over all deterministic policies, each evaluated by solving its linear equations."""
    n = len(mdp.next_cell)
    best = np.full(n, -np.inf)
    for policy in itertools.product(range(4), repeat=n):
        moves = np.arange(n), np.array(policy)
        onward = np.zeros((n, n))
        onward[np.arange(n), mdp.next_cell[moves]] = mdp.gamma * ~mdp.terminal[moves]
        best = np.maximum(best, np.linalg.solve(np.eye(n) - onward, mdp.reward[moves]))
    return best


@pytest.mark.parametrize("on_collision", ["stop", "end"])
@pytest.mark.parametrize("reward", [Reward(), REWARD, Reward.preset("seed")], ids=["default", "plain", "seed"])
def test_the_solution_is_the_best_of_all_policies(reward: Reward, on_collision: str) -> None:
    layout = Layout.from_text("S#\n.G\n..\n")
    task = Task(on_collision=on_collision)  # type: ignore[arg-type]
    mdp = GridMDP.of(layout, (1, 1), reward, task, gamma=0.95)
    free = ~layout.walls.ravel()

    solved = mdp.solve().max(axis=1)

    np.testing.assert_allclose(solved[free], best_by_brute_force(mdp)[free], atol=1e-7)


@pytest.mark.parametrize("reward", ["default", "seed"])
@pytest.mark.parametrize("on_collision", ["stop", "slide", "end"])
def test_the_tables_are_those_of_the_environment(reward: str, on_collision: str) -> None:
    classic = Layout.load("classic")
    task = Task(starts="any", on_collision=on_collision)  # type: ignore[arg-type]
    mdps = [GridMDP.of(classic, (r, c), Reward.load(reward), task) for r, c in classic.goal_cells.tolist()]
    n = 256
    env = GridWorldVectorEnv(n, layout=classic, task=task, reward=reward)
    rng = np.random.default_rng(0)
    observations, _ = env.reset(seed=0)
    seen = set()
    for _ in range(60):
        cells, goals = np.divmod(observations, len(mdps))
        actions = rng.integers(4, size=n)
        observations, rewards, terminated, truncated, info = env.step(actions)
        arrived = info["final_info"]["cell"] if "final_info" in info else info["cell"]

        for i in range(n):
            mdp, move = mdps[goals[i]], (cells[i], actions[i])
            assert rewards[i] == pytest.approx(mdp.reward[move], abs=1e-12)
            assert terminated[i] == mdp.terminal[move]
            assert divmod(int(mdp.next_cell[move]), 10) == tuple(arrived[i])
        assert not truncated.any()
        seen |= set(zip(cells.tolist(), actions.tolist(), strict=True))

    assert len(seen) > 300, "nearly all of the 88 cells x 4 moves"
