"""Reference trajectories, and scores on them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.evaluation.plots import draw_metrics
from magnetosuture_thread.evaluation.reference import (
    Evaluation,
    find_references,
    read_reference,
    score,
    score_rig,
)
from magnetosuture_thread.settings.errors import BagError
from test.shared import known

MATERIAL = {
    "kind": "polyamide USP 7-0 monofilament",
    "L_m": 0.019,
    "EI_Nm2": 1.27e-9,
    "EA_N": 5.0,
    "zeta_perp_Pa_s": 0.974,
    "zeta_par_Pa_s": 0.487,
    "diameter_m": 6e-5,
    "paper_nodes": 25,
}
TIMES = np.arange(40) / 66.0


def write(folder: Path, name: str, offset: float = 0.0, arrays: dict[str, Any] | None = None, **changes: Any) -> Path:
    """Write a straight thread that is pulled along itself, its truth off by a length to one side from then on.

    `arrays` are in place of the file's, `changes` of entries of its metadata.
    """
    poses = np.column_stack([5e-3 * TIMES, np.zeros(40), 0.1 * TIMES])
    threads = np.column_stack([-np.linspace(0.0, 0.019, 101), np.zeros(101)]) + poses[:, None, :2]
    threads[1:, :, 1] += offset
    metadata = {"name": name, "material": MATERIAL, "boundary": "pinned", "obstacle": None, **changes}
    content = {"t": TIMES, "pose": poses, "X": threads, "meta": json.dumps(metadata), **(arrays or {})}
    path = folder / f"{name}.npz"
    np.savez(path, **{key: value for key, value in content.items() if value is not None})
    return path


def no_progress(share: float) -> None:
    """Show nothing."""


def scored(paths: list[Path], formulation: str = "rod", solver: str = "banded") -> Evaluation:
    """Return the results."""
    return score(paths, formulation=formulation, solver=solver, progress=no_progress)


def test_a_trajectory_is_read_and_interpolated(tmp_path: Path):
    path = write(tmp_path, "small", obstacle={"type": "circle", "cx": 0.1, "cy": 0.2, "R": 0.05})
    assert find_references(tmp_path) == [path] == find_references(path)
    reference = read_reference(path)
    assert (reference.name, reference.discs[0].radius) == ("small", 0.05)
    tail, heading, thread = reference.at(0.2)
    assert tail == pytest.approx([1e-3, 0.0])
    assert heading == pytest.approx(0.02)
    assert thread[[0, -1], 0] == pytest.approx([1e-3, 1e-3 - 0.019])


def test_the_references_that_ship_give_the_error_that_the_readme_states():
    found = scored(find_references(Path(__file__).parents[2] / "examples" / "reference"))
    assert len(found.cases) == 12
    assert round(found.mean_error_percent, 3) == 0.013
    assert round(found.worst_error_percent, 3) == 0.032


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"X": None}, "the keys t, pose, X, meta"),
        ({"meta": "no json"}, "the keys t, pose, X, meta"),
        ({"meta": json.dumps({"obstacle": {"R": 1.0}})}, "the keys t, pose, X, meta"),
        ({"pose": np.zeros((40, 2))}, r"pose \(40, 2\)"),
        ({"t": np.zeros(40)}, "times that do not increase"),
        ({"pose": np.full((40, 3), np.nan)}, "not finite"),
        (lambda whole: b"hello", "no reference trajectory"),
        (lambda whole: whole[:200] + bytes(60) + whole[260:], "no reference trajectory"),
    ],
)
def test_what_is_no_trajectory_is_refused(tmp_path: Path, arrays: Any, words: str):
    path = write(tmp_path, "bad", arrays=None if callable(arrays) else arrays)
    if callable(arrays):
        path.write_bytes(arrays(path.read_bytes()))
    with pytest.raises(BagError, match=rf"bad\.npz.*{words}"):
        read_reference(path)


def test_a_missing_file_is_refused(tmp_path: Path):
    with pytest.raises(BagError, match="holds no reference trajectories"):
        find_references(tmp_path)
    for missing in (find_references, read_reference):
        with pytest.raises(BagError, match="does not exist"):
            missing(tmp_path / "none.npz")


@pytest.mark.parametrize("solver", ["banded", "osqp"])
def test_errors_are_in_percent_of_the_length_and_over_all_samples(tmp_path: Path, solver: str):
    paths = [write(tmp_path, "straight"), write(tmp_path, "off", offset=1.9e-4)]
    found = scored(paths, solver=solver)
    straight, off = found.cases
    assert straight.mean_error_percent < 1e-3  # it follows its needle
    assert straight.max_stretch < 1e-4
    assert straight.max_residual < 1e-6
    assert (straight.max_penetration_m, straight.fallbacks) == (0.0, 0)
    assert 0.0 < straight.step_median_s <= straight.step_p99_s
    assert found.results[0].vertices.shape == (40, 26, 2)
    assert off.max_error_percent == pytest.approx(1.0, rel=1e-4)
    assert off.mean_error_percent == pytest.approx(39.0 / 40.0, rel=1e-4)  # the first is right
    assert found.worst_error_percent == off.mean_error_percent
    assert found.mean_error_percent == pytest.approx(0.5 * found.worst_error_percent, rel=1e-3)
    mapping = found.to_mapping()
    assert json.loads(json.dumps(mapping)) == mapping
    assert set(mapping) == {"formulation", "solver", "cases", "mean_error_percent", "worst_error_percent"}
    metrics = found.results[1].metrics
    assert known(metrics.worst).error == pytest.approx(1.0, rel=1e-4)
    assert draw_metrics(metrics, "off", 0.05).startswith(b"\x89PNG")


def test_the_depth_in_an_obstacle_is_seen(tmp_path: Path):
    """The needle pulls nodes around a disc that they start inside of, so the first samples are too deep."""
    obstacle = {"type": "disc", "cx": -0.0105, "cy": 0.0, "R": 3e-4}
    found = scored([write(tmp_path, "inside", obstacle=obstacle)], formulation="paper")
    assert found.cases[0].max_penetration_m > 1e-5


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"material": None}, "has no thread in its metadata"),
        ({"material": {**MATERIAL, "L_m": "long"}}, "has no thread in its metadata"),
        ({"material": {**MATERIAL, "L_m": -0.019}}, "thread.length: got -0.019"),
        ({"material": {**MATERIAL, "EI_Nm2": 0.0}}, "not positive"),
        ({"boundary": "knotted"}, "knotted"),
    ],
)
def test_a_file_without_a_thread_is_refused(tmp_path: Path, changes: dict[str, Any], words: str):
    with pytest.raises(BagError, match=words):
        scored([write(tmp_path, "bad", **changes)])


def test_the_rigs_thread_follows_one_that_is_pulled(tmp_path: Path):
    evaluation = score_rig([write(tmp_path, "pulled")], segments=19, progress=no_progress)
    kept = [result.reference.name for result in evaluation.results]
    case = evaluation.cases[0]
    assert (evaluation.formulation, case.name, kept, case.fallbacks) == ("rig", "pulled", ["pulled"], 0)
    assert case.max_error_percent < 1e-3
    # Pulled by its own drag, half a segment less at the tail.
    assert case.max_stretch == pytest.approx(0.487 * 0.0185 * 5e-3 / 5.0, rel=1e-3)
    assert case.max_residual < 1e-6


@pytest.mark.parametrize("changes", [{"boundary": "loose"}, {"material": {}}, {"material": {**MATERIAL, "EA_N": 0.0}}])
def test_metadata_without_a_thread_of_the_rig_are_refused(tmp_path: Path, changes: dict[str, Any]):
    with pytest.raises(BagError, match=r"bad\.npz: has"):
        score_rig([write(tmp_path, "bad", **changes)], progress=no_progress)
