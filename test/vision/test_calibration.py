"""The camera's calibration, by the dish and by markers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.vision.frames import tilted
from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.settings.errors import InvalidInputError
from magnetosuture_thread.settings.shared_parameters import load_setup
from magnetosuture_thread.vision.calibration import (
    CORNERS,
    Calibration,
    calibrate_by_dish,
    calibrate_by_markers,
    measure_needle_length,
)
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import State, VisionTracker
from test.shared import known
from test.vision.scenes import SCENE, VIEW, Pose, render, rod

SPACING, SIDE = 0.034, 0.005


def markers(view: DishView, ids: tuple[int, ...] = (0, 1, 2, 3), share: float = 1.0) -> np.ndarray:
    """Draw markers as a camera with this view sees them, all lengths by a share of the usual ones."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    image = np.full((480, 640), 200, np.uint8)
    square = np.array(CORNERS, dtype=float)
    for index in ids:
        marker = cv2.copyMakeBorder(cv2.aruco.generateImageMarker(dictionary, index, 240), 40, 40, 40, 40, 0, value=255)
        corners = np.array([(40, 40), (280, 40), (280, 280), (40, 280)]) - 0.5
        seen = view.to_pixels(share * (0.5 * SPACING * square[index] + 0.5 * SIDE * square))
        matrix = cv2.getPerspectiveTransform(corners.astype(np.float32), seen.astype(np.float32))
        drawn = cv2.warpPerspective(marker, matrix, (640, 480), flags=cv2.INTER_AREA, borderValue=0)
        there = cv2.warpPerspective(np.full_like(marker, 255), matrix, (640, 480), borderValue=0)
        image = np.where(there > 127, drawn, image)
    return cv2.GaussianBlur(image, (0, 0), 0.7)


def read_back(found: Calibration, folder: Path) -> VisionTrackerSettings:
    """Write a calibration to a file and return the tracker's settings from it."""
    (folder / "camera.yaml").write_text(found.to_yaml())
    return load_setup(folder / "camera.yaml", (VisionTrackerSettings,))["vision_tracker"]


def test_what_is_not_sure_of_a_calibration_is_said(tmp_path: Path):
    frames = [render(Pose(np.array([0.001 * index, 0.0]), 0.3)) for index in range(10)]
    moved = [np.roll(frame, 10, axis=1) if index > 5 else frame for index, frame in enumerate(frames)]
    found = calibrate_by_dish(moved, 0.035)
    assert found.view.metres_per_pixel == pytest.approx(8e-5, rel=5e-3)
    assert "4 of 10 frames show the dish elsewhere" in found.remark
    assert found.view.centre_px[0] == pytest.approx(322.0, abs=0.3)
    assert read_back(replace(found, scale_error=0.07), tmp_path).scale_error == 0.07


def test_dishes_that_differ_or_are_missing_are_refused():
    frame = render(Pose(np.zeros(2), 0.3))
    with pytest.raises(InvalidInputError, match="a camera that stands still"):
        calibrate_by_dish([frame, np.roll(frame, 6, axis=1)], 0.035)
    with pytest.raises(InvalidInputError, match="1 of 3 with a dish"):
        calibrate_by_dish([frame, 0 * frame, 0 * frame], 0.035)
    with pytest.raises(InvalidInputError, match="frames of one size"):
        calibrate_by_dish([frame, frame[::2].copy()], 0.035)
    with pytest.raises(InvalidInputError, match="none"):
        calibrate_by_dish([], 0.035)


@pytest.mark.parametrize("rotation", [0.0, 0.3, -1.2])
def test_by_markers_centre_scale_and_rotation_are_found(rotation: float):
    view = DishView((318.4, 243.7), 1.2e-4, rotation)
    found = calibrate_by_markers([markers(view)], 0.035, SPACING, SIDE)
    assert np.linalg.norm(np.subtract(found.view.centre_px, view.centre_px)) < 0.3
    assert found.view.metres_per_pixel == pytest.approx(view.metres_per_pixel, rel=2e-3)
    assert found.view.rotation == pytest.approx(rotation, abs=2e-3)
    assert found.residual_px < 0.6


