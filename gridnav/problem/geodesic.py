"""Distance to the goal: exact on cells, any-angle and radius-aware in metres.

On the grid it is breadth-first search. For a robot it is the shortest way of a disc among the walls
(LaValle, *Planning Algorithms*, section 6.2.4): such a way runs straight from convex wall corner to
convex wall corner, so it is found on the graph of corners that see each other. A corner is rounded by
the disc's radius; three points stand for the arc, which is up to 2.3 % of the arc too long (4 mm at
each right-angle turn of a 0.105 m robot) and never too short, save half a millimetre for a robot that
touches the corner.
"""

from __future__ import annotations

import numba
import numpy as np
from scipy.sparse import csgraph, csr_array

from gridnav.problem.layout import Layout
from gridnav.problem.types import BoolArray, Cell, FloatArray, InputError, IntArray

TOLERANCE_M = 1e-6
"""Slack of the clearance test: it keeps points that lie exactly one radius off a wall in sight."""
ANCHOR_REACH = 1.0 / np.cos(np.pi / 12)
"""Distance of the points around a corner, in radii: the chords between points 30 degrees apart clear the arc."""


def cell_distances(layout: Layout, goal: Cell) -> FloatArray:
    """Fewest moves from every cell to the goal.

    Args:
        layout: The maze.
        goal: A free cell, (row, column).

    Returns:
        Shape ``(n_rows, n_cols)``, cells; infinite on walls and where no way leads.
    """
    index = np.arange(layout.n_cells).reshape(layout.walls.shape)
    free = ~layout.walls
    sideways, upward = free[:, 1:] & free[:, :-1], free[1:] & free[:-1]
    here = np.concatenate([index[:, 1:][sideways], index[1:][upward]])
    there = np.concatenate([index[:, :-1][sideways], index[:-1][upward]])
    graph = csr_array((np.ones(here.size), (here, there)), shape=(layout.n_cells, layout.n_cells))
    moves: FloatArray = csgraph.dijkstra(graph, directed=False, unweighted=True, indices=int(index[goal]))
    return moves.reshape(layout.walls.shape)


MAX_SIGHT_TESTS = 200_000_000
"""Larger mazes do without the list of anchors in sight of each cell: it would take longer to make than it saves."""


def cell_path(layout: Layout, start: Cell, goal: Cell) -> list[Cell]:
    """A shortest way by moves between cells, both ends included; of equal moves up, down, left, right the first.

    Raises:
        ValueError: When the goal cannot be reached.
    """
    left = np.pad(cell_distances(layout, goal), 1, constant_values=np.inf)
    path = [(int(start[0]), int(start[1]))]
    if not np.isfinite(left[path[0][0] + 1, path[0][1] + 1]):
        raise ValueError(f"goal {goal} cannot be reached from {start}")
    while path[-1] != tuple(goal):
        row, column = path[-1]
        around = [(row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)]
        path.append(min(around, key=lambda cell: float(left[cell[0] + 1, cell[1] + 1])))
    return path


