"""One agent in one world: from a budget and a seed to what it learnt."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, Self

import numpy as np

from gridnav.agents import Agent, OnProgress, Planner, Progress, QLearning
from gridnav.envs import LayoutMix, NavigationVectorEnv
from gridnav.experiment.checkpoint import Checkpoint, Standing, load_checkpoint, save_checkpoint
from gridnav.experiment.evaluation import evaluate_in
from gridnav.experiment.presets import choose_config
from gridnav.experiment.run_directory import MetricsLog, RunDirectory
from gridnav.experiment.worlds import Problem
from gridnav.problem.metrics import Episode, Summary, summarise
from gridnav.problem.types import InputError, IntArray, State

AgentKind = Literal["plan", "q-learning", "dqn", "ppo"]
OBSERVATIONS: dict[AgentKind, tuple[str, ...]] = {
    "plan": ("cell_goal",),
    "q-learning": ("cell_goal", "cell"),
    "dqn": ("cell_goal", "cell", "features"),
}
"""What agents of the grid can see, in the order in which ``--agent all`` trains them."""
BudgetName = Literal["quick", "default", "full"]


@dataclass(frozen=True)
class Budget:
    """How much a run may spend."""

    share: float
    """Of the environment steps that a network's preset asks for."""
    episodes: int
    """Evaluation episodes per rung."""


BUDGETS: dict[str, Budget] = {
    "quick": Budget(share=0.2, episodes=50),
    "default": Budget(share=1.0, episodes=200),
    "full": Budget(share=2.5, episodes=1000),
}
CHECKPOINT_S = 10.0
"""Seconds between two checkpoints of a training."""
CHECKPOINT_SHARE = 0.01
"""Of the time of a training that its checkpoints may take: where one takes long, the next one waits longer."""


@dataclass(frozen=True)
class Choice:
    """What one may choose about an agent."""

    preset: str = ""
    """Name of its hyper-parameters; by default those made for the problem and what it observes."""
    changes: Mapping[str, str] = field(default_factory=dict)
    """Hyper-parameters that differ from the preset: values in words, by name."""
    observation: str = "cell_goal"
    """What it sees on the grid: ``cell_goal``, ``cell`` or ``features``."""

    def preset_of(self, kind: AgentKind, problem: Problem) -> str:
        """The preset's name for a kind of agent."""
        if self.preset:
            return self.preset
        if kind == "ppo":
            return "layouts" if problem.family else "any" if problem.task.goals == "any" else "default"
        return self.observation if self.observation != "cell_goal" else "default"


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
    world: str = "GridWorld"
    """Where it was trained."""
    observation: str = "cell_goal"
    """What it sees on the grid."""
    visits: IntArray | None = None
    """How often a robot was seen in each cell in training, shape ``(n_rows, n_cols)``."""


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
    observation: str = "cell_goal"
    """What it sees on the grid."""

    @cached_property
    def summary(self) -> Summary:
        """Metrics of the episodes."""
        return summarise(self.episodes)


OnStage = Callable[[str], OnProgress]
"""Told what begins, in words; gives what is to be told of its progress."""


