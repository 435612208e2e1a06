"""Frames of each class, given to the tracker one by one, and how far what it says is from the ground truth."""

from __future__ import annotations

import math
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from benchmarks.vision.cases import CLASSES
from benchmarks.vision.frames import DISH_RADIUS, Case, Image, dense, render
from magnetosuture_thread.geometry.polyline import Points, arc_lengths
from magnetosuture_thread.scene import Scene
from magnetosuture_thread.scene.scene import Dish
from magnetosuture_thread.vision.look import Track
from magnetosuture_thread.vision.session import published_centreline
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import VisionTracker
from magnetosuture_thread.vision.warm_up import warm_up

WRONG_PX, WRONG_ANGLE = 2.0, math.radians(5.0)  # of the scale worked at: beyond, a pose is wrong
REVERSED = 0.5 * math.pi
UNKNOWN_ANGLE = 1.0  # rad; a standard deviation beyond which the heading is called unknown
HONEST = 14.16  # squared Mahalanobis distance of three numbers that 0.27 % of honest poses exceed
WRONG_LINE_PX = 1.5  # beyond, or beyond half of the thread's width, a point of a centreline is wrong


@dataclass(frozen=True)
class Result:
    """What the tracker said of one frame.

    Attributes:
        found: whether there is a pose.
        unknown: whether its heading is unknown by its own covariance.
        tail_px: how far the tail is off, at the scale worked at.
        angle: how far the heading is off, from 0 to pi [rad].
        honest: whether both are within the covariance; see `HONEST`.
        visible: length of the thread that can be seen [m].
        covered: of it, followed [m].
        line: length of the published centreline [m].
        wrong: of it, where no thread is [m].
        seconds: of CPU.
        reason: why there is no pose.
    """

    found: bool
    unknown: bool
    tail_px: float
    angle: float
    honest: bool
    visible: float
    covered: float
    line: float
    wrong: float
    seconds: float
    reason: str

    @property
    def is_wrong(self) -> bool:
        """Whether the pose would mislead; one that says that its heading is unknown does not by it."""
        return self.found and not self.unknown and (self.tail_px > WRONG_PX or self.angle > WRONG_ANGLE)

    @property
    def is_reversed(self) -> bool:
        """Whether the pose points the other way and doesn't say that it may."""
        return self.found and not self.unknown and self.angle > REVERSED


@dataclass(frozen=True)
class Row:
    """A class of frames. Lengths of thread are summed over all frames before they are divided.

    Attributes:
        name: of the class.
        frames: number of them.
        found: with a pose.
        unknown: of these, with an unknown heading.
        wrong: of these, tail or heading off by more than `WRONG_PX`, `WRONG_ANGLE`.
        reversed: of these, by more than a right angle.
        dishonest: of those found, off by more than their covariance tells.
        tail_px: root mean square over those found and not wrong; None if there are none.
        angle_deg: the same of the heading.
        covered: share of the visible thread that was followed, over all frames.
        covered_90: share of the frames with 90 % of it followed.
        wrong_line: share of the published centreline where no thread is; None if none was published.
        median_ms: CPU time of a frame.
        max_ms: the longest.
        reasons: why there was no pose, with their counts.
    """

    name: str
    frames: int
    found: int
    unknown: int
    wrong: int
    reversed: int
    dishonest: int
    tail_px: float | None
    angle_deg: float | None
    covered: float
    covered_90: float
    wrong_line: float | None
    median_ms: float
    max_ms: float
    reasons: dict[str, int]


def frame_of(name: str, index: int, seed: int) -> tuple[Case, Image]:
    """Return the frame of a class with a number, the same whichever others are drawn."""
    own = [seed, zlib.crc32(name.encode()), index]
    case = CLASSES[name](np.random.default_rng(own))
    return case, render(case, int(np.random.default_rng([*own, 1]).integers(2**31)))


def measure(case: Case, image: Image) -> Result:
    """Give a frame to a tracker that has seen no other, and compare."""
    lengths = arc_lengths(case.thread)
    settings = VisionTrackerSettings(
        needle_length=case.needle.length, needle_width=case.needle.width, thread_length=float(lengths[-1])
    )
    tracker = VisionTracker(settings, Scene(dish=Dish(2.0 * DISH_RADIUS)))
    tracker.set_lens(case.lens)
    if case.lens is not None:
        tracker.look(image)  # makes the lens's maps, once for a camera
    began = time.process_time()
    track = tracker.look(image)
    return compare(case, track, time.process_time() - began)


