"""Paths of the needle's body: its clearance, its shortest way by A*, and the way smoothed within the clearance.

The needle is driven along its chord and turned about the chord's middle (`NeedleKinematics`), so a way is a sequence of
straight drives, ahead or back, and of turns on the spot. The lattice has the middles on a square grid and 32 directions
to other points of it. How often the way has crossed the line across a gap, or one from a shape to the wall, is a
further coordinate: ways that differ in it go round the shapes differently.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from magnetosuture_thread.geometry.compiled import compiled, compiled_without_gil
from magnetosuture_thread.geometry.obstacles import measure, pack_obstacles
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.geometry.scene import Scene

CELLS = 400  # of the clearance map across the dish
STRIDE = 2  # of the clearance map's grid between two points of the lattice
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
    """Where a way may end, and what it must have crossed by then.

    Attributes:
        allowed: at which points of the lattice the way may be, shape (m, m), rows along y.
        places: at which points of the lattice it may end, shape (m, m), rows along y.
        headings: which of the directions, shape (32,).
        cuts: lines that the way crosses, x and y of both ends, shape (k, 4) [m].
        crossings: how often it must have crossed them, from their right to their left, less the other way round.
        lag: how far behind the middle of the chord the point is that crosses them [m].
        kept: lines that the middle crosses from left to right only where there is no other way, shape (k, 4) [m].
        target: a place that the goal is near, for the heuristic; NaN where there is none, shape (2,) [m].
    """

    allowed: NDArray[np.bool_]
    places: NDArray[np.bool_]
    headings: NDArray[np.bool_]
    cuts: NDArray[np.float64]
    crossings: int
    lag: float
    kept: NDArray[np.float64]
    target: NDArray[np.float64]


@compiled
def count_crossings(cuts: NDArray[np.float64], x: float, y: float, to_x: float, to_y: float) -> int:
    """Return how often a step crosses lines from their right to their left, less the other way round.

    Args:
        cuts: x and y of both ends of each line, shape (k, 4) [m].
        x: of the step's start [m].
        y: of the same [m].
        to_x: of its end [m].
        to_y: of the same [m].
    """
    count = 0
    for k in range(len(cuts)):
        ax, ay = cuts[k, 0], cuts[k, 1]
        ux, uy = cuts[k, 2] - ax, cuts[k, 3] - ay
        before, after = ux * (y - ay) - uy * (x - ax), ux * (to_y - ay) - uy * (to_x - ax)
        if (before >= 0.0) == (after >= 0.0):
            continue
        share = before / (before - after)
        along = ux * (x + share * (to_x - x) - ax) + uy * (y + share * (to_y - y) - ay)
        if 0.0 <= along <= ux * ux + uy * uy:
            count += 1 if after >= 0.0 else -1
    return count


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
) -> tuple[NDArray[np.float64], int]:
    """Return the cheapest way from a point of the lattice to the goal, and how many states were looked at.

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
        Of each state on the way x, y [m] and direction [rad], shape (k, 3); empty where there is no way, or none was
        found among 20 million. And the number.
    """
    moves, directions = MOVES, DIRECTIONS
    count, size, step = len(directions), len(goal.places), STRIDE * near.step
    sheets = goal.crossings + 2 if len(goal.cuts) > 0 else 1  # of net crossings, from -1 on
    cells = size * size * count
    cost = np.full(cells * sheets, np.inf, np.float32)
    parent = np.full(cells * sheets, -1, np.int32)
    done = np.zeros(cells * sheets, np.bool_)
    clear = np.full(cells, np.nan, np.float32)
    guided = not math.isnan(goal.target[0])

    first = (start[1] * size + start[0]) * count + start[2] + (cells if sheets > 1 else 0)
    cost[first] = 0.0
    heap = [(0.0, first)]
    looked, last = 0, -1
    while len(heap) > 0 and looked < 20_000_000:  # which takes a minute at most
        _, state = heapq.heappop(heap)
        if done[state]:
            continue
        done[state] = True
        looked += 1
        sheet, cell = state // cells, state % cells
        direction, place = cell % count, cell // count
        i, j = place % size, place // size
        x, y = near.origin + step * i, near.origin + step * j
        c, s = math.cos(directions[direction]), math.sin(directions[direction])
        if goal.places[j, i] and goal.headings[direction] and (sheets == 1 or sheet - 1 >= goal.crossings):
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
                # A way driven back costs half as much again.
                length *= 1.0 if choice == 0 else 1.5
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
            if sheets > 1:
                nc, ns = math.cos(directions[nd]), math.sin(directions[nd])
                behind = (x - goal.lag * c, y - goal.lag * s, nx - goal.lag * nc, ny - goal.lag * ns)
                nsheet = sheet + count_crossings(goal.cuts, *behind)
                if nsheet < 0 or nsheet >= sheets:
                    continue
            undone = choice < 2 and len(goal.kept) > 0 and count_crossings(goal.kept, x, y, nx, ny) < 0
            following = nsheet * cells + key
            # A way that undoes what was done costs 1 m more: longer than any other way in a dish.
            known = cost[state] + (1.0 if undone else 0.0)
            onward = known + length * _nearness(room, required, preferred)
            if choice < 2 and onward < cost[following]:
                # Most ways are no better than one that is known, whatever is halfway.
                halfway = body_clearance(0.5 * (x + nx), 0.5 * (y + ny), directions[nd], body, near)
                if halfway < required:
                    continue
                onward = known + length * _nearness(min(room, halfway), required, preferred)
            if onward < cost[following]:
                cost[following] = onward
                parent[following] = state
                rest = math.hypot(nx - goal.target[0], ny - goal.target[1]) if guided else 0.0
                heapq.heappush(heap, (float(onward) + rest, following))
    if last < 0:
        return np.empty((0, 3)), looked
    return _way_to(last, parent, size, near.origin, step, directions), looked


SPACING = 1.0e-4  # m; of the tip's way between two poses
PULL = 0.4  # share by which a pose moves towards the middle of its neighbours in a pass
PREFERRED = 5e-4  # m; beyond the required clearance, more is not worth a longer way
FILTER = 4.0  # poses; width of the last filter


@dataclass(frozen=True, eq=False)
class BodyPath:
    """Poses that the needle's body is to go through, one after the other.

    Attributes:
        middles: of the chord, shape (m, 2) [m].
        angles: of the chord against the x axis, unwrapped, shape (m,) [rad].
        lever: half of the needle's chord [m].
        leeway: by how much the body may be off each pose before it is as close as it may be, shape (m,) [m].
        ends: ways of the tip at which the goals on the path are reached, rising, shape (g,) [m].
    """

    middles: Points
    angles: NDArray[np.float64]
    lever: float
    leeway: NDArray[np.float64]
    ends: NDArray[np.float64]

    @classmethod
    def through(cls, poses: Points, lever: float) -> BodyPath:
        """Return a path of poses as they are, shape (m, 3), whose leeway is not known."""
        angles = np.unwrap(poses[:, 2])
        found = cls(poses[:, :2].copy(), angles, lever, np.zeros(len(poses)), np.zeros(0))
        return replace(found, ends=np.array([found.length]))

    @cached_property
    def travel(self) -> NDArray[np.float64]:
        """Way of the tip in the needle's frame up to each pose, |dx| + lever |dangle| summed up, shape (m,) [m]."""
        steps = np.hypot(*np.diff(self.middles, axis=0).T) + self.lever * np.abs(np.diff(self.angles))
        return np.concatenate([[0.0], np.cumsum(steps)])

    @property
    def poses(self) -> Points:
        """Middles and angles, shape (m, 3)."""
        return np.column_stack([self.middles, self.angles])

    @property
    def length(self) -> float:
        """Way of the tip from the first pose to the last [m]."""
        return float(self.travel[-1])

    def at(self, travel: float) -> tuple[NDArray[np.float64], float]:
        """Return middle and angle at a way of the tip."""
        x, y = (float(np.interp(travel, self.travel, column)) for column in self.middles.T)
        return np.array([x, y]), float(np.interp(travel, self.travel, self.angles))

    def part(self, begin: float, end: float) -> BodyPath:
        """Return the path from one way of the tip to another, where its last goal is reached."""
        between = (self.travel > begin) & (self.travel < end)
        (first, turned), (last, angle) = self.at(begin), self.at(end)
        middles = np.vstack([first, self.middles[between], last])
        angles, leeways = (
            np.concatenate([[from_], column[between], [to]])
            for from_, column, to in (
                (turned, self.angles, angle),
                (self.leeway_at(begin), self.leeway, self.leeway_at(end)),
            )
        )
        found = BodyPath(middles, angles, self.lever, leeways, np.zeros(0))
        return replace(found, ends=np.array([found.length]))

    def leeway_at(self, travel: float) -> float:
        """Return the leeway at a way of the tip [m]."""
        return float(np.interp(travel, self.travel, self.leeway))


