"""The driver of the simulated rig."""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.coils.bridge import CoilBridge
from magnetosuture_thread.coils.coil_system import CoilSystem
from magnetosuture_thread.coils.drivers import RecordingDriver, SimulatedDriver
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.settings.errors import ConfigurationError, InvalidInputError

HOW_TO = Path(__file__).parents[3] / "docs/how_to/add_a_driver.md"


def own_driver(timeout: float, write: Any) -> Any:
    """Return the driver of the how-to."""
    found, names = re.search(r"```python\n(.*?)```", HOW_TO.read_text(), re.DOTALL), dict[str, Any]()
    assert found is not None
    exec(compile(found[1], str(HOW_TO), "exec"), names)
    return names["BenchSupplyDriver"](coils=4, max_age=0.1, timeout=timeout, write=write)


def system_with(driver: Any, **settings: Any) -> CoilSystem:
    """Return an active system whose driver is open."""
    system, given = CoilSystem(), CoilBridgeSettings(**settings)
    system.open(given, CoilBridge(given, system.latch, Scene()), driver)
    system.latch.activate()
    return system


def wait(condition: Any) -> None:
    """Wait until a condition holds."""
    end = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.001)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_driver_whose_thread_has_died_is_not_ready_and_what_it_drove_is_a_fault():
    unplugged = list[bool]()

    def write(currents: np.ndarray) -> None:
        if unplugged:
            raise OSError("the device is gone")

    driver = own_driver(0.2, write)
    system = system_with(driver)
    wait(lambda: driver.state().ready)
    system.arm(True)
    system.step(500.0, 100.0)
    assert system.latch.armed
    unplugged.append(True)
    wait(lambda: not driver.state().ready)
    system.step(500.005, 100.005)
    assert system.latch.fault == "driver: its thread has died"
    with pytest.raises(InvalidInputError, match="a driver that is not ready"):
        system.reset()
    system.close()


@pytest.mark.parametrize("timeout", [0.21, np.inf])
def test_a_driver_that_holds_currents_for_longer_than_motion_is_certified_for_is_not_ready(timeout: float):
    driver = own_driver(timeout, lambda currents: None)
    system = system_with(driver, driver_timeout=0.2)
    wait(lambda: driver.state().ready)
    with pytest.raises(InvalidInputError, match=f"stops by itself after {timeout:g} s, expected at most .* 0.2 s"):
        system.arm(True)
    system.step(500.0, 100.0)
    assert not system.latch.armed
    assert not system.driver_state.ready
    system.close()


def test_a_driver_that_may_move_something_arms_by_a_person_alone():
    def write(currents: np.ndarray) -> None:
        pytest.fail("it was opened")

    with pytest.raises(ConfigurationError, match="autostart"):
        system_with(own_driver(0.2, write), autostart="armed")
    system = system_with(RecordingDriver(4), autostart="armed")  # whose currents end with the process
    system.arm(True)
    assert system.latch.armed


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
