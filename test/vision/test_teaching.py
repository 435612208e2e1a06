"""What one marked frame teaches, against drawn ground truth."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from magnetosuture_thread import cli
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.settings.errors import InvalidInputError
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.teaching import teach
from magnetosuture_thread.vision.tracker import UNDIRECTED, VisionTracker
from test.shared import known
from test.vision.scenes import VIEW, Pose, render
from test.vision.test_rods import DIAMETER, Rod, is_along, tracker_of

FLOOR = np.array([200.0, 205.0, 210.0])  # blue, green, red
COPPER = np.array([60.0, 75.0, 165.0])  # as bright in red as a thing that is passed over


def copper_frame(seed: int, turned: float = 0.0) -> tuple[np.ndarray, np.ndarray, VisionTrackerSettings]:
    """Return a frame with a rod of copper, its ends (u, v) [px], and its true size."""
    grey, ends, told = Rod(seed, share=0.02, turned=turned).drawn()
    bare = np.clip((grey.astype(float) - 40.0) / (np.median(grey) - 40.0), 0.0, 1.0)[..., None]
    noise = np.random.default_rng(seed).normal(0.0, 2.5, (*grey.shape, 3))
    image = np.clip(COPPER + bare * (FLOOR - COPPER) + noise, 0.0, 255.0).astype(np.uint8)
    size = replace(told, needle_length=told.needle_length / 1.03, needle_width=told.needle_width / 0.95)
    return image, ends, size


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("off", [0.0, 0.125])
def test_marks_that_are_off_teach_the_size_and_the_colours_of_a_needle(seed: int, off: float):
    image, ends, true = copper_frame(seed)
    random, usual = np.random.default_rng(seed), VisionTrackerSettings()
    view = known(tracker_of(usual).look(image).view)
    angles = random.uniform(-np.pi, np.pi, 2)
    marks = ends + off * math.dist(*ends) * np.column_stack([np.cos(angles), np.sin(angles)])
    taught = teach(image, view, 0.5 * DIAMETER, marks, usual)
    assert taught.settings.needle_length == pytest.approx(true.needle_length, rel=0.05)
    assert taught.settings.needle_width == pytest.approx(true.needle_width, rel=0.15, abs=1.0 * view.metres_per_pixel)
    assert taught.settings.needle_is_blunt
    assert np.abs(taught.ends - ends).max() < 2.0 + 0.03 * math.dist(*ends)
    scores = [score for _, score in taught.answers]
    assert scores[0] > 0.8
    assert all(score < 0.6 * scores[0] for score in scores[1:])
    for turned in (0.7, 2.1):
        other, other_ends, _ = copper_frame(seed, turned)
        seen = tracker_of(taught.settings).look(other)
        assert seen.reason == UNDIRECTED
        assert is_along(seen, other_ends) or is_along(seen, other_ends[::-1])
        # With its size alone it is too bright in red.
        assert not len(tracker_of(true).look(other).axis)
    without = np.clip(FLOOR + random.normal(0.0, 2.5, image.shape), 0.0, 255.0).astype(np.uint8)
    inside = np.hypot(*(np.indices(image.shape[:2])[::-1] - np.array(view.centre_px)[:, None, None])) < 170.0
    assert not len(tracker_of(taught.settings).look(np.where(inside[..., None], without, image)).axis)


def test_a_pointed_needle_is_not_taught_to_be_blunt():
    pose = Pose(np.array([0.002, -0.003]), 0.6)
    marks = VIEW.to_pixels(np.array([pose.tail, pose.at(1.0)]))
    taught = teach(render(pose), VIEW, 0.0175, marks, VisionTrackerSettings())
    assert not taught.settings.needle_is_blunt
    assert taught.settings.needle_length == pytest.approx(0.007, rel=0.06)
    assert pose.is_right(VisionTracker(taught.settings, Scene()).look(render(Pose(pose.tail, 0.6))))


@pytest.mark.parametrize(
    ("marks", "words"),
    [
        ([[300.0, 200.0], [380.0, 220.0]], "of the light of the floor"),
        ([[300.0, 200.0], [304.0, 203.0]], "at least 12 px apart"),
        ([[10.0, 20.0], [90.0, 20.0]], "tail and tip in the dish"),
    ],
)
def test_marks_without_a_needle_between_them_are_refused(marks: list[list[float]], words: str):
    frame = render(Pose(np.array([0.002, -0.009]), 0.0))
    with pytest.raises(InvalidInputError, match=words):
        teach(frame, VIEW, 0.0175, np.array(marks), VisionTrackerSettings())


def test_the_command_writes_what_track_takes_and_counts_the_frames_in_which_it_is_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    folder, taught, file = tmp_path / "frames", tmp_path / "taught.yaml", tmp_path / "seen.json"
    folder.mkdir()
    for index in range(4):
        image, ends, _ = copper_frame(4, 0.4 * (3 - index))
        cv2.imwrite(str(folder / f"{index}.png"), image)
    _, first, _ = copper_frame(4, 1.2)
    marks = ["--tail", *map(str, first[0].round(1)), "--tip", *map(str, first[1].round(1))]
    dish = ["--dish-diameter", str(DIAMETER)]
    assert cli.main(["teach", str(folder), *marks, *dish, "--output", str(taught)]) == 0
    assert "found in 3 of 3 other frames" in capsys.readouterr().out
    picture = np.asarray(cv2.imread(str(taught.with_suffix(".png"))))
    assert picture.shape == (480, 1280, 3)
    last = [str(folder / "3.png"), "--setup", str(taught), *dish, "--json", str(file)]
    assert cli.main(["track", *last]) == 0
    (row,) = json.loads(file.read_text())
    scale, (u, v) = row["metres_per_pixel"], row["dish_centre_px"]
    axis = np.array(row["axis_m"]) * (1.0, -1.0) / scale + (u, v)
    assert min(np.abs(axis - ends).max(), np.abs(axis - ends[::-1]).max()) < 4.0
    assert cli.main(["teach", str(folder), "--tail", "1", "1", *marks[3:], *dish, "--output", str(taught)]) == 1
