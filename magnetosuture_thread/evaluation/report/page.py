"""The report of one bag as a page of HTML that loads nothing, and the data of its plots."""

from __future__ import annotations

import base64
import hashlib
import math
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import datetime, timezone
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
from jinja2 import Template
from plotly.offline import get_plotlyjs

from magnetosuture_thread.evaluation.error_map import ErrorMap
from magnetosuture_thread.evaluation.frames import MARGIN, Array, WorstFrame
from magnetosuture_thread.evaluation.metrics import RunMetrics
from magnetosuture_thread.evaluation.report import figures as report
from magnetosuture_thread.evaluation.report.figures import AGAINST, STAGES, BagDetails, BagFigures
from magnetosuture_thread.evaluation.report.pictures import ReportPicture
from magnetosuture_thread.evaluation.report.template import page_style, read_source, read_template
from magnetosuture_thread.model.margins import SOLID

SINCE_EPOCH = 1_000_000_000  # s; a bag's time before it is no date
MAX_POINTS = 5000  # of a line
MAX_BANDS = 400
MIN_RANGE = 1.0  # s
MIN_STRAIN = 1e-7  # %, on a scale of powers of ten
LINE_GAP = 5.0  # times the usual interval; a line is broken where nothing came for longer
DIGITS = 5  # of a value in the page
LINE_COLOURS = ("kind0", "kind1", "kind3", "kind4")  # of the page

ERROR_LINES = (
    ("estimate_", "estimate", "estimated"),
    ("", "prediction", "predicted"),
    ("recorded_", "recorded prediction", "kind5"),
)

FORCE_LINES = (
    ("tension", "peak tension", "predicted", ""),
    ("pull", "pull upon the needle", "ink", ""),
    ("true_pull", "the same by the ground truth", "good", "dot"),
)

Line = tuple[str, str, str, str]  # column, name, colour, dash


def write_page(about: BagDetails, metrics: RunMetrics, figures: BagFigures, pictures: Sequence[ReportPicture]) -> str:
    """Return the page.

    It loads nothing: style, script, plots' library, data and pictures are in it, and its own policy forbids the browser
    to load anything or to run a script that is not one of its two. Whatever is said in a bag is shown as text.

    Args:
        about: the bag.
        metrics: its columns.
        figures: of it.
        pictures: of the worst frames, the worst first.
    """
    packed, library = _library()
    script = read_source(__package__, "page.js")
    return _template().render(
        about=about,
        figures=figures,
        headlines=report.headlines(about, figures),
        pictures=pictures,
        data={"simulated": bool(about.simulated), **page_data(metrics, [picture.worst for picture in pictures])},
        reasons=metrics.reasons.most_common(),
        against=AGAINST,
        times=[("model step", figures.step_time), ("tracker, one frame", figures.processing)],
        stages=STAGES,
        recorded=_date(about.start),
        style=page_style(),
        script=script,
        library=packed,
        hashes=" ".join(f"'{_hash(text)}'" for text in (script, library)),
    )


@cache
def _template() -> Template:
    functions: dict[str, Callable[..., Any]] = {
        "number": report.format_number,
        "milliseconds": report.milliseconds,
        "micrometres": report.micrometres,
        "micronewtons": report.micronewtons,
        "margin_state": report.margin_state,
    }
    return read_template(__package__, "page.html", functions)


@cache
def _library() -> tuple[str, str]:
    """Return plotly.js, packed to two fifths of its size and in letters, and as it is."""
    library = get_plotlyjs()
    return base64.b64encode(zlib.compress(library.encode(), 9)).decode(), library


