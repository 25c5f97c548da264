"""Rollouts as a Rerun recording, and pictures of it.

Every call to Rerun in the project is in this file, because its interface changes in most releases; ``viewer.py`` has
the processes. A recording holds rollouts on common timelines, ``sim_time`` in seconds and ``step``. Its entities, with
``NAME`` a rollout's name:

    /rollouts/NAME/maze, start, goal                      the scene
    /rollouts/NAME/policy/values, arrows                  what the agent makes of the maze, for this goal
    /rollouts/NAME/distance_field, plan                   shortest ways to the goal, and the one from the start
    /rollouts/NAME/trail, collisions                      the whole course, at all times
    /rollouts/NAME/robot, robot/body, heading, wheels     where the robot is
    /rollouts/NAME/robot/lidar/rays, hits                 what it sees, in the lidar's frame
    /return/NAME, /action/NAME, /wheel_speed/NAME,        curves
    /distance_to_goal/NAME
    /state/1_NAME                                         what it does, in words; the second rollout's is 2_NAME
    /run_card                                             what this is, in Markdown
    /drawn                                                what was drawn for each rollout, where something varied

An overlay of many episodes has ``/maze``, ``/trails``, ``/robots``, ``/ends`` and ``/arrived`` instead.
Data goes in as columns, one call per entity: one call per step is forty times slower.
"""

from __future__ import annotations

import re
import time
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Literal

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import RrdReader
from rerun.experimental import ViewerClient

from gridnav.display import palette
from gridnav.display.policy_map import PolicyMap
from gridnav.display.viewer import ViewerError, existing, headless_viewer, wait_until
from gridnav.problem.geodesic import Geodesic, cell_path
from gridnav.problem.layout import Layout
from gridnav.problem.metrics import STILL_SHARE, Episode, Trace
from gridnav.problem.robot import BURGER, LIDAR_HEIGHT_M, Robot
from gridnav.problem.types import AnyArray, Cell, FloatArray, InputError, IntArray

WALL_HEIGHT_M = 0.25
OUTER_WALL_M = 0.05
"""Thickness at which the outer wall is drawn."""
WHEEL_WIDTH_M = 0.018
"""Of the robot's tyres (ROBOTIS-GIT/turtlebot3, ``turtlebot3_burger.urdf``)."""
BODY_HEIGHT_M = 0.192
"""Of the robot (ROBOTIS e-manual, TurtleBot3 specifications)."""
GRID_BODY_SHARE = 0.5
"""Side of the box that stands for a grid robot, as a share of the cell."""

SEND_PATIENCE_S = 1.0
"""How long a viewer may take to accept an episode."""
NOTES_FADE_S = 4.5
"""The headless viewer's notes about itself are gone four seconds after it answers."""
SUM = "#9AA5B1"
"""Colour of the whole return: seen on a light and on a dark background."""
FIELD_DOTS = 4
"""Pixels of the distance field along the side of a cell."""
STATES = {
    "driving": palette.BLUE,
    "turning": palette.SKY,
    "standing": palette.GRID_LINE,
    "collided": palette.COLLISION,
    "arrived": palette.GOAL,
    "did not arrive": palette.ORANGE,
    "physics error": palette.PURPLE,
}
"""What a robot is doing, and how an episode ended."""


def write_recording(
    path: str | Path,
    layout: Layout,
    rollouts: Mapping[str, Episode],
    *,
    maps: Mapping[str, PolicyMap] | None = None,
    title: str = "gridnav rollout",
    properties: Mapping[str, object] | None = None,
    units: Mapping[str, str] | None = None,
    robot: Robot = BURGER,
) -> None:
    """Write one or more rollouts in the same maze to an .rrd file, side by side on one timeline.

    Args:
        path: The file to write; its folder exists.
        layout: The maze.
        rollouts: Name to episode, each with a trace. Grid rollouts have one number per action, robots two.
        maps: Values and policy of the agents of some rollouts, by the same names, for the floor.
        title: Heading of the run card, and the recording's name in the viewer.
        properties: Seeds, command, versions: shown on the run card and stored with the recording.
        units: Of what was drawn for the rollouts, by quantity.
        robot: Body and lidar to draw.

    Raises:
        ValueError: When there is no rollout, one without a trace, or one with another start or goal.
    """
    traces = _same_course(rollouts)
    card = _run_card(title, rollouts, properties)
    recording = rr.RecordingStream("gridnav", send_properties=False)
    recording.save(path, default_blueprint=_side_by_side(layout, traces, varied=_varies(rollouts)))
    _log_head(recording, title, properties, card)
    _log_drawn(recording, rollouts, units or {})
    _log_rollouts(recording, layout, rollouts, maps, robot)
    # Only this writes the footer that readers need.
    recording.disconnect()


