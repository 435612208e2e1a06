"""The table over bags."""

from __future__ import annotations

import csv
import io
import json

import numpy as np
import pytest
from rich.console import Console

from magnetosuture_thread.evaluation.figures import BagDetails, Figures, LiveFigures, headlines
from magnetosuture_thread.evaluation.frames import Observation
from magnetosuture_thread.evaluation.metrics import Percentiles, RunMetrics
from magnetosuture_thread.evaluation.tables import Row, bags_table, failed_row, flat, row_of, table_csv, table_json
from test.evaluation.runs import LENGTH, made_metrics

LIVE = LiveFigures({"frame to prediction": Percentiles(0.012, 0.018, 0.02)})
FIGURES = Figures.of(made_metrics(10, ("truth",)), LIVE)
MEAN = 100.0 * 2e-6 * 4.5 / LENGTH  # %, of ten frames


def row(name: str, simulated: str = "") -> Row:
    """Return the row of a bag."""
    return row_of(BagDetails(name, f"/data/{name}", "petri", simulated), FIGURES)


def read(rows: list[Row]) -> list[dict[str, str]]:
    """Return the table as a spreadsheet reads it."""
    return list(csv.DictReader(io.StringIO(table_csv(rows), newline="")))


def shown(*rows: Row) -> str:
    """Return the table as a terminal of 80 columns shows it."""
    console = Console(width=80, file=io.StringIO(), record=True)
    console.print(bags_table(rows))
    return console.export_text()


def test_a_row_has_the_figures_with_all_digits():
    (found,) = read([row("a")])
    assert tuple(found) == tuple(flat(row("a")))  # each value of a mapping has a column
    assert float(found["error_truth_mean_percent"]) == pytest.approx(MEAN, rel=1e-12)
    assert float(found["estimate_error_measured_mean_percent"] or "nan") != 0.0
    assert found["error_seen_mean_percent"] == found["least_wall_m"] == ""
    assert found["error_seen_frames"] == "0"
    assert float(found["recorded_error_truth_max_percent"]) == pytest.approx(100.0 * 9e-6 / LENGTH)
    assert float(found["least_obstacle_m"]) == 1e-3 - 9e-5
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
    assert found["mean"] == {"error_truth_mean_percent": pytest.approx(MEAN), "error_seen_mean_percent": None}
    assert found["worst"]["error_truth_mean_percent"] == pytest.approx(MEAN)


def test_the_terminal_s_table_fits_and_shows_names_as_they_are():
    text = shown(row("[bold]x"), failed_row("b", "p", "q"))
    for words in ("[bold]x", "10/10", "failed", f"{MEAN:.4f}"):
        assert words in text
    assert "…" not in text


def test_the_silence_of_a_sensor_is_in_table_row_and_headline():
    """4 of 6 minutes without frames read as all of the frames."""
    metrics = RunMetrics(LENGTH)
    for time in np.concatenate([np.arange(0.0, 60.0, 0.5), np.arange(300.0, 360.5, 0.5)]):
        metrics.observe(Observation(round(time * 1e9), np.zeros(2), np.array([1.0, 0.0])))
        metrics.series.add(time, {})
    figures, about = Figures.of(metrics), BagDetails("loop", "/data/loop", "petri", duration=360.0)
    (found,) = read([row_of(about, figures)])
    assert (found["silent_s"], found["max_silence_s"], found["silences"]) == ("240.5", "240.5", "1")
    text = shown(row_of(about, figures), row("other"))
    assert "loop !" in text
    assert "! without frames for 240.5 s in all" in text
    frames = next(each for each in headlines(about, figures) if each.name == "frames predicted")
    assert "none at all for 240 s, the longest 240 s at 59.5 s" in frames.detail
    assert frames.grade == "bad"
