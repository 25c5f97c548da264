"""The diagnosis of what robots do instead of arriving: on traces by hand, and in the real worlds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from gridnav.envs.grid_moves import steer
from numpy.typing import NDArray

from gridnav.agents import Planner
from gridnav.envs import NavigationVectorEnv
from gridnav.experiment.evaluation import evaluate, policy_for
from gridnav.experiment.worlds import make_worlds
from gridnav.problem.behaviour import BEHAVIOURS, diagnose
from gridnav.problem.layout import Layout
from gridnav.problem.metrics import Trace, summarise
from gridnav.problem.reward import Reward
from gridnav.problem.robot import Robot
from gridnav.problem.task import Task
from gridnav.problem.types import FloatArray

OPEN = Layout.load("open")
"""5 m square, without inner walls."""
ROBOT = Robot(wheel_radius_m=0.1, max_wheel_speed_rad_s=5.0)
"""0.5 m/s: a cell-time is 1 s, so with steps of 0.2 s a window is 20 steps and lasting is 40."""
STEP_S = 0.2
FAR_W = np.array([4.75, 0.25])
NOTHING = dict.fromkeys(BEHAVIOURS, 0.0)


def shares(poses: FloatArray, *, hits: tuple[int, ...] = (), goal_w: FloatArray = FAR_W) -> dict[str, float]:
    """Diagnosis of a robot that went through these poses."""
    n = len(poses) - 1
    trace = Trace(
        np.arange(n + 1) * STEP_S,
        poses,
        np.zeros((n + 1, 24)),
        np.zeros((n, 2)),
        {},
        np.isin(np.arange(n), hits).astype(np.int64),
    )
    return diagnose(trace, goal_w=goal_w, layout=OPEN, robot=ROBOT)


def grid_shares(cells: list[tuple[int, int]], goal: tuple[int, int] = (9, 9)) -> dict[str, float]:
    """Diagnosis of a grid robot that went through these cells; where it stays it bumped."""
    at = np.array(cells)
    n = len(cells) - 1
    poses = np.column_stack([OPEN.to_metres(at), np.zeros(n + 1)])
    bumps = (np.diff(at, axis=0) == 0).all(axis=1).astype(np.int64)
    times = np.arange(n + 1) * OPEN.cell_size_m / ROBOT.max_speed_m_s
    trace = Trace(times, poses, np.zeros((n + 1, 24)), np.zeros((n, 1)), {}, bumps)
    return diagnose(trace, goal_w=OPEN.to_metres(np.array(goal)), layout=OPEN, robot=ROBOT)


def still(n: int, x: float = 2.5, y: float = 2.5) -> FloatArray:
    """``n`` steps in one place, shape ``(n + 1, 3)``."""
    return np.tile([x, y, 0.0], (n + 1, 1))


def straight(n: int, *, x: float = 0.5, y: float = 2.5) -> FloatArray:
    """``n`` steps to the right at 0.2 m/s."""
    return np.column_stack([x + 0.04 * np.arange(n + 1), np.full(n + 1, y), np.zeros(n + 1)])


def wrapped(angles: FloatArray) -> FloatArray:
    return (angles + np.pi) % (2 * np.pi) - np.pi


# ---- By hand -----------------------------------------------------------------------------------


def test_driving_straight_or_standing_in_the_open_is_no_behaviour() -> None:
    assert shares(straight(100)) == NOTHING
    assert shares(still(100)) == NOTHING


def test_turning_on_the_spot_counts_for_as_long_as_it_lasts() -> None:
    poses = np.concatenate([straight(40), still(60, x=2.1)[1:]])
    # A full turn in 19.5 steps: only a window of nothing but turning, 20 steps, has one.
    poses[41:, 2] = wrapped(2 * np.pi / 19.5 * np.arange(1, 61))

    # By hand: 60 of 100 steps.
    assert shares(poses) == NOTHING | {"rotate-in-place": pytest.approx(0.6)}


@pytest.mark.parametrize(("n_turning", "expected"), [(40, 0.4), (39, 0.0)])
def test_what_takes_less_than_eight_cell_times_is_no_behaviour(n_turning: int, expected: float) -> None:
    poses = np.concatenate([straight(100 - n_turning), still(n_turning, x=0.5 + 0.04 * (100 - n_turning))[1:]])
    poses[-n_turning:, 2] = wrapped(2 * np.pi / 19.5 * np.arange(1, n_turning + 1))

    assert shares(poses)["rotate-in-place"] == pytest.approx(expected)


def test_a_circle_wider_than_the_robot_is_not_on_the_spot_but_leads_nowhere() -> None:
    # By hand: 0.105 m is the robot's radius. At 0.05 m and a turn in 15 steps it turns on the spot. At 0.3 m, a turn
    # in 19 steps, a window holds 2 m of driving and ends where it began, or nearly: dithering.
    for radius_m, period, behaviour in ((0.05, 15, "rotate-in-place"), (0.3, 19, "dithering")):
        angles = 2 * np.pi / period * np.arange(101)
        circle = 2.5 + radius_m * np.column_stack([np.cos(angles), np.sin(angles)])

        assert shares(np.column_stack([circle, wrapped(angles + np.pi / 2)])) == NOTHING | {behaviour: 1.0}


def test_swinging_left_and_right_on_the_spot_is_dithering() -> None:
    poses = still(100)
    poses[1::2, 2] = 0.4  # 20 steps turn by 8 rad, and by nothing in sum

    assert shares(poses) == NOTHING | {"dithering": 1.0}


def test_driving_to_and_fro_is_dithering_and_driving_round_a_wall_is_not() -> None:
    # 0.04 m a step, turning back every fifth: a window drives 0.8 m, more than a cell, and ends where it began.
    x = np.abs((np.arange(101) + 5) % 10 - 5) * 0.04
    assert shares(np.column_stack([2.5 + x, np.full((101, 2), (2.5, 0.0))])) == NOTHING | {"dithering": 1.0}

    # Around the end of a wall one cell thick: 1 m along it, 0.71 m across, 1 m back. By hand: the window of 2 m that
    # is least far from where it began has 0.645 m on both sides and 0.71 m between: 0.35 of the way.
    corner_points = np.array([[2.0, 2.0], [3.0, 2.0], [3.0, 2.71], [2.0, 2.71]])
    along = np.arange(0.0, 2.71, 0.1)
    ends = np.array([0.0, 1.0, 1.71, 2.71])
    way = np.column_stack([np.interp(along, ends, corner_points[:, axis]) for axis in (0, 1)])
    lead = np.column_stack([np.arange(0.6, 2.0, 0.1), np.full(14, 2.0)])
    poses = np.concatenate([lead, way, np.column_stack([np.arange(1.9, 0.5, -0.1), np.full(14, 2.71)])])
    assert shares(np.column_stack([poses, np.zeros(len(poses))])) == NOTHING


def test_pressing_into_a_wall_is_hugging_it() -> None:
    gap = ROBOT.radius_m + 0.01

    assert shares(still(100, y=gap)) == NOTHING | {"wall-hugging": 1.0}
    assert shares(still(100, y=ROBOT.radius_m + 0.04)) == NOTHING


def test_gliding_along_a_wall_is_no_behaviour_unless_the_robot_keeps_bumping() -> None:
    along = straight(100, y=ROBOT.radius_m + 0.01)

    assert shares(along) == NOTHING
    assert shares(along, hits=tuple(range(0, 100, 10))) == NOTHING | {"wall-hugging": 1.0}
    assert shares(straight(100), hits=tuple(range(0, 100, 10))) == NOTHING, "bumps away from walls are no hugging"


def test_staying_near_the_goal_without_arriving_is_loitering() -> None:
    # 1.5 cells are 0.75 m.
    assert shares(still(100), goal_w=np.array([2.5, 3.2])) == NOTHING | {"goal-loitering": 1.0}
    assert shares(still(100), goal_w=np.array([2.5, 3.3])) == NOTHING


def test_an_episode_shorter_than_a_behaviour_has_none() -> None:
    assert shares(still(39), goal_w=np.array([2.5, 2.5])) == NOTHING
    assert shares(still(0)) == NOTHING


def test_on_the_grid_the_same_names_mean_moves() -> None:
    to_and_fro = [(4, 4), (4, 5)] * 5
    bumping = [(0, 4)] * 10
    three_of_four = [(0, 4), (0, 4), (0, 4), (0, 4), (0, 5)] * 3
    round_the_goal = [(4, 4), (4, 5), (4, 6), (5, 6), (6, 6), (6, 5), (6, 4), (5, 4)] * 2
    staircase = [(i // 2, (i + 1) // 2) for i in range(19)]

    assert grid_shares(to_and_fro) == NOTHING | {"dithering": 1.0}
    assert grid_shares(bumping) == NOTHING | {"wall-hugging": 1.0}
    assert grid_shares(three_of_four)["wall-hugging"] > 0.5
    assert grid_shares(round_the_goal, goal=(5, 5)) == NOTHING | {"goal-loitering": 1.0}
    assert grid_shares(round_the_goal) == NOTHING, "a wide loop far from the goal is a detour as far as one can tell"
    assert grid_shares(staircase) == NOTHING


# ---- In the real worlds ------------------------------------------------------------------------


def diagnosed(worlds: NavigationVectorEnv, policy: Callable[[NDArray[Any]], NDArray[Any]]) -> list[set[str]]:
    """What each episode under a policy is diagnosed with."""
    return [{name for name, share in e.behaviours.items() if share > 0} for e in evaluate(policy, worlds)]


def commands(*rows: tuple[float, float]) -> Callable[[NDArray[Any]], NDArray[Any]]:
    """A policy that repeats these commands, whatever it sees."""
    step = iter(range(10_000))
    return lambda seen: np.tile(np.array(rows[next(step) % len(rows)], np.float32), (len(seen), 1))


def moves(*row: int) -> Callable[[NDArray[Any]], NDArray[Any]]:
    """A policy that repeats these moves, whatever it sees."""
    step = iter(range(10_000))
    return lambda seen: np.full(len(seen), row[next(step) % len(row)])


@pytest.mark.parametrize("world", ["Unicycle", "DiffDrive"])
def test_a_robot_that_only_turns_is_said_to_rotate_in_place(world: str) -> None:
    assert diagnosed(make_worlds(world, 4), commands((0.0, 0.5))) == [{"rotate-in-place"}] * 4


@pytest.mark.parametrize("world", ["Unicycle", "DiffDrive"])
def test_a_robot_that_only_drives_ahead_is_said_to_hug_the_wall_it_meets(world: str) -> None:
    assert diagnosed(make_worlds(world, 4, max_episode_steps=300), commands((1.0, 0.0))) == [{"wall-hugging"}] * 4


@pytest.mark.parametrize("world", ["Unicycle", "DiffDrive"])
def test_a_robot_that_turns_back_every_half_second_is_said_to_dither(world: str) -> None:
    policy = commands(*[(1.0, 0.0)] * 3, *[(-1.0, 0.0)] * 3)

    assert diagnosed(make_worlds(world, 4, max_episode_steps=200), policy) == [{"dithering"}] * 4


def test_a_robot_that_circles_its_goal_is_said_to_loiter() -> None:
    worlds = make_worlds("Unicycle", 4, layout=".....\n.....\n.SG..\n.....\n.....\n", max_episode_steps=300)

    def circle(observations: NDArray[Any]) -> NDArray[Any]:
        poses, goals_w = worlds.features.poses_and_goals(observations)
        ahead = np.arctan2(*(poses[:, :2] - goals_w).T[::-1]) + 0.5
        targets = goals_w + 0.5 * np.column_stack([np.cos(ahead), np.sin(ahead)])
        return steer(poses, targets, worlds.robot, 0.2).astype(np.float32)

    # A circle of 0.5 m radius is too wide for dithering.
    assert diagnosed(worlds, circle) == [{"goal-loitering"}] * 4


def test_a_grid_robot_is_diagnosed_too() -> None:
    worlds = make_worlds("GridWorld", 4, layout="open", max_episode_steps=40)

    assert all("dithering" in names for names in diagnosed(worlds, moves(2, 3)))
    assert all("wall-hugging" in names for names in diagnosed(worlds, moves(0)))


@pytest.mark.parametrize("world", ["GridWorld", "Unicycle", "DiffDrive"])
def test_a_plan_that_arrives_shows_no_behaviour(world: str) -> None:
    layout = Layout.load("classic")
    worlds = make_worlds(world, 20, layout=layout)
    planner = Planner.solve(layout, Task(), Reward())

    episodes = evaluate(policy_for(planner, worlds), worlds)

    assert all(episode.behaviours == NOTHING for episode in episodes)
    assert summarise(episodes).behaviours == NOTHING