def test_missing_markers_and_those_of_another_size_are_refused():
    view = DishView((320.0, 240.0), 1.2e-4)
    with pytest.raises(InvalidInputError, match="no marker 2"):
        calibrate_by_markers([markers(view, (0, 1, 3))], 0.035, SPACING, SIDE)
    with pytest.raises(InvalidInputError, match="from a camera above"):
        calibrate_by_markers([markers(view)], 0.035, SPACING, 0.8 * SIDE)


def test_markers_from_a_camera_that_moved_between_frames_are_refused():
    view, moved = DishView((305.0, 240.0), 1.2e-4), DishView((335.0, 240.0), 1.2e-4)
    with pytest.raises(
        InvalidInputError, match=r"markers that differ by 15\.\d\d px, expected a camera that stands still"
    ):
        calibrate_by_markers([markers(view), markers(moved)], 0.035, SPACING, SIDE)
    nudged = DishView((308.5, 240.0), 1.2e-4)
    with pytest.raises(InvalidInputError, match="a camera that stands still"):  # even if one marker alone tells
        calibrate_by_markers([markers(view, (0, 1)), markers(nudged, (1, 2, 3))], 0.035, SPACING, SIDE)


def test_the_length_of_a_rod_without_a_thread_is_measured_also_where_some_frames_are_wrong():
    images = []
    for index in range(14):
        beginning = np.array([-0.008 + 0.0009 * index, 0.008 - 0.001 * index])
        length = 0.0053 if index % 5 == 2 else 0.005  # as where something dark lies at an end
        images.append(rod(np.array([beginning, np.add(beginning, (length, 0.0))])))
    length = measure_needle_length(images, calibrate_by_dish(images, 0.035), 0.0052, 0.0004)
    assert length == pytest.approx(0.005, rel=0.02)


@pytest.mark.parametrize("share", [0.93, 1.07])
def test_the_needles_length_is_measured_over_frames_and_written_for_every_node(share: float, tmp_path: Path):
    poses = [Pose(np.array([-0.004 + 0.0008 * index, 0.003 - 0.0006 * index]), 0.5 * index) for index in range(10)]
    images = [render(pose) for pose in poses]
    found = calibrate_by_dish(images, 0.035)
    length = measure_needle_length(images, found, share * 0.007, 0.0004)
    assert length == pytest.approx(0.007, rel=0.01)
    settings = read_back(replace(found, needle=(length, 0.00041)), tmp_path)
    assert (settings.needle_length, settings.needle_width) == pytest.approx((length, 0.00041), abs=1e-6)
    with pytest.raises(InvalidInputError, match="both ends of a needle of 9 mm"):
        measure_needle_length(images, found, 0.009, 0.0004)
    with pytest.raises(InvalidInputError, match="no needle's length in 5 frames"):
        measure_needle_length(images[:5], found, 0.007, 0.0004)


@pytest.mark.parametrize(("degrees", "factor"), [(5.0, 1), (10.0, 2), (20.0, 1)])
def test_by_markers_a_tilted_camera_is_straightened_and_the_needle_is_where_it_is(
    degrees: float, factor: int, tmp_path: Path
):
    def taken(image: np.ndarray) -> np.ndarray:
        large = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)
        return tilted(np.radians(degrees), 0.7)(large, VIEW.shrunk(1.0 / factor))

    share = 2.0 / 3.0  # so that the markers are in the image
    found = calibrate_by_markers([taken(markers(VIEW, share=share))], 0.035, share * SPACING, share * SIDE)
    settings = read_back(found, tmp_path)
    np.testing.assert_allclose(known(settings.homography()), known(found.homography), rtol=1e-9)
    pose = Pose(np.array([0.009, -0.006]), 0.8)
    seen = VisionTracker(settings, SCENE).look(taken(render(pose)))
    assert seen.state is State.TRACKED
    assert pose.is_right(seen)
