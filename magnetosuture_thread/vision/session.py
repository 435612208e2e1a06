"""A session: camera frames as they come, what is told of each as it goes; what `vision_tracker` does without ROS."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.geometry.polyline import Points, arc_lengths, points_at
from magnetosuture_thread.scene.scene import Scene
from magnetosuture_thread.vision.lens import Lens
from magnetosuture_thread.vision.look import State, Track, no_pose
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import VisionTracker

CENTRELINE_POINTS = 64  # of the published centreline; each is a whole pose in the message
REPEATED = "camera repeats frames"
MAX_CYCLE = 100  # frames; after more of them a repetition is not found
SAMPLE_ROWS = 64  # of a frame, and as dense columns, that are compared; what moves in a dish covers several


class RepetitionDetector:
    """Finds frames that came before.

    No sensor gives the same noise twice: a frame that is equal, bit for bit, to an earlier one of the last `MAX_CYCLE`
    is not of this moment. Frames are compared by the hash of a sample of their pixels.
    """

    def __init__(self) -> None:
        self._seen: deque[tuple[float, int]] = deque(maxlen=MAX_CYCLE)

    def is_repeated(self, time_s: float, image: np.ndarray) -> bool:
        """Return whether a frame, taken at a time [s], was there before that time, and keep it."""
        step = max(1, min(image.shape[:2]) // SAMPLE_ROWS)
        sample = hash(image[::step, ::step].tobytes())
        # A bag that was wound back gives its frames again, at the same times.
        repeated = any(sample == other and before < time_s for before, other in self._seen)
        self._seen.append((time_s, sample))
        return repeated


@dataclass(frozen=True)
class FrameMeasurement:
    """What is told of one frame.

    Attributes:
        track: what was seen.
        centreline: of the thread, equally spaced from the needle's tail on, shape (64, 2) [m]; shape (0, 2) where
            there is none to tell.
        problem: why the frame was refused, if it was.
    """

    track: Track
    centreline: Points
    problem: InvalidInputError | None = None

    @property
    def tracked(self) -> bool:
        """Whether there is a pose to tell."""
        return self.track.state is State.TRACKED


class TrackerSession:
    """Tracks needle and thread over one run.

    The node `vision_tracker` and the replay without a graph are both a shell around this, so that the same
    frames give the same poses to the last bit.

    Args:
        settings: what to look for.
        scene: the dish, and the shapes in which neither needle nor thread can be.

    Attributes:
        frames: that came.
        tracked: those with a pose.
    """

    def __init__(self, settings: VisionTrackerSettings, scene: Scene) -> None:
        self._tracker = VisionTracker(settings, scene)
        self._repetition = RepetitionDetector()
        self.frames = self.tracked = 0

    @property
    def missing(self) -> State:
        """What to say of a frame that shows nothing: lost, or searching if there never was a needle."""
        return State.LOST if self.tracked else State.SEARCHING

    def set_scene(self, scene: Scene) -> None:
        """Take another scene; see `VisionTracker.set_scene`."""
        self._tracker.set_scene(scene)

    def set_lens(self, lens: Lens | None) -> None:
        """Take the camera's lens; see `VisionTracker.set_lens`."""
        self._tracker.set_lens(lens)

    def on_image(self, time_s: float, image: np.ndarray) -> FrameMeasurement:
        """Look at the next frame, taken at a time [s]; see `VisionTracker.track`. One that came before has no pose."""
        try:
            track = self._tracker.track(image, time_s)
        except InvalidInputError as error:
            return self.on_broken(error)
        if self._repetition.is_repeated(time_s, image) and len(track.tail):
            track = no_pose(self.missing, REPEATED, track.view)
        self.frames += 1
        self.tracked += track.state is State.TRACKED
        return FrameMeasurement(track, published_centreline(track))

    def on_broken(self, problem: InvalidInputError) -> FrameMeasurement:
        """Count a frame that cannot be looked at, and say why."""
        self.frames += 1
        return FrameMeasurement(no_pose(self.missing, str(problem), None), np.empty((0, 2)), problem)


def published_centreline(track: Track) -> Points:
    """Return what is told of a centreline: `CENTRELINE_POINTS` vertices equally spaced, or none, shape (m, 2) [m]."""
    if len(track.centreline) < 2:
        return np.empty((0, 2))
    at = np.linspace(0.0, arc_lengths(track.centreline)[-1], CENTRELINE_POINTS)
    return points_at(track.centreline, at)
