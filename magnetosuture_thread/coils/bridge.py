"""Core of the coil bridge: velocity commands and needle poses in, safe coil currents out."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.coils.allocation import Allocation, CertifiedAllocation, PoseDeviation
from magnetosuture_thread.coils.drivers import DriverState
from magnetosuture_thread.coils.filter import FRICTION, SPEED, NeedleSafetyFilter, rest_reason
from magnetosuture_thread.coils.inputs import (
    CONSISTENT_POSES,
    TOPIC,
    CommandWatchdog,
    PoseExtrapolator,
    PredictionMonitor,
    StampAges,
)
from magnetosuture_thread.coils.latch import ArmingLatch
from magnetosuture_thread.coils.motion_observer import FollowMonitor, MotionObserver
from magnetosuture_thread.coils.needle_motion import STUCK, NeedleTwist
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.settings.errors import InvalidInputError, shortened

Vector = NDArray[np.float64]

OPERATOR, NEEDLE = "operator", "needle"
INPUTS = {OPERATOR: "operator/servo_cv", NEEDLE: "needle/servo_cv"}  # topics, by priority

LOOKAHEAD_PERIODS = 2.0  # in which command and pose must stay valid: one to the next step, one to the boards
SWIFT = 1e3  # m/s and rad/s; faster than anything, so that no product overflows
MIN_JUDGED = 0.2  # s; poses that are no farther apart are judged, also by a bridge that takes none so old
MAX_BLIND_TURN = 0.35  # rad; between two poses: of a crossing of a coil's axis, which ends also where poses get lost
STILL = "a motion that leaves the tip where it is"
NO_SCENE, NO_POSE = "no scene", "no needle pose"
# Constraints of the bridge, besides those of the filter.
NO_PREDICTION, CURRENT_LIMIT, FIRST_MOTION = "no prediction", "current", "first motion"
FIRST_SPEED, FIRST_WAY = 2e-3, 0.01  # m/s and m; of a needle that moves for the first time with a setup


NO_VELOCITY: Vector = np.zeros(2)
NO_VELOCITY.flags.writeable = False  # shared by all steps without a command


@dataclass(frozen=True)
class BridgeOutput:
    """Result of one bridge step: currents, velocities and reasons.

    Attributes:
        coils: their names, in the order of the currents.
        allocation: the currents, and the tip velocity that they give.
        commanded: commanded tip velocity, shape (2,) [m/s]; zero without a valid command.
        filtered: tip velocity after friction, limits and barriers, shape (2,) [m/s].
        reasons: why the currents are zero; empty while a command is followed, even a zero command.
        publish: whether to report it: while a command is followed, and for a while after.
        source: input that is followed, "operator" or "needle"; empty for none.
        overridden: input whose valid commands are overridden by the source; empty for none.
        slowdown: factor on the speed by the thread's friction.
        active: names of the constraints that changed the command.
        scene_version: of the scene that the needle is kept within; empty for none.
        pull: velocity that the thread's pull gives the needle, measured and compensated, shape (2,) [m/s].
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
    pull: Vector = field(default_factory=lambda: NO_VELOCITY)

    @property
    def applied(self) -> Vector:
        """Tip velocity that the currents give, by the bridge's model, shape (2,) [m/s]."""
        return self.allocation.velocity

    @property
    def reason(self) -> str:
        """Why the currents are zero; empty while a command is followed."""
        return "; ".join(self.reasons)


class _SelectedInput(NamedTuple):
    """The input that is followed, or why there is none.

    Attributes:
        source: of the command; empty for none.
        overridden: input whose valid commands are overridden.
        command: velocity of the tip, shape (2,) [m/s], or the motion of the needle, shape (3,), see `NeedleTwist`.
        problem: why there is no command.
        tip: velocity of the tip that is commanded, shape (2,) [m/s].
    """

    source: str = ""
    overridden: str = ""
    command: Vector = NO_VELOCITY
    problem: str = ""
    tip: Vector = NO_VELOCITY


