"""From commands and poses to currents, with everything that can keep them at zero."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.coils.allocation import Allocation
from magnetosuture_thread.coils.drivers.protocol import DriverState
from magnetosuture_thread.coils.gate import CommandGate
from magnetosuture_thread.coils.latch import ArmingLatch
from magnetosuture_thread.coils.limits import approached
from magnetosuture_thread.coils.needle import NeedleWatch, Pose
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.scene import Scene

Vector = NDArray[np.float64]

AHEAD = 2.0  # periods that a command and a pose must still be good for: one to the next step, one to the boards
LONGEST = 2.0  # periods that velocity and currents may change over in one step, however late it comes
CORRECTIONS = 4  # of what the coils add to a velocity that leads towards the wall
BLOCKED = "the coils would pull the needle to the wall or an obstacle"
BLOCKED_FOR = 0.1  # s until it is tried again
TOLERANCE = 0.005  # of the greatest speed, that they may still add


@dataclass(frozen=True)
class Outcome:
    """What one step asks of the coils, and why.

    Attributes:
        coils: their names, in the order of the currents.
        allocation: the currents, and the tip velocity that they give.
        commanded: the tip velocity that was asked for, shape (2,) [m/s]; zero where none is good.
        applied: the same after all limits, shape (2,) [m/s].
        reasons: why the currents are zero; empty while a command is followed, be it to rest.
        publish: whether to tell: while a command is followed, and for a while after it has ended.
    """

    coils: tuple[str, ...]
    allocation: Allocation
    commanded: Vector
    applied: Vector
    reasons: tuple[str, ...]
    publish: bool


class Bridge:
    """Turns the last good command into currents, at a fixed rate, for as long as nothing speaks against it.

    One step takes the command, slows it to the greatest speed, limits how fast it changes, keeps the needle
    off the wall and obstacles (last, as this may not give way), and lays the field along the needle as it
    lies now, within the limits of current and slew. Whatever stops the needle takes effect at once, without
    these limits on change, and so does a command to rest.

    Pure: it reads no clock. `arrival` is a monotonic time, `now` the time of the stamps; both in seconds.

    Args:
        settings: of the bridge.
        latch: outlives it, as an emergency stop must.

    Attributes:
        latch: whether commands may pass at all.
        gate: of the commands.
        needle: where it is.
    """

    def __init__(self, settings: CoilBridgeSettings, latch: ArmingLatch, scene: Scene | None = None) -> None:
        self.latch = latch
        self.gate = CommandGate(settings.command_timeout, settings.max_speed)
        self.needle = NeedleWatch(settings.needle(), settings.pose_timeout, settings.reach)
        self._settings = settings
        self._coils = settings.allocation()
        self._workspace = settings.workspace(scene or Scene())
        self._losses = 0
        self._before = self._coils.zero()
        self._velocity = np.zeros(2)
        self._stepped = -math.inf
        self._stopped: float | None = None
        self._blocked = -math.inf
        # Once, so that no step waits for a compiler.
        self._workspace.safe_velocity(np.array([1.0, 0.0]), np.zeros(2), np.array([1.0, 0.0]))

    @property
    def coils(self) -> tuple[str, ...]:
        """The coils' names, in the order of their currents."""
        return self._coils.names

    def arm(self, driver: DriverState) -> None:
        """Let commands pass that come from now on; see `ArmingLatch.arm`."""
        self.latch.arm(driver.problem if not driver.ready else "")
        self._losses = driver.losses
        self.gate.forget()

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
            return self._rest(now, arrival, (self.latch.holds,))

    def _step(self, now: float, arrival: float, driver: DriverState) -> Outcome:
        if self.latch.armed and not (driver.ready and driver.losses == self._losses):
            self.latch.trip(f"driver: {driver.problem or 'currents were lost for a moment'}")
        period = 1.0 / self._settings.rate
        late = arrival - self._stepped
        self._stepped = arrival
        if late > self._settings.command_timeout:
            self._forget()  # the driver has gone to zero by itself meanwhile
        elapsed = min(max(late, 0.0), LONGEST * period)
        reasons, pose = self._why_not(now, arrival, driver)
        if reasons or pose is None:
            return self._rest(now, arrival, reasons)
        wanted = self.gate.velocity
        if not wanted.any():
            outcome = replace(self._rest(now, arrival, ()), publish=True)
            self._stopped = None
            return outcome
        velocity = approached(self._velocity, wanted, self._settings.max_acceleration * elapsed)
        velocity = self._workspace.safe_velocity(velocity, pose.tail, pose.heading)
        allocation = self._allocate(velocity, pose, self._settings.max_current_slew * elapsed)
        if allocation is None:
            self._blocked = arrival
            return self._rest(now, arrival, (BLOCKED,))
        self._before, self._velocity, self._stopped = allocation, velocity, None
        self.needle.move(allocation.velocity, now)
        return Outcome(self.coils, allocation, wanted, velocity, (), True)

    def _why_not(self, now: float, arrival: float, driver: DriverState) -> tuple[tuple[str, ...], Pose | None]:
        """Return all that speaks against a current until the next step, and the pose if there is a good one."""
        pose = self.needle.pose(now, arrival)
        # What would end before the next step has reached the boards ends now: no current outlives what it is for.
        ahead = AHEAD / self._settings.rate
        then = (now + ahead, arrival + ahead)
        blocked = BLOCKED if arrival - self._blocked < BLOCKED_FOR else ""
        unready = "" if driver.ready or self.latch.latched else f"driver: {driver.problem}"
        reasons = (self.latch.holds, unready, self.gate.closed(*then), self.needle.lost(*then), blocked)
        return tuple(reason for reason in reasons if reason), pose

    def _rest(self, now: float, arrival: float, reasons: tuple[str, ...]) -> Outcome:
        """Return no current, at once."""
        if self._stopped is None:
            self._stopped = arrival
        self._forget()
        self.needle.move(self._velocity, now)
        publish = arrival - self._stopped <= self._settings.zero_hold
        return Outcome(self.coils, self._before, np.zeros(2), self._velocity, reasons, publish)

    def _forget(self) -> None:
        """Begin anew from no current and no velocity."""
        self._before, self._velocity = self._coils.zero(), np.zeros(2)

    def _allocate(self, velocity: Vector, pose: Pose, largest_change: float) -> Allocation | None:
        """Return currents whose own velocity, drift included, keeps clear; None if none were found."""
        asked = velocity
        for _ in range(1 + CORRECTIONS):
            found = self._coils.allocate(asked, pose.tail, pose.heading, self._before.currents, largest_change)
            safe = self._workspace.safe_velocity(found.velocity, pose.tail, pose.heading)
            excess = found.velocity - safe
            if float(np.linalg.norm(excess)) <= TOLERANCE * self._settings.max_speed:
                return found
            asked = asked - excess
        return None
