"""Measures the figures that the README states; run it with nothing else running.

python scripts/measure.py q-learning                optimality and time of Q-learning, one goal and all goals, ten seeds
python scripts/measure.py zero-shot                 the Q-table driving DiffDrive, 200 episodes, five seeds
python scripts/measure.py ppo [SEED ...]            PPO on DiffDrive from scratch and warm-started
python scripts/measure.py ppo-settings [SEED ...]   PPO's environments, rollout, batch, epochs and network compared
"""

import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from gridnav.agents import Planner, QLearning, QLearningConfig
from gridnav.experiment.evaluation import evaluate, policy_for
from gridnav.experiment.ladder import steps_to
from gridnav.experiment.run_directory import MetricsLog, RunDirectory
from gridnav.experiment.training import BUDGETS, Workshop
from gridnav.experiment.worlds import Problem
from gridnav.problem.metrics import summarise

PROBLEM = Problem.load("classic", "default", "default")
BUDGET = BUDGETS["default"]

# What the default of PPOConfig was chosen among: environments, steps, batch, epochs, units of two hidden layers.
PPO_SETTINGS = [
    (256, 16, 512, 6, 64),
    (256, 16, 512, 8, 64),
    (128, 32, 512, 6, 64),
    (128, 32, 512, 8, 64),
    (128, 32, 1024, 8, 64),
    (64, 64, 512, 8, 128),
]


def q_learning() -> None:
    """Greedy moves against value iteration, from every reachable cell to one goal and to every goal."""
    only = np.zeros_like(PROBLEM.layout.goals)
    only[9, 9] = True
    _q_learning("one goal", replace(PROBLEM, layout=replace(PROBLEM.layout, goals=only)))
    _q_learning("all goals", PROBLEM)


def _q_learning(what: str, problem: Problem) -> None:
    layout, task = problem.layout, problem.task
    best = Planner.solve(layout, task, problem.reward).action_values
    # The oracle ties where two ways are equally short: any of the tied moves is optimal.
    optimal = (best > best.max(axis=1, keepdims=True) - 1e-9).reshape(layout.n_cells, -1, 4)
    goals = task.goal_cells(layout)
    asked = np.repeat(layout.reachable.ravel()[:, None], len(goals), axis=1)
    asked[goals[:, 0] * layout.n_cols + goals[:, 1], np.arange(len(goals))] = False
    seconds = []
    for seed in range(10):
        table, took = _learn(seed, problem)
        seconds.append(took)
        chosen = table.action_values.reshape(optimal.shape).argmax(axis=2)
        right = np.take_along_axis(optimal, chosen[:, :, None], axis=2)[:, :, 0][asked]
        worlds = problem.worlds("GridWorld", BUDGET.episodes)
        summary = summarise(evaluate(table.act, worlds))
        print(
            f"{what}, seed {seed}: {right.sum()} of {right.size} moves optimal, success {summary.success_rate:.1%}, "
            f"SPL {summary.spl:.3f}, {1000 * took:.0f} ms"
        )
    median, low, high = (1000 * f(seconds) for f in (np.median, min, max))
    print(f"{what}: median {median:.0f} ms, range {low:.0f} to {high:.0f} ms")


def zero_shot() -> None:
    """A learnt table drives the MuJoCo robot through grid moves."""
    for seed in range(5):
        table, _ = _learn(seed)
        worlds = PROBLEM.worlds("DiffDrive", BUDGET.episodes)
        began = time.perf_counter()
        summary = summarise(evaluate(policy_for(table, worlds), worlds))
        print(
            f"seed {seed}: success {summary.success_rate:.1%} (95 % interval {summary.success_interval[0]:.1%} to "
            f"{summary.success_interval[1]:.1%}), collision rate {summary.collision_rate:.1%}, SPL {summary.spl:.3f}, "
            f"{time.perf_counter() - began:.0f} s"
        )


