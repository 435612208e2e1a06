"""What is kept of a run: columns, worst frames, error map, lines of a plot."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.evaluation.frames import ErrorMap, FrameResult, TimeSeries, WorstFrames, with_gaps
from magnetosuture_thread.evaluation.report.page import thinned


def test_what_is_not_named_is_nan():
    table = TimeSeries(["a", "b"])
    table.add(0.5, {"a": 1.0})
    assert (len(table), table.times.tolist(), table.column("a").tolist()) == (1, [0.5], [1.0])
    assert table.has("a")
    assert not table.has("b")
    with pytest.raises(KeyError, match="no such columns: c"):
        table.add(1.0, {"c": 1.0})


@pytest.mark.parametrize("count", [5001, 17_999, 18_000, 123_457])
def test_no_peak_is_lost_and_no_line_is_longer_than_the_limit(count: int):
    times = np.arange(count) / 30.0
    values = np.random.default_rng(count).normal(size=count)
    values[count // 3], values[-1] = 50.0, -50.0
    values[7] = np.nan
    at, columns = thinned(times, {"a": values}, 5000)
    assert len(at) == len(columns["a"]) <= 5000
    assert (np.nanmax(columns["a"]), np.nanmin(columns["a"])) == (50.0, -50.0)
    assert (np.diff(at) >= 0.0).all()
    peak = at[int(np.nanargmax(columns["a"]))]
    assert abs(peak - times[count // 3]) <= 2.0 * count / 5000 / 30.0 + 1 / 30.0


def test_a_line_is_broken_where_nothing_came():
    times = np.array([0.0, 0.1, 0.2, 3.0, 3.1])
    at, values = with_gaps(times, np.arange(5.0))
    assert at[3:5] == pytest.approx([0.3, 2.9])
    assert np.isnan(values[3:5]).all()
    assert np.delete(values, [3, 4]).tolist() == [0, 1, 2, 3, 4]


def test_they_are_the_worst_first_and_apart():
    worst = WorstFrames(count=3, apart=1.0)
    for time, error in ((0.2, 1.0), (0.7, 9.0), (0.9, 8.0), (3.0, 5.0), (3.6, 4.0), (8.0, 2.0), (9.0, np.nan)):
        worst.add(time, error, FrameResult(round(time * 1e9)))
    found = worst.found()
    assert [(moment.time, moment.error) for moment in found] == [(0.7, 9.0), (3.0, 5.0), (8.0, 2.0)]
    assert found[0].frame.stamp == 700_000_000


LENGTH = 0.019


@pytest.mark.parametrize("frames", [1, 8, 9, 1000, 4096])
def test_the_map_stays_small_and_keeps_the_greatest_errors(frames: int):
    gathered = ErrorMap(LENGTH, columns=4)
    values = np.random.default_rng(frames).random((frames, 3))
    for index, errors in enumerate(values):
        gathered.add(index / 30.0, errors)
    grid = gathered.grid()
    assert grid is not None
    assert grid.errors.shape[1] == len(grid.times) <= 8
    assert grid.errors.max(axis=1).tolist() == values.max(axis=0).tolist()
    assert grid.lengths[-1] == LENGTH


def test_a_gap_is_empty():
    gathered = ErrorMap(LENGTH)
    for time in (0.0, 0.1, 0.2, 5.0, 5.1):
        gathered.add(time, np.ones(3))
    grid = gathered.grid()
    assert grid is not None
    inside = (grid.times > 0.2) & (grid.times < 5.0)
    assert inside.sum() == 2
    assert np.isnan(grid.errors[:, inside]).all()
    assert (grid.errors[:, ~inside] == 1.0).all()
