"""What a bag's observations say as arrays, and which bags are of no use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from magnetosuture_thread.calibration.recorded_run import (
    MAX_FRAMES,
    SETTLING,
    mean_error,
    read_run,
    replay_with_parameters,
)
from magnetosuture_thread.evaluation.frames import Observation
from magnetosuture_thread.settings.errors import BagError, InvalidInputError
from test.calibration.runs import LENGTH, SETTINGS, path, rig_run, stiff

TRUE = 1.3e-9
Observations = Sequence[Observation]


@pytest.fixture
def observations() -> tuple[Observation, ...]:
    """Return a run whose parameters are known."""
    return rig_run(TRUE)


def still(first: Observation, sight: Observation, shift: float) -> Observation:
    """Return the first sight at another time, the needle moved on by so much [m]."""
    by = np.array([shift, 0.0])
    return replace(sight, tail=first.tail + by, heading=first.heading, measured=first.measured + by)


def test_it_begins_where_the_thread_is_first_measured_and_compares_from_a_second_on(observations: Observations):
    hidden = [replace(sight, measured=np.empty((0, 2))) if k < 5 else sight for k, sight in enumerate(observations)]
    lost = [Observation(sight.stamp, reason="glare") if k == 50 else sight for k, sight in enumerate(hidden)]
    passage = read_run("bag", lost, SETTINGS)
    assert passage.stamps[0] == observations[5].stamp
    assert observations[50].stamp not in passage.stamps
    assert passage.times[0] == pytest.approx(SETTLING, abs=0.1)
    assert len(passage.frames) <= MAX_FRAMES
    assert passage.targets.shape == (len(passage.frames), SETTINGS.segments, 2)
    assert passage.known[:, :-1].all()  # the chords of the seen curve are a little shorter than the thread
    steps = [np.linalg.norm(path(k + 0.01)[0] - path(k)[0]) / 0.01 for k in np.arange(0.3, 6.0, 0.1)]
    assert passage.speed == pytest.approx(np.percentile(steps, 75.0), rel=0.15)


def test_after_a_gap_it_begins_anew_from_the_measured_thread(observations: Observations):
    gap = [sight for k, sight in enumerate(observations) if not 40 <= k < 50]
    passage = read_run("bag", gap, SETTINGS)
    assert passage.legs == (0, 40)
    assert np.array_equal(passage.initials[1], observations[50].measured)
    times = (passage.stamps[passage.frames] - observations[50].stamp) * 1e-9
    assert not ((times >= 0.0) & (times < SETTLING)).any()
    last = replay_with_parameters(passage, stiff(TRUE))[-1:]
    assert mean_error(last, passage.targets[-1:], LENGTH) < 0.3


def unusable(observations: Observations) -> dict[str, Observations]:
    """Return bags by the reason for which they cannot be used."""
    first, empty = observations[0], np.empty((0, 2))
    parts = [replace(sight, measured=sight.measured[:20]) for sight in observations]
    return {
        "no needle": [Observation(sight.stamp, reason="dark") for sight in observations],
        "no thread": [replace(sight, measured=empty) for sight in observations],
        "no ground truth": [replace(sight, ground_truth=empty) for sight in observations],
        "too short": observations[:40],
        "half of the thread": [first, *parts[1:]],
        "never shows half": parts,
        "nothing moves": [still(first, sight, 0.0) for sight in observations],
        "too slow": [still(first, sight, 1e-5 * k) for k, sight in enumerate(observations)],
    }


def test_bags_that_cannot_be_used_are_refused_with_the_reason(observations: Observations):
    for words, sights in unusable(observations).items():
        with pytest.raises(BagError, match=words) as refused:
            read_run("a bag", sights, SETTINGS, "truth" if words == "no ground truth" else "seen")
        assert str(refused.value).startswith("a bag: ")
    with pytest.raises(InvalidInputError, match="before the last"):
        read_run("a bag", [*observations, *observations], SETTINGS)
