"""The maze as data: what its text says, what is refused and in which words, and what the generators promise."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, reject
from hypothesis import strategies as st
from scipy import ndimage

from gridnav.problem.layout import MAX_FILE_BYTES, MAX_SIDE, NAMED_LAYOUTS, Layout
from gridnav.problem.types import InputError

MAZE_TEXTS = st.integers(1, 7).flatmap(
    lambda n_cols: st.lists(st.text("....#SG", min_size=n_cols, max_size=n_cols), min_size=1, max_size=7)
)
SMALL_LAYOUTS = st.builds(
    Layout.random,
    n_rows=st.integers(3, 8),
    n_cols=st.integers(3, 8),
    density=st.sampled_from([0.0, 0.1, 0.3]),
    seed=st.integers(0, 2**32),
)


def refusal(source: object) -> str:
    """The message with which a layout is refused."""
    with pytest.raises(InputError) as caught:
        Layout.load(source)  # type: ignore[arg-type]
    assert_short_line(caught.value)
    return str(caught.value)


def assert_short_line(error: InputError) -> None:
    """The command line prints the message as it is."""
    assert str(error).isprintable(), "a message is one line"
    assert len(str(error)) < 250


# ---- Text form ---------------------------------------------------------------------------------


def test_each_letter_of_the_text_means_one_thing() -> None:
    layout = Layout.from_text("S.#\nS.G\n")

    assert layout.walls.tolist() == [[False, False, True], [False, False, False]]
    assert layout.start_cells.tolist() == [[0, 0], [1, 0]]
    assert layout.goal_cells.tolist() == [[1, 2]]
    assert (layout.n_rows, layout.n_cols, layout.n_cells) == (2, 3, 6)


def test_without_a_letter_every_free_cell_is_a_start_and_a_goal() -> None:
    free = [[0, 0], [1, 0], [1, 1]]

    assert Layout.from_text(".#\n..\n").start_cells.tolist() == free
    assert Layout.from_text(".#\n..\n").goal_cells.tolist() == free
    assert Layout.from_text("S#\n..\n").goal_cells.tolist() == free
    assert Layout.from_text("G#\n..\n").start_cells.tolist() == free


@given(MAZE_TEXTS)
def test_a_text_is_refused_in_one_line_or_comes_back_as_it_was(rows: list[str]) -> None:
    try:
        layout = Layout.from_text("\n".join(rows))
    except InputError as error:
        assert_short_line(error)
        return

    again = Layout.from_text(layout.to_text())

    assert again == layout
    assert hash(again) == hash(layout)
    assert [line.count("#") for line in layout.to_text().split()] == [row.count("#") for row in rows]


@given(st.text(), st.text())
def test_no_text_makes_the_parser_fail_in_another_way(text: str, name: str) -> None:
    for hostile in (text, text + "\n", "S.G\n" + text):
        try:
            Layout.from_text(hostile, name=name)
        except InputError as error:
            assert_short_line(error)


def test_empty_lines_around_the_maze_and_line_ends_of_any_system_are_ignored() -> None:
    assert Layout.from_text("\n\n  \r\nS.\r\n.G  \r\n\n") == Layout.from_text("S.\n.G")


def test_a_cell_that_is_both_start_and_goal_among_others_has_no_letter() -> None:
    free = np.ones((1, 4), dtype=bool)
    starts, goals = free.copy(), free.copy()
    starts[0, 3] = goals[0, 0] = False

    with pytest.raises(InputError, match="both start and goal"):
        Layout(~free, starts, goals).to_text()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("S..\n..\n...", "line 2, column 3: the line has 2 cells and line 1 has 3; all lines must be equally long"),
        ("\nS..\n....\n", "line 3, column 4: the line has 4 cells and line 2 has 3"),
        ("\n\nS.\n.x\n", "line 4, column 2: 'x' is none of '#' wall, '.' free, 'S' start, 'G' goal"),
        ("S.\n\n.G\n", "line 2, column 1: the line has 0 cells and line 1 has 2"),
        ("S \tG\n", "line 1, column 2: ' ' is none of"),
        ("s.G\n", "line 1, column 1: 's' is none of"),
        ("S.\x1bG\n", r"line 1, column 3: '\x1b' is none of"),
        ("\n", "is empty: it needs lines of '#', '.', 'S' and 'G'"),
        ("S#G\n", "line 1, column 3: this goal cannot be reached from the start at line 1, column 1; open a way or"),
        ("\n.S\n##\n.G\n", "line 4, column 2: this goal cannot be reached from the start at line 2, column 2"),
        ("S#S\n..#\nG..\n", "line 1, column 3: this start cannot be reached from the start at line 1, column 1"),
        ("S#\n#G\n", "line 2, column 2: this goal cannot be reached"),  # walls that touch at a corner leave no way
        ("S\n", "at least two free cells, a start and a goal that differ"),
        ("###\n##.\n", "at least two free cells"),
        ("##\n##\n", "at least two free cells"),
        ("S" * 101 + "\n", "1 x 101 cells is out of range: 1 to 100 rows and columns"),
        ("S\n" * 101, "101 x 1 cells is out of range: 1 to 100 rows and columns"),
    ],
)
def test_a_wrong_text_is_refused_with_place_and_rule(text: str, words: str) -> None:
    assert words in refusal(text)


def test_the_largest_layout_is_as_large_as_the_error_says() -> None:
    layout = Layout.from_text(("." * MAX_SIDE + "\n") * MAX_SIDE)

    assert (layout.n_rows, layout.n_cols) == (100, 100)


# ---- Where layouts come from -------------------------------------------------------------------


def test_classic_is_the_maze_of_the_contract() -> None:
    # design.md: walls at row 3 columns 3-6, rows 3-7 column 3, and (1,5), (5,1), (7,8), (8,2); starts in the 3 x 3
    # top-left corner, goals in the free cells of the 3 x 3 bottom-right corner.
    walls = {(3, 3), (3, 4), (3, 5), (3, 6), (4, 3), (5, 3), (6, 3), (7, 3), (1, 5), (5, 1), (7, 8), (8, 2)}
    starts = [[row, col] for row in range(3) for col in range(3)]
    goals = [[row, col] for row in range(7, 10) for col in range(7, 10) if (row, col) != (7, 8)]

    classic = Layout.load("classic")

    assert classic.walls.shape == (10, 10)
    assert set(map(tuple, np.argwhere(classic.walls).tolist())) == walls
    assert classic.start_cells.tolist() == starts
    assert classic.goal_cells.tolist() == goals
    assert (classic.cell_size_m, classic.name) == (0.5, "classic")


@pytest.mark.parametrize("name", NAMED_LAYOUTS)
def test_a_named_layout_is_valid_and_leaves_no_free_cell_cut_off(name: str) -> None:
    layout = Layout.load(name)

    assert layout.name == name
    assert (layout.reachable == ~layout.walls).all()


def test_the_contract_names_its_layouts() -> None:
    assert {"classic", "open", "four-rooms", "u-trap", "corridors"} <= NAMED_LAYOUTS.keys()


def test_a_file_gives_its_maze_and_its_name(tmp_path: Path) -> None:
    path = tmp_path / "my maze.txt"
    path.write_bytes(b"S.\r\n.G\r\n")

    for source in (path, str(path)):
        layout = Layout.load(source, cell_size_m=0.4)
        assert layout == Layout.from_text("S.\n.G\n", cell_size_m=0.4)
        assert layout.name == "my maze"


def test_a_layout_and_a_text_load_as_themselves() -> None:
    layout = Layout.from_text("S.G\n")

    assert Layout.load(layout) is layout
    assert Layout.load("S.G\n") == layout
    assert Layout.load("S.G") == layout


def test_a_file_that_is_none_is_refused_with_the_names_that_exist() -> None:
    message = refusal("clasic")

    assert "unknown layout 'clasic': it is no file" in message
    assert all(name in message for name in NAMED_LAYOUTS)


def test_what_is_no_text_file_is_refused(tmp_path: Path) -> None:
    binary, huge, lying = tmp_path / "weights.bin", tmp_path / "huge.txt", tmp_path / "a.txt" / "b.txt"
    binary.write_bytes(bytes(range(256)))
    huge.write_bytes(b"." * (MAX_FILE_BYTES + 1))
    (tmp_path / "a.txt").write_text("S.G\n")

    assert "is not a file: give a text file" in refusal(tmp_path)
    assert "weights.bin' is not a text file: it must be UTF-8" in refusal(binary)
    assert f"huge.txt' is larger than {MAX_FILE_BYTES} bytes" in refusal(huge)
    assert "a.txt/b.txt'" in refusal(lying)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_a_named_pipe_is_refused_without_waiting_for_what_it_says(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    # Full of bytes, so that a reader that falls for it ends in the wrong error and not in a hanging test.
    pipe = os.open(tmp_path / "pipe", os.O_RDWR | os.O_NONBLOCK)
    os.write(pipe, b"." * (MAX_FILE_BYTES + 1))

    message = refusal(tmp_path / "pipe")

    os.close(pipe)
    assert "is not a file" in message


@pytest.mark.parametrize(
    "source",
    [
        "", ".", "..", "/", "a\0b", "a" * 5000, "a/" * 2000, "\x1b[2J", "a\rb", "\u2028", "\udcff", "%s{0}", "é" * 200,
        Path("two\nlines"), Path("classic"),
    ],
)  # fmt: skip
def test_a_hostile_name_is_refused_in_one_short_line(source: str | Path) -> None:
    refusal(source)


def test_a_hostile_file_name_keeps_the_message_short(tmp_path: Path) -> None:
    for name in ("n" * 250, "\x1b[31mred\n"):
        (tmp_path / name).write_text("S#G\n")
        assert "column 3: this goal" in refusal(tmp_path / name)
        (tmp_path / name).write_text("S?G\n")
        assert "column 2: '?'" in refusal(tmp_path / name)


@pytest.mark.parametrize("source", [None, 3, b"S.G\n", ["S.G"]])
def test_what_is_neither_name_nor_path_nor_text_is_refused(source: object) -> None:
    assert "must be a name, a path, a text or a Layout" in refusal(source)


@pytest.mark.parametrize("cell_size_m", [0.0, -0.5, float("nan"), float("inf")])
def test_a_cell_without_a_size_is_refused(cell_size_m: float) -> None:
    with pytest.raises(InputError, match=f"cell_size_m {cell_size_m} must be a positive number of metres"):
        Layout.from_text("S.G\n", cell_size_m=cell_size_m)


def test_masks_that_do_not_fit_are_refused() -> None:
    walls = np.array([[False, True, False], [False, False, False]])

    with pytest.raises(InputError, match=r"cell \(0, 1\) is a wall"):
        Layout(walls, walls, ~walls)
    with pytest.raises(InputError, match="one shape"):
        Layout(walls, ~walls[:1], ~walls)
    with pytest.raises(InputError, match="one shape"):
        Layout(walls[0], ~walls[0], ~walls[0])


def test_masks_of_zeros_and_ones_mean_what_they_say() -> None:
    """Otherwise ``~1`` would be -2, which is true."""
    walls = np.array([[0, 1, 0], [0, 0, 0]])

    layout = Layout(walls, 1 - walls, 1 - walls)

    assert layout == Layout.from_text(".#.\n...\n")
    assert not layout.reachable[0, 1]


# ---- One value, not two ------------------------------------------------------------------------


def test_layouts_are_equal_by_what_they_hold_and_not_by_name() -> None:
    layout = Layout.from_text("S.G\n", name="a")

    assert layout == Layout.from_text("S.G\n", name="b")
    assert hash(layout) == hash(Layout.from_text("S.G\n", name="b"))
    assert len({layout, Layout.from_text("S.G\n", name="b"), Layout.from_text("SG\n")}) == 2
    for other in ("SGG\n", "SSG\n", "S.G\n...\n", "S.G\n#..\n"):
        assert layout != Layout.from_text(other)
    assert layout != Layout.from_text("S.G\n", cell_size_m=0.4)
    assert layout != "S.G\n"


def test_a_layout_cannot_be_changed_and_leaves_alone_what_it_was_made_of() -> None:
    walls = np.zeros((2, 2), dtype=bool)
    layout = Layout(walls, ~walls, ~walls)

    walls[0, 0] = True  # still ours

    assert not layout.walls.any()
    for mask in (layout.walls, layout.starts, layout.goals, layout.reachable):
        with pytest.raises(ValueError, match="read-only"):
            mask[0, 0] = True


# ---- Cells and metres --------------------------------------------------------------------------


def test_metres_count_from_the_lower_left_corner_and_rows_from_the_top() -> None:
    classic = Layout.load("classic")

    # By hand, 10 rows of 0.5 m: x = (col + 0.5) * 0.5, y = (10 - row - 0.5) * 0.5.
    cells = np.array([(0, 0), (9, 9), (0, 9), (2, 5)])
    centres = np.array([(0.25, 4.75), (4.75, 0.25), (4.75, 4.75), (2.75, 3.75)])

    np.testing.assert_allclose(classic.to_metres(cells), centres)
    np.testing.assert_array_equal(classic.to_cell(centres), cells)
    assert classic.size_m == (5.0, 5.0)
    assert Layout.from_text("S..G\n....\n", cell_size_m=0.5).size_m == (2.0, 1.0)


def test_a_point_belongs_to_the_cell_around_it_and_outside_to_the_nearest() -> None:
    layout = Layout.from_text("S..\n..G\n", cell_size_m=1.0)

    points = np.array([(0.01, 0.01), (0.99, 0.99), (1.01, 1.01), (-3.0, 0.5), (9.0, 9.0), (2.5, -1.0)])

    assert layout.to_cell(points).tolist() == [[1, 0], [1, 0], [0, 1], [1, 0], [0, 2], [1, 2]]


@pytest.mark.parametrize("cell_size_m", [0.5, 0.3, 0.7, 1.0])
def test_every_cell_finds_back_from_its_centre(cell_size_m: float) -> None:
    layout = Layout.random(n_rows=7, n_cols=12, density=0.0, cell_size_m=cell_size_m)
    cells = np.argwhere(~layout.walls)

    np.testing.assert_array_equal(layout.to_cell(layout.to_metres(cells)), cells)


def test_a_cell_off_the_grid_is_not_free() -> None:
    layout = Layout.from_text("S#\n.G\n")

    assert layout.is_free((1, 1))
    for cell in ((0, 1), (-1, 0), (0, -1), (2, 0), (0, 2)):
        assert not layout.is_free(cell)


def test_the_walls_of_classic_are_six_rectangles() -> None:
    # By hand: the bar of the L (row 3, columns 3-6), its stem below (rows 4-7, column 3), and four single blocks.
    rectangles = Layout.load("classic").wall_rectangles().tolist()

    assert len(rectangles) == 6
    assert [1.5, 3.0, 3.5, 3.5] in rectangles
    assert [1.5, 1.0, 2.0, 3.0] in rectangles
    assert [2.5, 4.0, 3.0, 4.5] in rectangles  # the block (1, 5)


@given(SMALL_LAYOUTS)
def test_the_rectangles_cover_each_wall_cell_once_and_nothing_else(layout: Layout) -> None:
    covered = np.zeros(layout.walls.shape, dtype=int)
    for x_min, y_min, x_max, y_max in np.rint(layout.wall_rectangles() / layout.cell_size_m).astype(int):
        assert x_min < x_max
        assert y_min < y_max
        covered[layout.n_rows - y_max : layout.n_rows - y_min, x_min:x_max] += 1

    np.testing.assert_array_equal(covered, layout.walls.astype(int))


def test_no_walls_are_no_rectangles() -> None:
    assert Layout.load("open").wall_rectangles().shape == (0, 4)


# ---- Generators --------------------------------------------------------------------------------


@given(
    n_rows=st.integers(2, 12), n_cols=st.integers(2, 12), density=st.floats(0, 0.6), seed=st.integers(0, 2**63)
)  # fmt: skip
def test_random_blocks_leave_every_free_cell_reachable_and_honour_the_density(
    n_rows: int, n_cols: int, density: float, seed: int
) -> None:
    try:
        layout = Layout.random(n_rows=n_rows, n_cols=n_cols, density=density, seed=seed)
    except InputError:
        assert density > 0.1, "only many blocks may not fit"
        reject()

    assert layout.walls.sum() == round(density * n_rows * n_cols)
    assert ndimage.label(~layout.walls)[1] == 1
    assert (layout.reachable == ~layout.walls).all()
    assert layout == Layout.random(n_rows=n_rows, n_cols=n_cols, density=density, seed=seed)


@given(n_rows=st.integers(1, 8), n_cols=st.integers(1, 8), seed=st.integers(0, 2**63))
def test_a_maze_has_one_way_between_any_two_cells(n_rows: int, n_cols: int, seed: int) -> None:
    assume(n_rows * n_cols > 1)
    layout = Layout.maze(n_rows=2 * n_rows - 1, n_cols=2 * n_cols - 1, seed=seed)
    free = ~layout.walls

    # A connected graph with one edge less than it has nodes is a tree.
    edges = (free[1:] & free[:-1]).sum() + (free[:, 1:] & free[:, :-1]).sum()
    assert ndimage.label(free)[1] == 1
    assert edges == free.sum() - 1
    assert free[::2, ::2].all(), "every room is open"
    assert layout == Layout.maze(n_rows=2 * n_rows - 1, n_cols=2 * n_cols - 1, seed=seed)


def test_another_seed_makes_another_maze() -> None:
    assert len({Layout.random(seed=seed) for seed in range(10)}) == 10
    assert len({Layout.maze(seed=seed) for seed in range(10)}) == 10


@pytest.mark.parametrize(("n_rows", "n_cols"), [(10, 11), (11, 10), (4, 4)])
def test_a_maze_of_even_size_is_refused(n_rows: int, n_cols: int) -> None:
    with pytest.raises(
        InputError, match=f"a maze of {n_rows} x {n_cols} cells cannot be made: both counts must be odd"
    ):
        Layout.maze(n_rows=n_rows, n_cols=n_cols)


@pytest.mark.parametrize("density", [-0.1, 1.1, float("nan")])
def test_a_density_that_is_no_share_is_refused(density: float) -> None:
    with pytest.raises(InputError, match=r"outside \[0, 1\]"):
        Layout.random(density=density)


def test_more_blocks_than_fit_are_refused() -> None:
    with pytest.raises(InputError, match=r"density 0\.99 leaves no connected maze of 10 x 10 cells"):
        Layout.random(density=0.99)


@pytest.mark.parametrize(("n_rows", "n_cols"), [(0, 5), (5, 101), (-3, 3)])
def test_generators_refuse_a_size_out_of_range(n_rows: int, n_cols: int) -> None:
    for generate in (Layout.random, Layout.maze):
        with pytest.raises(InputError, match=f"{n_rows} x {n_cols} cells is out of range"):
            generate(n_rows=n_rows, n_cols=n_cols)
