"""One agent in one world: from a budget and a seed to what it learnt."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

from gridnav.agents import Agent, OnProgress, Planner, Progress, QLearning, QLearningConfig
from gridnav.envs import NavigationVectorEnv
from gridnav.experiment.checkpoint import save_agent
from gridnav.experiment.evaluation import evaluate, make_worlds, policy_for
from gridnav.experiment.run_directory import MetricsLog, RunDirectory
from gridnav.problem.layout import Layout
from gridnav.problem.metrics import Episode, Summary, summarise
from gridnav.problem.reward import Reward
from gridnav.problem.task import Task
from gridnav.problem.types import InputError

AgentKind = Literal["plan", "q-learning", "ppo"]
BudgetName = Literal["quick", "default", "full"]


@dataclass(frozen=True)
class Budget:
    """How much a run may spend."""

    q_learning_visits: int
    """Environment steps of tabular Q-learning, per entry of its table."""
    ppo_steps: int
    """Environment steps of one PPO training."""
    episodes: int
    """Evaluation episodes per rung."""


BUDGETS: dict[str, Budget] = {
    "quick": Budget(q_learning_visits=190, ppo_steps=160_000, episodes=50),
    "default": Budget(q_learning_visits=190, ppo_steps=800_000, episodes=200),
    "full": Budget(q_learning_visits=600, ppo_steps=2_000_000, episodes=1000),
}


@dataclass(frozen=True)
class Problem:
    """Layout, task and reward, the same in every world."""

    layout: Layout
    task: Task
    reward: Reward

    @classmethod
    def load(cls, layout: str, task: str, reward: str) -> Problem:
        """From names (and a path or text for the layout).

        Raises:
            InputError: When one of them is unknown or wrong.
        """
        return cls(Layout.load(layout), Task.load(task), Reward.load(reward))

    def worlds(self, world: str, num_envs: int, **options: Any) -> NavigationVectorEnv:
        """Robots that play this problem."""
        return make_worlds(
            world, num_envs, **{"layout": self.layout, "task": self.task, "reward": self.reward, **options}
        )


@dataclass(frozen=True)
class Trained:
    """An agent and what it took to train it."""

    name: str
    """Name of its checkpoint and of its metrics."""
    agent: Agent
    steps: int
    """Environment steps."""
    seconds: float
    """Wall-clock time."""


@dataclass(frozen=True)
class Result:
    """One row of a run's table: an agent in a world, evaluated."""

    name: str
    """Unique in the run."""
    world: str
    """Where it was evaluated."""
    agent: str
    """What acts, in words."""
    carried: str
    """What it took over from another rung, in words."""
    checkpoint: str
    """Name of the agent's checkpoint in the run."""
    episodes: list[Episode]
    """The evaluation's records."""
    steps: int = 0
    """Environment steps of its own training."""
    seconds: float = 0.0
    """Wall-clock time of its own training."""

    @property
    def summary(self) -> Summary:
        """Metrics of the episodes."""
        return summarise(self.episodes)


OnStage = Callable[[str], OnProgress]
"""Told what begins, in words; gives what is to be told of its progress."""


class Workshop:
    """Trains and evaluates the agents of one run, and keeps their checkpoints and metrics.

    Args:
        problem: What is to be solved.
        budget: How much may be spent.
        seed: Of everything that is random in training.
        run: Where files go.
        log: Where metrics go.
        on_stage: Told of every training and evaluation.
    """

    def __init__(
        self, problem: Problem, budget: Budget, seed: int, run: RunDirectory, log: MetricsLog, on_stage: OnStage
    ) -> None:
        self.problem, self.budget, self.seed = problem, budget, seed
        self._run, self._log, self._on_stage = run, log, on_stage
        self._run_steps = 0

    def train(self, name: str, kind: AgentKind, world: str, *, start: Agent | None = None) -> Trained:
        """Train an agent and save it as a checkpoint of the run, also when it is interrupted.

        Args:
            name: Series of the metrics and name of the checkpoint.
            kind: ``plan``, ``q-learning`` or ``ppo``.
            world: ``GridWorld``, ``Unicycle`` or ``DiffDrive``.
            start: A PPO agent whose weights it begins with.

        Raises:
            InputError: When the agent cannot act in that world.
        """
        check_fit(kind, world)
        report = self._on_stage(f"training {name}")
        taken = 0

        def on_progress(progress: Progress) -> None:
            nonlocal taken
            taken = progress.steps
            self._log.add(name, progress.steps, progress.metrics)
            report(progress)

        began = time.perf_counter()
        agent, worlds, steps = self._prepare(kind, world, start)
        try:
            agent.learn(worlds, steps=steps, on_progress=on_progress)
        finally:
            # An interrupt leaves what was learnt so far on disk.
            self._run_steps += taken
            save_agent(agent, self._run.checkpoints, self._run_steps, name=name)
            worlds.close()
        return Trained(name, agent, taken, time.perf_counter() - began)

    def evaluate(self, name: str, trained: Trained, world: str, agent: str, *, carried: str = "") -> Result:
        """Fixed-seed episodes of an agent in a world; an agent of the grid drives robots by grid moves.

        Args:
            name: The row's name, unique in the run.
            trained: Who acts.
            world: Where.
            agent: Who acts, in words.
            carried: What it took over from another rung, in words. Training counts in the row of the same name.
        """
        report = self._on_stage(f"evaluating {name}")
        worlds = self.problem.worlds(world, self.budget.episodes)
        episodes = evaluate(policy_for(trained.agent, worlds), worlds, on_progress=report)
        worlds.close()
        own = name == trained.name
        steps, seconds = (trained.steps, trained.seconds) if own else (0, 0.0)
        return Result(name, world, agent, carried, trained.name, episodes, steps, seconds)

    def _prepare(self, kind: AgentKind, world: str, start: Agent | None) -> tuple[Agent, NavigationVectorEnv, int]:
        problem = self.problem
        if kind == "plan":
            return Planner.solve(problem.layout, problem.task, problem.reward), problem.worlds(world, 1), 0
        if kind == "q-learning":
            config = QLearningConfig(seed=self.seed, gamma=problem.reward.gamma)
            # Exploring starts (Sutton and Barto 2018, section 5.3): the table is to be right everywhere.
            task = replace(problem.task, starts="any")
            worlds = problem.worlds(world, config.num_envs, task=task)
            table = QLearning(worlds.single_observation_space, worlds.single_action_space, config)
            return table, worlds, self.budget.q_learning_visits * table.action_values.size
        from gridnav.agents import PPOAgent, PPOConfig  # torch takes seconds to import

        ppo_config = PPOConfig(seed=self.seed)
        worlds = problem.worlds(world, ppo_config.num_envs)
        ppo = PPOAgent(worlds.single_observation_space, worlds.single_action_space, ppo_config)
        if isinstance(start, PPOAgent):
            ppo.policy.load_state_dict(start.policy.state_dict())
        return ppo, worlds, self.budget.ppo_steps


def check_fit(kind: AgentKind, world: str) -> None:
    """Whether an agent can act in a world.

    Raises:
        InputError: When it cannot, with the worlds where it can.
    """
    on_grid = kind in ("plan", "q-learning")
    if on_grid != (world == "GridWorld"):
        right = "gridnav/GridWorld-v0" if on_grid else "gridnav/Unicycle-v0 or gridnav/DiffDrive-v0"
        raise InputError(f"agent {kind} cannot act in gridnav/{world}-v0: it needs {right}")