def _hash(script: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()


def _date(start: int) -> str:
    """Return when a bag was recorded; empty if its clock does not say."""
    if start < SINCE_EPOCH * 10**9:
        return ""
    return datetime.fromtimestamp(start // 10**9, timezone.utc).strftime("%Y-%m-%d %H:%M:%S UTC")


def page_data(metrics: RunMetrics, worst: Sequence[WorstFrame], limit: int = MAX_POINTS) -> dict[str, Any]:
    """Return everything that the page's script draws.

    Times in s since the bag's start; `null` where there is no value.

    Args:
        metrics: of the bag.
        worst: the worst frames, numbered in their order.
        limit: points of a line.
    """
    table, times = metrics.series, metrics.observed.times
    solid = [f"{MARGIN}{name}" for name in SOLID]
    others = [name for name in table.names if name.startswith(MARGIN) and name not in solid]
    # In the units of the plots: %, mm, µm, ms.
    scales = {
        "strain": 100.0,
        "step_time": 1e3,
        "tension": 1e6,
        "pull": 1e6,
        "true_pull": 1e6,
        **dict.fromkeys(solid, 1e3),
        **dict.fromkeys(others, 1e6),
    }
    columns = {name: scales.get(name, 1.0) * table.column(name) for name in table.names}
    columns["strain"] = np.maximum(columns["strain"], MIN_STRAIN)
    predicted_times, predicted = with_gaps(*thinned(table.times, columns, limit))
    tracked = {"processing": 1e3 * metrics.observed.column("processing")}
    frame_times, tracked = with_gaps(*thinned(times, tracked, limit))

    errors = [
        (f"{kind}error_{target}", f"{name} against {words}", colour, dash)
        for kind, name, colour in ERROR_LINES
        for (target, words), dash in zip(AGAINST.items(), ("", "dot"), strict=True)
    ]
    distances = [(f"{MARGIN}{name}", name, colour, "") for name, colour in zip(SOLID, ("good", "kind5"), strict=True)]
    margins = [
        (column, column.removeprefix(MARGIN).replace("_", " "), LINE_COLOURS[k % len(LINE_COLOURS)], "")
        for k, column in enumerate(others)
    ]
    durations = _lines(predicted, [("step_time", "model step", "kind0", "")], dots=True)
    durations += _lines(tracked, [("processing", "tracker", "kind1", "")], at="frames", dots=True)
    plots: list[tuple[str, str, list[dict[str, Any]], dict[str, Any]]] = [
        (
            "error",
            "error [% of length]",
            _lines(predicted, errors),
            {"moments": f"error_{metrics.target}", "floor": 0.0},
        ),
        *_estimation_plots(metrics, predicted),
        ("stretch", "stretch [%]", _lines(predicted, [("strain", "maximum", "ink", "")]), {"log": True}),
        ("tension", "force [µN]", _lines(predicted, FORCE_LINES), {"floor": 0.0}),
        ("obstacle", "distance [mm]", _lines(predicted, distances), {"zero": True}),
        ("lengths", "margin [µm]", _lines(predicted, margins), {"zero": True}),
        ("pace", "time [ms]", durations, {"log": True}),
    ]
    consistency = metrics.estimation.consistency
    windows = np.empty(0) if consistency is None else _paired(consistency.begins, consistency.ends)
    return {
        "times": {
            "predicted": _values(predicted_times, 8),
            "frames": _values(frame_times, 8),
            "windows": _values(windows, 8),
        },
        "range": _range(times),
        "lost": [[round(a, 4), round(b, 4)] for a, b in _bands(metrics.lost)],
        "moments": [
            {"number": number, "time": round(each.time, 4), "error": _rounded(each.error)}
            for number, each in enumerate(worst, 1)
        ],
        "disturbances": [
            [round(event.begin_s, 4), round(event.end_s, 4)] for event in metrics.disturbances.events[:MAX_BANDS]
        ],
        "plots": [{"id": name, "y": label, "series": lines, **kind} for name, label, lines, kind in plots if lines],
        "map": _map(metrics.error_map),
        "estimate_map": _map(metrics.estimate_map),
    }


def _estimation_plots(
    metrics: RunMetrics, columns: Mapping[str, Array]
) -> list[tuple[str, str, list[dict[str, Any]], dict[str, Any]]]:
    """Return the plots of the estimate: its consistency, and how much of the thread was hidden."""
    found = metrics.estimation
    plots: list[tuple[str, str, list[dict[str, Any]], dict[str, Any]]] = []
    if (consistency := found.consistency) is not None:
        low, high, mean = (_paired(each, each) for each in (consistency.low, consistency.high, consistency.means))
        lines = _lines(columns, [("innovation_squared", "of each frame", "kind5", "")], dots=True)
        shown = {"low": low, "high": high, "mean": mean}
        band, mean_name = "95 % band of such a mean", f"mean over {consistency.width:.1f} s"
        names = [("low", "", "estimated", ""), ("high", band, "estimated", ""), ("mean", mean_name, "ink", "")]
        lines += _lines(shown, names, at="windows")
        for line in lines:
            line["band"] = line["id"] if line["id"] in ("low", "high") else ""
        top = max(
            2.5, 1.1 * float(np.nanmax(consistency.means)), float(np.nanpercentile(columns["innovation_squared"], 98))
        )
        plots.append(("consistency", "squared innovation", lines, {"top": round(top, 2)}))
    if found.estimated:
        hidden = {"hidden": 100.0 * columns["hidden"]}
        lines = _lines(hidden, [("hidden", "hidden", "kind5", "")])
        plots.append(("hidden", "hidden [% of length]", lines, {"top": 102.0}))
    return plots


def _paired(first: Array, second: Array) -> Array:
    """Return two columns as one, in turns."""
    return np.column_stack([first, second]).ravel()


def _map(errors: ErrorMap | None) -> dict[str, Any] | None:
    grid = errors.grid() if errors is not None else None
    if grid is None:
        return None
    return {
        "times": _values(grid.times, 8),
        "lengths": _values(1e3 * grid.lengths, 6),
        "errors": [_values(row, 4) for row in grid.errors],
    }


def _range(times: Array) -> list[float]:
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


def thinned(times: Array, columns: Mapping[str, Array], limit: int) -> tuple[Array, dict[str, Array]]:
    """Return the envelope of columns: of each run of rows the least and the greatest value, in the order they came.

    Rows are left as they are where there are no more than `limit`. Otherwise each run gives two points, at its first
    time and at its middle, so that all columns share their times and a value is off by less than a run.

    Args:
        times: rising, shape (m,) [s].
        columns: each of shape (m,); nan for none.
        limit: of points, at least 2.
    """
    count = len(times)
    if count <= limit:
        return times, dict(columns)
    run = -(-count // (limit // 2))
    runs = -(-count // run)
    first = np.arange(runs) * run
    at = np.column_stack([times[first], times[np.minimum(first + run // 2, count - 1)]]).ravel()
    return at, {name: _extremes(column, run, runs) for name, column in columns.items()}


def _extremes(column: Array, run: int, runs: int) -> Array:
    padded = np.full(run * runs, np.nan)
    padded[: len(column)] = column
    table = padded.reshape(runs, run)
    none = np.isnan(table)
    low = np.argmin(np.where(none, np.inf, table), axis=1)
    high = np.argmax(np.where(none, -np.inf, table), axis=1)
    pair = np.column_stack([np.minimum(low, high), np.maximum(low, high)])
    return np.take_along_axis(table, pair, axis=1).ravel()


def with_gaps(times: Array, columns: Mapping[str, Array]) -> tuple[Array, dict[str, Array]]:
    """Return columns with a nan in each long gap, so that no line is drawn over a time of which nothing is known."""
    if len(times) < 3:
        return times, dict(columns)
    steps = np.diff(times)
    gaps = np.flatnonzero(steps > LINE_GAP * float(np.median(steps))) + 1
    middles = 0.5 * (times[gaps - 1] + times[gaps])
    return np.insert(times, gaps, middles), {name: np.insert(column, gaps, np.nan) for name, column in columns.items()}


def _lines(
    columns: Mapping[str, Array], wanted: Iterable[Line], at: str = "predicted", dots: bool = False
) -> list[dict[str, Any]]:
    """Return the lines that hold any value."""
    return [
        dict(id=name, name=label, role=role, dash=dash, at=at, dots=dots, values=_values(columns[name], DIGITS))
        for name, label, role, dash in wanted
        if name in columns and np.isfinite(columns[name]).any()
    ]


def _values(column: Array, digits: int) -> list[float | None]:
    return [_rounded(value, digits) for value in column.tolist()]


def _rounded(value: float, digits: int = DIGITS) -> float | None:
    return float(f"{value:.{digits}g}") if math.isfinite(value) else None
