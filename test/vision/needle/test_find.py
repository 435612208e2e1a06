"""The needle: its ends are never swapped, and nothing else is taken for it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from magnetosuture_thread.rig.camera import CameraScene, DishCamera
from magnetosuture_thread.vision.images import Layer, prepare
from magnetosuture_thread.vision.needle.arc import REVERSED_PX, Arc, LengthEstimator, MeasuredNeedle, NeedleSize
from magnetosuture_thread.vision.needle.find import find_needles
from magnetosuture_thread.vision.needle.template import (
    BLOOM_PX,
    THIN,
    _draw_with_slopes,
    draw_needle,
)
from magnetosuture_thread.vision.thread.centreline import without_needle
from test.vision.scenes import NOWHERE, VIEW, Pose, render

SIZE = NeedleSize(0.007 / VIEW.metres_per_pixel, 0.0004 / VIEW.metres_per_pixel, 0.1)
CURVATURES = (-440.0, -120.0, 0.0, 300.0)


@cache  # not as the module is imported, which every worker does
def camera_of(curvature: float) -> DishCamera:
    """Return a camera over a needle of a curvature."""
    return DishCamera(CameraScene(needle_curvature=curvature), VIEW, seed=4)


def find(frame: np.ndarray, toward: np.ndarray | None = None) -> tuple[list[MeasuredNeedle], list[str]]:
    """Return the needles in a frame, and why other things are none."""
    picture = prepare(np.ascontiguousarray(frame[:, :, 1]), 2)
    return find_needles(picture, VIEW, 0.0175, SIZE, toward)


@given(
    angle=st.floats(-3.14, 3.14),
    distance=st.floats(0.0, 0.008),
    around=st.floats(-3.14, 3.14),
    curvature=st.sampled_from(CURVATURES),
)
@settings(max_examples=50, deadline=None)
def test_tail_and_tip_are_never_swapped(angle: float, distance: float, around: float, curvature: float):
    tail = distance * np.array([np.cos(around), np.sin(around)])
    pose = Pose(tail, angle, curvature)
    found, _ = find(camera_of(curvature).render(tail, angle, NOWHERE))
    if not found:  # a hot spot at an end, and it says so: how often that may be is another test's
        return
    assert len(found) == 1
    along = np.array([np.cos(angle), -np.sin(angle)])
    assert np.linalg.norm(found[0].tail_px - VIEW.to_pixels(pose.tail)) < 1.0
    assert found[0].direction_px @ along > np.cos(np.radians(2.5))
    assert found[0].width_px == pytest.approx(5.0, abs=1.2)
    assert -found[0].curvature_px == pytest.approx(curvature * VIEW.metres_per_pixel, abs=1.5e-3)


def test_nearly_everywhere_it_is_found():
    random = np.random.default_rng(8)
    found = 0
    for index in range(100):
        curvature = CURVATURES[index % len(CURVATURES)]
        tail, angle = random.uniform(-0.006, 0.006, 2), random.uniform(-np.pi, np.pi)
        found += len(find(camera_of(curvature).render(tail, angle, NOWHERE))[0])
    assert found >= 96


@pytest.mark.parametrize("length", [0.003, 0.0058, 0.0082, 0.012])
def test_a_needle_of_another_length_is_not_taken(length: float):
    frame = render(Pose(np.array([-0.005, 0.0]), 0.3), needle_length=length)
    assert find(frame)[0] == []


@pytest.mark.parametrize("width", [0.00015, 0.0009])
def test_a_needle_of_another_width_is_not_taken(width: float):
    assert find(render(Pose(np.array([-0.005, 0.0]), 0.3), needle_width=width))[0] == []


@pytest.mark.parametrize("length", [80, 87, 92])
def test_a_rod_with_two_blunt_ends_is_not_guessed_about(length: int):
    frame = render(Pose(np.array([0.5, 0.5]), 0.0))
    cv2.line(frame, (280, 240), (280 + length, 240), (50, 50, 50), 5, cv2.LINE_AA)
    assert find(frame)[0] == []


def test_where_both_ends_look_alike_the_direction_it_must_have_decides():
    """The tip, blurred, fades no farther than the tail; only a prediction tells them apart."""
    frame = render(Pose(np.zeros(2), 0.0))
    fades = np.array([1.0, 0.0])
    plain, _ = find(frame)
    for toward in (fades, -fades):
        told, _ = find(frame, toward)
        np.testing.assert_allclose(told[0].direction_px, plain[0].direction_px)  # where they differ, it says nothing
    blunt = render(Pose(np.array([0.5, 0.5]), 0.0))
    outline = np.array([(300.0, 237.5), (385.0, 237.5), (387.5, 240.0), (385.0, 242.5), (300.0, 242.5)])
    cv2.fillPoly(blunt, [np.round(outline * 16).astype(np.int32)], (50, 50, 50), cv2.LINE_AA, 4)
    blunt = cv2.GaussianBlur(blunt, (0, 0), 0.8)
    assert find(blunt, fades)[0][0].direction_px[0] > 0.99
    assert find(blunt, -fades)[0][0].direction_px[0] < -0.99
    for sideways in (None, np.array([0.0, 1.0])):
        (vague,) = find(blunt, sideways)[0]
        assert not vague.heading_known
        assert vague.covariance is not None
        deviations = np.sqrt(np.diag(vague.covariance))
        assert deviations[0] > 84.0  # either end may be the tail
        assert deviations[2] > np.pi


def test_a_needle_without_contrast_is_not_seen():
    frame = render(Pose(np.zeros(2), 0.3))
    faint = (200 + 0.2 * (frame.astype(float) - 200)).astype(np.uint8)
    assert find(faint)[0] == []


def test_speckles_are_not_searched_for_long():
    speckled = np.full((480, 640, 3), 220, np.uint8)
    for u in range(180, 460, 30):
        cv2.circle(speckled, (u, 240), 9, (30, 30, 30), -1)
    assert find(speckled) == ([], ["10 dark things"])


def test_a_needle_the_other_way_round_has_its_tail_and_the_doubt_of_it_at_the_other_end():
    needle = MeasuredNeedle(Arc(np.array([10.0, 20.0]), 0.5, 0.0), 30.0, 4.0, covariance=np.diag([0.01, 0.04, 0.001]))
    needle = replace(needle, tail_shift_px=0.4, size_measured=True)
    other = needle.reversed()
    np.testing.assert_allclose(other.tail_edge_px, needle.tip_px)
    assert not other.size_measured
    np.testing.assert_allclose(other.tail_px, needle.tip_px)
    np.testing.assert_allclose(other.tip_px, needle.tail_px)
    np.testing.assert_allclose(other.direction_px, -needle.direction_px)
    assert other.covariance is not None
    assert other.covariance[1, 1] == pytest.approx(0.04 + 30.0**2 * 0.001), "the tip swings by the heading's error"
    assert other.covariance[1, 2] == pytest.approx(-30.0 * 0.001)
    assert other.covariance[0, 0] == pytest.approx(0.01 + REVERSED_PX**2), "it is not known where along it ends"
    assert other.covariance[2, 2] == 0.001


def test_a_length_is_measured_once_eight_confident_frames_in_a_row_agree():
    estimator = LengthEstimator()
    for _ in range(9):
        estimator.add(0.009, confidence=0.2)
    for length in (*[0.007] * 7, 0.0072, *[0.007] * 7):
        estimator.add(length, confidence=0.9)
        assert estimator.length is None
    assert estimator.size(0.0068, 4e-4, 1e-4).length_px == pytest.approx(68.0)
    estimator.add(0.007, confidence=0.9)  # the eighth after the one that was another
    assert estimator.length == 0.007
    measured, given = estimator.size(0.0068, 4e-4, 1e-4), LengthEstimator().size(0.0068, 4e-4, 1e-4)
    assert (measured.length_px, measured.width_px) == pytest.approx((70.0, 4.0))
    assert measured.tolerance < given.tolerance


LENGTH, HALF = 60.0, 2.5  # of a needle to the right from (20, 30) [px]


def test_a_drawn_needle_changes_with_width_and_length_as_its_slopes_say():
    along, aside = np.arange(-3.7, 65.0), np.arange(-8.0, 9.0) * 0.75
    shape = len(along), len(aside)
    drawn, wider, longer = np.empty(shape), np.empty(shape), np.empty(shape)
    _draw_with_slopes(along, aside, LENGTH, HALF, BLOOM_PX, THIN, drawn, wider, longer)

    def with_shape(length: float, bloom: float) -> np.ndarray:
        result = np.empty(shape)
        draw_needle(along, aside, length, HALF, bloom, THIN, result)
        return result

    step = 1e-5
    np.testing.assert_allclose(drawn, with_shape(LENGTH, BLOOM_PX))
    for slope, more, less in (
        (wider, with_shape(LENGTH, BLOOM_PX + step), with_shape(LENGTH, BLOOM_PX - step)),
        (longer, with_shape(LENGTH + step, BLOOM_PX), with_shape(LENGTH - step, BLOOM_PX)),
    ):
        np.testing.assert_allclose(slope, (more - less) / (2.0 * step), atol=1e-4)


@pytest.mark.parametrize("curvature", [0.0, 0.015, -0.02])
def test_without_the_needle_there_is_floor_and_what_lies_beside_its_tip(curvature: float):
    needle = MeasuredNeedle(Arc(np.array([30.0, 60.0]), 0.3, curvature), 60.0, 5.0, contrast=0.7)
    along, half = np.linspace(0.0, 60.0, 61), 2.5 + BLOOM_PX
    own = half * np.interp(along, [48.0, 60.0], [1.0, THIN])
    outline = np.vstack([needle.arc.at(along, own), needle.arc.at(along, -own)[::-1]])
    share = np.zeros((960, 960), np.float32)
    cv2.fillPoly(share, [np.round(8.0 * outline + 3.5).astype(np.int32)], 1.0)
    share = cv2.GaussianBlur(cv2.resize(share, (120, 120), interpolation=cv2.INTER_AREA), (0, 0), 1.0)
    u, v = np.round(needle.arc.at(58.0, 3.5)).astype(int)
    pixels = np.rint(200.0 * (1.0 - 0.7 * share)).astype(np.uint8)
    pixels[v, u] = 60
    floor = np.full((60, 60), 200, np.uint8)
    cleared = without_needle(Layer(pixels, floor, floor), 2, needle).astype(int)
    assert cleared[v, u] < 80
    cleared[v, u] = 200
    assert pixels.min() < 80
    assert cleared.min() > 185
    assert cleared.max() == 200
