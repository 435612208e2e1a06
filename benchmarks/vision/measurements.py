"""Frames of each class, given to the tracker one by one, and how far what it says is from the ground truth."""

from __future__ import annotations

import math
import re
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
from magnetosuture_thread.geometry.scene import Dish, Scene
from magnetosuture_thread.geometry.thread_observation import PieceEnd, ThreadObservation, ThreadPiece
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import Track, VisionTracker, published_centreline, warm_up

WRONG_PX, WRONG_ANGLE = 2.0, math.radians(5.0)  # of the scale worked at: beyond, a pose is wrong
REVERSED = 0.5 * math.pi
UNKNOWN_ANGLE = 1.0  # rad; a standard deviation beyond which the heading is called unknown
HONEST = 14.16  # squared Mahalanobis distance of three numbers that 0.27 % of honest poses exceed
WRONG_LINE_PX = 1.5  # beyond, or beyond half of the thread's width, a point of a centreline is wrong
WRONG_END = 0.6e-3  # m; from the thread's end, beyond which an end claimed free is wrong


@dataclass(frozen=True)
class Result:
    """What the tracker said of one frame.

    Attributes:
        visible: length of the thread that can be seen [m].
        seconds: of CPU.
        reason: why there is no pose.
        found: whether there is a pose.
        unknown: whether its heading is unknown by its own covariance.
        tail_px: how far the tail is off, at the scale worked at.
        angle: how far the heading is off, from 0 to pi [rad].
        honest: whether both are within the covariance; see `HONEST`.
        covered: length of the visible thread that the published centreline follows [m].
        line: length of that centreline [m].
        wrong: of it, where no thread is [m].
        pieces: length of the visible thread that lies on a piece [m].
        length: of all pieces [m].
        wrong_pieces: of it, where no thread is [m].
        misplaced: number of pieces whose interval or direction is wrong.
        complete: whether all of the thread is claimed to be seen.
        incomplete: whether it is not, though claimed.
        free: number of ends that are claimed to be the thread's.
        not_free: of these, beyond `WRONG_END` from it.
        normalised: sum of the squares of points' distances from the thread over their standard deviation.
        points: number of these points, which lie on the thread.
    """

    visible: float
    seconds: float
    reason: str = ""
    found: bool = False
    unknown: bool = False
    tail_px: float = 0.0
    angle: float = 0.0
    honest: bool = True
    covered: float = 0.0
    line: float = 0.0
    wrong: float = 0.0
    pieces: float = 0.0
    length: float = 0.0
    wrong_pieces: float = 0.0
    misplaced: int = 0
    complete: bool = False
    incomplete: bool = False
    free: int = 0
    not_free: int = 0
    normalised: float = 0.0
    points: int = 0

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
        pieces: share of the visible thread that lies on pieces, over all frames.
        wrong_pieces: share of the pieces' length where no thread is; None without pieces.
        misplaced: number of pieces whose place along the thread is said to be known and is wrong.
        complete: frames of which is said that they show all of the thread.
        incomplete: of these, that don't.
        free: ends of which is said that they are the thread's.
        not_free: of these, that are not.
        normalised: root mean square of points' distances from the thread over their standard deviation; 1 is honest.
        median_ms: CPU time of a frame.
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
    pieces: float
    wrong_pieces: float | None
    misplaced: int
    complete: int
    incomplete: int
    free: int
    not_free: int
    normalised: float | None
    median_ms: float
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
        needle_length=case.needle.length * (1.0 + case.length_error),
        needle_width=case.needle.width,
        thread_length=float(lengths[-1]),
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
    seen, truth = case.visible_thread(), dense(case.thread)
    visible = float(arc_lengths(case.thread)[-1]) / len(truth) * len(seen)
    if not len(track.tail):
        return Result(visible, seconds, track.reason)
    off = np.append(track.tail - case.needle.tail, 0.0)
    turned = math.atan2(track.heading[1], track.heading[0]) - case.needle.heading
    off[2] = (turned + math.pi) % (2.0 * math.pi) - math.pi
    bound = max(WRONG_LINE_PX * case.working_scale, 0.5 * case.thread_px * case.view.metres_per_pixel)
    line = published_centreline(track)
    covered = wrong = length = 0.0
    if len(line) > 1:
        own = dense(line)
        length = float(arc_lengths(line)[-1])
        wrong = length * _share(own, truth, bound, beyond=True)
        covered = visible * _share(seen, own, bound)
    return Result(
        visible,
        seconds,
        found=True,
        unknown=float(track.covariance[2, 2]) > UNKNOWN_ANGLE**2,
        tail_px=float(np.hypot(off[0], off[1])) / case.working_scale,
        angle=abs(float(off[2])),
        honest=float(off @ np.linalg.solve(track.covariance, off)) < HONEST,
        covered=covered,
        line=length,
        wrong=wrong,
        **compare_pieces(case, track.observation, bound, seen, visible),
    )