def compare(case: Case, track: Track, seconds: float) -> Result:
    """Compare what was tracked with the ground truth."""
    seen = case.visible_thread()
    visible = _step(seen, case) * len(seen)
    if not len(track.tail):
        return Result(False, False, 0.0, 0.0, True, visible, 0.0, 0.0, 0.0, seconds, track.reason)
    off = np.append(track.tail - case.needle.tail, 0.0)
    turned = math.atan2(track.heading[1], track.heading[0]) - case.needle.heading
    off[2] = (turned + math.pi) % (2.0 * math.pi) - math.pi
    distance = float(off @ np.linalg.solve(track.covariance, off))
    bound = max(WRONG_LINE_PX * case.working_scale, 0.5 * case.thread_px * case.view.metres_per_pixel)
    line = published_centreline(track)
    covered = wrong = length = 0.0
    if len(line) > 1:
        own, truth = dense(line), dense(case.thread)
        length = float(arc_lengths(line)[-1])
        wrong = length * float((_nearest(own, truth) > bound).mean())
        if len(seen):
            covered = visible * float((_nearest(seen, own) < bound).mean())
    return Result(
        found=True,
        unknown=float(track.covariance[2, 2]) > UNKNOWN_ANGLE**2,
        tail_px=float(np.hypot(off[0], off[1])) / case.working_scale,
        angle=abs(float(off[2])),
        honest=distance < HONEST,
        visible=visible,
        covered=covered,
        line=length,
        wrong=wrong,
        seconds=seconds,
        reason="",
    )


def _step(seen: Points, case: Case) -> float:
    """Return the length that each point of the visible thread stands for [m]."""
    return float(arc_lengths(case.thread)[-1]) / len(dense(case.thread))


def _nearest(points: Points, line: Points) -> np.ndarray:
    """Return how far each of the points is from a line of points close together [m]."""
    return np.asarray(KDTree(line).query(points)[0])


def row_of(name: str, results: Iterable[Result]) -> Row:
    """Sum up the results of a class."""
    every = list(results)
    found = [each for each in every if each.found]
    right = [each for each in found if not each.is_wrong and not each.unknown]
    visible, line = sum(each.visible for each in every), sum(each.line for each in every)
    times = [1e3 * each.seconds for each in every]
    return Row(
        name=name,
        frames=len(every),
        found=len(found),
        unknown=sum(each.unknown for each in found),
        wrong=sum(each.is_wrong for each in found),
        reversed=sum(each.is_reversed for each in found),
        dishonest=sum(not each.honest for each in found),
        tail_px=_root_mean_square([each.tail_px for each in right]),
        angle_deg=_root_mean_square([math.degrees(each.angle) for each in right]),
        covered=sum(each.covered for each in every) / visible if visible else 0.0,
        covered_90=float(np.mean([each.covered >= 0.9 * each.visible for each in every])),
        wrong_line=sum(each.wrong for each in every) / line if line else None,
        median_ms=float(np.median(times)),
        max_ms=max(times),
        reasons=dict(Counter(_short(each.reason) for each in every if not each.found).most_common()),
    )


def _short(reason: str) -> str:
    """Return a reason without its numbers, so that it can be counted."""
    return "".join("#" if character.isdigit() else character for character in reason)


def _root_mean_square(values: list[float]) -> float | None:
    return float(np.sqrt(np.mean(np.square(values)))) if values else None


def measure_vision(
    names: list[str], count: int, seed: int, progress: Callable[[float], None] = lambda share: None
) -> tuple[list[Row], dict[str, Any]]:
    """Measure frames of each class; return the rows, and them as figures."""
    rows = []
    warm_up()  # and one thread
    for number, name in enumerate(names):
        results = []
        for index in range(count):
            case, image = frame_of(name, index, seed)
            results.append(measure(case, image))
            progress((number + (index + 1) / count) / len(names))
        rows.append(row_of(name, results))
    return rows, {"count": count, "seed": seed, "rows": [asdict(row) for row in rows]}
