"""The gate that every velocity command passes: checked, limited, and timed out.

Pure: it reads no clock. `arrival` is a monotonic time, `now` the time of the stamps; both in seconds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.coils.stamps import check_stamp
from magnetosuture_thread.errors import InvalidInputError

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Setpoint:
    """What the bridge asks of the coils.

    Attributes:
        velocity: of the needle, shape (2,) [m/s].
        stop: why it is zero; empty while a command is followed.
        send: whether to send it: false once a stop has been sent for long enough.
    """

    velocity: Vector
    stop: str
    send: bool


class CommandGate:
    """Holds the last good command for as long as it is good.

    Args:
        timeout: a command is good for this long after its arrival, and its stamp may be this old [s].
        max_speed: faster commands are slowed to this, their direction kept [m/s].
        zero_hold: after a stop, zeros are sent for this long [s].
    """

    def __init__(self, timeout: float, max_speed: float, zero_hold: float) -> None:
        self._timeout = timeout
        self._max_speed = max_speed
        self._zero_hold = zero_hold
        self._velocity = np.zeros(2)
        self._stamp = -math.inf
        self._arrival: float | None = None
        self._stopped_at: float | None = None

    def accept(self, velocity: Vector, stamp: float, now: float, arrival: float) -> None:
        """Take a command, or refuse it and keep the last one until that times out.

        Args:
            velocity: of the needle in the dish plane, shape (2,) [m/s].
            stamp: when it was made [s].
            now: the same clock now [s].
            arrival: a monotonic clock now [s].

        Raises:
            InvalidInputError: it is not finite, too old, from the future, or older than the last one.
        """
        if not np.all(np.isfinite(velocity)):
            raise InvalidInputError("needle/servo_cv.twist.linear", velocity.tolist(), "finite numbers [m/s]")
        check_stamp("needle/servo_cv", stamp, now, self._stamp, self._timeout)
        speed = float(np.linalg.norm(velocity))
        self._velocity = velocity * min(1.0, self._max_speed / speed) if speed > 0.0 else np.zeros(2)
        self._stamp, self._arrival, self._stopped_at = stamp, arrival, None

    def setpoint(self, arrival: float) -> Setpoint:
        """Return what to ask of the coils at a monotonic time [s]."""
        if self._arrival is not None and arrival - self._arrival <= self._timeout:
            return Setpoint(self._velocity, "", True)
        if self._stopped_at is None:
            self._stopped_at = arrival
        stop = "no command yet" if self._arrival is None else f"no command for {arrival - self._arrival:.3f} s"
        return Setpoint(np.zeros(2), stop, arrival - self._stopped_at <= self._zero_hold)
