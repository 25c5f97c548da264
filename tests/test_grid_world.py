"""The grid by hand: moves, bumps, slip, observations, text and pictures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from gridnav import Layout, Reward, Task

UP, DOWN, LEFT, RIGHT = range(4)
ID = "gridnav/GridWorld-v0"

# The walls of `classic` as the tutorial has them: row 3 columns 3 to 6, rows 3 to 7 column 3, four single blocks.
CLASSIC_WALLS = {(3, c) for c in range(3, 7)} | {(r, 3) for r in range(3, 8)} | {(1, 5), (5, 1), (7, 8), (8, 2)}
STEPS = {UP: (-1, 0), DOWN: (1, 0), LEFT: (0, -1), RIGHT: (0, 1)}


def play(moves: list[int], *, start: tuple[int, int], goal: tuple[int, int], **arguments: Any) -> list[Any]:
    """What ``step`` returns for each move of one episode."""
    env = gym.make(ID, **({"task": "any"} | arguments))
    env.reset(seed=0, options={"start": start, "goal": goal})
    return [env.step(move) for move in moves]


def test_moves_go_up_down_left_and_right_by_one_cell() -> None:
    steps = play([RIGHT, DOWN, LEFT, UP], start=(0, 0), goal=(9, 9))

    assert [info["cell"] for *_, info in steps] == [(0, 1), (1, 1), (1, 0), (0, 0)]
    assert [info["path_length_m"] for *_, info in steps] == [0.5, 1.0, 1.5, 2.0]
    # Row 0 is the top row: x to the right, y up, ten rows of 0.5 m.
    np.testing.assert_allclose(steps[1][4]["pose"], [0.75, 4.25, -np.pi / 2])  # facing down
    np.testing.assert_allclose(steps[3][4]["pose"], [0.25, 4.75, np.pi / 2])  # facing up


def test_every_move_from_every_free_cell_of_classic_goes_where_the_tutorials_walls_let_it() -> None:
    env = gym.make_vec(ID, num_envs=1, task="any", max_episode_steps=1)

    free = [(r, c) for r in range(10) for c in range(10) if (r, c) not in CLASSIC_WALLS]
    assert len(free) == 100 - 4 - 4 - 4  # (3, 3) is in both arms of the L
    for cell in free:
        for move, (dr, dc) in STEPS.items():
            goal = (9, 9) if cell != (9, 9) else (9, 8)
            env.reset(seed=0, options={"start": cell, "goal": goal})
            info = env.step(np.array([move]))[4]["final_info"]
            to = (cell[0] + dr, cell[1] + dc)
            goes = 0 <= to[0] < 10 and 0 <= to[1] < 10 and to not in CLASSIC_WALLS
            assert tuple(info["cell"][0]) == (to if goes else cell)
            assert info["collision"][0] == (not goes)
            assert info["path_length_m"][0] == (0.5 if goes else 0.0)
            assert info["is_success"][0] == (goes and to == goal)


@pytest.mark.parametrize(
    ("start", "move", "collision"),
    [((1, 4), RIGHT, -1.0), ((0, 0), UP, 0.0), ((0, 0), LEFT, 0.0)],
    ids=["wall cell", "upper edge", "left edge"],
)
def test_the_tutorials_reward_charges_a_wall_cell_and_not_the_edge(
    start: tuple[int, int], move: int, collision: float
) -> None:
    ((_, reward, terminated, _, info),) = play([move], start=start, goal=(9, 9), reward="seed")

    # Off the edge: -0.1 + 0.1 * (20 - d) / 20 with d = 18 from (0, 0), so -0.1 + 0.01.
    assert reward == pytest.approx(-1.0 if collision else -0.09)
    assert info["reward_terms"]["collision"] == collision
    assert (info["cell"], info["collision"], terminated) == (start, True, False)


def test_the_reward_of_a_move_is_the_one_worked_out_by_hand() -> None:
    reward = Reward(goal=10.0, collision_cost=2.0, distance_cost=0.05, time_cost=0.25, progress=0.5, gamma=0.99)
    steps = play([RIGHT, LEFT, LEFT], start=(0, 0), goal=(0, 2), reward=reward)

    # Distances 2 -> 1 -> 2 -> 2 (bump).
    terms = [info["reward_terms"] for *_, info in steps]
    np.testing.assert_allclose([t["progress"] for t in terms], [0.5 * (2 - 0.99), 0.5 * (1 - 1.98), 0.5 * (2 - 1.98)])
    np.testing.assert_allclose([t["distance"] for t in terms], [-0.05, -0.05, 0.0])
    np.testing.assert_allclose([t["time"] for t in terms], [-0.25] * 3)
    np.testing.assert_allclose([t["collision"] for t in terms], [0.0, 0.0, -2.0])
    assert [t["goal"] for t in terms] == [0.0] * 3


def test_the_shortest_path_is_the_fewest_moves() -> None:
    env = gym.make(ID, task="any")

    # From (0, 4) straight down is walled by row 3, columns 3 to 6; (4, 4) is reached around its right end at column 7:
    # 3 right, 4 down, 3 left.
    _, info = env.reset(options={"start": (0, 4), "goal": (4, 4)})
    assert info["shortest_path_m"] == (3 + 4 + 3) * 0.5


def test_a_path_of_fewest_moves_ends_with_success_and_the_shortest_length() -> None:
    steps = play([RIGHT, RIGHT, DOWN], start=(0, 0), goal=(1, 2))

    assert [terminated for _, _, terminated, _, _ in steps] == [False, False, True]
    info = steps[-1][4]
    assert info["is_success"]
    assert info["path_length_m"] == info["shortest_path_m"] == 1.5


def test_cell_goal_is_the_cell_times_the_goals_plus_the_goals_rank() -> None:
    env = gym.make(ID)
    goals = [(7, 7), (7, 9), (8, 7), (8, 8), (8, 9), (9, 7), (9, 8), (9, 9)]  # row by row, (7, 8) is a wall
    assert [tuple(goal) for goal in env.unwrapped.worlds.goal_cells.tolist()] == goals

    for rank, goal in enumerate(goals):
        observation, _ = env.reset(options={"start": (0, 2), "goal": goal})
        assert observation == 2 * 8 + rank
        observation, *_ = env.step(DOWN)
        assert observation == 12 * 8 + rank


def test_cell_observations_are_the_row_times_ten_plus_the_column() -> None:
    env = gym.make(ID, observation="cell")

    assert env.reset(options={"start": (2, 1)})[0] == 21
    assert env.step(DOWN)[0] == 31


def test_cell_observations_do_not_tell_the_goal_and_cell_goal_ones_do() -> None:
    """Defect 1 of the tutorial: with the cell alone the problem is not Markov."""
    seen: dict[str, set[int]] = {"cell": set(), "cell_goal": set()}
    for mode, observations in seen.items():
        env = gym.make(ID, observation=mode)
        for goal in ((7, 7), (9, 9)):
            observations.add(env.reset(options={"start": (0, 0), "goal": goal})[0])

    assert {mode: len(observations) for mode, observations in seen.items()} == {"cell": 1, "cell_goal": 2}


def test_a_goal_that_cell_goal_cannot_name_is_refused() -> None:
    env = gym.make(ID)

    with pytest.raises(ValueError, match=r"goal \(0, 5\)"):
        env.reset(options={"goal": (0, 5)})
    assert gym.make(ID, observation="cell").reset(options={"goal": (0, 5)})[1]["cell"] != (0, 5)


def test_a_layout_with_another_number_of_goals_is_refused_for_cell_goal() -> None:
    env = gym.make(ID, layout="S..\n..G\n")

    with pytest.raises(ValueError, match="2 goals, the environment 1"):
        env.reset(options={"layout": "S..\n.GG\n"})
    env.reset(options={"layout": "..S\nG..\n"})  # as many goals, elsewhere
    assert env.unwrapped.worlds.start_and_goal(0) == ((0, 2), (1, 0))


def test_starts_and_goals_are_drawn_evenly_from_the_corners() -> None:
    env = gym.make_vec(ID, num_envs=2000)
    env.reset(seed=0)
    starts, goals = env._start.tolist(), env._goal.tolist()

    # 9 starts and 8 goals, each expected 222 and 250 times; 5 standard deviations are 71 and 74.
    for cells, number, expected in ((starts, 9, 222), (goals, 8, 250)):
        _, counts = np.unique(np.array(cells), axis=0, return_counts=True)
        assert len(counts) == number
        assert np.abs(counts - expected).max() < 75
    assert {tuple(cell) for cell in starts} == {(r, c) for r in range(3) for c in range(3)}
    assert {tuple(cell) for cell in goals} == {(r, c) for r in range(7, 10) for c in range(7, 10)} - {(7, 8)}


@pytest.mark.parametrize("slip", [-0.1, 1.1, np.nan, 2])
def test_slip_is_a_probability(slip: float) -> None:
    with pytest.raises(ValueError, match=f"slip {slip}"):
        gym.make(ID, slip=slip)


@pytest.mark.parametrize("observation", ["pixels", "", None, 3])
def test_an_unknown_observation_is_refused(observation: Any) -> None:
    with pytest.raises(ValueError, match="observation"):
        gym.make(ID, observation=observation)


@pytest.mark.parametrize("move", [UP, RIGHT])
def test_a_slip_goes_to_either_side_with_half_its_probability(move: int) -> None:
    n, slip = 20_000, 0.3
    env = gym.make_vec(ID, num_envs=n, layout="open", task="any", slip=slip)
    env.reset(seed=0, options={"start": (5, 5), "goal": (0, 0)})

    _, _, _, _, info = env.step(np.full(n, move))

    went = info["cell"] - (5, 5)
    ahead, back = STEPS[move], (-STEPS[move][0], -STEPS[move][1])
    sides = [(0, -1), (0, 1)] if move == UP else [(-1, 0), (1, 0)]
    share = {step: float((went == step).all(axis=1).mean()) for step in [ahead, back, *sides]}
    # Binomial: five standard deviations of a share p are 5 * sqrt(p * (1 - p) / n), 0.0162 for 0.7 and 0.0126 for 0.15.
    assert share[ahead] == pytest.approx(0.7, abs=0.0162)
    assert [share[side] for side in sides] == pytest.approx([0.15, 0.15], abs=0.0126)
    assert share[back] == 0.0
    assert sum(share.values()) == 1.0


def test_slips_are_drawn_anew_in_each_step_and_for_each_robot() -> None:
    env = gym.make_vec(ID, num_envs=50, layout="open", task="any", slip=0.5)
    env.reset(seed=0, options={"start": (9, 5), "goal": (0, 0)})

    slipped = []
    before = np.tile([9, 5], (50, 1))
    for _ in range(8):
        cells = env.step(np.full(50, UP))[4]["cell"]
        slipped.append((cells[:, 0] == before[:, 0]).tolist())
        before = cells

    patterns = np.array(slipped).T
    assert len({tuple(pattern) for pattern in patterns}) > 40
    assert 0.35 < patterns.mean() < 0.65  # 400 draws of 0.5: five standard deviations are 0.125


def test_without_slip_nothing_is_drawn_while_moving() -> None:
    moved, waited = (gym.make(ID) for _ in range(2))
    moved.reset(seed=0)
    waited.reset(seed=0)
    for _ in range(50):
        moved.step(DOWN)

    np.testing.assert_array_equal(moved.reset()[1]["pose"], waited.reset()[1]["pose"])


def test_a_bump_ends_the_episode_where_the_task_is_fragile() -> None:
    ((_, _, terminated, truncated, info),) = play([UP], start=(0, 0), goal=(9, 9), task=Task("any", "any", "end"))

    assert (terminated, truncated, info["is_success"]) == (True, False, False)


# ---- Text and pictures ---------------------------------------------------------------------------


def test_the_text_shows_walls_robot_and_goal_with_row_0_on_top() -> None:
    env = gym.make(ID, layout="S..\n.#G\n", render_mode="ansi")
    env.reset()

    assert env.render() == "R..\n.#G\n"
    env.step(RIGHT)
    assert env.render() == ".R.\n.#G\n"
    env.step(RIGHT)
    env.step(DOWN)
    assert env.render() == "...\n.#*\n"


def colour(picture: np.ndarray, cell: tuple[int, int], *, at: tuple[float, float] = (0.5, 0.5)) -> tuple[int, ...]:
    """Pixel at a place in a cell of the 10 x 10 picture; (0, 0) is the cell's upper left corner."""
    return tuple(picture[int((cell[0] + at[0]) * 50), int((cell[1] + at[1]) * 50)].tolist())


