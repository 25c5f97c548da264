"""Figures are asked what they drew."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.quiver import Quiver
from matplotlib.text import Annotation

from gridnav.display import palette
from gridnav.display.curves import Curve, across_seeds, moving_average
from gridnav.display.figures import (
    command_motion,
    comparison,
    episode_strip,
    learning_curves,
    reward_terms,
    save_figure,
    success_bars,
    svg_text,
    trajectories,
    value_map,
    visit_counts,
)
from gridnav.display.style import signed
from gridnav.experiment.evaluation import evaluate
from gridnav.experiment.worlds import make_worlds
from gridnav.problem.layout import Layout
from gridnav.problem.metrics import Episode, Trace
from gridnav.problem.robot import BURGER
from gridnav.problem.types import FloatArray

CORRIDOR = Layout.from_text("S...G\n.###.\n.....\n")


def drive(
    *, steps: int = 10, is_success: bool = True, hits: tuple[int, ...] = (), forward: float = 1.0, turn: float = -0.5
) -> Episode:
    """A robot's episode from (0, 0) to (0, 4) of the corridor at constant speed, with its trace; 2 m in all."""
    x = np.linspace(0.25, 2.25 if is_success else 1.25, steps + 1)
    poses = np.column_stack([x, np.full(steps + 1, 1.25), np.full(steps + 1, np.pi / 6)])
    hit = np.isin(np.arange(steps), hits).astype(np.int64)
    terms = {"goal": np.r_[np.zeros(steps - 1), 10.0 * is_success], "time": np.full(steps, -0.25)}
    actions = np.tile([forward, turn], (steps, 1))
    trace = Trace(np.arange(steps + 1) * 0.2, poses, np.ones((steps + 1, 24)), actions, terms, hit)
    return Episode(
        (0, 0), (0, 4), is_success, len(hits), float(x[-1] - x[0]), 2.0, steps * 0.2, 10.0, steps,
        float(sum(term.sum() for term in terms.values())), trace=trace,
    )  # fmt: skip


def course(episode: Episode) -> Trace:
    assert episode.trace is not None
    return episode.trace


def by_gid(axes: Axes, gid: str) -> list[Line2D]:
    return [line for line in axes.lines if line.get_gid() == gid]


def arrows(axes: Axes) -> list[Quiver]:
    return [item for item in axes.collections if isinstance(item, Quiver)]


def legend_words(figure: Figure) -> list[str]:
    (legend,) = figure.legends
    return [text.get_text() for text in legend.get_texts()]


def assert_nothing_overlaps(figure: Figure) -> None:
    """The legend lies off the axes and everything within the figure."""
    figure.draw_without_rendering()
    box = figure.bbox.padded(1)
    for legend in figure.legends:
        extent = legend.get_window_extent()
        assert not any(extent.overlaps(axes.get_window_extent()) for axes in figure.axes)
        assert box.contains(extent.x0, extent.y0)
        assert box.contains(extent.x1, extent.y1)
    for axes in figure.axes:
        extent = axes.get_tightbbox()
        assert extent is not None
        assert box.contains(extent.x0, extent.y0)


# ---- Learning curves ----------------------------------------------------------------------------


def test_the_moving_average_looks_back_and_never_ahead() -> None:
    # By hand: 1, (1+2)/2, (2+3)/2, (3+8)/2.
    np.testing.assert_allclose(moving_average(np.array([1.0, 2.0, 3.0, 8.0]), 2), [1.0, 1.5, 2.5, 5.5])


def test_the_moving_average_leaves_out_what_was_not_measured() -> None:
    values = np.array([np.nan, 1.0, np.nan, np.nan, 4.0, 6.0])

    # By hand, two at a time: nothing; 1; 1; nothing; 4; (4+6)/2.
    np.testing.assert_allclose(moving_average(values, 2), [np.nan, 1.0, 1.0, np.nan, 4.0, 5.0])


