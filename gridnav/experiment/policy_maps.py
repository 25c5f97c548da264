"""What an agent makes of a maze: the value of each cell and where its policy heads, for each goal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.spaces import Discrete

from gridnav.agents import Agent, TabularAgent
from gridnav.display.policy_map import PolicyMap, best_moves, command_motion
from gridnav.envs import NavigationVectorEnv
from gridnav.experiment.evaluation import policy_for
from gridnav.experiment.worlds import Problem
from gridnav.problem.geodesic import cell_distances
from gridnav.problem.layout import Layout
from gridnav.problem.types import AnyArray, Cell, FloatArray

if TYPE_CHECKING:
    from gridnav.agents import DQNAgent

N_HEADINGS = 8
"""Headings at which a robot's network is asked in each cell."""


def policy_maps(
    problem: Problem, agent: Agent, world: str, goals: Sequence[Cell], *, observation: str = "cell_goal"
) -> dict[Cell, PolicyMap]:
    """A map for each goal.

    Args:
        problem: Gives the maze, the goals of the task and the shaping.
        agent: Whose values and policy.
        world: Where it learnt, and so what it observes.
        goals: Of the task's goals.
        observation: What an agent of the grid sees.
    """
    worlds = problem.worlds(world, 1, observation=observation)
    try:
        if isinstance(worlds.single_action_space, Discrete):
            return {goal: _map_of_moves(problem, agent, worlds, goal, observation) for goal in goals}
        return {goal: _map_of_commands(agent, worlds, goal) for goal in goals}
    finally:
        worlds.close()


def _map_of_moves(
    problem: Problem, agent: Agent, worlds: NavigationVectorEnv, goal: Cell, observation: str
) -> PolicyMap:
    """The best move and what it is worth, without the shaping, so that values grow towards the goal."""
    layout = problem.layout
    rank = int(problem.task.goal_ranks(layout)[goal])
    moves = _move_values(agent, worlds, layout, rank, goal, observation)
    distance = cell_distances(layout, goal).ravel()
    best, directions = best_moves(moves)
    values = best + problem.reward.potential(np.where(np.isfinite(distance), distance, 0.0))
    shape = layout.walls.shape
    return PolicyMap(values.reshape(shape), directions.reshape(shape), np.ones(shape))


def _move_values(
    agent: Agent, worlds: NavigationVectorEnv, layout: Layout, rank: int, goal: Cell, observation: str
) -> FloatArray:
    """Values of the four moves in each cell for the goal of that rank in the task, shape ``(n_cells, 4)``."""
    numbers, n_goals = np.arange(layout.n_cells), len(worlds.goal_cells)
    if isinstance(agent, TabularAgent):
        table = agent.action_values
        return table if observation == "cell" else table.reshape(layout.n_cells, n_goals, 4)[:, rank]
    if TYPE_CHECKING:
        assert isinstance(agent, DQNAgent)
    if observation == "features":
        cells = np.stack(np.divmod(numbers, layout.n_cols), axis=1)
        return agent.action_values(_features(worlds, layout.to_metres(cells), 0.0, goal))
    return agent.action_values(numbers if observation == "cell" else numbers * n_goals + rank)


def _map_of_commands(agent: Agent, worlds: NavigationVectorEnv, goal: Cell) -> PolicyMap:
    """Mean value of a robot at rest over its headings, and where it drives from the heading that it values most."""
    layout = worlds.layout
    cells = np.argwhere(~layout.walls)
    headings = np.arange(N_HEADINGS) * 2 * np.pi / N_HEADINGS
    observations = [_features(worlds, layout.to_metres(cells), heading, goal) for heading in headings]
    values = np.stack([agent.values(one) for one in observations])
    commands = [policy_for(agent, worlds)(one) for one in observations]  # each a beginning, of which nobody remembers
    ways, speeds = zip(*map(command_motion, commands, headings), strict=True)
    best = values.argmax(axis=0), np.arange(len(cells))

    def whole(numbers: AnyArray) -> FloatArray:
        array = np.full(layout.walls.shape, np.nan)
        array[tuple(cells.T)] = numbers
        return array

    return PolicyMap(whole(values.mean(axis=0)), whole(np.stack(ways)[best]), whole(np.stack(speeds)[best]))


def _features(worlds: NavigationVectorEnv, points_w: FloatArray, heading_rad: float, goal: Cell) -> Any:
    """What robots at rest at these points observe."""
    poses = np.column_stack([points_w, np.full(len(points_w), heading_rad)])
    goals = np.broadcast_to(worlds.layout.to_metres(np.array(goal)), (len(poses), 2))
    still = np.zeros((len(poses), 2))
    return worlds.features.observe(poses, worlds.scan(poses), goals, still, still)
