"""Recorded experiments without a graph: what the needle did, and what the model predicts of it.

The same core as in the nodes, fed by the same numbers, so that the predictions are those of the graph to the
last bit; but as fast as the machine can, and with nothing that depends on time.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from magnetosuture_thread.bags.reader import RecordedMessage
from magnetosuture_thread.bags.recording import Recording
from magnetosuture_thread.configuration import from_mapping, to_mapping
from magnetosuture_thread.errors import BagError, MagnetosutureError
from magnetosuture_thread.evaluation.frames import Observation
from magnetosuture_thread.interface import CAMERA, COMPRESSED_IMAGE, NEEDLE_POSE, SCENE
from magnetosuture_thread.messages.scene import parse_scene_message
from magnetosuture_thread.offline.observations import ObservationReader, Progress
from magnetosuture_thread.scene import Scene
from magnetosuture_thread.setups import Setup
from magnetosuture_thread.thread.margins import Margins
from magnetosuture_thread.thread.prediction import NeedlePose
from magnetosuture_thread.thread_model.session import MAX_WAITING_POSES, PredictionResult, ThreadSession
from magnetosuture_thread.thread_model.settings import ThreadModelSettings, parse_material

SOURCES = ("auto", "camera", "poses")


def read_observations(
    recording: Recording,
    setup: Setup,
    *,
    source: str = "auto",
    start: float = 0.0,
    duration: float | None = None,
    progress: Progress = lambda share: None,
) -> ObservationReader:
    """Return the observations of a bag: one for each camera frame, or recorded pose, in order.

    Args:
        recording: the bag.
        setup: what to look for, and how large the dish is.
        source: `camera`: the frames, tracked as `vision_tracker` does; `poses`: the needle poses and seen threads
            that were recorded; `auto`: the camera where there are frames.
        start: seconds into the bag to begin at.
        duration: [s]; to the bag's end if None.
        progress: called with the share done, 0 to 1.

    Raises:
        BagError: the bag does not hold the source; or while going through, a length is not in metres.
    """
    return ObservationReader(recording, setup, chosen_source(recording, source), start, duration, progress)


def chosen_source(recording: Recording, source: str) -> str:
    """Return `camera` or `poses`.

    Raises:
        BagError: the bag does not hold what was asked for.
    """
    has_frames = recording.camera is not None and bool(recording.counts.get(recording.camera.recorded))
    has_poses = bool(recording.counts.get(NEEDLE_POSE.recorded))
    if source == "auto" and (has_frames or has_poses):
        return "camera" if has_frames else "poses"
    if (source == "camera" and has_frames) or (source == "poses" and has_poses):
        return source
    for channel in (*CAMERA.values(), NEEDLE_POSE):
        if channel.recorded in recording.unfit:
            raise BagError(recording.path, recording.unfit[channel.recorded])
    recording.require(NEEDLE_POSE if source == "poses" else COMPRESSED_IMAGE)
    raise BagError(recording.path, "holds camera frames on a topic that is not theirs")  # require says all else


@dataclass(frozen=True)
class Step:
    """Prediction and estimate for one observation with a needle.

    Attributes:
        observation: the observation.
        result: prediction and estimate, or why there is none. A `late` one says why an observation was refused.
        margins: of the estimate, else of the prediction; None where there is none, or where it did not converge, so
            that they prove nothing.
        step_time: wall-clock time that the prediction took [s].
        settings: in force.
        scene: in force.
    """

    observation: Observation
    result: PredictionResult
    margins: Margins | None
    step_time: float
    settings: ThreadModelSettings
    scene: Scene | None


def predictions(given: Iterable[Observation], settings: ThreadModelSettings, scene: Scene | None) -> Iterator[Step]:
    """Predict and estimate the thread over one run, as `thread_model` does.

    Changes of scene and thread that the bag records apply as they come. A pose before the thread is first measured
    gives a step that waits, as live, and is not predicted later unless its own thread is measured; observations
    without a needle give none.

    Args:
        given: by time.
        settings: of thread and liquid.
        scene: until the bag says another.

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
        return Step(observation, result, result.margins, taken, session.settings, session.scene)

    for observation in given:
        if isinstance(given, ObservationReader):
            _change(session, given)
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


def changed(
    settings: ThreadModelSettings, scene: Scene | None, record: RecordedMessage
) -> tuple[ThreadModelSettings, Scene | None]:
    """Return settings and scene after a recorded message on one of these channels.

    Raises:
        BagError: it cannot be decoded.
        ConfigurationError: it cannot be used.
        InvalidInputError: it is of another frame, or damaged.
    """
    if record.topic == SCENE.recorded:
        return settings, parse_scene_message(record.decode())
    values = parse_material(record.decode())
    return from_mapping(ThreadModelSettings, {**to_mapping(settings), **values}), scene


def _change(session: ThreadSession, given: ObservationReader) -> None:
    """Take what the bag says of scene and thread; what cannot be used is counted, as live."""
    for record in given.changes():
        try:
            session.change(*changed(session.settings, session.scene, record))
        except MagnetosutureError as error:
            given.refused[f"{record.topic}: {error}"] += 1
