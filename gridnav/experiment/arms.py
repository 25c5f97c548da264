"""Transfer arms: ways in which what was learnt on an earlier rung helps on a later one, behind one interface.

An arm says what it needs and prepares a training: with which weights, rewards, commands or teacher it begins. To add
one, write such a function, three lines as a rule, and name it in ``ARMS``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any

import numpy as np

from gridnav.agents import Agent, TabularAgent
from gridnav.envs import Corrected, NavigationVectorEnv, PotentialShaping
from gridnav.experiment.demonstrations import demonstrate
from gridnav.experiment.evaluation import follow
from gridnav.experiment.presets import choose_config
from gridnav.experiment.training import Carry, Choice, Trained, Workshop, carry_weights
from gridnav.experiment.worlds import Problem
from gridnav.problem.geodesic import cell_distances
from gridnav.problem.potential import CellPotential
from gridnav.problem.types import AnyArray, FloatArray, InputError

if TYPE_CHECKING:
    from gridnav.agents import PPOAgent

TABLE, NETWORK, CLONE = "q-learning", "ppo-unicycle", "cloned"
"""What arms build on, by the name of its checkpoint: a Q-table of the grid, the Unicycle's network, and a network that
learnt by heart how the table drives the Unicycle."""
EARLY = "Unicycle"
"""Where networks are made before the target is seen."""


@dataclass(frozen=True)
class Arm:
    """One way from an earlier rung to a later one."""

    agent: str
    """Who acts in the end, in words."""
    carried: str
    """What is taken over, in words; empty for nothing."""
    sources: tuple[str, ...]
    """What it builds on, of ``TABLE``, ``NETWORK`` and ``CLONE``."""
    prepare: Callable[[Problem, Sequence[Trained]], Carry] | None
    """What a training takes over, given the problem and the trained sources; none where nothing is learnt."""


def scratch(problem: Problem, sources: Sequence[Trained]) -> Carry:
    """Nothing: what the others are compared with."""
    return Carry()


def weights(problem: Problem, sources: Sequence[Trained]) -> Carry:
    """The network as it is; a policy that has learnt explores little and would be thrown off by a beginner's steps."""
    (network,) = sources
    return carry_weights(network.agent, learning_rate="5e-4")


def potential(problem: Problem, sources: Sequence[Trained]) -> Carry:
    """The table's values as a potential."""
    (table,) = sources
    values = cell_values(problem, table.agent)

    def wrap(worlds: NavigationVectorEnv, agent: PPOAgent) -> PotentialShaping:
        return PotentialShaping(worlds, potential_of(worlds, values), agent.config.gamma)

    return Carry(wrap=wrap)


def clone(problem: Problem, sources: Sequence[Trained]) -> Carry:
    """The cloned policy and its critic, which first learns what the target's steps are worth.

    The policy is drawn to what it was for half of the training: left to itself it forgot more than it learnt.
    """
    *_, cloned = sources
    careful = {"learning_rate": "5e-4", "log_std_init": "-1.5", "critic_only_steps": "16000", "teacher_share": "0.5"}
    return replace(carry_weights(cloned.agent, **careful), teacher=cloned.agent)  # type: ignore[arg-type]


def kickstart(problem: Problem, sources: Sequence[Trained]) -> Carry:
    """Weights of its own, drawn to what the clone would do."""
    *_, cloned = sources
    return Carry(teacher=cloned.agent)  # type: ignore[arg-type]


def residual(problem: Problem, sources: Sequence[Trained]) -> Carry:
    """Corrections, none at first, of what the table has the robot do."""
    from gridnav.agents import RESIDUAL_SHARE, ResidualAgent  # torch takes seconds to import

    (table,) = sources
    assert isinstance(table.agent, TabularAgent)
    action_values = table.agent.action_values

    def begin(agent: PPOAgent) -> PPOAgent:
        return ResidualAgent(agent.observation_space, agent.action_space, agent.config, action_values)

    def wrap(worlds: NavigationVectorEnv, agent: PPOAgent) -> Corrected:
        assert isinstance(agent, ResidualAgent)
        return Corrected(worlds, follow(agent.moves, worlds), RESIDUAL_SHARE)

    return Carry({"log_std_init": "-1"}, begin, wrap)


