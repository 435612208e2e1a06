"""The worst frames."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.evaluation.frames import BIN, FrameResult, WorstFrames


def test_they_are_the_worst_first_and_apart():
    worst = WorstFrames(count=3, apart=1.0)
    for time, error in ((0.2, 1.0), (0.7, 9.0), (0.9, 8.0), (3.0, 5.0), (3.6, 4.0), (8.0, 2.0), (9.0, np.nan)):
        worst.add(time, error, FrameResult(round(time * 1e9)))
    found = worst.found()
    assert [(moment.time, moment.error) for moment in found] == [(0.7, 9.0), (3.0, 5.0), (8.0, 2.0)]
    assert found[0].frame.stamp == 700_000_000


@pytest.mark.parametrize("seed", range(5))
def test_few_frames_are_kept_and_none_too_few(seed: int):
    errors = np.random.default_rng(seed).random(9000).cumsum() % 7.0
    kept, whole = WorstFrames(), WorstFrames()
    whole._enough = 10**9
    for index, error in enumerate(errors):
        for worst in (kept, whole):
            worst.add(index / 30.0, error, FrameResult(index))
    assert len(kept._bins) < 120 < 9000 / 30.0 / BIN
    assert [moment.time for moment in kept.found()] == [moment.time for moment in whole.found()]
    assert len(kept.found()) == 5


def test_without_errors_there_are_none():
    assert WorstFrames().found() == []
