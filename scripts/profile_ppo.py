"""Where PPO's wall-clock goes on DiffDrive; run it with nothing else running.

python scripts/profile_ppo.py [--steps 131072] [--rounds 3] [--world DiffDrive] [--torch-threads 1]

Every round trains a fresh agent with the default settings and times the calls below from outside; they nest as the
table shows. "Network arithmetic" is what torch works out: the policy's forward passes, the losses' backward passes,
clipping and Adam. What is left is bookkeeping: sampling, buffers, advantages, infos.
"""

import argparse
import json
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import wraps
from pathlib import Path
from statistics import median
from typing import Any

import torch
from mujoco.batch import Batch
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy

from gridnav.agents import PPOAgent, PPOConfig
from gridnav.envs import NavigationVectorEnv
from gridnav.experiment.worlds import Problem

# What is timed: the name in the table, its owner, and the method.
TIMED: list[tuple[str, Any, str]] = [
    ("collecting", PPO, "collect_rollouts"),
    ("environment", NavigationVectorEnv, "step"),
    ("physics", Batch, "step"),
    ("policy inference", ActorCriticPolicy, "forward"),
    ("updating", PPO, "train"),
    ("losses forward", ActorCriticPolicy, "evaluate_actions"),
    ("losses backward", torch.Tensor, "backward"),
    ("clipping", torch.nn.utils, "clip_grad_norm_"),
    ("Adam", torch.optim.Adam, "step"),
]
NETWORK = ("policy inference", "losses forward", "losses backward", "clipping", "Adam")


@contextmanager
def timed(owner: Any, method: str, seconds: dict[str, float], name: str) -> Iterator[None]:
    """Add up how long a method takes."""
    plain = getattr(owner, method)

    @wraps(plain)
    def stopwatch(*args: Any, **kwargs: Any) -> Any:
        began = time.perf_counter()
        try:
            return plain(*args, **kwargs)
        finally:
            seconds[name] += time.perf_counter() - began

    setattr(owner, method, stopwatch)
    try:
        yield
    finally:
        setattr(owner, method, plain)


def profile(world: str, steps: int, seed: int, torch_threads: int) -> dict[str, float]:
    """Seconds of each part of one training, and of the whole."""
    config = PPOConfig(seed=seed)
    worlds = Problem.load("classic", "default", "default").worlds(world, config.num_envs)
    agent = PPOAgent(worlds.single_observation_space, worlds.single_action_space, config)
    torch.set_num_threads(torch_threads)
    agent.learn(worlds, steps=config.num_envs * config.n_steps)  # compiles and warms up
    seconds: dict[str, float] = defaultdict(float)
    with ExitStack() as stack:
        for name, owner, method in TIMED:
            stack.enter_context(timed(owner, method, seconds, name))
        began = time.perf_counter()
        agent.learn(worlds, steps=steps)
        seconds["whole"] = time.perf_counter() - began
    worlds.close()
    seconds["network arithmetic"] = sum(seconds[name] for name in NETWORK)
    seconds["physics and network"] = seconds["physics"] + seconds["network arithmetic"]
    return dict(seconds)


def main() -> None:
    """Print shares of the wall-clock, medians over the rounds with their range."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=131_072)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--world", choices=("DiffDrive", "Unicycle"), default="DiffDrive")
    parser.add_argument("--torch-threads", type=int, default=1)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()

    rounds = [profile(given.world, given.steps, seed, given.torch_threads) for seed in range(given.rounds)]
    rates = [given.steps / one["whole"] for one in rounds]
    print(f"{median(rates):,.0f} steps/s ({min(rates):,.0f} to {max(rates):,.0f}), {given.world}")
    for name in [*(name for name, _, _ in TIMED), "network arithmetic", "physics and network"]:
        shares = [one.get(name, 0.0) / one["whole"] for one in rounds]
        print(f"{name:20} {median(shares):6.1%}  ({min(shares):.1%} to {max(shares):.1%})")
    if given.json:
        given.json.write_text(json.dumps({"steps": given.steps, "world": given.world, "rounds": rounds}, indent=1))


if __name__ == "__main__":
    main()
