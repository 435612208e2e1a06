"""Tables of evaluations, replays and closed loops: for a terminal, and over many bags as CSV and JSON."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np
from rich.table import Table
from rich.text import Text

from magnetosuture_thread.barrier import BUILT_IN
from magnetosuture_thread.evaluation.estimation import EstimationFigures, compare_errors
from magnetosuture_thread.evaluation.frames import TimeSeries
from magnetosuture_thread.evaluation.graph_outputs import LoopSummary, ReplaySummary
from magnetosuture_thread.evaluation.metrics import Percentiles, finite_or_none
from magnetosuture_thread.evaluation.reference_scores import Evaluation
from magnetosuture_thread.evaluation.report.figures import (
    AGAINST,
    STAGES,
    BagDetails,
    BagFigures,
    format_number,
    micrometres,
    micronewtons,
    milliseconds,
)
from magnetosuture_thread.texts import printable

Value: TypeAlias = "str | int | float | None"
Row: TypeAlias = "dict[str, Value | dict[str, Any]]"

ERRORS = {"mean": "mean", "median": "median", "p99": "p99", "maximum": "max"}
SIMULATED, UNVERIFIED, SILENT = "*", "?", "!"  # marks of a bag
FORMULA = ("=", "+", "-", "@", "\t", "\r")  # what a spreadsheet takes the beginning of a formula for


def row_of(about: BagDetails, figures: BagFigures) -> Row:
    """Return the row of an evaluated bag: SI units and %, as the columns' names say; None where there is no value.

    `prediction`, `estimate` and `consistency` are mappings; in a table they are a column for each of their values.
    """
    row: Row = {
        "bag": about.name,
        "path": about.path,
        "setup": about.setup,
        "simulated": about.simulated,
        "source": about.source,
        "formulation": about.formulation,
        "duration_s": about.duration,
        "frames": figures.frames,
        "tracked": figures.tracked,
        "predicted": figures.predicted,
        "silent_s": figures.silence.total,
        "max_silence_s": figures.silence.max_gap,
        "silences": figures.silence.gaps,
    }
    for prefix, errors in (("error", figures.error), ("recorded_error", figures.recorded_error)):
        for target in AGAINST:
            found = errors.get(target) or {}
            row[f"{prefix}_{target}_frames"] = found.get("count", 0)
            row |= {f"{prefix}_{target}_{short}_percent": found.get(name) for name, short in ERRORS.items()}
    row |= {kind: dict(errors) for kind, errors in figures.compared.items()} | figures.estimation.to_json()
    row |= {
        "seen_share": figures.measured_share,
        "stretch_max": figures.strain,
        "residual_max": figures.residual,
        "tension_max_n": figures.tension,
        "needle_pull_max_n": figures.pull,
        "needle_pull_error_percent": figures.pull_error,
        "contact_frames": figures.contact_frames,
    }
    for barrier in BUILT_IN:
        row[f"least_{barrier}_m"] = figures.minimum[barrier].clearance if barrier in figures.minimum else None
    added = [f"{name}: {margin.clearance:.3e}" for name, margin in figures.minimum.items() if name not in BUILT_IN]
    row["least_added_m"] = "; ".join(added) or None
    row |= _percentiles("step", figures.step_time) | _percentiles("tracker", figures.processing)
    for stage in STAGES:
        row |= _percentiles(f"latency_{stage.replace(' ', '_')}", figures.live.latency.get(stage))
    row |= {"damage": "; ".join(about.damage), "unverified": about.unverified}
    row |= {"refused": sum(about.refused.values()), "problem": ""}
    return {column: finite_or_none(value) for column, value in row.items()}


def failed_row(name: str, path: str, problem: str) -> Row:
    """Return the row of a bag that could not be evaluated."""
    row: Row = {key: dict.fromkeys(value) if isinstance(value, dict) else None for key, value in _EMPTY.items()}
    row |= dict.fromkeys(("setup", "simulated", "source", "formulation", "damage", "unverified"), "")
    return row | {"bag": name, "path": path, "problem": problem}


def _percentiles(name: str, found: Percentiles | None) -> Row:
    return {f"{name}_median_s": found.median if found else None, f"{name}_p99_s": found.p99 if found else None}


_NOTHING = BagFigures(0, 0, 0, {}, {}, "", math.nan, math.nan, math.nan, {}, 0, None, None, math.nan)
_EMPTY = row_of(BagDetails("", "", ""), _NOTHING)
COLUMNS = tuple(_EMPTY)
TIMES = tuple(column for column in COLUMNS if column.startswith(("step_", "tracker_")))  # differ from run to run


def table_csv(rows: Sequence[Row]) -> str:
    """Return the table as CSV (RFC 4180), with all digits; an empty cell where there is no value.

    A text that a spreadsheet would take for a formula gets an apostrophe before it.
    """
    stream = io.StringIO(newline="")
    writer = csv.writer(stream, lineterminator="\r\n")
    writer.writerow(flat(_EMPTY))
    for row in rows:
        writer.writerow([_cell(value) for value in flat(row).values()])
    return stream.getvalue()


def flat(row: Row) -> dict[str, Value]:
    """Return a row with a column for each value of its mappings, `estimate_error_measured_mean_percent` for example."""
    columns: dict[str, Value] = {}
    for name, value in row.items():
        columns |= {f"{name}_{key}": own for key, own in value.items()} if isinstance(value, dict) else {name: value}
    return columns


def _cell(value: Value) -> Value:
    if not isinstance(value, str):
        return value
    return f"'{printable(value)}" if value.startswith(FORMULA) else printable(value)


def table_json(rows: Sequence[Row]) -> str:
    """Return the table as JSON.

    `bags` is a list of rows, `mean` and `worst` are over the mean errors of the bags that were evaluated, and
    `prediction` and `estimate` have the names of those of a bag: means of means, and maxima of maxima.
    """
    return json.dumps({"bags": list(rows), **totals(rows), **compared(rows)}, indent=2, allow_nan=False) + "\n"


def compared(rows: Sequence[Row]) -> dict[str, dict[str, float | None]]:
    """Return the errors of `prediction` and `estimate` over bags; None where no bag has any."""
    found: dict[str, dict[str, float | None]] = {}
    for kind, errors in compare_errors(TimeSeries([])).items():
        found[kind] = {}
        for name in errors:
            values = [own[name] for row in rows if isinstance(own := row[kind], dict) and own[name] is not None]
            whole = np.mean if name.endswith("_mean_percent") else np.max
            found[kind][name] = float(whole(values)) if values else None
    return found


def totals(rows: Sequence[Row]) -> dict[str, Any]:
    """Return mean and worst over bags of their mean errors, by the column's name; None where no bag has any."""
    columns = [f"error_{target}_mean_percent" for target in AGAINST]
    values = {column: _numbers(rows, column) for column in columns}
    return {
        "mean": {column: float(np.mean(own)) if own else None for column, own in values.items()},
        "worst": {column: max(own, default=None) for column, own in values.items()},
    }


