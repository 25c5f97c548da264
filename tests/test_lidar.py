"""The lidar by hand and against MuJoCo's own rays."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest
from gridnav.envs.mjcf import build_model
from mujoco.batch import Batch

from gridnav import Layout
from gridnav.envs import scan
from gridnav.problem.geodesic import clearances
from gridnav.problem.robot import BURGER

# A lidar above the axle makes the numbers those of the pose.
CENTRED = replace(BURGER, lidar_offset_m=0.0, n_beams=4)
ROOM = Layout.from_text("....\n....\n....\n")  # 2.0 x 1.5 m


def random_poses(layout: Layout, n: int, seed: int) -> np.ndarray:
    """Poses at which the robot's disc is free, shape ``(n, 3)``."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, layout.size_m, (40 * n, 2))
    points = points[clearances(points, layout)[0] > BURGER.radius_m][:n]
    assert len(points) == n
    return np.column_stack([points, rng.uniform(-np.pi, np.pi, n)])


def mujoco_rays(poses: np.ndarray, layout: Layout, n_beams: int) -> np.ndarray:
    """The same scan by ``mj_multiRay`` at the height of the real lidar, against walls alone."""
    model = build_model(layout)
    data = mujoco.MjData(model)
    data.qpos[:3] = [-5.0, -5.0, 5.0]  # the robot itself is out of the way
    mujoco.mj_forward(model, data)
    walls = np.array([1, 0, 0, 0, 0, 0], np.uint8)  # walls have the default group 0, the robot 2 and 3
    ranges = np.empty((len(poses), n_beams))
    ids = np.empty(n_beams, np.int32)
    for i, (x, y, heading) in enumerate(poses):
        angles = heading + np.arange(n_beams) * 2 * np.pi / n_beams
        directions = np.stack([np.cos(angles), np.sin(angles), np.zeros(n_beams)], axis=1).ravel()
        origin = np.array([x - 0.032 * np.cos(heading), y - 0.032 * np.sin(heading), 0.182])
        mujoco.mj_multiRay(model, data, origin, directions, walls, 1, -1, ids, ranges[i], None, n_beams, 100.0)
    return np.where(ranges < 0, 3.5, np.minimum(ranges, 3.5))


def test_beams_are_worked_out_by_hand_in_an_empty_room() -> None:
    """Ahead, left, behind, right of (0.5, 0.4) facing along x in a room of 2.0 x 1.5 m."""
    np.testing.assert_allclose(scan(np.array([[0.5, 0.4, 0.0]]), ROOM, CENTRED), [[1.5, 1.1, 0.5, 0.4]], atol=1e-12)


def test_beams_turn_with_the_robot() -> None:
    # Facing up: ahead is up, left is the left wall.
    up = scan(np.array([[0.5, 0.4, np.pi / 2]]), ROOM, CENTRED)

    np.testing.assert_allclose(up, [[1.1, 0.5, 0.4, 1.5]], atol=1e-9)


def test_a_slanted_beam_is_as_long_as_its_triangle_says() -> None:
    # 30 degrees up from (1.0, 0.5): the right wall at 1 / cos 30 = 1.155 m comes before the top at 1 / sin 30 = 2 m.
    ranges = scan(np.array([[1.0, 0.5, np.pi / 6]]), ROOM, CENTRED)

    assert ranges[0, 0] == pytest.approx(1 / np.cos(np.pi / 6))
    assert ranges[0, 2] == pytest.approx(min(0.5 / np.sin(np.pi / 6), 1 / np.cos(np.pi / 6)))


def test_the_lidar_stands_behind_the_axle() -> None:
    # Facing along x it is 0.032 m further left: 1.532 ahead and 0.468 behind.
    robot = replace(BURGER, n_beams=4)

    ranges = scan(np.array([[0.5, 0.4, 0.0], [0.5, 0.4, np.pi]]), ROOM, robot)

    np.testing.assert_allclose(ranges, [[1.532, 1.1, 0.468, 0.4], [0.532, 0.4, 1.468, 1.1]], atol=1e-9)


def test_a_wall_cell_is_seen_at_its_face() -> None:
    layout = Layout.from_text("....\n..#.\n....\n")  # the wall covers x 1.0 to 1.5, y 0.5 to 1.0

    ranges = scan(np.array([[0.3, 0.75, 0.0], [1.25, 0.2, np.pi / 2], [1.9, 0.9, np.pi]]), layout, CENTRED)

    np.testing.assert_allclose(ranges[:, 0], [0.7, 0.3, 0.4], atol=1e-9)


@pytest.mark.parametrize("heading", [0.0, np.pi / 2, np.pi, -np.pi / 2])
def test_rays_along_the_axes_meet_no_zero_division(heading: float) -> None:
    poses = np.array([[0.5, 0.5, heading], [1.0, 0.75, heading], [0.25, 1.0, heading]])  # also on cell borders

    with np.errstate(all="raise"):
        ranges = scan(poses, ROOM, CENTRED)

    # In whichever order, the four beams of a room add up to its width and height.
    np.testing.assert_allclose(ranges.sum(axis=1), 3.5, atol=1e-9)
    assert (ranges > 0).all()


