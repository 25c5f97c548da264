"""Cloning: a network learns by heart what somebody else does, before it learns from its own experience."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from gridnav.problem.types import FloatArray

from .ppo import PPOAgent
from .torch_state import guard_gradients

EPOCHS = 30
"""Passes over the demonstrations."""
BATCH_SIZE = 512
LEARNING_RATE = 2e-3
"""Adam's step size at the beginning; it falls linearly to a hundredth."""


@dataclass(frozen=True)
class Demonstrations:
    """What somebody did and what it earned, ``n`` steps in any order."""

    observations: NDArray[np.float32]
    """Shape ``(n, n_numbers)``."""
    actions: NDArray[np.float32]
    """What was done, shape ``(n, n_actions)``."""
    returns: FloatArray
    """Discounted rewards from each step to the end of its episode, shape ``(n,)``; NaN where that was not seen."""


def clone(agent: PPOAgent, demonstrations: Demonstrations) -> dict[str, float]:
    """Fit a policy's mean to demonstrated actions and its value network to their returns, by least squares.

    The exploration stays as it was: demonstrations say what is right, not how sure of it one may be.

    Args:
        agent: Changes in place; its seed orders the batches.
        demonstrations: By somebody with the same spaces.

    Returns:
        ``action_error``, the root mean square error of the actions, and ``explained_returns``, the share of the
        returns' variance that the values explain; both in the last pass.

    Raises:
        NonFiniteError: When a NaN or infinity came up, before it reached the weights.
    """
    policy, rng = agent.policy, np.random.default_rng(agent.config.seed)
    observations, actions = torch.from_numpy(demonstrations.observations), torch.from_numpy(demonstrations.actions)
    returns = torch.from_numpy(demonstrations.returns.astype(np.float32) * agent.config.reward_scale)
    optimizer = torch.optim.Adam(policy.parameters(), lr=LEARNING_RATE, fused=True)
    guard_gradients(optimizer, lambda: 0)
    n_batches = max(1, len(actions) // BATCH_SIZE)
    policy.set_training_mode(True)
    for epoch in range(EPOCHS):
        for group in optimizer.param_groups:
            group["lr"] = LEARNING_RATE * (1.0 - 0.99 * epoch / EPOCHS)
        errors = []
        for batch in np.array_split(rng.permutation(len(actions)), n_batches):
            of_policy, of_critic = policy.mlp_extractor(policy.extract_features(observations[batch]))
            action_loss = (policy.action_net(of_policy) - actions[batch]).square().mean()
            value_errors = policy.value_net(of_critic).squeeze(1) - returns[batch]
            value_loss = torch.where(torch.isfinite(returns[batch]), value_errors, 0.0).square().mean()
            optimizer.zero_grad()
            (action_loss + value_loss).backward()  # they share no weight, and Adam knows no scale
            optimizer.step()
            errors.append((action_loss.item(), value_loss.item()))
    policy.set_training_mode(False)
    of_actions, of_values = np.mean(errors, axis=0)
    explained = 1.0 - of_values / max(float(np.nanvar(returns.numpy())), 1e-12)
    return {"action_error": float(np.sqrt(of_actions)), "explained_returns": float(explained)}
