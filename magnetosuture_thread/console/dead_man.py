"""The dead man's switch: the needle goes on only while somebody keeps saying so.

Pure: it reads no clock; times are monotonic [s].
"""

from __future__ import annotations

import math

Velocity = tuple[float, float]
REST: Velocity = (0.0, 0.0)


class DeadManSwitch:
    """Passes on what an operator holds, for as long as that is young; then one zero, then nothing.

    Args:
        timeout: a word is young for this long [s].
    """

    def __init__(self, timeout: float) -> None:
        self._timeout = timeout
        self._velocity: Velocity | None = None
        self._heard = -math.inf
        self._held = False  # as last heard, though it may be too old to go on
        self._latched = False

    @property
    def moving(self) -> bool:
        """Whether a command is under way that has to be ended by a zero."""
        return self._velocity is not None

    @property
    def deadline(self) -> float:
        """When the last word ceases to be young [s]."""
        return self._heard + self._timeout

    def hold(self, velocity: Velocity, now: float) -> Velocity | None:
        """Hear what is held; return the command that has to go out at once, None if there is none.

        After a stop while something was held nothing passes until a release was heard.
        """
        if velocity == REST:
            return self.release()
        self._held = True
        if self._latched:
            return None
        changed = velocity != self._velocity
        self._velocity, self._heard = velocity, now
        return velocity if changed else None

    def release(self) -> Velocity | None:
        """Hear that nothing is held any more; return the zero that has to go out at once, if one has to."""
        self._held = self._latched = False
        return self._rest()

    def interrupt(self) -> Velocity | None:
        """End the movement, but believe nothing of what is held; return the zero that has to go out at once."""
        return self._rest()

    def stop(self) -> Velocity | None:
        """As `interrupt`, but what was held last, if anything, has to be released before anything passes again."""
        self._latched = self._latched or self._held
        return self._rest()

    def due(self, now: float) -> Velocity | None:
        """Return the command of this period: what is held, one zero when that is too old, then None."""
        if self._velocity is None:
            return None
        return self._velocity if now < self.deadline else self._rest()

    def _rest(self) -> Velocity | None:
        moving, self._velocity = self.moving, None
        return REST if moving else None
