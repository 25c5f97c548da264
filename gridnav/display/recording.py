"""Rollouts as a Rerun recording, pictures of it without a display, and the viewer.

Every call to Rerun in the project is in this file, because its interface changes in most releases.

A recording holds several rollouts of the same maze, start and goal on common timelines, ``sim_time`` in seconds and
``step``. Its entities, with ``NAME`` a rollout's name:

    /rollouts/NAME/maze, start, goal, trail, collisions   the whole course, at all times
    /rollouts/NAME/robot, robot/body, robot/heading       where the robot is
    /rollouts/NAME/robot/lidar/rays, hits                 what it sees, in the lidar's frame
    /distance_to_goal/NAME, /return/NAME, /action/NAME    curves
    /run_card                                             what this is, in Markdown

Data goes in as columns, one call per entity: one call per step is forty times slower.
"""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Literal

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.experimental import ViewerClient

from gridnav.display import palette
from gridnav.problem.geodesic import Geodesic
from gridnav.problem.layout import Layout
from gridnav.problem.metrics import Episode, Trace
from gridnav.problem.robot import BURGER, Robot
from gridnav.problem.types import AnyArray, FloatArray

WALL_HEIGHT_M = 0.25
OUTER_WALL_M = 0.05
"""Thickness at which the outer wall is drawn."""
LIDAR_HEIGHT_M = 0.182
"""Of the scan plane of a TurtleBot3 Burger above the floor (ROBOTIS-GIT/turtlebot3, ``burger.urdf``)."""
BODY_HEIGHT_M = 0.192
"""Of the robot (ROBOTIS e-manual, TurtleBot3 specifications)."""
GRID_BODY_SHARE = 0.5
"""Side of the box that stands for a grid robot, as a share of the cell."""

NOTES_FADE_S = 5.0
"""The headless viewer's notes about itself are gone four seconds after its start."""
VIEWER_PATIENCE_S = 60.0
"""How long the headless viewer may take to start, load and paint."""


class ViewerError(RuntimeError):
    """The Rerun viewer cannot be run here; the message is one line that says what to do."""


def write_recording(
    path: str | Path,
    layout: Layout,
    rollouts: Mapping[str, Episode],
    *,
    title: str = "gridnav rollout",
    properties: Mapping[str, object] | None = None,
    robot: Robot = BURGER,
) -> None:
    """Write one or more rollouts in the same maze to an .rrd file, side by side on one timeline.

    Args:
        path: The file to write; its folder exists.
        layout: The maze.
        rollouts: Name to episode, each with a trace. Grid rollouts have one number per action, robots two.
        title: Heading of the run card, and the recording's name in the viewer.
        properties: Seeds, command, versions: shown on the run card and stored with the recording.
        robot: Body and lidar to draw.

    Raises:
        ValueError: When there is no rollout, one without a trace, or one with another start or goal.
    """
    traces = {name: episode.trace for name, episode in rollouts.items() if episode.trace is not None}
    if not rollouts or len(traces) < len(rollouts):
        raise ValueError(f"a recording needs rollouts, each with a trace: {list(rollouts)} have {len(traces)}")
    ends = {(episode.start, episode.goal) for episode in rollouts.values()}
    if len(ends) > 1:
        raise ValueError(f"the rollouts of a recording share one start and goal, not {sorted(ends)}")
    shown = {key: str(value) for key, value in (properties or {}).items()}
    distance = Geodesic(layout, min(robot.radius_m, 0.49 * layout.cell_size_m))

    recording = rr.RecordingStream("gridnav", send_properties=False)
    recording.save(path, default_blueprint=_blueprint(layout, traces))
    recording.send_recording_name(title)
    if shown:
        recording.send_property("run", rr.AnyValues(drop_untyped_nones=True, **shown))
    card = rr.TextDocument(_run_card(title, rollouts, shown), media_type=rr.MediaType.MARKDOWN)
    recording.log("run_card", card, static=True)
    ((start, goal),) = ends
    for number, (name, trace) in enumerate(traces.items()):
        _log_scene(recording, _path("rollouts", name), layout, layout.to_metres(np.array([start, goal])))
        _log_robot(recording, _path("rollouts", name) + "/robot", trace, layout, robot)
        _log_course(recording, _path("rollouts", name), trace, robot)
        to_goal = distance.distances(trace.poses[:, :2], np.full(len(trace.poses), distance.goal_number(goal)))
        colour = palette.SERIES[number % len(palette.SERIES)]
        _log_curves(recording, _path("distance_to_goal", name), _times(trace), {name: to_goal}, [colour])
        _log_reward_and_action(recording, name, trace)
    # Only this writes the footer that readers need.
    recording.disconnect()


