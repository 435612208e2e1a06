"""The benchmark of the tracker: its frames show what their ground truth says, and its figures tell right from wrong."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.__main__ import main
from benchmarks.vision.cases import CLASSES
from benchmarks.vision.frames import Case
from benchmarks.vision.measurements import compare, frame_of, row_of
from magnetosuture_thread.vision.tracker import State, Track


def track_of(case: Case, *, turned: float = 0.0, deviation: float = 0.01) -> Track:
    """Return the ground truth as if it had been tracked, with a heading turned by an angle."""
    heading = np.array([math.cos(case.needle.heading + turned), math.sin(case.needle.heading + turned)])
    covariance = np.diag([1e-5**2, 1e-5**2, deviation**2])
    tail, tip = case.needle.tail, case.needle.axis(np.ones(1))[0][0]
    return Track(State.TRACKED, "", 1.0, tail, tip, heading, 0.0, covariance, case.thread, case.view)


@pytest.mark.parametrize("name", sorted(CLASSES))
def test_every_class_draws_a_case_whose_thread_begins_at_the_tail_within_the_dish(name: str):
    case = CLASSES[name](np.random.default_rng(7))
    np.testing.assert_allclose(case.thread[0], case.needle.tail)
    assert np.linalg.norm(case.thread, axis=1).max() < 0.0175
    assert len(case.visible_thread()) > 0


@pytest.mark.parametrize("name", ["fold_4_15_2.5mm", "thread_black_2px", "dark_field"])
def test_a_frame_shows_the_needle_and_the_thread_where_the_ground_truth_has_them(name: str):
    case, image = frame_of(name, 0, 3)
    again = frame_of(name, 0, 3)[1]
    np.testing.assert_array_equal(image, again)
    away = np.abs(image[:, :, 1].astype(float) - float(np.median(image[200:280, 280:360, 1])))
    steel, thread = case.needle.axis(np.linspace(0.1, 0.7, 9))[0], case.visible_thread()[::40]
    for points, contrast in ((steel, 60.0), (thread, 12.0)):
        u, v = np.round(case.view.to_pixels(points)).astype(int).T
        assert np.median([away[b - 1 : b + 2, a - 1 : a + 2].max() for a, b in zip(u, v, strict=True)]) > contrast


def test_right_reversed_and_unknown_poses_are_distinguished():
    case = CLASSES["usual"](np.random.default_rng(2))
    right = compare(case, track_of(case), 0.0)
    assert (right.is_wrong, right.is_reversed, right.honest) == (False, False, True)
    assert right.wrong == 0.0
    assert right.covered == pytest.approx(right.visible)
    turned = compare(case, track_of(case, turned=math.pi), 0.0)
    assert (turned.is_wrong, turned.is_reversed, turned.honest) == (True, True, False)
    unknown = compare(case, track_of(case, turned=math.pi, deviation=math.pi), 0.0)
    assert (unknown.is_wrong, unknown.is_reversed, unknown.honest) == (False, False, True)
    row = row_of("usual", [right, turned, unknown])
    assert (row.found, row.unknown, row.wrong, row.reversed, row.dishonest) == (3, 1, 1, 1, 1)


def test_a_line_beside_the_thread_is_wrong_and_a_hidden_thread_need_not_be_followed():
    case = CLASSES["cover_6mm"](np.random.default_rng(2))
    seen = compare(case, track_of(case), 0.0)
    assert seen.visible < 0.85 * 0.028
    assert seen.covered == pytest.approx(seen.visible)
    aside = compare(case, replace(track_of(case), centreline=case.thread + np.array([0.0, 3e-3])), 0.0)
    assert aside.wrong > 0.8 * aside.line


def test_its_figures_are_written_and_one_frame_is_saved(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    figures, picture = tmp_path / "figures.json", tmp_path / "frame.png"
    assert main(["vision", "--count", "1", "--seed", "4", "--classes", "usual", "--json", str(figures)]) == 0
    assert "usual" in capsys.readouterr().out
    (row,) = json.loads(figures.read_text())["rows"]
    assert (row["name"], row["frames"], row["reversed"]) == ("usual", 1, 0)
    assert main(["vision", "--seed", "4", "--save", "usual", "0", str(picture)]) == 0
    np.testing.assert_array_equal(cv2.imread(str(picture)), frame_of("usual", 0, 4)[1])
    assert main(["vision", "--classes", "moon"]) == 2
    assert main(["vision", "--save", "moon", "0", str(picture)]) == 2
    assert "usual" in capsys.readouterr().err
