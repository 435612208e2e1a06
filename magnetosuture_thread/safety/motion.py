"""The needle's safety filter in compiled code: the needle in a pose, and what is left of a commanded velocity."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.obstacles.distances import measure
from magnetosuture_thread.safety.barriers import nearest_clear, no_rows
from magnetosuture_thread.safety.certificate import WALL, FilterData, PosedNeedle
from magnetosuture_thread.safety.kinematics import move_pose

Pair = tuple[float, float]

STUCK = 1e-3
"""Share of the speed after the limits; a needle that is left no more rests."""


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


@compiled
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


@compiled
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


@compiled
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
    chord = (data.body.chord, data.body.chord_x, data.body.chord_y)
    ex, ey = chord[1] * pose[2] - chord[2] * pose[3], chord[1] * pose[3] + chord[2] * pose[2]
    along, across = ex * velocity[0] + ey * velocity[1], ex * velocity[1] - ey * velocity[0]
    if chord[0] == 0.0:
        move_pose(chord, pose, along + added[0], across + added[1], 0.0, duration)
    else:
        move_pose(chord, pose, along + added[0], added[1], across / (0.5 * chord[0]) + added[2], duration)
