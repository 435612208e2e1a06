"""The walk along the thread."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.geometry.polyline import arc_lengths, points_at
from magnetosuture_thread.vision.images import Wall, prepare
from magnetosuture_thread.vision.needle.arc import Arc, MeasuredNeedle
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.thread.centreline import WALL_PX, find_centreline
from magnetosuture_thread.vision.tracker import VisionTracker
from test.vision.scenes import PIXEL, SCENE, VIEW, Pose, blob, line_error, render

NEEDLE = MeasuredNeedle(Arc(np.array([300.0, 240.0]), 0.0, 0.0), 87.0, 5.0)
TRACKER = VisionTracker(VisionTrackerSettings(), SCENE)


def drawn(points: np.ndarray, width: int = 1, noise: float = 2.0, level: int = 140) -> np.ndarray:
    """Return a bright image with a needle and a dark line."""
    image = np.full((480, 640), 225, np.uint8)
    cv2.polylines(image, [np.round(points * 16).astype(np.int32)], False, level, width, cv2.LINE_AA, 4)
    cv2.line(image, (300, 240), (387, 240), 50, 5)
    rough = np.random.default_rng(0).normal(0.0, noise, image.shape)
    return np.clip(cv2.GaussianBlur(image, (0, 0), 0.8) + rough, 0, 255).astype(np.uint8)


def walk(image: np.ndarray, max_length: float = 400.0, reach: float = 230.0) -> np.ndarray:
    """Follow the thread."""
    return find_centreline(prepare(image, 2), NEEDLE, max_length, Wall((320.0, 240.0), reach + WALL_PX))


def wave(length: float = 150.0) -> np.ndarray:
    """Return a sine to the west of the needle's tail."""
    x = np.linspace(0.0, length, 300)
    return np.column_stack([300.0 - x, 240.0 + 12.0 * np.sin(x / 18.0)])


def winding(turn: np.ndarray, length: float = 237.0, start: tuple[float, float] = (300.0, 240.0)) -> np.ndarray:
    """Return a line of a length whose direction is given along it, from u towards v, shape (m + 1, 2)."""
    steps = length / len(turn) * np.column_stack([np.cos(turn), np.sin(turn)])
    return np.vstack([start, np.array(start) + np.cumsum(steps, axis=0)])


def check_order(found: np.ndarray, truth: np.ndarray, max_shift: float = 4.0) -> None:
    """Assert that a line goes along the true one, at the same length in the same place."""
    at = np.linspace(0.0, 0.94 * arc_lengths(truth)[-1], 60)
    assert arc_lengths(found)[-1] > 0.95 * arc_lengths(truth)[-1]
    assert np.linalg.norm(points_at(found, at) - points_at(truth, at), axis=1).max() < max_shift


@pytest.mark.parametrize(("noise", "level"), [(2.0, 140), (7.0, 140), (2.0, 195)], ids=["usual", "noisy", "faint"])
def test_it_follows_the_line_to_its_end_and_no_farther(noise: float, level: int):
    found = walk(drawn(wave(), noise=noise, level=level))
    mean, share = line_error(found, wave())
    assert mean < 0.5
    assert share > 0.97
    assert np.linalg.norm(found[-1] - wave()[-1]) < 6.0
    np.testing.assert_array_equal(found[0], NEEDLE.tail_px)


def test_it_goes_over_a_short_gap_and_ends_at_a_long_one():
    line = wave()
    for gap, crosses in ((7.0, True), (35.0, False)):
        image = drawn(line)
        image[200:280, int(230.0 - gap) : 230] = 225
        assert (walk(image)[-1, 0] < 170.0) == crosses


def test_under_glare_the_thread_may_go_on():
    line = np.column_stack([300.0 - np.linspace(0.0, 180.0, 300), 240.0 + np.linspace(0.0, 30.0, 300)])
    image = drawn(line)
    image[:, 190:222] = 225  # a gap too long to cross ...
    assert walk(image)[-1, 0] > 200.0
    image[:, 192:220] = 252  # ... but not where the lamp is seen instead of the floor
    assert walk(image)[-1, 0] < 130.0


