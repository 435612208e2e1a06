"""One evaluated bag: predicted without a graph, judged, and written as a page."""

from __future__ import annotations

import platform
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.bags.recording import CHANNELS
from magnetosuture_thread.configuration import Configuration, configuration_fields
from magnetosuture_thread.errors import BagError, InvalidInputError
from magnetosuture_thread.evaluation.frames import FrameResult, Observation, WorstFrame
from magnetosuture_thread.evaluation.metrics import RunMetrics
from magnetosuture_thread.evaluation.report.figures import BagDetails, BagFigures
from magnetosuture_thread.evaluation.report.page import write_page
from magnetosuture_thread.evaluation.report.pictures import Photo, ReportPicture, draw_worst_frame
from magnetosuture_thread.evaluation.tables import Row, row_of
from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.interface import DISH_FRAME, GROUND_TRUTH_THREAD, MEASURED_THREAD, PREDICTED_THREAD
from magnetosuture_thread.jobs.evaluate_live import RecordedPredictions, live_figures
from magnetosuture_thread.jobs.replay_inputs import Given, opened
from magnetosuture_thread.messages.reading import stamp_of
from magnetosuture_thread.model.session import WAITING
from magnetosuture_thread.model.settings import ThreadModelSettings
from magnetosuture_thread.offline.observations import NOT_FOUND, ObservationReader, pixels
from magnetosuture_thread.offline.predictions import predictions
from magnetosuture_thread.vision.tracker import VisionTracker

AGAINST = ("auto", "truth", "seen")
SOFTWARE = ("magnetosuture_thread", "numpy", "numba", "opencv-python-headless")

Log = Callable[[str], None]
Progress = Callable[[float], None]


@dataclass(frozen=True)
class Options:
    """How bags are evaluated.

    Attributes:
        setup: name or path of the set-up; the one that each bag names if empty.
        against: `truth` or `seen`; `auto`: both where present.
        source: `camera` or `poses`; `auto`: the camera where there are frames.
        remap: other names for topics of the bags, each as old name and new.
        frame: the bags' name of the dish frame.
        formulation: of the model; the set-up's if empty.
        start: seconds into each bag to begin at.
        duration: [s]; to each bag's end if None.
    """

    setup: str = ""
    against: str = "auto"
    source: str = "auto"
    remap: tuple[tuple[str, str], ...] = ()
    frame: str = DISH_FRAME
    formulation: str = ""
    start: float = 0.0
    duration: float | None = None


def evaluate_bag(path: Path, name: str, options: Options, page: Path, log: Log, progress: Progress) -> Row:
    """Evaluate a bag, write its page and return its row of the table.

    Of each frame some numbers are kept, and of a few frames the threads: memory grows by 130 bytes a frame.

    Args:
        path: of the bag.
        name: of the report.
        options: how.
        page: the file to write.
        log: called with a line for a person.
        progress: called with the share done, 0 to 1.

    Raises:
        BagError: the bag cannot be used, or nothing in it was predicted.
        ConfigurationError: the set-up cannot be used.
    """
    with opened(
        path,
        setup_name=options.setup,
        source=options.source,
        start=options.start,
        duration=options.duration,
        remap=dict(options.remap),
        frame=options.frame,
        log=log,
    ) as given:
        model = given.setup.model
        if options.formulation:
            model = replace(model, formulation=options.formulation)
        recorded = bool(given.recording.counts.get(PREDICTED_THREAD.recorded))
        targets = _targets(given, options.against)
        metrics = RunMetrics(model.thread_length, given.recording.start, targets, recorded=recorded)
        seen = _Looked(given, metrics, lambda share: progress(0.95 * share))
        refused = _predict(given, model, metrics, seen)
        figures = BagFigures.of(metrics, live_figures(given.recording, given.start, given.duration))
        about = _about(given, name, model, refused, seen.thread_problem())
        if not figures.predicted:
            counts = Counter(metrics.reasons) + refused
            why = "; ".join(f"{count} times {reason}" for reason, count in counts.most_common(3)) or WAITING
            raise BagError(path, f"gave no prediction: {figures.tracked} of {figures.frames} had a needle; {why}")
        pictures = _pictures(given, model, metrics)
    page.write_text(write_page(about, metrics, figures, pictures), encoding="utf-8")
    progress(1.0)
    return row_of(about, figures)


