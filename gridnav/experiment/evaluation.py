"""Fixed-seed episodes to records: every policy, in every world, meets the same starts, goals and headings."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Discrete
from numpy.typing import NDArray

from gridnav.agents import Agent, OnProgress, Progress, TabularAgent
from gridnav.envs import Lidar, MoveDriver, NavigationVectorEnv
from gridnav.problem.metrics import Episode, Trace
from gridnav.problem.types import AnyArray

EVALUATION_SEED = 1_000_000
"""Seed of the evaluation episodes; no training uses it."""

Policy = Callable[[NDArray[Any]], NDArray[Any]]
"""Observations of all environments to their actions, a leading batch axis on both."""


def make_worlds(world: str, num_envs: int, **options: Any) -> NavigationVectorEnv:
    """The vector form of ``GridWorld``, ``Unicycle`` or ``DiffDrive``, with its usual time limit."""
    worlds = gym.make_vec(f"gridnav/{world}-v0", num_envs=num_envs, **options)
    assert isinstance(worlds, NavigationVectorEnv)
    return worlds


def policy_for(agent: Agent, worlds: NavigationVectorEnv) -> Policy:
    """The agent's own actions, or grid moves driven by it where it learnt on the grid and these are robots."""
    on_grid = isinstance(worlds.single_action_space, Discrete)
    return drive_by_moves(agent, worlds) if isinstance(agent, TabularAgent) and not on_grid else agent.act


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
    goals = worlds.goal_cells
    goal_rank = np.full((layout.n_rows, layout.n_cols), 0)
    goal_rank[tuple(goals.T)] = np.arange(len(goals))
    started = np.zeros(n, dtype=bool)

    def act(observations: NDArray[Any]) -> NDArray[Any]:
        poses, goals_w = worlds.features.poses_and_goals(observations)
        due = np.flatnonzero(driver.finished(poses) | ~started)
        if due.size:
            cells, goal_cells = layout.to_cell(poses[due, :2]), layout.to_cell(goals_w[due])
            number = cells[:, 0] * layout.n_cols + cells[:, 1]
            moves = agent.act(number * len(goals) + goal_rank[tuple(goal_cells.T)])
            driver.begin(due, poses[due], moves)
            started[due] = True
        return driver.commands(poses).astype(np.float32)

    return act


def evaluate(
    policy: Policy,
    worlds: NavigationVectorEnv,
    *,
    seed: int = EVALUATION_SEED,
    on_progress: OnProgress | None = None,
) -> list[Episode]:
    """The first episode of every environment under a policy.

    Args:
        policy: Chooses the actions.
        worlds: As many environments as episodes are wanted. They need a time limit.
        seed: Gives every environment its start, goal and heading, the same in every world.
        on_progress: Told how many episodes have ended; its steps are episodes.

    Returns:
        One record per environment, with its trace.
    """
    if worlds.max_episode_steps is None:
        raise ValueError("evaluation needs a time limit: set max_episode_steps")
    n = worlds.num_envs
    observations, info = worlds.reset(seed=seed)
    course = _Course(worlds)
    course.add_state(info)
    last: list[dict[str, Any]] = [{} for _ in range(n)]
    running = np.ones(n, dtype=bool)
    while running.any():
        actions = policy(observations)
        observations, rewards, terminated, truncated, info = worlds.step(actions)
        course.add_step(actions, rewards, info)
        for i in np.flatnonzero((terminated | truncated) & running):
            last[i] = {key: value[i] for key, value in info["final_info"].items() if isinstance(value, np.ndarray)}
            running[i] = False
        if on_progress and "final_info" in info:
            ended = n - int(running.sum())
            arrived = sum(bool(one["is_success"]) for one in last if one)
            on_progress(Progress(ended, n, {"success_rate": arrived / max(ended, 1)}))
    return [course.episode(i, last[i]) for i in range(n)]


class _Course:
    """What a batch of environments went through, until each one's first episode is cut out of it."""

    def __init__(self, worlds: NavigationVectorEnv) -> None:
        self._worlds = worlds
        self._lidar = Lidar(worlds.layout, worlds.robot)
        self._starts, self._goals = worlds._start.copy(), worlds._goal.copy()
        self._poses: list[AnyArray] = []
        self._scans: list[AnyArray] = []
        self._actions: list[AnyArray] = []
        self._rewards: list[AnyArray] = []
        self._hits: list[AnyArray] = []
        self._terms: list[dict[str, AnyArray]] = []

    def add_state(self, info: dict[str, Any]) -> None:
        self._poses.append(info["pose"])
        self._scans.append(self._lidar.scan(info["pose"]))

    def add_step(self, actions: AnyArray, rewards: AnyArray, info: dict[str, Any]) -> None:
        # Where an episode ended, the info is the next one's first: what led there is in final_info.
        reached = info.get("final_info", info)
        self._actions.append(actions.reshape(len(actions), -1))
        self._rewards.append(rewards)
        self._hits.append(reached["collision"])
        self._terms.append(reached["reward_terms"])
        self.add_state(reached)

    def episode(self, i: int, last: dict[str, Any]) -> Episode:
        seconds = float(last["elapsed_s"])
        step_s = self._worlds.step_s
        steps = round(seconds / step_s)
        names = self._terms[0]
        trace = Trace(
            time_s=np.arange(steps + 1) * step_s,
            poses=np.stack([poses[i] for poses in self._poses[: steps + 1]]),
            scans_m=np.stack([scans[i] for scans in self._scans[: steps + 1]]),
            actions=np.stack([actions[i] for actions in self._actions[:steps]]),
            reward_terms={name: np.array([terms[name][i] for terms in self._terms[:steps]]) for name in names},
            hits=np.array([hits[i] for hits in self._hits[:steps]], dtype=np.int64),
        )
        return Episode(
            start=(int(self._starts[i, 0]), int(self._starts[i, 1])),
            goal=(int(self._goals[i, 0]), int(self._goals[i, 1])),
            is_success=bool(last["is_success"]),
            collisions=int(last["collisions"]),
            path_length_m=float(last["path_length_m"]),
            shortest_path_m=float(last["shortest_path_m"]),
            elapsed_s=seconds,
            shortest_time_s=float(last["shortest_path_m"]) / self._worlds.robot.max_speed_m_s,
            steps=steps,
            episode_return=float(sum(rewards[i] for rewards in self._rewards[:steps])),
            physics_error=bool(last.get("physics_error", False)),
            trace=trace,
        )