# ---- The scene ---------------------------------------------------------------------------------


def _log_scene(recording: rr.RecordingStream, at: str, layout: Layout, ends_w: FloatArray) -> None:
    """Floor, walls, and the start and goal cells, whose centres are ``ends_w``, shape ``(2, 2)``, metres."""
    (width, height), edge = layout.size_m, OUTER_WALL_M
    outer = [
        (-edge, -edge, width + edge, 0.0),
        (-edge, height, width + edge, height + edge),
        (-edge, 0.0, 0.0, height),
        (width, 0.0, width + edge, height),
    ]
    walls = np.concatenate([layout.wall_rectangles(), outer])
    _log_boxes(recording, f"{at}/maze/walls", walls, 0.0, WALL_HEIGHT_M, palette.WALL)
    _log_boxes(recording, f"{at}/maze/floor", np.array([[0, 0, width, height]]), -0.02, 0.0, palette.FLOOR)
    half = 0.45 * layout.cell_size_m
    for name, centre, colour in zip(("start", "goal"), ends_w, (palette.START, palette.GOAL), strict=True):
        tile = np.concatenate([centre - half, centre + half])[None]
        _log_boxes(recording, f"{at}/{name}", tile, 0.0, 0.004, colour)


def _log_boxes(
    recording: rr.RecordingStream, at: str, rectangles_w: FloatArray, bottom_m: float, top_m: float, colour: str
) -> None:
    """Solid boxes over rectangles x_min, y_min, x_max, y_max, shape ``(n, 4)``, metres."""
    n = len(rectangles_w)
    low = np.column_stack([rectangles_w[:, :2], np.full(n, bottom_m)])
    high = np.column_stack([rectangles_w[:, 2:], np.full(n, top_m)])
    boxes = rr.Boxes3D(mins=low, sizes=high - low, colors=_rgba(colour), fill_mode="solid")
    recording.log(at, boxes, static=True)


def _log_robot(recording: rr.RecordingStream, at: str, trace: Trace, layout: Layout, robot: Robot) -> None:
    """The moving body, red in a collision, and what its lidar sees."""
    zero = np.zeros(len(trace.poses))
    half_turn = zero if _is_grid(trace) else trace.poses[:, 2] / 2  # a grid robot has no front
    turns = np.column_stack([zero, zero, np.sin(half_turn), np.cos(half_turn)])  # x, y, z, w
    places = np.column_stack([trace.poses[:, :2], zero])
    _send(recording, at, _times(trace), rr.Transform3D.columns(translation=places, quaternion=turns))

    hit = np.concatenate([[False], trace.hits > 0])[:, None]
    colours = np.where(hit, _rgba(palette.COLLISION), _rgba(palette.INK))
    body = f"{at}/body"
    if _is_grid(trace):
        half = GRID_BODY_SHARE * layout.cell_size_m / 2
        box = rr.Boxes3D(half_sizes=[half, half, half / 2], centers=[0, 0, half / 2], fill_mode="solid")
        recording.log(body, box, static=True)
        _send(recording, body, _times(trace), rr.Boxes3D.columns(colors=colours))
        return
    cylinder = rr.Cylinders3D(
        lengths=[BODY_HEIGHT_M], radii=[robot.radius_m], centers=[0, 0, BODY_HEIGHT_M / 2], fill_mode="solid"
    )
    recording.log(body, cylinder, static=True)
    _send(recording, body, _times(trace), rr.Cylinders3D.columns(colors=colours))
    arrow = rr.Arrows3D(
        origins=[0, 0, BODY_HEIGHT_M + 0.03],
        vectors=[2.5 * robot.radius_m, 0, 0],
        radii=[0.025],
        colors=_rgba(palette.ORANGE),
    )
    recording.log(f"{at}/heading", arrow, static=True)
    _log_lidar(recording, f"{at}/lidar", trace, robot)


