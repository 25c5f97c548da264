"""What ready-made sweeps found: a sentence, tables and figures, on a page."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gridnav.display.curves import kept_success, success_bars
from gridnav.display.report import Picture, Report, Table, write_report
from gridnav.display.responses import Panel, Response, responses
from gridnav.display.style import save_figure
from gridnav.display.words import percent, percent_interval
from gridnav.envs import PARAMETERS, Randomization
from gridnav.experiment.across_seeds import labels_of
from gridnav.experiment.run_directory import RunDirectory
from gridnav.experiment.sim_to_real import Gap, correlation, measure_once
from gridnav.experiment.sweeps.studies import EVERYTHING, NOTHING, PARTS, UNDER, WHOLE
from gridnav.experiment.sweeps.sweep import Outcome, Trial
from gridnav.experiment.sweeps.trials import Row
from gridnav.experiment.training import BUDGETS, OnStage
from gridnav.experiment.transfer import transfer_report, write_transfer
from gridnav.problem.metrics import Summary
from gridnav.problem.statistics import iqm, stratified_bootstrap
from gridnav.problem.types import InputError

OVER_SEEDS = (
    "Interquartile means over seeds, of fewer than four the mean, with 95 % bootstrap intervals over them; with one "
    "seed the interval is Wilson's."
)
DEVELOPMENT = ("parametric", "structural")
"""Realities that a study of presets looks at."""
Middle = tuple[float, float, float]
"""Interquartile mean of a number over seeds, and the ends of its interval."""
Measured = Callable[[Mapping[str, RunDirectory]], list[Gap]]
"""The policies of finished runs, named, at home and in realities."""
QUESTIONS = {
    "arms": "What does a robot save that begins with what was learnt on an easier rung?",
    "presets": "Does training in a world that varies help in worlds that no training saw?",
    "leave-one-out": "Which part of the randomization does training need?",
    "one-at-a-time": "Which quantity of the robot may leave its nominal value, and how far?",
    "strength": "How much may everything vary together?",
}


@dataclass(frozen=True)
class Done:
    """A trial and what came of it."""

    trial: Trial
    outcome: Outcome


@dataclass(frozen=True)
class Findings:
    """What a study says."""

    sentence: str
    """The answer, with numbers."""
    tables: Sequence[Table]
    pictures: Mapping[str, Picture]
    """By the name of the file."""


# ---- Studies that train ---------------------------------------------------------------------------------


def _find_arms(done: Sequence[Done], sweep: RunDirectory, measured: Measured) -> Findings:
    runs = [RunDirectory.open(one.trial.folder(sweep)) for one in done if not one.outcome.error]
    report = transfer_report(runs)
    write_transfer(sweep.figures, report)
    return Findings(report.sentence, [report.table], {"transfer": report.picture})


def _find_presets(done: Sequence[Done], sweep: RunDirectory, measured: Measured) -> Findings:
    whole = [one for one in done if one.trial.settings["training"] == WHOLE]
    cells = _cells(whole, "randomization")
    presets = list(dict.fromkeys(preset for preset, _ in cells))
    bars = {f"{preset}, tested under {under}": cells[preset, under].success for under in UNDER for preset in presets}
    caption = "Success of PPO trained under each preset, tested where nothing varies, under burger and under wide."
    table = _matrix("Trained under, tested under", "trained under", cells, presets, list(UNDER))
    finished = [one for one in done if not one.outcome.error]
    gaps = measured(
        {" ".join(one.trial.settings.values()): RunDirectory.open(one.trial.folder(sweep)) for one in finished}
    )
    by_preset: dict[str, list[Gap]] = {preset: [] for preset in presets}
    for one, gap in zip(finished, gaps, strict=True):
        if one in whole:
            by_preset[one.trial.settings["randomization"]].append(gap)
    tables = [_kept_table(by_preset), table]
    if sum(one in whole for one in finished) > 1:
        tables.append(_foretelling(finished, gaps))
    return Findings(
        " ".join(_kept_words(by_preset, place) for place in DEVELOPMENT),
        tables,
        {"realities": _kept_picture(by_preset), "presets": Picture(success_bars(bars, target=None), caption)},
    )


def _kept_words(gaps: Mapping[str, Sequence[Gap]], place: str) -> str:
    """Which preset does best in a reality, against training without one."""
    away = {name: _successes([gap.away[place] for gap in here]) for name, here in gaps.items()}
    best = max(away, key=lambda name: away[name][0])
    home = _successes([gap.at_home for gap in gaps[best]])
    words = f"In the {place} reality PPO trained under {best} does best: {percent_interval(away[best])}, and at home "
    words += percent_interval(home)
    if best != "none" and "none" in away:
        words += f"; trained where nothing varies it reaches {percent_interval(away['none'])}"
    return words + "."


def _foretelling(done: Sequence[Done], gaps: Sequence[Gap]) -> Table:
    """How well success in each simulation foretells that in realities, over all policies."""
    simulated = {"at home": [gap.at_home.success_rate for gap in gaps]}
    for under in UNDER:
        simulated[f"under {under}"] = [
            float(row["success"]) for one in done for row in one.outcome.rows if row["under"] == under
        ]
    whole = np.flatnonzero([one.trial.settings["training"] == WHOLE for one in done])
    groups = {f"{len(whole)} whole trainings": whole}
    if len(whole) < len(gaps):
        groups[f"all {len(gaps)}"] = np.arange(len(gaps))
    rows = []
    for name, successes in simulated.items():
        words = []
        for place in DEVELOPMENT:
            pairs = np.column_stack([successes, [gap.away[place].success_rate for gap in gaps]])
            for group in groups.values():
                found = correlation(pairs[group])
                low, high = found.pearson_interval
                words.append(f"{found.pearson:.2f} ({low:.2f} to {high:.2f}), of ranks {found.spearman:.2f}")
        rows.append([name, *words])
    legend = (
        "Correlation over policies of success in a simulation with success in a reality (SRCC), with 95 % bootstrap "
        "intervals over policies. At home every policy has a world of its own; the others are one for all. Short "
        "trainings make policies that differ in quality."
    )
    columns = ("simulation", *(f"{place}, {group}" for place in DEVELOPMENT for group in groups))
    return Table("Which simulation foretells realities", columns, rows, legend)


def _kept_table(gaps: Mapping[str, Sequence[Gap]]) -> Table:
    rows = []
    for name, here in gaps.items():
        for place in DEVELOPMENT:
            _, *own = here[0].retention(place)
            kept, low, high = _over_seeds([gap.retention(place)[0] for gap in here], (own[0], own[1]))
            away = [gap.away[place] for gap in here]
            successes = [_successes([gap.at_home for gap in here]), _successes(away)]
            rows.append(
                [name, place, *map(percent_interval, successes), f"{kept:.2f} ({low:.2f} to {high:.2f})",
                 percent(float(iqm([one.collision_rate for one in away])))]
            )  # fmt: skip
    columns = ("trained under", "reality", "success at home", "success there", "kept", "collided there")
    legend = f"Home is what the policy was trained under. Kept: success there over success at home. {OVER_SEEDS}"
    return Table("What was kept in worlds that no training saw", columns, rows, legend)


def _kept_picture(gaps: Mapping[str, Sequence[Gap]]) -> Picture:
    home = {name: _successes([gap.at_home for gap in here]) for name, here in gaps.items()}
    away = {
        place: {name: _successes([gap.away[place] for gap in here]) for name, here in gaps.items()}
        for place in DEVELOPMENT
    }
    words = "Success of PPO trained under each preset, at home (ring) and in realities that no training saw."
    return Picture(kept_success(home, away), f"{words} All of them are simulations. {OVER_SEEDS}")


def _successes(summaries: Sequence[Summary]) -> Middle:
    """Success over seeds."""
    return _over_seeds([one.success_rate for one in summaries], summaries[0].success_interval)


def _find_leave_one_out(done: Sequence[Done], sweep: RunDirectory, measured: Measured) -> Findings:
    cells = _cells(done, "without")
    names = list(dict.fromkeys(name for name, _ in cells))
    parts = [name for name in names if name not in (NOTHING, EVERYTHING)]
    worst = min(parts, key=lambda name: cells[name, "whole"].success[0])
    reached = {name: percent_interval(cells[name, "whole"].success) for name in names}
    sentence = (
        f"Under the whole randomization, PPO that was trained in it reaches {reached[NOTHING]}; what it misses most is "
        f"{worst}: trained without, it reaches {reached[worst]}, and without everything {reached[EVERYTHING]}."
    )
    words = {NOTHING: "trained in all of it", EVERYTHING: "trained in none of it"}
    bars = {words.get(name, f"without {name}"): cells[name, "whole"].success for name in names}
    picture = Picture(
        success_bars(bars, target=None), "Success under the whole randomization, by what training lacked."
    )
    table = _matrix("What training lacked", "trained without", cells, names, ["whole", "none"])
    return Findings(sentence, [table], {"leave-one-out": picture})


# ---- Studies of finished runs ---------------------------------------------------------------------------


def _find_one_at_a_time(done: Sequence[Done], sweep: RunDirectory, measured: Measured) -> Findings:
    lines = _lines(done, "quantity", "value")
    quantities = list(dict.fromkeys(one.trial.settings["quantity"] for one in done))
    trained = _trained(done)
    panels, rows, falls = [], [], {}
    for name in quantities:
        unit, nominal = PARAMETERS[name].unit, PARAMETERS[name].nominal
        here = {label: line for (label, quantity), line in lines.items() if quantity == name}
        ends = trained[name] if trained else None
        panels.append(Panel(f"{name} ({unit})", here, ends))
        for label, line in here.items():
            at_nominal = line.y[int(np.argmin(np.abs(np.array(line.x) - nominal)))]
            worst = int(np.argmin(line.y))
            falls[name, label] = at_nominal - line.y[worst]
            range_words = "-" if ends is None else _ends(*ends)
            low, high = line.x[0], line.x[-1]
            rows.append(
                [name, label, unit, range_words, _ends(low, high), percent(at_nominal), percent(line.y[worst]),
                 f"{line.x[worst]:g}"]
            )  # fmt: skip
    name, label = max(falls, key=lambda key: falls[key])
    sentence = (
        f"Of {len(quantities)} quantities, varied one at a time, {name} costs {label} most: its success falls by "
        f"{100 * falls[name, label]:.1f} points; {sum(fall < 0.05 for fall in falls.values())} of {len(falls)} curves "
        "stay within five points of the nominal robot's."
    )
    columns = ("quantity", "agent", "unit", "in training", "tested", "success at nominal", "worst success", "at")
    table = Table("One at a time", columns, rows, OVER_SEEDS)
    return Findings(
        sentence,
        [table],
        {"one-at-a-time": Picture(responses(panels), f"Success against one quantity at a time. {OVER_SEEDS}")},
    )


def _find_strength(done: Sequence[Done], sweep: RunDirectory, measured: Measured) -> Findings:
    lines = {label: line for (label, _), line in _lines(done, "", "strength").items()}
    area = {
        label: float(np.trapezoid(line.y, line.x) / (line.x[-1] - line.x[0])) if len(line.x) > 1 else line.y[0]
        for label, line in lines.items()
    }
    best = max(area, key=lambda label: area[label])
    found = {label: dict(zip(line.x, line.y, strict=True)) for label, line in lines.items()}
    at = {label: [percent(y[k]) if k in y else "-" for k in (0.0, 1.0, 2.0)] for label, y in found.items()}
    told = [f"{label} {', '.join(at[label])}" for label in lines]
    sentence = (
        f"Success at strength 0, 1 and 2: {'; '.join(told)}. On average over strengths {best} reaches "
        f"{percent(area[best])}."
    )
    rows = [[label, *at[label], percent(area[label])] for label in lines]
    columns = ("agent", "strength 0", "strength 1", "strength 2", "mean over strengths")
    table = Table("Robustness", columns, rows, "The mean is the area under the curve over its width. " + OVER_SEEDS)
    figure = responses([Panel("strength of the randomization (1: as given, 0: nothing varies)", lines)])
    return Findings(
        sentence, [table], {"strength": Picture(figure, f"Success as all ranges are widened together. {OVER_SEEDS}")}
    )


def _lines(done: Sequence[Done], group: str, x: str) -> dict[tuple[str, str], Response]:
    """Success against a setting, by agent and group; seeds of one training are one line."""
    paths = list(dict.fromkeys(one.trial.config["run"] for one in done))
    labels = dict(zip(paths, labels_of([RunDirectory.open(Path(path)).read_config() for path in paths]), strict=True))
    points: dict[tuple[str, str], dict[float, list[Row]]] = {}
    for one in done:
        for row in one.outcome.rows:
            key = f"{row['name']} {labels[one.trial.config['run']]}".strip(), one.trial.settings.get(group, "")
            points.setdefault(key, {}).setdefault(float(one.trial.settings[x]), []).append(row)
    lines = {}
    for key, by_value in points.items():
        values = sorted(by_value)
        triples = [_number(by_value[value], "success") for value in values]
        lines[key] = Response(values, *(list(part) for part in zip(*triples, strict=True)))
    if not lines:
        raise InputError("no trial of the study gave a result: see the errors in its table")
    return lines


def _trained(done: Sequence[Done]) -> dict[str, tuple[float, float]]:
    """The ranges of training, where all runs had the same."""
    paths = list(dict.fromkeys(one.trial.config["run"] for one in done))
    varied = {RunDirectory.open(Path(path)).read_config().get("randomization", "none") for path in paths}
    if len(varied) > 1:
        return {}
    ranges = Randomization.load(varied.pop())
    return {name: (getattr(ranges, name).low, getattr(ranges, name).high) for name in PARAMETERS}


# ---- What they share --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Cell:
    """One kind of training in one kind of test, over seeds: middle and interval."""

    success: Middle
    spl: Middle
    collided: Middle
    n_seeds: int


def _cells(done: Sequence[Done], column: str) -> dict[tuple[str, str], _Cell]:
    """By the setting of a column and where it was tested."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for one in done:
        for row in one.outcome.rows:
            groups.setdefault((one.trial.settings[column], row["under"]), []).append(row)
    wanted = {one.trial.settings[column] for one in done}
    missing = wanted - {name for name, _ in groups}
    if missing:
        raise InputError(f"every trial of {sorted(missing)[0]} failed: see the errors in the table")
    return {
        key: _Cell(_number(rows, "success"), _number(rows, "spl"), _number(rows, "collided"), len(rows))
        for key, rows in groups.items()
    }


