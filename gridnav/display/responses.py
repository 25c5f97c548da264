"""Figures of what an agent does as the world leaves what it was trained in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, PercentFormatter

from gridnav.display import palette
from gridnav.display.curves import STROKES
from gridnav.display.style import SMALL_PT, STYLE, WIDTH_IN

MARKS = ("o", "s", "^", "D", "v", "P")
"""Of lines that stand side by side, in this order."""
PANELS_PER_ROW = 3
PANEL_IN = 1.15
"""Height of one of many panels, inches."""


@dataclass(frozen=True)
class Response:
    """How a share in [0, 1] answers to a quantity; all of shape ``(n,)``, in the order of the quantity."""

    x: Sequence[float]
    """Values of the quantity."""
    y: Sequence[float]
    """The share."""
    low: Sequence[float]
    """Lower end of its 95 % interval."""
    high: Sequence[float]
    """Upper end."""


@dataclass(frozen=True)
class Panel:
    """One quantity."""

    title: str
    """Its name with its unit."""
    lines: Mapping[str, Response]
    """By name of the agent."""
    trained: tuple[float, float] | None = None
    """From where to where it varied in training, if that is to be marked; both ends equal where it was constant."""


@matplotlib.rc_context(STYLE)
def responses(panels: Sequence[Panel], *, y_label: str = "success rate") -> Figure:
    """One panel per quantity: a share against the quantity's value, its interval as bars, the trained range shaded."""
    alone = len(panels) == 1
    columns = min(PANELS_PER_ROW, len(panels))
    rows = -(-len(panels) // columns)
    height = 3.6 if alone else PANEL_IN * rows + 0.6
    names = [*dict.fromkeys(name for panel in panels for name in panel.lines)]
    figure = Figure(figsize=(WIDTH_IN, height + 0.2 * len(names)), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, sharey=True)
    for axes in grid.flat[len(panels) :]:
        axes.set_axis_off()
    for axes, panel in zip(grid.flat, panels, strict=False):
        _draw(axes, panel, names, letters=10.0 if alone else SMALL_PT)
    if alone:
        grid[0, 0].set(xlabel=panels[0].title, ylabel=y_label, title="")
    else:
        figure.supylabel(y_label, fontsize=STYLE["font.size"])
    # Each name once, though it is in several panels.
    handles = {
        label: handle for axes in grid.flat for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend([*handles.values()], [*handles], loc="outside lower left")
    return figure


def _draw(axes: Axes, panel: Panel, names: Sequence[str], *, letters: float) -> None:
    if panel.trained is not None:
        low, high = panel.trained
        if low == high:
            axes.axvline(low, color=palette.INK, linewidth=1, linestyle=(0, (1, 2)), label="in training", gid="trained")
        else:
            axes.axvspan(low, high, color=palette.GRID_LINE, linewidth=0, label="range in training", gid="trained")
    for name, line in panel.lines.items():
        number = names.index(name)
        colour = palette.SERIES[number % len(palette.SERIES)]
        middle = np.asarray(line.y)
        bars = np.maximum([middle - line.low, np.asarray(line.high) - middle], 0.0)
        axes.errorbar(
            line.x, middle, yerr=bars, color=colour, linestyle=STROKES[number % len(STROKES)], linewidth=1.4,
            marker=MARKS[number % len(MARKS)], markersize=3.5, elinewidth=1, label=name,
        )  # fmt: skip
    axes.set_ylim(-0.03, 1.03)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, symbol=" %"))
    axes.xaxis.set_major_locator(MaxNLocator(5 if letters > SMALL_PT else 3))
    axes.grid(axis="y", color=palette.GRID_LINE, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.set_title(panel.title, fontsize=letters)
    axes.tick_params(labelsize=letters)
