"""What a run found, written down: evaluation, figures, recording and report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import version
from typing import Any

import numpy as np

from gridnav.agents import TabularAgent
from gridnav.display.figures import learning_curves, save_figure, trajectories, value_map
from gridnav.display.recording import write_recording
from gridnav.display.report import Picture, Report, Rung, write_report
from gridnav.experiment.checkpoint import LIBRARIES, load_agent
from gridnav.experiment.evaluation import EVALUATION_SEED, evaluate, policy_for
from gridnav.experiment.run_directory import MetricsLog, RunDirectory, read_json, write_json
from gridnav.experiment.training import AgentKind, Budget, OnStage, Problem, Result, Workshop
from gridnav.problem.geodesic import cell_distances
from gridnav.problem.types import InputError

DRAWN_EPISODES = 40
"""Ways drawn per panel: more would hide each other and swell the page."""
_NEEDED = ("world", "agent", "carried", "checkpoint")


def write_evaluation(run: RunDirectory, results: Sequence[Result], seed: int) -> None:
    """``evaluation.json``: every metric of every rung, and one row per episode."""
    write_json(run.evaluation, {"seed": seed, "evaluation_seed": EVALUATION_SEED, "results": evaluation(results)})


def evaluation(results: Sequence[Result]) -> dict[str, Any]:
    """Metrics and episode rows of each result by its name, fit for JSON."""
    return {
        result.name: {
            "world": result.world,
            "agent": result.agent,
            "carried": result.carried,
            "checkpoint": result.checkpoint,
            **asdict(result.summary),
            "training_steps": result.steps,
            "training_seconds": result.seconds,
            "rows": [episode.row() for episode in result.episodes],
        }
        for result in results
    }


def write_rollout(
    run: RunDirectory, problem: Problem, results: Sequence[Result], properties: Mapping[str, Any]
) -> None:
    """``rollout.rrd``: the same episode of each result side by side, one that all of them finish if there is one."""
    finished = np.all([[episode.is_success for episode in result.episodes] for result in results], axis=0)
    # argmax of all False is 0: then the first episode shows who fails.
    number = int(finished.argmax())
    rollouts = {f"{result.agent} on {result.world}": result.episodes[number] for result in results}
    write_recording(run.recording, problem.layout, rollouts, title=f"gridnav {run.path.name}", properties=properties)


def pictures(
    run: RunDirectory,
    problem: Problem,
    results: Sequence[Result],
    curves: Mapping[str, str],
    table: TabularAgent | None,
    log: MetricsLog,
) -> list[Picture]:
    """The figures of a run, each also as a PNG file.

    Args:
        run: Where the files go.
        problem: Gives the maze.
        results: One panel of trajectories each.
        curves: Series of the metrics to draw the success rate of, with their labels.
        table: Its values and moves are drawn for one goal.
        log: The metrics.
    """
    drawn = {f"{result.agent} on {result.world}": result.episodes[:DRAWN_EPISODES] for result in results}
    shown = {
        "trajectories": Picture(
            trajectories(problem.layout, drawn),
            f"The ways of the first {min(DRAWN_EPISODES, len(results[0].episodes))} evaluation episodes, the same "
            "starts and goals in every panel.",
        )
    }
    series = {label: log.curve(name, "success_rate") for name, label in curves.items()}
    series = {label: curve for label, curve in series.items() if len(curve[0]) > 1}
    if series:
        shown["learning"] = Picture(
            learning_curves({label: (np.array(x), np.array(y)) for label, (x, y) in series.items()}),
            "Success rate over the last 400 training episodes, exploration included, against environment steps.",
        )
    if table is not None:
        goals = problem.task.goal_cells(problem.layout)
        goal = (int(goals[-1, 0]), int(goals[-1, 1]))
        moves = table.action_values.reshape(problem.layout.n_cells, len(goals), 4)[:, -1]
        # The shaping moves values by the distance; without it they grow towards the goal, as a reader expects.
        distance = cell_distances(problem.layout, goal).ravel()
        moves = moves + problem.reward.potential(np.where(np.isfinite(distance), distance, 0.0))[:, None]
        shown["values"] = Picture(
            value_map(problem.layout, moves, goal),
            f"Values and preferred moves of the learnt table for the goal at cell {goal}, the shaping taken out.",
        )
    for name, picture in shown.items():
        save_figure(picture.figure, run.figures / f"{name}.png")
    return list(shown.values())


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
    )
    write_report(run.report, page)


def train_and_report(
    problem: Problem,
    budget: Budget,
    seed: int,
    kind: AgentKind,
    world: str,
    run: RunDirectory,
    command: str,
    config: Mapping[str, Any],
    on_stage: OnStage,
) -> Result:
    """Train one agent, evaluate it and write everything a run holds.

    Args:
        problem: What is to be solved.
        budget: How much may be spent.
        seed: Of everything that is random in training.
        kind: Who learns.
        world: Where.
        run: Where the files go.
        command: What makes the run again, for the report.
        config: The run's configuration, for the report.
        on_stage: Told of the training and the evaluation.
    """
    with MetricsLog(run) as log:
        workshop = Workshop(problem, budget, seed, run, log, on_stage)
        trained = workshop.train(kind, kind, world)
        result = workshop.evaluate(kind, trained, world, kind)
        write_evaluation(run, [result], seed)
        write_rollout(run, problem, [result], {"command": command, "training seed": seed})
        table = trained.agent if isinstance(trained.agent, TabularAgent) else None
        shown = pictures(run, problem, [result], {kind: f"{kind} on {world}"}, table, log)
    low, high = result.summary.success_interval
    write_page(
        run,
        title=f"{kind} on {world}, {problem.layout.name}",
        question=f"How well does {kind} solve {world}?",
        conclusion=f"It reaches the goal in {result.summary.success_rate:.1%} of {len(result.episodes)} episodes "
        f"(95 % interval {low:.1%} to {high:.1%}).",
        rows=report_rows([result], seed),
        shown=shown,
        command=command,
        config=config,
    )
    return result


def evaluate_again(run: RunDirectory, episodes: int, seed: int | None, on_stage: OnStage) -> list[Result]:
    """Evaluate every agent of a finished run anew.

    Args:
        run: A run with checkpoints and an evaluation.
        episodes: How many for each.
        seed: Of the episodes; that of every evaluation by default.
        on_stage: Told of every evaluation.

    Raises:
        InputError: When the run holds no evaluation or lacks a checkpoint.
    """
    config, stored = run.read_config(), read_json(run.evaluation)
    try:
        problem = Problem.load(config["layout"], config["task"], config["reward"])
        rows = {name: {key: row[key] for key in _NEEDED} for name, row in stored["results"].items()}
    except (KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{str(run.path)!r} is no whole run: its {error} is missing or damaged") from None
    results = []
    for name, row in rows.items():
        agent = load_agent(run.checkpoints, row["checkpoint"])
        worlds = problem.worlds(row["world"], episodes)
        report = on_stage(f"evaluating {name}")
        records = evaluate(
            policy_for(agent, worlds), worlds, seed=EVALUATION_SEED if seed is None else seed, on_progress=report
        )
        worlds.close()
        results.append(Result(name, row["world"], row["agent"], row["carried"], row["checkpoint"], records))
    return results
