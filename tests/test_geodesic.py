"""Distance to the goal, by hand, against a brute-force search, and never through a wall."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import csgraph

from gridnav.problem.geodesic import Geodesic, cell_distances, clearances
from gridnav.problem.layout import Layout
from gridnav.problem.types import FloatArray, InputError

RADIUS_M = 0.105
TURN_M = 0.004
"""By how much a right-angle turn may be too long."""
TOUCH_M = 0.0006
"""By how much the way of a robot that touches a corner may be too short."""

OPEN = Layout.from_text(".....\n" * 5)
BLOCK = Layout.from_text(".....\n.....\n..#..\n.....\n.....\n")
"""One wall cell, x and y from 1.0 to 1.5 m."""
CORNER = np.array([1.5, 1.5])
"""Its upper right corner."""


def around_corner(p: FloatArray, q: FloatArray, radius_m: float = RADIUS_M) -> float:
    """Shortest way counter-clockwise around the corner from p to q: tangent, arc, tangent; or straight."""
    a, b = p - CORNER, q - CORNER
    far_a, far_b = float(np.hypot(*a)), float(np.hypot(*b))
    turn = (np.arctan2(b[1], b[0]) - np.arctan2(a[1], a[0])) % (2 * np.pi)
    arc = turn - np.arccos(min(1.0, radius_m / far_a)) - np.arccos(min(1.0, radius_m / far_b))
    if arc <= 0.0:
        return float(np.hypot(*(p - q)))
    tangents = np.sqrt(max(far_a**2 - radius_m**2, 0.0)) + np.sqrt(max(far_b**2 - radius_m**2, 0.0))
    return float(tangents + radius_m * arc)


def free_points(layout: Layout, n: int, *, seed: int = 0, clearance_m: float = RADIUS_M) -> FloatArray:
    """Points where the disc fits, shape ``(n, 2)``."""
    points = np.random.default_rng(seed).uniform(0.0, layout.size_m, (40 * n, 2))
    return points[clearances(points, layout)[0] >= clearance_m][:n]


# ---- On cells ----------------------------------------------------------------------------------


def test_moves_are_counted_around_walls() -> None:
    layout = Layout.from_text("..#\n#.#\nG..\n")
    inf = np.inf

    # By hand, from the goal at (2, 0): right, up, up, left, and right to (2, 2).
    expected = [[4, 3, inf], [inf, 2, inf], [0, 1, 2]]

    np.testing.assert_array_equal(cell_distances(layout, (2, 0)), expected)


def test_no_move_leads_to_a_cell_that_is_cut_off() -> None:
    layout = Layout.from_text("SG#.\n")

    np.testing.assert_array_equal(cell_distances(layout, (0, 1)), [[1, 0, np.inf, np.inf]])


# ---- By hand -----------------------------------------------------------------------------------


def test_in_the_open_the_way_is_straight() -> None:
    geodesic = Geodesic(OPEN, RADIUS_M)
    points = free_points(OPEN, 50)

    distances = geodesic.distances(points, np.full(50, geodesic.goal_number((3, 1))))

    np.testing.assert_allclose(distances, np.hypot(*(points - (0.75, 0.75)).T), rtol=1e-12)


def test_around_one_corner_the_way_is_tangent_arc_tangent() -> None:
    # By hand: from (1.75, 1.25) to (1.25, 1.75), both sqrt(2)/4 = 0.353553 from the corner, at -45 and 135 degrees.
    # Tangents: sqrt(0.125 - 0.105^2) = 0.337602. Arc: pi - 2*acos(0.105/0.353553) = 0.603067 rad, 0.063322 m.
    by_hand = 2 * 0.337602 + 0.063322

    distance = Geodesic(BLOCK, RADIUS_M).distance(np.array([1.75, 1.25]), (1, 2))

    assert by_hand == pytest.approx(around_corner(np.array([1.75, 1.25]), np.array([1.25, 1.75])), abs=2e-6)
    assert by_hand - 1e-6 <= distance <= by_hand + TURN_M


def test_past_a_block_the_way_turns_at_two_corners() -> None:
    # By hand: from (1.75, 1.25) to (0.75, 1.25). Each corner is 0.353553 away, the tangent 0.337602 long. It meets the
    # circle acos(0.105/0.353553) = 72.723 degrees on, so 135 - 72.723 = 62.277 degrees remain to the top: 0.114128 m.
    # Between the tops of both circles the way is straight and 0.5 m long.
    by_hand = 2 * (0.337602 + 0.114128) + 0.5

    distance = Geodesic(BLOCK, RADIUS_M).distance(np.array([1.75, 1.25]), (2, 1))

    assert by_hand - 1e-5 <= distance <= by_hand + 2 * TURN_M


@pytest.mark.parametrize("radius_m", [0.02, 0.105, 0.2])
def test_around_one_corner_the_way_is_never_much_too_long_nor_too_short(radius_m: float) -> None:
    goal, goal_w = (1, 2), np.array([1.25, 1.75])
    rng = np.random.default_rng(0)
    angles = rng.uniform(-np.pi / 4, np.pi / 2, 2000)
    # Touching the corner, nearly touching it, and anywhere beside it.
    gaps = rng.choice([0.0, 1e-9, 1e-3, 0.01, 0.1, 0.3], 2000) * rng.random(2000)
    points = CORNER + (radius_m + gaps)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points = points[clearances(points, BLOCK)[0] >= radius_m - 1e-9]
    geodesic = Geodesic(BLOCK, radius_m)

    distances = geodesic.distances(points, np.full(len(points), geodesic.goal_number(goal)))

    excess = distances - [around_corner(point, goal_w, radius_m) for point in points]
    scale = radius_m / RADIUS_M
    assert excess.min() >= -TOUCH_M * scale
    assert excess.max() <= TURN_M * scale
    away = clearances(points, BLOCK)[0] > 1.04 * radius_m
    assert excess[away].min() >= -1e-9, "only a robot that touches the corner may be told too short a way"


def test_a_wider_robot_has_a_longer_way_round() -> None:
    point = np.array([1.75, 1.25])

    narrow, middle, wide = (Geodesic(BLOCK, radius_m).distance(point, (1, 2)) for radius_m in (0.02, 0.105, 0.24))

    assert narrow < middle - 0.001
    assert middle < wide - 0.001


# ---- Against brute force -----------------------------------------------------------------------


def brute_force(layout: Layout, radius_m: float, goal: tuple[int, int]) -> FloatArray:
    """Way lengths from all cell centres over 49 points around each wall corner, lines checked every 20 mm."""
    corners = {(r + i, c + j) for r, c in np.argwhere(layout.walls) for i in (0, 1) for j in (0, 1)}
    angles = np.linspace(0.0, 2 * np.pi, 49)
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1) * radius_m / np.cos(np.pi / 48)
    around = [np.array([c, layout.n_rows - r]) * layout.cell_size_m + ring for r, c in corners]
    cells = np.argwhere(np.ones_like(layout.walls))
    nodes = np.concatenate([layout.to_metres(cells), *around])
    inside = (nodes > radius_m - 1e-9).all(axis=1) & (nodes < np.array(layout.size_m) - radius_m + 1e-9).all(axis=1)
    nodes[~inside] = layout.to_metres(cells[0])  # of no use, but the numbering stays
    fits = clearances(nodes, layout)[0] >= radius_m - 1e-6

    first, second = np.triu_indices(len(nodes), 1)
    lengths = np.hypot(*(nodes[first] - nodes[second]).T)
    near = fits[first] & fits[second] & (lengths > 0)
    first, second, lengths = first[near], second[near], lengths[near]
    for share in np.linspace(0.0, 1.0, 1 + int(max(layout.size_m) * 1.42 / 0.02)):
        points = nodes[first] + share * (nodes[second] - nodes[first])
        clear = clearances(points, layout)[0] >= radius_m - 1e-4
        first, second, lengths = first[clear], second[clear], lengths[clear]
    graph = np.zeros((len(nodes), len(nodes)))
    graph[first, second] = lengths
    number = goal[0] * layout.n_cols + goal[1]
    return csgraph.dijkstra(csgraph.csgraph_from_dense(graph), directed=False, indices=number)[: layout.n_cells]


@pytest.mark.parametrize("text", ["S.#.\n.#..\n...#\n#...\n", "S#..\n.#.#\n.#..\n...G\n", "...\n.#.\n#..\n"])
@pytest.mark.parametrize("radius_m", [0.105, 0.2])
def test_the_way_is_the_one_that_brute_force_finds(text: str, radius_m: float) -> None:
    layout = Layout.from_text(text)
    free = np.flatnonzero(~layout.walls.ravel())
    cells = np.argwhere(~layout.walls)
    geodesic = Geodesic(layout, radius_m)
    for goal in (cells[-1], cells[len(cells) // 2]):
        goal_cell = (int(goal[0]), int(goal[1]))
        expected = brute_force(layout, radius_m, goal_cell)[free]

        numbers = np.full(len(free), geodesic.goal_number(goal_cell))
        distances = geodesic.distances(layout.to_metres(cells), numbers)

        np.testing.assert_array_equal(np.isfinite(distances), np.isfinite(expected))
        excess = (distances - expected)[np.isfinite(expected)]
        # At most six turns; the scan of the brute force is coarse, so its ways may cut a corner by a hair.
        assert excess.min() >= -0.002
        assert excess.max() <= 6 * TURN_M * radius_m / RADIUS_M


# ---- Properties --------------------------------------------------------------------------------


@given(seed=st.integers(0, 2**32), density=st.sampled_from([0.1, 0.25, 0.4]), radius_m=st.sampled_from([0.05, 0.2]))
def test_between_centres_the_way_lies_between_straight_and_square(seed: int, density: float, radius_m: float) -> None:
    try:
        layout = Layout.random(n_rows=6, n_cols=6, density=density, seed=seed)
    except InputError:
        return
    cells = np.argwhere(~layout.walls)
    centres = layout.to_metres(cells)
    geodesic = Geodesic(layout, radius_m)
    numbers = [geodesic.goal_number((row, col)) for row, col in cells.tolist()]

    ways = np.stack([geodesic.distances(centres, np.full(len(cells), number)) for number in numbers])

    straight = np.hypot(*(centres[:, None] - centres[None]).transpose(2, 0, 1))
    square = np.stack([cell_distances(layout, (row, col))[tuple(cells.T)] for row, col in cells.tolist()]) * 0.5
    assert (ways >= straight - 1e-12).all()
    assert (ways <= square + 1e-9).all()
    np.testing.assert_allclose(ways, ways.T, atol=1e-9)
    assert (np.diag(ways) == 0.0).all()


@pytest.mark.parametrize(("text", "goal"), [(".#.\n#.G\nS..\n", (1, 2)), ("S.G\n###\n...\n", (0, 2))])
def test_no_way_leads_through_walls_nor_between_two_that_touch(text: str, goal: tuple[int, int]) -> None:
    layout = Layout.from_text(text)
    geodesic = Geodesic(layout, 0.01)
    cut_off = layout.to_metres(np.argwhere(~layout.walls & ~layout.reachable))

    distances = geodesic.distances(cut_off, np.full(len(cut_off), geodesic.goal_number(goal)))

    assert np.isinf(distances).all()


def test_walls_that_touch_at_a_corner_are_gone_around() -> None:
    layout = Layout.from_text("S#..\n..#.\n....\n....\n")

    # By hand: between the walls (0, 1) and (1, 2) the way from (1, 1) to (0, 2) would be sqrt(2)/2 = 0.707 m. There is
    # none; it leads down, past three corners of (1, 2), and up: more than 0.5 + 1.0 m.
    assert Geodesic(layout, 0.01).distance(layout.to_metres(np.array([1, 1])), (0, 2)) > 1.5


@given(seed=st.integers(0, 2**32))
def test_a_millimetre_changes_the_way_by_no_more_than_that_and_two_turns(seed: int) -> None:
    layout = Layout.random(n_rows=6, n_cols=6, density=0.3, seed=seed)
    geodesic = Geodesic(layout, RADIUS_M)
    rng = np.random.default_rng(seed)
    goal = np.argwhere(~layout.walls)[0]
    # Anywhere, and pressed against the nearest wall.
    points = free_points(layout, 200, seed=seed)
    gap, direction, inner = clearances(points, layout)
    points[inner & (gap < 0.4)] += ((gap - RADIUS_M)[:, None] * direction)[inner & (gap < 0.4)]
    angles = rng.uniform(0.0, 2 * np.pi, len(points))
    moved = points + 0.001 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    fits = np.minimum(clearances(points, layout)[0], clearances(moved, layout)[0]) >= RADIUS_M - 1e-6
    number = np.full(fits.sum(), geodesic.goal_number((int(goal[0]), int(goal[1]))))

    change = np.abs(geodesic.distances(points[fits], number) - geodesic.distances(moved[fits], number))

    assert fits.sum() > 50
    # Either end may have each of its turns too long; seed 218 has two on one of the ways and 5.3 mm.
    assert change.max() <= 0.001 + 2 * TURN_M


def test_along_the_arc_of_a_corner_the_way_has_no_jumps() -> None:
    """A robot that turns about a corner it touches used to lose sight of the points around it: jumps of 55 mm."""
    geodesic = Geodesic(BLOCK, RADIUS_M)
    angles = np.radians(np.arange(0.0, 90.0, 0.25))
    number = np.full(len(angles), geodesic.goal_number((1, 3)))
    for gap in (0.0, 0.0005, 0.003):
        arc = CORNER + (RADIUS_M + gap) * np.stack([np.cos(angles), np.sin(angles)], axis=1)

        assert np.abs(np.diff(geodesic.distances(arc, number))).max() < 0.003


def test_a_robot_pressed_into_a_long_wall_still_sees_along_it() -> None:
    layout = Layout.from_text("......\n.####.\n......\n")
    geodesic = Geodesic(layout, RADIUS_M)
    goal = geodesic.goal_number((2, 5))
    heights = np.array([0.39, 0.395, 0.396, 0.4, 0.41])  # the wall's lower side is at 0.5: the disc touches at 0.395

    distances = geodesic.distances(np.stack([np.full(5, 0.75), heights], axis=1), np.full(5, goal))

    # By hand: straight to (2.75, 0.25).
    np.testing.assert_allclose(distances, np.hypot(2.0, heights - 0.25), atol=1e-12)


@pytest.mark.parametrize("radius_m", [0.25, 0.3])
def test_a_robot_too_wide_for_a_corridor_is_refused(radius_m: float) -> None:
    with pytest.raises(InputError, match=f"cell_size_m 0.5 is too small: a robot of radius {radius_m} m needs cells"):
        Geodesic(OPEN, radius_m)


@pytest.mark.parametrize("radius_m", [0.0, -0.1, float("nan")])
def test_a_robot_without_a_radius_is_refused(radius_m: float) -> None:
    """A point would slip through the slack of the clearance test, that is through every wall."""
    with pytest.raises(InputError, match=r"radius_m .* must be a positive number of metres"):
        Geodesic(OPEN, radius_m)


# ---- The way itself ----------------------------------------------------------------------------


def test_in_the_open_the_way_is_its_two_ends() -> None:
    np.testing.assert_array_equal(Geodesic(OPEN, RADIUS_M).path((1.0, 2.0), (3, 1)), [[1.0, 2.0], [0.75, 0.75]])


def test_past_a_block_the_way_bends_at_its_corners() -> None:
    way = Geodesic(BLOCK, RADIUS_M).path(np.array([1.75, 1.25, 0.0]), (2, 1))

    # By hand: above or below the block, round two of its corners, half a turn in all.
    np.testing.assert_array_equal(way[[0, -1]], [[1.75, 1.25], [0.75, 1.25]])
    beside = np.abs(way[1:-1, 1] - 1.25)
    assert ((beside > 0.25) & (beside <= 0.25 + 1.04 * RADIUS_M)).all()
    legs = np.diff(way, axis=0)
    turns = np.abs(np.diff(np.unwrap(np.arctan2(legs[:, 1], legs[:, 0]))))
    # The tangents from both centres are 62.3 degrees of arc away from the top, see above, at each of two corners.
    assert turns.sum() == pytest.approx(2 * np.radians(62.277), abs=0.1)


def test_where_no_way_leads_there_is_no_point() -> None:
    layout = Layout.from_text(".#.\n#.G\nS..\n")

    assert Geodesic(layout, 0.01).path(layout.to_metres(np.array([0, 0])), (1, 2)).shape == (0, 2)


@given(seed=st.integers(0, 2**32), density=st.sampled_from([0.1, 0.3]), radius_m=st.sampled_from([0.05, 0.2]))
def test_the_way_is_as_long_as_its_distance_and_clears_the_walls(seed: int, density: float, radius_m: float) -> None:
    layout = Layout.random(n_rows=7, n_cols=7, density=density, seed=seed)
    geodesic = Geodesic(layout, radius_m)
    rng = np.random.default_rng(seed)
    cells = np.argwhere(layout.reachable)
    for _ in range(5):
        row, col = cells[rng.integers(len(cells))].tolist()
        point = layout.to_metres(cells[rng.integers(len(cells))])

        way = geodesic.path(point, (row, col))

        assert np.hypot(*np.diff(way, axis=0).T).sum() == pytest.approx(geodesic.distance(point, (row, col)), abs=1e-9)
        for begin, end in pairwise(way):
            points = begin + np.linspace(0.0, 1.0, 60)[:, None] * (end - begin)
            assert clearances(points, layout)[0].min() >= radius_m - 1e-6


# ---- Clearances --------------------------------------------------------------------------------


def test_the_nearest_wall_is_found_with_its_direction() -> None:
    s = np.sqrt(0.5)
    # By hand, with the wall from 1.0 to 1.5 and the outer wall at 0 and 2.5 m.
    cases = [
        ((1.25, 0.75), 0.25, (0.0, 1.0), True),  # below the wall
        ((1.6, 1.25), 0.1, (-1.0, 0.0), True),  # right of it
        ((1.6, 1.6), 0.1 / s, (-s, -s), True),  # off its corner: sqrt(0.1^2 + 0.1^2)
        ((0.1, 1.2), 0.1, (-1.0, 0.0), False),  # the outer wall on the left
        ((1.2, 2.4), 0.1, (0.0, 1.0), False),  # the outer wall above
        ((2.45, 0.2), 0.05, (1.0, 0.0), False),  # two outer walls: the nearer one
        ((1.8, 0.2), 0.2, (0.0, -1.0), False),
    ]

    distance, direction, inner = clearances(np.array([point for point, *_ in cases]), BLOCK)

    np.testing.assert_allclose(distance, [gap for _, gap, _, _ in cases], atol=1e-12)
    np.testing.assert_allclose(direction, [way for _, _, way, _ in cases], atol=1e-12)
    assert inner.tolist() == [is_inner for *_, is_inner in cases]


def test_inside_a_wall_there_is_no_clearance_and_beyond_a_cell_it_reads_one_cell() -> None:
    distance, _, inner = clearances(np.array([(1.2, 1.3)]), BLOCK)
    assert (distance[0], inner[0]) == (0.0, True)

    far, _, _ = clearances(np.array([(2.5, 2.5)]), Layout.from_text(".........\n" * 9))
    assert far[0] == 0.5


@pytest.mark.parametrize(
    "layout", [Layout.load("classic"), Layout.random(density=0.3, seed=1)], ids=["classic", "random"]
)
def test_looking_only_at_anchors_in_sight_changes_no_distance(layout: Layout, monkeypatch: pytest.MonkeyPatch) -> None:
    few = Geodesic(layout, 0.105)
    monkeypatch.setattr("gridnav.problem.geodesic.MAX_SIGHT_TESTS", 0)
    all_of_them = Geodesic(layout, 0.105)
    assert len(few._in_sight) < layout.n_cells * len(all_of_them._in_sight)

    cells = np.argwhere(layout.reachable)
    rng = np.random.default_rng(0)
    points = layout.to_metres(cells[rng.integers(len(cells), size=500)]) + rng.uniform(-0.14, 0.14, (500, 2))
    goals = cells[rng.integers(len(cells), size=500)]
    one, other = (g.distances(points, g.goal_numbers(goals)) for g in (few, all_of_them))
    np.testing.assert_array_equal(one, other)
