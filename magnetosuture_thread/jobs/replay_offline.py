"""The job `magnetosuture replay --offline`: a recorded bag through the same core, without a graph."""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from magnetosuture_thread import InvalidInputError
from magnetosuture_thread.bags.reader import RecordedMessage
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.evaluation.frames import FrameResult
from magnetosuture_thread.evaluation.graph_outputs import ReplaySummary
from magnetosuture_thread.evaluation.metrics import RunMetrics
from magnetosuture_thread.interface import (
    ESTIMATED_THREAD,
    MARGINS,
    MEASURED_THREAD,
    NEEDLE_POSE,
    PREDICTED_THREAD,
    SCENE,
    THREAD_OBSERVATION,
    TRACKER_STATE,
)
from magnetosuture_thread.jobs.output import whole_folder
from magnetosuture_thread.jobs.replay_inputs import (
    BagInput,
    BagSelection,
    Log,
    Progress,
    open_bag,
    replay_summary,
    write_results,
)
from magnetosuture_thread.messages.outputs import (
    Outputs,
    estimate_outputs,
    pose_outputs,
    prediction_outputs,
    thread_outputs,
)
from magnetosuture_thread.messages.packing import packed_tracker_state
from magnetosuture_thread.messages.scene import packed_scene
from magnetosuture_thread.offline.observations import NOT_NEWER, ObservationReader
from magnetosuture_thread.offline.predictions import Step, predictions, read_observations
from magnetosuture_thread.thread_model.session import WAITING
from magnetosuture_thread.vision.tracker import FrameMeasurement

if TYPE_CHECKING:
    from typing_extensions import Unpack


def replay_offline(
    bag_path: Path,
    output: Path,
    *,
    log: Log = lambda text: None,
    progress: Progress = lambda share: None,
    **selection: Unpack[BagSelection],
) -> ReplaySummary:
    """Put a bag through tracker and model without a graph, and evaluate the predictions.

    `output` is made at the end, whole or not at all: `bag/`, `summary.json` and `summary.png`. The bag holds pose,
    what is seen of the thread, prediction, estimate and margins, each logged at its own stamp, with the numbers of
    the live graph. Two runs write it alike to the last bit: times that steps took are in the summary alone. The coil
    bridge has no part in it: what it does depends on real time.

    Args:
        bag_path: a bag.
        output: folder to make.
        log: called with a line for a person at each stage.
        progress: called with the share done, 0 to 1.
        selection: what of the bag is replayed.

    Raises:
        BagError: the bag cannot be used, nothing in it was predicted, or the output exists or cannot be written.
        ConfigurationError: the setup cannot be used.
    """
    with open_bag(bag_path, log, **selection) as given, whole_folder(output) as folder:
        what = "camera frames" if given.source == "camera" else "recorded poses"
        log(f"predicting by the {what} of {given.duration:.1f} s")
        seen = read_observations(
            given.recording,
            given.setup,
            source=given.source,
            start=given.start,
            duration=given.duration,
            progress=progress,
        )
        metrics = RunMetrics(given.setup.model.thread_length, given.recording.start)
        refused = Counter[str]()
        with BagWriter(folder / "bag", given.notes) as bag:
            made = _Output(bag, seen, given)
            steps = predictions(seen, given.setup.model, given.setup.scene)
            began = time.perf_counter()  # kernels are loaded
            for step in steps:
                made.write(step)
                if step.result.prediction is not None:
                    predicted, estimate = step.result.prediction, step.result.estimate
                    frame = FrameResult.of(
                        step.observation,
                        predicted,
                        step.margins,
                        step.step_time,
                        estimate=estimate,
                        estimated=step.settings.is_estimated,
                    )
                    metrics.add(frame)
                elif step.result.problem is not None:
                    refused[_kind(step.result.problem)] += 1
                if step.result.estimate_problem is not None and step.result.problem is None:
                    refused[_kind(step.result.estimate_problem)] += 1
            speed = given.duration / (time.perf_counter() - began)
        log(f"{speed:.3g} times as fast as it was recorded; evaluating the outputs")
        summary = _summary(given, seen, metrics, refused, speed)
        if summary.remark:
            log(summary.remark)
        write_results(folder, given, metrics, summary, log)
        return summary


def _kind(problem: Exception) -> str:
    """Return why a pose was refused, without the numbers."""
    if not isinstance(problem, InvalidInputError):
        return "a program that was not solved"
    return NOT_NEWER if problem.field == "needle pose stamp" else f"a {problem.field} that cannot be used"


def _summary(
    given: BagInput, seen: ObservationReader, metrics: RunMetrics, refused: Counter[str], speed: float
) -> ReplaySummary:
    """Return the figures.

    Raises:
        BagError: nothing was predicted.
    """
    refused = refused + seen.refused + given.recording.refused
    if not len(metrics.series):
        words = "; ".join(f"{count} times {why}" for why, count in refused.most_common()) or WAITING
        things = "frames" if given.source == "camera" else "poses"
        raise BagError(
            given.recording.path, f"gave no prediction: {seen.found} of {seen.count} {things} had a needle; {words}"
        )
    return replay_summary(
        given,
        metrics,
        frames=seen.count,
        tracked=seen.found,
        commands=0,
        driven=0,
        latency={},
        speed=speed,
        refused=dict(refused.most_common()),
        remark=seen.thread_problem(),
    )


class _Output:
    """Writes what the nodes would have published.

    Args:
        bag: to write to; it begins with the scene.
        seen: whose frames and records it gets as they go by.
        given: the bag that is replayed.
    """

    def __init__(self, bag: BagWriter, seen: ObservationReader, given: BagInput) -> None:
        self._bag = bag
        bag.add_topic(SCENE.recorded, SCENE.type_name)
        bag.write(SCENE.recorded, given.begin, packed_scene(given.begin, given.setup.scene))
        by_tracker = [TRACKER_STATE, THREAD_OBSERVATION] if seen.source == "camera" else []
        if seen.source == "poses" and given.recording.counts.get(THREAD_OBSERVATION.recorded):
            by_tracker = [THREAD_OBSERVATION]
        for channel in (NEEDLE_POSE, *by_tracker, MEASURED_THREAD, PREDICTED_THREAD, ESTIMATED_THREAD, MARGINS):
            bag.add_topic(channel.recorded, channel.type_name)
        self._version = given.setup.scene.version
        seen.on_frame, seen.on_record = self._frame, self._record

    def write(self, step: Step) -> None:
        """Write prediction, estimate and margins of an observation."""
        result = step.result
        self._write(result.stamp, prediction_outputs(result, step.settings.material))
        if result.refused is None and not result.late:  # as live: a pose that is refused gets no answer
            self._write(result.stamp, estimate_outputs(result))

    def _frame(self, stamp: int, seen: FrameMeasurement) -> None:
        track = seen.track
        if seen.tracked:
            self._write(stamp, pose_outputs(stamp, track.tail, track.heading, track.covariance))
            self._write(stamp, thread_outputs(stamp, track.observation, seen.centreline))
        self._bag.write(TRACKER_STATE.recorded, max(stamp, 0), packed_tracker_state(stamp, track))

    def _write(self, stamp: int, outputs: Outputs) -> None:
        for channel, data in outputs:
            self._bag.write(channel.recorded, max(stamp, 0), data)

    def _record(self, stamp: int, record: RecordedMessage) -> None:
        if record.topic == SCENE.recorded:
            version = record.decode().version
            if version == self._version:
                return  # written at the beginning
            self._version = version
        self._bag.write(record.topic, max(stamp, 0), record.data)
