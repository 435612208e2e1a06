"""The data of the page's plots, as plain values for its script."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from magnetosuture_thread.evaluation.metrics import RunMetrics
from magnetosuture_thread.evaluation.report.headlines import AGAINST
from magnetosuture_thread.evaluation.series import MARGIN, Column, TimeSeries, WorstFrame, thinned, with_gaps
from magnetosuture_thread.model.margins import SOLID

MAX_POINTS = 5000  # of a line
MAX_BANDS = 400
MIN_RANGE = 1.0  # s
MIN_STRAIN = 1e-7  # %, on a scale of powers of ten
DIGITS = 5  # of a value in the page
LINE_COLOURS = ("kind0", "kind1", "kind3", "kind4")  # of the page


def page_data(metrics: RunMetrics, worst: Sequence[WorstFrame], limit: int = MAX_POINTS) -> dict[str, Any]:
    """Return everything that the page's script draws.

    Times in s since the bag's start; `null` where there is no value.

    Args:
        metrics: of the bag.
        worst: the worst frames, numbered in their order.
        limit: points of a line.
    """
    predicted = _prepared(metrics.series.times, _columns(metrics), limit)
    looked = _prepared(metrics.observed.times, {"processing": 1e3 * metrics.observed.column("processing")}, limit)
    times = metrics.observed.times
    return {
        "times": {"predicted": _values(predicted[0], 8), "frames": _values(looked[0], 8)},
        "range": _range(times),
        "lost": [[round(a, 4), round(b, 4)] for a, b in _bands(metrics.lost)],
        "moments": [
            {"number": number, "time": round(each.time, 4), "error": _rounded(each.error)}
            for number, each in enumerate(worst, 1)
        ],
        "plots": [plot for plot in _plots(metrics, predicted[1], looked[1]) if plot["series"]],
        "map": _map(metrics),
    }


def _range(times: Column) -> list[float]:
    """Return what of the time is shown at first: all, and a second at the least."""
    first, last = (float(times.min()), float(times.max())) if len(times) else (0.0, 1.0)
    room = max(0.0, 0.5 * (MIN_RANGE - (last - first)))
    return [first - room, last + room]


def _bands(lost: Sequence[Sequence[float]]) -> list[list[float]]:
    """Return when the needle was not found; of very many bands those nearest to one another become one."""
    if len(lost) <= MAX_BANDS:
        return [list(band) for band in lost]
    gaps = np.array([after[0] - before[1] for before, after in pairwise(lost)])
    cuts = np.sort(np.argsort(-gaps, kind="stable")[: MAX_BANDS - 1]) + 1
    begins, ends = [0, *cuts.tolist()], [*cuts.tolist(), len(lost)]
    return [[lost[begin][0], lost[end - 1][1]] for begin, end in zip(begins, ends, strict=True)]


def _columns(metrics: RunMetrics) -> dict[str, Column]:
    """Return the columns in the units of the plots: %, mm, µm, ms."""
    table = metrics.series
    scales = {"strain": 100.0, "step_time": 1e3, **{f"{MARGIN}{name}": 1e3 for name in SOLID}}
    scales |= dict.fromkeys(_other_margins(table), 1e6)
    columns = {name: scales.get(name, 1.0) * table.column(name) for name in table.names}
    columns["strain"] = np.maximum(columns["strain"], MIN_STRAIN)
    return columns


def _other_margins(table: TimeSeries) -> list[str]:
    """Return the columns of the margins that are not distances from something solid."""
    solid = {f"{MARGIN}{name}" for name in SOLID}
    return [name for name in table.names if name.startswith(MARGIN) and name not in solid]


def _prepared(times: Column, columns: Mapping[str, Column], limit: int) -> tuple[Column, dict[str, Column]]:
    return with_gaps(*thinned(times, columns, limit))


def _plots(
    metrics: RunMetrics, predicted: Mapping[str, Column], looked: Mapping[str, Column]
) -> Iterable[dict[str, Any]]:
    errors = [(f"error_{target}", f"against {words}", target, "") for target, words in AGAINST.items()]
    errors += [
        (f"recorded_error_{target}", f"recorded, against {words}", target, "dot") for target, words in AGAINST.items()
    ]
    yield {
        "id": "error",
        "y": "error [% of length]",
        "series": _series(predicted, errors),
        "moments": f"error_{metrics.target}",
        "floor": 0.0,
    }
    yield {
        "id": "stretch",
        "y": "stretch [%]",
        "series": _series(predicted, [("strain", "greatest", "ink", "")]),
        "log": True,
    }
    yield {
        "id": "obstacle",
        "y": "distance [mm]",
        "series": _series(
            predicted,
            [(f"{MARGIN}{name}", name, colour, "") for name, colour in zip(SOLID, ("good", "kind5"), strict=True)],
        ),
        "zero": True,
    }
    kinds = [
        (column, column.removeprefix(MARGIN).replace("_", " "), LINE_COLOURS[k % len(LINE_COLOURS)], "")
        for k, column in enumerate(_other_margins(metrics.series))
    ]
    yield {"id": "lengths", "y": "margin [µm]", "series": _series(predicted, kinds), "zero": True}
    yield {
        "id": "pace",
        "y": "time [ms]",
        "series": _series(predicted, [("step_time", "model step", "kind0", "")], dots=True)
        + _series(looked, [("processing", "tracker", "kind1", "")], at="frames", dots=True),
        "log": True,
    }


def _series(
    columns: Mapping[str, Column],
    wanted: Iterable[tuple[str, str, str, str]],
    at: str = "predicted",
    dots: bool = False,
) -> list[dict[str, Any]]:
    """Return the lines that hold any value."""
    return [
        {
            "id": id_,
            "name": name,
            "role": role,
            "dash": dash,
            "at": at,
            "dots": dots,
            "values": _values(columns[id_], DIGITS),
        }
        for id_, name, role, dash in wanted
        if id_ in columns and np.isfinite(columns[id_]).any()
    ]


def _map(metrics: RunMetrics) -> dict[str, Any] | None:
    grid = metrics.error_map.grid() if metrics.error_map is not None else None
    if grid is None:
        return None
    return {
        "times": _values(grid.times, 8),
        "lengths": _values(1e3 * grid.lengths, 6),
        "errors": [_values(row, 4) for row in grid.errors],
    }


def _values(column: Column, digits: int) -> list[float | None]:
    return [_rounded(value, digits) for value in column.tolist()]


def _rounded(value: float, digits: int = DIGITS) -> float | None:
    return float(f"{value:.{digits}g}") if math.isfinite(value) else None
