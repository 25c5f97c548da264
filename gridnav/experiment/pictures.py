"""The figures of a run: how it learnt, where it went, what it makes of the maze."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.spaces import Discrete

from gridnav.agents import Agent, TabularAgent
from gridnav.display.figures import (
    command_motion,
    episode_strip,
    learning_curves,
    reward_terms,
    save_figure,
    success_bars,
    trajectories,
    value_map,
    visit_counts,
)
from gridnav.display.report import Picture
from gridnav.envs import NavigationVectorEnv
from gridnav.experiment.run_directory import MetricsLog, RunDirectory
from gridnav.experiment.training import Result, Trained
from gridnav.experiment.worlds import Problem
from gridnav.problem.geodesic import cell_distances
from gridnav.problem.layout import Layout
from gridnav.problem.types import Cell, FloatArray

if TYPE_CHECKING:
    from gridnav.agents import DQNAgent

DRAWN_EPISODES = 40
"""Ways drawn per panel: more would hide each other and swell the page."""
N_HEADINGS = 8
"""Headings at which a robot's network is asked in each cell."""


def pictures(
    run: RunDirectory,
    problem: Problem,
    results: Sequence[Result],
    trained: Sequence[Trained],
    curves: Mapping[str, str],
    log: MetricsLog,
) -> list[Picture]:
    """The figures of a run, each also as a PNG file.

    Args:
        run: Where the files go.
        problem: Gives the maze.
        results: One panel of trajectories and one row of intervals each; an episode of the last is told in steps.
        trained: Agents whose values, moves and visits are drawn.
        curves: Series of the metrics to draw the success rate of, with their labels.
        log: The metrics.
    """
    shown = dict(_drawn(problem, results, trained, curves, log))
    for name, picture in shown.items():
        save_figure(picture.figure, run.figures / f"{name}.png")
    return list(shown.values())


def _drawn(
    problem: Problem,
    results: Sequence[Result],
    trained: Sequence[Trained],
    curves: Mapping[str, str],
    log: MetricsLog,
) -> Iterator[tuple[str, Picture]]:
    layout = problem.layout
    series = {label: log.curve(name, "success_rate") for name, label in curves.items()}
    series = {label: curve for label, curve in series.items() if len(curve[0]) > 1}
    if series:
        figure = learning_curves({label: (np.array(x), np.array(y)) for label, (x, y) in series.items()}, window=3)
        words = "Success rate over the last 400 training episodes, exploration included, against environment steps."
        yield "learning", Picture(figure, words)
    if len(results) > 1:
        rows = {r.name: (r.summary.success_rate, *r.summary.success_interval) for r in results}
        yield "success", Picture(success_bars(rows), "Success in evaluation, with 95 % Wilson intervals.")
    here = {
        f"{result.agent} on {result.world}": [e for e in result.episodes if e.layout == layout.name]
        for result in results
    }
    drawn = {name: episodes[:DRAWN_EPISODES] for name, episodes in here.items()}
    n_drawn = max(len(episodes) for episodes in drawn.values())
    words = f"The ways of the first {n_drawn} evaluation episodes on {layout.name}, the same "
    yield "trajectories", Picture(trajectories(layout, drawn), words + "starts and goals in every panel.")
    for one in trained:
        suffix = f"-{one.name}" if len(trained) > 1 else ""
        yield f"values{suffix}", _values(problem, one)
        if one.visits is not None:
            words = f"Where {one.name} was in training, looked at each time it could have been cut."
            yield f"visits{suffix}", Picture(visit_counts(layout, one.visits), words)
    told, candidates = results[-1], list(here.values())[-1]
    episode = next((one for one in candidates if one.is_success), candidates[0])
    words = f"One evaluation episode of {told.agent} on {told.world}, step by step."
    yield "episode", Picture(episode_strip(layout, episode), words)
    yield "reward", Picture(reward_terms(episode), "What each term of the reward came to in that episode.")


