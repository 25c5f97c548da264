"""A randomization put into force in MuJoCo: one model, with per-robot values for what varies."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch

from gridnav.problem.types import FloatArray, IntArray

from .draws import Draws, wheel_factors

LAG_TO_ARMATURE = 0.5
"""Rotor inertia, kg m^2, that makes 63 % of a small step take a second longer; measured, and linear."""
EPISODE_S = 100.0
"""The battery's sag is what it loses in this time."""
STANDARD_GRAVITY = 9.81
LONGEST_DELAY_S = 0.6
"""Of a command: the engine keeps as many."""
WHEELS = ("wheel_left", "wheel_right")
# Places in a DC motor's gain parameters (MuJoCo 4): resistance in ohm, and the voltage that bounds it.
RESISTANCE, VOLTAGE = 0, 7


class Physics:
    """Writes what was drawn into the fields of a batch; always from the model's own values, so nothing adds up.

    Fields are expanded only for quantities that vary, and the constants that follow from them are set for the robots
    concerned alone: a fraction of a millisecond per step.
    """

    def __init__(self, batch: Batch, model: mujoco.MjModel, draws: Draws) -> None:
        self._batch, self._model, self._draws = batch, model, draws
        self._fields: dict[str, Any] = {}
        self._base = model.body("base").id
        self._wheels = [model.body(name).id for name in WHEELS]
        self._geoms = [model.geom(name).id for name in WHEELS]
        self._caster = model.geom("caster").id
        self._dofs = [int(model.joint(name).dofadr[0]) for name in WHEELS]
        self._motors = [model.actuator(name).id for name in ("motor_left", "motor_right")]

    def apply(self, ids: IntArray) -> None:
        """Give these robots the bodies, motors and floors that were drawn for them."""
        if not self._draws.randomization.acts_on("physics", "drive"):
            return
        self._apply_body(ids)
        self._apply_contacts(ids)
        self._apply_motors(ids)
        if self._varies("floor_tilt_rad"):
            self._tilt(ids)
        self._batch.set_const(ids)

    def _varies(self, *names: str) -> bool:
        return self._draws.varies(*names)

    def _field(self, name: str) -> Any:
        if name not in self._fields:
            self._fields[name] = self._batch.expand(name)
        return self._fields[name]

    def _of(self, name: str, ids: IntArray) -> FloatArray:
        return self._draws[name][ids]

    def _apply_body(self, ids: IntArray) -> None:
        model, base, of = self._model, self._base, self._of
        if self._varies("mass", "payload_kg", "yaw_inertia"):
            mass = model.body_mass[base] * of("mass", ids) + of("payload_kg", ids)
            self._field("body_mass")[ids, base] = mass
            inertia = model.body_inertia[base] * (mass / model.body_mass[base])[:, None]
            inertia[:, 2] *= of("yaw_inertia", ids)
            self._field("body_inertia")[ids, base] = inertia
        if self._varies("centre_x_m", "centre_y_m", "centre_z_m"):
            moved = np.stack([of(f"centre_{axis}_m", ids) for axis in "xyz"], axis=1)
            self._field("body_ipos")[ids, base] = model.body_ipos[base] + moved
        if self._varies("wheel_radius", "wheel_radius_ratio"):
            factors = wheel_factors(of("wheel_radius_ratio", ids))
            for geom, factor in zip(self._geoms, factors.T, strict=True):
                self._field("geom_size")[ids, geom, 0] = model.geom_size[geom, 0] * of("wheel_radius", ids) * factor
        if self._varies("wheel_separation"):
            for body in self._wheels:
                self._field("body_pos")[ids, body, 1] = model.body_pos[body, 1] * of("wheel_separation", ids)

    def _apply_contacts(self, ids: IntArray) -> None:
        if self._varies("wheel_friction"):
            for geom in self._geoms:
                self._field("geom_friction")[ids, geom, 0] = self._of("wheel_friction", ids)
        if self._varies("caster_friction"):
            self._field("geom_friction")[ids, self._caster, 0] = self._of("caster_friction", ids)

    def _apply_motors(self, ids: IntArray) -> None:
        model, of = self._model, self._of
        if self._varies("motor_left", "motor_right"):
            for motor, name in zip(self._motors, ("motor_left", "motor_right"), strict=True):
                # Stall torque is the motor constant times the voltage over the resistance; no-load speed stays.
                resistance = model.actuator_gainprm[motor, RESISTANCE] / of(name, ids)
                self._field("actuator_gainprm")[ids, motor, RESISTANCE] = resistance
        for dof in self._dofs:
            if self._varies("motor_lag_s"):
                self._field("dof_armature")[ids, dof] = LAG_TO_ARMATURE * of("motor_lag_s", ids)
            if self._varies("wheel_damping"):
                self._field("dof_damping")[ids, dof] = of("wheel_damping", ids)
            if self._varies("wheel_stiction_n_m"):
                self._field("dof_frictionloss")[ids, dof] = of("wheel_stiction_n_m", ids)

    def _tilt(self, ids: IntArray) -> None:
        # Direction of the slope: uniform.
        azimuth = 2.0 * np.pi * self._draws.shares("floor_tilt_rad", np.zeros(len(ids), dtype=np.int64), 1, ids)[:, 0]
        tilt = self._of("floor_tilt_rad", ids)
        across = np.sin(tilt)
        down = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), -np.cos(tilt)], axis=1)
        self._field("opt.gravity")[ids] = STANDARD_GRAVITY * down

    def begin_period(self, steps: IntArray, period_s: float, delays_s: FloatArray | None, qvel: Any) -> None:
        """What changes while robots drive: the battery, the delay of commands, and pushes.

        Args:
            steps: Control periods of each episode so far, shape ``(n,)``.
            period_s: Their length, seconds.
            delays_s: Of this period's command, shape ``(n,)``; none where commands are not delayed.
            qvel: Velocities of the robots, changed in place.
        """
        draws = self._draws
        if self._varies("battery_v", "battery_sag_v"):
            left = draws["battery_v"] - draws["battery_sag_v"] * steps * period_s / EPISODE_S
            self._field("actuator_gainprm")[:, self._motors, VOLTAGE] = left[:, None]
        if delays_s is not None:
            self._field("actuator_delay")[:] = np.minimum(delays_s, LONGEST_DELAY_S)[:, None]
        if self._varies("push_speed_m_s", "push_turn_rad_s"):
            self._push(steps, period_s, qvel)

    def _push(self, steps: IntArray, period_s: float, qvel: Any) -> None:
        draws, interval = self._draws, self._draws["push_interval_s"]
        before, now = (np.floor(count * period_s / interval) for count in (steps - 1, steps))
        is_pushed = (now > before) & (steps > 0)
        if not is_pushed.any():
            return
        # Direction: uniform. Turn: uniform between both ways.
        numbers = draws.shares("push", steps, 2)
        direction, speed = 2.0 * np.pi * numbers[:, 0], draws["push_speed_m_s"]
        qvel[is_pushed, 0] += (speed * np.cos(direction))[is_pushed]
        qvel[is_pushed, 1] += (speed * np.sin(direction))[is_pushed]
        qvel[is_pushed, 5] += (draws["push_turn_rad_s"] * (2.0 * numbers[:, 1] - 1.0))[is_pushed]
