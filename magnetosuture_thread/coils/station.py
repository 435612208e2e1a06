"""The bridge and its driver together, from configuring to cleaning up, under one latch."""

from __future__ import annotations

import numpy as np

from magnetosuture_thread.coils.bridge import Bridge, Outcome
from magnetosuture_thread.coils.drivers import CoilDriver, DriverState
from magnetosuture_thread.coils.latch import ArmingLatch
from magnetosuture_thread.coils.rhythm import Rhythm
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.scene import Scene

NO_DRIVER = DriverState(False, "unconfigured")


class CoilStation:
    """What the node has in hand: nothing while it is unconfigured, but for the latch.

    Whatever is pressed goes to the coils with the next `step`, which the node makes at once.

    Attributes:
        latch: whether commands may pass; it outlives a configuration, as an emergency stop must.
        bridge: None while unconfigured.
        driver: the last that was opened.
        outcome: of the last step; None while unconfigured.
        rhythm: of the watchdog.
    """

    def __init__(self) -> None:
        self.latch = ArmingLatch()
        # Loads its kernels, so that no step and no transition waits for a compiler.
        Bridge(CoilBridgeSettings(), self.latch, Scene())
        self.bridge: Bridge | None = None
        self.driver: CoilDriver | None = None
        self.outcome: Outcome | None = None
        self.rhythm = Rhythm(1.0)
        self._name = "none"
        self._arms = False

    @property
    def driver_name(self) -> str:
        """Name of the driver in use."""
        return self._name

    @property
    def driver_state(self) -> DriverState:
        """What the driver knows."""
        return NO_DRIVER if self.bridge is None or self.driver is None else self.driver.state()

    def open(self, settings: CoilBridgeSettings, bridge: Bridge, driver: CoilDriver) -> None:
        """Take a driver; from now on each step tells it something, zero at first."""
        self.driver, self._name = driver, settings.driver
        driver.open()
        self.bridge, self.rhythm = bridge, Rhythm(1.0 / settings.rate)

    def arm_when_ready(self) -> None:
        """Arm by itself, once, as soon as the driver is ready; whatever is pressed or fails before calls that off."""
        self._arms = True

    def close(self) -> None:
        """Leave the coils at zero."""
        self.bridge = self.outcome = None
        self._arms = False
        self._name = "none"
        if self.driver is not None:
            self.driver.close()

    def arm(self, asked: bool) -> None:
        """Let commands pass that come from now on, or none.

        Raises:
            InvalidInputError: see `ArmingLatch.arm`; or the bridge is not configured.
        """
        self._arms = False
        if not asked:
            self.latch.disarm()
        elif self.bridge is None:
            raise InvalidInputError("arm", "an unconfigured bridge", "an active one")
        else:
            self.bridge.arm(self.driver_state)

    def reset(self) -> None:
        """Forget the emergency stop and faults; nothing is armed by that.

        Raises:
            InvalidInputError: the driver is not ready.
        """
        self._arms = False
        if self.bridge is None:
            self.latch.reset("")
        else:
            self.bridge.reset(self.driver_state)

    def zero(self) -> None:
        """Tell the driver zero, whatever else may be wrong."""
        if self.driver is not None and self.outcome is not None:
            self.driver.apply(np.zeros_like(self.outcome.allocation.currents))

    def step(self, now: float, arrival: float) -> Outcome | None:
        """Let the bridge say what the coils get now, and tell the driver; None while unconfigured.

        Args:
            now: time of the stamps' clock [s].
            arrival: a monotonic time [s].
        """
        if self.bridge is None or self.driver is None:
            return None
        state = self.driver.state()
        self._arms = self._arms and self.latch.waits
        if self._arms and state.ready and self.bridge.scene is not None:
            self.arm(True)
        self.outcome = self.bridge.step(now, arrival, state)
        self.driver.apply(self.outcome.allocation.currents)
        return self.outcome
