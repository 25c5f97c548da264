"""The MuJoCo robot: numbers of its model, driving, walls, slip, and physics that fails."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gridnav.envs.mjcf import build_model

from gridnav import Layout, Task
from gridnav.problem.geodesic import clearances
from gridnav.problem.robot import BURGER

ID = "gridnav/DiffDrive-v0"
V, W = BURGER.max_speed_m_s, BURGER.max_turn_rad_s
OPEN = Layout.load("open")
EVERYWHERE = {"layout": OPEN, "task": Task(starts="any", goals="any", goal_radius_m=1e-6), "max_episode_steps": 10**6}


def start(cell: tuple[int, int] = (5, 5), heading_rad: float = 0.0, n: int = 1, **arguments: Any) -> Any:
    """Robots at rest at a cell's centre of an open room, whose goal is too small to be met by chance."""
    env = gym.make_vec(ID, num_envs=n, **(EVERYWHERE | {"n_threads": 1} | arguments))
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


def angle_between(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Difference of headings, within half a turn."""
    return (one - other + np.pi) % (2 * np.pi) - np.pi


# ---- The model -----------------------------------------------------------------------------------


def test_the_model_has_the_sourced_numbers_of_the_burger() -> None:
    model = gym.make(ID).unwrapped.model

    for side, y in (("left", 0.080), ("right", -0.080)):
        assert model.geom(f"wheel_{side}").size[0] == BURGER.wheel_radius_m == 0.033
        np.testing.assert_allclose(model.body(f"wheel_{side}").pos, [0, y, 0])
        assert model.body(f"wheel_{side}").mass[0] == pytest.approx(0.0285, abs=1e-5)
        np.testing.assert_allclose(model.jnt_axis[model.joint(f"wheel_{side}").id], [0, 1, 0])
        # 57 rpm at 11.1 V: 57 * 2 pi / 60 = 5.969 rad/s.
        assert model.actuator(f"motor_{side}").ctrlrange.tolist() == [-5.969, 5.969]
    assert pytest.approx(57 * 2 * np.pi / 60, abs=1e-3) == BURGER.max_wheel_speed_rad_s
    assert pytest.approx(0.160) == BURGER.wheel_separation_m
    # URDF: base 0.82573504, lidar 0.114, caster 0.005, two wheels of 0.02849894: 1.0017 kg.
    assert model.body_subtreemass[model.body("base").id] == pytest.approx(1.0017, abs=1e-3)
    assert model.geom("bumper").size[0] == BURGER.radius_m == 0.105
    np.testing.assert_allclose(model.geom("bumper").pos[:2], [0, 0])
    # The wheels and the caster stand on the floor when the axle is one wheel radius above it.
    assert model.body("base").pos[2] == 0.033
    assert model.geom("caster").pos[2] + 0.033 == pytest.approx(model.geom("caster").size[0])
    np.testing.assert_allclose(model.site("lidar").pos[:2], [BURGER.lidar_offset_m, 0.0])
    assert (model.nq, model.nv, model.opt.cone) == (9, 8, mujoco.mjtCone.mjCONE_ELLIPTIC)
    assert (model.opt.timestep, model.opt.integrator) == (0.025, mujoco.mjtIntegrator.mjINT_DISCRETE)
    assert model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_AUTORESET


@pytest.mark.parametrize("name", ["classic", "four-rooms", "corridors"])
def test_the_models_walls_cover_the_layouts_walls_and_nothing_else(name: str) -> None:
    layout = Layout.load(name)
    model = build_model(layout)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)

    # A ray straight down into each cell ends on a wall's top, 0.25 m, or on the floor.
    groups = np.array([1, 0, 0, 0, 0, 0], np.uint8)
    for row in range(layout.n_rows):
        for col in range(layout.n_cols):
            x, y = layout.to_metres(np.array([row, col]))
            for dx, dy in ((0, 0), (0.24, 0.24), (-0.24, 0.24), (0.24, -0.24), (-0.24, -0.24)):
                origin = np.array([x + dx, y + dy, 1.0])
                down = mujoco.mj_ray(
                    model, data, origin, np.array([0.0, 0.0, -1.0]), groups, 1, -1, np.array([-1], np.int32)
                )
                assert down == pytest.approx(0.75 if layout.walls[row, col] else 1.0)


def test_the_analytic_clearance_agrees_with_mujocos_contacts() -> None:
    layout = Layout.load("classic")
    model = build_model(layout)
    data = mujoco.MjData(model)
    bumper = model.geom("bumper").id
    rng = np.random.default_rng(0)
    points = rng.uniform(0.02, 4.98, (25_000, 2))
    gaps = clearances(points, layout)[0]
    points, gaps = points[(gaps > 0.09) & (gaps < 0.12)], gaps[(gaps > 0.09) & (gaps < 0.12)]
    assert len(points) > 1000

    for point, gap in zip(points[:1000], gaps[:1000], strict=True):
        data.qpos[:2], data.qpos[2] = point, 0.033
        mujoco.mj_fwdPosition(model, data)
        depths = [contact.dist for contact in data.contact if bumper in contact.geom]
        assert bool(depths) == (gap < 0.105)
        if depths:
            assert min(depths) == pytest.approx(gap - 0.105, abs=1e-6)


# ---- Driving -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("forward", "share"), [(1.0, 0.91), (0.5, 0.95), (0.3, 0.94), (-0.5, 0.95)])
def test_it_drives_straight_and_nearly_as_fast_as_told(forward: float, share: float) -> None:
    """Over 3 m; friction in the gears takes 5 to 9 %."""
    env = start((5, 0) if forward > 0 else (5, 9))
    steps = int(3.0 / (abs(forward) * V * share * 0.2))
    poses = np.array([info["pose"][0] for info in drive(env, forward, 0.0, steps)])

    assert abs(poses[-1, 0] - poses[0, 0]) > 2.8
    assert np.abs(poses[:, 1] - 2.25).max() < 1e-3
    assert np.abs(poses[:, 2]).max() < 1e-3
    steady = (poses[-1, 0] - poses[10, 0]) / (0.2 * (steps - 11))
    assert steady / (forward * V) == pytest.approx(share, abs=0.02)
    assert steady / (forward * V) < 1.0


def test_a_robot_leans_by_the_angle_between_its_up_and_the_world_s_and_a_turn_does_not_count() -> None:
    env = start(n=3)
    half = np.deg2rad(15.0)
    env._qpos[:, 3:7] = [
        [np.cos(half), 0.0, np.sin(half), 0.0],  # nose down
        [np.cos(half), 0.0, 0.0, np.sin(half)],  # to the left
        [0.0, 1.0, 0.0, 0.0],  # on its back
    ]

    np.testing.assert_allclose(np.degrees(env.lean_rad), [30.0, 0.0, 180.0], atol=1e-5)


def test_it_stops_within_a_centimetre_when_told_to() -> None:
    env = start((5, 1))
    moving = drive(env, 1.0, 0.0, 15)[-1]["pose"][0, 0]

    rest = [info["pose"][0, 0] for info in drive(env, 0.0, 0.0, 5)]

    assert rest[-1] - moving < 0.01
    assert abs(rest[-1] - rest[-2]) < 1e-5


@pytest.mark.parametrize("turn", [1.0, -0.5, 0.25])
def test_it_turns_in_place_without_wandering(turn: float) -> None:
    env = start()
    poses = np.array([info["pose"][0] for info in drive(env, 0.0, turn, 50)])

    assert np.hypot(*(poses[:, :2] - [2.75, 2.25]).T).max() < 2e-3
    turned = np.abs(angle_between(poses[1:, 2], poses[:-1, 2])).sum()
    assert turned / (abs(turn) * W * 49 * 0.2) == pytest.approx(0.93, abs=0.04)
    assert np.sign(angle_between(poses[1, 2], poses[0, 2])) == np.sign(turn)


@pytest.mark.parametrize(("forward", "turn"), [(0.5, 0.2), (0.4, -0.1), (0.8, 0.1)])
def test_a_circle_closes_and_has_the_radius_v_over_omega(forward: float, turn: float) -> None:
    env = start((7, 5) if turn > 0 else (2, 5))
    drive(env, forward, turn, 5)
    poses = [env._pose[0].copy()]
    turned = 0.0
    while turned < 2 * np.pi:
        poses.append(drive(env, forward, turn, 1)[0]["pose"][0])
        last = abs(angle_between(poses[-1][2], poses[-2][2]))
        turned += last
    back = poses[-1] + (poses[-2] - poses[-1]) * (turned - 2 * np.pi) / last  # where the full turn was complete

    assert np.hypot(*(back - poses[0])[:2]) < 5e-3
    points = np.array(poses)[:, :2]
    radius = (np.ptp(points[:, 0]) + np.ptp(points[:, 1])) / 4
    assert radius == pytest.approx(forward * V / (abs(turn) * W), rel=0.02)


def test_gentle_drives_agree_with_the_unicycle() -> None:
    """Both know the commands; inertia and friction, which takes 5 to 9 %, are what differs."""
    physical = start(n=32)
    kinematic = gym.make_vec("gridnav/Unicycle-v0", num_envs=32, **EVERYWHERE)
    kinematic.reset(seed=0, options={"start": (5, 5), "goal": (0, 0), "heading_rad": 0.0})
    rng = np.random.default_rng(1)

    for _ in range(5):
        commands = np.column_stack([rng.uniform(-0.3, 0.5, 32), rng.uniform(-0.3, 0.3, 32)]).astype(np.float32)
        for _ in range(10):
            one, other = physical.step(commands)[4], kinematic.step(commands)[4]
    apart = np.hypot(*(one["pose"] - other["pose"])[:, :2].T)

    assert (apart < 0.12 * other["path_length_m"]).all()
    assert np.median(apart / other["path_length_m"]) < 0.06
    assert np.abs(angle_between(one["pose"][:, 2], other["pose"][:, 2])).max() < 0.35
    np.testing.assert_allclose(one["path_length_m"], other["path_length_m"], rtol=0.12, atol=5e-3)


def test_one_command_is_held_for_the_whole_period() -> None:
    """One period of 0.2 s is two of 0.1 s with the same command, to the last bit."""
    long, short = start(n=4), start(n=4, control_period_s=0.1)
    rng = np.random.default_rng(0)

    for _ in range(15):
        commands = rng.uniform(-1, 1, (4, 2)).astype(np.float32)
        long.step(commands)
        for _ in range(2):
            short.step(commands)
        np.testing.assert_array_equal(long._qpos, short._qpos)
        np.testing.assert_array_equal(long._qvel, short._qvel)


@pytest.mark.parametrize("period", [0.01, 0.05, 0.123, 0.2, 1.0])
@pytest.mark.parametrize("timestep", [0.005, 0.025])
def test_whole_timesteps_no_longer_than_asked_for_make_a_period(period: float, timestep: float) -> None:
    env = start(control_period_s=period, timestep_s=timestep)
    begin = env._batch.bind("time").copy()
    drive(env, 0.5, 0.0, 3)

    n_substeps = period / env.model.opt.timestep
    assert env.model.opt.timestep <= timestep + 1e-12
    assert n_substeps == pytest.approx(round(n_substeps))
    np.testing.assert_allclose(env._batch.bind("time") - begin, 3 * period)


def test_a_robot_that_is_no_burger_is_refused_and_another_lidar_is_not() -> None:
    with pytest.raises(ValueError, match="no Burger"):
        gym.make(ID, robot=replace(BURGER, wheel_radius_m=0.04))

    env = gym.make(ID, robot=replace(BURGER, n_beams=36, lidar_range_m=8.0))
    assert env.observation_space.shape == (35 - 24 + 36,)


@pytest.mark.parametrize("timestep", [0.0, 0.026, float("nan"), -0.01])
def test_a_timestep_that_the_contacts_do_not_bear_is_refused(timestep: float) -> None:
    with pytest.raises(ValueError, match="timestep_s"):
        gym.make(ID, timestep_s=timestep)


def test_trajectories_do_not_depend_on_the_number_of_threads() -> None:
    envs = [gym.make_vec(ID, num_envs=32, task="any", max_episode_steps=40, n_threads=threads) for threads in (1, 2, 3)]
    seen = [env.reset(seed=0)[0] for env in envs]
    rng = np.random.default_rng(0)

    for _ in range(60):
        commands = rng.uniform(-1, 1, (32, 2)).astype(np.float32)
        results = [env.step(commands) for env in envs]
        for other in results[1:]:
            for one, two in zip(results[0][:4], other[:4], strict=True):
                np.testing.assert_array_equal(one, two)
            np.testing.assert_array_equal(results[0][4]["pose"], other[4]["pose"])
    np.testing.assert_array_equal(seen[0], seen[1])


# ---- Wheels --------------------------------------------------------------------------------------


def spin(*, friction: float, wheel_speed: float, seconds: float) -> tuple[mujoco.MjData, float, float]:
    """Wheels driven from rest on a floor: the final state, the largest torque and the largest slip in m/s."""
    model = build_model(OPEN)
    for side in ("left", "right"):
        model.geom(f"wheel_{side}").friction[0] = friction
    data = mujoco.MjData(model)
    data.qpos[:3] = [2.25, 2.25, 0.033]
    data.ctrl[:] = wheel_speed
    torque = slip = 0.0
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
        torque = max(torque, float(np.abs(data.actuator_force).max()))
        slip = max(slip, abs(data.qvel[6] * 0.033 - data.qvel[0]))
    return data, torque, slip


def test_wheels_roll_on_a_good_floor_and_slip_on_ice() -> None:
    grip, _, _ = spin(friction=0.8, wheel_speed=5.9, seconds=2.0)
    ice, _, _ = spin(friction=0.01, wheel_speed=5.9, seconds=0.3)

    # Rolling: v = omega r within the chatter of the contacts.
    assert grip.qvel[0] == pytest.approx(grip.qvel[6] * 0.033, rel=0.02)
    # Ice: mu g t is the most a wheel can give, 0.01 * 9.81 * 0.3 = 0.03 m/s, while the wheel is near full speed.
    assert ice.qvel[6] * 0.033 > 0.15
    assert abs(ice.qvel[0]) < 0.04


def test_a_full_speed_start_makes_the_wheels_slip_for_a_moment() -> None:
    _, _, hard = spin(friction=0.8, wheel_speed=5.969, seconds=0.5)
    _, _, soft = spin(friction=0.8, wheel_speed=0.5, seconds=0.5)

    assert hard > 0.05 > soft


def test_motors_saturate_at_stall_torque_and_no_load_speed() -> None:
    commanded, torque, _ = spin(friction=0.8, wheel_speed=5.969, seconds=1.0)
    beyond, more_torque, _ = spin(friction=0.8, wheel_speed=50.0, seconds=1.0)

    # XL430-W250 at 11.1 V: stall torque 1.4 N m, no-load speed 5.969 rad/s.
    assert torque <= 1.4 + 1e-9
    assert more_torque <= 1.4 + 1e-9
    assert commanded.qvel[6] < 5.969
    np.testing.assert_array_equal(commanded.qpos, beyond.qpos)


# ---- Walls ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("forward", [1.0, -1.0, 0.4])
@pytest.mark.parametrize("angle", [0.0, 0.2, 0.7, -1.0])
def test_a_robot_that_drives_into_a_wall_stops_there(angle: float, forward: float) -> None:
    env = start((5, 9), angle if forward > 0 else angle + np.pi)
    infos = drive(env, forward, 0.0, 60)

    poses = np.array([info["pose"][0] for info in infos])
    gaps = wall_gaps(poses[:, :2], OPEN) - BURGER.radius_m
    assert gaps.min() > -3e-3
    assert gaps[-1] < 3e-3
    # A cell-time is 12.7 periods of 0.2 s: pressing on counts again after every 13.
    hits = np.flatnonzero([info["collision"][0] for info in infos])
    assert np.diff(hits).tolist() == [13] * ((59 - hits[0]) // 13)
    assert np.hypot(*(poses[-1] - poses[-20])[:2]) < 1e-4  # it rests, and does not creep along the wall
    assert np.degrees(env.lean_rad).max() < 2.0


@pytest.mark.parametrize("forward", [1.0, -1.0])
def test_a_robot_that_grazes_a_wall_is_not_stopped_until_friction_has_turned_it_to_the_wall(forward: float) -> None:
    angle = np.pi / 2 - np.deg2rad(6.0)
    env = start((8, 9), angle if forward > 0 else angle + np.pi)
    infos = drive(env, forward, 0.0, 100)

    hits = np.flatnonzero([info["collision"][0] for info in infos])
    assert np.diff(hits).tolist() == [13] * ((99 - hits[0]) // 13)  # charged all the time
    touched, rests = infos[hits[0]]["pose"][0], infos[-1]["pose"][0]
    assert rests[1] - touched[1] > 0.05
    assert np.rad2deg(abs(angle_between(rests[2], angle if forward > 0 else angle + np.pi))) > 9.0
    gaps = wall_gaps(np.array([info["pose"][0, :2] for info in infos]), OPEN) - BURGER.radius_m
    assert gaps.min() > -3e-3


def test_turning_and_backing_off_at_a_wall_are_free() -> None:
    env = start((5, 9))
    pressed = drive(env, 1.0, 0.0, 10)[-1]["pose"][0]

    turned = drive(env, 0.0, 0.5, 10)[-1]
    assert np.hypot(*(turned["pose"][0] - pressed)[:2]) < 3e-3
    assert abs(angle_between(turned["pose"][0, 2], pressed[2])) > 2.0
    drive(env, 0.0, -0.5, 10)
    backed = drive(env, -1.0, 0.0, 10)[-1]
    assert backed["pose"][0, 0] < pressed[0] - 0.3
    assert backed["collisions"][0] == 1
    # A second contact after that is a new one.
    assert drive(env, 1.0, 0.0, 15)[-1]["collisions"][0] == 2


def test_sliding_along_a_wall_is_charged_in_every_step_of_it() -> None:
    env = start((7, 9), np.pi / 3, task=Task("any", "any", "slide", 1e-6))
    infos = drive(env, 0.8, 0.0, 40)

    first = next(i for i, info in enumerate(infos) if info["collision"][0])
    pressed = [bool(info["collision"][0]) for info in infos[first:]]
    assert np.mean(pressed) > 0.8
    assert all((info["reward_terms"]["collision"][0] < 0) == info["collision"][0] for info in infos)
    assert infos[-1]["pose"][0, 1] - infos[first]["pose"][0, 1] > 0.05
    assert np.degrees(env.lean_rad).max() < 8.0


@pytest.mark.parametrize("on_collision", ["stop", "slide"])
@pytest.mark.parametrize("name", ["classic", "random"])
def test_no_random_full_speed_drive_tunnels_tips_or_sinks(name: str, on_collision: Any) -> None:
    layout = Layout.random(density=0.35, seed=3) if name == "random" else Layout.load(name)
    env = gym.make_vec(
        ID, num_envs=64, layout=layout, task=Task("any", "any", on_collision), max_episode_steps=300, n_threads=1
    )
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    commands = np.zeros((64, 2), np.float32)

    hits, before = 0, env._pose.copy()
    for step in range(100):
        if step % 9 == 0:  # hold commands for a while, so that robots get to the walls and press
            commands = rng.choice([-1.0, -0.3, 0.0, 0.5, 1.0], (64, 2), p=[0.15, 0.1, 0.1, 0.15, 0.5]).astype(
                np.float32
            )
        info = env.step(commands)[4]
        final = info.get("final_info", info)
        assert "physics_error" not in final
        hits += int(final["collision"].sum())
        assert wall_gaps(final["pose"][:, :2], layout).min() > BURGER.radius_m - 5e-3
        assert np.hypot(*(final["pose"] - before)[:, :2].T).max() < 1.5 * V * 0.2
        assert np.degrees(env.lean_rad).max() < 8.0
        # Reversing into a wall at full speed rocks the robot on its caster: a few millimetres at the axle.
        assert np.abs(env._qpos[:, 2] - 0.033).max() < 8e-3
        before = info["pose"]
    assert hits > 50


@pytest.mark.slow
def test_no_random_drive_tunnels_in_two_hundred_thousand_steps() -> None:
    for seed in range(8):
        layout = Layout.random(density=0.3, seed=seed)
        env = gym.make_vec(ID, num_envs=256, layout=layout, task="any", max_episode_steps=500)
        env.reset(seed=seed)
        rng = np.random.default_rng(seed)
        for step in range(100):
            if step % 9 == 0:
                commands = rng.choice([-1.0, 0.0, 0.5, 1.0, 1.0], (256, 2)).astype(np.float32)
            info = env.step(commands)[4]
            final = info.get("final_info", info)
            assert wall_gaps(final["pose"][:, :2], layout).min() > BURGER.radius_m - 5e-3


# ---- Failing physics -----------------------------------------------------------------------------


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e12, -1e12])
@pytest.mark.parametrize(("state", "column"), [("_qpos", 1), ("_qpos", 4), ("_qvel", 1), ("_qvel", 6)])
def test_diverged_physics_ends_that_episode_alone_and_says_so(state: str, column: int, value: float) -> None:
    hurt, twin = (gym.make_vec(ID, num_envs=4, task="any", n_threads=1) for _ in range(2))
    hurt.reset(seed=0)
    twin.reset(seed=0)
    rng = np.random.default_rng(0)
    script = rng.uniform(-1, 1, (12, 4, 2)).astype(np.float32)
    for commands in script[:3]:
        hurt.step(commands)
        twin.step(commands)

    last_pose = hurt._pose[2].copy()
    getattr(hurt, state)[2, column] = value
    observations, rewards, terminated, truncated, info = hurt.step(script[3])
    expected = twin.step(script[3])

    final = info["final_info"]
    assert terminated.tolist() == [False, False, True, False]
    assert not truncated.any()
    assert final["physics_error"].tolist() == [False, False, True, False]
    assert not final["is_success"].any()
    assert np.isfinite(rewards).all()
    # Failing must not pay: at most the step's own small terms, never the way that was left.
    assert rewards[2] < 0.5
    assert observations in hurt.observation_space
    assert np.isfinite(info["final_obs"][2]).all()
    np.testing.assert_allclose(final["pose"][2], last_pose, atol=1e-9)  # the last good one
    others = [0, 1, 3]
    np.testing.assert_array_equal(observations[others], expected[0][others])
    np.testing.assert_array_equal(rewards[others], expected[1][others])

    # The environment works after its reset: finite, in bounds, and driving; the neighbours notice nothing.
    begin = hurt._pose[2].copy()
    for commands in script[4:]:
        commands[2] = [0.5, 0.5]
        observations, rewards, terminated, _, info = hurt.step(commands)
        expected = twin.step(commands)
        assert not terminated[2]
        assert "physics_error" not in info
        np.testing.assert_array_equal(observations[others], expected[0][others])
        assert observations in hurt.observation_space
    assert angle_between(hurt._pose[2, 2], begin[2]) > 0.2


@pytest.mark.parametrize("randomization", ["none", "wide"])
def test_parked_robots_stand_and_the_others_notice_nothing(randomization: str) -> None:
    some, all_of_them = (gym.make_vec(ID, num_envs=4, randomization=randomization) for _ in range(2))
    some.reset(seed=0)
    all_of_them.reset(seed=0)
    rng = np.random.default_rng(0)
    script = rng.uniform(-1, 1, (30, 4, 2)).astype(np.float32)
    parked = np.array([False, True, False, True])
    for commands in script[:10]:
        some.step(commands)
        all_of_them.step(commands)

    some.park(parked)
    begin = some._pose.copy()
    for commands in script[10:]:
        observations, rewards, *_ = some.step(commands)
        expected = all_of_them.step(commands)
        np.testing.assert_array_equal(observations[~parked], expected[0][~parked])
        np.testing.assert_array_equal(rewards[~parked], expected[1][~parked])
    np.testing.assert_array_equal(some._pose[parked], begin[parked])
    assert not np.array_equal(all_of_them._pose[parked], begin[parked])

    # A reset lets everybody go.
    again, expected_again = some.reset(seed=1)[0], all_of_them.reset(seed=1)[0]
    np.testing.assert_array_equal(again, expected_again)
    for commands in script:
        np.testing.assert_array_equal(some.step(commands)[0], all_of_them.step(commands)[0])


def test_diverged_physics_prints_nothing_and_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    robots = gym.make_vec(ID, num_envs=4)
    robots.reset(seed=0)
    robots._qvel[2, 0] = np.inf

    with caplog.at_level("INFO"):
        _, _, _, _, info = robots.step(np.zeros((4, 2), np.float32))

    assert info["final_info"]["physics_error"][2]
    assert any("unstable" in record.message for record in caplog.records)
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr() == ("", "")


def test_diverged_physics_ends_a_single_environments_episode_too() -> None:
    env = gym.make(ID)
    env.reset(seed=0)
    env.step(np.float32([0.5, 0.0]))
    env.unwrapped.worlds._qvel[0, 0] = np.inf

    observation, reward, terminated, truncated, info = env.step(np.float32([0.5, 0.0]))

    assert (terminated, truncated, info["physics_error"], info["is_success"]) == (True, False, True, False)
    assert np.isfinite(reward)
    assert observation in env.observation_space
    _, info = env.reset()
    assert "physics_error" not in info
    for _ in range(5):
        _, _, terminated, _, info = env.step(np.float32([0.5, 0.5]))
        assert not terminated
    assert info["path_length_m"] > 0.02


def test_an_environment_that_failed_plays_its_next_episode_like_any_other() -> None:
    """Nothing of the failure stays: the same start then gives the same drive as in a fresh environment."""
    hurt, fresh = start(n=2), start(n=2)
    drive(hurt, 0.5, 0.1, 3)
    hurt._qvel[0, 0] = np.nan
    drive(hurt, 0.5, 0.1, 1)
    options = {"start": (4, 4), "goal": (0, 0), "heading_rad": 0.3}
    for env in (hurt, fresh):
        env.reset(seed=1, options=options)

    for one, other in zip(drive(hurt, 0.8, -0.2, 20), drive(fresh, 0.8, -0.2, 20), strict=True):
        np.testing.assert_array_equal(one["pose"], other["pose"])


@pytest.mark.parametrize("camera", ["below", "", None])
def test_an_unknown_camera_is_refused(camera: Any) -> None:
    with pytest.raises(ValueError, match="camera"):
        gym.make(ID, camera=camera)
