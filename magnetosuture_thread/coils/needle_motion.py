"""The needle's safety filter in compiled code: the needle in a pose, and what is left of a commanded velocity.

The barriers find the tip velocity, nearest to the one commanded, that keeps the needle clear of wall and shapes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.coils.certificate import (
    NOTHING,
    WALL,
    FilterData,
    PosedNeedle,
    is_clear_turned,
    safe_time,
)
from magnetosuture_thread.geometry.compiled import compiled, compiled_inline, compiled_inner, compiled_uncounted
from magnetosuture_thread.geometry.needle_arc import needle_chord
from magnetosuture_thread.geometry.obstacles import ContactRows, polygon_rows, shape_distance
from magnetosuture_thread.geometry.polyline import Points

Vector = NDArray[np.float64]

LEAN, DEPTH = 0.1, 1e-5  # rad and m; so far beyond its bound, a point that slides leaves at this angle
MAX_ROWS = 2048
BAND = 2e-6  # m; by which the barriers keep farther away than the certificate, so that a needle can slide there
PASSES = 4  # of the projection, each with what the motion of the one before bends into and meets
ACTIVE = 1e-6  # of the speed; a barrier that leaves less room than this is active
SURE = 1.0 - 1e-9  # of the certified time, against rounding
ROUNDING = 1e-12  # of a projection beyond a line, relative to the size of the projected point
STUCK = 1e-3  # of the speed after the limits; a needle that is left no more rests
Pair = tuple[float, float]


@compiled_uncounted
def move_pose(
    chord: tuple[float, float, float], pose: Vector, along: float, left: float, turn_rate: float, duration: float
) -> None:
    """Move a needle whose motion is constant in the frame of its body.

    Args:
        chord: its length [m], and cosine and sine of its angle against the heading.
        pose: tail [m] and heading, written, shape (4,).
        along: velocity of the chord's middle along the chord [m/s].
        left: velocity of the middle across the chord, to its left [m/s].
        turn_rate: [rad/s].
        duration: [s].
    """
    length, c0, s0 = chord
    x, y, heading_x, heading_y = pose[0], pose[1], pose[2], pose[3]
    ex, ey = c0 * heading_x - s0 * heading_y, c0 * heading_y + s0 * heading_x
    lever, half = 0.5 * length, 0.5 * turn_rate * duration
    reach = duration * (math.sin(half) / half if half != 0.0 else 1.0)
    c, s = math.cos(half), math.sin(half)
    ux, uy = c * ex - s * ey, s * ex + c * ey  # the chord's direction halfway
    middle_x = x + lever * ex + reach * (along * ux - left * uy)
    middle_y = y + lever * ey + reach * (along * uy + left * ux)
    c, s = c * c - s * s, 2.0 * c * s
    hx, hy = c * heading_x - s * heading_y, s * heading_x + c * heading_y
    size = math.hypot(hx, hy)
    hx, hy = hx / size, hy / size
    pose[0], pose[1] = middle_x - lever * (c0 * hx - s0 * hy), middle_y - lever * (c0 * hy + s0 * hx)
    pose[2], pose[3] = hx, hy


class NeedleTwist(NamedTuple):
    """Motion of the needle in its own frame: x along its chord from tail to tip, y to the left.

    Attributes:
        along: velocity of the chord's middle along the chord [m/s].
        across: the same across it, to its left [m/s].
        turn_rate: counter-clockwise [rad/s].
    """

    along: float = 0.0
    across: float = 0.0
    turn_rate: float = 0.0

    def less(self, other: NeedleTwist) -> NeedleTwist:
        """Return the motion that gives this one together with another."""
        return NeedleTwist(self.along - other.along, self.across - other.across, self.turn_rate - other.turn_rate)

    def scaled(self, factor: float) -> NeedleTwist:
        """Return the same motion, slower or faster by a factor."""
        return NeedleTwist(factor * self.along, factor * self.across, factor * self.turn_rate)


@dataclass(frozen=True)
class NeedleKinematics:
    """A needle that is driven along its chord and turned about the middle of it.

        u = v . e,    omega = (v . n - w) / (chord / 2)
        x_middle(t) = x_middle + t sinc(omega t / 2) R(omega t / 2) (u e + w n),    heading(t) = R(omega t) heading

    with the tip's velocity v when the motion begins, the unit vector e from tail to tip and n to its left, and the
    velocity w at which the whole needle drifts across its chord, if it does. The velocity is constant in the frame of
    the needle's body: currents that do not change pull and turn the needle with it. A needle of length 0 is a point,
    which goes straight.

    Attributes:
        length: of the needle along its body; 0 for a point [m].
        curvature: of its arc, positive to the left of its heading [1/m].
    """

    length: float
    curvature: float = 0.0

    @cached_property
    def _chord(self) -> tuple[float, float, float]:
        """Length of the chord [m], cosine and sine of its angle against the heading."""
        chord, turn = needle_chord(self.length, self.curvature)
        return chord, float(turn[0, 0]), float(turn[1, 0])

    @property
    def chord(self) -> float:
        """Distance from tail to tip [m]."""
        return self._chord[0]

    @property
    def lever(self) -> float:
        """Half of the chord: the distance of both ends from the middle [m]."""
        return 0.5 * self.chord

    def chord_direction(self, heading: Vector) -> Vector:
        """Return the unit vector from tail to tip for the heading at the tail, shapes (2,)."""
        _, c, s = self._chord
        x, y = float(heading[0]), float(heading[1])
        return np.array([c * x - s * y, s * x + c * y])

    def tip(self, tail: Vector, heading: Vector) -> Vector:
        """Return where the tip is, shape (2,) [m]."""
        return np.asarray(tail + self.chord * self.chord_direction(heading))

    def turned_to(self, tail: Vector, heading: Vector, angle: float) -> tuple[Vector, Vector]:
        """Return tail and heading of a needle that is turned about its chord's middle to a direction of it [rad]."""
        chord, c, s = self._chord
        e, to = self.chord_direction(heading), np.array([math.cos(angle), math.sin(angle)])
        heading = np.array([c * to[0] + s * to[1], c * to[1] - s * to[0]])
        return tail + 0.5 * chord * (e - to), heading

    def body_velocity(self, heading: Vector, velocity: Vector) -> tuple[float, float]:
        """Return the components of a tip velocity along the chord and across it, to its left [m/s]."""
        e = self.chord_direction(heading)
        x, y = float(velocity[0]), float(velocity[1])
        return float(e[0]) * x + float(e[1]) * y, float(e[0]) * y - float(e[1]) * x

    def tip_velocity(self, heading: Vector, twist: NeedleTwist) -> Vector:
        """Return the velocity of the tip under a motion, shape (2,) [m/s]."""
        e, left = self.chord_direction(heading), twist.across + 0.5 * self.chord * twist.turn_rate
        return np.array([twist.along * e[0] - left * e[1], twist.along * e[1] + left * e[0]])

    def twist(self, heading: Vector, velocity: Vector, drift: float = 0.0) -> NeedleTwist:
        """Return the motion under a tip velocity, of which a drift across the chord is of the whole needle [m/s]."""
        along, left = self.body_velocity(heading, velocity)
        if self.length == 0.0:
            return NeedleTwist(along, left, 0.0)
        return NeedleTwist(along, drift, (left - drift) / (0.5 * self.chord))

    def moved(
        self, tail: Vector, heading: Vector, along: float, across: float, duration: float, drift: float = 0.0
    ) -> tuple[Vector, Vector]:
        """Return tail and heading after a motion.

        Args:
            tail: shape (2,) [m].
            heading: unit vector at the tail, shape (2,).
            along: of the tip's velocity, the part along the chord [m/s].
            across: the part across it, to its left [m/s].
            duration: of the motion [s].
            drift: as much of that part is of the whole needle; the rest turns it [m/s].
        """
        pose = np.array([tail[0], tail[1], heading[0], heading[1]], np.float64)
        if self.length == 0.0:
            move_pose(self._chord, pose, float(along), float(across), 0.0, float(duration))
        else:
            turn_rate = (across - drift) / (0.5 * self.chord)
            move_pose(self._chord, pose, float(along), float(drift), float(turn_rate), float(duration))
        return pose[:2], pose[2:]


