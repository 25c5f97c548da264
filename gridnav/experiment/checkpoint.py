"""Crash-safe, pickle-free files of a run.

A checkpoint is a fresh directory: written aside, synced, renamed, then older ones pruned. Whatever instant a run is
killed at, the newest directory under ``checkpoints/`` whose hashes verify is whole.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
import uuid
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from gridnav.agents import Agent, Planner, QLearning, read_state, write_state
from gridnav.problem.strict_json import read_object
from gridnav.problem.types import InputError, IntArray, State

FORMAT = 2
KEPT = 2
"""Checkpoints that pruning leaves."""
MANIFEST = "manifest.json"
LIBRARIES = ("gridnav", "numpy", "torch", "mujoco", "gymnasium", "stable-baselines3", "rerun-sdk")
"""What decides a run's numbers and files, in checkpoints and reports."""
LARGEST = 1 << 30
"""Bytes of the largest part that is read."""
log = logging.getLogger("gridnav")


@dataclass(frozen=True)
class Standing:
    """Where a run stood when a checkpoint was written."""

    steps: int = 0
    """Environment steps of this agent's training so far."""
    seconds: float = 0.0
    """Wall-clock time of this agent's training so far."""
    run_steps: int = 0
    """Environment steps of all agents of the run so far."""
    log_bytes: int = 0
    """Length of the run's metrics, which a continued run cuts back to."""
    is_finished: bool = False
    """This agent's training is over."""

    def __post_init__(self) -> None:
        counts = self.steps, self.run_steps, self.log_bytes
        if not all(type(count) is int and 0 <= count < 2**53 for count in counts):
            raise ValueError(f"steps and bytes of {self} must be whole numbers of at least 0")
        if not isinstance(self.seconds, int | float) or not 0 <= self.seconds < 1e300:
            raise ValueError(f"seconds {self.seconds!r:.60} must be a number of at least 0")
        if not isinstance(self.is_finished, bool):
            raise ValueError(f"is_finished {self.is_finished!r:.60} must be true or false")


@dataclass(frozen=True)
class Checkpoint:
    """What a checkpoint holds."""

    agent: Agent
    """As it was."""
    standing: Standing
    """Where the run stood."""
    training: State | None
    """What the learner needs to go on; none where its training is over."""
    worlds: State | None
    """The same of the environments."""
    visits: IntArray | None = None
    """How often a robot was seen in each cell, shape ``(n_rows, n_cols)``."""
    validation: State | None = None
    """The best policy so far, where policies of the training are judged."""


def save_checkpoint(directory: Path, name: str, checkpoint: Checkpoint) -> Path:
    """Write a checkpoint as ``step-000000012345`` into a directory of checkpoints.

    Args:
        directory: Made if it does not exist.
        name: Which of the run's agents it is; older checkpoints of the same name are pruned.
        checkpoint: What to save. The directory's number is that of the run's steps, or the next free one.

    Returns:
        The checkpoint's directory.

    Raises:
        OSError: When the disk is full or may not be written; what was saved before is intact, nothing else is left.
    """
    directory.mkdir(parents=True, exist_ok=True)
    aside = directory / f".tmp-{uuid.uuid4().hex}"
    try:
        aside.mkdir()
        _write(aside, name, checkpoint)
        final = _fresh(directory, checkpoint.standing.run_steps)
        aside.rename(final)
    except BaseException:
        shutil.rmtree(aside, ignore_errors=True)
        raise
    _sync(directory)
    for old in _whole(directory, name)[KEPT:]:
        # Out of sight first: killed in the middle, half a checkpoint would look like a damaged one.
        aside = directory / f".tmp-{uuid.uuid4().hex}"
        old.rename(aside)
        shutil.rmtree(aside)
    return final


def save_agent(agent: Agent, directory: Path, step: int, *, name: str) -> Path:
    """A checkpoint of an agent that has learnt; see ``save_checkpoint``."""
    standing = Standing(steps=step, run_steps=step, is_finished=True)
    return save_checkpoint(directory, name, Checkpoint(agent, standing, None, None))


def _write(aside: Path, name: str, checkpoint: Checkpoint) -> None:
    checkpoint.agent.save(aside)
    visits = None if checkpoint.visits is None else State({"visits": checkpoint.visits}, {})
    parts = {
        "training": checkpoint.training,
        "worlds": checkpoint.worlds,
        "visits": visits,
        "validation": checkpoint.validation,
    }
    for part, state in parts.items():
        if state is not None:
            write_state(state, aside, part)
    manifest = {
        "format": FORMAT,
        "name": name,
        "kind": checkpoint.agent.kind,
        "step": checkpoint.standing.run_steps,
        "standing": asdict(checkpoint.standing),
        "versions": {library: version(library) for library in LIBRARIES},
        "torch_threads": 1,
        "parts": {part.name: _digest(part) for part in sorted(aside.iterdir())},
    }
    (aside / MANIFEST).write_text(json.dumps(manifest, indent=2), encoding="utf-8")
    for file in aside.iterdir():
        _sync(file)
    _sync(aside)


def _fresh(directory: Path, step: int) -> Path:
    """The checkpoint's name, or the next higher one that is free: what is newer never has a lower number."""
    numbers = [path.name.removeprefix("step-") for path in directory.glob("step-*")]
    last = max((int(number) for number in numbers if len(number) == 12 and number.isdecimal()), default=-1)
    return directory / f"step-{max(step, last + 1):012d}"