def test_learning_curves_mark_the_target_and_keep_the_legend_off_the_data() -> None:
    steps = np.arange(1, 21) * 1000
    figure = learning_curves({"scratch": (steps, steps / 20000), "warm": (steps, np.ones(20))}, window=5)

    axes = figure.axes[0]
    (target,) = by_gid(axes, "target")
    assert list(target.get_ydata()) == [0.95, 0.95]
    averages = {line.get_label(): line for line in axes.lines}
    np.testing.assert_allclose(averages["scratch"].get_ydata()[-1], 0.9)  # by hand: mean of 0.80, 0.85 ... 1.00
    assert averages["scratch"].get_linestyle() != averages["warm"].get_linestyle()
    assert_nothing_overlaps(figure)


def test_learning_curves_run_over_seconds_too_and_show_gaps_as_gaps() -> None:
    seconds, spl = np.array([0.1, 0.2, 0.3, 0.4]), np.array([0.5, np.nan, np.nan, 0.7])

    figure = learning_curves({"ppo": (seconds, spl)}, window=2, x_label="training time (s)", y_label="SPL", target=None)

    axes = figure.axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("training time (s)", "SPL")
    assert by_gid(axes, "target") == []
    (line,) = [line for line in axes.lines if line.get_label() == "ppo"]
    np.testing.assert_allclose(line.get_ydata(), [0.5, 0.5, np.nan, 0.7])
    figure.draw_without_rendering()
    assert "0.20" in [tick.get_text() for tick in axes.get_xticklabels()], "not 200m, which reads as minutes"


# ---- Comparisons over seeds ----------------------------------------------------------------------


def seeds(*values: float) -> list[Curve]:
    """One constant curve per seed."""
    return [(np.array([0, 100]), np.full(2, value)) for value in values]


def test_from_four_seeds_on_the_middle_is_the_interquartile_mean() -> None:
    few = across_seeds(seeds(0.0, 0.1, 0.8), np.random.default_rng(0))
    many = across_seeds(seeds(0.0, 0.4, 0.6, 1.0), np.random.default_rng(0))
    robust = across_seeds(seeds(0.0, 0.0, 0.4, 0.6, 1.0), np.random.default_rng(0))

    np.testing.assert_allclose(few.middle, 0.3)  # by hand: (0.0 + 0.1 + 0.8) / 3
    assert few.words == "mean of 3 seeds"
    np.testing.assert_allclose(many.middle, 0.5)  # by hand: a quarter off at each end leaves 0.4 and 0.6
    assert many.words == "IQM of 4 seeds"
    np.testing.assert_allclose(robust.middle, 1 / 3)  # by hand: one off at each end leaves 0.0, 0.4 and 0.6


def test_curves_are_compared_where_all_seeds_have_data_and_held_in_between() -> None:
    one: Curve = (np.array([0.0, 10.0, 20.0]), np.array([0.0, 0.5, 1.0]))
    other: Curve = (np.array([5.0, 15.0, 40.0]), np.array([0.2, np.nan, 0.8]))

    band = across_seeds([one, other], np.random.default_rng(0))

    assert (band.x[0], band.x[-1]) == (5.0, 20.0)
    at = {x: np.flatnonzero(band.x <= x)[-1] for x in (9.9, 10.1, 20.0)}
    # By hand: (0.0 + 0.2)/2; (0.5 + 0.2)/2; (1.0 + 0.2)/2, the missing value and the one at 40 have no say.
    np.testing.assert_allclose(band.middle[list(at.values())], [0.1, 0.35, 0.6])


def test_the_band_holds_the_middle_and_comes_from_drawing_whole_seeds() -> None:
    band = across_seeds(seeds(0.2, 0.6), np.random.default_rng(0))

    # By hand: two seeds drawn twice are (0.2, 0.2), mixed or (0.6, 0.6) with 1/4, 1/2, 1/4: both ends lie within 2.5 %.
    np.testing.assert_allclose([band.low[0], band.middle[0], band.high[0]], [0.2, 0.4, 0.6])
    # Points drawn apart from each other would make a ragged band of constant curves.
    assert np.ptp(band.low) == np.ptp(band.high) == 0.0
    wide = across_seeds(seeds(*np.linspace(0.1, 0.9, 9)), np.random.default_rng(0))
    assert 0.1 < wide.low[0] < wide.middle[0] < wide.high[0] < 0.9


