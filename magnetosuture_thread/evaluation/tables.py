"""Figures of a replay, a closed loop and evaluated bags: as JSON, as a table in a file, and for a terminal."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeAlias, cast

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from magnetosuture_thread.bags.reading import heading_known, nanoseconds, planar_pose
from magnetosuture_thread.evaluation.frames import (
    Array,
    CurrentDifference,
    FrameResult,
    GraphCollector,
    TimeSeries,
    rms,
)
from magnetosuture_thread.evaluation.metrics import (
    TARGETS,
    EstimationFigures,
    MinimumMargin,
    Percentiles,
    RunMetrics,
    SensorSilence,
    compare_errors,
    finite_or_none,
    plain_values,
)
from magnetosuture_thread.geometry.barrier import BUILT_IN
from magnetosuture_thread.geometry.needle_arc import needle_axis
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.errors import ConfigurationError, GraphError, printable

Value: TypeAlias = "str | int | float | None"
Row: TypeAlias = "dict[str, Value | dict[str, Any]]"

STAGES = ("frame to needle pose", "frame to prediction", "command to currents")  # of a recorded graph
TEXTS = ("bag", "path", "setup", "simulated", "source", "formulation", "damage", "unverified", "problem")


@dataclass(frozen=True, kw_only=True)
class RunSummary:
    """The figures that a replay and a closed loop have in common.

    Attributes:
        setup: the setup's name.
        frames: camera frames, lost ones too, or recorded poses.
        tracked: frames with a pose.
        predicted: frames with a predicted thread.
        latency: of each stage, or from a frame's stamp to the arrival of what was made of it [s].
        step_time: of the model's step [s].
        stretch: greatest absolute stretch of a segment.
        seen_share: part of the thread's length that the camera saw, mean over the predicted frames.
        error_seen: prediction error against the seen centreline [% of length], over `count` frames.
        error_truth: the same against the truth, where the bag holds it.
        prediction: errors of the prediction; see `compare_errors`.
        estimate: errors of the estimate, under the same names.
    """

    setup: str
    frames: int
    tracked: int
    predicted: int
    latency: dict[str, Percentiles | None]
    step_time: Percentiles | None
    stretch: float
    seen_share: float
    error_seen: dict[str, float] | None
    error_truth: dict[str, float] | None
    prediction: dict[str, float | None] = field(default_factory=dict)
    estimate: dict[str, float | None] = field(default_factory=dict)


def figures_of(metrics: RunMetrics) -> dict[str, Any]:
    """Return the fields of `RunSummary` that the metrics of a run give, by their names."""
    errors = metrics.errors()
    return {
        "predicted": len(metrics.series),
        "step_time": Percentiles.of(metrics.series.column("step_time")),
        "stretch": metrics.maximum("strain"),
        "seen_share": metrics.mean("seen_share"),
        "error_seen": errors["seen"],
        "error_truth": errors["truth"],
        **compare_errors(metrics.series),
    }


@dataclass(frozen=True, kw_only=True)
class ReplaySummary(RunSummary):
    """The figures of a replayed bag.

    Attributes:
        bag: its path.
        simulated: what was simulated, empty if the bag does not say that anything was.
        commands: needle velocity commands played.
        driven: commands that reached the coils.
        least_margins: of each kind.
        contact_frames: predicted frames in which the thread touches an obstacle.
        residual: greatest scaled residual of a solve.
        peak_tension: greatest tension of a segment [N]; None where no force is known.
        needle_pull: greatest force of the thread upon the needle [N]; None where no force is known.
        estimation: what else there is of the estimate.
        currents: difference of the coils' currents from the recorded ones, where the bag holds any.
        source: `camera`, or `poses` where `frames` are recorded poses.
        speed: how many seconds of the bag were worked through in a second, of an offline replay; else None.
        refused: frames and poses that could not be used, by why.
        dropped: messages that got lost on a way, by which; empty offline, where there are none.
        silence: time without frames, or poses.
        damage: what of the bag could not be read, empty if nothing.
        unverified: why any message of the bag may be wrong, empty if nothing speaks against them.
        remark: what else to know of the bag, empty if nothing.
    """

    bag: str
    simulated: str
    commands: int
    driven: int
    least_margins: list[MinimumMargin]
    contact_frames: int
    residual: float
    peak_tension: float | None = None
    needle_pull: float | None = None
    estimation: EstimationFigures = field(default_factory=EstimationFigures)
    currents: CurrentDifference | None = None
    source: str = "camera"
    speed: float | None = None
    refused: dict[str, int] = field(default_factory=dict)
    dropped: dict[str, int] = field(default_factory=dict)
    silence: SensorSilence = field(default_factory=SensorSilence)
    damage: str = ""
    unverified: str = ""
    remark: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return the figures as plain values; units as above. Those of `estimation` stand beside the others."""
        figures = asdict(self)
        events = figures.pop("estimation")["disturbances"]
        figures["silence"]["at"] = finite_or_none(self.silence.at)
        return figures | self.estimation.to_json() | {"disturbances": list(events)}