@pytest.fixture
def draw() -> Callable[..., np.ndarray]:
    """Pictures of `classic` after moves from a start."""

    def picture(start: tuple[int, int], goal: tuple[int, int], moves: list[int]) -> np.ndarray:
        env = gym.make(ID, task="any", render_mode="rgb_array")
        env.reset(seed=0, options={"start": start, "goal": goal})
        for move in moves:
            env.step(move)
        drawn = env.render()
        env.close()
        return drawn

    return picture


def test_the_picture_shows_walls_and_goal_where_they_are(draw: Callable[..., np.ndarray]) -> None:
    from gridnav.envs import painter

    picture = draw((0, 0), (9, 8), [])

    assert (picture.shape, picture.dtype) == ((500, 500, 3), np.uint8)
    for row in range(10):
        for col in range(10):
            if (row, col) in CLASSIC_WALLS:
                assert colour(picture, (row, col)) == painter.WALL
            elif (row, col) == (9, 8):
                assert colour(picture, (row, col)) == painter.GOAL
            elif (row, col) != (0, 0):
                assert colour(picture, (row, col)) == painter.FLOOR


def test_up_is_drawn_upwards(draw: Callable[..., np.ndarray]) -> None:
    """Defect 6 of the tutorial: rows grew upward and arrows did not."""
    from gridnav.envs import painter

    before, after = draw((6, 7), (0, 0), []), draw((6, 7), (0, 0), [UP])

    def centre(picture: np.ndarray) -> np.ndarray:
        return np.argwhere((picture == painter.ROBOT).all(axis=2)).mean(axis=0)

    # Picture rows count from the top: up means fewer, by one cell of 50 pixels.
    np.testing.assert_allclose(centre(after) - centre(before), [-50, 0], atol=6)  # the nose turns
    np.testing.assert_allclose(centre(after), [5.5 * 50, 7.5 * 50], atol=6)
    # The white nose points up.
    assert colour(after, (5, 7), at=(0.35, 0.5)) == painter.NOSE
    assert colour(after, (5, 7), at=(0.65, 0.5)) == painter.ROBOT


