"""Watching an agent learn: an episode of what it can do by now, every now and then, in a viewer."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

from gridnav.agents import Agent
from gridnav.experiment.evaluation import evaluate, policy_for
from gridnav.experiment.policy_maps import policy_maps
from gridnav.experiment.worlds import UNITS, Problem

LIVE_SEED = 3_000_000
"""Seed of the episodes that are watched."""
log = logging.getLogger("gridnav")
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
        from gridnav.display.recording import send_recording  # takes a second to import, here before training begins

        self._send_recording = send_recording
        self._problem, self._address, self._period_s = problem, address, period_s
        self._due = time.perf_counter()
        self._sent, self._is_over = 0, False

    def watch(self, name: str, world: str, observation: str) -> Watch:
        """How a training of that name, in that world, is watched."""

        def look(agent: Agent, steps: int) -> None:
            if self._is_over or time.perf_counter() < self._due:
                return
            began = time.perf_counter()
            try:
                self._send(agent, name, world, observation, steps)
            except Exception as error:  # whatever it is, it must not cost the training
                log.warning("--live shows no more: %s", " ".join(str(error).split())[:150])
                self._is_over = True
            now = time.perf_counter()
            self._due = now + max(self._period_s, (now - began) / SHARE)

        return look

    def _send(self, agent: Agent, name: str, world: str, observation: str, steps: int) -> None:
        worlds = self._problem.worlds(world, 1, observation=observation)
        try:
            (episode,) = evaluate(policy_for(agent, worlds), worlds, seed=LIVE_SEED + self._sent)
        finally:
            worlds.close()
        maps = policy_maps(self._problem, agent, world, [episode.goal], observation=observation)
        title = f"{name} after {steps:,} steps"
        rollout, shown = {name: episode}, {name: maps[episode.goal]}
        self._send_recording(self._address, self._problem.layout, rollout, maps=shown, title=title, units=UNITS)
        self._sent += 1
