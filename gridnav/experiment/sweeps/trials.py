"""One trial of a sweep: a pure function from a configuration to rows of numbers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

from gridnav.experiment.checkpoint import clear_leftovers
from gridnav.experiment.course import CHECKPOINT_S
from gridnav.experiment.run_directory import RunDirectory, write_json
from gridnav.experiment.training import BUDGETS, Job, Result, Training, unseen
from gridnav.experiment.worlds import Problem
from gridnav.problem.types import InputError

Row = dict[str, Any]
"""An evaluated agent: names and numbers, fit for JSON."""
DIGITS = 6
"""Behind the point, of the numbers in rows."""
NOWHERE_ELSE: Mapping[str, str] = MappingProxyType({})
PATIENCE_S = 30.0
"""How long a trial waits for a process that still works on it, whose sweep was killed."""


def problem_of(config: Mapping[str, Any]) -> Problem:
    """The problem that a run's configuration describes.

    Raises:
        InputError: When a part of it is unknown or wrong.
    """
    return Problem.load(config["layout"], config["task"], config["reward"], config.get("randomization", "none"))


def trial(
    config: Mapping[str, Any],
    path: Path,
    checkpoint_s: float = CHECKPOINT_S,
    under: Mapping[str, str] = NOWHERE_ELSE,
) -> list[Row]:
    """Do what a configuration asks for; the same configuration gives the same rows.

    A trial that was killed goes on from its checkpoints, and gives the rows that it would have given.

    Args:
        config: As in the ``config.json`` of a run, with the command under ``command``: ``train``, ``ladder`` or
            ``evaluate``.
        path: The trial's run directory, which is made if it does not exist.
        checkpoint_s: Seconds between two checkpoints of a training.
        under: Where agents that were trained are evaluated: randomizations by the name that their rows bear. By
            default where they were trained.

    Returns:
        One row per evaluation of an agent.

    Raises:
        InputError: When the configuration is not possible, or the directory belongs to another one.
        NonFiniteError: When a training stopped at a number that is not finite.
        OSError: When the disk is full, or another process works in the directory.
    """
    with _directory(path, config) as run:
        results = TRIALS[config["command"]](config, run, checkpoint_s)
        if not under:
            return [row_of(result) for result in results]
        n_episodes = BUDGETS[config["budget"]].episodes
        return [{"under": name} | row_of(one) for name, what in under.items() for one in _again(run, n_episodes, what)]


@contextmanager
def _directory(path: Path, config: Mapping[str, Any]) -> Iterator[RunDirectory]:
    """The trial's run directory, this process's own."""
    run = RunDirectory(path)
    path.mkdir(parents=True, exist_ok=True)
    with run.own(patience_s=PATIENCE_S):
        check_config(run, config)
        if not run.config.is_file():
            write_json(run.config, config)
        clear_leftovers(run.checkpoints)
        yield run


def check_config(run: RunDirectory, config: Mapping[str, Any]) -> None:
    """Whether a trial may go on in a directory.

    Raises:
        InputError: When a trial of another configuration began there.
    """
    if run.config.is_file() and run.read_config() != config:
        raise InputError(f"{str(run.path)!r} holds a trial of another config: begin another sweep")


def _train(config: Mapping[str, Any], run: RunDirectory, checkpoint_s: float) -> list[Result]:
    from gridnav.experiment.results import train_and_report

    problem = problem_of(config)
    return train_and_report(_job(config, problem, run, checkpoint_s), Training.of(config, problem), with_pictures=False)


def _ladder(config: Mapping[str, Any], run: RunDirectory, checkpoint_s: float) -> list[Result]:
    from gridnav.experiment.arms import choose_arms
    from gridnav.experiment.ladder import climb, compare

    run.figures.mkdir(exist_ok=True)
    job = _job(config, problem_of(config), run, checkpoint_s)
    return compare(job, choose_arms(config["arms"])) if "arms" in config else climb(job)


def _job(config: Mapping[str, Any], problem: Problem, run: RunDirectory, checkpoint_s: float) -> Job:
    budget = BUDGETS[config["budget"]]
    return Job(problem, budget, config["seed"], run, unseen, config, checkpoint_s=checkpoint_s)


def _evaluate(config: Mapping[str, Any], run: RunDirectory, checkpoint_s: float) -> list[Result]:
    return _again(RunDirectory.open(Path(config["run"])), config["episodes"], config["randomization"])


def _again(run: RunDirectory, n_episodes: int, randomization: str) -> list[Result]:
    """The robots of a finished run, evaluated anew; nothing varies on the grid."""
    from gridnav.experiment.results import evaluate_again

    results = evaluate_again(run, n_episodes, None, unseen, randomization=randomization)
    return [result for result in results if result.world != "GridWorld"]


TRIALS: dict[str, Callable[[Mapping[str, Any], RunDirectory, float], list[Result]]] = {
    "train": _train,
    "ladder": _ladder,
    "evaluate": _evaluate,
}
"""What a trial can do, by the name of the command that does it alone."""


def row_of(result: Result) -> Row:
    """The numbers of a result that a table of many shows; none of them is a wall-clock time."""
    summary = result.summary
    low, high = summary.success_interval
    numbers = {
        "success": summary.success_rate,
        "success_low": low,
        "success_high": high,
        "spl": summary.spl,
        "sct": summary.sct,
        "collided": summary.collision_rate,
        "median_time_s": summary.median_time_s,
    }
    rounded = {name: None if value is None else round(value, DIGITS) for name, value in numbers.items()}
    return {"name": result.name, "world": result.world, "episodes": summary.episodes, **rounded, "steps": result.steps}
