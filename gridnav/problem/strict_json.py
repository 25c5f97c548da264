"""JSON from files that may be damaged, or made to harm."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NoReturn

LARGEST = 1 << 26
"""Bytes of the largest file that is read."""


def parse_object(text: str) -> dict[str, Any]:
    """The one JSON object that a text holds.

    Raises:
        ValueError: When it holds none, a number that is none, a key twice, or nesting without an end.
    """
    try:
        content = json.loads(text, object_pairs_hook=_without_repeats, parse_constant=_refuse)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    if not isinstance(content, dict):
        raise ValueError("it must hold one JSON object")
    return content


def read_object(path: Path) -> dict[str, Any]:
    """The one JSON object that a file holds.

    Raises:
        OSError: When the file cannot be read.
        ValueError: When it holds none; see ``parse_object``.
    """
    if path.exists() and not path.is_file():  # a pipe would never end
        raise ValueError("it is no regular file")
    if path.stat().st_size > LARGEST:
        raise ValueError(f"it has more than {LARGEST} bytes")
    return parse_object(path.read_text(encoding="utf-8"))


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        raise ValueError("it holds a key twice")
    return content


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is no JSON number")
