"""Which episodes of which runs are looked at, and the recording or film of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gridnav.display.recording import write_overlay, write_recording
from gridnav.experiment.rollouts import Rollouts, load_rollouts, names
from gridnav.experiment.run_directory import RunDirectory
from gridnav.experiment.worlds import UNITS
from gridnav.problem.types import Cell, InputError

SIDE_BY_SIDE = 4
"""More mazes than these are too small to see anything."""


@dataclass(frozen=True)
class Pick:
    """Which episode, by number or by outcome; at most one of them is given."""

    episode: int | None = None
    """Number, from 0."""
    worst: bool = False
    """The one with the lowest return."""
    failed: bool = False
    """The first that did not reach its goal."""

    def __post_init__(self) -> None:
        if (self.episode is not None) + self.worst + self.failed > 1:
            raise InputError("--episode, --worst and --failed exclude each other: give one of them")

    @property
    def is_given(self) -> bool:
        """Something was asked for."""
        return self.episode is not None or self.worst or self.failed

    def number(self, rollouts: Rollouts) -> int:
        """The episode's number; the first one where nothing was asked for.

        Raises:
            InputError: When there is no such episode.
        """
        episodes = rollouts.episodes
        if self.worst:
            return int(np.argmin([one.episode_return for one in episodes]))
        if self.failed:
            missed = [number for number, one in enumerate(episodes) if not one.is_success]
            if not missed:
                raise InputError(f"all {len(episodes)} episodes of {rollouts.name} arrived: look at --worst")
            return missed[0]
        number = self.episode or 0
        if not 0 <= number < len(episodes):
            raise InputError(f"--episode {number}: {rollouts.name} has episodes 0 to {len(episodes) - 1}")
        return number


def find_rollouts(runs: Sequence[RunDirectory], wanted: Sequence[str]) -> dict[str, Rollouts]:
    """Rollouts by what they are called on the screen: those of these names, else the last of each run's evaluation.

    Raises:
        InputError: When a run has none, or none of a name.
    """
    found: dict[str, Rollouts] = {}
    known: set[str] = set()
    for run in runs:
        there = names(run.rollouts)
        if not there:
            load_rollouts(run.rollouts, "any")  # says that there are none
        here = [name for name in wanted if name in there] if wanted else [run.last_rollouts(there)]
        if not here:
            raise InputError(f"{str(run.path)!r} has no rollouts of {wanted[0]!r}: there are {', '.join(there)}")
        known.update(there)
        for name in here:
            one = load_rollouts(run.rollouts, name)
            label = f"{one.agent} on {one.world}" if len(runs) == 1 else f"{run.path}: {name}"
            found[label if label not in found else f"{label} ({name})"] = one
    for name in wanted:
        if name not in known:
            raise InputError(f"no run has rollouts of {name!r}: there are {', '.join(sorted(known))}")
    if len(found) > SIDE_BY_SIDE:
        raise InputError(f"{len(found)} rollouts do not fit side by side: at most {SIDE_BY_SIDE}, see --rollouts")
    return found


def record_episode(path: Path, found: dict[str, Rollouts], pick: Pick) -> None:
    """Write the same episode of each as a recording; the first decides which one it is.

    Raises:
        InputError: When they were asked different episodes.
    """
    first = next(iter(found.values()))
    number = pick.number(first)
    layout, ends = first.layout_of(number), _ends(first, number)
    for label, other in found.items():
        if len(other.episodes) <= number or other.layout_of(number) != layout or _ends(other, number) != ends:
            raise InputError(f"episode {number} of {label} has another maze, start or goal: they cannot be compared")
    rollouts = {label: one.episodes[number] for label, one in found.items()}
    goal = first.episodes[number].goal
    maps = {label: one.maps[goal] for label, one in found.items() if goal in one.maps}
    write_recording(path, layout, rollouts, maps=maps, title=f"Episode {number}", units=UNITS)


def _ends(rollouts: Rollouts, number: int) -> tuple[Cell, Cell]:
    episode = rollouts.episodes[number]
    return episode.start, episode.goal


def record_overlay(path: Path, found: dict[str, Rollouts]) -> None:
    """Write all episodes of one set of rollouts as a recording, one above the other.

    Raises:
        InputError: When there are several sets, or several mazes.
    """
    if len(found) > 1:
        raise InputError(f"--overlay is of one set of episodes, not of {len(found)}: choose one with --rollouts")
    ((label, rollouts),) = found.items()
    if len(rollouts.layouts) > 1:
        raise InputError(f"the episodes of {label} are in {len(rollouts.layouts)} mazes: --overlay needs one")
    write_overlay(path, rollouts.layout_of(0), rollouts.episodes, title=label)
