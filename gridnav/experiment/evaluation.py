"""Fixed-seed episodes to records: every policy, in every world, meets the same starts, goals and headings."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
from gymnasium.spaces import Discrete
from numpy.typing import NDArray

from gridnav.agents import Agent, OnProgress, Policy, Progress, TabularAgent
from gridnav.envs import MoveDriver, NavigationVectorEnv, glide, lead
from gridnav.experiment.worlds import Problem
from gridnav.problem.behaviour import diagnose
from gridnav.problem.geodesic import Geodesic
from gridnav.problem.layout import Layout
from gridnav.problem.metrics import Episode, Trace, driving_time, measure_motion
from gridnav.problem.types import AnyArray, Cell

EVALUATION_SEED = 1_000_000
"""Seed of the evaluation episodes; no training uses it."""

HELD_OUT_LAYOUTS = 100
"""Layouts of an evaluation in a family of layouts, if there are episodes enough."""


class PolicyStopped(Exception):  # noqa: N818, no error
    """A policy, a person for example, does not go on: the episodes end where they are."""


def policy_for(agent: Agent, worlds: NavigationVectorEnv) -> Policy:
    """The agent's own actions; grid moves driven by it where it learnt on the grid and these are robots; or both."""
    on_grid = isinstance(worlds.single_action_space, Discrete)
    if agent.kind == "residual":
        return _corrected(agent, worlds)
    return drive_by_moves(agent, worlds) if isinstance(agent, TabularAgent) and not on_grid else agent.begin()


def _corrected(agent: Agent, worlds: NavigationVectorEnv) -> Policy:
    """Commands of a residual agent's table, with the network's corrections."""
    from gridnav.agents import RESIDUAL_SHARE, ResidualAgent  # torch takes seconds to import

    assert isinstance(agent, ResidualAgent)
    commands, corrections = follow(agent.moves, worlds), agent.begin()
    return lambda observations: np.clip(
        commands(observations) + RESIDUAL_SHARE * corrections(observations), -1.0, 1.0
    ).astype(np.float32)


def drive_by_moves(agent: Agent, worlds: NavigationVectorEnv) -> Policy:
    """A policy that lets an agent of the grid drive robots, move by move, as ``GridMoves`` does for one.

    It looks at the feature vector alone: pose and goal say in which cell the robot is and where it should go.

    Args:
        agent: Acts on ``cell_goal`` observations.
        worlds: The robots it will drive.
    """
    layout, n = worlds.layout, worlds.num_envs
    period_s: float = worlds.control_period_s  # type: ignore[attr-defined]
    driver = MoveDriver(layout, worlds.robot, period_s, n)
    started = np.zeros(n, dtype=bool)

    def act(observations: NDArray[Any]) -> NDArray[Any]:
        poses, goals_w = worlds.features.poses_and_goals(observations)
        due = np.flatnonzero(driver.finished(poses) | ~started)
        if due.size:
            seen = worlds.cell_goal(layout.to_cell(poses[due, :2]), layout.to_cell(goals_w[due]))
            driver.begin(due, poses[due], agent.act(seen))
            started[due] = True
        return driver.commands(poses).astype(np.float32)

    return act


def follow(moves_for: Policy, worlds: NavigationVectorEnv) -> Policy:
    """A policy that drives robots by an agent's grid moves from the feature vector alone, without a memory.

    A network can learn such commands by heart, and corrections can be added to them, for they do not hang on when a
    move was begun; any number of robots may ask.

    Args:
        moves_for: Moves for ``cell_goal`` observations.
        worlds: Of the kind of robots it will drive.
    """
    layout, robot = worlds.layout, worlds.robot
    period_s: float = worlds.control_period_s  # type: ignore[attr-defined]

    def act(observations: NDArray[Any]) -> NDArray[Any]:
        poses, goals_w = worlds.features.poses_and_goals(observations)
        cells, goals = layout.to_cell(poses[:, :2]), layout.to_cell(goals_w)
        moves = moves_for(worlds.cell_goal(cells, goals))
        is_there = (cells == goals).all(axis=1, keepdims=True)  # a table knows no move in the goal's own cell
        targets = np.where(is_there, layout.to_metres(goals), lead(poses, moves, layout))
        return glide(poses, targets, robot, period_s).astype(np.float32)

    return act


