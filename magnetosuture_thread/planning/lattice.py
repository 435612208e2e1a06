"""The clearance of the needle's body in a scene, and its shortest way: A* over a lattice of positions and headings.

The needle is driven along its chord and turned about the chord's middle (`NeedleKinematics`), so a way is a sequence of
straight drives, ahead or back, and of turns on the spot. The lattice has the middles on a square grid and 32 directions
to other points of it. Where a way is to lead around a shape, the angle swept about that shape is a further coordinate.
"""

from __future__ import annotations

import heapq
import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled, compiled_without_gil
from magnetosuture_thread.geometry.obstacles.distances import measure, pack_obstacles
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.scene import Scene

CELLS = 400  # of the clearance map across the dish
STRIDE = 2  # of the clearance map's grid between two points of the lattice
REVERSE_COST = 1.5  # of a way driven back, in that of the same way ahead
MAX_STATES = 20_000_000  # to look at
NEAR_COST = 3.0  # of a way at the required clearance, more than at the preferred one
_QUARTER = np.array([(1, 0), (3, 1), (2, 1), (3, 2), (1, 1), (2, 3), (1, 2), (1, 3)])
_TURNS = (((1, 0), (0, 1)), ((0, -1), (1, 0)), ((-1, 0), (0, -1)), ((0, 1), (-1, 0)))
MOVES = np.concatenate([_QUARTER @ np.array(turn).T for turn in _TURNS])
"""Points ahead for each direction, counterclockwise from the x axis, shape (32, 2)."""
DIRECTIONS = np.unwrap(np.arctan2(MOVES[:, 1], MOVES[:, 0]))
"""Their angles, rising from 0, shape (32,) [rad]."""


class ClearanceMap(NamedTuple):
    """The signed distance to the nearest of wall and shapes, at the points of a square grid over the dish.

    Attributes:
        origin: x and y of the first point [m].
        step: between points [m].
        distance: shape (m, m), rows along y [m].
    """

    origin: float
    step: float
    distance: NDArray[np.float64]


@lru_cache(maxsize=16)  # a plan asks for each of a few maps many times
def map_clearance(scene: Scene, shapes: tuple[str, ...] | None = None) -> ClearanceMap:
    """Return the distances from the wall and all shapes of a scene; from some shapes alone, if they are named.

    It is computed once for each scene and shapes, and not to be changed.

    Args:
        scene: dish and shapes.
        shapes: names of the shapes to measure from, without the wall; None for wall and all shapes.
    """
    packed = pack_obstacles(scene.obstacles, scene.dish.radius)
    radius = scene.dish.radius
    at = np.linspace(-radius, radius, CELLS + 1)
    wanted = [k for k in range(len(packed.shapes)) if shapes is None or scene.names[packed.shapes[k]] in shapes]
    distance = np.full((len(at), len(at)), np.inf)
    found, normal = np.empty((len(at), len(packed.shapes))), np.empty((len(at), len(packed.shapes), 2))
    for row, y in enumerate(at):
        points = np.column_stack([at, np.full(len(at), y)])
        measure(points, packed, found, normal)
        distance[row] = found[:, wanted].min(axis=1, initial=np.inf)
        if shapes is None:
            distance[row] = np.minimum(distance[row], radius - np.hypot(points[:, 0], points[:, 1]))
    return ClearanceMap(-radius, float(at[1] - at[0]), distance)


@compiled
def clearance_at(x: float, y: float, near: ClearanceMap) -> float:
    """Return the distance at a point, interpolated between the four around it; negative outside of the grid [m]."""
    count = len(near.distance)
    u, v = (x - near.origin) / near.step, (y - near.origin) / near.step
    i, j = math.floor(u), math.floor(v)
    if i < 0 or j < 0 or i >= count - 1 or j >= count - 1:
        return -1.0
    p, q = u - i, v - j
    low = (1.0 - p) * near.distance[j, i] + p * near.distance[j, i + 1]
    high = (1.0 - p) * near.distance[j + 1, i] + p * near.distance[j + 1, i + 1]
    return float((1.0 - q) * low + q * high)


