"""Held-out worlds, for evaluation alone: each is wrong in a way that no training sees. All of them are simulations.

Nothing that trains imports this file. ``parametric`` and ``structural`` are for development: anybody may look at what
they do and why a policy fails in them. ``test`` is drawn from a sealed seed: it gives numbers and nothing else.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import resources
from typing import Any

import mujoco
import numpy as np

from gridnav.agents import Agent, OnProgress
from gridnav.envs import NavigationVectorEnv, Randomization, Range
from gridnav.experiment.evaluation import EVALUATION_SEED, evaluate_in
from gridnav.experiment.worlds import Problem
from gridnav.problem.layout import Layout
from gridnav.problem.metrics import Episode, Summary, summarise
from gridnav.problem.types import InputError

SEAL = "0d942ead2e561c5b8637e9286583bf197bde84087c590c2b133338efdd79de24"
"""SHA-256 of the test reality's seed: it is the same one in every release, or this file says that it is not.

What it draws changes with the preset ``wide``, a part of which it draws from."""
DRAW = 2
"""Which world of that seed: the first one whose robots can drive, by ``drivability.try_driving`` and nothing else. Of
its two predecessors' robots 54 and 61 % could."""
WORLD = "DiffDrive"
PATCH_TOP_M, PATCH_MASK = 0.0005, 4
"""Height of slippery places above the floor, and their contact mask beside those of ``burger.xml``."""
STALL_V, STALL_N_M, NO_LOAD_RAD_S = 11.1, 1.4, 5.969
"""The motors of ``burger.xml``, which a motor with friction of another kind replaces."""


@dataclass(frozen=True)
class Reality:
    """A robot world that differs from those of training."""

    name: str
    """On the command line and in reports."""
    wrong: str
    """What differs, in words."""
    randomization: Randomization = field(repr=False)
    """What each episode draws."""
    edit_model: Callable[[mujoco.MjSpec], None] | None = None
    """How the model itself differs."""
    timestep_s: float = 0.025
    """Of the physics."""
    is_sealed: bool = False
    """It gives metrics and no episodes."""

    @property
    def options(self) -> dict[str, Any]:
        """How its environments differ, beside what each episode draws."""
        return {"edit_model": self.edit_model, "timestep_s": self.timestep_s}

    def episodes(
        self, problem: Problem, agent: Agent, n_episodes: int, *, on_progress: OnProgress | None = None
    ) -> list[Episode]:
        """The episodes of every evaluation, in this world.

        Raises:
            InputError: When it is sealed.
        """
        if self.is_sealed:
            raise InputError(f"the {self.name} reality is sealed: it gives metrics, and no episode is shown")
        return self._episodes(problem, agent, n_episodes, on_progress)

    def measure(
        self, problem: Problem, agent: Agent, n_episodes: int, *, on_progress: OnProgress | None = None
    ) -> Summary:
        """Metrics of the episodes of every evaluation, in this world."""
        return summarise(self._episodes(problem, agent, n_episodes, on_progress))

    def _episodes(
        self, problem: Problem, agent: Agent, n_episodes: int, on_progress: OnProgress | None
    ) -> list[Episode]:
        def worlds(n: int, layout: Layout) -> NavigationVectorEnv:
            return problem.worlds(WORLD, n, layout=layout, randomization=self.randomization, **self.options)

        return evaluate_in(
            problem, agent, WORLD, n_episodes, seed=EVALUATION_SEED, on_progress=on_progress, worlds=worlds
        )


def find_reality(name: str) -> Reality:
    """The one of that name.

    Raises:
        InputError: When there is none, or the seal of the test reality is broken.
    """
    if name not in REALITIES:
        raise InputError(f"unknown reality {name!r:.60}: choose {', '.join(REALITIES)}")
    return REALITIES[name]()


# ---- For development -----------------------------------------------------------------------------


