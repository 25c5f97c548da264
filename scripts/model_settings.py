"""Accuracy and throughput of the DiffDrive model's settings, in one table; run it with nothing else running.

python scripts/model_settings.py [--drives 40] [--rounds 7] [--json FILE]

Every row drives the same commands from the same poses: each wheel's speed drawn anew every 0.4 s from U(-0.2, 1) of the
motor's maximum, ten seconds in all, in `open` and in `classic` with whatever walls come in the way. An error is how far
a robot ends from where the same model ends at a timestep of 0.5 ms; that of the planar robot, which is another model,
is measured against the default model's. The speed is that of bare physics on one thread, relative to the default model
in the same round, the rows taken in turns.
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch

from gridnav.envs import build_spec
from gridnav.problem.layout import Layout
from gridnav.problem.robot import BURGER
from gridnav.problem.types import FloatArray

Edit = Callable[[mujoco.MjSpec], None]
DRIVE_S, COMMAND_S = 10.0, 0.4
REFERENCE_S = 0.0005


def settings(**options: object) -> Edit:
    """An edit of the model's options."""

    def edit(spec: mujoco.MjSpec) -> None:
        for name, value in options.items():
            setattr(spec.option, name, value)

    return edit


def flags_on(spec: mujoco.MjSpec) -> None:
    """MuJoCo's own defaults: midphase and constraint islands."""
    skipped = mujoco.mjtDisableBit.mjDSBL_MIDPHASE | mujoco.mjtDisableBit.mjDSBL_ISLAND
    spec.option.disableflags &= ~int(skipped)


def cylinder_wheels(spec: mujoco.MjSpec) -> None:
    """Wheels that stand on an edge instead of a point."""
    for name in ("wheel_left", "wheel_right"):
        wheel = spec.geom(name)
        wheel.type, wheel.size, wheel.quat = mujoco.mjtGeom.mjGEOM_CYLINDER, [0.033, 0.009, 0], [0.7071, 0.7071, 0, 0]


def no_looks(spec: mujoco.MjSpec) -> None:
    """Without the geoms that are only seen."""
    for geom in list(spec.geoms):
        if geom.group == 2:
            spec.delete(geom)


def planar(spec: mujoco.MjSpec) -> None:
    """A robot on three joints, x, y and yaw, pulled along by servos where its wheels would stand."""
    base = spec.body("base")
    for joint in list(spec.joints):
        spec.delete(joint)
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    for name in ("wheel_left", "wheel_right", "caster"):
        spec.geom(name).contype = spec.geom(name).conaffinity = 0
    base.pos = [0.0, 0.0, BURGER.wheel_radius_m]
    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    base.add_joint(name="x", type=slide, axis=[1, 0, 0])
    base.add_joint(name="y", type=slide, axis=[0, 1, 0])
    base.add_joint(name="yaw", type=hinge, axis=[0, 0, 1])
    half = BURGER.wheel_separation_m / 2
    # Along each wheel, and against slipping sideways; forces up to what rubber holds of half the robot's weight, 4 N.
    for name, y, gear in (("left", half, [1, 0, 0]), ("right", -half, [1, 0, 0]), ("sideways", 0.0, [0, 1, 0])):
        base.add_site(name=name, pos=[0.0, y, 0.0])
        servo = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_SITE, gear=[*gear, 0, 0, 0])
        servo.set_to_velocity(kv=100.0)
        servo.forcelimited, servo.forcerange = True, [-4.0, 4.0]


def both(*edits: Edit) -> Edit:
    """One edit after the other."""

    def edit(spec: mujoco.MjSpec) -> None:
        for one in edits:
            one(spec)

    return edit