def send_recording(
    address: str,
    layout: Layout,
    rollouts: Mapping[str, Episode],
    *,
    maps: Mapping[str, PolicyMap] | None = None,
    title: str = "gridnav rollout",
    units: Mapping[str, str] | None = None,
    robot: Robot = BURGER,
) -> None:
    """Send what ``write_recording`` writes to a viewer that runs, as a recording of its own.

    Args:
        address: The viewer's, ``rerun+http://127.0.0.1:PORT/proxy``. Nothing happens where none answers.
        layout: The maze.
        rollouts: See ``write_recording``.
        maps: See there.
        title: See there.
        units: See there.
        robot: See there.
    """
    recording = rr.RecordingStream("gridnav", send_properties=False)
    recording.connect_grpc(address)
    recording.send_blueprint(_side_by_side(layout, _same_course(rollouts), varied=_varies(rollouts)))
    _log_head(recording, title, None, _run_card(title, rollouts, None))
    _log_drawn(recording, rollouts, units or {})
    _log_rollouts(recording, layout, rollouts, maps, robot)
    # What nobody takes is dropped: a viewer that was closed must not hold training up.
    with suppress(RuntimeError):
        recording.flush(timeout_sec=SEND_PATIENCE_S)
    recording.disconnect()


def _same_course(rollouts: Mapping[str, Episode]) -> dict[str, Trace]:
    """The traces of rollouts that share start and goal."""
    traces = _traces_of(list(rollouts.values()))
    ends = {(episode.start, episode.goal) for episode in rollouts.values()}
    if len(ends) > 1:
        raise ValueError(f"the rollouts of a recording share one start and goal, not {sorted(ends)}")
    return dict(zip(rollouts, traces, strict=True))


def _traces_of(episodes: Sequence[Episode]) -> list[Trace]:
    traces = [episode.trace for episode in episodes if episode.trace is not None]
    if not traces or len(traces) < len(episodes):
        raise ValueError(f"a recording needs episodes, each with a trace: {len(episodes)} have {len(traces)}")
    return traces


def _log_rollouts(
    recording: rr.RecordingStream,
    layout: Layout,
    rollouts: Mapping[str, Episode],
    maps: Mapping[str, PolicyMap] | None,
    robot: Robot,
) -> None:
    distance = Geodesic(layout, min(robot.radius_m, 0.49 * layout.cell_size_m))
    for number, (name, episode) in enumerate(rollouts.items()):
        trace, here, goal = episode.trace, _path("rollouts", name), episode.goal
        assert trace is not None
        _log_scene(recording, here, layout, layout.to_metres(np.array([episode.start, goal])))
        _log_ways(recording, here, trace, layout, distance, goal)
        if maps and name in maps:
            _log_policy(recording, f"{here}/policy", layout, maps[name])
        _log_robot(recording, f"{here}/robot", trace, layout, robot)
        _log_course(recording, here, trace, robot)
        to_goal = distance.distances(trace.poses[:, :2], np.full(len(trace.poses), distance.goal_number(goal)))
        colour = palette.SERIES[number % len(palette.SERIES)]
        _log_curves(recording, _path("distance_to_goal", name), _times(trace), {name: to_goal}, [colour])
        _log_reward_and_action(recording, name, trace, robot)
        # The viewer writes this path above the row, in this order: without the signs that it would escape.
        _log_states(recording, f"/state/{number + 1}_{re.sub(r'[^A-Za-z0-9.-]+', '_', name)}", episode, trace, robot)


def write_overlay(
    path: str | Path,
    layout: Layout,
    episodes: Sequence[Episode],
    *,
    title: str = "gridnav episodes",
    properties: Mapping[str, object] | None = None,
    robot: Robot = BURGER,
) -> None:
    """Write many episodes in the same maze to an .rrd file, one above the other.

    Args:
        path: The file to write; its folder exists.
        layout: The maze.
        episodes: Each with a trace; starts and goals may differ.
        title: Heading of the run card, and the recording's name in the viewer.
        properties: Seeds, command, versions: shown on the run card and stored with the recording.
        robot: Body to draw.

    Raises:
        ValueError: When there is no episode, or one without a trace.
    """
    traces = _traces_of(episodes)
    card = _overlay_card(title, episodes, properties)
    recording = rr.RecordingStream("gridnav", send_properties=False)
    recording.save(path, default_blueprint=_overlaid(layout))
    _log_head(recording, title, properties, card)
    _log_maze(recording, "/maze", layout)
    half = 0.45 * layout.cell_size_m
    for name, cells, colour in (
        ("starts", [one.start for one in episodes], palette.START),
        ("goals", [one.goal for one in episodes], palette.GOAL),
    ):
        centres = layout.to_metres(np.unique(np.array(cells), axis=0))
        _log_boxes(recording, f"/ends/{name}", np.column_stack([centres - half, centres + half]), 0.0, 0.004, colour)
    for is_success, name in ((True, "arrived"), (False, "missed")):
        ways = [
            np.column_stack([trace.poses[:, :2], np.full(len(trace.poses), 0.012)])
            for trace, episode in zip(traces, episodes, strict=True)
            if episode.is_success == is_success
        ]
        colour = palette.ARRIVED if is_success else palette.MISSED
        recording.log(f"/trails/{name}", rr.LineStrips3D(ways, colors=_rgba(colour, 170), radii=-1.5), static=True)
    _log_crowd(recording, layout, episodes, traces, robot)
    recording.disconnect()