@compiled_uncounted
def needle_margin(data: FilterData, needle: PosedNeedle) -> tuple[float, int]:
    """Return the minimum distance of the needle's axis from wall and shapes, less keep_out [m], and of which shape."""
    minimum, shape = np.inf, WALL
    for i in range(len(needle.points)):
        wall = data.scene.wall_radius - math.hypot(needle.points[i, 0], needle.points[i, 1])
        if wall < minimum:
            minimum, shape = wall, WALL
        for s in range(needle.distances.shape[1]):
            if needle.distances[i, s] < minimum:
                minimum, shape = needle.distances[i, s], int(data.scene.shapes[s])
    return minimum - data.keep_out, shape


@compiled_uncounted
def limit_pair(x: float, y: float, largest: float) -> Pair:
    """Return a vector scaled down to a maximum norm; its direction is kept."""
    # Scaled by the largest component first: the squares of a hostile command may overflow.
    greatest = max(abs(x), abs(y))
    if greatest == 0.0:
        return 0.0, 0.0
    ux, uy = x / greatest, y / greatest
    norm = math.sqrt(ux * ux + uy * uy)
    if greatest * norm <= largest:
        return x, y
    return ux * (largest / norm), uy * (largest / norm)


@compiled_uncounted
def limit_velocity(
    commanded: Pair, slowdown: float, max_speed: float, previous: Pair, max_change: float
) -> tuple[float, float, bool, bool]:
    """Return a commanded velocity slowed down and limited (2), and whether its speed and its change were limited.

    Args:
        commanded: of the tip [m/s].
        slowdown: by the thread's friction.
        max_speed: of the tip [m/s].
        previous: velocity that the change is limited from [m/s].
        max_change: inf or not a number for no limit [m/s].
    """
    slowed_x, slowed_y = slowdown * commanded[0], slowdown * commanded[1]
    x, y = limit_pair(slowed_x, slowed_y, max_speed)
    fast = math.hypot(slowed_x, slowed_y) > max_speed * (1.0 + 1e-12)
    dx, dy = x - previous[0], y - previous[1]
    if max_change < np.inf and math.hypot(dx, dy) > max_change * (1.0 + 1e-12):
        dx, dy = limit_pair(dx, dy, max_change)
        return previous[0] + dx, previous[1] + dy, fast, True
    return x, y, fast, False