def compare_pieces(
    case: Case, observation: ThreadObservation, bound: float, seen: Points, visible: float
) -> dict[str, Any]:
    """Compare pieces of the thread with the ground truth; return the part of a `Result` on them.

    Args:
        case: what the frame shows.
        observation: what is said of it.
        bound: beyond which a point is wrong [m].
        seen: points along the visible thread, shape (m, 2) [m].
        visible: its length [m].
    """
    if not observation.pieces:
        return {}
    truth = dense(case.thread)
    at, tree = arc_lengths(truth), KDTree(truth)
    lines = [dense(piece.points) for piece in observation.pieces]
    found: dict[str, Any] = {
        "complete": observation.complete,
        "pieces": visible * _share(seen, np.vstack(lines), bound),
    }
    sums: Any = Counter()  # of numbers that are not whole
    for piece, line in zip(observation.pieces, lines, strict=True):
        off, nearest = (np.asarray(values) for values in tree.query(piece.points))
        ends = ((piece.first_end, piece.points[0]), (piece.last_end, piece.points[-1]))
        free = [float(np.hypot(*(point - truth[-1]))) for end, point in ends if end is PieceEnd.FREE]
        sums.update(
            length=piece.length,
            wrong_pieces=piece.length * _share(line, truth, bound, beyond=True),
            normalised=float(np.square(off / piece.deviation)[off < bound].sum()),
            points=int((off < bound).sum()),
            misplaced=int(_is_misplaced(piece, at[nearest])),
            free=len(free),
            not_free=sum(apart > WRONG_END for apart in free),
        )
    last = float(np.hypot(*(observation.pieces[0].points[-1] - truth[-1])))
    shown = at[-1] * _share(truth, lines[0], max(bound, WRONG_END))
    found["incomplete"] = bool(observation.complete and (last > WRONG_END or shown < at[-1] - WRONG_END))
    return {**found, **sums}


def _is_misplaced(piece: ThreadPiece, truth: np.ndarray) -> bool:
    """Say whether a piece lies elsewhere along the thread than is said; `truth` is the arc length at its points [m]."""
    along = arc_lengths(piece.points)
    # Medians: where the thread crosses itself, the nearest point of it may be of the other strand.
    grows = float(np.median(np.diff(truth))) > 0.0
    first = float(np.median(truth - along)) if grows else float(np.median(truth + along))
    if piece.direction_known and not grows and math.isfinite(piece.arc_length[0]):
        return True
    if not math.isfinite(piece.arc_length[0]):
        return False
    if not piece.direction_known and not grows:
        first = float(np.median(truth + along)) - float(along[-1])
    return not piece.arc_length[0] - WRONG_END <= first <= piece.arc_length[1] + WRONG_END


def _share(points: Points, line: Points, bound: float, *, beyond: bool = False) -> float:
    """Return which share of points lies within a bound of a line of points close together, or beyond it."""
    if not len(points):
        return 0.0
    near = np.asarray(KDTree(line).query(points)[0]) < bound
    return float(np.mean(~near if beyond else near))


def row_of(name: str, results: Iterable[Result]) -> Row:
    """Sum up the results of a class."""
    every = list(results)
    found = [each for each in every if each.found]
    right = [each for each in found if not each.is_wrong and not each.unknown]
    total: Counter[str] = Counter()
    for each in every:
        total.update({name: value for name, value in vars(each).items() if name != "reason"})
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
        covered=total["covered"] / total["visible"] if total["visible"] else 0.0,
        covered_90=float(np.mean([each.covered >= 0.9 * each.visible for each in every])),
        wrong_line=total["wrong"] / total["line"] if total["line"] else None,
        pieces=total["pieces"] / total["visible"] if total["visible"] else 0.0,
        wrong_pieces=total["wrong_pieces"] / total["length"] if total["length"] else None,
        **{name: total[name] for name in ("misplaced", "complete", "incomplete", "free", "not_free")},
        normalised=math.sqrt(total["normalised"] / total["points"]) if total["points"] else None,
        median_ms=1e3 * float(np.median([each.seconds for each in every])),
        reasons=dict(Counter(re.sub(r"\d", "#", each.reason) for each in every if not each.found).most_common()),
    )


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
