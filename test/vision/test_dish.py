"""The dish is found where it is."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.rig.camera import CameraScene, DishCamera, Lighting
from magnetosuture_thread.vision.dish import EDGE_ERROR_PX, DishWatch, see_dish
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from test.shared import known
from test.vision.scenes import NOWHERE, Pose, finger, render


def gray_of(centre: tuple[float, float], scale: float, seed: int, lighting: Lighting | None = None) -> np.ndarray:
    """Return the measured channel of a frame with a needle."""
    camera = DishCamera(CameraScene(), DishView(centre, scale), seed=seed, lighting=lighting)
    return np.ascontiguousarray(camera.render(np.zeros(2), 0.3, NOWHERE)[:, :, 1])


@pytest.mark.parametrize(
    ("centre", "scale", "seed"), [((322.0, 238.0), 8e-5, 0), ((300.4, 246.7), 8.6e-5, 1), ((341.0, 231.0), 9.5e-5, 2)]
)
@pytest.mark.parametrize("lighting", [Lighting(), Lighting(gain=0.5, slope=4.0, noise=3.0)])
def test_the_dish_is_found_to_a_quarter_of_a_pixel(centre, scale: float, seed: int, lighting: Lighting):
    found = known(see_dish(gray_of(centre, scale, seed, lighting), VisionTrackerSettings(), 0.035))
    assert found.scale_error == pytest.approx(EDGE_ERROR_PX * scale / 0.0175, rel=0.01)
    assert np.linalg.norm(np.subtract(found.view.centre_px, centre)) < 0.25
    assert found.view.metres_per_pixel == pytest.approx(scale, rel=min(6e-3, 3.0 * found.scale_error))


@pytest.mark.parametrize("blur", [0.75, 2.0])
@pytest.mark.parametrize("size", [(320, 240), (640, 480), (1280, 960)])
def test_the_scale_is_as_true_as_is_said(size: tuple[int, int], blur: float):
    scale, centre = 0.035 / (0.91 * size[1]), (0.503 * size[0], 0.496 * size[1])
    camera = DishCamera(CameraScene(), DishView(centre, scale), size, lighting=Lighting(blur_px=blur))
    found = known(see_dish(camera.render(np.zeros(2), 0.3, NOWHERE)[:, :, 1].copy(), VisionTrackerSettings(), 0.035))
    assert abs(found.view.metres_per_pixel / scale - 1.0) < 3.0 * found.scale_error


def test_a_hand_over_a_third_of_the_rim_does_not_move_the_dish():
    frame = render(Pose(np.zeros(2), 0.3), covers=(finger(np.array([0.008, 0.0]), 0.0, 0.024, (120.0, 150.0, 200.0)),))
    found = known(see_dish(frame, VisionTrackerSettings(), 0.035))
    assert np.linalg.norm(np.subtract(found.view.centre_px, (322.0, 238.0))) < 0.5
    assert found.view.metres_per_pixel == pytest.approx(8e-5, rel=6e-3)


def test_a_dish_that_only_its_ellipse_tells_is_found_once_it_is_there():
    bright = np.full((480, 640), 225, np.uint8)
    cv2.circle(bright, (322, 238), 200, 255, -1, cv2.LINE_AA)  # too little contrast for a rim
    watch = DishWatch(VisionTrackerSettings(), 0.035)
    assert watch.look(0 * bright)[0] != ""
    assert watch.look(bright)[0] == ""


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("inner", [0.86, 0.93])
def test_a_clear_dish_on_a_dark_bench_is_in_doubt_by_its_wall_and_lid(inner: float, seed: int):
    """Its outer edge, where it ends against the bench, looks like the inside of a steel wall."""
    random = np.random.default_rng(seed)
    (u, v), radius = random.uniform((300.0, 230.0), (340.0, 250.0)), 200.0
    columns, rows = np.meshgrid(np.arange(640.0), np.arange(480.0))

    def disc(share: float, shift: float) -> np.ndarray:
        """Return where a circle of a share of the radius is, shifted by its height."""
        return np.clip(share * radius - np.hypot(columns - u - shift, rows - v) + 0.5, 0.0, 1.0)

    light = 25.0 + 90.0 * disc(1.0, 4.0) + 25.0 * (disc(0.97, 4.0) - disc(inner + 0.02, 1.0)) - 8.0 * disc(inner, 0.0)
    light = cv2.GaussianBlur(light, (0, 0), 0.9) + random.standard_normal(light.shape) * 1.5
    found = known(see_dish(np.clip(light, 0.0, 255.0).astype(np.uint8), VisionTrackerSettings(), 0.09))
    assert not found.dark_field
    seen = 0.045 / found.view.metres_per_pixel / radius
    assert abs(seen / inner - 1.0) < found.scale_error + 0.005  # the truth is within the doubt
    assert seen == pytest.approx(inner, rel=0.03)
    assert found.scale_error > 0.7 * (1.0 / inner - 1.0)  # and, nearly, the outer edge