def _log_lidar(recording: rr.RecordingStream, at: str, trace: Trace, robot: Robot) -> None:
    """Rays, and points where they hit, in the lidar's frame: x ahead, at the height of the scan."""
    n_beams = trace.scans_m.shape[1]
    recording.log(at, rr.Transform3D(translation=[robot.lidar_offset_m, 0, LIDAR_HEIGHT_M]), static=True)
    angles = np.arange(n_beams) * (2 * np.pi / max(n_beams, 1))
    directions = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(n_beams)])
    ends = trace.scans_m[..., None] * directions
    rays = np.stack([np.zeros_like(ends), ends], axis=2).astype(np.float32)
    measured = np.isfinite(trace.scans_m)
    # A beam that reads the longest range met nothing.
    hit = measured & (trace.scans_m < robot.lidar_range_m)

    recording.log(f"{at}/rays", rr.LineStrips3D.from_fields(radii=[-0.5], colors=_rgba(palette.SKY)), static=True)
    recording.log(f"{at}/hits", rr.Points3D.from_fields(radii=[-4.0], colors=_rgba(palette.PURPLE)), static=True)
    lines = rr.LineStrips3D.columns(strips=rays[measured]).partition(measured.sum(axis=1))
    points = rr.Points3D.columns(positions=ends[hit]).partition(hit.sum(axis=1))
    _send(recording, f"{at}/rays", _times(trace), lines)
    _send(recording, f"{at}/hits", _times(trace), points)


def _log_course(recording: rr.RecordingStream, at: str, trace: Trace, robot: Robot) -> None:
    """The way taken, coloured by speed, and where it touched walls; both from start to end, at all times."""
    points = np.column_stack([trace.poses[:, :2], np.full(len(trace.poses), 0.012)])
    speeds = np.linalg.norm(np.diff(trace.poses[:, :2], axis=0), axis=1) / np.diff(trace.time_s)
    # Diverged physics leaves a pose that is no number.
    share = np.nan_to_num(np.clip(speeds / robot.max_speed_m_s, 0.0, 1.0))[:, None]
    colours = np.round((1 - share) * _rgba(palette.SLOW) + share * _rgba(palette.FAST)).astype(np.uint8)
    trail = rr.LineStrips3D(np.stack([points[:-1], points[1:]], axis=1), colors=colours, radii=-2.0)
    recording.log(f"{at}/trail", trail, static=True)
    touched = points[1:][trace.hits > 0] + [0, 0, 0.01]
    marks = rr.Points3D(touched, colors=_rgba(palette.COLLISION), radii=-5.0)
    recording.log(f"{at}/collisions", marks, static=True)


# ---- Curves and text ---------------------------------------------------------------------------


def _log_reward_and_action(recording: rr.RecordingStream, name: str, trace: Trace) -> None:
    """The return by terms, summed up to each step's end; actions from their step's beginning to its end."""
    colours = palette.SERIES
    # One step's progress would be invisible beside the reward at the goal; sums are of one size.
    earned = {term: np.cumsum(values) for term, values in trace.reward_terms.items()}
    _log_curves(recording, _path("return", name), _times(trace, slice(1, None)), earned, colours)
    commands = ["move"] if _is_grid(trace) else ["forward", "turn"]
    actions = dict(zip(commands, trace.actions.T, strict=True))
    _log_curves(
        recording, _path("action", name), _times(trace, slice(None, -1)), actions, colours, interpolation="StepAfter"
    )