def _numbers(rows: Sequence[Row], column: str) -> list[float]:
    return [float(value) for row in rows if isinstance(value := row[column], (int, float))]


def bags_table(rows: Sequence[Row]) -> Table:
    """Return the table for a terminal: the figures that matter most, and mean and worst."""
    table = Table(
        title="1 bag" if len(rows) == 1 else f"{len(rows)} bags",
        show_edge=False,  # which keeps it within 80 columns
        title_justify="left",
        title_style="bold",
        caption_justify="left",
    )
    table.caption = (
        "errors in % of the length, mean and maximum over time, of the estimate,\n"
        "and below of the prediction; margin: the minimum of an obstacle;\n"
        "step: median of the model's"
    )
    if any(row["simulated"] for row in rows):
        table.caption += f";\n{SIMULATED} simulated, as the bag itself says"
    if any(row["unverified"] for row in rows):
        table.caption += f";\n{UNVERIFIED} unverified: damaged, and nothing vouches for its messages"
    silent = [(silent_s, longest) for silent_s, longest in map(_silence, rows) if silent_s]
    if silent:
        total, longest = sum(each for each, _ in silent), max(longest for _, longest in silent)
        table.caption += f";\n{SILENT} without frames for {total:.1f} s in all, {longest:.1f} s at the longest"
    table.add_column("bag", overflow="fold", min_width=10)
    for name in ("frames", "ground\ntruth", "max", "measured", "max", "margin", "step"):
        table.add_column(name, justify="right", no_wrap=True)
    for row in rows:
        if row["problem"]:
            table.add_row(Text(str(row["bag"])), Text("failed", style="bold red"))
            continue
        marks_of = ((SIMULATED, "simulated"), (UNVERIFIED, "unverified"), (SILENT, "silences"))
        marks = [mark for mark, why in marks_of if row[why]]
        table.add_row(
            Text(" ".join([str(row["bag"]), *marks])),
            f"{row['predicted']}/{row['frames']}",
            *_errors_shown(row["estimate"]),
            _shown(row["least_obstacle_m"], micrometres),
            _shown(row["step_median_s"], milliseconds),
        )
        errors = [row[f"error_{target}_{which}_percent"] for target in AGAINST for which in ("mean", "max")]
        table.add_row(Text(" predicted", style="dim"), "", *(_shown(error, format_number) for error in errors))
    table.add_section()
    found = compared(rows)
    table.add_row("all bags", "", *_errors_shown(found["estimate"]))
    table.add_row(Text(" predicted", style="dim"), "", *_errors_shown(found["prediction"]))
    return table


