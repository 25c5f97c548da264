"""The figures of a run: how it learnt, where it went, what it makes of the maze."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from gridnav.display.figures import (
    episode_strip,
    learning_curves,
    reward_terms,
    save_figure,
    success_bars,
    trajectories,
    value_map,
    visit_counts,
)
from gridnav.display.report import Picture
from gridnav.experiment.policy_maps import N_HEADINGS, policy_maps
from gridnav.experiment.run_directory import MetricsLog, RunDirectory
from gridnav.experiment.training import Result, Trained
from gridnav.experiment.worlds import Problem

DRAWN_EPISODES = 40
"""Ways drawn per panel: more would hide each other and swell the page."""


def pictures(
    run: RunDirectory,
    problem: Problem,
    results: Sequence[Result],
    trained: Sequence[Trained],
    curves: Mapping[str, str],
    log: MetricsLog,
) -> list[Picture]:
    """The figures of a run, each also as a PNG and an SVG file.

    Args:
        run: Where the files go.
        problem: Gives the maze.
        results: One panel of trajectories and one row of intervals each; an episode of the last is told in steps.
        trained: Agents whose values, moves and visits are drawn.
        curves: Series of the metrics to draw the success rate of, with their labels.
        log: The metrics.
    """
    shown = dict(_drawn(problem, results, trained, curves, log))
    for name, picture in shown.items():
        for ending in (".png", ".svg"):
            save_figure(picture.figure, run.figures / f"{name}{ending}")
    return list(shown.values())


def _drawn(
    problem: Problem,
    results: Sequence[Result],
    trained: Sequence[Trained],
    curves: Mapping[str, str],
    log: MetricsLog,
) -> Iterator[tuple[str, Picture]]:
    layout = problem.layout
    series = {label: log.curve(name, "success_rate") for name, label in curves.items()}
    series = {label: curve for label, curve in series.items() if len(curve[0]) > 1}
    if series:
        figure = learning_curves({label: (np.array(x), np.array(y)) for label, (x, y) in series.items()}, window=3)
        words = "Success rate over the last 400 training episodes, exploration included, against environment steps."
        yield "learning", Picture(figure, words)
    if len(results) > 1:
        rows = {r.name: (r.summary.success_rate, *r.summary.success_interval) for r in results}
        yield "success", Picture(success_bars(rows), "Success in evaluation, with 95 % Wilson intervals.")
    here = {
        f"{result.agent} on {result.world}": [e for e in result.episodes if e.layout == layout.name]
        for result in results
    }
    drawn = {name: episodes[:DRAWN_EPISODES] for name, episodes in here.items()}
    n_drawn = max(len(episodes) for episodes in drawn.values())
    words = f"The ways of the first {n_drawn} evaluation episodes on {layout.name}, the same "
    yield "trajectories", Picture(trajectories(layout, drawn), words + "starts and goals in every panel.")
    for one in trained:
        suffix = f"-{one.name}" if len(trained) > 1 else ""
        yield f"values{suffix}", _values(problem, one)
        if one.visits is not None and one.visits.any():
            words = f"Where {one.name} was in training, looked at each time it could have been cut."
            yield f"visits{suffix}", Picture(visit_counts(layout, one.visits), words)
    told, candidates = results[-1], list(here.values())[-1]
    episode = next((one for one in candidates if one.is_success), candidates[0])
    words = f"One evaluation episode of {told.agent} on {told.world}, step by step."
    yield "episode", Picture(episode_strip(layout, episode), words)
    yield "reward", Picture(reward_terms(episode), "What each term of the reward came to in that episode.")


def _values(problem: Problem, trained: Trained) -> Picture:
    """What an agent makes of the maze, for the last goal of the task."""
    cell = problem.task.goal_cells(problem.layout)[-1]
    goal = (int(cell[0]), int(cell[1]))
    shown = policy_maps(problem, trained.agent, trained.world, [goal], observation=trained.observation)[goal]
    if trained.world == "GridWorld":
        label, arrows = "value (expected discounted reward)", "best move"
        words = f"Values and preferred moves of {trained.name} for the goal at cell {goal}, the shaping taken out."
    else:
        label, arrows = "value (discounted reward)", "where it drives from its best heading"
        words = (
            f"What {trained.name}'s value network expects in each cell at rest, mean of {N_HEADINGS} headings, for the "
            f"goal at cell {goal}, and the way its command takes it in a second."
        )
    figure = value_map(
        problem.layout, shown.values, goal,
        directions_rad=shown.directions_rad, speeds=shown.speeds, label=label, arrow_label=arrows,
    )  # fmt: skip
    return Picture(figure, words)
