"""Which settings a sweep tries: every combination of listed values, or values drawn at random."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from gridnav.problem.types import InputError

MOST_TRIALS = 10_000
"""More than these are a mistake."""
Settings = dict[str, str]
"""One trial's values in words, by field."""
Draw = Callable[[np.random.Generator, int], list[str]]

_LAWS: Mapping[str, Callable[[float, float, np.random.Generator, int], Sequence[float]]] = {
    # x ~ U(low, high)
    "uniform": lambda low, high, rng, n: [*rng.uniform(low, high, n)],
    # log x ~ U(log low, log high)
    "log": lambda low, high, rng, n: [*np.exp(rng.uniform(np.log(low), np.log(high), n))],
    # Whole numbers, both ends included, all alike.
    "int": lambda low, high, rng, n: [*rng.integers(int(low), int(high), n, endpoint=True)],
}


def settings_of(grid: Sequence[str], random: Sequence[str] = (), *, n_draws: int = 20, seed: int = 0) -> list[Settings]:
    """The settings of a sweep, in the order of its trials.

    Args:
        grid: Fields with the values to combine, such as ``seed=0,1,2``; the last one changes fastest.
        random: Fields with a law to draw from: ``log:LOW:HIGH``, ``uniform:LOW:HIGH``, ``int:LOW:HIGH``, or values of
            which each is as likely, such as ``batch_size=32,64``. Each draw meets every combination of the grid.
        n_draws: How many, where something is drawn.
        seed: Of the draws.

    Raises:
        InputError: When a text is no such thing, a field comes twice, or there are too many trials.
    """
    axes = dict(_axis(text) for text in grid)
    laws = {field: _law(field, words) for field, words in map(_field_and_words, random)}
    twice = [text for text in (*grid, *random) if [*map(_field, (*grid, *random))].count(_field(text)) > 1]
    if twice:
        raise InputError(f"the sweep has {_field(twice[0])!r:.60} twice: give all its values at once")
    if n_draws < 1:
        raise InputError(f"--n-trials {n_draws} must be at least 1")
    n_trials = math.prod(len(values) for values in axes.values()) * (n_draws if laws else 1)
    if n_trials > MOST_TRIALS:
        raise InputError(f"the sweep has {n_trials} trials: at most {MOST_TRIALS} are allowed")
    combinations = [dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]
    if not laws:
        return combinations
    # Each field has a stream of its own, so that one more field leaves the others' values as they were.
    streams = np.random.SeedSequence(seed).spawn(len(laws))
    columns = [draw(np.random.default_rng(s), n_draws) for draw, s in zip(laws.values(), streams, strict=True)]
    drawn = [dict(zip(laws, values, strict=True)) for values in zip(*columns, strict=True)]
    return [one | combination for one in drawn for combination in combinations]


def _field_and_words(text: str) -> tuple[str, str]:
    field, equals, words = text.partition("=")
    if not equals or not field or not words:
        raise InputError(f"{text!r:.60} must be FIELD=VALUES, such as seed=0,1,2")
    return _field(text), words


def _field(text: str) -> str:
    """The field's name as configurations write it."""
    return text.partition("=")[0].replace("-", "_")


def _axis(text: str) -> tuple[str, list[str]]:
    field, words = _field_and_words(text)
    values = _split(words)
    if "" in values or len(set(values)) < len(values):
        raise InputError(f"{text!r:.60} has an empty value, or one twice")
    return field, values


def _split(words: str) -> list[str]:
    """Values with commas between; those inside brackets belong to a value: ``[64,64],[128]`` are two."""
    values, depth = [""], 0
    for letter in words:
        depth += (letter in "[{") - (letter in "]}")
        if letter == "," and depth == 0:
            values.append("")
        else:
            values[-1] += letter
    return values


def _law(field: str, words: str) -> Draw:
    kind, *bounds = words.split(":")
    if kind not in _LAWS:
        _, values = _axis(f"{field}={words}")
        return lambda rng, n: [values[i] for i in rng.integers(len(values), size=n)]
    try:
        low, high = (float(bound) for bound in bounds)
        if not (-1e300 < low < high < 1e300 and (low > 0 or kind != "log")):
            raise ValueError
        if kind == "int" and not (low.is_integer() and high.is_integer() and max(-low, high) < 2**53):
            raise ValueError
    except ValueError:
        law = f"{field}={words}"
        raise InputError(
            f"{law!r:.60} must be {kind}:LOW:HIGH with LOW below HIGH"
            f"{', both above 0' if kind == 'log' else ', whole numbers' if kind == 'int' else ''}"
        ) from None
    # Six digits: what stands in the table is what was tried.
    return lambda rng, n: [f"{value:.6g}" if kind != "int" else str(value) for value in _LAWS[kind](low, high, rng, n)]
