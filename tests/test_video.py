"""Films have the right length and show the robot where its trace says it is."""

from __future__ import annotations

from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from gridnav.envs import RenderingError
from gridnav.experiment.video import FPS, LAST_S, write_video
from gridnav.problem.layout import Layout
from gridnav.problem.metrics import Episode, Trace
from gridnav.problem.types import AnyArray, InputError

CORRIDOR = Layout.from_text("S...G\n.###.\n.....\n")


def drive(*, on_grid: bool = False) -> Episode:
    """From (0, 0) to (0, 4) of the corridor in two seconds, for the grid in four moves."""
    steps = 4 if on_grid else 10
    x = np.linspace(0.25, 2.25, steps + 1)
    poses = np.column_stack([x, np.full(steps + 1, 1.25), np.zeros(steps + 1)])
    actions = np.full((steps, 1), 3.0) if on_grid else np.tile([1.0, 0.0], (steps, 1))
    trace = Trace(
        np.linspace(0, 2.0, steps + 1), poses, np.ones((steps + 1, 24)), actions, {"time": np.zeros(steps)},
        np.zeros(steps, dtype=np.int64),
    )  # fmt: skip
    return Episode((0, 0), (0, 4), True, 0, 2.0, 2.0, 2.0, 2.0, steps, 0.0, trace=trace)


def film(path: Path, **options: object) -> None:
    try:
        write_video(path, CORRIDOR, drive(), "test", size=(320, 240), **options)  # type: ignore[arg-type]
    except RenderingError as error:
        pytest.skip(str(error))


def frames(path: Path) -> list[AnyArray]:
    reader = imageio_ffmpeg.read_frames(path)
    width, height = next(reader)["size"]
    return [np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader]


def front_of_robot(frame: AnyArray, start: AnyArray) -> int:
    """The rightmost column in which something is not as it was at the start: the robot drives to the right."""
    changed = (np.abs(frame.astype(int) - start).max(axis=2) > 60).any(axis=0)
    return int(np.flatnonzero(changed).max())


def test_a_film_is_as_long_as_its_episode_and_the_robot_crosses_it(tmp_path: Path) -> None:
    film(tmp_path / "a.mp4")
    shown = frames(tmp_path / "a.mp4")
    # By hand: two seconds at 20 pictures each, and the last one for a second.
    assert len(shown) == 40 + FPS[".mp4"] * LAST_S
    assert shown[0].shape == (240, 320, 3)
    # By hand: the camera stands 1.32 x 2.5 m + 0.25 m high and sees 45 degrees; the robot's top is 0.18 m high.
    pixels_per_m = 120 / np.tan(np.pi / 8) / (1.32 * 2.5 + 0.25 - 0.18)
    for number in (8, 20, 34):
        middle_m = 0.25 + 2.0 * number / 40
        ahead_m = (front_of_robot(shown[number], shown[0]) - 160) / pixels_per_m + 1.25 - middle_m
        assert 0.0 < ahead_m < 0.12, f"picture {number}: the robot's front is {ahead_m:.2f} m ahead of its middle"


@pytest.mark.parametrize("camera", ["chase", "onboard"])
def test_every_camera_sees_something_that_changes(camera: str, tmp_path: Path) -> None:
    film(tmp_path / "a.mp4", camera=camera, speed=4.0)
    shown = frames(tmp_path / "a.mp4")
    assert all(frame.std() > 5 for frame in shown)
    assert np.abs(shown[0].astype(int) - shown[-1]).mean() > 1


def test_a_gif_repeats_and_has_its_own_speed(tmp_path: Path) -> None:
    film(tmp_path / "a.gif", speed=2.0)
    with Image.open(tmp_path / "a.gif") as picture:
        assert picture.size == (320, 240)
        assert picture.info["loop"] == 0
        # By hand: one second of film at 10 pictures, and the last one for a second; equal ones may be put together.
        assert 10 <= picture.n_frames <= 20  # type: ignore[attr-defined]


def test_a_grid_robot_is_filmed_too(tmp_path: Path) -> None:
    try:
        write_video(tmp_path / "g.mp4", CORRIDOR, drive(on_grid=True), "grid", size=(320, 240))
    except RenderingError as error:
        pytest.skip(str(error))
    assert len(frames(tmp_path / "g.mp4")) == 60


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("a.avi", {}, r"must end with \.mp4 or \.gif"),
        ("a.mp4", {"camera": "side"}, "camera 'side' is unknown"),
        ("a.mp4", {"size": (641, 480)}, "two even numbers"),
        ("a.mp4", {"size": (1080, 1920)}, "64 to 1920 and 1080 pixels"),
        ("a.mp4", {"speed": 0.0}, "speed 0.0 must be from"),
    ],
)
def test_what_cannot_be_filmed_is_refused_and_nothing_written(
    name: str, options: dict[str, object], words: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=words):
        write_video(tmp_path / name, CORRIDOR, drive(), "test", **options)  # type: ignore[arg-type]
    assert not (tmp_path / name).exists()
