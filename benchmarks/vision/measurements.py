"""Tracks rendered frames, each for itself, and holds poses and centrelines against the ground truth."""

from __future__ import annotations

import math
import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from benchmarks.vision.cases import CLASSES, DISH, Frame, render
from magnetosuture_thread.geometry.polyline import Points, arc_lengths, points_at
from magnetosuture_thread.scene import Dish, Scene
from magnetosuture_thread.vision.look import Track
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import VisionTracker
from magnetosuture_thread.vision.warm_up import warm_up

MAX_OFF_PX, MAX_TURN = 2.0, math.radians(5.0)  # of a pose that is right
UNKNOWN_TURN = 0.5 * math.pi  # standard deviation from which on a heading is published as unknown
NEAR_PX = 1.5  # of the true centreline, or half the thread's width where that is more
SPACING_PX = 0.5  # of the points that are compared


@dataclass(frozen=True)
class FrameResult:
    """What became of a frame.

    Attributes:
        found: whether a pose was found, with its heading.
        unknown: whether a pose was found whose heading is said to be unknown.
        wrong: whether tail or heading are off by more than `MAX_OFF_PX` or `MAX_TURN`.
        is_reversed: whether the heading is off by more than a quarter of a turn.
        off_px: of the tail; NaN where none was found.
        turn: of the heading [rad].
        covered: share of the visible thread that the centreline follows.
        astray: share of the centreline that is not on the thread; NaN without one.
        seconds: of processor time.
        reason: why no pose was found.
    """

    found: bool
    unknown: bool
    wrong: bool
    is_reversed: bool
    off_px: float
    turn: float
    covered: float
    astray: float
    seconds: float
    reason: str


def random_of(name: str, seed: int, index: int) -> np.random.Generator:
    """Return the random numbers of one frame, whichever others are rendered."""
    return np.random.default_rng([zlib.crc32(name.encode()), seed, index])


def measure(frame: Frame) -> FrameResult:
    """Track a frame by a new tracker and compare."""
    settings = VisionTrackerSettings(needle_length=frame.needle_length, needle_width=frame.needle_width)
    tracker = VisionTracker(settings, Scene(dish=Dish(diameter=DISH)))
    began = time.thread_time()
    seen = tracker.look(frame.image)
    seconds = time.thread_time() - began
    if seen.reason:
        return FrameResult(False, False, False, False, math.nan, math.nan, 0.0, math.nan, seconds, seen.reason)
    turned = math.atan2(seen.heading[1], seen.heading[0]) - frame.heading
    turn = abs((turned + math.pi) % (2.0 * math.pi) - math.pi)
    off = float(np.hypot(*(seen.tail - frame.tail))) / frame.scale
    unknown = bool(seen.covariance[2, 2] >= UNKNOWN_TURN**2)
    wrong = not unknown and (off > MAX_OFF_PX or turn > MAX_TURN)
    is_reversed = not unknown and turn > 0.5 * math.pi
    covered, astray = _centreline(frame, seen)
    return FrameResult(not unknown, unknown, wrong, is_reversed, off, turn, covered, astray, seconds, "")


def _centreline(frame: Frame, seen: Track) -> tuple[float, float]:
    """Return the share of the visible thread that is followed, and the share of the centreline that is astray."""
    near = max(NEAR_PX * frame.scale, 0.5 * frame.thread_width)
    truth, visible = _dense(frame.thread, frame.scale), frame.visible
    at = np.linspace(0.0, arc_lengths(frame.thread)[-1], len(truth))
    shown = visible[np.minimum(np.searchsorted(arc_lengths(frame.thread), at), len(visible) - 1)]
    if len(seen.centreline) < 2:
        return 0.0, math.nan
    own = _dense(np.asarray(seen.centreline), frame.scale)
    apart = np.hypot(own[:, None, 0] - truth[None, :, 0], own[:, None, 1] - truth[None, :, 1])
    covered = float((apart.min(axis=0) < near)[shown].mean()) if shown.any() else 1.0
    return covered, float((apart.min(axis=1) > near).mean())


def _dense(line: Points, scale: float) -> Points:
    total = float(arc_lengths(line)[-1])
    return np.asarray(points_at(line, np.linspace(0.0, total, max(2, int(total / (SPACING_PX * scale))))))


@dataclass(frozen=True)
class ClassResult:
    """The figures of a class.

    Attributes:
        name: of the class.
        frames: number of them.
        found: frames with a pose and its heading.
        unknown: frames with a pose whose heading is said to be unknown.
        wrong: frames with a wrong pose.
        is_reversed: frames with a reversed heading.
        tail_rms_px: over right poses; None without one.
        heading_rms_deg: the same.
        covered: mean share of the visible thread that is followed, over all frames.
        mostly: share of frames in which 90 % of it are.
        astray: mean share of the centreline that is not on the thread, over all centrelines; None without one.
        milliseconds: median processor time of a frame.
        reasons: why no pose was found, with the number of frames.
    """

    name: str
    frames: int
    found: int
    unknown: int
    wrong: int
    is_reversed: int
    tail_rms_px: float | None
    heading_rms_deg: float | None
    covered: float
    mostly: float
    astray: float | None
    milliseconds: float
    reasons: dict[str, int]

    def to_json(self) -> dict[str, Any]:
        """Return the figures."""
        return asdict(self)


def measure_classes(
    names: Sequence[str], count: int, seed: int, progress: Callable[[float], None] = lambda share: None
) -> list[ClassResult]:
    """Render and track `count` frames of each class."""
    warm_up()
    results = []
    for number, name in enumerate(names):
        found = []
        for index in range(count):
            found.append(measure(render(CLASSES[name], random_of(name, seed, index))))
            progress((number + (index + 1) / count) / len(names))
        results.append(_summary(name, found))
    return results


def _summary(name: str, found: list[FrameResult]) -> ClassResult:
    right = [each for each in found if each.found and not each.wrong]
    astray = [each.astray for each in found if not math.isnan(each.astray)]
    reasons: dict[str, int] = {}
    for each in found:
        if each.reason:
            reasons[each.reason] = reasons.get(each.reason, 0) + 1
    return ClassResult(
        name=name,
        frames=len(found),
        found=sum(each.found for each in found),
        unknown=sum(each.unknown for each in found),
        wrong=sum(each.wrong for each in found),
        is_reversed=sum(each.is_reversed for each in found),
        tail_rms_px=_rms([each.off_px for each in right]),
        heading_rms_deg=_rms([math.degrees(each.turn) for each in right]),
        covered=float(np.mean([each.covered for each in found])),
        mostly=float(np.mean([each.covered >= 0.9 for each in found])),
        astray=float(np.mean(astray)) if astray else None,
        milliseconds=1e3 * float(np.median([each.seconds for each in found])),
        reasons=reasons,
    )


def _rms(values: list[float]) -> float | None:
    return float(np.sqrt(np.mean(np.square(values)))) if values else None
