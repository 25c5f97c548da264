"""Metrics by hand."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gridnav.problem.metrics import Episode, Trace, success_weighted, summarise, wilson_interval

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


@pytest.mark.parametrize(
    ("n", "low", "high"), [(50, 0.786, 0.957), (100, 0.826, 0.945), (200, 0.851, 0.934), (500, 0.871, 0.923)]
)
def test_the_interval_is_wilsons(n: int, low: float, high: float) -> None:
    """The table of Wilson's formula for a share of 0.9, z = 1.96."""
    assert wilson_interval(round(0.9 * n), n) == (pytest.approx(low, abs=6e-4), pytest.approx(high, abs=6e-4))


def test_the_interval_of_no_success_begins_at_zero_and_has_a_width() -> None:
    # By hand, p = 0, n = 10: high = (z^2/n) / (1 + z^2/n) = 0.38415/1.38415 = 0.27753; p = 1 mirrors it.
    assert wilson_interval(0, 10) == (pytest.approx(0.0, abs=1e-12), pytest.approx(0.27753, abs=1e-4))
    assert wilson_interval(10, 10) == (pytest.approx(1 - 0.27753, abs=1e-4), pytest.approx(1.0, abs=1e-12))


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
    assert summary.physics_errors == 0


def test_a_summary_without_success_or_movement_has_no_gaps() -> None:
    stuck = replace(EPISODE, is_success=False, path_length_m=0.0, collisions=2, physics_error=True)

    summary = summarise([stuck])

    assert (summary.success_rate, summary.spl, summary.sct) == (0.0, 0.0, 0.0)
    assert summary.time_to_goal_s is None
    assert summary.collisions_per_metre == 0.0
    assert summary.physics_errors == 1


def test_a_record_without_its_trace_is_json() -> None:
    empty = np.zeros(0)
    trace = Trace(empty, np.zeros((1, 3)), np.zeros((1, 24)), np.zeros((0, 2)), {}, np.zeros(0, dtype=np.int64))

    row = json.loads(json.dumps(replace(EPISODE, trace=trace).row()))

    assert "trace" not in row
    assert row["start"] == [0, 0]
    assert row["shortest_path_m"] == 2.0
    assert replace(EPISODE, trace=trace) == EPISODE, "records are compared without their traces"