class AddedRows(NamedTuple):
    """Rows of the barriers that a user has added, on the velocity of the tip.

        rows_j . v >= -rate_j max(margin_j, 0) - drift_j

    Attributes:
        rows: shape (k, 2).
        margin: h over the size of its gradient, shape (k,) [m].
        rate: share of the margin by which it may decrease, shape (k,) [1/s].
        drift: change of the margin of a needle that stands still, as a barrier moves, shape (k,) [m/s].
        barrier: index among the names of constraints, shape (k,).
    """

    rows: Points
    margin: NDArray[np.float64]
    rate: NDArray[np.float64]
    drift: NDArray[np.float64]
    barrier: NDArray[np.int64]


@compiled
def no_rows() -> AddedRows:
    """Return no rows, for a filter without barriers of a user."""
    return AddedRows(np.empty((0, 2)), np.empty(0), np.empty(0), np.empty(0), np.empty(0, np.int64))


class Rows(NamedTuple):
    """Arrays for the rows of wall and shapes, written by `find_rows`.

    Attributes:
        margin: h, shape (k,) [m].
        gradient: of h by the point, unit vectors, shape (k, 2).
        point: index of the point, shape (k,).
        shape: index of the shape, or `WALL`, shape (k,).
    """

    margin: NDArray[np.float64]
    gradient: Points
    point: NDArray[np.int64]
    shape: NDArray[np.int64]


