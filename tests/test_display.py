"""Recordings are read back, and the report is parsed."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
import rerun as rr
import rerun.blueprint as rrb
from matplotlib.colors import to_rgb
from rerun.chunk import RrdReader

from gridnav.display import palette
from gridnav.display.figures import trajectories
from gridnav.display.policy_map import PolicyMap
from gridnav.display.recording import screenshot, write_overlay, write_recording
from gridnav.display.report import Picture, Report, Rung, write_report
from gridnav.display.viewer import ViewerError, open_window
from gridnav.problem.layout import Layout
from gridnav.problem.metrics import Episode, Trace, summarise
from gridnav.problem.robot import BURGER
from gridnav.problem.types import AnyArray

CORRIDOR = Layout.from_text("S...G\n.###.\n.....\n")


MAP = PolicyMap(np.arange(15.0).reshape(3, 5), np.zeros((3, 5)), np.ones((3, 5)))


@pytest.fixture(autouse=True)
def _strict_rerun() -> Iterator[None]:
    """Otherwise a failed log call is a warning and its data is missing."""
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


def drive(*, steps: int = 10, is_success: bool = True, hits: tuple[int, ...] = (), grid: bool = False) -> Episode:
    """An episode from (0, 0) to (0, 4) of the corridor at constant speed, with its trace; 2 m in all."""
    x = np.linspace(0.25, 2.25 if is_success else 1.25, steps + 1)
    poses = np.column_stack([x, np.full(steps + 1, 1.25), np.full(steps + 1, np.pi / 6)])
    scans = np.full((steps + 1, 24), 1.0)
    scans[:, 6:] = BURGER.lidar_range_m  # eighteen beams meet nothing
    hit = np.isin(np.arange(steps), hits).astype(np.int64)
    terms = {"goal": np.r_[np.zeros(steps - 1), 10.0 * is_success], "time": np.full(steps, -0.25)}
    actions = np.full((steps, 1), 3.0) if grid else np.tile([1.0, -0.5], (steps, 1))
    trace = Trace(np.arange(steps + 1) * 0.2, poses, scans, actions, terms, hit)
    return Episode(
        (0, 0), (0, 4), is_success, len(hits), float(x[-1] - x[0]), 2.0, steps * 0.2, 10.0, steps,
        float(sum(term.sum() for term in terms.values())), trace=trace,
    )  # fmt: skip


def columns(path: Path, entity: str, column: str) -> list[object]:
    """One column of an entity, one element per row, from the static or the timed data that has it."""
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        if chunk.entity_path == entity and column in batch.schema.names:
            return list(batch.column(column).to_pylist())
    raise AssertionError(f"{entity} has no {column}")


def entities(path: Path) -> set[str]:
    return {chunk.entity_path for chunk in RrdReader(path).stream()}


# ---- Recordings --------------------------------------------------------------------------------


def test_rollouts_stand_side_by_side_on_one_timeline(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"

    write_recording(path, CORRIDOR, {"grid": drive(steps=4, grid=True), "robot": drive(steps=10)})

    for name, steps in (("grid", 4), ("robot", 10)):
        assert columns(path, f"/rollouts/{name}/robot", "step") == list(range(steps + 1))
        seconds = [time.total_seconds() for time in columns(path, f"/rollouts/{name}/robot", "sim_time")]
        np.testing.assert_allclose(seconds, 0.2 * np.arange(steps + 1))
    here = entities(path)
    assert "/rollouts/robot/robot/lidar/rays" in here
    assert "/rollouts/grid/robot/lidar/rays" not in here, "a grid robot has no lidar to draw"


def test_what_was_drawn_for_an_episode_is_a_table_in_its_recording(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    drawn = {"battery_v": 9.25, "lidar_scale": 1.012345}
    rollouts = {"a|b": replace(drive(), randomization=drawn), "robot": drive()}

    write_recording(path, CORRIDOR, rollouts, units={"battery_v": "V", "lidar_scale": "x"})

    (text,) = columns(path, "/drawn", "TextDocument:text")[0]  # type: ignore[misc]
    assert text.splitlines()[0] == "| quantity | a/b | unit |"
    assert text.splitlines()[2:] == ["| battery_v | 9.25 | V |", "| lidar_scale | 1.012 | x |"]
    write_recording(path, CORRIDOR, {"robot": drive()})
    assert "/drawn" not in entities(path)


def test_the_robot_stands_and_looks_where_its_trace_says(tmp_path: Path) -> None:
    path, episode = tmp_path / "run.rrd", drive(steps=3)
    assert episode.trace is not None

    write_recording(path, CORRIDOR, {"robot": episode})

    places = np.array(columns(path, "/rollouts/robot/robot", "Transform3D:translation"))[:, 0]
    np.testing.assert_allclose(places[:, :2], episode.trace.poses[:, :2], rtol=1e-6)
    turns = np.array(columns(path, "/rollouts/robot/robot", "Transform3D:quaternion"))[:, 0]
    # By hand: 30 degrees about z is (0, 0, sin 15, cos 15) in the order x, y, z, w.
    np.testing.assert_allclose(turns, np.tile([0, 0, 0.2588190, 0.9659258], (4, 1)), atol=1e-6)


def test_rays_are_as_long_as_the_scan_and_only_measured_walls_have_points(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"

    write_recording(path, CORRIDOR, {"robot": drive(steps=3)})

    rays = np.array(columns(path, "/rollouts/robot/robot/lidar/rays", "Arrows3D:vectors"))
    assert rays.shape == (4, 24, 3)
    lengths = np.linalg.norm(rays, axis=-1)
    np.testing.assert_allclose(lengths[0], [1.0] * 6 + [3.5] * 18, rtol=1e-6)
    points = np.array(columns(path, "/rollouts/robot/robot/lidar/hits", "Points3D:positions"))
    assert points.shape == (4, 6, 3)
    np.testing.assert_allclose(points[0, 0], [1, 0, 0])  # the first beam looks ahead, in the lidar's frame
    assert points[0, 1, 1] > 0, "beams go counter-clockwise"
    mount = columns(path, "/rollouts/robot/robot/lidar", "Transform3D:translation")
    np.testing.assert_allclose(mount, [[[-0.032, 0.0, 0.182]]], rtol=1e-6)


def test_reward_curves_end_at_the_return(tmp_path: Path) -> None:
    path, episode = tmp_path / "run.rrd", drive(steps=4)

    write_recording(path, CORRIDOR, {"robot": episode})

    assert columns(path, "/return/robot", "SeriesLines:names") == [["goal", "time", "sum"]]
    sums = np.array(columns(path, "/return/robot", "Scalars:scalars"))
    np.testing.assert_allclose(sums, [[0, -0.25, -0.25], [0, -0.5, -0.5], [0, -0.75, -0.75], [10, -1.0, 9.0]])
    assert sums[-1, -1] == episode.episode_return
    assert columns(path, "/return/robot", "step") == [1, 2, 3, 4], "a reward stands at the end of its step"
    assert columns(path, "/action/robot", "step") == [0, 1, 2, 3], "an action stands at the beginning of its step"


def test_the_distance_curve_is_the_free_way_to_the_goal(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"

    write_recording(path, CORRIDOR, {"robot": drive(steps=4)})

    # By hand: from (0.25, 1.25) straight to (2.25, 1.25) in four steps of half a metre.
    distances = columns(path, "/distance_to_goal/robot", "Scalars:scalars")
    np.testing.assert_allclose(distances, [[2.0], [1.5], [1.0], [0.5], [0.0]], atol=1e-6)


def test_collisions_are_marked_and_turn_the_robot_red(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"

    write_recording(path, CORRIDOR, {"robot": drive(steps=4, hits=(1,))})

    (marks,) = columns(path, "/rollouts/robot/collisions", "Points3D:positions")
    np.testing.assert_allclose(np.array(marks)[:, :2], [[1.25, 1.25]])  # where the second step ended
    colours = np.array(columns(path, "/rollouts/robot/robot/body", "Cylinders3D:colors"))[:, 0]
    red = int(palette.COLLISION[1:] + "ff", 16)
    np.testing.assert_array_equal(colours == red, [False, True, False])
    assert columns(path, "/rollouts/robot/robot/body", "step") == [0, 2, 3], "a colour stays until the next one"


def test_the_run_card_says_what_was_reached_and_with_which_seeds(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    rollouts = {"from | scratch": drive(is_success=False), "warm": drive()}

    write_recording(path, CORRIDOR, rollouts, title="Two agents", properties={"seed": 7})

    ((card,),) = columns(path, "/run_card", "TextDocument:text")
    assert "# Two agents" in card
    assert "**from | scratch** **missed** its goal: 2.0 s, 1.00 m (shortest 2.00 m)" in card
    assert "**warm** reached its goal: 2.0 s, 2.00 m (shortest 2.00 m), 0 collisions, return 7.50" in card
    assert "- seed: 7" in card
    assert columns(path, "/__properties/run", "seed") == [["7"]]


def test_a_recording_is_written_in_columns_and_not_step_by_step(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"

    write_recording(path, CORRIDOR, {"robot": drive(steps=500)})

    chunks = [chunk for chunk in RrdReader(path).stream() if not chunk.is_static]
    assert len(chunks) == len({chunk.entity_path for chunk in chunks}), "one chunk per moving entity"


def test_a_long_rollout_stays_small(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"

    write_recording(path, CORRIDOR, {"robot": drive(steps=500)}, maps={"robot": MAP})

    assert path.stat().st_size <= 600_000


def test_values_and_policy_lie_on_the_floor(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"

    write_recording(path, CORRIDOR, {"robot": drive()}, maps={"robot": MAP})

    (pixels,) = columns(path, "/rollouts/robot/policy/values", "GridMap:data")
    # By hand: 0 to 14 over 15 cells become 0 to 255, row 0 first; walls count as the lowest.
    grid = np.frombuffer(bytes(pixels[0]), np.uint8).reshape(3, 5)
    np.testing.assert_array_equal(grid[0], np.round(np.arange(5) / 14 * 255))
    np.testing.assert_array_equal(grid[1, 1:4], [0, 0, 0])
    assert grid[2, 4] == 255
    (arrows,) = columns(path, "/rollouts/robot/policy/arrows", "Arrows3D:vectors")
    assert len(arrows) == 12, "one in each free cell"
    np.testing.assert_allclose(arrows[0], [0.65 * 0.5, 0.0, 0.0], atol=1e-6)


def test_the_wheels_roll_as_far_as_the_robot_drives(tmp_path: Path) -> None:
    path, episode = tmp_path / "run.rrd", drive(steps=10)
    assert episode.trace is not None

    write_recording(path, CORRIDOR, {"robot": episode})

    speeds = np.array(columns(path, "/wheel_speed/robot", "Scalars:scalars"))
    # By hand: 0.2 m along x in 0.2 s, seen along a heading of 30 degrees: cos 30 m/s on wheels of 0.033 m.
    np.testing.assert_allclose(speeds, np.full((10, 2), np.cos(np.pi / 6) / 0.033), rtol=1e-6)


def test_the_timeline_says_what_the_robot_does_and_how_it_ended(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"

    write_recording(path, CORRIDOR, {"a": drive(steps=10, hits=(3, 4)), "b": drive(is_success=False)})

    assert columns(path, "/state/1_a", "StateChange:state") == [["driving"], ["collided"], ["driving"], ["arrived"]]
    assert columns(path, "/state/1_a", "step") == [0, 3, 5, 10]
    assert columns(path, "/state/2_b", "StateChange:state") == [["driving"], ["did not arrive"]]


def test_many_episodes_lie_one_above_the_other(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"

    write_overlay(path, CORRIDOR, [drive(steps=4), drive(steps=10), drive(steps=6, is_success=False)])

    (trails,) = columns(path, "/trails/arrived", "LineStrips3D:strips")
    assert [len(trail) for trail in trails] == [5, 11]
    shares = np.array(columns(path, "/arrived", "Scalars:scalars"))[:, 0]
    np.testing.assert_allclose(shares, [0] * 4 + [1 / 3] * 6 + [2 / 3])
    robots = np.array(columns(path, "/robots", "Points3D:positions"))
    assert robots.shape == (11, 3, 3)
    np.testing.assert_allclose(robots[-1, 0, :2], [2.25, 1.25], rtol=1e-6)


def test_a_name_with_slashes_and_spaces_stays_one_entity(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"

    write_recording(path, CORRIDOR, {"PPO / warm: 2": drive()})

    assert {r"/distance_to_goal/PPO\ \/\ warm\:\ 2", "/state/1_PPO_warm_2"} <= entities(path)


def test_rollouts_without_a_trace_or_with_other_goals_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="each with a trace"):
        write_recording(tmp_path / "run.rrd", CORRIDOR, {"robot": replace(drive(), trace=None)})
    with pytest.raises(ValueError, match="share one start and goal"):
        write_recording(tmp_path / "run.rrd", CORRIDOR, {"a": drive(), "b": replace(drive(), goal=(2, 4))})


@contextmanager
def needs_vulkan() -> Iterator[None]:
    try:
        yield
    except ViewerError as error:
        if "Vulkan" in str(error):
            pytest.skip("no Vulkan driver here (Debian package mesa-vulkan-drivers)")
        raise


def centre_column(pixels: AnyArray, colour: str) -> float:
    """Where the pixels of a colour are in the upper left of a picture, where the maze is."""
    view = pixels[: len(pixels) // 2, : pixels.shape[1] * 2 // 3]
    columns_there = np.nonzero(np.abs(view - to_rgb(colour)).max(axis=-1) < 0.05)[1]
    assert columns_there.size > 20, f"nothing of colour {colour} is in sight"
    return float(np.median(columns_there))


@pytest.mark.parametrize("time_s", [0.6, 1.4])
def test_the_picture_shows_the_robot_where_its_data_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, time_s: float
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    recording, picture = tmp_path / "run.rrd", tmp_path / "run.png"
    episode = drive()
    assert episode.trace is not None
    blind = replace(episode.trace, scans_m=np.full_like(episode.trace.scans_m, np.nan))  # rays would cover the start
    write_recording(recording, CORRIDOR, {"robot": replace(episode, trace=blind)})

    with needs_vulkan():
        screenshot(recording, picture, time_s=time_s, window_size=(800, 600))

    pixels = matplotlib.image.imread(picture)[..., :3]
    assert pixels.shape == (600, 800, 3)
    # By hand: from the start at x = 0.25 m to the goal at 2.25 m at 1 m/s, so after t seconds t/2 of the way. The
    # robot's top is 0.2 m nearer to the eye, 3 m above the middle, than the floor: 0.2 off the middle looks like 0.214.
    start, goal = centre_column(pixels, palette.START), centre_column(pixels, palette.GOAL)
    robot = centre_column(pixels, palette.INK)
    assert (robot - start) / (goal - start) == pytest.approx(time_s / 2, abs=0.025)


def test_what_a_view_cannot_show_is_an_error_and_no_picture(tmp_path: Path) -> None:
    torn = rr.Image.from_fields(buffer=bytes(5), format=rr.components.ImageFormat(100, 100, color_model="L"))
    recording = rr.RecordingStream("gridnav", send_properties=False)
    recording.save(tmp_path / "torn.rrd", default_blueprint=rrb.Blueprint(rrb.Spatial2DView(), auto_views=False))
    recording.set_time("sim_time", duration=0.0)
    recording.log("image", torn)
    recording.disconnect()

    with needs_vulkan(), pytest.raises(ViewerError, match="Expected 10000 bytes"):
        screenshot(tmp_path / "torn.rrd", tmp_path / "torn.png")

    assert not (tmp_path / "torn.png").exists()


def test_without_a_graphics_driver_the_error_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_recording(tmp_path / "run.rrd", CORRIDOR, {"robot": drive()})
    for variable in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
        monkeypatch.setenv(variable, str(tmp_path / "none.json"))

    with pytest.raises(ViewerError, match="mesa-vulkan-drivers") as caught:
        screenshot(tmp_path / "run.rrd", tmp_path / "run.png")

    assert "\n" not in str(caught.value)


@pytest.mark.skipif("sys.platform != 'linux'", reason="elsewhere there is always a display")
def test_without_a_display_the_viewer_names_the_alternatives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    write_recording(tmp_path / "run.rrd", CORRIDOR, {"robot": drive()})

    with pytest.raises(ViewerError, match=r"--screenshot out\.png.*--web.*--save out\.rrd"):
        open_window(tmp_path / "run.rrd")
    with pytest.raises(ViewerError, match="there is no recording"):
        open_window(tmp_path / "other.rrd")


# ---- The report --------------------------------------------------------------------------------


class _Page(HTMLParser):
    """Tags, ids, links and the text of table cells."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.rows: list[list[str]] = []
        self._in_cell = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(value or "")
            if name in ("href", "src", "xlink:href"):
                self.links.append(value or "")
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self._in_cell = True
            self.rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        if tag in ("td", "th"):
            self._in_cell = False

    def handle_data(self, data: str) -> None:
        if self._in_cell:
            self.rows[-1][-1] = " ".join(f"{self.rows[-1][-1]} {data}".split())


