"""The learners: value iteration, tabular Q-learning, DQN, PPO."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .base import Agent, EpisodeWindow, OnCut, OnProgress, Progress, read_state, write_state
from .hyper_parameters import EpsilonGreedyConfig
from .planner import Planner
from .q_learning import Q_LEARNING_PRESETS, QLearning, QLearningConfig
from .tabular import TabularAgent

if TYPE_CHECKING:
    from .dqn import DQN_PRESETS, DQNAgent, DQNConfig
    from .ppo import PPO_PRESETS, PPOAgent, PPOConfig

__all__ = [
    "DQN_PRESETS",
    "PPO_PRESETS",
    "Q_LEARNING_PRESETS",
    "Agent",
    "DQNAgent",
    "DQNConfig",
    "EpisodeWindow",
    "EpsilonGreedyConfig",
    "OnCut",
    "OnProgress",
    "PPOAgent",
    "PPOConfig",
    "Planner",
    "Progress",
    "QLearning",
    "QLearningConfig",
    "TabularAgent",
    "read_state",
    "write_state",
]


def __getattr__(name: str) -> Any:
    """What needs torch on first use: it takes seconds to import."""
    for prefix, module in (("DQN", "dqn"), ("PPO", "ppo")):
        if name.startswith(prefix) and name in __all__:
            return getattr(import_module(f".{module}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
