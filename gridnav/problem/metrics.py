"""Episode records and what is computed from them: success, SPL, SCT, collisions, times, smoothness.

Formulas, units, sources and denominators are in ``docs/evaluation.md``; intervals and averages in ``statistics.py``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from gridnav.problem.geodesic import clearances
from gridnav.problem.layout import Layout
from gridnav.problem.robot import Robot
from gridnav.problem.statistics import cvar, kaplan_meier_median, mean, stratified_bootstrap, wilson_interval
from gridnav.problem.types import Cell, FloatArray, IntArray

STILL_SHARE = 0.05
"""A robot below this share of its top speed stands still: 1 cm/s for a Burger."""
WORST = 0.1
"""Share of the layouts that the CVaR looks at."""
DRAWS = 2_000
"""Resamplings of the episodes for the intervals of a summary; its seed is fixed, so they are the same every time."""


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

    @property
    def is_on_grid(self) -> bool:
        """The steps are moves between cells, not commands of a robot."""
        return self.actions.shape[1] == 1


@dataclass(frozen=True)
class Motion:
    """How a robot moved in one episode, for safety and smoothness."""

    clearance_m: float | None
    """Smallest gap between bumper and wall, metres; a cell less the radius where none came nearer; none on the grid."""
    turned_rad: float
    """Sum of all changes of heading, radians."""
    jerk_m_s3: float | None
    """Root mean square of the jerk, the third difference of the position, m/s^3; none on the grid."""
    action_change: float
    """Mean squared difference between successive actions; on the grid, share of moves unlike the one before."""
    still_share: float
    """Share of the time in which the position changed by less than ``STILL_SHARE`` of full speed."""


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
    """Length of the shortest way to the goal's centre in that world, metres."""
    elapsed_s: float
    """Duration, seconds."""
    shortest_time_s: float
    """Time of the shortest way to where the goal counts as reached, turns included, seconds; see ``driving_time``."""
    steps: int
    """Environment steps."""
    episode_return: float
    """Undiscounted sum of rewards."""
    physics_error: bool = False
    """The physics diverged and ended the episode."""
    trace: Trace | None = field(default=None, repr=False, compare=False)
    """The whole course, where it was recorded."""
    goal_radius_m: float = 0.0
    """How far from the goal's centre it counts as reached, metres; 0 on the grid."""
    motion: Motion | None = None
    """How the robot moved, where a trace was recorded."""
    behaviours: dict[str, float] = field(default_factory=dict)
    """Share of the time spent in each behaviour of ``gridnav.problem.behaviour``, 0 for what did not last."""
    layout: str = ""
    """Name of the layout."""
    randomization: dict[str, float] = field(default_factory=dict)
    """What was drawn for the episode, by quantity, where something varied."""

    @property
    def needed_path_m(self) -> float:
        """Length of the shortest way to where the goal counts as reached, metres."""
        return max(self.shortest_path_m - self.goal_radius_m, 0.0)

    @property
    def length_ratio(self) -> float:
        """The episode's part in the SPL."""
        return float(
            success_ratios([self.is_success], np.array([self.needed_path_m]), np.array([self.path_length_m]))[0]
        )

    @property
    def time_ratio(self) -> float:
        """The episode's part in the SCT."""
        return float(success_ratios([self.is_success], np.array([self.shortest_time_s]), np.array([self.elapsed_s]))[0])

    def row(self) -> dict[str, object]:
        """The record without its trace, fit for JSON."""
        row = asdict(replace(self, trace=None))
        del row["trace"]
        return row


