"""The command `magnetosuture track`, and the camera frames of picture files, folders and bags."""

from __future__ import annotations

import argparse
import itertools
import math
import re
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from magnetosuture_thread import InvalidInputError, Scene, read_scene
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.reading import stamp_of
from magnetosuture_thread.bags.recording import Recording
from magnetosuture_thread.bags.storage import COMPRESSED_SUFFIXES, pluralize
from magnetosuture_thread.commands import command
from magnetosuture_thread.evaluation.metrics import SensorSilence
from magnetosuture_thread.evaluation.recorded import read_image
from magnetosuture_thread.evaluation.workers import Log
from magnetosuture_thread.geometry.thread_observation import ThreadPiece
from magnetosuture_thread.rig.setups import read_vision_setup
from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.settings.files import MAX_FILE_BYTES, read_regular
from magnetosuture_thread.settings.interface import CAMERA, CAMERA_INFO, STORAGE_SUFFIXES, Channel
from magnetosuture_thread.vision.images import decode_image, upright
from magnetosuture_thread.vision.lens import Lens, lens_of, read_lens
from magnetosuture_thread.vision.overlay import OverlayWriter, draw_dish, draw_overlay, draw_refused, draw_region
from magnetosuture_thread.vision.refused import Refused, refused_needles
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import NO_NEEDLE, State, Track, VisionTracker, warm_up
from magnetosuture_thread.vision.video import VIDEOS, Video

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    option = parser.add_argument
    command.add_frames(parser)
    add_view(parser)
    needle = "the needle's length, known within 10 %%, and the width of its body [m] (default: the setup's)"
    option("--needle", type=command.number_argument(5e-5, 0.05), nargs=2, metavar=("LENGTH", "WIDTH"), help=needle)
    bright = "greatest brightness of the needle, as a share of the floor's (default: the setup's)"
    option("--needle-brightness", type=command.number_argument(0.1, 0.95), metavar="SHARE", help=bright)
    tip, pixel = parser.add_mutually_exclusive_group(), command.number_argument(0.0, 1e5)
    where = "a point near the needle's tip in the first frame that shows it, in the dish frame [m]"
    tip.add_argument("--tip", type=command.number_argument(-0.25, 0.25), nargs=2, metavar=("X", "Y"), help=where)
    tip.add_argument("--tip-px", type=pixel, nargs=2, metavar=("U", "V"), help="the same in the frame [px]")
    option("--json", type=command.output_file, metavar="FILE", help="write what was found to a file")
    overlay = "draw it over the frames: a video (.mp4, .avi), or a folder of PNG"
    option("--overlay", type=Path, metavar="PATH", help=overlay)


def add_view(parser: argparse.ArgumentParser) -> None:
    """Add the setup, and what of its dish and view is chosen in place of it."""
    option = parser.add_argument
    setup = "a setup's name or YAML file (default: %(default)s)"
    option("--setup", default="petri_35mm_polyamide", metavar="NAME", help=setup)
    scene = parser.add_mutually_exclusive_group()
    scene.add_argument("--scene", default="", metavar="NAME", help="a scene's name or file (default: the setup's)")
    diameter = "inner diameter of a dish with nothing in it, in place of a scene [m]"
    scene.add_argument("--dish-diameter", type=command.number_argument(0.005, 0.5), metavar="D", help=diameter)
    scale = "the scale (default: the setup's, or from the dish's diameter)"
    option("--metres-per-pixel", type=command.number_argument(1e-7, 1e-2), metavar="S", help=scale)
    centre = "the dish's centre [px] (default: the setup's, or found)"
    option("--centre", type=command.number_argument(0.0, 1e5), nargs=2, metavar=("U", "V"), help=centre)
    command.add_dish(parser)


