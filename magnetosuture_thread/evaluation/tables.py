"""Tables of evaluations, replays and closed loops: for a terminal, and over many bags as CSV and JSON."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias, cast

import numpy as np
from rich.table import Table
from rich.text import Text

from magnetosuture_thread.evaluation.figures import (
    AGAINST,
    STAGES,
    BagDetails,
    Figures,
    format_number,
    micrometres,
    micronewtons,
    milliseconds,
)
from magnetosuture_thread.evaluation.graph_outputs import LoopSummary, ReplaySummary, RunSummary
from magnetosuture_thread.evaluation.metrics import (
    KINDS,
    EstimationFigures,
    Percentiles,
    RunMetrics,
    compare_errors,
    finite_or_none,
)
from magnetosuture_thread.evaluation.reference import Evaluation
from magnetosuture_thread.geometry.barrier import BUILT_IN
from magnetosuture_thread.settings.texts import printable

Value: TypeAlias = "str | int | float | None"
Row: TypeAlias = "dict[str, Value | dict[str, Any]]"
Line: TypeAlias = "tuple[str, str, str]"  # of a table for a person: name, value, remark

MARKS = {"simulated": "*", "unverified": "?", "silences": "!"}  # of a bag, by the column that says so


def row_of(about: BagDetails, figures: Figures) -> Row:
    """Return the row of an evaluated bag: SI units and %, as the columns' names say; None where there is no value.

    `prediction`, `estimate` and `consistency` are mappings; in a table they are a column for each of their values.
    """
    metrics = figures.metrics
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
    for prefix in ("error", "recorded_error"):
        errors = metrics.errors(prefix)
        for target in AGAINST:
            found = errors.get(target) or {}
            row[f"{prefix}_{target}_frames"] = found.get("count", 0)
            for name, short in (("mean", "mean"), ("median", "median"), ("p99", "p99"), ("maximum", "max")):
                row[f"{prefix}_{target}_{short}_percent"] = found.get(name)
    row |= {**compare_errors(metrics.series), **metrics.estimation.to_json()}
    row |= {
        "seen_share": metrics.mean("seen_share"),
        "stretch_max": metrics.maximum("strain"),
        "residual_max": metrics.maximum("residual"),
        "tension_max_n": metrics.maximum("tension"),
        "needle_pull_max_n": metrics.maximum("pull"),
        "needle_pull_error_percent": metrics.pull_error_percent,
        "contact_frames": metrics.contact_frames,
    }
    minimum = {name: margin.clearance for name, margin in metrics.minimum_margins.items()}
    row |= {f"least_{barrier}_m": minimum.pop(barrier, None) for barrier in BUILT_IN}
    row["least_added_m"] = "; ".join(f"{name}: {clearance:.3e}" for name, clearance in minimum.items()) or None
    times = {"step": metrics.percentiles("step_time"), "tracker": Percentiles.of(metrics.observed.column("processing"))}
    times |= {f"latency_{stage.replace(' ', '_')}": figures.live.latency.get(stage) for stage in STAGES}
    for name, spread in times.items():
        row[f"{name}_median_s"] = spread.median if spread else None
        row[f"{name}_p99_s"] = spread.p99 if spread else None
    row |= {"damage": "; ".join(about.damage), "unverified": about.unverified}
    row |= {"refused": sum(about.refused.values()), "problem": ""}
    return {column: finite_or_none(value) for column, value in row.items()}


def failed_row(name: str, path: str, problem: str) -> Row:
    """Return the row of a bag that could not be evaluated."""
    row: Row = {key: dict.fromkeys(value) if isinstance(value, dict) else None for key, value in _EMPTY.items()}
    row |= dict.fromkeys(("setup", "simulated", "source", "formulation", "damage", "unverified"), "")
    return row | {"bag": name, "path": path, "problem": problem}


_EMPTY = row_of(BagDetails("", "", ""), Figures.of(RunMetrics(1.0)))
TIMES = tuple(column for column in _EMPTY if column.startswith(("step_", "tracker_")))  # differ from run to run


def flat(row: Row) -> dict[str, Value]:
    """Return a row with a column for each value of its mappings, `estimate_error_measured_mean_percent` for example."""
    columns: dict[str, Value] = {}
    for name, value in row.items():
        columns |= {f"{name}_{key}": own for key, own in value.items()} if isinstance(value, dict) else {name: value}
    return columns


def table_csv(rows: Sequence[Row]) -> str:
    """Return the table as CSV (RFC 4180), with all digits; an empty cell where there is no value.

    A text that a spreadsheet would take for a formula gets an apostrophe before it.
    """

    def cell(value: Value) -> Value:
        if not isinstance(value, str):
            return value
        is_formula = value.startswith(("=", "+", "-", "@", "\t", "\r"))
        return f"'{printable(value)}" if is_formula else printable(value)

    stream = io.StringIO(newline="")
    writer = csv.DictWriter(stream, list(flat(_EMPTY)))
    writer.writeheader()
    writer.writerows({name: cell(value) for name, value in flat(row).items()} for row in rows)
    return stream.getvalue()


def table_json(rows: Sequence[Row]) -> str:
    """Return the table as JSON.

    `bags` is a list of rows, `mean` and `worst` are over the mean errors of the bags that were evaluated, and
    `prediction` and `estimate` have the names of those of a bag: means of means, and maxima of maxima.
    """
    means = {column: _numbers(rows, column) for column in (f"error_{target}_mean_percent" for target in AGAINST)}
    found = {
        "bags": list(rows),
        "mean": {column: float(np.mean(own)) if own else None for column, own in means.items()},
        "worst": {column: max(own, default=None) for column, own in means.items()},
        **compared(rows),
    }
    return json.dumps(found, indent=2, allow_nan=False) + "\n"


def compared(rows: Sequence[Row]) -> dict[str, dict[str, float | None]]:
    """Return the errors of `prediction` and `estimate` over bags; None where no bag has any."""
    found: dict[str, dict[str, float | None]] = {kind: {} for kind in KINDS}
    for kind in KINDS:
        for name in cast("dict[str, Any]", _EMPTY[kind]):
            values = _numbers([cast("Row", row[kind]) for row in rows], name)
            whole = np.mean if name.endswith("_mean_percent") else np.max
            found[kind][name] = float(whole(values)) if values else None
    return found


def _numbers(rows: Sequence[Row], column: str) -> list[float]:
    return [float(value) for row in rows if isinstance(value := row[column], (int, float))]


def bags_table(rows: Sequence[Row]) -> Table:
    """Return the table for a terminal: the figures that matter most, and mean and worst."""
    caption = (
        "errors in % of the length, mean and maximum over time, of the estimate,\n"
        "and below of the prediction; margin: the minimum of an obstacle,\n"
        "chords between nodes included;\n"
        "step: median of the model's"
    )
    if any(row["simulated"] for row in rows):
        caption += f";\n{MARKS['simulated']} simulated, as the bag itself says"
    if any(row["unverified"] for row in rows):
        caption += f";\n{MARKS['unverified']} unverified: damaged, and nothing vouches for its messages"
    if any(silences := _numbers(rows, "silent_s")):
        longest = max(_numbers(rows, "max_silence_s"))
        caption += (
            f";\n{MARKS['silences']} without frames for {sum(silences):.1f} s in all, {longest:.1f} s at the longest"
        )
    columns = ("frames", "ground\ntruth", "max", "measured", "max", "margin", "step")
    table = _table("1 bag" if len(rows) == 1 else f"{len(rows)} bags", "bag", columns, caption)
    table.show_edge = False  # which keeps it within 80 columns

    def add_errors(name: str | Text, frames: str, found: Mapping[str, Any], *more: str) -> None:
        errors = [f"error_{of}_{which}_percent" for of in ("ground_truth", "measured") for which in ("mean", "max")]
        table.add_row(name, frames, *(_shown(found["estimate"][error], format_number) for error in errors), *more)
        predicted = (_shown(found["prediction"][error], format_number) for error in errors)
        table.add_row(Text(" predicted", style="dim"), "", *predicted)

    for row in rows:
        if row["problem"]:
            table.add_row(Text(str(row["bag"])), Text("failed", style="bold red"))
            continue
        name = Text(" ".join([str(row["bag"]), *(mark for why, mark in MARKS.items() if row[why])]))
        shown = _shown(row["least_obstacle_m"], micrometres), _shown(row["step_median_s"], milliseconds)
        add_errors(name, f"{row['predicted']}/{row['frames']}", row, *shown)
    table.add_section()
    add_errors("all bags", "", compared(rows))
    return table


def _shown(value: Any, how: Callable[[float], str]) -> str:
    return "" if value is None else how(value)


def evaluation_table(evaluation: Evaluation) -> Table:
    """Return the scores of a set of trajectories as a table that fits 80 columns."""
    residual = max(case.max_residual for case in evaluation.cases)
    marked = sum(case.fallbacks for case in evaluation.cases)
    caption = (
        "errors in % of the length, mean and maximum over time; stretch in %;\n"
        "deepest node in an obstacle in m; step in µs of wall clock, median and p99;\n"
        f"largest residual {residual:.0e}, {marked} steps fell back or did not converge"
    )
    title = f"formulation {evaluation.formulation}, solver {evaluation.solver}"
    table = _table(title, "case", ("error", "maximum", "stretch", "depth", "step", "p99"), caption)
    for case in evaluation.cases:
        errors = (case.mean_error_percent, case.max_error_percent, 100.0 * case.max_stretch)
        depth = f"{case.max_penetration_m:.0e}" if case.max_penetration_m else "none"
        times = (case.step_median_s, case.step_p99_s)
        table.add_row(case.name, *(f"{each:.3f}" for each in errors), depth, *(f"{1e6 * each:.0f}" for each in times))
    table.add_section()
    table.add_row("mean of the cases", f"{evaluation.mean_error_percent:.3f}")
    table.add_row("worst case", f"{evaluation.worst_error_percent:.3f}")
    return table


def _table(title: str, first: str, columns: Sequence[str], caption: str) -> Table:
    """Return a table of names with numbers beside them."""
    table = Table(title=title, title_justify="left", title_style="bold", caption=caption, caption_justify="left")
    table.add_column(first, overflow="fold", min_width=10)
    for name in columns:
        table.add_column(name, justify="right", no_wrap=True)
    return table


def summary_table(summary: ReplaySummary) -> Table:
    """Return the figures of a replayed bag as a table."""
    live, by_camera = summary.speed is None, summary.source == "camera"
    simulated = "simulated" if summary.simulated else ""
    frames: list[Line] = [
        ("camera frames" if by_camera else "recorded poses", str(summary.frames), simulated),
        ("  tracked" if by_camera else "  usable", str(summary.tracked), _share(summary.tracked, summary.frames)),
        ("  predicted", str(summary.predicted), _share(summary.predicted, summary.frames)),
        *(("  not used", str(count), why) for why, count in summary.refused.items()),
    ]
    if live:
        frames += [
            ("velocity commands", str(summary.commands), simulated),
            ("  reached the coils", str(summary.driven), _share(summary.driven, summary.commands)),
            ("messages dropped", str(sum(summary.dropped.values())), "of those played"),
            *(("  dropped", str(count), which) for which, count in summary.dropped.items() if count),
        ]
    if summary.silence.gaps:
        frames.append(("frames are missing", f"{summary.silence.total:.1f} s", summary.silence.longest))
    doubts = {"the bag is damaged": summary.damage, "the bag is unverified": summary.unverified}
    frames += [(name, "", why) for name, why in {**doubts, "setup in doubt": summary.remark}.items() if why]
    times: list[Line] = [
        ("latency, median" if live else "times, median", "", "99th percentile, maximum"),
        *_times({**summary.latency, "model step alone": summary.step_time}),
    ]
    if summary.speed is not None:
        times.append(("speed", f"{summary.speed:.3g}", "times as fast as recorded"))
    margins: list[Line] = [("minimum margin", "", "0 or more is safe, of nodes; lengths are met to 0.1 %")]
    for margin in summary.least_margins:
        where = f"node {margin.node}" + (f", obstacle {margin.obstacle}" if margin.obstacle >= 0 else "")
        margins.append((f"  {margin.kind}", micrometres(margin.promised), f"{where}, at {margin.time:.2f} s"))
        if margin.chord is not None:
            margins.append(("    deepest chord", micrometres(margin.chord), "between two nodes; no barrier keeps it"))
    margins += [
        ("frames in contact", str(summary.contact_frames), _share(summary.contact_frames, summary.predicted)),
        ("maximum stretch", f"{100.0 * summary.stretch:.1e} %", "of a segment"),
    ]
    if summary.peak_tension is not None and summary.needle_pull is not None:
        pull = f"on the needle at most {micronewtons(summary.needle_pull)}"
        margins.append(("peak tension", micronewtons(summary.peak_tension), pull))
    margins.append(("maximum residual", f"{summary.residual:.1e}", "scaled; checked apart from the solver"))
    sections = [frames, times, margins, [*_errors(summary), *_estimation(summary.estimation)]]
    if (apart := summary.currents) is not None:
        tail = f"{apart.p99:.2f}, {apart.greatest:.2f} A; recorded: {apart.recorded:.2f} A rms"
        stopped = ("  stopped in one only", f"{100.0 * apart.stopped_apart:.1f} %", f"of {apart.compared}")
        sections.append([("currents off the recorded", f"{apart.difference:.3f} A", tail), stopped])
    return _figures_table(f"{summary.bag}, setup {summary.setup}", sections)


def loop_table(summary: LoopSummary) -> Table:
    """Return the figures of a closed loop as a table."""
    frames: list[Line] = [
        ("camera frames", str(summary.frames), f"over {summary.duration:.1f} s of steering"),
        ("  skipped", str(summary.skipped), summary.too_slow or "the rig had no time for them"),
        ("  tracked", str(summary.tracked), f"{summary.lost} looked at and lost"),
        ("  wrong poses", str(summary.wrong), "more than 0.3 mm or 5 degrees from the ground truth"),
        ("  predicted", str(summary.predicted), _share(summary.predicted, summary.frames)),
    ]
    greatest = f"RMS; maximum {1e3 * summary.path_error_greatest:.3f} mm"
    needle: list[Line] = [
        ("needle from its path", f"{1e3 * summary.path_error:.3f} mm", greatest),
        ("tracked tail from the ground truth", f"{1e3 * summary.tail_error:.3f} mm", "RMS"),
        ("tracked heading", f"{math.degrees(summary.heading_error):.2f} deg", "RMS"),
        ("currents at a limit", f"{100.0 * summary.saturated:.1f} %", "of the commands"),
    ]
    latency = {f"to {name}": found for name, found in summary.latency.items()}
    latency |= {"tracker alone": summary.processing, "model step alone": summary.step_time}
    times: list[Line] = [("latency from the frame's stamp", "", "99th percentile, maximum"), *_times(latency)]
    sections = [frames, needle, times, _errors(summary)]
    if summary.procedure is not None:
        sections.append([outcome_line(summary.procedure)])
    return _figures_table(f"{summary.setup}, closed loop, simulated", sections)


def outcome_line(outcome: Mapping[str, Any]) -> Line:
    """Return what came of a procedure: its name, its state, the goals met and the reason where it failed."""
    state = "succeeded" if outcome["state"] == "done" else outcome["state"]
    met = f"{outcome['goals_met']} of {outcome['goals']} goals met"
    return f"procedure {outcome['procedure']}", state, f"{met}: {outcome['reason']}" if outcome["reason"] else met


def _figures_table(title: str, sections: Sequence[Sequence[Line]]) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold")
    table.add_column("", no_wrap=True)
    table.add_column("value", justify="right", no_wrap=True)
    table.add_column("remark", style="dim")
    for lines in sections:
        for line in lines:
            table.add_row(*line)
        table.add_section()
    return table


def _errors(summary: RunSummary) -> list[Line]:
    lines: list[Line] = [("thread measured, mean", f"{100.0 * summary.seen_share:.1f} %", "of its length")]
    for kind, errors in (("prediction", summary.prediction), ("estimate", summary.estimate)):
        found = [
            (f"  against the {title}", f"{mean:.3f} %", f"{errors[f'error_{name}_max_percent']:.3f} %")
            for name, title in (("measured", "measured centreline"), ("ground_truth", "ground truth"))
            if (mean := errors.get(f"error_{name}_mean_percent")) is not None
        ]
        if found or kind == "prediction":
            lines += [(f"{kind} error, mean", "" if found else "none", "maximum; % of the length"), *found]
    return lines


def _estimation(estimation: EstimationFigures) -> list[Line]:
    if (hidden := estimation.hidden) is None:
        return []
    lines: list[Line] = [("thread hidden", f"{100.0 * hidden.time:.1f} %", "of the time, in part or all")]
    if (found := estimation.consistency) is None:
        return [*lines, ("the estimate is a prediction only", "", "no measurement went in")]
    low, high = found.band
    within = f"{low:.2f} to {high:.2f} in {found.within} of {found.windows} windows of {found.width:.1f} s"
    lines.append(("normalised innovation squared", f"{found.mean:.3f}", within))
    lines.append(("disturbances", str(len(estimation.disturbances)), "that the model does not know"))
    return lines


def _times(found: Mapping[str, Percentiles | None]) -> list[Line]:
    return [
        (f"  {name}", f"{1e3 * each.median:.1f} ms", f"{1e3 * each.p99:.1f}, {1e3 * each.maximum:.1f} ms")
        if each
        else (f"  {name}", "no pairs", "")
        for name, each in found.items()
    ]


def _share(part: int, whole: int) -> str:
    return f"{100.0 * part / whole:.1f} %" if whole else ""