def _log_head(recording: rr.RecordingStream, title: str, properties: Mapping[str, object] | None, card: str) -> None:
    """Name, properties and run card."""
    recording.send_recording_name(title)
    if properties:
        shown = {key: str(value) for key, value in properties.items()}
        recording.send_property("run", rr.AnyValues(drop_untyped_nones=True, **shown))
    recording.log("run_card", rr.TextDocument(card, media_type=rr.MediaType.MARKDOWN), static=True)


def _varies(rollouts: Mapping[str, Episode]) -> bool:
    return any(episode.randomization for episode in rollouts.values())


def _log_drawn(recording: rr.RecordingStream, rollouts: Mapping[str, Episode], units: Mapping[str, str]) -> None:
    """What was drawn for each rollout, as a table; nothing where nothing varied."""
    if not _varies(rollouts):
        return
    drawn = {name: episode.randomization for name, episode in rollouts.items() if episode.randomization}
    lines = [
        f"| quantity | {' | '.join(_in_cell(name) for name in drawn)} | unit |",
        f"| --- |{' ---: |' * len(drawn)} --- |",
    ]
    for quantity in dict.fromkeys(name for values in drawn.values() for name in values):
        values = [f"{values[quantity]:.4g}" if quantity in values else "" for values in drawn.values()]
        lines.append(f"| {_in_cell(quantity)} | {' | '.join(values)} | {_in_cell(units.get(quantity, ''))} |")
    recording.log("drawn", rr.TextDocument("\n".join(lines), media_type=rr.MediaType.MARKDOWN), static=True)


# ---- The scene ---------------------------------------------------------------------------------


def _log_scene(recording: rr.RecordingStream, at: str, layout: Layout, ends_w: FloatArray) -> None:
    """The maze, and the start and goal cells, whose centres are ``ends_w``, shape ``(2, 2)``, metres."""
    _log_maze(recording, f"{at}/maze", layout)
    half = 0.45 * layout.cell_size_m
    for name, centre, colour in zip(("start", "goal"), ends_w, (palette.START, palette.GOAL), strict=True):
        tile = np.concatenate([centre - half, centre + half])[None]
        _log_boxes(recording, f"{at}/{name}", tile, 0.0, 0.004, colour)


def _log_maze(recording: rr.RecordingStream, at: str, layout: Layout) -> None:
    """Floor and walls."""
    (width, height), edge = layout.size_m, OUTER_WALL_M
    outer = [
        (-edge, -edge, width + edge, 0.0),
        (-edge, height, width + edge, height + edge),
        (-edge, 0.0, 0.0, height),
        (width, 0.0, width + edge, height),
    ]
    walls = np.concatenate([layout.wall_rectangles(), outer])
    _log_boxes(recording, f"{at}/walls", walls, 0.0, WALL_HEIGHT_M, palette.WALL)
    _log_boxes(recording, f"{at}/floor", np.array([[0, 0, width, height]]), -0.02, 0.0, palette.FLOOR)


def _log_boxes(
    recording: rr.RecordingStream, at: str, rectangles_w: FloatArray, bottom_m: float, top_m: float, colour: str
) -> None:
    """Solid boxes over rectangles x_min, y_min, x_max, y_max, shape ``(n, 4)``, metres."""
    n = len(rectangles_w)
    low = np.column_stack([rectangles_w[:, :2], np.full(n, bottom_m)])
    high = np.column_stack([rectangles_w[:, 2:], np.full(n, top_m)])
    boxes = rr.Boxes3D(mins=low, sizes=high - low, colors=_rgba(colour), fill_mode="solid")
    recording.log(at, boxes, static=True)


