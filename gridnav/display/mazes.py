"""Figures with a maze in them: ways taken, values and moves, visits, an episode moment by moment."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colorbar import Colorbar
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle
from matplotlib.patches import Patch, Rectangle
from matplotlib.path import Path
from matplotlib.ticker import EngFormatter, NullFormatter

from gridnav.display import palette
from gridnav.display.policy_map import best_moves, command_motion
from gridnav.display.style import SMALL_PT, STYLE, WIDTH_IN, signed
from gridnav.problem.grid_mdp import MOVE_HEADINGS_RAD
from gridnav.problem.layout import Layout
from gridnav.problem.metrics import Episode, Trace
from gridnav.problem.robot import BURGER, Robot
from gridnav.problem.types import Cell, FloatArray, IntArray

TITLE_LETTERS = 27
"""What fits above one of two panels."""
LEGEND_LETTERS = 26
"""What fits below a map beside two short entries."""
STRIP_COLUMNS = 4
STANDING = 0.05
"""Commands below this share of the maximum are called none."""
MOVE_WORDS = ("up", "down", "left", "right")
"""The actions of the grid, in their order."""

# How things look in every maze.
_ARRIVED: dict[str, Any] = {"color": palette.ARRIVED, "linewidth": 1.4, "alpha": 0.8}
_MISSED: dict[str, Any] = {"color": palette.MISSED, "linewidth": 1.4, "linestyle": (0, (4, 2))}
_FROM: dict[str, Any] = {
    "marker": "o",
    "markersize": 5,
    "color": "white",
    "markeredgecolor": palette.INK,
    "linestyle": "none",
}
_TO: dict[str, Any] = {
    "marker": "*",
    "markersize": 9,
    "color": palette.GOAL,
    "markeredgecolor": palette.INK,
    "linestyle": "none",
}
_LOST: dict[str, Any] = {
    "marker": "X",
    "markersize": 8,
    "color": palette.MISSED,
    "markeredgecolor": "white",
    "linestyle": "none",
}
_TOUCHED: dict[str, Any] = {
    "marker": "D",
    "markersize": 5.5,
    "color": palette.COLLISION,
    "markeredgecolor": palette.INK,
    "linestyle": "none",
}
# Hatched, so that no colour of a scale looks like a wall.
_WALL: dict[str, Any] = {"facecolor": palette.WALL, "edgecolor": "white", "hatch": "///", "linewidth": 0}
_DART = Path([(1.0, 0.0), (-0.8, 0.7), (-0.4, 0.0), (-0.8, -0.7), (1.0, 0.0)], closed=True)
"""The robot as a mark that looks along x."""
# Quivers have no entry in legends, so this mark stands for them.
_ARROW: dict[str, Any] = {
    "marker": Path(
        [(1, 0), (0.2, 0.4), (0.2, 0.15), (-1, 0.15), (-1, -0.15), (0.2, -0.15), (0.2, -0.4), (1, 0)], closed=True
    ),
    "markersize": 15,
    "markeredgecolor": palette.INK,
    "markeredgewidth": 0.6,
    "linestyle": "none",
}


def maze_axes(axes: Axes, layout: Layout) -> None:
    """Draw a maze to scale: walls dark, allowed starts and goals tinted, axes in metres, row 0 on top."""
    width, height = layout.size_m
    half = layout.cell_size_m / 2
    for cells, free, colour in (
        (layout.start_cells, layout.starts, palette.START),
        (layout.goal_cells, layout.goals, palette.GOAL),
    ):
        # Where every free cell is allowed, a tint would say nothing.
        if not np.array_equal(free, ~layout.walls):
            for x, y in layout.to_metres(cells) - half:
                axes.add_patch(Rectangle((x, y), 2 * half, 2 * half, color=colour, alpha=0.25, linewidth=0))
    _draw_walls(axes, layout, {"color": palette.WALL, "linewidth": 0})
    # Drawn at the edge, twice as thick as seen: the axes clip the outer half.
    axes.add_patch(Rectangle((0, 0), width, height, fill=False, edgecolor=palette.WALL, linewidth=4))
    axes.set(xlim=(0, width), ylim=(0, height), aspect="equal", xlabel="x (m)", ylabel="y (m)")
    axes.spines[:].set_visible(False)


def _draw_walls(axes: Axes, layout: Layout, style: dict[str, Any]) -> None:
    for x_min, y_min, x_max, y_max in layout.wall_rectangles():
        axes.add_patch(Rectangle((x_min, y_min), x_max - x_min, y_max - y_min, **style))


def _draw_arrows(
    axes: Axes, tails_w: FloatArray, directions_rad: FloatArray, lengths_m: FloatArray, **style: Any
) -> None:
    """Arrows in the world frame, x right and y up; all but the style of shape ``(n, ...)``."""
    u, v = lengths_m * np.cos(directions_rad), lengths_m * np.sin(directions_rad)
    axes.quiver(
        *tails_w.T, u, v, angles="xy", scale_units="xy", scale=1, edgecolor=palette.INK, linewidth=0.6, **style
    )  # fmt: skip


# ---- Ways -------------------------------------------------------------------------------------------


@matplotlib.rc_context(STYLE)
def trajectories(layout: Layout, rollouts: Mapping[str, Sequence[Episode]]) -> Figure:
    """The ways taken, one panel per rung or agent.

    Args:
        layout: The maze.
        rollouts: Name to episodes; those without a trace count in the title and are not drawn.
    """
    n_columns = min(len(rollouts), 2)
    n_rows = -(-len(rollouts) // n_columns)
    width, height = layout.size_m
    panel_height = (WIDTH_IN - 0.6) / n_columns * height / width + 0.55  # inches: the maze, and its title
    # Below: the x axis, the legend; and an x axis in mid-page where the last row is not full.
    below = 1.0 + 0.4 * (len(rollouts) % n_columns)
    figure = Figure(figsize=(WIDTH_IN, n_rows * panel_height + below), layout="constrained")
    for number, (name, episodes) in enumerate(rollouts.items()):
        axes = figure.add_subplot(n_rows, n_columns, number + 1)
        maze_axes(axes, layout)
        if number % n_columns:
            axes.set(ylabel="", yticklabels=[])
        if number + n_columns < len(rollouts):
            axes.set(xlabel="", xticklabels=[])
        arrived = sum(episode.is_success for episode in episodes)
        axes.set_title(f"{textwrap.fill(name, TITLE_LETTERS)}\n{arrived} of {len(episodes)} reached the goal")
        for episode in episodes:
            _draw_way(axes, episode)
    figure.legend(handles=_way_legend(), loc="outside lower center", ncols=3)
    return figure


def _draw_way(axes: Axes, episode: Episode) -> None:
    """One trajectory: solid where it arrived, dashed and crossed out at its end where it did not."""
    if episode.trace is None:
        return
    points = episode.trace.poses[:, :2]
    style = _ARRIVED if episode.is_success else _MISSED
    axes.plot(*points.T, **style, zorder=3 if episode.is_success else 3.5, gid="way")
    axes.plot(*points[0], **_FROM, zorder=4)
    axes.plot(*points[-1], **(_TO if episode.is_success else _LOST), zorder=5)
    _draw_collisions(axes, episode.trace, len(episode.trace.hits))


def _draw_collisions(axes: Axes, trace: Trace, n_steps: int, **style: Any) -> None:
    """Where the first steps ended that touched a wall."""
    touched = trace.poses[1 : n_steps + 1, :2][trace.hits[:n_steps] > 0]
    if len(touched):
        axes.plot(*touched.T, **({"zorder": 6} | _TOUCHED | style), gid="collisions")


def _way_legend() -> list[Line2D]:
    styles = {
        "reached the goal": _ARRIVED,
        "did not reach it": _MISSED,
        "start": _FROM,
        "arrival": _TO,
        "ended here": _LOST,
        "collision": _TOUCHED,
    }
    return [Line2D([], [], label=label, **style) for label, style in styles.items()]


# ---- Maps -------------------------------------------------------------------------------------------


@matplotlib.rc_context(STYLE)
def value_map(
    layout: Layout,
    values: FloatArray,
    goal: Cell,
    *,
    directions_rad: FloatArray | None = None,
    speeds: FloatArray | None = None,
    label: str = "value (expected discounted reward)",
    arrow_label: str = "best move",
) -> Figure:
    """State values as colours, with where the policy heads as arrows: of a table or of a network.

    Args:
        layout: The maze.
        values: Of the cells, shape ``(n_rows, n_cols)``, NaN where unknown; or of the moves up, down, left, right from
            each cell, row by row, shape ``(n_cells, 4)``: then the best is the cell's value and, without
            ``directions_rad``, its arrow, unless all four are worth the same.
        goal: Goal cell (row, column); it carries no value and no arrow.
        directions_rad: Where the policy heads, radians in the world frame (x right, y up), shape ``(n_rows, n_cols)``;
            NaN draws no arrow. ``command_motion`` gives it from a robot's commands.
        speeds: Shares of full speed in [0, 1] that lengthen the arrows, the same shape; full by default.
        label: What the colours say, with the unit.
        arrow_label: What the arrows say.
    """
    shape = layout.walls.shape
    if values.shape != shape:
        best, headings = best_moves(values)
        values = best.reshape(shape)
        directions_rad = headings.reshape(shape) if directions_rad is None else directions_rad
    blank = layout.walls.copy()
    blank[goal] = True  # nothing is earned after the goal, so its value means nothing
    figure, axes, _ = _heat_map(layout, np.ma.masked_array(values, blank | np.isnan(values)), label, cmap="viridis")
    handles: list[Any] = []
    if directions_rad is not None:
        _draw_policy(axes, layout, np.where(blank, np.nan, directions_rad), speeds)
        handles.append(Line2D([], [], label=textwrap.fill(arrow_label, LEGEND_LETTERS), color="white", **_ARROW))
    axes.plot(*layout.to_metres(np.array(goal)), **{**_TO, "markersize": 14}, zorder=5)
    handles += [Line2D([], [], label="goal", **_TO), Patch(label="wall", **_WALL)]
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


def _draw_policy(axes: Axes, layout: Layout, directions_rad: FloatArray, speeds: FloatArray | None) -> None:
    """An arrow in each cell that has a direction; at full speed half a cell long, at rest still to be seen."""
    cells = np.argwhere(np.isfinite(directions_rad))
    at = tuple(cells.T)
    share = np.ones(len(cells)) if speeds is None else np.clip(speeds[at], 0.0, 1.0)
    lengths_m = layout.cell_size_m * (0.25 + 0.4 * share)
    _draw_arrows(
        axes, layout.to_metres(cells), directions_rad[at], lengths_m,
        pivot="middle", color="white", width=0.009, zorder=4,
    )  # fmt: skip


@matplotlib.rc_context(STYLE)
def visit_counts(layout: Layout, counts: IntArray | FloatArray) -> Figure:
    """How often each cell was visited, on a logarithmic scale; cells that never were stay white.

    Args:
        layout: The maze.
        counts: Visits, shape ``(n_rows, n_cols)``.
    """
    never = counts <= 0
    visited = counts[~never] if (~never).any() else np.ones(1)
    # From one power of ten to another, so that both ends of the scale have a number.
    lowest = 10.0 ** np.floor(np.log10(visited.min()))
    norm = LogNorm(lowest, max(10.0 ** np.ceil(np.log10(visited.max())), 10.0 * lowest))
    shown = np.ma.masked_array(counts, never | layout.walls)
    figure, axes, scale = _heat_map(layout, shown, "visits (logarithmic scale)", cmap="viridis_r", norm=norm)
    scale.formatter = EngFormatter(sep="")
    scale.minorformatter = NullFormatter()
    axes.plot(*layout.to_metres(np.argwhere(never & ~layout.walls)).T, **_NEVER, gid="never")
    handles = [Line2D([], [], label="never visited", **_NEVER), Patch(label="wall", **_WALL)]
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return figure


_NEVER: dict[str, Any] = {"marker": "x", "markersize": 5, "color": palette.WALL, "linestyle": "none"}


def _heat_map(layout: Layout, values: Any, label: str, **scale: Any) -> tuple[Figure, Axes, Colorbar]:
    """A figure with one colour per cell, hatched walls, axes in metres and the colours' scale."""
    width, height = layout.size_m
    figure = Figure(figsize=(WIDTH_IN, WIDTH_IN * 0.82 * height / width + 0.4), layout="constrained")
    axes = figure.subplots()
    image = axes.imshow(values, extent=(0, width, 0, height), interpolation="nearest", **scale)
    _draw_walls(axes, layout, _WALL)
    axes.set(xlabel="x (m)", ylabel="y (m)")
    return figure, axes, figure.colorbar(image, ax=axes, label=label, shrink=0.9)


