"""The learning curve that arms are compared by: what the greedy policy can do at chosen steps of its training."""

from __future__ import annotations

import time

import numpy as np

from gridnav.agents import Agent
from gridnav.envs import NavigationVectorEnv
from gridnav.experiment.evaluation import policy_for

CURVE_SEED = 4_000_000
"""Seed of the curve's episodes: no evaluation, validation or training uses it."""
CURVE_EPISODES = 100
SUCCESS = "greedy_success_rate"
"""Name of the curve in the metrics."""
FIRST = (0, 8_000, 16_000, 32_000, 48_000, 64_000, 96_000)
"""Environment steps of the first points."""
EVERY = 32_000
"""Steps between the points that follow, or a fifteenth of the training where that is more."""


def curve_points(steps: int) -> list[int]:
    """Where the curve of a training of that many steps is measured, its two ends included."""
    gap = max(EVERY, steps // 15)
    later = range(FIRST[-1] + gap, steps, gap)
    return [point for point in (*FIRST, *later) if point < steps] + [steps]


class GreedyCurve:
    """Drives the same episodes with every policy it is shown; training is not touched by it.

    Training success says what a policy does while it explores, over the last 400 episodes; this is what it could do
    at once. Nothing is recorded of the episodes but how they ended, which makes them cheap, and a policy that arrives
    is measured in a second.

    Args:
        worlds: As many robots as episodes.
        steps: Environment steps of the training.
    """

    def __init__(self, worlds: NavigationVectorEnv, steps: int) -> None:
        self._worlds, self._points = worlds, curve_points(steps)
        self.seconds = 0.0
        """Spent here, which is no part of the training."""

    def is_due(self, steps: int, measured: int) -> bool:
        """Whether a point lies between the last measurement (-1 before the first) and here."""
        return any(measured < point <= steps for point in self._points)

    def measure(self, agent: Agent) -> dict[str, float]:
        """Success and collisions of the greedy policy."""
        began = time.perf_counter()
        worlds = self._worlds
        policy = policy_for(agent, worlds)
        observations, _ = worlds.reset(seed=CURVE_SEED)
        running = np.ones(worlds.num_envs, dtype=bool)
        arrived, collided = np.zeros_like(running), np.zeros_like(running)
        while running.any():
            observations, _, terminated, truncated, info = worlds.step(policy(observations))
            ended = (terminated | truncated) & running
            if ended.any():
                arrived[ended] = info["final_info"]["is_success"][ended]
                collided[ended] = info["final_info"]["collisions"][ended] > 0
                running &= ~ended
                worlds.park(~running)
        worlds.park(np.zeros_like(running))
        self.seconds += time.perf_counter() - began
        return {SUCCESS: float(arrived.mean()), "greedy_collision_rate": float(collided.mean())}

    def close(self) -> None:
        """Release the environments."""
        self._worlds.close()
