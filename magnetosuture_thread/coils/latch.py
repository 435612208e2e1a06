"""Who may move the needle: armed or not, the emergency stop, and faults that somebody has to reset."""

from __future__ import annotations

from enum import Enum

from magnetosuture_thread.errors import InvalidInputError


class Condition(Enum):
    """What the bridge as a whole is in."""

    INACTIVE = "inactive"
    ACTIVE = "active"
    FAULT = "fault"


class ArmingLatch:
    """Holds the bridge at zero until it is active, armed, and free of faults.

    An emergency stop and a fault disarm, and stay until they are reset; a reset never arms. So after
    whatever stopped the needle for good, two deliberate acts come before it moves again.

    Attributes:
        active: whether the node is.
        armed: whether commands may pass.
        emergency: whether the emergency stop has been pressed since the last reset.
        fault: what went wrong since the last reset; empty if nothing.
    """

    def __init__(self) -> None:
        self.active = False
        self.armed = False
        self.emergency = False
        self.fault = ""

    @property
    def condition(self) -> Condition:
        """What the bridge is in."""
        if self.latched:
            return Condition.FAULT
        return Condition.ACTIVE if self.active else Condition.INACTIVE

    @property
    def latched(self) -> str:
        """Say what keeps the bridge at zero until a reset; empty if nothing."""
        return "emergency stop" if self.emergency else self.fault

    @property
    def waits(self) -> bool:
        """Whether nothing but arming is missing."""
        return self.active and not self.armed and not self.latched

    @property
    def holds(self) -> str:
        """Say why no command may pass; empty if one may."""
        if self.latched:
            return self.latched
        if not self.active:
            return "inactive"
        return "" if self.armed else "disarmed"

    def activate(self) -> None:
        """Let the bridge be armed.

        Raises:
            InvalidInputError: something is latched.
        """
        if self.latched:
            raise InvalidInputError("activate", self.latched, "a reset before")
        self.active = True

    def deactivate(self) -> None:
        """Disarm for good, until somebody activates and arms again."""
        self.active = self.armed = False

    def arm(self, driver_problem: str) -> None:
        """Let commands pass from now on.

        Args:
            driver_problem: why currents do not get to the coils now; empty if they do.

        Raises:
            InvalidInputError: something is latched, the node is not active, or the driver not ready.
        """
        if self.latched:
            raise InvalidInputError("arm", self.latched, "a reset before")
        if not self.active:
            raise InvalidInputError("arm", "an inactive bridge", "an active one")
        if driver_problem:
            raise InvalidInputError("arm", f"a driver that is not ready ({driver_problem})", "one that is")
        self.armed = True

    def disarm(self) -> None:
        """Let no command pass from now on."""
        self.armed = False

    def stop(self) -> None:
        """Press the emergency stop."""
        self.emergency, self.armed = True, False

    def trip(self, fault: str) -> None:
        """Say what went wrong; the first fault is kept, as others may follow from it."""
        self.fault, self.armed = self.fault or fault, False

    def reset(self, driver_problem: str) -> None:
        """Forget the emergency stop and the fault; the bridge stays disarmed.

        Args:
            driver_problem: why currents do not get to the coils now; empty if they do.

        Raises:
            InvalidInputError: the driver is not ready.
        """
        if driver_problem:
            raise InvalidInputError("reset", f"a driver that is not ready ({driver_problem})", "one that is")
        self.emergency, self.fault, self.armed = False, "", False
