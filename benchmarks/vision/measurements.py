"""Frames of each class, given to the tracker one by one, and how far what it says is from the ground truth."""

from __future__ import annotations

import math
import time
import zlib
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from benchmarks.vision.cases import CLASSES
from benchmarks.vision.frames import DISH_RADIUS, Case, Image, dense, render
from magnetosuture_thread.geometry.polyline import Points, arc_lengths
from magnetosuture_thread.geometry.scene import Dish, Scene
from magnetosuture_thread.geometry.thread_observation import PieceEnd, ThreadObservation, ThreadPiece
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import Track, VisionTracker, published_centreline

WRONG_PX, WRONG_ANGLE = 2.0, math.radians(5.0)  # of the scale worked at: beyond, a pose is wrong
REVERSED = 0.5 * math.pi
UNKNOWN_ANGLE = 1.0  # rad; a standard deviation beyond which the heading is called unknown
HONEST = 14.16  # squared Mahalanobis distance of three numbers that 0.27 % of honest poses exceed
WRONG_LINE_PX = 1.5  # beyond, or beyond half of the thread's width, a point of a centreline is wrong
WRONG_END = 0.6e-3  # m; from the thread's end, beyond which an end claimed free is wrong
COUNTS = ("found", "unknown", "misplaced", "complete", "incomplete", "free", "not_free")


@dataclass(frozen=True)
class Result:
    """What the tracker said of one frame.

    Attributes:
        visible: length of the thread that can be seen [m].
        seconds: of CPU.
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
        """Whether the pose misleads; one that says that its heading is unknown does not by it."""
        return self.found and not self.unknown and (self.tail_px > WRONG_PX or self.angle > WRONG_ANGLE)

    @property
    def is_reversed(self) -> bool:
        """Whether the pose points the other way and doesn't say that it may."""
        return self.found and not self.unknown and self.angle > REVERSED


def frame_of(name: str, index: int, seed: int) -> tuple[Case, Image]:
    """Return the frame of a class with a number, the same whichever others are drawn."""
    own = [seed, zlib.crc32(name.encode()), index]
    case = CLASSES[name](np.random.default_rng(own))
    return case, render(case, int(np.random.default_rng([*own, 1]).integers(2**31)))


