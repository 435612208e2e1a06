"""Recorded experiments: a bag with its setup, what was observed in it, and what the model predicts of that.

The same core as in the nodes, fed by the same numbers, so that the predictions are those of the graph to the
last bit; but as fast as the machine can, and with nothing that depends on time.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, TypedDict

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.bags import reading
from magnetosuture_thread.bags.reader import Bag, RecordedMessage
from magnetosuture_thread.bags.reading import parse_scene_message, plane_force, stamp_of, thread_observation
from magnetosuture_thread.bags.recording import Recording
from magnetosuture_thread.estimator.settings import ThreadModelSettings, parse_material
from magnetosuture_thread.estimator.thread_session import MAX_WAITING_POSES, PredictionResult, ThreadSession
from magnetosuture_thread.evaluation.frames import Observation
from magnetosuture_thread.evaluation.workers import Log, Progress
from magnetosuture_thread.geometry.needle_arc import round_trip_heading
from magnetosuture_thread.geometry.polyline import Points, arc_lengths
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.geometry.thread_observation import ThreadObservation
from magnetosuture_thread.rig.setups import Setup, read_setup
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.configuration import from_mapping, to_mapping
from magnetosuture_thread.settings.errors import BagError, ConfigurationError, InvalidInputError, MagnetosutureError
from magnetosuture_thread.thread.prediction import NeedlePose
from magnetosuture_thread.vision.images import image_of
from magnetosuture_thread.vision.lens import lens_of
from magnetosuture_thread.vision.tracker import FrameMeasurement, TrackerSession, warm_up

if TYPE_CHECKING:
    from typing_extensions import Unpack

NOT_FOUND, NOT_NEWER = "no needle for sure", "a stamp not newer than the last"  # why frames and poses are refused
DEFAULT_SETUP = "petri_35mm_polyamide"
SETUP_NOTE = "scenario"  # of a bag, which holds the setup's text
CHANGING = (interface.SCENE, interface.MATERIAL)  # channels on which a bag records changes of scene and thread


def read_image(record: RecordedMessage) -> NDArray[np.uint8]:
    """Return the image of a recorded camera frame, raw or compressed.

    Raises:
        BagError: the message cannot be decoded.
        InvalidInputError: the image is broken.
    """
    return image_of(record.decode())


def _read_prediction(record: RecordedMessage) -> Points:
    """Return a recorded prediction, shape (n + 1, 2) [m]; shape (0, 2) where it cannot be used."""
    try:
        vertices = reading.plane_points(record.decode().positions)
    except BagError:
        vertices = np.empty((0, 2))
    return vertices if len(vertices) > 1 and np.isfinite(vertices).all() else np.empty((0, 2))


def _decoded(read: Callable[[Any, str], Any]) -> Callable[[RecordedMessage], Any]:
    """Return how a recorded message is read by what reads a message."""
    return lambda record: read(record.decode(), record.topic)


# Part of an observation that each topic gives, how it is read, and what stands for one that is not valid.
_PARTS: dict[str, tuple[str, Callable[[RecordedMessage], Any], Any]] = {
    interface.GROUND_TRUTH_THREAD.recorded: ("ground_truth", reading.read_path, np.empty((0, 2))),
    interface.MEASURED_THREAD.recorded: ("measured", reading.read_path, np.empty((0, 2))),
    interface.THREAD_OBSERVATION.recorded: ("observation", _decoded(thread_observation), ThreadObservation()),
    interface.GROUND_TRUTH_PULL.recorded: ("true_pull", _decoded(plane_force), np.empty(0)),
    interface.PREDICTED_THREAD.recorded: ("recorded", _read_prediction, np.empty((0, 2))),
}


class TrackedFrame(NamedTuple):
    """A camera frame that was tracked.

    Attributes:
        stamp: of the frame [ns].
        measurement: of needle and thread.
    """

    stamp: int
    measurement: FrameMeasurement


@dataclass(frozen=True)
class Step:
    """Prediction and estimate for one observation with a needle.

    Attributes:
        observation: the observation.
        result: prediction and estimate, or why there is none. A `late` one says why an observation was refused.
        step_time: wall-clock time that the prediction took [s].
        settings: in force.
        scene: in force.
    """

    observation: Observation
    result: PredictionResult
    step_time: float
    settings: ThreadModelSettings
    scene: Scene | None


Event: TypeAlias = "Observation | TrackedFrame | RecordedMessage | Step"


class ObservationReader:
    """The observations of a bag, to iterate over once: one for each camera frame, or recorded pose, in order.

    Frames are tracked as `vision_tracker` does. Only a few observations are in memory at a time.

    Args:
        bag: the bag, and what of it is read.
        progress: called with the share done, 0 to 1.

    Attributes:
        refused: frames, poses and others that cannot be used, by why.

    Raises:
        BagError: while iterating, a length is not in metres, or the bag is damaged.
    """

    def __init__(self, bag: BagInput, progress: Progress = lambda share: None) -> None:
        self.refused: Counter[str] = Counter()
        self._bag, self._progress = bag, progress
        self._scene, self._length = bag.setup.scene, bag.setup.model.thread_length
        self._measured = self._odd = 0
        self._tracker: TrackerSession | None = None
        channels = [interface.GROUND_TRUTH_THREAD, interface.GROUND_TRUTH_PULL, interface.PREDICTED_THREAD, *CHANGING]
        if bag.recording.camera is not None and bag.source == "camera":
            warm_up()
            self._tracker = TrackerSession(bag.setup.vision, bag.setup.scene)
            channels += bag.recording.camera, interface.CAMERA_INFO, interface.NEEDLE_TIP
        else:
            channels += interface.NEEDLE_POSE, interface.MEASURED_THREAD, interface.THREAD_OBSERVATION
        self._channels = [channel for channel in channels if bag.recording.counts.get(channel.recorded)]
        # What belongs to a frame, by topic and stamp.
        self._parts: dict[str, dict[int, Any]] = {c.recorded: {} for c in self._channels if c.recorded in _PARTS}

    def __iter__(self) -> Iterator[Observation]:
        """Yield the observations."""
        return (event for event in self.events() if isinstance(event, Observation))

    @contextmanager
    def counting(self, topic: str) -> Iterator[None]:
        """Count a message that cannot be used as refused, as live, and go on."""
        try:
            yield
        except MagnetosutureError as error:
            self.refused[f"{topic}: {error}"] += 1

    def thread_problem(self) -> str:
        """Return a text if most of the measured threads are not of this setup; else empty."""
        if 2 * self._odd <= self._measured:
            return ""
        return (
            f"{self._odd} of {self._measured} measured threads are longer than 3 times or "
            f"shorter than 0.2 times the setup's {self._length:g} m: is it another thread?"
        )

    def events(self) -> Iterator[Observation | TrackedFrame | RecordedMessage]:
        """Yield the observations, and what is recorded or tracked, as it comes.

        Tracked frames, recorded poses and measured threads come before their observations; a recorded change of scene
        or thread comes before the first observation that it is in force for.
        """
        recording, start, duration = self._bag.recording, self._bag.start, max(self._bag.duration, 1e-9)
        begin = reported = self._bag.begin
        for record in recording.records(CHANGING, duration=start) if start > 0.0 else ():
            if record.time < begin:
                self._follow(record)
                yield record
        waiting: deque[Observation | RecordedMessage] = deque()
        for record in recording.records(self._channels, start=start, duration=self._bag.duration):
            if record.time >= reported:  # a thousand times at the most: showing it takes longer than a step
                self._progress(min(1.0, (record.time - begin) * 1e-9 / duration))
                reported = record.time + max(round(duration * 1e6), 1)
            topic = record.topic
            if topic in self._parts:
                self._keep(record)
                if topic in (interface.MEASURED_THREAD.recorded, interface.THREAD_OBSERVATION.recorded):
                    yield record
            elif topic in (channel.recorded for channel in CHANGING):
                self._follow(record)
                waiting.append(record)
            elif self._tracker is None:
                yield record
                waiting.append(self._pose(record))
            elif topic == interface.CAMERA_INFO.recorded:
                lens = None
                with self.counting(topic):
                    lens = lens_of(record.decode())
                self._tracker.set_lens(lens)
            elif topic == interface.NEEDLE_TIP.recorded:
                with self.counting(topic):
                    stamp = min(stamp_of(record), record.time) or record.time
                    self._tracker.point_at_tip(reading.plane_point(record.decode(), topic), stamp * 1e-9)
            else:
                frame, observation = self._track(record, self._tracker)
                yield frame
                waiting.append(observation)
            while waiting and (len(waiting) > MAX_WAITING_POSES or self._is_complete(waiting[0])):
                yield self._with_parts(waiting.popleft())
        while waiting:
            yield self._with_parts(waiting.popleft())

    def _is_complete(self, head: Observation | RecordedMessage) -> bool:
        """Return whether all that belongs to an observation has come."""
        return isinstance(head, RecordedMessage) or all(head.stamp in known for known in self._parts.values())

    def _with_parts(self, head: Observation | RecordedMessage) -> Observation | RecordedMessage:
        """Return an observation with what belongs to it and has come; a recorded change as it is."""
        if isinstance(head, RecordedMessage):
            return head
        parts = {_PARTS[topic][0]: known.get(head.stamp, _PARTS[topic][2]) for topic, known in self._parts.items()}
        return replace(head, **parts)

    def _follow(self, record: RecordedMessage) -> None:
        """Look for the needle in a recorded scene from here on, as `vision_tracker` does."""
        if record.topic != interface.SCENE.recorded:
            return
        try:
            scene = parse_scene_message(record.decode())
            if scene.version != self._scene.version and self._tracker is not None:
                self._tracker.set_scene(scene)
        except MagnetosutureError:
            return  # counted and reported where the model takes it
        self._scene = scene

    def _keep(self, record: RecordedMessage) -> None:
        """Keep what belongs to a frame; nothing where it is not valid."""
        topic, known = record.topic, self._parts[record.topic]
        name, read, part = _PARTS[topic]
        try:
            part = read(record)
        except InvalidInputError as error:
            self.refused[f"{topic}: {error}"] += 1
        known[stamp_of(record)] = part
        if name in ("observation", "measured"):
            for points in [part] if name == "measured" else [piece.points for piece in part.pieces]:
                self._check_place(topic, points)
        if name == "measured" and len(part) and np.isfinite(part).all():
            self._odd += not 0.2 <= float(arc_lengths(part)[-1]) / self._length <= 3.0  # then it is not of this setup
            self._measured += 1
        if len(known) > 2 * MAX_WAITING_POSES:  # of a frame that never came
            del known[next(iter(known))]

    def _pose(self, record: RecordedMessage) -> Observation:
        """Return what a recorded pose says."""
        stamp = stamp_of(record)
        try:
            tail, heading, deviation = reading.read_pose(record)
        except InvalidInputError as error:
            self.refused["a pose that is not valid"] += 1
            return Observation(stamp, reason=str(error))
        self._check_place(record.topic, tail)
        return Observation(stamp, tail, heading, deviation=deviation)

    def _track(self, record: RecordedMessage, tracker: TrackerSession) -> tuple[TrackedFrame, Observation]:
        """Track a camera frame; return what is measured, and the observation as `thread_model` would get it."""
        stamp, began = stamp_of(record), time.perf_counter()
        try:
            image = read_image(record)
        except InvalidInputError as error:
            measurement = tracker.on_broken(error)
        else:
            began = time.perf_counter()
            measurement = tracker.on_image(stamp * 1e-9, image)
        seconds, track = time.perf_counter() - began, measurement.track
        frame = TrackedFrame(stamp, measurement)
        if not measurement.tracked:
            reason = NOT_FOUND if measurement.problem is None else str(measurement.problem)
            self.refused[NOT_NEWER if reason.startswith("image.stamp") else reason] += 1
            return frame, Observation(stamp, reason=track.reason, processing=seconds)
        return frame, Observation(
            stamp,
            np.asarray(track.tail),
            round_trip_heading(track.heading, interface.NEEDLE_POSE.name),
            measurement.centreline,
            processing=seconds,
            observation=track.observation,
            deviation=reading.pose_deviation(np.diag(track.covariance)),
        )

    def _check_place(self, topic: str, points: Points) -> None:
        """Refuse what is farther away than the dish is wide."""
        width = self._scene.dish.diameter
        far = np.where(np.isfinite(points), np.abs(points), 0.0)  # what is not finite is refused by the model
        if far.max(initial=0.0) > width:
            worst = points.reshape(-1, 2)[far.reshape(-1, 2).max(axis=1).argmax()]
            where = f"a point at ({worst[0]:g}, {worst[1]:g}) m, but the dish is {width:g} m wide"
            raise BagError(self._bag.recording.path, f"{topic} has {where}; are these millimetres, or another setup's?")


def predictions(reader: ObservationReader, settings: ThreadModelSettings, scene: Scene | None) -> Iterator[Event]:
    """Predict and estimate the thread over one run, as `thread_model` does; yield a `Step` for each prediction.

    Changes of scene and thread that the bag records apply as they come. A pose before the thread is first measured
    gives a step that waits, as live, and is not predicted later unless its own thread is measured; observations
    without a needle give none. The events of the reader are passed on, each observation before its steps.

    Args:
        reader: of the bag; what cannot be used of its changes is counted in its `refused`, as live.
        settings: of thread and liquid.
        scene: until the bag says another.

    Raises:
        ConfigurationError: a shape of the scene cannot be used.
    """
    session = ThreadSession(settings, scene)
    waiting: dict[int, Observation] = {}

    def step(observation: Observation, result: PredictionResult, seconds: float) -> Step:
        if result.waiting:
            waiting[result.stamp] = observation
        else:
            waiting.pop(result.stamp, None)
        return Step(observation, result, seconds, session.settings, session.scene)

    for event in reader.events():
        yield event
        if isinstance(event, RecordedMessage) and event.topic in (channel.recorded for channel in CHANGING):
            with reader.counting(event.topic):
                message = event.decode()
                if event.topic == interface.SCENE.recorded:
                    session.change(session.settings, parse_scene_message(message))
                else:
                    mapping = {**to_mapping(session.settings), **parse_material(message)}
                    session.change(from_mapping(ThreadModelSettings, mapping), session.scene)
        if not isinstance(event, Observation) or not event.found:
            continue
        results: Iterator[PredictionResult] = iter(())
        if event.observation is not None:
            results = session.on_observation(event.stamp, event.observation)
        elif len(event.measured):
            results = session.on_measured_thread(event.stamp, event.measured)
        began = time.perf_counter()
        for result in results:
            yield step(waiting.get(result.stamp, event), result, time.perf_counter() - began)
            began = time.perf_counter()
        began, pose = time.perf_counter(), NeedlePose(event.stamp * 1e-9, event.tail, event.heading, event.deviation)
        predicted = session.predict(event.stamp, pose)
        seconds = time.perf_counter() - began
        yield step(event, session.estimate(predicted), seconds)
        for late in session.late_estimates():  # of observations that are refused: all others come with their poses
            yield step(event, late, 0.0)
        while len(waiting) > 2 * MAX_WAITING_POSES:
            del waiting[next(iter(waiting))]


class BagSelection(TypedDict, total=False):
    """Part of a bag that is read, and the setup.

    Attributes:
        setup_name: name or path of the setup; the one that the bag names if empty.
        source: `camera`, `poses`, or `auto`: the camera where there are frames.
        start: seconds into the bag to begin at.
        duration: [s]; to the bag's end if None.
        remap: other names for topics of the bag, by the old one.
        frame: the bag's name of the dish frame.
    """

    setup_name: str
    source: str
    start: float
    duration: float | None
    remap: Mapping[str, str]
    frame: str


@dataclass(frozen=True)
class BagInput:
    """A bag to replay, with its setup.

    Attributes:
        recording: the bag.
        setup: with which.
        source: `camera` or `poses`.
        start: seconds into the bag to begin at.
        duration: of what is replayed [s].
    """

    recording: Recording
    setup: Setup
    source: str
    start: float
    duration: float

    @property
    def begin(self) -> int:
        """Return the bag's time to begin at [ns]."""
        return self.recording.start + round(self.start * 1e9)

    @property
    def notes(self) -> dict[str, str]:
        """Return the notes of a bag made from this one."""
        return {**self.recording.notes, "setup": self.setup.name, "replayed": str(self.recording.path)}

    def check_loop(self) -> None:
        """Raise `BagError` if the bag is too short to be played in a loop."""
        if self.duration < 1.5:  # s; nodes take a jump back of a second and less for messages that come late
            problem = f"gives {self.duration:.2f} s to play over and over; expected 1.5 s or more"
            raise BagError(self.recording.path, problem)


