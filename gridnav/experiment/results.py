"""What a run found, written down: evaluation, figures, recording and report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from importlib.metadata import version
from typing import Any

import numpy as np

from gridnav.display.recording import write_recording
from gridnav.display.report import Picture, Report, Rung, Table, write_report
from gridnav.display.words import percent
from gridnav.envs import Randomization
from gridnav.experiment.checkpoint import LIBRARIES, last_standing, load_agent
from gridnav.experiment.evaluation import EVALUATION_SEED, HELD_OUT_LAYOUTS, evaluate_in
from gridnav.experiment.pictures import pictures
from gridnav.experiment.rollouts import Rollouts, save_rollouts
from gridnav.experiment.run_directory import MetricsLog, RunDirectory, read_json, write_json
from gridnav.experiment.training import Job, OnStage, Result, Training, Workshop
from gridnav.experiment.worlds import UNITS, Problem
from gridnav.problem.metrics import Episode
from gridnav.problem.types import InputError

_NEEDED = ("world", "agent", "carried", "checkpoint", "observation", "training_steps", "training_seconds")


def write_evaluation(
    run: RunDirectory,
    results: Sequence[Result],
    seed: int,
    evaluation_seed: int = EVALUATION_SEED,
    arms: Mapping[str, Any] | None = None,
) -> None:
    """``evaluation.json``: every metric of every rung, and one row per episode; where there are arms, their cost."""
    content = {"seed": seed, "evaluation_seed": evaluation_seed, "results": evaluation(results)}
    write_json(run.evaluation, content | ({} if arms is None else {"arms": arms}))


def evaluation(results: Sequence[Result]) -> dict[str, Any]:
    """Metrics and episode rows of each result by its name, fit for JSON."""
    return {
        result.name: {
            "world": result.world,
            "agent": result.agent,
            "carried": result.carried,
            "checkpoint": result.checkpoint,
            "observation": result.observation,
            "randomization": result.randomization,
            **asdict(result.summary),
            "training_steps": result.steps,
            "training_seconds": result.seconds,
            "rows": [episode.row() for episode in result.episodes],
        }
        for result in results
    }


def write_rollouts(
    run: RunDirectory,
    problem: Problem,
    results: Sequence[Result],
    side_by_side: Sequence[Result],
    properties: Mapping[str, Any],
) -> None:
    """Every episode of each result below ``rollouts/``, and ``rollout.rrd``: one episode side by side.

    Args:
        run: Where the files go.
        problem: Gives the layouts.
        results: Whose episodes are kept.
        side_by_side: Of which the same episode is shown, one that all of them finish if there is one.
        properties: Seeds and command, for the recording.
    """
    for result in results:
        save_rollouts(run.rollouts, kept(problem, result))
    finished = np.all([[one.is_success for one in _here(problem, result)] for result in side_by_side], axis=0)
    # argmax of all False is 0: then the first episode shows who fails.
    number = int(finished.argmax())
    shown = {f"{result.agent} on {result.world}": result for result in side_by_side}
    rollouts = {name: _here(problem, result)[number] for name, result in shown.items()}
    maps = {name: result.maps[rollouts[name].goal] for name, result in shown.items() if result.maps}
    title = f"gridnav {run.path.name}, episode {number}"
    write_recording(run.recording, problem.layout, rollouts, maps=maps, title=title, properties=properties, units=UNITS)


def kept(problem: Problem, result: Result) -> Rollouts:
    """A result's episodes with the layouts they were in."""
    layouts = {problem.layout.name: problem.layout}
    if problem.family:
        layouts = {layout.name: layout for layout in problem.family.held_out(HELD_OUT_LAYOUTS)}
    seen = {episode.layout for episode in result.episodes}
    here = {name: layout for name, layout in layouts.items() if name in seen}
    return Rollouts(result.name, result.world, result.agent, here, result.episodes, result.maps)


def write_drives(run: RunDirectory, problem: Problem, world: str, episodes: list[Episode], seed: int) -> Result:
    """What a person drove, as the evaluation, rollouts and recording of a run."""
    result = Result("drive", world, "a person", "", "", episodes)
    write_evaluation(run, [result], seed, evaluation_seed=seed)
    write_rollouts(run, problem, [result], [result], {"seed": seed})
    return result


def _here(problem: Problem, result: Result) -> list[Episode]:
    """The episodes in the problem's own layout: all of them, unless there is a family of layouts."""
    return [episode for episode in result.episodes if episode.layout == problem.layout.name]


def report_rows(results: Sequence[Result], seed: int) -> list[Rung]:
    """The table's rows."""
    return [
        Rung(
            name=result.name,
            world=result.world,
            agent=result.agent,
            carried=result.carried,
            summary=result.summary,
            training_steps=result.steps,
            training_seconds=result.seconds,
            seeds=f"{seed}; {EVALUATION_SEED}",
        )
        for result in results
    ]


