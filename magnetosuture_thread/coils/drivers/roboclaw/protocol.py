"""Rules of the RoboClaw driver: duties, limits, status bits and polling sequence; no input or output."""

from __future__ import annotations

import enum
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]

FULL_DUTY = 32767  # duty of the full supply voltage
MIN_RETRY_DELAY, MAX_RETRY_DELAY = 0.1, 2.0  # s between two attempts to connect
SUPPLY_VOLTAGE_RANGE = (5.0, 80.0)  # V, over all models of boards
DUTY_TOLERANCE = 164  # by which a board may round a non-zero duty: 0.5 % of the supply
LIMITING_RATIO = 0.8  # of the maximum current, above which a board may reduce its duty
OVERCURRENT_RATIO = 1.2  # of the maximum current
MAX_OVERCURRENTS = 3  # consecutive measurements that are a fault
MIN_EXPECTED_CURRENT = 0.5  # A; below, a missing current cannot be detected
MIN_CURRENT_RATIO = 0.5  # of the expected current; below, a warm coil is no explanation
# Consecutive measurements below that ratio: a fifth of a second and more at 200 Hz, so that neither a change of
# the current nor the coil's L / R looks like a broken wire.
MAX_SHORTFALLS = 12
MAX_MISMATCHES = 2  # consecutive; the first may be a lost packet

# Errors in the boards' manual that the manufacturer's library lacks.
DRIVER_FAULTS = {0x0040: "Motor 1 Driver Fault", 0x0080: "Motor 2 Driver Fault"}


class Query(enum.Enum):
    """A query to a board between two writes."""

    DUTIES = enum.auto()
    CURRENTS = enum.auto()
    STATUS = enum.auto()
    VOLTAGES = enum.auto()
    TIMEOUT = enum.auto()
    LIMIT_1 = enum.auto()
    LIMIT_2 = enum.auto()


# Settings that a board loses with its supply; after a short loss, nothing else shows it.
SETTING_QUERIES = (Query.TIMEOUT, Query.LIMIT_1, Query.LIMIT_2)
# With a query each 20 to 25 ms, two boards on a line are polled completely within about a second.
POLL_SEQUENCE = tuple(
    query
    for setting in SETTING_QUERIES
    for query in (Query.DUTIES, Query.CURRENTS, Query.STATUS, Query.DUTIES, Query.CURRENTS, Query.VOLTAGES, setting)
)


def retry_delay(failures: int) -> float:
    """Return the delay before the next connection attempt: 0.1 s, doubled with each failure, up to 2 s.

    >>> [retry_delay(failures) for failures in (1, 2, 5, 6, 10**6)]
    [0.1, 0.2, 1.6, 2.0, 2.0]
    """
    return min(MAX_RETRY_DELAY, MIN_RETRY_DELAY * 2.0 ** min(failures - 1, 10))


def duties_for(currents: Vector, resistances: Vector, voltage: float) -> tuple[tuple[int, ...], bool]:
    """Return the duties for given currents, and whether the supply voltage is too low for them.

    d = I R / U, clipped to -1 ... 1, times 32767 and truncated to an integer, so that no current exceeds the
    commanded one. A board sets the mean voltage at a coil, and the current settles with the coil's L / R.

    Args:
        currents: I, shape (m,) [A].
        resistances: R, of each coil with its cable, shape (m,) [ohm].
        voltage: U, of the board's supply [V].

    >>> duties_for(np.array([3.0, -6.0, 30.0]), np.array([1.0, 0.5, 1.0]), 24.0)
    ((4095, -4095, 32767), True)
    """
    share = currents * resistances / voltage
    too_low = bool(np.any(np.abs(share) > 1.0))
    return tuple(np.trunc(FULL_DUTY * np.clip(share, -1.0, 1.0)).astype(int).tolist()), too_low


def steady_currents(duties: Sequence[int], resistances: Vector, voltage: float) -> tuple[float, ...]:
    """Return the steady-state currents of given duties [A].

    I = d U / R, see `duties_for`.

    >>> steady_currents((32767, 0), np.array([1.0, 2.0]), 24.0)
    (24.0, 0.0)
    """
    return tuple((np.array(duties) / FULL_DUTY * voltage / resistances).tolist())


def is_short(expected: float, measured: float) -> bool:
    """Return whether a coil's current is so low that its wire may be broken.

    A warm coil has 20 to 40 % less. The sign is ignored.

    Args:
        expected: steady-state current of its duty [A].
        measured: current in the coil [A].

    >>> [is_short(4.0, measured) for measured in (0.03, 2.4, -4.0)]
    [True, False, False]
    >>> is_short(0.4, 0.0)
    False
    """
    return abs(expected) >= MIN_EXPECTED_CURRENT and abs(measured) < MIN_CURRENT_RATIO * abs(expected)


def describe_bits(bits: int, descriptions: Mapping[int, str], kind: str) -> tuple[str, ...]:
    """Return the meaning of each set bit; an unknown bit is named by its number.

    >>> describe_bits(0x0201, {1: "Emergency Stop"}, "error")
    ('Emergency Stop', 'error bit 0x0200')
    """
    found = [1 << place for place in range(16) if bits >> place & 1]
    return tuple(descriptions.get(bit, f"{kind} bit 0x{bit:04x}") for bit in found)


def is_plausible_supply(voltage: float) -> bool:
    """Return whether a supply voltage [V] is plausible."""
    return SUPPLY_VOLTAGE_RANGE[0] <= voltage <= SUPPLY_VOLTAGE_RANGE[1]


def duties_match(
    written: Sequence[int], reported: Sequence[int], currents: Sequence[float], max_current: float
) -> bool:
    """Return whether a board's duties match those written.

    A board may round a non-zero duty, and reduce it where the coil's current is close to its limit.

    Args:
        written: duties.
        reported: duties reported by the board.
        currents: measured in each coil [A].
        max_current: maximum current in a coil [A].

    >>> duties_match((4096, 0), (4096, 0), (0.0, 0.0), 10.0)
    True
    >>> duties_match((0, 0), (1, 0), (0.0, 0.0), 10.0)
    False
    """
    for target, actual, current in zip(written, reported, currents, strict=True):
        exact = abs(target - actual) <= (DUTY_TOLERANCE if target else 0)
        limited = abs(current) >= LIMITING_RATIO * max_current and min(0, target) <= actual <= max(0, target)
        if not exact and not limited:
            return False
    return True


class ConsecutiveCounter:
    """Counts consecutive events.

    >>> counter = ConsecutiveCounter(2)
    >>> [counter.update(bad) for bad in (True, False, True, True)]
    [False, False, False, True]

    Args:
        limit: number of consecutive events to report.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self.count = 0

    def update(self, event: bool) -> bool:
        """Register one observation, and return whether the limit is reached."""
        self.count = self.count + 1 if event else 0
        return self.count >= self._limit