def test_seeds_without_a_common_range_are_refused() -> None:
    early, late = (np.array([0.0, 1.0]), np.ones(2)), (np.array([2.0, 3.0]), np.ones(2))
    for curves in ([early, late], [early, (early[0], np.full(2, np.nan))], []):
        with pytest.raises(ValueError, match="no range in common"):
            across_seeds(curves, np.random.default_rng(0))


def test_a_comparison_says_how_many_seeds_and_draws_no_band_around_one() -> None:
    runs = {"many": seeds(0.1, 0.2, 0.3, 0.4, 0.5), "few": seeds(0.6, 0.8), "alone": seeds(0.9)}

    figure = comparison(runs)

    axes = figure.axes[0]
    words = legend_words(figure)
    assert {"many (IQM of 5 seeds)", "few (mean of 2 seeds)", "alone (1 seed)"} <= set(words)
    assert words[-2] == "95 % bootstrap interval over seeds"
    bands = [band for band in axes.collections if band.get_gid() == "band"]
    lines = [line for line in axes.lines if "seed" in str(line.get_label())]
    assert [tuple(band.get_facecolor()[0][:3]) for band in bands] == [
        to_rgba(line.get_color())[:3] for line in lines[:2]
    ]
    heights = bands[1].get_paths()[0].get_extents()
    np.testing.assert_allclose([heights.y0, heights.y1], [0.6, 0.8])
    assert len({str(line.get_linestyle()) + str(line._dash_pattern) for line in lines}) == 3  # type: ignore[attr-defined]
    assert svg_text(figure) == svg_text(comparison(runs)), "the same data gives the same band"
    assert_nothing_overlaps(figure)


def test_a_comparison_of_single_runs_explains_no_band() -> None:
    assert legend_words(comparison({"a": seeds(0.5)})) == ["95 %", "a (1 seed)"]


# ---- Values, moves and visits ----------------------------------------------------------------------


@pytest.mark.parametrize(("move", "direction"), [(0, (0, 1)), (1, (0, -1)), (2, (-1, 0)), (3, (1, 0))])
def test_arrows_point_where_the_move_leads(move: int, direction: tuple[int, int]) -> None:
    """Up is +y although it goes to a smaller row."""
    values = np.zeros((15, 4))
    values[7, move] = 1.0  # the middle of the second row... which is a wall, so no arrow
    values[10, move] = 1.0  # row 2, column 0

    figure = value_map(CORRIDOR, values, (0, 4))

    (quiver,) = arrows(figure.axes[0])
    assert quiver.N == 1, "walls and cells without a preference carry no arrow"
    np.testing.assert_allclose([quiver.X[0], quiver.Y[0]], [0.25, 0.25])
    np.testing.assert_allclose(
        np.array([quiver.U[0], quiver.V[0]]) / np.hypot(quiver.U, quiver.V), direction, atol=1e-9
    )
    assert legend_words(figure) == ["best move", "goal", "wall"]


def test_the_value_map_shows_the_best_value_of_each_cell_with_row_0_on_top() -> None:
    values = np.arange(60.0).reshape(15, 4)

    for shown_values in (values, values.max(axis=1).reshape(3, 5)):
        axes = value_map(CORRIDOR, shown_values, (0, 4)).axes[0]

        (image,) = axes.images
        shown = image.get_array()
        assert image.get_extent() == [0, 2.5, 0, 1.5]
        assert image.origin == "upper"
        assert shown[0, 0] == 3.0
        assert shown[2, 4] == 59.0
        assert shown.mask[1].tolist() == [False, True, True, True, False]
        assert shown.mask[0, 4], "nothing is earned after the goal"


