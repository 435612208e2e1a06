"""Dishes in drawn photographs are found by their ellipse, and none where there is none."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from benchmarks.vision.photographs import DIAMETER, RIGHT, ellipse_error, photo_of
from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.vision.dish.edges import fit_harmonics, ring_support, steepest, thin_edges, vote
from magnetosuture_thread.vision.dish.ellipse import ALIGNMENT, BINS, MIN_GRADIENT, RING, TRIES, Ellipse, find_ellipse
from magnetosuture_thread.vision.dish.tilt import Tilt, find_tilt
from magnetosuture_thread.vision.look import FoundDish, see_dish
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from test.vision.scenes import Pose, render

CLASSES = (
    "photo_on_cloth",
    "photo_on_light_box",
    "photo_on_wood",
    "photo_blood",
    "photo_tilted",
    "photo_hand",
)


def drawn(ellipse: Ellipse, size: tuple[int, int], inside: int, outside: int) -> np.ndarray:
    """Draw an ellipse by the distance from its edge, to first order; polygons of OpenCV are half a pixel too large."""
    u, v = np.meshgrid(np.arange(size[0]) - ellipse.centre_px[0], np.arange(size[1]) - ellipse.centre_px[1])
    cosine, sine = math.cos(ellipse.direction), math.sin(ellipse.direction)
    x, y = (u * cosine + v * sine) / ellipse.minor, (v * cosine - u * sine) / ellipse.major
    away = np.hypot(x, y)
    slope = np.hypot(x / ellipse.minor, y / ellipse.major) / np.maximum(away, 1e-9)
    share = np.clip(0.5 - (away - 1.0) / np.maximum(slope, 1e-9), 0.0, 1.0)
    return cv2.GaussianBlur(np.round(outside + (inside - outside) * share).astype(np.uint8), (0, 0), 0.8)


@pytest.mark.parametrize("name", CLASSES)
def test_most_dishes_in_photographs_are_found(name: str):
    right = 0
    for index in range(6):
        photo = photo_of(name, index, 41)
        found = see_dish(photo.image, VisionTrackerSettings(), DIAMETER)
        right += (
            found is not None and min(ellipse_error(found, DIAMETER, at) for at in (photo.floor, photo.top)) < RIGHT
        )
    assert right >= 4


@pytest.mark.parametrize("levels", [(40, 200), (200, 40), (255, 128), (120, 100)])
@pytest.mark.parametrize("ratio", [1.0, 0.93, 0.84])
def test_an_ellipse_is_measured_to_a_part_of_a_pixel_whichever_side_is_brighter(levels: tuple[int, int], ratio: float):
    given = Ellipse((330.3, 228.6), 150.0, ratio * 150.0, 0.7)
    found = find_ellipse(drawn(given, (640, 480), *levels))
    assert found is not None
    assert math.dist(found.centre_px, given.centre_px) < 0.3
    assert found.major == pytest.approx(given.major, abs=0.5)
    assert found.minor == pytest.approx(given.minor, abs=0.5)


@pytest.mark.parametrize("size", [(320, 240), (480, 640), (1920, 1080), (3840, 2160)])
def test_sizes_portrait_frames_and_small_dishes_in_wide_ones(size: tuple[int, int]):
    radius = 0.15 * min(size)
    given = Ellipse((0.3 * size[0], 0.6 * size[1]), radius, radius, 0.0)
    found = find_ellipse(drawn(given, size, 190, 120))
    assert found is not None
    assert math.dist(found.centre_px, given.centre_px) < 0.01 * radius + 0.3
    assert found.major == pytest.approx(radius, rel=0.015)


def test_a_dish_of_which_two_fifths_are_cut_off_is_found():
    given = Ellipse((30.0, 240.0), 170.0, 170.0, 0.0)
    found = find_ellipse(drawn(given, (640, 480), 190, 120))
    assert found is not None
    assert math.dist(found.centre_px, given.centre_px) < 1.0


def test_no_dish_is_found_where_there_is_none():
    random = np.random.default_rng(0)
    text = np.full((480, 640), 240, np.uint8)
    for row in range(25):
        cv2.putText(text, "the quick brown fox jumps over", (5, 20 + 19 * row), 0, 0.9, 20, 2)
    square = np.full((480, 640), 180, np.uint8)
    cv2.rectangle(square, (150, 60), (500, 410), 20, 8)
    face = np.full((480, 640), 110, np.uint8)
    cv2.ellipse(face, (320, 240), (130, 180), 0, 0, 360, 180, -1)
    for u in (270, 370):
        cv2.circle(face, (u, 200), 20, 240, -1)
    cloud = cv2.GaussianBlur(random.standard_normal((480, 640)), (0, 0), 8.0)
    pictures = {
        "noise": random.integers(0, 255, (480, 640, 3)).astype(np.uint8),
        "clouds": np.clip(128.0 + 50.0 * cloud / cloud.std(), 0, 255).astype(np.uint8),
        "text": text,
        "square": square,
        "face": face,
        "black": 0 * text,
        "white": 0 * text + 255,
        "tall": np.full((4000, 70), 120, np.uint8),
    }
    assert {name for name, image in pictures.items() if find_ellipse(image) is not None} == set()


def test_a_given_scale_that_differs_from_the_dish_by_up_to_a_tenth_gives_way_and_is_warned_of():
    frame = render(Pose(np.zeros(2), 0.3))
    for share, remark in ((1.02, False), (1.07, True), (0.94, True)):
        found = see_dish(frame, VisionTrackerSettings(metres_per_pixel=share * 8e-5), 0.035)
        assert found is not None
        assert bool(found.warning) == remark
        expected = 8e-5 if remark else share * 8e-5
        assert found.view.metres_per_pixel == pytest.approx(expected, rel=5e-3)
    assert see_dish(frame, VisionTrackerSettings(metres_per_pixel=1.15 * 8e-5), 0.035) is None


def test_the_covariance_of_an_unknown_tilt_holds_the_perspective_of_any_below_it():
    radius, distance = 0.0175, 0.25
    for angle, about in ((0.05, 0.3), (0.05, 2.0), (0.15, -1.0)):
        tail, heading = np.array([0.008, -0.005]), np.array([0.6, 0.8])
        along = np.array([math.cos(about), math.sin(about)])
        near = math.sin(angle) / distance

        def seen(point: np.ndarray, along: np.ndarray = along, near: float = near) -> np.ndarray:
            return point / (1.0 - near * float(along @ point))

        ends = (seen(radius * along), seen(-radius * along))
        off = seen(tail) - 0.5 * (ends[0] + ends[1]) - tail
        turned = seen(tail + 1e-5 * heading) - seen(tail)
        angle_off = math.atan2(turned[1], turned[0]) - math.atan2(heading[1], heading[0])
        found = FoundDish(
            DishView((0.0, 0.0), 8e-5), tilt=Tilt(angle, -about) if angle > 0.1 else None, unseen_tilt=0.06
        )
        error = np.array([*off, angle_off])
        covariance = found.covariance(tail, heading, radius) + np.diag([4e-6, 4e-6, 1e-3]) ** 2
        assert float(error @ np.linalg.solve(covariance, error)) < 14.16


def test_points_of_an_ellipse_are_symmetric_about_its_centre_and_have_outward_normals():
    ellipse = Ellipse((330.0, 228.0), 150.0, 120.0, 0.7)
    points, normals = ellipse.points(40)
    offset = points - ellipse.centre_px
    assert np.abs(points[:20] + points[20:] - 2.0 * np.array(ellipse.centre_px)).max() < 1e-9
    assert np.hypot(*offset.T).max() == pytest.approx(ellipse.major, rel=1e-2)
    assert (np.einsum("ij,ij->i", offset, normals) > 0.0).all()


def test_of_a_tilted_dish_that_was_taken_for_a_circle_centre_scale_and_tilt_are_found():
    given = Ellipse((335.3, 228.6), 150.0, 140.0, 0.7)
    tilt, view = find_tilt(drawn(given, (640, 480), 190, 120), DishView((333.3, 231.6), DIAMETER / 290.0), DIAMETER)
    assert tilt is not None
    assert (tilt.angle, tilt.direction) == pytest.approx((math.acos(140.0 / 150.0), 0.7), abs=0.02)
    assert math.dist(view.centre_px, given.centre_px) < 0.8
    assert view.metres_per_pixel == pytest.approx(0.5 * DIAMETER / given.major, rel=6e-3)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("upright", [True, False])
def test_an_edge_is_one_pixel_wide_where_its_gradient_is_greatest(upright: bool, sign: float):
    across = np.tile(np.array([0.0, 1.0, 5.0, 9.0, 9.0, 5.0, 1.0, 0.0], np.float32), (8, 1))
    strength = np.ascontiguousarray(across if upright else across.T)
    along, other = np.float32(sign) * strength, np.zeros_like(strength)
    edges = np.empty((30, 4))
    along_u, along_v = (along, other) if upright else (other, along)
    count = thin_edges(along_u, along_v, strength, MIN_GRADIENT, edges)
    assert count == 6
    places, directions = edges[:6, :2], edges[:6, 2:]
    np.testing.assert_array_equal(places[:, int(upright)], np.arange(1.0, 7.0))
    assert set(places[:, int(not upright)]) in ({3.0}, {4.0})
    np.testing.assert_array_equal(directions, np.tile((sign, 0.0) if upright else (0.0, sign), (6, 1)))
    assert thin_edges(along_u, along_v, strength, MIN_GRADIENT, edges[:2]) == 2


def test_an_edge_votes_for_the_centres_of_all_circles_on_both_of_its_sides():
    votes = np.zeros((50, 60), np.float32)
    vote(np.array([[61.0, 51.0, 0.6, 0.8]]), 10.0, 30.0, np.array([1.0, 1.0]), 2.0, votes)
    rows, columns = np.nonzero(votes)
    offset = 2.0 * np.column_stack([columns, rows]) + 2.0 - (61.0, 51.0)
    along, aside = offset @ (0.6, 0.8), offset @ (-0.8, 0.6)
    assert np.abs(aside).max() < 1.5
    assert np.abs(along).max() == pytest.approx(30.0, abs=1.5)
    assert np.abs(along).min() == pytest.approx(10.0, abs=1.5)
    assert [votes[rows, columns][along * side > 0.0].sum() for side in (-1.0, 1.0)] == [11.0, 11.0]


@pytest.mark.parametrize(("degrees", "faces"), [(0.0, True), (15.0, True), (-25.0, False), (90.0, False)])
def test_edges_that_face_a_centre_mark_their_direction_in_their_ring(degrees: float, faces: bool):
    number = np.arange(36)
    turns, gradients = 2.0 * np.pi * (number + 0.5) / 36, np.pi * (number > 17) + np.radians(degrees)
    radii = 20.0 * RING ** np.where(number % 2, 4.5, 10.5)
    places = (50.0, 40.0) + radii[:, None] * np.column_stack([np.cos(turns), np.sin(turns)])
    edges = np.column_stack([places, np.cos(turns + gradients), np.sin(turns + gradients)])
    marks, expected = np.zeros((15, 36), np.uint8), np.zeros((15, 36), np.uint8)
    expected[4, 1::2] = expected[10, ::2] = faces
    ring_support(edges, np.array([50.0, 40.0]), 20.0, RING, ALIGNMENT, marks)
    np.testing.assert_array_equal(marks, expected)


def test_the_harmonics_of_an_ellipse_are_those_that_edges_agree_on_in_all_directions():
    angles = np.linspace(-np.pi, np.pi, 200, endpoint=False)
    basis = [np.ones(200), np.cos(angles), np.sin(angles), np.cos(2.0 * angles), np.sin(2.0 * angles)]
    given, best = np.array([100.0, 6.0, -4.0, 3.0, 2.0]), np.zeros(5)
    elsewhere = np.where(np.arange(200) % 4, 0.0, np.random.default_rng(1).uniform(5.0, 30.0, 200))
    assert fit_harmonics(angles, given @ basis + elsewhere, 1.0, TRIES, BINS, best) == BINS
    np.testing.assert_allclose(best, given, atol=1e-6)
    assert fit_harmonics(angles[100:], (given @ basis)[100:], 1.0, TRIES, BINS, best) == BINS // 2
    for refused in ([100.0, 0.0, 30.0, 0.0, 0.0], [100.0, 0.0, 0.0, -15.0, 0.0]):  # off the centre, and too long
        assert fit_harmonics(angles, np.array(refused) @ basis, 1.0, TRIES, BINS, best) == 0


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_along_a_normal_the_steepest_rise_or_fall_is_found_between_pixels(way: float):
    u = np.arange(80.0)
    light = 60.0 + 90.0 / (1.0 + np.exp((30.3 - u) / 1.2)) - 130.0 / (1.0 + np.exp((u - 42.6) / -1.2))
    gray = np.tile(np.rint(light).clip(0.0, 255.0).astype(np.uint8), (40, 1))
    points, normals = np.array([[40.0, 20.0], [0.5, 20.0]]), np.array([[way, 0.0], [way, 0.0]])
    for sign, at, slope in ((1, 30.3, 90.0 / 4.8), (-1, 42.6, -130.0 / 4.8), (0, 42.6, -130.0 / 4.8)):
        found = np.full((2, 2), np.nan)
        steepest(gray, points, normals, 12.0, 0.5, int(way) * sign, found)
        assert found[0, 0] == pytest.approx(way * (at - 40.0), abs=0.15)
        assert found[0, 1] == pytest.approx(way * slope, rel=0.15)
        assert found[1, 1] == 0.0