def _errors_shown(errors: Any) -> list[str]:
    names = [f"error_{name}_{which}_percent" for name in ("ground_truth", "measured") for which in ("mean", "max")]
    return [_shown(errors[name], format_number) for name in names]


def _silence(row: Row) -> tuple[float, float]:
    total, longest = (own if isinstance(own := row[name], float) else 0.0 for name in ("silent_s", "max_silence_s"))
    return total, longest


def _shown(value: Any, how: Callable[[float], str]) -> str:
    return "" if value is None else how(value)


def summary_table(summary: ReplaySummary) -> Table:
    """Return the figures of a replayed bag as a table."""
    table = _figures_table(f"{summary.bag}, setup {summary.setup}")
    live, by_camera = summary.speed is None, summary.source == "camera"
    simulated = "simulated" if summary.simulated else ""
    table.add_row("camera frames" if by_camera else "recorded poses", str(summary.frames), simulated)
    table.add_row(
        "  tracked" if by_camera else "  usable", str(summary.tracked), _share(summary.tracked, summary.frames)
    )
    table.add_row("  predicted", str(summary.predicted), _share(summary.predicted, summary.frames))
    for why, count in summary.refused.items():
        table.add_row("  not used", str(count), why)
    if live:
        table.add_row("velocity commands", str(summary.commands), simulated)
        table.add_row("  reached the coils", str(summary.driven), _share(summary.driven, summary.commands))
        table.add_row("messages dropped", str(sum(summary.dropped.values())), "of those played")
        for way, count in summary.dropped.items():
            if count:
                table.add_row("  dropped", str(count), way)
    if summary.damage:
        table.add_row("the bag is damaged", "", summary.damage)
    if summary.unverified:
        table.add_row("the bag is unverified", "", summary.unverified)
    if summary.remark:
        table.add_row("setup in doubt", "", summary.remark)
    table.add_section()
    table.add_row("latency, median" if live else "times, median", "", "99th percentile, maximum")
    for stage, found in summary.latency.items():
        table.add_row(f"  {stage}", _milliseconds(found), _tail(found))
    table.add_row("  model step alone", _milliseconds(summary.step_time), _tail(summary.step_time))
    if summary.speed is not None:
        table.add_row("speed", f"{summary.speed:.3g}", "times as fast as recorded")
    table.add_section()
    table.add_row("minimum margin", "", "0 or more is safe; lengths are met to 0.1 %")
    for margin in summary.least_margins:
        where = f"node {margin.node}" + (f", obstacle {margin.obstacle}" if margin.obstacle >= 0 else "")
        table.add_row(f"  {margin.kind}", f"{_micrometres(margin.clearance)} µm", f"{where}, at {margin.time:.2f} s")
    table.add_row("frames in contact", str(summary.contact_frames), _share(summary.contact_frames, summary.predicted))
    table.add_row("maximum stretch", f"{100.0 * summary.stretch:.1e} %", "of a segment")
    if summary.peak_tension is not None and summary.needle_pull is not None:
        pull = f"on the needle at most {micronewtons(summary.needle_pull)}"
        table.add_row("peak tension", micronewtons(summary.peak_tension), pull)
    table.add_row("maximum residual", f"{summary.residual:.1e}", "scaled; checked apart from the solver")
    table.add_section()
    _add_errors(table, summary, missing="no frame could be scored")
    _add_estimation(table, summary.estimation)
    if (apart := summary.currents) is not None:
        table.add_section()
        tail = f"{apart.p99:.2f}, {apart.greatest:.2f} A; recorded: {apart.recorded:.2f} A rms"
        table.add_row("currents off the recorded", f"{apart.difference:.3f} A", tail)
        table.add_row("  stopped in one only", f"{100.0 * apart.stopped_apart:.1f} %", f"of {apart.compared}")
    return table