@dataclass(frozen=True, kw_only=True)
class LoopSummary(RunSummary):
    """The figures of a closed loop. Everything in it is simulated.

    Attributes:
        duration: from the start of the steering until the path was done, or to the end; all figures are of
            this time [s].
        skipped: frames that are missing: the rig had no time for them.
        lost: frames that the tracker looked at without giving a pose.
        wrong: poses farther from the truth than 0.3 mm or 5 degrees.
        saturated: share of the currents at a limit.
        tail_error: distance of the tracked tail from the truth, root of the mean square [m].
        heading_error: of the tracked heading, the same [rad].
        path_error: distance of the needle's true tip from where the path wanted it, the same [m].
        path_error_greatest: greatest such distance [m].
        processing: of a frame in the tracker [s].
        procedure: what came of a procedure; None for a path that was followed.
        too_slow: that the computer was too slow for the run, and what to do; empty if it was not.
    """

    duration: float
    skipped: int
    lost: int
    wrong: int
    saturated: float
    tail_error: float
    heading_error: float
    path_error: float
    path_error_greatest: float
    processing: Percentiles | None
    procedure: dict[str, Any] | None = None
    too_slow: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return the figures as plain values, None where there is none; units as above."""
        return plain_values(self)


class LoopCollector:
    """Puts the messages of a closed loop side by side by their stamps.

    Args:
        thread_length: [m]
        needle_length: along the needle's body [m].
        needle_curvature: of its arc [1/m].
        frame_rate: of the camera [Hz].

    Attributes:
        instants: the predicted frames by time, once `summary` was asked for.
    """

    def __init__(self, thread_length: float, needle_length: float, needle_curvature: float, frame_rate: float) -> None:
        self._threads = GraphCollector()
        self._needle = needle_length, needle_curvature
        self._rate, self._length = frame_rate, thread_length
        self._truth: dict[int, Array] = {}
        self._tracked: dict[int, Array] = {}
        self._setpoints: dict[int, Array] = {}
        self._arrived: dict[str, dict[int, int]] = {interface.NEEDLE_POSE.name: {}, interface.PREDICTED_THREAD.name: {}}
        self._states: dict[int, tuple[int, float]] = {}
        self._saturated: list[bool] = []
        self.instants: list[FrameResult] = []

    def add(self, topic: str, time: int, message: Any) -> None:
        """Add one message that arrived at a time [ns]."""
        self._threads.add(topic, message)
        if not hasattr(message, "header"):
            return
        stamp = nanoseconds(message.header.stamp)
        match topic:
            case interface.GROUND_TRUTH_NEEDLE.recorded:
                self._truth[stamp] = np.array(planar_pose(message.pose))
            case interface.TIP_SETPOINT.recorded:
                self._setpoints[stamp] = np.array(planar_pose(message.pose))
            case interface.NEEDLE_POSE.recorded if heading_known(message):
                self._tracked[stamp] = np.array(planar_pose(message.pose.pose))
            case interface.TRACKER_STATE.recorded:
                self._states[stamp] = (message.state, message.processing_time)
            case interface.CURRENTS.recorded:
                self._saturated.append(bool(message.saturated))
        if topic.lstrip("/") in self._arrived:
            self._arrived[topic.lstrip("/")].setdefault(stamp, time)

    def summary(self, setup: str) -> LoopSummary:
        """Return the figures.

        Raises:
            GraphError: there is no frame with a pose and its truth.
        """
        first, last = (min(self._setpoints), max(self._setpoints)) if self._setpoints else (0, 0)
        if self._setpoints and self._threads.health.get("path_follower") != "done":
            last = max(self._truth, default=last)  # who steers is silent while the needle is lost
        frames = {stamp for stamp in self._truth if first <= stamp <= last}
        both = sorted(self._tracked.keys() & frames)
        if not both:
            health = "; ".join(f"{name}: {text}" for name, text in sorted(self._threads.health.items()))
            raise GraphError(f"the needle was tracked in no frame; {health}")
        self.instants = self._threads.frames(first, last)
        apart = np.array([self._tracked[stamp] - self._truth[stamp] for stamp in both])
        tail, heading = np.linalg.norm(apart[:, :2], axis=1), np.abs(np.angle(np.exp(1j * apart[:, 2])))
        off = np.array([np.linalg.norm(self._tip(s) - self._setpoints[s][:2]) for s in both if s in self._setpoints])
        states = [state for stamp, state in self._states.items() if stamp in frames]
        return LoopSummary(
            setup=setup,
            duration=(last - first) * 1e-9,
            frames=len(frames),
            skipped=max(0, round((last - first) * 1e-9 * self._rate) + 1 - len(frames)),
            tracked=len(both),
            lost=sum(state != 1 for state, _ in states),  # TrackerState.TRACKED
            wrong=int(np.sum((tail > 0.3e-3) | (heading > np.radians(5.0)))),
            saturated=float(np.mean(self._saturated or [False])),
            tail_error=rms(tail),
            heading_error=rms(heading),
            path_error=rms(off),
            path_error_greatest=float(off.max(initial=0.0)),
            processing=Percentiles.of([taken for _, taken in states]),
            latency={
                name: Percentiles.of([1e-9 * (at - stamp) for stamp, at in arrived.items() if stamp in self._setpoints])
                for name, arrived in self._arrived.items()
            },
            **figures_of(RunMetrics.of(self._length, self.instants)),
        )

    def _tip(self, stamp: int) -> Points:
        """Return where the needle's true tip was."""
        x, y, heading = self._truth[stamp]
        points, _ = needle_axis(np.array([x, y]), heading, *self._needle, np.ones(1))
        return np.asarray(points[0])


