"""Pictures of ropes on a table: one of several is followed from its end, through crossings with itself and others."""

from __future__ import annotations

import math
import time
import zlib
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from magnetosuture_thread.geometry.polyline import Points, arc_lengths, points_at
from magnetosuture_thread.vision.images import prepare
from magnetosuture_thread.vision.needle.arc import Arc
from magnetosuture_thread.vision.needle.measured_needle import MeasuredNeedle
from magnetosuture_thread.vision.thread.centreline import find_centreline

Image = NDArray[np.uint8]
Random = np.random.Generator

SIZE = (640, 480)  # px
MARGIN_PX = 40.0
PIECE_PX = 24.0  # of a rope, that lies over or under as a whole
LENGTHS_PX = (500.0, 800.0)
ROPE_BGR = (
    (60, 60, 200),
    (190, 110, 40),
    (60, 150, 70),
    (40, 40, 42),
    (225, 228, 230),
    (150, 190, 215),
    (120, 60, 140),
)
TABLE_BGR = ((205, 210, 212), (150, 180, 205), (95, 130, 165), (90, 95, 92), (232, 230, 228))
SHALLOW = (15.0, 40.0)  # degrees
MAX_TRIES = 4000


@dataclass(frozen=True, eq=False)
class RopeCase:
    """Ropes in pixels of the picture; the first is followed from its first vertex.

    Attributes:
        lines: centrelines, a pixel between vertices, each of shape (m, 2).
        widths: of the ropes [px].
        colours: of the ropes, BGR.
    """

    lines: tuple[Points, ...]
    widths: tuple[float, ...]
    colours: tuple[tuple[int, int, int], ...]


def _wound(random: Random, length: float, bend: float) -> Points | None:
    """Return a line that winds at random within the picture; None if none does."""
    size = np.array(SIZE, float)
    for _ in range(60):
        knots = np.linspace(0.0, length, max(4, round(length / 90.0)))
        bends = random.uniform(-bend, bend, len(knots))
        s = np.arange(0.0, length)
        angle = random.uniform(-math.pi, math.pi) + np.cumsum(np.interp(s, knots, bends))
        line = np.cumsum(np.column_stack([np.cos(angle), np.sin(angle)]), axis=0)
        low, high = line.min(axis=0), line.max(axis=0)
        if (high - low > size - 2.0 * MARGIN_PX).any():
            continue
        return np.asarray(line - low + MARGIN_PX + random.uniform(0.0, 1.0, 2) * (size - 2.0 * MARGIN_PX - high + low))
    return None


def _nearest(points: Points, line: Points) -> NDArray[np.float64]:
    """Return how far each of the points is from the vertices of a line [px]."""
    return np.asarray(cKDTree(line).query(points)[0])


def _crossings(one: Points, other: Points, *, own: bool) -> list[tuple[float, float]]:
    """Return where two lines cross, as a length along the first [px] and the angle between them [degrees]."""
    tree = cKDTree(other[::2])
    found: list[tuple[float, float]] = []
    for index, point in enumerate(one[::2]):
        others = [each for each in list(tree.query_ball_point(point, 1.6)) if not own or abs(each - index) > 20]
        if not others or (found and 2.0 * index - found[-1][0] < 30.0):
            continue
        a = one[min(2 * index + 3, len(one) - 1)] - one[max(0, 2 * index - 3)]
        b = other[min(2 * others[0] + 3, len(other) - 1)] - other[max(0, 2 * others[0] - 3)]
        turned = abs(a[0] * b[1] - a[1] * b[0]) / np.linalg.norm(a) / np.linalg.norm(b)
        found.append((2.0 * index, math.degrees(math.asin(min(1.0, turned)))))
    return found


