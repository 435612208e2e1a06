"""A session of frames, as the node and the replay without a graph have it."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.settings.errors import InvalidInputError
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import (
    REPEATED,
    RepetitionDetector,
    State,
    Track,
    TrackerSession,
)

TAIL = np.array([0.002, 0.001])


def test_the_pose_of_the_result_comes_before_the_thread_is_measured_and_not_of_a_repeated_frame(camera, thread_arc):
    image = camera.render(TAIL, 0.4, thread_arc(TAIL, 0.4 + np.pi, 40.0))
    session, poses = TrackerSession(VisionTrackerSettings(confirm_frames=1), Scene()), list[Track]()
    seen = session.on_image(1.0, image, poses.append)
    assert (len(poses[0].centreline), len(seen.centreline)) == (0, 64)
    for name in ("state", "confidence", "tail", "tip", "heading", "covariance", "curvature"):
        assert np.array_equal(getattr(poses[0], name), getattr(seen.track, name))
    assert not session.on_image(2.0, image, poses.append).tracked
    assert len(poses) == 1


def test_frames_are_counted_and_the_centreline_is_equally_spaced(camera, thread_arc):
    image = camera.render(TAIL, 0.4, thread_arc(TAIL, 0.4 + np.pi, 40.0))
    session = TrackerSession(VisionTrackerSettings(confirm_frames=1), Scene())
    assert session.missing is State.SEARCHING
    seen = session.on_image(1.0, image)
    assert seen.tracked
    steps = np.linalg.norm(np.diff(seen.centreline, axis=0), axis=1)
    assert steps == pytest.approx(np.full(63, steps.mean()), rel=0.1)
    late = session.on_image(0.9, image)
    assert not late.tracked
    assert late.problem is not None
    assert late.problem.field == "image.stamp"
    assert late.track.state is State.LOST
    broken = session.on_broken(InvalidInputError("image.data", "3 bytes", "a picture"))
    assert broken.track.reason == "image.data: got 3 bytes, expected a picture"
    assert len(broken.centreline) == 0
    assert (session.frames, session.tracked) == (3, 1)


def test_a_frame_that_came_before_has_no_pose_and_the_next_new_one_has(camera, thread_arc):
    one, other, third = (camera.render(TAIL, 0.4, thread_arc(TAIL, 0.4 + np.pi, 40.0)) for _ in range(3))
    session = TrackerSession(VisionTrackerSettings(confirm_frames=1), Scene())
    reasons = [
        session.on_image(float(at), image).track.reason for at, image in enumerate((one, one, other, one, third))
    ]
    assert reasons == ["", REPEATED, "", REPEATED, ""]
    assert (session.frames, session.tracked) == (5, 3)
    wound_back = [session.on_image(at, image) for at, image in ((0.0, one), (2.0, other))]
    assert [each.track.reason for each in wound_back] == ["", ""]


@pytest.mark.parametrize("cycle", [1, 10, 100])
def test_a_cycle_of_frames_is_found_in_its_second_round(cycle: int):
    frames = np.random.default_rng(1).integers(0, 256, (cycle, 96, 128, 3), dtype=np.uint8)
    detector = RepetitionDetector()
    found = [detector.is_repeated(float(at), frames[at % cycle]) for at in range(3 * cycle)]
    assert found == [False] * cycle + [True] * 2 * cycle
