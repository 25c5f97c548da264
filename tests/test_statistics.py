"""Intervals and averages, by hand, and whether the intervals hold what they promise."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gridnav.problem.statistics import (
    cvar,
    iqm,
    kaplan_meier_median,
    mean,
    probability_of_improvement,
    stratified_bootstrap,
    wilson_interval,
)
from gridnav.problem.types import InputError

# ---- Shares ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("n", "low", "high"), [(50, 0.786, 0.957), (100, 0.826, 0.945), (200, 0.851, 0.934), (500, 0.871, 0.923)]
)
def test_the_interval_of_a_share_is_wilsons(n: int, low: float, high: float) -> None:
    """The table of Wilson's formula for a share of 0.9, z = 1.96."""
    assert wilson_interval(round(0.9 * n), n) == (pytest.approx(low, abs=6e-4), pytest.approx(high, abs=6e-4))


def test_the_interval_of_no_success_begins_at_zero_and_has_a_width() -> None:
    # By hand, p = 0, n = 10: high = (z^2/n) / (1 + z^2/n) = 0.38415/1.38415 = 0.27753; p = 1 mirrors it.
    assert wilson_interval(0, 10) == (pytest.approx(0.0, abs=1e-12), pytest.approx(0.27753, abs=1e-4))
    assert wilson_interval(10, 10) == (pytest.approx(1 - 0.27753, abs=1e-4), pytest.approx(1.0, abs=1e-12))


# ---- Interquartile mean ------------------------------------------------------------------------


def test_the_interquartile_mean_leaves_out_a_quarter_at_each_end() -> None:
    # By hand: of eight values two go at each end, whatever their order and size: (3 + 4 + 5 + 8) / 4.
    assert iqm([100, 3, 1, 4, 2, 8, 5, 900]) == pytest.approx(5.0)
    # Of seven only one does, int(7/4): (2 + 3 + 4 + 5 + 6) / 5.
    assert iqm([1, 2, 3, 4, 5, 6, 700]) == pytest.approx(4.0)


def test_of_fewer_than_four_values_the_interquartile_mean_is_the_mean() -> None:
    assert iqm([1.0, 2.0, 9.0]) == pytest.approx(4.0)
    assert iqm([7.0]) == pytest.approx(7.0)


def test_averages_go_along_the_last_axis() -> None:
    scores = np.array([[0.0, 1.0, 3.0, 100.0], [2.0, 4.0, 6.0, 8.0]])

    np.testing.assert_allclose(iqm(scores), [2.0, 5.0])
    np.testing.assert_allclose(mean(scores), [26.0, 5.0])


# ---- Bootstrap ---------------------------------------------------------------------------------


def test_runs_are_drawn_within_their_task_and_never_across() -> None:
    """Tasks whose runs all agree leave nothing to chance, however different the tasks are."""
    low, high = stratified_bootstrap([[0.0] * 5, [1.0] * 5], rng=np.random.default_rng(0), statistic=mean, draws=200)

    assert (low, high) == (0.5, 0.5)


def test_two_runs_of_one_task_give_the_interval_that_counting_gives() -> None:
    # By hand: of 0 and 1, drawn twice, the mean is 0, 0.5 or 1 with chances 1/4, 1/2, 1/4: 2.5 % lie in 0 and in 1.
    interval = stratified_bootstrap([[0.0, 1.0]], rng=np.random.default_rng(0), statistic=mean, draws=2_000)

    assert interval == (0.0, 1.0)


def test_many_draws_come_in_chunks_that_change_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    scores = np.random.default_rng(1).normal(size=(3, 8))
    whole = stratified_bootstrap(scores, rng=np.random.default_rng(0))
    monkeypatch.setattr("gridnav.problem.statistics.MAX_CHUNK", 24 * 1_000)
    chunked = stratified_bootstrap(scores, rng=np.random.default_rng(0))

    assert chunked == pytest.approx(whole, abs=0.02)
    assert chunked == stratified_bootstrap(scores, rng=np.random.default_rng(0)), "the same seed, the same interval"


def test_tasks_may_have_different_numbers_of_runs() -> None:
    low, high = stratified_bootstrap([[1.0, 2.0, 3.0], [2.0]], rng=np.random.default_rng(0), statistic=mean)

    # By hand, mean of four: the first task's three runs sum to 3 at least and 9 at most.
    assert (3 + 2) / 4 <= low < high <= (9 + 2) / 4


