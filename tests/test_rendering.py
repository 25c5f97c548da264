"""Pictures of the robot worlds, and what is said where MuJoCo cannot draw."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from gridnav.envs import GL_BACK_ENDS, gl_works, painter
from gridnav.problem.robot import BURGER

needs_gl = pytest.mark.skipif(
    not any(gl_works(name) for name in GL_BACK_ENDS), reason="no GL back end works here, so MuJoCo cannot draw"
)


def place(world: str, start: tuple[int, int], heading: float = 0.0, **arguments: object) -> gym.Env:
    """A robot at a cell of `classic` that draws pictures."""
    env = gym.make(f"gridnav/{world}-v0", task="any", render_mode="rgb_array", **arguments)
    goal = (9, 9) if start != (9, 9) else (9, 8)
    env.reset(seed=0, options={"start": start, "goal": goal, "heading_rad": heading})
    return env


# ---- The painter's pictures of the Unicycle --------------------------------------------------------


@pytest.mark.parametrize("start", [(0, 0), (4, 5), (9, 0)])
def test_the_unicycle_is_drawn_where_its_pose_says(start: tuple[int, int]) -> None:
    env = place("Unicycle", start)
    env.step(np.float32([1.0, 0.1]))
    picture = env.render()
    pose = env.unwrapped.worlds._pose[0]

    pixels = np.argwhere((picture == painter.ROBOT).all(axis=2) | (picture == painter.NOSE).all(axis=2))
    # 100 pixels per metre, rows from the top: row = (5 - y) * 100, column = x * 100.
    np.testing.assert_allclose(pixels.mean(axis=0), [(5 - pose[1]) * 100, pose[0] * 100], atol=2.0)
    assert len(pixels) == pytest.approx(np.pi * (BURGER.radius_m * 100) ** 2, rel=0.15)  # pygame rounds down


@pytest.mark.parametrize(
    ("heading", "side"), [(0.0, (0, 1)), (np.pi / 2, (-1, 0)), (np.pi, (0, -1)), (-np.pi / 2, (1, 0))]
)
def test_the_nose_points_where_the_robot_is_heading(heading: float, side: tuple[int, int]) -> None:
    picture = place("Unicycle", (4, 5), heading).render()

    # The white line from the middle of cell (4, 5), at row 225 and column 275, to 0.8 of the radius.
    white = np.argwhere((picture == painter.NOSE).all(axis=2)).mean(axis=0)
    np.testing.assert_allclose(white - [225, 275], np.multiply(side, 4.0), atol=1.5)


def test_the_unicycles_window_works_without_a_display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = gym.make("gridnav/Unicycle-v0", render_mode="human")
    env.reset(seed=0)

    assert env.render() is None
    env.close()


def test_a_layout_that_is_not_square_keeps_its_proportions() -> None:
    env = gym.make("gridnav/Unicycle-v0", layout="....\n....\n", render_mode="rgb_array")
    env.reset(seed=0)

    assert env.render().shape == (250, 500, 3)


def test_without_a_render_mode_nothing_is_drawn() -> None:
    for world in ("GridWorld", "Unicycle", "DiffDrive"):
        env = gym.make_vec(f"gridnav/{world}-v0", num_envs=2)
        env.reset(seed=0)
        assert env.render() is None


# ---- MuJoCo's pictures -----------------------------------------------------------------------------


@needs_gl
def test_the_diff_drive_is_drawn_where_its_pose_says() -> None:
    """The camera above sees the whole maze: what differs between two pictures is where the robots are."""
    pictures, places = [], []
    for start in ((4, 5), (8, 5)):
        env = place("DiffDrive", start, width=400, height=400)
        pictures.append(env.render().astype(int))
        places.append(env.unwrapped.worlds._pose[0, :2].copy())
        env.close()

    assert pictures[0].shape == (400, 400, 3)
    assert np.ptp(pictures[0]) > 100  # not blank
    changed = np.argwhere(np.abs(pictures[0] - pictures[1]).sum(axis=2) > 60)
    rows, columns = changed.T
    # In the maze, row 4 is above row 8 and both robots stand right of the middle, in column 5.
    split = rows.mean()
    upper, lower = changed[rows < split], changed[rows >= split]
    assert len(upper) > 20
    assert len(lower) > 20
    # The maze of 5 m takes 2 * tan(22.5) * 6.85 = 5.67 m of height at the floor: 70.5 pixels per metre.
    apart = lower.mean(axis=0) - upper.mean(axis=0)
    np.testing.assert_allclose(apart, [(places[0][1] - places[1][1]) * 70.5, 0.0], atol=8.0)
    centre = (upper.mean(axis=0) + lower.mean(axis=0)) / 2
    middle = (places[0] + places[1]) / 2 - 2.5
    np.testing.assert_allclose(centre, [200 - middle[1] * 70.5, 200 + middle[0] * 70.5], atol=8.0)
    assert np.ptp(columns) < 40


@needs_gl
@pytest.mark.parametrize("camera", ["above", "chase", "onboard"])
def test_every_camera_shows_something_that_moves_with_the_robot(camera: str) -> None:
    env = place("DiffDrive", (0, 0), camera=camera, width=120, height=90)
    first = env.render()
    kept = first.copy()
    for _ in range(15):
        env.step(np.float32([1.0, 0.0]))
    second = env.render()
    env.close()

    assert (first.shape, first.dtype) == ((90, 120, 3), np.uint8)
    assert len(np.unique(first.reshape(-1, 3), axis=0)) > 10
    np.testing.assert_array_equal(first, kept)
    assert not np.shares_memory(first, second)
    assert (first != second).any(axis=2).mean() > 0.001


@needs_gl
def test_rendering_changes_no_trajectory() -> None:
    drawn, blind = place("DiffDrive", (0, 0), width=64, height=64), place("DiffDrive", (0, 0))
    for _ in range(10):
        drawn.render()
        one, other = drawn.step(np.float32([0.8, 0.3])), blind.step(np.float32([0.8, 0.3]))
        np.testing.assert_array_equal(one[0], other[0])
    drawn.close()


@needs_gl
def test_the_checker_passes_with_rendering_and_without_a_warning() -> None:
    env = gym.make("gridnav/DiffDrive-v0", render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
    env.close()


@needs_gl
def test_the_picture_follows_a_new_layout() -> None:
    env = place("DiffDrive", (0, 0), width=100, height=100)
    before = env.render()
    env.reset(options={"start": (0, 0), "goal": (9, 9), "heading_rad": 0.0, "layout": "open"})
    after = env.render()
    env.close()

    # `classic` has 12 wall cells of 100; seen from above most of them must be gone.
    assert 0.05 < (np.abs(before.astype(int) - after).sum(axis=2) > 60).mean() < 0.3


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux can be without a display this way")
def test_where_mujoco_cannot_draw_one_line_says_what_to_install(tmp_path: Path) -> None:
    program = (
        "import gymnasium as gym, gridnav\n"
        "env = gym.make('gridnav/DiffDrive-v0', render_mode='rgb_array')\n"
        "env.reset(seed=0)\n"
        "env.step(env.action_space.sample())\n"
        "print('drives')\n"
        "try:\n"
        "    env.render()\n"
        "except Exception as error:\n"
        "    print(type(error).__name__, '|', error)\n"
    )
    environment = os.environ | {"MUJOCO_GL": "glfw", "DISPLAY": "", "WAYLAND_DISPLAY": ""}

    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=120
    )

    # Without a picture the world works all the same.
    lines = done.stdout.splitlines()
    assert lines[:1] == ["drives"], done.stderr[-500:]
    assert len(lines) == 2
    assert lines[1].startswith("RenderingError | ")
    assert "apt-get install libegl1" in lines[1]
    assert "MUJOCO_GL" in lines[1]
