"""The job `magnetosuture track`: needle and thread in camera frames, without a graph."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.jobs.frames import FrameFile, FrameSource, numbered
from magnetosuture_thread.scene import Scene
from magnetosuture_thread.vision.frame import State, Track, no_pose
from magnetosuture_thread.vision.overlay import OverlayWriter, draw_dish, draw_overlay
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import VisionTracker, warm_up


@dataclass(frozen=True)
class TrackedFrame:
    """What one frame showed.

    Attributes:
        name: the file's name, with its folders where another file has the same; or topic and stamp.
        track: what was seen.
        duration: processor time that looking took, on one core, decoding not included; other work on the
            machine does not show in it [s].
        stamp: when the frame was taken [s]; None where nothing tells.
    """

    name: str
    track: Track
    duration: float
    stamp: float | None

    def to_json(self) -> dict[str, Any]:
        """Return what is written of it, in SI units; null for what has no value."""
        track, seen = self.track, not self.track.reason
        thread = [_numbers(point) for point in track.centreline] if seen else None
        return {
            "file": self.name,
            "status": track.state.value,
            "reason": track.reason or None,
            "tail_m": _numbers(track.tail) if seen else None,
            "heading_rad": _number(math.atan2(track.heading[1], track.heading[0])) if seen else None,
            "tip_m": _numbers(track.tip) if seen else None,
            "curvature_per_m": _number(track.curvature) if seen else None,
            "thread_m": None if thread is None or None in thread else thread,
            "confidence": _number(track.confidence),
            "time_s": self.duration,
            "stamp_s": self.stamp,
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
    files = numbered([Path(name.replace("/", "_")).stem for name in source.names], "{}_{}")
    with OverlayWriter(overlay, source.rate()) if overlay is not None else nullcontext() as writer:
        for index, frame in enumerate(source):
            result = _look(tracker, frame, source.is_sequence)
            results.append(result)
            if writer is not None and frame.image is not None:
                name = f"frame_{index:06d}" if source.is_sequence else files[index]
                writer.write(name, _drawn(frame.image, result, settings, scene))
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
