"""The needle's safety filter, the last stage of every velocity command."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.arguments import bounded, checked_arguments
from magnetosuture_thread.barrier import Barrier
from magnetosuture_thread.errors import ConfigurationError, InvalidInputError
from magnetosuture_thread.geometry.arrays import finite_array
from magnetosuture_thread.geometry.needle_arc import check_needle, needle_points
from magnetosuture_thread.safety.added_barriers import AddedNeedleBarriers
from magnetosuture_thread.safety.barriers import NO_ROWS, SURE, measure, nearest_clear
from magnetosuture_thread.safety.certificate import NOTHING, PosedNeedle, safe_time
from magnetosuture_thread.safety.kinematics import NeedleKinematics
from magnetosuture_thread.safety.limits import FINITE, checked_velocity, limit_norm, rate_limit
from magnetosuture_thread.safety.motion import BodyData, FilterData
from magnetosuture_thread.safety.packed_scene import pack_scene
from magnetosuture_thread.scene import Scene

Vector = NDArray[np.float64]

COARSEST = 5e-4  # m; distance at most between the points that stand for the needle, where that are not too many
MAX_POINTS = 129
BAND = 2e-6  # m; by which the barriers keep farther away than the certificate, so that a needle can slide there
MAX_SPEED = 10.0  # m/s; a faster command is shortened first, as rounding grows with its size
STUCK = 1e-3  # of the speed commanded; a needle that is left less rests
SIDESTEP_MARGIN = 2e-4  # m; beyond keep_out, within which the needle is taken off sideways
SIDESTEP_RATE, MAX_SIDESTEP = 10.0, 2e-3  # 1/s and m/s
SIDESTEP_BALANCE = 1e-6  # m; of depth on both sides, from which on the needle is in a gap
POSITION = bounded("m", -1.0, 1.0)  # no dish is larger
WALL_NAME = "wall"
SPEED, ACCELERATION, FRICTION = "speed", "acceleration", "friction"


@dataclass(frozen=True)
class FilteredCommand:
    """What the filter makes of one commanded velocity.

    Attributes:
        commanded: velocity of the tip, shape (2,) [m/s].
        filtered: after friction, limits and barriers, shape (2,) [m/s].
        slowdown: by the thread's friction; 1 for none.
        active: names of the constraints that changed it: "friction", "speed", "acceleration", "wall", or of a shape.
        reason: why the needle rests although it is commanded to move; empty else.
    """

    commanded: Vector
    filtered: Vector
    slowdown: float = 1.0
    active: tuple[str, ...] = ()
    reason: str = ""


class NeedleSafetyFilter:
    """Keeps the needle's axis at a distance from the wall and from every shape of a scene, in sampled time.

    A commanded velocity is slowed by the thread's friction, shortened to the greatest speed, limited in how fast it
    changes, and then bent aside as little as the barriers ask for,

        min |v - v_commanded|^2    such that    grad h . J_p v >= -rate max(h, 0)      for points p of the needle
        h = distance of p from the wall or a shape - keep_out,    rate = min(approach_rate, 1 / hold_time)

    The guarantee is not in these rows but in `safe_share`: the share of a velocity that may be held, unchanged as the
    needle sees it, for the whole of `hold_time` without any point of the axis getting closer than `keep_out`. It is
    computed in closed form for the arcs on which the points move, not in steps. Whoever gives the needle another
    velocity than the one filtered, as coil currents do, multiplies it by its own share.

    A needle that is closer already may leave or slide along, and gets no closer; zero is always allowed, and nothing
    but a command moves the needle, no faster than it was commanded. `sidestep` is for whoever can push it sideways.

    The axis is represented by at most 129 points, a distance s apart. None of them gets closer to a shape than
    sqrt(keep_out^2 + (1 + |c| keep_out) s^2 / 4), nor to the wall than keep_out + |c| s^2 / 8, with the needle's
    curvature c: so nothing between two points is closer than keep_out.

    Source: A. D. Ames et al., Control Barrier Functions: Theory and Applications, 2019, section II. Deviation:
    max(h, 0) for h, so that a measured pose beyond the bound leaves zero feasible; the certificate.

    Barriers that a user adds are enforced by rows of the same program, on the points of the needle from tail to tip.
    They are then checked at `CHECKS` instants of the hold, and the velocity is scaled down until they hold there.
    Between these instants they are not certified. Of a barrier that moves, the row is

        grad h . J_p v + dh/dt >= -rate max(h, 0)

    and at each instant the needle may be no worse off than if it stood still, where that breaks the barrier too: it may
    flee, no faster than it is commanded.

    Args:
        scene: dish and shapes.
        barriers: what is enforced besides wall and shapes, see `Barrier`; their positions are the needle's points.
        keep_out: least distance of the needle's axis from wall and shapes; half of its width is within [m].
        approach_rate: share of that distance by which the needle may approach [1/s].
        hold_time: for which a velocity may go on without anybody looking: until the coil drivers switch off by
            themselves, and a period of the loop [s].
        max_speed: of the tip [m/s].
        max_acceleration: greatest change of the velocity before the barriers [m/s^2].
        needle_length: along the needle's body; 0 for a point [m].
        needle_curvature: of its arc, positive to the left of its heading [1/m].

    Raises:
        ConfigurationError: a number is out of bounds, or the needle has no room in the dish.
    """

    @checked_arguments("safety filter")
    def __init__(
        self,
        scene: Scene,
        barriers: Sequence[Barrier] = (),
        *,
        keep_out: Annotated[float, bounded("m", 1e-6, 0.1)] = 5e-4,
        approach_rate: Annotated[float, bounded("1/s", 0.01, 1e3)] = 10.0,
        hold_time: Annotated[float, bounded("s", 1e-3, 10.0)] = 0.205,
        max_speed: Annotated[float, bounded("m/s", 1e-6, 0.5, unlimited=True)] = math.inf,
        max_acceleration: Annotated[float, bounded("m/s^2", 1e-6, 1e3, unlimited=True)] = math.inf,
        needle_length: Annotated[float, bounded("m", 0.0, 0.1)] = 0.0,
        needle_curvature: Annotated[float, bounded("1/m", -1e4, 1e4)] = 0.0,
    ) -> None:
        self.scene, self.keep_out, self.hold_time = scene, keep_out, hold_time
        self.kinematics = NeedleKinematics(needle_length, needle_curvature)
        chord = self.kinematics.chord
        check_needle("safety filter", needle_length, needle_curvature)
        least = chord + 2.0 * keep_out
        if scene.dish.diameter <= least:
            expected = f"more than {least:g} m, room for the needle and keep_out on both sides"
            raise ConfigurationError("scene.dish.diameter", scene.dish.diameter, expected)
        self._rate = min(approach_rate, 1.0 / hold_time)
        self._max_speed, self._max_acceleration = max_speed, max_acceleration
        self._straight = abs(needle_curvature) * needle_length < 1e-9
        if needle_length > 0.0:
            spacing = max(min(COARSEST, 0.5 * keep_out), needle_length / (MAX_POINTS - 1))
            body = needle_points(needle_length, needle_curvature, spacing)
            spacing = needle_length / (len(body.points) - 1)
            self._points, self._turning, self._turn = body.points, body.turning, 2.0 / chord
        else:
            spacing = 0.0
            self._points, self._turning, self._turn = np.zeros((1, 2)), np.array([[0.0, 1.0]]), 0.0
        bend = abs(needle_curvature)
        self._keep = math.sqrt(keep_out**2 + 0.25 * spacing**2 * (1.0 + bend * keep_out))
        self._keep_wall = keep_out + 0.125 * bend * spacing**2
        self._packed = pack_scene(scene)
        added = self.kinematics, self._points, hold_time, self._rate, len(scene.names)
        self._added = AddedNeedleBarriers(barriers, *added)
        self._names = (*scene.names, *[barrier.name for barrier in barriers], WALL_NAME)  # so that -1 is the wall
        self._touched = np.zeros(len(self._names), np.bool_)
        self._pose: tuple[tuple[float, ...], PosedNeedle] | None = None  # the last one, by tail and heading
        # Compiled now, not in the first step.
        middle, east = np.array([-0.5 * chord, 0.0]), np.array([1.0, 0.0])
        self.nearest_clear(np.array([1e-3, 0.0]), middle, east)
        self.safe_share(np.array([1e-3, 0.0]), middle, east)
        self._added.time = None

    def compiled_data(self) -> FilterData:
        """Return the filter for compiled loops.

        Raises:
            ConfigurationError: it has barriers of a user, which compiled code does not know.
        """
        if self._added:
            raise ConfigurationError(
                "barriers of the safety filter", self._names[-2], "none: compiled code has its own"
            )
        x, y = self.kinematics.chord_direction(np.array([1.0, 0.0])).tolist()
        body = BodyData(self._points, self._turning, self._straight, self.kinematics.chord, x, y, float(self._turn))
        keep, rate = (self._keep, self._keep_wall, float(self.keep_out)), float(self._rate)
        limits = min(float(self._max_speed), MAX_SPEED), float(self._max_acceleration), STUCK
        return FilterData(body, float(self.hold_time), *keep, rate, BAND, *limits, self._packed, NO_ROWS)

    @checked_arguments("command", InvalidInputError)
    def filter(
        self,
        commanded: Vector,
        tail: Vector,
        heading: Vector,
        *,
        slowdown: Annotated[float, bounded("", 0.0, 1.0)] = 1.0,
        max_speed: Annotated[float, bounded("m/s", 0.0, unlimited=True)] = math.inf,
        previous: Vector | None = None,
        elapsed: Annotated[float, bounded("s", 0.0, unlimited=True)] = math.inf,
        time: float | None = None,
        first_time: float = 0.0,
    ) -> FilteredCommand:
        """Return what is left of a commanded velocity: slowed, limited, and kept clear for the whole hold.

        Args:
            commanded: velocity of the tip, shape (2,) [m/s].
            tail: the needle's tail, shape (2,) [m].
            heading: unit vector along the needle at its tail, shape (2,).
            slowdown: factor on the speed by the thread's friction, 0 to 1.
            max_speed: a limit that holds now, besides the filter's own [m/s].
            previous: velocity that the change is limited from, shape (2,) [m/s]; not limited if None.
            elapsed: since then [s].
            time: now, by the clock of the poses' stamps, for barriers that move; see `Barrier.set_time` [s].
            first_time: of the needle's first pose by that clock [s].

        Raises:
            InvalidInputError: something is not finite or out of bounds, or a barrier moves and there is no time.
        """
        self._added.time, self._added.first_time = time, first_time
        self._added.set_time()
        commanded = checked_velocity(commanded)
        speed = math.hypot(*commanded)
        if speed == 0.0:
            return FilteredCommand(commanded, np.zeros(2), slowdown)
        active = [FRICTION] if slowdown < 1.0 else []
        largest = min(self._max_speed, max_speed, MAX_SPEED)
        velocity = limit_norm(slowdown * commanded, largest)
        if slowdown * speed > largest * (1.0 + 1e-12):
            active.append(SPEED)
        if previous is not None and math.isfinite(self._max_acceleration):
            previous, change = finite_array("previous", previous, (2,), FINITE), self._max_acceleration * elapsed
            if math.hypot(*(velocity - previous)) > change * (1.0 + 1e-12):
                velocity = rate_limit(previous, velocity, change)
                active.append(ACCELERATION)
        passed, touched = self.nearest_clear(velocity, tail, heading)
        active += touched
        if math.hypot(*passed) <= STUCK * math.hypot(*velocity):
            named = [name for name in active if name not in (SPEED, ACCELERATION)] or active
            return FilteredCommand(commanded, np.zeros(2), slowdown, tuple(active), rest_reason(named))
        return FilteredCommand(commanded, passed, slowdown, tuple(active))

    def nearest_clear(self, velocity: Vector, tail: Vector, heading: Vector) -> tuple[Vector, list[str]]:
        """Return the velocity nearest to one that keeps clear for the hold, and what changed it.

        Args:
            velocity: of the tip, shape (2,) [m/s]; returned bit for bit where it keeps clear.
            tail: the needle's tail, shape (2,) [m].
            heading: unit vector along the needle at its tail, shape (2,).

        Raises:
            InvalidInputError: something is not finite.
        """
        velocity, needle = checked_velocity(velocity), self._at(tail, heading)
        if not velocity.any():
            return velocity, []
        self._touched[:] = False
        added = self._added.rows(needle) if self._added else NO_ROWS
        x, y = nearest_clear(
            float(velocity[0]), float(velocity[1]), needle, self._rate, BAND, self._packed, added, self._touched
        )
        clear = velocity if x == velocity[0] and y == velocity[1] else np.array([x, y])
        if self._added:
            share, name = self._added.checked_share(clear, tail, heading)
            if share < 1.0:
                clear = share * clear
                self._touched[self._names.index(name)] = True
        if clear is velocity:
            return velocity, []
        return clear, [self._names[k] for k in np.flatnonzero(self._touched)]

    def safe_share(self, velocity: Vector, tail: Vector, heading: Vector, drift: float = 0.0) -> tuple[float, str]:
        """Return the share of a velocity that keeps clear while it is held for the whole hold time: the guarantee.

        With the share of it the needle goes the same way more slowly, and is at the end of the hold where with all
        of it it would be when it has to stop.

        Args:
            velocity: of the tip, shape (2,) [m/s].
            tail: the needle's tail, shape (2,) [m].
            heading: unit vector along the needle at its tail, shape (2,).
            drift: part of it across the chord, to its left, that the whole needle has [m/s]; the rest of it turns
                the needle about its middle.

        Returns:
            The share, 0 to 1, and the name of what it is for; empty for a share of 1.

        Raises:
            InvalidInputError: something is not finite.
        """
        velocity = checked_velocity(velocity)
        x, y = float(velocity[0]), float(velocity[1])
        time, what, _ = safe_time(x, y, self._at(tail, heading), self._packed, drift)
        found = (1.0, "") if what == NOTHING else (SURE * time / self.hold_time, self._names[what])
        if not self._added:
            return found
        return min(found, self._added.checked_share(velocity, tail, heading, drift), key=lambda share: share[0])

    def clearance(self, tail: Vector, heading: Vector) -> float:
        """Return the signed least distance of the points of the needle's axis from the wall and all shapes [m].

        Raises:
            InvalidInputError: something is not finite.
        """
        needle = self._at(tail, heading)
        wall = self.scene.dish.radius - float(np.hypot(needle.points[:, 0], needle.points[:, 1]).max())
        return min(wall, float(needle.distances.min(initial=math.inf)))

    def sidestep(self, tail: Vector, heading: Vector) -> float:
        """Return the velocity across the chord, to its left, that takes the needle off what it is close to [m/s].

        With the distances d of the needle's points from wall and shapes, their gradients g, and n across the chord,

            r w    of the greatest |w| with    w = max(0, keep_out + SIDESTEP_MARGIN - d) g . n,    r = SIDESTEP_RATE

        It is 0 for a needle that is close to nothing, or to something on both sides.

        Raises:
            InvalidInputError: something is not finite.
        """
        needle = self._at(tail, heading)
        bound = self.keep_out + SIDESTEP_MARGIN
        radii = np.hypot(needle.points[:, 0], needle.points[:, 1])
        walls = self.scene.dish.radius - radii
        if walls.min() >= bound and needle.distances.min(initial=math.inf) >= bound:
            return 0.0
        n = np.array([-needle.chord_y, needle.chord_x])
        from_wall = np.maximum(0.0, bound - walls) * (needle.points @ n) / -np.maximum(radii, 1e-12)
        from_shapes = np.maximum(0.0, bound - needle.distances) * (needle.normal @ n)
        found = np.concatenate([from_wall, from_shapes.ravel()])
        left, right = float(found.max(initial=0.0)), float(found.min(initial=0.0))
        if left > SIDESTEP_BALANCE and right < -SIDESTEP_BALANCE:
            return 0.0
        return min(MAX_SIDESTEP, max(-MAX_SIDESTEP, SIDESTEP_RATE * (left + right)))

    def _at(self, tail: Vector, heading: Vector) -> PosedNeedle:
        """Return the needle in a pose, with its distances measured; the last pose is remembered."""
        tail, heading = finite_array("tail", tail, (2,), POSITION), finite_array("heading", heading, (2,), FINITE)
        key = (float(tail[0]), float(tail[1]), float(heading[0]), float(heading[1]))
        last = self._pose  # read once, as forecasts have the same filter in a thread of their own
        if last is not None and last[0] == key:
            return last[1]
        size = math.hypot(key[2], key[3])
        if not size > 0.0:
            raise InvalidInputError("heading", heading.tolist(), "a direction")
        c, s = key[2] / size, key[3] / size
        turn = np.array([[c, s], [-s, c]])  # of rows
        e = self.kinematics.chord_direction(np.array([c, s]))
        points = self._points @ turn + tail
        shapes = len(self._packed.shapes)
        distances, normal = np.empty((len(points), shapes)), np.empty((len(points), shapes, 2))
        measure(points, self._packed, distances, normal)
        chord_x, chord_y = float(e[0]), float(e[1])
        needle = PosedNeedle(
            points,
            self._turning @ turn,
            self._straight,
            chord_x,
            chord_y,
            self._turn,
            self.hold_time,
            self._keep,
            self._keep_wall,
            distances,
            normal,
        )
        self._pose = key, needle
        return needle


def rest_reason(names: list[str]) -> str:
    """Return the reason of a needle that rests at constraints."""
    return f"stopped by {', '.join(dict.fromkeys(names))}"
