"""Jogging: the control lease, the dead man's switch, and the controller that publishes velocity commands of both.

Lease, switch and delay estimator are pure: they read no clock; times are monotonic [s].
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable

Velocity = tuple[float, float]
ZERO_VELOCITY: Velocity = (0.0, 0.0)


class ControlLease:
    """Exclusive control of the needle.

    Only the holder releases control. Another client may acquire it while the holder cannot command: while its page is
    hidden, or after `timeout` without a message.

    Args:
        timeout: maximum silence of the holder [s].

    Attributes:
        holder: number of the client that has control, None if there is none.
        hidden: whether the holder's page is hidden.
    """

    def __init__(self, timeout: float) -> None:
        self.holder: int | None = None
        self.hidden = False
        self._timeout, self._last_message = timeout, -math.inf

    def available(self, now: float) -> bool:
        """Return whether another client may acquire control."""
        return self.holder is None or self.hidden or now - self._last_message > self._timeout

    def acquire(self, client: int, now: float) -> str:
        """Give control to a client; return an empty text, or the reason of a refusal."""
        if client != self.holder and not self.available(now):
            return f"page {self.holder} has control and must release it first"
        self.holder, self._last_message, self.hidden = client, now, False
        return ""

    def release(self, client: int) -> bool:
        """Release control if this client holds it; return whether it did."""
        if client != self.holder:
            return False
        self.holder, self.hidden = None, False
        return True

    def keep_alive(self, client: int, now: float) -> None:
        """Register a message of a client."""
        if client == self.holder:
            self._last_message = now

    def set_hidden(self, client: int, hidden: bool) -> None:
        """Register whether a client's page is hidden."""
        if client == self.holder:
            self.hidden = hidden


class DeadManSwitch:
    """Repeats the jogged velocity while it is fresh; then sends one zero, then nothing.

    Args:
        timeout: a jog message is fresh for this long [s].

    Attributes:
        latched: whether nothing is sent until a release.
    """

    def __init__(self, timeout: float) -> None:
        self.latched = False
        self._timeout, self._arrival = timeout, -math.inf
        self._velocity: Velocity | None = None
        self._pressed = False  # by the last message, even if that is stale

    @property
    def moving(self) -> bool:
        """Whether a command is active that a zero must end."""
        return self._velocity is not None

    @property
    def deadline(self) -> float:
        """Time at which the last jog message becomes stale [s]."""
        return self._arrival + self._timeout

    def press(self, velocity: Velocity, now: float) -> Velocity | None:
        """Register a jog message; return a command to send at once, or None.

        After a stop during a jog, nothing is sent until a release.
        """
        if velocity == ZERO_VELOCITY:
            return self.release()
        self._pressed = True
        if self.latched:
            return None
        changed = velocity != self._velocity
        self._velocity, self._arrival = velocity, now
        return velocity if changed else None

    def release(self) -> Velocity | None:
        """Register a release; return the zero to send at once, if any."""
        self._pressed = self.latched = False
        return self.interrupt()

    def interrupt(self) -> Velocity | None:
        """End the motion without a release; return the zero to send at once, if any."""
        moving, self._velocity = self.moving, None
        return ZERO_VELOCITY if moving else None

    def stop(self) -> Velocity | None:
        """End the motion and require a release if a jog was active; return the zero to send at once, if any."""
        self.latched = self.latched or self._pressed
        return self.interrupt()

    def due(self, now: float) -> Velocity | None:
        """Return the command of this period: the jogged velocity, one zero when it is stale, then None."""
        if self._velocity is None:
            return None
        return self._velocity if now < self.deadline else self.interrupt()


class DelayEstimator:
    """Delay of messages on the network, relative to the fastest one.

    The page's clock has another origin, so the fastest message defines zero delay. A late message describes the past
    and must not move the needle.
    """

    def __init__(self) -> None:
        self._min_offset = math.inf  # arrival minus sending time of the fastest message [s]
        self._arrival = 0.0

    def update(self, sent: float, arrival: float) -> float:
        """Register a message and return its delay relative to the fastest one [s].

        Args:
            sent: by the page's monotonic clock [s].
            arrival: by the server's monotonic clock [s].
        """
        # The minimum is forgotten by 1e-4 s/s, which is above the drift between two clocks.
        drift = 1e-4 * max(0.0, arrival - self._arrival)
        self._min_offset, self._arrival = min(self._min_offset + drift, arrival - sent), arrival
        return arrival - sent - self._min_offset


class JogController:
    """Publishes velocity commands for the client that has control. All calls come from the thread of one asyncio loop.

    Args:
        publish: publishes a velocity [m/s].
        rate: of the commands during a jog [Hz].
        timeout: of the dead man's switch [s].

    Attributes:
        lease: who has control.
        switch: what is sent.
    """

    def __init__(self, publish: Callable[[Velocity], None], rate: float, timeout: float) -> None:
        # A page acknowledges every state: after 3 s without a message it is gone.
        self.lease, self.switch = ControlLease(3.0), DeadManSwitch(timeout)
        self._publish, self._period = publish, 1.0 / rate
        self._timer: asyncio.TimerHandle | None = None
        self._armed = False

    @property
    def holder(self) -> int | None:
        """Number of the client that has control, None if there is none."""
        return self.lease.holder

    @property
    def available(self) -> bool:
        """Whether another client may acquire control now."""
        return self.lease.available(_now())

    def acquire_control(self, client: int) -> str:
        """Give control to a client; return an empty text, or the reason of a refusal."""
        before = self.holder
        refusal = self.lease.acquire(client, _now())
        if not refusal and before != client:
            self._send(self.switch.release())
        return refusal

    def release_control(self, client: int) -> None:
        """Release control if this client has it, on request or after it disconnected."""
        if self.lease.release(client):
            self._send(self.switch.release())

    def set_visible(self, client: int, visible: bool) -> None:
        """Register whether a client's page is visible; a hidden one cannot jog."""
        self.lease.set_hidden(client, not visible)
        if not visible and client == self.holder:
            self.stop()

    def jog(self, client: int, velocity: Velocity) -> bool:
        """Register a jog message; return whether the client has control and its page is visible."""
        if client != self.holder or self.lease.hidden:
            return False
        self._send(self.switch.press(velocity, _now()))
        if self.switch.moving and self._timer is None:
            self._schedule(_now() + self._period)
        return True

    def end_jog(self, client: int) -> None:
        """Register the end of a client's jog."""
        if client == self.holder:
            self._send(self.switch.release())

    def interrupt(self, client: int) -> None:
        """End the motion of a client after an invalid message; a stop stays latched."""
        if client == self.holder:
            self._send(self.switch.interrupt())

    def set_armed(self, armed: bool) -> None:
        """Register whether the bridge is armed; when it is disarmed, a jog must be released first."""
        if self._armed and not armed:
            self.stop()
        self._armed = armed

    def stop(self) -> None:
        """Stop the needle until the present jog is released."""
        self._send(self.switch.stop())

    def _send(self, velocity: Velocity | None) -> None:
        if velocity is not None:
            self._publish(velocity)
        if not self.switch.moving and self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _schedule(self, at: float) -> None:
        at = min(at, self.switch.deadline)
        self._timer = asyncio.get_running_loop().call_at(at, self._tick, at)

    def _tick(self, planned: float) -> None:
        self._timer = None
        now = _now()
        self._send(self.switch.due(max(now, planned)))
        if self.switch.moving:
            self._schedule(max(now, planned + self._period))


def _now() -> float:
    return asyncio.get_running_loop().time()
