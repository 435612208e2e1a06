"""Finds the pieces of a thread that do not leave the needle, and tells why each piece ends."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.polyline import Points, arc_lengths
from magnetosuture_thread.thread_observation import PieceEnd
from magnetosuture_thread.vision.images import Picture
from magnetosuture_thread.vision.needle.arc import MeasuredNeedle
from magnetosuture_thread.vision.sampling import middle
from magnetosuture_thread.vision.thread.appearance import (
    FAINTEST,
    SPACING_PX,
    Appearance,
    Gray,
    Strand,
    across,
    below_needle,
    looks_alike,
    respaced,
    runs,
    sampled,
    sampled_colours,
)
from magnetosuture_thread.vision.thread.hiding import WALL_PX, Hiding
from magnetosuture_thread.vision.thread.walk import Ridge, walk_on

MIN_SEED_PX, MIN_LENGTH_PX = 6, 12.0  # of a ridge from which a walk begins, and of a piece
TWICE_PX, MAX_TWICE_PX = 2.5, 10.0  # a line this near to another shows the same thread, unless it only crosses it
NEAR_PX = 7.0  # from an end, up to which something hides the thread that goes on there
AHEAD_PX, AHEAD = (3.0, 5.0, 7.0, 9.0, 11.0), math.radians(50.0)  # beyond an end, where floor must be visible
BESIDE_POINTS = 6  # last vertices of a piece, beside which its floor is measured
BARE_COLOUR = 0.03  # of it, by which colours may change apart, on average over the farthest rings


def _off_line() -> NDArray[np.float64]:
    """Return the matrix that takes light at the vertices and ahead to what it is off a straight line fitted to it."""
    line = np.vander(np.concatenate([SPACING_PX * np.arange(1 - BESIDE_POINTS, 1), AHEAD_PX]), 2)
    return np.asarray(np.eye(len(line)) - line @ np.linalg.pinv(line))


OFF_LINE = _off_line()


def two_sided_ridge(gray: Gray, thread: Appearance, hiding: Hiding) -> Gray:
    """Return how much darker each pixel is than the floor on both sides of it.

        R(p) = max_k min(I(p + d n_k), I(p - d n_k)) - I(p)

    with d a little more than half of the thread's width and n_k unit vectors all around, so that an edge, bright on
    one side only, is none. It is 0 where something hides the floor.
    """
    reach = thread.beside_px
    edge = math.ceil(reach) + 1
    padded = cv2.copyMakeBorder(gray, edge, edge, edge, edge, cv2.BORDER_REPLICATE)
    rows, columns = gray.shape
    best = np.zeros_like(gray)
    for index in range(8):
        angle = math.pi * index / 8
        u, v = round(reach * math.cos(angle)), round(reach * math.sin(angle))
        one = padded[edge + v : edge + v + rows, edge + u : edge + u + columns]
        other = padded[edge - v : edge - v + rows, edge - u : edge - u + columns]
        best = cv2.max(best, cv2.subtract(cv2.min(one, other), gray))
    best[hiding.solid > 0] = 0
    return np.ascontiguousarray(best)


def find_pieces(
    picture: Picture,
    gray: Gray,
    thread: Appearance,
    hiding: Hiding,
    known: list[Points],
    max_length: float,
) -> list[Points]:
    """Find all other pieces of a thread.

    Args:
        picture: the frame or a part of it.
        gray: its darkest colour without the needle, smoothed.
        thread: how the piece looks that leaves the needle.
        hiding: areas where nothing can be seen.
        known: pieces that are known, each of shape (m, 2) [px].
        max_length: of all these pieces: what is left of the thread, so that anything longer is none of it [px].

    Returns:
        Pieces in the picture's pixels, the longest first, each of shape (m, 2), m >= 2 [px].
    """
    if max_length < MIN_LENGTH_PX or thread.strength < 2.0 * FAINTEST:  # The floor's texture looks like a faint thread.
        return []
    ridge = two_sided_ridge(gray, thread, hiding)
    (u, v), reach = hiding.wall.centre, hiding.wall.radius - WALL_PX
    ridge[~hiding.inside] = 0
    inside = hiding.inside[::5, ::5]
    noise = middle(ridge[::5, ::5][inside]) if inside.any() else 0.0
    faintest = max(FAINTEST, 4.0 * noise)
    fresh = (ridge > max(noise + faintest, 0.45 * thread.strength)).astype(np.uint8)
    for line in known:
        _clear(fresh, line, thread.beside_px)
    found: list[Points] = []
    walked, dish = Ridge(ridge, np.zeros((1, 1), np.uint8), 1, noise, faintest), (u, v, reach)
    for _ in range(24):
        seed = _seed(fresh, ridge)
        if seed is None:
            break
        line = _traced(walked, seed, max(thread.strength, faintest), dish, max_length + MIN_LENGTH_PX)
        _clear(fresh, line, thread.beside_px)
        cv2.circle(fresh, (round(seed[0]), round(seed[1])), MIN_SEED_PX, 0, -1)
        for part in fresh_parts(line, known + found):
            long = MIN_LENGTH_PX <= arc_lengths(part)[-1] <= max_length
            if long and _is_thread(picture, gray, thread, hiding, part):
                found.append(part)
    return sorted(found, key=lambda line: -arc_lengths(line)[-1])


def _seed(fresh: NDArray[np.uint8], ridge: Gray) -> tuple[float, float, float] | None:
    """Return place and direction of the largest ridge that no walk has begun at yet: u, v, angle."""
    outlines, _ = cv2.findContours(fresh, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    boxes = [cv2.boundingRect(outline) for outline in outlines]
    extents = [math.hypot(width, height) for _, _, width, height in boxes]
    if not extents or max(extents) < MIN_SEED_PX:
        return None
    largest = int(np.argmax(extents))
    left, top, width, height = boxes[largest]
    own = np.zeros((height, width), np.uint8)
    cv2.drawContours(own, outlines, largest, 1, -1, cv2.LINE_8, offset=(-left, -top))
    box = slice(top, top + height), slice(left, left + width)
    own &= fresh[box]
    v, u = np.unravel_index(int(np.argmax(np.where(own, ridge[box], 0))), own.shape)
    at_v, at_u = np.nonzero(own)
    near = np.hypot(at_u - u, at_v - v) < 7.0
    spread = np.cov(np.stack([at_u[near], at_v[near]])) if near.sum() > 2 else np.eye(2)
    along = np.linalg.eigh(spread)[1][:, 1]
    return float(u + left), float(v + top), math.atan2(along[1], along[0])


def _traced(
    ridge: Ridge,
    seed: tuple[float, float, float],
    strength: float,
    dish: tuple[float, float, float],
    max_length: float,
) -> Points:
    """Walk from a place along a ridge to both of its ends."""
    halves = []
    for turn in (math.pi, 0.0):
        path, strong = np.zeros((int(max_length) + 16, 6)), np.zeros(int(max_length) + 16, np.bool_)
        path[0, :5] = seed[0], seed[1], seed[2] + turn, 0.0, strength
        count, _ = walk_on(ridge, dish, max_length, path, strong, 1, 9.0, np.empty((0, 3)))
        halves.append(path[:count, :2].copy())
    line = np.vstack([halves[0][::-1], halves[1][1:]])
    return line if len(line) > 1 else np.vstack([line, line + 1e-3])


def _clear(fresh: NDArray[np.uint8], line: Points, reach: float) -> None:
    """Take what lies along a line out of where walks may begin."""
    at = np.round(line * 16.0).astype(np.int32)
    cv2.polylines(fresh, [at], False, 0, 2 * math.ceil(reach) + 1, cv2.LINE_8, 4)


def fresh_parts(line: Points, known: list[Points]) -> list[Points]:
    """Return the parts of a line that run along no known one, nor along itself; they may cross them."""
    line = respaced(line, 1.0)
    others = np.vstack([respaced(other, 1.0) for other in known]) if known else np.empty((0, 2))
    twice = np.empty(len(line), np.bool_)
    _mark_twice(line, others, twice)
    for first, last in runs(twice):
        if last - first < MAX_TWICE_PX and first > 0 and last < len(twice):
            twice[first:last] = False
    return [line[first:last] for first, last in runs(~twice) if last - first > 1]


@compiled
def _mark_twice(line, others, twice):
    """Mark where a line with vertices 1 px apart comes near to other points, or to its own from long before."""
    for index in range(len(line)):
        u, v = line[index, 0], line[index, 1]
        twice[index] = False
        for own in range(index - int(MAX_TWICE_PX)):
            if (line[own, 0] - u) ** 2 + (line[own, 1] - v) ** 2 < TWICE_PX**2:
                twice[index] = True
                break
        for other in range(len(others)):
            if twice[index]:
                break
            twice[index] = (others[other, 0] - u) ** 2 + (others[other, 1] - v) ** 2 < TWICE_PX**2


def _is_thread(picture: Picture, gray: Gray, thread: Appearance, hiding: Hiding, line: Points) -> bool:
    """Say whether a line looks like the thread and lies on the floor."""
    reach = thread.beside_px
    ground = sampled(gray, across(line, np.array([-reach, reach]))).astype(float)
    floor = sampled(hiding.floor, line).astype(float)[:, None]
    if abs(float(np.median(ground / floor)) - 1.0) > 0.06:  # of the floor's brightness
        return False
    return looks_alike(picture, thread, line, 0.35)


def end_direction(points: Points) -> Points:
    """Return the unit direction in which a polyline leaves at its last point, shape (2,)."""
    at = arc_lengths(points)
    first = int(np.searchsorted(at, at[-1] - 8.0))
    near = points[min(first, len(points) - 2) :]
    if len(near) > 3:  # A parabola's tangent at its end: a bent thread turns on the way.
        s = arc_lengths(near)
        powers = np.vander(s - s[-1], 3)
        direction = np.linalg.solve(powers.T @ powers, powers.T @ near)[1]
    else:
        direction = near[-1] - near[0]
    return np.asarray(direction / max(float(np.hypot(*direction)), 1e-9))


def why_it_ends(
    picture: Picture,
    gray: Gray,
    thread: Appearance,
    strand: Strand,
    needle: MeasuredNeedle,
    hiding: Hiding,
) -> tuple[PieceEnd, int]:
    """Tell why a piece ends at its last point, and the number of the area that it runs into, 0 for none."""
    point, way = strand.points[-1], end_direction(strand.points)
    aside = np.array([-way[1], way[0]])
    rows, columns = gray.shape
    for ahead in np.arange(0.0, NEAR_PX + 0.5):
        for beside in (0.0, -1.5, 1.5):
            at = point + ahead * way + beside * aside
            area = hiding.area_at(at)
            if area > 0:
                return PieceEnd.COVERED, area
            if not (1.0 <= at[0] < columns - 2 and 1.0 <= at[1] < rows - 2):
                return PieceEnd.FRAME, 0
            if area < 0:
                return PieceEnd.UNKNOWN, 0
    return (PieceEnd.FREE if is_bare_beyond(picture, gray, thread, strand, needle) else PieceEnd.UNKNOWN), 0


def is_bare_beyond(picture: Picture, gray: Gray, thread: Appearance, strand: Strand, needle: MeasuredNeedle) -> bool:
    """Say whether there is nothing but floor beyond a piece's last point, like that beside it, where it is strong."""
    if len(strand.points) < BESIDE_POINTS:
        return False
    usual = float(np.median(strand.strength[-BESIDE_POINTS:]))
    if usual < max(2.0 * FAINTEST, 4.0 * thread.noise):
        return False
    point, way = strand.points[-1], end_direction(strand.points)
    angle = math.atan2(way[1], way[0])
    turns = np.linspace(-AHEAD, AHEAD, 9)
    reach = np.array(AHEAD_PX)
    ahead = point + reach[:, None, None] * np.stack([np.cos(angle + turns), np.sin(angle + turns)], axis=-1)[None]
    rows, columns = gray.shape
    if ahead.min() < 2.0 or (ahead > np.array([columns, rows]) - 3.0).any():
        return False
    if below_needle(needle, ahead.reshape(-1, 2)).any():
        return False
    aside = thread.beside_px + np.array([0.5, 1.5, 2.5])
    last = strand.points[-BESIDE_POINTS - 1 :]  # with one more, for the direction at the first
    beside = across(last, np.concatenate([-aside, aside]))[-BESIDE_POINTS:]
    floor, beyond = float(np.median(sampled(gray, beside))), sampled(gray, ahead)
    if floor - float(beyond[1:].min()) > max(0.5 * usual, FAINTEST + 3.0 * thread.noise):  # It goes on.
        return False
    light = np.vstack([np.median(sampled_colours(picture.image, at), axis=1) for at in (beside, ahead)])
    light /= np.maximum(np.median(light[: len(beside)], axis=0), 1.0)
    mean = light.mean(axis=1)
    step = np.abs(OFF_LINE @ mean).max()
    even = step < 0.025 and np.abs(mean - 1.0).max() < 0.06
    return bool(even and np.ptp(light[-3:].mean(axis=0)) < BARE_COLOUR)
