"""Estimating bags of poses: with the thread's centreline whole, ending early, in pieces, or not measured at all."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.commands.evaluate import evaluate_bags
from magnetosuture_thread.commands.render import render_bag
from magnetosuture_thread.evaluation.reference import ReferenceTrajectory
from magnetosuture_thread.rig.setups import read_setup
from test.conftest import arc

SETUP = read_setup("petri_35mm_polyamide")
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


def evaluated(bag: Path, folder: Path, **selection: Any) -> dict[str, Any]:
    """Return the row of a bag as in table.json."""
    evaluate_bags([bag], folder, **selection)
    table = json.loads((folder / "table.json").read_text())
    (row,) = table["bags"]
    assert row["problem"] == ""
    for kind in ("prediction", "estimate"):
        assert list(row[kind]) == NAMES
        assert table[kind] == row[kind]  # of one bag
    return dict(row)


def test_a_whole_path_corrects_what_the_model_does_not_know(tmp_path: Path, pushed_bag: Path):
    row = evaluated(pushed_bag, tmp_path / "out")
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