def chosen_view(options: argparse.Namespace) -> tuple[VisionTrackerSettings, Scene]:
    """Return the settings and the scene that the options choose: those of `add_view`, and of the needle if any."""
    given = read_scene(options.scene) if options.scene else None
    if options.dish_diameter is not None:
        given = Scene.create(dish_diameter=options.dish_diameter)
    settings, scene = read_vision_setup(options.setup, given)
    length, width = vars(options).get("needle") or (None, None)
    values = {
        "metres_per_pixel": options.metres_per_pixel,
        "dish_centre_px": tuple(options.centre or ()),
        "region_px": tuple(options.region or ()),
        "rim": options.rim,
        "needle_length": length,
        "needle_width": width,
        "max_needle_brightness": vars(options).get("needle_brightness"),
    }
    chosen: dict[str, Any] = {name: value for name, value in values.items() if value}
    return replace(settings, **chosen), scene


def run_track(options: argparse.Namespace, terminal: command.Terminal) -> int:
    """Find needle and thread in camera frames, without a graph.

    FRAMES are pictures, a folder of them, a video, or a bag. Pictures that are named are searched one by one; the
    frames of a bag, a video, or a folder are followed over time, as the node vision_tracker does. Those of a folder
    are searched one by one too where sizes differ, or where, without --rate, a needle is mostly farther than its
    length from where it was one picture before.

    --json writes a list with an entry for each frame: file (for a bag or video, with the stamp), status (tracked,
    lost or searching) and its reason, warning (of the dish's scale and tilt, and of the lens), axis_m (both ends of
    the needle, also where nothing tells which is the tip; --tip does, from then on), dish_centre_px, metres_per_pixel
    and by which share it may be off, scale_doubt, tail_m, tip_m and heading_rad (the tangent at the tail),
    curvature_per_m (positive to the left), thread_m from the tail on, all in the dish frame, needle_length_m as
    measured over the first frames that follow one another, pieces of the thread (points_m, deviation_m across, why
    their ends are ends, arc_length_m of the first point at least and at most) and whether they are complete,
    confidence from 0 to 1, refused (what else is dark and slender where no needle is found, and which settings would
    admit it), stamp_s, and time_s, the processor time to search the frame, on one core, without reading and decoding
    it; all is compiled before. What has no value is null.

    Where no frame shows a needle the command fails.
    """
    settings, scene = chosen_view(options)
    source = open_frames(options, terminal.log)
    warm_up()
    if source.is_sequence and source.names:
        how = f"is read as a video of {source.rate():g} frames/s (--rate); name pictures to search them one by one"
        first = [options.frames[0] / name for name in source.names[:10]]
        if options.rate is None and not _is_film(VisionTracker(settings, scene), first, settings.needle_length):
            how, source.is_sequence = "is no video, as its needle jumps: each is searched by itself", False
        terminal.log(f"{options.frames[0]} {how}")
    tracker = VisionTracker(settings, scene)
    pointed = options.tip if options.tip_px is None else None  # in the dish frame, once that is known
    if pointed is not None:
        tracker.point_at_tip(np.array(pointed))
    rows, refused = list[dict[str, Any]](), list[Refused]()
    # Two files may differ in their folder or their ending alone; their overlays must not overwrite each other.
    files = numbered([Path(name).stem for name in source.names], "{}_{}")
    with (
        terminal.progress("track") as advance,
        nullcontext() if options.overlay is None else OverlayWriter(options.overlay, source.rate()) as writer,
    ):
        for index, frame in enumerate(source.frames):
            tracker.set_lens(frame.lens)
            if pointed is None and options.tip_px and frame.image is not None:
                seen = _look(tracker, frame, False)
                if seen.view is not None:
                    pointed = seen.place_of(np.array(options.tip_px))
                    tracker.point_at_tip(pointed)
            began = time.thread_time()
            track = _look(tracker, frame, source.is_sequence)
            took = time.thread_time() - began
            others = _refused(frame, track, scene, settings)
            refused += others
            unverified = {"unverified": source.unverified} if source.unverified else {}
            rows.append({**_row(frame, track, took), "refused": [each.reason for each in others], **unverified})
            if writer is not None and frame.image is not None:
                drawn = draw_overlay(frame.undistorted(), track, settings.needle_length, frame.name)
                if track.view is not None:
                    draw_dish(drawn, track.view.centre_px, scene.dish.radius / track.view.metres_per_pixel)
                draw_region(drawn, settings.region_px)
                draw_refused(drawn, others)
                writer.write(files[index] if files else f"frame_{index:06d}", drawn)
            advance((index + 1) / max(source.count, 1))
    source.log_refused(terminal.log)
    terminal.print(_table(rows))
    for warning, count in Counter(row["warning"] for row in rows if row["warning"]).most_common():
        terminal.log(f"{warning}: {pluralize(count, 'frame')}")
    for named, count in Counter(tuple(each.admitted_by) for each in refused).most_common(3):
        example = next(each for each in refused if tuple(each.admitted_by) == named)
        terminal.log(f"{pluralize(count, 'dark thing')} as this one: {example.reason}")
    if rows:
        counts = ", ".join(f"{n} {status}" for status, n in Counter(row["status"] for row in rows).most_common())
        median, high = np.percentile([1e3 * row["time_s"] for row in rows], (50, 95))
        terminal.log(f"{counts}; {median:.1f} ms a frame in the median, {high:.1f} ms in the 95th")
    command.write_json(options.json, rows)
    return command.DONE if any(row["axis_m"] for row in rows) else command.FAILED


