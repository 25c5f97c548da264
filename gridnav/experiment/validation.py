"""Which policy of a training is kept: of the greedy ones in its last quarter, the best in episodes of their own."""

from __future__ import annotations

from typing import Any

import numpy as np

from gridnav.agents import Agent
from gridnav.envs import NavigationVectorEnv
from gridnav.experiment.evaluation import evaluate, policy_for
from gridnav.problem.metrics import summarise
from gridnav.problem.types import State

VALIDATION_SEED = 2_000_000
"""Seed of the validation's episodes; no evaluation uses it, and no training unless asked for this very number."""
BEGIN = 0.75
"""Share of the planned steps after which policies are judged."""


class Validation:
    """Judges policies at equal distances up to the last one, by the return of greedy episodes.

    An update can undo what an earlier one learnt for places that are seldom met, and a robot that gets there is stuck:
    the last policy of a training is not always the one to keep (docs/ppo.md).

    Args:
        agent: Who learns.
        worlds: Where; each environment plays one episode.
        steps: Environment steps of the training.
        n_policies: How many are judged.
        saved: What ``state`` gave before a cut.

    Raises:
        ValueError: When ``saved`` holds no such agent (or another of ``course.UNFIT``).
    """

    def __init__(
        self, agent: Agent, worlds: NavigationVectorEnv, steps: int, n_policies: int, saved: State | None = None
    ) -> None:
        self._agent, self._worlds = agent, worlds
        self._due = np.linspace(BEGIN * steps, steps, n_policies + 1)[1:]
        self._best: State | None = None
        self._best_return, self._n_judged = -np.inf, 0
        if saved is not None:
            # Weights alone: what they belong to is known.
            self._best = State(saved.arrays, agent.state().values)
            self._best_return, self._n_judged = float(saved.values["return"]), int(saved.values["n_judged"])
            self.best()

    def is_due(self, steps: int) -> bool:
        """The next policy is to be judged; the last one is judged when training is over, whatever this says."""
        return self._n_judged < len(self._due) - 1 and steps >= self._due[self._n_judged]

    def judge(self) -> dict[str, float]:
        """Keep the agent as it is if none before was better; the metrics of its episodes."""
        summary = summarise(evaluate(policy_for(self._agent, self._worlds), self._worlds, seed=VALIDATION_SEED))
        self._n_judged += 1
        if summary.mean_return >= self._best_return:
            self._best, self._best_return = self._agent.state(), summary.mean_return
        return {
            "validation_success_rate": summary.success_rate,
            "validation_collision_rate": summary.collision_rate,
            "validation_return": summary.mean_return,
        }

    def close(self) -> None:
        """Release the environments."""
        self._worlds.close()

    def best(self) -> Agent:
        """The best of those that were judged."""
        assert self._best is not None
        return type(self._agent).from_state(self._best)

    def state(self) -> State | None:
        """What goes on from here after a cut; none while no policy was judged."""
        if self._best is None:
            return None
        values: dict[str, Any] = {"return": self._best_return, "n_judged": self._n_judged}
        return State(self._best.arrays, values)
