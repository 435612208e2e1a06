"""A session of frames, as the node and the replay without a graph have it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.geometry.thread_observation import ThreadObservation
from magnetosuture_thread.settings.errors import InvalidInputError
from magnetosuture_thread.vision.observe import observe
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import (
    REPEATED,
    RepetitionDetector,
    State,
    Track,
    TrackerSession,
    VisionTracker,
)

TAIL = np.array([0.002, 0.001])


@pytest.fixture
def searches(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Return a list that grows with each measurement of a thread, by whether all of the frame is searched."""
    searches = list[bool]()

    def measure(*args: Any, **options: Any) -> ThreadObservation:
        searches.append(options["search"])
        return observe(*args, **options)

    monkeypatch.setattr("magnetosuture_thread.vision.tracker.observe", measure)
    return searches


def test_the_pose_of_the_result_comes_before_the_thread_is_measured_and_not_of_a_repeated_frame(
    camera, thread_arc, searches: list[bool]
):
    image = camera.render(TAIL, 0.4, thread_arc(TAIL, 0.4 + np.pi, 40.0))
    session, poses, measured = TrackerSession(VisionTrackerSettings(confirm_frames=1), Scene()), list[Track](), []

    def on_pose(pose: Track) -> None:
        poses.append(pose)
        measured.append(len(searches))

    seen = session.on_image(1.0, image, on_pose)
    assert measured == [0]
    for name in ("state", "confidence", "tail", "tip", "heading", "covariance", "curvature"):
        assert np.array_equal(getattr(poses[0], name), getattr(seen.track, name))
    assert not session.on_image(2.0, image, on_pose).tracked
    assert len(poses) == 1


def test_all_of_a_frame_is_searched_for_a_thread_that_seems_cut_four_times_a_second(
    camera, thread_arc, searches: list[bool]
):
    image = camera.render(TAIL, 0.4, thread_arc(TAIL, 0.4 + np.pi, 40.0)[:60])  # never all of the thread
    follower = VisionTracker(VisionTrackerSettings(confirm_frames=1), Scene())
    for index in range(16):
        assert follower.track(image, index / 20.0).state is State.TRACKED
    assert sum(searches) == 4  # at 0, 0.25, 0.5 and 0.75 s
    assert len(searches) == 16 + 3  # but for the first frame, after the part of it around the needle


def test_frames_are_counted_and_the_centreline_is_equally_spaced(camera, thread_arc):
    image = camera.render(TAIL, 0.4, thread_arc(TAIL, 0.4 + np.pi, 40.0))
    session = TrackerSession(VisionTrackerSettings(confirm_frames=1), Scene())
    assert session.missing is State.SEARCHING
    seen = session.on_image(1.0, image)
    assert seen.tracked
    assert seen.problem is None
    assert seen.centreline.shape == (64, 2)
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