def _parametric() -> Reality:
    """Numbers beyond ``burger``, from its ends to what stress tests take; ``wide`` reaches into some.

    Slope, grip and centre of mass go as far as nearly all of its robots can still drive.
    """
    beyond = Randomization(
        wheel_radius=Range(0.96, 0.98),
        wheel_radius_ratio=Range(1.01, 1.02),
        wheel_separation=Range(0.92, 0.95),
        payload_kg=Range(0.5, 2.0),
        yaw_inertia=Range(10.0, 20.0),
        centre_x_m=Range(-0.03, -0.02),
        wheel_friction=Range(0.3, 0.4),
        battery_v=Range(8.5, 9.0),
        motor_left=Range(0.88, 0.95),
        motor_lag_s=Range(0.05, 0.1),
        wheel_stiction_n_m=Range(0.06, 0.12),
        floor_tilt_rad=Range(0.026, 0.035),
        push_speed_m_s=Range(0.05, 0.15),
        push_turn_rad_s=Range(0.3, 0.6),
        command_delay_s=Range(0.15, 0.25),
        command_jitter_s=Range(0.04, 0.06),
        command_loss=Range(0.1, 0.15),
        command_quantum=0.01,  # type: ignore[arg-type]
        command_deadband_m_s=Range(0.015, 0.03),
        lidar_noise_m=Range(0.015, 0.02),
        lidar_noise=Range(0.035, 0.05),
        lidar_bias_m=Range(0.015, 0.03),
        lidar_scale=Range(0.94, 0.97),
        lidar_yaw_rad=Range(0.035, 0.087),
        lidar_dropout=Range(0.05, 0.15),
        lidar_dark_beams=Range(2.0, 4.0),
        lidar_delay_s=Range(0.25, 0.35),
        lidar_skew=1.0,  # type: ignore[arg-type]
        heading_drift_rad_s=Range(0.02, 0.05),
        odometry_scale=Range(0.95, 0.98),
        position_noise_m=Range(0.03, 0.05),
        goal_noise_m=Range(0.03, 0.05),
    )
    return Reality("parametric", "numbers beyond what burger varies, all at once", beyond)


def _structural() -> Reality:
    """Numbers such as a robot may have, in a world that is made differently."""
    inside = Randomization(
        wheel_radius_ratio=Range(0.993, 0.997),
        battery_v=Range(10.0, 11.5),
        battery_sag_v=Range(0.3, 0.6),
        floor_tilt_rad=Range(0.02, 0.03),
        command_delay_s=Range(0.06, 0.12),
        command_jitter_s=Range(0.05, 0.15),
        command_loss=Range(0.01, 0.03),
        command_loss_length=Range(2.0, 6.0),
        command_quantum=0.01,  # type: ignore[arg-type]
        command_deadband_m_s=Range(0.005, 0.02),
        lidar_noise_m=0.01,  # type: ignore[arg-type]
        lidar_noise=0.02,  # type: ignore[arg-type]
        lidar_bias_m=Range(-0.02, -0.01),
        lidar_scale=Range(1.01, 1.03),
        lidar_dropout=0.02,  # type: ignore[arg-type]
        lidar_dark_beams=Range(2.0, 3.0),
        lidar_delay_s=Range(0.08, 0.15),
        lidar_period_s=0.2,  # type: ignore[arg-type]
        lidar_skew=1.0,  # type: ignore[arg-type]
        heading_drift_rad_s=Range(-0.03, -0.01),
        odometry_scale=Range(1.01, 1.03),
        position_noise_m=0.02,  # type: ignore[arg-type]
        goal_noise_m=0.02,  # type: ignore[arg-type]
    )
    wrong = "other integrator, timestep and contacts; motors with friction and play; bursts of lost commands; a lidar \
that turns while the robot drives and has dark sectors; slippery patches on a tilted floor"
    return Reality("structural", wrong, inside, _rebuild(7, stiction_n_m=0.06, play_rad=0.0087), timestep_s=0.005)


# ---- Sealed --------------------------------------------------------------------------------------