DISCRETE = mujoco.mjtIntegrator.mjINT_DISCRETE
IMPLICITFAST = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
EULER = mujoco.mjtIntegrator.mjINT_EULER
ROWS: dict[str, Edit] = {
    "**default: discrete, 25 ms**": lambda spec: None,
    "discrete, 2 ms": settings(timestep=0.002),
    "discrete, 5 ms": settings(timestep=0.005),
    "discrete, 10 ms": settings(timestep=0.01),
    "discrete, 20 ms": settings(timestep=0.02),
    "discrete, 40 ms": settings(timestep=0.04),
    "implicitfast, 2 ms": settings(integrator=IMPLICITFAST, timestep=0.002),
    "implicitfast, 5 ms": settings(integrator=IMPLICITFAST, timestep=0.005),
    "implicitfast, 10 ms": settings(integrator=IMPLICITFAST, timestep=0.01),
    "implicitfast, 20 ms": settings(integrator=IMPLICITFAST, timestep=0.02),
    "Euler, 2 ms": settings(integrator=EULER, timestep=0.002),
    "Euler, 5 ms": settings(integrator=EULER, timestep=0.005),
    "default, midphase and islands on": flags_on,
    "default, CG solver": settings(solver=mujoco.mjtSolver.mjSOL_CG),
    "default, pyramidal friction cone": settings(cone=mujoco.mjtCone.mjCONE_PYRAMIDAL),
    "default, frictional impedance ratio 10": settings(impratio=10.0),
    "default, sparse Jacobian": settings(jacobian=mujoco.mjtJacobian.mjJAC_SPARSE),
    "default, two solver iterations": settings(iterations=2),
    "default, cylinder wheels": cylinder_wheels,
    "default, without the geoms that are only seen": no_looks,
    "planar joints, implicitfast, 10 ms": both(planar, settings(integrator=IMPLICITFAST, timestep=0.01)),
    "planar joints, implicitfast, 20 ms": both(planar, settings(integrator=IMPLICITFAST, timestep=0.02)),
}


def compiled(edit: Edit, layout: Layout, timestep_s: float | None = None) -> mujoco.MjModel:
    """The default model with an edit, and with another timestep if one is given."""
    spec = build_spec(layout)
    edit(spec)
    if timestep_s is not None:
        spec.option.timestep = timestep_s
    return spec.compile()


def is_planar(model: mujoco.MjModel) -> bool:
    """Whether the robot stands on three joints."""
    return bool(model.nq == 3)


class Drives:
    """The same commands from the same poses, for every model."""

    def __init__(self, layout: Layout, n: int) -> None:
        rng = np.random.default_rng(0)
        self.n = n
        self.starts = layout.to_metres(layout.start_cells[rng.integers(len(layout.start_cells), size=n)])
        self.headings = rng.uniform(-np.pi, np.pi, n)
        # Wheel speeds: U(-0.2, 1) of the maximum each, so that the robot drives ahead more often than back.
        n_commands = round(DRIVE_S / COMMAND_S)
        self.commands = rng.uniform(-0.2, 1.0, (n_commands, n, 2)) * BURGER.max_wheel_speed_rad_s

    def batch(self, model: mujoco.MjModel, n_threads: int = 0) -> Batch:
        """Robots at the starts."""
        batch = Batch(model, self.n, nthread=n_threads)
        batch.qpos[:, :2] = self.starts
        if is_planar(model):
            batch.qpos[:, 2] = self.headings
        else:
            batch.qpos[:, 3], batch.qpos[:, 6] = np.cos(self.headings / 2), np.sin(self.headings / 2)
        return batch

    def drive(self, batch: Batch, model: mujoco.MjModel) -> None:
        """Carry out all commands."""
        for wheels in self.commands:
            batch.ctrl[:] = controls(model, wheels)
            batch.step(nstep=round(COMMAND_S / model.opt.timestep))

    def positions(self, model: mujoco.MjModel) -> FloatArray:
        """Where the robots are after the drive, metres, shape ``(n, 2)``; NaN where the physics diverged."""
        batch = self.batch(model)
        self.drive(batch, model)
        diverged = (batch.warning[:, :, 1] > 0).any(axis=1)
        positions: FloatArray = np.where(diverged[:, None], np.nan, batch.qpos[:, :2])
        return positions

    def seconds(self, model: mujoco.MjModel) -> float:
        """Wall-clock time of the drive on one thread."""
        batch = self.batch(model, 1)
        began = time.perf_counter()
        self.drive(batch, model)
        return time.perf_counter() - began


def controls(model: mujoco.MjModel, wheels: FloatArray) -> FloatArray:
    """Controls for wheel speeds in rad/s, shape ``(n, 2)``."""
    if not is_planar(model):
        return wheels
    along = wheels * BURGER.wheel_radius_m
    return np.column_stack([along, np.zeros(len(along))])


