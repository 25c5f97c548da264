"""Runs and rollouts as matplotlib figures, which the caller saves or puts into a report.

Each function returns a ``matplotlib.figure.Figure`` of its own: nothing here touches pyplot, a display or global
state. What a colour says is also said by a line style, a mark or a word.
"""

from gridnav.display.curves import (
    Curve,
    comparison,
    kept_success,
    learning_curves,
    reward_terms,
    success_bars,
)
from gridnav.display.mazes import (
    episode_strip,
    trajectories,
    value_map,
    visit_counts,
)
from gridnav.display.policy_map import command_motion
from gridnav.display.style import STYLE, save_figure, svg_text

__all__ = [
    "STYLE",
    "Curve",
    "command_motion",
    "comparison",
    "episode_strip",
    "kept_success",
    "learning_curves",
    "reward_terms",
    "save_figure",
    "success_bars",
    "svg_text",
    "trajectories",
    "value_map",
    "visit_counts",
]
