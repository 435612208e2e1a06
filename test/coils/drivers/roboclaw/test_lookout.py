"""What the driver notices of boards and coils that otherwise go on."""

from __future__ import annotations

import time

import numpy as np
import pytest

CURRENTS = (3.0, -6.0, 1.5, 0.0)
DUTIES = [(4095, -8191), (2047, 0)]


@pytest.mark.parametrize("currents", [CURRENTS, (0.0, 0.0, 0.0, 0.0)])
@pytest.mark.parametrize("shared", [False, True])
def test_a_board_whose_power_was_gone_is_a_loss_however_soon_it_is_back(
    bench, shared: bool, currents: tuple[float, ...]
):
    if shared:
        bench.share()
    driver = bench.open(apply_timeout=60.0, roboclaw_answer_timeout=0.5)  # no loss that is only the busy machine's
    driver.apply(np.array(currents), time.monotonic())
    bench.wait(lambda: bench.duties(1) == (DUTIES[1] if any(currents) else (0, 0)), "the duties")
    with bench.stage.lines[-1].lock:
        bench.boards[1].power_cycle()
    bench.wait(lambda: driver.state().losses == 1, "the loss")
    bench.wait(lambda: driver.state().ready, "the driver to be back")
    assert (bench.boards[1].timeout, bench.boards[1].limits) == (2, [1000, 1000])
    bench.heard(0)
    bench.heard(1)
    assert bench.duties(0) == bench.duties(1) == (0, 0)
    driver.apply(np.array(CURRENTS), time.monotonic())
    bench.wait(lambda: [bench.duties(0), bench.duties(1)] == DUTIES, "the duties again")
    assert driver.state().losses == 1


def test_a_broken_wire_is_a_warning_that_names_its_coil(bench):
    driver = bench.open(roboclaw_answer_timeout=0.5)
    bench.boards[1].broken.add(0)
    with bench.held(driver, 3.0, -6.0, 4.0, 1.0):
        bench.wait(
            lambda: driver.state().warnings == ("coil 2: 0.00 A measured, 4.00 A commanded",),
            "the warning and no other",
        )
        assert driver.state().ready
        bench.boards[1].broken.clear()
        bench.wait(lambda: driver.state().warnings == (), "the warning to go")
    assert driver.state().losses == 0
