"""Coil bridge, driver and arming latch as one unit, from configuration to cleanup."""

from __future__ import annotations

import math
import sys
from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from magnetosuture_thread.coils.bridge import FIRST_WAY, BridgeOutput, CoilBridge
from magnetosuture_thread.coils.drivers import CoilDriver, DriverState
from magnetosuture_thread.coils.latch import ArmingLatch, RecordedState, StopRecord
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.geometry.barrier import import_barriers
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.settings.errors import ConfigurationError, InvalidInputError

UNCONFIGURED, FINALIZED = "unconfigured", "finalized"
UNCLEAN_END = "the bridge ended while armed or in fault, and not in order"


class LoopTiming:
    """Jitter statistics over the last intervals of a loop.

    Args:
        period: of the loop [s].
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self._last: float | None = None
        # The statistics are over the last 2000 intervals.
        self._deviations: deque[float] = deque(maxlen=2000)

    def tick(self, arrival: float) -> None:
        """Register one run of the loop at a monotonic time [s]."""
        if self._last is not None:
            self._deviations.append(abs(arrival - self._last - self._period))
        self._last = arrival

    @property
    def jitter_ms(self) -> tuple[float, float, float]:
        """Deviation of an interval from the period: median, 99th percentile, maximum [ms]; NaN if unknown."""
        if not self._deviations:
            return math.nan, math.nan, math.nan
        median, p99, maximum = 1e3 * np.percentile(np.array(self._deviations), [50.0, 99.0, 100.0])
        return float(median), float(p99), float(maximum)


class CoilSystem:
    """Lifecycle of bridge and driver; while unconfigured there is only the latch.

    Every switch takes effect with the next `step`, which the node makes at once.

    Attributes:
        latch: arming state; it outlives a configuration, as an emergency stop must.
        bridge: None while unconfigured.
        driver: the last that was opened.
        driver_name: of the driver in use.
        output: of the last step; None while unconfigured.
        timing: of the watchdog's loop.
        closed: why there is no bridge, while there is none.

    Args:
        record: of the latch, over a restart; none if None.
    """

    def __init__(self, record: StopRecord | None = None) -> None:
        self.latch = ArmingLatch()
        # Loads the compiled functions, so that no step and no transition waits for a compiler.
        CoilBridge(CoilBridgeSettings(), self.latch, Scene())
        self.bridge: CoilBridge | None = None
        self.driver: CoilDriver | None = None
        self.output: BridgeOutput | None = None
        self.timing = LoopTiming(1.0)
        self.closed = UNCONFIGURED
        self._record = record
        self.driver_name = "none"
        self._auto_arm, self._max_timeout = False, 0.0
        self._identity = self._followed = ""  # of the setup, and of that with which a needle has followed
        self._imported: tuple[str, ...] = ()

    @property
    def driver_state(self) -> DriverState:
        """State of the driver; one that may hold currents for longer than motion is certified for is not ready."""
        if self.bridge is None or self.driver is None:
            return DriverState(False, self.closed)
        state = self.driver.state()
        if not state.ready or state.timeout <= self._max_timeout:
            return state
        expected = f"expected at most driver_timeout, {self._max_timeout:g} s"
        return replace(state, ready=False, problem=f"it stops by itself after {state.timeout:g} s, {expected}")

    @property
    def closed_reasons(self) -> tuple[str, ...]:
        """Why the currents are zero while there is no bridge."""
        latched = self.latch.latched_reason
        return (latched,) if latched and self.closed == UNCONFIGURED else tuple(filter(None, (latched, self.closed)))

    def recall(self, record: StopRecord) -> None:
        """Latch what a record holds of the process before, and keep the latch in it from now on."""
        self._record = record
        found = record.read()
        self._followed = record.followed or self._followed
        if found is RecordedState.STOPPED:
            self.latch.stop()
        elif found is RecordedState.ARMED and not self.latch.armed:
            self.latch.trip(UNCLEAN_END)

    def remember(self, *, ends: bool = False) -> None:
        """Write what must outlive this process: an emergency stop, and that it has not ended in order.

        Args:
            ends: whether it ends now, in order.

        Raises:
            InvalidInputError: the file cannot be written.
        """
        if self._record is None:
            return
        if self.latch.emergency:
            state = RecordedState.STOPPED
        else:
            state = RecordedState.ARMED if (self.latch.armed or self.latch.fault) and not ends else RecordedState.SAFE
        self._record.followed = self._followed
        try:
            self._record.write(state)
        except (OSError, ValueError) as error:
            problem = f"{self._record.path} ({getattr(error, 'strerror', None) or error})"
            field = f"{CoilBridgeSettings.GROUP}.stop_file"
            raise InvalidInputError(field, problem, "a file that can be written") from None

    def import_barriers(self, names: Sequence[str]) -> None:
        """Import the modules of barriers, at the start: while one is imported, no emergency stop is answered."""
        import_barriers(names)
        self._imported = tuple(names)

    def check_barriers(self, names: Sequence[str]) -> None:
        """Refuse barriers whose modules were neither named at the start nor imported by others.

        Raises:
            ConfigurationError: naming the barrier.
        """
        for name in names:
            if name not in self._imported and name.partition(":")[0] not in sys.modules:
                where = f"{CoilBridgeSettings.GROUP}.barriers"
                raise ConfigurationError(where, name, "one that was named when the node started")

    def open(self, settings: CoilBridgeSettings, bridge: CoilBridge, driver: CoilDriver) -> None:
        """Open a driver; from now on each step applies currents, zero at first.

        One that may move something moves the needle slowly at first, unless one has followed with this setup before.

        Raises:
            ConfigurationError: the bridge would arm itself with a driver that may move something.
        """
        moves_nothing = getattr(driver, "moves_nothing", False)
        if settings.autostart == "armed" and not moves_nothing:
            raise settings.refused("autostart", "active at most: what may move something is armed by a person")
        self._max_timeout = math.inf if moves_nothing else settings.driver_timeout
        self._identity = "" if moves_nothing else settings.identity
        bridge.slow_way = FIRST_WAY if self._identity else 0.0
        bridge.first_way = 0.0 if self._identity == self._followed else bridge.slow_way
        self.driver, self.driver_name = driver, settings.driver
        driver.open()
        self.bridge, self.timing = bridge, LoopTiming(1.0 / settings.rate)

    def arm_when_ready(self, wanted: bool = True) -> None:
        """Arm automatically, once, as soon as the driver is ready; any switch or fault before cancels that."""
        self._auto_arm = wanted

    def close(self, reason: str = UNCONFIGURED) -> BridgeOutput | None:
        """Set the coils to zero and close the driver.

        Args:
            reason: why there is no bridge from now on.

        Returns:
            The zeros with which it ends; None if there was no bridge.
        """
        final = None if self.bridge is None else self.bridge.final_output(reason)
        self.bridge = self.output = None
        self.closed = reason
        self._auto_arm, self.driver_name = False, "none"
        if self.driver is not None:
            self.driver.close()
        return final

    def arm(self, armed: bool) -> None:
        """Arm, so that later commands are followed, which is recorded before; or disarm, which is left to `remember`.

        Raises:
            InvalidInputError: see `ArmingLatch.arm`; or the bridge is not configured.
        """
        self._auto_arm = False
        if not armed:
            self.latch.disarm()
            return
        if self.bridge is None:
            raise InvalidInputError("arm", "an unconfigured bridge", "an active one")
        self.bridge.arm(self.driver_state)
        try:
            self.remember()
        except InvalidInputError:
            self.latch.disarm()
            raise

    def reset(self) -> None:
        """Clear the emergency stop and faults; the bridge stays disarmed.

        Raises:
            InvalidInputError: the driver is not ready, or the record of the stop cannot be cleared.
        """
        self._auto_arm = False
        emergency, fault = self.latch.emergency, self.latch.fault
        if self.bridge is None:
            self.latch.reset("")
        else:
            self.bridge.reset(self.driver_state)
        try:
            self.remember()
        except InvalidInputError:
            self.latch.emergency, self.latch.fault = emergency, fault
            raise

    def zero(self) -> None:
        """Apply zero currents, unconditionally."""
        if self.driver is not None and self.output is not None:
            self.driver.apply(np.zeros_like(self.output.allocation.currents), math.inf)

    def step(self, now: float, arrival: float, scene_problem: str = "") -> BridgeOutput | None:
        """Compute the coil currents and apply them; None while unconfigured.

        Args:
            now: time of the stamps' clock [s].
            arrival: a monotonic time [s].
            scene_problem: see `CoilBridge`.
        """
        if self.bridge is None or self.driver is None:
            return None
        state = self.driver_state
        self._auto_arm = self._auto_arm and self.latch.ready_to_arm
        if self._auto_arm and state.ready and self.bridge.scene is not None:
            try:
                self.arm(True)
            except InvalidInputError as error:
                self.latch.trip(str(error))
        self.bridge.scene_problem = scene_problem
        self.output = self.bridge.step(now, arrival, state)
        self.driver.apply(self.output.allocation.currents, arrival)
        if self._identity:  # recorded with the next switch: the loop does not wait for the disk
            self._followed = "" if self.bridge.first_way else self._identity
        return self.output
