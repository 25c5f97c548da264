"""An agent's values and policy on the cells of a maze, as pictures and recordings draw them."""

from __future__ import annotations

from dataclasses import dataclass

from gridnav.problem.types import FloatArray


@dataclass(frozen=True)
class PolicyMap:
    """Values and directions of the cells for one goal, arrays of shape ``(n_rows, n_cols)``."""

    values: FloatArray
    """Expected discounted reward; NaN where unknown."""
    directions_rad: FloatArray
    """Where the policy heads, world frame (x right, y up); NaN where nowhere."""
    speeds: FloatArray
    """Shares of full speed, in [0, 1]."""