def place(model: mujoco.MjModel, x: float, y: float, heading_rad: float) -> mujoco.MjData:
    """One robot, at rest."""
    data = mujoco.MjData(model)
    data.qpos[:2] = x, y
    if is_planar(model):
        data.qpos[2] = heading_rad
    else:
        data.qpos[3:7] = np.cos(heading_rad / 2), 0.0, 0.0, np.sin(heading_rad / 2)
    return data


def turning(model: mujoco.MjModel) -> float:
    """Yaw after four seconds of turning in place with half the wheels' full speed, as a share of what was commanded."""
    data = place(model, 1.25, 4.5, 0.0)
    data.ctrl[:] = controls(model, np.array([[-0.5, 0.5]]) * BURGER.max_wheel_speed_rad_s)[0]
    turned = 0.0
    for _ in range(round(4.0 / model.opt.timestep)):
        mujoco.mj_step(model, data)
        turned += data.qvel[2 if is_planar(model) else 5] * model.opt.timestep
    return float(turned / (4.0 * 0.5 * BURGER.max_turn_rad_s))


def sinking(model: mujoco.MjModel) -> float:
    """Deepest that the bumper enters a wall met head-on at full speed, metres."""
    data = place(model, 0.5, 4.75, np.pi)  # towards the left outer wall
    data.ctrl[:] = controls(model, np.full((1, 2), BURGER.max_wheel_speed_rad_s))[0]
    deepest = 0.0
    for _ in range(round(4.0 / model.opt.timestep)):
        mujoco.mj_step(model, data)
        deepest = max(deepest, BURGER.radius_m - float(data.qpos[0]))
    return deepest


def main() -> None:
    """Print the table as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=40)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    mujoco.set_mju_user_warning(lambda message: None)  # diverging rows are counted, not told

    layouts = {name: Layout.load(name) for name in ("open", "classic")}
    drives = {name: Drives(layout, given.drives) for name, layout in layouts.items()}
    models = {name: compiled(edit, layouts["classic"]) for name, edit in ROWS.items()}
    seconds: dict[str, list[float]] = {name: [] for name in ROWS}
    for _ in range(given.rounds):
        for name, model in models.items():
            seconds[name].append(drives["classic"].seconds(model))

    table = []
    print("| setting | speed | us per `mj_step` | error `open`, m | error `classic`, m | yaw | wall depth, mm |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name, edit in ROWS.items():
        model = models[name]
        own = (lambda spec: None) if is_planar(model) else edit
        errors = {}
        for where, layout in layouts.items():
            truth = drives[where].positions(compiled(own, layout, REFERENCE_S))
            errors[where] = np.linalg.norm(drives[where].positions(compiled(edit, layout)) - truth, axis=1)
        speeds = np.array(next(iter(seconds.values()))) / np.array(seconds[name])
        n_steps = given.drives * round(DRIVE_S / model.opt.timestep)
        row = {
            "setting": name,
            "speed": speeds.tolist(),
            "us_per_step": float(np.median(seconds[name])) * 1e6 / n_steps,
            **{f"error_m_{where}": error.tolist() for where, error in errors.items()},
            "yaw": turning(model),
            "wall_depth_m": sinking(model),
        }
        table.append(row)
        print(as_markdown(row), flush=True)
    if given.json:
        given.json.write_text(json.dumps(table, indent=1))


def as_markdown(row: dict[str, Any]) -> str:
    """One line of the table: medians, with the range of speeds and the ninth decile of errors."""
    speeds = row["speed"]
    cells = [row["setting"], f"{np.median(speeds):.2f} ({min(speeds):.2f} to {max(speeds):.2f})"]
    cells.append(f"{row['us_per_step']:.1f}")
    for where in ("open", "classic"):
        error = np.array(row[f"error_m_{where}"])
        diverged = np.isnan(error).sum()
        median, ninth = np.nanquantile(error, (0.5, 0.9)) if diverged < error.size else (np.nan, np.nan)
        cells.append(f"{diverged} of {error.size} diverged" if diverged else f"{median:.4f} (90 %: {ninth:.3f})")
    if np.isfinite(row["yaw"]):
        cells += [f"{row['yaw']:.3f}", f"{1000 * row['wall_depth_m']:.1f}"]
    else:
        cells += ["-", "-"]
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main()
