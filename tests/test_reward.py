"""One reward for all worlds: each term by hand, and what their sum must never do."""

from __future__ import annotations

import itertools
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gridnav import Layout, Reward, Task
from gridnav.problem.geodesic import cell_distances
from gridnav.problem.reward import TERM_NAMES, Transition, total
from gridnav.problem.types import InputError

REWARD = Reward(goal=10.0, collision_cost=3.0, distance_cost=0.1, time_cost=0.2, progress=0.5, gamma=0.9)
SEED = Reward.preset("seed")
PRESETS = sorted(Reward.PRESETS)

WEIGHTS = st.floats(0, 20)
REWARDS = st.builds(
    Reward,
    goal=WEIGHTS,
    collision_cost=WEIGHTS,
    distance_cost=WEIGHTS,
    time_cost=WEIGHTS,
    progress=WEIGHTS,
    gamma=st.floats(0.5, 1.0),
)


def step(**changes: Any) -> Transition:
    """One grid move from 5 cells to 4 cells off the goal, with changes; scalars become batches of one."""
    values: dict[str, Any] = {
        "travelled": 1.0,
        "duration": 1.0,
        "distance": 5.0,
        "next_distance": 4.0,
        "manhattan": 4.0,
        "at_goal": False,
        "hit": False,
        "hit_inner_wall": False,
        "terminal": False,
        "time_up": False,
    }
    assert changes.keys() <= values.keys()
    return Transition(**{name: np.atleast_1d(np.array(value)) for name, value in (values | changes).items()})


def terms(reward: Reward, **changes: Any) -> dict[str, float]:
    """Each term of one step."""
    return {name: float(values[0]) for name, values in reward.terms(step(**changes)).items()}


def pay(reward: Reward, **changes: Any) -> float:
    """The reward of one step."""
    return float(total(reward.terms(step(**changes)))[0])


# ---- By hand -----------------------------------------------------------------------------------


def test_a_move_towards_the_goal_costs_its_way_and_its_time_and_pays_its_progress() -> None:
    # By hand: phi goes from -5 to -4, so progress pays 0.5 * (0.9 * -4 + 5) = 0.7.
    assert terms(REWARD) == pytest.approx({"goal": 0, "collision": 0, "distance": -0.1, "time": -0.2, "progress": 0.7})
    assert pay(REWARD) == pytest.approx(0.4)


def test_a_bump_costs_a_collision_and_the_time_but_no_way() -> None:
    # By hand: progress 0.5 * (5 - 0.9 * 5) = 0.25.
    bump = terms(REWARD, hit=True, hit_inner_wall=True, travelled=0.0, next_distance=5.0)

    assert bump == pytest.approx({"goal": 0, "collision": -3, "distance": 0, "time": -0.2, "progress": 0.25})


def test_part_of_a_cell_in_part_of_a_cell_time_is_charged_in_part() -> None:
    # By hand: 0.1 * 0.5, 0.2 * 0.25, and 0.5 * (5 - 0.9**0.25 * 4.5) = 0.308492 with 0.9**0.25 = 0.974004.
    part = terms(REWARD, travelled=0.5, duration=0.25, next_distance=4.5)

    assert part == pytest.approx(
        {"goal": 0, "collision": 0, "distance": -0.05, "time": -0.05, "progress": 0.308492}, abs=2e-6
    )


def test_the_goal_is_paid_and_its_potential_is_zero() -> None:
    # By hand: phi goes from -1 to 0 whatever the distance within the goal's radius is: 0.5 * 1.
    arrival = terms(REWARD, distance=1.0, next_distance=0.3, manhattan=0.0, at_goal=True, terminal=True)

    assert arrival == pytest.approx({"goal": 10, "collision": 0, "distance": -0.1, "time": -0.2, "progress": 0.5})


def test_a_collision_that_ends_the_episode_has_potential_zero_and_one_that_does_not_has_its_own() -> None:
    crash = {"hit": True, "travelled": 0.0, "next_distance": 5.0}

    # By hand: 0.5 * (0 + 5) = 2.5, and 0.5 * (5 - 0.9 * 5) = 0.25.
    assert terms(REWARD, **crash, terminal=True)["progress"] == pytest.approx(2.5)
    assert terms(REWARD, **crash, terminal=False)["progress"] == pytest.approx(0.25)


