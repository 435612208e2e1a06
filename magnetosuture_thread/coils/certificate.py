"""The certificate: for how long a constant motion of the needle keeps it clear. The guarantee is here, and only here.

A constant motion takes every point p of the needle along an arc of a circle,

    p(t) = p + d(t),    d(t) = t sinc(omega t / 2) R(omega t / 2) v_p

With m = tan(omega t / 2) / (omega / 2), which is t where omega = 0, and v' = v_p turned by a right angle to the left,

    n . d = [ (n . v_p) m + (omega / 2) (n . v') m^2 ] / (1 + omega^2 m^2 / 4)
    |d|^2 = |v_p|^2 m^2 / (1 + omega^2 m^2 / 4)

so that the time at which the point meets a line or a circle is the root of a quadratic in m, in closed form and
without steps in time. Points closer to an obstacle than f lie in the discs of radius f around its corners and in the
strips of width f along its edges; a point that comes from outside crosses one of these first.

Source: none; the discs and strips are the Minkowski sum of a polygon's boundary and a disc.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.compiled import compiled, compiled_inner, compiled_uncounted
from magnetosuture_thread.geometry.obstacles import EDGE_WIDTH, WorkspaceData, measure
from magnetosuture_thread.geometry.polyline import Points

ROUNDING = 1e-13
"""What a point that is at its bound may get nearer in one hold, so that rounding does not keep it from sliding [m]."""
"""A point this near to a polygon, or inside of it, goes by the side that it has to leave by [m]."""
WALL, NOTHING = -1, -2
"""In the place of a shape's index."""


class BodyData(NamedTuple):
    """The needle's body, in the frame of its tail with its heading along x; for compiled code.

    Attributes:
        points: that stand for the needle, shape (m, 2) [m].
        turning: velocity of each for a tip velocity of 1 m/s across the chord, shape (m, 2).
        straight: whether the needle is; its first and last point are then the ones nearest to the wall.
        chord: distance from tail to tip, 0 of a needle that is a point [m].
        chord_x: unit vector from tail to tip.
        chord_y: unit vector from tail to tip.
        turn: rate of turning for that velocity [rad/m].
    """

    points: Points
    turning: Points
    straight: bool
    chord: float
    chord_x: float
    chord_y: float
    turn: float


class FilterData(NamedTuple):
    """A safety filter without barriers of a user, for compiled code. Not to be written to.

    Attributes:
        body: of the needle.
        hold: for which a motion has to keep clear [s].
        turn_time: for how much of it the needle goes on turning at the most [s].
        keep: minimum distance of a point of the needle from shapes [m].
        keep_wall: minimum distance of a point from the wall [m].
        keep_out: minimum distance of the needle's axis from both [m].
        rate: share of a margin by which the needle may approach [1/s].
        max_speed: of the tip [m/s].
        max_acceleration: maximum change of the velocity before the barriers [m/s^2].
        scene: dish and shapes.
    """

    body: BodyData
    hold: float
    turn_time: float
    keep: float
    keep_wall: float
    keep_out: float
    rate: float
    max_speed: float
    max_acceleration: float
    scene: WorkspaceData


class PosedNeedle(NamedTuple):
    """The needle in one pose, and how far everything is from it, for compiled code.

    Attributes:
        data: the needle, and what it keeps from.
        points: that stand for the needle, shape (m, 2) [m].
        turning: velocity of each for a tip velocity of 1 m/s across the chord, shape (m, 2).
        chord_x: unit vector along the chord.
        chord_y: unit vector along the chord.
        distances: signed distance of each point from each disc, then polygon, shape (m, s) [m].
        normal: its gradient, shape (m, s, 2).
    """

    data: FilterData
    points: Points
    turning: Points
    chord_x: float
    chord_y: float
    distances: NDArray[np.float64]
    normal: NDArray[np.float64]


