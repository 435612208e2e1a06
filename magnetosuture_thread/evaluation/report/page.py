"""The report of one bag as a page of HTML that loads nothing, and the data of its plots."""

from __future__ import annotations

import base64
import hashlib
import math
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import datetime, timezone
from functools import cache
from typing import Any

import numpy as np
from jinja2 import Template
from plotly.offline import get_plotlyjs

from magnetosuture_thread.evaluation.frames import MARGIN, Array, ErrorMap, WorstFrame, with_gaps
from magnetosuture_thread.evaluation.metrics import RunMetrics
from magnetosuture_thread.evaluation.plots import ReportPicture
from magnetosuture_thread.evaluation.report import figures as report
from magnetosuture_thread.evaluation.report.figures import AGAINST, STAGES, BagDetails, Figures
from magnetosuture_thread.evaluation.report.template import page_style, read_source, read_template
from magnetosuture_thread.thread.margins import SOLID

SINCE_EPOCH = 1_000_000_000  # s; a bag's time before it is no date
MAX_POINTS = 5000  # of a line
MAX_BANDS = 400  # of times in which the needle was not found
MIN_RANGE = 1.0  # s
MIN_STRAIN = 1e-7  # %, on a scale of powers of ten
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


def write_page(about: BagDetails, metrics: RunMetrics, figures: Figures, pictures: Sequence[ReportPicture]) -> str:
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
    estimation, observed = metrics.estimation, metrics.observed.times
    times, columns = thinned(metrics.series.times, _in_units(metrics), limit)
    tracked_times, tracked = thinned(observed, {"processing": 1e3 * metrics.observed.column("processing")}, limit)
    errors = [
        (f"{kind}error_{target}", f"{name} against {words}", colour, dash)
        for kind, name, colour in ERROR_LINES
        for (target, words), dash in zip(AGAINST.items(), ("", "dot"), strict=True)
    ]
    solid = [(f"{MARGIN}{name}", name, colour, "") for name, colour in zip(SOLID, ("good", "kind5"), strict=True)]
    others = [name for name in columns if name.startswith(MARGIN) and name.removeprefix(MARGIN) not in SOLID]
    margins = [
        (column, column.removeprefix(MARGIN).replace("_", " "), LINE_COLOURS[k % len(LINE_COLOURS)], "")
        for k, column in enumerate(others)
    ]
    durations = _lines(columns, [("step_time", "model step", "kind0", "")], dots=True)
    durations += _lines(tracked, [("processing", "tracker", "kind1", "")], at="frames", dots=True)
    moments = {"moments": f"error_{metrics.target}", "floor": 0.0}
    hidden = _lines(columns if estimation.estimated else {}, [("hidden", "hidden", "kind5", "")])
    windows, consistency, top = _consistency_lines(metrics, columns)
    plots: list[tuple[str, str, list[dict[str, Any]], dict[str, Any]]] = [
        ("error", "error [% of length]", _lines(columns, errors), moments),
        ("consistency", "squared innovation", consistency, {"top": top}),
        ("hidden", "hidden [% of length]", hidden, {"top": 102.0}),
        ("stretch", "stretch [%]", _lines(columns, [("strain", "maximum", "ink", "")]), {"log": True}),
        ("tension", "force [µN]", _lines(columns, FORCE_LINES), {"floor": 0.0}),
        ("obstacle", "distance [mm]", _lines(columns, solid), {"zero": True}),
        ("lengths", "margin [µm]", _lines(columns, margins), {"zero": True}),
        ("pace", "time [ms]", durations, {"log": True}),
    ]
    return {
        "times": {
            name: _values(at, 8)
            for name, at in zip(("predicted", "frames", "windows"), (times, tracked_times, windows), strict=True)
        },
        "range": _range(observed),
        "lost": [[round(a, 4), round(b, 4)] for a, b in _bands(metrics.lost)],
        "moments": [
            {"number": number, "time": round(each.time, 4), "error": _rounded(each.error)}
            for number, each in enumerate(worst, 1)
        ],
        "disturbances": [[round(event.begin_s, 4), round(event.end_s, 4)] for event in estimation.disturbances],
        "plots": [{"id": name, "y": label, "series": lines, **kind} for name, label, lines, kind in plots if lines],
        "map": _map(metrics.error_map),
        "estimate_map": _map(metrics.estimate_map),
    }