def _log_policy(recording: rr.RecordingStream, at: str, layout: Layout, shown: PolicyMap) -> None:
    """Values as colours on the floor, and an arrow in each cell; at full speed two thirds of a cell long."""
    _log_floor_map(recording, f"{at}/values", layout, np.where(layout.walls, np.nan, shown.values), 0.002, "Viridis")
    cells = np.argwhere(np.isfinite(shown.directions_rad) & ~layout.walls)
    inside = tuple(cells.T)
    directions = np.column_stack([np.cos(shown.directions_rad[inside]), np.sin(shown.directions_rad[inside])])
    vectors = directions * layout.cell_size_m * (0.25 + 0.4 * np.clip(shown.speeds[inside], 0, 1))[:, None]
    origins = layout.to_metres(cells) - vectors / 2
    flat = [np.column_stack([part, np.full(len(part), height)]) for part, height in ((origins, 0.008), (vectors, 0.0))]
    arrows = rr.Arrows3D(origins=flat[0], vectors=flat[1], radii=0.035, colors=_rgba("#FFFFFF", 200))
    recording.log(f"{at}/arrows", arrows, static=True)


def _log_floor_map(
    recording: rr.RecordingStream, at: str, layout: Layout, values: FloatArray, height_m: float, colormap: str
) -> None:
    """Numbers on the floor, row 0 at the top; NaN as the lowest of them."""
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    share = (np.nan_to_num(values, nan=low) - low) / max(high - low, 1e-9)
    n_rows, n_cols = values.shape
    colormap_of = {"Viridis": rr.components.Colormap.Viridis, "Magma": rr.components.Colormap.Magma}
    grid = rr.GridMap(
        data=np.round(255 * share).astype(np.uint8).tobytes(),
        format=rr.components.ImageFormat(width=n_cols, height=n_rows, color_model="L", channel_datatype="U8"),
        cell_size=layout.size_m[0] / n_cols,
        translation=[0.0, 0.0, height_m],
        colormap=colormap_of[colormap],
    )
    recording.log(at, grid, static=True)


