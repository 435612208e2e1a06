"""Arming state machine with latched emergency stop and faults, and its record over a restart."""

from __future__ import annotations

import os
from contextlib import suppress
from enum import Enum
from pathlib import Path

from magnetosuture_thread.settings.errors import InvalidInputError
from magnetosuture_thread.settings.files import output_problem, read_regular


class ArmingState(Enum):
    """State of the bridge as a whole."""

    INACTIVE = "inactive"
    ACTIVE = "active"
    FAULT = "fault"


class ArmingLatch:
    """State machine that keeps the bridge at zero until it is active, armed, and free of faults.

    Emergency stop and fault disarm and stay latched until a reset; a reset never arms. After either, two
    deliberate acts are needed before the needle moves again.

    Attributes:
        active: whether the node is.
        armed: whether commands are followed.
        emergency: whether the emergency stop has been pressed since the last reset.
        fault: the first fault since the last reset; empty if none.
    """

    def __init__(self) -> None:
        self.active = False
        self.armed = False
        self.emergency = False
        self.fault = ""

    @property
    def state(self) -> ArmingState:
        """State of the bridge."""
        if self.latched_reason:
            return ArmingState.FAULT
        return ArmingState.ACTIVE if self.active else ArmingState.INACTIVE

    @property
    def latched_reason(self) -> str:
        """Why the bridge stays at zero until a reset; empty if nothing is latched."""
        return "emergency stop" if self.emergency else self.fault

    @property
    def ready_to_arm(self) -> bool:
        """Whether only arming is missing."""
        return self.active and not self.armed and not self.latched_reason

    @property
    def stop_reason(self) -> str:
        """Why no command is followed; empty while armed."""
        if self.latched_reason:
            return self.latched_reason
        if not self.active:
            return "inactive"
        return "" if self.armed else "disarmed"

    def activate(self) -> None:
        """Activate, so that the bridge can be armed.

        Raises:
            InvalidInputError: an emergency stop or a fault is latched.
        """
        if self.latched_reason:
            raise InvalidInputError("activate", self.latched_reason, "a reset before")
        self.active = True

    def deactivate(self) -> None:
        """Deactivate and disarm."""
        self.active = self.armed = False

    def arm(self, driver_problem: str) -> None:
        """Arm: follow commands from now on.

        Args:
            driver_problem: why the driver is not ready; empty if it is.

        Raises:
            InvalidInputError: an emergency stop or a fault is latched, the node is not active, or the driver not ready.
        """
        if self.latched_reason:
            raise InvalidInputError("arm", self.latched_reason, "a reset before")
        if not self.active:
            raise InvalidInputError("arm", "an inactive bridge", "an active one")
        if driver_problem:
            raise InvalidInputError("arm", f"a driver that is not ready ({driver_problem})", "one that is")
        self.armed = True

    def disarm(self) -> None:
        """Disarm: follow no command from now on."""
        self.armed = False

    def stop(self) -> None:
        """Latch the emergency stop."""
        self.emergency, self.armed = True, False

    def trip(self, fault: str) -> None:
        """Latch a fault; the first is kept, as others may follow from it."""
        self.fault, self.armed = self.fault or fault, False

    def reset(self, driver_problem: str) -> None:
        """Clear emergency stop and fault; the bridge stays disarmed.

        Args:
            driver_problem: why the driver is not ready; empty if it is.

        Raises:
            InvalidInputError: the driver is not ready.
        """
        if driver_problem:
            raise InvalidInputError("reset", f"a driver that is not ready ({driver_problem})", "one that is")
        self.emergency, self.fault, self.armed = False, "", False


class RecordedState(Enum):
    """What a bridge leaves behind."""

    SAFE = "disarmed"  # nothing to remember: it was disarmed, or has ended in order
    ARMED = "armed"  # or with a fault that was not reset
    STOPPED = "stopped"  # the emergency stop was pressed, and not reset


class StopRecord:
    """A file that holds the state of a bridge and the setup it has moved a needle with, on the disk after `write`.

    Args:
        path: of the file; its folder is made with the first `write`.

    Attributes:
        followed: identity of the setup with which a needle has followed, in hexadecimal digits; empty if none.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.followed = path, ""
        self._written: tuple[RecordedState, str] | None = None

    def read(self) -> RecordedState:
        """Return the state that was left behind; without a file none, and of a damaged one the emergency stop."""
        try:
            state, *rest = read_regular(self.path, 1000).decode().split() or [""]
            if rest and (len(rest) > 1 or not rest[0].isalnum()):
                return RecordedState.STOPPED
            recorded = RecordedState(state)  # before the setup of a damaged file is believed
            self.followed = "".join(rest)
            return recorded
        except FileNotFoundError:
            return RecordedState.SAFE
        except (OSError, ValueError):
            return RecordedState.STOPPED

    def write(self, state: RecordedState) -> None:
        """Replace the file, unless it holds this state already.

        Raises:
            OSError: it cannot be written.
        """
        lines = state, self.followed
        if lines == self._written:
            return
        self._written = None
        if problem := output_problem(self.path):
            raise OSError(problem)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        partial = self.path.with_name(f".{self.path.name}.{os.getpid()}")
        try:
            with partial.open("w", encoding="utf-8") as stream:
                stream.writelines(f"{line}\n" for line in (state.value, self.followed) if line)
                stream.flush()
                os.fsync(stream.fileno())
            partial.replace(self.path)
        finally:
            with suppress(OSError):
                partial.unlink(missing_ok=True)
        folder = os.open(self.path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)  # else the name may still be that of the file before, after a power failure
        finally:
            os.close(folder)
        self._written = lines
