"""Measures the figures that the README states; run it with nothing else running.

python scripts/measure.py q-learning                optimality and time of Q-learning, one goal and all goals, ten seeds
python scripts/measure.py zero-shot                 the Q-table driving DiffDrive, 200 episodes, five seeds
python scripts/measure.py ppo [SEED ...]            PPO on DiffDrive, `classic`, from scratch, ten seeds
python scripts/measure.py ppo-any [SEED ...]        the same from any start to any goal
python scripts/measure.py ppo-layouts [SEED ...]    PPO on random layouts: trained on the Unicycle, evaluated in 100
                                                    layouts that no training saw, on the Unicycle and on DiffDrive
python scripts/measure.py ppo-warm [SEED ...]       PPO on DiffDrive, warm-started from the Unicycle
python scripts/measure.py ppo-settings [SEED ...]   PPO's environments, rollout, batch, epochs and network compared
python scripts/measure.py sac [SEED ...]            SAC of stable-baselines3 on DiffDrive, success against time
python scripts/measure.py randomization             what randomising 256 DiffDrives costs, by preset and by quantity
python scripts/measure.py randomized-training       what it costs a training of PPO, of the same settings
python scripts/measure.py drivable [RANDOMIZATION ...]
                                                    robots that fall over or stay where they are when told to drive
                                                    squares: of these, or of all presets and the open realities
"""

import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from gridnav.agents import Planner, QLearning
from gridnav.envs import RANDOMIZATION_PRESETS, Randomization
from gridnav.experiment.drivability import try_driving
from gridnav.experiment.evaluation import evaluate, policy_for
from gridnav.experiment.ladder import steps_to
from gridnav.experiment.reality import find_reality
from gridnav.experiment.run_directory import MetricsLog, RunDirectory
from gridnav.experiment.training import BUDGETS, Choice, Job, Workshop, carry_weights, make_learner, unseen
from gridnav.experiment.worlds import Problem
from gridnav.problem.metrics import Summary, summarise

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


