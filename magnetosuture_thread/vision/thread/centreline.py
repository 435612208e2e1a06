"""Finds the thread's centreline: a walk along its ridge, dark or pale, that starts at the needle's tail."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from magnetosuture_thread.geometry.polyline import arc_lengths, points_at
from magnetosuture_thread.vision.images import Picture
from magnetosuture_thread.vision.needle.measured_needle import MeasuredNeedle
from magnetosuture_thread.vision.thread.search import (
    ENOUGH,
    FAINT,
    MIN_CENTRED,
    SCALES,
    SURE_SHARE,
    WALL_PX,
    WIDER_SHARE,
    ThreadSearch,
    Walk,
    is_strong,
    only_tail,
)

WIDENESS = 1.2  # of a walk along the edge, the shadow or the texture of something far wider than itself
PALE_WIDENESS = 1.0  # the same where that is as bright as the floor but for its edges
LEAVES = 0.3  # of the mean evidence, that a wide thread has where it comes out; less, and bare floor lies before it
WIDE_SHOWN = 0.4  # of what a walk along its edge shows, that one along the middle of what is wide must show
MIN_CONFIDENCE = 0.9  # of a crossing, that the thread is followed beyond
FAINT_SHARE = 0.5  # of enough, that a faint or pale thread must show: less may be another thread, or glare
MIN_BEGINNING, MIN_EVIDENCE = 2.5, 5.0  # mean evidence where a thread comes out and of all of it: more than noise shows
CLEAR_EVIDENCE = 10.0  # mean evidence of a line as long as the thread, that may be fainter where it comes out
MIN_EDGE = 0.15  # share of the evidence, that a thread's fainter edge has: less, and it is the border of something else


@dataclass(frozen=True)
class FollowedThread:
    """A thread's centreline, and how sure it is that it is one thread's.

    Attributes:
        points: vertices from the tail on, shape (m, 2) [px], m = 1 if no thread is seen.
        confidence: least of all its crossings, 0 to 1; 1 if it crosses nothing, 0 if nothing is seen.
        doubtful_px: where it is least, shape (2,) [px]; None if it crosses nothing.
    """

    points: np.ndarray
    confidence: float
    doubtful_px: np.ndarray | None


def find_centreline(
    picture: Picture, needle: MeasuredNeedle, max_length: float, centre: tuple[float, float], wall: float
) -> np.ndarray:
    """Follow the thread from the needle's tail to its end.

    The ridge strength of a dark thread is the black-hat transform, how much darker a pixel is than the brightest
    background within a few pixels, of the image without the needle. Where that shows too little, the thread is faint or
    pale, and a signed difference is taken, whose noise has no mean; see `ridge`. The walk leaves the tail along
    the arc that shows most of the thread, below the needle where it must, and goes by steps along arcs that look some
    way ahead, a change of curvature having a price: so it goes straight over gaps. At crossings the smoothest of all
    pairings of the strands that meet decides. Where the
    needle or the lamp's reflection hides the thread, nothing counts for or against a way. A thread wider than the
    window is looked for at half the size.

    Args:
        picture: the frame or a part of it.
        needle: the needle, in the picture's pixels.
        max_length: the walk stops at this length [px].
        centre: the dish's centre [px].
        wall: the dish's radius; the walk stops before it [px].

    Returns:
        Vertices from the tail on, up to the first crossing where it is in doubt how the thread goes on, shape (m, 2)
        [px], m = 1 if no thread is seen.
    """
    return certain_points(walk_from(picture, needle, max_length, centre, wall))


def certain_points(walk: Walk) -> np.ndarray:
    """Return the vertices of a walk up to the first crossing where it is in doubt how the thread goes on."""
    doubtful = [crossing for crossing in walk.crossings if crossing.confidence < MIN_CONFIDENCE]
    if not doubtful:
        return walk.points
    at = arc_lengths(walk.points)
    last = int(np.searchsorted(at, _share(walk, doubtful[0].first) * at[-1]))
    return walk.points[: max(2, last)]


def follow_thread(
    picture: Picture, needle: MeasuredNeedle, max_length: float, centre: tuple[float, float], wall: float
) -> FollowedThread:
    """Follow the thread as `find_centreline` does, but beyond doubtful crossings too, with a confidence.

    At each crossing with another thread, or of the thread with itself, the confidence is how probable the way is that
    was taken: the least of all crossings counts. See `arms`.

    Args:
        picture: see `find_centreline`.
        needle: see there.
        max_length: see there.
        centre: see there.
        wall: see there.
    """
    walk = walk_from(picture, needle, max_length, centre, wall)
    if not walk.crossings:
        return FollowedThread(walk.points, 1.0 if len(walk.points) > 1 else 0.0, None)
    least = min(walk.crossings, key=lambda crossing: crossing.confidence)
    at = _share(walk, (least.first + least.last) // 2) * arc_lengths(walk.points)[-1]
    return FollowedThread(walk.points, least.confidence, points_at(walk.points, np.array([at]))[0])


def _share(walk: Walk, vertex: int) -> float:
    """Return at which share of its length a walk passes a vertex of its path."""
    return float(walk.path[min(vertex, len(walk.path) - 1), 5] / walk.path[-1, 5])


def walk_from(
    picture: Picture,
    needle: MeasuredNeedle,
    max_length: float,
    centre: tuple[float, float],
    wall: float,
    *,
    doubted: bool = False,
) -> Walk:
    """Return the walk that shows the thread best; see `find_centreline`.

    Where it is doubted that the needle carries the thread, a line that passes its tail is none of its own.
    """
    reach = wall - WALL_PX
    search = ThreadSearch(picture, needle, max_length, centre, reach)
    dark = search.dark()
    enough = ENOUGH * max_length
    best = dark if is_strong(dark, enough) else _best_centred(search, dark, enough)
    wideness = search.wideness(best) if len(best.points) >= MIN_CENTRED else 0.0
    edge = search.between_edges(best) if wideness > PALE_WIDENESS and not best.ridge.signed else None
    passes = False
    if wideness > WIDENESS:
        wide = search.wide()
        if wide.shown > max(WIDE_SHOWN * best.shown, SURE_SHARE * enough):
            centred, section = search.centred(wide)
            has_edges = centred.shown > SURE_SHARE * wide.shown  # else they are too far apart, as a rope's
            best, passes = centred if has_edges else wide, has_edges and section.beginning < LEAVES * section.mean
        elif edge is not None:
            best = edge
        elif best is dark and dark.shown > SURE_SHARE * enough:
            best = only_tail(dark)  # Its middle is not visible; a short one may be covered.
    elif edge is not None:
        best = edge
    if doubted:
        own = replace(only_tail(best), passes=True) if passes else search.without_passing_line(best)
        # A faint line that passes, as the border of tissue, does not speak against a thread that is dark beyond doubt.
        instead = own.passes and best is not dark and dark.strength > FAINT
        best = search.without_passing_line(dark) if instead else own
    return best if best is edge else search.resolved(best)  # An edge's own crossings are with other edges.


def _best_centred(search: ThreadSearch, dark: Walk, enough: float) -> Walk:
    """Return the walk with the greatest evidence for a thread that leaves the needle, at first at full size."""
    best, greatest, weakest = dark, 0.0, 0.0
    for scale in SCALES:
        for walk in search.faint(scale) + ([dark] if scale == 1 else []):
            if walk.shown < FAINT_SHARE * enough:
                continue
            centred, section = search.centred(walk)
            is_clear = section.mean > CLEAR_EVIDENCE and centred.shown > enough
            begins = section.beginning > MIN_BEGINNING or is_clear
            if not begins or section.mean < MIN_EVIDENCE or section.fainter_edge < MIN_EDGE:
                continue
            # At half the size a thread and its shadow are one: what is as clear at full size is taken from there.
            total = section.mean * centred.shown
            clearer = total > (WIDER_SHARE if scale > 1 else 1.0) * greatest
            if clearer and centred.shown > FAINT_SHARE * enough:
                best, greatest, weakest = centred, total, section.weakest
        if best.shown > enough and weakest > MIN_BEGINNING:
            break
    return best
