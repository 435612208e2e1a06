"""The frames of the benchmark of the tracker, and what is found of them."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.__main__ import main
from benchmarks.vision.cases import CLASSES, Frame, render
from benchmarks.vision.measurements import measure, random_of

ELSEWHERE = np.array([0.0, 5e-3])  # m


@pytest.fixture(scope="module")
def frame() -> Frame:
    """A frame that the tracker gets right."""
    return render(CLASSES["usual"], random_of("usual", 3, 0))


def test_a_frame_depends_on_its_class_seed_and_number_alone(frame: Frame):
    again = render(CLASSES["usual"], random_of("usual", 3, 0))
    np.testing.assert_array_equal(again.thread, frame.thread)
    assert again.heading == frame.heading
    assert render(CLASSES["usual"], random_of("usual", 3, 1)).heading != frame.heading


def test_a_right_pose_and_a_right_centreline_are_counted_as_such(frame: Frame):
    found = measure(frame)
    assert found.found
    assert not found.wrong
    assert found.off_px < 1.0
    assert found.covered > 0.9
    assert found.astray < 0.02


def test_a_reversed_heading_and_a_centreline_elsewhere_are_noticed(frame: Frame):
    other = replace(frame, heading=frame.heading + math.pi, thread=frame.tail + 1.4 * (frame.thread - frame.tail))
    found = measure(other)
    assert found.wrong
    assert found.is_reversed
    assert found.astray > 0.2


def test_only_the_visible_thread_is_asked_for(frame: Frame):
    visible = np.arange(len(frame.thread)) < 20
    assert measure(replace(frame, thread=frame.thread + ELSEWHERE, visible=~visible)).covered < 0.5
    half = len(frame.thread) // 2
    bent = np.vstack([frame.thread[:half], frame.thread[half:] + ELSEWHERE])
    assert measure(replace(frame, thread=bent, visible=np.arange(len(bent)) < half)).covered > 0.9


@pytest.mark.parametrize(("name", "low", "high"), [("fold_04_15_2.5mm", 4.0, 15.0), ("fold_26_50_7mm", 26.0, 50.0)])
def test_folded_threads_leave_as_their_class_says(name: str, low: float, high: float):
    frame = render(CLASSES[name], random_of(name, 1, 0))
    along = frame.thread[3] - frame.thread[0]
    turned = math.degrees(math.atan2(along[1], along[0]) - frame.heading)
    assert low - 1.0 < abs((turned + 180.0) % 360.0 - 180.0) < high + 1.0


def test_the_command_writes_its_figures_and_pictures(tmp_path: Path):
    file = tmp_path / "figures.json"
    assert main(["vision", "--classes", "usual", "--count", "2", "--seed", "3", "--json", str(file)]) == 0
    figures = json.loads(file.read_text())
    assert [row["name"] for row in figures["classes"]] == ["usual", "usual_2.5mm"]
    assert all(row["frames"] == 2 and row["wrong"] == 0 for row in figures["classes"])
    assert main(["vision", "--classes", "tilt_10", "--save", str(tmp_path / "frames")]) == 0
    picture = cv2.imread(str(tmp_path / "frames" / "tilt_10.png"))
    assert picture is not None
    assert picture.shape == (480, 640, 3)