class _Looked(ObservationReader):
    """A bag's sights, each of which the metrics take as it goes by; what else the bag says goes to the model."""

    def __init__(self, given: Given, metrics: RunMetrics, progress: Progress) -> None:
        super().__init__(given.recording, given.setup, given.source, given.start, given.duration, progress)
        self._metrics = metrics

    def __next__(self) -> Observation:
        """Return the next sight."""
        sight = super().__next__()
        self._metrics.observe(sight)
        return sight


def _targets(given: Given, against: str) -> list[str]:
    """Return what the predictions are held against.

    Raises:
        BagError: the bag does not hold what was asked for.
    """
    counts = given.recording.counts
    there = {
        "truth": bool(counts.get(GROUND_TRUTH_THREAD.recorded)),
        "seen": given.source == "camera" or bool(counts.get(MEASURED_THREAD.recorded)),
    }
    if against != "auto" and not there[against]:
        topic = GROUND_TRUTH_THREAD if against == "truth" else MEASURED_THREAD
        raise BagError(given.recording.path, f"has no messages on {topic.recorded} ({topic.type_name})")
    return [target for target, is_there in there.items() if is_there and against in ("auto", target)]


def _predict(given: Given, model: ThreadModelSettings, metrics: RunMetrics, seen: ObservationReader) -> Counter[str]:
    """Go through a bag once; return what was refused, by why."""
    recorded = RecordedPredictions(given.recording, given.start, given.duration)
    refused = Counter[str]()
    for step in predictions(seen, model, given.setup.scene):
        if step.outcome.prediction is not None:
            frame = FrameResult.of(
                step.sight,
                step.outcome.prediction,
                step.margins,
                step.step_time,
                recorded=recorded.of(step.sight.stamp),
                obstacles=step.scene.obstacles if step.scene is not None else (),
            )
            metrics.add(frame)
        elif step.outcome.problem is not None:
            refused[_kind(step.outcome.problem)] += 1
    refused += Counter({why: count for why, count in seen.refused.items() if why != NOT_FOUND})
    return refused + given.recording.refused


def _kind(problem: Exception) -> str:
    if isinstance(problem, InvalidInputError):
        return f"the model: {problem.field}, expected {problem.expectation}"
    return "the model: a program that was not solved"


def _pictures(given: Given, model: ThreadModelSettings, metrics: RunMetrics) -> list[ReportPicture]:
    worst = metrics.worst_frames()
    photos = _photos(given, worst)
    return [
        draw_worst_frame(
            each,
            photos.get(each.frame.stamp),
            target=metrics.target,
            length=model.thread_length,
            dish_diameter=given.setup.scene.dish.diameter,
            simulated=bool(given.recording.notes.get("simulated")),
        )
        for each in worst
    ]


def _photos(given: Given, worst: list[WorstFrame]) -> dict[int, Photo]:
    """Return the camera images of the worst frames, by stamp; of a frame without a dish the view is that of another."""
    wanted = {each.frame.stamp for each in worst}
    camera = given.recording.camera
    images, views = dict[int, NDArray[np.uint8]](), dict[int, DishView]()
    if camera is None:
        return {}
    for record in given.recording.records([camera], start=given.start, duration=given.duration):
        if len(images) == len(wanted):
            break
        stamp = stamp_of(record)
        if stamp not in wanted or stamp in images:
            continue
        try:
            images[stamp] = pixels(record.decode(), record.type_name)
        except (BagError, InvalidInputError):
            continue
        view = VisionTracker(given.setup.vision, given.setup.scene).look(images[stamp]).view
        if view is not None:
            views[stamp] = view
    spare = next(iter(views.values()), None)
    if spare is None:
        return {}
    return {stamp: Photo(image, views.get(stamp, spare)) for stamp, image in images.items()}


def _about(given: Given, name: str, model: ThreadModelSettings, refused: Counter[str], problem: str) -> BagDetails:
    recording, setup = given.recording, given.setup
    return BagDetails(
        name=name,
        path=printable_path(str(recording.path)),
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


def printable_path(text: str) -> str:
    """Return a text of one line that can be written as UTF-8 and shown, whatever bytes a file's name is made of."""
    decoded = text.encode("utf-8", "surrogateescape").decode("utf-8", "replace")
    return "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in decoded)
