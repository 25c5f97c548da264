"""The files of a run: made in one place, found again from one path."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.event_file_writer import EventFileWriter

from gridnav.problem.types import InputError

CONFIG, METRICS, EVALUATION, REPORT, RECORDING = (
    "config.json",
    "metrics.jsonl",
    "evaluation.json",
    "report.html",
    "rollout.rrd",
)


class RunDirectory:
    """``runs/<run-id>/`` with config, metrics, evaluation, report, recording, figures and checkpoints."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.config, self.evaluation = path / CONFIG, path / EVALUATION
        self.report, self.recording = path / REPORT, path / RECORDING
        self.figures, self.checkpoints = path / "figures", path / "checkpoints"

    @classmethod
    def create(cls, path: Path | None, name: str, config: Mapping[str, Any]) -> Self:
        """A new run with its config on disk.

        Args:
            path: Where; ``runs/<name>-<time>`` below the current folder by default.
            name: What the run does.
            config: Everything that makes the run again, fit for JSON.

        Raises:
            InputError: When the directory exists and is not empty, so that no run is ever overwritten.
        """
        if path is None:
            stamp = time.strftime("%Y%m%d-%H%M%S")
            path = Path("runs") / f"{name}-{stamp}"
            for count in range(2, 100):
                if not path.exists():
                    break
                path = Path("runs") / f"{name}-{stamp}-{count}"
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise InputError(f"run directory {str(path)!r} exists and is not empty: name another with --run-dir")
        run = cls(path)
        run.figures.mkdir(parents=True)
        write_json(run.config, config)
        return run

    @classmethod
    def open(cls, path: Path) -> Self:
        """An existing run.

        Raises:
            InputError: When the path is no run directory.
        """
        if not (path / CONFIG).is_file():
            raise InputError(f"{str(path)!r} is not a run directory: it has no {CONFIG}; give the folder of a run")
        return cls(path)

    def read_config(self) -> dict[str, Any]:
        """The config the run was made with.

        Raises:
            InputError: When the file is no JSON object.
        """
        return read_json(self.config)


class MetricsLog:
    """Rows of numbers to ``metrics.jsonl`` and to TensorBoard, keyed by series and environment steps."""

    def __init__(self, run: RunDirectory) -> None:
        self._file = (run.path / METRICS).open("a", encoding="utf-8")
        # TensorBoard's own writer, without torch's wrapper: tabular runs need not wait for torch.
        self._events = EventFileWriter(str(run.path))
        self._rows: dict[str, list[dict[str, float]]] = {}

    def add(self, series: str, steps: int, metrics: Mapping[str, float]) -> None:
        """Write one row, for example ``add("ppo", 16384, {"success_rate": 0.5})``."""
        row = {"steps": steps, **metrics}
        # JSON has no NaN: a rate that is not known yet is left out.
        finite = {name: value for name, value in row.items() if value == value}
        self._rows.setdefault(series, []).append(finite)
        self._file.write(json.dumps({"series": series, **finite}) + "\n")
        self._file.flush()
        values = [Summary.Value(tag=f"{series}/{n}", simple_value=v) for n, v in finite.items() if n != "steps"]
        self._events.add_event(Event(wall_time=time.time(), step=steps, summary=Summary(value=values)))

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


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a file that is either whole or not there."""
    aside = path.with_name(f".tmp-{path.name}")
    aside.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    aside.replace(path)


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object from a file.

    Raises:
        InputError: When the file cannot be read as one.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{str(path)!r} cannot be read: {error.strerror}") from None
    except ValueError:
        raise InputError(f"{str(path)!r} is not valid JSON") from None
    if not isinstance(content, dict):
        raise InputError(f"{str(path)!r} must hold one JSON object")
    return content
