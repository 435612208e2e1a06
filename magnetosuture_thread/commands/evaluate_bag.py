"""Evaluation of one bag: predictions and estimates without a graph, latencies of the recorded graph, and the page."""

from __future__ import annotations

import platform
from array import array
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

from magnetosuture_thread import interface
from magnetosuture_thread.bags.reader import RecordedMessage
from magnetosuture_thread.bags.recording import CHANNELS, Recording
from magnetosuture_thread.commands.observations import NOT_FOUND, measure_step, predictions
from magnetosuture_thread.commands.recorded import BagInput, BagSelection, open_bag
from magnetosuture_thread.commands.replay import find_photos
from magnetosuture_thread.configuration import Configuration, configuration_fields
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.evaluation.figures import STAGES, BagDetails, Figures, LiveFigures
from magnetosuture_thread.evaluation.metrics import Percentiles, RunMetrics
from magnetosuture_thread.evaluation.page import write_page
from magnetosuture_thread.evaluation.plots import draw_worst_frame
from magnetosuture_thread.evaluation.tables import Row, row_of
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.messages.reading import stamp_of
from magnetosuture_thread.texts import one_line
from magnetosuture_thread.thread_model.session import WAITING
from magnetosuture_thread.thread_model.settings import ThreadModelSettings
from magnetosuture_thread.workers import Log, Progress

SOFTWARE = ("magnetosuture_thread", "numpy", "numba", "opencv-python-headless")
LATENT = dict(zip((interface.NEEDLE_POSE, interface.PREDICTED_THREAD, interface.CURRENTS), STAGES, strict=True))
MAX_LATENCY = 10.0  # s; a median beyond is of two clocks
MAX_WAITING = 600  # recorded predictions that may wait for their frame


@dataclass(frozen=True)
class EvaluationTask:
    """A bag to evaluate.

    Attributes:
        path: of the bag.
        name: of its report.
        against: what predictions are compared with: `truth`, `seen` (measured), or `auto`: both where present.
        formulation: of the model; the setup's if empty.
        selection: what of the bag is read.
    """

    path: Path
    name: str
    against: str
    formulation: str
    selection: BagSelection


def evaluate_bag(task: EvaluationTask, log: Log, progress: Progress) -> tuple[Row, str]:
    """Evaluate a bag; return its row of the table, and its page.

    Of each frame some numbers are kept, and of a few frames the threads: memory grows by 210 bytes a frame.

    Args:
        task: which bag, and how.
        log: called with a line for a person.
        progress: called with the share done, 0 to 1.

    Raises:
        BagError: the bag cannot be used, what is compared with is not in it, or nothing in it was predicted.
        ConfigurationError: the setup cannot be used.
    """
    with open_bag(task.path, log, **task.selection) as given:
        recording, span = given.recording, (given.start, given.duration)
        model = replace(given.setup.model, formulation=task.formulation or given.setup.model.formulation)
        is_recorded = bool(recording.counts.get(interface.PREDICTED_THREAD.recorded))
        targets = _targets(given, task.against)
        metrics = RunMetrics(model.thread_length, recording.start, targets, recorded=is_recorded)
        seen = given.observations(lambda share: progress(0.95 * share))
        recorded, refused = RecordedPredictions(recording, *span), Counter[str]()
        for step in predictions(seen, model, given.setup.scene, metrics.observe):
            own = recorded.of(step.observation.stamp) if step.result.prediction is not None else None
            measure_step(step, metrics, refused, own)
        figures = Figures.of(metrics, live_figures(recording, *span), (given.start, given.start + given.duration))
        refused += Counter({why: count for why, count in seen.refused.items() if why != NOT_FOUND}) + recording.refused
        if not figures.predicted:
            counts = Counter(metrics.reasons) + refused
            why = "; ".join(f"{count} times {reason}" for reason, count in counts.most_common(3)) or WAITING
            found = f"{figures.tracked} of {figures.frames} had a needle"
            raise BagError(recording.path, f"gave no prediction: {found}; {why}")
        about = _about(given, task.name, model, refused, seen.thread_problem())
        worst = metrics.worst_frames()
        photos = find_photos(given, {each.frame.stamp for each in worst})
        pictures = [
            draw_worst_frame(
                each,
                photos.get(each.frame.stamp),
                target=metrics.target,
                length=model.thread_length,
                dish_diameter=given.setup.scene.dish.diameter,
                simulated=bool(about.simulated),
            )
            for each in worst
        ]
    page = write_page(about, metrics, figures, pictures)
    progress(1.0)
    return row_of(about, figures), page


def _targets(given: BagInput, against: str) -> list[str]:
    """Return what the predictions are compared with.

    Raises:
        BagError: the bag does not hold it.
    """
    counts = given.recording.counts
    there = {
        "truth": bool(counts.get(interface.GROUND_TRUTH_THREAD.recorded)),
        "seen": given.source == "camera" or bool(counts.get(interface.MEASURED_THREAD.recorded)),
    }
    if against != "auto" and not there[against]:
        topic = interface.GROUND_TRUTH_THREAD if against == "truth" else interface.MEASURED_THREAD
        raise BagError(given.recording.path, f"has no messages on {topic.recorded} ({topic.type_name})")
    return [target for target, is_there in there.items() if is_there and against in ("auto", target)]


