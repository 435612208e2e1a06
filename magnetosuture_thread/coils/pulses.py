"""Pulses of the coils: currents for a while, ended by what the needle does, for a rig that is not known yet."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.coils.allocation import Allocation
from magnetosuture_thread.coils.bridge import INPUTS, LOOKAHEAD_PERIODS, BridgeOutput, CoilBridge, _SelectedInput
from magnetosuture_thread.coils.drivers import DriverState
from magnetosuture_thread.coils.inputs import TOPIC
from magnetosuture_thread.coils.latch import ArmingLatch
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.settings.errors import InvalidInputError
from magnetosuture_thread.settings.interface import Service

Vector = NDArray[np.float64]

MAX_TIME = 0.5  # s; of a pulse: for so long the needle moves at most where who has asked for it is gone
MAX_WAY, MAX_SPEED = 1.5e-3, 8e-3  # m and m/s; of the needle's middle, beyond which a pulse ends
WALL = 0.6  # of the dish's radius, beyond which a needle whose middle moves outwards ends a pulse
OUTWARDS = 5e-5  # m; of a way outwards that is no error of a pose
SPEED_POSES = 4  # over which a speed is measured: errors of some micrometres are small against their way
IS_OVER, NO_PULSE, STOOD_STILL = "the pulse is over", "no pulse", "the bridge stood still"


class MotionGuard:
    """Says by measured poses when a needle that nobody can predict has moved enough.

    Args:
        reach: distance of its middle from the dish's centre beyond which it may not move outwards [m].
    """

    def __init__(self, reach: float) -> None:
        self._reach = reach
        self._middles: deque[tuple[float, Vector]] = deque(maxlen=SPEED_POSES)
        self._origin: Vector | None = None

    def update(self, stamp: float, middle: Vector) -> None:
        """Register where the middle of the needle was at a time [s], shape (2,) [m]."""
        self._middles.append((stamp, middle))
        self._origin = middle if self._origin is None else self._origin

    def begin(self) -> None:
        """Count the way from the last pose on; without one, from the next."""
        self._origin = self._middles[-1][1] if self._middles else None

    def problem(self) -> str:
        """Return why the needle must not go on; empty if it may."""
        if self._origin is None:
            return ""
        (before, earlier), (stamp, middle) = self._middles[0], self._middles[-1]
        way, moved = middle - self._origin, math.hypot(*(middle - earlier))
        if (length := math.hypot(*way)) > MAX_WAY:
            return f"the needle has moved {1e3 * length:.1f} mm"
        if moved > MAX_SPEED * (stamp - before):
            return f"the needle moves at {1e3 * moved / max(stamp - before, 1e-3):.1f} mm/s"
        if (away := math.hypot(*middle)) > self._reach and float(middle @ way) > OUTWARDS * away:
            return "the needle comes to the wall"
        return ""


def guard_reach(dish_radius: float, needle_length: float, keep_out: float) -> float:
    """Return how far from the centre the middle of a needle may move outwards [m]: its ends stay off the wall."""
    return min(WALL * dish_radius, dish_radius - keep_out - 0.5 * needle_length)


@dataclass(frozen=True)
class _Pulse:
    """Currents [A], for how long [s], and since when by a monotonic clock [s]; None before their first step."""

    currents: Vector
    duration: float
    since: float | None = None


class PulseBridge(CoilBridge):
    """A bridge of a rig that is being commissioned: it gives pulses of currents, and follows no velocity.

    Latch, driver, scene and poses stop a pulse as they stop a command. Between two pulses there are zeros for as long
    as the driver's timeout, so that boards have them. What needs to know coils and needle, as the safety filter and the
    follow check, does not take part. A pulse ends besides after its time, by `MotionGuard`, once anybody commands a
    velocity, and where the loop stands still for longer than the driver holds currents. Currents change within the
    limits of `CoilBridgeSettings`, zeros take effect at once.

    Args:
        settings: as of `CoilBridge`.
        latch: the same.
        scene: the same; a pulse is given in an empty dish only.
    """

    def __init__(self, settings: CoilBridgeSettings, latch: ArmingLatch, scene: Scene | None) -> None:
        super().__init__(settings, latch, scene)
        self._pulse: _Pulse | None = None
        self._idle_reason, self._over = NO_PULSE, -math.inf  # why no pulse flows, and since when [s]

    def set_scene(self, scene: Scene | None) -> None:
        """Replace the scene from the next step on; a pulse that flows ends."""
        super().set_scene(scene)
        self._pulse = None
        radius = 0.0 if scene is None else scene.dish.radius
        self._guard = MotionGuard(guard_reach(radius, self._settings.needle_length, self._settings.keep_out))

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
        """Register a measured needle pose. One that jumps ends a pulse and is no fault: the field may turn a needle."""
        self.stamp_ages.add(TOPIC, now - stamp, arrival)
        self.extrapolator.update(tail, heading, stamp, number, now, arrival, covariance)
        self._guard.update(stamp, 0.5 * (tail + self._needle.kinematics.tip(tail, heading)))

    def pulse(self, currents: Vector, duration: float, now: float, arrival: float, driver: DriverState) -> None:
        """Give currents from the next step on.

        Args:
            currents: of each coil, shape (m,) [A].
            duration: [s].
            now: time of the stamps' clock [s].
            arrival: a monotonic time [s].
            driver: its state.

        Raises:
            InvalidInputError: they are too large, too long, not finite or too few; something stops the coils, a pulse
                flows or has just ended, or there are shapes in the dish.
        """
        most = self._settings.max_current
        if currents.shape != (len(self.coils),) or not np.all(np.abs(currents) <= most):
            expected = f"{len(self.coils)} numbers of at most {most:g} A"
            raise InvalidInputError(f"{Service.PULSE}.current", currents.tolist(), expected)
        if not 0.0 < duration <= MAX_TIME:
            raise InvalidInputError(f"{Service.PULSE}.duration", duration, f"above 0, at most {MAX_TIME:g} s")
        if self.scene is not None and self.scene.shapes:
            raise InvalidInputError(Service.PULSE, f"{len(self.scene.shapes)} shapes in the dish", "an empty dish")
        if self._pulse is not None:
            raise InvalidInputError(Service.PULSE, "a pulse that flows", "its end before the next one")
        if reasons := self._reasons("", now, arrival, driver):
            raise InvalidInputError(Service.PULSE, "; ".join(reasons), "a bridge that may give currents")
        if (rest := self._over + self._settings.driver_timeout - arrival) > 0.0:
            raise InvalidInputError(Service.PULSE, f"coils that rest for {rest:.2f} s more", "zeros between two pulses")
        self._pulse = _Pulse(np.array(currents, dtype=float), duration)
        self._guard.begin()

    def _step(self, now: float, arrival: float, driver: DriverState) -> BridgeOutput:
        interval = self._begin_step(arrival, driver)
        period = 1.0 / self._settings.rate
        if self._pulse is not None and self._pulse.since is None:
            self._pulse = replace(self._pulse, since=arrival)
        elif self._pulse is not None and (ended := self._ended(arrival, interval)):
            self._pulse, self._idle_reason, self._over = None, ended, arrival
        reasons = self._reasons("" if self._pulse else self._idle_reason, now, arrival, driver)
        if reasons or self._pulse is None:
            if self._pulse is not None:
                self._pulse, self._idle_reason, self._over = None, NO_PULSE, arrival
            return self._zero_output(now, arrival, _SelectedInput(), reasons)
        change = self._settings.max_current_slew * min(max(interval, 0.0), 2.0 * period)
        before = self._previous.currents
        currents = np.clip(self._pulse.currents, before - change, before + change)
        self._previous, self._stopped = Allocation(currents, np.zeros(2), False), None
        return self._output(_SelectedInput(), ())

    def _ended(self, arrival: float, interval: float) -> str:
        """Return why the pulse that flows ends now by itself; empty if it goes on for another period."""
        assert self._pulse is not None
        assert self._pulse.since is not None
        if interval > self._hold:
            return f"{STOOD_STILL} for {interval:.2f} s"
        if arrival + 1.0 / self._settings.rate > self._pulse.since + self._pulse.duration + 1e-9:
            return IS_OVER
        return self._guard.problem()

    def _reasons(self, idle: str, now: float, arrival: float, driver: DriverState) -> tuple[str, ...]:
        """Return all reasons for zero currents until the next step, beside there being no pulse."""
        ahead = LOOKAHEAD_PERIODS / self._settings.rate
        then = now + ahead, arrival + ahead
        commanding = [
            INPUTS[name]
            for name, watchdog in self.watchdogs.items()
            if not watchdog.stale_reason(*then) or watchdog.has_conflict(arrival)
        ]
        problem = f"{commanding[0]} commands the needle" if commanding else idle
        return self._stop_reasons(arrival, then, driver, _SelectedInput(problem=problem), "")
