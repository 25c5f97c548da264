"""Driving by keyboard: a person is the policy, and what they do is kept like any evaluation."""

from __future__ import annotations

import contextlib
import time
from typing import Any

import numpy as np
from gymnasium.spaces import Discrete
from numpy.typing import NDArray

from gridnav.display.window import DriveWindow
from gridnav.envs import NavigationVectorEnv
from gridnav.experiment.evaluation import PolicyStopped, evaluate
from gridnav.experiment.worlds import Problem
from gridnav.problem.metrics import Episode
from gridnav.problem.robot import LIDAR_HEIGHT_M
from gridnav.problem.types import AnyArray

MOVES = ("up", "down", "left", "right")
"""Keys in the order of the grid's actions."""
TURN = 0.35
"""Turning command of an arrow key, as a fraction of the maximum: 50 degrees a second."""
SLOW = 0.4
"""Factor while shift is held."""
LISTEN_S = 0.02
HINTS = {
    True: "arrows: one move",
    False: "arrows: drive and turn, shift: slowly",
}


def play(problem: Problem, world: str, seed: int) -> list[Episode]:
    """Let a person drive, episode after episode, until Escape.

    Args:
        problem: What is to be solved.
        world: ``GridWorld``, ``Unicycle`` or ``DiffDrive``.
        seed: Of starts, goals and headings; each episode has the next one.

    Returns:
        The episodes, the one that was broken off included if anything was done in it.

    Raises:
        ViewerError: When no window can be opened.
    """
    episodes: list[Episode] = []
    # Without a reset of its own, what is drawn at the end is the end.
    worlds = problem.worlds(world, 1, render_mode="rgb_array", autoreset=False)
    try:
        with (
            contextlib.suppress(KeyboardInterrupt),  # what was driven is kept
            DriveWindow(f"gridnav play: {problem.layout.name} on {world}") as window,
        ):
            while not window.is_closed:
                driver = _Driver(worlds, window)
                done = evaluate(driver.act, worlds, seed=seed + len(episodes), on_info=driver.look)
                episodes += done
                if not window.is_closed:
                    driver.wait_for_next(done[0])
    finally:
        worlds.close()
    return episodes


class _Driver:
    """Keys to actions; between two actions the window shows where things stand."""

    def __init__(self, worlds: NavigationVectorEnv, window: DriveWindow) -> None:
        self._worlds, self._window = worlds, window
        self._on_grid = isinstance(worlds.single_action_space, Discrete)
        self._earned: dict[str, float] = {}
        self._info: dict[str, Any] = {}
        self._due = time.monotonic()

    def look(self, info: dict[str, Any]) -> None:
        """Take note of what a step led to, or of the start, and show it."""
        self._info = info
        for term, values in info["reward_terms"].items():
            self._earned[term] = self._earned.get(term, 0.0) + float(values[0])
        self._show(HINTS[self._on_grid], "escape: end")

    def act(self, observations: NDArray[Any]) -> NDArray[Any]:
        """The person's action: on the grid when a key goes down, on a robot once per control period.

        Raises:
            PolicyStopped: When the person is done.
        """
        while True:
            pressed = self._window.listen()
            if self._window.is_closed:
                raise PolicyStopped
            moves = [key for key in pressed if key in MOVES]
            if self._on_grid and moves:
                return np.array([MOVES.index(moves[-1])])
            if not self._on_grid and time.monotonic() >= self._due:
                # In time with the simulation, but never in a hurry to catch up.
                self._due = max(self._due + self._worlds.step_s, time.monotonic())
                return self._command()
            time.sleep(LISTEN_S)

    def wait_for_next(self, episode: Episode) -> None:
        """Show how it ended until the space bar is pressed or the window closed."""
        ended = "arrived" if episode.is_success else "did not arrive"
        self._show(f"{ended}, SPL {episode.length_ratio:.2f}", "space: next, escape: end")
        while not self._window.is_closed and "space" not in self._window.listen():
            time.sleep(LISTEN_S)

    def _command(self) -> NDArray[np.float32]:
        held = self._window.held
        forward = ("up" in held) - ("down" in held)
        turn = TURN * (("left" in held) - ("right" in held))
        return np.array([[forward, turn]], dtype=np.float32) * (SLOW if "shift" in held else 1.0)

    def _show(self, *hints: str) -> None:
        info = self._info
        picture = np.asarray((self._worlds.render() or ())[0])
        words = [
            f"time {float(info['elapsed_s'][0]):.1f} s",
            f"way {float(info['path_length_m'][0]):.2f} m, shortest {float(info['shortest_path_m'][0]):.2f} m",
            f"collisions {int(info['collisions'][0])}",
            f"return {sum(self._earned.values()):+.2f}",
            *hints,
        ]
        self._window.show(picture, self._rays_px(picture.shape), words, self._earned)

    def _rays_px(self, shape: tuple[int, ...]) -> AnyArray:
        """The lidar's beams in the picture, shape ``(n_beams, 2, 2)``; none on the grid."""
        if self._on_grid:
            return np.zeros((0, 2, 2))
        pose, robot = self._info["pose"], self._worlds.robot
        ranges = self._worlds.scan(pose)[0]
        heading = pose[0, 2]
        eye = pose[0, :2] + robot.lidar_offset_m * np.array([np.cos(heading), np.sin(heading)])
        angles = heading + robot.beam_angles_rad
        ends = eye + ranges[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
        rays = np.stack([np.broadcast_to(eye, ends.shape), ends], axis=1)[np.isfinite(ranges)]
        return self._to_pixels(rays, shape)

    def _to_pixels(self, points_w: AnyArray, shape: tuple[int, ...]) -> AnyArray:
        """Points at the lidar's height in the picture from above, x to the right and y down."""
        height, width = shape[:2]
        size = np.array(self._worlds.layout.size_m)
        if self._worlds.world == "DiffDrive":
            model = self._worlds.model  # type: ignore[attr-defined]
            camera = model.cam("above")
            above_m = float(camera.pos[2]) - LIDAR_HEIGHT_M
            scale = height / 2 / np.tan(np.deg2rad(float(camera.fovy[0])) / 2) / above_m
        else:
            scale = height / size[1]
        centred = (points_w - size / 2) * scale
        return np.array([width / 2, height / 2]) + centred * [1.0, -1.0]
