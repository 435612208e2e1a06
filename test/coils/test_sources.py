"""How many publishers speak at once."""

from __future__ import annotations

import random

import pytest

from magnetosuture_thread.coils.sources import SILENCE, SourceWatch


def test_one_that_loses_messages_is_one():
    watch = SourceWatch()
    number = 0
    source = random.Random(1)
    for k in range(1000):
        number += source.choice([1, 1, 1, 2, 5, 30])
        assert watch.hear(number, 0.01 * k) == 1


@pytest.mark.parametrize("ahead", [0, 1, 3, 50, 100, 101, 5000, -1, -40, -5000])
def test_two_are_two_however_their_numbers_lie(ahead: int):
    watch = SourceWatch()
    counts = []
    for k in range(20):
        watch.hear(10_000 + k, 0.02 * k)
        counts.append(watch.hear(10_000 + k + ahead, 0.02 * k + 0.007))
    assert counts[1:] == [2] * 19


def test_one_far_ahead_is_noticed_with_its_first_message():
    watch = SourceWatch()
    watch.hear(10, 0.0)
    assert watch.hear(5000, 0.01) == 2


def test_one_that_was_started_again_is_one():
    watch = SourceWatch()
    watch.hear(5000, 0.0)
    assert watch.hear(1, SILENCE + 0.01) == 1


def test_who_is_silent_does_not_speak():
    watch = SourceWatch()
    watch.hear(1, 0.0)
    watch.hear(1, 0.3)
    assert watch.count(0.4) == 2
    assert watch.count(0.6) == 1
    assert watch.count(2.0) == 0
