"""Checks that what has to end a current does, by the bridge's word and the needle's rest, once the needle moves."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Protocol

import numpy as np

from magnetosuture_thread.calibration.commission import middle_of
from magnetosuture_thread.calibration.pulse_model import Pulse
from magnetosuture_thread.coils.pulses import MAX_TIME, STOOD_STILL
from magnetosuture_thread.geometry.polyline import Vector

TO_REST, RESTING = 0.3, 0.7  # s in which a needle comes to rest and frames show it: delays; and in which it rests
TRIES = 3  # a busy computer may disturb a pulse too late, or stand still itself


class StopBench(Protocol):
    """A bench whose currents something else than their time ends.

    Attributes:
        needle_length: [m].
        driver_timeout: after which the boards stop by themselves [s].
    """

    needle_length: float
    driver_timeout: float

    def disturbed_pulse(
        self, currents: Vector, seconds: float, after: float, disturbance: AbstractContextManager[None], hold: float
    ) -> tuple[Pulse, float, float]:
        """Give currents, and disturb for a while once they have flowed for a time.

        Args:
            currents: shape (m,) [A].
            seconds: of the pulse.
            after: of the currents' begin the disturbance does [s].
            disturbance: that is entered then.
            hold: for so long [s].

        Returns:
            The pulse, and when the disturbance began and ended by the clock of its poses [s].
        """

    def stopped(self) -> AbstractContextManager[None]:
        """Press the emergency stop."""

    def blind(self) -> AbstractContextManager[None]:
        """Let no poses come."""

    def frozen(self) -> AbstractContextManager[None] | None:
        """Let the bridge's process stand still; None where that cannot be done from here."""

    def recover(self, causes: tuple[str, ...]) -> None:
        """Reset what a check has latched, and arm.

        Args:
            causes: how what it latches may begin; something else, as a person's stop, is not reset.
        """


def check_stops(bench: StopBench, currents: Vector, speed: float, log: Callable[[str], None]) -> dict[str, str]:
    """Let an emergency stop, lost poses and a bridge that stands still end currents.

    By the bridge the currents have to end in time and for that reason; by the camera the needle has to rest after that.

    Args:
        bench: to drive.
        currents: the least that move the needle, shape (m,) [A].
        speed: with which they do [m/s].
        log: called with a line for a person.

    Returns:
        Why each failed, by the name of what ended the currents; empty if it passed.
    """
    problems = {}
    for name, disturb, ended, causes in (
        ("emergency stop", bench.stopped, "emergency stop", ("emergency stop",)),
        ("no poses", bench.blind, "no needle pose", ()),
        ("standstill of the bridge", bench.frozen, "", (STOOD_STILL, "driver")),
    ):
        problem, tries = "", TRIES
        while tries:
            if (disturbance := disturb()) is None:
                log(f"{name}: not checked from here: end the bridge by kill -9 while a current flows")
                break
            hold = RESTING + (0.0 if ended else bench.driver_timeout + TO_REST)
            pulse, begun, over = bench.disturbed_pulse(currents, MAX_TIME, 0.05, disturbance, hold)  # s
            bench.recover(causes)
            problem = "" if ended in pulse.ended else f"currents ended by {pulse.ended or 'their time'}"
            tries = tries - 1 if problem else 0
            if ended:
                resting = pulse.times > pulse.off + TO_REST
            else:
                resting = (pulse.times > begun + bench.driver_timeout + TO_REST) & (pulse.times < over)
            problem = problem or _moving(middle_of(pulse.poses, bench.needle_length)[resting], speed)
        else:
            log(f"{name}: {problem or 'ends the currents'}")
            problems[name] = problem
    return problems


def _moving(middles: Vector, speed: float) -> str:
    """Return how a needle that should rest moves, by its middles, shape (k, 2) [m]; empty if it rests."""
    if len(middles) < 5:
        return "too few poses show whether the needle rests"
    way = float(np.hypot(*(middles[-1] - middles[0])))
    allowed = 5e-5 + 0.2 * speed * RESTING  # m; errors of poses, and a share of the way under the current
    return f"the needle moves on, by {1e3 * way:.2f} mm" if way > allowed else ""
