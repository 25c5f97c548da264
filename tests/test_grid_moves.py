"""Grid moves on a continuous robot: where a move ends, what it earns, and the grid's plan on real wheels."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gridnav.envs.grid_moves import ARRIVED_M, steer
from gymnasium.utils.env_checker import check_env

from gridnav import Layout, Reward, Task
from gridnav.agents import Planner
from gridnav.envs import GridMoves
from gridnav.problem.robot import BURGER

UP, DOWN, LEFT, RIGHT = range(4)
ROBOTS = ["gridnav/DiffDrive-v0", "gridnav/Unicycle-v0"]

pytestmark = pytest.mark.parametrize("env_id", ROBOTS)


def make(env_id: str, *, observation: str = "cell_goal", **arguments: Any) -> GridMoves:
    """A robot that takes grid moves, anywhere on `classic`."""
    return GridMoves(gym.make(env_id, **({"task": "any"} | arguments)), observation=observation)


@pytest.mark.parametrize("observation", ["cell_goal", "cell", "features"])
def test_gymnasiums_checker_passes_without_a_warning(env_id: str, observation: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Two things are known: wrappers are not what the checker asks for, and MuJoCo draws elsewhere.
        warnings.filterwarnings("ignore", message=".*different from the unwrapped version.*")
        check_env(make(env_id, observation=observation), skip_render_check=True)


@pytest.mark.parametrize(("move", "step"), [(UP, (-1, 0)), (DOWN, (1, 0)), (LEFT, (0, -1)), (RIGHT, (0, 1))])
@pytest.mark.parametrize("heading", [0.0, 2.0, -1.3])
def test_a_move_ends_at_the_next_cells_centre(env_id: str, move: int, step: tuple[int, int], heading: float) -> None:
    env = make(env_id)
    env.reset(seed=0, options={"start": (5, 6), "goal": (0, 0), "heading_rad": heading})

    _, _, terminated, truncated, info = env.step(move)

    cell = (5 + step[0], 6 + step[1])
    assert info["cell"] == cell
    centre = env.unwrapped.layout.to_metres(np.array(cell))
    assert np.hypot(*(info["pose"][:2] - centre)) < ARRIVED_M
    assert (terminated, truncated, info["collisions"]) == (False, False, 0)
    # Not before the cell is crossed, and with a half turn at half speed, 2.6 s, not long after.
    assert 0.46 / BURGER.max_speed_m_s <= info["duration_s"] <= 0.5 / BURGER.max_speed_m_s * 1.15 + 3.2
    assert info["duration_s"] == pytest.approx(info["elapsed_s"])


def test_many_moves_do_not_add_up_their_errors(env_id: str) -> None:
    env = make(env_id, max_episode_steps=10_000)
    env.reset(seed=0, options={"start": (4, 5), "goal": (0, 0)})

    cells = []
    for move in [RIGHT, DOWN, LEFT, UP] * 5:
        info = env.step(move)[4]
        cells.append(info["cell"])
        centre = env.unwrapped.layout.to_metres(np.array(info["cell"]))
        assert np.hypot(*(info["pose"][:2] - centre)) < ARRIVED_M

    assert cells == [(4, 6), (5, 6), (5, 5), (4, 5)] * 5
    assert info["collisions"] == 0


@pytest.mark.parametrize(("start", "move"), [((0, 0), UP), ((4, 4), UP), ((1, 4), RIGHT)], ids=["edge", "L", "block"])
def test_a_move_into_a_wall_counts_one_collision_and_ends(env_id: str, start: tuple[int, int], move: int) -> None:
    env = make(env_id)
    env.reset(seed=0, options={"start": start, "goal": (9, 9), "heading_rad": 0.0})

    _, reward, terminated, truncated, info = env.step(move)

    assert (info["cell"], info["collision"], info["collisions"]) == (start, True, 1)
    assert (terminated, truncated) == (False, False)
    assert reward < 0.0
    assert info["duration_s"] < 3.0


def test_pressing_on_against_a_wall_ends_too(env_id: str) -> None:
    """The contact is counted once, so a second move into the same wall ends because nothing moves."""
    env = make(env_id)
    env.reset(seed=0, options={"start": (0, 0), "goal": (9, 9), "heading_rad": np.pi / 2})
    env.step(UP)

    info = env.step(UP)[4]

    assert info["cell"] == (0, 0)
    assert info["collisions"] == 1
    assert info["duration_s"] <= 5.0
    # And the way back is free.
    info = env.step(DOWN)[4]
    assert (info["cell"], info["collisions"]) == ((1, 0), 1)


def test_the_reward_is_the_discounted_sum_of_the_steps_rewards(env_id: str) -> None:
    """Replayed on a twin, command by command."""
    reward = Reward(gamma=0.9)
    env, twin = make(env_id, reward=reward), gym.make(env_id, task="any", reward=reward)
    options = {"start": (0, 0), "goal": (1, 1), "heading_rad": 0.5}
    env.reset(seed=0, options=options)
    _, info = twin.reset(seed=0, options=options)
    gamma = twin.unwrapped.worlds.step_gamma
    # A control period is 0.2 * 0.197 / 0.5 = 0.0788 cell-times.
    assert gamma == pytest.approx(0.9**0.0788, rel=1e-4)

    for move, step in ((RIGHT, (0, 1)), (DOWN, (1, 0))):
        total, discount, steps = 0.0, 1.0, 0
        target = twin.unwrapped.layout.to_metres(np.array(info["cell"]) + step)
        terminated = False
        while np.hypot(*(info["pose"][:2] - target)) >= ARRIVED_M and not terminated:
            command = steer(info["pose"][None], target[None], BURGER, 0.2)[0].astype(np.float32)
            _, one, terminated, _, info = twin.step(command)
            total += discount * one
            discount *= gamma
            steps += 1

        _, earned, over, _, move_info = env.step(move)

        assert earned == pytest.approx(total, abs=1e-12)
        assert move_info["discount"] == pytest.approx(discount)
        assert move_info["duration_s"] == pytest.approx(steps * 0.2)
        np.testing.assert_array_equal(move_info["pose"], info["pose"])
        assert over == terminated
    assert move_info["is_success"]


def test_observations_are_those_of_the_grid(env_id: str) -> None:
    grid = gym.make("gridnav/GridWorld-v0")
    env = make(env_id, task="default")
    options = {"start": (0, 1), "goal": (8, 9)}

    assert env.observation_space == grid.observation_space
    assert env.action_space == grid.action_space
    seen, expected = [env.reset(options=options)[0]], [grid.reset(options=options)[0]]
    for move in (RIGHT, DOWN, DOWN, LEFT):
        seen.append(env.step(move)[0])
        expected.append(grid.step(move)[0])
    assert seen == expected

    cell = make(env_id, observation="cell")
    assert cell.reset(options={"start": (2, 1)})[0] == 21
    features = make(env_id, observation="features")
    assert features.reset(seed=0)[0] in features.observation_space


@pytest.mark.parametrize("bad", [4, -1, 1.0, np.nan, "up", None, [1], [0, [1]], True])
def test_a_wrong_move_is_named_and_changes_nothing(env_id: str, bad: Any) -> None:
    env, twin = make(env_id), make(env_id)
    env.reset(seed=0)
    twin.reset(seed=0)

    with pytest.raises(ValueError, match="action") as caught:
        env.step(bad)

    assert "\n" not in str(caught.value)
    assert env.step(DOWN)[:4] == twin.step(DOWN)[:4]


def test_an_unknown_observation_is_refused(env_id: str) -> None:
    with pytest.raises(ValueError, match="pixels"):
        make(env_id, observation="pixels")


def test_the_time_limit_ends_a_move(env_id: str) -> None:
    env = make(env_id, max_episode_steps=4)
    env.reset(seed=0, options={"start": (5, 6), "goal": (0, 0), "heading_rad": 0.0})

    _, _, terminated, truncated, info = env.step(RIGHT)

    assert (terminated, truncated) == (False, True)
    assert info["duration_s"] == pytest.approx(0.8)


def test_a_collision_that_ends_the_episode_ends_the_move(env_id: str) -> None:
    env = make(env_id, task=Task("any", "any", "end"))
    env.reset(seed=0, options={"start": (0, 0), "goal": (9, 9), "heading_rad": np.pi / 2})

    _, _, terminated, _, info = env.step(UP)

    assert (terminated, info["is_success"], info["collisions"]) == (True, False, 1)


@pytest.mark.parametrize("heading", [0.0, 3.0])
def test_the_planners_table_drives_the_robot_across_the_maze_without_a_collision(env_id: str, heading: float) -> None:
    layout, task = Layout.load("classic"), Task.load("default")
    planner = Planner.solve(layout, task, Reward())
    env = make(env_id, task=task, max_episode_steps=2000)
    observation, info = env.reset(seed=0, options={"start": (0, 0), "goal": (9, 9), "heading_rad": heading})

    moves = 0
    terminated = False
    while not terminated and moves < 40:
        observation, _, terminated, truncated, info = env.step(int(planner.act(np.array([observation]))[0]))
        moves += 1
        assert not truncated

    # (0, 0) to (9, 9): nine down and nine right.
    assert (info["is_success"], info["collisions"], moves) == (True, 0, 18)
    assert info["path_length_m"] == pytest.approx(18 * 0.5 - 0.15, abs=0.3)
