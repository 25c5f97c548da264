"""A family of layouts for training that is to work in layouts it never saw."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gridnav.problem.layout import Layout

HELD_OUT = 1 << 30
"""Seeds of layouts from here on are for evaluation; training draws below."""


@dataclass(frozen=True)
class RandomLayouts:
    """Single blocks at random, any free cell to any other; see ``Layout.random``."""

    n_rows: int = 10
    """Cells from top to bottom."""
    n_cols: int = 10
    """Cells from left to right."""
    densities: tuple[float, float] = (0.1, 0.2)
    """Share of cells that are walls: uniform between these."""

    def draw(self, rng: np.random.Generator) -> Layout:
        """A layout for training."""
        return self._layout(int(rng.integers(HELD_OUT)))

    def held_out(self, n: int) -> list[Layout]:
        """The first ``n`` layouts for evaluation, always the same; no training draws them."""
        return [self._layout(HELD_OUT + i) for i in range(n)]

    def _layout(self, seed: int) -> Layout:
        # Density: uniform, from the layout's own seed.
        density = round(float(np.random.default_rng((seed, 1)).uniform(*self.densities)), 2)
        return Layout.random(n_rows=self.n_rows, n_cols=self.n_cols, density=density, seed=seed)
