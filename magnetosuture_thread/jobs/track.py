"""Camera frames of picture files, folders and bags, and the job `magnetosuture track`: needle and thread in them."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from magnetosuture_thread import InvalidInputError, Scene
from magnetosuture_thread.bags.reader import Bag, RecordedMessage
from magnetosuture_thread.bags.recording import Recording
from magnetosuture_thread.bags.storage import COMPRESSED_SUFFIXES, pluralize
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.files import read_regular
from magnetosuture_thread.interface import CAMERA, CAMERA_INFO, STORAGE_SUFFIXES
from magnetosuture_thread.thread_observation import ThreadPiece
from magnetosuture_thread.untrusted import MAX_FILE_BYTES
from magnetosuture_thread.vision.images import decode_image, image_header, unpack_image
from magnetosuture_thread.vision.lens import Lens, lens_of
from magnetosuture_thread.vision.look import State, Track, no_pose
from magnetosuture_thread.vision.overlay import OverlayWriter, draw_dish, draw_overlay
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import VisionTracker
from magnetosuture_thread.vision.warm_up import warm_up

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
PICTURE_RATE = 30.0  # frames/s, of what has no rate of its own
MIN_RATE, MAX_RATE = 0.1, 240.0  # frames/s, that video players show
FRAMES_FOR_RATE = 300  # of a bag, from its beginning


@dataclass(frozen=True)
class FrameFile:
    """One frame.

    Attributes:
        name: see `FrameSource.names`, or topic and stamp.
        image: None if it is broken.
        problem: why it is; else empty.
        stamp: when it was taken [s]; None where nothing tells.
    """

    name: str
    image: np.ndarray | None
    problem: str = ""
    stamp: float | None = None


class FrameSource:
    """The frames at given paths.

    Args:
        paths: picture files, one folder of pictures, or one bag.
        remap: new name of a bag's topic by its recorded name.

    Attributes:
        count: number of frames.
        names: of picture files; with their folders where two have the same name, and numbered where a file is given
            twice; empty for a bag.
        is_sequence: whether the frames follow one another in time, as in a bag.
        notes: what a bag's writer says of it.
        doubts: on a bag, a line each: what is damaged, or why damage may not have been noticed.
        unverified: why any frame of a bag may be wrong; empty if nothing speaks against them.
        lens: of a bag's camera, by the last camera_info before the frame; None if there is none that can be used.

    Raises:
        BagError: a path does not exist, a folder holds no pictures, or a bag cannot be used.
    """

    def __init__(self, paths: Sequence[Path], *, remap: Mapping[str, str] | None = None) -> None:
        self._files: list[Path] = []
        self._turned = 0  # frames that have an orientation
        self.lens: Lens | None = None
        self._lens_problems: Counter[str] = Counter()
        self._recording: Recording | None = None
        self._channel = CAMERA["raw"]
        self.notes: dict[str, str] = {}
        self.doubts: list[str] = []
        self.unverified = ""
        for path in paths:
            self._add(path, remap, alone=len(paths) == 1)
        self.is_sequence = self._recording is not None
        if remap and self._recording is None:
            raise BagError(paths[0], "is no bag, so there is no topic in it to remap")
        names = [file.name for file in self._files]
        unique = len(set(names)) == len(names)
        self.names = numbered(names if unique else [str(file) for file in self._files], "{} ({})")
        recording = self._recording
        self.count = recording.counts[self._channel.recorded] if recording is not None else len(self._files)

    @property
    def refused(self) -> list[str]:
        """Return why frames of a bag could not be taken, and what else to know, once all have been gone through."""
        reasons = self._recording.refused if self._recording is not None else {}
        lines = [f"{reason}: {pluralize(count, 'frame')} left out" for reason, count in reasons.items()]
        lines += [f"{problem}: frames are taken as they are" for problem in self._lens_problems]
        if self._turned:
            lines.append(f"{pluralize(self._turned, 'frame')} with an EXIF orientation, read as stored: it is ignored")
        return lines

    def _add(self, path: Path, remap: Mapping[str, str] | None, alone: bool) -> None:
        try:
            path.stat()
            is_folder = path.is_dir()
            inside = sorted(path.iterdir()) if is_folder else []
        except FileNotFoundError:
            raise BagError(path, "does not exist; expected pictures, a folder of them, or a bag") from None
        except (OSError, ValueError) as error:
            raise BagError(path, f"cannot be read: {error}") from None
        if any(file.name.endswith((*STORAGE_SUFFIXES, *COMPRESSED_SUFFIXES)) for file in (path, *inside)):
            if not alone:
                raise BagError(path, "is a bag; expected it alone, without other frames")
            bag = Bag(path, remap=remap)
            recording = self._recording = Recording(bag)
            self.notes, self.unverified = bag.notes, bag.unverified
            doubt = f"is unverified: {bag.unverified}" if bag.unverified else bag.unchecked
            self.doubts = [line for line in (str(bag.damage or ""), doubt, *bag.remarks) if line]
            if recording.camera is None:
                topics, present = " or ".join(c.recorded for c in CAMERA.values()), ", ".join(sorted(bag.counts))
                raise BagError(path, f"holds no camera frames; expected some on {topics}; its topics: {present}")
            self._channel = recording.camera
        elif is_folder:
            pictures = [file for file in inside if file.suffix.lower() in PICTURES and file.is_file()]
            if not pictures:
                raise BagError(path, f"holds no pictures; expected files that end in {', '.join(PICTURES)}, or a bag")
            self._files += pictures
        else:
            self._files.append(path)

    def __iter__(self) -> Iterator[FrameFile]:
        """Go through the frames: files in the order given, a folder by name, a bag by time."""
        if self._recording is not None:
            self._recording.refused.clear()
            self._turned = 0
            wanted = [c for c in (CAMERA_INFO, self._channel) if self._recording.counts.get(c.recorded)]
            for record in self._recording.records(wanted):
                if record.topic == CAMERA_INFO.recorded:
                    self._take_lens(record)
                else:
                    yield self._recorded(record)
            return
        for name, file in zip(self.names, self._files, strict=True):
            try:
                data = read_regular(file, MAX_FILE_BYTES)
                self._note_orientation(data)
                yield FrameFile(name, decode_image(data))
            except OSError as error:
                yield FrameFile(name, None, f"cannot be read: {error.strerror}")
            except InvalidInputError as error:
                yield FrameFile(name, None, str(error))

    def _take_lens(self, record: RecordedMessage) -> None:
        try:
            self.lens = lens_of(record.decode())
        except (BagError, InvalidInputError) as error:
            self.lens = None
            self._lens_problems[str(error)] += 1

    def _note_orientation(self, data: bytes | memoryview) -> None:
        header = image_header(data)
        self._turned += header is not None and header.orientation != 1

    def rate(self) -> float:
        """Return the frame rate of a bag, by the median interval of its first frames' stamps; 30 for pictures."""
        if self._recording is None:
            return PICTURE_RATE
        stamps = [_stamp(record) for record in islice(self._recording.records([self._channel]), FRAMES_FOR_RATE)]
        intervals = [after - before for before, after in pairwise(stamps) if after > before]
        if not intervals:
            return PICTURE_RATE
        # To 0.01 frames/s: the time base of MPEG-4 has no room for more.
        return min(MAX_RATE, max(MIN_RATE, round(1.0 / float(np.median(intervals)), 2)))

    def _recorded(self, record: RecordedMessage) -> FrameFile:
        """Return a recorded frame; it is broken where message or picture are."""
        stamp = record.time * 1e-9
        try:
            message = record.decode()
            stamp = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
            if record.type_name == CAMERA["compressed"].type_name:
                self._note_orientation(message.data.data)
                image = decode_image(message.data)
            else:
                image = unpack_image(message.data, message.height, message.width, message.step, message.encoding)
        except (BagError, InvalidInputError) as error:
            return FrameFile(f"{record.topic} {stamp:.6f}", None, str(error), stamp)
        return FrameFile(f"{record.topic} {stamp:.6f}", np.asarray(image), "", stamp)


