"""Who steers and what is held, over a running graph: a word becomes a command in the same turn of the loop."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from magnetosuture_thread.console.dead_man import DeadManSwitch, Velocity
from magnetosuture_thread.console.lease import Lease

SILENCE = 3.0  # a page says something with every state that it gets, so one that is silent for this long is gone [s]


class Steering:
    """The lease and the dead man's switch. All calls are made from the thread of one asyncio loop.

    Args:
        steer: publishes a velocity [m/s].
        rate: of the commands while something is held [Hz].
        timeout: of the dead man's switch [s].
    """

    def __init__(self, steer: Callable[[Velocity], None], rate: float, timeout: float) -> None:
        self._steer = steer
        self._period = 1.0 / rate
        self._lease = Lease(SILENCE)
        self._switch = DeadManSwitch(timeout)
        self._pulse: asyncio.TimerHandle | None = None
        self._armed = False

    @property
    def holder(self) -> int | None:
        """The number of the client who steers, None if nobody does."""
        return self._lease.holder

    @property
    def available(self) -> bool:
        """Whether somebody else may take steering now."""
        return self._lease.available(_now())

    def take(self, client: int) -> str:
        """Let a client steer from now on; return an empty text, or why not."""
        before = self.holder
        refusal = self._lease.take(client, _now())
        if not refusal and before != client:
            self._send(self._switch.release())
        return refusal

    def hand_back(self, client: int) -> None:
        """Let nobody steer, if this client did: it hands back, or is gone."""
        if self._lease.hand_back(client):
            self._send(self._switch.release())

    def hear(self, client: int) -> None:
        """Know that a client is alive."""
        self._lease.hear(client, _now())

    def show(self, client: int, seen: bool) -> None:
        """Know whether a client's page is seen; a hidden one steers nothing."""
        self._lease.hide(client, not seen)
        if not seen and client == self.holder:
            self.rest()

    def hold(self, client: int, velocity: Velocity) -> bool:
        """Hear what a client holds; return whether it is the one who steers, its page seen."""
        if client != self.holder or self._lease.hidden:
            return False
        self._send(self._switch.hold(velocity, _now()))
        if self._switch.moving and self._pulse is None:
            self._next(_now() + self._period)
        return True

    def release(self, client: int) -> None:
        """Hear that a client holds nothing any more."""
        if client == self.holder:
            self._send(self._switch.release())

    def interrupt(self, client: int) -> None:
        """End the movement of a client of whom something came that cannot be used; a stop stays in force."""
        if client == self.holder:
            self._send(self._switch.interrupt())

    def watch(self, armed: bool) -> None:
        """Know whether the bridge is armed; when it ceases to be, by whomever, what is held has to be released."""
        if self._armed and not armed:
            self.rest()
        self._armed = armed

    def rest(self) -> None:
        """Let the needle rest, whoever steers, until what is held has been released."""
        self._send(self._switch.stop())

    def _send(self, velocity: Velocity | None) -> None:
        if velocity is not None:
            self._steer(velocity)
        if not self._switch.moving and self._pulse is not None:
            self._pulse.cancel()
            self._pulse = None

    def _next(self, at: float) -> None:
        at = min(at, self._switch.deadline)
        self._pulse = asyncio.get_running_loop().call_at(at, self._tick, at)

    def _tick(self, planned: float) -> None:
        self._pulse = None
        now = _now()
        self._send(self._switch.due(max(now, planned)))
        if self._switch.moving:
            self._next(max(now, planned + self._period))


def _now() -> float:
    return asyncio.get_running_loop().time()
