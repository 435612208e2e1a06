"""Evaluating bags: pictures and table, whatever becomes of one of the bags."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from magnetosuture_thread import cli, replay_offline
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.commands.evaluate import evaluate_bags, find_bags
from magnetosuture_thread.settings.errors import BagError, ConfigurationError
from magnetosuture_thread.settings.interface import NEEDLE_POSE, PREDICTED_THREAD
from test.bags.bags import changed, copy_with_notes


def broken(path: Path) -> Path:
    """Make a bag of which nothing can be read."""
    path.mkdir()
    (path / "broken.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    return path


def test_a_bag_gets_a_picture_and_a_row(tmp_path: Path, short_bag: Path):
    (row,) = evaluate_bags([short_bag], tmp_path / "out")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"pull.png", "table.json"}
    assert row["bag"] == "pull"
    assert "straight_pull" in str(row["simulated"])
    assert (row["frames"], row["predicted"], row["problem"]) == (30, 28, "")
    assert 0.0 < float(str(row["error_truth_mean_percent"])) < 1.0
    assert 0.0 < float(str(row["error_seen_mean_percent"])) < 1.0
    assert row["recorded_error_truth_frames"] == 0
    (written,) = json.loads((tmp_path / "out" / "table.json").read_text())["bags"]
    assert written == row
    assert 0.0 < written["estimate"]["error_ground_truth_mean_percent"] < 1.0
    assert written["prediction"]["error_ground_truth_mean_percent"] == row["error_truth_mean_percent"]
    assert (tmp_path / "out" / "pull.png").read_bytes().startswith(b"\x89PNG")


def test_what_is_wrong_with_one_bag_is_in_its_row_and_ends_with_1(tmp_path: Path, short_bag: Path, capsys):
    copy_with_notes(short_bag, tmp_path / "again" / "pull", unverified="salvaged without checksums")
    bags = [str(broken(tmp_path / "=x")), str(short_bag), str(tmp_path / "again" / "pull")]
    output = tmp_path / "out"
    options = ["--output", str(output), "--duration", "0.4", "--table", str(tmp_path / "t.csv")]
    assert cli.main(["evaluate", *bags, *options]) == 1
    assert "=x: " in capsys.readouterr().out
    rows = json.loads((output / "table.json").read_text())["bags"]
    assert "nothing intact" in rows[0]["problem"]
    assert [row["problem"] for row in rows[1:]] == ["", ""]
    assert [row["unverified"] for row in rows[1:]] == ["", "salvaged without checksums"]
    assert {path.name for path in output.glob("*.png")} == {"pull.png", "pull-2.png"}
    with (tmp_path / "t.csv").open(newline="") as stream:
        assert [row["bag"] for row in csv.DictReader(stream)] == ["'=x", "pull", "pull-2"]


def test_what_the_bag_itself_predicted_is_judged_beside(tmp_path: Path, short_bag: Path):
    replay_offline(short_bag, tmp_path / "replay")
    replayed, said = Bag(tmp_path / "replay" / "bag"), {each.recorded: each for each in (NEEDLE_POSE, PREDICTED_THREAD)}
    late = [(said[each.topic], each.time + 20_000_000, each.decode()) for each in replayed.records(set(said))]
    seen = {"/camera/image_raw/compressed", "/ground_truth/thread"}
    notes = {"setup": "petri_35mm_polyamide"}
    both = changed(short_bag, tmp_path / "both", lambda old, it: it if old.topic in seen else None, late, notes)
    (row,) = evaluate_bags([both], tmp_path / "out")
    assert row["recorded_error_truth_frames"] == 28
    assert row["recorded_error_truth_mean_percent"] == pytest.approx(row["error_truth_mean_percent"], abs=1e-9)
    assert row["latency_frame_to_prediction_median_s"] == pytest.approx(0.02)
    assert row["latency_command_to_currents_median_s"] is None
    assert row["simulated"] == ""


def test_what_is_wrong_for_all_bags_is_said_at_once(tmp_path: Path, short_bag: Path):
    for paths, output, setup, error, words in (
        ([short_bag], tmp_path / "out", "none", ConfigurationError, "setup: got 'none'"),
        ([short_bag], tmp_path, "", BagError, "exists already"),
        ([tmp_path], tmp_path / "out", "", BagError, "holds no bags"),
        ([tmp_path / "none"], tmp_path / "out", "", BagError, "does not exist"),
    ):
        with pytest.raises(error, match=words):
            evaluate_bags(paths, output, setup_name=setup)
    assert list(tmp_path.iterdir()) == []


def touched(*paths: Path) -> None:
    """Make empty files, with their folders."""
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def test_bags_are_found_two_folders_down_each_once(tmp_path: Path):
    touched(tmp_path / "b" / "b_0.mcap", tmp_path / "b" / "metadata.yaml", tmp_path / "c" / "d" / "one.db3")
    touched(tmp_path / "c" / "e" / "x.mcap", tmp_path / "c" / "e" / "y.mcap", tmp_path / "c" / "f" / "g" / "deep.mcap")
    touched(tmp_path / "s" / "s_0.mcap", tmp_path / "s" / "s_1.mcap", tmp_path / ".hidden" / "h.mcap")
    found = [str(path.relative_to(tmp_path)) for path in find_bags([tmp_path / "b", tmp_path])]
    assert found == ["b", "c/d", "c/e/x.mcap", "c/e/y.mcap", "s"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["b", "--table", "t.xls"], "--table: got 't.xls'"),
        (["b", "--output", "o", "--segments", "9"], "only for reference trajectories"),
        (["r", "--setup", "x"], "only for bags"),
    ],
)
def test_options_of_the_other_kind_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch, arguments: list[str], words: str
):
    touched(tmp_path / "r" / "a.npz", tmp_path / "b" / "b.mcap")
    monkeypatch.chdir(tmp_path)
    assert cli.main(["evaluate", *arguments]) == 2
    assert words in capsys.readouterr().err
