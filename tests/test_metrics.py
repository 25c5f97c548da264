"""Metrics by hand, and what a perfect drive measures."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from gridnav.agents import Planner
from gridnav.envs import NavigationVectorEnv
from gridnav.experiment.evaluation import evaluate, policy_for
from gridnav.experiment.worlds import make_worlds
from gridnav.problem.geodesic import Geodesic
from gridnav.problem.layout import Layout
from gridnav.problem.metrics import Episode, Motion, Trace, driving_time, measure_motion, success_weighted, summarise
from gridnav.problem.reward import Reward
from gridnav.problem.robot import BURGER, Robot
from gridnav.problem.statistics import wilson_interval
from gridnav.problem.task import Task
from gridnav.problem.types import FloatArray

OPEN = Layout.load("open")

EPISODE = Episode(
    start=(0, 0),
    goal=(9, 9),
    is_success=True,
    collisions=0,
    path_length_m=4.0,
    shortest_path_m=2.0,
    elapsed_s=40.0,
    shortest_time_s=10.0,
    steps=100,
    episode_return=5.0,
)


def test_spl_weighs_each_success_by_how_direct_it_was() -> None:
    # By hand: direct 2/2 = 1, a detour 2/4 = 0.5, a failure 0: 1.5/3. A way shorter than the shortest counts as 1.
    assert success_weighted([True, True, False], np.full(3, 2.0), np.array([2.0, 4.0, 2.0])) == pytest.approx(0.5)
    assert success_weighted([True], np.array([2.0]), np.array([1.0])) == 1.0


def test_an_episode_that_starts_at_its_goal_counts_in_full() -> None:
    assert success_weighted([True, True], np.array([0.0, 1.0]), np.array([0.0, 4.0])) == pytest.approx((1 + 0.25) / 2)
    assert success_weighted([True], np.array([0.0]), np.array([3.0])) == 0.0


@given(st.lists(st.tuples(st.booleans(), st.floats(0, 100), st.floats(0, 100)), min_size=1, max_size=30))
def test_spl_is_never_more_than_the_success_rate(rows: list[tuple[bool, float, float]]) -> None:
    successes, best, taken = zip(*rows, strict=True)

    spl = success_weighted(successes, np.array(best), np.array(taken))

    assert 0.0 <= spl <= np.mean(successes) + 1e-12


# ---- Shortest time -----------------------------------------------------------------------------

SIMPLE = Robot(wheel_radius_m=0.1, max_wheel_speed_rad_s=5.0, wheel_separation_m=0.5)
"""0.5 m/s and 2 rad/s."""


def test_the_shortest_time_has_the_turns_and_ends_at_the_edge_of_the_goal() -> None:
    # By hand: 1 m up, a left turn, 2 m to the left of which the last 0.5 m need not be driven: 2.5 m, 5 s. The robot
    # looks to the right: pi/2 to look up and pi/2 at the corner, at 2 rad/s.
    path = np.array([[0.0, 0.0], [0.0, 1.0], [-2.0, 1.0]])

    assert driving_time(path, 0.0, SIMPLE, 0.5) == pytest.approx(5.0 + np.pi / 2)


def test_a_turn_beyond_the_edge_of_the_goal_is_not_needed() -> None:
    path = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.25]])

    # By hand: of 1.25 m the last 0.5 m are spared, the corner with them.
    assert driving_time(path, 0.0, SIMPLE, 0.5) == pytest.approx(0.75 / 0.5)
    assert driving_time(path, 0.0, SIMPLE, 0.125) == pytest.approx(1.125 / 0.5 + np.pi / 4)
    assert driving_time(path, 0.0, SIMPLE, 2.0) == 0.0, "the start lies within the goal"


def test_a_robot_that_looks_away_drives_backwards() -> None:
    path = np.array([[0.0, 0.0], [1.0, 0.0]])

    assert driving_time(path, np.pi, SIMPLE, 0.0) == pytest.approx(2.0)
    # By hand: at 135 degrees the rear is 45 degrees off: pi/4 at 2 rad/s. Across the cut of the angle as well.
    assert driving_time(path, 0.75 * np.pi, SIMPLE, 0.0) == pytest.approx(2.0 + np.pi / 8)
    assert driving_time(-path, -0.75 * np.pi, SIMPLE, 0.0) == pytest.approx(2.0 + np.pi / 8)


DIAGONAL = Layout.load("classic")
DIAGONAL = Layout(DIAGONAL.walls, *(np.isin(np.arange(100), cell).reshape(10, 10) for cell in (74, 96)))
"""From cell (7, 4) to (9, 6) of the classic maze: nothing in between."""


def test_every_world_is_measured_against_its_own_shortest_way() -> None:
    planner = Planner.solve(DIAGONAL, Task(), Reward())
    episodes = {}
    for world in ("GridWorld", "Unicycle"):
        worlds = make_worlds(world, 3, layout=DIAGONAL)
        episodes[world] = evaluate(policy_for(planner, worlds), worlds)

    for one in episodes["GridWorld"]:
        # By hand: four moves, 2 m and four cell-times of 0.5 m at 5.969 rad/s * 0.033 m.
        assert (one.shortest_path_m, one.goal_radius_m) == (2.0, 0.0)
        assert one.shortest_time_s == pytest.approx(4 * 0.5 / (5.969 * 0.033))
    for one in episodes["Unicycle"]:
        # By hand: the diagonal of 1 m by 1 m, of which the last 0.15 m are spared; the heading it wants is -45 degrees.
        assert one.shortest_path_m == pytest.approx(np.sqrt(2))
        assert one.needed_path_m == pytest.approx(np.sqrt(2) - 0.15)
        assert one.trace is not None
        off = abs(one.trace.poses[0, 2] + np.pi / 4) % np.pi
        turn_s = min(off, np.pi - off) / BURGER.max_turn_rad_s
        assert one.shortest_time_s == pytest.approx((np.sqrt(2) - 0.15) / BURGER.max_speed_m_s + turn_s)
    assert summarise(episodes["GridWorld"]).spl == summarise(episodes["GridWorld"]).sct == 1.0
    # A plan drives the two sides of the square: 2 m less the 0.15 m, for what could be 1.26 m.
    assert summarise(episodes["Unicycle"]).spl == pytest.approx(1.264 / 1.85, abs=0.02)


def shortest_drive(worlds: NavigationVectorEnv) -> Callable[[NDArray[Any]], NDArray[Any]]:
    """A policy that turns in place and drives straight, both at full speed, along shortest ways; backwards first."""
    geodesic = Geodesic(worlds.layout, worlds.robot.radius_m + 0.01)  # a little room, so that nothing is touched
    ways: list[FloatArray] = []
    turn_per_step, metres_per_step = worlds.robot.max_turn_rad_s * 0.2, worlds.robot.max_speed_m_s * 0.2

    def act(observations: NDArray[Any]) -> NDArray[Any]:
        poses, goals_w = worlds.features.poses_and_goals(observations)
        actions = np.zeros((len(poses), 2), np.float32)
        for i, (pose, goal_w) in enumerate(zip(poses, goals_w, strict=True)):
            if len(ways) <= i:
                row, col = worlds.layout.to_cell(goal_w[None])[0]
                ways.append(geodesic.path(pose, (int(row), int(col)))[1:])
            if len(ways[i]) > 1 and np.hypot(*(ways[i][0] - pose[:2])) < 1e-3:
                ways[i] = ways[i][1:]
            gap = ways[i][0] - pose[:2]
            error = (np.arctan2(gap[1], gap[0]) - pose[2] + np.pi) % (2 * np.pi) - np.pi
            forward = 1.0 if abs(error) < np.pi / 2 else -1.0
            error = error if forward > 0 else error - np.copysign(np.pi, error)
            if abs(error) > 1e-3:
                actions[i, 1] = np.clip(error / turn_per_step, -1.0, 1.0)
            else:
                actions[i, 0] = forward * min(1.0, np.hypot(*gap) / metres_per_step)
        return actions

    return act


@pytest.mark.parametrize("layout", ["open", "classic"])
def test_a_perfect_drive_takes_the_shortest_length_and_time_and_never_less(layout: str) -> None:
    worlds = make_worlds("Unicycle", 30, layout=layout)

    episodes = evaluate(shortest_drive(worlds), worlds)

    for one in episodes:
        assert one.is_success
        assert one.collisions == 0
        # A step is 0.04 m, of which the last may go too far; the room around the corners costs up to 3 cm.
        assert 0.0 <= one.path_length_m - one.needed_path_m <= 0.08
        # A step is 0.2 s; every leg and every turn ends with a part of one: four points at a corner cost up to 1.6 s.
        corners = 0.0 if layout == "open" else 3.2
        assert 0.0 <= one.elapsed_s - one.shortest_time_s <= 0.6 + corners
    assert summarise(episodes).spl > 0.98


# ---- Motion ------------------------------------------------------------------------------------


def trace_of(positions: FloatArray, actions: FloatArray, headings: FloatArray | None = None) -> Trace:
    """A trace with steps of 0.5 s."""
    n = len(positions) - 1
    heading = np.zeros(n + 1) if headings is None else headings
    poses = np.column_stack([positions, heading])
    return Trace(0.5 * np.arange(n + 1), poses, np.zeros((n + 1, 24)), actions, {}, np.zeros(n, dtype=np.int64))


def test_motion_by_hand() -> None:
    # x = t^3: its third derivative is 6, and so is its third difference over 0.5^3. y stays.
    seconds = 0.5 * np.arange(4)
    positions = np.column_stack([0.2 + seconds**3, np.full(4, 1.0)])
    actions = np.array([[0.0, 0.0], [0.6, 0.8], [3.0, 0.8]])

    motion = measure_motion(trace_of(positions, actions, np.array([3.0, -3.0, -2.5, -2.5])), OPEN, SIMPLE)

    assert motion.jerk_m_s3 == pytest.approx(6.0)
    # By hand: the first pose is 0.2 m off the left wall, the radius 0.105 m.
    assert motion.clearance_m == pytest.approx(0.095)
    # From 3 to -3 rad it is 2*pi - 6 across the cut, then 0.5.
    assert motion.turned_rad == pytest.approx(2 * np.pi - 6 + 0.5)
    # (0.36 + 0.64 + 0.4^2) / 2: a command of 3 means 1.
    assert motion.action_change == pytest.approx((1.0 + 0.16) / 2)
    assert motion.still_share == 0.0


def test_slower_than_a_twentieth_is_standing_still() -> None:
    # By hand: 0.5 m/s * 0.5 s * 0.05 = 0.0125 m a step.
    positions = np.column_stack([1.0 + np.array([0.0, 0.012, 0.025, 0.037, 0.237]), np.full(5, 1.0)])

    assert measure_motion(trace_of(positions, np.zeros((4, 2))), OPEN, SIMPLE).still_share == 0.5


def test_on_the_grid_a_change_of_move_counts_as_one_and_jerk_and_clearance_mean_nothing() -> None:
    positions = np.array([[0.25, 0.25], [0.75, 0.25], [0.75, 0.25], [0.75, 0.75]])
    moves = np.array([[3], [3], [0]])

    motion = measure_motion(trace_of(positions, moves), OPEN, SIMPLE)

    assert motion == Motion(clearance_m=None, turned_rad=0.0, jerk_m_s3=None, action_change=0.5, still_share=1 / 3)


def test_one_step_is_enough_to_measure() -> None:
    motion = measure_motion(trace_of(np.array([[1.0, 1.0], [1.1, 1.0]]), np.ones((1, 2))), OPEN, SIMPLE)

    assert (motion.jerk_m_s3, motion.action_change, motion.still_share) == (0.0, 0.0, 0.0)


# ---- Summaries ---------------------------------------------------------------------------------


def test_a_summary_holds_every_metric() -> None:
    episodes = [
        EPISODE,  # SPL 2/4, SCT 10/40
        replace(EPISODE, path_length_m=2.0, elapsed_s=10.0, collisions=3, episode_return=9.0),  # SPL 1, SCT 1
        replace(EPISODE, elapsed_s=20.0, path_length_m=8.0),  # SPL 0.25, SCT 0.5
        replace(EPISODE, is_success=False, path_length_m=6.0, elapsed_s=500.0, collisions=1, episode_return=-7.0),
    ]

    summary = summarise(episodes)

    assert summary.episodes == 4
    assert summary.success_rate == 0.75
    assert summary.success_interval == wilson_interval(3, 4)
    assert summary.spl == pytest.approx((0.5 + 1.0 + 0.25) / 4)
    assert summary.sct == pytest.approx((0.25 + 1.0 + 0.5) / 4)
    assert summary.collision_rate == 0.5  # two of four episodes, not four collisions
    assert summary.collisions_per_metre == pytest.approx(4 / 20)
    assert summary.time_to_goal_s == 20.0  # the median of 10, 20, 40: failures do not arrive
    assert summary.mean_return == pytest.approx((5 + 9 + 5 - 7) / 4)
    # By Kaplan and Meier: of four, 10 s leave 3/4 under way, 20 s a half.
    assert summary.median_time_s == 20.0
    assert summary.physics_errors == 0
    for interval, value in ((summary.spl_interval, summary.spl), (summary.sct_interval, summary.sct)):
        assert 0.0 <= interval[0] < value < interval[1] <= 1.0
    assert summary == summarise(episodes), "the intervals are the same every time"
    assert (summary.clearance_m, summary.turn_per_metre_rad, summary.still_share) == (None, None, None)


def test_a_summary_of_traces_holds_safety_smoothness_and_behaviours() -> None:
    motions = [
        Motion(clearance_m=0.1, turned_rad=2.0, jerk_m_s3=1.0, action_change=0.2, still_share=0.0),
        Motion(clearance_m=0.3, turned_rad=4.0, jerk_m_s3=2.0, action_change=0.4, still_share=0.5),
        Motion(clearance_m=0.0, turned_rad=0.0, jerk_m_s3=6.0, action_change=0.0, still_share=1.0),
    ]
    spins: list[dict[str, float]] = [{"spin": 0.0, "hug": 0.1}, {"spin": 0.5, "hug": 0.1}, {"spin": 1.0, "hug": 0.1}]
    lengths = [1.0, 3.0, 0.0]

    summary = summarise(
        [
            replace(EPISODE, motion=motion, behaviours=behaviours, path_length_m=length)
            for motion, behaviours, length in zip(motions, spins, lengths, strict=True)
        ]
    )

    assert summary.clearance_m == 0.1  # the median
    assert summary.turn_per_metre_rad == pytest.approx(6 / 4)
    assert (summary.jerk_m_s3, summary.action_change, summary.still_share) == (3.0, pytest.approx(0.2), 0.5)
    assert summary.behaviours == {"spin": pytest.approx(2 / 3), "hug": 1.0}  # shares of episodes, not of time


def test_a_failure_that_ended_early_is_not_taken_for_one_that_might_still_arrive() -> None:
    """A crash after a second would otherwise leave the sample, and the median would be that of the survivors."""
    crash = replace(EPISODE, is_success=False, elapsed_s=1.0)

    # By hand: of four, one arrives: 3/4 stay under way. Censored at their end, the crashes would leave 0 of 1.
    assert summarise([EPISODE, crash, crash, crash]).median_time_s is None


def test_the_length_that_need_not_be_driven_is_not_asked_for() -> None:
    # By hand: 2 m to the centre, 0.5 m of it within the goal. Driving 1.5 m is perfect and 3 m a half.
    edge = replace(EPISODE, goal_radius_m=0.5)

    assert summarise([replace(edge, path_length_m=1.5)]).spl == 1.0
    assert summarise([replace(edge, path_length_m=3.0)]).spl == 0.5


def test_a_summary_without_success_or_movement_has_no_gaps() -> None:
    stuck = replace(EPISODE, is_success=False, path_length_m=0.0, collisions=2, physics_error=True)

    summary = summarise([stuck])

    assert (summary.success_rate, summary.spl, summary.sct) == (0.0, 0.0, 0.0)
    assert summary.time_to_goal_s is None
    assert summary.median_time_s is None
    assert summary.turn_per_metre_rad is None
    assert summary.collisions_per_metre == 0.0
    assert summary.physics_errors == 1


def test_a_record_without_its_trace_is_json() -> None:
    empty = np.zeros(0)
    trace = Trace(empty, np.zeros((1, 3)), np.zeros((1, 24)), np.zeros((0, 2)), {}, np.zeros(0, dtype=np.int64))

    motion = Motion(clearance_m=None, turned_rad=0.0, jerk_m_s3=None, action_change=0.5, still_share=0.25)

    row = json.loads(json.dumps(replace(EPISODE, trace=trace, motion=motion, behaviours={"dithering": 0.5}).row()))

    assert "trace" not in row
    assert row["start"] == [0, 0]
    assert row["shortest_path_m"] == 2.0
    assert (row["motion"]["still_share"], row["behaviours"]) == (0.25, {"dithering": 0.5})
    assert replace(EPISODE, trace=trace) == EPISODE, "records are compared without their traces"
    json.dumps(asdict(summarise([EPISODE])))