@compiled_inner
def find_rows(needle: PosedNeedle, reach: float, rows: Rows) -> int:
    """Write a row for every local minimum of a point's distance to the wall or a shape within reach [m].

    Returns:
        The number of rows. Where there is no room for more, a shape's nearest points are left.
    """
    data, scene, points = needle.data, needle.data.scene, needle.points
    keep, keep_wall = data.keep + BAND, data.keep_wall + BAND
    used, discs, count, room = 0, len(scene.discs), len(points), len(rows.margin)
    for i in range(count):
        x, y = points[i, 0], points[i, 1]
        away = math.hypot(x, y)
        at_end = not data.body.straight or i == 0 or i == count - 1
        if at_end and scene.wall_radius - away - keep_wall <= reach and used < room and away > 1e-9:
            rows.margin[used] = scene.wall_radius - away - keep_wall
            rows.gradient[used, 0], rows.gradient[used, 1] = -x / away, -y / away
            rows.point[used], rows.shape[used] = i, WALL
            used += 1
        for s in range(len(scene.shapes)):
            nearest, start = needle.distances[i, s], used
            if nearest - keep > reach:
                continue
            if s >= discs and nearest > 0.0:
                to = ContactRows(rows.margin, rows.gradient)
                used = max(start, polygon_rows(x, y, s - discs, reach + keep, scene, used, to).rows)
            if used == start and used < room:
                rows.margin[used] = nearest
                rows.gradient[used, 0], rows.gradient[used, 1] = needle.normal[i, s, 0], needle.normal[i, s, 1]
                used += 1
            for k in range(start, used):
                rows.margin[k] -= keep
                rows.point[k], rows.shape[k] = i, scene.shapes[s]
    return used


@compiled_uncounted
def project_onto_half_planes(
    point: NDArray[np.float64], given: Points, bounds: NDArray[np.float64], work: Points, found: NDArray[np.float64]
) -> bool:
    """Write the nearest point; `work` (k, 3) has room for rows of length one; return whether there is one."""
    # Of size one, so that the tolerance means something however small or large the point is.
    size = math.hypot(point[0], point[1])
    if size == 0.0:
        size = 1e-300
        for i in range(len(bounds)):
            size = max(size, abs(bounds[i]))
    x, y = point[0] / size, point[1] / size
    for i in range(len(given)):
        length = math.hypot(given[i, 0], given[i, 1])
        work[i, 2] = bounds[i] / length / size if length > 0.0 else -np.inf
        work[i, 0] = given[i, 0] / length if length > 0.0 else 0.0
        work[i, 1] = given[i, 1] / length if length > 0.0 else 0.0
    best, inside = np.inf, True
    for i in range(len(work)):
        nx, ny, least = work[i, 0], work[i, 1], work[i, 2]
        if nx * x + ny * y >= least:
            continue
        inside = False
        # Along the line i, from its point nearest to the origin: where all the others let it be.
        px, py, low, high = least * nx, least * ny, -np.inf, np.inf
        for j in range(len(work)):
            slope = work[j, 1] * nx - work[j, 0] * ny
            # Without slack, rounding would make two nearly equal lines exclude each other.
            missing = work[j, 2] - work[j, 0] * px - work[j, 1] * py - 1e-14
            if slope > 0.0:
                low = max(low, missing / slope)
            elif slope < 0.0:
                high = min(high, missing / slope)
        along = min(max(y * nx - x * ny, low), high)
        qx, qy = px - along * ny, py + along * nx
        square = (qx - x) ** 2 + (qy - y) ** 2
        if not square < best:
            continue
        holds = True
        for j in range(len(work)):
            if work[j, 0] * qx + work[j, 1] * qy < work[j, 2] - ROUNDING:
                holds = False
                break
        if holds:
            best, found[0], found[1] = square, size * qx, size * qy
    if inside:
        found[0], found[1] = point[0], point[1]
    return inside or best < np.inf