def rope_case(
    count: int, shallow: bool, random: Random, crossings: tuple[int, int] = (1, 10), min_angle: float = SHALLOW[0]
) -> RopeCase:
    """Draw some ropes at random, of which the first is crossed so many times, at shallow angles or at others."""
    for _ in range(MAX_TRIES):
        lines = [_wound(random, random.uniform(*LENGTHS_PX), random.uniform(0.008, 0.02)) for _ in range(count)]
        if any(line is None for line in lines):
            continue
        every = [line for line in lines if line is not None]
        crossed = _crossings(every[0], every[0], own=True)
        for line in every[1:]:
            crossed += _crossings(every[0], line, own=False)
        angles = np.array([angle for _, angle in crossed])
        if (
            not crossings[0] <= len(angles) <= crossings[1]
            or angles.min() < min_angle
            or shallow != bool((angles < SHALLOW[1]).any())
        ):
            continue
        # Its beginning is free.
        rest = np.vstack([every[0][60:], *every[1:]])
        width = random.uniform(10.0, 20.0)
        if _nearest(every[0][:30], rest).min() < 1.6 * width:
            continue
        colour = ROPE_BGR[int(random.integers(len(ROPE_BGR)))]
        same = random.random() < 0.6
        colours = [colour if same else ROPE_BGR[int(random.integers(len(ROPE_BGR)))] for _ in every]
        return RopeCase(tuple(every), (width,) * count, tuple(colours))
    raise RuntimeError("no ropes cross so")


def _table(random: Random) -> NDArray[np.float32]:
    bgr = np.array(TABLE_BGR[int(random.integers(len(TABLE_BGR)))], np.float32)
    image = np.empty((SIZE[1], SIZE[0], 3), np.float32)
    v, u = np.indices(image.shape[:2], dtype=np.float32)
    light = 1.0 + random.uniform(-0.15, 0.15) * (u / SIZE[0] - 0.5) + random.uniform(-0.15, 0.15) * (v / SIZE[1] - 0.5)
    if random.random() < 0.4:  # grain of wood
        grain = cv2.GaussianBlur(random.normal(0.0, 1.0, image.shape[:2]).astype(np.float32), (0, 0), 40.0, sigmaY=1.2)
        light += random.uniform(0.01, 0.03) * grain / grain.std()
    image[:] = bgr * light[..., None]
    return image


def render_ropes(case: RopeCase, seed: int) -> Image:
    """Draw the picture: BGR, shape (480, 640, 3)."""
    random = np.random.default_rng(seed)
    image = _table(random)
    shade = np.zeros(image.shape[:2], np.float32)
    shift = random.uniform(-4.0, 4.0, 2)
    for line, width in zip(case.lines, case.widths, strict=True):
        at = np.round((line + shift) * 16.0).astype(np.int32)
        cv2.polylines(shade, [at], False, 1.0, round(width), cv2.LINE_8, 4)
    image *= 1.0 - random.uniform(0.1, 0.4) * cv2.GaussianBlur(shade, (0, 0), 4.0)[..., None]
    pieces: list[tuple[int, NDArray[np.int64]]] = []
    pitch = random.uniform(0.6, 1.2)
    for number, line in enumerate(case.lines):
        count = max(1, round(len(line) / PIECE_PX))
        pieces += [(number, part) for part in np.array_split(np.arange(len(line)), count)]
    order = random.permutation(len(pieces))
    for index in order:
        number, part = pieces[int(index)]
        _draw_piece(image, case, number, part, pitch, random.uniform(0.08, 0.2))
    image = cv2.GaussianBlur(image, (0, 0), 0.8) + random.normal(0.0, 2.0, image.shape)
    return np.asarray(np.clip(image, 0.0, 255.0), dtype=np.uint8)


