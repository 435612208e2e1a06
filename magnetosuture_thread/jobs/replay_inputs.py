"""What live and offline replay share: the bag and its setup at the start, figures and picture at the end."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread import ConfigurationError, InvalidInputError, Scene
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.recording import Recording
from magnetosuture_thread.bags.storage import UNVERIFIED_NOTE
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.evaluation.graph_outputs import ReplaySummary
from magnetosuture_thread.evaluation.metrics import RunMetrics, compare_errors, finite_or_none
from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.interface import (
    DISH_FRAME,
    GROUND_TRUTH_PULL,
    GROUND_TRUTH_THREAD,
    MEASURED_THREAD,
    NEEDLE_COMMAND,
    SCENE,
)
from magnetosuture_thread.messages.scene import parse_scene_message
from magnetosuture_thread.offline.observations import pixels
from magnetosuture_thread.offline.predictions import chosen_source
from magnetosuture_thread.setups import Setup, read_setup
from magnetosuture_thread.vision.tracker import VisionTracker

if TYPE_CHECKING:
    from typing_extensions import Unpack

DEFAULT_SETUP = "petri_35mm_polyamide"
SETUP_NOTE = "scenario"  # of a bag, which holds the setup's text
MIN_LOOP_DURATION = 1.5  # s; nodes take a jump back of a second and less for messages that come late

Log = Callable[[str], None]
Progress = Callable[[float], None]


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
        own = {UNVERIFIED_NOTE: self.recording.unverified} if self.recording.unverified else {}
        return {**self.recording.notes, **own, "setup": self.setup.name, "replayed": str(self.recording.path)}

    def check_loop(self) -> None:
        """Raise `BagError` if the bag is too short to be played in a loop."""
        if self.duration < MIN_LOOP_DURATION:
            problem = f"gives {self.duration:.2f} s to play over and over; expected {MIN_LOOP_DURATION:g} s or more"
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
    recording = Recording(Bag(path, remap=selection.get("remap")), dish_frame=selection.get("frame", DISH_FRAME))
    if recording.damage is not None:
        log(f"the bag is damaged, what is intact is played: {recording.damage}")
    if recording.unverified:
        log(f"unverified: {recording.unverified}")
    elif recording.unchecked and recording.damage is None:
        log(recording.unchecked)
    for remark in recording.remarks:
        log(remark)
    if not 0.0 <= start <= recording.duration:
        raise BagError(path, f"is {recording.duration:.3f} s long; asked to start at {start:g} s")
    source = chosen_source(recording, selection.get("source", "auto"))
    for channel in (MEASURED_THREAD, NEEDLE_COMMAND, GROUND_TRUTH_THREAD, GROUND_TRUTH_PULL):
        if channel.recorded in recording.unfit:
            raise BagError(path, recording.unfit[channel.recorded])
    left = recording.duration - start
    with TemporaryDirectory() as spare:
        scene = scene_at(recording, start)
        setup = _setup_of(recording, selection.get("setup_name", ""), Path(spare), scene, log)
        yield BagInput(recording, setup, source, start, left if duration is None else min(duration, left))


def scene_at(recording: Recording, start: float) -> Scene | None:
    """Return the scene in force at a time into a bag [s], else the first one; None if the bag has none.

    Raises:
        BagError: what it tells is no scene.
    """
    found: Scene | None = None
    if recording.counts.get(SCENE.recorded):
        for record in recording.records([SCENE]):
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


def replay_summary(given: BagInput, metrics: RunMetrics, **others: Any) -> ReplaySummary:
    """Return the figures of a replay.

    Args:
        given: what was replayed.
        metrics: of its predictions, of which there are some.
        others: the fields of `ReplaySummary` that these do not give.
    """
    errors, compared = metrics.errors(), compare_errors(metrics.series)
    return ReplaySummary(
        bag=str(given.recording.path),
        setup=given.setup.name,
        simulated=given.recording.notes.get("simulated", ""),
        predicted=len(metrics.series),
        step_time=metrics.percentiles("step_time"),
        least_margins=list(metrics.minimum_margins.values()),
        contact_frames=metrics.contact_frames,
        stretch=metrics.maximum("strain"),
        residual=metrics.maximum("residual"),
        peak_tension=finite_or_none(metrics.maximum("tension")),
        needle_pull=finite_or_none(metrics.maximum("pull")),
        seen_share=metrics.mean("seen_share"),
        error_seen=errors["seen"],
        error_truth=errors["truth"],
        source=given.source,
        damage=str(given.recording.damage or ""),
        unverified=given.recording.unverified,
        estimation=metrics.estimation,
        prediction=compared["prediction"],
        estimate=compared["estimate"],
        **others,
    )


def write_results(folder: Path, given: BagInput, metrics: RunMetrics, summary: ReplaySummary, log: Log) -> None:
    """Write summary.json and summary.png.

    Args:
        folder: that gets them.
        given: what was replayed.
        metrics: of its predictions.
        summary: the figures.
        log: called with a line for a person.
    """
    text = json.dumps(summary.to_json(), indent=2, allow_nan=False)
    (folder / "summary.json").write_text(text + "\n", encoding="utf-8")
    chosen = metrics.worst_measured
    assert chosen is not None
    from magnetosuture_thread.evaluation.plots import Photo, draw_plan, draw_summary  # late, as it imports matplotlib

    found = _frame_of(given, chosen.stamp) if given.source == "camera" else None
    if found is None and given.source == "camera":
        log("no picture: the dish is not found in any frame")
        return
    scene = given.setup.scene
    photo = Photo(*found) if found is not None else draw_plan(scene.dish.diameter)
    at = (chosen.stamp - given.recording.start) * 1e-9
    draw_summary(folder / "summary.png", photo, replace(chosen, obstacles=scene.obstacles), at, summary)


def _frame_of(given: BagInput, stamp: int) -> tuple[NDArray[np.uint8], DishView] | None:
    """Return the camera frame of a stamp, and where the dish is, by the first frame in which it is found."""
    view, frame = None, None
    tracker = VisionTracker(given.setup.vision, given.setup.scene)
    camera = given.recording.camera
    assert camera is not None
    for record in given.recording.records([camera], start=given.start, duration=given.duration):
        message = record.decode()
        is_chosen = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamp
        if view is not None and not is_chosen:
            continue
        try:
            image = pixels(message, record.type_name)
            view = view or tracker.look(image).view
        except InvalidInputError:
            continue
        frame = image if is_chosen else frame
        if view is not None and frame is not None:
            return frame, view
    return None
