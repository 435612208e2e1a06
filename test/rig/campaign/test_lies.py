"""The needle follows, or it stops: poses that are not the needle's end in a fault before it has gone far. Simulated."""

from __future__ import annotations

import math

import pytest

from benchmarks.lies import LIES, run_lie

SEED = 3
UNSEEN = ("drifts at 5 mm/s", "none")  # a drift of the camera is like a pull that is compensated
ALIVE = ("goes in a circle", "walks at random")  # what moves may follow by chance for a while


@pytest.mark.parametrize("kind", [kind for kind in LIES if kind not in (*UNSEEN, *ALIVE)])
@pytest.mark.parametrize("setup", ["hernia_ring", "petri_35mm_polyamide_post"])
def test_a_lie_is_latched_before_the_needle_has_gone_far(setup: str, kind: str):
    told = run_lie((setup, kind, SEED))
    assert "needle does not follow" in told["fault"]
    assert told["stopped_s"] < 0.5 or told["travel_m"] < 1.5e-3
    assert told["peak_speed_ratio"] < 1.25
    assert not told["broken"]


@pytest.mark.parametrize("setup", ["hernia_ring", "dish_50mm", "petri_35mm_polyamide", "petri_35mm_polyamide_post"])
def test_an_honest_tracker_is_believed(setup: str):
    told = run_lie((setup, "none", SEED))
    assert told["fault"] == told["stopped_before"] == ""
    assert told["stopped_s"] is None
    assert math.isfinite(told["peak_speed_ratio"])
