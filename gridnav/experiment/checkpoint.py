"""Crash-safe, pickle-free files of a run.

A checkpoint is a fresh directory: written aside, synced, renamed, then older ones pruned. Whatever instant a run is
killed at, the newest directory under ``checkpoints/`` whose hashes verify is whole.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import uuid
from importlib.metadata import version
from pathlib import Path
from typing import Any

from gridnav.agents import Agent, Planner, QLearning
from gridnav.problem.types import InputError

FORMAT = 1
KEPT = 2
"""Checkpoints that pruning leaves."""
MANIFEST = "manifest.json"
LIBRARIES = ("gridnav", "numpy", "torch", "mujoco", "gymnasium", "stable-baselines3", "rerun-sdk")
"""What decides a run's numbers and files, in checkpoints and reports."""


def save_agent(agent: Agent, directory: Path, step: int, *, name: str) -> Path:
    """Write an agent as ``step-000000012345`` into a directory of checkpoints.

    Args:
        agent: What to save.
        directory: Made if it does not exist.
        step: Environment steps the run has taken so far; the next free number is taken where two agents share one.
        name: Which of the run's agents it is; older checkpoints of the same name are pruned.

    Returns:
        The checkpoint's directory.
    """
    directory.mkdir(parents=True, exist_ok=True)
    aside = directory / f".tmp-{uuid.uuid4().hex}"
    aside.mkdir()
    agent.save(aside)
    parts = {part.name: _digest(part) for part in sorted(aside.iterdir())}
    manifest = {
        "format": FORMAT,
        "name": name,
        "kind": agent.kind,
        "step": step,
        "versions": {name: version(name) for name in LIBRARIES},
        "parts": parts,
    }
    (aside / MANIFEST).write_text(json.dumps(manifest, indent=2), encoding="utf-8")
    for part in aside.iterdir():
        _sync(part)
    _sync(aside)
    final = _fresh(directory, step)
    aside.rename(final)
    _sync(directory)
    for old in _checkpoints(directory, name)[KEPT:]:
        shutil.rmtree(old)
    return final


def _fresh(directory: Path, step: int) -> Path:
    """The checkpoint's name, or the next free one: nothing that was saved is ever overwritten."""
    while (final := directory / f"step-{step:012d}").exists():
        step += 1
    return final


def load_agent(directory: Path, name: str) -> Agent:
    """An agent of a run, from its newest whole checkpoint.

    Args:
        directory: A directory of checkpoints.
        name: Which of the run's agents.

    Raises:
        InputError: When it holds none that verifies.
    """
    for checkpoint in _checkpoints(directory, name):
        return _agent_class(_manifest(checkpoint)["kind"]).load(checkpoint)
    raise InputError(f"{str(directory)!r} holds no whole checkpoint of {name!r}")


def _checkpoints(directory: Path, name: str) -> list[Path]:
    """Whole checkpoints of one agent, newest first."""
    newest_first = sorted(directory.glob("step-*"), reverse=True)
    return [path for path in newest_first if _is_whole(path) and _manifest(path)["name"] == name]


def _manifest(checkpoint: Path) -> dict[str, Any]:
    manifest: dict[str, Any] = json.loads((checkpoint / MANIFEST).read_text(encoding="utf-8"))
    return manifest


def _agent_class(kind: str) -> type[Agent]:
    if kind == "ppo":
        from gridnav.agents import PPOAgent  # torch takes seconds to import

        return PPOAgent
    for known in (Planner, QLearning):
        if known.kind == kind:
            return known
    raise InputError(f"the checkpoint holds an agent of the unknown kind {kind!r}")


def _is_whole(checkpoint: Path) -> bool:
    try:
        manifest = _manifest(checkpoint)
        parts: dict[str, dict[str, object]] = manifest["parts"]
        # Names come from a file: only plain ones inside the checkpoint are looked at.
        plain = all(name == Path(name).name for name in parts)
        named = isinstance(manifest["name"], str) and isinstance(manifest["kind"], str)
        complete = manifest["format"] == FORMAT and set(Agent.files) <= parts.keys()
        return plain and named and complete and all(_digest(checkpoint / n) == d for n, d in parts.items())
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return False


def _digest(part: Path) -> dict[str, object]:
    content = part.read_bytes()
    return {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}


def _sync(path: Path) -> None:
    """Force a file or directory to the disk, where the system lets a directory be opened."""
    if os.name == "nt" and path.is_dir():
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
