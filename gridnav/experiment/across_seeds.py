"""Several runs as one result: the same training with several seeds, and different trainings side by side."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from gridnav.display.figures import comparison
from gridnav.experiment.run_directory import METRICS, RunDirectory, read_rows
from gridnav.experiment.training import Result
from gridnav.problem.metrics import by_layout
from gridnav.problem.statistics import iqm, stratified_bootstrap
from gridnav.problem.types import FloatArray, InputError

SOLVED = 0.99
"""Success from which on a seed counts as solved."""
OWN_TO_A_SEED = ("seed", "command", "agent")
"""What labels leave out: the agent has a name of its own in front of them."""


@dataclass(frozen=True)
class AcrossSeeds:
    """One training, repeated with several seeds. Pairs are an interquartile mean's 95 % bootstrap interval."""

    name: str
    """Of the agent, with what tells its runs from the others'."""
    world: str
    """Where it was evaluated."""
    seeds: list[int]
    """Of training."""
    n_solved: int
    """Seeds with a success of at least ``SOLVED``."""
    success: float
    """Interquartile mean over seeds and layouts."""
    success_interval: tuple[float, float]
    success_range: tuple[float, float]
    """Worst and best seed."""
    spl: float
    spl_interval: tuple[float, float]
    sct: float
    sct_interval: tuple[float, float]
    collision_rate: float
    """Share of episodes with a collision."""
    collision_rate_interval: tuple[float, float]
    training_steps: float
    """Median over seeds."""
    training_seconds: float
    """Median over seeds."""


def across_seeds(runs: Sequence[tuple[RunDirectory, Sequence[Result]]]) -> list[AcrossSeeds]:
    """One row per agent and kind of run, its seeds put together.

    Raises:
        InputError: When two runs have the same config and the same seed: they are one run twice.
    """
    groups: dict[str, list[tuple[int, Result]]] = {}
    for label, run, result in _labelled(runs):
        groups.setdefault(label, []).append((int(run.read_config()["seed"]), result))
    rows = []
    for label, members in groups.items():
        seeds = [seed for seed, _ in members]
        if len(set(seeds)) < len(seeds):
            raise InputError(f"two of the runs of {label} have the same seed: {sorted(seeds)}")
        rows.append(_row(label, seeds, [result for _, result in members]))
    return rows


def compared_curves(runs: Sequence[tuple[RunDirectory, Sequence[Result]]]) -> Figure:
    """Training success of each kind of run against environment steps, with intervals over seeds.

    Raises:
        InputError: When no run has a curve.
    """
    curves: dict[str, list[tuple[FloatArray, FloatArray]]] = {}
    for label, run, result in _labelled(runs):
        rows = [row for row in read_rows(run.path / METRICS) if row["series"] == result.name and "success_rate" in row]
        if len(rows) > 1:
            x, y = (np.array([float(row[key]) for row in rows]) for key in ("steps", "success_rate"))
            curves.setdefault(label, []).append((x, y))
    if not curves:
        raise InputError("none of the runs has a learning curve: a plan has nothing to learn")
    return comparison(curves)


def _labelled(
    runs: Sequence[tuple[RunDirectory, Sequence[Result]]],
) -> list[tuple[str, RunDirectory, Result]]:
    """Every result with its agent's name and the flags in which its run differs from others."""
    labelled = []
    for (run, results), words in zip(runs, labels_of([run.read_config() for run, _ in runs]), strict=True):
        labelled += [(f"{result.name} {words}".strip(), run, result) for result in results]
    return labelled


def labels_of(configs: Sequence[Mapping[str, Any]]) -> list[str]:
    """What tells the configurations of runs from each other, in words, whatever their seeds; empty where nothing."""
    own = [{key: value for key, value in config.items() if key not in OWN_TO_A_SEED} for config in configs]
    keys = dict.fromkeys(key for config in own for key in config)
    differ = [key for key in keys if len({json.dumps(config.get(key)) for config in own}) > 1]
    labels, known = [], dict[str, list[Any]]()
    for config in own:
        words = " ".join(_words(config.get(key)) for key in differ if config.get(key))
        alike = known.setdefault(words, [])
        if config not in alike:
            alike.append(config)
        number = alike.index(config) + 1  # words are cut short, and what is cut off may differ
        labels.append(words if number == 1 else f"{words} ({number})")
    return labels


def _words(value: Any) -> str:
    return " ".join(value) if isinstance(value, list) else str(value).split("\n")[0][:30]


def _row(label: str, seeds: list[int], results: Sequence[Result]) -> AcrossSeeds:
    summaries = [result.summary for result in results]
    successes = [summary.success_rate for summary in summaries]
    metrics: Mapping[str, Any] = {
        "success": lambda episodes: np.mean([episode.is_success for episode in episodes]),
        "spl": lambda episodes: np.mean([episode.length_ratio for episode in episodes]),
        "sct": lambda episodes: np.mean([episode.time_ratio for episode in episodes]),
        "collision_rate": lambda episodes: np.mean([episode.collisions > 0 for episode in episodes]),
    }
    parts = [by_layout(result.episodes) for result in results]
    values: dict[str, Any] = {}
    for name, metric in metrics.items():
        # The layouts are the tasks; of each, every seed gives one score.
        scores = [[float(metric(part[layout])) for part in parts] for layout in parts[0]]
        values[name] = float(iqm(np.concatenate(scores)))
        values[f"{name}_interval"] = stratified_bootstrap(scores, rng=np.random.default_rng(0))
    return AcrossSeeds(
        name=label,
        world=results[0].world,
        seeds=seeds,
        n_solved=sum(success >= SOLVED for success in successes),
        success_range=(min(successes), max(successes)),
        training_steps=float(np.median([result.steps for result in results])),
        training_seconds=float(np.median([result.seconds for result in results])),
        **values,
    )