def _about(given: BagInput, name: str, model: ThreadModelSettings, refused: Counter[str], problem: str) -> BagDetails:
    recording, setup = given.recording, given.setup
    return BagDetails(
        name=name,
        path=one_line(str(recording.path)),
        setup=setup.name,
        simulated=recording.notes.get("simulated", ""),
        source=given.source,
        formulation=model.formulation,
        length=model.thread_length,
        segments=model.segments,
        dish_diameter=setup.scene.dish.diameter,
        start=recording.start,
        begin=given.start,
        duration=given.duration,
        damage=tuple(str(place) for place in recording.damage.regions) if recording.damage else (),
        unverified=recording.unverified,
        refused=dict(refused.most_common()),
        topics={
            channel.recorded: (channel.type_name, recording.counts[channel.recorded])
            for channel in CHANNELS
            if recording.counts.get(channel.recorded)
        },
        settings=(*_settings(model), *_settings(setup.vision)),
        remarks=(problem,) if problem else (),
        software=(*_versions(), ("Python", platform.python_version())),
    )


def _settings(settings: Configuration) -> Iterator[tuple[str, str, str]]:
    for field in configuration_fields(type(settings)):
        value = getattr(settings, field.name)
        shown = ", ".join(f"{entry}" for entry in value) if isinstance(value, tuple) else f"{value}"
        yield f"{field.group}.{field.name}", shown, field.quantity.unit


def _versions() -> Iterator[tuple[str, str]]:
    for name in SOFTWARE:
        try:
            yield name, version(name)
        except PackageNotFoundError:  # as where Ubuntu's python3-opencv is in its place
            continue


def live_figures(recording: Recording, start: float, duration: float | None) -> LiveFigures:
    """Return the latencies of a recorded graph: from a stamp to when the first message about it was recorded.

    Args:
        recording: the bag.
        start: seconds into the bag to begin at.
        duration: [s]; to the bag's end if None.

    Raises:
        BagError: the bag has changed since it was opened.
    """
    there = [channel for channel in LATENT if recording.counts.get(channel.recorded)]
    if not there:
        return LiveFigures()
    if "replayed" in recording.notes:
        return LiveFigures(remark="not measured: the bag was replayed")
    latencies = {channel.recorded: array("d") for channel in there}
    latest: dict[str, int] = {}
    for record in recording.records(there, start=start, duration=duration):
        stamp = _stamp(record)
        if stamp > latest.get(record.topic, 0):  # the first about each
            latest[record.topic] = stamp
            latencies[record.topic].append((record.time - stamp) * 1e-9)
    percentiles = {LATENT[channel]: Percentiles.of(latencies[channel.recorded]) for channel in there}
    found = {stage: each for stage, each in percentiles.items() if each is not None}
    if any(not 0.0 <= each.median <= MAX_LATENCY for each in found.values()):
        return LiveFigures(remark="not measured: stamps and times of recording are of two clocks")
    if all(each.maximum == 0.0 for each in found.values()):
        return LiveFigures(remark="not measured: the bag was made offline")
    return LiveFigures(found)


def _stamp(record: RecordedMessage) -> int:
    """Return the stamp of what a message answers [ns]; 0 for currents that answer no command or are broken."""
    if record.topic != interface.CURRENTS.recorded:
        return stamp_of(record)
    try:
        message = record.decode()
    except BagError:
        return 0
    return 0 if message.stop else int(message.command.sec * 1_000_000_000 + message.command.nanosec)


class RecordedPredictions:
    """Gives the predictions that a bag holds, one by one, beside those made now; few are held at a time.

    Args:
        recording: the bag.
        start: seconds into the bag to begin at.
        duration: [s]; to the bag's end if None.
    """

    def __init__(self, recording: Recording, start: float, duration: float | None) -> None:
        there = bool(recording.counts.get(interface.PREDICTED_THREAD.recorded))
        channels = [interface.PREDICTED_THREAD] if there else []
        self._records: Iterator[RecordedMessage] = recording.records(channels, start=start, duration=duration)
        self._held: dict[int, RecordedMessage] = {}
        self._latest = -1

    def of(self, stamp: int) -> Points | None:
        """Return the recorded prediction of a frame, shape (n + 1, 2) [m]; None if there is none.

        Args:
            stamp: of the frame [ns], not before those asked for until now.
        """
        while self._latest < stamp and len(self._held) < MAX_WAITING:
            record = next(self._records, None)
            if record is None:
                break
            self._latest = max(self._latest, at := stamp_of(record))
            if at >= stamp:  # those before were of frames that nobody asked for
                self._held[at] = record
        found = self._held.pop(stamp, None)
        self._held = {at: record for at, record in self._held.items() if at > stamp}
        if found is None:
            return None
        try:
            vertices = np.array([[point.x, point.y] for point in found.decode().positions])
        except BagError:
            return None
        return vertices if vertices.shape[0] > 1 and np.isfinite(vertices).all() else None