def _draw_piece(
    image: NDArray[np.float32], case: RopeCase, number: int, part: NDArray[np.int64], pitch: float, depth: float
) -> None:
    """Draw a piece of a rope over what is there, with the strands' twist and its shadow on what lies below."""
    line, half = case.lines[number], 0.5 * case.widths[number]
    own = line[max(0, part[0] - 1) : part[-1] + 2]
    low = np.maximum(own.min(axis=0) - half - 6.0, 0.0).astype(int)
    high = np.minimum(own.max(axis=0) + half + 7.0, np.array(SIZE)).astype(int)
    u, v = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
    at = np.column_stack([u.ravel(), v.ravel()])
    away, nearest = cKDTree(own).query(at)
    nearest = np.minimum(nearest + max(0, part[0] - 1), len(line) - 1)
    along = line[np.minimum(nearest + 1, len(line) - 1)] - line[np.maximum(nearest - 1, 0)]
    away_from = at - line[nearest]
    side = (along[:, 0] * away_from[:, 1] - along[:, 1] * away_from[:, 0]) / np.linalg.norm(along, axis=1)
    x = side / half
    # Beyond its two ends a piece is its neighbours'.
    s = (along * away_from).sum(axis=1) / np.linalg.norm(along, axis=1)
    inside = (away < half) & (np.abs(s) < 1.5)
    box = slice(low[1], high[1]), slice(low[0], high[0])
    region = image[box].reshape(-1, 3)
    region *= (1.0 - 0.3 * np.clip(1.0 - (away - half) / 4.0, 0.0, 1.0) * (np.abs(s) < 1.5))[:, None].astype(np.float32)
    twist = np.sin(2.0 * math.pi * (nearest / (pitch * 2.0 * half) + 0.5 * x))
    light = (0.55 + 0.45 * np.sqrt(np.clip(1.0 - x * x, 0.0, 1.0))) * (1.0 + depth * twist)
    colour = np.array(case.colours[number], np.float32)
    region[inside] = (colour + 12.0) * light[inside, None].astype(np.float32)
    image[box] = region.reshape(image[box].shape)


def followed(case: RopeCase, image: Image) -> Points:
    """Follow the first rope from its first vertex, as if a needle lay before it."""
    line = case.lines[0]
    way = line[0] - line[8]
    needle = MeasuredNeedle(Arc(line[0], math.atan2(way[1], way[0]), 0.0), 60.0, 5.0)
    length = 1.05 * float(arc_lengths(line)[-1])
    return find_centreline(prepare(image, 2), needle, length, (0.5 * SIZE[0], 0.5 * SIZE[1]), 600.0)


def compared(case: RopeCase, found: Points) -> tuple[float, float]:
    """Return the share of the first rope that was followed, and the share of what was followed that is not on it."""
    line, bound = case.lines[0], 0.5 * case.widths[0]
    if len(found) < 2:
        return 0.0, 0.0
    length = float(arc_lengths(found)[-1])
    own = points_at(found, np.arange(0.0, length))
    return float((_nearest(line, own) < bound).mean()), float((_nearest(own, line) > bound).mean())


def measure_rope(name: str, index: int, seed: int) -> tuple[float, float, float]:
    """Return what `compared` does of a picture of a class, and the seconds of CPU that it took."""
    own = [seed, zlib.crc32(name.encode()), index]
    case = ROPES[name](np.random.default_rng(own))
    image = render_ropes(case, int(np.random.default_rng([*own, 1]).integers(2**31)))
    began = time.process_time()
    found = followed(case, image)
    seconds = time.process_time() - began
    return (*compared(case, found), seconds)


@dataclass(frozen=True)
class RopeRow:
    """A class of pictures of ropes.

    Attributes:
        name: of the class.
        frames: number of pictures.
        covered: share of the first rope that was followed, mean.
        covered_90: share of the pictures with 90 % of it followed.
        wrong: share of what was followed that is not on it, mean.
        median_ms: CPU time of a picture.
    """

    name: str
    frames: int
    covered: float
    covered_90: float
    wrong: float
    median_ms: float


def rope_row(name: str, count: int, seed: int) -> RopeRow:
    """Measure pictures of a class."""
    figures = np.array([measure_rope(name, index, seed) for index in range(count)])
    covered, wrong, seconds = figures.T
    ninety = float((covered >= 0.9).mean())
    return RopeRow(name, count, float(covered.mean()), ninety, float(wrong.mean()), 1e3 * float(np.median(seconds)))


ROPES = {f"ropes_{count}": partial(rope_case, count, False) for count in (1, 2, 3)} | {
    "ropes_shallow": partial(rope_case, 3, True),
    "ropes_tangled": partial(rope_case, 3, True, crossings=(2, 6), min_angle=10.0),
}