def chosen_source(recording: Recording, source: str) -> str:
    """Return `camera` or `poses`.

    Args:
        recording: the bag.
        source: `camera`: its frames; `poses`: the needle poses and seen threads that were recorded; `auto`: the camera
            where there are frames.

    Raises:
        BagError: the bag does not hold what was asked for.
    """
    if recording.camera is not None and source != "poses":
        return "camera"
    if source == "camera" or not recording.counts.get(interface.NEEDLE_POSE.recorded):
        recording.refuse_unfit(*interface.CAMERA.values(), interface.NEEDLE_POSE)
        recording.require(interface.NEEDLE_POSE if source == "poses" else interface.COMPRESSED_IMAGE)
    return "poses"


@contextmanager
def open_bag(path: Path, log: Log, **selection: Unpack[BagSelection]) -> Iterator[BagInput]:
    """Open a bag to replay, and log what is unusual about it.

    Args:
        path: of the bag.
        log: called with a line for a person.
        selection: what of the bag is read; see `BagSelection`.

    Raises:
        BagError: the bag cannot be used, or has no such time.
        ConfigurationError: the setup cannot be used.
    """
    log(f"checking {path}")
    start, duration = selection.get("start", 0.0), selection.get("duration")
    bag = Bag(path, remap=selection.get("remap"))
    recording = Recording(bag, dish_frame=selection.get("frame", interface.DISH_FRAME))
    if recording.damage is not None:
        log(f"the bag is damaged, what is intact is played: {recording.damage}")
    if recording.salvaged_without_checksum:
        log(f"unverified: {recording.salvaged_without_checksum}")
    elif recording.has_no_checksum and recording.damage is None:
        log(recording.has_no_checksum)
    for remark in recording.remarks:
        log(remark)
    if not 0.0 <= start <= recording.duration:
        raise BagError(path, f"is {recording.duration:.3f} s long; asked to start at {start:g} s")
    source = chosen_source(recording, selection.get("source", "auto"))
    recording.refuse_unfit(interface.MEASURED_THREAD, interface.NEEDLE_COMMAND)
    recording.refuse_unfit(interface.GROUND_TRUTH_THREAD, interface.GROUND_TRUTH_PULL)
    left = recording.duration - start
    with TemporaryDirectory() as spare:
        setup = _setup_of(recording, selection.get("setup_name", ""), Path(spare), _scene_at(recording, start), log)
        yield BagInput(recording, setup, source, start, left if duration is None else min(duration, left))