ARMS: dict[str, Arm] = {
    "scratch": Arm("PPO from scratch", "", (), scratch),
    "waypoint": Arm("Q-table", "the whole table, driven by grid moves", (TABLE,), None),
    "potential": Arm("PPO", "the table's values, as a potential", (TABLE,), potential),
    "clone": Arm("PPO", "how the table drives, learnt by heart", (TABLE, CLONE), clone),
    "kickstart": Arm("PPO", "how the table drives, as a teacher", (TABLE, CLONE), kickstart),
    "weights": Arm("PPO", "the Unicycle's network", (NETWORK,), weights),
    "residual": Arm("PPO on top of the Q-table", "how the table drives, to be corrected", (TABLE,), residual),
}
"""By name, in the order of the tables."""


def choose_arms(names: str) -> dict[str, Arm]:
    """Arms by their names.

    Args:
        names: Separated by commas.

    Raises:
        InputError: When one is unknown or named twice.
    """
    chosen: dict[str, Arm] = {}
    for name in names.split(","):
        if name not in ARMS:
            near = get_close_matches(name, ARMS, 1, cutoff=0.0)
            raise InputError(f"unknown arm {name!r:.60}: did you mean {near[0]}? The arms are {', '.join(ARMS)}")
        if name in chosen:
            raise InputError(f"arm {name} is named twice")
        chosen[name] = ARMS[name]
    return chosen


class Sources:
    """What the arms of a run build on: each is made once, when the first arm asks for it.

    Args:
        workshop: Trains them.
    """

    def __init__(self, workshop: Workshop) -> None:
        self._workshop = workshop
        self.made: dict[str, Trained] = {}
        """By name, in the order in which they were asked for."""

    def get(self, names: Sequence[str]) -> list[Trained]:
        """The sources of these names; one may build on those before it."""
        makers = {TABLE: self._table, NETWORK: self._network, CLONE: self._clone}
        for name in names:
            if name not in self.made:
                self.made[name] = makers[name]()
        return [self.made[name] for name in names]

    def _table(self) -> Trained:
        return self._workshop.train(TABLE, "q-learning", "GridWorld")

    def _network(self) -> Trained:
        return self._workshop.train(NETWORK, "ppo", EARLY)

    def _clone(self) -> Trained:
        from gridnav.agents import PPOAgent  # torch takes seconds to import
        from gridnav.agents import clone as learn_by_heart

        problem, seed = self._workshop.problem, self._workshop.seed
        (table,) = self.get([TABLE])
        changes = {"seed": str(seed), "log_std_init": "-1.5"}
        config = choose_config("ppo", Choice().preset_of("ppo", problem), changes)

        def make() -> tuple[Agent, int, dict[str, float]]:
            shown = demonstrate(
                problem, table.agent, EARLY, gamma=config.gamma, seed=seed, stack_size=config.stack_size
            )
            worlds = problem.worlds(EARLY, 1)
            agent = PPOAgent(worlds.single_observation_space, worlds.single_action_space, config)
            worlds.close()
            return agent, len(shown.actions), learn_by_heart(agent, shown)

        return self._workshop.keep(CLONE, EARLY, config, make)


# ---- The table's values as a function of places --------------------------------------------------


def cell_values(problem: Problem, agent: Agent) -> FloatArray:
    """What each cell is worth on the way to each goal, the reward's own shaping taken out; at the goal what it pays.

    Args:
        problem: Gives maze, goals and reward.
        agent: Values ``cell_goal`` observations.

    Returns:
        Shape ``(n_goals, n_rows, n_cols)``, in units of reward.
    """
    layout, goals = problem.layout, problem.task.goal_cells(problem.layout)
    table = agent.values(np.arange(layout.n_cells * len(goals))).reshape(layout.n_cells, len(goals))
    values: FloatArray = table.T.reshape(len(goals), *layout.walls.shape).copy()
    for number, (row, col) in enumerate(goals.tolist()):
        distance = cell_distances(layout, (row, col))
        values[number] += problem.reward.potential(np.where(np.isfinite(distance), distance, 0.0))
        values[number, row, col] = problem.reward.goal
    return values


def potential_of(worlds: NavigationVectorEnv, values: FloatArray) -> Callable[[AnyArray], FloatArray]:
    """A potential of observations: the values of the cells, interpolated.

    Args:
        worlds: Whose feature vectors are observed.
        values: Of each goal and cell, shape ``(n_goals, n_rows, n_cols)``.
    """
    place_value = CellPotential(worlds.layout, values)

    def of(observations: Any) -> FloatArray:
        poses, goals_w = worlds.features.poses_and_goals(observations)
        goals = worlds.layout.to_cell(goals_w)
        return place_value(poses, worlds.rank_of(goals))

    return of
