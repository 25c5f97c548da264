"""One agent in one world: from a budget and a seed to what it learnt."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, Self

from gridnav.agents import Agent, OnProgress, Planner, QLearning
from gridnav.display.policy_map import PolicyMap
from gridnav.envs import NavigationVectorEnv, WrappedWorlds
from gridnav.experiment.checkpoint import Checkpoint, Standing, load_checkpoint, save_checkpoint
from gridnav.experiment.course import CHECKPOINT_S, UNFIT, Course, Worlds, bring_back
from gridnav.experiment.evaluation import evaluate_in
from gridnav.experiment.greedy_curve import CURVE_EPISODES, GreedyCurve
from gridnav.experiment.live import Spectator
from gridnav.experiment.policy_maps import policy_maps
from gridnav.experiment.presets import choose_config
from gridnav.experiment.run_directory import MetricsLog, RunDirectory
from gridnav.experiment.validation import Validation
from gridnav.experiment.worlds import Problem
from gridnav.problem.metrics import Episode, Summary, summarise
from gridnav.problem.types import Cell, InputError, IntArray

if TYPE_CHECKING:
    from gridnav.agents import PPOAgent

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
            varied = "randomized" if problem.randomization.names else "default"
            return "layouts" if problem.family else "any" if problem.task.goals == "any" else varied
        return self.observation if self.observation != "cell_goal" else "default"


@dataclass(frozen=True)
class Training:
    """Who learns where, of one run."""

    kinds: Sequence[AgentKind]
    """Who learns; several are compared."""
    world: str
    """Where: ``GridWorld``, ``Unicycle`` or ``DiffDrive``."""
    choice: Choice
    """Hyper-parameters and observation."""

    @classmethod
    def of(cls, config: Mapping[str, Any], problem: Problem) -> Self:
        """From the configuration of a run.

        Args:
            config: As in the run's ``config.json``.
            problem: What it describes.

        Raises:
            InputError: When something in it is unknown, not possible or does not go together.
        """
        choice = Choice(config["preset"], _changes(config["set"]), config["observation"])
        agent = config["agent"]
        all_of_them: list[AgentKind] = [kind for kind, seen in OBSERVATIONS.items() if choice.observation in seen]
        kinds = all_of_them if agent == "all" else [agent]
        home = "gridnav/DiffDrive-v0" if agent == "ppo" else "gridnav/GridWorld-v0"
        world = config.get("env", home).split("/")[1].removesuffix("-v0")
        check_choice(kinds, problem, world, choice)
        if world == "GridWorld" and problem.randomization.names:
            raise InputError("--randomization varies robots, and the grid has none: leave it out or give another --env")
        return cls(kinds, world, choice)


def _changes(pairs: Sequence[str]) -> dict[str, str]:
    """Hyper-parameters by name, from pairs such as ``batch_size=64``."""
    changes = {}
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not equals or name == "seed":
            raise InputError(f"--set {pair!r:.60} must be name=value, and the seed is --seed")
        changes[name] = value
    return changes


@dataclass(frozen=True)
class Carry:
    """What a training of PPO takes over from others; by default nothing."""

    changes: Mapping[str, str] = field(default_factory=dict)
    """Hyper-parameters that differ for its sake: values in words, by name."""
    begin: Callable[[PPOAgent], PPOAgent] | None = None
    """Makes of an untrained agent the one that begins."""
    wrap: Callable[[NavigationVectorEnv, PPOAgent], WrappedWorlds] | None = None
    """Puts the worlds in which the agent learns into a wrapper."""
    teacher: PPOAgent | None = None
    """Whom the agent is drawn to."""


def carry_weights(source: Agent, **changes: str) -> Carry:
    """Begin with the weights of another PPO agent, see ``PPOAgent.take_weights``."""

    def begin(agent: PPOAgent) -> PPOAgent:
        agent.take_weights(source)  # type: ignore[arg-type]
        return agent

    return Carry(changes, begin)


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
    maps: Mapping[Cell, PolicyMap] = field(default_factory=dict)
    """What the agent makes of the maze, for the goals of the episodes; none in a family of layouts."""
    randomization: Mapping[str, Any] = field(default_factory=dict)
    """What varied, as ``Randomization.to_json`` says it."""

    @cached_property
    def summary(self) -> Summary:
        """Metrics of the episodes."""
        return summarise(self.episodes)


OnStage = Callable[[str], OnProgress]
"""Told what begins, in words; gives what is to be told of its progress."""


def unseen(name: str) -> OnProgress:
    """A stage whose progress nobody watches."""
    return lambda progress: None


@dataclass(frozen=True)
class Job:
    """A run to be made: of what, with how much, where, and who is told."""

    problem: Problem
    """What is to be solved."""
    budget: Budget
    """How much may be spent."""
    seed: int
    """Of everything that is random in training."""
    run: RunDirectory
    """Where files go; whoever makes the job owns it. A run that was stopped goes on."""
    on_stage: OnStage
    """Told of every training and evaluation."""
    config: Mapping[str, Any] = field(default_factory=dict)
    """The run's configuration, for its report."""
    command: str = ""
    """What makes the run again, for its report."""
    checkpoint_s: float = CHECKPOINT_S
    """Seconds between two checkpoints of a training; 0 makes one at every opportunity."""
    spectator: Spectator | None = None
    """Watches every training."""


