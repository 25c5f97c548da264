"""The learners: value iteration, tabular Q-learning, PPO."""

from typing import TYPE_CHECKING, Any

from .base import Agent, OnProgress, Progress
from .planner import Planner
from .q_learning import QLearning, QLearningConfig
from .tabular import TabularAgent

if TYPE_CHECKING:
    from .ppo import PPOAgent, PPOConfig

__all__ = [
    "Agent",
    "OnProgress",
    "PPOAgent",
    "PPOConfig",
    "Planner",
    "Progress",
    "QLearning",
    "QLearningConfig",
    "TabularAgent",
]


def __getattr__(name: str) -> Any:
    """PPO on first use: it brings torch, which takes seconds to import."""
    if name in ("PPOAgent", "PPOConfig"):
        from . import ppo

        return getattr(ppo, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