@pytest.mark.parametrize("start", [(0, 0), (6, 7), (9, 0)])
def test_the_start_is_marked_where_the_episode_started(draw: Callable[..., np.ndarray], start: tuple[int, int]) -> None:
    """Defect 5 of the tutorial: the start was drawn at (0, 0) whatever it was."""
    from gridnav.envs import painter

    picture = draw(start, (9, 9), [RIGHT, RIGHT])

    marked = np.argwhere((picture == painter.START).all(axis=2)) / 50 - start
    assert len(marked) > 200
    assert marked.min() > 0.0
    assert marked.max() < 1.0


def test_rendering_draws_no_random_numbers_and_moves_nothing() -> None:
    drawn, blind = gym.make(ID, render_mode="rgb_array", slip=0.5), gym.make(ID, slip=0.5)
    drawn.reset(seed=0)
    blind.reset(seed=0)

    for move in np.random.default_rng(0).integers(4, size=30):
        drawn.render()
        assert drawn.step(move)[:4] == blind.step(move)[:4]


def test_a_picture_is_fresh_memory() -> None:
    env = gym.make(ID, render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    kept = first.copy()
    env.step(DOWN)
    second = env.render()

    assert not np.shares_memory(first, second)
    np.testing.assert_array_equal(first, kept)


def test_a_batch_draws_one_picture_per_robot() -> None:
    env = gym.make_vec(ID, num_envs=2, render_mode="rgb_array")
    env.reset(seed=0)
    pictures = env.render()

    assert len(pictures) == 2
    text = gym.make_vec(ID, num_envs=2, render_mode="ansi")
    text.reset(seed=0)
    assert len(text.render()) == 2


def test_the_window_opens_shows_and_closes_without_a_display(monkeypatch: pytest.MonkeyPatch) -> None:
    import pygame

    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = gym.make(ID, render_mode="human")
    env.reset(seed=0)

    assert env.render() is None
    assert pygame.display.get_surface().get_size() == (500, 500)
    env.step(RIGHT)
    env.render()
    env.close()
    assert pygame.display.get_surface() is None
    env.close()


def test_features_on_the_grid_see_the_walls_from_the_cells_centre() -> None:
    env = gym.make(ID, layout=Layout.from_text("....\n....\n..#.\n....\n"), observation="features")
    env.reset(options={"start": (2, 0), "goal": (0, 3)})
    observation, *_ = env.step(UP)  # at (1, 0), facing up
    lidar = observation[env.unwrapped.features.slices["lidar"]] * 3.5

    # The lidar stands 0.032 m behind the centre: ahead 0.25 + 0.5 + 0.032 to the upper edge, to the left 0.25,
    # behind 0.25 + 1.0 - 0.032, to the right 1.75.
    np.testing.assert_allclose(lidar[[0, 6, 12, 18]], [0.782, 0.25, 1.218, 1.75], atol=1e-6)
