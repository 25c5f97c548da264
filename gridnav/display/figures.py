"""Rollouts, learning curves and values as matplotlib figures, which the caller saves or puts into a report.

Each function returns a ``matplotlib.figure.Figure`` of its own: nothing here touches pyplot, a display or global
state. What a colour says is also said by a line style, a mark or a word.
"""

from __future__ import annotations

import io
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import EngFormatter, PercentFormatter

from gridnav.display import palette
from gridnav.problem.grid_mdp import MOVES
from gridnav.problem.layout import Layout
from gridnav.problem.metrics import Episode
from gridnav.problem.types import AnyArray, Cell, FloatArray

WIDTH_IN = 5.2
"""Width of every figure, inches: shrunk to a phone, its letters of 10 points are still 8 pixels high."""
TITLE_LETTERS = 27
"""What fits above one of two panels."""
SAVE_DPI = 150
TARGET = 0.95
"""Success rate that the ladder asks of a rung, marked in learning curves."""

STYLE: dict[Any, Any] = {
    "font.size": 10.0,
    "axes.titlesize": 10.0,
    "axes.edgecolor": palette.WALL,
    "axes.labelcolor": palette.INK,
    "text.color": palette.INK,
    "xtick.color": palette.INK,
    "ytick.color": palette.INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "figure.facecolor": "white",
    "legend.frameon": False,
    # Names come from outside: a dollar sign in them is no formula.
    "text.parse_math": False,
}
"""In force while a figure is made, and nowhere else."""


def maze_axes(axes: Axes, layout: Layout) -> None:
    """Draw a maze to scale: walls dark, allowed starts and goals tinted, axes in metres, row 0 on top."""
    width, height = layout.size_m
    half = layout.cell_size_m / 2
    for cells, free, colour in (
        (layout.start_cells, layout.starts, palette.START),
        (layout.goal_cells, layout.goals, palette.GOAL),
    ):
        # Where every free cell is allowed, a tint would say nothing.
        if not np.array_equal(free, ~layout.walls):
            for x, y in layout.to_metres(cells) - half:
                axes.add_patch(Rectangle((x, y), 2 * half, 2 * half, color=colour, alpha=0.25, linewidth=0))
    for x_min, y_min, x_max, y_max in layout.wall_rectangles():
        axes.add_patch(Rectangle((x_min, y_min), x_max - x_min, y_max - y_min, color=palette.WALL, linewidth=0))
    # Drawn at the edge, twice as thick as seen: the axes clip the outer half.
    axes.add_patch(Rectangle((0, 0), width, height, fill=False, edgecolor=palette.WALL, linewidth=4))
    axes.set(xlim=(0, width), ylim=(0, height), aspect="equal", xlabel="x (m)", ylabel="y (m)")
    axes.spines[:].set_visible(False)