@compiled
def _projected(
    vx: float,
    vy: float,
    rows: Points,
    least: NDArray[np.float64],
    depth: NDArray[np.float64],
    count: int,
    lean: bool,
) -> tuple[bool, float, float]:
    """Return whether there is a velocity but zero within the rows, and the one nearest to (vx, vy).

    With `lean`, what is beyond its bound has to leave, within a sector around the way out.
    """
    speed = math.hypot(vx, vy)
    given, bounds, work, used = np.empty((2 * count, 2)), np.empty(2 * count), np.empty((2 * count, 3)), 0
    for k in range(count):
        x, y = rows[k, 0], rows[k, 1]
        if lean and depth[k] > 0.0:
            angle = LEAN * min(1.0, depth[k] / DEPTH)
            c, s = math.cos(angle), math.sin(angle)
            given[used, 0], given[used, 1], bounds[used] = c * x - s * y, c * y + s * x, max(least[k], 0.0)
            given[used + 1, 0], given[used + 1, 1], bounds[used + 1] = c * x + s * y, c * y - s * x, max(least[k], 0.0)
            used += 2
        elif math.hypot(x, y) * speed > -least[k]:  # else no velocity of this size meets it
            given[used, 0], given[used, 1], bounds[used] = x, y, least[k]
            used += 1
    found = np.empty(2)
    holds = project_onto_half_planes(np.array([vx, vy]), given[:used], bounds[:used], work[:used], found)
    if not holds:
        return False, 0.0, 0.0
    size = math.hypot(found[0], found[1])
    if not size > 1e-9 * speed:
        return False, 0.0, 0.0
    shorter = min(1.0, speed / size)
    return True, shorter * found[0], shorter * found[1]


@compiled_inner
def _tangent(x: float, y: float, what: int, needle: PosedNeedle) -> tuple[float, float, float]:
    """Return the way out (2) at a point that meets the wall or a shape, and its margin there [m]."""
    data, scene = needle.data, needle.data.scene
    if what == WALL:
        away = math.hypot(x, y)
        return -x / away, -y / away, scene.wall_radius - away - data.keep_wall
    s = 0
    while scene.shapes[s] != what:
        s += 1
    distance, gx, gy, _ = shape_distance(x, y, s, -1, scene)
    return gx, gy, distance - data.keep


@compiled_inner
def _is_clear(
    vx: float, vy: float, needle: PosedNeedle, rows: NDArray[np.float64], least: NDArray[np.float64], count: int
) -> bool:
    """Return whether rows @ v >= least and the motion is certified, as constant or as one that turns for a while.

    In the first `count` rows, of wall and shapes, a motion of the second kind has as much less of its turn.
    """
    data, holding, turned = needle.data, True, True
    across = (1.0 - data.turn_time / data.hold) * (-vx * needle.chord_y + vy * needle.chord_x)
    x, y = vx + across * needle.chord_y, vy - across * needle.chord_x
    for k in range(len(least)):
        holds = rows[k, 0] * vx + rows[k, 1] * vy >= least[k]
        holding = holding and holds
        turned = turned and (rows[k, 0] * x + rows[k, 1] * y >= least[k] if k < count else holds)
    if holding and safe_time(vx, vy, needle, 0.0)[0] >= data.hold:
        return True
    return data.turn_time < data.hold and turned and is_clear_turned(vx, vy, needle, 0.0)


@compiled_inline
def _append(added: AddedRows, count: int, rows: Points, least: Vector, depth: Vector, who: NDArray[np.int64]) -> None:
    """Write the rows of a user's barriers behind the first `count`; to assign slices takes seconds to compile."""
    for j in range(len(added.margin)):
        k = count + j
        rows[k, 0], rows[k, 1] = added.rows[j, 0], added.rows[j, 1]
        least[k] = -added.rate[j] * max(added.margin[j], 0.0) - added.drift[j]
        depth[k], who[k] = -added.margin[j], added.barrier[j]


