"""The report of one bag as a page of HTML that loads nothing: its data, and the template and style of all reports."""

from __future__ import annotations

import base64
import hashlib
import math
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import datetime, timezone
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np
from jinja2 import Environment, StrictUndefined, Template

from magnetosuture_thread.evaluation import figures as report
from magnetosuture_thread.evaluation.figures import AGAINST, COLOURS, STAGES, BagDetails, Figures
from magnetosuture_thread.evaluation.frames import MARGIN, Array, ErrorMap, WorstFrame, with_gaps
from magnetosuture_thread.evaluation.metrics import Consistency, Percentiles, RunMetrics
from magnetosuture_thread.settings.errors import printable
from magnetosuture_thread.thread.margins import SOLID

if TYPE_CHECKING:
    from magnetosuture_thread.evaluation.plots import ReportPicture

MAX_POINTS = 5000  # of a line

Line = tuple[str, str, str, str, float]  # column, name, colour, dash, scale to the axis's unit


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
        metrics=metrics,
        estimation=metrics.estimation,
        headlines=report.headlines(about, figures),
        pictures=pictures,
        data={"simulated": bool(about.simulated), **page_data(metrics, [picture.worst for picture in pictures])},
        reasons=metrics.reasons.most_common(),
        against=AGAINST,
        times=[
            ("model step", metrics.percentiles("step_time")),
            ("tracker, one frame", Percentiles.of(metrics.observed.column("processing"))),
        ],
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
    from plotly.offline import get_plotlyjs  # late, as other reports draw nothing with it

    library = get_plotlyjs()
    return base64.b64encode(zlib.compress(library.encode(), 9)).decode(), library


