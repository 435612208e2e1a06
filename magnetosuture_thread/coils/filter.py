"""The needle's safety filter, the last stage of every velocity command."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.coils.certificate import (
    NOTHING,
    BodyData,
    FilterData,
    PosedNeedle,
    is_clear_turned,
    pose_needle,
    safe_time,
)
from magnetosuture_thread.coils.needle_motion import (
    STUCK,
    SURE,
    AddedRows,
    NeedleKinematics,
    limit_velocity,
    nearest_clear,
    needle_margin,
    no_rows,
)
from magnetosuture_thread.geometry.barrier import Barrier, check_barriers
from magnetosuture_thread.geometry.needle_arc import needle_points
from magnetosuture_thread.geometry.obstacles import pack_obstacles
from magnetosuture_thread.geometry.polyline import finite_array
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.settings.configuration import Quantity, bounded, checked_arguments
from magnetosuture_thread.settings.errors import ConfigurationError, InvalidInputError
from magnetosuture_thread.settings.shared_parameters import check_needle

Vector = NDArray[np.float64]

EAST = np.array([1.0, 0.0])
FINITE = Quantity("", "m/s")
MAX_POINTS = 129
SIDESTEP_MARGIN = 2e-4  # m; beyond keep_out, within which the needle is taken off sideways
SIDESTEP_RATE, MAX_SIDESTEP = 10.0, 2e-3  # 1/s and m/s
SIDESTEP_BALANCE = 1e-6  # m; of depth on both sides, from which on the needle is in a gap
SPEED, ACCELERATION, FRICTION = "speed", "acceleration", "friction"
CHECKS = 8  # instants of a hold at which an added barrier is checked


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


class AddedNeedleBarriers:
    """The barriers that a user adds to a safety filter, see there.

    Args:
        barriers: in their order.
        kinematics: of the needle.
        data: of the filter.
        first: index of the first barrier among the names of constraints.

    Attributes:
        barriers: in their order.
        time: now, by the clock of the poses' stamps; None before it is known [s].
        first_time: of the needle's first pose by that clock [s].
    """

    def __init__(self, barriers: Sequence[Barrier], kinematics: NeedleKinematics, data: FilterData, first: int) -> None:
        self.barriers = tuple(barriers)
        check_barriers(self.barriers)
        self.time: float | None = 0.0
        self.first_time = 0.0
        self._kinematics, self._data, self._first = kinematics, data, first

    def __bool__(self) -> bool:
        """Return whether there are any."""
        return bool(self.barriers)

    def rows(self, needle: PosedNeedle) -> AddedRows:
        """Return the rows of the added barriers on the tip's velocity, each over the size of its gradient."""
        along = np.array([needle.chord_x, needle.chord_y])
        left = np.array([-along[1], along[0]])
        found: list[AddedRows] = []
        ahead = self._data.hold / CHECKS
        for index, barrier in enumerate(self.barriers, start=self._first):
            self.set_time(ahead)
            later = np.asarray(barrier.value(needle.points), np.float64)
            self.set_time()
            rows = barrier.rows(needle.points)
            # What appears meanwhile is left to the checks.
            drift = (later - rows.value) / ahead if later.shape == rows.value.shape else np.zeros(len(rows.value))
            slope = np.sqrt(np.einsum("rkd,rkd->r", rows.gradient, rows.gradient))
            size = np.where(slope > 0.0, slope, 1.0)
            gradient = rows.gradient / size[:, None, None]
            drive = np.einsum("rkd,d->r", gradient, along)
            turn = np.einsum("rkd,rkd->r", gradient, needle.turning[rows.nodes])
            rate, which = np.full(len(size), min(barrier.gain, self._data.rate)), np.full(len(size), index, np.int64)
            on_tip = drive[:, None] * along + turn[:, None] * left
            found.append(AddedRows(on_tip, rows.value / size, rate, drift / size, which))
        return AddedRows(*(np.concatenate(parts) for parts in zip(*found, strict=True)))

    def checked_share(self, velocity: Vector, tail: Vector, heading: Vector, drift: float = 0.0) -> tuple[float, str]:
        """Return the share of a velocity with which every added barrier holds at every check, and what it is for."""
        broken = self._broken(velocity, tail, heading, drift)
        if not broken:
            return 1.0, ""
        low, high = 0.0, 1.0
        for _ in range(10):
            middle = 0.5 * (low + high)
            is_broken = bool(self._broken(middle * velocity, tail, heading, middle * drift))
            low, high = (low, middle) if is_broken else (middle, high)
        return low, broken

    def _broken(self, velocity: Vector, tail: Vector, heading: Vector, drift: float) -> str:
        """Return the first added barrier that gets below 0, and lower than for a needle at rest; empty for none."""
        heading = np.asarray(heading) / math.hypot(float(heading[0]), float(heading[1]))
        along, across = self._kinematics.body_velocity(heading, velocity)
        begin = self.points_at(np.asarray(tail), heading)
        times = [check / CHECKS * self._data.hold for check in range(1, CHECKS + 1)]
        points = [self.points_at(*self._kinematics.moved(tail, heading, along, across, time, drift)) for time in times]
        for time, where in zip(times, points, strict=True):
            self.set_time(time)
            for barrier in self.barriers:
                least, value = np.minimum(barrier.value(begin), 0.0) - 1e-12, barrier.value(where)
                # But for rounding. Where the number of rows changes with the place, every one of them has to be safe.
                if not (value >= (least if value.shape == least.shape else -1e-12)).all():
                    return barrier.name
        return ""

    def set_time(self, ahead: float = 0.0) -> None:
        """Set the time of the barriers' next evaluation, ahead of now [s]."""
        for barrier in self.barriers:
            if self.time is not None:
                barrier.move_to(self.time + ahead, self.first_time)
            elif barrier.moves:
                raise InvalidInputError("time", None, f"the time now [s], as the barrier {barrier.name} moves")

    def points_at(self, tail: Vector, heading: Vector) -> Vector:
        """Return the points that stand for the needle, from tail to tip, shape (m, 2) [m]."""
        c, s = float(heading[0]), float(heading[1])
        return np.asarray(self._data.body.points @ np.array([[c, s], [-s, c]]) + tail)


