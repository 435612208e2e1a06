"""Faults of the simulated rig."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from magnetosuture_thread.rig.rig import FaultSchedule
from magnetosuture_thread.rig.settings import KINDS, Fault
from magnetosuture_thread.settings.errors import ConfigurationError

TAIL, TIP = np.array([0.002, 0.001]), np.array([0.009, 0.001])


def schedule(*faults: str) -> FaultSchedule:
    """Return a schedule of faults in words."""
    return FaultSchedule([Fault.parse(text) for text in faults], 0.035, 0.007, seed=3)


@pytest.mark.parametrize("kind", KINDS)
def test_a_fault_holds_from_its_start_for_its_duration(kind: str):
    faults = schedule(f"{kind} 2.0 1.5")
    assert [kind in faults.kinds(time) for time in (1.99, 2.0, 3.49, 3.5)] == [False, True, True, False]


@pytest.mark.parametrize(
    "text", ["", "glare", "glare 1", "glare 1 2 3", "sun 1 2", "glare -1 2", "glare 1 0", "glare 1 nan", "glare x 1"]
)
def test_what_is_no_fault_is_refused_in_words(text: str):
    with pytest.raises(ConfigurationError, match="KIND START DURATION"):
        Fault.parse(text)


def test_the_needle_is_carried_over_the_rim_and_back():
    faults = schedule("needle_out 1 3")
    away = [float(np.linalg.norm(faults.lifted(time))) for time in (0.9, 1.1, 2.5, 3.9, 4.1)]
    assert away[0] == away[4] == 0.0
    assert 0.0 < away[1] < 0.02
    assert away[2] > 0.035
    assert 0.0 < away[3] < 0.02


@pytest.mark.parametrize("kind", ["glare", "hand", "tool"])
def test_what_covers_lies_on_the_needle(kind: str):
    (cover,) = schedule(f"{kind} 0 2").covers(0.3, TAIL, TIP)
    assert shapely.Polygon(cover.outline).intersects(shapely.LineString([TAIL, TIP]))
