"""The kinematic robot against closed forms, walls and the grid."""

from __future__ import annotations

import itertools
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from gridnav import Layout, Task
from gridnav.problem.robot import BURGER

ID = "gridnav/Unicycle-v0"
V, W = BURGER.max_speed_m_s, BURGER.max_turn_rad_s
SUBSTEP_M = V * 0.01  # 1.97 mm: how far it drives between two looks for contact
EVERYWHERE = {"layout": "open", "task": Task(starts="any", goals="any", goal_radius_m=1e-6), "max_episode_steps": 10**6}


def start(cell: tuple[int, int] = (5, 5), heading_rad: float = 0.0, n: int = 1, **arguments: Any) -> Any:
    """Robots at a cell's centre of an open room, whose goal is too small to be met by chance."""
    env = gym.make_vec(ID, num_envs=n, **(EVERYWHERE | arguments))
    env.reset(seed=0, options={"start": cell, "goal": (0, 0), "heading_rad": heading_rad})
    return env


def drive(env: Any, forward: float, turn: float, steps: int) -> list[dict[str, Any]]:
    """The infos of ``steps`` control periods with one command for all."""
    commands = np.tile(np.array([forward, turn], np.float32), (env.num_envs, 1))
    return [env.step(commands)[4] for _ in range(steps)]


def wall_gaps(points: np.ndarray, layout: Layout) -> np.ndarray:
    """Distance of points to the nearest wall by plain geometry: merged rectangles and the outer edge."""
    width, height = layout.size_m
    x, y = points[..., 0], points[..., 1]
    gaps = [x, width - x, y, height - y]
    for x0, y0, x1, y1 in layout.wall_rectangles():
        outside = np.hypot(np.maximum.reduce([x0 - x, x - x1, 0 * x]), np.maximum.reduce([y0 - y, y - y1, 0 * y]))
        gaps.append(outside)
    return np.minimum.reduce(gaps)


# ---- Closed forms --------------------------------------------------------------------------------


@pytest.mark.parametrize("heading", [0.0, np.pi / 2, -2.5])
@pytest.mark.parametrize("forward", [1.0, 0.3, -0.7])
def test_a_straight_drive_covers_speed_times_time(heading: float, forward: float) -> None:
    info = drive(start(heading_rad=heading), forward, 0.0, 25)[-1]

    way = np.float32(forward) * V * 5.0  # 25 periods of 0.2 s
    np.testing.assert_allclose(
        info["pose"][0], [2.75 + way * np.cos(heading), 2.25 + way * np.sin(heading), heading], atol=1e-12
    )
    assert info["path_length_m"][0] == pytest.approx(abs(way))


@pytest.mark.parametrize(("forward", "turn"), [(0.5, 0.25), (0.5, -0.25), (-0.4, 0.1), (0.05, 0.9)])
def test_a_constant_command_drives_the_arc_of_radius_v_over_omega(forward: float, turn: float) -> None:
    steps = 17
    info = drive(start(), forward, turn, steps)[-1]

    v, w = np.float64(np.float32(forward)) * V, np.float64(np.float32(turn)) * W
    t = steps * 0.2
    # Siegwart et al.: the centre of the circle lies at distance v / omega to the left of the robot.
    np.testing.assert_allclose(
        info["pose"][0, :2], [2.75 + v / w * np.sin(w * t), 2.25 + v / w * (1 - np.cos(w * t))], atol=1e-9
    )
    assert np.exp(1j * info["pose"][0, 2]) == pytest.approx(np.exp(1j * w * t), abs=1e-9)
    assert info["path_length_m"][0] == pytest.approx(abs(v) * t)


def test_a_circle_closes() -> None:
    # A full circle in 100 steps: omega * 20 s = 2 pi.
    turn = 2 * np.pi / 20 / W
    first = start()
    poses = [info["pose"][0] for info in drive(first, 0.5, turn, 100)]

    # The command is a float32: an angle error of 1e-7 relative.
    np.testing.assert_allclose(poses[-1], [2.75, 2.25, 0.0], atol=1e-5)
    assert np.ptp(np.array(poses)[:, 0]) == pytest.approx(2 * 0.5 * V / (turn * W), rel=1e-3)


@pytest.mark.parametrize("turn", [1.0, -0.3])
def test_turning_in_place_does_not_move(turn: float) -> None:
    infos = drive(start(), 0.0, turn, 50)

    for number, info in enumerate(infos, start=1):
        np.testing.assert_array_equal(info["pose"][0, :2], [2.75, 2.25])
        angle = np.float64(np.float32(turn)) * W * 0.2 * number
        assert np.exp(1j * info["pose"][0, 2]) == pytest.approx(np.exp(1j * angle), abs=1e-9)
    assert infos[-1]["path_length_m"][0] == 0.0


