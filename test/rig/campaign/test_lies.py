"""The needle follows, or it stops: poses that are not the needle's end in a fault before it has gone far. Simulated."""

from __future__ import annotations

import math

import pytest

from benchmarks.lies import FAULTS, LIES, TIMES, run_lie

pytestmark = pytest.mark.slow

SEED = 3
UNSEEN = ("drifts at 5 mm/s", "none")  # a drift of the camera is like a pull that is compensated
ALIVE = ("goes in a circle", "walks at random")  # what moves may follow by chance for a while
SHARES = ("moves by 0.3 of its way", "moves by 1.7 of its way")  # as a needle does that is pulled
SPARSE = "frozen, at 4.5 frames/s"
HONEST = ("none", *TIMES, *FAULTS, *SHARES)


@pytest.mark.parametrize("kind", [kind for kind in LIES if kind not in (*UNSEEN, *ALIVE, *HONEST, SPARSE)])
@pytest.mark.parametrize("setup", ["hernia_ring", "petri_35mm_polyamide_post"])
def test_a_lie_is_latched_before_the_needle_has_gone_far(setup: str, kind: str):
    told = run_lie((setup, kind, SEED))
    assert "needle does not follow" in told["fault"]
    assert told["stopped_s"] < 0.5 or told["travel_m"] < 1.5e-3
    assert told["peak_speed_ratio"] < 1.25
    assert not told["broken"]


@pytest.mark.parametrize("setup", ["hernia_ring", "petri_35mm_polyamide_post"])
def test_a_picture_that_is_frozen_and_comes_less_often_than_poses_count_is_latched(setup: str):
    told = run_lie((setup, SPARSE, SEED))
    assert "needle does not follow" in told["fault"]
    assert told["travel_m"] < 2.5e-3  # of 1.5 mm by the model, and what comes until the next pose


@pytest.mark.parametrize(("kind", "strength"), [*((kind, 1.0) for kind in SHARES), ("coils 3 times as strong", 3.0)])
@pytest.mark.parametrize("setup", ["hernia_ring", "petri_35mm_polyamide_post"])
def test_what_is_taken_for_a_pull_gives_the_needle_no_more_than_that_can_take(setup: str, kind: str, strength: float):
    told = run_lie((setup, kind, SEED))
    assert told["bound_ratio"] < 1.25 * strength


@pytest.mark.parametrize("kind", ["none", *TIMES])
@pytest.mark.parametrize("setup", ["hernia_ring", "dish_50mm", "petri_35mm_polyamide", "petri_35mm_polyamide_post"])
def test_an_honest_tracker_is_believed_also_when_it_is_late_and_its_stamps_are_wrong(setup: str, kind: str):
    told = run_lie((setup, kind, SEED))
    assert told["fault"] == told["stopped_before"] == ""
    assert told["stopped_s"] is None
    assert math.isfinite(told["peak_speed_ratio"])
    # Paths of 2 to 5 mm/s, of 20 to 25 mm/s that are allowed. Behind a clamped thread wrong stamps are found out late,
    # see known limits.
    assert told["peak_speed_ratio"] < (1.25 if setup.startswith("petri") and "stamped" in kind else 0.5)