def ppo(problem: Problem, world: str, evaluated_in: Sequence[str], seeds: Sequence[int]) -> None:
    """A preset's result: one line per seed, and a row with the medians and ranges."""
    results: dict[str, list[tuple[Summary, float]]] = {name: [] for name in evaluated_in}
    for seed in seeds:
        with _workshop(seed, problem) as (workshop, log):
            trained = workshop.train("ppo", "ppo", world)
            reached = {share: steps_to(log, "ppo", share) for share in (0.9, 0.95, 0.98)}
            for name in evaluated_in:
                summary = workshop.evaluate("ppo", trained, name, "ppo").summary
                results[name].append((summary, trained.seconds))
                low, high = summary.success_interval
                print(
                    f"seed {seed} on {name}: success {summary.success_rate:.1%} ({low:.1%} to {high:.1%}), collision "
                    f"rate {summary.collision_rate:.1%}, SPL {summary.spl:.2f}, worst tenth of {summary.layouts} "
                    f"layouts {summary.success_cvar:.1%}, {summary.behaviours}, {trained.steps:,} steps, "
                    f"{trained.seconds:.0f} s, steps to a training success of {reached}",
                    flush=True,
                )
    print("| evaluated on | seeds | success >= 99 % | success, each seed | no collision, each seed | SPL | training |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name, pairs in results.items():
        successes = [summary.success_rate for summary, _ in pairs]
        free = [1.0 - summary.collision_rate for summary, _ in pairs]
        spl, seconds = [summary.spl for summary, _ in pairs], [took for _, took in pairs]
        print(
            f"| {name} | {seeds[0]} to {seeds[-1]} | {sum(x >= 0.99 for x in successes)} of {len(seeds)} | "
            f"{', '.join(f'{100 * x:.1f}' for x in successes)} % | {', '.join(f'{100 * x:.1f}' for x in free)} % | "
            f"{np.median(spl):.2f} | {np.median(seconds):.0f} s ({min(seconds):.0f} to {max(seconds):.0f}) |"
        )


def ppo_warm(seeds: Sequence[int]) -> None:
    """Started on the network that learnt on the Unicycle."""
    for seed in seeds:
        with _workshop(seed) as (workshop, log):
            unicycle = workshop.train("ppo-unicycle", "ppo", "Unicycle")
            trained = workshop.train(
                "ppo-warm", "ppo", "DiffDrive", carry=carry_weights(unicycle.agent), choice=Choice("warm")
            )
            summary = workshop.evaluate("ppo-warm", trained, "DiffDrive", "ppo-warm").summary
            print(
                f"seed {seed}: success {summary.success_rate:.1%}, collision rate {summary.collision_rate:.1%}, "
                f"SPL {summary.spl:.2f}, {summary.behaviours}, {trained.steps:,} steps, {trained.seconds:.0f} s, "
                f"95 % in training after {steps_to(log, 'ppo-warm', 0.95)}; Unicycle {unicycle.seconds:.0f} s",
                flush=True,
            )


def sac(seeds: Sequence[int]) -> None:
    """Stable-baselines3's SAC in the same environments, through the same adapter, for three times PPO's time."""
    import torch
    from gridnav.agents.ppo import Sb3VecEnv
    from stable_baselines3 import SAC
    from stable_baselines3.common.callbacks import BaseCallback

    from gridnav.agents import PPO_PRESETS

    class Clock(BaseCallback):
        """Evaluates every 20 s of training, and stops after 180 s; evaluations do not count."""

        def _on_training_start(self) -> None:
            self.spent, self.asked, self.since = 0.0, 0.0, time.perf_counter()

        def _on_step(self) -> bool:
            now = time.perf_counter()
            if self.spent + now - self.since < self.asked + 20.0:
                return True
            self.spent += now - self.since
            self.asked += 20.0
            summary = summarise(evaluate(lambda o: self.model.predict(o, deterministic=True)[0], judge))
            print(
                f"seed {seed}: {self.spent:.0f} s, {self.num_timesteps:,} steps: success {summary.success_rate:.1%}, "
                f"collision rate {summary.collision_rate:.1%}",
                flush=True,
            )
            self.since = time.perf_counter()
            return self.spent < 180.0

    judge = PROBLEM.worlds("DiffDrive", BUDGET.episodes)
    for seed in seeds:
        torch.set_num_threads(1)
        worlds = PROBLEM.worlds("DiffDrive", 64)
        model = SAC(
            "MlpPolicy", Sb3VecEnv(worlds), seed=seed, device="cpu", gamma=PPO_PRESETS["default"].gamma,
            learning_rate=1e-3, batch_size=512, buffer_size=500_000, learning_starts=5_000, train_freq=1,
            gradient_steps=2, policy_kwargs={"net_arch": [64, 64]},
        )  # fmt: skip
        model.learn(10_000_000, callback=Clock())


def randomization(num_envs: int = 256, rounds: int = 9, steps: int = 20) -> None:
    """Steps per second of processor time against those without randomisation; the cases take turns."""
    burger = Randomization.load("burger")
    caster = burger.only("caster_friction")
    cases = {name: Randomization.load(name) for name in RANDOMIZATION_PRESETS if name != "curriculum"}
    cases |= {"burger without caster_friction": burger.without("caster_friction"), "caster_friction alone": caster}
    worlds = {name: PROBLEM.worlds("DiffDrive", num_envs, randomization=one) for name, one in cases.items()}
    rng, taken = np.random.default_rng(0), {name: [] for name in cases}
    for one in worlds.values():
        one.reset(seed=0)
    for _ in range(rounds + 1):
        actions = np.clip(rng.uniform(-0.6, 1.4, (steps, num_envs, 2)), -1.0, 1.0)
        for name, one in worlds.items():
            began = time.process_time()
            for action in actions:
                one.step(action)
            taken[name].append(time.process_time() - began)
    # The first round compiles and warms up.
    base = np.array(taken["none"][1:])
    for name, seconds in taken.items():
        ratios = base / np.array(seconds[1:])
        print(f"{name}: {np.median(ratios):.2f} ({ratios.min():.2f} to {ratios.max():.2f})", flush=True)


def randomized_training(rounds: int = 3, steps: int = 40_960) -> None:
    """Steps per second of PPO's default training, physics and network together; the cases take turns."""
    from gridnav.agents import PPOAgent, PPOConfig

    taken: dict[str, list[float]] = {"none": [], "burger": [], "wide": []}
    for _ in range(rounds + 1):
        for name, seconds in taken.items():
            config = PPOConfig(steps=steps)
            randomization = Randomization.load(name)
            worlds = PROBLEM.worlds("DiffDrive", config.num_envs, randomization=randomization)
            agent = PPOAgent(worlds.single_observation_space, worlds.single_action_space, config)
            began = time.perf_counter()
            agent.learn(worlds, steps=steps)
            seconds.append(time.perf_counter() - began)
            worlds.close()
    # The first round compiles and warms up.
    base = np.array(taken["none"][1:])
    for name, seconds in taken.items():
        ratios = base / np.array(seconds[1:])
        speeds = steps / np.array(seconds[1:])
        print(
            f"{name}: {np.median(ratios):.2f} ({ratios.min():.2f} to {ratios.max():.2f}), "
            f"{np.median(speeds):,.0f} steps/s",
            flush=True,
        )


def drivable(sources: Sequence[str], n: int = 1000) -> None:
    """Robots that fall over, or hardly move or turn, when they are told to drive squares on an open floor."""
    presets = [name for name in RANDOMIZATION_PRESETS if name != "curriculum"]  # which ends where `wide` does
    cases = {name: (Randomization.load(name), {}) for name in sources or presets}
    if not sources:
        realities = [find_reality(name) for name in ("parametric", "structural")]
        cases |= {one.name: (one.randomization, one.options) for one in realities}
    for name, (randomization, options) in cases.items():
        found = try_driving(randomization, n, **options)
        print(f"{name}: {found.falls.mean():.1%} fall, {found.stays.mean():.1%} hardly move or turn", flush=True)


def ppo_settings(seeds: Sequence[int]) -> None:
    """Each setting with each seed: speed, steps to a training success of 95 %, and what the greedy policy achieves."""
    from gridnav.agents import PPOAgent, PPOConfig

    judge = PROBLEM.worlds("DiffDrive", BUDGET.episodes)
    for num_envs, n_steps, batch_size, n_epochs, units in PPO_SETTINGS:
        for seed in seeds:
            config = PPOConfig(
                seed=seed, num_envs=num_envs, n_steps=n_steps, batch_size=batch_size, n_epochs=n_epochs,
                hidden=(units, units),
            )  # fmt: skip
            worlds = PROBLEM.worlds("DiffDrive", num_envs)
            agent = PPOAgent(worlds.single_observation_space, worlds.single_action_space, config)
            curve: list[tuple[int, float]] = []
            began = time.perf_counter()
            agent.learn(
                worlds,
                steps=config.steps,
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
    began = time.perf_counter()
    table, worlds, steps = make_learner(problem, "q-learning", "GridWorld", seed, BUDGET, Choice())
    assert isinstance(table, QLearning)
    table.learn(worlds, steps=steps)
    return table, time.perf_counter() - began


@contextmanager
def _workshop(seed: int, problem: Problem = PROBLEM) -> Iterator[tuple[Workshop, MetricsLog]]:
    with (
        tempfile.TemporaryDirectory() as folder,
        RunDirectory.create(Path(folder) / "run", "measure", {}) as run,
        MetricsLog(run) as log,
    ):
        yield Workshop(Job(problem, BUDGET, seed, run, unseen), log), log


if __name__ == "__main__":
    what, *words = sys.argv[1:] or ["help"]
    seeds = [] if what == "drivable" else [int(word) for word in words]
    if what == "q-learning":
        q_learning()
    elif what == "zero-shot":
        zero_shot()
    elif what == "ppo":
        ppo(PROBLEM, "DiffDrive", ["DiffDrive"], seeds or range(10))
    elif what == "ppo-any":
        ppo(Problem.load("classic", "any", "default"), "DiffDrive", ["DiffDrive"], seeds or range(10))
    elif what == "ppo-layouts":
        ppo(Problem.load("random", "default", "default"), "Unicycle", ["Unicycle", "DiffDrive"], seeds or range(3))
    elif what == "ppo-warm":
        ppo_warm(seeds or range(3))
    elif what == "ppo-settings":
        ppo_settings(seeds or range(3))
    elif what == "randomization":
        randomization()
    elif what == "randomized-training":
        randomized_training()
    elif what == "drivable":
        drivable(words)
    elif what == "sac":
        sac(seeds or range(2))
    else:
        sys.exit(__doc__)