def evaluate(
    policy: Policy,
    worlds: NavigationVectorEnv,
    *,
    seed: int = EVALUATION_SEED,
    on_progress: OnProgress | None = None,
    on_info: Callable[[dict[str, Any]], None] | None = None,
) -> list[Episode]:
    """The first episode of every environment under a policy.

    Args:
        policy: Chooses the actions, or raises ``PolicyStopped``.
        worlds: As many environments as episodes are wanted. They need a time limit.
        seed: Gives every environment its start, goal and heading, the same in every world.
        on_progress: Told how many episodes have ended; its steps are episodes.
        on_info: Given the info of the start and of what each step led to.

    Returns:
        One record per environment, with its trace; none where a policy stopped before it began.
    """
    if worlds.max_episode_steps is None:
        raise ValueError("evaluation needs a time limit: set max_episode_steps")
    n = worlds.num_envs
    observations, info = worlds.reset(seed=seed)
    course = _Course(worlds)
    course.add_state(info)
    if on_info:
        on_info(info)
    last: list[dict[str, Any]] = [{} for _ in range(n)]
    running = np.ones(n, dtype=bool)
    while running.any():
        try:
            actions = policy(observations)
        except PolicyStopped:
            if not course.n_steps:
                return []
            last = [last[i] if not running[i] else _of_one(info, i) for i in range(n)]
            break
        observations, rewards, terminated, truncated, info = worlds.step(actions)
        course.add_step(actions, rewards, info)
        # Where episodes go on by themselves, the info is the next one's first.
        reached = info.get("final_info", info)
        if on_info:
            on_info(reached)
        ended = np.flatnonzero((terminated | truncated) & running)
        for i in ended:
            last[i] = _of_one(reached, int(i))
        if ended.size:
            running[ended] = False
            worlds.park(~running)
        if on_progress and "final_info" in info:
            n_ended = n - int(running.sum())
            arrived = sum(bool(one["is_success"]) for one in last if one)
            on_progress(Progress(n_ended, n, {"success_rate": arrived / max(n_ended, 1)}))
    worlds.park(np.zeros(n, dtype=bool))
    return course.episodes(last)


def _of_one(info: dict[str, Any], i: int) -> dict[str, Any]:
    one = {key: value[i] for key, value in info.items() if isinstance(value, np.ndarray)}
    return one | {"randomization": {name: float(drawn[i]) for name, drawn in info.get("randomization", {}).items()}}


def evaluate_in(
    problem: Problem,
    agent: Agent,
    world: str,
    n_episodes: int,
    *,
    observation: str = "cell_goal",
    seed: int = EVALUATION_SEED,
    on_progress: OnProgress | None = None,
    worlds: Callable[[int, Layout], NavigationVectorEnv] | None = None,
) -> list[Episode]:
    """Fixed-seed episodes of an agent in a world, in as many held-out layouts as there can be where there is a family.

    Args:
        problem: What is to be solved.
        agent: Who acts; an agent of the grid drives robots by grid moves.
        world: Where.
        n_episodes: How many; with held-out layouts, rounded down to a multiple of those.
        observation: What an agent of the grid sees.
        seed: Of starts, goals and headings.
        on_progress: Told how many episodes have ended.
        worlds: Makes so many robots in a layout; by default those of the problem.
    """
    n_layouts = min(n_episodes, HELD_OUT_LAYOUTS) if problem.family else 1
    problem = problem.for_evaluation
    layouts = problem.family.held_out(n_layouts) if problem.family else [problem.layout]
    per_layout = n_episodes // n_layouts
    episodes: list[Episode] = []
    for number, layout in enumerate(layouts):
        if worlds is None:
            robots = problem.worlds(world, per_layout, observation=observation, layout=layout)
        else:
            robots = worlds(per_layout, layout)
        inner = on_progress if n_layouts == 1 else None
        episodes += evaluate(policy_for(agent, robots), robots, seed=seed + number, on_progress=inner)
        robots.close()
        if on_progress and n_layouts > 1:
            success = float(np.mean([episode.is_success for episode in episodes]))
            on_progress(Progress(len(episodes), n_layouts * per_layout, {"success_rate": success}))
    return episodes