@compiled
def pose_needle(data: FilterData, x: float, y: float, heading_x: float, heading_y: float) -> PosedNeedle:
    """Return the needle with its tail at (x, y) [m] and a unit heading, its distances from all shapes measured."""
    body = data.body
    count, shapes = len(body.points), len(data.scene.shapes)
    points, turning = np.empty((count, 2)), np.empty((count, 2))
    for i in range(count):
        px, py = body.points[i, 0], body.points[i, 1]
        points[i, 0], points[i, 1] = px * heading_x - py * heading_y + x, px * heading_y + py * heading_x + y
        px, py = body.turning[i, 0], body.turning[i, 1]
        turning[i, 0], turning[i, 1] = px * heading_x - py * heading_y, px * heading_y + py * heading_x
    distances, normal = np.empty((count, shapes)), np.empty((count, shapes, 2))
    measure(points, data.scene, distances, normal)
    chord_x = body.chord_x * heading_x - body.chord_y * heading_y
    chord_y = body.chord_x * heading_y + body.chord_y * heading_x
    return PosedNeedle(data, points, turning, chord_x, chord_y, distances, normal)


@compiled_inner
def crossings(square: float, linear: float, constant: float, omega: float) -> tuple[float, float]:
    """Return the times of both roots of  square m^2 + linear m + constant = 0  within a turn, rising; inf for none.

        m = tan(omega t / 2) / (omega / 2)

    Negative roots come after the positive ones, in the second half of the turn; where omega is 0, never.
    """
    disc = linear * linear - 4.0 * square * constant
    if not disc >= 0.0:
        return np.inf, np.inf
    q = -0.5 * (linear + math.copysign(math.sqrt(disc), linear))
    if q == 0.0:
        return np.inf, np.inf
    rate = 0.5 * abs(omega)
    first, second = np.inf, np.inf
    for k in range(2):
        m = q / square if k == 0 else constant / q
        if not rate > 0.0:
            t = m if m >= 0.0 else np.inf
        else:
            t = math.atan(m * rate) / rate if m >= 0.0 else (math.pi + math.atan(m * rate)) / rate
        if k == 0:
            first = t
        else:
            second = t
    return (first, second) if first <= second else (second, first)


@compiled_inner
def circle_exit(
    qx: float, qy: float, gap: float, radius: float, vx: float, vy: float, omega: float, outside: bool
) -> float:
    """Return when a point that is off a circle by `gap` > 0 meets it, inf for never [s].

    Args:
        qx: of the point from the circle's centre [m].
        qy: of the point from the circle's centre [m].
        gap: to the circle, with the point's distance from the centre exact [m].
        radius: of the circle [m].
        vx: velocity of the point now [m/s].
        vy: velocity of the point now [m/s].
        omega: by which that velocity turns [rad/s].
        outside: whether the point is outside of the circle.
    """
    away = radius + gap if outside else radius - gap
    c = gap * (away + radius)  # the difference of the squares without a difference
    a = qx * vx + qy * vy
    b = -qx * vy + qy * vx  # q . (v turned to the left)
    square = vx * vx + vy * vy + omega * b
    if outside:
        return crossings(square + 0.25 * omega * omega * c, 2.0 * a, c, omega)[0]
    return crossings(-square + 0.25 * omega * omega * c, -2.0 * a, c, omega)[0]


@compiled_inner
def _disc_time(qx: float, qy: float, base: float, keep: float, vx: float, vy: float, omega: float) -> float:
    """Return when a point gets nearer to a disc of radius `base` than `keep`, or than it is if that is nearer [s]."""
    away = math.hypot(qx, qy)
    radius = min(base + keep, away) - ROUNDING
    if radius <= 0.0:
        return np.inf  # in the disc's very middle: any way leads out
    return circle_exit(qx, qy, away - radius, radius, vx, vy, omega, True)


@compiled_inner
def _strip_time(
    qx: float, qy: float, dx: float, dy: float, length: float, floor: float, vx: float, vy: float, omega: float
) -> float:
    """Return when a point enters the strip of width `floor` along the outer side of an edge, inf for never [s].

    Args:
        qx: of the point from the edge's start [m].
        qy: of the point from the edge's start [m].
        dx: unit direction of the edge.
        dy: unit direction of the edge.
        length: of the edge [m].
        floor: width of the strip [m].
        vx: velocity of the point now [m/s].
        vy: velocity of the point now [m/s].
        omega: by which that velocity turns [rad/s].
    """
    nx, ny = dy, -dx  # outwards, as the solid is to the left
    room = nx * qx + ny * qy - floor
    a, b = nx * vx + ny * vy, -nx * vy + ny * vx
    first, second = crossings(0.5 * omega * b + 0.25 * omega * omega * room, a, room, omega)
    # From outside of the line it is crossed inwards first, from within outwards first.
    t = first if room >= 0.0 else second
    if t == np.inf:
        return t
    half = 0.5 * omega * t
    reach = t * (math.sin(half) / half if abs(half) > 1e-9 else 1.0)
    c, s = math.cos(half), math.sin(half)
    along = dx * qx + dy * qy + reach * (dx * (c * vx - s * vy) + dy * (s * vx + c * vy))
    slack = 1e-9 * (1.0 + length)  # beyond the ends is what the corners' discs are for; rounding opens no gap
    return t if -slack <= along <= length + slack else np.inf