def test_the_time_limit_changes_no_term() -> None:
    """A truncated state is not final: its potential stays, and learners bootstrap from its value."""
    assert terms(REWARD, time_up=True) == terms(REWARD, time_up=False)


def test_a_batch_is_judged_row_by_row() -> None:
    rows = [{}, {"hit": True, "terminal": True}, {"at_goal": True, "terminal": True, "next_distance": 0.0}]
    batch = Transition(
        **{f.name: np.concatenate([getattr(step(**row), f.name) for row in rows]) for f in fields(Transition)}
    )
    for reward in (REWARD, SEED):
        np.testing.assert_array_equal(total(reward.terms(batch)), [pay(reward, **row) for row in rows])


@pytest.mark.parametrize("name", PRESETS)
def test_the_terms_are_those_that_the_info_names(name: str) -> None:
    reward = Reward.preset(name)

    assert tuple(reward.terms(step())) == TERM_NAMES
    for changes in ({}, {"at_goal": True, "terminal": True}, {"hit": True, "hit_inner_wall": True}, {"time_up": True}):
        assert pay(reward, **changes) == pytest.approx(sum(terms(reward, **changes).values()))


# ---- Properties of the shaping -----------------------------------------------------------------


@given(
    reward=REWARDS,
    distances=st.lists(st.floats(0, 100), min_size=2, max_size=30),
    durations=st.lists(st.floats(0.01, 2.0), min_size=29, max_size=29),
    ends=st.booleans(),
)
def test_progress_pays_for_the_end_points_and_not_for_the_route(
    reward: Reward, distances: list[float], durations: list[float], ends: bool
) -> None:
    """Otherwise the robot could earn reward by driving in circles."""
    discount, earned = 1.0, 0.0
    for i, (here, there) in enumerate(itertools.pairwise(distances)):
        last = i == len(distances) - 2
        progress = terms(reward, distance=here, next_distance=there, duration=durations[i], terminal=ends and last)
        earned += discount * progress["progress"]
        discount *= reward.gamma ** durations[i]

    # gamma**T * phi(s_T) - phi(s_0), with phi(s_T) = 0 in a terminal state.
    phi_end = 0.0 if ends else -distances[-1]
    assert earned == pytest.approx(reward.progress * (discount * phi_end + distances[0]), abs=1e-7)


@given(reward=REWARDS, k=st.integers(1, 200))
def test_a_way_in_k_substeps_earns_the_same_up_to_the_step(reward: Reward, k: int) -> None:
    """A grid move and the same way driven by a robot are judged alike."""
    ends = np.linspace(5.0, 4.0, k + 1)
    batch = Transition(
        travelled=np.full(k, 1 / k),
        duration=np.full(k, 1 / k),
        distance=ends[:-1],
        next_distance=ends[1:],
        manhattan=np.full(k, 4.0),
        **{name: np.zeros(k, dtype=bool) for name in ("at_goal", "hit", "hit_inner_wall", "terminal", "time_up")},
    )
    discounts = reward.gamma ** (np.arange(k) / k)

    in_parts = float((discounts * total(reward.terms(batch))).sum())

    # Progress telescopes exactly; what is charged late is discounted by at most one move.
    slack = (reward.distance_cost + reward.time_cost) * (1 - reward.gamma)
    assert pay(reward) - 1e-9 <= in_parts <= pay(reward) + slack + 1e-9


@given(reward=REWARDS, distance=st.floats(0, 100))
def test_the_potential_is_what_shaping_took_from_the_values(reward: Reward, distance: float) -> None:
    # By hand: one move to the goal from afar earns progress*D more than without shaping; values are that much higher.
    shaped = pay(reward, distance=distance, next_distance=0.0, at_goal=True, terminal=True)
    plain = Reward(**{f.name: getattr(reward, f.name) for f in fields(reward)} | {"progress": 0.0})

    unshaped = pay(plain, distance=distance, next_distance=0.0, at_goal=True, terminal=True)

    assert shaped + float(reward.potential(np.array(distance))) == pytest.approx(unshaped, abs=1e-9)


# ---- The default -------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["default", "fragile"])
@pytest.mark.parametrize("duration", [1.0, 0.08, 0.001])
def test_idling_never_pays_on_classic(name: str, duration: float) -> None:
    classic = Layout.load("classic")
    for row, col in Task(goals="any").goal_cells(classic).tolist():
        distances = cell_distances(classic, (row, col))
        for distance in np.unique(distances[np.isfinite(distances)]):
            idle = {"distance": distance, "next_distance": distance, "travelled": 0.0, "duration": duration}
            assert pay(Reward.preset(name), **idle) < 0.0


