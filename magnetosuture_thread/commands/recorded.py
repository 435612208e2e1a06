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
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread import ConfigurationError, InvalidInputError, MagnetosutureError, NeedlePose, Scene
from magnetosuture_thread.bags.reader import Bag, RecordedMessage
from magnetosuture_thread.bags.reading import (
    plane_point,
    pose_deviation,
    read_force,
    read_observation,
    read_path,
    read_pose,
    stamp_of,
)
from magnetosuture_thread.bags.recording import Recording
from magnetosuture_thread.bags.scene_message import parse_scene_message
from magnetosuture_thread.bags.storage import SALVAGED_NOTE
from magnetosuture_thread.estimator.settings import ThreadModelSettings, parse_material
from magnetosuture_thread.estimator.thread_session import MAX_WAITING_POSES, PredictionResult, ThreadSession
from magnetosuture_thread.evaluation.frames import FrameResult, Observation
from magnetosuture_thread.evaluation.metrics import RunMetrics
from magnetosuture_thread.geometry.orientation import round_trip_heading
from magnetosuture_thread.geometry.polyline import Points, arc_lengths
from magnetosuture_thread.geometry.thread_observation import ThreadObservation
from magnetosuture_thread.rig.setups import Setup, read_setup
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.configuration import from_mapping, to_mapping
from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.settings.interface import Channel
from magnetosuture_thread.vision.images import image_of
from magnetosuture_thread.vision.lens import lens_of
from magnetosuture_thread.vision.tracker import FrameMeasurement, TrackerSession, warm_up
from magnetosuture_thread.workers import Log, Progress

if TYPE_CHECKING:
    from typing_extensions import Unpack

MAX_LENGTH_RATIO, MIN_LENGTH_RATIO = 3.0, 0.2  # of the setup's thread; a seen one beyond is not of this setup
# Why frames and poses are refused, as it is counted.
NOT_FOUND, NOT_NEWER = "no needle for sure", "a stamp not newer than the last"
CHANGING = (interface.SCENE, interface.MATERIAL)  # channels on which a bag records changes of scene and thread
_NOTHING, _NO_FORCE = np.empty((0, 2)), np.empty(0)
_TRUE, _SEEN = interface.GROUND_TRUTH_THREAD.recorded, interface.MEASURED_THREAD.recorded
_OBSERVED, _PULL = interface.THREAD_OBSERVATION.recorded, interface.GROUND_TRUTH_PULL.recorded
# How a part of an observation is read, and what stands for one that is not valid.
_READERS: dict[str, tuple[Callable[[RecordedMessage], Any], Any]] = {
    _TRUE: (read_path, _NOTHING),
    _SEEN: (read_path, _NOTHING),
    _OBSERVED: (read_observation, ThreadObservation()),
    _PULL: (read_force, _NO_FORCE),
}


def read_image(record: RecordedMessage) -> NDArray[np.uint8]:
    """Return the image of a recorded camera frame, raw or compressed.

    Raises:
        BagError: the message cannot be decoded.
        InvalidInputError: the image is broken.
    """
    return image_of(record.decode())


def chosen_source(recording: Recording, source: str) -> str:
    """Return `camera` or `poses`.

    Args:
        recording: the bag.
        source: `camera`: its frames; `poses`: the needle poses and seen threads that were recorded; `auto`: the camera
            where there are frames.

    Raises:
        BagError: the bag does not hold what was asked for.
    """
    for name, is_there in (
        ("camera", recording.camera is not None),
        ("poses", recording.counts.get(interface.NEEDLE_POSE.recorded)),
    ):
        if is_there and source in ("auto", name):
            return name
    for channel in (*interface.CAMERA.values(), interface.NEEDLE_POSE):
        if channel.recorded in recording.unfit:
            raise BagError(recording.path, recording.unfit[channel.recorded])
    recording.require(interface.NEEDLE_POSE if source == "poses" else interface.COMPRESSED_IMAGE)
    raise BagError(recording.path, "holds camera frames on a topic that is not theirs")  # require says all else


