"""Estimating bags of poses: with the thread's centreline whole, ending early, in pieces, or not measured at all."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.bags.message_types import typestore
from magnetosuture_thread.bags.packing import packed_path
from magnetosuture_thread.bags.reader import RecordedMessage
from magnetosuture_thread.bags.reading import path_points, stamp_of
from magnetosuture_thread.commands.evaluate import evaluate_bags
from magnetosuture_thread.commands.render import render_bag
from magnetosuture_thread.evaluation.reference import ReferenceTrajectory
from magnetosuture_thread.rig.setups import read_setup
from magnetosuture_thread.settings.interface import MEASURED_THREAD
from test.bags.bags import changed
from test.conftest import arc

SETUP = read_setup("petri_35mm_polyamide")
STRAIGHT = """
/**: {ros__parameters: {scene: dish_35mm, thread_length: 0.019}}
/**/thread_model: {ros__parameters: {initial_shape: straight}}
"""
FRAMES = 60
NAMES = [f"error_{of}_{which}_percent" for of in ("ground_truth", "measured") for which in ("mean", "max", "max_node")]


@pytest.fixture(scope="module")
def pushed_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a bag of poses in which something that no model knows keeps the thread curved."""
    times = np.linspace(0.0, 2.0, 133)
    tails = np.column_stack([0.002 + 0.002 * times, np.full(133, 0.002)])
    threads = np.stack([arc(tail, np.pi, 60.0) for tail in tails])
    reference = ReferenceTrajectory("pushed", times, tails, np.zeros(133), threads, (), {})
    path = tmp_path_factory.mktemp("pushed") / "pushed"
    render_bag(reference, SETUP, path, pose_noise=1e-5)
    return path


def with_paths(bag: Path, folder: Path, change: Callable[[int, np.ndarray], np.ndarray | None]) -> Path:
    """Write a bag again, each measured centreline as it comes out of a function of its number and points."""
    numbers: dict[int, int] = {}

    def measured(old: RecordedMessage, message: Any) -> Any:
        if old.topic != MEASURED_THREAD.recorded:
            return message
        points = change(numbers.setdefault(stamp_of(old), len(numbers)), path_points(message, old.topic))
        if points is None:
            return None
        return typestore().deserialize_cdr(packed_path(stamp_of(old), points), MEASURED_THREAD.type_name)

    return changed(bag, folder, measured)


def evaluated(bag: Path, folder: Path, **selection: Any) -> tuple[dict[str, Any], str]:
    """Return the row of a bag as in table.json, and its page."""
    evaluate_bags([bag], folder, **selection)
    table = json.loads((folder / "table.json").read_text())
    (row,) = table["bags"]
    assert row["problem"] == ""
    for kind in ("prediction", "estimate"):
        assert list(row[kind]) == NAMES
        assert table[kind] == row[kind]  # of one bag
    return row, (folder / f"{bag.name}.html").read_text()


def test_a_whole_path_corrects_what_the_model_does_not_know(tmp_path: Path, pushed_bag: Path):
    row, page = evaluated(pushed_bag, tmp_path / "out")
    estimate, prediction = row["estimate"], row["prediction"]
    assert estimate["error_ground_truth_mean_percent"] < 0.3 * prediction["error_ground_truth_mean_percent"]
    assert estimate["error_measured_mean_percent"] < 0.3 * prediction["error_measured_mean_percent"]
    assert prediction["error_ground_truth_mean_percent"] == row["error_truth_mean_percent"]
    assert prediction["error_measured_max_percent"] == row["error_seen_max_percent"]
    assert (row["corrected_frames"], row["hidden_time_share"], row["all_hidden_time_share"]) == (FRAMES, 0.0, 0.0)
    assert row["consistency"]["windows"] == 1
    low, high = row["consistency"]["band_95_low"], row["consistency"]["band_95_high"]
    assert 0.8 < low < 1.0 < high < 1.2
    assert row["disturbances"] > 0
    for text in (
        "estimate, against the ground truth",
        'id="plot-consistency"',
        "Disturbances",
    ):
        assert text in page
    assert "a prediction only" not in page


def test_a_path_that_ends_early_is_a_part_and_hides_the_rest(tmp_path: Path, pushed_bag: Path):
    bag = with_paths(pushed_bag, tmp_path / "early", lambda k, points: points[:40] if k >= 30 else points)
    row, _ = evaluated(bag, tmp_path / "out")
    assert row["hidden_time_share"] == pytest.approx(0.5, abs=0.02)
    assert row["all_hidden_time_share"] == 0.0
    assert row["hidden_length_share"] == pytest.approx(0.5 * 24 / 63, abs=0.01)
    assert row["corrected_frames"] == FRAMES
    # A whole thread of 62 % of the length would be bent to fit into the part.
    assert row["estimate"]["error_ground_truth_max_percent"] < row["prediction"]["error_ground_truth_max_percent"]


def test_without_a_measurement_the_estimate_is_the_prediction_and_says_so(tmp_path: Path, pushed_bag: Path):
    setup = tmp_path / "straight.yaml"
    setup.write_text(STRAIGHT)
    blind = with_paths(pushed_bag, tmp_path / "blind", lambda k, points: None)
    row, page = evaluated(blind, tmp_path / "out", setup_name=str(setup))
    assert row["estimate"] == row["prediction"]
    assert row["estimate"]["error_ground_truth_mean_percent"] > 0.0
    assert row["estimate"]["error_measured_mean_percent"] is None
    assert (row["corrected_frames"], row["all_hidden_time_share"], row["disturbances"]) == (0, 1.0, 0)
    assert row["consistency"]["normalised_innovation_squared_mean"] is None
    assert "The estimate is a prediction only:" in page