@compiled
def body_clearance(x: float, y: float, angle: float, body: Points, near: ClearanceMap) -> float:
    """Return the least distance of the needle's points from wall and shapes [m].

    Args:
        x: of the middle of its chord [m].
        y: of the same [m].
        angle: of its chord against the x axis [rad].
        body: points of the needle's axis about the middle of its chord, the chord along x, shape (m, 2) [m].
        near: the distances.
    """
    c, s = math.cos(angle), math.sin(angle)
    least = np.inf
    for k in range(len(body)):
        px, py = body[k, 0], body[k, 1]
        least = min(least, clearance_at(x + c * px - s * py, y + s * px + c * py, near))
    return float(least)


class LatticeGoal(NamedTuple):
    """Where a way may end.

    Attributes:
        allowed: at which points of the lattice the way may be, shape (m, m), rows along y.
        places: at which points of the lattice it may end, shape (m, m), rows along y.
        headings: which of the directions, shape (32,).
        swept: angle that must have been swept about `centre`, positive counterclockwise [rad]; 0 for any.
        centre: of the shape that the way leads around, shape (2,) [m].
        target: a place that the goal is near, for the heuristic; NaN where there is none, shape (2,) [m].
    """

    allowed: NDArray[np.bool_]
    places: NDArray[np.bool_]
    headings: NDArray[np.bool_]
    swept: float
    centre: NDArray[np.float64]
    target: NDArray[np.float64]