def test_ranges_end_at_the_lidars_limit() -> None:
    layout = Layout.load("open")  # 5 x 5 m

    ranges = scan(np.array([[0.2, 2.5, 0.0]]), layout, CENTRED)

    # 4.8 m ahead reads 3.5 m.
    np.testing.assert_allclose(ranges, [[3.5, 2.5, 0.2, 2.5]], atol=1e-9)
    assert scan(np.array([[0.2, 2.5, 0.0]]), layout, replace(CENTRED, lidar_range_m=10.0))[0, 0] == pytest.approx(4.8)


@pytest.mark.parametrize("n_beams", [0, 361, -1, 24.0, True])
def test_a_number_of_beams_outside_1_to_360_is_refused(n_beams: Any) -> None:
    with pytest.raises(ValueError, match="n_beams"):
        replace(BURGER, n_beams=n_beams)


@pytest.mark.parametrize("n_beams", [1, 2, 3, 24, 359, 360])
def test_any_number_of_beams_is_evenly_spaced(n_beams: int) -> None:
    layout = Layout.load("classic")
    poses = random_poses(layout, 20, seed=n_beams)

    ranges = scan(poses, layout, replace(BURGER, n_beams=n_beams))

    assert ranges.shape == (20, n_beams)
    # Beam k is beam 0 of a robot turned by k parts about its lidar.
    k = n_beams // 2
    turned = poses[:, 2] + k * 2 * np.pi / n_beams
    lidars = poses[:, :2] - 0.032 * np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1)
    other = scan(np.column_stack([lidars, turned]), layout, replace(CENTRED, n_beams=1))
    np.testing.assert_allclose(ranges[:, k], other[:, 0], atol=1e-9)


LAYOUTS = [
    *(Layout.load(name) for name in ("classic", "open", "four-rooms", "u-trap", "corridors")),
    *(Layout.random(density=0.3, seed=seed) for seed in range(5)),
    *(Layout.maze(seed=seed) for seed in range(3)),
    Layout.random(n_rows=7, n_cols=23, density=0.25, seed=9),
    Layout.random(n_rows=12, n_cols=5, density=0.2, seed=1, cell_size_m=0.37),
]


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.name)
def test_ranges_equal_mujocos_rays_within_a_millimetre(layout: Layout) -> None:
    poses = random_poses(layout, 60, seed=0)

    error = np.abs(scan(poses, layout, replace(BURGER, n_beams=90)) - mujoco_rays(poses, layout, 90))

    # A ray that grazes a corner may see it or not: nothing else may differ.
    assert np.sort(error.ravel())[-3] < 1e-3
    assert np.median(error) < 1e-9


def test_ranges_equal_the_rays_of_a_batch_of_real_robots() -> None:
    """From the lidar's site of robots that stand in the maze, as the wheels and the floor hold them."""
    layout = Layout.load("classic")
    poses = random_poses(layout, 16, seed=4)
    model = build_model(layout)
    batch = Batch(model, 16, nthread=1)
    qpos = batch.bind("qpos")
    qpos[:, :2] = poses[:, :2]
    qpos[:, 3], qpos[:, 4:6], qpos[:, 6] = np.cos(poses[:, 2] / 2), 0.0, np.sin(poses[:, 2] / 2)
    data = mujoco.MjData(model)
    ranges = np.empty((16, 24))
    groups = np.array([1, 0, 0, 0, 0, 0], np.uint8)
    for i in range(16):
        data.qpos[:] = qpos[i]
        mujoco.mj_forward(model, data)
        site = data.site("lidar")
        angles = np.arange(24) * 2 * np.pi / 24
        beams = np.stack([np.cos(angles), np.sin(angles), np.zeros(24)], axis=1) @ site.xmat.reshape(3, 3).T
        for k in range(24):
            found = mujoco.mj_ray(model, data, site.xpos, beams[k], groups, 1, -1, np.array([-1], np.int32))
            ranges[i, k] = 3.5 if found < 0 else min(found, 3.5)

    np.testing.assert_allclose(scan(poses, layout, BURGER), ranges, atol=1e-3)


def test_a_lidar_inside_a_wall_reads_nothing() -> None:
    layout = Layout.from_text("..#.\n....\n")

    assert (scan(np.array([[1.25, 0.75, 0.3]]), layout, CENTRED) == 0.0).all()


def test_scans_are_fresh_memory_and_leave_the_poses_alone() -> None:
    poses = np.array([[0.5, 0.4, 0.3]])
    kept = poses.copy()
    first, second = scan(poses, ROOM, BURGER), scan(poses, ROOM, BURGER)

    assert not np.shares_memory(first, second)
    np.testing.assert_array_equal(poses, kept)
    np.testing.assert_array_equal(first, second)
