"""Domain randomisation as data: which quantities of the robot and its senses vary, within which ranges, drawn when.

A ``Randomization`` is a set of ranges and nothing else: hashable, readable as JSON, the same for every world. Who draws
is ``Draws``; who puts what was drawn into force are ``imperfections`` (commands and senses) and ``physics`` (MuJoCo).
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Literal, Self

from gridnav.problem.strict_json import parse_object, read_object
from gridnav.problem.types import InputError

Drawn = Literal["episode", "step", "interval", "layout"]
"""Once per episode; as the strength of a noise that is drawn at every step; of events that come at intervals; once per
call of ``reset`` for the whole batch."""
Law = Literal["uniform", "log"]


@dataclass(frozen=True)
class Range:
    """From where to where a quantity is drawn; a point where both are equal."""

    low: float
    """Lowest value."""
    high: float
    """Highest value."""
    law: Law = "uniform"
    """``uniform``, or ``log``: the logarithm is uniform, for what may vary by factors."""

    def at(self, share: float) -> float:
        """The value that so large a share of all draws lies below."""
        low, high = (math.log(end) if self.law == "log" else end for end in (self.low, self.high))
        value = low + share * (high - low)
        return math.exp(value) if self.law == "log" else value

    def scaled(self, strength: float, nominal: float) -> Range:
        """The range drawn together around the nominal value: 0 is that value alone, 1 the range as it is."""
        low, high = (nominal + strength * (end - nominal) for end in (self.low, self.high))
        if self.law == "log":  # by factors; nothing that is drawn so has a nominal value of 0
            low, high = (nominal * (end / nominal) ** strength for end in (self.low, self.high))
        return Range(low, high, self.law)


@dataclass(frozen=True)
class Parameter:
    """What may be said about a quantity."""

    unit: str
    """``x`` stands for a factor on the nominal robot's value."""
    nominal: float
    """The robot's own value."""
    lowest: float
    """No range may begin below."""
    highest: float
    """No range may end above."""
    drawn: Drawn
    """When."""
    acts_on: str
    """``physics`` (DiffDrive alone), ``drive`` (the Unicycle too), ``command``, ``sense`` or ``layout``."""


def _parameter(unit: str, nominal: float, lowest: float, highest: float, acts_on: str, drawn: Drawn = "episode") -> Any:
    parameter = Parameter(unit, nominal, lowest, highest, drawn, acts_on)
    return field(default=Range(nominal, nominal), metadata={"parameter": parameter})