def test_a_network_is_drawn_by_its_values_directions_and_speeds() -> None:
    values = np.ones((3, 5))
    values[2, 0] = np.nan
    directions = np.full((3, 5), np.nan)
    directions[0, 0], directions[2, 4], directions[1, 1] = np.pi / 2, np.pi, 0.0  # the last in a wall
    speeds = np.full((3, 5), 0.5)
    speeds[2, 4] = 1.0

    figure = value_map(
        CORRIDOR, values, (0, 4), directions_rad=directions, speeds=speeds, arrow_label="mean command, facing east"
    )

    (quiver,) = arrows(figure.axes[0])
    np.testing.assert_allclose(np.column_stack([quiver.X, quiver.Y]), [[0.25, 1.25], [2.25, 0.25]])
    np.testing.assert_allclose(np.arctan2(quiver.V, quiver.U), [np.pi / 2, np.pi])
    assert np.hypot(quiver.U, quiver.V)[0] < np.hypot(quiver.U, quiver.V)[1], "the faster the longer"
    assert figure.axes[0].images[0].get_array().mask[2, 0], "an unknown value has no colour"
    assert "mean command, facing east" in legend_words(figure)
    assert legend_words(value_map(CORRIDOR, values, (0, 4))) == ["goal", "wall"], "no arrows, nothing to explain"
    assert_nothing_overlaps(figure)


def test_a_command_leads_along_the_chord_of_its_arc() -> None:
    # Straight; both wheels clipped: the left one stands, so half speed and half turn; in place; back with a turn.
    commands = np.array([[0.5, 0.0], [1.0, 1.0], [0.0, -1.0], [-0.5, 0.25]])

    directions, speeds = command_motion(commands, np.pi / 2, seconds=0.2)

    half_turn = BURGER.max_turn_rad_s * 0.2 / 2
    np.testing.assert_allclose(
        directions,
        np.pi / 2 + np.array([0.0, 0.5 * half_turn, -half_turn, np.pi + 0.25 * half_turn]),
    )
    np.testing.assert_allclose(speeds, [0.5, 0.5, 0.0, 0.5])


def test_visits_are_counted_on_a_logarithmic_scale_and_unvisited_cells_are_crossed() -> None:
    counts = np.array([[2, 30, 0, 400, 5], [1, 9, 9, 9, 1], [0, 3, 3, 3, 3]])

    figure = visit_counts(CORRIDOR, counts)

    axes, scale = figure.axes
    (image,) = axes.images
    assert isinstance(image.norm, LogNorm)
    assert (image.norm.vmin, image.norm.vmax) == (1.0, 1000.0)
    shown = image.get_array()
    assert shown.mask.tolist() == [
        [False, False, True, False, False],
        [False, True, True, True, False],
        [True] + [False] * 4,
    ]
    assert shown[0, 3] == 400
    (never,) = by_gid(axes, "never")
    np.testing.assert_allclose(np.array(never.get_data()).T, [[1.25, 1.25], [0.25, 0.25]])
    assert scale.get_ylabel() == "visits (logarithmic scale)"
    assert len([patch for patch in axes.patches if patch.get_hatch()]) == 1, "the corridor has one wall"
    assert legend_words(figure) == ["never visited", "wall"]


@pytest.mark.parametrize("visits", [0, 1, 7, 10, 123456])
def test_any_number_of_visits_has_a_scale(visits: int) -> None:
    counts = np.zeros((3, 5), dtype=np.int64)
    counts[0, 0] = visits

    figure = visit_counts(CORRIDOR, counts)

    norm = figure.axes[0].images[0].norm
    assert norm.vmin is not None
    assert norm.vmax is not None
    assert norm.vmin <= max(visits, 1) <= norm.vmax
    assert norm.vmax >= 10 * norm.vmin
    figure.draw_without_rendering()


# ---- Ways ------------------------------------------------------------------------------------------


def test_trajectories_tell_success_from_failure_without_colour() -> None:
    figure = trajectories(CORRIDOR, {"A": [drive(), drive(is_success=False, hits=(2, 3))], "B": [drive()]})

    first, second = figure.axes
    ways = by_gid(first, "way")
    assert [line.get_linestyle() for line in ways] == ["-", "--"]
    np.testing.assert_allclose(np.array(ways[0].get_data())[:, [0, -1]], [[0.25, 2.25], [1.25, 1.25]])
    assert [line.get_marker() for line in first.lines].count("X") == 1
    (collisions,) = by_gid(first, "collisions")
    np.testing.assert_allclose(collisions.get_xdata(), [0.55, 0.65])  # by hand: 0.25 m + three and four tenths
    assert collisions.get_color() == palette.COLLISION, "as in the recording"
    assert first.get_title() == "A\n1 of 2 reached the goal"
    assert (first.get_xlabel(), first.get_ylabel()) == ("x (m)", "y (m)")
    assert first.get_ylim() == (0, 1.5)
    assert len(by_gid(second, "way")) == 1


