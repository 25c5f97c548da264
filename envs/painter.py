"""The maze and a robot as a picture from above, and in a window."""

from __future__ import annotations

import numpy as np
import pygame
from numpy.typing import NDArray

from gridnav.problem.layout import Layout
from gridnav.problem.types import FloatArray, IntArray

PICTURE_SIDE_PX = 500
FLOOR, GRID_LINE, WALL = (250, 250, 247), (225, 226, 222), (70, 82, 102)
START, GOAL, ROBOT, NOSE = (150, 170, 200), (38, 160, 90), (20, 100, 190), (255, 255, 255)


class Painter:
    """Draws with pygame-ce; opens a window only when asked to show.

    Args:
        fps: Pictures per second that the window shows.
    """

    def __init__(self, *, fps: int) -> None:
        self._fps = fps
        self._window: pygame.Surface | None = None
        self._clock: pygame.time.Clock | None = None

    def picture(
        self, layout: Layout, pose: FloatArray, start: IntArray, goal: IntArray, radius_m: float
    ) -> NDArray[np.uint8]:
        """The world as RGB, shape ``(height, width, 3)``, row 0 on top."""
        pixels = pygame.surfarray.array3d(self._paint(layout, pose, start, goal, radius_m))
        return np.ascontiguousarray(pixels.transpose(1, 0, 2))

    def show(self, layout: Layout, pose: FloatArray, start: IntArray, goal: IntArray, radius_m: float) -> None:
        """The world in a window; waits so that pictures come at the frame rate."""
        picture = self._paint(layout, pose, start, goal, radius_m)
        if self._window is None or self._clock is None:
            pygame.display.init()
            pygame.display.set_caption("gridnav")
            self._window = pygame.display.set_mode(picture.get_size())
            self._clock = pygame.time.Clock()
        self._window.blit(picture, (0, 0))
        pygame.event.pump()
        pygame.display.flip()
        self._clock.tick(self._fps)

    def close(self) -> None:
        """Close the window, if one is open."""
        if self._window is not None:
            pygame.display.quit()
            self._window = None

    def _paint(
        self, layout: Layout, pose: FloatArray, start: IntArray, goal: IntArray, radius_m: float
    ) -> pygame.Surface:
        scale = PICTURE_SIDE_PX / max(layout.size_m)
        width, height = (round(side * scale) for side in layout.size_m)
        surface = pygame.Surface((width, height))
        surface.fill(FLOOR)
        side = layout.cell_size_m * scale
        for row in range(layout.n_rows):
            for col in range(layout.n_cols):
                box = pygame.Rect(round(col * side), round(row * side), round(side) + 1, round(side) + 1)
                if layout.walls[row, col]:
                    surface.fill(WALL, box)
                else:
                    pygame.draw.rect(surface, GRID_LINE, box, width=1)
        self._mark(surface, start, START, side, width=3)
        self._mark(surface, goal, GOAL, side, width=0)

        x, y = pose[0] * scale, height - pose[1] * scale
        pygame.draw.circle(surface, ROBOT, (x, y), max(radius_m * scale, 3.0))
        nose = (x + 0.8 * radius_m * scale * np.cos(pose[2]), y - 0.8 * radius_m * scale * np.sin(pose[2]))
        pygame.draw.line(surface, NOSE, (x, y), nose, width=3)
        return surface

    @staticmethod
    def _mark(
        surface: pygame.Surface, cell: IntArray, colour: tuple[int, int, int], side: float, *, width: int
    ) -> None:
        box = pygame.Rect(0, 0, round(side * 0.8), round(side * 0.8))
        box.center = (round((cell[1] + 0.5) * side), round((cell[0] + 0.5) * side))
        pygame.draw.rect(surface, colour, box, width=width, border_radius=4)
