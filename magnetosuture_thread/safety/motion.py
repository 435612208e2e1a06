"""The needle's safety filter in compiled code: the needle in a pose, and what is left of a commanded velocity."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.needle_arc import needle_chord
from magnetosuture_thread.geometry.obstacles.distances import measure
from magnetosuture_thread.safety.barriers import nearest_clear, no_rows
from magnetosuture_thread.safety.certificate import WALL, FilterData, PosedNeedle

Vector = NDArray[np.float64]


@compiled
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

    def chord_direction(self, heading: Vector) -> Vector:
        """Return the unit vector from tail to tip for the heading at the tail, shapes (2,)."""
        _, c, s = self._chord
        x, y = float(heading[0]), float(heading[1])
        return np.array([c * x - s * y, s * x + c * y])

    def tip(self, tail: Vector, heading: Vector) -> Vector:
        """Return where the tip is, shape (2,) [m]."""
        return np.asarray(tail + self.chord * self.chord_direction(heading))

    def body_velocity(self, heading: Vector, velocity: Vector) -> tuple[float, float]:
        """Return the components of a tip velocity along the chord and across it, to its left [m/s]."""
        e = self.chord_direction(heading)
        x, y = float(velocity[0]), float(velocity[1])
        return float(e[0]) * x + float(e[1]) * y, float(e[0]) * y - float(e[1]) * x

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
