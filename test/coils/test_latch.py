"""Armed, disarmed, emergency stop, fault: who may move the needle."""

from __future__ import annotations

import itertools

import pytest

from magnetosuture_thread.coils.latch import ArmingLatch, Condition
from magnetosuture_thread.errors import InvalidInputError


def armed() -> ArmingLatch:
    """Return a latch that lets commands pass."""
    latch = ArmingLatch()
    latch.activate()
    latch.arm("")
    return latch


def test_it_holds_until_it_is_active_and_armed():
    latch = ArmingLatch()
    assert (latch.holds, latch.condition) == ("inactive", Condition.INACTIVE)
    with pytest.raises(InvalidInputError, match="an inactive bridge"):
        latch.arm("")
    latch.activate()
    assert (latch.holds, latch.condition) == ("disarmed", Condition.ACTIVE)
    latch.arm("")
    assert (latch.holds, latch.armed) == ("", True)
    latch.disarm()
    assert latch.holds == "disarmed"


def test_who_is_deactivated_is_disarmed():
    latch = armed()
    latch.deactivate()
    assert latch.holds == "inactive"
    latch.activate()
    assert latch.holds == "disarmed"


@pytest.mark.parametrize("activate_first", [True, False])
def test_an_emergency_stop_stays_until_it_is_reset_and_a_reset_does_not_arm(activate_first: bool):
    latch = armed() if activate_first else ArmingLatch()
    latch.stop()
    assert (latch.holds, latch.condition) == ("emergency stop", Condition.FAULT)
    for act in (lambda: latch.arm(""), latch.activate):
        with pytest.raises(InvalidInputError, match="emergency stop"):
            act()
    latch.disarm()
    latch.deactivate()
    assert latch.holds == "emergency stop"
    latch.reset("")
    assert not latch.armed
    latch.activate()
    assert latch.holds == "disarmed"


def test_the_first_fault_is_kept_and_latched():
    latch = armed()
    latch.trip("driver: silent")
    latch.trip("something that followed")
    assert (latch.holds, latch.condition, latch.armed) == ("driver: silent", Condition.FAULT, False)
    with pytest.raises(InvalidInputError, match="driver: silent"):
        latch.arm("")


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
            assert not (latched and latch.holds == "")
        assert (latch.holds == "") == (allowed and active and not latched), sequence
