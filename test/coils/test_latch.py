"""Arming state machine: armed, disarmed, emergency stop, fault."""

from __future__ import annotations

import itertools

import pytest

from magnetosuture_thread.coils.latch import ArmingLatch, ArmingState
from magnetosuture_thread.settings.errors import InvalidInputError


def armed() -> ArmingLatch:
    """Return an armed latch."""
    latch = ArmingLatch()
    latch.activate()
    latch.arm("")
    return latch


@pytest.mark.parametrize("activate_first", [True, False])
def test_emergency_stop_is_latched_until_a_reset_which_does_not_arm(activate_first: bool):
    latch = armed() if activate_first else ArmingLatch()
    latch.stop()
    assert (latch.stop_reason, latch.state) == ("emergency stop", ArmingState.FAULT)
    for act in (lambda: latch.arm(""), latch.activate):
        with pytest.raises(InvalidInputError, match="emergency stop"):
            act()
    latch.disarm()
    latch.deactivate()
    assert latch.stop_reason == "emergency stop"
    latch.reset("")
    assert not latch.armed
    latch.activate()
    assert latch.stop_reason == "disarmed"


def test_neither_arming_nor_a_reset_passes_over_a_driver_that_is_not_ready():
    latch = ArmingLatch()
    latch.activate()
    with pytest.raises(InvalidInputError, match="not ready \\(no answer\\)"):
        latch.arm("no answer")
    latch.stop()
    with pytest.raises(InvalidInputError, match="not ready \\(no answer\\)"):
        latch.reset("no answer")
    assert latch.emergency


def test_whatever_is_pressed_in_whatever_order_nothing_passes_without_an_arm_after_the_last_stop():
    """All sequences of five presses: armed only if arm came after activate and after any stop was reset."""
    presses = {
        "activate": lambda latch: latch.activate(),
        "deactivate": lambda latch: latch.deactivate(),
        "arm": lambda latch: latch.arm(""),
        "disarm": lambda latch: latch.disarm(),
        "stop": lambda latch: latch.stop(),
        "trip": lambda latch: latch.trip("fault"),
        "reset": lambda latch: latch.reset(""),
    }
    ends = {"deactivate", "disarm", "stop", "trip", "reset"}
    for sequence in itertools.product(presses, repeat=5):
        latch = ArmingLatch()
        allowed = active = latched = False
        for press in sequence:
            try:
                presses[press](latch)
            except InvalidInputError:
                continue
            latched = (latched or press in {"stop", "trip"}) and press != "reset"
            active = press == "activate" or (active and press != "deactivate")
            allowed = press == "arm" or (allowed and press not in ends)
            assert not (latched and latch.stop_reason == "")
            assert latch.ready_to_arm == (active and not latched and not allowed)
        assert (latch.stop_reason == "") == (allowed and active and not latched), sequence


def test_first_fault_is_latched():
    latch = armed()
    latch.trip("driver: silent")
    latch.trip("something that followed")
    assert (latch.stop_reason, latch.state, latch.armed) == ("driver: silent", ArmingState.FAULT, False)
    with pytest.raises(InvalidInputError, match="driver: silent"):
        latch.arm("")
