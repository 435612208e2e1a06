"""Observations of a bag: each camera frame or recorded pose, with the measured thread and the ground truth."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from magnetosuture_thread.bags.reader import RecordedMessage
from magnetosuture_thread.bags.recording import Recording
from magnetosuture_thread.errors import BagError, InvalidInputError, MagnetosutureError
from magnetosuture_thread.evaluation.frames import Observation
from magnetosuture_thread.geometry.orientation import round_trip_heading
from magnetosuture_thread.geometry.polyline import Points, arc_lengths
from magnetosuture_thread.interface import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    GROUND_TRUTH_PULL,
    GROUND_TRUTH_THREAD,
    MATERIAL,
    MEASURED_THREAD,
    NEEDLE_POSE,
    SCENE,
    THREAD_OBSERVATION,
)
from magnetosuture_thread.messages.reading import (
    pose_deviation,
    read_force,
    read_observation,
    read_path,
    read_pose,
    stamp_of,
)
from magnetosuture_thread.messages.scene import parse_scene_message
from magnetosuture_thread.setups import Setup
from magnetosuture_thread.thread_model.session import MAX_WAITING_POSES
from magnetosuture_thread.thread_observation import ThreadObservation
from magnetosuture_thread.vision.images import decode_image, unpack_image
from magnetosuture_thread.vision.lens import lens_of
from magnetosuture_thread.vision.tracker import FrameMeasurement, TrackerSession, warm_up

MEASURED = 8  # the length of each so many seen threads is looked at
MAX_LENGTH_RATIO, MIN_LENGTH_RATIO = 3.0, 0.2  # of the setup's thread; a seen one beyond is not of this setup
NOT_FOUND, BROKEN, NOT_NEWER, NO_POSE = (
    "no needle for sure",
    "a broken picture",
    "a stamp not newer than the last",
    "a pose that is none",
)
Progress = Callable[[float], None]
CHANGING = (SCENE, MATERIAL)  # channels on which a bag records changes of scene and thread
_CHANGING = {channel.recorded for channel in CHANGING}
_TRUE, _SEEN = GROUND_TRUTH_THREAD.recorded, MEASURED_THREAD.recorded
_OBSERVED, _PULL = THREAD_OBSERVATION.recorded, GROUND_TRUTH_PULL.recorded
_NOTHING, _NO_FORCE = np.empty((0, 2)), np.empty(0)
_READERS: dict[str, tuple[Callable[[RecordedMessage], Any], Any]] = {
    _TRUE: (read_path, _NOTHING),
    _SEEN: (read_path, _NOTHING),
    _OBSERVED: (read_observation, ThreadObservation()),
    _PULL: (read_force, _NO_FORCE),
}


class ObservationReader(Iterator[Observation]):
    """Iterates over a bag's observations; see `read_observations`. Only a few are in memory at a time.

    Attributes:
        source: `camera` or `poses`.
        count: camera frames, or poses, so far.
        found: of these with a needle.
        refused: the others, by why.
        on_frame: called with stamp and what was seen in each frame, before its observation is given.
        on_record: called with stamp and each recorded pose and seen thread, before its observation is given; and
            with each scene that is taken.
    """

    def __init__(
        self,
        recording: Recording,
        setup: Setup,
        source: str,
        start: float,
        duration: float | None,
        progress: Progress,
    ) -> None:
        self.source = source
        self.count = self.found = 0
        self.refused: Counter[str] = Counter()
        self.on_frame: Callable[[int, FrameMeasurement], None] = lambda stamp, seen: None
        self.on_record: Callable[[int, RecordedMessage], None] = lambda stamp, record: None
        self._scene = setup.scene
        self._length = setup.model.thread_length
        self._threads = self._measured = self._odd = 0
        self._tracker: TrackerSession | None = None
        if source == "camera":
            warm_up()
            self._tracker = TrackerSession(setup.vision, setup.scene)
        self._recording = recording
        begin = recording.start + round(start * 1e9)
        whole = max((recording.duration - start) if duration is None else min(duration, recording.duration - start), 0)
        own = (
            (recording.camera, CAMERA_INFO)
            if source == "camera"
            else (NEEDLE_POSE, MEASURED_THREAD, THREAD_OBSERVATION)
        )
        given = (GROUND_TRUTH_THREAD, GROUND_TRUTH_PULL, *CHANGING, *own)
        channels = [channel for channel in given if channel is not None and recording.counts.get(channel.recorded)]
        earlier = recording.records(CHANGING, duration=start) if start > 0.0 else ()
        self._changes = [record for record in earlier if record.time < begin]
        for record in self._changes:
            self._follow(record)
        # What belongs to a frame, by topic and stamp.
        self._parts: dict[str, dict[int, Any]] = {c.recorded: {} for c in channels if c.recorded in _READERS}
        records = recording.records(channels, start=start, duration=duration)
        self._going = self._go(_with_progress(records, begin, whole, progress))

    def __next__(self) -> Observation:
        """Return the next observation.

        Raises:
            BagError: a length is not in metres, or the bag is damaged.
        """
        return next(self._going)

    def changes(self) -> list[RecordedMessage]:
        """Return, once, the changes of scene and thread before the last observation."""
        changes, self._changes = self._changes, []
        for record in changes:
            if record.topic == SCENE.recorded:
                self.on_record(stamp_of(record), record)
        return changes

    def thread_problem(self) -> str:
        """Return a text if most of the measured threads are not of this setup; else empty."""
        if 2 * self._odd <= self._measured:
            return ""
        return (
            f"{self._odd} of {self._measured} measured threads are longer than {MAX_LENGTH_RATIO:g} times or "
            f"shorter than {MIN_LENGTH_RATIO:g} times the setup's {self._length:g} m: is it another thread?"
        )

    def _go(self, records: Iterator[RecordedMessage]) -> Iterator[Observation]:
        """Give an observation once what belongs to it has come, or cannot be expected any more."""
        waiting: deque[Observation | RecordedMessage] = deque()
        for record in records:
            if record.topic in self._parts:
                self._keep(record)
            elif record.topic in _CHANGING:
                self._follow(record)
                waiting.append(record)
            elif record.topic == CAMERA_INFO.recorded:
                self._take_lens(record)
            else:
                waiting.append(self._pose(record) if self.source == "poses" else self._frame(record))
            while waiting and (len(waiting) > MAX_WAITING_POSES or self._complete(waiting[0])):
                yield from self._next(waiting.popleft())
        while waiting:
            yield from self._next(waiting.popleft())

    def _complete(self, head: Observation | RecordedMessage) -> bool:
        return isinstance(head, RecordedMessage) or all(head.stamp in known for known in self._parts.values())

    def _next(self, head: Observation | RecordedMessage) -> Iterator[Observation]:
        """Keep a change until it is asked for; give an observation with its parts."""
        if isinstance(head, RecordedMessage):
            self._changes.append(head)
            return
        found = {topic: known[head.stamp] for topic, known in self._parts.items() if head.stamp in known}
        truth, pull = found.get(_TRUE, _NOTHING), found.get(_PULL, _NO_FORCE)
        if self.source != "poses":
            yield replace(head, ground_truth=truth, true_pull=pull)
            return
        # As live, the centreline alone tells nothing where observations come.
        observed = found.get(_OBSERVED, ThreadObservation()) if _OBSERVED in self._parts else None
        measured = found.get(_SEEN, _NOTHING)
        yield replace(head, measured=measured, ground_truth=truth, true_pull=pull, observation=observed)

    def _follow(self, record: RecordedMessage) -> None:
        """Look for the needle in a recorded scene from here on, as `vision_tracker` does."""
        if record.topic != SCENE.recorded:
            return
        try:
            scene = parse_scene_message(record.decode())
            if scene.version != self._scene.version and self._tracker is not None:
                self._tracker.set_scene(scene)
        except MagnetosutureError:
            return  # counted and reported where the model takes it
        self._scene = scene

    def _take_lens(self, record: RecordedMessage) -> None:
        """Undo the distortion of a recorded lens from here on, as `vision_tracker` does."""
        assert self._tracker is not None
        try:
            lens = lens_of(record.decode())
        except MagnetosutureError as error:
            self.refused[f"{record.topic}: {error}"] += 1
            lens = None
        self._tracker.set_lens(lens)

    def _keep(self, record: RecordedMessage) -> None:
        """Keep what belongs to a frame; nothing where it isn't valid."""
        stamp, topic, known = stamp_of(record), record.topic, self._parts[record.topic]
        if topic in (_SEEN, _OBSERVED):
            self.on_record(stamp, record)
        read, nothing = _READERS[topic]
        try:
            known[stamp] = part = read(record)
        except InvalidInputError as error:
            self.refused[f"{topic}: {error}"] += 1
            known[stamp] = part = nothing
        for points in [piece.points for piece in part.pieces] if topic == _OBSERVED else [part]:
            if topic in (_SEEN, _OBSERVED) and len(points):
                self._check_place(topic, points)
        if topic == _SEEN and len(part):
            self._count_length(part)
        if len(known) > 2 * MAX_WAITING_POSES:  # of a frame that never came
            del known[next(iter(known))]

    def _count_length(self, points: Points) -> None:
        """Count every eighth measured thread, and those whose length is not of this setup."""
        if self._threads % MEASURED == 0 and np.isfinite(points).all():
            length = float(arc_lengths(points)[-1]) / self._length
            self._odd += not MIN_LENGTH_RATIO <= length <= MAX_LENGTH_RATIO
            self._measured += 1
        self._threads += 1

    def _pose(self, record: RecordedMessage) -> Observation:
        """Return what a recorded pose says."""
        self.count += 1
        stamp = stamp_of(record)
        self.on_record(stamp, record)
        try:
            tail, heading, deviation = read_pose(record)
        except InvalidInputError as error:
            self.refused[NO_POSE] += 1
            return Observation(stamp, reason=str(error))
        self._check_place(record.topic, tail)
        self.found += 1
        return Observation(stamp, tail, heading, _NOTHING, _NOTHING, deviation=deviation)

    def _frame(self, record: RecordedMessage) -> Observation:
        """Return what a camera frame says, as `thread_model` would get it."""
        assert self._tracker is not None
        self.count += 1
        message = record.decode()
        stamp = int(message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec)
        began = time.perf_counter()
        try:
            image = pixels(message, record.type_name)
        except InvalidInputError as error:
            seen, kind = self._tracker.on_broken(error), BROKEN
        else:
            began = time.perf_counter()
            seen, kind = self._tracker.on_image(stamp * 1e-9, image), NOT_FOUND
            if seen.problem is not None:
                kind = NOT_NEWER if seen.problem.field == "image.stamp" else BROKEN
        taken = time.perf_counter() - began
        self.on_frame(stamp, seen)
        if not seen.tracked:
            self.refused[kind] += 1
            return Observation(stamp, reason=seen.track.reason, processing=taken)
        self.found += 1
        heading = round_trip_heading(seen.track.heading, NEEDLE_POSE.name)
        return Observation(
            stamp,
            np.asarray(seen.track.tail),
            heading,
            seen.centreline,
            processing=taken,
            observation=seen.track.observation,
            deviation=pose_deviation(np.diag(seen.track.covariance)),
        )

    def _check_place(self, topic: str, points: Points) -> None:
        """Refuse what is farther away than the dish is wide."""
        width = self._scene.dish.diameter
        far = np.where(np.isfinite(points), np.abs(points), 0.0)  # what is not finite is refused by the model
        if np.maximum.reduce(far, axis=None) > width:
            worst = points.reshape(-1, 2)[far.reshape(-1, 2).max(axis=1).argmax()]
            where = f"a point at ({worst[0]:g}, {worst[1]:g}) m, but the dish is {width:g} m wide"
            raise BagError(self._recording.path, f"{topic} has {where}; are these millimetres, or another setup's?")


def pixels(message: Any, type_name: str) -> Any:
    """Return a decoded message's image; see `decode_image` and `unpack_image`.

    Raises:
        InvalidInputError: it is broken.
    """
    if type_name == COMPRESSED_IMAGE.type_name:
        return decode_image(message.data)
    return np.asarray(unpack_image(message.data, message.height, message.width, message.step, message.encoding))


def _with_progress(
    records: Iterator[RecordedMessage], begin: int, whole: float, progress: Progress
) -> Iterator[RecordedMessage]:
    """Go through records and report progress, a thousand times at the most: showing it takes longer than a step."""
    following, pause = begin, max(round(whole * 1e6), 1)
    for record in records:
        if record.time >= following:
            progress(min(1.0, (record.time - begin) * 1e-9 / max(whole, 1e-9)))
            following = record.time + pause
        yield record
