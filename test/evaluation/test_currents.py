"""Coil currents of a replay beside those that were recorded."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from magnetosuture_thread.evaluation.graph_outputs import CurrentSeries


def message(time: float, *currents: float, stop: str = "") -> Any:
    """Return what a message of currents amounts to."""
    stamp = SimpleNamespace(sec=int(time), nanosec=round((time - int(time)) * 1e9))
    return SimpleNamespace(header=SimpleNamespace(stamp=stamp), current=list(currents), stop=stop)


def series(*messages: Any) -> CurrentSeries:
    """Return a series of messages."""
    made = CurrentSeries()
    for each in messages:
        made.add(each)
    return made


def test_the_current_in_force_is_the_one_to_compare_with():
    recorded = series(message(1.0, 1.0, 0.0), message(1.01, 2.0, 0.0), message(1.02, 3.0, 0.0))
    found = series(message(1.013, 2.5, 0.0), message(1.0199, 2.0, 0.0)).against(recorded)
    assert found is not None
    assert (found.compared, found.greatest, found.difference) == (2, 0.5, 0.0)
    assert found.recorded == pytest.approx(2.0**0.5)


def test_a_stop_in_one_only_is_counted():
    recorded = series(message(1.0, 0.0), message(1.01, 0.0, stop="no command for 0.1 s"))
    found = series(message(1.0, 0.0), message(1.01, 0.0)).against(recorded)
    assert found is not None
    assert found.stopped_apart == 0.5


def test_what_has_nothing_beside_it_is_not_compared():
    recorded = series(message(1.0, 1.0))
    assert series(message(0.9, 1.0), message(1.06, 1.0)).against(recorded) is None
    assert series(message(1.0, 1.0, 2.0)).against(recorded) is None
    assert series().against(recorded) is None
    assert series(message(1.0, 1.0)).against(series()) is None
