"""Watching an agent learn: an episode of what it can do by now, every now and then, in a viewer."""

from __future__ import annotations

import time
from collections.abc import Callable

from gridnav.agents import Agent
from gridnav.display.recording import send_recording
from gridnav.experiment.evaluation import evaluate, policy_for
from gridnav.experiment.policy_maps import policy_maps
from gridnav.experiment.worlds import Problem

LIVE_SEED = 3_000_000
"""Seed of the episodes that are watched; nothing else uses it."""
SHARE = 0.02
"""Of the time of a training that watching may take: where an episode takes long, the next one waits longer."""

Watch = Callable[[Agent, int], None]
"""Given who learns and its environment steps so far, as often as one likes."""


class Spectator:
    """Sends greedy episodes to a viewer; training sees nothing of it and goes on without a viewer.

    Args:
        problem: What is to be solved.
        address: The viewer's.
        period_s: Seconds between two episodes, at least.
    """

    def __init__(self, problem: Problem, address: str, period_s: float) -> None:
        self._problem, self._address, self._period_s = problem, address, period_s
        self._due = time.perf_counter()
        self._sent = 0

    def watch(self, name: str, world: str, observation: str) -> Watch:
        """How a training of that name, in that world, is watched."""

        def look(agent: Agent, steps: int) -> None:
            if time.perf_counter() < self._due:
                return
            began = time.perf_counter()
            worlds = self._problem.worlds(world, 1, observation=observation)
            (episode,) = evaluate(policy_for(agent, worlds), worlds, seed=LIVE_SEED + self._sent)
            worlds.close()
            goal = episode.goal
            shown = policy_maps(self._problem, agent, world, [goal], observation=observation)
            title = f"{name} after {steps:,} steps"
            send_recording(self._address, self._problem.layout, {name: episode}, maps={name: shown[goal]}, title=title)
            self._sent += 1
            now = time.perf_counter()
            self._due = now + max(self._period_s, (now - began) / SHARE)

        return look
