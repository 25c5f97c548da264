"""Episodes with their traces as files: what an evaluation or a person's drive leaves for the viewer and the video.

A set of rollouts is a pair of files, ``NAME.safetensors`` with the states and steps of all episodes end to end, and
``NAME.json`` with one row per episode and the layouts as text.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gridnav.agents import read_state, write_state
from gridnav.display.policy_map import PolicyMap
from gridnav.problem.layout import Layout
from gridnav.problem.metrics import Episode, Motion, Trace
from gridnav.problem.types import AnyArray, Cell, InputError, State

FORMAT = 1
RAGGED = {"poses": np.float64, "scans_m": np.float16, "actions": np.float32, "hits": np.int8}
"""Arrays of a trace and the precision they are kept in; that of the scans is 2 mm at the lidar's longest range."""
MAPS = ("values", "directions_rad", "speeds")


@dataclass(frozen=True)
class Rollouts:
    """Episodes of one policy in one world."""

    name: str
    """Name of the evaluation's row, or of the drive."""
    world: str
    """``GridWorld``, ``Unicycle`` or ``DiffDrive``."""
    agent: str
    """Who acted, in words."""
    layouts: dict[str, Layout]
    """Layouts by name."""
    episodes: Sequence[Episode]
    """Each with its trace."""
    maps: Mapping[Cell, PolicyMap] = field(default_factory=dict)
    """What the agent makes of the maze, by goal, where that is known."""

    def layout_of(self, number: int) -> Layout:
        """The layout of an episode."""
        return self.layouts[self.episodes[number].layout]


def save_rollouts(directory: Path, rollouts: Rollouts) -> None:
    """Write ``NAME.safetensors`` and ``NAME.json`` into a directory, which is made if it does not exist."""
    traces = [episode.trace for episode in rollouts.episodes if episode.trace is not None]
    if not traces or len(traces) < len(rollouts.episodes):
        raise ValueError(f"{rollouts.name} has {len(rollouts.episodes)} episodes and {len(traces)} traces")
    arrays: dict[str, AnyArray] = {
        name: np.concatenate([getattr(trace, name) for trace in traces]).astype(kept) for name, kept in RAGGED.items()
    }
    for term in traces[0].reward_terms:
        arrays[f"reward/{term}"] = np.concatenate([trace.reward_terms[term] for trace in traces]).astype(np.float32)
    if rollouts.maps:
        for part in MAPS:
            arrays[f"maps/{part}"] = np.stack([getattr(one, part) for one in rollouts.maps.values()]).astype(np.float32)
    arrays["steps"] = np.array([len(trace.actions) for trace in traces])
    values = {
        "format": FORMAT,
        "world": rollouts.world,
        "agent": rollouts.agent,
        "step_s": [float(trace.time_s[1]) for trace in traces],
        "layouts": {
            name: {"text": layout.to_text(), "cell_size_m": layout.cell_size_m}
            for name, layout in rollouts.layouts.items()
        },
        "map_goals": list(rollouts.maps),
        "rows": [episode.row() for episode in rollouts.episodes],
    }
    directory.mkdir(parents=True, exist_ok=True)
    write_state(State(arrays, values), directory, rollouts.name)


def load_rollouts(directory: Path, name: str) -> Rollouts:
    """Read what ``save_rollouts`` wrote; nothing in the files is run.

    Raises:
        InputError: When there are none of that name, or the files are damaged.
    """
    try:
        arrays, values = read_state(directory, name)
        if values["format"] != FORMAT:
            raise ValueError(f"its format is {values['format']!r:.20}, not {FORMAT}")
        layouts = {
            key: Layout.from_text(one["text"], cell_size_m=one["cell_size_m"], name=key)
            for key, one in values["layouts"].items()
        }
        traces = _traces(arrays, values["step_s"])
        episodes = [_episode(row, trace) for row, trace in zip(values["rows"], traces, strict=True)]
        if not episodes or any(episode.layout not in layouts for episode in episodes):
            raise ValueError("it holds no episode, or one in an unknown layout")
        goals = [_cell(pair) for pair in values["map_goals"]]
        maps = {goal: PolicyMap(*(arrays[f"maps/{part}"][i] for part in MAPS)) for i, goal in enumerate(goals)}
        shape = layouts[episodes[0].layout].walls.shape
        if any(getattr(one, part).shape != shape for one in maps.values() for part in MAPS):
            raise ValueError("its maps have the wrong shape")
        for episode in episodes:
            _check(episode, layouts[episode.layout])
        return Rollouts(name, str(values["world"]), str(values["agent"]), layouts, episodes, maps)
    except FileNotFoundError:
        raise InputError(f"{str(directory)!r} holds no rollouts of {name!r}: {_there(directory)}") from None
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"rollouts {str(directory / name)!r} are damaged: {reason:.120}") from None