def row_of(
    metrics: RunMetrics,
    silence: SensorSilence | None = None,
    latency: Mapping[str, Percentiles] | None = None,
    **facts: Value,
) -> Row:
    """Return the row of an evaluated bag: SI units and %, as the columns' names say; None where there is no value.

    `prediction`, `estimate` and `consistency` are mappings; in a table they are a column for each of their values.

    Args:
        metrics: of the run.
        silence: time without frames, or poses.
        latency: of each stage of the recorded graph that is known [s].
        facts: the columns of `TEXTS`, `duration_s` and `refused`.
    """
    silence = silence or SensorSilence()
    row: Row = dict.fromkeys(TEXTS[:6], "") | {"duration_s": None}
    row |= {"frames": len(metrics.observed), "tracked": metrics.tracked, "predicted": len(metrics.series)}
    row |= {"silent_s": silence.total, "max_silence_s": silence.max_gap, "silences": silence.gaps}
    for prefix in ("error", "recorded_error"):
        errors = metrics.errors(prefix)
        for target in TARGETS:
            figures = errors.get(target) or {}
            row[f"{prefix}_{target}_frames"] = figures.get("count", 0)
            for name, short in (("mean", "mean"), ("median", "median"), ("p99", "p99"), ("maximum", "max")):
                row[f"{prefix}_{target}_{short}_percent"] = figures.get(name)
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
    columns = {"step": metrics.series.column("step_time"), "tracker": metrics.observed.column("processing")}
    times = {name: Percentiles.of(column) for name, column in columns.items()}
    times |= {f"latency_{stage.replace(' ', '_')}": (latency or {}).get(stage) for stage in STAGES}
    for name, spread in times.items():
        row[f"{name}_median_s"] = spread.median if spread else None
        row[f"{name}_p99_s"] = spread.p99 if spread else None
    row |= {"damage": "", "unverified": "", "refused": 0, "problem": "", **facts}
    return {column: finite_or_none(value) for column, value in row.items()}


