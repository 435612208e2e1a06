"""The table over bags, as a file by its name's ending and for a terminal."""

from __future__ import annotations

import csv
import io
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from magnetosuture_thread.commands.evaluate import bags_table
from magnetosuture_thread.evaluation.frames import Observation
from magnetosuture_thread.evaluation.metrics import Percentiles, RunMetrics, SensorSilence
from magnetosuture_thread.evaluation.tables import (
    Row,
    bags_document,
    check_table,
    failed_row,
    flat,
    row_of,
    table_csv,
    write_table,
)
from magnetosuture_thread.settings.errors import ConfigurationError
from test.evaluation.runs import LENGTH, made_metrics

MEAN = 100.0 * 2e-6 * 4.5 / LENGTH  # %, of ten frames


def row(name: str, simulated: str = "") -> Row:
    """Return the row of a bag."""
    latency = {"frame to prediction": Percentiles(0.012, 0.018, 0.02)}
    metrics = made_metrics(10, ("truth",))
    return row_of(metrics, SensorSilence(), latency, bag=name, setup="petri", simulated=simulated, duration_s=0.3)


def shown(*rows: Row) -> str:
    """Return the table as a terminal of 80 columns shows it."""
    console = Console(width=80, file=io.StringIO(), record=True)
    console.print(bags_table(rows))
    return console.export_text()


def test_a_table_is_written_as_its_name_ends_with_all_digits(tmp_path: Path):
    parquet = pytest.importorskip("pyarrow.parquet")
    rows = [row("a"), failed_row("b", "/data/b", "is broken")]
    for ending in ("json", "csv", "parquet"):
        check_table(tmp_path / f"table.{ending}")
        write_table(tmp_path / f"table.{ending}", rows, bags_document(rows))
    document = json.loads((tmp_path / "table.json").read_text())
    assert document["bags"] == rows
    assert document["mean"] == {"error_truth_mean_percent": pytest.approx(MEAN), "error_seen_mean_percent": None}
    assert document["worst"]["error_truth_mean_percent"] == pytest.approx(MEAN)
    with (tmp_path / "table.csv").open(newline="") as stream:
        first, second = csv.DictReader(stream)
    assert tuple(first) == tuple(flat(row("a")))  # each value of a mapping has a column
    assert float(first["error_truth_mean_percent"]) == pytest.approx(MEAN, rel=1e-12)
    assert first["error_seen_mean_percent"] == first["least_wall_m"] == ""
    assert float(first["recorded_error_truth_max_percent"]) == pytest.approx(100.0 * 9e-6 / LENGTH)
    assert float(first["least_obstacle_m"]) == 1e-3 - 9e-5
    assert float(first["latency_frame_to_prediction_p99_s"]) == 0.018
    assert (first["simulated"], second["problem"]) == ("", "is broken")
    assert parquet.read_table(tmp_path / "table.parquet").to_pylist()[0] == flat(row("a"))


def test_a_table_that_cannot_be_written_is_refused_before_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(ConfigurationError, match=r"ends in \.json, \.csv, \.parquet"):
        check_table(tmp_path / "table.xlsx")
    (tmp_path / "pyarrow.py").write_text("raise ImportError('it is built for another NumPy')")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "pyarrow", raising=False)
    with pytest.raises(ConfigurationError, match=r"extra `cluster`.*another NumPy"):
        check_table(tmp_path / "table.parquet")


@pytest.mark.parametrize("name", ["=cmd()", "+1", "-1", "@x", "\tx", 'a "b", c\nd', "ö"])
def test_any_name_is_one_cell_and_none_is_a_formula(name: str):
    (found,) = csv.DictReader(io.StringIO(table_csv([row(name, simulated=name)]), newline=""))
    assert found["bag"].removeprefix("'") == found["simulated"].removeprefix("'") == name
    assert not found["bag"].startswith(("=", "+", "-", "@", "\t", "\r"))
    assert found["setup"] == "petri"


def test_the_terminal_s_table_fits_and_shows_names_as_they_are():
    text = shown(row("[bold]x"), failed_row("b", "p", "q"))
    for words in ("[bold]x", "10/10", "failed", f"{MEAN:.3g}"):
        assert words in text
    assert "…" not in text


def test_the_silence_of_a_sensor_is_in_row_and_table():
    """4 of 6 minutes without frames read as all of the frames."""
    metrics = RunMetrics(LENGTH)
    for time in np.concatenate([np.arange(0.0, 60.0, 0.5), np.arange(300.0, 360.5, 0.5)]):
        metrics.observe(Observation(round(time * 1e9), np.zeros(2), np.array([1.0, 0.0])))
        metrics.series.add(time, {})
    found = row_of(metrics, SensorSilence.of(metrics.observed.times, 0.0, 360.0), bag="loop")
    assert (found["silent_s"], found["max_silence_s"], found["silences"]) == (240.5, 240.5, 1)
    text = " ".join(shown(found, row("other")).split())
    assert "loop !" in text
    assert "! frames are missing for 240.5 s, 240.5 s at the longest" in text
