"""The promise: the axis keeps `keep_out`, attacked in simulated time. `python -m benchmarks keep-out` runs longer."""

from __future__ import annotations

import pytest

from benchmarks.keep_out import Tally, attack

pytestmark = pytest.mark.slow

EPISODES = 80


@pytest.fixture(scope="module")
def found() -> Tally:
    """What came of driving at everything, for at least 300 s of simulated time."""
    total = Tally()
    for seed in range(EPISODES):
        total.add(attack(seed))
    return total


def test_the_needle_keeps_out_whatever_is_commanded(found: Tally):
    assert found.seconds > 300.0
    assert found.violations == 0, found.worst
    assert found.deepest < 1e-9


def test_the_attack_was_one(found: Tally):
    assert found.driven > 0.6 * found.steps  # it does not keep out by standing still
    assert found.pressed > 500
    assert found.stalls > 200
    assert found.deepest > -1e-5  # it did get to the bound