@compiled
def nearest_clear(
    vx: float, vy: float, needle: PosedNeedle, added: AddedRows, touched: NDArray[np.bool_]
) -> tuple[float, float]:
    """Return the velocity nearest to (vx, vy) that the barriers let through and that is certified for the hold.

        grad h . J_p v >= -rate max(h, 0) + (hold / 2) max(0, -h''(v))

    for points p of the needle, with h'' the second derivative of h along the motion of the pass before, so that
    the needle leans away from what its way bends into and does not have to be slowed down for it. Where that leaves
    nothing but zero it is left out, and slowing down remains. A motion that turns for a part of the hold is let through
    as it is where the rows hold with as much less of its turning, and where that is certified.

    Args:
        vx: velocity of the tip commanded [m/s].
        vy: velocity of the tip commanded [m/s].
        needle: in its pose.
        added: rows of the barriers that a user has added.
        touched: set for each shape, then each added barrier, then the wall, that changed the velocity.
    """
    speed, hold, rate, turning = math.hypot(vx, vy), needle.data.hold, needle.data.rate, needle.turning
    points, chord_x, chord_y = needle.points, needle.chord_x, needle.chord_y
    swiftest = 0.0
    for i in range(len(points)):
        swiftest = max(swiftest, math.hypot(turning[i, 0], turning[i, 1]))
    reach = math.hypot(1.0, swiftest) * speed / rate
    margin, gradient = np.empty(MAX_ROWS), np.empty((MAX_ROWS, 2))
    point, shape = np.empty(MAX_ROWS, np.int64), np.empty(MAX_ROWS, np.int64)
    count = find_rows(needle, reach, Rows(margin, gradient, point, shape))
    fixed = count + len(added.margin)
    room = fixed + PASSES
    rows, least, depth, who = np.empty((room, 2)), np.empty(room), np.empty(room), np.empty(room, np.int64)
    for k in range(count):
        i, who[k] = point[k], shape[k]
        along = gradient[k, 0] * chord_x + gradient[k, 1] * chord_y
        aside = gradient[k, 0] * turning[i, 0] + gradient[k, 1] * turning[i, 1]
        rows[k, 0], rows[k, 1] = along * chord_x - aside * chord_y, along * chord_y + aside * chord_x
        least[k], depth[k] = -rate * max(margin[k], 0.0), -margin[k]
    _append(added, count, rows, least, depth, who)
    if not (depth[:fixed] > 0.0).any() and _is_clear(vx, vy, needle, rows[:fixed], least[:fixed], count):
        return vx, vy
    what = safe_time(vx, vy, needle, 0.0)[1]
    bounded = least.copy()
    best, bx, by = speed * speed, 0.0, 0.0  # zero, that always is allowed
    ux, uy, total = vx, vy, fixed
    for _ in range(PASSES):
        holds, x, y = False, 0.0, 0.0
        for fallback in range(4):  # the last one between barriers that close in: no nearer to any by itself
            bound = bounded if fallback < 2 else least if fallback == 2 else np.minimum(least, 0.0)
            used = total if fallback < 2 else fixed
            holds, x, y = _projected(vx, vy, rows, bound, depth, used, fallback == 0)
            if holds:
                break
        if not holds:
            break
        time, ended, where = safe_time(x, y, needle, 0.0)
        share = 1.0 if time >= hold else SURE * time / hold
        off = (share * x - vx) ** 2 + (share * y - vy) ** 2
        if off < best:
            best, bx, by, ux, uy = off, share * x, share * y, x, y
            what = ended
        if share >= 1.0:
            break
        across, forwards = -x * chord_y + y * chord_x, x * chord_x + y * chord_y
        omega = needle.data.body.turn * across
        # What the motion bends into within the hold.
        for k in range(count):
            i = point[k]
            px, py = forwards * chord_x + across * turning[i, 0], forwards * chord_y + across * turning[i, 1]
            gx, gy = gradient[k, 0], gradient[k, 1]
            aside = -px * gy + py * gx
            # A disc, or a corner for all that is known here, bends away from the point: that is left out.
            bend = -1.0 / math.hypot(points[i, 0], points[i, 1]) if shape[k] == WALL else 0.0
            second = omega * (-gx * py + gy * px) + bend * aside * aside
            bounded[k] = least[k] + max(0.0, -0.5 * hold * second)
        # And what it meets: after the hold, the point has to be on the near side of the tangent there.
        if total < room:
            px = forwards * chord_x + across * turning[where, 0]
            py = forwards * chord_y + across * turning[where, 1]
            half = 0.5 * omega * time
            way = time * (math.sin(half) / half if abs(half) > 1e-9 else 1.0)
            c, s = math.cos(half), math.sin(half)
            dx, dy = way * (c * px - s * py), way * (s * px + c * py)
            gx, gy, left = _tangent(points[where, 0] + dx, points[where, 1] + dy, ended, needle)
            along, aside = gx * chord_x + gy * chord_y, gx * turning[where, 0] + gy * turning[where, 1]
            rows[total, 0], rows[total, 1] = along * chord_x - aside * chord_y, along * chord_y + aside * chord_x
            bent = 0.5 * hold * omega * (-gx * py + gy * px)
            missing = BAND - left if left > -BAND else 0.0  # nothing beyond but to get no nearer
            bounded[total] = min((gx * dx + gy * dy + missing) / hold - min(bent, 0.0), LEAN * speed)
            least[total], depth[total] = bounded[total], 0.0
            who[total] = ended
            total += 1
    touched[:] = False
    if bx == vx and by == vy:
        return vx, vy
    if what != NOTHING:
        touched[what] = True
    worst, missing = -1, 0.0
    for k in range(total):
        least[k] = rows[k, 0] * vx + rows[k, 1] * vy - bounded[k]  # what the commanded velocity leaves
        if least[k] < missing:
            worst, missing = k, least[k]
        left = rows[k, 0] * ux + rows[k, 1] * uy - bounded[k]
        leans = depth[k] > 0.0 and least[k] < LEAN * speed * math.hypot(rows[k, 0], rows[k, 1])
        if leans or (least[k] < 0.0 and left <= ACTIVE * speed):
            touched[who[k]] = True
    if worst >= 0 and not touched.any():
        touched[who[worst]] = True
    return bx, by


