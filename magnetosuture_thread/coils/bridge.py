"""From commands and poses to currents, with everything that can keep them at zero."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.coils.allocation import Allocation
from magnetosuture_thread.coils.drivers.protocol import DriverState
from magnetosuture_thread.coils.gate import CommandGate
from magnetosuture_thread.coils.latch import ArmingLatch
from magnetosuture_thread.coils.needle import NeedleWatch, Pose
from magnetosuture_thread.coils.prediction import PredictionWatch
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.safety import FilteredCommand, NeedleSafetyFilter
from magnetosuture_thread.safety.filter import STUCK, held_by
from magnetosuture_thread.scene import Scene

Vector = NDArray[np.float64]

OPERATOR, NEEDLE = "operator", "needle"
INPUTS = {OPERATOR: "operator/servo_cv", NEEDLE: "needle/servo_cv"}  # topics, by priority

AHEAD = 2.0  # periods that a command and a pose must still be good for: one to the next step, one to the boards
LONGEST = 2.0  # periods that velocity and currents may change over in one step, however late it comes
CORRECTIONS = 4  # of what the coils add to a velocity that leads towards the wall
ENOUGH = 0.98  # share of a velocity that is not worth another correction
BLOCKED_FOR = 0.1  # s until it is tried again
NO_SCENE = "no scene"
NO_PREDICTION, CURRENT = "no prediction", "current"  # constraints of the bridge, besides those of the filter


@dataclass(frozen=True)
class Outcome:
    """What one step asks of the coils, and why.

    Attributes:
        coils: their names, in the order of the currents.
        allocation: the currents, and the tip velocity that they give.
        commanded: the tip velocity that was commanded, shape (2,) [m/s]; zero where no command is good.
        filtered: the same after friction, limits and barriers, shape (2,) [m/s].
        reasons: why the currents are zero; empty while a command is followed, be it to rest.
        publish: whether to report it: while a command is followed, and for a while after it has ended.
        source: input that is followed, "operator" or "needle"; empty for none.
        overridden: input whose good commands are not followed because of the source; empty for none.
        slowdown: factor on the speed by the thread's friction.
        active: names of the constraints that changed the command.
        scene_version: of the scene that the needle is kept within; empty for none.
    """

    coils: tuple[str, ...]
    allocation: Allocation
    commanded: Vector
    filtered: Vector
    reasons: tuple[str, ...]
    publish: bool
    source: str = ""
    overridden: str = ""
    slowdown: float = 1.0
    active: tuple[str, ...] = ()
    scene_version: str = ""

    @property
    def applied(self) -> Vector:
        """Tip velocity that the currents give, by the bridge's model, shape (2,) [m/s]."""
        return self.allocation.velocity

    @property
    def reason(self) -> str:
        """Why the needle rests; empty while it moves or is commanded to rest."""
        return "; ".join(self.reasons)


@dataclass(frozen=True)
class _Followed:
    """Which input is followed, and why none is."""

    source: str = ""
    overridden: str = ""
    velocity: Vector = field(default_factory=lambda: np.zeros(2))
    problem: str = ""