@dataclass(frozen=True)
class Summary:
    """Metrics of episodes in one world; means are over episodes. ``docs/evaluation.md`` has the formulas."""

    episodes: int
    """How many episodes."""
    success_rate: float
    """Share of episodes that reached the goal."""
    success_interval: tuple[float, float]
    """95 % Wilson interval of the success rate."""
    spl: float
    """Success weighted by path length: mean of success * shortest / max(taken, shortest) (Anderson et al. 2018)."""
    spl_interval: tuple[float, float]
    """95 % bootstrap interval of the SPL over episodes."""
    sct: float
    """Success weighted by completion time: the same with times (Yokoyama et al. 2021)."""
    sct_interval: tuple[float, float]
    """95 % bootstrap interval of the SCT over episodes."""
    collision_rate: float
    """Share of episodes with a collision."""
    collisions_per_metre: float
    """Collisions over all metres driven."""
    time_to_goal_s: float | None
    """Median over the successes, seconds; none without a success."""
    median_time_s: float | None
    """Kaplan-Meier median over all episodes, seconds: when half have arrived; none where fewer do."""
    mean_return: float
    """Mean undiscounted return."""
    physics_errors: int
    """Episodes that ended by diverged physics."""
    clearance_m: float | None
    """Median of the smallest clearances, metres; none on the grid, as all that follows without traces."""
    turn_per_metre_rad: float | None
    """Turning over all metres driven, radians per metre; none where nothing moved."""
    jerk_m_s3: float | None
    """Mean of the RMS jerks, m/s^3; none on the grid."""
    action_change: float | None
    """Mean of the mean squared changes of action."""
    still_share: float | None
    """Mean share of the time in which the robot did not drive."""
    layouts: int
    """Layouts that the episodes were in."""
    success_cvar: float
    """Success in the worst tenth of the layouts (CVaR); with one layout, in that."""
    behaviours: dict[str, float]
    """Share of episodes that show each behaviour."""


def success_ratios(successes: Sequence[bool], best: FloatArray, taken: FloatArray) -> FloatArray:
    """``S * best / max(taken, best)`` of each episode: SPL with lengths, SCT with times (Anderson et al. 2018).

    Args:
        successes: Whether each episode arrived, ``n`` of them.
        best: Shortest length or time, shape ``(n,)``; an episode that starts at its goal counts as 1.
        taken: Length or time taken, shape ``(n,)``.

    Returns:
        Shape ``(n,)``, in [0, 1].
    """
    longer = np.maximum(taken, best)
    ratios: FloatArray = np.divide(best, longer, out=np.ones(len(best)), where=longer > 0)
    return np.asarray(successes) * ratios


def success_weighted(successes: Sequence[bool], best: FloatArray, taken: FloatArray) -> float:
    """Mean of ``success_ratios``."""
    return float(np.mean(success_ratios(successes, best, taken)))


def driving_time(path_w: FloatArray, heading_rad: float, robot: Robot, goal_radius_m: float) -> float:
    """Shortest time for a way: straight legs at full speed, turns in place at full turning speed.

    Turning while driving gains nothing: with each wheel's speed bounded, ``|v|/v_max + |w|/w_max <= 1`` at all times,
    so a way of length L that turns by A takes at least ``L/v_max + A/w_max`` (Balkcom and Mason 2002, IJRR 21:199-217:
    the fastest drives are straight legs and turns in place). Robots drive as fast backwards, so no turn is more than
    a right angle. It is a bound for this way: a longer one with fewer turns may be a little faster, which is why SCT
    never counts an episode above 1.

    Args:
        path_w: Points of the way to the goal's centre, metres, world frame, shape ``(n, 2)``.
        heading_rad: Heading at the start, world frame.
        robot: Gives both maxima.
        goal_radius_m: The last stretch of this length need not be driven.

    Returns:
        Seconds.
    """
    legs = np.diff(path_w, axis=0)
    lengths = np.hypot(legs[:, 0], legs[:, 1])
    needed = max(float(lengths.sum()) - goal_radius_m, 0.0)
    driven = legs[np.cumsum(lengths) - lengths < needed]  # legs that begin before the goal counts as reached
    turns = np.abs(_wrapped(np.diff(np.arctan2(driven[:, 1], driven[:, 0]), prepend=heading_rad)))
    turned = float(np.minimum(turns, np.pi - turns).sum())
    return needed / robot.max_speed_m_s + turned / robot.max_turn_rad_s


def heading_changes(trace: Trace) -> FloatArray:
    """Turn of each step, radians in [-pi, pi), counter-clockwise positive, shape ``(t,)``."""
    return _wrapped(np.diff(trace.poses[:, 2]))