@dataclass(frozen=True)
class FrameFile:
    """One frame.

    Attributes:
        name: the file's, with its folders where two have the same; or topic or video and stamp.
        image: None if it is broken.
        problem: why it is; else empty.
        stamp: when it was taken [s], of a video or folder after its first frame; None where nothing tells.
        lens: the given one, or that of the last camera_info before the frame; None if there is none that can be used.
    """

    name: str
    image: np.ndarray | None
    problem: str = ""
    stamp: float | None = None
    lens: Lens | None = None

    @property
    def lens_problem(self) -> InvalidInputError | None:
        """Return why the lens is not that of the image; None if it is, or there is none."""
        return None if self.lens is None or self.image is None else self.lens.problem_with(self.image.shape)

    def undistorted(self) -> np.ndarray:
        """Return the image, which must be there, without the lens's distortion where the lens can be used."""
        assert self.image is not None
        return self.image if self.lens is None or self.lens_problem else self.lens.undistorted(self.image)


@dataclass
class FrameSource:
    """The frames at some paths: pictures in their order, those of a folder by name, of a video or bag by time.

    Attributes:
        frames: to go through once.
        count: number of frames, as far as it is known before.
        rate: returns the frame rate [1/s].
        is_sequence: whether the frames follow one another in time: those of a bag, a video, or one folder of pictures
            of one size.
        names: of picture files; empty for a bag or video.
        unverified: why any frame of a bag may be wrong; empty if nothing speaks against them.
        refused: why frames that were gone through could not be taken, with their number.
        remarks: on the frames that were taken.
    """

    frames: Iterator[FrameFile] = field(default_factory=lambda: iter(()))
    count: int = 0
    rate: Callable[[], float] = lambda: 30.0
    is_sequence: bool = True
    names: Sequence[str] = ()
    unverified: str = ""
    refused: Counter[str] = field(default_factory=Counter)
    remarks: set[str] = field(default_factory=set)

    def log_refused(self, log: Log) -> None:
        """Log why frames could not be taken, once all have been gone through."""
        for reason, count in self.refused.items():
            log(f"{reason}: {pluralize(count, 'frame')} left out")
        for remark in self.remarks:
            log(remark)

    def read(self, name: str, read: Callable[[], np.ndarray], stamp: float | None, lens: Lens | None) -> FrameFile:
        """Return a frame, or why it cannot be read."""
        try:
            return FrameFile(name, read(), "", stamp, lens)
        except OSError as error:
            problem = f"cannot be read: {error.strerror}"
        except (BagError, InvalidInputError) as error:
            problem = str(error)
        self.refused[problem] += 1
        return FrameFile(name, None, problem, stamp, lens)