def _log_ways(
    recording: rr.RecordingStream, at: str, trace: Trace, layout: Layout, distance: Geodesic, goal: Cell
) -> None:
    """The shortest way from the start, by cells or any-angle; and how far the goal is from everywhere, if asked for."""
    start = trace.poses[0, :2]
    if trace.is_on_grid:
        cells = cell_path(layout, tuple(layout.to_cell(start[None])[0].tolist()), goal)
        points = layout.to_metres(np.array(cells))
    else:
        points = distance.path(start, goal)
    # Under the trail and broader than it: both are seen where they are one.
    plan = np.column_stack([points, np.full(len(points), 0.01)])
    recording.log(f"{at}/plan", rr.LineStrips3D([plan], colors=_rgba(palette.PURPLE), radii=-2.5), static=True)
    dots = np.stack(
        np.meshgrid(
            (np.arange(layout.n_cols * FIELD_DOTS) + 0.5) * layout.cell_size_m / FIELD_DOTS,
            layout.size_m[1] - (np.arange(layout.n_rows * FIELD_DOTS) + 0.5) * layout.cell_size_m / FIELD_DOTS,
        ),
        axis=-1,
    )
    far = distance.distances(dots.reshape(-1, 2), np.full(dots.size // 2, distance.goal_number(goal)))
    field = np.where(np.isfinite(far), far, np.nan).reshape(dots.shape[:2])
    _log_floor_map(recording, f"{at}/distance_field", layout, -field, 0.001, "Magma")


def _log_robot(recording: rr.RecordingStream, at: str, trace: Trace, layout: Layout, robot: Robot) -> None:
    """The moving body, red in a collision, and what its lidar sees."""
    zero = np.zeros(len(trace.poses))
    half_turn = zero if trace.is_on_grid else trace.poses[:, 2] / 2  # a grid robot has no front
    turns = np.column_stack([zero, zero, np.sin(half_turn), np.cos(half_turn)])  # x, y, z, w
    places = np.column_stack([trace.poses[:, :2], zero])
    _send(recording, at, _times(trace), rr.Transform3D.columns(translation=places, quaternion=turns))

    hit = np.concatenate([[False], trace.hits > 0])
    changes = np.flatnonzero(np.concatenate([[True], hit[1:] != hit[:-1]]))  # a colour stays until the next one
    colours = np.where(hit[changes, None], _rgba(palette.COLLISION), _rgba(palette.INK))
    body = f"{at}/body"
    if trace.is_on_grid:
        half = GRID_BODY_SHARE * layout.cell_size_m / 2
        box = rr.Boxes3D(half_sizes=[half, half, half / 2], centers=[0, 0, half / 2], fill_mode="solid")
        recording.log(body, box, static=True)
        _send(recording, body, _times(trace, changes), rr.Boxes3D.columns(colors=colours))
        return
    clear = 2 * robot.wheel_radius_m  # the wheels stand out below
    cylinder = rr.Cylinders3D(
        lengths=[BODY_HEIGHT_M - clear],
        radii=[robot.radius_m],
        centers=[0, 0, (BODY_HEIGHT_M + clear) / 2],
        fill_mode="solid",
    )
    recording.log(body, cylinder, static=True)
    _send(recording, body, _times(trace, changes), rr.Cylinders3D.columns(colors=colours))
    arrow = rr.Arrows3D(
        origins=[0, 0, BODY_HEIGHT_M + 0.03],
        vectors=[2.5 * robot.radius_m, 0, 0],
        radii=[0.025],
        colors=_rgba(palette.ORANGE),
    )
    recording.log(f"{at}/heading", arrow, static=True)
    _log_wheels(recording, f"{at}/wheels", trace, robot)
    _log_lidar(recording, f"{at}/lidar", trace, robot)


def _log_wheels(recording: rr.RecordingStream, at: str, trace: Trace, robot: Robot) -> None:
    """Two wheels that roll as far as the robot went, with a mark on each."""
    rolled = np.concatenate(
        [np.zeros((1, 2)), np.cumsum(_wheel_speeds(trace, robot) * np.diff(trace.time_s)[:, None], 0)]
    )
    for number, (name, side) in enumerate((("left", 1), ("right", -1))):
        # The wheel's frame has its axle along z: laid along the robot's y, and then rolled about it.
        half = rolled[:, number] / 2
        turns = np.column_stack([np.cos(half), np.sin(half), -np.sin(half), np.cos(half)]) / np.sqrt(2)
        here = [0.0, side * robot.wheel_separation_m / 2, robot.wheel_radius_m]
        recording.log(f"{at}/{name}", rr.Transform3D.from_fields(translation=here), static=True)
        _send(recording, f"{at}/{name}", _times(trace), rr.Transform3D.columns(quaternion=turns))
        # A rod across, a little thicker than the tyre, shows that it turns.
        across = [0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5)]  # about y, x y z w
        shape = rr.Cylinders3D(
            lengths=[WHEEL_WIDTH_M, 1.8 * robot.wheel_radius_m],
            radii=[robot.wheel_radius_m, 0.55 * WHEEL_WIDTH_M],
            quaternions=[[0.0, 0.0, 0.0, 1.0], across],
            colors=[_rgba(palette.WALL), _rgba(palette.FLOOR)],
            fill_mode="solid",
        )
        recording.log(f"{at}/{name}/shape", shape, static=True)


def _wheel_speeds(trace: Trace, robot: Robot) -> FloatArray:
    """Left and right, rad/s, that give the motion of each step if nothing slips, shape ``(t, 2)``."""
    step_s = np.diff(trace.time_s)
    heading = np.unwrap(trace.poses[:, 2])
    middle = (heading[1:] + heading[:-1]) / 2
    forward = (np.diff(trace.poses[:, :2], axis=0) * np.column_stack([np.cos(middle), np.sin(middle)])).sum(axis=1)
    return robot.wheel_turns(forward, np.diff(heading)) / step_s[:, None]


def _log_lidar(recording: rr.RecordingStream, at: str, trace: Trace, robot: Robot) -> None:
    """Rays, and points where they hit, in the lidar's frame: x ahead, at the height of the scan."""
    n_beams = trace.scans_m.shape[1]
    recording.log(at, rr.Transform3D(translation=[robot.lidar_offset_m, 0, LIDAR_HEIGHT_M]), static=True)
    angles = np.arange(n_beams) * (2 * np.pi / max(n_beams, 1))
    directions = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(n_beams)])
    ends = trace.scans_m[..., None] * directions
    measured = np.isfinite(trace.scans_m)
    # A beam that reads the longest range met nothing.
    hit = measured & (trace.scans_m < robot.lidar_range_m)

    recording.log(f"{at}/rays", rr.Arrows3D.from_fields(radii=[-0.5], colors=_rgba(palette.SKY)), static=True)
    recording.log(f"{at}/hits", rr.Points3D.from_fields(radii=[-4.0], colors=_rgba(palette.PURPLE)), static=True)
    # Arrows begin at the lidar by themselves: half of what strips of two points take.
    lines = rr.Arrows3D.columns(vectors=ends[measured]).partition(measured.sum(axis=1))
    points = rr.Points3D.columns(positions=ends[hit]).partition(hit.sum(axis=1))
    _send(recording, f"{at}/rays", _times(trace), lines)
    _send(recording, f"{at}/hits", _times(trace), points)