# ---- An episode moment by moment ---------------------------------------------------------------------


def roll_out(world: str, layout: Layout, act: Callable[[np.random.Generator], FloatArray]) -> list[Episode]:
    """Four episodes of twenty steps, each action drawn anew."""
    rng = np.random.default_rng(5)
    worlds = make_worlds(world, 4, layout=layout, max_episode_steps=20)
    return evaluate(lambda observations: np.stack([act(rng) for _ in observations]), worlds)


def direction(quiver: Quiver) -> FloatArray:
    """Unit vector of a single arrow."""
    vector = np.array([quiver.U[0], quiver.V[0]])
    return vector / np.hypot(*vector)


def test_the_arrow_of_a_grid_move_agrees_with_the_motion() -> None:
    """In the tutorial "up" was drawn upward while rows grew upward too."""
    layout = Layout.load("classic")
    words = {(0, 1): "up", (0, -1): "down", (-1, 0): "left", (1, 0): "right"}
    seen, bumps = set(), 0
    for episode in roll_out("GridWorld", layout, lambda rng: rng.integers(4)):
        trace = course(episode)
        frames = episode_strip(layout, episode, n_frames=20).axes
        assert len(frames) == len(trace.hits)
        for step, axes in enumerate(frames):
            (arrow,), (robot,), place = arrows(axes), by_gid(axes, "robot"), trace.poses[step, :2]
            np.testing.assert_allclose(np.ravel(robot.get_data()), place)
            np.testing.assert_allclose([arrow.X[0], arrow.Y[0]], place)
            moved = trace.poses[step + 1, :2] - place
            if trace.hits[step]:
                bumps += 1
                ahead = place + 0.5 * direction(arrow)
                outside = (ahead < 0).any() or (ahead > layout.size_m).any()
                assert outside or layout.walls[tuple(layout.to_cell(ahead))], "it points into what was hit"
            else:
                np.testing.assert_allclose(direction(arrow), moved / np.hypot(*moved), atol=1e-9)
                x, y = np.sign(moved.round(6)).astype(int)
                assert axes.get_title().startswith(f"step {step + 1}: {words[x, y]}\n")
                seen.add(words[x, y])
    assert seen == set(words.values())
    assert bumps > 0


def test_the_arrow_of_a_command_agrees_with_the_motion() -> None:
    layout = Layout.load("u-trap")  # in twenty steps no robot comes from a start to a wall
    compared = 0
    for episode in roll_out("Unicycle", layout, lambda rng: rng.uniform(-1, 1, 2).astype(np.float32)):
        poses = course(episode).poses
        for step, axes in enumerate(episode_strip(layout, episode, n_frames=20).axes):
            moved = poses[step + 1, :2] - poses[step, :2]
            for arrow in arrows(axes):
                np.testing.assert_allclose(direction(arrow), moved / np.hypot(*moved), atol=1e-6)
                compared += 1
    assert compared > 60


def test_the_robot_looks_where_its_trace_says() -> None:
    axes = episode_strip(CORRIDOR, drive()).axes[0]

    (robot,) = by_gid(axes, "robot")
    tip = robot._marker.get_transform().transform([1.0, 0.0])  # type: ignore[attr-defined]
    # By hand: the mark's tip lies ahead, and the robot looks 30 degrees to the left of x.
    np.testing.assert_allclose(tip / np.hypot(*tip), [np.sqrt(3) / 2, 0.5])