def loop_table(summary: LoopSummary) -> Table:
    """Return the figures of a closed loop as a table."""
    table = _figures_table(f"{summary.setup}, closed loop, simulated")
    table.add_row("camera frames", str(summary.frames), f"over {summary.duration:.1f} s of steering")
    table.add_row("  skipped", str(summary.skipped), "the rig had no time for them")
    table.add_row("  tracked", str(summary.tracked), f"{summary.lost} looked at and lost")
    table.add_row("  wrong poses", str(summary.wrong), "more than 0.3 mm or 5 degrees from the ground truth")
    table.add_row("  predicted", str(summary.predicted), _share(summary.predicted, summary.frames))
    table.add_section()
    table.add_row("needle from its path", f"{1e3 * summary.path_error:.3f} mm", _greatest(summary.path_error_greatest))
    table.add_row("tracked tail from the ground truth", f"{1e3 * summary.tail_error:.3f} mm", "RMS")
    heading = math.degrees(summary.heading_error)
    table.add_row("tracked heading", f"{heading:.2f} deg", "RMS")
    table.add_row("currents at a limit", f"{100.0 * summary.saturated:.1f} %", "of the commands")
    table.add_section()
    table.add_row("latency from the frame's stamp", "", "99th percentile, maximum")
    for name, found in summary.latency.items():
        table.add_row(f"  to {name}", _milliseconds(found), _tail(found))
    table.add_row("  tracker alone", _milliseconds(summary.processing), _tail(summary.processing))
    table.add_row("  model step alone", _milliseconds(summary.step_time), _tail(summary.step_time))
    table.add_section()
    _add_errors(table, summary)
    return table