class Workshop:
    """Trains and evaluates the agents of one run, and keeps their checkpoints and metrics.

    A run that was killed goes on where its checkpoints left it: what was trained is loaded, what was in training is
    continued bit for bit, the rest is done as ever.

    Args:
        job: What is to be made.
        log: Where metrics go.
    """

    def __init__(self, job: Job, log: MetricsLog) -> None:
        self.problem, self.budget, self.seed = job.problem, job.budget, job.seed
        self._job, self._run, self._log, self._on_stage = job, job.run, log, job.on_stage
        self._run_steps = 0

    def train(
        self,
        name: str,
        kind: AgentKind,
        world: str,
        *,
        carry: Carry | None = None,
        choice: Choice | None = None,
        with_curve: bool = False,
    ) -> Trained:
        """Train an agent, with checkpoints in the run, or load what an earlier process trained.

        Args:
            name: Series of the metrics and name of the checkpoints.
            kind: ``plan``, ``q-learning``, ``dqn`` or ``ppo``.
            world: ``GridWorld``, ``Unicycle`` or ``DiffDrive``.
            carry: What a PPO agent takes over from others.
            choice: Its hyper-parameters and observation.
            with_curve: Measure its greedy policies on the way, see ``GreedyCurve``.

        Raises:
            InputError: When the agent cannot act in that world.
            KeyboardInterrupt: After a checkpoint, when the process was asked to stop.
            NonFiniteError: When a NaN or infinity came up; the last checkpoint is from before.
        """
        choice, carry = choice or Choice(), carry or Carry()
        check_fit(kind, world)
        saved = load_checkpoint(self._run.checkpoints, name)
        if saved is not None and saved.standing.is_finished:
            self._run_steps = saved.standing.run_steps
            there = saved.standing
            return Trained(name, saved.agent, there.steps, there.seconds, world, choice.observation, saved.visits)
        report = self._on_stage(f"training {name}")
        agent, worlds, steps = make_learner(self.problem, kind, world, self.seed, self.budget, choice, carry)
        before = Standing(run_steps=self._run_steps)
        if saved is not None:
            _check_config(name, saved.agent, getattr(agent, "config", None))
            agent, before = saved.agent, saved.standing
            bring_back(worlds, saved, name)
        if carry.teacher is not None:
            agent.teacher = carry.teacher  # type: ignore[attr-defined]
        validation = make_validation(self.problem, agent, world, steps, self.budget, saved)
        spectator = self._job.spectator
        watch = spectator.watch(name, world, choice.observation) if spectator else None
        judged = self.problem.for_evaluation
        curve = GreedyCurve(judged.worlds(world, CURVE_EPISODES), steps) if with_curve else None
        course = Course(
            name, agent, worlds, validation, before, saved, self._run, self._log, report, self._job.checkpoint_s, watch,
            curve,
        )  # fmt: skip
        end = course.go(steps)
        for used in (worlds, validation, curve):
            if used is not None:
                used.close()
        self._run_steps = end.run_steps
        return Trained(name, course.agent, end.steps, end.seconds, world, choice.observation, course.visits)

    def keep(
        self, name: str, world: str, config: object, make: Callable[[], tuple[Agent, int, dict[str, float]]]
    ) -> Trained:
        """An agent that comes about in one go, with a checkpoint in the run, or the one an earlier process made.

        Args:
            name: Name of its metrics and of its checkpoint.
            world: Where it has its experience from.
            config: Its hyper-parameters.
            make: Gives the agent, the environment steps that it took, and metrics.
        """
        saved = load_checkpoint(self._run.checkpoints, name)
        if saved is None:
            self._on_stage(f"making {name}")
            began = time.perf_counter()
            agent, steps, metrics = make()
            self._log.add(name, steps, metrics)
            seconds, run_steps = time.perf_counter() - began, self._run_steps + steps
            saved = Checkpoint(agent, Standing(steps, seconds, run_steps, self._log.sync(), True), None, None)
            save_checkpoint(self._run.checkpoints, name, saved)
        _check_config(name, saved.agent, config)
        self._run_steps = saved.standing.run_steps
        return Trained(name, saved.agent, saved.standing.steps, saved.standing.seconds, world)

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
        goals = [] if self.problem.family else sorted({episode.goal for episode in episodes})
        maps = policy_maps(self.problem, trained.agent, trained.world, goals, observation=trained.observation)
        own = name == trained.name
        steps, seconds = (trained.steps, trained.seconds) if own else (0, 0.0)
        return Result(
            name, world, agent, carried, trained.name, episodes, steps, seconds, trained.observation, maps,
            self.problem.randomization.to_json(),
        )  # fmt: skip


