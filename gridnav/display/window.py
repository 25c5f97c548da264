"""A window for driving by keyboard: the maze, the lidar, the reward so far, and which keys are held."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Self

import pygame

from gridnav.display import palette
from gridnav.display.viewer import ViewerError
from gridnav.problem.types import AnyArray

PANEL_PX = 300
"""Width of the panel beside the maze."""
LINE_PX = 24
FONT_PX = 17
LARGEST_BAR = 10.0
"""Reward that fills half of the panel."""
KEYS = {
    pygame.K_UP: "up",
    pygame.K_DOWN: "down",
    pygame.K_LEFT: "left",
    pygame.K_RIGHT: "right",
    pygame.K_LSHIFT: "shift",
    pygame.K_RSHIFT: "shift",
    pygame.K_SPACE: "space",
    pygame.K_ESCAPE: "escape",
}
"""The keys that mean something."""


class DriveWindow:
    """A context around a window, for as long as somebody drives.

    Raises:
        ViewerError: On entering, when there is no display.
    """

    def __init__(self, title: str) -> None:
        self._title = title
        self._surface: pygame.Surface | None = None
        self.held: set[str] = set()
        """Keys that are down."""
        self.is_closed = False
        """Escape was pressed or the window was closed."""

    def __enter__(self) -> Self:
        try:
            pygame.display.init()
            pygame.font.init()
            pygame.display.set_caption(self._title)
            self._surface = pygame.display.set_mode((640 + PANEL_PX, 640))
        except pygame.error as error:
            raise ViewerError(
                f"no window can be opened here ({error}): gridnav play needs a display; on a machine without one, "
                "gridnav view RUN --screenshot out.png shows what agents did"
            ) from None
        self._font = pygame.font.Font(None, FONT_PX + 4)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pygame.display.quit()

    def listen(self) -> list[str]:
        """Keys that went down since the last call; ``held`` and ``is_closed`` are up to date then."""
        pressed = []
        for event in pygame.event.get():
            if event.type == pygame.QUIT:
                self.is_closed = True
            elif event.type == pygame.KEYDOWN and event.key in KEYS:
                pressed.append(KEYS[event.key])
                self.held.add(KEYS[event.key])
            elif event.type == pygame.KEYUP and event.key in KEYS:
                self.held.discard(KEYS[event.key])
        self.is_closed = self.is_closed or "escape" in pressed
        return pressed

    def show(
        self,
        picture: AnyArray,
        rays_px: AnyArray,
        words: Sequence[str],
        bars: Mapping[str, float],
    ) -> None:
        """Draw a state.

        Args:
            picture: The maze from above, RGB, shape ``(height, width, 3)``, row 0 on top.
            rays_px: Ends of the lidar's beams, (x to the right, y down), shape ``(n_beams, 2, 2)``, pixels.
            words: Lines of the panel.
            bars: Reward by term, drawn to the right or, where negative, to the left.
        """
        height, width, _ = picture.shape
        if self._surface is None or self._surface.get_size() != (width + PANEL_PX, height):
            self._surface = pygame.display.set_mode((width + PANEL_PX, height))
        surface = self._surface
        surface.blit(pygame.surfarray.make_surface(picture.swapaxes(0, 1)), (0, 0))
        for start, end in rays_px:
            pygame.draw.aaline(surface, palette.SKY, start, end)
            pygame.draw.circle(surface, palette.PURPLE, end, 3)
        surface.fill(palette.INK, pygame.Rect(width, 0, PANEL_PX, height))
        y = 14
        for line in words:
            self._write(line, (width + 16, y))
            y += LINE_PX
        y += LINE_PX // 2
        middle = width + 16 + PANEL_PX // 2
        for term, value in bars.items():
            self._write(f"{term} {value:+.2f}", (width + 16, y))
            length = round(min(1.0, abs(value) / LARGEST_BAR) * (PANEL_PX // 2 - 32))
            box = pygame.Rect(middle - (length if value < 0 else 0), y + LINE_PX - 5, length, 8)
            pygame.draw.rect(surface, palette.REWARD_TERMS.get(term, palette.FLOOR), box)
            y += 2 * LINE_PX - 8
        pygame.display.flip()

    def _write(self, line: str, at: tuple[int, int]) -> None:
        assert self._surface is not None
        self._surface.blit(self._font.render(line, True, palette.FLOOR), at)
