"""The transfer report: what each arm saved, from the runs of one seed or of several."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from gridnav.display.figures import comparison, save_figure
from gridnav.display.report import Picture, Report, Table, write_report
from gridnav.display.words import percent, thousands
from gridnav.experiment.across_seeds import OWN_TO_A_SEED
from gridnav.experiment.arms import ARMS
from gridnav.experiment.greedy_curve import CURVE_EPISODES, SUCCESS
from gridnav.experiment.run_directory import METRICS, RunDirectory, read_json, read_rows, write_json
from gridnav.problem.transfer import THRESHOLD, Estimate, Learnt, Transfer, transfer
from gridnav.problem.types import InputError

SCRATCH = "scratch"
LEARNT = percent(THRESHOLD, 0)
QUESTION = "What does a robot save that begins with what was learnt on an easier rung?"
CAPTION = (
    f"Success of the greedy policies on the target, {CURVE_EPISODES} episodes of a seed of their own, against "
    "environment steps there."
)
LEGEND = (
    f"Steps are the target's. To {LEARNT}: the first point of the curve that is there for good, the mean over "
    "the tenth of the training that follows being there too; a seed that never gets there counts with all its steps. "
    "Jumpstart and transfer ratio (area under the curve) are against scratch, the asymptote is the mean of the last "
    "quarter. Sources are what an arm builds on, whatever their world. Interquartile means over seeds with 95 % "
    "bootstrap intervals; with one seed there are none."
)
COLUMNS = (
    "arm", "jumpstart", f"steps to {LEARNT}", "of scratch's", "with sources", "time", "with sources",
    "asymptote", "transfer ratio",
)  # fmt: skip


@dataclass(frozen=True)
class TransferReport:
    """What arms came to, over the seeds of their runs."""

    target: str
    """World and layout."""
    seeds: tuple[int, ...]
    """Of the runs."""
    horizon: float
    """Environment steps over which curves are compared."""
    arms: Mapping[str, Transfer]
    """By name, scratch first."""
    learnt: Mapping[str, Sequence[Learnt]]
    """What they were worked out from, one per seed."""

    @property
    def best(self) -> str:
        """The learning arm that needs the fewest steps, and of several those with the cheapest sources."""
        others = [name for name in self.arms if name != SCRATCH and ARMS[name].prepare is not None]
        rank = {name: (self.arms[name].steps.value, self.arms[name].total_steps.value) for name in others}
        return min(others, key=lambda name: rank[name], default="")

    @property
    def sentence(self) -> str:
        """The conclusion, one sentence."""
        n_seeds = f"{len(self.seeds)} seed{'s' * (len(self.seeds) > 1)}"
        if not self.best:
            return f"On {self.target}, {n_seeds}, no learning arm was compared with scratch."
        arm, scratch = self.arms[self.best], self.arms[SCRATCH]
        share = "" if arm.steps_ratio is None else f", {_number(arm.steps_ratio, '.2f')} of them"
        harm = [f"{name} ({', '.join(one.negative)})" for name, one in self.arms.items() if one.negative]
        return (
            f"On {self.target}, {n_seeds}, learning from scratch needs {_steps(scratch)} to {LEARNT} success, "
            f"and {self.best}, the quickest arm, {_steps(arm)}{share}, with a jumpstart of "
            f"{_number(arm.jumpstart, '+.2f')}, and {thousands(arm.total_steps.value)} steps if those of its sources "
            "count, whatever their world; "
            + (f"transfer was negative for {', '.join(harm)}." if harm else "no arm was worse than scratch.")
        )

    @property
    def table(self) -> Table:
        """One row per arm."""
        return Table("What transfer saved", COLUMNS, [_row(name, arm) for name, arm in self.arms.items()], LEGEND)

    def figure(self) -> Figure:
        """The arms' learning curves, with intervals over seeds."""
        return comparison({name: [one.curve for one in seeds] for name, seeds in self.learnt.items()})

    @property
    def picture(self) -> Picture:
        """The figure with its caption."""
        return Picture(self.figure(), CAPTION)

    def numbers(self) -> dict[str, Any]:
        """Everything in it, fit for JSON."""
        arms = {name: asdict(arm) for name, arm in self.arms.items()}
        values = {"target": self.target, "seeds": self.seeds, "horizon": self.horizon, "sentence": self.sentence}
        return json.loads(json.dumps(values | {"arms": arms}))


