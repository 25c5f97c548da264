"""What transfer saved: learning curves of one task, with and without help, to numbers (Taylor and Stone 2009, JMLR 10).

A curve is a pair of arrays of shape ``(n,)``: environment steps, rising from 0, and success in [0, 1] there. All curves
of a comparison are looked at over one horizon, the steps of the longest training; what was measured last holds until
then.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from gridnav.problem.statistics import iqm, stratified_bootstrap
from gridnav.problem.types import FloatArray

Curve = tuple[FloatArray, FloatArray]
THRESHOLD = 0.95
"""Success from which on a task counts as learnt."""
AHEAD_SHARE = 0.1
"""Of the horizon: a threshold is reached for good if the mean over this much of what follows is there too."""
LAST_SHARE = 0.25
"""Of the horizon: the asymptote is the mean over this last part."""
WORSE_SHARE, SLOWER = 0.02, 1.1
"""Negative transfer: asymptote or area below scratch's by more than this, or more than so many times the steps."""
DRAWS = 10_000


def steps_to(curve: Curve, horizon: float, threshold: float = THRESHOLD) -> float:
    """Steps at the first point that reaches a threshold for good, infinite if none does.

    For good means that the mean over the tenth of the horizon that follows is there too: the greedy policies of one
    training go up and down by tens of percents from point to point while it is young, and measuring them with a hundred
    episodes adds two.
    """
    held = _held(curve, horizon)
    for step, success in zip(*curve, strict=True):
        if success >= threshold and _mean(held, step, min(step + AHEAD_SHARE * horizon, horizon)) >= threshold:
            return float(step)
    return math.inf


def jumpstart(curve: Curve) -> float:
    """Success before the first step of learning."""
    return float(curve[1][0])


def area(curve: Curve, horizon: float) -> float:
    """Mean success over the horizon, straight between the points: the area under the curve, over its width."""
    return _mean(_held(curve, horizon), 0.0, horizon)


def asymptote(curve: Curve, horizon: float) -> float:
    """Mean success over the last quarter of the horizon."""
    return _mean(_held(curve, horizon), (1.0 - LAST_SHARE) * horizon, horizon)


def _held(curve: Curve, horizon: float) -> Curve:
    """The curve up to the horizon, its last value held until there."""
    steps, success = np.asarray(curve[0], dtype=np.float64), np.asarray(curve[1], dtype=np.float64)
    inside = steps < horizon
    return np.append(steps[inside], horizon), np.append(success[inside], np.interp(horizon, steps, success))


def _mean(curve: Curve, begin: float, end: float) -> float:
    """Mean between two numbers of steps within the curve, straight between its points."""
    steps, success = curve
    inside = (steps > begin) & (steps < end)
    x = np.concatenate([[begin], steps[inside], [end]])
    y = np.interp(x, steps, success)
    return float(np.trapezoid(y, x) / (end - begin)) if end > begin else float(y[0])


@dataclass(frozen=True)
class Estimate:
    """A number over seeds."""

    value: float
    """From interquartile means over seeds."""
    low: float
    """Lower end of its 95 % bootstrap interval over seeds; the value itself with one seed."""
    high: float
    """Upper end."""


@dataclass(frozen=True)
class Transfer:
    """What an arm came to, against scratch where it is said so; steps are the target's."""

    n_seeds: int
    n_reached: int
    """Seeds that reached the threshold."""
    jumpstart: Estimate
    """Success at the beginning, less scratch's."""
    steps: Estimate
    """To the threshold; a seed that never got there counts with the horizon, which flatters it."""
    steps_ratio: Estimate | None
    """Those steps over scratch's; none where scratch needs no step."""
    total_steps: Estimate
    """With the environment steps of all sources, whatever their world."""
    seconds: Estimate
    """To the threshold, of training."""
    total_seconds: Estimate
    """With the sources' training."""
    asymptote: Estimate
    gain: Estimate
    """Asymptote, less scratch's."""
    ratio: Estimate | None
    """Transfer ratio: area under the curve less scratch's, over scratch's; none where scratch's is 0."""
    negative: tuple[str, ...]
    """In what it is worse than scratch, in words; empty where transfer did no harm that these seeds show."""