def _selected(source: str, overridden: str, command: Vector) -> _SelectedInput:
    """Return the input that is followed; what the tip makes of a motion of the needle is known with its pose."""
    return _SelectedInput(source, overridden, command, tip=command if len(command) == 2 else NO_VELOCITY)


class CoilBridge:
    """Converts the last valid command into coil currents at a fixed rate, and to zero on any stop condition.

    There are two inputs: commands of `operator` have priority over those of `needle`, which are followed again when
    the operator's are stale. A step limits the command of the selected input, filters it by `NeedleSafetyFilter` if it
    is a velocity of the tip, and allocates the coil currents at the extrapolated pose, within the limits of current and
    slew. Of them, as much is set as the filter certifies for as long as the coils may hold it, see
    `CertifiedAllocation`. A stop, a zero command and that share take effect at once, without the limits on change.

    Pure: it reads no clock. `arrival` is a monotonic time, `now` the time of the stamps; both in seconds.

    Args:
        settings: of the bridge.
        latch: arming state; it outlives the bridge, as an emergency stop must.
        scene: dish and shapes; without one the bridge does not arm.

    Attributes:
        latch: arming state.
        watchdogs: command watchdogs by input, "operator" and "needle".
        extrapolator: extrapolates the needle's pose.
        prediction_monitor: monitors the thread model's margins.
        stamp_ages: how old commands and poses are when they arrive.
        slow_way: how far a needle has to follow with this setup, and after each fault that it does not, before it is
            driven faster than `FIRST_SPEED`; 0 where nothing moves [m].
        first_way: how much of that is left [m].
        scene_problem: why the scene that was heard last is not in force, while the currents are zero; empty if it is.

    Raises:
        ConfigurationError: the needle has no room in the scene.
    """

    def __init__(self, settings: CoilBridgeSettings, latch: ArmingLatch, scene: Scene | None) -> None:
        self.latch, self.scene_problem = latch, ""
        self.watchdogs = {name: CommandWatchdog(settings.command_timeout, topic) for name, topic in INPUTS.items()}
        self._hold = min(settings.command_timeout, settings.driver_timeout)  # the coils certainly hold a current
        needle = self._needle = settings.needle()
        kinematics = needle.kinematics
        self.extrapolator = PoseExtrapolator(
            kinematics,
            settings.pose_timeout,
            settings.reach,
            max_speed=settings.max_speed,
            uncertainty=settings.pose_uncertainty,
            min_hold=self._hold,
            max_hold=settings.hold_time,
        )
        self.prediction_monitor, self.stamp_ages = PredictionMonitor(settings.prediction_timeout), StampAges()
        self._observer = MotionObserver(kinematics, self._hold, min(settings.max_speed, needle.max_pull_speed))
        slack_ratio = needle.drag / needle.slack_drag
        max_interval = max(MIN_JUDGED, settings.pose_timeout)
        self._follow = FollowMonitor(settings.pose_uncertainty, slack_ratio, max_interval)
        self._settings, self._heading, self._allocation = settings, settings.heading_observer(), settings.allocation()
        self._coils = CertifiedAllocation(self._allocation, settings.max_speed, needle.max_pull_speed)
        self._filter: NeedleSafetyFilter | None = None
        self._losses, self._previous, self._velocity = 0, self._allocation.zero(), np.zeros(2)
        self._last_step, self._was_armed, self._blocked, self._blocked_reason = -math.inf, False, -math.inf, ""
        self._stopped: float | None = None
        self._pose_stamp = -math.inf
        self._turned = 0.0  # by which the needle was turned since the last pose [rad]
        self.slow_way = self.first_way = 0.0
        self.set_scene(scene)

    @property
    def coils(self) -> tuple[str, ...]:
        """The coils' names, in the order of their currents."""
        return self._allocation.names

    @property
    def scene(self) -> Scene | None:
        """The scene in force; None without one."""
        return None if self._filter is None else self._filter.scene

    @property
    def scene_version(self) -> str:
        """Version of the scene; empty without one."""
        return "" if self._filter is None else self._filter.scene.version

    def set_scene(self, scene: Scene | None) -> None:
        """Replace the scene from the next step on; without one the currents are zero.

        Raises:
            ConfigurationError: the needle has no room in it; the previous scene stays.
        """
        self._filter = None if scene is None else self._settings.safety_filter(scene)
        self._last_step = -math.inf  # it took its time, before which the coils were set to zero
        self.extrapolator.dish_radius = math.inf if scene is None else scene.dish.radius

    def rest(self, now: float, arrival: float) -> None:
        """Register that the currents are zero from a time on; see `step` for the times."""
        self._clear()
        self._observer.rest(now)
        self._heading.rest(now)
        self.extrapolator.apply_velocity(self._velocity, now, arrival)

    def command(self, source: str, command: Vector, stamp: float, number: int, now: float, arrival: float) -> None:
        """Register a command of an input; see `CommandWatchdog.update`.

        Args:
            source: the input, "operator" or "needle".
            command: velocity of the needle's tip in the dish plane, shape (2,) [m/s], or the motion of the needle in
                its own frame, shape (3,), see `NeedleTwist`.
            stamp: when it was made [s].
            number: of the message, counted by its publisher.
            now: the same clock now [s].
            arrival: a monotonic clock now [s].
        """
        self.stamp_ages.add(INPUTS[source], now - stamp, arrival)
        if source == OPERATOR and len(command) != 2:
            raise InvalidInputError(INPUTS[source], "a motion in the frame of the needle", "the velocity of the tip")
        self.watchdogs[source].update(command, stamp, number, now, arrival)

    def on_pose(
        self,
        tail: Vector,
        heading: Vector,
        stamp: float,
        number: int,
        now: float,
        arrival: float,
        covariance: Vector | None = None,
    ) -> None:
        """Register a measured needle pose; see `PoseExtrapolator.update`."""
        self.stamp_ages.add(TOPIC, now - stamp, arrival)
        error = self._heading.stamp_error  # 0 without compensation
        try:
            self.extrapolator.update(tail, heading, stamp, number, now, arrival, covariance, self.latch.armed, error)
        except InvalidInputError:
            if self.latch.armed and self.extrapolator.rejections >= CONSISTENT_POSES:
                self._trip_follow(f"needle does not follow: {self.extrapolator.rejection}")
            raise
        deviation = 0.0
        if stamp > self._pose_stamp:
            self._turned = 0.0
        self._pose_stamp = stamp
        if self._settings.motion_compensation:
            self._heading.update(heading, stamp)
            self._allocation.gains, deviation = self._heading.gains, self._heading.stamp_deviation
        seen = stamp - error
        motion = self._observer.update(tail, heading, seen, self._follow.is_trusted(seen), deviation)
        if motion is not None and self.latch.armed and self._filter is not None:
            at_shape = self._filter.clearance(tail, heading) < self._filter.keep_out
            if problem := self._follow.update(motion, at_shape):
                self._trip_follow(problem)
            elif self.first_way and (driven := math.hypot(*motion.driven)):
                # With its sign, so that noise adds nothing.
                followed = min(driven, max(-driven, float(motion.measured @ motion.driven) / driven))
                self.first_way = min(self.slow_way, max(0.0, self.first_way - followed))

    def _trip_follow(self, problem: str) -> None:
        """Latch that the needle does not follow; the next one moves slowly at first."""
        self.latch.trip(problem)
        self.first_way = self.slow_way

    def on_margins(self, stamp: float, valid: bool, slowdown: float, scene_version: str, arrival: float) -> None:
        """Register the thread model's margins; see `PredictionMonitor.update`."""
        self.prediction_monitor.update(stamp, valid, slowdown, scene_version, arrival)

    def arm(self, driver: DriverState) -> None:
        """Arm: follow later commands; see `ArmingLatch.arm`.

        Raises:
            InvalidInputError: see there; or there is no scene.
        """
        if self._filter is None:
            raise InvalidInputError("arm", NO_SCENE, "a scene, as a parameter or on its topic")
        self.latch.arm(driver.problem if not driver.ready else "")
        self._losses, self.extrapolator.rejections = driver.losses, 0
        self._follow.clear()
        for watchdog in self.watchdogs.values():
            watchdog.clear()

    def reset(self, driver: DriverState) -> None:
        """Clear emergency stop and faults; see `ArmingLatch.reset`."""
        self.latch.reset(driver.problem if not driver.ready else "")
        self._losses = driver.losses

    def step(self, now: float, arrival: float, driver: DriverState) -> BridgeOutput:
        """Compute the coil currents now.

        Args:
            now: time of the stamps' clock [s].
            arrival: a monotonic time [s].
            driver: state of the driver.
        """
        try:
            return self._step(now, arrival, driver)
        except Exception as error:  # After any error in here, the coils go to zero and stay there.
            self.latch.trip(f"internal error: {type(error).__name__}: {shortened(str(error))}")
            return self._zero_output(now, arrival, _SelectedInput(), (self.latch.stop_reason,))

    def final_output(self, reason: str) -> BridgeOutput:
        """Return the zeros with which the bridge ends, for a reason."""
        self._clear()
        return self._output(_SelectedInput(), (reason,))

    def _begin_step(self, arrival: float, driver: DriverState) -> float:
        """Latch what has happened to driver and loop since the step before; return the time since then [s]."""
        interval = arrival - self._last_step
        if self.latch.armed and not (driver.ready and driver.losses == self._losses):
            self.latch.trip(f"driver: {driver.problem or 'currents were lost for a moment'}")
        elif self._was_armed and driver.timeout < interval < math.inf:
            # The needle stopped at an unknown position; an operator must check.
            self.latch.trip(f"the bridge stood still for {interval:.2f} s: the coils stopped by themselves")
        self._last_step, self._was_armed = arrival, self.latch.armed
        if interval > self._hold:
            self._clear()  # the driver has gone to zero by itself
        return interval

    def _step(self, now: float, arrival: float, driver: DriverState) -> BridgeOutput:
        period = 1.0 / self._settings.rate
        interval = self._begin_step(arrival, driver)
        # However late a step is, velocity and currents change by at most that of two periods.
        elapsed = min(max(interval, 0.0), 2.0 * period)
        # An input that becomes stale before the next step has reached the boards is stale now.
        then = (now + LOOKAHEAD_PERIODS * period, arrival + LOOKAHEAD_PERIODS * period)
        selected = self._select_input(*then)
        pose = self.extrapolator.pose(now, arrival)
        angle = self._heading.angle(now) if self._settings.motion_compensation else None
        if pose is not None and angle is not None:
            tail, direction = self._needle.kinematics.turned_to(pose.tail, pose.heading, angle)
            pose = replace(pose, tail=tail, heading=direction)
        in_needle_frame, commanded = len(selected.command) == 3, NeedleTwist()
        if pose is not None and in_needle_frame:
            commanded = NeedleTwist(*np.clip(selected.command, -SWIFT, SWIFT).tolist())
            selected = selected._replace(tip=self._needle.kinematics.tip_velocity(pose.heading, commanded))
        no_prediction = self.prediction_monitor.stale_reason(now, arrival)
        reasons = self._stop_reasons(arrival, then, driver, selected, no_prediction)
        active: tuple[str, ...] = (NO_PREDICTION,) if no_prediction else ()
        slowly = FIRST_SPEED if self.first_way else math.inf
        if reasons or pose is None or self._filter is None:
            self._follow.end_probe()
            reasons = reasons or (self.extrapolator.stale_reason(now, arrival) or NO_POSE,)
            return self._zero_output(now, arrival, selected, reasons, active)
        if self._follow.probe_rate and selected.command.any():
            in_needle_frame, commanded = True, NeedleTwist(turn_rate=self._follow.probe_rate)
            tip = self._needle.kinematics.tip_velocity(pose.heading, commanded)
            selected = selected._replace(command=np.array(commanded), tip=tip)
        if not selected.command.any():
            self._follow.end_probe()
            output, self._stopped = replace(self._zero_output(now, arrival, selected, ()), publish=True), None
            return output
        settings, compensates = self._settings, self._settings.motion_compensation
        max_speed = min(settings.max_speed, settings.speed_without_prediction if no_prediction else math.inf)
        # The factor is felt by who steers; a needle that drags a real thread on its own is slowed by it already.
        slowed = selected.source == OPERATOR or settings.friction_feedback == "all"
        slowdown = self.prediction_monitor.slowdown if slowed and not no_prediction else 1.0
        kinematics, pull = self._needle.kinematics, self._observer.pull(pose.heading) if compensates else None
        if in_needle_frame:
            self._filter.set_time(now, self.extrapolator.first_stamp)
            first = min(1.0, slowly / max(math.hypot(commanded.along, commanded.across), 1e-300))
            commanded = commanded._replace(along=first * commanded.along, across=first * commanded.across)
            # Of the end that is turned ahead, which is the swifter one.
            swiftest = math.hypot(commanded.along, abs(commanded.across) + kinematics.lever * abs(commanded.turn_rate))
            limited = min(slowdown, max_speed / max(swiftest, 1e-300))
            twist = commanded.scaled(limited)
            wanted = kinematics.tip_velocity(pose.heading, twist)
            if not compensates:  # what is driven across the needle counts as a part of its turn
                twist = kinematics.twist(pose.heading, wanted)
            is_fast = limited < slowdown or first < 1.0
            active += tuple(filter(None, (FRICTION if slowdown < 1.0 else "", SPEED if is_fast else "")))
        else:
            filtered = self._filter.filter(
                selected.command,
                pose.tail,
                pose.heading,
                slowdown=slowdown,
                max_speed=min(max_speed, slowly),
                previous=self._velocity,
                elapsed=elapsed,
                time=now,
                first_time=self.extrapolator.first_stamp,
            )
            active += filtered.active
            if filtered.reason and not compensates:
                return self._zero_output(now, arrival, selected, (filtered.reason,), active, filtered.slowdown)
            wanted, aside = filtered.filtered, 0.0
            if compensates:
                room = min(slowdown * math.hypot(*selected.command), min(max_speed, slowly) - math.hypot(*wanted))
                room = max(0.0, room)  # while the needle slows down to another limit it is still faster
                aside = min(room, max(-room, self._filter.sidestep(pose.tail, pose.heading)))
            twist = kinematics.twist(pose.heading, wanted)._replace(across=aside)
        if not compensates and not wanted.any():
            return self._zero_output(now, arrival, selected, (rest_reason(list(active) or [STILL]),), active, slowdown)
        if compensates:
            rate = max(0.0, MAX_BLIND_TURN - abs(self._turned)) / period
            unproven = self._observer.pull(pose.heading, self._follow.unproven_pull(self._observer.velocity))
            twist = NeedleTwist(
                twist.along + unproven.along,
                twist.across + unproven.across,
                min(rate, max(-rate, twist.turn_rate)),
            )
        max_change = settings.max_current_slew * elapsed
        balance = 0.0 if pull is None else self._heading.balance(pull.across)
        doubt = PoseDeviation(self._observer.place_deviation(now), self._heading.stamp_deviation)
        allocation, limiting = self._coils.allocate(
            twist, pose, self._filter, self._previous, max_change, pull, balance, doubt, slowly
        )
        limits = limiting, CURRENT_LIMIT if allocation.saturated else ""
        active += tuple(name for name in limits if name and name not in active)
        active += (FIRST_MOTION,) if self.first_way and SPEED in active else ()
        pulled = NeedleTwist() if pull is None else pull
        expected = allocation.velocity + kinematics.tip_velocity(pose.heading, pulled)
        own_drift = allocation.drift if compensates else 0.0  # else it counts as part of the turn
        is_stuck = math.hypot(*expected) <= STUCK * math.hypot(*wanted)
        # A needle that is pulled is held by currents where it may not go on.
        # With less than 0.1 mA in each coil the needle is at rest, which needs a reason.
        if (is_stuck and not compensates) or np.abs(allocation.currents).max() < 1e-4:
            names = [name for name in active if name in (limiting, CURRENT_LIMIT)] or list(active) or [CURRENT_LIMIT]
            self._blocked, self._blocked_reason = arrival, f"{rest_reason(names)}: no feasible currents"
            return self._zero_output(now, arrival, selected, (self._blocked_reason,), active, slowdown)
        self._previous, self._stopped = allocation, None
        self._velocity = expected if in_needle_frame else wanted
        self.extrapolator.apply_velocity(expected, now, arrival, own_drift + pulled.across)
        self._heading.apply(now, pose.tail, pose.heading, allocation.currents, pulled.across)
        motion = kinematics.twist(pose.heading, expected, own_drift + pulled.across)
        e = kinematics.chord_direction(pose.heading)
        n = np.array([-e[1], e[0]])
        applied = (motion.along - pulled.along) * e + own_drift * n
        # Where the force that is allowed does not suffice, what was intended is the wanted velocity.
        intended = twist.along * e + twist.across * n if limiting == SPEED else applied + self._observer.velocity
        self._observer.apply(now, applied, intended, motion.turn_rate)
        self._follow.register_turn(motion.turn_rate * period)
        self._turned += motion.turn_rate * period
        return self._output(selected, (), active, slowdown, self._observer.velocity if compensates else NO_VELOCITY)

    def _select_input(self, now: float, arrival: float) -> _SelectedInput:
        """Return the input to follow at a time of the stamps' clock and a monotonic time [s]."""
        operator, needle = self.watchdogs[OPERATOR], self.watchdogs[NEEDLE]
        problem = operator.stale_reason(now, arrival)
        if not problem:
            overridden = "" if needle.is_empty or needle.stale_reason(now, arrival) else NEEDLE
            return _selected(OPERATOR, overridden, operator.velocity)
        if operator.has_conflict(arrival):
            return _SelectedInput(problem=problem)
        other = needle.stale_reason(now, arrival)
        if not other:
            return _selected(NEEDLE, "", needle.velocity)
        # An input that was never used does not explain why there is no command now.
        return _SelectedInput(problem=problem if needle.is_empty and not needle.has_conflict(arrival) else other)

    def _stop_reasons(
        self,
        arrival: float,
        then: tuple[float, float],
        driver: DriverState,
        selected: _SelectedInput,
        no_prediction: str,
    ) -> tuple[str, ...]:
        """Return all stop conditions until the next step."""
        reasons = (
            self.latch.stop_reason,
            "" if driver.ready or self.latch.latched_reason else f"driver: {driver.problem}",
            self.scene_problem,
            NO_SCENE if self._filter is None else self.prediction_monitor.scene_mismatch(self.scene_version, arrival),
            selected.problem,
            self.extrapolator.stale_reason(*then),
            no_prediction if self._settings.without_prediction == "stop" else "",
            # A blocked command is tried again after 0.1 s.
            self._blocked_reason if arrival - self._blocked < 0.1 else "",
        )
        return tuple(reason for reason in reasons if reason)

    def _zero_output(
        self,
        now: float,
        arrival: float,
        selected: _SelectedInput,
        reasons: tuple[str, ...],
        active: tuple[str, ...] = (),
        slowdown: float = 1.0,
    ) -> BridgeOutput:
        """Return zero currents, without limits on change."""
        self._stopped = arrival if self._stopped is None else self._stopped
        self.rest(now, arrival)
        publish = arrival - self._stopped <= self._settings.zero_hold
        return replace(self._output(selected, reasons, active, slowdown), publish=publish)

    def _output(
        self,
        selected: _SelectedInput,
        reasons: tuple[str, ...],
        active: tuple[str, ...] = (),
        slowdown: float = 1.0,
        pull: Vector = NO_VELOCITY,
    ) -> BridgeOutput:
        """Return the result of a step with the currents and the filtered velocity that it has ended with."""
        source, overridden, _, _, tip = selected
        fixed = (self.coils, self._previous, tip, self._velocity, reasons, True, source, overridden)
        return BridgeOutput(*fixed, slowdown, active, self.scene_version, pull)

    def _clear(self) -> None:
        """Restart the limits on change from zero current and velocity."""
        self._previous, self._velocity = self._allocation.zero(), np.zeros(2)
