"""The learners: value iteration, tabular Q-learning, PPO.

Only the tabular agents are imported here: PPO brings torch, which takes seconds; import it from ``gridnav.agents.ppo``.
"""

from gridnav.agents.base import Agent, Progress
from gridnav.agents.planner import Planner
from gridnav.agents.q_learning import QLearning, QLearningConfig

__all__ = ["Agent", "Planner", "Progress", "QLearning", "QLearningConfig"]