def test_the_strip_tells_action_reward_and_collision_in_words() -> None:
    episode = drive(steps=4, hits=(1,))

    figure = episode_strip(CORRIDOR, episode)

    # By hand: -0.25 a step for time, and 10 for the goal with the last.
    assert [axes.get_title() for axes in figure.axes] == [
        "0.0 s: ahead, right\nreward −0.25",
        "0.2 s: ahead, right\nreward −0.25, hit",
        "0.4 s: ahead, right\nreward −0.25",
        "0.6 s: ahead, right\nreward +9.75",
    ]
    assert [len(by_gid(axes, "collisions")) for axes in figure.axes] == [0, 1, 1, 1]
    ways = [by_gid(axes, "way")[0].get_xdata() for axes in figure.axes]
    np.testing.assert_allclose(ways[2], [0.25, 0.75, 1.25])
    assert figure.get_suptitle() == "4 moments of 0.8 s, goal reached; maze 2.5 m x 1.5 m"


@pytest.mark.parametrize(
    ("forward", "turn", "words", "has_arrow"),
    [
        (1.0, 0.0, "ahead", True),
        (-0.5, 0.3, "back, left", True),
        (0.0, 0.4, "turns left", False),
        (0.0, -0.4, "turns right", False),
        (0.0, 0.0, "stands", False),
    ],
)
def test_what_a_robot_does_has_a_word_and_rest_has_no_arrow(
    forward: float, turn: float, words: str, has_arrow: bool
) -> None:
    axes = episode_strip(CORRIDOR, drive(forward=forward, turn=turn)).axes[0]

    assert axes.get_title().startswith(f"0.0 s: {words}\n")
    assert bool(arrows(axes)) == has_arrow


def test_a_strip_shows_evenly_spaced_moments_from_first_to_last_step() -> None:
    figure = episode_strip(CORRIDOR, drive(steps=28), n_frames=10)

    # By hand: steps 0, 3, 6 ... 27, of 0.2 s each.
    times = [float(axes.get_title().split(" s:")[0]) for axes in figure.axes]
    np.testing.assert_allclose(times, 0.6 * np.arange(10))


@pytest.mark.parametrize("n_frames", [1, 2, 7, 10, 11])
def test_a_strip_of_any_length_has_its_legend_beside_the_mazes(n_frames: int) -> None:
    figure = episode_strip(CORRIDOR, drive(steps=28), n_frames=n_frames)

    assert len(figure.axes) == n_frames
    assert legend_words(figure) == ["robot", "action", "way so far", "goal", "collision"]
    assert_nothing_overlaps(figure)


def test_an_episode_without_a_trace_has_no_strip_and_no_course() -> None:
    bare = replace(drive(), trace=None)
    with pytest.raises(ValueError, match="without a trace"):
        episode_strip(CORRIDOR, bare)
    with pytest.raises(ValueError, match="without a trace"):
        reward_terms(bare)


# ---- Rewards -----------------------------------------------------------------------------------------


def stacked(axes: Axes, gid: str, time_s: float) -> tuple[float, float]:
    """Lower and upper edge of an area just after a moment."""
    (area,) = [item for item in axes.collections if item.get_gid() == gid]
    corners = np.concatenate([path.vertices for path in area.get_paths()])
    (at,) = {x for x in corners[:, 0] if np.isclose(x, time_s)} or {np.nan}
    after = corners[corners[:, 0] == min(x for x in corners[:, 0] if x > at + 1e-9)]
    # Areas are steps: what stands at the next moment's left side held since this one.
    return float(after[:, 1].min()), float(after[:, 1].max())


def test_reward_terms_are_summed_up_and_stacked_by_sign() -> None:
    episode = drive(steps=4)
    trace = course(episode)
    terms = {
        "goal": np.array([0.0, 0.0, 0.0, 10.0]),
        "collision": np.array([0.0, -1.0, 0.0, 0.0]),
        "time": np.full(4, -0.25),
        "progress": np.ones(4),
    }

    figure = reward_terms(replace(episode, trace=replace(trace, reward_terms=terms)))

    axes = figure.axes[0]
    (line,) = by_gid(axes, "return")
    # By hand: 0; +0.75; -0.25 + 0.75 = 0.5; 1.25; 12.0; and held beyond the end.
    np.testing.assert_allclose(line.get_ydata(), [0.0, 0.75, 0.5, 1.25, 12.0, 12.0])
    np.testing.assert_allclose(line.get_xdata()[:5], [0.0, 0.2, 0.4, 0.6, 0.8])
    # After the end, by hand: progress from 0 to 4, the goal on it to 14; time from 0 to -1, the collision below to -2.
    np.testing.assert_allclose(stacked(axes, "progress gain", 0.8), (0.0, 4.0))
    np.testing.assert_allclose(stacked(axes, "goal gain", 0.8), (4.0, 14.0))
    np.testing.assert_allclose(stacked(axes, "time cost", 0.8), (-1.0, 0.0))
    np.testing.assert_allclose(stacked(axes, "collision cost", 0.8), (-2.0, -1.0))
    assert legend_words(figure) == [
        "goal +10.00", "collision −1.00", "time −1.00", "progress +4.00", "return +12.00", "end of the episode",
    ]  # fmt: skip
    (goal,) = [item for item in axes.collections if item.get_gid() == "goal gain"]
    assert tuple(goal.get_facecolor()[0]) == to_rgba(palette.GOAL)
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("time (s)", "reward so far")
    assert_nothing_overlaps(figure)