class Geodesic:
    """Shortest way of a disc from any point of a layout to the centres of its cells.

    Args:
        layout: The maze; its outer edge is a wall too.
        radius_m: Radius of the disc, less than half a cell so that every corridor is passable.
    """

    def __init__(self, layout: Layout, radius_m: float) -> None:
        if not radius_m > TOLERANCE_M:
            raise InputError(f"radius_m {radius_m} must be a positive number of metres")
        if not radius_m < layout.cell_size_m / 2:
            raise InputError(
                f"cell_size_m {layout.cell_size_m} is too small: a robot of radius {radius_m} m needs cells "
                f"wider than {2 * radius_m} m"
            )
        self.layout = layout
        self.radius_m = radius_m
        self._anchors = _anchors(layout, radius_m)
        self._in_sight, self._spans = _in_sight(layout, self._anchors)
        self._graph = self._visible_lengths(self._anchors)
        self._goals = np.empty((0, 2))
        # Of each goal and anchor: length of the way, and the next anchor on it, their number for the goal itself.
        self._costs = np.empty((0, len(self._anchors)))
        self._next = np.empty((0, len(self._anchors)), dtype=np.int32)
        self._number_of_cell = np.full(layout.walls.shape, -1)

    def goal_numbers(self, goals: IntArray) -> IntArray:
        """Numbers under which ``distances`` knows goals; each is worked out at its first use.

        Args:
            goals: Free cells, (row, column), shape ``(n, 2)``.
        """
        numbers = self._number_of_cell[goals[:, 0], goals[:, 1]]
        if (numbers < 0).any():
            for row, col in np.unique(goals[numbers < 0], axis=0).tolist():
                self._add_goal((row, col))
            numbers = self._number_of_cell[goals[:, 0], goals[:, 1]]
        return numbers

    def goal_number(self, goal: Cell) -> int:
        """``goal_numbers`` of one cell."""
        return int(self.goal_numbers(np.array([goal]))[0])

    def distances(self, points_w: FloatArray, goal_numbers: IntArray) -> FloatArray:
        """Length of the shortest way of the disc's centre to each point's goal.

        A point nearer to a wall than the radius (a robot pressed against it) may leave the wall or
        keep its distance, so the length stays finite and continuous there.

        Args:
            points_w: x and y in metres, world frame, outside the walls, shape ``(n, 2)``; more columns do not matter.
            goal_numbers: From ``goal_numbers``, shape ``(n,)``.

        Returns:
            Shape ``(n,)``, metres; infinite where no way leads.
        """
        out = np.empty(len(points_w))
        _shortest(
            points_w,
            goal_numbers,
            self._goals,
            self._anchors,
            self._in_sight,
            self._spans,
            self._costs,
            self.layout.walls,
            self.layout.cell_size_m,
            self.radius_m,
            out,
        )
        return out

    def distance(self, point_w: FloatArray, goal: Cell) -> float:
        """``distances`` for one point, shape ``(2,)``, and one goal cell; metres."""
        return float(self.distances(np.asarray(point_w)[None], np.array([self.goal_number(goal)]))[0])

    def path(self, point_w: FloatArray, goal: Cell) -> FloatArray:
        """The shortest way itself: straight from point to point, as long as ``distance`` says.

        Args:
            point_w: x and y in metres, world frame, outside the walls, shape ``(2,)``; more numbers do not matter.
            goal: A free cell, (row, column).

        Returns:
            The point, the corners to be rounded (up to three points each) and the goal, metres, world frame, shape
            ``(n, 2)``; empty where no way leads.
        """
        number, point_w = self.goal_number(goal), np.asarray(point_w, dtype=np.float64)[:2]
        goal_w, walls, cell = self._goals[number], self.layout.walls, self.layout.cell_size_m
        nodes, costs = np.concatenate([self._anchors, goal_w[None]]), np.append(self._costs[number], 0.0)
        seen = _visible_from(point_w, nodes, walls, cell, _slim(point_w[0], point_w[1], walls, cell, self.radius_m))
        totals = np.where(seen, np.hypot(*(nodes - point_w).T), np.inf) + costs
        node = int(totals.argmin())
        if np.isinf(totals[node]):
            return np.empty((0, 2))
        way = [point_w, nodes[node]]
        while node < len(self._anchors):
            node = int(self._next[number, node])
            way.append(nodes[node])
        return np.stack(way)

    def _add_goal(self, goal: Cell) -> None:
        goal_w = self.layout.to_metres(np.array(goal))
        nodes = np.concatenate([self._anchors, goal_w[None]])
        n = len(self._anchors)
        lengths = np.full((n + 1, n + 1), np.inf)
        lengths[:n, :n] = self._graph
        seen = _visible_from(goal_w, self._anchors, self.layout.walls, self.layout.cell_size_m, self.radius_m)
        lengths[n, :n] = np.where(seen, np.hypot(*(self._anchors - nodes[n]).T), np.inf)
        lengths[:n, n] = lengths[n, :n]
        lengths[~np.isfinite(lengths)] = 0.0  # csgraph reads a zero of a dense matrix as "no edge"
        # Searched from the goal: what comes before an anchor there comes after it on the way to the goal.
        costs, following = csgraph.dijkstra(csr_array(lengths), directed=False, indices=n, return_predecessors=True)
        self._number_of_cell[goal] = len(self._goals)
        self._goals = np.concatenate([self._goals, goal_w[None]])
        self._costs = np.concatenate([self._costs, costs[None, :n]])
        self._next = np.concatenate([self._next, following[None, :n]])

    def _visible_lengths(self, anchors: FloatArray) -> FloatArray:
        """Lengths of the straight ways between anchors, shape ``(n, n)``, infinite where a wall is in the way."""
        lengths = np.full((len(anchors), len(anchors)), np.inf)
        for i, anchor in enumerate(anchors):
            seen = _visible_from(anchor, anchors, self.layout.walls, self.layout.cell_size_m, self.radius_m)
            lengths[i, seen] = np.hypot(*(anchors[seen] - anchor).T)
        return lengths


