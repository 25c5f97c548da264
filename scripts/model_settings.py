"""Accuracy and throughput of the DiffDrive model's settings, in one table; run it with nothing else running.

python scripts/model_settings.py [--drives 40] [--rounds 7] [--json FILE]

Every row drives the same commands from the same poses: each wheel command uniform over the motor's range, held for
0.4 s, ten seconds in all. The reference is the default model at a timestep of 0.5 ms. Throughput is that of bare
physics on one thread, the rows taken in turns in every round.
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path

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


MILLISECOND = 0.001
INTEGRATORS = {
    "discrete": mujoco.mjtIntegrator.mjINT_DISCRETE,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "Euler": mujoco.mjtIntegrator.mjINT_EULER,
}
ROWS: dict[str, Edit] = {
    f"{name}, {step} ms": settings(integrator=integrator, timestep=step * MILLISECOND)
    for name, integrator in INTEGRATORS.items()
    for step in (2, 5, 10, 20)
}
ROWS["discrete, 40 ms"] = settings(timestep=0.04)
AT_DEFAULT: dict[str, Edit] = {
    "midphase and islands on": flags_on,
    "CG solver": settings(solver=mujoco.mjtSolver.mjSOL_CG),
    "elliptic friction cone": settings(cone=mujoco.mjtCone.mjCONE_ELLIPTIC),
    "sparse Jacobian": settings(jacobian=mujoco.mjtJacobian.mjJAC_SPARSE),
    "two solver iterations": settings(iterations=2),
    "cylinder wheels": cylinder_wheels,
    "without the geoms that are only seen": no_looks,
}
ROWS |= {f"default with {name}": edit for name, edit in AT_DEFAULT.items()}


def compiled(edit: Edit | None, layout: Layout) -> mujoco.MjModel:
    """The default model with an edit."""
    spec = build_spec(layout)
    if edit is not None:
        edit(spec)
    return spec.compile()


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
        batch.qpos[:, 3], batch.qpos[:, 6] = np.cos(self.headings / 2), np.sin(self.headings / 2)
        return batch

    def positions(self, model: mujoco.MjModel) -> FloatArray:
        """Where the robots are after the drive, metres, shape ``(n, 2)``; NaN where the physics diverged."""
        batch = self.batch(model)
        for command in self.commands:
            batch.ctrl[:] = command
            batch.step(nstep=round(COMMAND_S / model.opt.timestep))
        diverged = (batch.warning[:, :, 1] > 0).any(axis=1)
        positions: FloatArray = np.where(diverged[:, None], np.nan, batch.qpos[:, :2])
        return positions

    def seconds_per_command(self, model: mujoco.MjModel) -> float:
        """Wall-clock time of one command of one robot on one thread."""
        batch = self.batch(model, 1)
        began = time.perf_counter()
        for command in self.commands:
            batch.ctrl[:] = command
            batch.step(nstep=round(COMMAND_S / model.opt.timestep))
        return (time.perf_counter() - began) / self.n / len(self.commands)


def turning(model: mujoco.MjModel) -> float:
    """Yaw of a robot that turns in place at half speed for four seconds, as a fraction of what its wheels command."""
    data = mujoco.MjData(model)
    data.qpos[:2] = 1.25, 4.5
    data.ctrl[:] = np.array([-0.5, 0.5]) * BURGER.max_wheel_speed_rad_s
    yaw = 0.0
    for _ in range(round(4.0 / model.opt.timestep)):
        mujoco.mj_step(model, data)
        yaw += data.qvel[5] * model.opt.timestep
    wheels = (data.qpos[8] - data.qpos[7]) * BURGER.wheel_radius_m / BURGER.wheel_separation_m
    return float(yaw / wheels)


def sinking(model: mujoco.MjModel) -> float:
    """Deepest that the bumper enters a wall met head-on at full speed, metres."""
    data = mujoco.MjData(model)
    data.qpos[:2] = 0.5, 4.75
    data.qpos[3:7] = 0.0, 0.0, 0.0, 1.0  # towards the left outer wall
    data.ctrl[:] = BURGER.max_wheel_speed_rad_s
    deepest = 0.0
    for _ in range(round(4.0 / model.opt.timestep)):
        mujoco.mj_step(model, data)
        deepest = max(deepest, BURGER.radius_m - data.qpos[0])
    return deepest


def main() -> None:
    """Print the table."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--drives", type=int, default=40)
    arguments.add_argument("--rounds", type=int, default=7)
    arguments.add_argument("--json", type=Path)
    given = arguments.parse_args()

    floor, maze = Layout.load("open"), Layout.load("classic")
    reference = settings(timestep=REFERENCE_S)
    drives = {"floor": Drives(Layout.random(n_rows=60, n_cols=60, density=0.0), given.drives)} if False else {}
    drives = {"open": Drives(floor, given.drives), "classic": Drives(maze, given.drives)}
    layouts = {"open": floor, "classic": maze}
    truth = {name: drives[name].positions(compiled(reference, layouts[name])) for name in drives}

    rows = {"default": None, **ROWS}
    models = {name: compiled(edit, maze) for name, edit in rows.items()}
    times: dict[str, list[float]] = {name: [] for name in rows}
    for _ in range(given.rounds):
        for name, model in models.items():
            times[name].append(drives["classic"].seconds_per_command(model))

    table = []
    for name, edit in rows.items():
        row: dict[str, object] = {"setting": name}
        for where, drive in drives.items():
            error = np.linalg.norm(drive.positions(compiled(edit, layouts[where])) - truth[where], axis=1)
            row[f"error_m_{where}"] = [float(x) for x in np.nanquantile(error, (0.5, 0.9))]
            row[f"diverged_{where}"] = int(np.isnan(error).sum())
        row["yaw_of_wheels"] = turning(models[name])
        row["wall_depth_mm"] = 1000 * sinking(models[name])
        ratios = np.array(times["default"]) / np.array(times[name])
        row["speed"] = [float(x) for x in (np.median(ratios), ratios.min(), ratios.max())]
        row["us_per_mj_step"] = float(np.median(times[name]) * 1e6 / round(COMMAND_S / models[name].opt.timestep))
        table.append(row)
        print(row, flush=True)
    if given.json:
        given.json.write_text(json.dumps(table, indent=1))


if __name__ == "__main__":
    main()
