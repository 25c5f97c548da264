"""An episode as a film: the maze and the robot in MuJoCo's picture, from above, from behind or from on board."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal, get_args

import imageio_ffmpeg
import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from gridnav.display import palette
from gridnav.envs import build_model, make_renderer
from gridnav.problem.layout import Layout
from gridnav.problem.metrics import Episode, Trace
from gridnav.problem.robot import BURGER, Robot
from gridnav.problem.types import AnyArray, FloatArray, InputError

Camera = Literal["above", "chase", "onboard"]
FPS = {".mp4": 20, ".gif": 10}
"""Pictures per second; a gif keeps every one of them whole."""
LARGEST = (1920, 1080)
"""Width and height of the robot model's off-screen buffer, ``assets/mjcf/burger.xml``."""
GIF_COLOURS = 64
LAST_S = 1.0
"""How long the last picture stays."""
CAPTION_SHARE = 0.045
"""Height of the caption's letters, as a share of the picture's."""
TRAIL_M = 0.02
"""Thickness of the trail."""


def write_video(
    path: Path,
    layout: Layout,
    episode: Episode,
    caption: str,
    *,
    camera: Camera = "above",
    size: tuple[int, int] = (640, 480),
    speed: float = 1.0,
    robot: Robot = BURGER,
    on_frame: Callable[[int, int], None] | None = None,
) -> None:
    """Write an episode as a film, .mp4 (H.264) or .gif.

    Between two states of the trace the robot moves evenly, on the grid too; its wheels roll without slipping.

    Args:
        path: The file to write; its folder exists.
        layout: The maze.
        episode: With a trace.
        caption: Who drives where; time, collisions and outcome are added.
        camera: ``above``: the whole maze; ``chase``: behind the robot; ``onboard``: what it would see.
        size: Width and height, pixels, even numbers.
        speed: Seconds of the episode per second of the film.
        robot: Wheels and radius.
        on_frame: Told how many pictures are done, and of how many.

    Raises:
        InputError: When the file's ending, the camera, the size or the speed is not possible.
        RenderingError: When no OpenGL back end works.
    """
    if path.suffix not in FPS:
        raise InputError(f"video {str(path)!r} must end with {' or '.join(FPS)}")
    if camera not in get_args(Camera):
        raise InputError(f"camera {camera!r} is unknown: choose {', '.join(get_args(Camera))}")
    if any(side % 2 or not 64 <= side <= most for side, most in zip(size, LARGEST, strict=True)):
        raise InputError(f"size {size} must be two even numbers from 64 to {LARGEST[0]} and {LARGEST[1]} pixels")
    if not 0.1 <= speed <= 100:
        raise InputError(f"speed {speed} must be from 0.1 to 100")
    if episode.trace is None:
        raise ValueError("a film needs an episode with a trace")
    fps = FPS[path.suffix]
    pictures = _pictures(layout, episode, caption, camera, size, fps, speed, robot, on_frame)
    if path.suffix == ".gif":
        first, *others = (Image.fromarray(picture).quantize(GIF_COLOURS) for picture in pictures)
        first.save(path, save_all=True, append_images=others, duration=round(1000 / fps), loop=0)
        return
    # Aside first, by its whole path: what breaks off leaves no half film, and no name is an option of the encoder's.
    aside = path.resolve().with_name(f".tmp-{path.name}")
    # Every player knows H.264 with these colours; the quality is the encoder's usual one.
    film = imageio_ffmpeg.write_frames(aside, size, fps=fps, codec="libx264", pix_fmt_out="yuv420p", macro_block_size=2)
    try:
        for number, picture in enumerate(pictures):
            if number == 0:
                film.send(None)  # the encoder starts once there is something to encode
            film.send(np.ascontiguousarray(picture))
        film.close()
        if not aside.is_file() or not aside.stat().st_size:
            raise OSError(f"the encoder wrote no film to {str(path)!r}: is there room on the disk?")
        aside.rename(path)
    except RuntimeError as error:
        raise OSError(f"the encoder failed: {' '.join(str(error).split())[:150]}") from error
    finally:
        aside.unlink(missing_ok=True)


def _pictures(
    layout: Layout,
    episode: Episode,
    caption: str,
    camera: Camera,
    size: tuple[int, int],
    fps: int,
    speed: float,
    robot: Robot,
    on_frame: Callable[[int, int], None] | None,
) -> Iterator[AnyArray]:
    trace = episode.trace
    assert trace is not None
    end_s = float(trace.time_s[-1])
    times = np.append(np.arange(0.0, end_s, speed / fps), np.full(round(LAST_S * fps), end_s))
    poses, wheels = _between(trace, robot, times)
    model = build_model(layout)
    data = mujoco.MjData(model)
    rest_m = float(model.qpos0[2])
    renderer = make_renderer(model, *size)
    try:
        for i, time_s in enumerate(times):
            x, y, heading = poses[i]
            data.qpos[:] = [x, y, rest_m, np.cos(heading / 2), 0, 0, np.sin(heading / 2), *wheels[i]]
            data.mocap_pos[0] = [*layout.to_metres(np.array(episode.goal)), 0.002]
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera=camera)
            _draw_trail(renderer.scene, trace, robot, time_s, poses[i])
            picture = Image.fromarray(renderer.render())
            _write_caption(picture, _words(episode, trace, caption, time_s))
            yield np.asarray(picture)
            if on_frame:
                on_frame(i + 1, len(times))
    finally:
        renderer.close()


