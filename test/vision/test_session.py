"""A session of frames, as the node and the replay without a graph have it."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.scene import Scene
from magnetosuture_thread.vision.look import State
from magnetosuture_thread.vision.session import TrackerSession
from magnetosuture_thread.vision.settings import VisionTrackerSettings

TAIL = np.array([0.002, 0.001])


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