def _log_course(recording: rr.RecordingStream, at: str, trace: Trace, robot: Robot) -> None:
    """The way taken, coloured by speed, and where it touched walls; both from start to end, at all times."""
    points = np.column_stack([trace.poses[:, :2], np.full(len(trace.poses), 0.02)])
    speeds = np.linalg.norm(np.diff(trace.poses[:, :2], axis=0), axis=1) / np.diff(trace.time_s)
    share = np.clip(speeds / robot.max_speed_m_s, 0.0, 1.0)[:, None]
    colours = np.round((1 - share) * _rgba(palette.SLOW) + share * _rgba(palette.FAST)).astype(np.uint8)
    trail = rr.LineStrips3D(np.stack([points[:-1], points[1:]], axis=1), colors=colours, radii=-1.5)
    recording.log(f"{at}/trail", trail, static=True)
    touched = points[1:][trace.hits > 0] + [0, 0, 0.01]
    marks = rr.Points3D(touched, colors=_rgba(palette.COLLISION), radii=-5.0)
    recording.log(f"{at}/collisions", marks, static=True)


# ---- Curves and text ---------------------------------------------------------------------------


def _log_crowd(
    recording: rr.RecordingStream, layout: Layout, episodes: Sequence[Episode], traces: Sequence[Trace], robot: Robot
) -> None:
    """All robots at once as balls, each until its end, where it stays."""
    longest = max(traces, key=lambda trace: float(trace.time_s[-1]))
    steps = np.arange(len(longest.time_s))
    at = np.stack([trace.poses[np.minimum(steps, len(trace.poses) - 1), :2] for trace in traces], axis=1)
    colours = np.array([_rgba(palette.ARRIVED if one.is_success else palette.MISSED) for one in episodes])
    radius = GRID_BODY_SHARE * layout.cell_size_m / 2 if longest.is_on_grid else robot.radius_m
    points = np.concatenate([at, np.full((*at.shape[:2], 1), radius)], axis=2).astype(np.float32)
    recording.log("/robots", rr.Points3D.from_fields(colors=colours, radii=[radius]), static=True)
    columns = rr.Points3D.columns(positions=points.reshape(-1, 3)).partition(np.full(len(steps), len(traces)))
    _send(recording, "/robots", _times(longest), columns)
    arrived = np.array(
        [[one.is_success and n >= len(t.actions) for n in steps] for one, t in zip(episodes, traces, strict=True)]
    )
    _log_curves(recording, "/arrived", _times(longest), {"arrived": arrived.mean(axis=0)}, [palette.ARRIVED])


def _log_states(recording: rr.RecordingStream, at: str, episode: Episode, trace: Trace, robot: Robot) -> None:
    """What the robot is doing, wherever that changes, and how the episode ended."""
    states = _states(trace, robot)
    ended = "arrived" if episode.is_success else "physics error" if episode.physics_error else "did not arrive"
    names = [*states, ended]
    changes = [i for i in range(len(names)) if i == 0 or names[i] != names[i - 1]]
    style = rr.StateConfiguration(values=list(STATES), colors=[_rgba(c) for c in STATES.values()])
    recording.log(at, style, static=True)
    _send(recording, at, _times(trace, np.array(changes)), rr.StateChange.columns(state=[names[i] for i in changes]))


def _states(trace: Trace, robot: Robot) -> list[str]:
    """One word for each step."""
    step_s = np.diff(trace.time_s)
    speed = np.linalg.norm(np.diff(trace.poses[:, :2], axis=0), axis=1) / step_s
    turn = np.abs(np.diff(np.unwrap(trace.poses[:, 2]))) / step_s
    kinds = [trace.hits > 0, speed > STILL_SHARE * robot.max_speed_m_s, turn > STILL_SHARE * robot.max_turn_rad_s]
    return list(np.select(kinds, ["collided", "driving", "turning"], "standing"))


def _log_reward_and_action(recording: rr.RecordingStream, name: str, trace: Trace, robot: Robot) -> None:
    """The return by terms, summed up to each step's end; actions from their step's beginning to its end."""
    colours = palette.SERIES
    # One step's progress would be invisible beside the reward at the goal; sums are of one size.
    earned = {term: np.cumsum(values) for term, values in trace.reward_terms.items()}
    shades = [palette.REWARD_TERMS.get(term, colours[i % len(colours)]) for i, term in enumerate(earned)]
    total = {"sum": np.sum(list(earned.values()), axis=0)}
    _log_curves(recording, _path("return", name), _times(trace, slice(1, None)), earned | total, [*shades, SUM])
    if not trace.is_on_grid:
        rolled = dict(zip(("left", "right"), _wheel_speeds(trace, robot).T, strict=True))
        at = _path("wheel_speed", name)
        _log_curves(recording, at, _times(trace, slice(None, -1)), rolled, colours, interpolation="StepAfter")
    commands = ["move"] if trace.is_on_grid else ["forward", "turn"]
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


