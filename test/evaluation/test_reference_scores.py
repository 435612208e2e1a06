"""Scores on reference trajectories."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.errors import BagError
from magnetosuture_thread.evaluation.plots import draw_case
from magnetosuture_thread.evaluation.reference_scores import (
    CaseResult,
    Evaluation,
    find_references,
    score,
)
from magnetosuture_thread.evaluation.tables import evaluation_table

MATERIAL = {
    "kind": "polyamide USP 7-0 monofilament",
    "L_m": 0.019,
    "EI_Nm2": 1.27e-9,
    "zeta_perp_Pa_s": 0.974,
    "zeta_par_Pa_s": 0.487,
    "diameter_m": 6e-5,
    "paper_nodes": 25,
}


def write(folder: Path, name: str, offset: float = 0.0, **changes: Any) -> Path:
    """Write a straight thread that is pulled along itself, its truth off by a length to one side from then on."""
    times = np.arange(40) / 66.0
    tails = np.column_stack([5e-3 * times, np.zeros(40), np.zeros(40)])
    curve = np.column_stack([-np.linspace(0.0, 0.019, 101), np.zeros(101)])
    threads = curve + tails[:, None, :2]
    threads[1:, :, 1] += offset
    metadata = {"name": name, "material": MATERIAL, "boundary": "pinned", "obstacle": None, **changes}
    path = folder / f"{name}.npz"
    np.savez(path, t=times, pose=tails, X=threads, meta=json.dumps(metadata))
    return path


def scored(paths: list[Path], formulation: str = "rod", solver: str = "banded") -> tuple[Evaluation, list[CaseResult]]:
    """Return the scores and the results."""
    results: list[CaseResult] = []
    shares: list[float] = []
    found = score(paths, formulation=formulation, solver=solver, progress=shares.append, keep=results.append)
    return found, results


@pytest.mark.parametrize("solver", ["banded", "osqp"])
def test_a_thread_that_follows_its_needle_is_predicted(tmp_path: Path, solver: str):
    found, results = scored([write(tmp_path, "straight")], solver=solver)
    case = found.cases[0]
    assert case.mean_error_percent < 1e-3
    assert case.max_stretch < 1e-4
    assert case.max_residual < 1e-6
    assert case.max_penetration_m == 0.0
    assert case.fallbacks == 0
    assert 0.0 < case.step_median_s <= case.step_p99_s
    assert results[0].vertices.shape == (40, 26, 2)


def test_the_error_is_in_percent_of_the_length_and_over_all_samples(tmp_path: Path):
    found, results = scored([write(tmp_path, "straight"), write(tmp_path, "off", offset=1.9e-4)])
    assert found.cases[1].max_error_percent == pytest.approx(1.0, rel=1e-5)
    assert found.cases[1].mean_error_percent == pytest.approx(39.0 / 40.0, rel=1e-5)  # the first is right
    assert found.worst_error_percent == found.cases[1].mean_error_percent
    assert found.mean_error_percent == pytest.approx(0.5 * found.worst_error_percent, rel=1e-3)
    assert results[1].error_percent[0] == 0.0


def test_the_depth_in_an_obstacle_is_seen(tmp_path: Path):
    """The needle pulls nodes around a disc that they start inside of, so the first samples are too deep."""
    obstacle = {"type": "disc", "cx": -0.0105, "cy": 0.0, "R": 3e-4}
    found, _ = scored([write(tmp_path, "inside", obstacle=obstacle)], formulation="paper")
    assert found.cases[0].max_penetration_m > 1e-5


def test_the_mapping_is_what_was_promised(tmp_path: Path):
    mapping = scored([write(tmp_path, "straight")], formulation="paper")[0].to_mapping()
    assert json.loads(json.dumps(mapping)) == mapping
    assert set(mapping) == {"formulation", "solver", "cases", "mean_error_percent", "worst_error_percent"}
    assert {
        "name",
        "mean_error_percent",
        "max_error_percent",
        "max_stretch",
        "max_penetration_m",
        "step_median_s",
        "step_p99_s",
    } <= set(mapping["cases"][0])
    assert (mapping["formulation"], mapping["solver"]) == ("paper", "banded")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"material": None}, "has no thread in its metadata"),
        ({"material": {**MATERIAL, "L_m": "long"}}, "has no thread in its metadata"),
        ({"material": {k: v for k, v in MATERIAL.items() if k != "EI_Nm2"}}, "EI_Nm2"),
        ({"material": {**MATERIAL, "L_m": -0.019}}, "thread.length: got -0.019"),
        ({"material": {**MATERIAL, "EI_Nm2": float("inf")}}, "thread.bending_stiffness: got inf"),
        ({"material": {**MATERIAL, "EI_Nm2": 0.0}}, "not positive"),
        ({"boundary": "knotted"}, "knotted"),
    ],
)
def test_a_file_without_a_thread_is_refused(tmp_path: Path, changes: dict[str, Any], words: str):
    with pytest.raises(BagError, match=words):
        scored([write(tmp_path, "bad", **changes)])


def test_a_folder_without_trajectories_is_refused(tmp_path: Path):
    with pytest.raises(BagError, match="holds no reference trajectories"):
        find_references(tmp_path)
    with pytest.raises(BagError, match="does not exist"):
        find_references(tmp_path / "nowhere")
    path = write(tmp_path, "one")
    assert find_references(tmp_path) == [path] == find_references(path)


def test_a_table_and_a_picture_can_be_made(tmp_path: Path):
    found, results = scored([write(tmp_path, "straight", obstacle={"cx": 0.0, "cy": 0.01, "R": 2e-3})])
    assert evaluation_table(found).row_count == 3
    picture = tmp_path / "straight.png"
    draw_case(picture, results[0], "rod")
    assert picture.read_bytes().startswith(b"\x89PNG")
