"""Figures with numbers on both axes: learning curves, comparisons over seeds, rewards over time, success rates."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import EngFormatter, PercentFormatter

from gridnav.display import palette
from gridnav.display.style import STYLE, WIDTH_IN, signed
from gridnav.problem.metrics import Episode
from gridnav.problem.statistics import iqm
from gridnav.problem.types import AnyArray, FloatArray, InputError

TARGET = 0.95
"""Success rate that the ladder asks of a rung, marked in learning curves."""
STROKES = ("-", (0, (6, 2)), (0, (3, 1, 1, 1)), (0, (2, 2)))
"""Line styles of curves that stand side by side, in this order."""
HATCHES = ("", "xx", "..", "\\\\", "//", "--")
"""Patterns of areas that stand side by side, in this order."""
NAME_LETTERS = 20
"""What fits left of a plot."""

SEEDS_FOR_IQM = 4
"""Of fewer seeds a quarter is none, so that their interquartile mean is the mean of all."""
N_RESAMPLES = 2000
N_GRID = 200
"""Points at which curves of several seeds are compared."""

Curve = tuple[AnyArray, AnyArray]
"""Where a metric was measured (environment steps, unless said otherwise) and its values, both of shape ``(n,)``."""


@dataclass(frozen=True)
class Band:
    """Several seeds' curves as one."""

    x: FloatArray
    """Shape ``(n,)``, within the range that every seed covers."""
    middle: FloatArray
    """IQM or mean over seeds, shape ``(n,)``."""
    low: FloatArray
    """Lower end of the 95 % bootstrap interval over seeds, shape ``(n,)``; the middle itself with one seed."""
    high: FloatArray
    """Upper end."""
    words: str
    """What the middle is, such as ``IQM of 5 seeds``."""


# ---- Learning --------------------------------------------------------------------------------------


@matplotlib.rc_context(STYLE)
def learning_curves(
    curves: Mapping[str, Curve],
    *,
    window: int = 10,
    x_label: str = "environment steps",
    y_label: str = "success rate",
    target: float | None = TARGET,
) -> Figure:
    """A metric in [0, 1] while learning: measurements as dots, their moving average as a line.

    Args:
        curves: Name to curve; a value that is NaN was not measured, and the line has a gap where an average has none.
        window: Measurements in the average: each with those before it, fewer at the beginning.
        x_label: What the curves run over, with its unit, such as ``episodes`` or ``training time (s)``.
        y_label: Name of the metric.
        target: Where a dotted line marks what is asked for, if anywhere.
    """
    figure = Figure(figsize=(WIDTH_IN, 3.3 + 0.2 * len(curves)), layout="constrained")
    axes = figure.subplots()
    _share_axis(axes, axes.yaxis, target)
    for number, (name, (x, values)) in enumerate(curves.items()):
        colour = palette.SERIES[number % len(palette.SERIES)]
        axes.plot(x, values, ".", color=colour, alpha=0.35, markersize=4)
        axes.plot(
            x, moving_average(np.asarray(values), window), color=colour, linewidth=2.2,
            linestyle=STROKES[number % len(STROKES)], label=name,
        )  # fmt: skip
    _x_axis(axes, x_label, y_label)
    axes.plot([], [], ".", color=palette.WALL, markersize=4, label=f"one measurement (lines: mean of {window})")
    figure.legend(loc="outside lower left")
    return figure


def moving_average(values: FloatArray, window: int) -> FloatArray:
    """Mean of each value and up to ``window - 1`` before it, NaNs left out; NaN where there is no other, ``(n,)``."""
    measured = np.isfinite(values)
    sums = np.concatenate([[0.0], np.cumsum(np.where(measured, values, 0.0))])
    counts = np.concatenate([[0], np.cumsum(measured)])
    ends = np.arange(1, len(values) + 1)
    begins = np.maximum(ends - window, 0)
    n = counts[ends] - counts[begins]
    return np.divide(sums[ends] - sums[begins], n, out=np.full(len(values), np.nan), where=n > 0)


@matplotlib.rc_context(STYLE)
def comparison(
    runs: Mapping[str, Sequence[Curve]],
    *,
    x_label: str = "environment steps",
    y_label: str = "success rate",
    target: float | None = TARGET,
) -> Figure:
    """A metric in [0, 1] of several agents, each trained with several seeds: their middle as a line, with a band.

    Args:
        runs: Name to one curve per seed.
        x_label: What the curves run over, with its unit.
        y_label: Name of the metric.
        target: Where a dotted line marks what is asked for, if anywhere.

    Raises:
        InputError: When the seeds of a name have no range in common.
    """
    figure = Figure(figsize=(WIDTH_IN, 3.6 + 0.2 * len(runs)), layout="constrained")
    axes = figure.subplots()
    _share_axis(axes, axes.yaxis, target)
    several = False
    for number, (name, curves) in enumerate(runs.items()):
        band = across_seeds(curves, np.random.default_rng(0))
        colour, stroke = palette.SERIES[number % len(palette.SERIES)], STROKES[number % len(STROKES)]
        axes.plot(
            band.x, band.middle, color=colour, linewidth=1.8, linestyle=stroke, label=f"{name} ({band.words})", zorder=3
        )
        if len(curves) > 1:
            several = True
            axes.fill_between(band.x, band.low, band.high, color=colour, alpha=0.2, linewidth=0, gid="band")
    _x_axis(axes, x_label, y_label)
    handles, _ = axes.get_legend_handles_labels()
    if several:
        handles += [
            Patch(facecolor=palette.WALL, alpha=0.2, label="95 % bootstrap interval over seeds"),
            Line2D([], [], linestyle="none", label="drawn where all seeds have data; each value holds until the next"),
        ]
    figure.legend(handles=handles, loc="outside lower left")
    return figure