def names(directory: Path) -> list[str]:
    """Names of the rollouts in a directory, sorted."""
    return sorted(path.stem for path in directory.glob("*.safetensors"))


def _there(directory: Path) -> str:
    found = names(directory)
    return f"there are {', '.join(found)}" if found else "the run has not finished, or was made by an older gridnav"


def _traces(arrays: Mapping[str, AnyArray], step_s: Sequence[float]) -> list[Trace]:
    steps = arrays["steps"].astype(np.int64)
    most = len(arrays["actions"])
    if steps.ndim != 1 or len(steps) != len(step_s) or (steps < 1).any() or (steps > most).any():
        raise ValueError("the lengths of its episodes are not what they should be")
    if not all(isinstance(period, int | float) and 1e-3 <= period <= 1e3 for period in step_s):
        raise ValueError("the lengths of its steps must be from 0.001 to 1000 seconds")
    ends = np.cumsum(steps)[:-1]  # of the steps; each episode has one state more
    n_states = np.cumsum(steps + 1)
    terms = {key.removeprefix("reward/"): arrays[key] for key in arrays if key.startswith("reward/")}
    of_steps = {"actions": arrays["actions"], "hits": arrays["hits"], **terms}
    of_states = {"poses": arrays["poses"], "scans_m": arrays["scans_m"]}
    if any(len(array) != steps.sum() for array in of_steps.values()) or any(
        len(array) != n_states[-1] for array in of_states.values()
    ):
        raise ValueError("its arrays are not as long as its episodes")
    shapes = [array.ndim == 2 for array in (arrays["poses"], arrays["scans_m"], arrays["actions"])]
    flat = [array.ndim == 1 for array in (arrays["hits"], *terms.values())]
    if not all(shapes + flat) or arrays["poses"].shape[1] != 3 or arrays["actions"].shape[1] not in (1, 2):
        raise ValueError("its arrays have the wrong shape")
    if not all(np.isfinite(array).all() for array in (arrays["poses"], arrays["actions"], *terms.values())):
        raise ValueError("its poses, actions and rewards must be finite numbers")
    parts = {key: np.split(array, ends) for key, array in of_steps.items()}
    poses, scans = (np.split(array, n_states[:-1]) for array in of_states.values())
    return [
        Trace(
            time_s=np.arange(steps[i] + 1) * float(step_s[i]),
            poses=poses[i],
            scans_m=scans[i].astype(np.float64),
            actions=parts["actions"][i].astype(np.float64),
            reward_terms={term: parts[term][i].astype(np.float64) for term in terms},
            hits=parts["hits"][i].astype(np.int64),
        )
        for i in range(len(steps))
    ]


def _episode(row: dict[str, Any], trace: Trace) -> Episode:
    start, goal = (_cell(row[key]) for key in ("start", "goal"))
    motion = None if row["motion"] is None else Motion(**row["motion"])
    return Episode(**{**row, "start": start, "goal": goal, "motion": motion}, trace=trace)


def _check(episode: Episode, layout: Layout) -> None:
    """What pictures rely on: ends on free cells, a robot in the maze, numbers where numbers are."""
    for row, column in (episode.start, episode.goal):
        if not (0 <= row < layout.n_rows and 0 <= column < layout.n_cols) or layout.walls[row, column]:
            raise ValueError(f"cell {(row, column)} is no free cell of its layout")
    assert episode.trace is not None
    places = episode.trace.poses[:, :2]
    if (places < 0).any() or (places > layout.size_m).any():
        raise ValueError("its robot leaves the maze")
    numbers = ("episode_return", "path_length_m", "shortest_path_m", "elapsed_s", "collisions", "shortest_time_s")
    if not all(isinstance(getattr(episode, name), int | float) for name in numbers):
        raise ValueError("its rows hold words where numbers should be")
    if not all(type(value) in (int, float) for value in episode.randomization.values()):
        raise ValueError("what was drawn for an episode must be numbers")


def _cell(pair: Sequence[int]) -> Cell:
    row, column = pair
    return int(row), int(column)