@matplotlib.rc_context(STYLE)
def trajectories(layout: Layout, rollouts: Mapping[str, Sequence[Episode]]) -> Figure:
    """The ways taken, one panel per rung or agent.

    Args:
        layout: The maze.
        rollouts: Name to episodes; those without a trace count in the title and are not drawn.
    """
    n_columns = min(len(rollouts), 2)
    n_rows = -(-len(rollouts) // n_columns)
    width, height = layout.size_m
    panel_height = (WIDTH_IN - 0.6) / n_columns * height / width + 0.55  # inches: the maze, and its title
    # Below: the x axis, the legend; and an x axis in mid-page where the last row is not full.
    below = 1.0 + 0.4 * (len(rollouts) % n_columns)
    figure = Figure(figsize=(WIDTH_IN, n_rows * panel_height + below), layout="constrained")
    for number, (name, episodes) in enumerate(rollouts.items()):
        axes = figure.add_subplot(n_rows, n_columns, number + 1)
        maze_axes(axes, layout)
        if number % n_columns:
            axes.set(ylabel="", yticklabels=[])
        if number + n_columns < len(rollouts):
            axes.set(xlabel="", xticklabels=[])
        arrived = sum(episode.is_success for episode in episodes)
        axes.set_title(f"{textwrap.fill(name, TITLE_LETTERS)}\n{arrived} of {len(episodes)} reached the goal")
        for episode in episodes:
            _draw_way(axes, episode)
    figure.legend(handles=_way_legend(), loc="outside lower center", ncols=3)
    return figure


def _draw_way(axes: Axes, episode: Episode) -> None:
    """One trajectory: solid where it arrived, dashed and crossed out at its end where it did not."""
    if episode.trace is None:
        return
    points = episode.trace.poses[:, :2]
    style = _ARRIVED if episode.is_success else _MISSED
    axes.plot(*points.T, **style, zorder=3, gid="way")
    axes.plot(*points[0], **_FROM, zorder=4)
    axes.plot(*points[-1], **(_TO if episode.is_success else _LOST), zorder=5)
    touched = points[1:][episode.trace.hits > 0]
    if len(touched):
        axes.plot(*touched.T, **_TOUCHED, zorder=4, gid="collisions")


_ARRIVED: dict[str, Any] = {"color": palette.BLUE, "linewidth": 1.4, "alpha": 0.8}
_MISSED: dict[str, Any] = {"color": palette.VERMILLION, "linewidth": 1.4, "linestyle": (0, (4, 2))}
_FROM: dict[str, Any] = {
    "marker": "o",
    "markersize": 5,
    "color": "white",
    "markeredgecolor": palette.INK,
    "linestyle": "none",
}
_TO: dict[str, Any] = {
    "marker": "*",
    "markersize": 9,
    "color": palette.GOAL,
    "markeredgecolor": palette.INK,
    "linestyle": "none",
}
_LOST: dict[str, Any] = {
    "marker": "X",
    "markersize": 8,
    "color": palette.VERMILLION,
    "markeredgecolor": "white",
    "linestyle": "none",
}
_TOUCHED: dict[str, Any] = {
    "marker": "D",
    "markersize": 5.5,
    "color": palette.INK,
    "markeredgecolor": "white",
    "linestyle": "none",
}


def _way_legend() -> list[Line2D]:
    styles = {
        "reached the goal": _ARRIVED,
        "did not reach it": _MISSED,
        "start": _FROM,
        "arrival": _TO,
        "ended here": _LOST,
        "collision": _TOUCHED,
    }
    return [Line2D([], [], label=label, **style) for label, style in styles.items()]


@matplotlib.rc_context(STYLE)
def learning_curves(curves: Mapping[str, tuple[AnyArray, AnyArray]], *, window: int = 10) -> Figure:
    """Success rate over environment steps: measurements as dots, their moving average as a line.

    Args:
        curves: Name to environment steps and success rates in [0, 1], both of shape ``(n,)``.
        window: Measurements in the average: each with those before it, fewer at the beginning.
    """
    figure = Figure(figsize=(WIDTH_IN, 3.3 + 0.2 * len(curves)), layout="constrained")
    axes = figure.subplots()
    axes.axhline(
        TARGET, color=palette.INK, linewidth=1, linestyle=(0, (1, 2)), label=f"{TARGET * 100:.0f} %", gid="target"
    )
    strokes = ("-", (0, (6, 2)), (0, (3, 1, 1, 1)), (0, (2, 2)))
    for number, (name, (steps, rates)) in enumerate(curves.items()):
        colour = palette.SERIES[number % len(palette.SERIES)]
        axes.plot(steps, rates, ".", color=colour, alpha=0.35, markersize=4)
        axes.plot(
            steps, moving_average(np.asarray(rates), window), color=colour, linewidth=2.2,
            linestyle=strokes[number % len(strokes)], label=name,
        )  # fmt: skip
    axes.set(ylim=(-0.03, 1.03), xlabel="environment steps", ylabel="success rate")
    axes.set_xlim(left=0)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, symbol=" %"))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.grid(axis="y", color="#E4E7EB", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.plot([], [], ".", color=palette.WALL, markersize=4, label=f"one measurement (lines: mean of {window})")
    figure.legend(loc="outside lower left")
    return figure


def moving_average(values: FloatArray, window: int) -> FloatArray:
    """Mean of each value and up to ``window - 1`` before it, shape ``(n,)``."""
    sums = np.concatenate([[0.0], np.cumsum(values)])
    ends = np.arange(1, len(values) + 1)
    begins = np.maximum(ends - window, 0)
    return np.asarray((sums[ends] - sums[begins]) / (ends - begins))


@matplotlib.rc_context(STYLE)
def value_map(layout: Layout, action_values: FloatArray, goal: Cell) -> Figure:
    """State values, the largest of a cell's action values, with the policy's move as an arrow.

    Args:
        layout: The maze.
        action_values: Of the moves up, down, left, right from each cell, row by row, shape ``(n_cells, 4)``.
        goal: Goal cell (row, column); it and cells whose moves are worth the same carry no arrow.
    """
    width, height = layout.size_m
    figure = Figure(figsize=(WIDTH_IN, WIDTH_IN * 0.82 * height / width + 0.4), layout="constrained")
    axes = figure.subplots()
    blank = layout.walls.copy()
    blank[goal] = True  # nothing is earned after the goal, so its value means nothing
    values = np.ma.masked_array(action_values.max(axis=1).reshape(layout.walls.shape), blank)
    image = axes.imshow(values, extent=(0, width, 0, height), cmap="viridis", interpolation="nearest")
    _draw_policy(axes, layout, action_values, blank)
    axes.plot(*layout.to_metres(np.array(goal)), **{**_TO, "markersize": 14}, zorder=5)
    # Hatched, so that no colour of the scale looks like a wall.
    wall: dict[str, Any] = {"facecolor": palette.WALL, "edgecolor": "white", "hatch": "///", "linewidth": 0}
    for x_min, y_min, x_max, y_max in layout.wall_rectangles():
        axes.add_patch(Rectangle((x_min, y_min), x_max - x_min, y_max - y_min, **wall))
    axes.set(xlabel="x (m)", ylabel="y (m)")
    figure.colorbar(image, ax=axes, label="value (expected discounted reward)", shrink=0.9)
    handles = [Line2D([], [], label="goal", **_TO), Patch(label="wall", **wall)]
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return figure


def _draw_policy(axes: Axes, layout: Layout, action_values: FloatArray, blank: AnyArray) -> None:
    """An arrow along the best move of each cell that prefers one."""
    prefers = (action_values.max(axis=1) > action_values.min(axis=1)) & ~blank.ravel()
    cells = np.argwhere(prefers.reshape(blank.shape))
    rows_down, columns_right = MOVES[action_values[prefers].argmax(axis=1)].T
    x, y = layout.to_metres(cells).T
    length = 0.55 * layout.cell_size_m
    axes.quiver(
        x, y, length * columns_right, -length * rows_down, pivot="middle", angles="xy", scale_units="xy", scale=1,
        color="white", edgecolor=palette.INK, linewidth=0.6, width=0.009, zorder=4,
    )  # fmt: skip


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure; the suffix says how, ``.png`` or ``.svg``."""
    figure.savefig(path, dpi=SAVE_DPI)


def svg_text(figure: Figure) -> str:
    """The figure as an ``<svg>`` element to put into a page: equal figures give equal text."""
    text = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "gridnav"}):
        # Without these entries matplotlib writes the date and addresses of other sites.
        figure.savefig(text, format="svg", metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
    svg = text.getvalue()
    return svg[svg.index("<svg") :]