class ObservationReader(Iterator[Observation]):
    """Iterates over the observations of a bag: one for each camera frame, or recorded pose, in order.

    Frames are tracked as `vision_tracker` does. Only a few observations are in memory at a time.

    Args:
        given: the bag, and what of it is read.
        progress: called with the share done, 0 to 1.

    Attributes:
        source: `camera` or `poses`.
        count: camera frames, or poses, so far.
        found: of these with a needle.
        refused: the others, by why.
        on_frame: called with stamp and what was seen in each frame, before its observation is given.
        on_record: called with stamp and each recorded pose and seen thread, before its observation is given; and
            with each scene that is taken.

    Raises:
        BagError: while going through, a length is not in metres.
    """

    def __init__(self, given: BagInput, progress: Progress = lambda share: None) -> None:
        recording, setup = given.recording, given.setup
        self.source = given.source
        self.count = self.found = 0
        self.refused: Counter[str] = Counter()
        self.on_frame: Callable[[int, FrameMeasurement], None] = lambda stamp, seen: None
        self.on_record: Callable[[int, RecordedMessage], None] = lambda stamp, record: None
        self._path, self._scene, self._length = recording.path, setup.scene, setup.model.thread_length
        self._measured = self._odd = 0
        self._tracker: TrackerSession | None = None
        own: tuple[Channel, ...] = (interface.NEEDLE_POSE, interface.MEASURED_THREAD, interface.THREAD_OBSERVATION)
        if recording.camera is not None and self.source == "camera":
            warm_up()
            self._tracker = TrackerSession(setup.vision, setup.scene)
            own = (recording.camera, interface.CAMERA_INFO, interface.NEEDLE_TIP)
        possible = (interface.GROUND_TRUTH_THREAD, interface.GROUND_TRUTH_PULL, *CHANGING, *own)
        channels = [channel for channel in possible if recording.counts.get(channel.recorded)]
        earlier = recording.records(CHANGING, duration=given.start) if given.start > 0.0 else ()
        self._changes = [record for record in earlier if record.time < given.begin]
        for record in self._changes:
            self._follow(record)
        # What belongs to a frame, by topic and stamp.
        self._parts: dict[str, dict[int, Any]] = {c.recorded: {} for c in channels if c.recorded in _READERS}
        self._going = self._go(recording.records(channels, start=given.start, duration=given.duration), given, progress)

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
            if record.topic == interface.SCENE.recorded:
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

    def _go(self, records: Iterator[RecordedMessage], given: BagInput, progress: Progress) -> Iterator[Observation]:
        """Give an observation once what belongs to it has come, or cannot be expected any more."""
        changing = {channel.recorded for channel in CHANGING}
        waiting: deque[Observation | RecordedMessage] = deque()
        span, reported = max(given.duration, 1e-9), given.begin
        for record in records:
            if record.time >= reported:  # a thousand times at the most: showing it takes longer than a step
                progress(min(1.0, (record.time - given.begin) * 1e-9 / span))
                reported = record.time + max(round(span * 1e6), 1)
            if record.topic in self._parts:
                self._keep(record)
            elif record.topic in changing:
                self._follow(record)
                waiting.append(record)
            elif self._tracker is None:
                waiting.append(self._pose(record))
            elif record.topic == interface.CAMERA_INFO.recorded:
                self._take_lens(record, self._tracker)
            elif record.topic == interface.NEEDLE_TIP.recorded:
                self._take_tip(record, self._tracker)
            else:
                waiting.append(self._frame(record, self._tracker))
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
        found = {topic: known.get(head.stamp, _READERS[topic][1]) for topic, known in self._parts.items()}
        head = replace(head, ground_truth=found.get(_TRUE, _NOTHING), true_pull=found.get(_PULL, _NO_FORCE))
        if self.source == "poses":
            # As live, the centreline alone tells nothing where observations come.
            head = replace(head, measured=found.get(_SEEN, _NOTHING), observation=found.get(_OBSERVED))
        yield head

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

    def _take_lens(self, record: RecordedMessage, tracker: TrackerSession) -> None:
        """Undo the distortion of a recorded lens from here on, as `vision_tracker` does."""
        lens = None
        try:
            lens = lens_of(record.decode())
        except MagnetosutureError as error:
            self.refused[f"{record.topic}: {error}"] += 1
        tracker.set_lens(lens)

    def _take_tip(self, record: RecordedMessage, tracker: TrackerSession) -> None:
        """Take which end of the needle is its tip, as `vision_tracker` does."""
        try:
            taken = min(stamp_of(record), record.time) or record.time
            tracker.point_at_tip(plane_point(record.decode(), record.topic), taken * 1e-9)
        except MagnetosutureError as error:
            self.refused[f"{record.topic}: {error}"] += 1

    def _keep(self, record: RecordedMessage) -> None:
        """Keep what belongs to a frame; nothing where it isn't valid."""
        stamp, topic, known = stamp_of(record), record.topic, self._parts[record.topic]
        if topic in (_SEEN, _OBSERVED):
            self.on_record(stamp, record)
        read, part = _READERS[topic]
        try:
            part = read(record)
        except InvalidInputError as error:
            self.refused[f"{topic}: {error}"] += 1
        known[stamp] = part
        if topic == _OBSERVED:
            for piece in part.pieces:
                self._check_place(topic, piece.points)
        if topic == _SEEN:
            self._check_place(topic, part)
            if len(part) and np.isfinite(part).all():
                length = float(arc_lengths(part)[-1]) / self._length
                self._odd += not MIN_LENGTH_RATIO <= length <= MAX_LENGTH_RATIO
                self._measured += 1
        if len(known) > 2 * MAX_WAITING_POSES:  # of a frame that never came
            del known[next(iter(known))]

    def _pose(self, record: RecordedMessage) -> Observation:
        """Return what a recorded pose says."""
        self.count += 1
        stamp = stamp_of(record)
        self.on_record(stamp, record)
        try:
            tail, heading, deviation = read_pose(record)
        except InvalidInputError as error:
            self.refused["a pose that is none"] += 1
            return Observation(stamp, reason=str(error))
        self._check_place(record.topic, tail)
        self.found += 1
        return Observation(stamp, tail, heading, deviation=deviation)

    def _frame(self, record: RecordedMessage, tracker: TrackerSession) -> Observation:
        """Return what a camera frame says, as `thread_model` would get it."""
        self.count += 1
        stamp = stamp_of(record)
        try:
            image = read_image(record)
        except InvalidInputError as error:
            began = time.perf_counter()
            seen = tracker.on_broken(error)
        else:
            began = time.perf_counter()
            seen = tracker.on_image(stamp * 1e-9, image)
        taken = time.perf_counter() - began
        self.on_frame(stamp, seen)
        if not seen.tracked:
            kind = NOT_FOUND if seen.problem is None else str(seen.problem)
            self.refused[NOT_NEWER if kind.startswith("image.stamp") else kind] += 1
            return Observation(stamp, reason=seen.track.reason, processing=taken)
        self.found += 1
        return Observation(
            stamp,
            np.asarray(seen.track.tail),
            round_trip_heading(seen.track.heading, interface.NEEDLE_POSE.name),
            seen.centreline,
            processing=taken,
            observation=seen.track.observation,
            deviation=pose_deviation(np.diag(seen.track.covariance)),
        )

    def _check_place(self, topic: str, points: Points) -> None:
        """Refuse what is farther away than the dish is wide."""
        width = self._scene.dish.diameter
        far = np.where(np.isfinite(points), np.abs(points), 0.0)  # what is not finite is refused by the model
        if far.max(initial=0.0) > width:
            worst = points.reshape(-1, 2)[far.reshape(-1, 2).max(axis=1).argmax()]
            where = f"a point at ({worst[0]:g}, {worst[1]:g}) m, but the dish is {width:g} m wide"
            raise BagError(self._path, f"{topic} has {where}; are these millimetres, or another setup's?")


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


