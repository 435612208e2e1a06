"""The walk along the thread."""

from __future__ import annotations

import cv2
import numpy as np

from magnetosuture_thread.vision.centreline import find_centreline
from magnetosuture_thread.vision.needle import SeenNeedle

NEEDLE = SeenNeedle(np.array([300.0, 240.0]), np.array([387.0, 240.0]), np.array([1.0, 0.0]), 5.0)


def drawn(points: np.ndarray, width: int = 1) -> np.ndarray:
    """Return a bright image with a needle and a dark line."""
    image = np.full((480, 640), 225, np.uint8)
    cv2.line(image, (300, 240), (387, 240), 50, 5)
    cv2.polylines(image, [np.round(points * 16).astype(np.int32)], False, 140, width, cv2.LINE_AA, 4)
    noise = np.random.default_rng(0).normal(0.0, 2.0, image.shape)
    return np.clip(cv2.GaussianBlur(image, (0, 0), 0.8) + noise, 0, 255).astype(np.uint8)


def walk(image: np.ndarray, longest: float = 400.0, reach: float = 230.0) -> np.ndarray:
    """Follow the thread."""
    return find_centreline(image, NEEDLE, longest, (320.0, 240.0), reach)


def wave(length: float = 150.0) -> np.ndarray:
    """Return a sine to the west of the needle's tail."""
    x = np.linspace(0.0, length, 300)
    return np.column_stack([300.0 - x, 240.0 + 12.0 * np.sin(x / 18.0)])


def distance(points: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Return the distance of points from a finely sampled line [px]."""
    return np.array([np.linalg.norm(line - point, axis=1).min() for point in points])


def test_it_follows_the_line_to_its_end_and_no_farther():
    found = walk(drawn(wave()))
    assert distance(found, wave()).mean() < 0.3
    assert np.linalg.norm(found[-1] - wave()[-1]) < 5.0
    np.testing.assert_array_equal(found[0], NEEDLE.tail_px)


def test_it_goes_over_a_short_gap_and_ends_at_a_long_one():
    line = wave()
    for gap, crosses in ((7.0, True), (25.0, False)):
        image = drawn(line)
        image[200:280, int(230.0 - gap) : 230] = 225
        assert (walk(image)[-1, 0] < 170.0) == crosses


def test_it_stops_at_the_longest_length_and_at_the_wall():
    assert walk(drawn(wave()), longest=60.0)[-1, 0] > 240.0
    near_wall = walk(drawn(wave()), reach=100.0)
    assert np.linalg.norm(near_wall - (320.0, 240.0), axis=1).max() <= 100.0


def test_without_a_line_there_is_only_the_tail():
    assert walk(drawn(np.array([[0.0, 0.0], [5.0, 5.0]]))).shape == (1, 2)


def test_a_line_that_folds_back_beside_the_needle_is_found():
    fold = np.column_stack([300.0 + np.linspace(0.0, 45.0, 100), 240.0 - np.linspace(0.0, 100.0, 100)])
    found = walk(drawn(fold))
    assert np.linalg.norm(found[-1] - fold[-1]) < 5.0