def _check_config(name: str, saved: Agent, config: object) -> None:
    """Whether a checkpoint's agent has these hyper-parameters.

    Raises:
        InputError: When it has others.
    """
    if getattr(saved, "config", None) != config:
        raise InputError(
            f"the checkpoint of {name!r} was trained with other hyper-parameters than these: they are another "
            "gridnav's; begin another run"
        )


def make_learner(
    problem: Problem,
    kind: AgentKind,
    world: str,
    seed: int,
    budget: Budget,
    choice: Choice,
    carry: Carry | None = None,
) -> tuple[Agent, Worlds, int]:
    """An agent that has not learnt yet, the environments it learns in, and for how many steps.

    Args:
        problem: What is to be solved.
        kind: Who learns.
        world: Where.
        seed: Of everything that is random in training.
        budget: How much may be spent.
        choice: Its hyper-parameters and observation.
        carry: What a PPO agent takes over from others.

    Raises:
        InputError: When a preset or hyper-parameter is unknown, or a value is not possible.
    """
    if kind == "plan":
        return Planner.solve(problem.layout, problem.task, problem.reward), problem.worlds(world, 1), 0
    carry = carry or Carry()
    changes = {"seed": str(seed), **carry.changes, **choice.changes}
    config = choose_config(kind, choice.preset_of(kind, problem), changes)
    worlds = problem.training_worlds(
        world, config.num_envs, observation=choice.observation, exploring_starts=config.exploring_starts
    )
    spaces = worlds.single_observation_space, worlds.single_action_space
    if kind == "q-learning":
        table = QLearning(*spaces, config)
        return table, worlds, table.planned_steps
    from gridnav.agents import DQNAgent, PPOAgent  # torch takes seconds to import

    if kind == "dqn":
        deep = DQNAgent(*spaces, config)
        return deep, worlds, int(deep.planned_steps * budget.share)
    agent = PPOAgent(*spaces, config)
    if carry.begin is not None:
        agent = carry.begin(agent)
    steps = int(agent.planned_steps * budget.share)
    if carry.wrap is None:
        return agent, worlds, steps
    if not isinstance(worlds, NavigationVectorEnv):
        raise InputError("what is carried is of one maze: it cannot help in mazes that change")
    return agent, carry.wrap(worlds, agent), steps


def make_validation(
    problem: Problem, agent: Agent, world: str, steps: int, budget: Budget, saved: Checkpoint | None
) -> Validation | None:
    """Who judges the policies of a training, where its preset wants that and the budget lasts for two of them.

    In a family of layouts none: a policy is judged in one.

    Args:
        problem: What is to be solved.
        agent: Who learns.
        world: Where.
        steps: Environment steps of the training.
        budget: How much may be spent.
        saved: The checkpoint that is continued, if one is.

    Raises:
        InputError: When the checkpoint's best policy does not fit.
    """
    config: Any = getattr(agent, "config", None)
    n_policies = round(getattr(config, "n_validations", 0) * budget.share)
    if n_policies < 2 or problem.family is not None:
        return None
    worlds = problem.for_evaluation.worlds(world, config.validation_episodes)
    try:
        return Validation(agent, worlds, steps, n_policies, saved.validation if saved else None)
    except UNFIT as error:
        raise InputError(f"the checkpoint's best policy does not fit its training: {error!r:.100}") from error


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