def test_headings_stay_within_half_a_turn() -> None:
    headings = [info["pose"][0, 2] for info in drive(start(heading_rad=3.0), 0.0, 1.0, 60)]

    assert -np.pi <= min(headings) < -3.0
    assert 3.0 < max(headings) <= np.pi


@pytest.mark.parametrize(
    ("command", "wheels"),
    [
        ((1.0, 0.0), (1.0, 1.0)),
        ((1.0, 0.5), (0.5, 1.0)),  # 1 + 0.5 is clipped to 1: slower forward, less turn
        ((1.0, 1.0), (0.0, 1.0)),
        ((-1.0, 1.0), (-1.0, 0.0)),
        ((0.0, 1.0), (-1.0, 1.0)),
        ((0.5, 0.25), (0.25, 0.75)),
        ((9.0, 0.0), (1.0, 1.0)),
    ],
)
def test_each_wheel_is_clipped_to_its_own_maximum(command: tuple[float, float], wheels: tuple[float, float]) -> None:
    observation, *_ = start().step(np.array([command]))

    left, right = wheels
    # Both wheels forward is speed, their difference is turn: v = (l + r) / 2, omega = (r - l) / 2 of the maxima.
    features = start().features
    np.testing.assert_allclose(
        observation[0, features.slices["speed"]], [(left + right) / 2, (right - left) / 2], atol=1e-6
    )


@pytest.mark.parametrize("period", [0.05, 0.1, 0.2, 1.0, 0.123])
def test_the_control_period_scales_the_step(period: float) -> None:
    info = drive(start(control_period_s=period), 0.5, 0.0, 1)[0]

    assert info["pose"][0, 0] == pytest.approx(2.75 + 0.5 * V * period)
    assert info["elapsed_s"][0] == pytest.approx(period)


