"""Many trials on all cores, each done exactly once however often the sweep is killed, and one table of them all."""

from __future__ import annotations

import csv
import io
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import joblib
from joblib.externals.loky.process_executor import TerminatedWorkerError

from gridnav.experiment.run_directory import RESULT, RunDirectory, read_json, write_json, write_whole
from gridnav.experiment.trials import Row, check_config, trial
from gridnav.problem.types import InputError

TABLE = "results.csv"
Backend = Literal["local", "ray"]
ROUND = 8
"""Trials per job in a round on a cluster, at whose end the table is written."""
WATCH_S = 0.2
"""How often a worker looks whether its sweep is still alive."""


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
    sweeper = os.getpid() if backend == "local" else None
    work = [joblib.delayed(_attempt)(one, one.folder(sweep).resolve(), checkpoint_s, sweeper) for one in left]
    with _workers(backend, jobs):
        for one, outcome in _results(work, backend, jobs):
            one.folder(sweep).mkdir(parents=True, exist_ok=True)  # a cluster's machine may have had one of its own
            write_json(one.folder(sweep) / RESULT, vars(outcome))
            outcomes[one.number] = outcome
            tell()
    return [outcomes[one.number] for one in trials]


def check_backend(backend: Backend) -> None:
    """Whether trials can be done there.

    Raises:
        InputError: When it is not installed.
    """
    if backend == "ray" and find_spec("ray") is None:
        raise InputError("--backend ray needs Ray, which is not installed: uv pip install ray, or leave --backend out")


@contextmanager
def _workers(backend: Backend, jobs: int) -> Iterator[None]:
    if backend == "ray":
        from ray.util.joblib import register_ray

        register_ray()
    # One thread of arithmetic each: the networks are small, and the number of threads decides the last bit.
    how: dict[str, Any] = {"backend": "ray"} if backend == "ray" else {"backend": "loky", "inner_max_num_threads": 1}
    try:
        with joblib.parallel_config(n_jobs=jobs, **how):
            yield
    except TerminatedWorkerError:
        raise OSError("a worker died, perhaps for want of memory: --resume goes on, with fewer --jobs if so") from None


def _results(work: Sequence[Any], backend: Backend, jobs: int) -> Iterator[tuple[Trial, Outcome]]:
    """What workers give back, as soon as it is there."""
    if backend == "local":
        yield from joblib.Parallel(return_as="generator_unordered", batch_size=1)(work)
        return
    # Joblib's Ray backend gives nothing back before all is done: in rounds the table grows meanwhile.
    for begin in range(0, len(work), ROUND * jobs):
        yield from joblib.Parallel(batch_size=1)(work[begin : begin + ROUND * jobs])


def _attempt(one: Trial, folder: Path, checkpoint_s: float, sweeper: int | None) -> tuple[Trial, Outcome]:
    """A trial in a worker; what speaks against the trial is an outcome, what speaks against the machine is raised."""
    if sweeper is not None:
        _end_with(sweeper)
    began = time.perf_counter()
    try:
        rows, error = trial(one.config, folder, checkpoint_s, one.under), ""
    except OSError:
        raise
    except Exception as failure:  # one bad trial must not take the others down
        rows, error = [], f"{type(failure).__name__}: {' '.join(str(failure).split())[:300]}"
    return one, Outcome(rows, error, round(time.perf_counter() - began, 3))


def _end_with(sweeper: int) -> None:
    """Let this worker end when its sweep is gone: killed, that cannot say goodbye, and workers would go on alone."""

    def watch() -> None:
        while os.getppid() == sweeper:
            time.sleep(WATCH_S)
        os._exit(1)

    name = "gridnav-watch"
    if os.getpid() != sweeper and all(thread.name != name for thread in threading.enumerate()):
        threading.Thread(target=watch, name=name, daemon=True).start()


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