def _hash(script: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()


def _date(start: int) -> str:
    """Return when a bag was recorded; empty if its clock does not say: before 2001 it is no date."""
    if start < 10**18:
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
    series, observed, estimation = metrics.series, metrics.observed, metrics.estimation
    times, columns = thinned(series.times, {name: series.column(name) for name in series.names}, limit)
    frames, tracked = thinned(observed.times, {"processing": observed.column("processing")}, limit)
    threads = [("estimate_", "estimate", "estimated"), ("", "prediction", "predicted")]
    errors = [
        (f"{prefix}error_{target}", f"{name} against {words}", colour, dash, 1.0)
        for prefix, name, colour in [*threads, ("recorded_", "recorded prediction", "kind5")]
        for (target, words), dash in zip(AGAINST.items(), ("", "dot"), strict=True)
    ]
    solid = [(f"{MARGIN}{name}", name, colour, "", 1e3) for name, colour in zip(SOLID, ("good", "kind5"), strict=True)]
    others = [name for name in columns if name.startswith(MARGIN) and name.removeprefix(MARGIN) not in SOLID]
    margins = [
        (column, column.removeprefix(MARGIN).replace("_", " "), f"kind{(0, 1, 3, 4)[k % 4]}", "", 1e6)
        for k, column in enumerate(others)
    ]
    forces = [
        ("tension", "peak tension", "predicted", "", 1e6),
        ("pull", "pull upon the needle", "ink", "", 1e6),
        ("true_pull", "the same by the ground truth", "good", "dot", 1e6),
    ]
    durations = _lines(columns, [("step_time", "model step", "kind0", "", 1e3)], dots=True)
    durations += _lines(tracked, [("processing", "tracker", "kind1", "", 1e3)], at="frames", dots=True)
    hidden = [("hidden", "hidden", "kind5", "", 100.0)] if estimation.estimated else []
    windows, consistency, top = _consistency_lines(estimation.consistency, columns)
    moments = {"moments": f"error_{metrics.target}", "floor": 0.0}
    plots: list[tuple[str, str, list[dict[str, Any]], dict[str, Any]]] = [
        ("error", "error [% of length]", _lines(columns, errors), moments),
        ("consistency", "squared innovation", consistency, {"top": top}),
        ("hidden", "hidden [% of length]", _lines(columns, hidden), {"top": 102.0}),
        ("stretch", "stretch [%]", _lines(columns, [("strain", "maximum", "ink", "", 100.0)]), {"log": True}),
        ("tension", "force [µN]", _lines(columns, forces), {"floor": 0.0}),
        ("obstacle", "distance [mm]", _lines(columns, solid), {"zero": True}),
        ("lengths", "margin [µm]", _lines(columns, margins), {"zero": True}),
        ("pace", "time [ms]", durations, {"log": True}),
    ]
    first, last = float(observed.times.min(initial=math.inf)), float(observed.times.max(initial=-math.inf))
    return {
        "times": {"predicted": _values(times, 8), "frames": _values(frames, 8), "windows": _values(windows, 8)},
        "range": [first, max(last, first + 1.0)] if len(observed) else [0.0, 1.0],
        "lost": [[round(a, 4), round(b, 4)] for a, b in metrics.lost],
        "moments": [
            {"number": number, "time": round(each.time, 4), "error": _rounded(each.error)}
            for number, each in enumerate(worst, 1)
        ],
        "disturbances": [[round(event.begin_s, 4), round(event.end_s, 4)] for event in estimation.disturbances],
        "plots": [{"id": name, "y": label, "series": lines, **kind} for name, label, lines, kind in plots if lines],
        "map": _map(metrics.error_map()),
        "estimate_map": _map(metrics.error_map("estimate")),
    }


def _consistency_lines(
    found: Consistency | None, columns: Mapping[str, Array]
) -> tuple[Array, list[dict[str, Any]], float]:
    """Return times of the windows, the lines of normalised innovations squared, and the end of their axis."""
    if found is None:
        return np.empty(0), [], 0.0
    bounds = {name: _paired(each, each) for name, each in (("low", found.low), ("high", found.high))}
    lines = _lines(columns, [("innovation_squared", "of each frame", "kind5", "", 1.0)], dots=True)
    band = [("low", "", "estimated", "", 1.0), ("high", "95 % band of such a mean", "estimated", "", 1.0)]
    lines += [{**line, "band": line["id"]} for line in _lines(bounds, band, at="windows")]
    mean = [("mean", f"mean over {found.width:.1f} s", "ink", "", 1.0)]
    lines += _lines({"mean": _paired(found.means, found.means)}, mean, at="windows")
    top = max(2.5, 1.1 * float(np.nanmax(found.means)), float(np.nanpercentile(columns["innovation_squared"], 98)))
    return _paired(found.begins, found.begins + found.width), lines, round(top, 2)


def _paired(first: Array, second: Array) -> Array:
    """Return two columns as one, in turns."""
    return np.column_stack([first, second]).ravel()


def _map(errors: ErrorMap | None) -> dict[str, Any] | None:
    if errors is None or (grid := errors.grid()) is None:
        return None
    times, lengths, values = grid
    rows = [_values(row, 4) for row in values]
    return {"times": _values(times, 8), "lengths": _values(1e3 * lengths, 6), "errors": rows}


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
        first = np.arange(0, count, run)
        low, high = (extreme.reduceat(values, first, axis=1) for extreme in (np.fmin, np.fmax))  # nan if all are
        values = np.stack([low, high], axis=2).reshape(len(columns), 2 * len(first))
        times = _paired(times[first], times[np.minimum(first + run // 2, count - 1)])
    times, values = with_gaps(times, values)
    return times, dict(zip(columns, values, strict=True))


def _lines(
    columns: Mapping[str, Array], wanted: Iterable[Line], at: str = "predicted", dots: bool = False
) -> list[dict[str, Any]]:
    """Return the lines that hold any value."""
    return [
        dict(id=name, name=label, role=role, dash=dash, at=at, dots=dots, values=_values(scale * columns[name], 5))
        for name, label, role, dash, scale in wanted
        if name in columns and np.isfinite(columns[name]).any()
    ]


def _values(column: Array, digits: int) -> list[float | None]:
    return [_rounded(value, digits) for value in column.tolist()]


def _rounded(value: float, digits: int = 5) -> float | None:
    return float(f"{value:.{digits}g}") if math.isfinite(value) else None


def read_template(package: str, name: str, functions: Mapping[str, Callable[..., Any]]) -> Template:
    """Return a template that ships with a subpackage, in which texts are escaped and nothing may be undefined.

    Args:
        package: name of the subpackage.
        name: of the file.
        functions: that the template uses as filters or calls, by name.
    """
    environment = Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined, finalize=_shown
    )
    environment.filters.update(functions)
    environment.globals.update(functions)
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    return environment.from_string(read_source(package, name))


def read_source(package: str, name: str) -> str:
    """Return a file that ships with a subpackage."""
    return files(package).joinpath(name).read_text(encoding="utf-8")


def _shown(value: Any) -> Any:
    """Return what the page gets for a value: of a text from outside, what can be shown."""
    return printable(value) if type(value) is str else value  # not Markup, which is ours


@cache
def page_style() -> str:
    """Return the style sheet of all reports: the colours as variables, `--measured` and the others, and the rest."""
    light, dark = (" ".join(f"--{name}: {pair[ground]};" for name, pair in COLOURS.items()) for ground in (0, 1))
    colours = f":root {{ {light} }}\n@media screen and (prefers-color-scheme: dark) {{ :root {{ {dark} }} }}\n"
    return colours + read_source(__package__, "page.css")