def _between(trace: Trace, robot: Robot, times: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Poses and wheel angles at any times, shapes ``(n, 3)`` and ``(n, 2)``; a grid robot looks where it goes."""
    states = trace.poses.copy()
    if trace.is_on_grid:
        moved = np.diff(states[:, :2], axis=0)
        ways = np.where(np.abs(moved).sum(axis=1) > 0, np.arctan2(moved[:, 1], moved[:, 0]), np.nan)
        for i in range(len(ways)):  # where it stands still it looks as before
            states[i, 2] = ways[i] if np.isfinite(ways[i]) else states[max(i - 1, 0), 2]
        states[-1, 2] = states[-2, 2]
        poses = np.column_stack([np.interp(times, trace.time_s, states[:, axis]) for axis in (0, 1)])
        at = np.clip(np.searchsorted(trace.time_s, times, side="right") - 1, 0, len(ways))
        poses = np.column_stack([poses, states[at, 2]])
    else:
        states[:, 2] = np.unwrap(states[:, 2])
        poses = np.column_stack([np.interp(times, trace.time_s, states[:, axis]) for axis in range(3)])
    middle = states[:-1, 2] if trace.is_on_grid else (states[1:, 2] + states[:-1, 2]) / 2
    ahead = (np.diff(states[:, :2], axis=0) * np.column_stack([np.cos(middle), np.sin(middle)])).sum(axis=1)
    turned = 0.0 if trace.is_on_grid else np.diff(states[:, 2])
    rolled = np.cumsum(robot.wheel_turns(ahead, turned), axis=0)
    rolled = np.concatenate([np.zeros((1, 2)), rolled])
    return poses, np.column_stack([np.interp(times, trace.time_s, rolled[:, side]) for side in range(2)])


def _draw_trail(scene: mujoco.MjvScene, trace: Trace, robot: Robot, time_s: float, pose: FloatArray) -> None:
    """The way so far, orange where it was slow and blue where it was fast."""
    n = int(np.searchsorted(trace.time_s, time_s, side="right"))
    points = np.concatenate([trace.poses[:n, :2], pose[None, :2]])
    step_s = float(trace.time_s[1])
    slow, fast = (np.array([*bytes.fromhex(colour[1:])]) / 255 for colour in (palette.SLOW, palette.FAST))
    for here, there in itertools.pairwise(points):
        length = float(np.hypot(*(there - here)))
        if scene.ngeom >= scene.maxgeom or length < 1e-6:
            continue
        share = min(1.0, length / step_s / robot.max_speed_m_s)
        colour = np.array([*(share * fast + (1 - share) * slow), 1.0], dtype=np.float32)
        geom = scene.geoms[scene.ngeom]
        kind = mujoco.mjtGeom.mjGEOM_CAPSULE
        mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), colour)
        mujoco.mjv_connector(geom, kind, TRAIL_M / 2, np.array([*here, 0.004]), np.array([*there, 0.004]))
        scene.ngeom += 1


def _words(episode: Episode, trace: Trace, caption: str, time_s: float) -> str:
    done = int(np.searchsorted(trace.time_s, time_s, side="right")) - 1
    words = f"{caption}   {time_s:4.1f} s"
    hits = int(trace.hits[:done].sum())
    if hits:
        words += f"   {hits} collision{'s' if hits > 1 else ''}"
    if time_s >= trace.time_s[-1]:
        words += "   arrived" if episode.is_success else "   did not arrive"
    return words


def _write_caption(picture: Image.Image, words: str) -> None:
    """One line on a bar along the lower edge; letters shrink until it fits."""
    width, height = picture.size
    letters = height * CAPTION_SHARE
    draw = ImageDraw.Draw(picture, "RGBA")
    font = ImageFont.load_default(letters)
    letters *= min(1.0, 0.96 * width / draw.textlength(words, font=font))
    font = ImageFont.load_default(letters)
    bar = round(1.7 * height * CAPTION_SHARE)
    draw.rectangle([0, height - bar, width, height], fill=(31, 41, 51, 200))
    draw.text((0.02 * width, height - bar / 2), words, font=font, fill=(255, 255, 255), anchor="lm")