def _log_curves(
    recording: rr.RecordingStream,
    at: str,
    times: list[rr.TimeColumn],
    curves: Mapping[str, AnyArray],
    colours: list[str] | tuple[str, ...],
    interpolation: Literal["Linear", "StepAfter"] = "Linear",
) -> None:
    """Named curves of equal length in one entity."""
    n = len(curves)
    style = rr.SeriesLines(
        names=list(curves),
        colors=[_rgba(colours[i % len(colours)]) for i in range(n)],
        widths=[1.5] * n,
        interpolation_mode=interpolation,
    )
    recording.log(at, style, static=True)
    values = np.column_stack(list(curves.values())).astype(np.float64)
    _send(recording, at, times, rr.Scalars.columns(scalars=values.ravel()).partition(np.full(len(values), n)))


def _run_card(title: str, rollouts: Mapping[str, Episode], properties: Mapping[str, str]) -> str:
    """What the recording shows, in Markdown."""
    first = next(iter(rollouts.values()))
    lines = [
        f"# {_plain(title)}",
        f"From cell {first.start} to cell {first.goal} (row, column), the same in each view.",
        "",
        "| rollout | goal | path m | shortest m | time s | hits | return |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name, episode in rollouts.items():
        lines.append(
            f"| {_plain(name)} | {'reached' if episode.is_success else '**missed**'} "
            f"| {episode.path_length_m:.2f} | {episode.shortest_path_m:.2f} | {episode.elapsed_s:.1f} "
            f"| {episode.collisions} | {episode.episode_return:.2f} |"
        )
    lines += ["", "Trail: orange is slow, blue is full speed. Red: collisions.", ""]
    lines += [f"- {_plain(key)}: {_plain(value)}" for key, value in properties.items()]
    return "\n".join(lines)


def _plain(text: str) -> str:
    """Text on one line that cannot break a Markdown table."""
    return " ".join(text.replace("|", "/").split())


# ---- The arrangement ---------------------------------------------------------------------------


def _blueprint(layout: Layout, traces: Mapping[str, Trace]) -> rrb.Blueprint:
    """The mazes side by side, each with its curves below; on the right what they share."""
    mazes = [
        rrb.Spatial3DView(
            name=name,
            origin=_path("rollouts", name),
            eye_controls=_eye(layout, len(traces)),
            background=[255, 255, 255],
            line_grid=False,
        )
        for name in traces
    ]
    rewards = [
        _curve_view(f"{name}: reward so far", _path("return", name), rrb.PlotLegend(rrb.Corner2D.LeftTop))
        for name in traces
    ]
    # A legend would cover these low plots: their titles say it.
    actions = [
        _curve_view(f"{name}: {_action_words(trace)}", _path("action", name), rrb.PlotLegend(visible=False))
        for name, trace in traces.items()
    ]
    rows = [rrb.Horizontal(*views) for views in (mazes, rewards, actions)]
    to_goal = rrb.PlotLegend(rrb.Corner2D.LeftBottom)
    shared = [
        rrb.TextDocumentView(name="Run", origin="/run_card"),
        _curve_view("Shortest way to the goal (m)", "/distance_to_goal", to_goal),
    ]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(*rows, row_shares=[10, 6, 4]),
            rrb.Vertical(*shared, row_shares=[1, 1]),
            column_shares=[max(len(traces), 2), 1],
        ),
        rrb.TimePanel(state="collapsed", timeline="sim_time"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
    )


def _curve_view(name: str, origin: str, legend: rrb.PlotLegend) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(name=name, origin=origin, plot_legend=legend)