class _Course:
    """What a batch of environments went through, until each one's first episode is cut out of it."""

    def __init__(self, worlds: NavigationVectorEnv) -> None:
        self._worlds = worlds
        self._on_grid = isinstance(worlds.single_action_space, Discrete)
        self._ends = [worlds.start_and_goal(i) for i in range(worlds.num_envs)]
        self._poses: list[AnyArray] = []
        self._scans: list[AnyArray] = []
        self._actions: list[AnyArray] = []
        self._rewards: list[AnyArray] = []
        self._hits: list[AnyArray] = []
        self._terms: list[dict[str, AnyArray]] = []

    @property
    def n_steps(self) -> int:
        return len(self._actions)

    def add_state(self, info: dict[str, Any]) -> None:
        self._poses.append(info["pose"])
        self._scans.append(self._worlds.scan(info["pose"]))

    def add_step(self, actions: AnyArray, rewards: AnyArray, info: dict[str, Any]) -> None:
        # Where an episode ended, the info is the next one's first: what led there is in final_info.
        reached = info.get("final_info", info)
        self._actions.append(actions.reshape(len(actions), -1))
        self._rewards.append(rewards)
        self._hits.append(reached["collision"])
        self._terms.append(reached["reward_terms"])
        self.add_state(reached)

    def episodes(self, last: list[dict[str, Any]]) -> list[Episode]:
        """One record per environment, given the info in which its first episode ended."""
        poses, scans, actions = (np.stack(part, axis=1) for part in (self._poses, self._scans, self._actions))
        rewards, hits = np.stack(self._rewards, axis=1), np.stack(self._hits, axis=1).astype(np.int64)
        terms = {name: np.stack([one[name] for one in self._terms], axis=1) for name in self._terms[0]}
        step_s = self._worlds.step_s
        times = np.arange(poses.shape[1]) * step_s
        records = []
        for i, info in enumerate(last):
            n = round(float(info["elapsed_s"]) / step_s)
            # Copies: a record should not keep the whole batch in memory.
            trace = Trace(
                time_s=times[: n + 1],
                poses=poses[i, : n + 1].copy(),
                scans_m=scans[i, : n + 1].copy(),
                actions=actions[i, :n].copy(),
                reward_terms={name: shares[i, :n].copy() for name, shares in terms.items()},
                hits=hits[i, :n].copy(),
            )
            records.append(self._episode(i, info, trace, float(rewards[i, :n].sum())))
        return records

    def _episode(self, i: int, info: dict[str, Any], trace: Trace, episode_return: float) -> Episode:
        layout, robot = self._worlds.layout, self._worlds.robot
        start, goal = self._ends[i]
        return Episode(
            start=start,
            goal=goal,
            is_success=bool(info["is_success"]),
            collisions=int(info["collisions"]),
            path_length_m=float(info["path_length_m"]),
            shortest_path_m=float(info["shortest_path_m"]),
            elapsed_s=float(info["elapsed_s"]),
            shortest_time_s=self._shortest_time(float(info["shortest_path_m"]), goal, trace),
            steps=len(trace.actions),
            episode_return=episode_return,
            physics_error=bool(info.get("physics_error", False)),
            trace=trace,
            goal_radius_m=0.0 if self._on_grid else self._worlds.task.goal_radius_m,
            motion=measure_motion(trace, layout, robot),
            behaviours=diagnose(trace, goal_w=layout.to_metres(np.array(goal)), layout=layout, robot=robot),
            layout=layout.name,
            randomization=info["randomization"],
        )

    def _shortest_time(self, shortest_path_m: float, goal: Cell, trace: Trace) -> float:
        """A cell-time for each move on the grid; for a robot, turns and straight legs to the edge of the goal."""
        robot = self._worlds.robot
        if self._on_grid:
            return shortest_path_m / robot.max_speed_m_s
        x, y, heading = trace.poses[0]
        path = self._geodesic.path(np.array([x, y]), goal)
        return driving_time(path, heading, robot, self._worlds.task.goal_radius_m)

    @cached_property
    def _geodesic(self) -> Geodesic:
        return Geodesic(self._worlds.layout, self._worlds.robot.radius_m)
