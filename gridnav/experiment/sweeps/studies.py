"""Ready-made sweeps: which trials each of them does."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gridnav.envs import PARAMETERS, RANDOMIZATION_PRESETS, Randomization
from gridnav.experiment.arms import ARMS
from gridnav.experiment.run_directory import RunDirectory, check_names
from gridnav.experiment.sweeps.design import Settings
from gridnav.experiment.transfer import SCRATCH
from gridnav.problem.types import InputError

RANDOMIZED = "burger"
"""The randomization of studies that are not told another one."""
UNDER = {"none": "none", "burger": "burger", "wide": "wide"}
"""Where agents of the presets are evaluated."""
WHOLE = "whole"
"""A training of its preset's length."""
SHORTENED = "short"
"""A training of ``SHORT`` steps: a correlation needs policies that differ in quality."""
SHORT = {"none": 48_000, "wide": 96_000}
"""Steps by the randomization of the training: a tenth of what `classic` takes."""
STRENGTHS = tuple(k / 4 for k in range(9))
REACHES = (0.5, 1.0, 1.5, 2.0)
"""How far a quantity goes from its nominal value, as a share of the way to either end of its range."""
GROUPS = {
    group: tuple(name for name, parameter in PARAMETERS.items() if parameter.acts_on == group)
    for group in ("drive", "physics", "command", "sense")
}
"""Quantities that are left out together."""
NOTHING, EVERYTHING = "nothing", "everything"
"""Names of what is left out where nothing is, and where nothing is left."""


@dataclass(frozen=True)
class Wish:
    """What a study is asked for, as far as it asks."""

    seeds: Sequence[int] = (0, 1, 2)
    """Of the trainings."""
    randomization: str = ""
    """A preset, a JSON file or JSON text; the runs' own or ``burger`` by default."""
    quantities: Sequence[str] = ()
    """Of that randomization, or groups of them; all by default."""
    randomizations: Sequence[str] = ()
    """Which are compared: presets and JSON files; all presets by default."""
    arms: str = ""
    """Names of arms of transfer with commas between; all by default."""
    runs: Sequence[Path] = ()
    """Finished runs, where those are evaluated."""
    episodes: int = 200
    """Of each of their evaluations."""


@dataclass(frozen=True)
class Draft:
    """A trial before its command has checked it."""

    command: str
    """``train``, ``ladder`` or ``evaluate``."""
    settings: Settings
    """What tells it from the others, by column of the table."""
    fields: Mapping[str, Any]
    """Its configuration, as far as the study decides it; all of it for ``evaluate``. What it says under ``set`` comes
    after what the command line says there."""
    under: Mapping[str, str] = field(default_factory=dict)
    """See ``Trial``."""


# ---- Studies that train ---------------------------------------------------------------------------------


def _plan_arms(wish: Wish) -> list[Draft]:
    arms = wish.arms or ",".join(ARMS)
    if SCRATCH not in arms.split(","):
        raise InputError(f"--arms {arms}: the study compares arms with {SCRATCH}, which is not among them")
    return [Draft("ladder", {"seed": str(seed)}, {"seed": str(seed), "arms": arms}) for seed in wish.seeds]


def _plan_presets(wish: Wish) -> list[Draft]:
    ranges = compared(wish.randomizations or tuple(RANDOMIZATION_PRESETS))
    drafts = []
    for training, steps in ((WHOLE, dict.fromkeys(ranges)), (SHORTENED, SHORT)):
        for name in [one for one in ranges if one in steps]:
            changes = () if steps[name] is None else (f"steps={steps[name]}",)
            for seed in wish.seeds:
                settings = {"randomization": name, "training": training, "seed": str(seed)}
                drafts.append(_training(settings, ranges[name], seed, UNDER, changes))
    return drafts


def compared(sources: Sequence[str]) -> dict[str, str]:
    """Randomizations by their names in the table, each a preset or JSON text, which needs no file.

    Args:
        sources: Presets, JSON files, which are called as the file is without its ending, and ``NAME={JSON}``.

    Raises:
        InputError: When one is not possible, or two have one name.
    """
    named: dict[str, str] = {}
    for source in sources:
        name, equals, text = source.partition("=")
        if source in RANDOMIZATION_PRESETS:
            name = text = source
        elif not (equals and text.lstrip().startswith("{")):
            name, text = Path(source).stem, source
        if source.lstrip().startswith("{") or not name:
            raise InputError(f"--randomizations {source:.40} has no name for the table: write NAME={{...}}")
        text = Randomization.inlined(text)
        if name in named or (text != name and name in RANDOMIZATION_PRESETS):
            raise InputError(f"--randomizations {source:.60}: another one is called {name!r:.60}, rename it")
        named[name] = text
    return named


def _training(
    settings: Settings, randomization: str, seed: int, under: Mapping[str, str], changes: tuple[str, ...] = ()
) -> Draft:
    fields = {"agent": "ppo", "seed": str(seed), "randomization": randomization, "set": list(changes)}
    return Draft("train", settings, fields, under)


