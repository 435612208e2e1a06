"""The table over bags."""

from __future__ import annotations

import csv
import io
import json
import math
from dataclasses import replace

import pytest
from rich.console import Console

from magnetosuture_thread.evaluation.metrics import MinimumMargin, Percentiles, RunMetrics, SensorSilence
from magnetosuture_thread.evaluation.report.figures import BagDetails, Figures, LiveFigures, headlines
from magnetosuture_thread.evaluation.tables import (
    Row,
    bags_table,
    failed_row,
    flat,
    row_of,
    table_csv,
    table_json,
)

ERROR = {"count": 9, "mean": 0.1 + 0.2, "median": 0.2, "p99": 0.5, "maximum": 0.75}
NOTHING = Figures.of(RunMetrics(1.0))
FIGURES = replace(
    NOTHING,
    compared={
        "prediction": {**NOTHING.compared["prediction"], "error_ground_truth_mean_percent": 0.3},
        "estimate": NOTHING.compared["estimate"],
    },
    frames=10,
    tracked=9,
    predicted=9,
    error={"truth": ERROR, "seen": None},
    recorded_error={"truth": ERROR},
    target="truth",
    measured_share=1.0,
    strain=math.nan,
    residual=1e-9,
    minimum={"obstacle": MinimumMargin("obstacle", -2e-6, -2e-6, 7, 0, 1.5)},
    contact_frames=3,
    step_time=Percentiles(1e-4, 2e-4, 3e-4),
    processing=None,
    interval=1 / 30,
    live=LiveFigures({"frame to prediction": Percentiles(0.012, 0.018, 0.02)}),
)


def row(name: str, simulated: str = "") -> Row:
    """Return the row of a bag."""
    return row_of(BagDetails(name, f"/data/{name}", "petri", simulated), FIGURES)


def read(rows: list[Row]) -> list[dict[str, str]]:
    """Return the table as a spreadsheet reads it."""
    return list(csv.DictReader(io.StringIO(table_csv(rows), newline="")))


def test_a_row_has_the_figures_with_all_digits():
    (found,) = read([row("a")])
    assert tuple(found) == tuple(flat(row("a")))  # each value of a mapping has a column
    assert float(found["error_truth_mean_percent"]) == 0.1 + 0.2
    assert found["error_seen_mean_percent"] == found["stretch_max"] == found["tracker_median_s"] == ""
    assert found["error_seen_frames"] == "0"
    assert float(found["recorded_error_truth_max_percent"]) == 0.75
    assert float(found["least_obstacle_m"]) == -2e-6
    assert float(found["latency_frame_to_prediction_p99_s"]) == 0.018


@pytest.mark.parametrize("name", ["=cmd()", "+1", "-1", "@x", "\tx", 'a "b", c\nd', "ö"])
def test_any_name_is_one_cell_and_none_is_a_formula(name: str):
    (found,) = read([row(name, simulated=name)])
    assert found["bag"].removeprefix("'") == found["simulated"].removeprefix("'") == name
    assert not found["bag"].startswith(("=", "+", "-", "@", "\t", "\r"))
    assert found["setup"] == "petri"


def test_json_says_the_same_with_mean_and_worst():
    rows = [row("a"), failed_row("b", "/data/b", "is broken")]
    found = json.loads(table_json(rows))
    assert found["bags"] == rows
    assert found["bags"][1]["problem"] == "is broken"
    assert found["mean"] == {"error_truth_mean_percent": 0.1 + 0.2, "error_seen_mean_percent": None}
    assert found["worst"]["error_truth_mean_percent"] == 0.1 + 0.2


def test_the_terminal_s_table_fits_and_shows_names_as_they_are():
    console = Console(width=80, file=io.StringIO(), record=True)
    console.print(bags_table([row("[bold]x"), failed_row("b", "p", "q")]))
    text = console.export_text()
    assert "[bold]x" in text
    assert "9/10" in text
    assert "failed" in text
    assert "0.300" in text
    assert "…" not in text


def test_the_silence_of_a_sensor_is_in_table_row_and_headline():
    """4 of 6 minutes without frames read as 1383 of 1387 frames."""
    figures = replace(FIGURES, frames=1387, predicted=1383, silence=SensorSilence(1, 240.0, 240.0, 60.0), span=360.0)
    about = BagDetails("loop", "/data/loop", "petri", duration=360.0)
    (found,) = read([row_of(about, figures)])
    assert (found["silent_s"], found["max_silence_s"], found["silences"]) == ("240.0", "240.0", "1")
    console = Console(width=80, file=io.StringIO(), record=True)
    console.print(bags_table([row_of(about, figures), row("other")]))
    text = console.export_text()
    assert "loop !" in text
    assert "! without frames for 240.0 s in all" in text
    frames = next(each for each in headlines(about, figures) if each.name == "frames predicted")
    assert "none at all for 240 s, the longest 240 s at 60.0 s" in frames.detail
    assert frames.grade == "bad"
