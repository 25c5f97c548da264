"""The learners: value iteration, tabular Q-learning, DQN, PPO."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .base import Agent, EpisodeWindow, FrameStack, OnCut, OnProgress, Policy, Progress, read_state, write_state
from .hyper_parameters import EpsilonGreedyConfig
from .planner import Planner
from .q_learning import Q_LEARNING_PRESETS, QLearning, QLearningConfig
from .tabular import TabularAgent

if TYPE_CHECKING:
    from .cloning import Demonstrations, clone
    from .dqn import DQN_PRESETS, DQNAgent, DQNConfig
    from .ppo import PPO_PRESETS, PPOAgent, PPOConfig
    from .residual import RESIDUAL_SHARE, ResidualAgent

__all__ = [
    "DQN_PRESETS",
    "PPO_PRESETS",
    "Q_LEARNING_PRESETS",
    "RESIDUAL_SHARE",
    "Agent",
    "DQNAgent",
    "DQNConfig",
    "Demonstrations",
    "EpisodeWindow",
    "EpsilonGreedyConfig",
    "FrameStack",
    "OnCut",
    "OnProgress",
    "PPOAgent",
    "PPOConfig",
    "Planner",
    "Policy",
    "Progress",
    "QLearning",
    "QLearningConfig",
    "ResidualAgent",
    "TabularAgent",
    "clone",
    "read_state",
    "write_state",
]


_WITH_TORCH = {
    "cloning": ("Demonstrations", "clone"),
    "dqn": ("DQN_PRESETS", "DQNAgent", "DQNConfig"),
    "ppo": ("PPO_PRESETS", "PPOAgent", "PPOConfig"),
    "residual": ("RESIDUAL_SHARE", "ResidualAgent"),
}


def __getattr__(name: str) -> Any:
    """What needs torch on first use: it takes seconds to import."""
    for module, names in _WITH_TORCH.items():
        if name in names:
            return getattr(import_module(f".{module}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