def failed_row(name: str, path: str, problem: str) -> Row:
    """Return the row of a bag that could not be evaluated."""
    empty = row_of(RunMetrics(1.0))
    row: Row = {key: dict.fromkeys(value) if isinstance(value, dict) else None for key, value in empty.items()}
    return row | dict.fromkeys(TEXTS, "") | {"bag": name, "path": path, "problem": problem}


def flat(row: Row) -> dict[str, Value]:
    """Return a row with a column for each value of its mappings, `estimate_error_measured_mean_percent` for example."""
    columns: dict[str, Value] = {}
    for name, value in row.items():
        columns |= {f"{name}_{key}": part for key, part in value.items()} if isinstance(value, dict) else {name: value}
    return columns


def check_table(path: Path) -> None:
    """Refuse a table that could not be written, before the work begins.

    Raises:
        ConfigurationError: the ending is not known, or it is of Parquet and pyarrow cannot be imported.
    """
    if path.suffix not in (".json", ".csv", ".parquet"):
        raise ConfigurationError("--table", str(path), "a name that ends in .json, .csv, .parquet")
    if path.suffix == ".parquet":
        try:
            from pyarrow import parquet  # noqa: F401
        except ImportError as error:  # also with libraries of another NumPy
            expected = f"pyarrow (extra `cluster`), or .csv or .json: {' '.join(str(error).split())}"
            raise ConfigurationError("--table", str(path), expected) from None