def _run_card(title: str, rollouts: Mapping[str, Episode], properties: Mapping[str, object] | None) -> str:
    """What the recording shows, in Markdown."""
    first = next(iter(rollouts.values()))
    lines = [
        f"# {_plain(title)}",
        f"From cell {first.start} to cell {first.goal} (row, column), the same in each view.",
        "",
    ]
    for name, episode in rollouts.items():  # a list, for a table is cut off where the view is narrow
        lines.append(
            f"- **{_plain(name)}** {'reached' if episode.is_success else '**missed**'} its goal: "
            f"{episode.elapsed_s:.1f} s, {episode.path_length_m:.2f} m (shortest {episode.shortest_path_m:.2f} m), "
            f"{_counted(episode.collisions, 'collision')}, return {episode.episode_return:.2f}"
        )
    lines += ["", "Trail: orange is slow, blue is full speed. Red: collisions. Purple: the shortest way.", ""]
    return "\n".join(lines + _facts(properties))


def _overlay_card(title: str, episodes: Sequence[Episode], properties: Mapping[str, object] | None) -> str:
    """What the overlay shows, in Markdown: how many arrived, and which did not."""
    arrived = sum(one.is_success for one in episodes)
    touched = sum(one.collisions > 0 for one in episodes)
    lines = [
        f"# {_plain(title)}",
        f"{len(episodes)} episodes: {arrived} arrived (blue), {len(episodes) - arrived} did not (red), "
        f"{touched} touched a wall.",
        "",
    ]
    return "\n".join(lines + _facts(properties))


def _facts(properties: Mapping[str, object] | None) -> list[str]:
    return [f"- {_plain(key)}: {_plain(str(value))}" for key, value in (properties or {}).items()]


def _counted(n: int, what: str) -> str:
    return f"{n} {what}" if n == 1 else f"{n} {what}s"


def _plain(text: str) -> str:
    """Text on one line."""
    return " ".join(text.split())


def _in_cell(text: str) -> str:
    """The same without what would end a table's cell."""
    return _plain(text).replace("|", "/")


# ---- The arrangement ---------------------------------------------------------------------------


def _side_by_side(layout: Layout, traces: Mapping[str, Trace], *, varied: bool) -> rrb.Blueprint:
    """The mazes side by side, each with its curves below; on the right what they share."""
    mazes = [
        rrb.Spatial3DView(
            name=name,
            origin=_path("rollouts", name),
            # There for those who ask: it would hide the values.
            overrides={_path("rollouts", name, "distance_field"): rrb.EntityBehavior(visible=False)},
            eye_controls=_eye(layout, len(traces)),
            background=[255, 255, 255],
            line_grid=False,
        )
        for name in traces
    ]
    legend = rrb.PlotLegend(rrb.Corner2D.LeftTop)
    rewards = [_curve_view(f"{name}: reward so far", _path("return", name), legend) for name in traces]
    # A legend would cover these low plots: their titles say it.
    none = rrb.PlotLegend(visible=False)
    actions = [
        rrb.Tabs(
            _curve_view(_action_words(name, trace), _path("action", name), none),
            *(
                []
                if trace.is_on_grid
                else [
                    _curve_view("wheels, rad/s: left (blue), right (orange)", _path("wheel_speed", name), none),
                ]
            ),
        )
        for name, trace in traces.items()
    ]
    rows = [rrb.Horizontal(*views) for views in (mazes, rewards, actions)]
    to_goal = rrb.PlotLegend(rrb.Corner2D.LeftBottom)
    shared = [
        rrb.TextDocumentView(name="Run", origin="/run_card"),
        _curve_view("Shortest way to the goal (m)", "/distance_to_goal", to_goal),
        rrb.StateTimelineView(name="What it does", origin="/state", time_view=_whole_episode()),
    ]
    shares = [5, 5, 3]
    if varied:
        shared.insert(1, rrb.TextDocumentView(name="Drawn for this episode", origin="/drawn"))
        shares.insert(1, 5)
    return _arranged(
        rrb.Vertical(*rows, row_shares=[10, 6, 4]), rrb.Vertical(*shared, row_shares=shares), max(len(traces), 2)
    )