# ---- An episode moment by moment ----------------------------------------------------------------------


@matplotlib.rc_context(STYLE)
def episode_strip(layout: Layout, episode: Episode, *, n_frames: int = 10, robot: Robot = BURGER) -> Figure:
    """An episode as a row of small mazes: the first steps on the grid, evenly spaced moments of a robot.

    Each shows the way so far, the robot before the step, and its action as an arrow that points where it leads: on the
    grid to the next cell, for a robot along the way of this step, the longer the faster. Above it stand the action and
    the step's reward in words.

    Args:
        layout: The maze.
        episode: With its trace.
        n_frames: Mazes, or fewer where the episode has fewer steps.
        robot: Gives the maximum speeds.
    """
    trace = episode.trace
    if trace is None:
        raise ValueError("an episode without a trace has no course to draw")
    on_grid = trace.actions.shape[1] == 1
    steps = len(trace.hits)
    if on_grid:
        frames = np.arange(min(steps, n_frames))
        which = f"The first {len(frames)} of {steps} steps" if len(frames) < steps else f"All {steps} steps"
    else:
        frames = np.unique(np.linspace(0, steps - 1, n_frames).round().astype(np.int64))
        which = f"{len(frames)} moments of {trace.time_s[-1]:.1f} s"
    width, height = layout.size_m
    n_columns = min(STRIP_COLUMNS, len(frames))
    n_rows = -(-len(frames) // n_columns)
    panel_height = WIDTH_IN / n_columns * height / width + 0.4  # inches: the maze, and its title
    # The last row may leave room for the legend.
    has_room = n_rows * n_columns - len(frames) >= 2
    below = 0.2 if has_room else 0.8
    figure = Figure(figsize=(WIDTH_IN, n_rows * panel_height + below), layout=ConstrainedLayoutEngine(w_pad=0.09))
    for number, step in enumerate(frames):
        axes = figure.add_subplot(n_rows, n_columns, number + 1)
        maze_axes(axes, layout)
        axes.set(xlabel="", ylabel="", xticks=[], yticks=[])
        axes.plot(*layout.to_metres(np.array(episode.goal)), **_TO, zorder=2)
        _draw_moment(axes, layout, trace, int(step), robot)
        # The pad is for arrows that point into the outer wall.
        axes.set_title(_moment_words(trace, int(step)), fontsize=SMALL_PT, pad=12)
    end = "goal reached" if episode.is_success else "goal not reached"
    figure.suptitle(f"{which}, {end}; maze {width:g} m x {height:g} m")
    place: dict[str, Any] = {"loc": "lower right"} if has_room else {"loc": "outside lower center", "ncols": 3}
    figure.legend(handles=_strip_legend(on_grid), **place)
    return figure


def _draw_moment(axes: Axes, layout: Layout, trace: Trace, step: int, robot: Robot) -> None:
    """The robot before a step, how it got there, and where the step's action leads."""
    x, y, heading_rad = trace.poses[step]
    axes.plot(*trace.poses[: step + 1, :2].T, **_SO_FAR, zorder=3, gid="way")
    if trace.actions.shape[1] == 1:
        direction_rad = MOVE_HEADINGS_RAD[int(trace.actions[step, 0])]
        length_m = 1.3 * layout.cell_size_m
        axes.plot(x, y, **_GRID_ROBOT, zorder=4, gid="robot")
    else:
        seconds = float(trace.time_s[step + 1] - trace.time_s[step])
        directions, speeds = command_motion(trace.actions[step], heading_rad, seconds=seconds, robot=robot)
        direction_rad = float(directions)
        # Any shorter arrow would hide in the robot; at rest there is no way to point along.
        length_m = layout.cell_size_m * (1.2 + 0.6 * float(speeds)) if speeds >= STANDING else 0.0
        mark = MarkerStyle(_DART).rotated(rad=heading_rad)
        axes.plot(x, y, **(_ROBOT | {"marker": mark}), zorder=4, gid="robot")
    if length_m:
        _draw_arrows(
            axes, np.array([[x, y]]), np.array([direction_rad]), np.array([length_m]),
            color=palette.ACTION, width=0.025, headwidth=4, headlength=4, headaxislength=4, zorder=5, clip_on=False,
        )  # fmt: skip
    # Below the robot, and larger than it.
    _draw_collisions(axes, trace, step + 1, markersize=9, zorder=3.5)


_SO_FAR: dict[str, Any] = {"color": palette.ARRIVED, "linewidth": 1.4}
_ROBOT: dict[str, Any] = {
    "color": palette.ROBOT,
    "markersize": 12,
    "markeredgecolor": "white",
    "markeredgewidth": 0.5,
    "linestyle": "none",
}
_GRID_ROBOT = _ROBOT | {"marker": "o", "markersize": 7}


def _moment_words(trace: Trace, step: int) -> str:
    """The action and the step's reward, such as ``step 3: up`` above ``reward -0.25, hit``."""
    reward = sum(float(term[step]) for term in trace.reward_terms.values())
    if trace.actions.shape[1] == 1:
        action = f"step {step + 1}: {MOVE_WORDS[int(trace.actions[step, 0])]}"
    else:
        action = f"{trace.time_s[step]:.1f} s: {_command_words(*trace.actions[step])}"
    return f"{action}\nreward {signed(reward)}{', hit' if trace.hits[step] else ''}"


def _command_words(forward: float, turn: float) -> str:
    side = "left" if turn > 0 else "right"
    if abs(forward) < STANDING:
        return f"turns {side}" if abs(turn) >= STANDING else "stands"
    return ("ahead" if forward > 0 else "back") + (f", {side}" if abs(turn) >= STANDING else "")


def _strip_legend(on_grid: bool) -> list[Line2D]:
    styles = {
        "robot": _GRID_ROBOT if on_grid else _ROBOT | {"marker": _DART},
        "action": _ARROW | {"color": palette.ACTION},
        "way so far": _SO_FAR,
        "goal": _TO,
        "collision": _TOUCHED,
    }
    return [Line2D([], [], label=label, **style) for label, style in styles.items()]
