"""From words to an agent's hyper-parameters: a named preset, and single values changed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields, replace
from difflib import get_close_matches
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from gridnav import agents
from gridnav.problem.types import InputError


def presets(kind: str) -> dict[str, Any]:
    """The named hyper-parameters of a kind of agent; none for the planner."""
    names = {"q-learning": "Q_LEARNING_PRESETS", "dqn": "DQN_PRESETS", "ppo": "PPO_PRESETS"}
    return getattr(agents, names[kind]) if kind in names else {}


def choose_config(kind: str, preset: str, changes: Mapping[str, str]) -> Any:
    """The hyper-parameters of a preset with some of them changed.

    Args:
        kind: ``q-learning``, ``dqn`` or ``ppo``.
        preset: One of ``presets(kind)``.
        changes: Values in words, as JSON or plain, by name.

    Raises:
        InputError: When the preset or a name is unknown, or a value is not of its type or outside its range.
    """
    known = presets(kind)
    if preset not in known:
        raise InputError(f"unknown preset {preset!r:.60} of {kind}: the presets are {', '.join(known)}")
    config = known[preset]
    types = get_type_hints(type(config))
    names = {field.name for field in fields(config)}
    values = {}
    for name, words in changes.items():
        if name not in names:
            near = get_close_matches(name, names, 1) or sorted(names)
            raise InputError(f"{kind} has no hyper-parameter {name!r:.60}: did you mean {near[0]}?")
        values[name] = _value(name, words, types[name])
    return replace(config, **values)


def _value(name: str, words: str, kind: Any) -> Any:
    """What the words mean, for a field of this type."""
    try:
        value = json.loads(words, parse_constant=lambda constant: constant)
    except (ValueError, RecursionError):
        value = words
    if isinstance(value, list):
        value = tuple(value)
    if not _fits(value, kind):
        wanted = kind.__name__ if isinstance(kind, type) else str(kind)
        raise InputError(f"{name}={words:.60} is not of type {wanted}")
    return value


def _fits(value: Any, kind: Any) -> bool:
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return any(_fits(value, one) for one in inner)
    if origin is Literal:
        return value in inner
    if origin is tuple:
        return isinstance(value, tuple) and all(_fits(one, inner[0]) for one in value)
    if kind is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    if kind is int:
        return isinstance(value, int) and not isinstance(value, bool)
    return isinstance(value, kind)
