"""Layout and robot file to one compiled MuJoCo model."""

from __future__ import annotations

from importlib import resources

import mujoco
import numpy as np

from gridnav.problem.layout import Layout

WALL_HEIGHT_M = 0.25
"""Higher than the lidar, which turns 0.182 m above the floor."""
OUTER_WALL_THICKNESS_M = 0.05
FLOOR_RGBA = (0.93, 0.93, 0.91, 1.0)
WALL_RGBA = (0.36, 0.42, 0.52, 1.0)
GOAL_RGBA = (0.18, 0.68, 0.38, 0.9)


def build_model(layout: Layout, *, goal_radius_m: float = 0.15) -> mujoco.MjModel:
    """The compiled model of ``build_spec``."""
    return build_spec(layout, goal_radius_m=goal_radius_m).compile()


def build_spec(layout: Layout, *, goal_radius_m: float = 0.15, n_kept_commands: int = 0) -> mujoco.MjSpec:
    """The Burger on a floor, among the layout's merged walls and an outer wall.

    Args:
        layout: The maze.
        goal_radius_m: Radius of the goal mark, a mocap body named ``goal`` that touches nothing.
        n_kept_commands: Timesteps of commands that the motors keep, so that a delay can be set; with 0 there is none.

    Returns:
        What compiles to a model with 9 positions (free joint, left and right wheel), 8 velocities and 2 controls (wheel
        speeds in rad/s).
    """
    spec = mujoco.MjSpec.from_string(
        resources.files("gridnav.assets").joinpath("mjcf/burger.xml").read_text(encoding="utf-8")
    )
    world = spec.worldbody
    width, height = layout.size_m
    _add_box(world, "floor", (width / 2, height / 2, -0.05), (width / 2 + 0.3, height / 2 + 0.3, 0.05), FLOOR_RGBA, 1)

    t = OUTER_WALL_THICKNESS_M
    boxes = [
        ("outer_left", -t, -t, 0.0, height + t),
        ("outer_right", width, -t, width + t, height + t),
        ("outer_bottom", 0.0, -t, width, 0.0),
        ("outer_top", 0.0, height, width, height + t),
        *((f"wall_{i}", *rectangle) for i, rectangle in enumerate(layout.wall_rectangles())),
    ]
    for name, x0, y0, x1, y1 in boxes:
        centre = ((x0 + x1) / 2, (y0 + y1) / 2, WALL_HEIGHT_M / 2)
        _add_box(world, name, centre, ((x1 - x0) / 2, (y1 - y0) / 2, WALL_HEIGHT_M / 2), WALL_RGBA, 2)

    goal = world.add_body(name="goal", mocap=True)
    goal.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=[goal_radius_m, 0.002, 0],
        rgba=GOAL_RGBA,
        contype=0,
        conaffinity=0,
        group=2,
    )
    for motor in spec.actuators if n_kept_commands else ():
        motor.nsample = n_kept_commands
    reach = max(width, height)
    world.add_light(
        pos=[width / 2, height / 2, 2 * reach], dir=[0.2, 0.3, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    )
    # From above, the whole maze in sight at 45 degrees of field of view.
    world.add_camera(name="above", pos=[width / 2, height / 2, 1.32 * reach + WALL_HEIGHT_M], quat=[1, 0, 0, 0])
    spec.stat.center = [width / 2, height / 2, 0]
    spec.stat.extent = reach
    return spec


def _add_box(
    world: mujoco.MjsBody,
    name: str,
    centre: tuple[float, ...],
    half_size: tuple[float, ...],
    rgba: tuple[float, ...],
    contact_mask: int,
) -> None:
    world.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=np.asarray(centre),
        size=np.asarray(half_size),
        rgba=rgba,
        contype=contact_mask,
        conaffinity=contact_mask,
        condim=3,
        # Friction combines by the larger value, so the robot's own coefficients decide.
        friction=[0.001, 0.005, 0.0001],
    )
