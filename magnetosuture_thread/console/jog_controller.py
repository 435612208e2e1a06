"""Jog controller: control lease and dead man's switch, which turn jog messages into velocity commands at once."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from magnetosuture_thread.console.control_lease import ControlLease
from magnetosuture_thread.console.dead_man import DeadManSwitch, Velocity

CLIENT_TIMEOUT = 3.0  # [s] without a message, after which a page is gone; it acknowledges every state


class JogController:
    """Publishes velocity commands for the client that has control. All calls come from the thread of one asyncio loop.

    Args:
        publish: publishes a velocity [m/s].
        rate: of the commands during a jog [Hz].
        timeout: of the dead man's switch [s].
    """

    def __init__(self, publish: Callable[[Velocity], None], rate: float, timeout: float) -> None:
        self._publish = publish
        self._period = 1.0 / rate
        self._lease = ControlLease(CLIENT_TIMEOUT)
        self._switch = DeadManSwitch(timeout)
        self._timer: asyncio.TimerHandle | None = None
        self._armed = False

    @property
    def holder(self) -> int | None:
        """Number of the client that has control, None if there is none."""
        return self._lease.holder

    @property
    def available(self) -> bool:
        """Whether another client may acquire control now."""
        return self._lease.available(_now())

    def acquire_control(self, client: int) -> str:
        """Give control to a client; return an empty text, or the reason of a refusal."""
        before = self.holder
        refusal = self._lease.acquire(client, _now())
        if not refusal and before != client:
            self._send(self._switch.release())
        return refusal

    def release_control(self, client: int) -> None:
        """Release control if this client has it, on request or after it disconnected."""
        if self._lease.release(client):
            self._send(self._switch.release())

    def keep_alive(self, client: int) -> None:
        """Register a message of a client."""
        self._lease.keep_alive(client, _now())

    def set_visible(self, client: int, visible: bool) -> None:
        """Register whether a client's page is visible; a hidden one cannot jog."""
        self._lease.set_hidden(client, not visible)
        if not visible and client == self.holder:
            self.stop()

    def jog(self, client: int, velocity: Velocity) -> bool:
        """Register a jog message; return whether the client has control and its page is visible."""
        if client != self.holder or self._lease.hidden:
            return False
        self._send(self._switch.press(velocity, _now()))
        if self._switch.moving and self._timer is None:
            self._schedule(_now() + self._period)
        return True

    def end_jog(self, client: int) -> None:
        """Register the end of a client's jog."""
        if client == self.holder:
            self._send(self._switch.release())

    def interrupt(self, client: int) -> None:
        """End the motion of a client after an invalid message; a stop stays latched."""
        if client == self.holder:
            self._send(self._switch.interrupt())

    def set_armed(self, armed: bool) -> None:
        """Register whether the bridge is armed; when it is disarmed, a jog must be released first."""
        if self._armed and not armed:
            self.stop()
        self._armed = armed

    def stop(self) -> None:
        """Stop the needle until the present jog is released."""
        self._send(self._switch.stop())

    def _send(self, velocity: Velocity | None) -> None:
        if velocity is not None:
            self._publish(velocity)
        if not self._switch.moving and self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _schedule(self, at: float) -> None:
        at = min(at, self._switch.deadline)
        self._timer = asyncio.get_running_loop().call_at(at, self._tick, at)

    def _tick(self, planned: float) -> None:
        self._timer = None
        now = _now()
        self._send(self._switch.due(max(now, planned)))
        if self._switch.moving:
            self._schedule(max(now, planned + self._period))


def _now() -> float:
    return asyncio.get_running_loop().time()
