"""The table over bags, as a file by its name's ending and for a terminal."""

from __future__ import annotations

import csv
import io
import json
import sys
from pathlib import Path

import pytest

from magnetosuture_thread.evaluation.metrics import Percentiles, SensorSilence
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

NASTY = "a\x1b[31m\u202eb\x9b1m"
MEAN = 100.0 * 2e-6 * 4.5 / LENGTH  # %, of ten frames


def row(name: str, simulated: str = "") -> Row:
    """Return the row of a bag."""
    latency = {"frame to prediction": Percentiles(0.012, 0.018, 0.02)}
    metrics = made_metrics(10)
    return row_of(metrics, SensorSilence(), latency, bag=name, setup="petri", simulated=simulated, duration_s=0.3)


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


def test_names_are_escaped():
    table = table_csv([failed_row(NASTY, NASTY, NASTY)])
    assert not set(table) & {"\x1b", "\u202e", "\x9b"}
    assert r"\x1b" in table


@pytest.mark.parametrize("name", ["=cmd()", "+1", "-1", "@x", "\tx", 'a "b", c\nd', "ö"])
def test_any_name_is_one_cell_and_none_is_a_formula(name: str):
    (found,) = csv.DictReader(io.StringIO(table_csv([row(name, simulated=name)]), newline=""))
    assert found["bag"].removeprefix("'") == found["simulated"].removeprefix("'") == name
    assert not found["bag"].startswith(("=", "+", "-", "@", "\t", "\r"))
    assert found["setup"] == "petri"