def _action_words(trace: Trace) -> str:
    return "up 0, down 1, left 2, right 3" if _is_grid(trace) else "forward (blue), turn (orange)"


def _eye(layout: Layout, n_views: int) -> rrb.EyeControls3D:
    """From above and a little from the south, so far away that the whole maze is in sight of a narrow view."""
    width, height = layout.size_m
    centre = np.array([width / 2, height / 2, 0.0])
    tilt = np.deg2rad(20.0)
    away = max(1.05, 0.47 * n_views) * max(width, height) * np.array([0.0, -np.sin(tilt), np.cos(tilt)])
    return rrb.EyeControls3D(kind="Orbital", position=centre + away, look_target=centre, eye_up=[0, 0, 1])


# ---- Small parts -------------------------------------------------------------------------------


def _is_grid(trace: Trace) -> bool:
    return bool(trace.actions.shape[1] == 1)


def _times(trace: Trace, part: slice = slice(None)) -> list[rr.TimeColumn]:
    """Both timelines of the trace's states, or of a part of them."""
    steps = np.arange(len(trace.time_s))
    return [rr.TimeColumn("sim_time", duration=trace.time_s[part]), rr.TimeColumn("step", sequence=steps[part])]


def _send(recording: rr.RecordingStream, at: str, times: list[rr.TimeColumn], columns: rr.ComponentColumnList) -> None:
    # Not strict, a failure would be a warning and the data would be missing.
    recording.send_columns(at, times, columns, strict=True)


def _path(*parts: str) -> str:
    return "/" + "/".join(rr.escape_entity_path_part(part) for part in parts)


def _rgba(colour: str, alpha: int = 255) -> AnyArray:
    """``#RRGGBB`` as four bytes."""
    return np.array([*bytes.fromhex(colour[1:]), alpha], dtype=np.uint8)


# ---- Looking at a recording --------------------------------------------------------------------


