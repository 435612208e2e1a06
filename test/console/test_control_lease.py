"""One page has control at a time."""

from __future__ import annotations

from magnetosuture_thread.console.jog_controller import ControlLease


def test_control_is_acquired_and_released():
    lease = ControlLease(3.0)
    assert lease.available(0.0)
    assert lease.acquire(1, 0.0) == ""
    assert lease.holder == 1
    assert not lease.available(1.0)
    assert lease.release(1)
    assert lease.holder is None


def test_control_is_not_taken_from_an_active_page():
    lease = ControlLease(3.0)
    lease.acquire(1, 0.0)
    for now in range(100):
        lease.keep_alive(1, float(now))
        assert "page 1 has control" in lease.acquire(2, now + 2.9)
    assert lease.holder == 1


def test_control_is_taken_from_a_silent_page():
    lease = ControlLease(3.0)
    lease.acquire(1, 0.0)
    assert lease.acquire(2, 3.0) != ""
    assert lease.acquire(2, 3.1) == ""
    lease.keep_alive(1, 3.2)
    assert lease.holder == 2


def test_control_is_taken_from_a_hidden_page_only_while_hidden():
    lease = ControlLease(3.0)
    lease.acquire(1, 0.0)
    lease.set_hidden(1, True)
    assert lease.available(0.1)
    lease.set_hidden(1, False)
    assert lease.acquire(2, 0.2) != ""
    lease.set_hidden(1, True)
    assert lease.acquire(2, 0.3) == ""
    assert not lease.hidden


def test_messages_of_others_do_not_extend_the_lease():
    lease = ControlLease(3.0)
    lease.acquire(1, 0.0)
    lease.keep_alive(2, 3.0)
    assert lease.available(3.1)