def test_no_two_reward_terms_look_alike_without_colour() -> None:
    figure = reward_terms(drive())

    (legend,) = figure.legends
    hatches = [patch.get_hatch() for patch in legend.get_patches()]
    assert len(set(hatches)) == len(hatches) == 2


def test_a_signed_number_has_a_real_minus_and_no_negative_zero() -> None:
    assert [signed(value) for value in (1.0, -0.254, -0.0, -0.001)] == ["+1.00", "−0.25", "+0.00", "+0.00"]


# ---- Success -----------------------------------------------------------------------------------------


def test_success_stands_as_dot_interval_and_number_from_top_to_bottom() -> None:
    rows = {
        "q-learning on GridWorld, every goal": (0.94, 0.84, 0.98),
        "ppo": (1.0, 0.93, 1.0),
        "none": (0.0, 0.0, 0.07),
    }

    figure = success_bars(rows)

    axes = figure.axes[0]
    intervals = [list(line.get_xdata()) for line in by_gid(axes, "interval")]
    assert intervals == [[0.84, 0.98], [0.93, 1.0], [0.0, 0.07]]
    assert [float(line.get_xdata()[0]) for line in by_gid(axes, "value")] == [0.94, 1.0, 0.0]
    assert [label.get_text() for label in axes.get_yticklabels()] == [
        "q-learning on\nGridWorld, every\ngoal", "ppo", "none",
    ]  # fmt: skip
    bottom, top = axes.get_ylim()
    assert bottom > top, "the first row is on top"
    words = [text.get_text() for text in axes.texts if isinstance(text, Annotation) and text.get_gid() == "words"]
    assert words == ["94.0 %\n(84 to 98 %)", "100.0 %\n(93 to 100 %)", "0.0 %\n(0 to 7 %)"]
    (target,) = by_gid(axes, "target")
    assert list(target.get_xdata()) == [0.95, 0.95]
    assert axes.get_xlabel() == "success rate (bar: 95 % interval)"
    assert_nothing_overlaps(figure)


# ---- Saving ------------------------------------------------------------------------------------------


def test_figures_are_saved_by_suffix_and_names_are_no_formulas(tmp_path: Path) -> None:
    name = r"a $\frac{$ & <b>"
    figure = trajectories(CORRIDOR, {name: [drive()]})

    save_figure(figure, tmp_path / "a.png")
    save_figure(figure, tmp_path / "a.svg")

    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    assert "<svg" in (tmp_path / "a.svg").read_text()
    assert svg_text(figure).startswith("<svg")
    for other in (
        learning_curves({name: seeds(0.5)[0]}),
        comparison({name: seeds(0.5)}),
        success_bars({name: (0.5, 0.4, 0.6)}),
        value_map(CORRIDOR, np.ones((3, 5)), (0, 4), directions_rad=np.zeros((3, 5)), arrow_label=name),
    ):
        assert svg_text(other).startswith("<svg")


def test_equal_figures_give_equal_svg() -> None:
    def figures() -> list[Figure]:
        return [value_map(CORRIDOR, np.arange(60.0).reshape(15, 4), (0, 4)), episode_strip(CORRIDOR, drive())]

    assert [svg_text(figure) for figure in figures()] == [svg_text(figure) for figure in figures()]