@pytest.mark.parametrize("name", ["default", "fragile"])
def test_on_classic_getting_closer_pays_and_getting_away_costs(name: str) -> None:
    reward = Reward.preset(name)
    for distance in range(1, 25):
        assert pay(reward, distance=distance, next_distance=distance - 1.0) > 0.0
        assert pay(reward, distance=distance, next_distance=distance + 1.0) < 0.0


def test_where_a_collision_ends_the_episode_the_fragile_preset_charges_more_than_the_potential_gives() -> None:
    classic = Layout.load("classic")
    farthest = max(
        np.nanmax(np.where(np.isfinite(d := cell_distances(classic, (row, col))), d, np.nan))
        for row, col in Task.load("any").goal_cells(classic).tolist()
    )
    crash = {"hit": True, "travelled": 0.0, "distance": farthest, "next_distance": farthest, "terminal": True}

    assert pay(Reward.preset("fragile"), **crash) < 0.0


def test_the_default_reward_is_the_class_itself() -> None:
    assert Reward.preset("default") == Reward()
    assert Reward.load("default") == Reward()
    assert Reward.load(REWARD) is REWARD


# ---- The tutorial's ----------------------------------------------------------------------------


def test_the_tutorial_pays_every_move_for_closeness() -> None:
    # By hand: -0.1 + 0.1 * (20 - d) / 20 = -0.005 * d.
    assert pay(SEED, manhattan=7.0) == pytest.approx(-0.035)
    assert pay(SEED, manhattan=1.0) == pytest.approx(-0.005)
    # Off the edge: no move and the ordinary reward.
    assert pay(SEED, manhattan=7.0, hit=True, travelled=0.0) == pytest.approx(-0.035)
    # Distance in cells along the free way does not matter.
    assert pay(SEED, manhattan=7.0, distance=30.0, next_distance=31.0) == pytest.approx(-0.035)


def test_the_tutorial_pays_for_wall_and_goal_instead_of_the_move() -> None:
    assert pay(SEED, hit=True, hit_inner_wall=True, travelled=0.0) == -1.0
    assert pay(SEED, manhattan=0.0, at_goal=True, terminal=True) == 10.0


@pytest.mark.parametrize(
    "changes", [{}, {"hit": True, "hit_inner_wall": True}, {"hit": True}, {"at_goal": True, "terminal": True}]
)
def test_the_tutorial_takes_one_for_the_move_that_ends_the_time_whatever_else_it_did(changes: dict[str, bool]) -> None:
    assert pay(SEED, **changes, time_up=True) == -1.0


def test_the_tutorial_has_no_potential() -> None:
    np.testing.assert_array_equal(SEED.potential(np.array([3.0, 7.0])), [0.0, 0.0])


# ---- Wrong values ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["goal", "collision_cost", "distance_cost", "time_cost", "progress", "gamma"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), "1", None, True])
def test_a_weight_that_is_no_number_is_named(name: str, value: Any) -> None:
    with pytest.raises(InputError, match=f"reward {name} {value!r} must be a finite number"):
        Reward(**{name: value})


@pytest.mark.parametrize("gamma", [0.0, -0.5, 1.0001])
def test_a_discount_out_of_range_is_refused(gamma: float) -> None:
    with pytest.raises(InputError, match=rf"gamma {gamma} is outside \(0, 1\]"):
        Reward(gamma=gamma)


@pytest.mark.parametrize("name", ["", "Default", "x" * 1000, "a\nb", None, ["seed"]])
def test_an_unknown_preset_is_refused_with_the_names_that_exist(name: Any) -> None:
    with pytest.raises(InputError, match=r"unknown reward .*: the presets are default, .*seed") as caught:
        Reward.load(name)

    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 250


def test_whole_numbers_as_weights_are_as_good_as_others() -> None:
    whole = Reward(goal=20, collision_cost=3, distance_cost=0, time_cost=1, progress=2, gamma=1)

    assert pay(whole, at_goal=True, terminal=True) == pytest.approx(20 - 1 + 2 * 5)
    assert pay(replace(SEED, goal=20), at_goal=True, terminal=True) == pytest.approx(20)
