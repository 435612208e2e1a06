"""What the driver decides without a device: duties, pauses, what bits mean, which question is next."""

from __future__ import annotations

import enum
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]

FULL = 32767  # duty of the whole supply voltage
FIRST_PAUSE, LONGEST_PAUSE = 0.1, 2.0  # s between two attempts to connect
SUPPLY = (5.0, 80.0)  # V that a board may have, of all that are made
ROUNDED = 164  # of a duty, by which a board may round one that is not zero: 0.5 % of the supply
AT_LIMIT = 0.8  # of the greatest current, from which on a board may take its duty back
EXCESS = 1.2  # of the greatest current, that is too much
EXCESSES = 3  # in a row, that are too many
LEAST_ASKED = 0.5  # A that a coil should have before anybody can tell that they are missing
SHORT = 0.5  # of the current that a coil should have, below which it is not only warm
# Measurements in a row that must be too small: a fifth of a second and more at 200 Hz, so that neither a change of
# the current nor the coil's L / R looks like a broken wire.
SHORTFALLS = 12
MISMATCHES = 2  # in a row, that are too many: the first may be a packet that got lost

# Errors that the boards' manual knows and the maker's library does not.
DRIVER_FAULTS = {0x0040: "Motor 1 Driver Fault", 0x0080: "Motor 2 Driver Fault"}


class Question(enum.Enum):
    """What a board is asked between two writes."""

    DUTIES = enum.auto()
    CURRENTS = enum.auto()
    STATUS = enum.auto()
    VOLTAGES = enum.auto()
    TIMEOUT = enum.auto()
    LIMIT_1 = enum.auto()
    LIMIT_2 = enum.auto()


# What a board forgets when its supply breaks down; if that was short, nothing else tells.
SET = (Question.TIMEOUT, Question.LIMIT_1, Question.LIMIT_2)
# In turn; with a question each 20 to 25 ms, two boards on a line have told everything within about a second.
ROUND = tuple(
    question
    for setting in SET
    for question in (
        Question.DUTIES,
        Question.CURRENTS,
        Question.STATUS,
        Question.DUTIES,
        Question.CURRENTS,
        Question.VOLTAGES,
        setting,
    )
)


def pause(failures: int) -> float:
    """Return how long to wait after a number of failures in a row: 0.1 s, doubled with each, up to 2 s.

    >>> [pause(failures) for failures in (1, 2, 5, 6, 10**6)]
    [0.1, 0.2, 1.6, 2.0, 2.0]
    """
    return min(LONGEST_PAUSE, FIRST_PAUSE * 2.0 ** min(failures - 1, 10))


def duties(currents: Vector, resistances: Vector, voltage: float) -> tuple[tuple[int, ...], bool]:
    """Return the duties that give currents, and whether the supply is too low for them.

    d = I R / U, clipped to -1 ... 1, times 32767 and cut to a whole number, as no current may be greater than it
    was asked for: a board sets the mean voltage at a coil, and the current
    settles to it with the coil's own L / R.

    Args:
        currents: I, shape (m,) [A].
        resistances: R, of each coil with its cable, shape (m,) [ohm].
        voltage: U, of the board's supply [V].

    >>> duties(np.array([3.0, -6.0, 30.0]), np.array([1.0, 0.5, 1.0]), 24.0)
    ((4095, -4095, 32767), True)
    """
    share = currents * resistances / voltage
    short = bool(np.any(np.abs(share) > 1.0))
    return tuple(np.trunc(FULL * np.clip(share, -1.0, 1.0)).astype(int).tolist()), short


def settled(duties: Sequence[int], resistances: Vector, voltage: float) -> tuple[float, ...]:
    """Return the currents that duties give in the end [A].

    I = d U / R, see `duties`.

    >>> settled((32767, 0), np.array([1.0, 2.0]), 24.0)
    (24.0, 0.0)
    """
    return tuple((np.array(duties) / FULL * voltage / resistances).tolist())


def falls_short(due: float, measured: float) -> bool:
    """Return whether a coil has so much less current than it should that its wire may be broken.

    One that is warm has a fifth or two fifths less. The sign does not count.

    Args:
        due: the current that its duty gives in the end [A].
        measured: the current that it has [A].

    >>> [falls_short(4.0, measured) for measured in (0.03, 2.4, -4.0)]
    [True, False, False]
    >>> falls_short(0.4, 0.0)
    False
    """
    return abs(due) >= LEAST_ASKED and abs(measured) < SHORT * abs(due)


def meanings(bits: int, descriptions: Mapping[int, str], kind: str) -> tuple[str, ...]:
    """Return what each bit that is set means; one that nobody knows is named by its number.

    >>> meanings(0x0201, {1: "Emergency Stop"}, "error")
    ('Emergency Stop', 'error bit 0x0200')
    """
    found = [1 << place for place in range(16) if bits >> place & 1]
    return tuple(descriptions.get(bit, f"{kind} bit 0x{bit:04x}") for bit in found)


def plausible(voltage: float) -> bool:
    """Return whether a supply's voltage [V] can be one."""
    return SUPPLY[0] <= voltage <= SUPPLY[1]


def holds(written: Sequence[int], has: Sequence[int], currents: Sequence[float], most: float) -> bool:
    """Return whether a board has the duties that were written.

    It may round one that is not zero, and take one back, towards zero, where the coil's current is close to
    its limit.

    Args:
        written: duties.
        has: the duties that it says it has.
        currents: measured in each coil [A].
        most: greatest current in a coil [A].

    >>> holds((4096, 0), (4096, 0), (0.0, 0.0), 10.0)
    True
    >>> holds((0, 0), (1, 0), (0.0, 0.0), 10.0)
    False
    """
    for wanted, got, current in zip(written, has, currents, strict=True):
        exact = abs(wanted - got) <= (ROUNDED if wanted else 0)
        limited = abs(current) >= AT_LIMIT * most and min(0, wanted) <= got <= max(0, wanted)
        if not exact and not limited:
            return False
    return True


class Streak:
    """Counts what happens in a row.

    >>> streak = Streak(2)
    >>> [streak.over(bad) for bad in (True, False, True, True)]
    [False, False, False, True]

    Args:
        most: how many are too many.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self.count = 0

    def over(self, happens: bool) -> bool:
        """Take one more, and return whether there are too many."""
        self.count = self.count + 1 if happens else 0
        return self.count >= self._most