# ---- Walls ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("angle", [0.0, 0.3, -0.7, 1.2])
@pytest.mark.parametrize("forward", [1.0, -1.0, 0.4])
def test_a_robot_that_drives_into_a_wall_stops_there(angle: float, forward: float) -> None:
    env = start((5, 8), angle if forward > 0 else angle + np.pi)
    infos = drive(env, forward, 0.0, 150)

    poses = np.array([info["pose"][0] for info in infos])
    gap = wall_gaps(poses[:, :2], env.layout) - BURGER.radius_m
    assert gap.min() >= -1e-9
    assert gap[-1] <= SUBSTEP_M + 1e-4
    hits = [bool(info["collision"][0]) for info in infos]
    # A cell-time is 12.7 periods of 0.2 s: pressing on counts again after every 13.
    assert np.diff(np.flatnonzero(hits)).tolist() == [13] * ((149 - hits.index(True)) // 13)
    # Refused commands do not slide along the wall: from the contact on it stands still.
    np.testing.assert_array_equal(poses[hits.index(True) :], np.tile(poses[-1], (150 - hits.index(True), 1)))
    assert infos[-1]["path_length_m"] == infos[hits.index(True)]["path_length_m"]


def test_a_contact_is_charged_once_until_the_robot_has_left_the_wall() -> None:
    env = start((5, 9), 0.0)

    hits = sum(bool(info["collision"][0]) for info in drive(env, 1.0, 0.0, 10))
    assert hits == 1
    # 5 mm back and forth: still the same contact.
    for _ in range(3):
        assert not any(info["collision"][0] for info in drive(env, -0.12, 0.0, 1) + drive(env, 1.0, 0.0, 3))
    # 39 mm back is more than the 10 mm that end a contact.
    infos = drive(env, -1.0, 0.0, 1) + drive(env, 1.0, 0.0, 3)
    assert sum(bool(info["collision"][0]) for info in infos) == 1
    assert infos[-1]["collisions"][0] == 2


def test_turning_and_backing_off_at_a_wall_are_free() -> None:
    env = start((5, 9), 0.0)
    pressed = drive(env, 1.0, 0.0, 10)[-1]["pose"][0]

    turned = drive(env, 0.0, 0.5, 5)[-1]
    np.testing.assert_array_equal(turned["pose"][0, :2], pressed[:2])
    assert turned["pose"][0, 2] == pytest.approx(0.5 * W * 1.0)
    drive(env, 0.0, -0.5, 5)
    backed = drive(env, -1.0, 0.0, 5)[-1]
    assert backed["pose"][0, 0] == pytest.approx(pressed[0] - V * 1.0)
    assert backed["collisions"][0] == 1


def test_a_robot_at_a_wall_may_drive_along_it() -> None:
    env = start((5, 9), 0.0)
    pressed = drive(env, 1.0, 0.0, 10)[-1]["pose"][0]
    quarter = np.pi / 2 / (W * 0.2 * 10)
    drive(env, 0.0, quarter, 10)

    along = drive(env, 1.0, 0.0, 5)[-1]

    assert along["pose"][0, 1] == pytest.approx(pressed[1] + V, abs=1e-3)
    assert along["collisions"][0] == 1


@pytest.mark.parametrize("forward", [1.0, -1.0])
def test_a_robot_that_grazes_a_wall_scrapes_along_it_and_pays_as_for_pressing(forward: float) -> None:
    """At 10 degrees to the wall; the part of the speed along it is left, and each cell-time costs a collision."""
    angle = np.pi / 2 - np.deg2rad(10.0)
    env = start((8, 9), angle if forward > 0 else angle + np.pi)
    infos = drive(env, forward, 0.0, 80)

    hits = [bool(info["collision"][0]) for info in infos]
    first = hits.index(True)
    assert np.diff(np.flatnonzero(hits)).tolist() == [13] * ((79 - first) // 13)
    way = infos[-1]["pose"][0] - infos[first]["pose"][0]
    assert way[1] == pytest.approx(V * np.cos(np.deg2rad(10.0)) * (79 - first) * 0.2, rel=1e-6)
    gaps = wall_gaps(np.array([info["pose"][0, :2] for info in infos]), env.layout)
    assert gaps.min() >= BURGER.radius_m - 1e-6


def test_sliding_goes_along_the_wall_and_every_step_of_it_is_charged() -> None:
    """Against a wall at 45 degrees: the part of the speed along the wall, 0.139 m/s, is left."""
    env = start((5, 9), np.pi / 4, task=Task("any", "any", "slide", 1e-6))
    infos = drive(env, 1.0, 0.0, 20)

    first = next(i for i, info in enumerate(infos) if info["collision"][0])
    assert all(info["collision"][0] for info in infos[first:])
    assert all(info["reward_terms"]["collision"][0] < 0 for info in infos[first:])
    way = infos[-1]["pose"][0] - infos[first]["pose"][0]
    seconds = (19 - first) * 0.2
    assert way[1] == pytest.approx(V * np.sin(np.pi / 4) * seconds, rel=1e-6)
    assert infos[-1]["path_length_m"][0] - infos[first]["path_length_m"][0] == pytest.approx(way[1], rel=1e-6)
    gaps = wall_gaps(np.array([info["pose"][0, :2] for info in infos]), env.layout)
    assert gaps.min() >= BURGER.radius_m - 1e-6


def test_a_collision_ends_the_episode_where_the_task_is_fragile() -> None:
    env = start((5, 9), 0.0, task=Task("any", "any", "end", 1e-6))

    ends = [bool(env.step(np.array([[1.0, 0.0]], np.float32))[2][0]) for _ in range(5)]

    # 0.25 - 0.105 = 0.145 m to go at 0.0394 m per step: the fourth step meets the wall.
    assert ends == [False, False, False, True, False]


@pytest.mark.parametrize("on_collision", ["stop", "slide"])
@pytest.mark.parametrize("name", ["classic", "corridors", "random"])
def test_no_random_drive_ever_enters_a_wall(name: str, on_collision: Any) -> None:
    layout = Layout.random(density=0.35, seed=3) if name == "random" else Layout.load(name)
    env = gym.make_vec(ID, num_envs=128, layout=layout, task=Task("any", "any", on_collision), max_episode_steps=200)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    commands = np.zeros((128, 2), np.float32)

    collisions, before = 0, env._pose.copy()
    for step in range(400):
        if step % 7 == 0:  # hold commands for a while, so that robots get to the walls and press
            commands = rng.choice([-1.0, -0.3, 0.0, 0.5, 1.0], (128, 2), p=[0.15, 0.1, 0.1, 0.15, 0.5]).astype(
                np.float32
            )
        *_, info = env.step(commands)
        pose = info.get("final_info", info)["pose"]
        collisions += int(info.get("final_info", info)["collision"].sum())
        # Rounding a corner, a straight substep s cuts the circle by at most s^2 / 2r = 18 um.
        assert wall_gaps(pose[:, :2], layout).min() >= BURGER.radius_m - SUBSTEP_M**2 / (2 * BURGER.radius_m) - 2e-6
        assert np.hypot(*(pose - before)[:, :2].T).max() <= V * 0.2 + 1e-9
        before = info["pose"]
    assert collisions > 300


# ---- The grid and the robot worlds on the same way ------------------------------------------------


def drive_cells(env: Any, path: list[tuple[int, int]]) -> tuple[list[float], dict[str, float], dict[str, Any]]:
    """Drive a robot along cell centres: rewards, sums of the reward terms, last info."""
    from gridnav.envs.grid_moves import steer

    _, info = env.reset(options={"start": path[0], "goal": path[-1], "heading_rad": 0.0})
    sums: dict[str, float] = dict.fromkeys(info["reward_terms"], 0.0)
    rewards = []
    for cell in path[1:]:
        target = env.unwrapped.layout.to_metres(np.array(cell))
        while np.hypot(*(info["pose"][:2] - target)) > 0.04:
            command = steer(info["pose"][None], target[None], BURGER, 0.2)[0]
            _, reward, terminated, truncated, info = env.step(command.astype(np.float32))
            rewards.append(reward)
            for name, value in info["reward_terms"].items():
                sums[name] += value
            assert not truncated
            if terminated:
                break
    assert info["is_success"]
    return rewards, sums, info


@pytest.mark.parametrize("robot_id", ["gridnav/Unicycle-v0", "gridnav/DiffDrive-v0"])
@pytest.mark.parametrize(
    "path",
    [
        [(0, c) for c in range(8)],
        [(0, 2), *((r, 2) for r in range(1, 5)), *((4, c) for c in (1, 0)), *((r, 0) for r in range(5, 9))],
    ],
    ids=["straight", "round corners"],
)
def test_the_same_way_on_the_grid_and_by_robot_earns_about_the_same(robot_id: str, path: list[tuple[int, int]]) -> None:
    moves = {(-1, 0): 0, (1, 0): 1, (0, -1): 2, (0, 1): 3}
    grid = gym.make("gridnav/GridWorld-v0", task="any")
    _, start_info = grid.reset(options={"start": path[0], "goal": path[-1]})
    sums = dict.fromkeys(start_info["reward_terms"], 0.0)
    for here, there in itertools.pairwise(path):
        _, _, terminated, _, info = grid.step(moves[(there[0] - here[0], there[1] - here[1])])
        for name, value in info["reward_terms"].items():
            sums[name] += value
    assert terminated

    rewards, robot_sums, robot_info = drive_cells(gym.make(robot_id, task="any"), path)

    assert list(robot_sums) == list(sums)
    assert robot_sums["goal"] == sums["goal"]
    assert robot_sums["collision"] == sums["collision"] == 0.0
    assert sum(robot_sums.values()) == pytest.approx(sum(rewards))
    cells = len(path) - 1
    weight = sums["distance"] / cells
    # The robot stops 0.15 m (0.3 cells) before the goal's centre and may cut or overshoot each corner by 0.04 m.
    corners = 0 if robot_id.endswith("Unicycle-v0") and path[0][0] == path[-1][0] else 3
    assert robot_sums["distance"] / weight == pytest.approx(cells - 0.3, abs=0.1 + 0.1 * corners)
    # Time: at full speed a cell takes a cell-time; turning in place, slowing down and friction only add to it.
    assert (cells - 0.4) * sums["time"] / cells >= robot_sums["time"] >= 1.7 * sums["time"]
    # Progress telescopes to the weight times each world's own distance at the start, but for discounting.
    per_cell = robot_sums["progress"] / (robot_info["shortest_path_m"] / 0.5)
    assert per_cell == pytest.approx(sums["progress"] / cells, rel=0.1)
    # Both know the same shortest way, the robot's by the diagonals that its radius allows.
    assert robot_info["shortest_path_m"] <= start_info["shortest_path_m"] + 1e-9
    assert robot_info["path_length_m"] >= robot_info["shortest_path_m"] - 0.15 - 1e-6


@pytest.mark.parametrize("name", ["classic", "open", "four-rooms", "u-trap", "corridors"])
def test_a_robots_shortest_way_is_at_most_the_grids_and_at_least_the_straight_line(name: str) -> None:
    grid, robot = (gym.make_vec(i, num_envs=64, layout=name, task="any") for i in ("gridnav/GridWorld-v0", ID))

    _, grid_info = grid.reset(seed=0)
    _, robot_info = robot.reset(seed=0)

    # Both draw the same episodes from the same seed.
    np.testing.assert_array_equal(grid._start, robot._start)
    np.testing.assert_array_equal(grid._goal, robot._goal)
    straight = np.hypot(*(robot._goal_w - robot._pose[:, :2]).T)
    assert (robot_info["shortest_path_m"] <= grid_info["shortest_path_m"] + 1e-9).all()
    assert (robot_info["shortest_path_m"] >= straight - 1e-9).all()
