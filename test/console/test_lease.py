"""One operator steers at a time."""

from __future__ import annotations

from magnetosuture_thread.console.lease import Lease


def test_a_free_needle_is_taken_and_handed_back():
    lease = Lease(3.0)
    assert lease.available(0.0)
    assert lease.take(1, 0.0) == ""
    assert lease.holder == 1
    assert not lease.available(1.0)
    assert lease.hand_back(1)
    assert lease.holder is None


def test_nobody_takes_it_from_one_who_is_there():
    lease = Lease(3.0)
    lease.take(1, 0.0)
    for now in range(100):
        lease.hear(1, float(now))
        assert "page 1 steers" in lease.take(2, now + 2.9)
    assert lease.holder == 1


def test_it_is_taken_from_one_who_is_silent():
    lease = Lease(3.0)
    lease.take(1, 0.0)
    assert lease.take(2, 3.0) != ""
    assert lease.take(2, 3.1) == ""
    lease.hear(1, 3.2)
    assert lease.holder == 2


def test_it_is_taken_from_one_whose_page_is_hidden_and_no_longer_once_it_is_seen():
    lease = Lease(3.0)
    lease.take(1, 0.0)
    lease.hide(1, True)
    assert lease.available(0.1)
    lease.hide(1, False)
    assert lease.take(2, 0.2) != ""
    lease.hide(1, True)
    assert lease.take(2, 0.3) == ""
    assert not lease.hidden


def test_others_hand_nothing_back_and_hide_nothing():
    lease = Lease(3.0)
    lease.take(1, 0.0)
    lease.hide(2, True)
    assert not lease.hand_back(2)
    assert not lease.available(0.1)


def test_others_do_not_keep_it_alive():
    lease = Lease(3.0)
    lease.take(1, 0.0)
    lease.hear(2, 3.0)
    assert lease.available(3.1)


def test_taking_again_what_one_has_is_fine():
    lease = Lease(3.0)
    lease.take(1, 0.0)
    assert lease.take(1, 1.0) == ""
