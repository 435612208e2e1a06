"""The dish is found, and only where there is one; the watch over it notices a bumped camera."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.rig.camera import CameraScene, DishCamera, Lighting
from magnetosuture_thread.vision.dish.find import CONTRAST, MIN_CONTRAST, RIM_RAYS, find_cut_dish, find_dish, rim_shift
from magnetosuture_thread.vision.dish.robust_fits import fit_circle, fit_rim
from magnetosuture_thread.vision.dish.tilt import Tilt
from magnetosuture_thread.vision.dish.watch import AGREEING, LONG_SEARCH, DishWatch
from magnetosuture_thread.vision.look import FoundDish, see_dish
from magnetosuture_thread.vision.sampling import rim_along_rays
from magnetosuture_thread.vision.settings import VisionTrackerSettings
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
    found = find_dish(gray_of(centre, scale, seed, lighting), 0.035)
    assert found is not None
    assert np.linalg.norm(np.subtract(found.centre_px, centre)) < 0.25
    assert found.metres_per_pixel == pytest.approx(scale, rel=6e-3)


def test_a_hand_over_a_third_of_the_rim_does_not_move_the_dish():
    frame = render(Pose(np.zeros(2), 0.3), covers=(finger(np.array([0.008, 0.0]), 0.0, 0.024, (120.0, 150.0, 200.0)),))
    found = find_dish(np.ascontiguousarray(frame[:, :, 1]), 0.035)
    assert found is not None
    assert np.linalg.norm(np.subtract(found.centre_px, (322.0, 238.0))) < 0.5
    assert found.metres_per_pixel == pytest.approx(8e-5, rel=6e-3)


def test_no_dish_is_found_where_there_is_none():
    noise = np.random.default_rng(0).integers(150, 200, (480, 640)).astype(np.uint8)
    plain = np.full((480, 640), 180, np.uint8)
    square = plain.copy()
    cv2.rectangle(square, (150, 60), (500, 410), 20, 8)
    for image in (noise, plain, square, 0 * plain, 0 * plain + 255):
        assert find_dish(image, 0.035) is None


def test_the_quick_check_tells_how_far_the_rim_has_moved():
    gray = gray_of((322.0, 238.0), 8e-5, 3)
    radius = 0.0175 / 8e-5
    assert rim_shift(gray, (322.0, 238.0), radius)[0] < 0.2
    shift, rays = rim_shift(gray, (324.0, 236.0), radius)
    assert shift == pytest.approx(np.hypot(2.0, 2.0), abs=0.4)
    assert rays > 0.8 * RIM_RAYS
    assert rim_shift(0 * gray, (322.0, 238.0), radius)[1] == 0


def test_a_bumped_camera_is_believed_only_after_several_frames():
    before, after = gray_of((322.0, 238.0), 8e-5, 3), gray_of((330.0, 235.0), 8e-5, 3)
    watch = DishWatch(VisionTrackerSettings(), 0.035)
    assert watch.look(before)[0] == ""
    seen = watch.view
    assert [watch.look(after)[0] != "" for _ in range(AGREEING)] == [True] * (AGREEING - 1) + [False]
    assert watch.view is not None
    assert np.linalg.norm(np.subtract(watch.view.centre_px, (330.0, 235.0))) < 0.5
    assert watch.look(before)[0] != ""  # and one odd frame later changes nothing
    assert watch.look(after)[0] == ""
    assert seen is not None


def test_a_camera_that_is_bumped_again_and_again_is_not_believed():
    before = gray_of((322.0, 238.0), 8e-5, 3)
    after = [np.roll(before, moved, axis=1) for moved in (8, -6)]
    watch = DishWatch(VisionTrackerSettings(), 0.035)
    assert watch.look(before)[0] == ""
    for index in range(AGREEING + 1):
        assert watch.look(after[index % 2])[0] == "the dish is not where it was"


def test_two_dishes_agree_as_far_as_is_known_of_each():
    watch = DishWatch(VisionTrackerSettings(), 0.035)
    for error, agree in ((0.001, False), (0.01, True)):
        dish = FoundDish(DishView((320.0, 240.0), 8e-5), scale_error=error)
        for moved in (replace(dish.view, centre_px=(322.0, 240.0)), replace(dish.view, metres_per_pixel=8.1e-5)):
            assert watch._agree(dish, replace(dish, view=moved)) == agree


def test_a_dark_frame_gives_no_view_and_changes_none():
    gray = gray_of((322.0, 238.0), 8e-5, 3)
    watch = DishWatch(VisionTrackerSettings(), 0.035)
    watch.look(gray)
    view = watch.view
    assert watch.look(0 * gray)[0] == "too little of the dish is seen"
    assert watch.look(gray)[0] == ""
    assert watch.view is view


def test_a_dish_that_only_its_ellipse_tells_is_found_within_a_few_frames():
    bright = np.full((480, 640), 128, np.uint8)
    cv2.circle(bright, (322, 238), 200, 255, -1, cv2.LINE_AA)  # saturated, so that the rim's dark is not told
    assert see_dish(bright, VisionTrackerSettings(), 0.035, photographed=False) is None
    watch = DishWatch(VisionTrackerSettings(), 0.035)
    assert watch.look(bright)[0] == ""  # in the first frame at once
    watch.forget()
    for _ in range(2):
        assert watch.look(0 * bright)[0] != ""
    reasons = [watch.look(bright)[0] for _ in range(LONG_SEARCH)]
    assert reasons[0] != ""
    assert reasons[-1] == ""


def test_a_bright_rim_around_a_bright_floor_is_no_dark_field():
    clear = np.full((480, 640), 240, np.uint8)
    cv2.circle(clear, (322, 238), 217, 180, -1, cv2.LINE_AA)
    cv2.circle(clear, (322, 238), 220, 255, 6, cv2.LINE_AA)
    assert find_dish(255 - clear, 0.035) is not None  # its negative looks like a dish
    found = see_dish(clear, VisionTrackerSettings(), 0.035)
    assert found is None or not found.dark_field


def test_what_is_all_texture_shows_no_dish():
    for seed in range(3):
        noise = np.random.default_rng(seed).integers(0, 256, (480, 640)).astype(np.uint8)
        assert find_dish(noise, 0.035) is None


def test_a_dish_that_the_frame_cuts_off_too_far_is_not_found():
    gray = gray_of((322.0, 238.0), 8e-5, 0)
    circle = 322.0, 238.0, 217.0
    assert find_cut_dish(np.ascontiguousarray(gray[:, :240]), circle, 0.035) is None  # a third of its rim
    for share, is_found in ((0.1, True), (0.45, False)):
        hidden = gray.copy()
        hidden[: round(480 * share)] = gray[238, 400]  # as bright as the floor: there is no rim
        assert (find_cut_dish(hidden, circle, 0.035) is not None) == is_found


def test_a_given_view_needs_no_dish():
    settings = VisionTrackerSettings(dish_centre_px=(320.0, 240.0), metres_per_pixel=8e-5, camera_rotation=0.1)
    watch = DishWatch(settings, 0.035)
    assert watch.look(np.zeros((480, 640), np.uint8))[0] == ""
    assert watch.view == DishView((320.0, 240.0), 8e-5, 0.1)


@pytest.mark.parametrize("rotation", [0.0, 0.7])
def test_the_direction_of_a_tilt_is_the_same_in_image_and_dish(rotation: float):
    tilt, view = Tilt(0.2, 0.4, rotation), DishView((320.0, 240.0), 8e-5, rotation)
    across = view.to_pixels(np.array([[0.0, 0.0], tilt.direction_in_dish]))
    u, v = across[1] - across[0]
    assert math.atan2(v, u) == pytest.approx(0.4)


def test_a_dish_that_the_frame_cuts_off_is_found_on_whichever_side():
    gray = gray_of((322.0, 238.0), 8e-5, 0)
    for left, top, right, bottom in ((0, 0, 440, 480), (200, 0, 640, 480), (0, 120, 640, 480)):
        u, v = 322.0 - left, 238.0 - top
        cut = np.ascontiguousarray(gray[top:bottom, left:right])
        found = find_cut_dish(cut, (u + 3.0, v - 2.0, 217.0), 0.035)
        assert found is not None
        assert math.dist(found.centre_px, (u, v)) < 0.3
        assert found.metres_per_pixel == pytest.approx(8e-5, rel=6e-3)


@pytest.mark.parametrize("beyond", [200.0, 80.0])
def test_rays_meet_a_rim_at_half_of_its_dark_and_its_darkest_ring_where_it_is_brighter_again(beyond: float):
    u, v = np.meshgrid(np.arange(240.0), np.arange(200.0))
    away = np.hypot(u - 120.3, v - 99.6)
    light = np.rint(np.interp(away, [70.0, 78.0, 86.0], [200.0, 80.0, beyond])).astype(np.uint8)
    edges, darkest = np.empty((90, 2)), np.empty((90, 2))
    circle = 120.3, 99.6, 75.0
    counts = rim_along_rays(light, circle, 20.0, 0.5, 12.0, MIN_CONTRAST, CONTRAST, edges, darkest)
    assert counts == (90, 90 if beyond > 80.0 else 0)
    np.testing.assert_allclose(np.linalg.norm(edges - circle[:2], axis=1), 74.0, atol=0.35)
    found = np.linalg.norm(darkest[: counts[1]] - circle[:2], axis=1)
    np.testing.assert_allclose(found, 78.0, atol=0.4)
    faint = np.rint(200.0 + 0.2 * (light - 200.0)).astype(np.uint8)
    assert rim_along_rays(faint, circle, 20.0, 0.5, 12.0, MIN_CONTRAST, CONTRAST, edges, darkest) == (0, 0)


def test_a_circle_is_fitted_to_the_points_that_agree_alone():
    turns = np.linspace(0.0, 2.0 * np.pi, 100, endpoint=False)
    around = np.column_stack([np.cos(turns), np.sin(turns)])
    points = (150.3, 90.8) + np.where(np.arange(100) % 4, 60.0, 72.0)[:, None] * around
    circle = np.empty(3)
    assert fit_circle(points, 2.0, circle) == 75
    np.testing.assert_allclose(circle, [150.3, 90.8, 60.0], atol=1e-6)
    assert fit_circle(points[:19], 2.0, circle) == 0


def test_a_rim_is_fitted_without_what_lies_beside_it_and_its_spread_is_that_of_the_others():
    turns, number = np.linspace(0.0, 2.0 * np.pi, 200, endpoint=False), np.arange(200)
    given = np.array([80.0, 3.0, -2.0, 1.5, 2.5])
    radii = given @ [np.ones(200), np.cos(turns), np.sin(turns), np.cos(2.0 * turns), np.sin(2.0 * turns)]
    radii += np.where(number % 10, 0.2 * (-1.0) ** number, 9.0)
    points = (150.3, 90.8) + radii[:, None] * np.column_stack([np.cos(turns), np.sin(turns)])
    rim = np.empty(5)
    count, spread = fit_rim(points, (150.3, 90.8), 100, rim)
    assert count == 180
    assert spread == pytest.approx(0.2, rel=0.02)
    np.testing.assert_allclose(rim, given, atol=0.05)
    assert fit_rim(points, (150.3, 90.8), 201, rim) == (0, 0.0)