@compiled_inner
def _polygon_time(needle: PosedNeedle, i: int, s: int, vx: float, vy: float, omega: float, limit: float) -> float:
    """Return when a point gets nearer to a polygon than `keep`, or than it is if that is nearer; `limit` for later [s].

    A point inside must leave by the nearest side: it goes no deeper than it is, and by at most `keep` beyond it.
    """
    scene, keep = needle.data.scene, needle.data.keep
    x, y, distance = needle.points[i, 0], needle.points[i, 1], needle.distances[i, s]
    best, polygon = limit, s - len(scene.discs)
    if distance <= 1e-12:
        gx, gy = needle.normal[i, s, 0], needle.normal[i, s, 1]
        depth = max(-distance, 0.0)
        a, b = gx * vx + gy * vy, -gx * vy + gy * vx
        room = ROUNDING
        best = min(best, crossings(0.5 * omega * b + 0.25 * omega * omega * room, a, room, omega)[0])
        return min(best, circle_exit(-depth * gx, -depth * gy, keep, depth + keep, vx, vy, omega, False))
    floor = min(keep, distance) - ROUNDING
    speed = math.hypot(vx, vy)
    for block in range(scene.polygons[polygon, 0], scene.polygons[polygon, 1]):
        far = scene.circles[block, 2] + floor + speed * best
        bx, by = x - scene.circles[block, 0], y - scene.circles[block, 1]
        if bx * bx + by * by > far * far:
            continue
        begin = scene.ranges[block, 0]
        for edge in range(begin, begin + scene.ranges[block, 1]):
            k = edge * EDGE_WIDTH
            qx, qy = x - scene.edges[k], y - scene.edges[k + 1]
            dx, dy, length = scene.edges[k + 4], scene.edges[k + 5], scene.edges[k + 6]
            travel = speed * best
            near = floor + travel
            if qx * qx + qy * qy <= near * near:
                room = math.hypot(qx, qy) - floor
                best = min(best, circle_exit(qx, qy, max(room, ROUNDING), floor, vx, vy, omega, True))
            side, along = dy * qx - dx * qy, dx * qx + dy * qy
            if abs(side - floor) <= travel and -travel <= along <= length + travel:
                best = min(best, _strip_time(qx, qy, dx, dy, length, floor, vx, vy, omega))
    return best


@compiled_uncounted
def safe_time(vx: float, vy: float, needle: PosedNeedle, drift: float = 0.0) -> tuple[float, int, int]:
    """Return for how long a motion keeps the needle clear, at most `hold`, what ends it, and which point meets it.

    No point of the needle gets closer than `keep` to a shape or `keep_wall` to the wall; one that is closer already
    gets no closer than it is.

    Args:
        vx: velocity of the tip [m/s].
        vy: velocity of the tip [m/s].
        needle: in its pose.
        drift: part of the tip's velocity across the chord, to its left, that the whole needle has [m/s].

    Returns:
        The time [s]; the index of the shape in the scene, `WALL` or `NOTHING`; the index of the point, and -1 for none.
    """
    data, scene = needle.data, needle.data.scene
    best, what, where = data.hold, NOTHING, -1
    points, distances, chord_x, chord_y = needle.points, needle.distances, needle.chord_x, needle.chord_y
    along, across = vx * chord_x + vy * chord_y, -vx * chord_y + vy * chord_x - drift
    omega = data.body.turn * across
    count, discs = len(points), len(scene.discs)
    for i in range(count):
        x, y = points[i, 0], points[i, 1]
        px = along * chord_x - drift * chord_y + across * needle.turning[i, 0]
        py = along * chord_y + drift * chord_x + across * needle.turning[i, 1]
        speed = math.hypot(px, py)
        if speed == 0.0:
            continue
        if not data.body.straight or i == 0 or i == count - 1:
            away = math.hypot(x, y)
            radius = max(scene.wall_radius - data.keep_wall, away) + ROUNDING
            if radius - away <= speed * best:
                t = circle_exit(x, y, radius - away, radius, px, py, omega, False)
                if t < best:
                    best, what, where = t, WALL, i
        for s in range(distances.shape[1]):
            if distances[i, s] - data.keep > speed * best:
                continue
            if s < discs:
                disc = scene.discs[s]
                t = _disc_time(x - disc[0], y - disc[1], disc[2], data.keep, px, py, omega)
            else:
                t = _polygon_time(needle, i, s, px, py, omega, best)
            if t < best:
                best, what, where = t, int(scene.shapes[s]), i
    return best, what, where