def ppo(seeds: list[int]) -> None:
    """From scratch, and warm-started from the Unicycle; the same evaluation episodes for all."""
    for seed in seeds:
        with _workshop(seed) as (workshop, log):
            unicycle = workshop.train("ppo-unicycle", "ppo", "Unicycle")
            for name, start in (("ppo-scratch", None), ("ppo-warm", unicycle.agent)):
                trained = workshop.train(name, "ppo", "DiffDrive", start=start)
                result = workshop.evaluate(name, trained, "DiffDrive", name)
                summary, reached = result.summary, {share: steps_to(log, name, share) for share in (0.9, 0.95, 0.98)}
                print(
                    f"seed {seed} {name}: success {summary.success_rate:.1%} (95 % interval "
                    f"{summary.success_interval[0]:.1%} to {summary.success_interval[1]:.1%}), collision rate "
                    f"{summary.collision_rate:.1%}, SPL {summary.spl:.2f}, {trained.steps:,} steps, "
                    f"{trained.seconds:.0f} s, steps to a training success of {reached}",
                    flush=True,
                )
            print(f"seed {seed} ppo-unicycle: {unicycle.steps:,} steps, {unicycle.seconds:.0f} s", flush=True)


def ppo_settings(seeds: list[int]) -> None:
    """Each setting with each seed: speed, steps to a training success of 95 %, and what the greedy policy achieves."""
    from gridnav.agents import PPOAgent, PPOConfig

    judge = PROBLEM.worlds("DiffDrive", BUDGET.episodes)
    for num_envs, n_steps, batch_size, n_epochs, units in PPO_SETTINGS:
        for seed in seeds:
            config = PPOConfig(seed, num_envs, n_steps, batch_size, n_epochs, hidden=(units, units))
            worlds = PROBLEM.worlds("DiffDrive", num_envs)
            agent = PPOAgent(worlds.single_observation_space, worlds.single_action_space, config)
            curve: list[tuple[int, float]] = []
            began = time.perf_counter()
            agent.learn(
                worlds,
                steps=BUDGET.ppo_steps,
                on_progress=lambda p, curve=curve: curve.append((p.steps, p.metrics["success_rate"])),
            )
            speed = curve[-1][0] / (time.perf_counter() - began)
            reached = next((steps for steps, success in curve if success >= 0.95), None)
            summary = summarise(evaluate(agent.act, judge))
            print(
                f"{num_envs} x {n_steps}, batch {batch_size}, {n_epochs} epochs, {units} x {units}, seed {seed}: "
                f"{speed:,.0f} steps/s, 95 % after {reached} steps, greedy success {summary.success_rate:.1%}, "
                f"collision rate {summary.collision_rate:.1%}",
                flush=True,
            )


def _learn(seed: int, problem: Problem = PROBLEM) -> tuple[QLearning, float]:
    config = QLearningConfig(seed=seed, gamma=problem.reward.gamma)
    began = time.perf_counter()
    worlds = problem.worlds("GridWorld", config.num_envs, task=replace(problem.task, starts="any"))
    table = QLearning(worlds.single_observation_space, worlds.single_action_space, config)
    table.learn(worlds, steps=BUDGET.q_learning_visits * table.action_values.size)
    return table, time.perf_counter() - began


@contextmanager
def _workshop(seed: int) -> Iterator[tuple[Workshop, MetricsLog]]:
    with tempfile.TemporaryDirectory() as folder:
        run = RunDirectory.create(Path(folder) / "run", "measure", {})
        with MetricsLog(run) as log:
            yield Workshop(PROBLEM, BUDGET, seed, run, log, lambda name: lambda progress: None), log


if __name__ == "__main__":
    what, *numbers = sys.argv[1:] or ["help"]
    if what == "q-learning":
        q_learning()
    elif what == "zero-shot":
        zero_shot()
    elif what == "ppo":
        ppo([int(number) for number in numbers] or [0, 1, 2])
    elif what == "ppo-settings":
        ppo_settings([int(number) for number in numbers] or [0, 1, 2])
    else:
        sys.exit(__doc__)