def _number(rows: Sequence[Row], name: str) -> Middle:
    """A number of the rows over seeds."""
    scores = [float(row[name]) for row in rows]
    low, high = (float(rows[0].get(f"{name}_{end}", scores[0])) for end in ("low", "high"))
    return _over_seeds(scores, (low, high))


def _over_seeds(scores: Sequence[float], own: tuple[float, float]) -> Middle:
    """Middle and 95 % interval over seeds; the episodes' own interval where there is one seed."""
    if len(scores) == 1:
        return scores[0], *own
    return float(iqm(scores)), *stratified_bootstrap([scores], rng=np.random.default_rng(0))


def _matrix(
    title: str, first: str, cells: Mapping[tuple[str, str], _Cell], names: Iterable[str], tests: Sequence[str]
) -> Table:
    """One row per training, one column of success per test; SPL and collisions in the first test."""
    columns = (first, *(f"success under {test}" for test in tests), f"SPL under {tests[0]}", "collided", "seeds")
    rows = []
    for name in names:
        here = cells[name, tests[0]]
        successes = [percent_interval(cells[name, test].success) for test in tests]
        rows.append([name, *successes, f"{here.spl[0]:.2f}", percent(here.collided[0]), str(here.n_seeds)])
    return Table(title, columns, rows, f"SPL and collisions are those under {tests[0]}. {OVER_SEEDS}")