def turn_of(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return angles within half a turn of 0 [rad]."""
    return np.asarray((angles + math.pi) % (2.0 * math.pi) - math.pi)


@compiled
def _nearness(room: float, required: float, preferred: float) -> float:
    """Return the factor on the cost of a way, by the clearance of the body on it."""
    share = min(1.0, max(0.0, (preferred - room) / max(preferred - required, 1e-12)))
    return 1.0 + (NEAR_COST - 1.0) * share


@compiled
def _way_to(
    last: int, parent: NDArray[np.int32], size: int, origin: float, step: float, directions: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return x, y and direction of the states that led to one, shape (k, 3)."""
    count = len(directions)
    cells = size * size * count
    steps, state = 1, last
    while parent[state] >= 0:
        state = parent[state]
        steps += 1
    path = np.empty((steps, 3))
    state = last
    for k in range(steps - 1, -1, -1):
        cell = state % cells
        place = cell // count
        path[k, 0] = origin + step * (place % size)
        path[k, 1] = origin + step * (place // size)
        path[k, 2] = directions[cell % count]
        state = parent[state]
    return path


@compiled_without_gil
def search_lattice(
    start: NDArray[np.int64],
    body: Points,
    lever: float,
    required: float,
    preferred: float,
    goal: LatticeGoal,
    near: ClearanceMap,
) -> NDArray[np.float64]:
    """Return the cheapest way from a point of the lattice to the goal: x, y and direction of each state.

    The cost is the way of the tip, times `NEAR_COST` where the body is as close as it may be, falling to 1 where it is
    at the preferred clearance.

    Args:
        start: column, row and direction, shape (3,).
        body: points of the needle's axis, see `body_clearance`.
        lever: half of the needle's chord [m].
        required: clearance of the body [m].
        preferred: clearance beyond which more is not worth a longer way [m].
        goal: where the way may end.
        near: distances from wall and shapes.

    Returns:
        Shape (k, 3): x, y [m] and direction [rad]; empty where there is no way, or none was found
        within `MAX_STATES`.
    """
    moves, directions = MOVES, DIRECTIONS
    count, size, step = len(directions), len(goal.places), STRIDE * near.step
    sheets = math.ceil(abs(goal.swept) / (2.0 * math.pi)) + 2 if goal.swept != 0.0 else 1
    cells = size * size * count
    cost = np.full(cells * sheets, np.inf, np.float32)
    parent = np.full(cells * sheets, -1, np.int32)
    done = np.zeros(cells * sheets, np.bool_)
    clear = np.full(cells, np.nan, np.float32)
    sense = 1.0 if goal.swept >= 0.0 else -1.0
    guided = not math.isnan(goal.target[0])

    x0, y0 = near.origin + step * start[0], near.origin + step * start[1]
    begin = math.atan2(y0 - goal.centre[1], x0 - goal.centre[0])
    first = (start[1] * size + start[0]) * count + start[2] + (cells if sheets > 1 else 0)
    cost[first] = 0.0
    heap = [(0.0, first)]
    looked, last = 0, -1
    while len(heap) > 0 and looked < MAX_STATES:
        _, state = heapq.heappop(heap)
        if done[state]:
            continue
        done[state] = True
        looked += 1
        sheet, cell = state // cells, state % cells
        direction, place = cell % count, cell // count
        i, j = place % size, place // size
        x, y = near.origin + step * i, near.origin + step * j
        angle = math.atan2(y - goal.centre[1], x - goal.centre[0])
        ahead = (sense * (angle - begin)) % (2.0 * math.pi)  # of the start, on sheet 0 from 0 to 2 pi
        if goal.places[j, i] and goal.headings[direction]:
            swept = ahead + 2.0 * math.pi * (sheet - 1 if sheets > 1 else 0)
            if goal.swept == 0.0 or swept >= abs(goal.swept) - 1e-9:
                last = state
                break
        for choice in range(4):
            ni, nj, nd, nsheet = i, j, direction, sheet
            if choice < 2:
                sign = 1 if choice == 0 else -1
                ni, nj = i + sign * moves[direction, 0], j + sign * moves[direction, 1]
                if ni < 0 or nj < 0 or ni >= size or nj >= size:
                    continue
                length = step * math.hypot(float(moves[direction, 0]), float(moves[direction, 1]))
                length *= 1.0 if choice == 0 else REVERSE_COST
            else:
                nd = (direction + (1 if choice == 2 else count - 1)) % count
                turn = abs(directions[nd] - directions[direction])
                length = lever * min(turn, 2.0 * math.pi - turn)
            nx, ny = near.origin + step * ni, near.origin + step * nj
            if not goal.allowed[nj, ni]:
                continue
            key = (nj * size + ni) * count + nd
            if math.isnan(clear[key]):
                clear[key] = body_clearance(nx, ny, directions[nd], body, near)
            room = clear[key]
            if room < required:
                continue
            if sheets > 1 and choice < 2:
                there = math.atan2(ny - goal.centre[1], nx - goal.centre[0])
                way = (there - angle + math.pi) % (2.0 * math.pi) - math.pi
                later = (sense * (there - begin)) % (2.0 * math.pi)
                turns = (ahead + sense * way - later) / (2.0 * math.pi)
                nsheet = sheet + round(turns)
                if nsheet < 0 or nsheet >= sheets:
                    continue
            following = nsheet * cells + key
            onward = cost[state] + length * _nearness(room, required, preferred)
            if choice < 2 and onward < cost[following]:
                # Most ways are no better than one that is known, whatever is halfway.
                halfway = body_clearance(0.5 * (x + nx), 0.5 * (y + ny), directions[nd], body, near)
                if halfway < required:
                    continue
                onward = cost[state] + length * _nearness(min(room, halfway), required, preferred)
            if onward < cost[following]:
                cost[following] = onward
                parent[following] = state
                rest = math.hypot(nx - goal.target[0], ny - goal.target[1]) if guided else 0.0
                heapq.heappush(heap, (float(onward) + rest, following))
    if last < 0:
        return np.empty((0, 3))
    return _way_to(last, parent, size, near.origin, step, directions)