def transfer_report(runs: Sequence[RunDirectory]) -> TransferReport:
    """Compare the arms of runs of ``gridnav ladder --arms``, which differ in their seeds alone.

    Args:
        runs: Finished ones, one per seed.

    Raises:
        InputError: When there is none, one has no arms or no scratch, or they do not belong together.
    """
    if not runs:
        raise InputError("a transfer report needs at least one run of gridnav ladder --arms")
    configs = [run.read_config() for run in runs]
    seeds = _seeds(runs, configs)
    learnt: dict[str, list[Learnt]] = {}
    horizon, world = 0.0, ""
    for run in runs:
        costs = _costs(run)
        rows = read_rows(run.path / METRICS)
        steps = max(cost["steps"] for cost in costs.values())
        horizon = max(horizon, steps)
        for name, cost in costs.items():
            world = cost["world"]
            learnt.setdefault(name, []).append(_learnt(rows, name, cost, steps, run))
    if SCRATCH not in learnt:
        raise InputError("a transfer report compares arms with scratch: add it to --arms")
    arms = {name: transfer(learnt[name], learnt[SCRATCH], horizon) for name in ARMS if name in learnt}
    layout = "a maze of its own" if "\n" in configs[0]["layout"] else configs[0]["layout"]
    task = "" if configs[0]["task"] == "default" else f", task {configs[0]['task']}"
    return TransferReport(f"{world}, {layout}{task}", seeds, horizon, arms, {name: learnt[name] for name in arms})


def write_transfer(folder: Path, report: TransferReport) -> None:
    """``transfer.json`` and the figure as ``transfer.png`` and ``.svg``, into a folder that exists."""
    write_json(folder / "transfer.json", report.numbers())
    figure = report.figure()
    for ending in (".png", ".svg"):
        save_figure(figure, folder / f"transfer{ending}")


def write_transfer_page(file: Path, report: TransferReport, *, command: str, config: Mapping[str, Any]) -> None:
    """A page of its own for a study over several seeds."""
    page = Report(
        f"Transfer to {report.target}", QUESTION, report.sentence, (), [report.picture], config, command,
        recording="", tables=[report.table],
    )  # fmt: skip
    write_report(file, page)


def _seeds(runs: Sequence[RunDirectory], configs: Sequence[Mapping[str, Any]]) -> tuple[int, ...]:
    """The runs' seeds, each another one, all else being equal."""
    shared = [{k: v for k, v in one.items() if k not in OWN_TO_A_SEED and k != "arms"} for one in configs]
    for run, one in zip(runs, shared, strict=True):
        if one != shared[0]:
            keys = ", ".join(key for key in one.keys() | shared[0].keys() if one.get(key) != shared[0].get(key))
            raise InputError(f"{str(run.path)!r} differs from the first run in more than its seed: {keys:.100}")
    seeds = tuple(int(one["seed"]) for one in configs)
    if len(set(seeds)) < len(seeds):
        raise InputError(f"two of the runs have the same seed: {sorted(seeds)}")
    return seeds


def _costs(run: RunDirectory) -> dict[str, dict[str, Any]]:
    """What each arm of a run cost, from its evaluation."""
    stored = read_json(run.evaluation)
    arms = stored.get("arms")
    keys = {"world", "steps", "seconds", "source_steps", "source_seconds"}
    if (
        not isinstance(arms, dict)
        or not arms
        or not all(isinstance(a, dict) and keys <= a.keys() for a in arms.values())
    ):
        raise InputError(f"{str(run.path)!r} has no arms to compare: it is no finished run of gridnav ladder --arms")
    return arms


def _learnt(
    rows: Sequence[Mapping[str, Any]], name: str, cost: Mapping[str, Any], horizon: float, run: RunDirectory
) -> Learnt:
    points = [(row["steps"], row[SUCCESS]) for row in rows if row["series"] == name and SUCCESS in row]
    if not points:
        raise InputError(f"{str(run.path)!r} has no curve of the arm {name!r:.60}")
    steps, success = np.array(points, dtype=np.float64).T
    if steps[-1] < horizon:  # what does not learn stays as it is
        steps, success = np.append(steps, horizon), np.append(success, success[-1])
    per_step = cost["seconds"] / max(1, cost["steps"])
    return Learnt((steps, success), per_step, cost["source_steps"], cost["source_seconds"])


# ---- Words -----------------------------------------------------------------------------------------


def _row(name: str, arm: Transfer) -> list[str]:
    words = f"{name}: {', '.join(arm.negative)}" if arm.negative else name
    return [
        words,
        _number(arm.jumpstart, "+.2f"),
        _steps(arm),
        "-" if arm.steps_ratio is None else _number(arm.steps_ratio, ".2f"),
        thousands(arm.total_steps.value),
        f"{arm.seconds.value:.0f} s",
        f"{arm.total_seconds.value:.0f} s",
        _number(arm.asymptote, ".3f"),
        "-" if arm.ratio is None else _number(arm.ratio, "+.2f"),
    ]


def _steps(arm: Transfer) -> str:
    reached = "" if arm.n_reached == arm.n_seeds else f", {arm.n_reached} of {arm.n_seeds} seeds got there"
    least = "" if arm.n_reached == arm.n_seeds else "at least "
    return f"{least}{thousands(arm.steps.value)} steps{reached}"


def _number(estimate: Estimate, form: str) -> str:
    value = format(estimate.value, form)
    if estimate.low == estimate.high:
        return value
    return f"{value} ({format(estimate.low, form)} to {format(estimate.high, form)})"
