"""The needle's safety filter and its kinematics for compiled loops: a command held for a step, and where it leads.

The arithmetic is that of `NeedleSafetyFilter.filter` and of `NeedleKinematics.moved`; both are compared in the tests.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.safety.barriers import AddedRows, measure, nearest_clear
from magnetosuture_thread.safety.certificate import WALL, PosedNeedle
from magnetosuture_thread.safety.packed_scene import PackedScene

Pair = tuple[float, float]


class BodyData(NamedTuple):
    """The needle's body, in the frame of its tail with its heading along x; for compiled code.

    Attributes:
        points: that stand for the needle, shape (m, 2) [m].
        turning: velocity of each for a tip velocity of 1 m/s across the chord, shape (m, 2).
        straight: whether the needle is.
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
        hold: for which a velocity has to keep clear [s].
        keep: least distance of a point of the needle from shapes [m].
        keep_wall: least distance of a point from the wall [m].
        keep_out: least distance of the needle's axis from both [m].
        rate: share of a margin by which the needle may approach [1/s].
        band: by which the barriers keep farther away than the certificate asks for [m].
        max_speed: of the tip [m/s].
        max_acceleration: greatest change of the velocity before the barriers [m/s^2].
        rest_share: of the speed commanded; a needle that is left no more rests.
        scene: packed.
        added: no rows.
    """

    body: BodyData
    hold: float
    keep: float
    keep_wall: float
    keep_out: float
    rate: float
    band: float
    max_speed: float
    max_acceleration: float
    rest_share: float
    scene: PackedScene
    added: AddedRows


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
    return PosedNeedle(
        points,
        turning,
        body.straight,
        chord_x,
        chord_y,
        body.turn,
        data.hold,
        data.keep,
        data.keep_wall,
        distances,
        normal,
    )


@compiled
def needle_margin(data: FilterData, needle: PosedNeedle) -> tuple[float, int]:
    """Return the least distance of the needle's axis from what is solid, less keep_out [m], and of which shape."""
    least, shape = np.inf, WALL
    for i in range(len(needle.points)):
        wall = data.scene.radius - math.hypot(needle.points[i, 0], needle.points[i, 1])
        if wall < least:
            least, shape = wall, WALL
        for s in range(needle.distances.shape[1]):
            if needle.distances[i, s] < least:
                least, shape = needle.distances[i, s], int(data.scene.shapes[s])
    return least - data.keep_out, shape


@compiled
def limit_pair(x: float, y: float, largest: float) -> Pair:
    """Return a vector scaled down to a maximum norm."""
    greatest = max(abs(x), abs(y))
    if greatest == 0.0:
        return 0.0, 0.0
    ux, uy = x / greatest, y / greatest
    norm = math.sqrt(ux * ux + uy * uy)
    if greatest * norm <= largest:
        return x, y
    return ux * (largest / norm), uy * (largest / norm)


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
    """Return what `NeedleSafetyFilter.filter` leaves of a commanded tip velocity; 0 where the needle rests.

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
    vx, vy = limit_pair(slowdown * commanded[0], slowdown * commanded[1], data.max_speed)
    change = data.max_acceleration * elapsed
    if change < np.inf and math.hypot(vx - previous[0], vy - previous[1]) > change * (1.0 + 1e-12):
        dx, dy = limit_pair(vx - previous[0], vy - previous[1], change)
        vx, vy = previous[0] + dx, previous[1] + dy
    if vx == 0.0 and vy == 0.0:
        return 0.0, 0.0
    x, y = nearest_clear(vx, vy, needle, data.rate, data.band, data.scene, data.added, touched)
    if math.hypot(x, y) <= data.rest_share * math.hypot(vx, vy):
        return 0.0, 0.0
    return x, y


@compiled
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
    body = data.body
    x, y, heading_x, heading_y = pose[0], pose[1], pose[2], pose[3]
    ex = body.chord_x * heading_x - body.chord_y * heading_y
    ey = body.chord_x * heading_y + body.chord_y * heading_x
    if body.chord == 0.0:
        pose[0] = x + duration * (velocity[0] + added[0] * ex - added[1] * ey)
        pose[1] = y + duration * (velocity[1] + added[0] * ey + added[1] * ex)
        return
    along, across = ex * velocity[0] + ey * velocity[1], ex * velocity[1] - ey * velocity[0]
    lever = 0.5 * body.chord
    half = 0.5 * (across / lever + added[2]) * duration
    reach = duration * (math.sin(half) / half if half != 0.0 else 1.0)
    forwards, left = reach * (along + added[0]), reach * added[1]
    c, s = math.cos(half), math.sin(half)
    ux, uy = c * ex - s * ey, s * ex + c * ey
    middle_x = x + lever * ex + forwards * ux - left * uy
    middle_y = y + lever * ey + forwards * uy + left * ux
    c, s = c * c - s * s, 2.0 * c * s
    hx, hy = c * heading_x - s * heading_y, s * heading_x + c * heading_y
    size = math.hypot(hx, hy)
    hx, hy = hx / size, hy / size
    ex, ey = body.chord_x * hx - body.chord_y * hy, body.chord_x * hy + body.chord_y * hx
    pose[0], pose[1], pose[2], pose[3] = middle_x - lever * ex, middle_y - lever * ey, hx, hy
