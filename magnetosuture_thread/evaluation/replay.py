"""Recorded bags through tracker and model without a graph: the outputs as a bag, the figures, the picture."""

from __future__ import annotations

import json
import time
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from magnetosuture_thread.bags import packing
from magnetosuture_thread.bags.packing import packed_scene
from magnetosuture_thread.bags.reader import RecordedMessage
from magnetosuture_thread.bags.reading import nanoseconds, stamp_of
from magnetosuture_thread.bags.recording import Recording
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.estimator.settings import ThreadModelSettings
from magnetosuture_thread.estimator.thread_session import WAITING
from magnetosuture_thread.evaluation import recorded
from magnetosuture_thread.evaluation.frames import EstimatedThread, FrameResult, Observation
from magnetosuture_thread.evaluation.metrics import TARGETS, Percentiles, RunMetrics, SensorSilence, finite_or_none
from magnetosuture_thread.evaluation.recorded import BagInput, Event, Step, TrackedFrame
from magnetosuture_thread.evaluation.tables import STAGES, ReplaySummary, figures_of
from magnetosuture_thread.evaluation.workers import Log, Progress
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.errors import BagError, InvalidInputError
from magnetosuture_thread.settings.files import whole_folder
from magnetosuture_thread.vision.tracker import VisionTracker

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from magnetosuture_thread.evaluation.plots import Photo


class MeasuredRun(NamedTuple):
    """The predictions of a whole bag, measured.

    Attributes:
        metrics: of the run.
        refused: frames and poses that could not be used, by why.
        remark: what else to know of the bag, empty if nothing.
        silence: time without frames, or poses.
        speed: how many seconds of the bag were worked through in a second.
    """

    metrics: RunMetrics
    refused: Counter[str]
    remark: str
    silence: SensorSilence
    speed: float


def measure_run(
    bag: BagInput,
    model: ThreadModelSettings,
    targets: Sequence[str] = TARGETS,
    progress: Progress = lambda share: None,
    write: Callable[[Event], None] = lambda event: None,
) -> MeasuredRun:
    """Predict and estimate the thread over a bag, and measure how that went.

    Of each frame some numbers are kept, and of a few frames the threads: memory grows by 210 bytes a frame.

    Args:
        bag: what of which bag.
        model: of the thread.
        targets: what predictions are compared with, of `truth` and `seen`.
        progress: called with the share done, 0 to 1.
        write: called with each event of the run; see `predictions`.

    Raises:
        BagError: nothing in the bag was predicted.
    """
    reader = recorded.ObservationReader(bag, progress)
    metrics, refused = RunMetrics(model.thread_length, bag.recording.start, targets), Counter[str]()
    began = time.perf_counter()  # kernels are loaded
    for event in recorded.predictions(reader, model, bag.setup.scene):
        write(event)
        if isinstance(event, Observation):
            metrics.observe(event)
        elif isinstance(event, Step):
            _measure_step(event, metrics, refused)
    silence = SensorSilence.of(metrics.observed.times, bag.start, bag.start + bag.duration)
    speed = (bag.duration - silence.total) / (time.perf_counter() - began)
    refused += reader.refused + bag.recording.refused
    if not len(metrics.series):
        others = Counter({why: count for why, count in refused.items() if why != recorded.NOT_FOUND})
        reasons = Counter(metrics.reasons) + others
        words = "; ".join(f"{count} times {why}" for why, count in reasons.most_common(3)) or WAITING
        things = "frames" if bag.source == "camera" else "poses"
        counts = f"{metrics.tracked} of {len(metrics.observed)} {things} had a needle"
        raise BagError(bag.recording.path, f"gave no prediction: {counts}; {words}")
    return MeasuredRun(metrics, refused, reader.thread_problem(), silence, speed)


def _measure_step(step: Step, metrics: RunMetrics, refused: Counter[str]) -> None:
    """Add a step to the figures of a run, or why there is no prediction to what is refused."""
    result = step.result
    if result.prediction is not None:
        frame = FrameResult.of(step.observation, result.prediction, result.margins, step.step_time)
        if step.settings.is_estimated:
            frame.estimate = EstimatedThread.of(result.estimate, result.prediction)
        frame.obstacles = step.scene.obstacles if step.scene is not None else ()
        metrics.add(frame)
    problem = result.problem or result.estimate_problem
    if isinstance(problem, InvalidInputError):
        is_late = problem.field == "needle pose stamp"
        refused[recorded.NOT_NEWER if is_late else f"a {problem.field} that cannot be used"] += 1
    elif problem is not None:
        refused["a program that was not solved"] += 1