class Bridge:
    """Turns the last good command into currents, at a fixed rate, for as long as nothing speaks against it.

    There are two inputs: an operator's commands are followed before those of `needle`, which counts again when the
    operator's have timed out. One step takes the command of the input that counts, filters it by `NeedleSafetyFilter`,
    and lays the field along the needle as it lies now, within the limits of current and slew. What the currents give
    is not exactly what was filtered: so they are multiplied, all by the same factor, by the share of their velocity
    that the filter certifies for as long as the coils may hold it. Whatever stops the needle takes effect at once,
    without the limits on change; so do a command to rest, and that factor.

    Pure: it reads no clock. `arrival` is a monotonic time, `now` the time of the stamps; both in seconds.

    Args:
        settings: of the bridge.
        latch: outlives it, as an emergency stop must.
        scene: dish and shapes; without one the bridge does not arm.

    Attributes:
        latch: whether commands may pass at all.
        gates: of the commands, by input: "operator" and "needle".
        needle: where it is.
        prediction: what the thread model has said.

    Raises:
        ConfigurationError: the needle has no room in the scene.
    """

    def __init__(self, settings: CoilBridgeSettings, latch: ArmingLatch, scene: Scene | None) -> None:
        self.latch = latch
        self.gates = {name: CommandGate(settings.command_timeout, topic) for name, topic in INPUTS.items()}
        self._hold = min(settings.command_timeout, settings.driver_timeout)  # that coils certainly keep a current
        self.needle = NeedleWatch(
            settings.needle().kinematics,
            settings.pose_timeout,
            settings.reach,
            max_speed=settings.max_speed,
            uncertainty=settings.pose_uncertainty,
            holds=self._hold,
            stops=settings.hold_time,
        )
        self.prediction = PredictionWatch(settings.prediction_timeout)
        self._settings = settings
        self._coils = settings.allocation()
        self._filter: NeedleSafetyFilter | None = None
        self._losses = 0
        self._before = self._coils.zero()
        self._velocity = np.zeros(2)
        self._stepped = -math.inf
        self._stopped: float | None = None
        self._blocked, self._blocked_by = -math.inf, ""
        self.set_scene(scene)

    @property
    def coils(self) -> tuple[str, ...]:
        """The coils' names, in the order of their currents."""
        return self._coils.names

    @property
    def scene(self) -> Scene | None:
        """The scene that the needle is kept within."""
        return None if self._filter is None else self._filter.scene

    @property
    def scene_version(self) -> str:
        """Version of the scene; empty without one."""
        return "" if self._filter is None else self._filter.scene.version

    def set_scene(self, scene: Scene | None) -> None:
        """Keep the needle within another scene from the next step on; without one it rests.

        Raises:
            ConfigurationError: the needle has no room in it; the scene before stays.
        """
        self._filter = None if scene is None else self._settings.safety_filter(scene)
        self.needle.radius = math.inf if scene is None else scene.dish.radius

    def command(self, source: str, velocity: Vector, stamp: float, number: int, now: float, arrival: float) -> None:
        """Take a command of an input; see `CommandGate.accept`.

        Args:
            source: the input, "operator" or "needle".
            velocity: of the needle's tip in the dish plane, shape (2,) [m/s].
            stamp: when it was made [s].
            number: of the message, counted by its publisher.
            now: the same clock now [s].
            arrival: a monotonic clock now [s].
        """
        self.gates[source].accept(velocity, stamp, number, now, arrival)

    def on_margins(self, stamp: float, valid: bool, slowdown: float, scene_version: str, arrival: float) -> None:
        """Take the thread model's margins; see `PredictionWatch.hear`."""
        self.prediction.hear(stamp, valid, slowdown, scene_version, arrival)

    def arm(self, driver: DriverState) -> None:
        """Let commands pass that come from now on; see `ArmingLatch.arm`.

        Raises:
            InvalidInputError: see there; or there is no scene.
        """
        if self._filter is None:
            raise InvalidInputError("arm", NO_SCENE, "a scene, as a parameter or on its topic")
        self.latch.arm(driver.problem if not driver.ready else "")
        self._losses = driver.losses
        for gate in self.gates.values():
            gate.forget()

    def reset(self, driver: DriverState) -> None:
        """Forget the emergency stop and faults; see `ArmingLatch.reset`."""
        self.latch.reset(driver.problem if not driver.ready else "")
        self._losses = driver.losses

    def step(self, now: float, arrival: float, driver: DriverState) -> Outcome:
        """Return what to ask of the coils now.

        Args:
            now: time of the stamps' clock [s].
            arrival: a monotonic time [s].
            driver: what the driver knows.
        """
        try:
            return self._step(now, arrival, driver)
        except Exception as error:  # Whatever is wrong in here, the coils go to zero and stay there.
            self.latch.trip(f"internal error: {type(error).__name__}: {error}")
            return self._rest(now, arrival, _Followed(), (self.latch.holds,))

    def _step(self, now: float, arrival: float, driver: DriverState) -> Outcome:
        if self.latch.armed and not (driver.ready and driver.losses == self._losses):
            self.latch.trip(f"driver: {driver.problem or 'currents were lost for a moment'}")
        period = 1.0 / self._settings.rate
        late = arrival - self._stepped
        self._stepped = arrival
        if late > self._hold:
            self._forget()  # the driver has gone to zero by itself meanwhile
        elapsed = min(max(late, 0.0), LONGEST * period)
        # What would end before the next step has reached the boards ends now: no current outlives what it is for.
        then = (now + AHEAD * period, arrival + AHEAD * period)
        followed = self._followed(*then)
        pose = self.needle.pose(now, arrival)
        unpredicted = self.prediction.missing(now, arrival)
        reasons = self._why_not(arrival, then, driver, followed, unpredicted)
        active: tuple[str, ...] = (NO_PREDICTION,) if unpredicted else ()
        if reasons or pose is None or self._filter is None:
            return self._rest(now, arrival, followed, reasons, active)
        if not followed.velocity.any():
            outcome = replace(self._rest(now, arrival, followed, ()), publish=True)
            self._stopped = None
            return outcome
        filtered = self._filter.filter(
            followed.velocity,
            pose.tail,
            pose.heading,
            slowdown=1.0 if unpredicted else self.prediction.slowdown,
            max_speed=self._settings.speed_without_prediction if unpredicted else math.inf,
            previous=self._velocity,
            elapsed=elapsed,
            time=now,
        )
        active += filtered.active
        if filtered.reason:
            return self._rest(now, arrival, followed, (filtered.reason,), active, filtered)
        allocation, held = self._allocate(
            filtered.filtered, pose, self._settings.max_current_slew * elapsed, self._filter
        )
        active += tuple(name for name in (held, CURRENT if allocation.saturated else "") if name and name not in active)
        if math.hypot(*allocation.velocity) <= STUCK * math.hypot(*filtered.filtered):
            names = [name for name in active if name in (held, CURRENT)] or list(active) or [CURRENT]
            self._blocked, self._blocked_by = arrival, f"{held_by(names)}: no currents lead away"
            return self._rest(now, arrival, followed, (self._blocked_by,), active, filtered)
        self._before, self._velocity, self._stopped = allocation, filtered.filtered, None
        self.needle.move(allocation.velocity, now, arrival)
        return self._outcome(allocation, followed, filtered.filtered, (), True, active, filtered.slowdown)

    def _followed(self, now: float, arrival: float) -> _Followed:
        """Return the input that counts at a time of the stamps' clock and a monotonic time [s]."""
        operator, needle = self.gates[OPERATOR], self.gates[NEEDLE]
        problem = operator.closed(now, arrival)
        if not problem:
            overridden = "" if needle.unused or needle.closed(now, arrival) else NEEDLE
            return _Followed(OPERATOR, overridden, operator.velocity)
        if operator.disputed(arrival):
            return _Followed(problem=problem)
        other = needle.closed(now, arrival)
        if not other:
            return _Followed(NEEDLE, "", needle.velocity)
        # Who has never commanded says nothing about why nobody does now.
        return _Followed(problem=problem if needle.unused and not needle.disputed(arrival) else other)

    def _why_not(
        self, arrival: float, then: tuple[float, float], driver: DriverState, followed: _Followed, unpredicted: str
    ) -> tuple[str, ...]:
        """Return all that speaks against a current until the next step."""
        reasons = (
            self.latch.holds,
            "" if driver.ready or self.latch.latched else f"driver: {driver.problem}",
            NO_SCENE if self._filter is None else self.prediction.disagreement(self.scene_version, arrival),
            followed.problem,
            self.needle.lost(*then),
            unpredicted if self._settings.without_prediction == "stop" else "",
            self._blocked_by if arrival - self._blocked < BLOCKED_FOR else "",
        )
        return tuple(reason for reason in reasons if reason)

    def _rest(
        self,
        now: float,
        arrival: float,
        followed: _Followed,
        reasons: tuple[str, ...],
        active: tuple[str, ...] = (),
        filtered: FilteredCommand | None = None,
    ) -> Outcome:
        """Return no current, at once."""
        if self._stopped is None:
            self._stopped = arrival
        self._forget()
        self.needle.move(self._velocity, now, arrival)
        publish = arrival - self._stopped <= self._settings.zero_hold
        slowdown = filtered.slowdown if filtered is not None else 1.0
        return self._outcome(self._before, followed, np.zeros(2), reasons, publish, active, slowdown)

    def _outcome(
        self,
        allocation: Allocation,
        followed: _Followed,
        filtered: Vector,
        reasons: tuple[str, ...],
        publish: bool,
        active: tuple[str, ...],
        slowdown: float,
    ) -> Outcome:
        return Outcome(
            self.coils,
            allocation,
            followed.velocity,
            filtered,
            reasons,
            publish,
            followed.source,
            followed.overridden,
            slowdown,
            active,
            self.scene_version,
        )

    def _forget(self) -> None:
        """Begin anew from no current and no velocity."""
        self._before, self._velocity = self._coils.zero(), np.zeros(2)

    def _allocate(
        self, velocity: Vector, pose: Pose, largest_change: float, safety: NeedleSafetyFilter
    ) -> tuple[Allocation, str]:
        """Return currents whose own velocity, drift included, keeps clear for the hold, and what they are held by."""
        asked, best, nearest, held = velocity, self._coils.zero(), math.inf, ""
        for _ in range(1 + CORRECTIONS):
            found = self._coils.allocate(asked, pose.tail, pose.heading, self._before.currents, largest_change)
            share, name = safety.safe_share(found.velocity, pose.tail, pose.heading)
            kept = found.scaled(share)
            off = float(np.linalg.norm(kept.velocity - velocity))
            if off < nearest:
                best, nearest, held = kept, off, name
            if share >= ENOUGH:
                break
            clear, _ = safety.nearest_clear(found.velocity, pose.tail, pose.heading)
            asked = asked - (found.velocity - clear)
        return best, held