def clearances(points_w: FloatArray, layout: Layout) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Distance of points to the nearest wall, the outer wall included, and the direction to it.

    Only walls within one cell of the point's own are looked at: beyond, the distance reads one cell.

    Args:
        points_w: x and y in metres, world frame, shape ``(n, 2)``; more columns do not matter.
        layout: The maze.

    Returns:
        Distance in metres, 0 inside a wall, shape ``(n,)``; unit vectors to the nearest wall point, world frame,
        shape ``(n, 2)``; whether it belongs to an inner wall, shape ``(n,)``.
    """
    n = len(points_w)
    distance, direction, inner = np.empty(n), np.empty((n, 2)), np.empty(n, dtype=np.bool_)
    _clearances(points_w, layout.walls, layout.cell_size_m, distance, direction, inner)
    return distance, direction, inner


def _anchors(layout: Layout, radius_m: float) -> FloatArray:
    """Points around every convex wall corner, a little more than one radius away, where the disc fits."""
    # The outer edge is a wall: it makes the corner points on it flat or concave, so they drop out.
    padded = np.pad(layout.walls, 1, constant_values=True)
    reach = radius_m * ANCHOR_REACH
    spread = np.array([-np.pi / 6, 0.0, np.pi / 6])
    points = []
    for row in range(1, layout.n_rows):
        for col in range(1, layout.n_cols):
            around = padded[row : row + 2, col : col + 2]
            if around.sum() != 1:
                continue
            wall_down, wall_right = np.argwhere(around)[0]
            away = np.arctan2(1.0 if wall_down else -1.0, -1.0 if wall_right else 1.0)
            corner = np.array([col, layout.n_rows - row]) * layout.cell_size_m
            points.append(corner + reach * np.stack([np.cos(away + spread), np.sin(away + spread)], axis=1))
    anchors = np.concatenate(points) if points else np.empty((0, 2))
    distance, _, _ = clearances(anchors, layout)
    return np.ascontiguousarray(anchors[distance >= radius_m - TOLERANCE_M])


def _in_sight(layout: Layout, anchors: FloatArray) -> tuple[IntArray, IntArray]:
    """Anchors that may be seen from somewhere in each cell: a query need not look at the others.

    Returns:
        Numbers of anchors, shape ``(n,)``, and where in them those of each cell begin and end, ``(n_cells, 2)``.
    """
    rectangles = layout.wall_rectangles()
    if layout.n_cells * len(anchors) * len(rectangles) > MAX_SIGHT_TESTS:
        return np.arange(len(anchors)), np.tile([0, len(anchors)], (layout.n_cells, 1))
    hidden = np.zeros((layout.n_cells, len(anchors)), dtype=np.bool_)
    _hide(anchors, rectangles, layout.n_rows, layout.n_cols, layout.cell_size_m, hidden)
    cells, numbers = np.nonzero(~hidden)
    ends = np.searchsorted(cells, np.arange(layout.n_cells + 1))
    return numbers, np.stack([ends[:-1], ends[1:]], axis=1)


@numba.njit(cache=True)
def _hide(
    anchors: FloatArray, rectangles: FloatArray, n_rows: int, n_cols: int, cell: float, hidden: BoolArray
) -> None:
    """Mark the anchors that one wall hides from a whole cell.

    What a convex wall hides from a point is convex, so a cell lies in it if its four corners do.
    """
    for number in range(n_rows * n_cols):
        left, bottom = (number % n_cols) * cell, (n_rows - 1 - number // n_cols) * cell
        for k in range(len(anchors)):
            for r in range(len(rectangles)):
                corner = 0
                while corner < 4:
                    x, y = left + (corner % 2) * cell, bottom + (corner // 2) * cell
                    if not _crosses(anchors[k, 0], anchors[k, 1], x, y, rectangles[r]):
                        break
                    corner += 1
                if corner == 4:
                    hidden[number, k] = True
                    break


@numba.njit(cache=True)
def _crosses(ax: float, ay: float, bx: float, by: float, rectangle: FloatArray) -> bool:
    """Whether a segment meets a rectangle of x_min, y_min, x_max, y_max."""
    enter, leave = 0.0, 1.0
    for start, step, low, high in (
        (ax, bx - ax, rectangle[0], rectangle[2]),
        (ay, by - ay, rectangle[1], rectangle[3]),
    ):
        if step == 0.0:
            if start < low or start > high:
                return False
        else:
            t0, t1 = (low - start) / step, (high - start) / step
            enter, leave = max(enter, min(t0, t1)), min(leave, max(t0, t1))
    return enter <= leave


@numba.njit(cache=True)
def _shortest(
    points: FloatArray,
    goal_numbers: IntArray,
    goals: FloatArray,
    anchors: FloatArray,
    in_sight: IntArray,
    spans: IntArray,
    costs: FloatArray,
    walls: BoolArray,
    cell: float,
    radius: float,
    out: FloatArray,
) -> None:
    """Best first over the anchors: the first one in sight, in order of total length, is the answer."""
    n_rows, n_cols = walls.shape
    totals = np.empty(len(anchors) + 1)
    for i in range(len(points)):
        x, y = points[i, 0], points[i, 1]
        slim = _slim(x, y, walls, cell, radius)
        goal = goals[goal_numbers[i]]
        cost = costs[goal_numbers[i]]
        col = min(max(int(np.floor(x / cell)), 0), n_cols - 1)
        row = n_rows - 1 - min(max(int(np.floor(y / cell)), 0), n_rows - 1)
        near = in_sight[spans[row * n_cols + col, 0] : spans[row * n_cols + col, 1]]
        n = len(near)
        for k in range(n):
            # Not hypot: its care for huge numbers costs more than all the rest.
            dx, dy = anchors[near[k], 0] - x, anchors[near[k], 1] - y
            totals[k] = np.sqrt(dx * dx + dy * dy) + cost[near[k]]
        totals[n] = np.sqrt((goal[0] - x) ** 2 + (goal[1] - y) ** 2)
        out[i] = np.inf
        while True:
            k = n
            for j in range(n):
                if totals[j] < totals[k]:
                    k = j
            if totals[k] == np.inf:
                break
            to_x, to_y = (goal[0], goal[1]) if k == n else (anchors[near[k], 0], anchors[near[k], 1])
            if _sees(x, y, to_x, to_y, walls, cell, slim):
                out[i] = totals[k]
                break
            totals[k] = np.inf


@numba.njit(cache=True)
def _slim(x: float, y: float, walls: BoolArray, cell: float, radius: float) -> float:
    """Radius with which a disc at this point looks for its first corner, or the goal."""
    # A robot nearer to a wall than its radius may keep its distance. And where it touches a corner, it sees the
    # points around only through a sliver of the corner's arc.
    return float(min(radius, clearance(x, y, walls, cell)[0] / ANCHOR_REACH))


@numba.njit(cache=True)
def _visible_from(point: FloatArray, others: FloatArray, walls: BoolArray, cell: float, radius: float) -> BoolArray:
    seen = np.empty(len(others), dtype=np.bool_)
    for k in range(len(others)):
        seen[k] = _sees(point[0], point[1], others[k, 0], others[k, 1], walls, cell, radius)
    return seen


@numba.njit(cache=True)
def _sees(ax: float, ay: float, bx: float, by: float, walls: BoolArray, cell: float, radius: float) -> bool:
    """Whether a disc can roll straight from a to b."""
    allowed = radius - TOLERANCE_M
    n_rows, n_cols = walls.shape
    low = max(int((min(ay, by) - radius) / cell), 0)
    high = min(int((max(ay, by) + radius) / cell), n_rows - 1)
    for band in range(low, high + 1):  # rows counted from below
        # The stretch of the segment that can come within a radius of this row of cells.
        x0, x1 = ax, bx
        if ay != by:
            t0 = (band * cell - radius - ay) / (by - ay)
            t1 = ((band + 1) * cell + radius - ay) / (by - ay)
            t0, t1 = max(0.0, min(t0, t1)), min(1.0, max(t0, t1))
            x0, x1 = ax + t0 * (bx - ax), ax + t1 * (bx - ax)
        left = max(int((min(x0, x1) - radius) / cell), 0)
        right = min(int((max(x0, x1) + radius) / cell), n_cols - 1)
        for col in range(left, right + 1):
            if walls[n_rows - 1 - band, col]:
                wx, wy = col * cell, band * cell
                if _segment_box(ax, ay, bx, by, wx, wy, cell) < allowed:
                    return False
    return True


@numba.njit(cache=True)
def _point_box(x: float, y: float, left: float, bottom: float, side: float) -> float:
    dx = max(left - x, 0.0, x - left - side)
    dy = max(bottom - y, 0.0, y - bottom - side)
    return float(np.hypot(dx, dy))


@numba.njit(cache=True)
def _segment_box(ax: float, ay: float, bx: float, by: float, left: float, bottom: float, side: float) -> float:
    """Distance between a segment and a square, 0 where they meet."""
    enter, leave = 0.0, 1.0
    for start, step, near in ((ax, bx - ax, left), (ay, by - ay, bottom)):
        if step == 0.0:
            if start < near or start > near + side:
                leave = -1.0
        else:
            t0, t1 = (near - start) / step, (near + side - start) / step
            enter, leave = max(enter, min(t0, t1)), min(leave, max(t0, t1))
    if enter <= leave:
        return 0.0
    nearest = min(_point_box(ax, ay, left, bottom, side), _point_box(bx, by, left, bottom, side))
    length2 = (bx - ax) ** 2 + (by - ay) ** 2
    for cx in (left, left + side):
        for cy in (bottom, bottom + side):
            t = 0.0
            if length2 > 0.0:
                t = min(1.0, max(0.0, ((cx - ax) * (bx - ax) + (cy - ay) * (by - ay)) / length2))
            nearest = min(nearest, np.hypot(ax + t * (bx - ax) - cx, ay + t * (by - ay) - cy))
    return float(nearest)


@numba.njit(cache=True)
def _clearances(
    points: FloatArray, walls: BoolArray, cell: float, distance: FloatArray, direction: FloatArray, inner: BoolArray
) -> None:
    for i in range(len(points)):
        distance[i], direction[i, 0], direction[i, 1], inner[i] = clearance(points[i, 0], points[i, 1], walls, cell)


@numba.njit(cache=True)
def clearance(x: float, y: float, walls: BoolArray, cell: float) -> tuple[float, float, float, bool]:
    """``clearances`` of one point, for compiled loops: distance, direction x and y, whether the wall is inner."""
    n_rows, n_cols = walls.shape
    nearest, to_x, to_y, inner = cell, 1.0, 0.0, False
    for gap, ux, uy in (
        (x, -1.0, 0.0),
        (n_cols * cell - x, 1.0, 0.0),
        (y, 0.0, -1.0),
        (n_rows * cell - y, 0.0, 1.0),
    ):
        if gap < nearest:
            nearest, to_x, to_y = max(gap, 0.0), ux, uy
    col, band = int(np.floor(x / cell)), int(np.floor(y / cell))
    for b in range(max(band - 1, 0), min(band + 2, n_rows)):
        for c in range(max(col - 1, 0), min(col + 2, n_cols)):
            if walls[n_rows - 1 - b, c]:
                dx = min(max(x, c * cell), (c + 1) * cell) - x
                dy = min(max(y, b * cell), (b + 1) * cell) - y
                gap = np.hypot(dx, dy)
                if gap < nearest:
                    nearest, inner = gap, True
                    if gap > 0.0:
                        to_x, to_y = dx / gap, dy / gap
    return nearest, to_x, to_y, inner
