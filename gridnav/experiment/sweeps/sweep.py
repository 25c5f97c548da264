"""Many trials on all cores, each done exactly once however often the sweep is killed, and one table of them all."""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gridnav.experiment.run_directory import RESULT, RunDirectory, read_json, write_json, write_whole
from gridnav.experiment.sweeps.trials import Row, check_config, trial
from gridnav.experiment.workers import Backend, check_backend, in_workers
from gridnav.problem.types import InputError

TABLE = "results.csv"


@dataclass(frozen=True)
class Trial:
    """One line of a sweep's plan."""

    number: int
    """From 0, in the order of the design; its folder's name."""
    settings: Mapping[str, str]
    """What tells it from the others, by column of the table."""
    config: Mapping[str, Any]
    """What it does, as the command that does it alone would write it down."""
    under: Mapping[str, str] = field(default_factory=dict)
    """Randomizations that its agents are evaluated under, by name; by default the one they were trained in."""

    def folder(self, sweep: RunDirectory) -> Path:
        """Where its files are."""
        return sweep.path / "trials" / f"{self.number:04d}"


@dataclass(frozen=True)
class Outcome:
    """What came of a trial."""

    rows: Sequence[Row]
    """One per evaluated agent; none where it failed."""
    error: str = ""
    """Why it failed, in words."""
    seconds: float = 0.0
    """Wall-clock time of the process that ended it."""


def carry_out(
    trials: Sequence[Trial],
    sweep: RunDirectory,
    *,
    jobs: int,
    backend: Backend = "local",
    checkpoint_s: float,
    on_done: Callable[[int, int], None],
) -> list[Outcome]:
    """Do the trials that are not done yet, and keep the table of those that are.

    A trial that fails becomes a row with its error in words, and the sweep goes on.

    Args:
        trials: In the order of the table.
        sweep: Where the files go; whoever calls owns it.
        jobs: How many trials at once.
        backend: On this machine, or on a Ray cluster.
        checkpoint_s: Seconds between two checkpoints of a training.
        on_done: Told how many trials are done and how many of them failed, at the beginning and after each.

    Returns:
        One outcome per trial.

    Raises:
        InputError: When the backend is not installed, or a folder holds a trial of another config; nothing was written.
        OSError: When the disk is full, a folder is in use, or a worker died.
        KeyboardInterrupt: When asked to stop; ``carry_out`` again goes on.
    """
    check_backend(backend)
    outcomes = {one.number: outcome for one in trials if (outcome := _stored(one, sweep)) is not None}

    def tell() -> None:
        write_table(sweep, trials, outcomes)
        on_done(len(outcomes), sum(bool(outcome.error) for outcome in outcomes.values()))

    tell()
    left = [one for one in trials if one.number not in outcomes]
    work = [(one, one.folder(sweep).resolve(), checkpoint_s) for one in left]
    for one, outcome in in_workers(_attempt, work, jobs, backend):
        one.folder(sweep).mkdir(parents=True, exist_ok=True)  # a cluster's machine may have had one of its own
        write_json(one.folder(sweep) / RESULT, vars(outcome))
        outcomes[one.number] = outcome
        tell()
    return [outcomes[one.number] for one in trials]


def _attempt(one: Trial, folder: Path, checkpoint_s: float) -> tuple[Trial, Outcome]:
    """A trial in a worker; what speaks against the trial is an outcome, what speaks against the machine is raised."""
    began = time.perf_counter()
    try:
        rows, error = trial(one.config, folder, checkpoint_s, one.under), ""
    except OSError:
        raise
    except Exception as failure:  # one bad trial must not take the others down
        rows, error = [], f"{type(failure).__name__}: {' '.join(str(failure).split())[:300]}"
    return one, Outcome(rows, error, round(time.perf_counter() - began, 3))


# ---- Files -------------------------------------------------------------------------------------------


def _stored(one: Trial, sweep: RunDirectory) -> Outcome | None:
    """The outcome of a trial that an earlier process finished."""
    folder = one.folder(sweep)
    check_config(RunDirectory(folder), one.config)
    if not (folder / RESULT).is_file():
        return None
    try:
        outcome = Outcome(**read_json(folder / RESULT))
        if not all(isinstance(row, dict) for row in outcome.rows) or not isinstance(outcome.error, str):
            raise TypeError("it holds no rows")
    except TypeError as error:
        raise InputError(f"{str(folder / RESULT)!r} is damaged: {error}; remove it to do the trial again") from None
    return outcome


def table_of(trials: Sequence[Trial], outcomes: Mapping[int, Outcome]) -> list[Row]:
    """The rows of all trials that are done, in the order of the design: settings, numbers, error."""
    rows = []
    for one in trials:
        if one.number in outcomes:
            outcome = outcomes[one.number]
            for numbers in outcome.rows or [{}]:
                rows.append({"trial": one.number, **one.settings, **numbers, "error": outcome.error})
    return rows


def write_table(sweep: RunDirectory, trials: Sequence[Trial], outcomes: Mapping[int, Outcome]) -> None:
    """``results.csv``, whole or not at all, and the same bytes in whichever order the trials were done."""
    rows = table_of(trials, outcomes)
    columns = [key for key in dict.fromkeys(key for row in rows for key in row) if key != "error"]
    text = io.StringIO()
    writer = csv.DictWriter(text, [*columns, "error"], restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_whole(sweep.path / TABLE, text.getvalue())
