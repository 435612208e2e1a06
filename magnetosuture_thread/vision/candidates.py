"""Finds where a needle may be, by a matched filter: the share of dark along a bent rod, less that of its border.

    score = inside - (left + right) / 2 - min(behind, ahead) / 2 - angle / 20

with means of the darkness D of the floor over the rod, beside it on its left and right, and beyond its two ends, and
the angle that it is bent by, as straight needles are more usual,

    D = 2 (1 - I / F) / (1 - b) - 1, from 0 to 1

of an image I, its floor F, closed over what is narrower than 2.4 widths, and the brightness b of a needle at most.
A blob and an edge have about 0 by it, a line that goes on beyond both ends 0.5, and a rod 1, also where a thread
as wide leaves one end.

Straight rods, as long as an arc is about straight, are searched at all dark pixels of a reduced picture; the best of
them are the middles of arcs of the whole length, of which the best climb to where the score is the greatest, in full
resolution. Beyond the wall and in shapes a needle may go on, and nothing is beside it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.compiled import compiled, compiled_inner
from magnetosuture_thread.vision.arc import Arc, NeedleSize
from magnetosuture_thread.vision.images import RIM_PX, Picture, Wall, sample

MIN_SCORE = 0.3  # of a rod, and of a part of one, that is looked at further
DARK_END, GOES_ON = 0.2, 0.6  # darkness beyond an end, from which on something may go on there, and does
TAPER = 0.1  # share of the rows of samples at each end, of which the middle alone counts
BESIDE = (0.65, 1.1)  # widths from the axis to what is beside it
UNKNOWN = 0  # darkness is 1 to 255 where it is known


@dataclass(frozen=True)
class Candidate:
    """Where a needle may be.

    Attributes:
        arc: its axis, from either end on.
        score: see the module, -1 to 1.
        thing: number of the dark thing that it is in, with all that touches it.
        ends: darkness beyond its first and its last point, 0 to 1.
        dark: the image that it was found in; see `darkness`.
        origin: of that in the picture, shape (2,) [px].
    """

    arc: Arc
    score: float
    thing: int
    ends: tuple[float, ...]
    dark: NDArray[np.uint8]
    origin: NDArray[np.int_]


@dataclass(frozen=True)
class Prior:
    """Where a needle must be, by what was seen before.

    Attributes:
        middle: of its axis, shape (2,) [px].
        reach: how far from there it may be [px].
        angle: of its axis there, in either direction [rad], from u towards v.
        turn: by how much it may differ [rad].
    """

    middle: NDArray[np.float64]
    reach: float
    angle: float
    turn: float


def find_candidates(picture: Picture, size: NeedleSize, prior: Prior | None = None) -> list[Candidate]:
    """Return where a needle of a size may be in a picture, the best first; all over it without a prior."""
    offset = np.zeros(2, int)
    if prior is not None:
        away = prior.reach + 0.5 * size.length_px + 4.0 * size.width_px  # with its floor and what is beyond its ends
        picture, offset = _part(picture, prior.middle - away, prior.middle + away)
        prior = replace(prior, middle=prior.middle - offset)
    if size.length_px > math.hypot(*picture.shape):
        return []
    dark, taper = darkness(picture, size), 0.0 if size.is_blunt else TAPER
    factor = max(1, round(size.width_px / 2.5))  # px; width of the needle in the reduced picture
    rows, columns = (side // factor * factor for side in dark.shape)
    whole = dark[:rows, :columns]
    coarse = np.asarray(cv2.resize(whole, (columns // factor, rows // factor), interpolation=cv2.INTER_AREA))
    _, things = cv2.connectedComponents(cv2.threshold(coarse, 128, 255, cv2.THRESH_BINARY)[1])
    length, width = size.length_px / factor, size.width_px / factor
    angles = max(12, math.ceil(math.pi / (1.6 * width / length)))
    bends = 2 * min(20, math.ceil(size.max_bend / (6.0 * width / length))) + 1
    best, which = np.zeros(coarse.shape, np.float32), np.zeros(coarse.shape, np.int32)
    # Along 0.66 of its length one bent by 1 rad is about straight; of other bends, where the sagitta is the same.
    seed = min(0.7, 0.66 / math.sqrt(max(size.max_bend, 1e-6))) * length
    region: tuple[float, ...] = (0.0, 0.0, math.hypot(*coarse.shape), 0.0, math.pi)
    if prior is not None:
        u, v = ((float(value) + 0.5) / factor - 0.5 for value in prior.middle)
        region = (u, v, prior.reach / factor + 1.0, prior.angle, prior.turn + math.pi / angles)
    _search_seeds(coarse, seed, width, angles, region, best, which)
    rough: list[tuple[float, np.ndarray, int]] = []
    for row, column in _peaks(best, max(1, round(0.1 * length))):
        state = np.array([column, row, math.pi * which[row, column] / angles, 0.0])
        score = _bend(coarse, state, length, width, size.max_bend, bends, taper)
        scaled = [*((state[:2] + 0.5) * factor - 0.5), state[2], state[3] / factor]
        rough.append((score, np.array(scaled), int(things[row, column])))
    found = list[Candidate]()
    for score, state, thing in sorted(rough, key=lambda each: -each[0]):
        if score < MIN_SCORE or len(found) == 8:
            break
        if any(_is_same(state, other, size) for other in found):
            continue
        score = climb(dark, state, size.length_px, size.width_px, size.max_bend, taper)
        u, v, angle, curvature = (float(value) for value in state)
        inside, _, _, *ends = _answer(dark, u, v, angle, curvature, size.length_px, size.width_px, taper)
        # A thread is not as dark inside.
        if score > MIN_SCORE and inside > 0.6 and not any(_is_same(state, other, size) for other in found):
            middle = Arc(np.array([u, v]), angle, curvature)
            arc = middle.moved(-0.5 * size.length_px, 0.0, 0.0, 0.0)
            found.append(Candidate(arc, score, thing, tuple(ends), dark, offset))
    found.sort(key=lambda candidate: -candidate.score)
    return [replace(each, arc=each.arc.shifted(offset)) for each in found]


def _part(picture: Picture, low: NDArray[np.float64], high: NDArray[np.float64]) -> tuple[Picture, NDArray[np.int_]]:
    """Return what the search needs of a picture between two corners (u, v) [px], and where it begins in it."""
    columns, rows = (np.array([low, high + 1.0]).T.clip(0, np.array(picture.shape[::-1])[:, None])).astype(int)
    box, offset = (slice(*rows), slice(*columns)), np.array([columns[0], rows[0]])
    layer, (u, v), mask = picture.brightest, picture.wall.centre, picture.mask
    brightest = replace(layer, pixels=layer.pixels[box], floor=layer.floor[box])
    wall = replace(picture.wall, centre=(u - float(offset[0]), v - float(offset[1])))
    mask = None if mask is None else replace(mask, depth=mask.depth[box])
    return replace(picture, brightest=brightest, wall=wall, mask=mask), offset


def _peaks(best: NDArray[np.float32], reach: int) -> NDArray[np.int_]:
    """Return row and column of the greatest scores within a reach [px], the best first, shape (n, 2).

    Along a rod that is all dark many are equal: those that are as far from each other count, from its middle on.
    """
    side = 2 * reach + 1
    top = ((best >= cv2.dilate(best, np.ones((side, side), np.uint8))) & (best > MIN_SCORE)).astype(np.uint8)
    _, labels, _, centres = cv2.connectedComponentsWithStats(top)
    at = np.argwhere(top)
    apart = np.hypot(*(at - centres[labels[at[:, 0], at[:, 1]]][:, ::-1]).T)
    left, peaks = at[np.lexsort((apart, -best[at[:, 0], at[:, 1]]))], list[NDArray[np.int_]]()
    while len(left) and len(peaks) < 96:
        peaks.append(left[0])
        left = left[np.abs(left - left[0]).max(axis=1) > reach]
    return np.array(peaks).reshape(-1, 2)


def _around_ends(dark: NDArray[np.uint8], arc: Arc, size: NeedleSize) -> tuple[float, ...]:
    """Return how dark the darkest line ahead of each end is, also where it bends away, 0 to 1."""
    ahead, aside = np.linspace(-1.4, -0.5, 4) * size.width_px, np.linspace(-1.2, 1.2, 9) * size.width_px
    ways = (arc, arc.reversed_at(size.length_px))
    return tuple(float(way.strip(dark, ahead, aside).mean(axis=0).max()) / 255.0 for way in ways)


def _filled_ends(dark: NDArray[np.uint8], arc: Arc, size: NeedleSize) -> tuple[float, ...]:
    """Return how dark an axis is in its first and its last quarter, where it is in sight, 0 to 1."""
    along, filled = np.linspace(0.0, 0.25, 9) * size.length_px, list[float]()
    for way in (arc, arc.reversed_at(size.length_px)):
        values = way.strip(dark, along, np.zeros(1))
        seen = values[values > UNKNOWN]
        filled.append(float(seen.mean()) / 255.0 if len(seen) else 1.0)
    return tuple(filled)


def is_unique(candidates: list[Candidate], wall: Wall, size: NeedleSize) -> bool:
    """Say whether the first of those found is a needle by its score alone: a rod up to both ends, and no other as good.

    At the wall it may be dark beyond an end.
    """
    if not candidates or candidates[0].score < 0.65:  # A line half as wide has 0.6.
        return False
    first = candidates[0]
    own = first.arc.shifted(-first.origin)
    # A thing that is 15 % shorter leaves so much dark in a quarter.
    if min(_filled_ends(first.dark, own, size)) < 0.4:
        return False
    ends = first.arc.at(np.array([0.0, size.length_px]))
    free = np.hypot(*(ends - wall.centre).T) < wall.radius - 2.0 * size.width_px
    if np.any(free & (np.maximum(_around_ends(first.dark, own, size), first.ends) > GOES_ON)):
        return False
    return all(each.score < 0.85 * first.score for each in candidates[1:])


def _is_same(state: np.ndarray, other: Candidate, size: NeedleSize) -> bool:
    """Say whether an axis by the place (u, v) and the angle of its middle is of what was found."""
    half = 0.5 * size.length_px
    turned = math.remainder(state[2] - other.arc.angle - half * other.arc.curvature, math.pi)
    return math.dist(state[:2], other.arc.point(half)) < 0.15 * size.length_px and abs(turned) < 0.25


def darkness(picture: Picture, size: NeedleSize) -> NDArray[np.uint8]:
    """Return D of a picture, 1 for the floor to 255, and `UNKNOWN` beyond the wall and in shapes of the scene."""
    pixels, floor = picture.brightest.pixels, picture.brightest.floor
    side = 2 * int(0.5 * 2.4 * size.width_px) + 1  # widths, below which a dark thing is not taken for the floor
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    inside = picture.wall.inside(picture.shape, RIM_PX)
    shown = cv2.min(pixels, floor)
    cv2.copyTo(floor, cv2.bitwise_not(inside), shown)  # so that what touches the wall is a thing of its own
    light = cv2.blur(cv2.morphologyEx(shown, cv2.MORPH_CLOSE, kernel), (5, 5))
    floor = cv2.min(floor, light)
    share = cv2.divide(pixels, floor, scale=200.0)
    levels = 2.0 * (1.0 - np.arange(256) / 200.0) / (1.0 - size.max_brightness) - 1.0
    dark = cv2.LUT(share, np.clip(255.0 * levels, 1.0, 255.0).astype(np.uint8))
    if picture.mask is not None:
        solid = cv2.compare(picture.mask.depth, picture.mask.tolerance_px, cv2.CMP_GT)
        inside[solid > 0] = 0
    return np.asarray(cv2.bitwise_and(dark, inside))


@compiled
def _search_seeds(dark, length, width, angles, region, best, which):
    """Fill in the best score of straight rods around each dark pixel of a region, and the number of its angle."""
    centre_u, centre_v, reach, middle_angle, turn = region
    rows, columns = dark.shape
    count = max(3, int(length))
    step = length / count
    aside = BESIDE[1] * width
    for row in range(rows):
        for column in range(columns):
            if dark[row, column] < 96:  # by more than a third of what a needle is
                continue
            if math.hypot(column - centre_u, row - centre_v) > reach:
                continue
            for index in range(angles):
                angle = math.pi * index / angles
                turned = (angle - middle_angle) % math.pi
                if min(turned, math.pi - turned) > turn:
                    continue
                c, s = math.cos(angle), math.sin(angle)
                inside, beside, known = 0.0, 0.0, 0
                for place in range(count):
                    t = (place + 0.5) * step - 0.5 * length
                    u, v = column + t * c, row + t * s
                    for side in range(-1, 2):
                        x, y = int(u - side * aside * s + 0.5), int(v + side * aside * c + 0.5)
                        if not (0 <= x < columns and 0 <= y < rows):
                            continue
                        value = float(dark[y, x])
                        if side == 0:
                            inside += value
                            known += value > 0.0
                        else:
                            beside += value
                if 2 * known < count:
                    continue
                score = (inside / known - 0.5 * beside / count) / 255.0
                if score > best[row, column]:
                    best[row, column] = score
                    which[row, column] = index


@compiled_inner
def _value(dark, u, v):
    """Return the darkness at a point, 0 to 1, and whether it is known; what is not may be dark or not."""
    if not (0.0 <= u < dark.shape[1] - 1 and 0.0 <= v < dark.shape[0] - 1):
        return 0.5, False
    if dark[int(v + 0.5), int(u + 0.5)] == UNKNOWN:
        return 0.5, False
    return sample(dark, u, v) / 255.0, True


@compiled
def _answer(dark, u, v, angle, curvature, length, width, taper):
    """Return the darkness inside of a bent rod, left and right of it, behind and ahead; see the module.

    Args:
        dark: D, shape (rows, columns).
        u: of its middle [px].
        v: of its middle [px].
        angle: there [rad].
        curvature: [1/px].
        length: of it [px].
        width: of it [px].
        taper: share of its rows at each end, of which the middle alone counts.
    """
    count = max(8, int(length / (0.4 * width)))  # rows of samples
    inside, behind, ahead, left, right = 0.0, 0.0, 0.0, 0.0, 0.0
    seen, due = 0, 0
    for place in range(-2, count + 2):
        if place < 0:
            t = -0.5 * length + (0.5 * place) * width
        elif place < count:
            t = (place + 0.5) * length / count - 0.5 * length
        else:
            t = 0.5 * length + (0.5 + 0.5 * (place - count)) * width
        half = 0.5 * curvature * t
        chord = t if abs(half) < 1e-9 else t * math.sin(half) / half
        x, y = u + chord * math.cos(angle + half), v + chord * math.sin(angle + half)
        c, s = math.cos(angle + 2.0 * half) * width, math.sin(angle + 2.0 * half) * width
        is_end = min(place, count - 1 - place) < taper * count  # where a point may be
        for line in range(-2, 3):
            if line != 0 and is_end and 0 <= place < count:
                continue
            value, is_known = _value(dark, x - 0.2 * line * s, y + 0.2 * line * c)
            if place < 0:
                behind += 0.1 * value
            elif place < count:
                due += 1
                inside += value
                seen += is_known
            else:
                ahead += 0.1 * value
        if 0 <= place < count:
            for aside in BESIDE:
                one, is_left_known = _value(dark, x + aside * s, y - aside * c)
                other, is_right_known = _value(dark, x - aside * s, y + aside * c)
                left += one * is_left_known  # Beyond the wall and in a shape there is nothing.
                right += other * is_right_known
    if seen < 0.7 * due:  # too little of the rod is in sight
        return 0.0, 1.0, 1.0, 1.0, 1.0
    return inside / due, 0.5 * left / count, 0.5 * right / count, behind, ahead


@compiled_inner
def _score(dark, u, v, angle, curvature, length, width, taper):
    """Return the score of a bent rod; see the module."""
    inside, left, right, behind, ahead = _answer(dark, u, v, angle, curvature, length, width, taper)
    return inside - 0.5 * (left + right) - 0.5 * min(behind, ahead) - 0.05 * abs(curvature) * length


@compiled
def _bend(dark, state, length, width, max_bend, bends, taper):
    """Change the curvature of (u, v, angle, curvature) to that of the best of bent rods; return its score."""
    best = -1.0
    for index in range(bends):
        # From the straight one on, to both sides in turn.
        curvature = ((index + 1) // 2) * (2 * (index % 2) - 1) * 2.0 * max_bend / (max(bends - 1, 1) * length)
        score = _score(dark, state[0], state[1], state[2], curvature, length, width, taper)
        if score > best:
            best = score
            state[3] = curvature
    return best


@compiled
def climb(dark, state, length, width, max_bend, taper):
    """Change (u, v, angle, curvature) to where the score is the greatest nearby; return it.

    Steps are along the bent axis and aside of it, of its angle and its curvature, halved where none of them is upwards,
    and begin anew while that gains more than noise of 2 grey levels over a rod does: what was too far before may not be
    any more.
    """
    best = _score(dark, state[0], state[1], state[2], state[3], length, width, taper)
    trial, gain = np.empty(4), 1.0
    while gain > 0.002:
        gain, step = -best, width
        while step > 0.2:  # px; noise moves the end of a climb by more
            moved = False
            for kind in range(4):
                for way in range(-1, 2, 2):
                    trial[:] = state
                    c, s = math.cos(state[2]), math.sin(state[2])
                    if kind == 0:
                        turned = way * step * state[3]  # of the chord by which it slides; the tangent by twice that
                        trial[0] = state[0] + 2.0 * way * step * math.cos(state[2] + turned)
                        trial[1] = state[1] + 2.0 * way * step * math.sin(state[2] + turned)
                        trial[2] = state[2] + 2.0 * turned
                    elif kind == 1:
                        trial[0], trial[1] = state[0] - way * step * s, state[1] + way * step * c
                    elif kind == 2:
                        trial[2] = state[2] + way * step * 2.0 / length
                    else:
                        bent = state[3] + way * step * 8.0 / (length * length)
                        trial[3] = min(max(bent, -max_bend / length), max_bend / length)
                    score = _score(dark, trial[0], trial[1], trial[2], trial[3], length, width, taper)
                    if score > best:
                        best = score
                        state[:] = trial
                        moved = True
            if not moved:
                step *= 0.5
        gain += best
    return best