def across_seeds(curves: Sequence[Curve], rng: np.random.Generator) -> Band:
    """The curves of several seeds as one, with a percentile bootstrap over whole seeds.

    Each measurement holds until the next one, and what lies outside the range of any seed is left out.

    Args:
        curves: One per seed, each with rising x; values that are NaN count as not measured.
        rng: Draws the seeds of each resample.

    Raises:
        InputError: When the seeds have no range in common.
    """
    measured = [(np.asarray(x)[np.isfinite(y)], np.asarray(y)[np.isfinite(y)]) for x, y in curves]
    low = max((x[0] for x, _ in measured if len(x)), default=np.inf)
    high = min((x[-1] if len(x) else -np.inf for x, _ in measured), default=-np.inf)
    if low > high:
        raise InputError(
            f"{len(curves)} curves have no range in common: each seed needs measurements over the same one"
        )
    grid = np.linspace(low, high, N_GRID)
    values = np.stack([y[np.searchsorted(x, grid, side="right") - 1] for x, y in measured])
    middle, words = iqm(values.T), _middle_words(len(values))
    if len(values) == 1:
        return Band(grid, middle, middle, middle, words)
    # Whole seeds are drawn, with replacement: the points of a curve are not independent.
    drawn = rng.integers(len(values), size=(N_RESAMPLES, len(values)))
    lower, upper = np.percentile(iqm(np.moveaxis(values[drawn.T], 0, -1)), [2.5, 97.5], axis=0)
    return Band(grid, middle, lower, upper, words)


def _middle_words(n_seeds: int) -> str:
    if n_seeds == 1:
        return "1 seed"
    return f"{'IQM' if n_seeds >= SEEDS_FOR_IQM else 'mean'} of {n_seeds} seeds"


# ---- One episode ------------------------------------------------------------------------------------


@matplotlib.rc_context(STYLE)
def reward_terms(episode: Episode) -> Figure:
    """The reward of one episode summed up over time: its terms stacked, gains upwards and costs downwards.

    Args:
        episode: With its trace. A step's reward stands at the step's end.
    """
    trace = episode.trace
    if trace is None:
        raise ValueError("an episode without a trace has no course to draw")
    end = trace.time_s[-1]
    # Beyond the end the sums stay: what is earned with the last step would have no width.
    time_s = np.append(trace.time_s, 1.08 * end)
    sums = {name: _running_sum(earned) for name, earned in trace.reward_terms.items()}
    figure = Figure(figsize=(WIDTH_IN, 3.6), layout="constrained")
    axes = figure.subplots()
    styles = {name: _term_style(name, number) for number, name in enumerate(sums)}
    above, below = np.zeros(len(time_s)), np.zeros(len(time_s))
    # The goal, which comes first and is earned last, lies on top and lifts nothing.
    for name, earned in reversed(sums.items()):
        for edge, part, side in (
            (above, np.maximum(earned, 0.0), "gain"),
            (below, np.minimum(earned, 0.0), "cost"),
        ):
            if part.any():
                axes.fill_between(time_s, edge, edge + part, step="post", gid=f"{name} {side}", **styles[name])
                edge += part
    total = above + below
    (line,) = axes.plot(time_s, total, color=palette.INK, linewidth=1.8, drawstyle="steps-post", gid="return")
    axes.axhline(0.0, color=palette.INK, linewidth=0.8)
    ending = axes.axvline(end, color=palette.INK, linewidth=1, linestyle=(0, (1, 2)))
    axes.set(xlim=(0, time_s[-1]), xlabel="time (s)", ylabel="reward so far")
    handles = [Patch(label=f"{name} {signed(earned[-1])}", **styles[name]) for name, earned in sums.items()]
    line.set_label(f"return {signed(total[-1])}")
    ending.set_label("end of the episode")
    figure.legend(handles=[*handles, line, ending], loc="outside lower left", ncols=2)
    return figure


def _term_style(name: str, number: int) -> dict[str, Any]:
    colour = palette.REWARD_TERMS.get(name, palette.SERIES[number % len(palette.SERIES)])
    return {"facecolor": colour, "edgecolor": "white", "hatch": HATCHES[number % len(HATCHES)], "linewidth": 0}


def _running_sum(rewards: FloatArray) -> FloatArray:
    """0 at the start, the sum after each step, and the last one again: shape ``(t,)`` to ``(t + 2,)``."""
    sums = np.concatenate([[0.0], np.cumsum(rewards)])
    return np.append(sums, sums[-1])


