"""Pure functions on all cores, or on the cores of a Ray cluster, through joblib."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from importlib.util import find_spec
from typing import Any, Literal, TypeVar

import joblib
from joblib.externals.loky.process_executor import TerminatedWorkerError

from gridnav.problem.types import InputError

Backend = Literal["local", "ray"]
ROUND = 8
"""Calls per job in a round on a cluster, at whose end they give something back."""
WATCH_S = 0.2
"""How often a worker looks whether its master is still alive."""
Outcome = TypeVar("Outcome")


def check_backend(backend: Backend) -> None:
    """Whether something can be done there.

    Raises:
        InputError: When it is not installed.
    """
    if backend == "ray" and find_spec("ray") is None:
        raise InputError("--backend ray needs Ray, which is not installed: uv pip install ray, or leave --backend out")


def in_workers(
    function: Callable[..., Outcome], calls: Sequence[tuple[Any, ...]], jobs: int, backend: Backend = "local"
) -> Iterator[Outcome]:
    """What a function gives for each of its arguments, as soon as it is there.

    Args:
        function: Pure; it and its arguments can be sent to another process.
        calls: Arguments of each call.
        jobs: How many at once.
        backend: On this machine, or on a Ray cluster.

    Raises:
        OSError: When a worker died.
    """
    # One thread of arithmetic each: the networks are small, and the number of threads decides the last bit.
    how: dict[str, Any] = {"backend": "loky", "inner_max_num_threads": 1}
    if backend == "ray":
        from ray.util.joblib import register_ray

        register_ray()
        how = {"backend": "ray"}
    master = os.getpid() if backend == "local" else None
    work = [joblib.delayed(_call)(master, function, arguments) for arguments in calls]
    try:
        with joblib.parallel_config(n_jobs=jobs, **how):
            if backend == "local":
                yield from joblib.Parallel(return_as="generator_unordered", batch_size=1)(work)
                return
            # Joblib's Ray backend gives nothing back before all is done: in rounds something comes meanwhile.
            for begin in range(0, len(work), ROUND * jobs):
                yield from joblib.Parallel(batch_size=1)(work[begin : begin + ROUND * jobs])
    except TerminatedWorkerError:
        raise OSError("a worker died, perhaps for want of memory: --resume goes on, with fewer --jobs if so") from None


def _call(master: int | None, function: Callable[..., Outcome], arguments: tuple[Any, ...]) -> Outcome:
    if master is not None:
        _end_with(master)
    return function(*arguments)


def _end_with(master: int) -> None:
    """Let this worker end when its master is gone: killed, that cannot say goodbye, and workers would go on alone."""

    def watch() -> None:
        while os.getppid() == master:
            time.sleep(WATCH_S)
        os._exit(1)

    name = "gridnav-watch"
    if os.getpid() != master and all(thread.name != name for thread in threading.enumerate()):
        threading.Thread(target=watch, name=name, daemon=True).start()