@dataclass(frozen=True)
class Randomization:
    """A range for each quantity that may vary; what is not named keeps the robot's own value.

    Ranges are written as ``Range``, as a pair, or as one number, which is a constant other than the nominal one.

    Raises:
        InputError: When a range is reversed or leaves what is possible.
    """

    # ---- Physics ----
    wheel_radius: Range = _parameter("x", 1.0, 0.8, 1.2, "drive")
    """Of both wheels: wear, tyre pressure, and what calibrations differ by."""
    wheel_radius_ratio: Range = _parameter("x", 1.0, 0.9, 1.1, "drive")
    """Right over left."""
    wheel_separation: Range = _parameter("x", 1.0, 0.8, 1.25, "drive")
    """Between the wheels' contact points."""
    mass: Range = _parameter("x", 1.0, 0.3, 3.0, "physics")
    """Of the body, with its inertia."""
    payload_kg: Range = _parameter("kg", 0.0, 0.0, 10.0, "physics")
    """On top of the body's mass and spread as that is, so the inertia grows with it."""
    yaw_inertia: Range = _parameter("x", 1.0, 0.1, 30.0, "physics")
    """Of the body; the robot's official files differ by a factor of ten."""
    centre_x_m: Range = _parameter("m", 0.0, -0.05, 0.05, "physics")
    """How far the centre of mass lies ahead of where it should be."""
    centre_y_m: Range = _parameter("m", 0.0, -0.05, 0.05, "physics")
    """The same to the left."""
    centre_z_m: Range = _parameter("m", 0.0, -0.04, 0.1, "physics")
    """The same upwards."""
    wheel_friction: Range = _parameter("1", 0.8, 0.05, 2.0, "physics")
    """Sliding friction between wheels and floor."""
    caster_friction: Range = _parameter("1", 0.02, 0.001, 1.0, "physics")
    """The same of the caster."""
    battery_v: Range = _parameter("V", 11.1, 6.5, 12.6, "drive")
    """Supply at the beginning; it bounds the wheels' speed."""
    battery_sag_v: Range = _parameter("V", 0.0, 0.0, 3.0, "physics")
    """Lost in 100 s of driving."""
    motor_left: Range = _parameter("x", 1.0, 0.3, 1.5, "physics")
    """Stall torque of the left motor."""
    motor_right: Range = _parameter("x", 1.0, 0.3, 1.5, "physics")
    """The same of the right one."""
    motor_lag_s: Range = _parameter("s", 0.002, 0.002, 0.3, "physics")
    """Until a wheel has made 63 % of a small step of its speed: the rotor's inertia, seen through the gear."""
    wheel_damping: Range = _parameter("N m s/rad", 0.02, 0.001, 0.3, "physics")
    """Viscous friction of each wheel's joint."""
    wheel_stiction_n_m: Range = _parameter("N m", 0.01, 0.0, 0.5, "physics")
    """Dry friction of each wheel's joint."""
    floor_tilt_rad: Range = _parameter("rad", 0.0, 0.0, 0.2, "physics")
    """Slope of the floor, in a direction of its own each episode."""
    push_speed_m_s: Range = _parameter("m/s", 0.0, 0.0, 1.0, "physics", "interval")
    """Speed that a push gives the robot, in any direction."""
    push_turn_rad_s: Range = _parameter("rad/s", 0.0, 0.0, 5.0, "physics", "interval")
    """Turning speed that a push gives it, either way."""
    push_interval_s: Range = _parameter("s", 4.0, 0.2, 100.0, "physics", "interval")
    """Between two pushes."""

    # ---- Commands ----
    command_delay_s: Range = _parameter("s", 0.0, 0.0, 0.4, "command")
    """From the policy to the motors."""
    command_jitter_s: Range = _parameter("s", 0.0, 0.0, 0.2, "command", "step")
    """Largest additional delay, uniform for each command."""
    command_loss: Range = _parameter("1", 0.0, 0.0, 0.9, "command", "step")
    """Probability that losses begin with a command: the one before stays in force, for half a second at most."""
    command_loss_length: Range = _parameter("commands", 1.0, 1.0, 20.0, "command")
    """How many are lost in a row once one is."""
    command_quantum: Range = _parameter("m/s and rad/s", 0.0, 0.0, 0.1, "command")
    """Steps in which forward and turning speed are passed on."""
    command_deadband_m_s: Range = _parameter("m/s", 0.0, 0.0, 0.1, "command")
    """Wheel speeds below this do not move the wheel."""

    # ---- Senses ----
    lidar_noise_m: Range = _parameter("m", 0.0, 0.0, 0.3, "sense", "step")
    """Standard deviation of every range."""
    lidar_noise: Range = _parameter("x range", 0.0, 0.0, 0.3, "sense", "step")
    """Standard deviation in proportion to the range, beside the other one."""
    lidar_bias_m: Range = _parameter("m", 0.0, -0.2, 0.2, "sense")
    """Added to every range."""
    lidar_scale: Range = _parameter("x", 1.0, 0.8, 1.2, "sense")
    """Factor on every range."""
    lidar_yaw_rad: Range = _parameter("rad", 0.0, -0.3, 0.3, "sense")
    """How far the lidar is turned on the robot."""
    lidar_dropout: Range = _parameter("1", 0.0, 0.0, 0.9, "sense", "step")
    """Probability that a beam finds nothing and reads the longest range."""
    lidar_dark_beams: Range = _parameter("beams", 0.0, 0.0, 12.0, "sense")
    """So many neighbouring beams never find anything: glass, or a part of the robot; whole numbers count."""
    lidar_delay_s: Range = _parameter("s", 0.0, 0.0, 0.4, "sense")
    """Age of a scan when it arrives."""
    lidar_period_s: Range = _parameter("s", 0.0, 0.0, 0.4, "sense")
    """Between two scans; with 0 there is one for every command."""
    lidar_skew: Range = _parameter("1", 0.0, 0.0, 1.0, "sense")
    """Share of a lidar's turn (0.2 s) over which the beams of a scan are taken one after the other."""
    heading_drift_rad_s: Range = _parameter("rad/s", 0.0, -0.2, 0.2, "sense")
    """Of the estimated heading."""
    odometry_scale: Range = _parameter("x", 1.0, 0.8, 1.2, "sense")
    """Of the estimated way over the true one."""
    localization_s: Range = _parameter("s", 3.0, 0.5, 1000.0, "sense")
    """Time in which the estimated pose falls back to the true one, as a scan matcher's does."""
    position_noise_m: Range = _parameter("m", 0.0, 0.0, 0.5, "sense", "step")
    """Standard deviation of the estimated position, each axis."""
    goal_noise_m: Range = _parameter("m", 0.0, 0.0, 0.5, "sense")
    """Standard deviation of where the goal is thought to be, each axis, for a whole episode."""

    # ---- Layout ----
    obstacles_moved: Range = _parameter("walls", 0.0, 0.0, 20.0, "layout", "layout")
    """Inner wall cells that stand elsewhere; whole numbers count, and every goal stays reachable."""
    cell_size: Range = _parameter("x", 1.0, 0.6, 1.6, "layout", "layout")
    """Of the whole maze."""

    curriculum: bool = False
    """Ranges begin at the nominal values and widen as episodes at their ends succeed, see ``draws.Curriculum``."""

    def __post_init__(self) -> None:
        for name, parameter in PARAMETERS.items():
            object.__setattr__(self, name, _range(name, getattr(self, name), parameter))

    @property
    def names(self) -> tuple[str, ...]:
        """Of the quantities that are not always nominal."""
        ranges = {name: getattr(self, name) for name in PARAMETERS}
        return tuple(n for n, r in ranges.items() if not r.low == r.high == PARAMETERS[n].nominal)

    def acts_on(self, *what: str) -> bool:
        """Whether something of these kinds is not always nominal."""
        return any(PARAMETERS[name].acts_on in what for name in self.names)

    def scaled(self, strength: float) -> Self:
        """Every range drawn together (0: nothing varies) or blown up (2: twice as wide), within what is possible."""
        if not 0.0 <= strength <= 10.0:
            raise InputError(f"strength {strength} of a randomization is outside 0 to 10")
        changed: dict[str, Any] = {}
        for name in self.names:
            parameter = PARAMETERS[name]
            wanted: Range = getattr(self, name).scaled(strength, parameter.nominal)
            low, high = (min(max(end, parameter.lowest), parameter.highest) for end in (wanted.low, wanted.high))
            changed[name] = Range(low, high, wanted.law)
        return replace(self, **changed)

    def without(self, *names: str) -> Self:
        """The same with these quantities nominal."""
        nominal: dict[str, Any] = {_known(name): PARAMETERS[name].nominal for name in names}
        return replace(self, **nominal)

    def only(self, *names: str) -> Self:
        """The same with everything but these quantities nominal."""
        return self.without(*(name for name in self.names if name not in [_known(one) for one in names]))

    @classmethod
    def fixed(cls, **values: float) -> Self:
        """Every named quantity at one value."""
        points: dict[str, Any] = {_known(name): value for name, value in values.items()}
        return cls(**points)

    def to_json(self) -> dict[str, Any]:
        """What is not nominal: ``[low, high]`` by name, with ``"log"`` behind where that is the law."""
        ranges = {name: getattr(self, name) for name in self.names}
        values: dict[str, Any] = {
            n: [r.low, r.high] + ([r.law] if r.law != "uniform" else []) for n, r in ranges.items()
        }
        return values | ({"curriculum": True} if self.curriculum else {})

    @classmethod
    def inlined(cls, source: str) -> str:
        """A preset's name as it is, anything else as JSON text: what needs no file to be loaded again."""
        return source if source in PRESETS else json.dumps(cls.load(source).to_json())

    @classmethod
    def load(cls, source: str | Path | Mapping[str, Any] | Randomization) -> Randomization:
        """A preset by its name, JSON text or a JSON file with ``{"quantity": [low, high], ...}``.

        ``"preset"`` in the JSON names what the ranges change.

        Raises:
            InputError: When a name is unknown or a range is not possible.
        """
        if isinstance(source, Randomization):
            return source
        values = dict(source) if isinstance(source, Mapping) else _read(source)
        preset = values.pop("preset", "none")
        if not isinstance(preset, str) or preset not in PRESETS:
            raise InputError(f"unknown randomization {preset!r:.60}: the presets are {', '.join(PRESETS)}")
        curriculum = values.pop("curriculum", PRESETS[preset].curriculum)
        if not isinstance(curriculum, bool):
            raise InputError(f"curriculum {curriculum!r:.20} of a randomization must be true or false")
        known = {_known(name): value for name, value in values.items()}
        return replace(PRESETS[preset], curriculum=curriculum, **known)