@pytest.mark.parametrize("statistic", [iqm, mean])
def test_the_bootstrap_interval_holds_the_true_value_about_as_often_as_it_says(statistic: object) -> None:
    """Four tasks of ten normal scores around 0: 400 repetitions have a standard error of 1.1 %."""
    rng = np.random.default_rng(0)
    n_held = 0
    for _ in range(400):
        low, high = stratified_bootstrap(
            rng.normal(size=(4, 10)),
            rng=rng,
            statistic=statistic,  # type: ignore[arg-type]
            draws=400,
        )
        n_held += low <= 0.0 <= high

    assert 0.90 <= n_held / 400 <= 0.97


@pytest.mark.parametrize("scores", [[], [[1.0], []], [1.0, 2.0]], ids=["no task", "no runs", "no list of runs"])
def test_a_bootstrap_of_nothing_is_refused(scores: list[object]) -> None:
    with pytest.raises(InputError, match="at least one task with at least one run each"):
        stratified_bootstrap(scores, rng=np.random.default_rng(0))  # type: ignore[arg-type]


# ---- Worst cases -------------------------------------------------------------------------------


def test_the_worst_share_is_rounded_up_to_whole_layouts() -> None:
    scores = [0.9, 0.1, 0.5, 0.7, 0.3]

    assert cvar(scores, 0.4) == pytest.approx(0.2)  # two of five: (0.1 + 0.3) / 2
    assert cvar(scores, 0.41) == pytest.approx(0.3)  # three: (0.1 + 0.3 + 0.5) / 3
    assert cvar(scores, 0.01) == pytest.approx(0.1)  # one at least
    assert cvar(scores, 1.0) == pytest.approx(0.5)
    assert cvar(np.arange(100), 0.07) == pytest.approx(3.0)  # seven, though 0.07 * 100 is a little more


@pytest.mark.parametrize("share", [0.0, -0.1, 1.1])
def test_a_share_outside_zero_to_one_is_refused(share: float) -> None:
    with pytest.raises(InputError, match=r"share .* is outside \(0, 1\]"):
        cvar([1.0], share)


# ---- Times -------------------------------------------------------------------------------------


def test_the_median_time_counts_those_that_did_not_arrive() -> None:
    # By hand: under way after 10 s 4/5, after 20 s 3/5; one is lost from sight at 25 s, then at 30 s one of the two
    # left arrives: 3/5 * 1/2 = 0.3, the first time at or below a half.
    assert kaplan_meier_median([10, 20, 25, 30, 60], [True, True, False, True, False]) == 30.0


def test_with_everyone_arrived_the_median_time_is_the_lower_middle_one() -> None:
    assert kaplan_meier_median([3, 1, 2], [True] * 3) == 2.0
    assert kaplan_meier_median([4, 3, 1, 2], [True] * 4) == 2.0


def test_where_fewer_than_half_arrive_there_is_no_median_time() -> None:
    assert kaplan_meier_median([10, 100, 100], [True, False, False]) is None
    assert kaplan_meier_median([100], [False]) is None
    assert kaplan_meier_median([10, 100], [True, False]) == 10.0, "half of them have arrived"


@given(st.lists(st.tuples(st.integers(1, 9), st.booleans()), min_size=1, max_size=20))
def test_the_median_time_is_that_of_the_textbook_product(rows: list[tuple[int, bool]]) -> None:
    times, arrived = map(np.array, zip(*rows, strict=True))
    under_way, expected = 1.0, None
    for time in np.unique(times[arrived]):
        under_way *= 1.0 - np.sum(arrived & (times == time)) / np.sum(times >= time)
        if under_way <= 0.5 + 1e-12:
            expected = float(time)
            break

    assert kaplan_meier_median(times, arrived) == expected


# ---- Comparisons -------------------------------------------------------------------------------


def test_the_probability_of_improvement_counts_pairs_and_halves_ties() -> None:
    # By hand, six pairs: 2 beats 1 and ties 2; 3 beats both; 1 ties 1 and loses to 2: (1 + .5 + 2 + .5) / 6.
    assert probability_of_improvement([2, 3, 1], [1, 2]) == pytest.approx(4 / 6)
    assert probability_of_improvement([1, 2], [2, 3, 1]) == pytest.approx(2 / 6)
    assert probability_of_improvement([1, 1], [1]) == 0.5
