"""The driver of the simulated rig."""

from __future__ import annotations

import numpy as np

from magnetosuture_thread.coils.drivers import SimulatedDriver


def test_it_sends_while_somebody_listens_and_ends_with_zeros():
    sent: list[list[float]] = []
    listeners = [1]
    driver = SimulatedDriver(4, lambda currents: sent.append(currents.tolist()), lambda: listeners[0])
    driver.apply(np.ones(4), 0.0)
    assert not driver.state().ready
    driver.open()
    assert driver.state().ready
    driver.apply(np.ones(4), 0.0)
    driver.close()
    driver.apply(np.ones(4), 0.0)
    assert sent == [[1.0] * 4, [0.0] * 4]


def test_without_anybody_there_it_is_not_ready_and_each_loss_counts():
    listeners = [0]
    driver = SimulatedDriver(4, lambda currents: None, lambda: listeners[0])
    driver.open()
    assert (driver.state().ready, driver.state().problem) == (False, "no rig_simulator subscribed")
    assert driver.state().losses == 0
    for number in (1, 2):
        listeners[0] = 1
        assert driver.state().ready
        listeners[0] = 0
        driver.apply(np.ones(4), 0.0)
        assert driver.state().losses == number
