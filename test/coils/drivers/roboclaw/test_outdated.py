"""A process that was stopped and goes on writes no duty of before: SIGSTOP, a debugger, a virtual machine."""

from __future__ import annotations

import select
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.coils.drivers import roboclaw as board

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


def test_currents_that_grow_old_before_their_packet_is_written_are_zero(bench, monkeypatch: pytest.MonkeyPatch):
    """As where the thread of the line is stopped between looking at their age and writing."""
    driver = bench.open(apply_timeout=0.1, roboclaw_answer_timeout=1.0, driver_timeout=1.0)
    real = select.select

    def stopped(*waited: Any) -> Any:
        time.sleep(0.15)
        return real(*waited)

    monkeypatch.setattr(board, "select", SimpleNamespace(select=stopped))
    for _ in range(4):
        driver.apply(CURRENTS, time.monotonic())
        assert duties_during(bench, 0.5) == {(0, 0)}
    assert driver.state().ready