PARAMETERS: dict[str, Parameter] = {
    f.name: f.metadata["parameter"] for f in fields(Randomization) if "parameter" in f.metadata
}
"""Unit, nominal value, bounds, time of drawing and place of effect of each quantity."""


MISTAKEN_UNITS: dict[str, dict[float, str]] = {
    "s": {1e-3: "milliseconds"},
    "m": {1e-2: "centimetres", 1e-3: "millimetres"},
    "m/s": {1e-2: "centimetres per second", 1e-3: "millimetres per second"},
    "rad": {0.0174533: "degrees"},
    "rad/s": {0.0174533: "degrees per second"},
    "kg": {1e-3: "grams"},
    "V": {1e-3: "millivolts"},
    "x": {1e-2: "percent"},
    "x range": {1e-2: "percent"},
    "1": {1e-2: "percent"},
}
"""By unit: what a number that is out of bounds may have been given in, with the factor to the right unit."""


def _read(source: str | Path) -> dict[str, Any]:
    text = str(source)
    is_text = text.lstrip().startswith("{")
    if not is_text and not text.endswith(".json"):
        return {"preset": text}
    try:
        return parse_object(text) if is_text else read_object(Path(text))
    except OSError as error:
        raise InputError(f"randomization {text!r:.80} cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise InputError(f"randomization {text!r:.60} is not valid JSON: {error}") from None


def _known(name: str) -> str:
    if name not in PARAMETERS:
        near = get_close_matches(name, PARAMETERS, 1, cutoff=0.0)
        raise InputError(f"no quantity {name!r:.60} can be randomised: did you mean {near[0]}?")
    return name


def _range(name: str, value: Any, parameter: Parameter) -> Range:
    """The value as a range within what is possible."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        value = (value, value)
    if isinstance(value, list | tuple) and 2 <= len(value) <= 3:
        value = Range(*value)
    ends = (value.low, value.high) if isinstance(value, Range) else ()
    if not ends or not all(isinstance(end, int | float) and not isinstance(end, bool) for end in ends):
        raise InputError(f'{name} {json.dumps(value, default=str):.60} must be a number, [low, high] or with "log"')
    low, high = (float(min(max(end, -1e99), 1e99)) for end in ends)  # a JSON number may have any number of digits
    if low > high:
        raise InputError(f"{name} [{low:g}, {high:g}] is reversed: the first number must be the lower one")
    for end in (low, high):
        if not parameter.lowest <= end <= parameter.highest:
            raise InputError(f"{name} {end:g} is outside {_bounds(parameter)}{_unit_hint(end, parameter)}")
    if value.law not in ("uniform", "log") or (value.law == "log" and (low <= 0.0 or parameter.nominal <= 0.0)):
        raise InputError(f"{name} cannot follow the law {value.law!r:.20}: log is for positive numbers, else uniform")
    return Range(low, high, value.law if low < high else "uniform")


def _bounds(parameter: Parameter) -> str:
    unit = "" if parameter.unit == "1" else f" {parameter.unit}"
    return f"{parameter.lowest:g} to {parameter.highest:g}{unit}"


def _unit_hint(value: float, parameter: Parameter) -> str:
    """What the number may have been meant as, where a plausible factor brings it within bounds."""
    for factor, unit in MISTAKEN_UNITS.get(parameter.unit, {}).items():
        if parameter.lowest <= value * factor <= parameter.highest:
            return f": is it in {unit}? Then write {value * factor:.3g}"
    return ""


_BURGER = Randomization(
    wheel_radius=Range(0.98, 1.02),
    wheel_radius_ratio=Range(0.99, 1.01),
    wheel_separation=Range(0.95, 1.05),
    mass=Range(0.8, 1.3),
    payload_kg=Range(0.0, 0.5),
    yaw_inertia=Range(0.5, 10.0, "log"),
    centre_x_m=Range(-0.02, 0.01),
    centre_y_m=Range(-0.01, 0.01),
    centre_z_m=Range(-0.03, 0.02),
    wheel_friction=Range(0.4, 1.2),
    caster_friction=Range(0.01, 0.2),
    battery_v=Range(9.0, 12.0),
    battery_sag_v=Range(0.0, 0.3),
    motor_left=Range(0.95, 1.05),
    motor_right=Range(0.95, 1.05),
    motor_lag_s=Range(0.002, 0.05),
    wheel_damping=Range(0.005, 0.05, "log"),
    wheel_stiction_n_m=Range(0.0, 0.06),
    floor_tilt_rad=Range(0.0, 0.026),
    push_speed_m_s=Range(0.0, 0.05),
    push_turn_rad_s=Range(0.0, 0.3),
    push_interval_s=Range(2.0, 6.0),
    command_delay_s=Range(0.02, 0.15),
    command_jitter_s=Range(0.0, 0.04),
    command_loss=Range(0.0, 0.1),
    command_quantum=0.01,  # type: ignore[arg-type]
    command_deadband_m_s=Range(0.0, 0.015),
    lidar_noise_m=Range(0.003, 0.015),
    lidar_noise=Range(0.0, 0.035),
    lidar_bias_m=Range(-0.015, 0.015),
    lidar_scale=Range(0.97, 1.03),
    lidar_yaw_rad=Range(-0.035, 0.035),
    lidar_dropout=Range(0.0, 0.05),
    lidar_dark_beams=Range(0.0, 2.0),
    lidar_delay_s=Range(0.05, 0.25),
    lidar_skew=Range(0.0, 1.0),
    heading_drift_rad_s=Range(-0.02, 0.02),
    odometry_scale=Range(0.98, 1.02),
    position_noise_m=Range(0.0, 0.03),
    goal_noise_m=Range(0.0, 0.03),
)

# Half as wide again, but for the centre of mass along the robot: further ahead it falls on its nose when it stops,
# further back its wheels lose their hold.
_WIDE = replace(_BURGER.scaled(1.5), centre_x_m=_BURGER.centre_x_m)

PRESETS: dict[str, Randomization] = {
    "none": Randomization(),
    # What may be true of one TurtleBot3 Burger or the next: the project's table of ranges with their sources is in
    # docs/randomization.md.
    "burger": _BURGER,
    # For a robot of which less is known.
    "wide": _WIDE,
    # Random pushes and nothing else: the baseline that often does as well (Valassakis, Ding and Mahajan 2020,
    # arXiv 2008.06686).
    "force-only": Randomization(
        push_speed_m_s=Range(0.0, 0.1), push_turn_rad_s=Range(0.0, 1.0), push_interval_s=Range(0.5, 3.0)
    ),
    # Up to "wide", as fast as the policy can follow (automatic domain randomisation, OpenAI et al. 2019,
    # arXiv 1910.07113, with one strength for all quantities).
    "curriculum": replace(_WIDE, curriculum=True),
}
"""By name."""
