"""A lens's distortion is undone; parameters of no camera are refused."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import yaml

from benchmarks.vision.frames import distorted, lens_with
from magnetosuture_thread.settings.errors import InvalidInputError
from magnetosuture_thread.vision.lens import Lens, lens_of, read_lens
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import VisionTracker
from test.vision.scenes import SCENE, VIEW, Pose, render

SIZE = (640, 480)
MATRIX = (900.0, 0.0, 320.0, 0.0, 900.0, 240.0, 0.0, 0.0, 1.0)
LENSES = {
    "plumb_bob": (-0.25, 0.08, 0.001, -0.001, 0.0),
    "rational_polynomial": (-0.2, 0.05, 0.0, 0.0, 0.0, 0.02, 0.01, 0.0),
    "equidistant": (-0.05, 0.01, 0.0, 0.0),
}
YAML = """image_width: 640
image_height: 480
camera_name: overhead
camera_matrix: {rows: 3, cols: 3, data: [900, 0, 320, 0, 900, 240, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.25, 0.08, 0.001, -0.001, 0]}
"""


@pytest.mark.parametrize("model", LENSES)
def test_what_the_lens_does_is_undone(model: str):
    v, u = np.mgrid[:480, :640].astype(np.float32)
    pattern = (127.0 + 60.0 * np.sin(u / 15.0) + 60.0 * np.sin(v / 17.0)).astype(np.uint8)
    lens = Lens(SIZE, model, LENSES[model], MATRIX)
    # What the lens shows at a pixel is what a pinhole camera sees where OpenCV undistorts that pixel to.
    pixels = np.column_stack([u.ravel(), v.ravel()]).astype(np.float64)[:, None]
    matrix, coefficients = np.reshape(MATRIX, (3, 3)), np.array(LENSES[model])
    if model == "equidistant":
        at = cv2.fisheye.undistortPoints(pixels, matrix, coefficients, P=matrix)
    else:
        at = cv2.undistortPoints(pixels, matrix, coefficients, P=matrix)
    seen = cv2.remap(pattern, at.reshape(480, 640, 2).astype(np.float32), None, cv2.INTER_LINEAR)
    middle = np.s_[100:380, 100:540]
    assert np.abs(seen[middle].astype(int) - pattern[middle]).max() > 20
    assert np.abs(lens.undistorted(seen)[middle].astype(int) - pattern[middle]).max() <= 6


def test_in_large_frames_the_lens_is_shrunk_with_them():
    frame = cv2.resize(render(Pose(np.array([0.008, -0.004]), 0.3)), (1920, 1440), interpolation=cv2.INTER_CUBIC)
    bent = distorted(0.05)(frame, VIEW)
    tracker = VisionTracker(VisionTrackerSettings(), SCENE)
    tracker.set_lens(lens_with(0.05, (1920, 1440)))
    assert np.linalg.norm(tracker.look(bent).tail - (0.008, -0.004)) < 1.0 * VIEW.metres_per_pixel


@pytest.mark.parametrize(
    ("size", "model", "coefficients", "matrix", "words"),
    [
        (SIZE, "plumb_bob", (np.nan, 0, 0, 0, 0), MATRIX, "finite numbers"),
        (SIZE, "plumb_bob", (-0.2, 0, 0, 0, 0), (0.0,) * 9, "above 0"),
        (SIZE, "plumb_bob", (-0.2, 0, 0), MATRIX, "3 coefficients, expected 4 or 5 of plumb_bob"),
        (SIZE, "omni", (0.0,) * 4, MATRIX, "plumb_bob, rational_polynomial, equidistant"),
        (SIZE, "plumb_bob", (1e6, 0, 0, 0, 0), MATRIX, "that can be undone"),
        (SIZE, "equidistant", (1e9, -1e9, 1e9, -1e9), MATRIX, "that can be undone"),
        ((0, 0), "plumb_bob", (-0.2, 0, 0, 0, 0), MATRIX, "the frames' size"),
    ],
)
def test_parameters_of_no_camera_are_refused(size, model: str, coefficients, matrix, words: str):
    with pytest.raises(InvalidInputError, match=words):
        Lens(size, model, coefficients, matrix)


def test_a_lens_of_another_size_is_warned_of_and_not_used():
    frame = render(Pose(np.zeros(2), 0.3))
    tracker = VisionTracker(VisionTrackerSettings(), SCENE)
    without = tracker.look(frame)
    tracker.set_lens(Lens((1280, 960), "plumb_bob", LENSES["plumb_bob"], MATRIX))
    found = tracker.look(frame)
    assert found.warning == "camera_info.width: got 1280 x 960 pixels, expected the frames' 640 x 480; it is not used"
    assert np.array_equal(found.tail, without.tail)


def test_the_doubt_of_a_calibrated_scale_is_stated():
    settings = VisionTrackerSettings(
        dish_centre_px=VIEW.centre_px, metres_per_pixel=VIEW.metres_per_pixel, scale_error=0.07
    )
    found = VisionTracker(settings, SCENE).look(render(Pose(np.array([0.008, 0.0]), 0.3)))
    assert found.scale_error == 0.07
    assert found.warning.startswith("the scale is known to 7 % only")
    assert found.covariance[0, 0] > (0.07 * 0.008) ** 2


def test_a_calibration_file_is_read(tmp_path: Path):
    file = tmp_path / "camera.yaml"
    file.write_text(YAML)
    assert read_lens(file) == Lens(SIZE, "plumb_bob", LENSES["plumb_bob"], MATRIX)


@pytest.mark.parametrize(
    ("distortion", "camera", "count", "model"),
    [
        (None, "fisheye", 4, "equidistant"),
        ("Kannala-Brandt", None, 4, "equidistant"),
        ("plumb_bob", None, 8, "rational_polynomial"),
        ("none", None, 5, "distortion_model: got '', expected plumb_bob"),
        (None, "omni", 4, "distortion_model: got 'omni', expected plumb_bob"),
        ("radtan", "omni", 4, "camera_model: got omni, expected that of distortion_model, which is radtan"),
    ],
)
def test_a_model_has_many_names_and_none_is_guessed(distortion, camera, count: int, model: str, tmp_path: Path):
    file = tmp_path / "camera.yaml"
    content = yaml.safe_load(YAML) | {"distortion_model": distortion, "camera_model": camera}
    content["distortion_coefficients"]["data"] = [0.01] * count
    file.write_text(yaml.safe_dump({key: value for key, value in content.items() if value is not None}))
    if ":" in model:
        with pytest.raises(InvalidInputError, match=model):
            read_lens(file)
    else:
        assert read_lens(file).model == model


@pytest.mark.parametrize("text", ["", "[]", "a: b", YAML.replace("900, 0, 320", "x, 0, 320"), "a: [", "a: &b [*b]"])
def test_a_file_that_is_no_calibration_is_refused_in_one_line(text: str, tmp_path: Path):
    file = tmp_path / "camera.yaml"
    file.write_text(text)
    with pytest.raises(InvalidInputError) as refused:
        read_lens(file)
    assert "\n" not in str(refused.value)
    with pytest.raises(InvalidInputError):
        read_lens(tmp_path)


@pytest.mark.parametrize(("across", "down"), [(2, 1), (1, 2)])
def test_binned_frames_are_refused(across: int, down: int):
    info = SimpleNamespace(width=640, height=480, distortion_model="plumb_bob", d=LENSES["plumb_bob"], k=MATRIX)
    info.binning_x, info.binning_y = across, down
    with pytest.raises(InvalidInputError, match=f"{across} x {down}"):
        lens_of(info)
