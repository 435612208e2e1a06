"""The needle: its ends are never swapped, and nothing else is taken for it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from magnetosuture_thread.rig.camera import DishCamera, Scene
from magnetosuture_thread.vision.needle import find_needle

NOWHERE = np.array([[0.5, 0.5], [0.51, 0.5]])


def find(frame: np.ndarray, view):
    """Return the needle in a frame."""
    return find_needle(np.ascontiguousarray(frame[:, :, 1]), view, 0.0175, 0.007, 0.0004)


@pytest.mark.parametrize("degrees", range(0, 360, 15))
def test_tail_and_tip_are_never_swapped(camera, view, degrees: int):
    angle = np.radians(degrees)
    along = np.array([np.cos(angle), np.sin(angle)])
    tail = -0.0035 * along + (0.0004, -0.0003)
    found = find(camera.render(tail, angle, NOWHERE), view)
    assert found is not None
    assert np.linalg.norm(view.to_dish(found.tail_px) - tail) < 0.6 * view.metres_per_pixel
    assert np.degrees(np.arccos(found.direction_px @ (along * (1, -1)))) < 0.5
    assert found.width_px == pytest.approx(5.0, abs=1.5)


def test_a_needle_of_another_length_is_not_taken(view):
    for length in (0.003, 0.012):
        camera = DishCamera(Scene(needle_length=length), view)
        assert find(camera.render(np.array([-0.005, 0.0]), 0.3, NOWHERE), view) is None


def test_a_rod_with_two_blunt_ends_is_not_guessed_about(camera, view):
    frame = camera.render(np.array([0.5, 0.5]), 0.0, NOWHERE).copy()
    cv2.line(frame, (280, 240), (367, 240), (50, 50, 50), 5, cv2.LINE_AA)
    assert find(frame, view) is None


def test_a_needle_without_contrast_is_not_seen(camera, view):
    frame = camera.render(np.array([0.0, 0.0]), 0.3, NOWHERE)
    faint = (200 + 0.2 * (frame.astype(float) - 200)).astype(np.uint8)
    assert find(faint, view) is None
