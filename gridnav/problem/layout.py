"""The maze as data: text form, validation, generators, cells and metres, wall rectangles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy import ndimage

from gridnav.problem.types import BoolArray, Cell, FloatArray, InputError, IntArray

WALL, FREE, START, GOAL = "#", ".", "S", "G"
MAX_SIDE = 100
"""Rows and columns a layout may have: beyond it a table over cells and goals no longer fits a laptop."""
MAX_FILE_BYTES = 4 * MAX_SIDE * MAX_SIDE

NAMED_LAYOUTS = {
    # The maze of the tutorial: an L, four single blocks, starts top left, goals bottom right.
    "classic": """
SSS.......
SSS..#....
SSS.......
...####...
...#......
.#.#......
...#......
...#...G#G
..#....GGG
.......GGG
""",
    "open": "\n".join(["." * 10] * 10),
    "four-rooms": """
.....#.....
.....#.....
...........
.....#.....
.....#.....
#.####.....
.....###.##
.....#.....
.....#.....
...........
.....#.....
""",
    "u-trap": """
...........
.SSS.......
.SSS.......
...........
..#######..
........#..
........#..
.GGG....#..
.GGG....#..
........#..
...........
""",
    "corridors": """
S.........
#########.
..........
.#########
..........
#########.
..........
.#########
.........G
""",
}


@dataclass(frozen=True, eq=False)
class Layout:
    """Walls, allowed starts and allowed goals on a grid of square cells.

    Around the grid stands an outer wall that the text does not show. A layout is valid once it
    exists: every start reaches every goal by moves between side-by-side free cells.
    """

    walls: BoolArray
    """True where a cell is a wall, shape ``(n_rows, n_cols)``, row 0 on top."""
    starts: BoolArray
    """True where an episode may start, same shape."""
    goals: BoolArray
    """True where an episode may end, same shape."""
    cell_size_m: float = 0.5
    """Side of a cell, metres."""
    name: str = "custom"
    """The named layout it came from, a file's stem, or ``custom``."""
    start_cells: IntArray = field(init=False, repr=False)
    """The starts as (row, column), shape ``(n_starts, 2)``, row by row."""
    goal_cells: IntArray = field(init=False, repr=False)
    """The goals as (row, column), shape ``(n_goals, 2)``, row by row."""
    reachable: BoolArray = field(init=False, repr=False)
    """True on the free cells that the starts reach, same shape as the walls."""

    def __post_init__(self) -> None:
        for name in ("walls", "starts", "goals"):
            mask = np.array(getattr(self, name), dtype=np.bool_)  # a copy: who made it may go on writing to theirs
            mask.setflags(write=False)
            object.__setattr__(self, name, mask)
        shapes = {self.walls.shape, self.starts.shape, self.goals.shape}
        if len(shapes) != 1 or self.walls.ndim != 2:
            raise InputError(f"walls, starts and goals must have one shape (n_rows, n_cols), not {sorted(shapes)}")
        object.__setattr__(self, "start_cells", np.argwhere(self.starts))
        object.__setattr__(self, "goal_cells", np.argwhere(self.goals))
        self._validate()

    # ---- Text form ---------------------------------------------------------------------------

    @classmethod
    def from_text(cls, text: str, *, cell_size_m: float = 0.5, name: str = "custom") -> Layout:
        """Read the text form: ``#`` wall, ``.`` free, ``S`` start allowed, ``G`` goal allowed.

        Without any ``S`` (or ``G``) every free cell is one. Empty lines before and after the maze
        are ignored.

        Raises:
            InputError: With line, column and rule, when the text is no valid layout.
        """
        rows, first_line = _rows(text, name)
        grid = np.array([list(row) for row in rows])
        walls = grid == WALL
        starts, goals = grid == START, grid == GOAL
        try:
            return cls(
                walls,
                starts if starts.any() else ~walls,
                goals if goals.any() else ~walls,
                cell_size_m,
                name,
            )
        except _UnreachableError as error:
            raise InputError(error.located(name, first_line)) from None

    def to_text(self) -> str:
        """The text form; reading it back gives an equal layout.

        Raises:
            InputError: When a cell is both start and goal while others are not, which the letters cannot say.
        """
        grid = np.where(self.walls, WALL, FREE)
        some_starts = bool((self.starts != ~self.walls).any())
        some_goals = bool((self.goals != ~self.walls).any())
        if some_starts and some_goals and bool((self.starts & self.goals).any()):
            raise InputError("this layout has a cell that is both start and goal, which its text form cannot say")
        if some_starts:
            grid[self.starts] = START
        if some_goals:
            grid[self.goals] = GOAL
        return "\n".join("".join(row) for row in grid) + "\n"

    @classmethod
    def load(cls, source: str | Path | Layout, *, cell_size_m: float = 0.5) -> Layout:
        """A layout from its name, a path to a text file, a text, or itself.

        Raises:
            InputError: When the source is none of these, or what it names is no valid layout.
        """
        if isinstance(source, Layout):
            return source
        if isinstance(source, str):
            if source in NAMED_LAYOUTS:
                return cls.from_text(NAMED_LAYOUTS[source], cell_size_m=cell_size_m, name=source)
            if "\n" in source or (source and set(source) <= {WALL, FREE, START, GOAL} and source not in {".", ".."}):
                return cls.from_text(source, cell_size_m=cell_size_m)
        elif not isinstance(source, Path):
            raise InputError(f"layout must be a name, a path, a text or a Layout, not {type(source).__name__}")
        return cls.from_text(_read(Path(source)), cell_size_m=cell_size_m, name=Path(source).stem)

    # ---- Generators --------------------------------------------------------------------------

    @classmethod
    def random(
        cls, *, n_rows: int = 10, n_cols: int = 10, density: float = 0.2, seed: int = 0, cell_size_m: float = 0.5
    ) -> Layout:
        """Single blocks at random until a share ``density`` of the cells is wall; every free cell stays reachable.

        Raises:
            InputError: When the size or density is out of range, or so many blocks cannot be placed.
        """
        _check_size(n_rows, n_cols)
        if not 0.0 <= density <= 1.0:
            raise InputError(f"density {density} is outside [0, 1]: it is the share of cells that are walls")
        rng = np.random.default_rng(seed)
        walls = np.zeros((n_rows, n_cols), dtype=bool)
        wanted = round(density * walls.size)
        for index in rng.permutation(walls.size):
            if walls.sum() == wanted:
                break
            walls.flat[index] = True
            if (~walls).sum() < 2 or ndimage.label(~walls)[1] != 1:
                walls.flat[index] = False
        if walls.sum() < wanted:
            raise InputError(
                f"density {density} leaves no connected maze of {n_rows} x {n_cols} cells with seed {seed}: lower it"
            )
        return cls(walls, ~walls, ~walls, cell_size_m, f"random-{n_rows}x{n_cols}-{density:g}-{seed}")

    @classmethod
    def maze(cls, *, n_rows: int = 11, n_cols: int = 11, seed: int = 0, cell_size_m: float = 0.5) -> Layout:
        """A perfect maze (one way between any two cells) by depth-first search with a random order.

        Rooms lie on even rows and columns, so both counts must be odd.

        Raises:
            InputError: When a count is even or out of range.
        """
        _check_size(n_rows, n_cols)
        if n_rows % 2 == 0 or n_cols % 2 == 0:
            raise InputError(f"a maze of {n_rows} x {n_cols} cells cannot be made: both counts must be odd")
        rng = np.random.default_rng(seed)
        walls = np.ones((n_rows, n_cols), dtype=bool)
        walls[0, 0] = False
        stack = [(0, 0)]
        while stack:
            row, col = stack[-1]
            rooms = [(row + dr, col + dc) for dr, dc in ((-2, 0), (2, 0), (0, -2), (0, 2))]
            closed = [(r, c) for r, c in rooms if 0 <= r < n_rows and 0 <= c < n_cols and walls[r, c]]
            if not closed:
                stack.pop()
                continue
            r, c = closed[rng.integers(len(closed))]
            walls[r, c] = walls[(row + r) // 2, (col + c) // 2] = False
            stack.append((r, c))
        return cls(walls, ~walls, ~walls, cell_size_m, f"maze-{n_rows}x{n_cols}-{seed}")

    def with_moved_walls(self, n: int, rng: np.random.Generator, *, kept: Sequence[Cell] = ()) -> Layout:
        """A layout in which up to ``n`` wall cells stand elsewhere and the free cells still hang together.

        Starts and goals stay where they are; where every free cell was one, every free cell is one.

        Args:
            n: How many walls.
            rng: Chooses them and where they go.
            kept: Reachable cells beside starts and goals that stay free and reachable.
        """
        walls = self.walls.copy()
        any_start, any_goal = (bool((mask == ~walls).all()) for mask in (self.starts, self.goals))
        stays = (self.starts & (not any_start)) | (self.goals & (not any_goal))
        for cell in kept:
            stays[cell] = True
        n_regions = ndimage.label(~walls)[1]
        for _ in range(n):
            # From and to: uniform over walls, and over free cells that are neither start nor goal.
            sources, targets = (rng.permutation(np.argwhere(cells)) for cells in (walls, ~walls & ~stays))
            for source, target in zip(sources, targets, strict=False):
                moved = walls.copy()
                moved[tuple(source)], moved[tuple(target)] = False, True
                regions, n_now = ndimage.label(~moved)
                if n_now <= n_regions and len(np.unique(regions[stays])) <= 1:
                    walls = moved
                    break
        starts, goals = (~walls if any_start else self.starts), (~walls if any_goal else self.goals)
        return replace(self, walls=walls, starts=starts, goals=goals)

    # ---- Cells and metres --------------------------------------------------------------------

    @property
    def n_rows(self) -> int:
        """Rows of cells."""
        return int(self.walls.shape[0])

    @property
    def n_cols(self) -> int:
        """Columns of cells."""
        return int(self.walls.shape[1])

    @property
    def n_cells(self) -> int:
        """Cells, walls included."""
        return int(self.walls.size)

    @property
    def size_m(self) -> tuple[float, float]:
        """Width (x) and height (y) of the grid, metres."""
        return self.n_cols * self.cell_size_m, self.n_rows * self.cell_size_m

    def is_free(self, cell: Cell) -> bool:
        """Whether the cell lies on the grid and is no wall."""
        row, col = cell
        return 0 <= row < self.n_rows and 0 <= col < self.n_cols and not self.walls[row, col]

    def to_metres(self, cells: IntArray) -> FloatArray:
        """Centres of cells: (row, column), shape ``(..., 2)``, to (x, y) in metres, world frame.

        The origin is the lower-left corner, x points right and y up.
        """
        cells = np.asarray(cells)
        x = (cells[..., 1] + 0.5) * self.cell_size_m
        y = (self.n_rows - cells[..., 0] - 0.5) * self.cell_size_m
        return np.stack([x, y], axis=-1)

    def to_cell(self, points_w: FloatArray) -> IntArray:
        """Cells that hold points: (x, y) in metres, shape ``(..., 2)``, to (row, column), clipped to the grid."""
        points_w = np.asarray(points_w)
        col = np.floor(points_w[..., 0] / self.cell_size_m)
        row = self.n_rows - 1 - np.floor(points_w[..., 1] / self.cell_size_m)
        cells = np.stack([np.clip(row, 0, self.n_rows - 1), np.clip(col, 0, self.n_cols - 1)], axis=-1)
        return cells.astype(np.int64)

    def wall_rectangles(self) -> FloatArray:
        """The inner walls merged into few rectangles that cover each wall cell once.

        Returns:
            x_min, y_min, x_max, y_max in metres, world frame, shape ``(n_rectangles, 4)``.
        """
        left = self.walls.copy()
        rectangles = []
        for row, col in np.argwhere(self.walls):
            if not left[row, col]:
                continue
            right = col
            while right + 1 < self.n_cols and left[row, right + 1]:
                right += 1
            bottom = row
            while bottom + 1 < self.n_rows and left[bottom + 1, col : right + 1].all():
                bottom += 1
            left[row : bottom + 1, col : right + 1] = False
            rectangles.append((col, self.n_rows - bottom - 1, right + 1, self.n_rows - row))
        return np.array(rectangles, dtype=np.float64).reshape(-1, 4) * self.cell_size_m

    def __eq__(self, other: object) -> bool:
        """Equal walls, starts, goals and cell size; the name does not matter."""
        return (
            isinstance(other, Layout)
            and self.cell_size_m == other.cell_size_m
            and np.array_equal(self.walls, other.walls)
            and np.array_equal(self.starts, other.starts)
            and np.array_equal(self.goals, other.goals)
        )

    def __hash__(self) -> int:
        """Follows ``__eq__``."""
        return hash((self.cell_size_m, self.walls.tobytes(), self.starts.tobytes(), self.goals.tobytes()))

    def _validate(self) -> None:
        _check_size(self.n_rows, self.n_cols)
        if not (np.isfinite(self.cell_size_m) and self.cell_size_m > 0):
            raise InputError(f"cell_size_m {self.cell_size_m} must be a positive number of metres")
        ends = self.starts | self.goals
        if (ends & self.walls).any():
            row, col = np.argwhere(ends & self.walls)[0]
            raise InputError(f"layout cell ({row}, {col}) is a wall and so can be no start or goal")
        if not self.starts.any() or not self.goals.any() or ends.sum() < 2:
            raise InputError("a layout needs at least two free cells, a start and a goal that differ")
        regions = ndimage.label(~self.walls)[0]
        start, *_ = self.start_cells
        for cells, what in ((self.goal_cells, "goal"), (self.start_cells, "start")):
            for row, col in cells:
                if regions[row, col] != regions[tuple(start)]:
                    raise _UnreachableError(what, (int(row), int(col)), (int(start[0]), int(start[1])))
        object.__setattr__(self, "reachable", regions == regions[tuple(start)])
        self.reachable.setflags(write=False)


class _UnreachableError(InputError):
    """A start or goal lies in another region than the first start."""

    def __init__(self, what: str, cell: Cell, start: Cell) -> None:
        self.what, self.cell, self.start = what, cell, start
        super().__init__(f"layout: the {what} at cell {cell} cannot be reached from the start at cell {start}")

    def located(self, name: str, first_line: int) -> str:
        """The message in lines and columns of the text."""
        (row, col), (start_row, start_col) = self.cell, self.start
        return (
            f"layout {_short(name)}, line {row + first_line}, column {col + 1}: this {self.what} cannot be reached "
            f"from the start at line {start_row + first_line}, column {start_col + 1}; open a way or make it '#'"
        )


def _rows(text: str, name: str) -> tuple[list[str], int]:
    """The maze's lines and the number of the first, once each character and length is right."""
    name = _short(name)
    lines = [line.rstrip() for line in text.splitlines()]
    filled = [number for number, line in enumerate(lines) if line]
    if not filled:
        raise InputError(f"layout {name} is empty: it needs lines of '#', '.', 'S' and 'G'")
    first, last = filled[0], filled[-1]
    rows = lines[first : last + 1]
    if len(rows) > MAX_SIDE or len(rows[0]) > MAX_SIDE:
        _check_size(len(rows), len(rows[0]))
    for number, row in enumerate(rows, start=first + 1):
        for column, character in enumerate(row, start=1):
            if character not in (WALL, FREE, START, GOAL):
                raise InputError(
                    f"layout {name}, line {number}, column {column}: {character!r} is none of "
                    "'#' wall, '.' free, 'S' start, 'G' goal"
                )
        if len(row) != len(rows[0]):
            column = min(len(row), len(rows[0])) + 1
            raise InputError(
                f"layout {name}, line {number}, column {column}: the line has {len(row)} cells and line "
                f"{first + 1} has {len(rows[0])}; all lines must be equally long"
            )
    return rows, first + 1


def _read(path: Path) -> str:
    """The text of a layout file, with one clear error for everything that can be wrong with it."""
    shown = f"'{_short(str(path))}'"
    try:
        if not path.exists():
            known = ", ".join(NAMED_LAYOUTS)
            raise InputError(f"unknown layout {shown}: it is no file, and the named layouts are {known}")
        if not path.is_file():
            raise InputError(f"layout {shown} is not a file: give a text file, or one of the named layouts")
        with path.open("rb") as file:
            content = file.read(MAX_FILE_BYTES + 1)
        if len(content) > MAX_FILE_BYTES:
            raise InputError(f"layout {shown} is larger than {MAX_FILE_BYTES} bytes, the most a layout can need")
        return content.decode("utf-8")
    except UnicodeDecodeError:
        raise InputError(f"layout {shown} is not a text file: it must be UTF-8") from None
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise InputError(f"layout {shown} cannot be read: {reason}") from None


def _short(text: str) -> str:
    """The text fit for a message of one line: it may come from a hostile file name."""
    text = text if text.isprintable() else repr(text)[1:-1]
    return text if len(text) <= 100 else f"{text[:37]}...{text[-60:]}"


def _check_size(n_rows: int, n_cols: int) -> None:
    if not (1 <= n_rows <= MAX_SIDE and 1 <= n_cols <= MAX_SIDE):
        raise InputError(f"a layout of {n_rows} x {n_cols} cells is out of range: 1 to {MAX_SIDE} rows and columns")