def smooth_path(
    states: Points,
    ends: NDArray[np.int64],
    lever: float,
    body: Points,
    required: float,
    margin: float,
    near: ClearanceMap,
) -> BodyPath:
    """Return the path through the states of the lattice, its corners rounded as far as the clearance allows.

    Args:
        states: x, y [m] and direction [rad] of each, shape (k, 3); the first and those of the goals stay.
        ends: index of the state at which each goal is reached, shape (g,), rising; the last is that of the last state.
        lever: half of the needle's chord [m].
        body: points of the needle's axis, see `body_clearance`.
        required: clearance of the body [m].
        margin: how much more than that is kept on the path [m].
        near: distances from wall and shapes.
    """
    poses, reached, first = [states[:1]], [], 0
    states = np.column_stack([states[:, :2], np.unwrap(states[:, 2])])
    for end in ends.tolist():
        part = states[first : end + 1]
        coarse = BodyPath.through(part, lever)
        at = np.linspace(0.0, coarse.length, max(2, math.ceil(coarse.length / SPACING) + 1))
        dense = np.column_stack([np.interp(at, coarse.travel, column) for column in part.T])
        _relax(dense, body, required + margin, required + margin + PREFERRED, near)
        poses.append(_filtered(dense, body, required + margin, near)[1:])
        reached.append(sum(map(len, poses)) - 1)
        first = end
    found = np.vstack(poses)
    leeway = np.array([body_clearance(x, y, angle, body, near) for x, y, angle in found]) - required
    smooth = BodyPath(found[:, :2].copy(), found[:, 2].copy(), lever, np.maximum(leeway, 0.0), np.zeros(0))
    return replace(smooth, ends=smooth.travel[reached])


