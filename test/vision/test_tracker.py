"""The tracker against rendered frames whose truth is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.geometry.polyline import arc_lengths, points_at
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import VisionTracker, decode_image, unpack_image

PIXEL = 8e-5

# Tail [m], heading [rad], angle at which the thread leaves against the opposite of the heading, curvature [1/m].
POSES = [
    ((0.002, 0.001), 0.4, 0.0, 40.0),
    ((-0.002, 0.003), 3.5, 0.3, -60.0),
    ((-0.004, -0.004), -1.9, -0.8, -90.0),
    ((-0.004, -0.006), -1.6, 0.2, -110.0),
    ((-0.005, -0.006), -4.04, 1.7, 0.0),
]


def track(camera, tail, heading, thread):
    """Render a frame and track it."""
    return VisionTracker(VisionTrackerSettings()).track(camera.render(np.asarray(tail), heading, thread))


@pytest.mark.parametrize(("tail", "heading", "leaves", "curvature"), POSES)
def test_needle_and_thread_are_where_they_were_drawn(camera, thread_arc, tail, heading, leaves, curvature):
    thread = thread_arc(np.asarray(tail), heading + np.pi + leaves, curvature)
    found = track(camera, tail, heading, thread)
    assert found.lost == ""
    assert np.linalg.norm(found.tail - tail) < 1.2 * PIXEL
    along = np.array([np.cos(heading), np.sin(heading)])
    assert np.degrees(np.arccos(np.clip(found.heading @ along, -1.0, 1.0))) < 0.5
    assert np.linalg.norm(found.tip - (tail + 0.007 * along)) < 3.0 * PIXEL
    dense = points_at(thread, np.linspace(0.0, 0.019, 2000))
    apart = [np.linalg.norm(dense - point, axis=1).min() for point in found.centreline]
    assert np.mean(apart) < 0.5 * PIXEL
    assert arc_lengths(found.centreline)[-1] > 0.95 * 0.019


def test_the_walk_goes_straight_through_a_crossing(camera):
    """The thread leaves to the west, turns by 270 degrees, and crosses itself on its way north."""
    s = np.linspace(0.0, 1.0, 400)
    turn = np.pi + 1.5 * np.pi * np.clip((s - 0.3) / 0.45, 0.0, 1.0)
    steps = 0.019 / 399 * np.column_stack([np.cos(turn), np.sin(turn)])[:-1]
    tail = np.array([0.004, -0.002])
    thread = np.vstack([tail, tail + np.cumsum(steps, axis=0)])
    found = track(camera, tail, 0.0, thread)
    assert found.lost == ""
    length = arc_lengths(found.centreline)[-1]
    assert length > 0.95 * 0.019
    at = np.linspace(0.0, 0.95 * 0.019, 50)
    apart = np.linalg.norm(points_at(found.centreline, at) - points_at(thread, at), axis=1)
    assert apart.max() < 4.0 * PIXEL


def test_the_thread_is_followed_past_a_post(camera_with_post, thread_arc):
    tail = np.array([0.0, 0.006])
    thread = thread_arc(tail, -1.0, -45.0)
    found = track(camera_with_post, tail, np.pi - 1.0, thread)
    assert found.lost == ""
    assert arc_lengths(found.centreline)[-1] == pytest.approx(0.019, rel=0.05)


def test_a_thread_over_the_wall_is_followed_up_to_the_wall(camera, thread_arc):
    tail = np.array([0.008, 0.0])
    found = track(camera, tail, np.pi, thread_arc(tail, 0.3, 0.0))
    assert found.lost == ""
    assert np.linalg.norm(found.centreline, axis=1).max() < 0.0175
    assert arc_lengths(found.centreline)[-1] > 0.006


def test_without_a_needle_it_says_lost_and_gives_nothing(camera):
    found = track(camera, (0.5, 0.5), 0.0, np.array([[0.5, 0.5], [0.51, 0.5]]))
    assert found.lost == "no single needle in the dish"
    assert found.tail.size == found.heading.size == found.centreline.size == 0


def test_two_needles_are_not_guessed_between(camera, thread_arc):
    first = camera.render(np.array([0.002, 0.005]), 0.4, thread_arc(np.array([0.002, 0.005]), 3.5, 0.0, length=1e-3))
    second = camera.render(np.array([-0.005, -0.006]), 0.4, np.array([[-0.005, -0.006], [-0.0051, -0.006]]))
    assert VisionTracker(VisionTrackerSettings()).track(np.minimum(first, second)).lost != ""


def test_without_a_dish_it_says_lost():
    found = VisionTracker(VisionTrackerSettings()).track(np.full((480, 640, 3), 120, np.uint8))
    assert found.lost == "no dish in the image"
    assert found.view is None


def test_a_needle_without_a_thread_has_no_centreline(camera):
    found = track(camera, (0.0, 0.0), 0.7, np.array([[0.5, 0.5], [0.51, 0.5]]))
    assert found.lost == ""
    assert len(found.centreline) == 1


def test_grey_frames_of_another_size_are_taken(camera, thread_arc):
    frame = camera.render(np.zeros(2), 0.2, thread_arc(np.zeros(2), 0.2 + np.pi, 30.0))
    tracker = VisionTracker(VisionTrackerSettings())
    assert tracker.track(frame).lost == ""
    grey = cv2.resize(frame[:, :, 1], (800, 600), interpolation=cv2.INTER_CUBIC)
    found = tracker.track(grey)
    assert found.lost == ""
    assert np.linalg.norm(found.tail) < 2.0 * PIXEL


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((480, 640, 3), np.float32),
        np.zeros((480, 640, 4), np.uint8),
        np.zeros((10, 10, 3), np.uint8),
        np.zeros(7, np.uint8),
        np.zeros((0, 0, 3), np.uint8),
    ],
)
def test_what_is_no_image_is_refused(image: np.ndarray):
    with pytest.raises(InvalidInputError, match="image"):
        VisionTracker(VisionTrackerSettings()).track(image)


def test_bytes_that_are_no_image_are_refused():
    for data in (b"", b"\xff\xd8 no jpeg", b"0" * 500):
        with pytest.raises(InvalidInputError, match="a JPEG or PNG image"):
            decode_image(data)


def test_raw_images_are_unpacked_with_their_padding():
    pixels = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3)
    padded = np.zeros((2, 12), np.uint8)
    padded[:, :9] = pixels.reshape(2, 9)
    assert (unpack_image(padded.tobytes(), 2, 3, 12, "bgr8") == pixels).all()
    assert (unpack_image(padded.tobytes(), 2, 3, 12, "rgb8") == pixels[:, :, ::-1]).all()
    assert (unpack_image(padded.tobytes(), 2, 9, 12, "mono8") == padded[:, :9]).all()


@pytest.mark.parametrize(
    ("height", "width", "step", "encoding", "words"),
    [
        (2, 3, 9, "bayer_rggb8", "bgr8, rgb8 or mono8"),
        (2, 3, 10, "bgr8", "height times step bytes"),
        (2, 4, 9, "bgr8", "height times step bytes"),
        (0, 3, 9, "bgr8", "height times step bytes"),
    ],
)
def test_raw_images_that_do_not_fit_are_refused(height: int, width: int, step: int, encoding: str, words: str):
    with pytest.raises(InvalidInputError, match=words):
        unpack_image(bytes(18), height, width, step, encoding)