def open_frames(options: argparse.Namespace, log: Log) -> FrameSource:
    """Open the frames that the options of `command.add_frames` name.

    Args:
        options: of the command.
        log: called with a line for a person on what of a bag is damaged or not checked.

    Raises:
        BagError: a path does not exist, a folder holds no pictures, or a bag or video cannot be used.
        InvalidInputError: the lens cannot be used.
    """
    lens = read_lens(options.camera_info) if options.camera_info is not None else None
    paths: list[Path] = options.frames
    path, files = paths[0], [file for path in paths for file in _files_at(path)]
    is_bag = any(file.name.endswith((*STORAGE_SUFFIXES, *COMPRESSED_SUFFIXES)) for file in (*paths, *files))
    is_video = any(path.suffix.lower() in VIDEOS and not path.is_dir() for path in paths)
    is_folder = not is_bag and len(paths) == 1 and len(files) > 1 and _of_one_size(files)
    if (is_bag or is_video) and len(paths) > 1:
        raise BagError(path, f"is beside a {'bag' if is_bag else 'video'}; expected that alone, without other frames")
    if options.remap and not is_bag:
        raise BagError(path, "is no bag, so there is no topic in it to remap")
    if options.rate is not None and not (is_folder or is_video):
        raise BagError(path, "is no video and no folder of frames of one size, so --rate has no meaning for it")
    source = FrameSource(is_sequence=is_bag or is_video or is_folder)
    if is_bag:
        bag = Bag(path, remap=dict(options.remap))
        recording = Recording(bag)
        doubt = f"is unverified: {bag.salvaged_without_checksum}" if bag.salvaged_without_checksum else ""
        for line in (str(bag.damage or ""), doubt or bag.has_no_checksum, *recording.remarks):
            if line:
                log(f"{recording.path} {line}")
        camera = recording.camera
        if camera is None:
            topics, present = " or ".join(c.recorded for c in CAMERA.values()), ", ".join(sorted(bag.counts))
            raise BagError(path, f"holds no camera frames; expected some on {topics}; its topics: {present}")
        if recording.rectified and lens is not None:
            raise BagError(path, f"has rectified frames on {recording.rectified}; omit --camera-info")
        source.count, source.unverified = recording.counts[camera.recorded], recording.salvaged_without_checksum
        source.rate = partial(_median_rate, recording, camera)
        source.frames = _recorded(source, recording, camera, lens)
    elif is_video:
        video = Video(path, options.rate)
        source.count, source.rate = video.count, lambda: video.rate
        source.frames = _filmed(source, path, video, lens)
    else:
        rate, names = options.rate or 30.0, [file.name for file in files]
        source.count, source.rate = len(files), lambda: rate
        source.names = names if len(set(names)) == len(names) else list(map(str, files))
        source.frames = (
            source.read(name, partial(_read_picture, file), index / rate if source.is_sequence else None, lens)
            for index, (name, file) in enumerate(zip(source.names, files, strict=True))
        )
    return source


def _filmed(source: FrameSource, path: Path, video: Video, lens: Lens | None) -> Iterator[FrameFile]:
    count = 0
    for stamp, image in video.frames():
        count += 1
        yield FrameFile(f"{path.name} {stamp:.6f}", image, "", stamp, lens)
    if count < source.count:
        source.refused[f"{path} is damaged"] += source.count - count


def _recorded(source: FrameSource, recording: Recording, camera: Channel, override: Lens | None) -> Iterator[FrameFile]:
    lens: Lens | None = None
    channels = [channel for channel in (CAMERA_INFO, camera) if recording.counts.get(channel.recorded)]
    recording.refused.clear()  # counted by the rate too
    for record in recording.records(channels):
        if record.topic == CAMERA_INFO.recorded:
            try:
                lens = lens_of(record.decode())
            except (BagError, InvalidInputError) as error:
                lens = None
                source.remarks.add(f"{error}: frames are taken as they are")
            continue
        stamp = stamp_of(record) * 1e-9
        yield source.read(f"{record.topic} {stamp:.6f}", partial(read_image, record), stamp, override or lens)
    source.refused.update(recording.refused)


