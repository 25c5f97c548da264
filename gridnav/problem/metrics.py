"""Episode records and what is computed from them: success, SPL, SCT, collisions, intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field

import numpy as np
from scipy import stats

from gridnav.problem.types import Cell, FloatArray, IntArray


@dataclass(frozen=True)
class Trace:
    """What happened in one episode, step by step: ``t + 1`` states and the ``t`` steps between them."""

    time_s: FloatArray
    """Time of each state, shape ``(t + 1,)``, 0 at the start."""
    poses: FloatArray
    """x and y in metres and heading in radians, world frame, shape ``(t + 1, 3)``."""
    scans_m: FloatArray
    """Lidar ranges, shape ``(t + 1, n_beams)``; beam 0 points ahead, counter-clockwise."""
    actions: FloatArray
    """Forward and turning command as fractions of the maxima, shape ``(t, 2)``; on the grid the move, ``(t, 1)``."""
    reward_terms: dict[str, FloatArray]
    """Each term's share of the reward of each step, shape ``(t,)``."""
    hits: IntArray
    """1 where the step had a collision, shape ``(t,)``."""


@dataclass(frozen=True)
class Episode:
    """One evaluated episode."""

    start: Cell
    """Start cell (row, column)."""
    goal: Cell
    """Goal cell (row, column)."""
    is_success: bool
    """The goal was reached."""
    collisions: int
    """Steps with a collision."""
    path_length_m: float
    """Length of the way taken, metres."""
    shortest_path_m: float
    """Length of the shortest way in that world, metres."""
    elapsed_s: float
    """Duration, seconds."""
    shortest_time_s: float
    """Time for the shortest way at full speed, turns not counted, seconds."""
    steps: int
    """Environment steps."""
    episode_return: float
    """Undiscounted sum of rewards."""
    physics_error: bool = False
    """The physics diverged and ended the episode."""
    trace: Trace | None = field(default=None, repr=False, compare=False)
    """The whole course, where it was recorded."""

    def row(self) -> dict[str, object]:
        """The record without its trace, fit for JSON."""
        row = asdict(self)
        del row["trace"]
        return row


@dataclass(frozen=True)
class Summary:
    """Metrics of a set of episodes; see Anderson et al. 2018 (SPL), Yokoyama et al. 2021 (SCT)."""

    episodes: int
    """How many episodes."""
    success_rate: float
    """Share of episodes that reached the goal."""
    success_interval: tuple[float, float]
    """95 % Wilson interval of the success rate."""
    spl: float
    """Success weighted by path length: mean of success * shortest / max(taken, shortest)."""
    sct: float
    """Success weighted by completion time: the same with times."""
    collision_rate: float
    """Share of episodes with a collision."""
    collisions_per_metre: float
    """Collisions over all metres driven."""
    time_to_goal_s: float | None
    """Median over the successes, seconds; none without a success."""
    mean_return: float
    """Mean undiscounted return."""
    physics_errors: int
    """Episodes that ended by diverged physics."""


def success_weighted(successes: Sequence[bool], best: FloatArray, taken: FloatArray) -> float:
    """Mean of ``S * best / max(taken, best)``: SPL with lengths, SCT with times (Anderson et al. 2018).

    Args:
        successes: Whether each episode arrived, ``n`` of them.
        best: Shortest length or time, shape ``(n,)``; an episode that starts at its goal counts as 1.
        taken: Length or time taken, shape ``(n,)``.
    """
    ratio = np.divide(best, np.maximum(taken, best), out=np.ones(len(best)), where=np.maximum(taken, best) > 0)
    return float(np.mean(np.asarray(successes) * ratio))


def wilson_interval(successes: int, n: int) -> tuple[float, float]:
    """95 % Wilson score interval of a share, within [0, 1]."""
    interval = stats.binomtest(successes, n).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


def summarise(episodes: Sequence[Episode]) -> Summary:
    """All metrics of at least one episode."""
    successes = [episode.is_success for episode in episodes]
    lengths = np.array([episode.path_length_m for episode in episodes])
    times = np.array([episode.elapsed_s for episode in episodes])
    collisions = np.array([episode.collisions for episode in episodes])
    driven = float(lengths.sum())
    return Summary(
        episodes=len(episodes),
        success_rate=float(np.mean(successes)),
        success_interval=wilson_interval(sum(successes), len(episodes)),
        spl=success_weighted(successes, np.array([e.shortest_path_m for e in episodes]), lengths),
        sct=success_weighted(successes, np.array([e.shortest_time_s for e in episodes]), times),
        collision_rate=float(np.mean(collisions > 0)),
        collisions_per_metre=float(collisions.sum() / driven) if driven > 0 else 0.0,
        time_to_goal_s=float(np.median(times[successes])) if any(successes) else None,
        mean_return=float(np.mean([e.episode_return for e in episodes])),
        physics_errors=sum(e.physics_error for e in episodes),
    )