def open_viewer(recording_path: str | Path) -> None:
    """Show a recording in the Rerun viewer; returns when its window is closed.

    Raises:
        ViewerError: When there is no display, no viewer, or no graphics driver.
    """
    path = _existing(recording_path)
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ViewerError(
            "no display here: use `gridnav view RUN --screenshot out.png`, or copy "
            f"{path.name} to a machine with a display and run `rerun {path.name}` there"
        )
    command = [*_viewer_command("auto"), str(path)]
    done = subprocess.run(command, env=_viewer_environment(), capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise _viewer_failure(done.stderr)


def screenshot(
    recording_path: str | Path,
    png_path: str | Path,
    *,
    time_s: float | None = None,
    window_size: tuple[int, int] = (1600, 1000),
) -> None:
    """Picture of a recording in the Rerun viewer, made without a display.

    Args:
        recording_path: The .rrd file.
        png_path: The picture to write; its folder exists.
        time_s: Moment on the timeline ``sim_time``, seconds; the end by default.
        window_size: Width and height, pixels.

    Raises:
        ViewerError: When there is no viewer or no graphics driver, or a view reports an error.
    """
    path = _existing(recording_path)
    with _headless_viewer(window_size) as client:
        client.open(path.resolve().as_uri())
        _wait_until(lambda: not client.get_state().loading, "load the recording")
        if time_s is None:
            time_s = _end_s(client)
        client.set_time("sim_time", duration=time_s, play_state="paused")
        client.run_command("ui.toggle_top_panel")
        picture = _settled_picture(client)
        errors = [
            f"{v.name}: {r.summary}" for v in client.get_state().views for r in v.reports if r.severity == "error"
        ]
        if errors:
            raise ViewerError(f"the viewer cannot show {path.name}: {'; '.join(errors)}")
    Path(png_path).write_bytes(picture)


@contextmanager
def _headless_viewer(window_size: tuple[int, int]) -> Iterator[ViewerClient]:
    """A viewer without a window, that only this machine can reach; its processes end with the block."""
    port = _free_port()
    size = "{}x{}".format(*window_size)
    command = [*_viewer_command(str(port)), "--headless", "--hide-welcome-screen", "--window-size", size]
    with tempfile.TemporaryFile() as log:
        # The `rerun` command starts the real viewer as its child: a session of their own ends them together.
        process = subprocess.Popen(
            command, env=_viewer_environment(), stdout=log, stderr=log, stdin=subprocess.DEVNULL, start_new_session=True
        )
        try:
            _wait_until(lambda: process.poll() is not None or _is_open(port), "start")
            if process.poll() is not None:
                raise _viewer_failure(_text(log))
            yield ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
        except ViewerError:
            raise
        except (OSError, RuntimeError) as error:
            # Without a driver the viewer answers first and ends then, and says why.
            with suppress(subprocess.TimeoutExpired):
                process.wait(2.0)
            raise _viewer_failure(str(error) if process.poll() is None else _text(log)) from None
        finally:
            _end(process)


def _viewer_command(port: str) -> list[str]:
    """The viewer of this Python environment, else the one on the path; bound to this machine, not to the network."""
    beside = Path(sys.executable).with_name("rerun.exe" if os.name == "nt" else "rerun")
    program = str(beside) if beside.exists() else shutil.which("rerun")
    if program is None:
        raise ViewerError("no `rerun` program here: install it with `pip install 'rerun-sdk>=0.41,<0.42'`")
    return [program, "--bind", "127.0.0.1", "--port", port]


def _viewer_environment() -> dict[str, str]:
    # The viewer sends no usage statistics where this says that it runs in continuous integration.
    return {**os.environ, "CI": "1"}


def _viewer_failure(log: str) -> ViewerError:
    """One line from what the viewer wrote, or from what asking it gave."""
    if "graphics adapter" in log or "render context" in log:
        return ViewerError(
            "the Rerun viewer found no Vulkan driver: install one, for example with "
            "`apt-get install mesa-vulkan-drivers`, which draws on the processor"
        )
    lines = [line.strip() for line in log.splitlines() if line.strip()]
    telling = [line for line in lines if "panicked at" in line or line.startswith("Error")] or lines[-1:]
    return ViewerError(f"the Rerun viewer failed: {telling[0] if telling else 'it gave no reason'}")


def _existing(recording_path: str | Path) -> Path:
    path = Path(recording_path)
    if not path.is_file():
        raise ViewerError(f"there is no recording {str(path)!r}")
    return path


def _end_s(client: ViewerClient) -> float:
    """Last moment of ``sim_time``, which the viewer counts in nanoseconds."""
    timelines = [t for recording in client.get_state().recordings for t in recording.timelines]
    return max((t.end or 0) / 1e9 for t in timelines if t.name == "sim_time")


def _settled_picture(client: ViewerClient) -> bytes:
    """A PNG of the whole window, once pop-up notes have faded and plots have stopped zooming."""
    faded = time.monotonic() + NOTES_FADE_S
    picture = client.take_screenshot()

    def settled() -> bool:
        nonlocal picture
        before, picture = picture, client.take_screenshot()
        return before == picture and time.monotonic() > faded

    _wait_until(settled, "finish its picture")
    return picture


def _wait_until(condition: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + VIEWER_PATIENCE_S
    while not condition():
        if time.monotonic() > deadline:
            raise ViewerError(f"the Rerun viewer did not {what} within {VIEWER_PATIENCE_S:.0f} s")
        time.sleep(0.05)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _is_open(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def _end(process: subprocess.Popen[bytes]) -> None:
    """End the process and its children."""
    if os.name == "nt":
        subprocess.run(["taskkill", "/PID", str(process.pid), "/T", "/F"], capture_output=True, check=False)
    else:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _text(log: IO[bytes]) -> str:
    log.seek(0)
    return log.read().decode(errors="replace")