def _values(problem: Problem, trained: Trained) -> Picture:
    """What an agent makes of the maze, for the last goal of the task."""
    layout, goals = problem.layout, problem.task.goal_cells(problem.layout)
    goal = (int(goals[-1, 0]), int(goals[-1, 1]))
    worlds = problem.worlds(trained.world, 1, observation=trained.observation)
    try:
        if isinstance(worlds.single_action_space, Discrete):
            moves = _move_values(trained.agent, worlds, layout, len(goals), goal, trained.observation)
            # The shaping moves values by the distance; without it they grow towards the goal, as a reader expects.
            distance = cell_distances(layout, goal).ravel()
            moves = moves + problem.reward.potential(np.where(np.isfinite(distance), distance, 0.0))[:, None]
            words = f"Values and preferred moves of {trained.name} for the goal at cell {goal}, the shaping taken out."
            return Picture(value_map(layout, moves, goal), words)
        values, directions, speeds = _network_values(trained.agent, worlds, goal)
    finally:
        worlds.close()
    figure = value_map(
        layout, values, goal, directions_rad=directions, speeds=speeds,
        label="value (discounted reward)", arrow_label="where it drives from its best heading",
    )  # fmt: skip
    words = (
        f"What {trained.name}'s value network expects in each cell at rest, mean of {N_HEADINGS} headings, for the "
        f"goal at cell {goal}, and the way its command takes it in a second."
    )
    return Picture(figure, words)


def _move_values(
    agent: Agent, worlds: NavigationVectorEnv, layout: Layout, n_goals: int, goal: Cell, observation: str
) -> FloatArray:
    """Values of the four moves in each cell, shape ``(n_cells, 4)``; the goal is the last of the task."""
    numbers = np.arange(layout.n_cells)
    if isinstance(agent, TabularAgent):
        table = agent.action_values
        return table if observation == "cell" else table.reshape(layout.n_cells, n_goals, 4)[:, -1]
    if TYPE_CHECKING:
        assert isinstance(agent, DQNAgent)
    if observation == "features":
        cells = np.stack(np.divmod(numbers, layout.n_cols), axis=1)
        return agent.action_values(_features(worlds, layout.to_metres(cells), 0.0, goal))
    return agent.action_values(numbers if observation == "cell" else numbers * n_goals + n_goals - 1)


def _network_values(agent: Agent, worlds: NavigationVectorEnv, goal: Cell) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Values, directions and speeds of a robot's network in each free cell, shape ``(n_rows, n_cols)`` each."""
    layout = worlds.layout
    cells = np.argwhere(~layout.walls)
    headings = np.arange(N_HEADINGS) * 2 * np.pi / N_HEADINGS
    observations = [_features(worlds, layout.to_metres(cells), heading, goal) for heading in headings]
    values = np.stack([agent.values(one) for one in observations])
    ways, speeds = zip(
        *(command_motion(agent.act(one), heading) for one, heading in zip(observations, headings, strict=True)),
        strict=True,
    )
    best = values.argmax(axis=0), np.arange(len(cells))
    maps = []
    for numbers in (values.mean(axis=0), np.stack(ways)[best], np.stack(speeds)[best]):
        whole = np.full(layout.walls.shape, np.nan)
        whole[tuple(cells.T)] = numbers
        maps.append(whole)
    return maps[0], maps[1], maps[2]


def _features(worlds: NavigationVectorEnv, points_w: FloatArray, heading_rad: float, goal: Cell) -> Any:
    """What robots at rest at these points observe."""
    poses = np.column_stack([points_w, np.full(len(points_w), heading_rad)])
    goals = np.broadcast_to(worlds.layout.to_metres(np.array(goal)), (len(poses), 2))
    still = np.zeros((len(poses), 2))
    return worlds.features.observe(poses, worlds.scan(poses), goals, still, still)