def turning_points(middles: Points, angles: NDArray[np.float64], lever: float) -> list[tuple[int, float]]:
    """Return the poses at which a stretch ends that is driven in one sense, and that sense: 1 ahead, -1 back."""
    steps, turns = np.diff(middles, axis=0), np.diff(angles)
    between = 0.5 * (angles[1:] + angles[:-1])
    drive = steps[:, 0] * np.cos(between) + steps[:, 1] * np.sin(between)
    # A turn on the spot is of no sense.
    driven = np.abs(drive) > np.maximum(1e-9, 0.2 * (np.hypot(*steps.T) + lever * np.abs(turns)))
    found, sense = [], 0.0
    for k in np.flatnonzero(driven):
        here = math.copysign(1.0, drive[k])
        if sense and here != sense:
            found.append((int(k), sense))
        sense = here
    return [*found, (len(middles) - 1, sense or 1.0)]


def _filtered(poses: Points, body: Points, required: float, near: ClearanceMap) -> Points:
    """Return the poses without the kinks of the lattice, each stretch on its own, where the body stays clear."""
    smooth, first = poses.copy(), 0
    for last, _ in turning_points(poses[:, :2], poses[:, 2], 0.0):
        stretch = poses[first : last + 1]
        reach = min(int(4.0 * FILTER), len(stretch) - 1)
        if reach > 1:
            padded = np.pad(stretch, ((reach, reach), (0, 0)), mode="reflect", reflect_type="odd")
            smooth[first : last + 1] = gaussian_filter1d(padded, FILTER, axis=0)[reach:-reach]
        first = last
    near_before = [body_clearance(x, y, angle, body, near) for x, y, angle in poses]
    for k, (x, y, angle) in enumerate(smooth):
        if body_clearance(x, y, angle, body, near) < min(required, near_before[k]):
            smooth[k] = poses[k]
    return np.asarray(smooth)


@compiled_without_gil
def _relax(poses: Points, body: Points, required: float, preferred: float, near: ClearanceMap) -> None:
    """Move each pose to the middle of its neighbours, and turn it along the way, where the clearance allows.

    A clearance may not fall below the one that is preferred; where it is less already, it may not fall at all.
    """
    count = len(poses)
    # Passes of the smoothing.
    for _ in range(400):
        for k in range(1, count - 1):
            x, y, angle = poses[k, 0], poses[k, 1], poses[k, 2]
            nx = x + PULL * (0.5 * (poses[k - 1, 0] + poses[k + 1, 0]) - x)
            ny = y + PULL * (0.5 * (poses[k - 1, 1] + poses[k + 1, 1]) - y)
            turned = angle + PULL * (0.5 * (poses[k - 1, 2] + poses[k + 1, 2]) - angle)
            wx, wy = poses[k + 1, 0] - poses[k - 1, 0], poses[k + 1, 1] - poses[k - 1, 1]
            way = math.hypot(wx, wy)
            if way > 0.0:
                # Ahead or back, whichever is nearer to how it is headed; the less it goes, the less this says.
                off = (math.atan2(wy, wx) - turned + 0.5 * math.pi) % math.pi - 0.5 * math.pi
                # The heading turns to the way by 0.3 of the difference.
                turned += 0.3 * min(1.0, way / (2.0 * SPACING)) * off
            # The clearance may fall by 1 um in a pass, so that a corner of the lattice can be rounded.
            kept = max(required, min(preferred, body_clearance(x, y, angle, body, near)) - 1e-6)
            if body_clearance(nx, ny, turned, body, near) >= kept:
                poses[k, 0], poses[k, 1], poses[k, 2] = nx, ny, turned
            elif body_clearance(x, y, turned, body, near) >= kept:
                poses[k, 2] = turned
            elif body_clearance(nx, ny, angle, body, near) >= kept:
                poses[k, 0], poses[k, 1] = nx, ny
