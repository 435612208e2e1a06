"""Reference trajectories."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.errors import BagError
from magnetosuture_thread.evaluation.reference import read_reference


def save(path: Path, **changes: object) -> Path:
    """Write a small trajectory, with some of its arrays changed."""
    times = np.linspace(0.0, 1.0, 11)
    threads = np.zeros((11, 5, 2))
    threads[:, :, 0] = times[:, None] - 0.01 * np.arange(5)
    obstacle = {"type": "circle", "cx": 0.1, "cy": 0.2, "R": 0.05}
    content: dict[str, Any] = {
        "t": times,
        "pose": np.column_stack([times, np.zeros(11), 0.1 * times]),
        "X": threads,
        "meta": json.dumps({"name": "small", "obstacle": obstacle}),
    }
    content.update(changes)
    np.savez(path, **{key: value for key, value in content.items() if value is not None})
    return path


def test_a_trajectory_is_read_and_interpolated(tmp_path: Path):
    reference = read_reference(save(tmp_path / "small.npz"))
    assert reference.name == "small"
    assert reference.discs[0].radius == 0.05
    tail, heading, thread = reference.at(0.55)
    assert tail == pytest.approx([0.55, 0.0])
    assert heading == pytest.approx(0.055)
    assert thread[:, 0] == pytest.approx(0.55 - 0.01 * np.arange(5))
    assert reference.at(1.0)[0] == pytest.approx([1.0, 0.0])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"X": None}, "the keys t, pose, X, meta"),
        ({"meta": "no json"}, "the keys t, pose, X, meta"),
        ({"pose": np.zeros((11, 2))}, "pose (11, 2)"),
        ({"t": np.zeros(11)}, "times that do not increase"),
        ({"pose": np.full((11, 3), np.nan)}, "not finite"),
        ({"t": np.append(np.arange(10.0), np.inf)}, "not finite"),
        ({"meta": "[1, 2]"}, "the keys t, pose, X, meta"),
        ({"meta": json.dumps({"obstacle": {"R": 1.0}})}, "the keys t, pose, X, meta"),
    ],
)
def test_what_is_no_trajectory_is_refused(tmp_path: Path, changes: dict[str, object], words: str):
    path = save(tmp_path / "bad.npz", **changes)
    with pytest.raises(BagError) as caught:
        read_reference(path)
    assert words in str(caught.value)
    assert str(path) in str(caught.value)


def test_a_missing_or_broken_file_is_refused(tmp_path: Path):
    with pytest.raises(BagError, match="does not exist"):
        read_reference(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("hello")
    np.save(tmp_path / "array.npy", np.zeros(3))
    whole = save(tmp_path / "whole.npz").read_bytes()
    (tmp_path / "damaged.npz").write_bytes(whole[:200] + bytes(60) + whole[260:])
    for name in ("text.npz", "array.npy", "damaged.npz"):
        with pytest.raises(BagError, match="no reference trajectory"):
            read_reference(tmp_path / name)
