"""Measures the tables of docs/dqn.md; run it with nothing else running.

python scripts/measure_dqn.py default [SEED ...]    cell_goal on `classic`: plain, double, dueling and both
python scripts/measure_dqn.py features [SEED ...]   the feature vector on `classic`
python scripts/measure_dqn.py tutorial [SEED ...]   the tutorial's setting, its presets against ours, Q-learning too

Ten seeds unless some are given. Success is that of greedy moves in 200 evaluation episodes.
"""

import sys
import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gridnav.agents import Progress
from gridnav.experiment.evaluation import evaluate
from gridnav.experiment.training import BUDGETS, Choice, make_learner
from gridnav.experiment.worlds import Problem
from gridnav.problem.metrics import summarise

BUDGET = BUDGETS["default"]


class Row(NamedTuple):
    """What is trained with every seed."""

    kind: str
    preset: str
    observation: str
    reward: str


MODES = {
    "default": [Row("dqn", preset, "cell_goal", "default") for preset in ("plain", "double", "dueling", "default")],
    "features": [Row("dqn", "features", "features", "default")],
    "tutorial": [
        Row(kind, preset, "cell", "seed") for kind in ("q-learning", "dqn") for preset in ("tutorial", "cell")
    ],
}


class Outcome(NamedTuple):
    """What one training came to."""

    success: float
    spl: float
    steps: int
    episodes: int
    seconds: float


def train(row: Row, seed: int) -> Outcome:
    """One training and its evaluation; the seconds are those of training alone."""
    problem, reports = Problem.load("classic", "default", row.reward), list[Progress]()
    choice = Choice(row.preset, observation=row.observation)
    began = time.perf_counter()
    agent, worlds, steps = make_learner(problem, row.kind, "GridWorld", seed, BUDGET, choice)
    agent.learn(worlds, steps=steps, on_progress=reports.append)
    seconds = time.perf_counter() - began
    judge = problem.worlds("GridWorld", BUDGET.episodes, observation=row.observation)
    summary = summarise(evaluate(agent.act, judge))
    return Outcome(summary.success_rate, summary.spl, reports[-1].steps, int(reports[-1].metrics["episodes"]), seconds)


def measure(rows: Sequence[Row], seeds: Sequence[int]) -> None:
    """One line per seed, a summary per row, and the table."""
    table = ["| agent | preset | success, median (range) | SPL, median | steps | episodes | seconds, median (range) |"]
    table.append("| --- | --- | --- | --- | --- | --- | --- |")
    # The first training compiles the world's loops and warms up torch: that is nobody's time.
    train(rows[-1], seeds[0])
    for row in rows:
        outcomes = []
        for seed in seeds:
            one = train(row, seed)
            outcomes.append(one)
            print(
                f"{row.kind} {row.preset}, seed {seed}: success {one.success:.1%}, SPL {one.spl:.3f}, {one.steps:,} "
                f"steps, {one.episodes:,} episodes, {one.seconds:.1f} s",
                flush=True,
            )
        success, spl, steps, episodes, seconds = np.array(outcomes).T
        line = (
            f"| {row.kind} | {row.preset} | {np.median(success):.1%} ({success.min():.1%} to {success.max():.1%}) | "
            f"{np.median(spl):.3f} | {np.median(steps):,.0f} | {np.median(episodes):,.0f} | "
            f"{np.median(seconds):.1f} ({seconds.min():.1f} to {seconds.max():.1f}) |"
        )
        print(f"{row.kind} {row.preset}: mean success {success.mean():.1%}\n{line}", flush=True)
        table.append(line)
    print(f"\nSeeds {', '.join(map(str, seeds))}.\n", *table, sep="\n")


if __name__ == "__main__":
    mode, *numbers = sys.argv[1:] or ["help"]
    if mode not in MODES:
        sys.exit(__doc__)
    measure(MODES[mode], [int(number) for number in numbers] or list(range(10)))