class NeedleSafetyFilter:
    """Keeps the needle's axis at a distance from the wall and from every shape of a scene, in sampled time.

    A commanded velocity is slowed by the thread's friction, shortened to the greatest speed, limited in how fast it
    changes, and then bent aside as little as the barriers ask for,

        min |v - v_commanded|^2    such that    grad h . J_p v >= -rate max(h, 0)      for points p of the needle
        h = distance of p from the wall or a shape - keep_out,    rate = min(approach_rate, 1 / hold_time)

    The guarantee is not in these rows but in `safe_share`: the share of a velocity that may be held, unchanged as the
    needle sees it, for the whole of `hold_time` without any point of the axis getting closer than `keep_out`; or all of
    it, where the needle turns for a limited time and may go straight on then, see `limit_turns`. It is computed in
    closed form for the arcs on which the points move, not in steps. Whoever gives the needle another velocity than the
    one filtered, as coil currents do, multiplies it by its own share.

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
        room = chord + 2.0 * keep_out
        if scene.dish.diameter <= room:
            expected = f"more than {room:g} m, room for the needle and keep_out on both sides"
            raise ConfigurationError("scene.dish.diameter", scene.dish.diameter, expected)
        points, turning, spacing = np.zeros((1, 2)), np.array([[0.0, 1.0]]), 0.0
        if needle_length > 0.0:
            spacing = max(min(5e-4, 0.5 * keep_out), needle_length / (MAX_POINTS - 1))
            points, turning = needle_points(needle_length, needle_curvature, spacing)
            spacing = needle_length / (len(points) - 1)
        x, y = self.kinematics.chord_direction(EAST).tolist()
        bend = abs(needle_curvature)
        is_straight, turn = bend * needle_length < 1e-9, 2.0 / chord if needle_length > 0.0 else 0.0
        self._data = FilterData(
            BodyData(points, turning, is_straight, chord, x, y, turn),
            hold_time,
            hold_time,
            math.sqrt(keep_out**2 + 0.25 * spacing**2 * (1.0 + bend * keep_out)),
            keep_out + 0.125 * bend * spacing**2,
            keep_out,
            min(approach_rate, 1.0 / hold_time),
            # Faster commands are shortened first, as rounding grows with their size.
            min(max_speed, 10.0),
            max_acceleration,
            pack_obstacles(scene.obstacles, scene.dish.radius),
        )
        self._added = AddedNeedleBarriers(barriers, self.kinematics, self._data, len(scene.names))
        self._names = (*scene.names, *[barrier.name for barrier in barriers], "wall")  # so that -1 is the wall
        self._pose: tuple[tuple[float, ...], PosedNeedle] | None = None  # the last one, by tail and heading
        # Compiled now, not in the first step.
        middle = np.array([-0.5 * chord, 0.0])
        self._added.time = 0.0
        self.filter(1e-3 * EAST, middle, EAST, time=0.0)
        self.safe_share(1e-3 * EAST, middle, EAST)
        self.kinematics.moved(middle, EAST, 1e-3, 0.0, hold_time)
        self._added.time = None

    @checked_arguments("safety filter")
    def limit_turns(self, turn_time: Annotated[float, bounded("s", 0.0, unlimited=True)]) -> None:
        """Certify motions from now on also as those of a needle that turns for no longer than a time.

        Barriers that a user adds are checked for the constant motion all the same.

        Args:
            turn_time: for which it goes on turning at the most while nobody looks, as a field that is held also holds
                its direction; no more than `hold_time` counts [s].

        Raises:
            ConfigurationError: the time is out of bounds.
        """
        self._data = self._data._replace(turn_time=min(turn_time, self.hold_time))
        self._pose = None
        is_clear_turned(1e-3, 0.0, self._at(np.zeros(2), EAST), 0.0)  # compiled now, not in the first step

    def set_time(self, time: float | None, first_time: float = 0.0) -> None:
        """Set the time of the next calls, for barriers that move; see `Barrier.set_time` [s].

        Args:
            time: now, by the clock of the poses' stamps; None if there is none [s].
            first_time: of the needle's first pose by that clock [s].

        Raises:
            InvalidInputError: a barrier moves and there is no time.
        """
        self._added.time, self._added.first_time = time, first_time
        self._added.set_time()

    def compiled_data(self) -> FilterData:
        """Return the filter for compiled loops.

        Raises:
            ConfigurationError: it has barriers of a user, which compiled code does not know.
        """
        if self._added:
            raise ConfigurationError(
                "barriers of the safety filter", self._names[-2], "none: compiled code has its own"
            )
        return self._data

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
        self.set_time(time, first_time)
        commanded = _checked_velocity(commanded)
        if not commanded.any():
            return FilteredCommand(commanded, np.zeros(2), slowdown)
        change, before = math.inf, np.zeros(2)
        if previous is not None:
            before, change = finite_array("previous", previous, (2,), FINITE), self._data.max_acceleration * elapsed
        (x, y), (u, v) = commanded.tolist(), before.tolist()
        largest = min(self._data.max_speed, max_speed)
        x, y, is_fast, is_abrupt = limit_velocity((x, y), slowdown, largest, (u, v), change)
        flags = {FRICTION: slowdown < 1.0, SPEED: is_fast, ACCELERATION: is_abrupt}
        passed, touched = self.nearest_clear(np.array([x, y]), tail, heading)
        active = tuple([name for name, is_active in flags.items() if is_active] + touched)
        if math.hypot(*passed) <= STUCK * math.hypot(x, y):
            named = [name for name in active if name not in (SPEED, ACCELERATION)] or list(active)
            return FilteredCommand(commanded, np.zeros(2), slowdown, active, rest_reason(named))
        return FilteredCommand(commanded, passed, slowdown, active)

    def nearest_clear(self, velocity: Vector, tail: Vector, heading: Vector) -> tuple[Vector, list[str]]:
        """Return the velocity nearest to one that keeps clear for the hold, and what changed it.

        Args:
            velocity: of the tip, shape (2,) [m/s]; returned bit for bit where it keeps clear.
            tail: the needle's tail, shape (2,) [m].
            heading: unit vector along the needle at its tail, shape (2,).

        Raises:
            InvalidInputError: something is not finite.
        """
        velocity, needle = _checked_velocity(velocity), self._at(tail, heading)
        if not velocity.any():
            return velocity, []
        touched = np.zeros(len(self._names), np.bool_)
        added = self._added.rows(needle) if self._added else no_rows()
        x, y = nearest_clear(float(velocity[0]), float(velocity[1]), needle, added, touched)
        clear = velocity if x == velocity[0] and y == velocity[1] else np.array([x, y])
        if self._added:
            share, name = self._added.checked_share(clear, tail, heading)
            if share < 1.0:
                clear = share * clear
                touched[self._names.index(name)] = True
        return clear, [] if clear is velocity else [self._names[k] for k in np.flatnonzero(touched)]

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
        velocity, needle = _checked_velocity(velocity), self._at(tail, heading)
        drift = float(finite_array("drift", [drift], (1,), FINITE)[0])
        x, y = velocity.tolist()
        time, what, _ = safe_time(x, y, needle, drift)
        is_clear = what == NOTHING or (self._data.turn_time < self.hold_time and is_clear_turned(x, y, needle, drift))
        found = (1.0, "") if is_clear else (SURE * time / self.hold_time, self._names[what])
        if not self._added:
            return found
        return min(found, self._added.checked_share(velocity, tail, heading, drift), key=lambda share: share[0])

    def clearance(self, tail: Vector, heading: Vector) -> float:
        """Return the signed least distance of the points of the needle's axis from the wall and all shapes [m].

        Raises:
            InvalidInputError: something is not finite.
        """
        return needle_margin(self._data, self._at(tail, heading))[0] + self.keep_out

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
        last = self._pose  # read once, as forecasts have the same filter in a thread of their own
        if last is not None and last[0] == (*np.ravel(tail).tolist(), *np.ravel(heading).tolist()):
            return last[1]
        # No dish is larger than 1 m.
        tail = finite_array("tail", tail, (2,), bounded("m", -1.0, 1.0))
        heading = finite_array("heading", heading, (2,), FINITE)
        key = (*tail.tolist(), *heading.tolist())
        x, y, c, s = key
        size = math.hypot(c, s)
        if not size > 0.0:
            raise InvalidInputError("heading", heading.tolist(), "a direction")
        needle: PosedNeedle = pose_needle(self._data, x, y, c / size, s / size)
        self._pose = key, needle
        return needle


def rest_reason(names: list[str]) -> str:
    """Return the reason of a needle that rests at constraints."""
    return f"stopped by {', '.join(dict.fromkeys(names))}"


def _checked_velocity(velocity: Vector) -> Vector:
    return finite_array("velocity", velocity, (2,), FINITE)