def _sealed() -> Reality:
    """Both kinds of wrong at once, with numbers from the sealed seed, each a narrow part of its wide range."""
    seed = resources.files("gridnav.assets").joinpath("reality/test.seed").read_text(encoding="utf-8").strip()
    if hashlib.sha256(seed.encode()).hexdigest() != SEAL:
        raise InputError("the seal of the test reality is broken: its seed is not the one that was committed to")
    rng = np.random.default_rng([int(seed, 16), DRAW])
    wider = Randomization.load("wide")
    drawn: dict[str, Any] = {}
    for name in wider.names:
        low, high = getattr(wider, name).low, getattr(wider, name).high
        # Each quantity: a tenth of the wide range, anywhere in it.
        begin = low + rng.uniform(0.0, 0.9) * (high - low)
        drawn[name] = Range(begin, begin + 0.1 * (high - low))
    # Friction, play and floor: uniform between half and twice those of the structural reality.
    edit = _rebuild(
        int(rng.integers(1 << 30)),
        stiction_n_m=0.06 * float(rng.uniform(0.5, 2.0)),
        play_rad=0.0087 * float(rng.uniform(0.5, 2.0)),
    )
    wrong = "drawn from a sealed seed: numbers and structure"
    return Reality("test", wrong, Randomization(**drawn), edit, timestep_s=0.005, is_sealed=True)


REALITIES: dict[str, Callable[[], Reality]] = {"parametric": _parametric, "structural": _structural, "test": _sealed}
"""What makes each of them, by name."""


# ---- How a model differs -------------------------------------------------------------------------


def _rebuild(seed: int, *, stiction_n_m: float, play_rad: float) -> Callable[[mujoco.MjSpec], None]:
    """Another integrator and contact model, motors with LuGre friction and play, an uneven wheel, and a patchy floor.

    Args:
        seed: Of where the patches are.
        stiction_n_m: Coulomb friction of each motor; it sticks at half as much again.
        play_rad: Between motor and wheel, to each side.
    """

    def edit(spec: mujoco.MjSpec) -> None:
        _add_patches(spec, np.random.default_rng(seed))
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
        for geom in spec.geoms:
            geom.solref = [0.01, 1.2]  # harder and more damped than MuJoCo's 0.02, 1
        for motor in spec.actuators:
            kept = motor.nsample, int(motor.ctrlspec)
            motor.set_to_dcmotor(
                motorconst=[0.0, 0.0],
                resistance=0.0,
                nominal=[STALL_V, STALL_N_M, NO_LOAD_RAD_S],
                controller=[0.0, 0.0, 0.5, 0.0, 0.0, STALL_V],
                # Stiffness and damping of the bristles, sliding and sticking friction, Stribeck speed (Canudas de Wit
                # et al. 1995, IEEE TAC 40:419-425).
                lugre=[100.0, 1.0, stiction_n_m, 1.5 * stiction_n_m, 0.1],
                ctrlspec=kept[1],
            )
            motor.nsample = kept[0]
        for side in ("left", "right"):
            spec.body(f"wheel_{side}").add_joint(
                name=f"play_{side}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0], limited=True,
                range=[-play_rad, play_rad], damping=0.001, armature=1e-4,
            )  # fmt: skip
        spec.geom("wheel_left").pos = [0.0005, 0.0, 0.0]  # out of true by half a millimetre

    return edit


def _add_patches(spec: mujoco.MjSpec, rng: np.random.Generator) -> None:
    """Slippery places on a fifth of the floor.

    They lie half a millimetre above it: flush with it, the floor would carry its share of a wheel and hold it. The
    caster, which slips anyway, does not feel them.
    """
    for side in ("left", "right"):
        spec.geom(f"wheel_{side}").contype |= PATCH_MASK
    width, height = 2.0 * np.asarray(spec.stat.center)[:2]
    for number in range(int(0.2 * width * height / 0.36)):
        # Place: uniform on the floor. Friction: uniform from wet to dusty.
        x, y = rng.uniform((0.0, 0.0), (width, height))
        spec.worldbody.add_geom(
            name=f"patch_{number}", type=mujoco.mjtGeom.mjGEOM_BOX, pos=[x, y, PATCH_TOP_M - 0.05],
            size=[0.3, 0.3, 0.05], contype=PATCH_MASK, conaffinity=PATCH_MASK, condim=3,
            friction=[float(rng.uniform(0.1, 0.3)), 0.005, 0.0001], priority=1,
            rgba=[0.75, 0.85, 0.95, 1.0],
        )  # fmt: skip