def _ends(low: float, high: float) -> str:
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


FINDERS: dict[str, Callable[[Sequence[Done], RunDirectory, Measured], Findings]] = {
    "arms": _find_arms,
    "presets": _find_presets,
    "leave-one-out": _find_leave_one_out,
    "one-at-a-time": _find_one_at_a_time,
    "strength": _find_strength,
}


def write_study(
    name: str,
    trials: Sequence[Trial],
    outcomes: Sequence[Outcome],
    sweep: RunDirectory,
    on_stage: OnStage,
    *,
    jobs: int,
    command: str,
    config: Mapping[str, Any],
) -> str:
    """``report.html`` and the figures of a finished study.

    Args:
        name: One of ``PARTS``.
        trials: All of them.
        outcomes: What came of them.
        sweep: Where the files go.
        on_stage: Told of evaluations in realities.
        jobs: How many of those at once.
        command: What makes the study again.
        config: Its configuration.

    Returns:
        The answer, in a sentence or two.

    Raises:
        InputError: When so many trials failed that there is no answer.
    """

    def measured(runs: Mapping[str, RunDirectory]) -> list[Gap]:
        episodes = BUDGETS[str(config["budget"])].episodes
        return list(measure_once(runs, DEVELOPMENT, episodes, on_stage, jobs=jobs).values())

    done = [Done(trial, outcome) for trial, outcome in zip(trials, outcomes, strict=True)]
    found = []
    for part in PARTS[name]:
        own = [one for one in done if one.trial.settings.get("study", part) == part]
        found.append(FINDERS[part](own, sweep, measured))
    pictures = {name: picture for one in found for name, picture in one.pictures.items()}
    for file, picture in pictures.items():
        for ending in (".png", ".svg"):
            save_figure(picture.figure, sweep.figures / f"{file}{ending}")
    failed = sum(bool(outcome.error) for outcome in outcomes)
    sentence = " ".join(one.sentence for one in found) + (f" {failed} of {len(done)} trials failed." if failed else "")
    page = Report(
        f"Study: {name}", " ".join(QUESTIONS[part] for part in PARTS[name]), sentence, (), [*pictures.values()],
        config, command, recording="", tables=[table for one in found for table in one.tables],
    )  # fmt: skip
    write_report(sweep.report, page)
    return sentence