def _plan_leave_one_out(wish: Wish) -> list[Draft]:
    whole = Randomization.load(wish.randomization or RANDOMIZED)
    parts = {name: GROUPS.get(name, (name,)) for name in wish.quantities or GROUPS}
    left = {NOTHING: whole} | {name: whole.without(*quantities) for name, quantities in parts.items()}
    idle = [name for name, rest in left.items() if name != NOTHING and rest == whole]
    if idle and (wish.quantities or len(idle) == len(parts)):
        what = f"--quantities {idle[0]}" if wish.quantities else f"--randomization {wish.randomization:.60}"
        raise InputError(f"{what}: the randomization leaves that as it is, so nothing can be left out")
    left = {name: rest for name, rest in left.items() if name not in idle} | {EVERYTHING: Randomization()}
    under = {"whole": _text(whole), "none": "none"}
    return [
        _training({"without": name, "seed": str(seed)}, _text(rest), seed, under)
        for name, rest in left.items()
        for seed in wish.seeds
    ]


# ---- Studies of finished runs ---------------------------------------------------------------------------


def _plan_one_at_a_time(wish: Wish) -> list[Draft]:
    drafts = []
    for run in _runs(wish):
        ranges = Randomization.load(_varied(wish, run))
        for name in _chosen(wish.quantities, ranges):
            for value in _values(ranges, name):
                settings = {"run": run.path.name, "quantity": name, "value": value}
                drafts.append(_evaluation(settings, Randomization.fixed(**{name: float(value)}), run, wish))
    return drafts


def _values(ranges: Randomization, name: str) -> list[str]:
    """The nominal value, and points on the way to both ends of the range and beyond, as far as is possible."""
    parameter = PARAMETERS[name]
    reached = [getattr(ranges.scaled(reach).only(name), name) for reach in REACHES]
    values = {parameter.nominal} | {end for one in reached for end in (one.low, one.high)}
    return list(dict.fromkeys(f"{value:.6g}" for value in sorted(values)))


def _plan_strength(wish: Wish) -> list[Draft]:
    return [
        _evaluation({"run": run.path.name, "strength": f"{strength:g}"}, part.scaled(strength), run, wish)
        for run in _runs(wish)
        for ranges in [Randomization.load(_varied(wish, run))]
        for part in [ranges.only(*_chosen(wish.quantities, ranges))]
        for strength in STRENGTHS
    ]


def _chosen(quantities: Sequence[str], ranges: Randomization) -> list[str]:
    """Those that vary of the quantities that were asked for, alone or in groups; mazes stay in evaluations."""
    wanted = [one for name in quantities for one in GROUPS.get(name, (name,))]
    unknown = [name for name in wanted if name not in PARAMETERS]
    if unknown:
        Randomization().without(*unknown)  # says what was meant
    names = [name for name in ranges.names if PARAMETERS[name].acts_on != "layout"]
    chosen = [name for name in names if not wanted or name in wanted]
    if not chosen:
        what = ", ".join(quantities) or "robots, commands and senses"
        raise InputError(f"nothing of {what:.60} varies in that randomization: {', '.join(ranges.names):.100}")
    return chosen


def _runs(wish: Wish) -> list[RunDirectory]:
    if not wish.runs:
        raise InputError("this study evaluates finished runs: name them with --runs RUN ...")
    runs = [RunDirectory.open(path.resolve()) for path in wish.runs]
    for run in runs:
        if not run.evaluation.is_file():
            raise InputError(f"{str(run.path)!r} has no {run.evaluation.name}: the run has not finished")
    check_names(runs)
    return runs


def _varied(wish: Wish, run: RunDirectory) -> str:
    own = run.read_config().get("randomization", "none")
    return wish.randomization or (own if own != "none" else RANDOMIZED)


def _evaluation(settings: Settings, randomization: Randomization, run: RunDirectory, wish: Wish) -> Draft:
    config = {
        "command": "evaluate",
        "run": str(run.path),
        # A run that was made anew since then is another one.
        "evaluation_sha256": hashlib.sha256(run.evaluation.read_bytes()).hexdigest(),
        "randomization": _text(randomization),
        "episodes": wish.episodes,
    }
    return Draft("evaluate", settings, config)


def _text(randomization: Randomization) -> str:
    return json.dumps(randomization.to_json())


# ---- By name ---------------------------------------------------------------------------------------------

PLANS: dict[str, Callable[[Wish], list[Draft]]] = {
    "arms": _plan_arms,
    "presets": _plan_presets,
    "leave-one-out": _plan_leave_one_out,
    "one-at-a-time": _plan_one_at_a_time,
    "strength": _plan_strength,
}
EVALUATING = ("one-at-a-time", "strength")
"""These evaluate finished runs and train nothing."""
PARTS = {"default": ("arms", "presets")} | {name: (name,) for name in PLANS}
"""Which of them a name on the command line stands for."""


def plan(name: str, wish: Wish) -> list[Draft]:
    """The trials of a study, in the order of its table.

    Raises:
        InputError: When a run, a quantity or a randomization is unknown or does not fit.
    """
    parts = PARTS[name]
    drafts = []
    for part in parts:
        for draft in PLANS[part](wish):
            settings = ({"study": part} if len(parts) > 1 else {}) | draft.settings
            drafts.append(Draft(draft.command, settings, draft.fields, draft.under))
    return drafts
