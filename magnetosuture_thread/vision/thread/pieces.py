"""Finds the pieces of a thread that do not leave the needle: ridges that look like the piece that does."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.polyline import Points, arc_lengths
from magnetosuture_thread.vision.images import Picture
from magnetosuture_thread.vision.sampling import middle
from magnetosuture_thread.vision.thread.appearance import (
    SURE_STRENGTH,
    Appearance,
    across,
    looks_alike,
    respaced,
    runs,
    sampled,
)
from magnetosuture_thread.vision.thread.hiding import WALL_PX, Hiding
from magnetosuture_thread.vision.thread.walk import walk_on

DIRECTIONS = 8  # in which both sides of a ridge are looked at
NOISES = 4.0  # times the ridge's median, that a ridge is stronger than at least
FAINTEST = 3.0  # grey levels
BEGIN_SHARE = 0.45  # of the thread's usual strength, at least, where a walk begins
MIN_SEED_PX, MIN_LENGTH_PX = 6, 12.0  # of a ridge from which a walk begins, and of a piece
MAX_WALKS = 24
TWICE_PX, MAX_TWICE_PX = 2.5, 10.0  # a line this near to another shows the same thread, unless it only crosses it
SLACK = 0.35  # of the thread's darkness, that a piece may differ by
NEAR_PX = 7.0  # around a walk's beginning, in which its direction is measured
GROUND_SLACK = 0.06  # of the floor's brightness, that the ground beside a piece may differ by

Ridge = NDArray[np.uint8]


def two_sided_ridge(gray: NDArray[np.uint8], thread: Appearance, hiding: Hiding) -> Ridge:
    """Return how much darker, or brighter, each pixel is than the floor on both sides of it.

        R(p) = max_k min(I(p + d n_k), I(p - d n_k)) - I(p)

    with d a little more than half of the thread's width and n_k unit vectors all around, so that an edge, bright on
    one side only, is none. It is 0 where something hides the floor.
    """
    image = cv2.bitwise_not(gray) if thread.pale else gray
    reach = thread.beside_px
    edge = math.ceil(reach) + 1
    padded = cv2.copyMakeBorder(image, edge, edge, edge, edge, cv2.BORDER_REPLICATE)
    rows, columns = image.shape
    best = np.zeros_like(image)
    for index in range(DIRECTIONS):
        angle = math.pi * index / DIRECTIONS
        u, v = round(reach * math.cos(angle)), round(reach * math.sin(angle))
        one = padded[edge + v : edge + v + rows, edge + u : edge + u + columns]
        other = padded[edge - v : edge - v + rows, edge - u : edge - u + columns]
        best = cv2.max(best, cv2.subtract(cv2.min(one, other), image))
    best[hiding.solid > 0] = 0
    return np.ascontiguousarray(best)


def find_pieces(
    picture: Picture,
    gray: NDArray[np.uint8],
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
    if max_length < MIN_LENGTH_PX or thread.strength < SURE_STRENGTH:  # The floor's texture looks like a faint thread.
        return []
    ridge = two_sided_ridge(gray, thread, hiding)
    (u, v), reach = hiding.wall.centre, hiding.wall.radius - WALL_PX
    ridge[~hiding.inside] = 0
    inside = hiding.inside[::5, ::5]
    noise = middle(ridge[::5, ::5][inside]) if inside.any() else 0.0
    faintest = max(FAINTEST, NOISES * noise)
    begin = max(noise + faintest, BEGIN_SHARE * thread.strength)
    fresh = (ridge > begin).astype(np.uint8)
    for line in known:
        _clear(fresh, line, thread.beside_px)
    found: list[Points] = []
    dish = (u, v, reach)
    for _ in range(MAX_WALKS):
        seed = _seed(fresh, ridge)
        if seed is None:
            break
        line = _traced(ridge, noise, faintest, seed, thread.strength, dish, max_length + MIN_LENGTH_PX)
        _clear(fresh, line, thread.beside_px)
        cv2.circle(fresh, (round(seed[0]), round(seed[1])), MIN_SEED_PX, 0, -1)
        for part in fresh_parts(line, known + found):
            long = MIN_LENGTH_PX <= arc_lengths(part)[-1] <= max_length
            if long and _is_thread(picture, gray, thread, hiding, part):
                found.append(part)
    return sorted(found, key=lambda line: -arc_lengths(line)[-1])


def _seed(fresh: NDArray[np.uint8], ridge: Ridge) -> tuple[float, float, float] | None:
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
    near = np.hypot(at_u - u, at_v - v) < NEAR_PX
    spread = np.cov(np.stack([at_u[near], at_v[near]])) if near.sum() > 2 else np.eye(2)
    along = np.linalg.eigh(spread)[1][:, 1]
    return float(u + left), float(v + top), math.atan2(along[1], along[0])


def _traced(
    ridge: Ridge,
    noise: float,
    faintest: float,
    seed: tuple[float, float, float],
    strength: float,
    dish: tuple[float, float, float],
    max_length: float,
) -> Points:
    """Walk from a place along a ridge to both of its ends."""
    halves = []
    hidden = np.zeros((1, 1), np.uint8)
    for turn in (math.pi, 0.0):
        path, strong = np.zeros((int(max_length) + 16, 6)), np.zeros(int(max_length) + 16, np.bool_)
        path[0, :5] = seed[0], seed[1], seed[2] + turn, 0.0, max(strength, faintest)
        forks = np.empty((0, 3))
        count, _ = walk_on(ridge, hidden, 1, noise, faintest, 1.0, dish, max_length, path, strong, 1, 9.0, forks)
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


def _is_thread(picture: Picture, gray: NDArray[np.uint8], thread: Appearance, hiding: Hiding, line: Points) -> bool:
    """Say whether a line looks like the thread and lies on the floor."""
    reach = thread.beside_px
    ground = sampled(gray, across(line, np.array([-reach, reach]))).astype(float)
    floor = sampled(hiding.floor, line).astype(float)[:, None]
    if abs(float(np.median(ground / floor)) - 1.0) > GROUND_SLACK:
        return False
    return looks_alike(picture, thread, line, SLACK)
