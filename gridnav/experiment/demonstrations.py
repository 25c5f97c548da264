"""Demonstrations: what a table of the grid has robots do, with what it earned, for a network to learn by heart."""

from __future__ import annotations

import numpy as np

from gridnav.agents import Agent, Demonstrations, FrameStack
from gridnav.experiment.evaluation import follow
from gridnav.experiment.worlds import Problem
from gridnav.problem.types import BoolArray, FloatArray

ROBOTS = 256
STEPS = 400
"""Of each robot: two or three episodes of ``classic``, of which the last one is not seen to its end."""
EXPLORING_STARTS = 0.5
NOISE = 0.3
"""Standard deviation of what is added to the commands, as a fraction of full speed: so the robots get to where a
network that is not quite right will lead them, and the way back is demonstrated (DART, Laskey et al. 2017)."""


def demonstrate(
    problem: Problem, agent: Agent, world: str, *, gamma: float, seed: int, steps: int = STEPS, stack_size: int = 1
) -> Demonstrations:
    """Let an agent of the grid drive, badly shaken, and note what it would have done.

    Args:
        problem: What is to be solved.
        agent: Acts on ``cell_goal`` observations.
        world: ``Unicycle`` or ``DiffDrive``: where, and whose environment steps it costs, ``ROBOTS`` times ``steps``.
        gamma: Discount per step of the returns.
        seed: Of episodes and noise.
        steps: Of each robot.
        stack_size: Observations that who learns from it sees at once.
    """
    worlds = problem.for_evaluation.training_worlds(world, ROBOTS, exploring_starts=EXPLORING_STARTS)
    commands = follow(agent.act, worlds)  # type: ignore[arg-type]
    episodes, noise = np.random.SeedSequence([seed, ROBOTS]).spawn(2)
    rng = np.random.default_rng(noise)
    observations, _ = worlds.reset(seed=int(episodes.generate_state(1)[0]))
    stack = FrameStack(stack_size)
    stack.begin(observations)
    seen, done, rewards, ends = [], [], [], []
    for _ in range(steps):
        seen.append(stack.seen)
        done.append(commands(observations))
        # Shaking: normal, the same law for forward and turning commands.
        shaken = np.clip(done[-1] + NOISE * rng.standard_normal(done[-1].shape), -1.0, 1.0)
        observations, reward, terminated, truncated, _ = worlds.step(shaken.astype(np.float32))
        stack.push(observations, terminated | truncated)
        rewards.append(reward)
        ends.append(np.where(terminated, 1, np.where(truncated, 2, 0)))
    worlds.close()
    returns = discounted_returns(np.stack(rewards), np.stack(ends) == 1, np.stack(ends) == 2, gamma)
    return Demonstrations(np.concatenate(seen), np.concatenate(done), returns.ravel())


def discounted_returns(rewards: FloatArray, terminated: BoolArray, truncated: BoolArray, gamma: float) -> FloatArray:
    """Discounted rewards from each step to its episode's end.

    Args:
        rewards: Of ``t`` steps of ``n`` robots, shape ``(t, n)``.
        terminated: The step ended the task, shape ``(t, n)``.
        truncated: The step ended the episode's time, shape ``(t, n)``.
        gamma: Discount per step.

    Returns:
        Shape ``(t, n)``; NaN for episodes whose task was not seen to its end.
    """
    returns = np.empty_like(rewards)
    ahead = np.full(rewards.shape[1], np.nan)
    for t in reversed(range(len(rewards))):
        ahead = np.where(terminated[t], 0.0, np.where(truncated[t], np.nan, ahead))
        ahead = rewards[t] + gamma * ahead
        returns[t] = ahead
    return returns