def test_it_stops_at_the_longest_length_and_at_the_wall():
    assert walk(drawn(wave()), max_length=60.0)[-1, 0] > 240.0
    near_wall = walk(drawn(wave()), reach=100.0)
    assert np.linalg.norm(near_wall - (320.0, 240.0), axis=1).max() <= 100.0
    assert np.linalg.norm(near_wall[-1] - (320.0, 240.0)) > 96.0


def test_without_a_line_there_is_only_the_tail():
    for noise in (2.0, 7.0):
        assert walk(drawn(np.array([[0.0, 0.0], [5.0, 5.0]]), noise=noise)).shape == (1, 2)


@pytest.mark.parametrize("angle", [-2.0, -1.1, 1.4, 2.6])
def test_the_thread_may_leave_the_tail_at_any_angle_but_the_needles(angle: float):
    line = winding(np.full(100, angle) + 0.4 * np.linspace(0.0, 1.0, 100), length=120.0)
    found = walk(drawn(line))
    assert np.linalg.norm(found[-1] - line[-1]) < 5.0


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("radius", [30.0, 16.0])
def test_the_walk_goes_straight_through_its_own_crossing(sign: float, radius: float):
    turned = np.clip((np.linspace(0.0, 237.0, 800) - 50.0) / radius, 0.0, 1.6 * np.pi)
    line = winding(np.pi + sign * turned)
    check_order(walk(drawn(line), max_length=250.0), line)


def test_the_walk_crosses_under_the_needle():
    turned = np.clip((np.linspace(0.0, 237.0, 800) - 25.0) / 26.0, 0.0, 1.5 * np.pi)
    line = winding(np.pi + turned)
    assert line[:, 0].max() > 330.0 or line[:, 1].min() < 200.0
    check_order(walk(drawn(line), max_length=250.0), line)


def test_a_near_pass_beside_an_earlier_part_does_not_capture_it():
    """A hairpin whose arms are 7 px apart."""
    s = np.linspace(0.0, 237.0, 1200)
    line = winding(np.pi + np.clip((s - 110.0) / 7.0, 0.0, np.pi) - 0.25 * np.clip((s - 140.0) / 90.0, 0.0, 1.0))
    check_order(walk(drawn(line), max_length=250.0), line)


def test_the_thread_is_followed_past_posts():
    tail = np.array([0.004, 0.006])
    angle = np.pi - 0.2 + np.linspace(0.0, 2.4, 300)
    thread = np.vstack([tail, tail + np.cumsum(0.019 / 300 * np.column_stack([np.cos(angle), np.sin(angle)]), axis=0)])
    aside = np.column_stack([np.sin(angle), -np.cos(angle)])
    posts = [Disc(tuple(thread[i] + 0.00142 * aside[i] * sign), 0.0013) for i, sign in ((90, 1.0), (190, -1.0))]
    seen = TRACKER.look(render(Pose(tail, -0.2), thread, obstacles=tuple(posts)))
    assert seen.reason == ""
    mean, share = line_error(VIEW.to_pixels(seen.centreline), VIEW.to_pixels(thread))
    assert mean < 1.0
    assert share > 0.95


def test_the_thread_is_followed_through_a_hot_spot_and_up_to_the_wall():
    tail = np.array([0.004, 0.0])
    thread = np.column_stack([np.linspace(0.004, 0.0235, 200), 0.002 * np.sin(np.linspace(0.0, 3.0, 200))])
    spot = blob(np.array([0.0105, 0.0016]), 4e-4, (255.0, 255.0, 255.0))
    seen = TRACKER.look(render(Pose(tail, np.pi), thread, covers=(spot,)))
    assert seen.reason == ""
    reach = np.linalg.norm(seen.centreline, axis=1)
    assert 0.0175 - 6.0 * PIXEL < reach.max() < 0.0175
    mean, _ = line_error(VIEW.to_pixels(seen.centreline), VIEW.to_pixels(thread))
    assert mean < 1.0