def write_table(path: Path, rows: Sequence[Row], document: Any) -> None:
    """Write a table as its name ends: JSON, CSV (RFC 4180) or Parquet.

    Args:
        path: the file to make; see `check_table`.
        rows: the same columns in each; with a column for each value of their mappings in CSV and Parquet.
        document: what JSON gets.
    """
    if path.suffix == ".parquet":
        import pyarrow
        from pyarrow import parquet

        parquet.write_table(pyarrow.Table.from_pylist([flat(row) for row in rows]), path)
    elif path.suffix == ".csv":
        path.write_text(table_csv(rows), encoding="utf-8", newline="")
    else:
        path.write_text(json.dumps(document, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def table_csv(rows: Sequence[Row]) -> str:
    """Return rows as CSV, with all digits; an empty cell where there is no value.

    A text that a spreadsheet would take for a formula gets an apostrophe before it.
    """

    def cell(value: Value) -> Value:
        if not isinstance(value, str):
            return value
        is_formula = value.startswith(("=", "+", "-", "@", "\t", "\r"))
        return f"'{printable(value)}" if is_formula else printable(value)

    stream = io.StringIO(newline="")
    cells = [{name: cell(value) for name, value in flat(row).items()} for row in rows]
    writer = csv.DictWriter(stream, list(cells[0]) if cells else [])
    writer.writeheader()
    writer.writerows(cells)
    return stream.getvalue()


def bags_document(rows: Sequence[Row]) -> dict[str, Any]:
    """Return the rows of bags with what JSON has besides.

    `bags` is a list of rows, `mean` and `worst` are over the mean errors of the bags that were evaluated, and
    `prediction` and `estimate` have the names of those of a bag: means of means, and maxima of maxima.
    """
    means = {column: _numbers(rows, column) for column in (f"error_{target}_mean_percent" for target in TARGETS)}
    return {
        "bags": list(rows),
        "mean": {column: float(np.mean(values)) if values else None for column, values in means.items()},
        "worst": {column: max(values, default=None) for column, values in means.items()},
        **compare_bags(rows),
    }


def compare_bags(rows: Sequence[Row]) -> dict[str, dict[str, float | None]]:
    """Return the errors of `prediction` and `estimate` over bags; None where no bag has any."""
    compared = compare_errors(TimeSeries())
    for kind, errors in compared.items():
        for name in errors:
            values = _numbers([cast("Row", row[kind]) for row in rows], name)
            whole = np.mean if name.endswith("_mean_percent") else np.max
            errors[name] = float(whole(values)) if values else None
    return compared


def _numbers(rows: Sequence[Row], column: str) -> list[float]:
    return [float(value) for row in rows if isinstance(value := row[column], (int, float))]


def summary_table(summary: ReplaySummary) -> Table:
    """Return the figures of a replayed bag as a table."""
    is_live, things = summary.speed is None, "camera frames" if summary.source == "camera" else "recorded poses"
    counts = f"{summary.tracked} {'tracked' if things == 'camera frames' else 'usable'}, {summary.predicted} predicted"
    lines = {things + ", simulated" * bool(summary.simulated): f"{summary.frames}: {counts}"}
    lines["not used"] = "; ".join(f"{count} times {why}" for why, count in summary.refused.items())
    if is_live:
        share = f" ({100.0 * summary.driven / summary.commands:.1f} %)" if summary.commands else ""
        lines["velocity commands"] = f"{summary.commands}: {summary.driven} reached the coils{share}"
        lines["messages dropped"] = "; ".join(f"{count} {what}" for what, count in summary.dropped.items() if count)
    lines["frames are missing"] = str(summary.silence)
    lines |= {"damaged": summary.damage, "unverified": summary.unverified, "setup in doubt": summary.remark}
    kind = "latency" if is_live else "time"
    lines |= {f"{kind}, {name}": _spread(spread) for name, spread in summary.latency.items()}
    lines["time, model step alone"] = _spread(summary.step_time)
    lines["speed"] = "" if is_live else f"{summary.speed:.3g} times as fast as recorded"
    for margin in summary.least_margins:
        place = f"node {margin.node}" + (f" at obstacle {margin.obstacle}" if margin.obstacle >= 0 else "")
        chord = "" if margin.chord is None else f"; deepest chord between nodes {micrometres(margin.chord)}"
        least = f"{micrometres(margin.promised)} of {place}, {margin.time:.2f} s"
        lines[f"minimum margin, {margin.kind}"] = least + chord
    lines["in contact"] = f"{summary.contact_frames} frames"
    lines["maximum stretch"] = f"{100.0 * summary.stretch:.1e} % of a segment"
    lines["maximum residual"] = f"{summary.residual:.1e}, scaled"
    if summary.peak_tension is not None and summary.needle_pull is not None:
        pull = f"{1e6 * summary.needle_pull:.3g} µN on the needle"
        lines["peak tension"] = f"{1e6 * summary.peak_tension:.3g} µN, {pull}"
    lines |= _errors(summary)
    if (hidden := summary.estimation.hidden.hidden_time_share) is not None:
        lines["thread hidden"] = f"{100.0 * hidden:.1f} % of the time, in part or all"
        lines["disturbances"] = str(len(summary.estimation.disturbances))
        lines["squared innovation, mean"] = "none, the estimate is a prediction only"
    if (found := summary.estimation.consistency).windows:
        band = f"in {found.band_95_low:.2f} to {found.band_95_high:.2f} in {found.windows_within_band} of"
        windows = f"{found.windows} windows of {found.window_s:.1f} s"
        lines["squared innovation, mean"] = f"{found.normalised_innovation_squared_mean:.3f}; {band} {windows}"
    if (apart := summary.currents) is not None:
        median = f"{apart.difference:.3f} A median of {apart.recorded:.2f} A rms; maximum {apart.greatest:.2f} A"
        stopped = f"{100.0 * apart.stopped_apart:.1f} % of {apart.compared} stopped in one only"
        lines["currents off the recorded"] = f"{median}; {stopped}"
    return _figures_table(f"{summary.bag}, setup {summary.setup}", lines)


def loop_table(summary: LoopSummary) -> Table:
    """Return the figures of a closed loop as a table."""
    skipped = f"{summary.skipped} skipped" + f", {summary.too_slow}" * bool(summary.too_slow)
    greatest = summary.path_error_greatest
    poses = f"{summary.tracked} tracked, {summary.lost} lost, {summary.wrong} wrong by 0.3 mm or 5 degrees"
    lines = {
        "camera frames": f"{summary.frames} in {summary.duration:.1f} s of steering, {skipped}",
        "poses": f"{poses}; {summary.predicted} predictions",
        "needle off its path": f"{1e3 * summary.path_error:.3f} mm RMS; maximum {1e3 * greatest:.3f} mm",
        "tracked tail": f"{1e3 * summary.tail_error:.3f} mm RMS off",
        "tracked heading": f"{math.degrees(summary.heading_error):.2f} deg RMS off",
        "currents at a limit": f"{100.0 * summary.saturated:.1f} % of the commands",
        **{f"latency, frame to {name}": _spread(spread) for name, spread in summary.latency.items()},
        "time, tracker alone": _spread(summary.processing),
        "time, model step alone": _spread(summary.step_time),
        **_errors(summary),
    }
    if summary.procedure is not None:
        name, *outcome = outcome_line(summary.procedure)
        lines[name] = ", ".join(outcome)
    return _figures_table(f"{summary.setup}, closed loop, simulated", lines)


def outcome_line(outcome: Mapping[str, Any]) -> tuple[str, str, str]:
    """Return what came of a procedure: its name, its state, the goals met and the reason where it failed."""
    state = "succeeded" if outcome["state"] == "done" else outcome["state"]
    met = f"{outcome['goals_met']} of {outcome['goals']} goals met"
    return f"procedure {outcome['procedure']}", state, f"{met}: {outcome['reason']}" if outcome["reason"] else met


def micrometres(metres: float) -> str:
    """Return a margin as text; what is 0 within the solvers' tolerance is written so."""
    if abs(metres) <= 1e-9:
        return "0 µm"
    return f"{1e6 * metres:.3g} µm" if abs(metres) < 1e-4 else f"{1e3 * metres:.3g} mm"


def _figures_table(title: str, lines: Mapping[str, str]) -> Table:
    """Return names and figures as a table; what is empty is left out."""
    table = Table(title=title, title_justify="left", title_style="bold", box=SIMPLE_HEAD, show_header=False)
    table.add_column(no_wrap=True)
    table.add_column()
    for name, text in lines.items():
        if text:
            table.add_row(name, Text(text))
    return table


def _errors(summary: RunSummary) -> dict[str, str]:
    mean = {"prediction error, mean": error_text(summary.prediction) or "none"}
    lines = {"thread measured": f"{100.0 * summary.seen_share:.1f} % of its length, mean", **mean}
    return lines | {"estimate error, mean": error_text(summary.estimate)}


def error_text(errors: Mapping[str, float | None], seen: str = "the measured thread") -> str:
    """Return errors of `compare_errors` in words, with what is `seen`; empty if there are none."""
    return "; ".join(
        f"{mean:.3f} % from {target} (maximum {errors[f'error_{name}_max_percent']:.3f} %)"
        for name, target in (("measured", seen), ("ground_truth", "ground truth"))
        if (mean := errors.get(f"error_{name}_mean_percent")) is not None
    )


def _spread(spread: Percentiles | None) -> str:
    if spread is None:
        return "no pairs"
    return f"{1e3 * spread.median:.1f} ms median; 99 % {1e3 * spread.p99:.1f}, maximum {1e3 * spread.maximum:.1f} ms"