def predictions(
    given: ObservationReader,
    settings: ThreadModelSettings,
    scene: Scene | None,
    observe: Callable[[Observation], None] = lambda observation: None,
) -> Iterator[Step]:
    """Predict and estimate the thread over one run, as `thread_model` does.

    Changes of scene and thread that the bag records apply as they come. A pose before the thread is first measured
    gives a step that waits, as live, and is not predicted later unless its own thread is measured; observations
    without a needle give none.

    Args:
        given: by time.
        settings: of thread and liquid.
        scene: until the bag says another.
        observe: called with each observation, also of those without a needle.

    Raises:
        ConfigurationError: a shape of the scene cannot be used.
    """
    session = ThreadSession(settings, scene)
    waiting: dict[int, Observation] = {}

    def step(observation: Observation, result: PredictionResult, taken: float) -> Step:
        if result.waiting:
            waiting[result.stamp] = observation
        else:
            waiting.pop(result.stamp, None)
        return Step(observation, result, taken, session.settings, session.scene)

    for observation in given:
        observe(observation)
        _take_changes(session, given)
        if not observation.found:
            continue
        results: Iterator[PredictionResult] = iter(())
        if observation.observation is not None:
            results = session.on_observation(observation.stamp, observation.observation)
        elif len(observation.measured):
            results = session.on_measured_thread(observation.stamp, observation.measured)
        began = time.perf_counter()
        for result in results:
            yield step(waiting.get(result.stamp, observation), result, time.perf_counter() - began)
            began = time.perf_counter()
        began = time.perf_counter()
        pose = NeedlePose(observation.stamp * 1e-9, observation.tail, observation.heading, observation.deviation)
        predicted = session.predict(observation.stamp, pose)
        taken = time.perf_counter() - began
        yield step(observation, session.estimate(predicted), taken)
        for late in session.late_estimates():  # of observations that are refused: all others come with their poses
            yield step(observation, late, 0.0)
        while len(waiting) > 2 * MAX_WAITING_POSES:
            del waiting[next(iter(waiting))]


