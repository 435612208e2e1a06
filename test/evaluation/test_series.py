"""Numbers over time: kept, thinned, broken at gaps."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.evaluation.frames import TimeSeries
from magnetosuture_thread.evaluation.report.page import thinned, with_gaps


def test_what_is_not_named_is_nan():
    table = TimeSeries(["a", "b"])
    table.add(0.5, {"a": 1.0})
    assert (len(table), table.times.tolist(), table.column("a").tolist()) == (1, [0.5], [1.0])
    assert table.has("a")
    assert not table.has("b")
    with pytest.raises(KeyError, match="no such columns: c"):
        table.add(1.0, {"c": 1.0})


def test_few_rows_are_left_as_they_are():
    times = np.arange(10.0)
    at, columns = thinned(times, {"a": times**2}, 10)
    assert at is times
    assert columns["a"].tolist() == (times**2).tolist()


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
    at, columns = with_gaps(times, {"a": np.arange(5.0)})
    assert at[3] == pytest.approx(1.6)
    assert np.isnan(columns["a"][3])
    assert np.delete(columns["a"], 3).tolist() == [0, 1, 2, 3, 4]
