"""Number of active publishers."""

from __future__ import annotations

import random

import pytest

from magnetosuture_thread.coils.inputs import SILENCE_TIMEOUT, PublisherCounter


def test_lost_messages_do_not_add_a_publisher():
    counter = PublisherCounter()
    number = 0
    source = random.Random(1)
    for k in range(1000):
        number += source.choice([1, 1, 1, 2, 5, 30])
        assert counter.update(number, 0.01 * k) == 1


@pytest.mark.parametrize("ahead", [0, 1, 3, 50, 100, 101, 5000, -1, -40, -5000])
def test_two_publishers_are_counted_for_any_offset(ahead: int):
    counter = PublisherCounter()
    counts = []
    for k in range(20):
        counter.update(10_000 + k, 0.02 * k)
        counts.append(counter.update(10_000 + k + ahead, 0.02 * k + 0.007))
    assert counts[1:] == [2] * 19


def test_restarted_publisher_is_one():
    counter = PublisherCounter()
    counter.update(5000, 0.0)
    assert counter.update(1, SILENCE_TIMEOUT + 0.01) == 1


def test_silent_publisher_is_not_counted():
    counter = PublisherCounter()
    counter.update(1, 0.0)
    counter.update(1, 0.3)
    assert counter.count(0.4) == 2
    assert counter.count(0.6) == 1
    assert counter.count(2.0) == 0