def ladder_report(*, hostile: str = "") -> Report:
    rungs = [
        Rung(
            "robot" + hostile, "gridnav/DiffDrive-v0" + hostile, "PPO", "the table" + hostile,
            summarise([drive(), drive(), drive(is_success=False, hits=(1,)), drive()]), 1234567, 754.0,
            note="no noise" + hostile, seeds="0-2",
        ),
        Rung("stuck", "gridnav/Unicycle-v0", "DQN", "", summarise([drive(is_success=False)]), 0, 12.34),
    ]  # fmt: skip
    pictures = [
        Picture(trajectories(CORRIDOR, {"robot" + hostile: [drive()]}), "The way" + hostile),
        Picture(trajectories(CORRIDOR, {"robot" + hostile: [drive()]}), "The way again"),
    ]
    return Report(
        "Ladder" + hostile, "Does it help?" + hostile, "It does." + hostile, rungs, pictures,
        {"seed": 3, "name": "x" + hostile}, "gridnav ladder --seed 3" + hostile, {"mujoco": "4.0.0" + hostile},
        "runs/a" + hostile,
    )  # fmt: skip


def page(tmp_path: Path, report: Report) -> tuple[str, _Page]:
    write_report(tmp_path / "report.html", report)
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    return text, _Page(text)