class Workshop:
    """Trains and evaluates the agents of one run, and keeps their checkpoints and metrics.

    A run that was killed goes on where its checkpoints left it: what was trained is loaded, what was in training is
    continued bit for bit, the rest is done as ever.

    Args:
        problem: What is to be solved.
        budget: How much may be spent.
        seed: Of everything that is random in training.
        run: Where files go; whoever makes the workshop owns it.
        log: Where metrics go.
        on_stage: Told of every training and evaluation.
        checkpoint_s: Seconds between two checkpoints of a training; 0 makes one at every opportunity.
    """

    def __init__(
        self,
        problem: Problem,
        budget: Budget,
        seed: int,
        run: RunDirectory,
        log: MetricsLog,
        on_stage: OnStage,
        *,
        checkpoint_s: float = CHECKPOINT_S,
    ) -> None:
        self.problem, self.budget, self.seed = problem, budget, seed
        self._run, self._log, self._on_stage, self._checkpoint_s = run, log, on_stage, checkpoint_s
        self._run_steps = 0

    def train(
        self, name: str, kind: AgentKind, world: str, *, start: Agent | None = None, choice: Choice | None = None
    ) -> Trained:
        """Train an agent, with checkpoints in the run, or load what an earlier process trained.

        Args:
            name: Series of the metrics and name of the checkpoints.
            kind: ``plan``, ``q-learning``, ``dqn`` or ``ppo``.
            world: ``GridWorld``, ``Unicycle`` or ``DiffDrive``.
            start: A PPO agent whose weights it begins with.
            choice: Its hyper-parameters and observation.

        Raises:
            InputError: When the agent cannot act in that world.
            KeyboardInterrupt: After a checkpoint, when the process was asked to stop.
            NonFiniteError: When a NaN or infinity came up; the last checkpoint is from before.
        """
        choice = choice or Choice()
        check_fit(kind, world)
        saved = load_checkpoint(self._run.checkpoints, name)
        if saved is not None and saved.standing.is_finished:
            self._run_steps = saved.standing.run_steps
            there = saved.standing
            return Trained(name, saved.agent, there.steps, there.seconds, world, choice.observation, saved.visits)
        report = self._on_stage(f"training {name}")
        agent, worlds, steps = make_learner(self.problem, kind, world, self.seed, self.budget, choice, start)
        if saved is not None:
            agent = saved.agent
            _bring_back(worlds, saved, name)
        visits = None if saved is None else saved.visits
        if saved is None and isinstance(worlds, NavigationVectorEnv):
            visits = np.zeros(worlds.layout.walls.shape, dtype=np.int64)
        before = saved.standing if saved is not None else Standing(run_steps=self._run_steps)
        began = time.perf_counter()

        def standing(*, is_finished: bool) -> Standing:
            seconds = before.seconds + time.perf_counter() - began
            run_steps = before.run_steps + taken - before.steps
            return Standing(taken, seconds, run_steps, self._log.sync(), is_finished)

        taken, n_cuts = before.steps, 0

        def on_progress(progress: Progress) -> None:
            nonlocal taken
            taken = progress.steps
            self._log.add(name, progress.steps, progress.metrics)
            report(progress)

        with Interruption() as interruption:
            clock = _Clock(self._checkpoint_s)

            def on_cut(training: Callable[[], State]) -> None:
                nonlocal n_cuts
                n_cuts += 1
                is_saved = saved is not None and n_cuts == 1  # it is the cut that the checkpoint was made at
                if not is_saved and (clock.is_due or interruption.is_asked):
                    with clock:
                        here = Checkpoint(agent, standing(is_finished=False), training(), worlds.get_state(), visits)
                        save_checkpoint(self._run.checkpoints, name, here)
                if interruption.is_asked:
                    raise KeyboardInterrupt
                # After the checkpoint, for a continued training comes by here again.
                if visits is not None and isinstance(worlds, NavigationVectorEnv):
                    np.add.at(visits, tuple(worlds.cells.T), 1)

            resume = saved.training if saved is not None else None
            try:
                agent.learn(worlds, steps=steps, on_progress=on_progress, on_cut=on_cut, resume=resume)
            except UNFIT as error:
                # Until a first piece of training is through, it is the checkpoint's fault.
                if saved is None or n_cuts > 1:
                    raise
                raise InputError(f"the checkpoint of {name!r} does not fit its training: {error!r:.100}") from error
            end = standing(is_finished=True)
            save_checkpoint(self._run.checkpoints, name, Checkpoint(agent, end, None, None, visits))
            if interruption.is_asked:
                raise KeyboardInterrupt
        worlds.close()
        self._run_steps = end.run_steps
        return Trained(name, agent, end.steps, end.seconds, world, choice.observation, visits)

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
        episodes = evaluate_in(
            self.problem, trained.agent, world, self.budget.episodes,
            observation=trained.observation, on_progress=report,
        )  # fmt: skip
        own = name == trained.name
        steps, seconds = (trained.steps, trained.seconds) if own else (0, 0.0)
        return Result(name, world, agent, carried, trained.name, episodes, steps, seconds, trained.observation)


UNFIT = LookupError, TypeError, ValueError, AttributeError, RuntimeError
"""What comes of a checkpoint whose parts are whole and do not belong together."""