def numbered(names: Sequence[str], form: str) -> list[str]:
    """Return names each of which is there once: where one comes again, it gets a number.

    Args:
        names: that may come again.
        form: of a name with its number, 2 and up, for example `{}_{}`.
    """
    given, numbers, taken = list[str](), Counter[str](), set(names)
    for name in names:
        numbers[name] += 1
        own = name
        while numbers[name] > 1 and (own := form.format(name, numbers[name])) in taken:
            numbers[name] += 1
        taken.add(own)
        given.append(own)
    return given


def _stamp(record: RecordedMessage) -> float:
    """Return when a frame was taken [s]; when it was recorded, where it is broken."""
    try:
        stamp = record.decode().header.stamp
    except BagError:
        return record.time * 1e-9
    return float(stamp.sec + stamp.nanosec * 1e-9)


@dataclass(frozen=True)
class TrackedFrame:
    """What one frame showed.

    Attributes:
        name: the file's name, with its folders where another file has the same; or topic and stamp.
        track: what was seen.
        duration: processor time that looking took, on one core, decoding not included; other work on the
            machine does not show in it [s].
        stamp: when the frame was taken [s]; None where nothing tells.
        unverified: why a bag's frame may be wrong; empty if nothing speaks against it.
    """

    name: str
    track: Track
    duration: float
    stamp: float | None
    unverified: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return what is written of it, in SI units; null for what has no value."""
        track, seen = self.track, not self.track.reason
        thread = [_numbers(point) for point in track.centreline] if seen else None
        return {
            "file": self.name,
            "status": track.state.value,
            "reason": track.reason or None,
            "warning": track.warning or None,
            "tail_m": _numbers(track.tail) if seen else None,
            "heading_rad": _number(math.atan2(track.heading[1], track.heading[0])) if seen else None,
            "tip_m": _numbers(track.tip) if seen else None,
            "curvature_per_m": _number(track.curvature) if seen else None,
            "thread_m": None if thread is None or None in thread else thread,
            "needle_length_m": None if track.needle_length is None else _number(track.needle_length),
            "pieces": [_piece(piece) for piece in track.observation.pieces] if seen else None,
            "complete": track.observation.complete,
            "confidence": _number(track.confidence),
            "time_s": self.duration,
            "stamp_s": self.stamp,
            **({"unverified": self.unverified} if self.unverified else {}),
        }


def _piece(piece: ThreadPiece) -> dict[str, Any]:
    """Return what is written of a piece of the thread, in SI units; null where nothing tells."""
    return {
        "points_m": piece.points.tolist(),
        "deviation_m": piece.deviation.tolist(),
        "first_end": piece.first_end.name.lower(),
        "last_end": piece.last_end.name.lower(),
        "arc_length_m": [_number(value) for value in piece.arc_length],
        "direction_known": piece.direction_known,
        "confidence": piece.confidence,
    }


def settings_with(
    settings: VisionTrackerSettings, metres_per_pixel: float | None, centre_px: tuple[float, float] | None
) -> VisionTrackerSettings:
    """Return settings with what of the view is given.

    Raises:
        ConfigurationError: the view is not one.
    """
    if metres_per_pixel is not None:
        settings = replace(settings, metres_per_pixel=metres_per_pixel)
    if centre_px is not None:
        settings = replace(settings, dish_centre_px=tuple(centre_px))
    return settings


def track(
    paths: Sequence[Path],
    settings: VisionTrackerSettings,
    scene: Scene,
    *,
    overlay: Path | None = None,
    remap: Mapping[str, str] | None = None,
    lens: Lens | None = None,
    log: Callable[[str], None] = lambda text: None,
    progress: Callable[[float], None] = lambda share: None,
) -> list[TrackedFrame]:
    """Track the needle in frames: each by itself, or over time where they are a bag's.

    Args:
        paths: picture files, one folder of pictures, or one bag.
        settings: what to look for.
        scene: in which.
        overlay: folder or video to draw into.
        remap: new name of a bag's topic by its recorded name.
        lens: of the camera; None: a bag's own, and none of pictures.
        log: called with a line for a person on what of a bag is damaged or not checked.
        progress: called with the share done, 0 to 1.

    Raises:
        BagError: there are no frames, or the overlay cannot be written.
    """
    source = FrameSource(paths, remap=remap)
    for doubt in source.doubts:
        log(f"{paths[0]} {doubt}")
    tracker = VisionTracker(settings, scene)
    warm_up()
    results = []
    # Two files may differ in their folder or their ending alone; their overlays must not overwrite each other.
    files = numbered([Path(name).stem for name in source.names], "{}_{}")
    with OverlayWriter(overlay, source.rate()) if overlay is not None else nullcontext() as writer:
        for index, frame in enumerate(source):
            own = lens or source.lens
            tracker.set_lens(own)
            result = _look(tracker, frame, source.is_sequence)
            results.append(replace(result, unverified=source.unverified))
            if writer is not None and frame.image is not None:
                name = f"frame_{index:06d}" if source.is_sequence else files[index]
                picture = frame.image
                if own is not None and own.problem_with(picture.shape) is None:
                    picture = own.undistorted(picture)
                writer.write(name, _drawn(picture, result, settings, scene))
            progress((index + 1) / max(source.count, 1))
    for line in source.refused:
        log(line)
    return results


def _look(tracker: VisionTracker, frame: FrameFile, in_sequence: bool) -> TrackedFrame:
    """Look at one frame, and time it."""
    began = time.thread_time()
    try:
        if frame.image is None:
            raise InvalidInputError("image", "a broken picture", frame.problem)
        if in_sequence and frame.stamp is not None:
            seen = tracker.track(frame.image, frame.stamp)
        else:
            seen = tracker.look(frame.image)
    except InvalidInputError as error:
        seen = no_pose(State.LOST, frame.problem or str(error), None)
    return TrackedFrame(frame.name, seen, time.thread_time() - began, frame.stamp)


def _drawn(image: np.ndarray, result: TrackedFrame, settings: VisionTrackerSettings, scene: Scene) -> np.ndarray:
    drawn = draw_overlay(image, result.track, settings.needle_length, result.name)
    view = result.track.view
    if view is not None:
        draw_dish(drawn, view.centre_px, scene.dish.radius / view.metres_per_pixel)
    return drawn


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _numbers(values: np.ndarray) -> list[float] | None:
    return [float(value) for value in values] if np.isfinite(values).all() else None