def _scene_at(recording: Recording, start: float) -> Scene | None:
    """Return the scene in force at a time into a bag [s], else the first one; None if the bag has none.

    Raises:
        BagError: a message is not a valid scene.
    """
    scene: Scene | None = None
    for record in recording.records([interface.SCENE]) if recording.counts.get(interface.SCENE.recorded) else ():
        if scene is not None and record.time > recording.start + round(start * 1e9):
            break
        try:
            scene = parse_scene_message(record.decode())
        except InvalidInputError as error:
            raise BagError(recording.path, str(error)) from None
    return scene


def _setup_of(recording: Recording, name: str, folder: Path, scene: Scene | None, log: Log) -> Setup:
    """Return the setup to replay a bag with: the named one, or the bag's own, or the default.

    Raises:
        ConfigurationError: it cannot be used; of the bag's own, the message says to name another.
    """
    named, text = recording.notes.get("setup", ""), recording.notes.get(SETUP_NOTE, "")
    if name:
        if named and name != named:
            log(f"the bag names the setup {named}; taking {name}")
        return read_setup(name, scene)
    if text or named:
        try:
            return setup_of_notes(recording.notes, folder, scene)
        except ConfigurationError as error:
            if not text:
                raise
            # Its lines may be of another version of this package, which had dish and obstacles in every section.
            expected = "what this version knows; name a setup by --setup"
            raise ConfigurationError("the bag's own setup", error.name, expected) from None
    lost = ", or has lost its name" if recording.damage is not None else ""
    log(f"the bag names no setup{lost}; taking {DEFAULT_SETUP}, which may not be its own: --setup names another")
    return read_setup(DEFAULT_SETUP, scene)


def setup_of_notes(notes: Mapping[str, str], folder: Path, scene: Scene | None = None) -> Setup:
    """Return the setup that a bag was recorded with.

    Its text counts more than its name: the file may have changed, or be on another machine.

    Args:
        notes: of the bag, with one of the two.
        folder: that gets the text as a file, which the setup names.
        scene: in place of the setup's.

    Raises:
        ConfigurationError: it cannot be used.
    """
    name, text = notes.get("setup", ""), notes.get(SETUP_NOTE, "")
    if not text:
        return read_setup(name, scene)
    path = folder / f"{name or 'scenario'}.yaml"
    path.write_text(text, encoding="utf-8")
    return read_setup(str(path), scene)
