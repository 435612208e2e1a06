"""Dishes in drawn photographs are found by their ellipse, and none where there is none."""

from __future__ import annotations

import math
import re

import cv2
import numpy as np
import pytest

from magnetosuture_thread.vision.dish import Ellipse, find_rings, see_dish
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from test.shared import known
from test.vision.photographs import DIAMETER, PHOTOGRAPHS, RIGHT, ellipse_error, photo_of
from test.vision.scenes import Pose, render

pytestmark = pytest.mark.slow


def drawn(ellipse: Ellipse, size: tuple[int, int], inside: int, outside: int) -> np.ndarray:
    """Draw an ellipse by the distance from its edge, to first order; polygons of OpenCV are half a pixel too large."""
    u, v = np.meshgrid(np.arange(size[0]) - ellipse.centre_px[0], np.arange(size[1]) - ellipse.centre_px[1])
    cosine, sine = math.cos(ellipse.direction), math.sin(ellipse.direction)
    x, y = (u * cosine + v * sine) / ellipse.minor, (v * cosine - u * sine) / ellipse.major
    away = np.hypot(x, y)
    slope = np.hypot(x / ellipse.minor, y / ellipse.major) / np.maximum(away, 1e-9)
    share = np.clip(0.5 - (away - 1.0) / np.maximum(slope, 1e-9), 0.0, 1.0)
    return cv2.GaussianBlur(np.round(outside + (inside - outside) * share).astype(np.uint8), (0, 0), 0.8)


@pytest.mark.parametrize("name", PHOTOGRAPHS)
def test_most_dishes_in_photographs_are_found(name: str):
    right = 0
    for index in range(6):
        photo = photo_of(name, index, 41)
        found = see_dish(photo.image, VisionTrackerSettings(), DIAMETER)
        right += (
            found is not None and min(ellipse_error(found, DIAMETER, at) for at in (photo.floor, photo.top)) < RIGHT
        )
    assert right >= 4


def test_a_given_scale_is_used_and_a_warning_says_by_how_much_the_dish_contradicts_it():
    frame = render(Pose(np.zeros(2), 0.3))
    for share, remark in ((1.02, ""), (1.07, "is 7% off the dish"), (0.94, "is 6% off the dish")):
        found = known(see_dish(frame, VisionTrackerSettings(metres_per_pixel=share * 8e-5), 0.035))
        assert re.search(remark, found.warning)
        assert bool(found.warning) == bool(remark)
        assert found.view.metres_per_pixel == pytest.approx(share * 8e-5, rel=1e-9)
        assert found.scale_error == pytest.approx(abs(1.0 / share - 1.0) if remark else 0.0, abs=5e-3)
    assert see_dish(frame, VisionTrackerSettings(metres_per_pixel=1.3 * 8e-5), 0.035) is None


@pytest.mark.parametrize("light", [(200, 150, 120), (120, 200, 150)])
def test_a_wall_of_two_edges_makes_the_doubt_of_the_scale_unless_the_user_names_one(light: tuple[int, int, int]):
    floor, wall, ground = light
    inner, outer = (Ellipse((331.3, 238.6), radius, radius, 0.0) for radius in (170.0, 184.0))
    frame = drawn(outer, (640, 480), wall, ground) // 2 + drawn(inner, (640, 480), floor, wall) // 2
    for size in (1.0, 0.5):
        image = cv2.resize(frame, None, fx=size, fy=size, interpolation=cv2.INTER_AREA)
        for rim, radius, doubt in (("", 170.0, 14.0 / 170.0), ("inner", 170.0, 0.01), ("outer", 184.0, 0.01)):
            found = known(see_dish(image, VisionTrackerSettings(rim=rim), 0.035))
            if not rim:
                assert abs(0.0175 / found.view.metres_per_pixel / size / radius - 1.0) < doubt + 0.01
                assert "name the wall's edge by rim" in found.warning
            else:
                assert 0.0175 / found.view.metres_per_pixel / size == pytest.approx(radius, rel=0.01)
                assert found.warning == ""
            assert found.scale_error == pytest.approx(doubt, rel=0.25)


def test_no_ellipse_is_found_where_there_is_none():
    square = np.full((480, 640), 180, np.uint8)
    cv2.rectangle(square, (150, 60), (500, 410), 20, 8)
    cloud = cv2.GaussianBlur(np.random.default_rng(0).standard_normal((480, 640)), (0, 0), 8.0)
    clouds = np.clip(128.0 + 50.0 * cloud / cloud.std(), 0, 255).astype(np.uint8)
    for image in (square, clouds, np.full((4000, 70), 120, np.uint8)):
        assert not find_rings(image)