# ---- Success ----------------------------------------------------------------------------------------


@matplotlib.rc_context(STYLE)
def success_bars(
    rows: Mapping[str, tuple[float, float, float]], *, x_label: str = "success rate", target: float | None = TARGET
) -> Figure:
    """A share per agent, rung or seed as a dot with its interval, the first on top.

    Args:
        rows: Name to value, lower and upper end of its 95 % interval, each in [0, 1].
        x_label: What the share is.
        target: Where a dotted line marks what is asked for, if anywhere.
    """
    names = [textwrap.fill(name, NAME_LETTERS) for name in rows]
    lines = sum(name.count("\n") + 1 for name in names)
    figure = Figure(figsize=(WIDTH_IN, 1.2 + 0.17 * (lines + len(names))), layout="constrained")
    axes = figure.subplots()
    _share_axis(axes, axes.xaxis, target)
    places = np.arange(len(names))
    for place, (value, low, high) in zip(places, rows.values(), strict=True):
        axes.plot([low, high], [place, place], color=palette.BLUE, linewidth=2.2, solid_capstyle="butt", gid="interval")
        axes.plot(value, place, "o", color=palette.BLUE, markersize=7, clip_on=False, zorder=3, gid="value")
        words = f"{100 * value:.1f} %\n({100 * low:.0f} to {100 * high:.0f} %)"
        axes.annotate(words, (1.04, place), xycoords=axes.get_yaxis_transform(), va="center", gid="words")
    if target is not None:
        axes.annotate(f"{100 * target:.0f} %", (target, 1.01), xycoords=axes.get_xaxis_transform(), ha="center")
    axes.set_yticks(places, names)
    axes.tick_params(axis="y", length=0)
    axes.set(ylim=(len(names) - 0.5, -0.5), xlabel=f"{x_label} (bar: 95 % interval)")
    return figure


def kept_success(
    home: Mapping[str, tuple[float, float, float]], away: Mapping[str, Mapping[str, tuple[float, float, float]]]
) -> Figure:
    """What each policy keeps of its success elsewhere: a ring at home, a dot away, and the line between.

    Args:
        home: Policy to success at home, lower and upper end of its 95 % interval, each in [0, 1].
        away: The same by the name of each other place; one panel each, side by side.
    """
    names = [textwrap.fill(name, NAME_LETTERS) for name in home]
    lines = sum(name.count("\n") + 1 for name in names)
    figure = Figure(figsize=(WIDTH_IN, 1.3 + 0.17 * (lines + len(names))), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(away), sharey=True))
    places = np.arange(len(names))
    for axes, (place, there) in zip(panels, away.items(), strict=True):
        _share_axis(axes, axes.xaxis, None)
        for row, name in zip(places, home, strict=True):
            kept, low, high = there[name]
            axes.plot([home[name][0], kept], [row, row], color=palette.GRID_LINE, linewidth=5, zorder=1, gid="lost")
            axes.plot([low, high], [row, row], color=palette.BLUE, linewidth=1.6, zorder=2, gid="interval")
            ring = {"markerfacecolor": "white", "markeredgecolor": palette.INK}
            axes.plot(home[name][0], row, "o", markersize=8, zorder=3, clip_on=False, gid="home", **ring)
            axes.plot(kept, row, "o", color=palette.BLUE, markersize=5.5, zorder=4, clip_on=False, gid="away")
        axes.set(title=place, xlabel="success rate", ylim=(len(names) - 0.5, -0.5))
        axes.tick_params(axis="y", length=0)
    panels[0].set_yticks(places, names)
    ring_mark = Line2D([], [], marker="o", linestyle="", markerfacecolor="white", markeredgecolor=palette.INK)
    dot = Line2D([], [], marker="o", linestyle="-", color=palette.BLUE, markersize=5.5)
    figure.legend([ring_mark, dot], ["at home", "there, with 95 % interval"], loc="outside lower center", ncols=2)
    return figure


# ---- Axes -------------------------------------------------------------------------------------------


def _share_axis(axes: Axes, axis: Axis, target: float | None) -> None:
    """One axis from 0 to 100 %, with the target as a dotted line."""
    upright = axis is axes.xaxis
    (axes.set_xlim if upright else axes.set_ylim)(-0.03, 1.03)
    axis.set_major_formatter(PercentFormatter(1.0, symbol=" %"))
    axis.grid(color=palette.GRID_LINE, linewidth=0.8)
    axes.set_axisbelow(True)
    if target is not None:
        line = axes.axvline if upright else axes.axhline
        line(target, color=palette.INK, linewidth=1, linestyle=(0, (1, 2)), label=f"{target * 100:.0f} %", gid="target")


def _x_axis(axes: Axes, x_label: str, y_label: str) -> None:
    axes.set(xlabel=x_label, ylabel=y_label)
    axes.set_xlim(left=0)
    # Below, "500m" would stand for half a second.
    if axes.get_xlim()[1] >= 10_000:
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
