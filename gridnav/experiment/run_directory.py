"""The files of a run: made in one place, found again from one path."""

from __future__ import annotations

import json
import math
import os
import socket
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from filelock import FileLock, Timeout
from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.event_file_writer import EventFileWriter

from gridnav.problem.strict_json import parse_object, read_object
from gridnav.problem.types import InputError

CONFIG, METRICS, EVALUATION, REPORT, RECORDING = (
    "config.json",
    "metrics.jsonl",
    "evaluation.json",
    "report.html",
    "rollout.rrd",
)


RESULT = "result.json"
"""What came of a sweep's trial; other runs have none."""
LOCK, OWNER = ".lock", ".owner"


class RunInUseError(OSError):
    """Another process owns the run directory."""


class RunDirectory:
    """``runs/<run-id>/`` with config, metrics, evaluation, report, recording, rollouts, figures and checkpoints."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.config, self.evaluation = path / CONFIG, path / EVALUATION
        self.report, self.recording = path / REPORT, path / RECORDING
        self.figures, self.checkpoints, self.rollouts = path / "figures", path / "checkpoints", path / "rollouts"
        self._lock, self._owner = path / LOCK, path / OWNER

    @classmethod
    @contextmanager
    def create(cls, path: Path | None, name: str, config: Mapping[str, Any]) -> Iterator[Self]:
        """A new run with its config on disk, this process's own until the context ends.

        Args:
            path: Where; ``runs/<name>-<time>`` below the current folder by default.
            name: What the run does.
            config: Everything that makes the run again, fit for JSON.

        Raises:
            InputError: When the directory exists and is not empty, so that no run is ever overwritten.
            RunInUseError: When another process owns it.
        """
        run = cls(_free_path(name) if path is None else path)
        if run._lock.exists():
            with run.own():  # says who owns it, if somebody does
                pass
        run.check_free()
        run.path.mkdir(parents=True, exist_ok=True)
        with run.own():
            if not run.is_fresh:
                raise InputError(
                    f"run directory {str(run.path)!r} was taken by another run: name another with --run-dir"
                )
            run.figures.mkdir(exist_ok=True)
            write_json(run.config, config)
            yield run

    @contextmanager
    def own(self, patience_s: float = 0.0) -> Iterator[None]:
        """Keep other processes out of the run; the system ends it with this process, whatever ends that.

        Args:
            patience_s: How long to wait for another process that owns it.

        Raises:
            RunInUseError: When another process owns the run; the message names it.
        """
        lock = FileLock(self._lock)
        try:
            lock.acquire(timeout=patience_s)
        except Timeout:
            try:
                owner = self._owner.read_text(encoding="utf-8").strip()
            except OSError:
                owner = "another process"
            words = f"run directory {str(self.path)!r} is in use by {owner}: wait for it or stop it"
            raise RunInUseError(words) from None
        try:
            self._owner.write_text(f"process {os.getpid()} on {socket.gethostname()}", encoding="utf-8")
            yield
        finally:
            lock.release()

    def check_free(self) -> None:
        """Whether a run may begin here.

        Raises:
            InputError: When the directory exists and is not empty.
        """
        if self.path.exists() and not self.is_fresh:
            raise InputError(f"run directory {str(self.path)!r} exists and is not empty: name another with --run-dir")

    @property
    def is_fresh(self) -> bool:
        """Nothing was ever run here: the directory is empty but for what a start that was killed leaves."""
        if not self.path.is_dir():
            return False
        left = {entry.name for entry in self.path.iterdir()}
        return left <= {LOCK, OWNER, self.figures.name, f".tmp-{CONFIG}"} and not any(self.figures.glob("*"))

    @classmethod
    def open(cls, path: Path) -> Self:
        """An existing run.

        Raises:
            InputError: When the path is no run directory.
        """
        if not (path / CONFIG).is_file():
            raise InputError(f"{str(path)!r} is not a run directory: it has no {CONFIG}; give the folder of a run")
        return cls(path)

    def last_rollouts(self, there: Sequence[str]) -> str:
        """Of the rollouts that are there, those of the last row of the evaluation."""
        rows = read_json(self.evaluation).get("results", {}) if self.evaluation.is_file() else {}
        known = [name for name in rows if name in there] if isinstance(rows, dict) else []
        return known[-1] if known else there[-1]

    def read_config(self) -> dict[str, Any]:
        """The config the run was made with.

        Raises:
            InputError: When the file is no JSON object.
        """
        return read_json(self.config)


class MetricsLog:
    """Rows of numbers to ``metrics.jsonl`` and to TensorBoard, keyed by series and environment steps.

    Args:
        run: Whose.
        keep_bytes: Length of what a continued run keeps of its metrics; later rows will be written again.

    Raises:
        InputError: When there is less than that to keep, or it is damaged; nothing has changed then.
    """

    def __init__(self, run: RunDirectory, keep_bytes: int = 0) -> None:
        self._rows: dict[str, list[dict[str, float]]] = {}
        self._file = (run.path / METRICS).open("a+b")
        kept = self._cut_back(keep_bytes)
        # The new file of events tells everything again, for TensorBoard would show both sides of a cut.
        for earlier in run.path.glob("events.out.tfevents.*"):
            earlier.unlink()
        # TensorBoard's own writer, without torch's wrapper: tabular runs need not wait for torch.
        self._events = EventFileWriter(str(run.path))
        for row in kept:
            self._keep(row.pop("series"), row)

    def _cut_back(self, length: int) -> list[dict[str, Any]]:
        there = self._file.seek(0, os.SEEK_END)
        if there < length:
            raise InputError(f"{METRICS} has {there} bytes, its checkpoint needs {length}: rows are missing")
        self._file.seek(0)
        rows = _rows(self._file.read(length))
        self._file.truncate(length)
        self._file.seek(0, os.SEEK_END)
        return rows

    def add(self, series: str, steps: int, metrics: Mapping[str, float]) -> None:
        """Write one row, for example ``add("ppo", 16384, {"success_rate": 0.5})``."""
        row = {"steps": steps, **metrics}
        # JSON has no NaN and no infinity: a rate that is not known yet is left out.
        finite = {name: value for name, value in row.items() if math.isfinite(value)}
        self._file.write((json.dumps({"series": series, **finite}) + "\n").encode("utf-8"))
        self._file.flush()
        self._keep(series, finite)

    def _keep(self, series: str, row: dict[str, float]) -> None:
        self._rows.setdefault(series, []).append(row)
        values = [Summary.Value(tag=f"{series}/{n}", simple_value=v) for n, v in row.items() if n != "steps"]
        event = Event(wall_time=time.time(), step=int(row["steps"]), summary=Summary(value=values))
        self._events.add_event(event)

    def sync(self) -> int:
        """Force all rows to the disk; their length in bytes."""
        os.fsync(self._file.fileno())
        return self._file.tell()

    def curve(self, series: str, metric: str) -> tuple[list[float], list[float]]:
        """Steps and values of one metric, where it was measured."""
        rows = [row for row in self._rows.get(series, []) if metric in row]
        return [row["steps"] for row in rows], [row[metric] for row in rows]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()
        self._events.close()


def read_rows(path: Path) -> list[dict[str, Any]]:
    """The rows of a run's metrics.

    Raises:
        InputError: When the file cannot be read as such.
    """
    try:
        return _rows(path.read_bytes())
    except OSError as error:
        raise InputError(f"{str(path)!r} cannot be read: {error.strerror}") from None


def _rows(content: bytes) -> list[dict[str, Any]]:
    try:
        return [_row(line) for line in content.decode("utf-8").splitlines()]
    except ValueError as error:
        raise InputError(f"{METRICS} is damaged: a line is no row of metrics: {error}") from None


def _row(line: str) -> dict[str, Any]:
    """A row of metrics from a file, as ``add`` wrote it; ValueError if it is none."""
    row = parse_object(line)
    numbers = [value for name, value in row.items() if name != "series"]
    if not isinstance(row.get("series"), str) or not all(text.isprintable() for text in (*row, row["series"])):
        raise ValueError("it has no series")
    if not all(isinstance(number, int | float) and abs(number) < 1e300 for number in numbers):
        raise ValueError("it holds more than numbers")
    if not 0 <= row.get("steps", -1) < 2**53:
        raise ValueError("it has no steps")
    return row


def _free_path(name: str) -> Path:
    """``runs/<name>-<time>``, with a number where two runs start in one second."""
    stamp = time.strftime("%Y%m%d-%H%M%S")
    path = Path("runs") / f"{name}-{stamp}"
    for count in range(2, 100):
        if not path.exists():
            break
        path = Path("runs") / f"{name}-{stamp}-{count}"
    return path


def check_names(runs: Sequence[RunDirectory]) -> None:
    """Whether the names of their folders tell some runs apart.

    Raises:
        InputError: When two have the same one.
    """
    names = [run.path.resolve().name for run in runs]
    if len(set(names)) < len(names):
        twice = max(names, key=names.count)
        raise InputError(f"two of the runs are called {twice!r}: the table could not tell them apart, rename a folder")


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a file that is either whole or not there."""
    write_whole(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


def write_whole(path: Path, text: str) -> None:
    """Write a file that is either whole or as it was before."""
    aside = path.with_name(f".tmp-{path.name}")
    with aside.open("w", encoding="utf-8", newline="") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    aside.replace(path)


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object from a file.

    Raises:
        InputError: When the file cannot be read as one.
    """
    try:
        return read_object(path)
    except OSError as error:
        raise InputError(f"{str(path)!r} cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise InputError(f"{str(path)!r} is not valid JSON: {error}") from None
