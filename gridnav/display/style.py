"""How every figure looks, and how it is written."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from gridnav.display import palette

WIDTH_IN = 5.2
"""Width of every figure, inches: shrunk to a phone, its letters of 10 points are still 8 pixels high."""
SAVE_DPI = 150
SMALL_PT = 8.0
"""Smallest letters of a figure, points."""

STYLE: dict[Any, Any] = {
    "font.size": 10.0,
    "axes.titlesize": 10.0,
    "figure.titlesize": 10.0,
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


def signed(value: float) -> str:
    """A number with its sign, two digits behind the point and a real minus, as on the axes."""
    # Adding 0.0 turns -0.0 into 0.0.
    return f"{round(value, 2) + 0.0:+.2f}".replace("-", "\N{MINUS SIGN}")


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure; the suffix says how, ``.png`` or ``.svg``."""
    if Path(path).suffix == ".svg":
        Path(path).write_text(svg_text(figure), encoding="utf-8")
    else:
        figure.savefig(path, dpi=SAVE_DPI)


def svg_text(figure: Figure) -> str:
    """The figure as an ``<svg>`` element to put into a page: equal figures give equal text."""
    text = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "gridnav"}):
        # Without these entries matplotlib writes the date and addresses of other sites.
        figure.savefig(text, format="svg", metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
    svg = text.getvalue()
    return svg[svg.index("<svg") :]