def _median_rate(recording: Recording, camera: Channel) -> float:
    """Return the frame rate by the median interval of a bag's first frames' stamps [1/s]."""
    intervals = 1e-9 * np.diff([stamp_of(record) for record in itertools.islice(recording.records([camera]), 300)])
    if not np.any(intervals > 0.0):
        return 30.0
    # To 0.01 frames/s: the time base of MPEG-4 has no room for more. Video players show 0.1 to 240.
    return min(240.0, max(0.1, round(1.0 / float(np.median(intervals[intervals > 0.0])), 2)))


def _natural(path: Path) -> list[tuple[int, str]]:
    """Return a key that sorts frame_2 before frame_10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name)]


def _of_one_size(files: list[Path]) -> bool:
    """Return whether pictures may be of one camera, by the first of them."""
    sizes = set()
    for file in files[:10]:
        with suppress(OSError, BagError, InvalidInputError):  # reported when it is its turn
            sizes.add(_read_picture(file).shape[:2])
    return len(sizes) < 2


def _is_film(tracker: VisionTracker, pictures: list[Path], length: float) -> bool:
    """Return whether a needle of a length [m] moves by less than that between most of the pictures that show it."""
    places = list[np.ndarray | None]()
    for file in pictures:
        with suppress(OSError, BagError, InvalidInputError):  # reported when it is its turn
            track = tracker.look(_read_picture(file))
            places.append(None if track.reason else np.array([track.tail, track.tip]))
    pairs = [(a, b) for a, b in itertools.pairwise(places) if a is not None and b is not None]
    ways = [np.linalg.norm(b - a, axis=1).max() for a, b in pairs]
    return not ways or float(np.median(ways)) < length


def _read_picture(file: Path) -> np.ndarray:
    data = read_regular(file, MAX_FILE_BYTES)
    return upright(decode_image(data), data)


def _files_at(path: Path) -> list[Path]:
    """Return a file itself, or what may be frames in a folder: pictures, or the files of a bag."""
    try:
        path.stat()
        if not path.is_dir():
            return [path]
        inside = sorted(path.iterdir(), key=_natural)
    except FileNotFoundError:
        raise BagError(path, "does not exist; expected pictures, a folder of them, a video, or a bag") from None
    except (OSError, ValueError) as error:
        raise BagError(path, f"cannot be read: {error}") from None
    endings = (*PICTURES, *STORAGE_SUFFIXES, *COMPRESSED_SUFFIXES)
    files = [file for file in inside if file.name.lower().endswith(endings) and file.is_file()]
    if not files:
        raise BagError(path, f"holds no pictures; expected files that end in {', '.join(PICTURES)}, or a bag")
    return files


def numbered(names: Sequence[str], form: str) -> list[str]:
    """Return names each of which is there once: where one comes again, it gets a number.

    Args:
        names: that may come again.
        form: of a name with its number, 2 and up, for example `{}_{}`.
    """
    taken = dict[str, None]()
    for name in names:
        others = (form.format(name, number) for number in itertools.count(2))
        free = name if name not in taken else next(o for o in others if o not in taken and o not in names)
        taken[free] = None
    return list(taken)


def _look(tracker: VisionTracker, frame: FrameFile, in_sequence: bool) -> Track:
    """Return what a frame shows."""
    if frame.image is None:
        return Track(State.LOST, frame.problem)
    try:
        if in_sequence and frame.stamp is not None:
            return tracker.track(frame.image, frame.stamp)
        return tracker.look(frame.image)
    except InvalidInputError as error:
        return Track(State.LOST, str(error))


def _refused(frame: FrameFile, track: Track, scene: Scene, settings: VisionTrackerSettings) -> list[Refused]:
    """Return what was not taken for the needle in a frame in which there is none."""
    if frame.image is None or track.view is None or not track.reason.startswith(NO_NEEDLE):
        return []
    return refused_needles(frame.undistorted(), track, scene, settings)


def _row(frame: FrameFile, track: Track, duration: float) -> dict[str, Any]:
    """Return what is written of a frame, in SI units; null for what has no value.

    Args:
        frame: that was looked at.
        track: what was seen.
        duration: processor time that looking took, on one core, decoding not included; other work on the
            machine does not show in it [s].
    """
    names = ("tail_m", "heading_rad", "tip_m", "curvature_per_m", "thread_m", "pieces")
    pose: dict[str, Any] = dict.fromkeys(names)
    if not track.reason:
        angle, pieces = np.arctan2(track.heading[1], track.heading[0]), map(_piece, track.observation.pieces)
        values = (track.tail, angle, track.tip, track.curvature, track.centreline)
        pose = dict(zip(names, (*map(_finite, values), list(pieces)), strict=True))
    return {
        "file": frame.name,
        "status": track.state.value,
        "reason": track.reason or None,
        "warning": track.warning or None,
        "axis_m": track.axis.tolist() if len(track.axis) else None,
        "dish_centre_px": None if track.view is None else list(track.view.centre_px),
        "metres_per_pixel": None if track.view is None else track.view.metres_per_pixel,
        "scale_doubt": None if track.view is None else track.scale_error,
        **pose,
        "needle_length_m": _finite(track.needle_length),
        "complete": track.observation.complete,
        "confidence": _finite(track.confidence),
        "time_s": duration,
        "stamp_s": frame.stamp,
    }


def _finite(values: Any) -> Any:
    """Return a number, or an array as lists; None where any of it is not finite, or there is none."""
    array = np.asarray(np.nan if values is None else values, dtype=float)
    return array.tolist() if np.isfinite(array).all() else None


def _piece(piece: ThreadPiece) -> dict[str, Any]:
    """Return what is written of a piece of the thread, in SI units; null where nothing tells."""
    return {
        "points_m": piece.points.tolist(),
        "deviation_m": piece.deviation.tolist(),
        "first_end": piece.first_end.name.lower(),
        "last_end": piece.last_end.name.lower(),
        "arc_length_m": [_finite(value) for value in piece.arc_length],
        "direction_known": piece.direction_known,
        "confidence": piece.confidence,
    }


def _table(rows: Sequence[dict[str, Any]]) -> Table:
    """Return a row for each of the first frames, as `_row` gives them."""
    began, lines = rows[0]["stamp_s"] if rows else None, []
    for row in rows[:20]:
        name = row["file"] if began is None else f"at {row['stamp_s'] - began:.3f} s"
        cells = [""] * 4
        if row["tail_m"] and row["heading_rad"] is not None:
            steps = np.diff(np.reshape(row["thread_m"] or [], (-1, 2)), axis=0)
            x, y, heading = 1e3 * row["tail_m"][0], 1e3 * row["tail_m"][1], math.degrees(row["heading_rad"])
            length = f"{1e3 * np.hypot(*steps.T).sum():.1f}" if len(steps) else ""
            cells = [f"{x:.2f}, {y:.2f}", f"{heading:.1f}", length, f"{row['confidence']:.2f}"]
        status = ": ".join(filter(None, (row["status"], row["reason"])))
        lines.append((name, status, *cells, f"{1e3 * row['time_s']:.1f}"))
    if len(rows) > 20:
        lines.append((f"and {len(rows) - 20} more", "", "", "", "", "", ""))
    caption = "tail and thread's length in mm, heading in degrees, confidence, processor time"
    if began is not None:
        times = np.array([row["stamp_s"] - began for row in rows])
        caption = "; ".join(filter(None, (caption, str(SensorSilence.of(times, 0.0, float(times.max()))))))
    columns = ("frame", "status", "tail", "heading", "thread", "sure", "ms")
    return command.make_table(f"{len(rows)} frames", columns, lines, caption, left=2)