def write_page(
    run: RunDirectory,
    *,
    title: str,
    question: str,
    conclusion: str,
    rows: Sequence[Rung],
    shown: Sequence[Picture],
    command: str,
    config: Mapping[str, Any],
    tables: Sequence[Table] = (),
) -> None:
    """``report.html``."""
    versions = {name: version(name) for name in LIBRARIES}
    page = Report(
        title,
        question,
        conclusion,
        rows,
        shown,
        config,
        command,
        versions,
        run_dir=str(run.path),
        recording=run.recording.name,
        tables=tables,
    )
    write_report(run.report, page)


def train_and_report(job: Job, training: Training, *, with_pictures: bool = True) -> list[Result]:
    """Train agents in a world, evaluate them and write everything a run holds.

    Args:
        job: The run.
        training: Who learns where.
        with_pictures: Draw figures, recording and report; without them the run has evaluation and rollouts alone.
    """
    problem, run, seed, kinds, world = job.problem, job.run, job.seed, training.kinds, training.world
    with open_log(run) as log:
        workshop = Workshop(job, log)
        trained = [workshop.train(kind, kind, world, choice=training.choice) for kind in kinds]
        results = [workshop.evaluate(one.name, one, world, one.name) for one in trained]
        write_evaluation(run, results, seed)
        if not with_pictures:
            for result in results:
                save_rollouts(run.rollouts, kept(problem, result))
            return results
        write_rollouts(run, problem, results, results, {"command": job.command, "training seed": seed})
        shown = pictures(run, problem, results, trained, {kind: f"{kind} on {world}" for kind in kinds}, log)
    names, many = " and ".join(kinds), len(kinds) > 1
    found = [
        f"{result.name} reaches the goal in {percent(result.summary.success_rate)} of {len(result.episodes)} episodes "
        f"(95 % interval {' to '.join(map(percent, result.summary.success_interval))})"
        for result in results
    ]
    write_page(
        run,
        title=f"{names} on {world}, {problem.layout.name}",
        question=f"How well {'do' if many else 'does'} {names} solve {world}?",
        conclusion="; ".join(found) + ".",
        rows=report_rows(results, seed),
        shown=shown,
        command=job.command,
        config=job.config,
    )
    return results


def open_log(run: RunDirectory) -> MetricsLog:
    """A run's metrics, cut back to where its checkpoints stand."""
    return MetricsLog(run, last_standing(run.checkpoints).log_bytes)


def evaluate_again(
    run: RunDirectory, episodes: int, seed: int | None, on_stage: OnStage, *, randomization: str | None = None
) -> list[Result]:
    """Evaluate every agent of a finished run anew.

    Args:
        run: A run with checkpoints and an evaluation.
        episodes: How many for each.
        seed: Of the episodes; that of every evaluation by default.
        on_stage: Told of every evaluation.
        randomization: What varies; what varied in training by default.

    Raises:
        InputError: When the run holds no evaluation or lacks a checkpoint.
    """
    varied = Randomization.load(randomization or "none").to_json()
    problem, rows = stored_evaluation(run)
    results = []
    for name, row in rows.items():
        agent = load_agent(run.checkpoints, row["checkpoint"])
        row["randomization"] = row["randomization"] if randomization is None else varied
        here = replace(problem, randomization=Randomization.load(row["randomization"]))
        records = evaluate_in(
            here, agent, row["world"], episodes,
            observation=row["observation"], seed=EVALUATION_SEED if seed is None else seed,
            on_progress=on_stage(f"evaluating {name}"),
        )  # fmt: skip
        spent = row.pop("training_steps"), row.pop("training_seconds")
        results.append(Result(name, episodes=records, steps=spent[0], seconds=spent[1], **row))
    return results


def stored_evaluation(run: RunDirectory) -> tuple[Problem, dict[str, dict[str, Any]]]:
    """What a finished run solved, and what is needed to evaluate each of its agents anew, by the name of its row.

    What varied stands in the rows: the problem's robots are nominal.

    Raises:
        InputError: When the run holds no evaluation.
    """
    config, stored = run.read_config(), read_json(run.evaluation)
    try:
        problem = Problem.load(config["layout"], config["task"], config["reward"])
        rows = {name: {key: row[key] for key in _NEEDED} for name, row in stored["results"].items()}
        for name, row in rows.items():
            row["randomization"] = dict(stored["results"][name].get("randomization", {}))
            Randomization.load(row["randomization"])
        return problem, rows
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{str(run.path)!r} is no whole run: its {error} is missing or damaged") from None
