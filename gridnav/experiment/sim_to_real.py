"""From simulation to realities: what policies keep of their success in worlds that training never saw."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from gridnav.agents import Agent, Progress
from gridnav.display.figures import kept_success
from gridnav.display.report import Picture, Report, Table, write_report
from gridnav.display.words import percent, percent_interval
from gridnav.envs import Randomization
from gridnav.experiment.checkpoint import load_agent
from gridnav.experiment.evaluation import evaluate_in
from gridnav.experiment.reality import WORLD, Reality, find_reality
from gridnav.experiment.results import stored_evaluation, write_evaluation, write_rollouts
from gridnav.experiment.run_directory import RunDirectory, check_names, read_json, write_json
from gridnav.experiment.training import OnStage, Result, unseen
from gridnav.experiment.workers import in_workers
from gridnav.experiment.worlds import Problem
from gridnav.problem.metrics import Summary, summarise
from gridnav.problem.types import FloatArray, InputError

MEASURED = "realities.json"
"""In a run: what ``measure_once`` found."""
SEALED_LOG = "sealed-evaluations.jsonl"
"""In a run: one line for every time one of its policies was measured in the test reality."""
DRAWS = 10_000
"""Resamplings for intervals; their seed is fixed."""
ENOUGH_POLICIES = 8
"""Of fewer policies a correlation says little."""
MOST_SHOWN = 3
"""Agents side by side in the recording of ``keep``."""
OnEpisodes = Callable[[Problem, Result], None]
TITLE = "From simulation to reality"
QUESTION = "What do policies keep of their success in worlds that training never saw?"
COLUMNS = ("policy", "world", "success", "kept", "SPL", "collided")
LEGEND = (
    "Home is the world of the policy's training, with what was randomised there. Kept: success in the reality over "
    "success at home. In parentheses 95 % intervals: Wilson's, and of what was kept from Jeffreys' posteriors. "
    "Collided: share of the episodes with a contact. The same starts, goals and headings everywhere."
)


@dataclass(frozen=True)
class Gap:
    """One policy at home and away."""

    policy: str
    """Its name in the report."""
    at_home: Summary
    """In the world it was trained in, with what was randomised there."""
    away: dict[str, Summary]
    """In each reality."""

    def retention(self, reality: str) -> tuple[float, float, float]:
        """Share of the success at home that is left, with its 95 % interval; NaN where there was none."""
        home, there = self.at_home, self.away[reality]
        if home.success_rate == 0.0:
            return float("nan"), float("nan"), float("nan")
        rng = np.random.default_rng(0)
        # True success, at home and away: Jeffreys' posterior, which has a width where all or nothing arrived.
        draws = []
        for one in (there, home):
            arrived = one.success_rate * one.episodes
            draws.append(rng.beta(arrived + 0.5, one.episodes - arrived + 0.5, DRAWS))
        low, high = np.quantile(draws[0] / draws[1], [0.025, 0.975])
        return there.success_rate / home.success_rate, float(low), float(high)


@dataclass(frozen=True)
class Correlation:
    """How well success in one world foretells success in a reality, over policies (SRCC, Kadian et al. 2020)."""

    n_policies: int
    """How many."""
    pearson: float
    """Correlation of the success rates; NaN where all are equal at one of the places."""
    pearson_interval: tuple[float, float]
    """95 % bootstrap interval over policies."""
    spearman: float
    """The same of their ranks."""
    spearman_interval: tuple[float, float]
    """95 % bootstrap interval over policies."""


def measure(
    runs: Sequence[RunDirectory],
    realities: Sequence[str],
    episodes: int,
    on_stage: OnStage,
    *,
    on_episodes: OnEpisodes | None = None,
) -> list[Gap]:
    """Every policy of some runs that drives robots, at home and in realities.

    Args:
        runs: Finished runs.
        realities: Names.
        episodes: Of each policy in each world, the same ones everywhere.
        on_stage: Told of every evaluation.
        on_episodes: Given the episodes in each reality that is not sealed, with the problem they are of.

    Raises:
        InputError: When a reality is unknown, a run is not whole, or two have one name.
    """
    worlds = [find_reality(name) for name in realities]
    if len(runs) > 1:
        check_names(runs)
    gaps = []
    # All are read before one is measured: a look at the sealed reality that nobody is told of would be lost.
    for run, (problem, rows) in [(run, stored_evaluation(run)) for run in runs]:
        for name, row in rows.items():
            if row["world"] == "GridWorld":
                continue
            if row["world"] != WORLD and any(one["world"] == WORLD for one in rows.values()):
                continue  # the same agent on the robot has a row of its own
            agent = load_agent(run.checkpoints, row["checkpoint"])
            label = name if len(runs) == 1 else f"{run.path.name} {name}"
            home = replace(problem, randomization=Randomization.load(row["randomization"]))
            report = on_stage(f"{label} at home")
            at_home = summarise(evaluate_in(home, agent, row["world"], episodes, on_progress=report))
            away = {}
            for reality in worlds:
                away[reality.name] = _away(label, run, home, agent, reality, episodes, on_stage, on_episodes)
            gaps.append(Gap(label, at_home, away))
    return gaps


def measure_once(
    runs: Mapping[str, RunDirectory], realities: Sequence[str], episodes: int, on_stage: OnStage, *, jobs: int
) -> dict[str, Gap]:
    """The last policy of each run, at home and in realities; what an earlier call measured is read from the run.

    Args:
        runs: Finished runs by what their policies are called. Each belongs to the caller.
        realities: Names.
        episodes: Of each policy in each world.
        on_stage: Told of the evaluations.
        jobs: How many policies at once.
    """
    asked = {"realities": list(realities), "episodes": episodes}
    left = [run.path.resolve() for run in runs.values() if not _is_measured(run, asked)]
    report = on_stage("policies in realities") if left else None
    for number, _ in enumerate(in_workers(_measure_run, [(path, asked) for path in left], jobs), start=1):
        if report:
            report(Progress(number, len(left), {}))
    gaps = {}
    for name, run in runs.items():
        stored = read_json(run.path / MEASURED)
        away = {place: _summary(one) for place, one in stored["away"].items()}
        gaps[name] = Gap(name, _summary(stored["home"]), away)
    return gaps


def _is_measured(run: RunDirectory, asked: Mapping[str, Any]) -> bool:
    file = run.path / MEASURED
    stored = read_json(file) if file.is_file() else {}
    return all(stored.get(key) == value for key, value in asked.items())


def _measure_run(path: Path, asked: Mapping[str, Any]) -> None:
    """In a worker: the last policy of a run, whose numbers go there."""
    run = RunDirectory.open(path)
    gap = measure([run], asked["realities"], asked["episodes"], unseen)[-1]
    there = {place: asdict(summary) for place, summary in gap.away.items()}
    write_json(run.path / MEASURED, {**asked, "home": asdict(gap.at_home), "away": there})


def _summary(stored: Mapping[str, Any]) -> Summary:
    values: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in stored.items()}
    return Summary(**values)


def _away(
    label: str,
    run: RunDirectory,
    problem: Problem,
    agent: Agent,
    reality: Reality,
    n_episodes: int,
    on_stage: OnStage,
    on_episodes: OnEpisodes | None,
) -> Summary:
    report = on_stage(f"{label} in {reality.name}")
    if reality.is_sealed:
        summary = reality.measure(problem, agent, n_episodes, on_progress=report)
        _log(run, label, summary)
        return summary
    episodes = reality.episodes(problem, agent, n_episodes, on_progress=report)
    if on_episodes is not None:
        name = f"{label}-{reality.name}".replace(" ", "-")
        on_episodes(problem, Result(name, WORLD, f"{label} in {reality.name}", "", "", episodes))
    return summarise(episodes)


def keep(path: Path, episodes: Sequence[tuple[Problem, Result]], config: Mapping[str, Any]) -> None:
    """Episodes in realities as a run that ``gridnav view`` and ``gridnav video`` show.

    Args:
        path: The run's folder, which must not exist or be empty.
        episodes: What ``measure`` gave to ``on_episodes``.
        config: What was asked for.

    Raises:
        InputError: When the folder is taken.
    """
    problem, results = episodes[0][0], [result for _, result in episodes]
    with RunDirectory.create(path, "realities", config) as run:
        write_evaluation(run, results, 0)
        write_rollouts(run, problem, results, results[-MOST_SHOWN:], {})


def check_one_maze(runs: Sequence[RunDirectory]) -> None:
    """Whether episodes of these runs can be shown together.

    Raises:
        InputError: When they are of several mazes.
    """
    stored = [stored_evaluation(run) for run in runs]
    mazes = {problem.layout for problem, rows in stored if any(row["world"] != "GridWorld" for row in rows.values())}
    if len(mazes) > 1:
        raise InputError("--keep takes runs of one maze: their episodes are shown in it")


def _log(run: RunDirectory, policy: str, summary: Summary) -> None:
    row = {
        "time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "policy": policy,
        "episodes": summary.episodes,
        "success_rate": summary.success_rate,
    }
    with (run.path / SEALED_LOG).open("a", encoding="utf-8") as file:
        file.write(json.dumps(row) + "\n")


def sealed_evaluations(run: RunDirectory) -> int:
    """How often policies of a run were measured in the test reality."""
    log = run.path / SEALED_LOG
    return len(log.read_text(encoding="utf-8").splitlines()) if log.is_file() else 0


def home_and_away(gaps: Sequence[Gap], reality: str) -> FloatArray:
    """Success at home and in a reality, shape ``(n_policies, 2)``."""
    return np.array([[gap.at_home.success_rate, gap.away[reality].success_rate] for gap in gaps])


def correlation(pairs: FloatArray) -> Correlation:
    """Between success in one world and in a reality, of at least two policies, shape ``(n_policies, 2)``."""
    rng = np.random.default_rng(0)
    # Policies: uniform with replacement, so many as there are.
    picked = pairs[rng.integers(len(pairs), size=(DRAWS, len(pairs)))]
    ranks = stats.rankdata(picked, axis=1)
    return Correlation(
        len(pairs),
        _pearson(pairs),
        _interval(_pearsons(picked)),
        _pearson(stats.rankdata(pairs, axis=0)),
        _interval(_pearsons(ranks)),
    )


def _pearson(pairs: FloatArray) -> float:
    return float(_pearsons(pairs[None])[0])


def _pearsons(pairs: FloatArray) -> FloatArray:
    """Correlation of each draw, shape ``(n_draws,)``, of pairs of shape ``(n_draws, n, 2)``; NaN without variation."""
    centred = pairs - pairs.mean(axis=1, keepdims=True)
    covariance, variances = (centred[..., 0] * centred[..., 1]).sum(axis=1), (centred**2).sum(axis=1)
    product = np.sqrt(variances.prod(axis=1))
    return np.divide(covariance, product, out=np.full(len(pairs), np.nan), where=product > 1e-12)


def _interval(values: FloatArray) -> tuple[float, float]:
    known = values[np.isfinite(values)]
    if not known.size:
        return float("nan"), float("nan")
    low, high = np.quantile(known, [0.025, 0.975])
    return float(low), float(high)


# ---- The report ----------------------------------------------------------------------------------


def as_json(gaps: Sequence[Gap]) -> dict[str, Any]:
    """Everything that was measured, fit for JSON."""
    names = list(gaps[0].away) if gaps else []
    return {
        "policies": {
            gap.policy: {
                "home": asdict(gap.at_home),
                **{name: asdict(summary) for name, summary in gap.away.items()},
                "retention": {name: _known(gap.retention(name)) for name in names},
            }
            for gap in gaps
        },
        "correlation": {
            name: {key: _known(value) for key, value in asdict(correlation(home_and_away(gaps, name))).items()}
            for name in names
            if len(gaps) > 1
        },
    }


def _known(value: Any) -> Any:
    """JSON has no NaN."""
    if isinstance(value, tuple):
        return [_known(one) for one in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def conclusion(gaps: Sequence[Gap]) -> str:
    """What the numbers say, a sentence for each reality."""
    sentences = []
    for name in gaps[0].away:
        best, worst = (pick(gaps, key=_success_in(name)) for pick in (max, min))
        words = (
            f"In the {name} reality {best.policy} has {percent(best.away[name].success_rate)} success "
            f"({percent(best.at_home.success_rate)} at home), {worst.policy} {percent(worst.away[name].success_rate)} "
            f"({percent(worst.at_home.success_rate)})"
        )
        if len(gaps) > 1:
            found = correlation(home_and_away(gaps, name))
            words += f"; {_correlated(found)}"
        sentences.append(words + ".")
    return " ".join(sentences)


def _correlated(found: Correlation) -> str:
    """How success at home and in a reality go together."""
    if np.isnan(found.pearson):
        return f"all {found.n_policies} policies do equally well at one of the places, so nothing correlates"
    low, high = found.pearson_interval
    caution = "" if found.n_policies >= ENOUGH_POLICIES else "; too few to rely on"
    return (
        f"over {found.n_policies} policies success at home and there correlate by {found.pearson:.2f} "
        f"({low:.2f} to {high:.2f}{caution})"
    )


def _success_in(reality: str) -> Callable[[Gap], float]:
    return lambda gap: gap.away[reality].success_rate


def table(gaps: Sequence[Gap]) -> Table:
    """A row for each policy and world."""
    rows = []
    for gap in gaps:
        for name, summary in {"home": gap.at_home, **gap.away}.items():
            kept = ""
            if name != "home":
                share, least, most = gap.retention(name)
                kept = f"{share:.2f} ({least:.2f} to {most:.2f})"
            success = percent_interval(_with_interval(summary))
            ratios = [f"{summary.spl:.2f}", percent(summary.collision_rate)]
            rows.append([gap.policy, name, success, kept, *ratios])
    return Table("What was kept", COLUMNS, rows, LEGEND)


def write_gap_report(path: Path, gaps: Sequence[Gap], command: str) -> None:
    """A page with the question, the answer, the table and a figure."""
    realities = {name: find_reality(name).wrong for name in gaps[0].away}
    figure = kept_success(
        {gap.policy: _with_interval(gap.at_home) for gap in gaps},
        {name: {gap.policy: _with_interval(gap.away[name]) for gap in gaps} for name in realities},
    )
    caption = "Success at home (ring) and in each reality, with 95 % intervals: the line between is what was lost. "
    picture = Picture(figure, caption + _described(realities))
    page = Report(TITLE, QUESTION, conclusion(gaps), (), [picture], {}, command, recording="", tables=[table(gaps)])
    write_report(path, page)


def _with_interval(summary: Summary) -> tuple[float, float, float]:
    return summary.success_rate, *summary.success_interval


def _described(realities: Mapping[str, str]) -> str:
    words = "; ".join(f"{name}: {wrong}" for name, wrong in realities.items())
    return f"All realities are simulations. {words}."