def test_the_table_holds_the_numbers_of_each_rung(tmp_path: Path) -> None:
    text, parsed = page(tmp_path, ladder_report())

    _head, robot, stuck = parsed.rows
    assert robot == [
        "robot PPO in gridnav/DiffDrive-v0 no noise",
        "the table",
        "75 % 30 % to 95 %",  # Wilson's interval of 3 in 4: 0.301 to 0.954
        "0.75",  # every success took the shortest way
        "0.75",
        "25 %",
        "2.0 s",
        "1 234 567 13 min",
        "4 0-2",
    ]
    assert stuck[1] == "nothing"
    assert stuck[6] == "never"
    assert stuck[7] == "0 12.3 s"
    assert text.index("Does it help?") < text.index("It does.") < text.index("<table")
    assert "gridnav view runs/a" in text
    assert "&#34;seed&#34;: 3" in text
    assert parsed.tags.count("svg") == 2


def test_hostile_text_is_shown_and_not_obeyed(tmp_path: Path) -> None:
    hostile = "<script>alert(1)</script>\"'><img src=x onerror=alert(1)>--></style></svg>"

    text, parsed = page(tmp_path, ladder_report(hostile=hostile))

    assert parsed.tags.count("script") == 1, "the page's own"
    assert "img" not in parsed.tags
    assert parsed.tags.count("style") == 1 + 2  # the page's own, and one in each figure
    assert "&lt;script&gt;" in text


def test_the_page_asks_no_other_site_for_anything(tmp_path: Path) -> None:
    text, parsed = page(tmp_path, ladder_report())

    outside = [link for link in parsed.links if not link.startswith(("#", "data:")) and link != "rollout.rrd"]
    assert outside == []
    assert not re.search(r"url\((?!#)|@import", text)
    addresses = set(re.findall(r"https?://[^\s\"'<>]+", text))
    assert addresses <= {"http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"}, "names, not addresses"


def test_no_two_elements_of_the_page_share_an_id(tmp_path: Path) -> None:
    """Two figures on one page would otherwise clip each other."""
    text, parsed = page(tmp_path, ladder_report())

    assert len(parsed.ids) == len(set(parsed.ids))
    used = set(re.findall(r"url\(#([^)]+)\)", text)) | {link[1:] for link in parsed.links if link.startswith("#")}
    assert used <= set(parsed.ids)


def test_a_report_without_pictures_and_details_is_a_page_too(tmp_path: Path) -> None:
    text, parsed = page(
        tmp_path, replace(ladder_report(), pictures=(), config={}, command="", versions={}, recording="")
    )

    assert "What it looks like" not in text
    assert "details" not in parsed.tags
    assert "rollout.rrd" not in text
