"""The law by which a task draws starts, goals and headings."""

from __future__ import annotations

import itertools
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gridnav import Layout, Task
from gridnav.problem.task import DRAWS_PER_EPISODE
from gridnav.problem.types import InputError

ROW = Layout.from_text("SS.GG\n")
ANY = Task(starts="any", goals="any")

LAYOUTS = st.sampled_from(
    [
        Layout.load("classic"),
        Layout.from_text("SG\n"),
        Layout.from_text("S.\n..\n"),
        Layout.from_text("..G\n"),  # the one goal is a start cell too
        Layout.from_text("S.G#.\n.#.#.\n"),  # two free cells are cut off
    ]
)
TASKS = st.builds(Task, starts=st.sampled_from(["layout", "any"]), goals=st.sampled_from(["layout", "any"]))
SHARES = st.floats(0, 1, exclude_max=True)


def sample(task: Task, layout: Layout, *uniforms: tuple[float, float, float]) -> tuple[list[object], list[object]]:
    """Start and goal cells for given draws, as lists."""
    starts, goals, _ = task.sample(layout, np.array(uniforms))
    return starts.tolist(), goals.tolist()


def test_each_draw_picks_its_cell() -> None:
    # By hand: two starts and two goals, so each half of [0, 1) means one of them.
    starts, goals = sample(Task(), ROW, (0.0, 0.0, 0), (0.49, 0.51, 0), (0.5, 0.49, 0), (0.999999, 0.999999, 0))

    assert starts == [[0, 0], [0, 0], [0, 1], [0, 1]]
    assert goals == [[0, 3], [0, 4], [0, 3], [0, 4]]


def test_the_start_is_left_out_of_the_goals_and_the_others_stay_equally_likely() -> None:
    layout = Layout.from_text("...\n.#.\n")  # five free cells
    n = 5
    draws = np.array([((i + 0.5) / n, (j + 0.5) / (n - 1), 0.0) for i in range(n) for j in range(n - 1)])

    starts, goals, _ = ANY.sample(layout, draws)

    # Twenty equally likely draws, twenty pairs of different cells: each exactly once.
    pairs = Counter(zip(map(tuple, starts.tolist()), map(tuple, goals.tolist()), strict=True))
    cells = [(0, 0), (0, 1), (0, 2), (1, 0), (1, 2)]
    assert pairs == Counter(itertools.permutations(cells, 2))


def test_the_only_goal_is_never_a_start() -> None:
    starts, goals = sample(Task(), Layout.from_text("..G\n"), (0.0, 0.0, 0), (0.5, 0.9, 0), (0.99, 0.99, 0))

    assert starts == [[0, 0], [0, 1], [0, 1]]
    assert goals == [[0, 2]] * 3


def test_headings_are_uniform_over_the_circle() -> None:
    draws = np.array([(0.0, 0.0, share) for share in (0.0, 0.25, 0.5, 0.75, 1 - 1e-12)])

    _, _, headings = Task().sample(ROW, draws)

    np.testing.assert_allclose(headings, [-np.pi, -np.pi / 2, 0.0, np.pi / 2, np.pi])


@given(LAYOUTS, TASKS, st.lists(st.tuples(SHARES, SHARES, SHARES), min_size=1, max_size=20))
def test_episodes_start_away_from_their_goal_on_cells_the_task_allows(
    layout: Layout, task: Task, draws: list[tuple[float, float, float]]
) -> None:
    starts, goals, headings = task.sample(layout, np.array(draws))

    assert (starts != goals).any(axis=1).all()
    allowed_starts = layout.starts if task.starts == "layout" else layout.reachable
    allowed_goals = layout.goals if task.goals == "layout" else layout.reachable
    assert allowed_starts[tuple(starts.T)].all()
    assert allowed_goals[tuple(goals.T)].all()
    assert layout.reachable[tuple(starts.T)].all()
    assert (np.abs(headings) <= np.pi).all()


def test_every_start_and_every_goal_of_classic_is_drawn() -> None:
    classic = Layout.load("classic")
    draws = np.random.default_rng(0).random((2000, DRAWS_PER_EPISODE))

    for task in (Task(), Task(starts="any"), ANY):
        starts, goals, _ = task.sample(classic, draws)
        assert set(map(tuple, starts.tolist())) == set(map(tuple, task.start_cells(classic).tolist()))
        assert set(map(tuple, goals.tolist())) == set(map(tuple, task.goal_cells(classic).tolist()))


def test_any_is_every_cell_that_the_starts_reach() -> None:
    layout = Layout.from_text("S.G#.\n.#.#.\n")

    assert ANY.start_cells(layout).tolist() == [[0, 0], [0, 1], [0, 2], [1, 0], [1, 2]]
    assert ANY.goal_cells(layout).tolist() == ANY.start_cells(layout).tolist()


def test_the_named_tasks_are_what_their_names_say() -> None:
    assert Task.load("default") == Task()
    assert Task().on_collision == "stop"
    assert (Task.load("any").starts, Task.load("any").goals) == ("any", "any")
    assert Task.load("fragile").on_collision == "end"
    assert Task.load(ANY) is ANY


@pytest.mark.parametrize("name", ["Default", "", "x" * 1000, "a\nb", None, 3, ["any"]])
def test_an_unknown_task_is_refused_with_the_names_that_exist(name: object) -> None:
    with pytest.raises(InputError, match=r"unknown task .*: the named tasks are default, any, fragile") as caught:
        Task.load(name)  # type: ignore[arg-type]

    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 250


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("starts", "all"),
        ("goals", ""),
        ("on_collision", "END"),
        ("on_collision", None),
        ("goal_radius_m", 0.0),
        ("goal_radius_m", -0.1),
        ("goal_radius_m", float("nan")),
        ("goal_radius_m", float("inf")),
    ],
)
def test_a_wrong_field_is_named_with_its_value(field: str, value: object) -> None:
    with pytest.raises(InputError, match=f"task {field} {value!r} (is none of|must be a positive)"):
        Task(**{field: value})  # type: ignore[arg-type]
