"""Where the needle may be: velocities that would take its body into the wall or an obstacle are bent aside."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.coils.allocation import NeedleMechanics
from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.geometry.arc import needle_points
from magnetosuture_thread.geometry.half_planes import ROUNDING, nearest_within
from magnetosuture_thread.geometry.obstacles import Disc, Polygon, Surroundings, SurroundingsData, find_near
from magnetosuture_thread.geometry.polyline import Points

Vector = NDArray[np.float64]

COARSEST, FINEST = 5e-4, 1e-4  # m; bounds on the distance between the points that stand for the needle
LEAN, DEPTH = 0.1, 1e-5  # rad and m; so far beyond the bound, a needle that slides does so by this angle outwards
MOST = 10.0  # m/s; beyond, a velocity is shortened first, as rounding grows with its size
STUCK = 1e-9  # of the velocity asked for; less is none


@dataclass(frozen=True)
class _Body:
    """The needle in one pose: points p (m, 2) [m], their turning dp/d(v.n) (m, 2), chord e and n across (2,)."""

    points: Points
    turning: Points
    along: Vector
    across: Vector


class Workspace:
    """Keeps the needle's body off the dish's wall and off obstacles, by control barrier functions.

    For each of many points p of the needle's axis, and the wall or each obstacle near it,

        grad h . v_p >= -rate max(h, 0)                     h = signed distance - clearance
        v_p = (v . e) e + (v . n) / lever perp(p - middle)

    where the tip velocity v moves the needle along its chord e and turns it about the chord's middle, as
    the bridge's kinematics have it. The velocity let through is the one that is nearest to v. Zero always
    is allowed; a needle that is too near may leave or slide along, and goes no deeper.

    Held for a time t, a velocity along a curved bound leads beyond it by up to (|v| t)^2 / (2 r), and the
    next is not asked to return. So a point beyond has to leave, if it moves, at an angle that grows with
    how far it is beyond, which is a little less than the inequality allows, and is left out where it would
    let nothing but zero through, as for a needle between two walls. At 20 mm/s and 200 Hz a needle of 7 mm
    that slides along is then beyond by 2 um at most; one whose both ends touch a round wall cannot leave,
    and sinks by up to 0.3 um in each step in which it moves around.

    The axis is looked at by points at most half of the clearance apart, and from 0.1 to 0.5 mm; the
    clearance is the axis's and has to hold half of the needle's width. Between two points a distance s
    apart a corner may come nearer, by c - sqrt(c^2 - s^2 / 4): 3 % of the clearance c at s = c / 2.

    Source: A. D. Ames et al., Control Barrier Functions: Theory and Applications, 2019, section II.
    Deviation: max(h, 0) for h, so that a measured pose beyond the bound still leaves zero feasible; the angle.

    Args:
        radius: of the dish, inside [m].
        obstacles: in the dish.
        clearance: that the needle's axis keeps [m].
        rate: share of the clearance that is left by which the needle may approach [1/s].
        needle: its mechanics.
        fastest: up to this speed only what is near is looked at; beyond, all is, with the same result [m/s].

    Raises:
        ConfigurationError: an obstacle cannot be used.
    """

    def __init__(
        self,
        radius: float,
        obstacles: Sequence[Disc | Polygon],
        clearance: float,
        rate: float,
        needle: NeedleMechanics,
        fastest: float = 0.02,
    ) -> None:
        self._radius, self._keep, self._rate, self._needle = radius, clearance, rate, needle
        spacing = min(COARSEST, max(FINEST, 0.5 * clearance))
        body = needle_points(needle.length, needle.curvature, spacing)
        # Both turn with the heading, and by one product.
        self._shape = np.vstack([body.points, body.turning])
        # No point of the body moves faster than this many times the tip velocity.
        self._fastest_point = math.hypot(1.0, float(np.hypot(*body.turning.T).max()))
        # Two searches: the quick one knows what is near only, the other reaches through all of the dish.
        reach = min(4.0 * radius, clearance + self._fastest_point * fastest / rate)
        self._near = Surroundings(obstacles, reach).data
        self._all = Surroundings(obstacles, 4.0 * radius).data
        self._room(256)
        # Compile now, not in the first step: at the wall, where all is needed.
        self.safe_velocity(np.array([fastest, 0.0]), np.array([radius, 0.0]), np.array([1.0, 0.0]))
        self.clearance(np.zeros(2), np.array([1.0, 0.0]))

    def safe_velocity(self, velocity: Vector, tail: Vector, heading: Vector) -> Vector:
        """Return the tip velocity nearest to one asked for that keeps clear, zero if only rounding is left.

        Args:
            velocity: of the tip, shape (2,) [m/s].
            tail: the needle's tail, shape (2,) [m].
            heading: unit vector along the needle at its tail, shape (2,).

        Returns:
            Shape (2,) [m/s]; what was asked for, bit for bit, where that keeps clear and is at most 10 m/s.

        Raises:
            InvalidInputError: something is not finite.
        """
        speed = _speed(velocity)
        velocity = velocity * min(1.0, MOST / max(MOST, speed))
        rows, least, depth = self._constraints(min(speed, MOST), tail, heading)
        if not len(rows):
            return velocity
        found: Vector | None = None
        beyond = depth > 0.0
        if beyond.any():
            found = _if_any(nearest_within(velocity, *_leaning(rows, least, depth, beyond)), velocity)
        if found is None:
            found = _if_any(nearest_within(velocity, rows, least), velocity)
        return found if found is not None else np.zeros(2)

    def allows(self, velocity: Vector, tail: Vector, heading: Vector, tolerance: float) -> bool:
        """Return whether a tip velocity keeps clear, each point of the body within a tolerance [m/s].

        Raises:
            InvalidInputError: something is not finite.
        """
        speed = _speed(velocity)
        rows, least, _ = self._constraints(speed, tail, heading)
        return bool((rows @ velocity >= least - tolerance - ROUNDING * speed).all())

    def clearance(self, tail: Vector, heading: Vector) -> float:
        """Return the signed least distance of the needle's axis from wall and obstacles [m].

        Raises:
            InvalidInputError: something is not finite.
        """
        points = self._body(tail, heading).points
        wall = self._radius - float(np.hypot(points[:, 0], points[:, 1]).max())
        count = self._find(points, self._near)
        if not count and wall > self._near.reach:
            count = self._find(points, self._all)
        return min(wall, float(self._distance[:count].min(initial=math.inf)))

    def _constraints(self, speed: float, tail: Vector, heading: Vector) -> tuple[Points, Vector, Vector]:
        """Return rows a (k, 2) and bounds b (k,) [m/s] of a . v >= b that a speed can reach, and depths -h (k,) [m]."""
        body = self._body(tail, heading)
        # The nearest velocity is no faster than the one asked for, since zero is allowed.
        far = self._keep + self._fastest_point * speed / self._rate
        size = np.hypot(body.points[:, 0], body.points[:, 1])
        at_wall = np.flatnonzero(self._radius - size <= far)
        count = self._find(body.points, self._near if far <= self._near.reach else self._all)
        at_obstacle = np.flatnonzero(self._distance[:count] <= far)
        if not len(at_wall) and not len(at_obstacle):
            return np.empty((0, 2)), np.empty(0), np.empty(0)
        inwards = body.points[at_wall] / -np.maximum(size[at_wall, None], 1e-9)
        outwards = np.concatenate([inwards, self._outward[at_obstacle]])
        turning = body.turning[np.concatenate([at_wall, self._node[at_obstacle]])]
        depth = self._keep - np.concatenate([self._radius - size[at_wall], self._distance[at_obstacle]])
        rows = np.outer(outwards @ body.along, body.along)
        rows += np.outer(np.einsum("kd,kd->k", outwards, turning), body.across)
        return rows, self._rate * np.minimum(depth, 0.0), depth

    def _body(self, tail: Vector, heading: Vector) -> _Body:
        """Return the needle in a pose, once it is known to be one."""
        x, y = float(heading[0]), float(heading[1])
        size = math.hypot(x, y)
        if not (math.isfinite(size) and size > 0.0 and math.isfinite(tail[0]) and math.isfinite(tail[1])):
            raise InvalidInputError("pose", [*tail.tolist(), *heading.tolist()], "finite numbers and a direction")
        unit = np.array([x, y]) / size
        shape = self._shape @ np.array([[unit[0], unit[1]], [-unit[1], unit[0]]])
        half = len(shape) // 2
        e = self._needle.chord_direction(unit)
        return _Body(shape[:half] + tail, shape[half:], e, np.array([-e[1], e[0]]))

    def _find(self, points: Points, data: SurroundingsData) -> int:
        """Write what is near into our arrays; return the number of contacts."""
        while True:
            count = find_near(points, data, self._node, self._obstacle, self._distance, self._outward, self._nearest)
            if count >= 0:
                return count
            self._room(2 * len(self._node))

    def _room(self, count: int) -> None:
        """Make arrays with room for contacts."""
        self._node, self._obstacle = np.empty(count, np.int64), np.empty(count, np.int64)
        self._distance, self._outward = np.empty(count), np.empty((count, 2))
        self._nearest = np.empty(count, np.bool_)


def _speed(velocity: Vector) -> float:
    """Return the size of a velocity, once it is known to have one."""
    speed = math.hypot(velocity[0], velocity[1])
    if not math.isfinite(speed):
        raise InvalidInputError("velocity", velocity.tolist(), "finite numbers [m/s]")
    return speed


def _leaning(rows: Points, least: Vector, depth: Vector, beyond: NDArray[np.bool_]) -> tuple[Points, Vector]:
    """Return the constraints with the two sides of a sector around the way out where a point is beyond its bound."""
    angle = LEAN * np.minimum(1.0, depth[beyond] / DEPTH)
    c, s, (x, y) = np.cos(angle), np.sin(angle), rows[beyond].T
    left, right = np.column_stack([c * x - s * y, c * y + s * x]), np.column_stack([c * x + s * y, c * y - s * x])
    return np.concatenate([rows[~beyond], left, right]), np.concatenate([least[~beyond], np.zeros(2 * len(left))])


def _if_any(found: Vector | None, velocity: Vector) -> Vector | None:
    """Return a velocity, None for one that is nothing beside the one asked for."""
    return found if found is not None and math.hypot(*found) > STUCK * math.hypot(*velocity) else None