def measure_motion(trace: Trace, layout: Layout, robot: Robot) -> Motion:
    """How a robot moved in an episode of at least one step."""
    positions, step_s = trace.poses[:, :2], float(trace.time_s[1] - trace.time_s[0])
    moves, jerks = np.diff(positions, axis=0), np.diff(positions, n=3, axis=0) / step_s**3
    on_grid = trace.is_on_grid
    # Moves are names, not quantities. Commands beyond the maxima mean the maxima.
    changes = np.diff(trace.actions, axis=0) != 0 if on_grid else np.diff(np.clip(trace.actions, -1.0, 1.0), axis=0)
    gap_m = None if on_grid else max(float(clearances(positions, layout)[0].min()) - robot.radius_m, 0.0)
    return Motion(
        clearance_m=gap_m,
        turned_rad=float(np.abs(heading_changes(trace)).sum()),
        jerk_m_s3=None if on_grid else float(np.sqrt((jerks**2).sum() / max(len(jerks), 1))),
        action_change=float((changes.astype(np.float64) ** 2).sum() / max(len(changes), 1)),
        still_share=float(np.mean(np.hypot(*moves.T) < STILL_SHARE * robot.max_speed_m_s * step_s)),
    )


def by_layout(episodes: Sequence[Episode]) -> dict[str, list[Episode]]:
    """The episodes of each layout, by its name."""
    parts: dict[str, list[Episode]] = {}
    for episode in episodes:
        parts.setdefault(episode.layout, []).append(episode)
    return parts


def summarise(episodes: Sequence[Episode]) -> Summary:
    """All metrics of at least one episode."""
    successes = [episode.is_success for episode in episodes]
    lengths = np.array([episode.path_length_m for episode in episodes])
    times = np.array([episode.elapsed_s for episode in episodes])
    collisions = np.array([episode.collisions for episode in episodes])
    driven = float(lengths.sum())
    length_ratios = success_ratios(successes, np.array([e.needed_path_m for e in episodes]), lengths)
    time_ratios = success_ratios(successes, np.array([e.shortest_time_s for e in episodes]), times)
    motions = [e.motion for e in episodes if e.motion]
    measured = float(sum(e.path_length_m for e in episodes if e.motion))
    turned = sum(m.turned_rad for m in motions)
    clearance = [m.clearance_m for m in motions if m.clearance_m is not None]
    layouts = by_layout(episodes)
    names = dict.fromkeys(name for e in episodes for name in e.behaviours)
    return Summary(
        episodes=len(episodes),
        success_rate=float(np.mean(successes)),
        success_interval=wilson_interval(sum(successes), len(episodes)),
        spl=float(length_ratios.mean()),
        spl_interval=_interval(length_ratios),
        sct=float(time_ratios.mean()),
        sct_interval=_interval(time_ratios),
        collision_rate=float(np.mean(collisions > 0)),
        collisions_per_metre=float(collisions.sum() / driven) if driven > 0 else 0.0,
        time_to_goal_s=float(np.median(times[successes])) if any(successes) else None,
        # What a collision or diverged physics ended will not arrive later: as time-outs, to the end of the longest.
        median_time_s=kaplan_meier_median(np.where(successes, times, times.max()), successes),
        mean_return=float(np.mean([e.episode_return for e in episodes])),
        physics_errors=sum(e.physics_error for e in episodes),
        clearance_m=float(np.median(clearance)) if clearance else None,
        turn_per_metre_rad=turned / measured if measured > 0 else None,
        jerk_m_s3=_mean_known(m.jerk_m_s3 for m in motions),
        action_change=_mean_known(m.action_change for m in motions),
        still_share=_mean_known(m.still_share for m in motions),
        layouts=len(layouts),
        success_cvar=cvar([np.mean([e.is_success for e in one]) for one in layouts.values()], WORST),
        behaviours={name: float(np.mean([e.behaviours.get(name, 0.0) > 0 for e in episodes])) for name in names},
    )


def _interval(ratios: FloatArray) -> tuple[float, float]:
    """Of a mean over episodes: they are runs of one task."""
    return stratified_bootstrap([ratios], rng=np.random.default_rng(0), statistic=mean, draws=DRAWS)


def _mean_known(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _wrapped(angles: FloatArray) -> FloatArray:
    """The same angles in [-pi, pi)."""
    return (angles + np.pi) % (2.0 * np.pi) - np.pi