def _in_units(metrics: RunMetrics) -> dict[str, Array]:
    """Return the columns of a run in the units of the plots: %, mm, µm, ms, µN."""
    scales = {
        "strain": 100.0,
        "hidden": 100.0,
        "step_time": 1e3,
        **dict.fromkeys(("tension", "pull", "true_pull"), 1e6),
    }
    scales |= {name: 1e6 for name in metrics.series.names if name.startswith(MARGIN)}
    scales |= {f"{MARGIN}{name}": 1e3 for name in SOLID}
    columns = {name: scales.get(name, 1.0) * metrics.series.column(name) for name in metrics.series.names}
    columns["strain"] = np.maximum(columns["strain"], MIN_STRAIN)
    return columns


def _consistency_lines(metrics: RunMetrics, columns: Mapping[str, Array]) -> tuple[Array, list[dict[str, Any]], float]:
    """Return times of the windows, the lines of normalised innovations squared, and the end of their axis."""
    found = metrics.estimation.consistency
    if found is None:
        return np.empty(0), [], 0.0
    shown = {
        name: _paired(each, each) for name, each in (("low", found.low), ("high", found.high), ("mean", found.means))
    }
    names = [
        ("low", "", "estimated", ""),
        ("high", "95 % band of such a mean", "estimated", ""),
        ("mean", f"mean over {found.width:.1f} s", "ink", ""),
    ]
    lines = _lines(columns, [("innovation_squared", "of each frame", "kind5", "")], dots=True)
    lines += _lines(shown, names, at="windows")
    for line in lines:
        line["band"] = line["id"] if line["id"] in ("low", "high") else ""
    frames = float(np.nanpercentile(columns["innovation_squared"], 98))
    return _paired(found.begins, found.ends), lines, round(max(2.5, 1.1 * float(np.nanmax(found.means)), frames), 2)


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
    """Return when the needle was not found, bands that a plot cannot tell apart as one."""
    bands: list[list[float]] = []
    apart = (lost[-1][1] - lost[0][0]) / MAX_BANDS if len(lost) > MAX_BANDS else 0.0
    for begin, end in lost:
        if bands and begin - bands[-1][1] < apart:
            bands[-1][1] = end
        else:
            bands.append([begin, end])
    return bands


def thinned(times: Array, columns: Mapping[str, Array], limit: int) -> tuple[Array, dict[str, Array]]:
    """Return the envelope of columns: of each run of rows the least and the greatest value, with a nan in long gaps.

    Rows are left as they are where there are no more than `limit`. Otherwise each run gives two points, at its first
    time and at its middle, so that all columns share their times and a value is off by less than a run.

    Args:
        times: rising, shape (m,) [s].
        columns: each of shape (m,); nan for none.
        limit: of points, at least 2.
    """
    values = np.array(list(columns.values())).reshape(len(columns), len(times))
    if (count := len(times)) > limit:
        run = -(-count // (limit // 2))
        runs = -(-count // run)
        padded = np.full((len(columns), runs * run), np.nan)
        padded[:, :count] = values
        table = padded.reshape(len(columns), runs, run)
        low, high = np.nan_to_num(table, nan=np.inf).argmin(axis=2), np.nan_to_num(table, nan=-np.inf).argmax(axis=2)
        pair = np.stack([np.minimum(low, high), np.maximum(low, high)], axis=2)
        values = np.take_along_axis(table, pair, axis=2).reshape(len(columns), 2 * runs)
        first = np.arange(runs) * run
        times = _paired(times[first], times[np.minimum(first + run // 2, count - 1)])
    times, values = with_gaps(times, values)
    return times, dict(zip(columns, values, strict=True))


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