@compiled
def is_clear_turned(vx: float, vy: float, needle: PosedNeedle, drift: float = 0.0) -> bool:
    """Return whether a needle keeps clear that turns for no longer than `turn_time`, and goes straight on after that.

    It turns by some angle between 0 and Phi = omega `turn_time`, at any rate. With the velocity w of its middle, its
    points are then, from when it begins, by no more than |w| `turn_time` Phi off

        F(phi, t) = c + R(phi) (p - c + t w)

    with c the middle now. F(0, t) and F(Phi, t) are straight, and asked by `safe_time` for the whole hold. The others
    lie between them, on arcs of the radius r = |p - c| + |w| `hold` at most; so they are clear by k where both are by

        sqrt((k + r Phi^2 / 8 + |w| `turn_time` Phi)^2 + (r Phi / 2)^2)

    One that is closer than that at t = 0 is not clear here, nor one that turns by more than a radian, or is a point.

    Args:
        vx: velocity of the tip [m/s].
        vy: velocity of the tip [m/s].
        needle: in its pose.
        drift: part of the tip's velocity across the chord, to its left, that the whole needle has [m/s].
    """
    data, body = needle.data, needle.data.body
    chord_x, chord_y = needle.chord_x, needle.chord_y
    along, across = vx * chord_x + vy * chord_y, -vx * chord_y + vy * chord_x - drift
    turn = body.turn * across * data.turn_time
    if body.turn == 0.0 or not abs(turn) < 1.0:
        return False
    swiftest, lever, speed = 0.0, 0.5 * body.chord, math.hypot(along, drift)
    for i in range(len(needle.points)):
        swiftest = max(swiftest, math.hypot(needle.turning[i, 0], needle.turning[i, 1]))
    reach = lever * swiftest + speed * data.hold
    off = 0.125 * reach * turn * turn + speed * data.turn_time * abs(turn)
    keep = math.hypot(data.keep + off, 0.5 * reach * turn)
    keep_wall = math.hypot(data.keep_wall + off, 0.5 * reach * turn)
    most = data.scene.wall_radius - keep_wall
    wider = FilterData(
        body,
        data.hold,
        data.turn_time,
        keep,
        keep_wall,
        data.keep_out,
        data.rate,
        data.max_speed,
        data.max_acceleration,
        data.scene,
    )
    for angle in (0.0, turn):
        cosine, sine = math.cos(angle), math.sin(angle)
        ex, ey = cosine * chord_x - sine * chord_y, sine * chord_x + cosine * chord_y
        x = needle.points[0, 0] + lever * (chord_x - ex)
        y = needle.points[0, 1] + lever * (chord_y - ey)
        turned = pose_needle(wider, x, y, body.chord_x * ex + body.chord_y * ey, body.chord_x * ey - body.chord_y * ex)
        for i in range(len(turned.points)):
            if math.hypot(turned.points[i, 0], turned.points[i, 1]) > most:
                return False
            for s in range(turned.distances.shape[1]):
                if turned.distances[i, s] < keep:
                    return False
        wx, wy = along * ex - drift * ey, along * ey + drift * ex
        if safe_time(wx, wy, turned, drift)[1] != NOTHING:
            return False
    return True