def _take_changes(session: ThreadSession, given: ObservationReader) -> None:
    """Take what the bag says of scene and thread; what cannot be used is counted, as live."""
    for record in given.changes():
        try:
            settings, scene = session.settings, session.scene
            if record.topic == interface.SCENE.recorded:
                scene = parse_scene_message(record.decode())
            else:
                values = {**to_mapping(settings), **parse_material(record.decode())}
                settings = from_mapping(ThreadModelSettings, values)
            session.change(settings, scene)
        except MagnetosutureError as error:
            given.refused[f"{record.topic}: {error}"] += 1


def measure_step(step: Step, metrics: RunMetrics, refused: Counter[str], recorded: Points | None = None) -> None:
    """Add a step to the figures of a run, or why there is no prediction to what is refused.

    Args:
        step: of the run.
        metrics: that get its prediction.
        refused: counts by reason, without the numbers of each case.
        recorded: the prediction of the same frame that the bag holds.
    """
    result = step.result
    if result.prediction is not None:
        frame = FrameResult.of(
            step.observation,
            result.prediction,
            result.margins,
            step.step_time,
            estimate=result.estimate,
            estimated=step.settings.is_estimated,
            recorded=recorded,
            obstacles=step.scene.obstacles if step.scene is not None else (),
        )
        metrics.add(frame)
    problem = result.problem or result.estimate_problem
    if isinstance(problem, InvalidInputError):
        is_late = problem.field == "needle pose stamp"
        refused[NOT_NEWER if is_late else f"a {problem.field} that cannot be used"] += 1
    elif problem is not None:
        refused["a program that was not solved"] += 1


DEFAULT_SETUP = "petri_35mm_polyamide"
SETUP_NOTE = "scenario"  # of a bag, which holds the setup's text


class BagSelection(TypedDict, total=False):
    """What of a bag is read, and with which setup.

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
        own = (
            {SALVAGED_NOTE: self.recording.salvaged_without_checksum}
            if self.recording.salvaged_without_checksum
            else {}
        )
        return {**self.recording.notes, **own, "setup": self.setup.name, "replayed": str(self.recording.path)}

    def observations(self, progress: Progress = lambda share: None) -> ObservationReader:
        """Return the observations; `progress` is called with the share done, 0 to 1."""
        return ObservationReader(self, progress)

    def check_loop(self) -> None:
        """Raise `BagError` if the bag is too short to be played in a loop."""
        if self.duration < 1.5:  # s; nodes take a jump back of a second and less for messages that come late
            problem = f"gives {self.duration:.2f} s to play over and over; expected 1.5 s or more"
            raise BagError(self.recording.path, problem)


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
    recording = Recording(
        Bag(path, remap=selection.get("remap")), dish_frame=selection.get("frame", interface.DISH_FRAME)
    )
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
    for channel in (
        interface.MEASURED_THREAD,
        interface.NEEDLE_COMMAND,
        interface.GROUND_TRUTH_THREAD,
        interface.GROUND_TRUTH_PULL,
    ):
        if channel.recorded in recording.unfit:
            raise BagError(path, recording.unfit[channel.recorded])
    left = recording.duration - start
    with TemporaryDirectory() as spare:
        setup = _setup_of(recording, selection.get("setup_name", ""), Path(spare), _scene_at(recording, start), log)
        yield BagInput(recording, setup, source, start, left if duration is None else min(duration, left))


def _scene_at(recording: Recording, start: float) -> Scene | None:
    """Return the scene in force at a time into a bag [s], else the first one; None if the bag has none.

    Raises:
        BagError: what it tells is no scene.
    """
    found: Scene | None = None
    for record in recording.records([interface.SCENE]) if recording.counts.get(interface.SCENE.recorded) else ():
        if found is not None and record.time > recording.start + round(start * 1e9):
            break
        try:
            found = parse_scene_message(record.decode())
        except InvalidInputError as error:
            raise BagError(recording.path, str(error)) from None
    return found


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
    named = notes.get("setup", "")
    if not (text := notes.get(SETUP_NOTE, "")):
        return read_setup(named, scene)
    path = folder / f"{named or 'scenario'}.yaml"
    path.write_text(text, encoding="utf-8")
    return read_setup(str(path), scene)