def measure(case: Case, image: Image) -> Result:
    """Give a frame to a tracker that has seen no other, and compare."""
    settings = VisionTrackerSettings(
        needle_length=case.needle.length * (1.0 + case.length_error),
        needle_width=case.needle.width,
        thread_length=float(arc_lengths(case.thread)[-1]),
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
        return Result(visible, seconds)
    turned = math.atan2(track.heading[1], track.heading[0]) - case.needle.heading
    off = np.append(track.tail - case.needle.tail, (turned + math.pi) % (2.0 * math.pi) - math.pi)
    bound = max(WRONG_LINE_PX * case.working_scale, 0.5 * case.thread_px * case.view.metres_per_pixel)
    line, lengths = published_centreline(track), dict[str, Any]()
    if len(line) > 1:
        points, length = dense(line), float(arc_lengths(line)[-1])
        lengths = {"line": length, "wrong": length * (1.0 - _share(points, truth, bound))}
        lengths["covered"] = visible * _share(seen, points, bound)
    pieces = _compare_pieces(track.observation, truth, bound) if track.observation.pieces else {}
    if pieces:
        points = np.vstack([dense(piece.points) for piece in track.observation.pieces])
        pieces["pieces"] = visible * _share(seen, points, bound)
    return Result(
        visible,
        seconds,
        found=True,
        unknown=float(track.covariance[2, 2]) > UNKNOWN_ANGLE**2,
        tail_px=float(np.hypot(off[0], off[1])) / case.working_scale,
        angle=abs(float(off[2])),
        honest=float(off @ np.linalg.solve(track.covariance, off)) < HONEST,
        **lengths,
        **pieces,
    )


def _compare_pieces(observation: ThreadObservation, truth: Points, bound: float) -> dict[str, Any]:
    """Compare pieces of the thread with the ground truth; return the part of a `Result` on them.

    Args:
        observation: what is said of the thread.
        truth: points along all of it, shape (m, 2) [m].
        bound: beyond which a point is wrong [m].
    """
    at, tree, sums = arc_lengths(truth), KDTree(truth), Counter[str]()
    for piece in observation.pieces:
        off, nearest = (np.asarray(values) for values in tree.query(piece.points))
        ends = ((piece.first_end, piece.points[0]), (piece.last_end, piece.points[-1]))
        free = [float(np.hypot(*(point - truth[-1]))) for end, point in ends if end is PieceEnd.FREE]
        figures: Any = {  # some of them are no whole numbers
            "length": piece.length,
            "wrong_pieces": piece.length * (1.0 - _share(dense(piece.points), truth, bound)),
            "normalised": float(np.square(off / piece.deviation)[off < bound].sum()),
            "points": int((off < bound).sum()),
            "misplaced": int(_is_misplaced(piece, at[nearest])),
            "free": len(free),
            "not_free": sum(apart > WRONG_END for apart in free),
        }
        sums.update(figures)
    first = observation.pieces[0].points
    last = float(np.hypot(*(first[-1] - truth[-1])))
    shown = at[-1] * _share(truth, dense(first), max(bound, WRONG_END))
    incomplete = observation.complete and (last > WRONG_END or shown < at[-1] - WRONG_END)
    return {"complete": observation.complete, "incomplete": bool(incomplete), **sums}


def _is_misplaced(piece: ThreadPiece, truth: np.ndarray) -> bool:
    """Return whether a piece lies elsewhere along the thread than is said; `truth` is the arc length at its points."""
    along, known = arc_lengths(piece.points), math.isfinite(piece.arc_length[0])
    # Medians: where the thread crosses itself, the nearest point of it may be of the other strand.
    grows = float(np.median(np.diff(truth))) > 0.0
    if not known or (piece.direction_known and not grows):
        return known
    first = float(np.median(truth - along)) if grows else float(np.median(truth + along)) - float(along[-1])
    return not piece.arc_length[0] - WRONG_END <= first <= piece.arc_length[1] + WRONG_END


def _share(points: Points, line: Points, bound: float) -> float:
    """Return which share of points lies within a bound of a line of points close together."""
    return float(np.mean(np.asarray(KDTree(line).query(points)[0]) < bound)) if len(points) else 0.0


def row_of(name: str, results: Iterable[Result]) -> dict[str, Any]:
    """Sum up the results of a class; lengths of thread are summed over all frames before they are divided.

    Returns:
        `name` of the class; number of `frames`; those `found`, with a pose; of these `unknown`, with an unknown
        heading, `wrong`, tail or heading off by more than `WRONG_PX`, `WRONG_ANGLE`, `reversed`, off by more than a
        right angle, and `dishonest`, off by more than the covariance tells; `tail_px`, root mean square over those
        found and not wrong, None if there are none, and `angle_deg`, the same of the heading; `covered`, share of the
        visible thread that was followed, over all frames; `covered_90`, share of the frames with 90 % of it followed;
        `wrong_line`, share of the published centreline where no thread is, None if none was published; `pieces`, share
        of the visible thread that lies on pieces, over all frames; `wrong_pieces`, share of the pieces' length where no
        thread is, None without pieces; `misplaced`, pieces whose place along the thread is said to be known and is
        wrong; `complete`, frames of which is said that they show all of the thread, and `incomplete`, those of them
        that don't; `free`, ends of which is said that they are the thread's, and `not_free`, those of them that are
        not; `normalised`, root mean square of points' distances from the thread over their standard deviation, 1 if
        honest; `median_ms`, CPU time of a frame.
    """
    frames = list(results)
    found = [frame for frame in frames if frame.found]
    right = [frame for frame in found if not frame.is_wrong and not frame.unknown]
    total = {field.name: sum(getattr(frame, field.name) for frame in frames) for field in fields(Result)}

    def share(part: str, whole: str) -> float | None:
        return total[part] / total[whole] if total[whole] else None

    def root_mean_square(values: list[float]) -> float | None:
        return float(np.sqrt(np.mean(np.square(values)))) if values else None

    normalised = share("normalised", "points")
    return {
        "name": name,
        "frames": len(frames),
        **{field: total[field] for field in COUNTS},
        "wrong": sum(frame.is_wrong for frame in found),
        "reversed": sum(frame.is_reversed for frame in found),
        "dishonest": sum(not frame.honest for frame in found),
        "tail_px": root_mean_square([frame.tail_px for frame in right]),
        "angle_deg": root_mean_square([math.degrees(frame.angle) for frame in right]),
        "covered": share("covered", "visible") or 0.0,
        "covered_90": float(np.mean([frame.covered >= 0.9 * frame.visible for frame in frames])),
        "wrong_line": share("wrong", "line"),
        "pieces": share("pieces", "visible") or 0.0,
        "wrong_pieces": share("wrong_pieces", "length"),
        "normalised": None if normalised is None else math.sqrt(normalised),
        "median_ms": 1e3 * float(np.median([frame.seconds for frame in frames])),
    }
