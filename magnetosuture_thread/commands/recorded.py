"""A bag to replay or to evaluate: which part of it, with which setup, and what a person must know of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, TypedDict

from magnetosuture_thread import ConfigurationError, InvalidInputError, Scene, interface
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.recording import Recording
from magnetosuture_thread.bags.storage import UNVERIFIED_NOTE
from magnetosuture_thread.commands.observations import ObservationReader, chosen_source
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.messages.scene import parse_scene_message
from magnetosuture_thread.setups import Setup, read_setup
from magnetosuture_thread.workers import Log, Progress

if TYPE_CHECKING:
    from typing_extensions import Unpack

DEFAULT_SETUP = "petri_35mm_polyamide"
SETUP_NOTE = "scenario"  # of a bag, which holds the setup's text
MIN_LOOP_DURATION = 1.5  # s; nodes take a jump back of a second and less for messages that come late


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

    def observations(self, progress: Progress = lambda share: None) -> ObservationReader:
        """Return the observations; `progress` is called with the share done, 0 to 1."""
        return ObservationReader(self.recording, self.setup, self.source, self.start, self.duration, progress)

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
    recording = Recording(
        Bag(path, remap=selection.get("remap")), dish_frame=selection.get("frame", interface.DISH_FRAME)
    )
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