def _overlaid(layout: Layout) -> rrb.Blueprint:
    """One maze with everybody in it; on the right what became of them."""
    maze = rrb.Spatial3DView(
        name="Episodes", origin="/", eye_controls=_eye(layout, 1), background=[255, 255, 255], line_grid=False
    )
    shared = [
        rrb.TextDocumentView(name="Run", origin="/run_card"),
        _curve_view("Share that has arrived", "/arrived", rrb.PlotLegend(visible=False), (0.0, 1.0)),
    ]
    return _arranged(maze, rrb.Vertical(*shared, row_shares=[1, 1]), 2)


def _arranged(main: rrb.Container | rrb.View, side: rrb.Container, main_share: int) -> rrb.Blueprint:
    return rrb.Blueprint(
        rrb.Horizontal(main, side, column_shares=[main_share, 1]),
        rrb.TimePanel(state="collapsed", timeline="sim_time"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
    )


def _curve_view(
    name: str, origin: str, legend: rrb.PlotLegend, values: tuple[float, float] | None = None
) -> rrb.TimeSeriesView:
    axis_y = rrb.archetypes.ScalarAxis(range=values) if values else None
    return rrb.TimeSeriesView(name=name, origin=origin, plot_legend=legend, axis_x=_whole_episode(), axis_y=axis_y)


def _whole_episode() -> rrb.archetypes.TimeAxis:
    # By itself the viewer shows no more than a minute, around the present moment.
    everything = rr.TimeRangeBoundary.infinite()
    return rrb.archetypes.TimeAxis(view_range=rr.TimeRange(start=everything, end=everything))


def _action_words(name: str, trace: Trace) -> str:
    return f"{name}: " + ("up 0, down 1, left 2, right 3" if trace.is_on_grid else "forward (blue), turn (orange)")


def _eye(layout: Layout, n_views: int) -> rrb.EyeControls3D:
    """From above and a little from the south, so far away that the whole maze is in sight of a narrow view."""
    width, height = layout.size_m
    centre = np.array([width / 2, height / 2, 0.0])
    tilt = np.deg2rad(20.0)
    away = max(1.2, 0.47 * n_views) * max(width, height) * np.array([0.0, -np.sin(tilt), np.cos(tilt)])
    return rrb.EyeControls3D(kind="Orbital", position=centre + away, look_target=centre, eye_up=[0, 0, 1])


# ---- Small parts -------------------------------------------------------------------------------


def _times(trace: Trace, part: slice | IntArray = slice(None)) -> list[rr.TimeColumn]:
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


# ---- Pictures of a recording -------------------------------------------------------------------


def check_recording(path: Path) -> None:
    """Whether a file is a whole recording.

    Raises:
        InputError: When it is none, or cut off.
    """
    try:
        with warnings.catch_warnings(action="error"):  # a file that was cut off has no footer
            whole = bool(RrdReader(path).recordings())
    except (ValueError, OSError, RuntimeError, Warning):
        whole = False
    if not whole:
        raise InputError(f"{str(path)!r} is no whole recording: make it again with its run")


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
    path = existing(recording_path)
    with headless_viewer(window_size) as address:
        faded = time.monotonic() + NOTES_FADE_S
        client = ViewerClient.connect(address)
        client.open(path.resolve().as_uri())
        wait_until(lambda: not client.get_state().loading, "load the recording")
        if time_s is None:
            time_s = _end_s(client)
        client.set_time("sim_time", duration=time_s, play_state="paused")
        client.run_command("ui.toggle_top_panel")
        picture = _settled_picture(client, faded)
        errors = [
            f"{v.name}: {r.summary}" for v in client.get_state().views for r in v.reports if r.severity == "error"
        ]
        errors += [entry.message for entry in client.get_logs() if entry.level == "ERROR"]
        if errors:
            raise ViewerError(f"the viewer cannot show {path.name}: {'; '.join(errors)}")
    Path(png_path).write_bytes(picture)


def _end_s(client: ViewerClient) -> float:
    """Last moment of ``sim_time``, which the viewer counts in nanoseconds."""
    timelines = [t for recording in client.get_state().recordings for t in recording.timelines]
    return max(((t.end or 0) / 1e9 for t in timelines if t.name == "sim_time"), default=0.0)


def _settled_picture(client: ViewerClient, faded: float) -> bytes:
    """A PNG of the whole window, once pop-up notes have faded and plots have stopped zooming."""
    picture = client.take_screenshot()

    def settled() -> bool:
        nonlocal picture
        before, picture = picture, client.take_screenshot()
        return before == picture and time.monotonic() > faded

    wait_until(settled, "finish its picture")
    return picture
