"""The reward lint on a robot: scripted behaviours that avoid the goal, against driving to it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gridnav.agents import Planner, Policy
from gridnav.envs import NavigationVectorEnv
from gridnav.experiment.evaluation import EVALUATION_SEED, drive_by_moves
from gridnav.experiment.worlds import make_worlds
from gridnav.problem.layout import Layout
from gridnav.problem.lint import Finding
from gridnav.problem.reward import Reward
from gridnav.problem.task import Task
from gridnav.problem.types import BoolArray, FloatArray, InputError

EPISODES = 32
HORIZON_STEPS = 3000
"""Ten minutes of driving, 236 cell-times: with the default discount what comes later counts half as much at most."""

Script = Callable[[FloatArray, int], tuple[FloatArray | float, FloatArray | float]]
"""Lidar ranges ``(n, n_beams)`` in metres and the number of the step to forward and turning commands."""


def _hug_the_wall(ranges_m: FloatArray, step: int) -> tuple[FloatArray, FloatArray]:
    """Drive with the wall on the right, half a cell away."""
    ahead = ranges_m[:, [0, 1, -1]].min(axis=1)
    right = ranges_m[:, 3 * ranges_m.shape[1] // 4]
    blocked = ahead < 0.35
    return np.where(blocked, 0.0, 0.7), np.where(blocked, 0.5, np.clip(2.0 * (0.25 - right), -0.3, 0.3))


SCRIPTS: dict[str, Script] = {
    "standing still": lambda ranges, step: (0.0, 0.0),
    "spinning in place": lambda ranges, step: (0.0, 1.0),
    "circling tightly": lambda ranges, step: (0.4, 0.6),
    "circling widely": lambda ranges, step: (0.8, 0.2),
    "driving to and fro": lambda ranges, step: (1.0 if step // 5 % 2 == 0 else -1.0, 0.0),
    "hugging the wall": _hug_the_wall,
}


def lint_robot(reward: Reward, layout: Layout, task: Task, *, world: str = "Unicycle") -> list[Finding]:
    """Discounted returns of scripted behaviours and of driving to the goal, from the same starts.

    Args:
        reward: The reward to judge.
        layout: The maze.
        task: Gives starts, goals and what a collision does.
        world: ``Unicycle`` or ``DiffDrive``.

    Returns:
        One finding per behaviour that anywhere keeps off the goal, for the start where it comes closest to, or gets
        past, reaching it.
    """
    options: dict[str, Any] = {"layout": layout, "task": task, "reward": reward, "max_episode_steps": HORIZON_STEPS}
    worlds = make_worlds(world, EPISODES, **options)
    if reward.gamma == 1.0:
        raise InputError("gamma 1.0 is outside (0, 1): the lint compares discounted returns over all time")
    reaching, arrived = _returns(worlds, drive_by_moves(Planner.solve(layout, task, Reward()), worlds))
    if not arrived.all():
        seconds = HORIZON_STEPS * 0.2
        raise InputError(
            f"layout {layout.name} has goals further than {seconds:.0f} s of driving: too far for the lint"
        )
    findings = []
    for name, script in SCRIPTS.items():
        avoiding, arrived = _returns(worlds, _scripted(script, worlds))
        if arrived.all():
            continue
        i = int(np.where(arrived, np.inf, reaching - avoiding).argmin())
        worlds.reset(seed=EVALUATION_SEED)
        start, goal = worlds.start_and_goal(i)
        findings.append(Finding(world, name, start, goal, float(avoiding[i]), float(reaching[i])))
    return findings


def _scripted(script: Script, worlds: NavigationVectorEnv) -> Policy:
    step = 0

    def act(observations: NDArray[Any]) -> NDArray[Any]:
        nonlocal step
        commands = np.zeros((len(observations), 2), dtype=np.float32)
        commands[:, 0], commands[:, 1] = script(worlds.scan(), step)
        step += 1
        return commands

    return act


def _returns(worlds: NavigationVectorEnv, policy: Policy) -> tuple[FloatArray, BoolArray]:
    """Discounted return of each environment's first episode, and whether it reached the goal."""
    observations, _ = worlds.reset(seed=EVALUATION_SEED)
    returns, arrived = np.zeros(worlds.num_envs), np.zeros(worlds.num_envs, dtype=bool)
    running, discount = np.ones(worlds.num_envs, dtype=bool), 1.0
    while running.any():
        observations, rewards, terminated, truncated, info = worlds.step(policy(observations))
        returns += discount * rewards * running
        discount *= worlds.step_gamma
        if "final_info" in info:
            arrived |= running & info["_final_info"] & info["final_info"]["is_success"]
        running &= ~(terminated | truncated)
    return returns, arrived