def evaluation_table(evaluation: Evaluation) -> Table:
    """Return the scores of a set of trajectories as a table that fits 80 columns."""
    title = f"formulation {evaluation.formulation}, solver {evaluation.solver}"
    table = Table(title=title, title_justify="left", title_style="bold", caption_justify="left")
    residual = max(case.max_residual for case in evaluation.cases)
    marked = sum(case.fallbacks for case in evaluation.cases)
    table.caption = (
        "errors in % of the length, mean and maximum over time; stretch in %;\n"
        "deepest node in an obstacle in m; step in µs of wall clock, median and p99;\n"
        f"largest residual {residual:.0e}, {marked} steps fell back or did not converge"
    )
    table.add_column("case", no_wrap=True)
    for name in ("error", "maximum", "stretch", "depth", "step", "p99"):
        table.add_column(name, justify="right", no_wrap=True)
    for case in evaluation.cases:
        table.add_row(
            case.name,
            f"{case.mean_error_percent:.3f}",
            f"{case.max_error_percent:.3f}",
            f"{100.0 * case.max_stretch:.3f}",
            f"{case.max_penetration_m:.0e}" if case.max_penetration_m else "none",
            f"{1e6 * case.step_median_s:.0f}",
            f"{1e6 * case.step_p99_s:.0f}",
        )
    table.add_section()
    table.add_row("mean of the cases", f"{evaluation.mean_error_percent:.3f}")
    table.add_row("worst case", f"{evaluation.worst_error_percent:.3f}")
    return table


def _figures_table(title: str) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold")
    table.add_column("", no_wrap=True)
    table.add_column("value", justify="right", no_wrap=True)
    table.add_column("remark", style="dim")
    return table


def _add_errors(table: Table, summary: ReplaySummary | LoopSummary, missing: str = "") -> None:
    curves = (
        ("measured centreline", "measured", summary.error_seen),
        ("ground truth", "ground_truth", summary.error_truth),
    )
    table.add_row("thread measured, mean", f"{100.0 * summary.seen_share:.1f} %", "of its length")
    table.add_row("prediction error, mean", "", "maximum; % of the length")
    if summary.error_seen is None and missing:
        table.add_row("  against the measured centreline", "none", missing)
    for title, _, figures in curves:
        if figures is not None:
            scored = f"{figures['maximum']:.3f} %; {figures['count']:.0f} frames scored"
            table.add_row(f"  against the {title}", f"{figures['mean']:.3f} %", scored)
    if any(value is not None for value in summary.estimate.values()):
        table.add_row("estimate error, mean", "", "maximum; % of the length")
    for title, name, _ in curves:
        if (mean := summary.estimate.get(f"error_{name}_mean_percent")) is not None:
            maximum = summary.estimate[f"error_{name}_max_percent"]
            table.add_row(f"  against the {title}", f"{mean:.3f} %", f"{maximum:.3f} %")


def _add_estimation(table: Table, estimation: EstimationFigures) -> None:
    if (hidden := estimation.hidden) is None:
        return
    table.add_row("thread hidden", f"{100.0 * hidden.time:.1f} %", "of the time, in part or all")
    if (found := estimation.consistency) is None:
        table.add_row("the estimate is a prediction only", "", "no measurement went in")
        return
    low, high = found.band
    within = f"{low:.2f} to {high:.2f} in {found.within} of {found.windows} windows of {found.width:.1f} s"
    table.add_row("normalised innovation squared", f"{found.mean:.3f}", within)
    table.add_row("disturbances", str(estimation.disturbance_count), "that the model does not know")
    for each in estimation.learned:
        table.add_row(f"learned {each.name}", *str(each).split(", ", 1))


def _micrometres(metres: float) -> str:
    """Return a margin in micrometres; what is 0 within the solvers' tolerance is written so."""
    return f"{metres * 1e6:+.3f}" if abs(metres) > 1e-9 else "0.000"


def _greatest(metres: float) -> str:
    return f"RMS; maximum {1e3 * metres:.3f} mm"


def _share(part: int, whole: int) -> str:
    return f"{100.0 * part / whole:.1f} %" if whole else ""


def _milliseconds(found: Percentiles | None) -> str:
    return f"{1e3 * found.median:.1f} ms" if found else "no pairs"


def _tail(found: Percentiles | None) -> str:
    return f"{1e3 * found.p99:.1f}, {1e3 * found.maximum:.1f} ms" if found else ""
