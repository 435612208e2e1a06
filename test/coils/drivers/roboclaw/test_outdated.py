"""A process that was stopped and goes on writes no duty of before: SIGSTOP, a debugger, a virtual machine."""

from __future__ import annotations

import time

import numpy as np
import pytest

CURRENTS = np.array([3.0, -6.0, 1.5, 2.0])


def duties_during(bench, seconds: float) -> set[tuple[int, int]]:
    """Return all duties that the boards have for a while."""
    until, found = time.monotonic() + seconds, set()
    while time.monotonic() < until:
        found |= {bench.duties(0), bench.duties(1)}
        time.sleep(0.001)
    return found


@pytest.mark.parametrize(
    "timeouts", [{"apply_timeout": 0.1}, {"command_timeout": 1.0, "driver_timeout": 0.2}], ids=["command", "board"]
)
def test_currents_that_were_computed_long_ago_are_zero(bench, timeouts: dict[str, float]):
    """As where the bridge is stopped before the driver; boards that have stopped by themselves must not start again."""
    driver = bench.open(**timeouts)
    driver.apply(CURRENTS, time.monotonic() - 0.45)
    assert duties_during(bench, 0.3) == {(0, 0)}