@compiled
def filter_velocity(
    data: FilterData,
    needle: PosedNeedle,
    commanded: Pair,
    slowdown: float,
    previous: Pair,
    elapsed: float,
    touched: NDArray[np.bool_],
) -> Pair:
    """Return what is left of a commanded tip velocity, without barriers of a user; 0 where the needle rests.

    Args:
        data: of the filter.
        needle: in its pose.
        commanded: [m/s].
        slowdown: by the thread's friction.
        previous: velocity that the change is limited from [m/s].
        elapsed: since then, inf for no limit [s].
        touched: set for each shape, then the wall, that changed the velocity.
    """
    touched[:] = False
    if commanded[0] == 0.0 and commanded[1] == 0.0:
        return 0.0, 0.0
    x, y, _, _ = limit_velocity(commanded, slowdown, data.max_speed, previous, data.max_acceleration * elapsed)
    if x == 0.0 and y == 0.0:
        return 0.0, 0.0
    clear_x, clear_y = nearest_clear(x, y, needle, no_rows(), touched)
    if math.hypot(clear_x, clear_y) <= STUCK * math.hypot(x, y):
        return 0.0, 0.0
    return clear_x, clear_y


@compiled_uncounted
def moved_needle(
    data: FilterData, pose: NDArray[np.float64], velocity: Pair, added: NDArray[np.float64], duration: float
) -> None:
    """Move the needle by a tip velocity that is held, as the needle has it, for a time.

    Args:
        data: of the filter.
        pose: tail [m] and heading, written, shape (4,).
        velocity: of the tip [m/s].
        added: to the motion that the velocity gives: velocity of the chord's middle along it and to its left [m/s], and
            rate of turning [rad/s], shape (3,); a needle that is a point does not turn.
        duration: [s].
    """
    chord = (data.body.chord, data.body.chord_x, data.body.chord_y)
    ex, ey = chord[1] * pose[2] - chord[2] * pose[3], chord[1] * pose[3] + chord[2] * pose[2]
    along, across = ex * velocity[0] + ey * velocity[1], ex * velocity[1] - ey * velocity[0]
    if chord[0] == 0.0:
        move_pose(chord, pose, along + added[0], across + added[1], 0.0, duration)
    else:
        move_pose(chord, pose, along + added[0], added[1], across / (0.5 * chord[0]) + added[2], duration)
