"""The needle: its arc, its tail's edge; its ends are never swapped, and nothing else is taken for it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.vision.cases import SIZES, usual_case
from benchmarks.vision.frames import DISH_RADIUS, ROWS
from benchmarks.vision.frames import render as render_case
from magnetosuture_thread.geometry.scene import Dish, Scene
from magnetosuture_thread.rig.camera import CameraScene, DishCamera
from magnetosuture_thread.vision.arc import (
    Arc,
    MeasuredNeedle,
    NeedleSize,
    fit_arc,
)
from magnetosuture_thread.vision.images import prepare
from magnetosuture_thread.vision.needle import find_needles
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import VisionTracker
from test.vision.scenes import NOWHERE, VIEW, Pose, render

SIZE = NeedleSize(0.007 / VIEW.metres_per_pixel, 0.0004 / VIEW.metres_per_pixel, 0.1)
CURVATURES = (-440.0, -120.0, 0.0, 300.0)


ANGLES = st.floats(-3.1, 3.1)
ARC_CURVATURES = st.floats(-0.035, 0.035)


@given(angle=ANGLES, curvature=ARC_CURVATURES)
@settings(max_examples=60, deadline=None)
def test_coordinates_are_the_inverse_of_points(angle: float, curvature: float):
    arc = Arc(np.array([100.0, 80.0]), angle, curvature)
    along, aside = np.linspace(-4.0, 84.0, 30), np.linspace(-5.0, 5.0, 30)
    back = arc.coordinates(arc.at(along, aside))
    np.testing.assert_allclose(back[0], along, atol=0.01)
    np.testing.assert_allclose(back[1], aside, atol=0.01)


@given(angle=ANGLES, curvature=ARC_CURVATURES)
@settings(max_examples=60, deadline=None)
def test_a_fit_goes_through_points_of_an_arc(angle: float, curvature: float):
    points = Arc(np.array([300.0, 200.0]), angle, curvature).at(np.linspace(0.0, 80.0, 50))
    fitted = fit_arc(points)
    assert abs(abs(fitted.curvature) - abs(curvature)) < 1e-5
    assert np.abs(fitted.coordinates(points)[1]).max() < 0.01


@cache  # not as the module is imported, which every worker does
def camera_of(curvature: float) -> DishCamera:
    """Return a camera over a needle of a curvature."""
    return DishCamera(CameraScene(needle_curvature=curvature), VIEW, seed=4)


def find(frame: np.ndarray, toward: np.ndarray | None = None) -> tuple[list[MeasuredNeedle], list[str]]:
    """Return the needles in a frame, and why other things are none."""
    return find_needles(prepare(frame[:, :, 1], VIEW, 0.0175), SIZE, toward)


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
    if not found:  # a hot spot at an end, and it says so
        return
    assert len(found) == 1
    along = np.array([np.cos(angle), -np.sin(angle)])
    assert np.linalg.norm(found[0].tail_px - VIEW.to_pixels(pose.tail)) < 1.0
    assert found[0].direction_px @ along > np.cos(np.radians(2.5))
    assert found[0].width_px == pytest.approx(5.0, abs=1.2)
    assert -found[0].curvature_px == pytest.approx(curvature * VIEW.metres_per_pixel, abs=1.5e-3)


@pytest.mark.parametrize(
    "size", [{"needle_length": length} for length in (0.003, 0.0058, 0.0082, 0.012)] + [{"needle_width": 0.0009}]
)
def test_a_needle_of_another_size_is_not_taken(size: dict[str, Any]):
    assert find(render(Pose(np.array([-0.005, 0.0]), 0.3), **size))[0] == []


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


FRAMES = 24
DRAWN_LARGER_PX = 0.12  # by which the rig's camera draws all solids too large, on each side; in its own pixels


@pytest.mark.parametrize("columns", [640, 1280])
def test_the_tail_is_neither_too_far_back_nor_too_far_ahead(columns: int):
    ahead = []
    for number in range(FRAMES):
        random = np.random.default_rng([columns, number])
        size = SIZES[columns]
        case = replace(
            usual_case(random), size=size, thread_px=0.975 * size[1] / ROWS, shift=tuple(random.uniform(-1.0, 1.0, 2))
        )
        given_view = VisionTrackerSettings(
            needle_length=case.needle.length,
            needle_width=case.needle.width,
            thread_length=0.019,
            metres_per_pixel=case.view.metres_per_pixel,
            dish_centre_px=case.view.centre_px,
        )
        track = VisionTracker(given_view, Scene(dish=Dish(2.0 * DISH_RADIUS))).look(render_case(case, number))
        assert len(track.tail), track.reason
        along = np.array([np.cos(case.needle.heading), np.sin(case.needle.heading)])
        ahead.append(float((track.tail - case.needle.tail) @ along) / case.working_scale)
    assert abs(np.mean(ahead) + DRAWN_LARGER_PX) < 0.05
    assert np.std(ahead) < 0.12
