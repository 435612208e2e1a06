"""What stays in force, and who is ready, by a clock of the test's own."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.coils.drivers.roboclaw.driver import LineReport, Mailbox

CURRENTS = np.array([1.0, 2.0, 3.0, 4.0])


def report(number: int, *warnings: str) -> LineReport:
    """Return what a line with one board says."""
    return LineReport({2 * number: 0.5, 2 * number + 1: -0.5}, {number: 24.0 + number}, warnings)


def mailbox() -> Mailbox:
    """Return the mailbox of two lines that are ready."""
    made = Mailbox(4, ["one", "other"], timeout=0.1)
    made.set_ready(1, report(1))
    made.set_ready(0, report(0))
    return made


def test_currents_are_in_force_for_the_patience():
    made = mailbox()
    made.put(CURRENTS, 1.0)
    for now in (1.0, 1.09):
        taken, until = made.latest(now)
        assert taken is not None
        assert taken.tolist() == CURRENTS.tolist()
        assert until == pytest.approx(1.1)
    assert made.latest(1.11)[0] is None
    assert made.latest(1.05)[0] is None  # they do not come back
    assert made.state().warnings == ("no currents were commanded within 0.1 s: coils at zero",)
    made.put(CURRENTS, 2.0)
    assert made.state().warnings == ()
    assert made.latest(2.0)[0] is not None


def test_zeros_that_are_not_asked_for_any_more_are_no_warning():
    made = mailbox()
    made.put(np.zeros(4), 1.0)
    assert made.latest(2.0)[0] is None
    assert made.state().warnings == ()


def test_nothing_is_kept_until_every_line_is_ready():
    made = Mailbox(4, ["one", "other"], timeout=0.1)
    assert made.state().problem == "one; other"
    made.set_ready(0, report(0))
    made.put(CURRENTS, 1.0)
    made.set_ready(1, report(1))
    assert made.latest(1.0)[0] is None


def test_a_loss_drops_the_currents_for_good_and_is_counted_once():
    made = mailbox()
    made.put(CURRENTS, 1.0)
    made.set_failed(0, "gone")
    assert made.latest(1.0)[0] is None
    assert made.state().losses == 1
    made.set_failed(0, "still gone")
    made.set_failed(1, "gone too")
    assert made.state().losses == 1
    assert made.state().problem == "still gone; gone too"
    made.set_ready(0, report(0))
    assert not made.state().ready
    made.set_ready(1, report(1))
    assert made.state().ready
    assert made.latest(1.0)[0] is None
    made.set_failed(1, "again")
    assert made.state().losses == 2
