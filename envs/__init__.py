"""The worlds: grid, kinematic robot, MuJoCo robot. Importing this registers their ids with Gymnasium."""

import gymnasium as gym

from .carried import Corrected, PotentialShaping, WrappedWorlds
from .diff_drive import DiffDriveEnv, DiffDriveVectorEnv
from .gl import BACK_ENDS as GL_BACK_ENDS
from .gl import RenderingError, make_renderer
from .gl import works as gl_works
from .grid_moves import GridMoves, MoveDriver, glide, lead
from .grid_world import GridWorldEnv, GridWorldVectorEnv
from .layout_mix import LayoutMix
from .lidar import scan
from .mjcf import build_model, build_spec
from .navigation import NavigationVectorEnv
from .observation import FeatureVector
from .randomization import PARAMETERS, Randomization, Range
from .randomization import PRESETS as RANDOMIZATION_PRESETS
from .single import NavigationEnv
from .unicycle import UnicycleEnv, UnicycleVectorEnv

__all__ = [
    "GL_BACK_ENDS",
    "PARAMETERS",
    "RANDOMIZATION_PRESETS",
    "Corrected",
    "DiffDriveEnv",
    "DiffDriveVectorEnv",
    "FeatureVector",
    "GridMoves",
    "GridWorldEnv",
    "GridWorldVectorEnv",
    "LayoutMix",
    "MoveDriver",
    "NavigationEnv",
    "NavigationVectorEnv",
    "PotentialShaping",
    "Randomization",
    "Range",
    "RenderingError",
    "UnicycleEnv",
    "UnicycleVectorEnv",
    "WrappedWorlds",
    "build_model",
    "build_spec",
    "gl_works",
    "glide",
    "lead",
    "make_renderer",
    "scan",
]

MAX_EPISODE_STEPS = {"GridWorld": 100, "Unicycle": 500, "DiffDrive": 500}
"""The time limit of each world: 100 moves, or 100 s of driving."""

for _world, _file in (("GridWorld", "grid_world"), ("Unicycle", "unicycle"), ("DiffDrive", "diff_drive")):
    gym.register(
        id=f"gridnav/{_world}-v0",
        entry_point=f"gridnav.envs.{_file}:{_world}Env",
        vector_entry_point=f"gridnav.envs.{_file}:{_world}VectorEnv",
        max_episode_steps=MAX_EPISODE_STEPS[_world],
    )
