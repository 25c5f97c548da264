"""The ladder: from a plan to a Q-table to robots, and what each rung carries to the next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from gridnav.display.words import percent, thousands
from gridnav.experiment.arms import TABLE, Arm, Sources
from gridnav.experiment.greedy_curve import CURVE_EPISODES, SUCCESS, GreedyCurve
from gridnav.experiment.pictures import pictures
from gridnav.experiment.results import (
    open_log,
    report_rows,
    write_evaluation,
    write_page,
    write_rollouts,
)
from gridnav.experiment.run_directory import MetricsLog
from gridnav.experiment.training import Choice, Job, Result, Trained, Workshop, carry_weights
from gridnav.experiment.transfer import QUESTION as TRANSFER_QUESTION
from gridnav.experiment.transfer import SCRATCH, transfer_report, write_transfer
from gridnav.experiment.worlds import NOTHING_VARIES

QUESTION = (
    "How far does a table learnt on the grid carry a wheeled robot, and what does a network save that "
    "starts from another one?"
)
TARGET = "DiffDrive"
"""World that arms carry something to."""
SOLVED = 0.95
"""The share of training episodes from which on a learner counts as there."""


def climb(job: Job) -> list[Result]:
    """All rungs, in order, written to a run directory.

    Where robots vary, there is one more rung for that; the others are without.
    """
    problem, run = job.problem, job.run
    with open_log(run) as log:
        nominal = replace(problem, randomization=NOTHING_VARIES)
        workshop = Workshop(replace(job, problem=nominal), log)
        plan = workshop.train("plan", "plan", "GridWorld")
        results = [workshop.evaluate("plan", plan, "GridWorld", "value iteration")]

        table = workshop.train("q-learning", "q-learning", "GridWorld")
        results.append(workshop.evaluate("q-learning", table, "GridWorld", "Q-table"))
        moves = "the whole table, driven by grid moves"
        results.append(workshop.evaluate("q-table-unicycle", table, "Unicycle", "Q-table", carried=moves))
        results.append(workshop.evaluate("q-table-diffdrive", table, "DiffDrive", "Q-table", carried=moves))

        unicycle = workshop.train("ppo-unicycle", "ppo", "Unicycle")
        results.append(workshop.evaluate("ppo-unicycle", unicycle, "Unicycle", "PPO from scratch"))
        network = "the Unicycle's network"
        results.append(workshop.evaluate("ppo-transferred", unicycle, "DiffDrive", "PPO as it is", carried=network))

        scratch = workshop.train("ppo-scratch", "ppo", "DiffDrive")
        results.append(workshop.evaluate("ppo-scratch", scratch, "DiffDrive", "PPO from scratch"))
        warm = workshop.train(
            "ppo-warm", "ppo", "DiffDrive", carry=carry_weights(unicycle.agent), choice=Choice("warm")
        )
        results.append(workshop.evaluate("ppo-warm", warm, "DiffDrive", "PPO warm-started", carried=network))
        if problem != nominal:
            workshop.problem = problem
            varied = workshop.train("ppo-randomized", "ppo", "DiffDrive", carry=carry_weights(scratch.agent))
            carried = "the network from scratch"
            results.append(
                workshop.evaluate("ppo-randomized", varied, "DiffDrive", "PPO under randomisation", carried=carried)
            )

        _write(job, results, [table, warm], log)
    return results


def compare(job: Job, arms: Mapping[str, Arm]) -> list[Result]:
    """Arms of transfer to the MuJoCo robot side by side, with what they build on, written to a run directory.

    Args:
        job: The run.
        arms: By name.
    """
    problem, run = job.problem, job.run
    with open_log(run) as log:
        workshop = Workshop(job, log)
        sources, costs = Sources(workshop), {}
        trained: dict[str, Trained] = {}
        for name, arm in arms.items():
            trained[name] = _train(name, arm, workshop, sources, log)
            costs[name] = _cost(trained[name], arm, sources)
        results = [workshop.evaluate(one.name, one, one.world, "source of arms") for one in sources.made.values()]
        results += [
            workshop.evaluate(name, trained[name], TARGET, arm.agent, carried=arm.carried) for name, arm in arms.items()
        ]
        write_evaluation(run, results, job.seed, arms=costs)
        side_by_side = [one for one in results if one.name in (TABLE, "waypoint")] + results[-1:]
        write_rollouts(run, problem, results, side_by_side[:2] + results[-1:], _properties(job))
        shown = pictures(run, problem, results, list(trained.values())[-1:], {}, log)
    report = transfer_report([run]) if SCRATCH in arms else None
    if report is not None:
        write_transfer(run.figures, report)
    write_page(
        run,
        title=f"Arms of transfer on {problem.layout.name}",
        question=TRANSFER_QUESTION,
        conclusion=report.sentence if report else "Without the arm scratch there is nothing to compare with.",
        rows=report_rows(results, job.seed),
        shown=[report.picture, *shown] if report else shown,
        command=job.command,
        config=job.config,
        tables=[report.table] if report else [],
    )
    return results


def _train(name: str, arm: Arm, workshop: Workshop, sources: Sources, log: MetricsLog) -> Trained:
    """Who acts in the end; its curve is in the log."""
    made = sources.get(arm.sources)
    if arm.prepare is not None:
        carry = arm.prepare(workshop.problem, made)
        return workshop.train(name, "ppo", TARGET, carry=carry, with_curve=True)
    if not log.curve(name, SUCCESS)[0]:  # or an earlier process was here
        curve = GreedyCurve(workshop.problem.for_evaluation.worlds(TARGET, CURVE_EPISODES), 1)
        log.add(name, 0, curve.measure(made[-1].agent))
        curve.close()
    return made[-1]


def _cost(trained: Trained, arm: Arm, sources: Sources) -> dict[str, Any]:
    """What an arm cost, on the target and in its sources, for ``evaluation.json``."""
    made = sources.get(arm.sources)
    learns = arm.prepare is not None
    return {
        "world": TARGET,
        "steps": trained.steps if learns else 0,
        "seconds": trained.seconds if learns else 0.0,
        "source_steps": sum(one.steps for one in made),
        "source_seconds": sum(one.seconds for one in made),
    }


def _write(job: Job, results: Sequence[Result], trained: Sequence[Trained], log: MetricsLog) -> None:
    problem, run = job.problem, job.run
    write_evaluation(run, results, job.seed)
    by_name = {result.name: result for result in results}
    best = "ppo-warm" if _success(by_name["ppo-warm"]) >= _success(by_name["ppo-scratch"]) else "ppo-scratch"
    side_by_side = [by_name["q-learning"], by_name["q-table-diffdrive"], by_name[best]]
    write_rollouts(run, problem, results, side_by_side, _properties(job))
    curves = {
        "ppo-unicycle": "Unicycle, from scratch",
        "ppo-scratch": "DiffDrive, from scratch",
        "ppo-warm": "DiffDrive, warm-started",
    }
    shown = pictures(run, problem, results, trained, curves, log)
    write_page(
        run,
        title=f"The ladder on {problem.layout.name}",
        question=QUESTION,
        conclusion=conclusion(by_name, log),
        rows=report_rows(results, job.seed),
        shown=shown,
        command=job.command,
        config=job.config,
    )


def _properties(job: Job) -> dict[str, Any]:
    """What a recording says of its run."""
    return {"command": job.command, "training seed": job.seed, "run": job.run.path.name}


def conclusion(results: dict[str, Result], log: MetricsLog) -> str:
    """What the numbers say, in two sentences."""
    table, scratch, warm = (results[name] for name in ("q-table-diffdrive", "ppo-scratch", "ppo-warm"))
    steps = {name: steps_to(log, name, SOLVED) for name in ("ppo-scratch", "ppo-warm")}
    driven, alone, carried = (percent(_success(one)) for one in (table, scratch, warm))
    first = (
        f"The Q-table drives the MuJoCo robot to its goal in {driven} of {len(table.episodes)} episodes without having "
        f"seen it; PPO reaches {alone} from scratch and {carried} started on the Unicycle's network."
    )
    reached = {
        name: f"after {thousands(count)} steps" if count else "nowhere within the budget"
        for name, count in steps.items()
    }
    second = (
        f" In training, {percent(SOLVED, 0)} success on the robot came {reached['ppo-scratch']} from scratch and "
        f"{reached['ppo-warm']} warm-started."
    )
    return first + second


def steps_to(log: MetricsLog, series: str, success: float) -> int | None:
    """Environment steps until the training success rate first reached a share, or none."""
    for steps, rate in zip(*log.curve(series, "success_rate"), strict=True):
        if rate >= success:
            return int(steps)
    return None


def _success(result: Result) -> float:
    return result.summary.success_rate