def replay_offline(
    bag_path: Path,
    output: Path,
    *,
    log: Log = lambda text: None,
    progress: Progress = lambda share: None,
    **selection: Unpack[recorded.BagSelection],
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
    with recorded.open_bag(bag_path, log, **selection) as bag, whole_folder(output) as folder:
        source = "camera frames" if bag.source == "camera" else "recorded poses"
        log(f"predicting by the {source} of {bag.duration:.1f} s")
        with BagWriter(folder / "bag", bag.notes) as writer:
            write = _OutputWriter(writer, bag).write
            metrics, refused, remark, silence, speed = measure_run(bag, bag.setup.model, progress=progress, write=write)
        log(f"{speed:.3g} times as fast as it was recorded; evaluating the outputs")
        counts = {"frames": len(metrics.observed), "tracked": metrics.tracked, "commands": 0, "driven": 0}
        run = {"speed": speed, "refused": dict(refused.most_common()), "silence": silence, "remark": remark}
        summary = replay_summary(bag, metrics, **counts, latency={}, **run)
        if remark:
            log(remark)
        write_results(folder, bag, metrics, summary, log)
        return summary


class _OutputWriter:
    """Writes what the nodes would have published.

    Args:
        writer: of the output bag; it begins with the scene.
        bag: that is replayed.
    """

    def __init__(self, writer: BagWriter, bag: BagInput) -> None:
        self._writer, self._version = writer, bag.setup.scene.version
        writer.add_topic(interface.SCENE.recorded, interface.SCENE.type_name)
        writer.write(interface.SCENE.recorded, bag.begin, packed_scene(bag.begin, bag.setup.scene))
        is_camera = bag.source == "camera"
        is_observed = is_camera or bag.recording.counts.get(interface.THREAD_OBSERVATION.recorded)
        channels = [*[interface.TRACKER_STATE] * is_camera, *[interface.THREAD_OBSERVATION] * bool(is_observed)]
        channels += [interface.NEEDLE_POSE, interface.MEASURED_THREAD]
        channels += [interface.PREDICTED_THREAD, interface.ESTIMATED_THREAD, interface.MARGINS]
        for channel in channels:
            writer.add_topic(channel.recorded, channel.type_name)

    def write(self, event: Event) -> None:
        """Write what is recorded, tracked, predicted and estimated, as it comes."""
        match event:
            case RecordedMessage(topic=interface.MATERIAL.recorded):
                pass
            case RecordedMessage(topic=interface.SCENE.recorded):
                version = event.decode().version
                if version != self._version:  # else it is there already
                    self._version = version
                    self._writer.write(event.topic, max(stamp_of(event), 0), event.data)
            case RecordedMessage():
                self._writer.write(event.topic, max(stamp_of(event), 0), event.data)
            case TrackedFrame(stamp=stamp, measurement=measurement):
                track = measurement.track
                if measurement.tracked:
                    self._write(stamp, packing.pose_outputs(stamp, track.tail, track.heading, track.covariance))
                    self._write(stamp, packing.thread_outputs(stamp, track.observation, measurement.centreline))
                state = packing.packed_tracker_state(stamp, track)
                self._write(stamp, [(interface.TRACKER_STATE, state)])
            case Step(result=result, settings=settings):
                self._write(result.stamp, packing.prediction_outputs(result, settings.material))
                if result.refused is None and not result.late:  # as live: a pose that is refused gets no answer
                    self._write(result.stamp, packing.estimate_outputs(result))

    def _write(self, stamp: int, outputs: Iterable[tuple[interface.Channel, bytes]]) -> None:
        for channel, data in outputs:
            self._writer.write(channel.recorded, max(stamp, 0), data)


def replay_summary(bag: BagInput, metrics: RunMetrics, **others: Any) -> ReplaySummary:
    """Return the figures of a replay.

    Args:
        bag: what was replayed.
        metrics: of its predictions, of which there are some.
        others: the fields of `ReplaySummary` that these do not give.
    """
    return ReplaySummary(
        bag=str(bag.recording.path),
        setup=bag.setup.name,
        simulated=bag.recording.notes.get("simulated", ""),
        least_margins=list(metrics.minimum_margins.values()),
        contact_frames=metrics.contact_frames,
        residual=metrics.maximum("residual"),
        peak_tension=finite_or_none(metrics.maximum("tension")),
        needle_pull=finite_or_none(metrics.maximum("pull")),
        source=bag.source,
        damage=str(bag.recording.damage or ""),
        unverified=bag.recording.salvaged_without_checksum,
        estimation=metrics.estimation,
        **figures_of(metrics),
        **others,
    )


def write_results(folder: Path, bag: BagInput, metrics: RunMetrics, summary: ReplaySummary, log: Log) -> None:
    """Write summary.json, and then summary.png, which may fail without costing anything.

    Args:
        folder: that gets them.
        bag: what was replayed.
        metrics: of its predictions.
        summary: the figures.
        log: called with a line for a person.
    """
    text = json.dumps(summary.to_json(), indent=2, allow_nan=False)
    (folder / "summary.json").write_text(text + "\n", encoding="utf-8")
    if picture := draw_run(bag, metrics, log):
        (folder / "summary.png").write_bytes(picture)


def draw_run(bag: BagInput, metrics: RunMetrics, log: Log) -> bytes:
    """Return the picture of a run as PNG; empty, with a line in the log, where it cannot be drawn.

    Args:
        bag: what was evaluated.
        metrics: of its predictions, of which there are some.
        log: called with a line for a person.
    """

    def draw() -> bytes:
        from magnetosuture_thread.evaluation.plots import draw_metrics  # late, as it imports matplotlib

        assert metrics.worst is not None
        photo = find_photo(bag, metrics.worst.frame.stamp)
        title = f"{bag.recording.path.name}, setup {bag.setup.name}"
        simulated = bag.recording.notes.get("simulated", "")
        return draw_metrics(metrics, title, bag.setup.scene.dish.diameter, photo, simulated)

    return picture_or_log(draw, log)


def picture_or_log(draw: Callable[[], bytes], log: Log) -> bytes:
    """Return a picture; empty, with a line in the log, where it cannot be drawn.

    Whatever matplotlib, a font or a decoder raises: figures are worth more than their picture, and are written before.

    Args:
        draw: returns the picture, and imports what it is drawn with.
        log: called with a line for a person.
    """
    try:
        return draw()
    except Exception as error:
        log(f"no picture: {type(error).__name__}: {' '.join(str(error).split())}")
        return b""


def find_photo(bag: BagInput, stamp: int) -> Photo | None:
    """Return the camera image of a stamp, with the view of the dish of the frame nearest before where it has none."""
    from magnetosuture_thread.evaluation.plots import Photo  # late, as it imports matplotlib

    camera, view = bag.recording.camera, None
    if camera is None or bag.source != "camera":
        return None
    for record in bag.recording.records([camera], start=bag.start, duration=bag.duration):
        is_wanted = stamp_of(record) == stamp
        if view is not None and not is_wanted:
            continue
        try:
            image = recorded.read_image(record)
        except (BagError, InvalidInputError):
            continue
        view = VisionTracker(bag.setup.vision, bag.setup.scene).look(image).view or view
        if is_wanted:
            return None if view is None else Photo(image, view)
    return None


def recorded_latency(recording: Recording, start: float, duration: float | None) -> dict[str, Percentiles]:
    """Return the latencies of a recorded graph by stage: from a stamp to when the first message about it was recorded.

    There are none of a bag that was replayed or made offline, nor where stamps and times of recording are of two
    clocks.

    Args:
        recording: the bag.
        start: seconds into the bag to begin at.
        duration: [s]; to the bag's end if None.

    Raises:
        BagError: the bag has changed since it was opened.
    """
    if "replayed" in recording.notes:
        return {}
    answers = interface.NEEDLE_POSE, interface.PREDICTED_THREAD, interface.CURRENTS
    channels = [channel for channel in answers if recording.counts.get(channel.recorded)]
    stages = dict(zip((channel.recorded for channel in answers), STAGES, strict=True))
    latencies, latest = {stage: array("d") for stage in STAGES}, dict.fromkeys(STAGES, 0)
    for record in recording.records(channels, start=start, duration=duration):
        stage, stamp = stages[record.topic], _answered_stamp(record)
        if stamp > latest[stage]:
            latest[stage] = stamp
            latencies[stage].append((record.time - stamp) * 1e-9)
    known = {stage: spread for stage, times in latencies.items() if (spread := Percentiles.of(times)) is not None}
    one_clock = all(0.0 <= spread.median <= 10.0 for spread in known.values())
    return known if one_clock and any(spread.maximum > 0.0 for spread in known.values()) else {}


def _answered_stamp(record: RecordedMessage) -> int:
    """Return the stamp of what a message answers [ns]; 0 for currents that answer no command or are broken."""
    if record.topic != interface.CURRENTS.recorded:
        return stamp_of(record)
    try:
        message = record.decode()
    except BagError:
        return 0
    return 0 if message.stop else nanoseconds(message.command)