def _bring_back(worlds: NavigationVectorEnv | LayoutMix, saved: Checkpoint, name: str) -> None:
    """Put the worlds where a checkpoint left them; InputError where it is not one of them."""
    try:
        if saved.worlds is None or saved.training is None:
            raise InputError("it holds no training to go on with")
        worlds.set_state(saved.worlds)
        if saved.visits is not None and isinstance(worlds, NavigationVectorEnv):
            np.add.at(saved.visits, tuple(worlds.cells.T), 0)
    except UNFIT as error:
        raise InputError(f"the checkpoint of {name!r} does not fit its worlds: {error!r:.100}") from error


class Interruption:
    """SIGINT and SIGTERM as a request, which training answers at its next cut; a second one ends it at once."""

    def __enter__(self) -> Self:
        self.is_asked = False
        self._before: dict[int, Any] = {}
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._note) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, *_: object) -> None:
        if self.is_asked:
            raise KeyboardInterrupt
        self.is_asked = True


class _Clock:
    """When the next checkpoint is due; a context around the making of one."""

    def __init__(self, period_s: float) -> None:
        self._period_s, self._due = period_s, time.perf_counter()

    @property
    def is_due(self) -> bool:
        return time.perf_counter() >= self._due

    def __enter__(self) -> None:
        self._began = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        now = time.perf_counter()
        wait = max(self._period_s, (now - self._began) / CHECKPOINT_SHARE) if self._period_s else 0.0
        self._due = now + wait


def make_learner(
    problem: Problem,
    kind: AgentKind,
    world: str,
    seed: int,
    budget: Budget,
    choice: Choice,
    start: Agent | None = None,
) -> tuple[Agent, NavigationVectorEnv | LayoutMix, int]:
    """An agent that has not learnt yet, the environments it learns in, and for how many steps.

    Args:
        problem: What is to be solved.
        kind: Who learns.
        world: Where.
        seed: Of everything that is random in training.
        budget: How much may be spent.
        choice: Its hyper-parameters and observation.
        start: A PPO agent whose weights it begins with.

    Raises:
        InputError: When a preset or hyper-parameter is unknown, or a value is not possible.
    """
    if kind == "plan":
        return Planner.solve(problem.layout, problem.task, problem.reward), problem.worlds(world, 1), 0
    config = choose_config(kind, choice.preset_of(kind, problem), {"seed": str(seed), **choice.changes})
    worlds = problem.training_worlds(
        world, config.num_envs, observation=choice.observation, exploring_starts=config.exploring_starts
    )
    spaces = worlds.single_observation_space, worlds.single_action_space
    if kind == "q-learning":
        table = QLearning(*spaces, config)
        return table, worlds, table.planned_steps
    from gridnav.agents import DQNAgent, PPOAgent  # torch takes seconds to import

    agent: DQNAgent | PPOAgent
    if kind == "dqn":
        agent = DQNAgent(*spaces, config)
    else:
        agent = PPOAgent(*spaces, config)
        if isinstance(start, PPOAgent):
            agent.policy.load_state_dict(start.policy.state_dict())
    return agent, worlds, int(agent.planned_steps * budget.share)


def check_choice(kinds: Sequence[AgentKind], problem: Problem, world: str, choice: Choice) -> None:
    """Whether agents can be made of a choice, before anything is written.

    Raises:
        InputError: When a preset or hyper-parameter is unknown, or a value is not possible.
    """
    for kind in kinds:
        check_fit(kind, world)
        if problem.family and kind != "ppo" and choice.observation != "features":
            raise InputError(
                f"{kind} on random layouts needs to see them: take dqn with --observation features, or ppo"
            )
        if world == "GridWorld" and choice.observation not in OBSERVATIONS[kind]:
            raise InputError(f"{kind} cannot observe {choice.observation}: it needs {' or '.join(OBSERVATIONS[kind])}")
        if world != "GridWorld" and choice.observation != "cell_goal":
            raise InputError(f"observation {choice.observation} is for gridnav/GridWorld-v0: robots observe features")
        if kind != "plan":
            choose_config(kind, choice.preset_of(kind, problem), choice.changes)


def check_fit(kind: AgentKind, world: str) -> None:
    """Whether an agent can act in a world.

    Raises:
        InputError: When it cannot, with the worlds where it can.
    """
    on_grid = kind in OBSERVATIONS
    if on_grid != (world == "GridWorld"):
        right = "gridnav/GridWorld-v0" if on_grid else "gridnav/Unicycle-v0 or gridnav/DiffDrive-v0"
        raise InputError(f"agent {kind} cannot act in gridnav/{world}-v0: it needs {right}")
