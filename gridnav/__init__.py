"""Robot navigation from a Q-table to a robot: one maze, one task and one reward in three worlds."""

from gridnav.problem.layout import Layout
from gridnav.problem.reward import Reward
from gridnav.problem.task import Task

try:
    import gridnav.envs as _envs  # registers the environments
except ModuleNotFoundError as error:
    if error.name != "gridnav.envs":
        raise
    raise ModuleNotFoundError(
        "gridnav is not installed: run 'python3 start.py setup' in its folder (or 'pip install -e .')",
        name="gridnav.envs",
    ) from None

__all__ = ["Layout", "Reward", "Task"]
__version__ = "0.1.0"

del _envs
