"""A person at the keyboard, played by posted key events."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pygame
import pytest

from gridnav.cli import main
from gridnav.display.viewer import ViewerError
from gridnav.display.window import KEYS, DriveWindow
from gridnav.experiment.play import play
from gridnav.experiment.rollouts import load_rollouts
from gridnav.experiment.worlds import Problem
from gridnav.problem.types import AnyArray

CORRIDOR = "S...G"
CODES = {name: code for code, name in KEYS.items()}


@pytest.fixture(autouse=True)
def _without_a_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


def press(key: str, *, release: bool = False) -> None:
    pygame.event.post(pygame.event.Event(pygame.KEYUP if release else pygame.KEYDOWN, key=CODES[key]))


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[list[str]]]:
    """Keys that go down each time the window has drawn something; when they run out, Escape."""
    keys: list[list[str]] = []
    shown = DriveWindow.show

    def show(self: DriveWindow, *arguments: AnyArray) -> None:
        shown(self, *arguments)
        for key in keys.pop(0) if keys else ["escape"]:
            press(key)

    monkeypatch.setattr(DriveWindow, "show", show)
    return keys


def test_arrows_move_a_grid_robot_to_its_goal_and_space_begins_another(script: list[list[str]]) -> None:
    # Four moves to the goal; then what is shown is how it ended, and the next episode's start.
    script += [["right"], ["right"], ["right"], ["right"], [], ["space"], ["escape"]]
    episodes = play(Problem.load(CORRIDOR, "default", "default"), "GridWorld", 0)
    assert [one.is_success for one in episodes] == [True], "the second was ended before a move"
    assert episodes[0].trace is not None
    np.testing.assert_array_equal(episodes[0].trace.actions.ravel(), [3, 3, 3, 3])


@pytest.mark.parametrize("world", ["Unicycle", "DiffDrive"])
def test_holding_up_drives_a_robot_and_escape_keeps_what_was_driven(world: str, script: list[list[str]]) -> None:
    script += [["up"], [], [], [], ["left"], []]
    (episode,) = play(Problem.load(CORRIDOR, "default", "default"), world, 0)
    assert episode.trace is not None
    actions = episode.trace.actions
    assert not episode.is_success
    assert episode.steps == len(actions) >= 5
    np.testing.assert_allclose(actions[:4], [[1.0, 0.0]] * 4)
    assert actions[-1, 1] > 0, "left turns counter-clockwise"
    assert episode.path_length_m > 0.02


def test_keys_that_are_released_are_no_longer_held() -> None:
    with DriveWindow("test") as window:
        press("up")
        assert window.listen() == ["up"]
        assert window.held == {"up"}
        press("up", release=True)
        assert window.listen() == []
        assert window.held == set()
        pygame.event.post(pygame.event.Event(pygame.QUIT))
        window.listen()
        assert window.is_closed


def test_a_drive_becomes_a_run_that_can_be_looked_at(
    script: list[list[str]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script += [["right"], ["right"]]
    run = tmp_path / "drive"
    with pytest.raises(SystemExit) as leaving:
        main(["play", "--env", "gridnav/GridWorld-v0", "--layout", CORRIDOR, "--run-dir", str(run)])
    assert not leaving.value.code
    assert load_rollouts(run / "rollouts", "drive").episodes[0].steps == 2
    with pytest.raises(SystemExit) as leaving:
        main(["view", str(run), "--episode", "0", "--save", str(tmp_path / "d.rrd")])
    assert not leaving.value.code
    assert (tmp_path / "d.rrd").stat().st_size > 1000


def test_without_a_display_one_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    pygame.display.quit()
    monkeypatch.setenv("SDL_VIDEODRIVER", "none-of-these")
    with pytest.raises(ViewerError, match="needs a display") as caught, DriveWindow("test"):
        pass
    assert "\n" not in str(caught.value)
