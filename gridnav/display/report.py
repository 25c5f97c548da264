"""A run as one HTML page: the question, the answer, its evidence, and how to make it again.

The page asks no other site for anything, and its one script sorts the table, so it can be mailed, archived and printed.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure

from gridnav.display.figures import svg_text
from gridnav.display.words import percent, thousands
from gridnav.problem.metrics import Summary


@dataclass(frozen=True)
class Rung:
    """One row of the table: an agent in a world, and what it built on."""

    name: str
    """What the reader knows it by, unique in the report."""
    world: str
    """Where it was trained and evaluated, such as ``DiffDrive``."""
    agent: str
    """What learnt, such as ``PPO``."""
    carried: str
    """What it took over from the rung before; empty where nothing."""
    summary: Summary
    """Its evaluation."""
    training_steps: int
    """Environment steps of training."""
    training_seconds: float
    """Wall-clock time of training, seconds."""
    note: str = ""
    """What a reader of the numbers should know, or empty."""
    seeds: str = ""
    """Seeds of training and of evaluation, such as ``0-2; 1000-1099``."""


@dataclass(frozen=True)
class Table:
    """A table of words beside that of the rungs."""

    title: str
    """Heading."""
    columns: Sequence[str]
    """Their names, the first one that of the rows."""
    rows: Sequence[Sequence[str]]
    """As many words each as there are columns."""
    legend: str
    """What the columns mean."""


@dataclass(frozen=True)
class Picture:
    """A figure with what it shows."""

    figure: Figure
    """Made by ``gridnav.display.figures``."""
    caption: str
    """One or two sentences: what to see, not how it was drawn."""


@dataclass(frozen=True)
class Report:
    """Everything the page says."""

    title: str
    """Heading."""
    question: str
    """What the run was to find out, one sentence."""
    conclusion: str
    """What it found, one sentence with numbers."""
    rungs: Sequence[Rung]
    """Rows of the table, in the order of the ladder; where there are none the page has no such table."""
    pictures: Sequence[Picture] = ()
    """Shown below the table."""
    config: Mapping[str, object] = field(default_factory=dict)
    """The run's configuration."""
    command: str = ""
    """The command that makes the run again."""
    versions: Mapping[str, str] = field(default_factory=dict)
    """Of gridnav and the libraries that decide its numbers."""
    run_dir: str = "RUN"
    """The run directory, as a user types it after ``gridnav view``."""
    recording: str = "rollout.rrd"
    """The recording beside the page; empty where there is none."""
    tables: Sequence[Table] = ()
    """Further tables, above the pictures."""


def write_report(path: str | Path, report: Report) -> None:
    """Write the page to a file in an existing folder."""
    environment = Environment(
        loader=PackageLoader("gridnav.display"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(percent=partial(percent, digits=0), share=_share, duration=_duration, count=thousands)
    page = environment.get_template("report.html").render(
        report=report,
        drawings=[_drawing(number, picture) for number, picture in enumerate(report.pictures, start=1)],
        config=json.dumps(report.config, indent=2, default=str, ensure_ascii=False),
    )
    Path(path).write_text(page, encoding="utf-8")


def _drawing(number: int, picture: Picture) -> Markup:
    """The figure as an SVG element for this page."""
    svg = svg_text(picture.figure)
    # Figures repeat each other's ids, and an id names one element of a page.
    svg = re.sub(r'(\bid="|\burl\(#|\bhref="#)', rf"\g<1>figure{number}-", svg)
    label = Markup('<svg role="img" aria-label="{}"').format(picture.caption)
    return label + Markup(svg.removeprefix("<svg"))  # noqa: S704, matplotlib escapes the names in it


def _share(value: float) -> str:
    return f"{value:.2f}"


def _duration(seconds: float) -> str:
    """In the two largest units that matter."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60:02d} min"