@dataclass(frozen=True)
class Learnt:
    """One seed of one arm."""

    curve: Curve
    """Success of the greedy policy on the target."""
    seconds_per_step: float
    """Of training on the target."""
    source_steps: float
    """Environment steps of what it builds on."""
    source_seconds: float
    """Their time."""


def transfer(arm: Sequence[Learnt], scratch: Sequence[Learnt], horizon: float) -> Transfer:
    """Compare the seeds of an arm with those of learning from scratch.

    Intervals resample the seeds of both, apart from each other.

    Args:
        arm: One per seed.
        scratch: One per seed.
        horizon: Environment steps over which curves are compared.
    """

    def both(measure: Callable[[Learnt], float], compare: Callable[[FloatArray, FloatArray], FloatArray]) -> Estimate:
        return _estimate([[measure(one) for one in arm], [measure(one) for one in scratch]], compare)

    def own(measure: Callable[[Learnt], float]) -> Estimate:
        return _estimate([[measure(one) for one in arm]], lambda mine: mine)

    def steps(one: Learnt) -> float:
        return min(steps_to(one.curve, horizon), horizon)

    gain = both(lambda one: asymptote(one.curve, horizon), np.subtract)
    steps_ratio = _known(both(steps, _over))
    ratio = _known(both(lambda one: area(one.curve, horizon), lambda mine, theirs: _over(mine - theirs, theirs)))
    return Transfer(
        n_seeds=len(arm),
        n_reached=sum(math.isfinite(steps_to(one.curve, horizon)) for one in arm),
        jumpstart=both(lambda one: jumpstart(one.curve), np.subtract),
        steps=own(steps),
        steps_ratio=steps_ratio,
        total_steps=own(lambda one: steps(one) + one.source_steps),
        seconds=own(lambda one: steps(one) * one.seconds_per_step),
        total_seconds=own(lambda one: steps(one) * one.seconds_per_step + one.source_seconds),
        asymptote=own(lambda one: asymptote(one.curve, horizon)),
        gain=gain,
        ratio=ratio,
        # One seed has no interval to lie on the wrong side.
        negative=tuple(_worse(gain, steps_ratio, ratio)) if min(len(arm), len(scratch)) > 1 else (),
    )


def _worse(gain: Estimate, steps_ratio: Estimate | None, ratio: Estimate | None) -> Iterator[str]:
    """In what an arm is worse than scratch: by how much it matters, and in more than its interval allows for."""
    if gain.high < 0.0 and gain.value < -WORSE_SHARE:
        yield f"an asymptote {-100 * gain.value:.0f} points lower"
    if steps_ratio and steps_ratio.low > 1.0 and steps_ratio.value > SLOWER:
        yield f"{steps_ratio.value:.1f} times the steps"
    if ratio and ratio.high < 0.0 and ratio.value < -WORSE_SHARE:
        yield f"an area {-100 * ratio.value:.0f} % smaller"


def _estimate(scores: Sequence[Sequence[float]], compare: Callable[..., FloatArray]) -> Estimate:
    """A comparison of the groups' interquartile means, with seeds resampled within each group."""
    ends = np.cumsum([len(group) for group in scores])[:-1]

    def statistic(flat: FloatArray) -> FloatArray:
        return compare(*(iqm(group) for group in np.split(flat, ends, axis=-1)))

    value = float(statistic(np.concatenate([np.asarray(group, dtype=np.float64) for group in scores])))
    low, high = stratified_bootstrap(scores, rng=np.random.default_rng(0), statistic=statistic, draws=DRAWS)
    return Estimate(value, low, high)


def _over(part: FloatArray, whole: FloatArray) -> FloatArray:
    """A ratio, NaN where there is nothing to divide by."""
    return np.divide(part, whole, out=np.full(np.shape(whole), np.nan), where=np.asarray(whole) != 0.0)


def _known(ratio: Estimate) -> Estimate | None:
    """None where scratch has nothing to divide by, in one of the resamples at least."""
    return ratio if all(map(math.isfinite, (ratio.value, ratio.low, ratio.high))) else None
