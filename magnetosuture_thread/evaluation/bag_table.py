"""The table over evaluated bags: a row a bag, as CSV, as JSON, and for a terminal."""

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
from magnetosuture_thread.evaluation.metrics import Percentiles
from magnetosuture_thread.evaluation.report.figures import STAGES, BagDetails, BagFigures
from magnetosuture_thread.evaluation.report.headlines import AGAINST, format_number, micrometres, milliseconds

Row: TypeAlias = "dict[str, str | int | float | None]"

ERRORS = {"mean": "mean", "median": "median", "p99": "p99", "maximum": "max"}
SIMULATED = "*"  # mark of a bag
FORMULA = ("=", "+", "-", "@", "\t", "\r")  # what a spreadsheet takes the beginning of a formula for


def row_of(about: BagDetails, figures: BagFigures) -> Row:
    """Return the row of an evaluated bag: SI units and %, as the columns' names say; None where there is no value."""
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
    }
    for prefix, errors in (("error", figures.error), ("recorded_error", figures.recorded_error)):
        for target in AGAINST:
            found = errors.get(target) or {}
            row[f"{prefix}_{target}_frames"] = found.get("count", 0)
            row |= {f"{prefix}_{target}_{short}_percent": found.get(name) for name, short in ERRORS.items()}
    row |= {
        "seen_share": figures.seen_share,
        "stretch_max": figures.strain,
        "residual_max": figures.residual,
        "contact_frames": figures.contact_frames,
    }
    for barrier in BUILT_IN:
        row[f"least_{barrier}_m"] = figures.minimum[barrier].clearance if barrier in figures.minimum else None
    added = [f"{name}: {margin.clearance:.3e}" for name, margin in figures.minimum.items() if name not in BUILT_IN]
    row["least_added_m"] = "; ".join(added) or None
    row |= _percentiles("step", figures.step_time) | _percentiles("tracker", figures.processing)
    for stage in STAGES:
        row |= _percentiles(f"latency_{stage.replace(' ', '_')}", figures.live.latency.get(stage))
    row |= {"damage": "; ".join(about.damage), "refused": sum(about.refused.values()), "problem": ""}
    return {column: _plain(value) for column, value in row.items()}


def failed_row(name: str, path: str, problem: str) -> Row:
    """Return the row of a bag that could not be evaluated."""
    row: Row = dict.fromkeys(COLUMNS)
    words = ("setup", "simulated", "source", "formulation", "damage")
    return row | dict.fromkeys(words, "") | {"bag": name, "path": path, "problem": problem}


def _percentiles(name: str, found: Percentiles | None) -> Row:
    return {f"{name}_median_s": found.median if found else None, f"{name}_p99_s": found.p99 if found else None}


def _plain(value: str | int | float | None) -> str | int | float | None:
    return None if isinstance(value, float) and not math.isfinite(value) else value


_NOTHING = BagFigures(0, 0, 0, {}, {}, "", math.nan, math.nan, math.nan, {}, 0, None, None, math.nan)
COLUMNS = tuple(row_of(BagDetails("", "", ""), _NOTHING))
TIMES = tuple(column for column in COLUMNS if column.startswith(("step_", "tracker_")))  # differ from run to run


def table_csv(rows: Sequence[Row]) -> str:
    """Return the table as CSV (RFC 4180), with all digits; an empty cell where there is no value.

    A text that a spreadsheet would take for a formula gets an apostrophe before it.
    """
    stream = io.StringIO(newline="")
    writer = csv.writer(stream, lineterminator="\r\n")
    writer.writerow(COLUMNS)
    for row in rows:
        writer.writerow([_cell(row[column]) for column in COLUMNS])
    return stream.getvalue()


def _cell(value: str | int | float | None) -> str | int | float | None:
    return f"'{value}" if isinstance(value, str) and value.startswith(FORMULA) else value


def table_json(rows: Sequence[Row]) -> str:
    """Return the table as JSON: `bags`, a list of rows, and `mean` and `worst` over the bags that were evaluated."""
    return json.dumps({"bags": list(rows), **totals(rows)}, indent=2, allow_nan=False) + "\n"


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
        title_justify="left",
        title_style="bold",
        caption_justify="left",
    )
    table.caption = (
        "errors in % of the length, mean and greatest over time;\n"
        "margin: the least of an obstacle; step: median of the model's"
    )
    if any(row["simulated"] for row in rows):
        table.caption += f";\n{SIMULATED} simulated, as the bag itself says"
    table.add_column("bag", overflow="fold", min_width=12)
    for name in ("frames", "truth", "max", "seen", "max", "margin", "step"):
        table.add_column(name, justify="right", no_wrap=True)
    for row in rows:
        if row["problem"]:
            table.add_row(Text(str(row["bag"])), Text("failed", style="bold red"))
            continue
        errors = [row[f"error_{target}_{which}_percent"] for target in AGAINST for which in ("mean", "max")]
        table.add_row(
            Text(f"{row['bag']} {SIMULATED}" if row["simulated"] else str(row["bag"])),
            f"{row['predicted']}/{row['frames']}",
            *(_shown(error, format_number) for error in errors),
            _shown(row["least_obstacle_m"], micrometres),
            _shown(row["step_median_s"], milliseconds),
        )
    summed = totals(rows)
    table.add_section()
    for name in ("mean", "worst"):
        means = [_shown(summed[name][f"error_{target}_mean_percent"], format_number) for target in AGAINST]
        table.add_row(name, "", means[0], "", means[1])
    return table


def _shown(value: Any, how: Callable[[float], str]) -> str:
    return "" if value is None else how(value)