def load_checkpoint(directory: Path, name: str) -> Checkpoint | None:
    """The newest whole checkpoint of one of a run's agents, or none where there is none at all.

    A damaged one is passed over for the one before, and said so on the log.

    Args:
        directory: A directory of checkpoints.
        name: Which of the run's agents.

    Raises:
        InputError: When there are checkpoints of that agent and none is whole, or what they hold is no agent.
    """
    faults: list[str] = []
    for path in _newest_first(directory):
        if not _may_be_of(path, name):
            continue
        fault = _fault(path)
        if not fault:
            if faults:
                log.warning("passed over damaged checkpoints, going back to %s: %s", path.name, faults[0])
            return _load(path)
        faults.append(fault)
    if faults:
        raise InputError(f"{str(directory)!r} holds no whole checkpoint of {name!r}: {faults[0]}")
    return None


def _load(path: Path) -> Checkpoint:
    manifest = _manifest(path)
    try:
        agent = _agent_class(manifest["kind"]).load(path)
        training, worlds, visits, validation = (
            read_state(path, part) if f"{part}.json" in manifest["parts"] else None
            for part in ("training", "worlds", "visits", "validation")
        )
        standing = Standing(**manifest["standing"])
        return Checkpoint(agent, standing, training, worlds, visits.arrays["visits"] if visits else None, validation)
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        reason = " ".join(str(error).split())  # torch's have many lines
        raise InputError(f"checkpoint {str(path)!r} cannot be used: {reason:.150}") from error


def load_agent(directory: Path, name: str) -> Agent:
    """An agent of a run, from its newest whole checkpoint.

    Raises:
        InputError: When there is none; see ``load_checkpoint``.
    """
    checkpoint = load_checkpoint(directory, name)
    if checkpoint is None:
        raise InputError(f"{str(directory)!r} holds no checkpoint of {name!r}")
    return checkpoint.agent


def last_standing(directory: Path) -> Standing:
    """Where a run stood in its newest whole checkpoint, of whichever agent; at its beginning without any.

    Raises:
        InputError: When there are checkpoints and none is whole.
    """
    faults = []
    for path in _newest_first(directory):
        fault = _fault(path)
        if not fault:
            return Standing(**_manifest(path)["standing"])
        faults.append(fault)
    if faults:
        raise InputError(f"{str(directory)!r} holds no whole checkpoint: {faults[0]}")
    return Standing()


def clear_leftovers(directory: Path) -> None:
    """Remove what a killed run was writing aside; only for the run's owner."""
    for left in directory.glob(".tmp-*"):
        shutil.rmtree(left, ignore_errors=True)


def _newest_first(directory: Path) -> list[Path]:
    return sorted(directory.glob("step-*"), reverse=True)


def _whole(directory: Path, name: str) -> list[Path]:
    """Whole checkpoints of one agent, newest first."""
    return [path for path in _newest_first(directory) if _may_be_of(path, name) and not _fault(path)]


def _may_be_of(checkpoint: Path, name: str) -> bool:
    """Whether it is one of that agent's, or so damaged that one cannot tell."""
    try:
        return bool(_manifest(checkpoint)["name"] == name)
    except (OSError, ValueError, KeyError):
        return True


def _manifest(checkpoint: Path) -> dict[str, Any]:
    return read_object(checkpoint / MANIFEST)


def _agent_class(kind: str) -> type[Agent]:
    if kind == "ppo":
        from gridnav.agents import PPOAgent  # torch takes seconds to import

        return PPOAgent
    if kind == "residual":
        from gridnav.agents import ResidualAgent

        return ResidualAgent
    if kind == "dqn":
        from gridnav.agents import DQNAgent

        return DQNAgent
    for known in (Planner, QLearning):
        if known.kind == kind:
            return known
    raise InputError(f"the checkpoint holds an agent of the unknown kind {kind!r:.60}")


def _fault(checkpoint: Path) -> str:
    """Why a checkpoint is not whole, in words; empty if it is."""
    try:
        manifest = _manifest(checkpoint)
        parts: dict[str, dict[str, object]] = manifest["parts"]
        if manifest["format"] != FORMAT:
            return f"{checkpoint.name} has format {manifest['format']!r:.20}, not {FORMAT}"
        if not isinstance(manifest["name"], str) or not isinstance(manifest["kind"], str):
            return f"{checkpoint.name}/{MANIFEST} is damaged"
        if not {"agent.safetensors", "agent.json"} <= parts.keys():
            return f"{checkpoint.name}/{MANIFEST} names no agent"
        Standing(**manifest["standing"])
        if (checkpoint / MANIFEST).is_symlink() or any(_partner(part) not in parts for part in parts):
            return f"{checkpoint.name}/{MANIFEST} is damaged"
        for part, expected in parts.items():
            # Names come from a file: only plain ones inside the checkpoint are looked at.
            if part != Path(part).name or (checkpoint / part).is_symlink():
                return f"{checkpoint.name}/{MANIFEST} names {part!r:.60}, which is no file of its own"
            if not (checkpoint / part).is_file():
                return f"{checkpoint.name}/{part} is missing"
            if (checkpoint / part).stat().st_size > LARGEST or _digest(checkpoint / part) != expected:
                return f"{checkpoint.name}/{part} is damaged: its SHA-256 is not that of {MANIFEST}"
        return ""
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return f"{checkpoint.name}/{MANIFEST} is missing or damaged"


def _partner(part: str) -> str:
    """Each part is a pair of files."""
    stem, _, suffix = part.rpartition(".")
    return f"{stem}.{ {'json': 'safetensors', 'safetensors': 'json'}.get(suffix, '') }"


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
