"""Finds a dish in a photograph: an ellipse that the edges of its wall agree on, whatever is brighter."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.vision.images import Gray, measured_channel, sampled, shrunk

COARSE_SIDE = 160  # rows or columns of the image in which an ellipse is looked for
MIN_RADIUS, MAX_RADIUS = 0.12, 0.8  # of the shorter side
CELL = 2.0  # px; of votes
RING = 1.03  # ratio of radii of a ring
BINS = 72  # directions
ALIGNMENT = math.cos(math.radians(20.0))  # of an edge's gradient with the direction from the centre
AGREEMENT, FINE_AGREEMENT = 0.012, 0.006  # of the radius, within which an edge agrees with an ellipse
MIN_RATIO = 0.8  # of the axes: a camera tilted by 37 degrees
INNER_RADIUS = 0.82  # of the best supported ellipse, that the wall's inner edge has at least
NORMALS, FINE_REACH = 180, 0.03  # along which the edge is measured; how far, of the radius


@dataclass(frozen=True)
class Ellipse:
    """An ellipse in an image.

    Attributes:
        centre_px: u and v [px].
        major: half of the longer axis [px].
        minor: half of the shorter one [px].
        direction: of the shorter one [rad], from u towards v.
        support: share of the directions in the frame in which an edge agrees.
    """

    centre_px: tuple[float, float]
    major: float
    minor: float
    direction: float
    support: float = 0.0

    @property
    def axes(self) -> np.ndarray:
        """Unit vectors along the shorter and the longer axis, by rows, shape (2, 2)."""
        cosine, sine = math.cos(self.direction), math.sin(self.direction)
        return np.array([[cosine, sine], [-sine, cosine]])

    def points(self, count: int) -> tuple[Points, Points]:
        """Return points of the ellipse and its outward normals, both of shape (count, 2)."""
        turns = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
        circle = np.column_stack([np.cos(turns), np.sin(turns)])
        normals = circle * (self.major, self.minor) @ self.axes
        return self.at(circle), normals / np.hypot(*normals.T)[:, None]

    def coordinates(self, points: Points) -> Points:
        """Return points along the shorter and the longer axis, in halves of them, shape (m, 2)."""
        return np.asarray((points - self.centre_px) @ self.axes.T / (self.minor, self.major))

    def at(self, coordinates: Points) -> Points:
        """Return the points of coordinates, the inverse of `coordinates` [px]."""
        return np.asarray(coordinates * (self.minor, self.major) @ self.axes + self.centre_px)

    def is_cut(self, shape: tuple[int, ...]) -> bool:
        """Say whether a part of it lies outside of an image of a shape (rows, columns)."""
        points, _ = self.points(60)
        return not ((points > 0.0) & (points < np.array(shape[1::-1]) - 1.0)).all()

    def scaled(self, factor: float) -> Ellipse:
        """Return the ellipse in an image enlarged by a factor."""
        shift = 0.5 * (factor - 1.0)
        u, v = (value * factor + shift for value in self.centre_px)
        return replace(self, centre_px=(u, v), major=self.major * factor, minor=self.minor * factor)


@dataclass(frozen=True)
class _Edges:
    """Edges of an image of a shape (rows, columns): their places and unit gradients, both of shape (m, 2)."""

    points: Points
    normals: Points
    shape: tuple[int, ...]

    def radii(self, ellipse: Ellipse) -> tuple[Points, np.ndarray]:
        """Return the edges' coordinates in an ellipse, and which of their gradients lie along its normals."""
        at = ellipse.coordinates(self.points)
        normal = at / (ellipse.minor, ellipse.major)
        along = (normal * (self.normals @ ellipse.axes.T)).sum(axis=1)
        return at, np.abs(along) > ALIGNMENT * np.hypot(*normal.T)


def find_ellipse(image: np.ndarray) -> Ellipse | None:
    """Find the inner edge of a dish's wall, by gradients alone.

    In a small image edges vote for the centres of circles along their gradients; the image is stretched in a few
    directions beside, in which the ellipse of a tilted camera is nearly a circle. Around the centres with the most
    votes, random samples of five edges give ellipses, and the one is kept that edges in the most directions agree on,
    within a share of its radius. Of concentric edges, as of a wall and a lid, the innermost is taken that is about as
    well supported as the best. In the full image the edge is measured along the ellipse's normals.

    Args:
        image: shape (rows, columns) or (rows, columns, 3), uint8.

    Returns:
        The ellipse, or None if no edges agree on one.
    """
    factor = max(1.0, min(image.shape[:2]) / COARSE_SIDE)
    size = (round(image.shape[1] / factor), round(image.shape[0] / factor))
    if max(size) > 4 * COARSE_SIDE:  # no frame of a camera
        return None
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if factor > 1.0 else image
    edges = _edges_of(small)
    if len(edges.points) < 40:
        return None
    found: list[tuple[float, Ellipse]] = []
    for ratio, ways in ((1.0, 1), (1.0 / 0.9, 4)):
        for way in range(ways):
            found += _candidates(edges, ratio, math.pi * way / ways)
        if found and max(found, key=lambda each: each[0])[1].support > 0.8:
            break
    if not found:
        return None
    inner = _innermost(edges, max(found, key=lambda each: each[0])[1])
    return _refined(image, inner.scaled(image.shape[1] / small.shape[1]))


def edge_along(gray: Gray, at: Ellipse, reach: float = FINE_REACH) -> Points:
    """Return where an image changes most along the normals of an ellipse, in the stronger sign, shape (m, 2).

    Args:
        gray: shape (rows, columns), uint8.
        at: the ellipse [px].
        reach: how far to look to both sides of it, as a share of its radius.
    """
    step, half = 0.5, int(2.0 * max(4.0, reach * at.major))
    points, normals = at.points(NORMALS)
    offsets = step * np.arange(-half, half + 1)
    profiles = sampled(gray, points[:, None] + offsets[:, None] * normals[:, None])
    # Slope of a line through five samples.
    slopes = (2.0 * (profiles[:, 4:] - profiles[:, :-4]) + profiles[:, 3:-1] - profiles[:, 1:-3]) / (10.0 * step)
    inside = ((points >= 1.0) & (points <= np.array(gray.shape[::-1]) - 2.0)).all(axis=1)
    rows, steepest = np.arange(NORMALS), np.abs(slopes).argmax(axis=1)
    strongest = np.where(inside, slopes[rows, steepest], 0.0)
    sign = 1.0 if np.sum(np.sign(strongest) * np.sqrt(np.abs(strongest))) > 0.0 else -1.0
    slopes = sign * slopes
    steepest = slopes.argmax(axis=1)
    kept = inside & (steepest > 0) & (steepest < slopes.shape[1] - 1)
    kept &= slopes[rows, steepest] > 0.5  # grey levels a pixel
    rows, steepest = rows[kept], steepest[kept]
    before, top, after = (np.abs(slopes[rows, steepest + shift]) for shift in (-1, 0, 1))
    bend = before - 2.0 * top + after
    part = np.where(bend < 0.0, 0.5 * (before - after) / np.minimum(bend, -1e-9), 0.0)
    return np.asarray(points[rows] + (offsets[steepest + 2] + step * part)[:, None] * normals[rows])


def fitted_robustly(points: Points, begin: Ellipse) -> Ellipse | None:
    """Return the ellipse that most points agree on, near a first one; None if few do."""
    kept, at = points, begin
    for tolerance in (4.0 * FINE_AGREEMENT, 2.0 * FINE_AGREEMENT, FINE_AGREEMENT):
        fitted = _fitted(kept)
        if fitted is None:
            return None
        at = fitted
        kept = points[np.abs(np.hypot(*at.coordinates(points).T) - 1.0) < max(tolerance, 1.0 / at.major)]
        if len(kept) < NORMALS // 4:
            return None
    if math.dist(at.centre_px, begin.centre_px) > 0.05 * begin.major or abs(at.major / begin.major - 1.0) > 0.08:
        return None
    return at


def _edges_of(image: np.ndarray) -> _Edges:
    """Return the points of an image whose gradient is greatest along its own direction, at most 3000."""
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
    along_u, along_v = (cv2.Sobel(smooth, cv2.CV_32F, *order, scale=0.125) for order in ((1, 0), (0, 1)))
    strength = np.hypot(along_u, along_v)
    if image.ndim == 3:  # of the colour that changes most
        most = strength.argmax(axis=2)[..., None]
        along_u, along_v, strength = (np.take_along_axis(a, most, axis=2)[..., 0] for a in (along_u, along_v, strength))
    rows, columns = (index + 1 for index in np.nonzero(strength[1:-1, 1:-1] >= 4.0))
    value = strength[rows, columns]
    normals = np.column_stack([along_u[rows, columns], along_v[rows, columns]]) / value[:, None]
    right, down = np.rint(normals).astype(int).T
    thin = (value >= strength[rows + down, columns + right]) & (value > strength[rows - down, columns - right])
    chosen = np.flatnonzero(thin)
    chosen = np.sort(chosen[np.argsort(value[chosen], kind="stable")[-3000:]])  # The weak ones are texture.
    return _Edges(
        np.column_stack([columns, rows])[chosen].astype(float), normals[chosen].astype(float), image.shape[:2]
    )


def _candidates(edges: _Edges, ratio: float, direction: float) -> list[tuple[float, Ellipse]]:
    """Return ellipses with their scores, of edges stretched in a direction by a ratio."""
    along = np.array([math.cos(direction), math.sin(direction)])
    stretch = np.eye(2) + (ratio - 1.0) * np.outer(along, along)
    back = np.linalg.inv(stretch)
    normals = edges.normals @ back
    moved = _Edges(edges.points @ stretch, normals / np.hypot(*normals.T)[:, None], edges.shape)
    rows, columns = edges.shape
    side = min(edges.shape)
    corners = np.array([(0, 0), (columns, 0), (0, rows), (columns, rows)], float) @ stretch
    low, high = corners.min(axis=0) - 0.15 * side, corners.max(axis=0) + 0.15 * side
    wide, tall = np.ceil((high - low) / CELL).astype(int)
    radii = np.arange(MIN_RADIUS * side, MAX_RADIUS * side, CELL)
    steps = np.concatenate([-radii, radii])[:, None, None]
    cells = np.floor((moved.points + steps * moved.normals - low) / CELL).astype(int).reshape(-1, 2)
    cells = cells[((cells >= 0) & (cells < (wide, tall))).all(axis=1)]
    votes = np.bincount(cells[:, 1] * wide + cells[:, 0], minlength=wide * tall).reshape(tall, wide)
    votes = cv2.GaussianBlur(votes.astype(np.float32), (0, 0), 1.5)
    votes -= cv2.blur(votes, (31, 31))
    found = []
    for _ in range(4):
        _, _, _, (column, row) = cv2.minMaxLoc(votes)
        votes[max(0, row - 4) : row + 5, max(0, column - 4) : column + 5] = -np.inf
        found += _around(edges, moved, low + CELL * (np.array([column, row]) + 0.5), back)
    return found


def _around(edges: _Edges, moved: _Edges, centre: np.ndarray, back: np.ndarray) -> list[tuple[float, Ellipse]]:
    """Return the ellipses around a centre in the stretched image, with their scores.

    Args:
        edges: of the image.
        moved: the same in the stretched image.
        centre: in the stretched image, shape (2,) [px].
        back: matrix that takes points of the stretched image back, shape (2, 2).
    """
    smallest, largest = MIN_RADIUS * min(edges.shape), MAX_RADIUS * min(edges.shape)
    offset = moved.points - centre
    away = np.hypot(*offset.T)
    facing = np.abs((offset * moved.normals).sum(axis=1)) > ALIGNMENT * away
    rings = (np.log(np.maximum(away, 1e-9) / smallest) / math.log(RING)).astype(int)
    marks = np.zeros((int(math.log(largest / smallest) / math.log(RING)) + 2, BINS), np.bool_)
    inside = facing & (away >= smallest) & (rings < len(marks))
    marks[rings[inside], _sectors(offset[inside])] = True
    spread = marks.copy()  # An ellipse is no circle: it lies in several rings.
    for shift in (1, 2):
        spread[shift:] |= marks[:-shift]
        spread[:-shift] |= marks[shift:]
    support = spread.sum(axis=1)
    found = []
    for _ in range(2):
        ring = int(support.argmax())
        if support[ring] < 0.35 * BINS:
            break
        support[max(0, ring - 4) : ring + 5] = 0
        radius = smallest * RING ** (ring + 0.5)
        some = np.flatnonzero(facing & (np.abs(away - radius) < 0.14 * radius))
        points = _through(offset[some[:: 1 + len(some) // 300]], max(0.8, AGREEMENT * radius))
        ellipse = _fitted((centre + points) @ back) if points is not None else None
        if ellipse is None:
            continue
        share, seen = _support(edges, ellipse)
        if seen >= 0.5 and share >= _needed(seen):
            score = share * math.sqrt(seen) * (ellipse.major / min(edges.shape)) ** 0.25
            found.append((score, replace(ellipse, support=share)))
    return found


def _sectors(offsets: Points) -> np.ndarray:
    """Return in which of `BINS` directions offsets lie, shape (m,)."""
    return ((np.arctan2(offsets[:, 1], offsets[:, 0]) / (2.0 * np.pi) + 1.0) * BINS).astype(int) % BINS


def _support(edges: _Edges, ellipse: Ellipse) -> tuple[float, float]:
    """Return in which share of the directions in the frame edges agree with an ellipse, and the share in the frame."""
    points, _ = ellipse.points(BINS)
    inside = ((points > 1.0) & (points < np.array(edges.shape[::-1]) - 2.0)).all(axis=1)
    if not inside.any():
        return 0.0, 0.0
    at, facing = edges.radii(ellipse)
    agree = facing & (np.abs(np.hypot(*at.T) - 1.0) < max(0.8 / ellipse.major, AGREEMENT))
    marks = np.zeros(BINS, bool)
    marks[_sectors(at[agree])] = True
    return float((marks & inside).sum() / inside.sum()), float(inside.mean())


def _needed(seen: float) -> float:
    """Return the support that an ellipse needs of which a share lies in the frame: of a short arc chance is more."""
    return 0.6 + 0.5 * (1.0 - seen)


def _innermost(edges: _Edges, best: Ellipse) -> Ellipse:
    """Return the innermost of the edges within the best that are about as well supported.

    Wall and lid are at different heights: seen by a tilted camera their edges are not concentric.
    """
    inner = best
    for _ in range(4):  # edges of wall and lid
        at, facing = edges.radii(inner)
        away = np.hypot(*at.T)
        outer = 1.0 - max(1.5 * AGREEMENT, 2.0 / inner.major)
        least = INNER_RADIUS * best.major / inner.major
        near = facing & (away > least) & (away < 1.0 + INNER_RADIUS - least)
        near &= (away < outer) | (away > 2.0 - outer)  # not those of the one that is known
        points = _through(at[near], max(0.8 / inner.major, AGREEMENT))
        found = _fitted(inner.at(points)) if points is not None else None
        if found is None or not INNER_RADIUS * best.major < found.major < 0.99 * inner.major:
            break
        support, seen = _support(edges, found)
        if support < max(0.85 * best.support, _needed(seen)):
            break
        inner = replace(found, support=support)
    return inner


def _through(offsets: Points, tolerance: float) -> Points | None:
    """Return points of the ellipse near a centre that edges in the most directions agree on, by random samples of five.

        r(t) = c_0 + c_1 cos t + c_2 sin t + c_3 cos 2t + c_4 sin 2t

    Args:
        offsets: of the edges from the centre, shape (m, 2).
        tolerance: between an edge and the ellipse, in their unit.

    Returns:
        Offsets of `BINS` points from the centre, shape (BINS, 2); None where no edges agree.
    """
    if len(offsets) < 20:
        return None
    shape = np.zeros(5)
    angles = np.arctan2(offsets[:, 1], offsets[:, 0])
    if not fit_harmonics(angles, np.hypot(*offsets.T), tolerance, 200, BINS, shape):
        return None
    turns = np.linspace(0.0, 2.0 * np.pi, BINS, endpoint=False)
    best = _harmonics(turns) @ shape
    return np.asarray(best[:, None] * np.column_stack([np.cos(turns), np.sin(turns)]))


def _harmonics(turns: np.ndarray) -> np.ndarray:
    """Return the functions of `_through` at some angles, shape (m, 5)."""
    return np.column_stack(
        [np.ones_like(turns), np.cos(turns), np.sin(turns), np.cos(2.0 * turns), np.sin(2.0 * turns)]
    )


def _refined(image: np.ndarray, ellipse: Ellipse) -> Ellipse | None:
    """Return an ellipse measured along its normals, in the image's own pixels."""
    gray = measured_channel(image)
    factor = max(1, round(min(gray.shape) / 960))  # rows or columns are enough to measure in
    gray, at = shrunk(gray, factor), ellipse.scaled(1.0 / factor)
    for reach in (FINE_REACH, 0.5 * FINE_REACH):
        fitted = fitted_robustly(edge_along(gray, at, reach), at)
        if fitted is None:
            break
        at = fitted
    return replace(at, support=ellipse.support).scaled(float(factor)) if at.minor > MIN_RATIO * at.major else None


def _fitted(points: Points) -> Ellipse | None:
    """Return the least-squares ellipse of points; None where there is none near a circle."""
    if len(points) < 6:
        return None
    mean = points.mean(axis=0)
    (u, v), axes, angle = cv2.fitEllipseDirect((points - mean).astype(np.float32))
    minor, major = 0.5 * min(axes), 0.5 * max(axes)
    if not (np.isfinite([u, v, minor, major]).all() and major > 1.0 and minor > MIN_RATIO * major):
        return None
    direction = math.radians(angle) + (0.0 if axes[0] <= axes[1] else 0.5 * math.pi)
    return Ellipse((float(u + mean[0]), float(v + mean[1])), major, minor, direction)


@compiled
def fit_harmonics(angles, radii, tolerance, tries, bins, best):
    """Find by random samples the ellipse near a centre that edges in the most directions agree on.

        r(t) = c_0 + c_1 cos t + c_2 sin t + c_3 cos 2t + c_4 sin 2t

    Args:
        angles: of the edges from the centre, shape (m,) [rad].
        radii: of them [px].
        tolerance: between an edge and the ellipse [px].
        tries: how many samples of five edges are drawn.
        bins: directions that are counted.
        best: filled with c, shape (5,).

    Returns:
        In how many directions an edge agrees.
    """
    count = len(angles)
    basis = np.empty((count, 5))
    sector = np.empty(count, np.int64)
    for index in range(count):
        t = angles[index]
        basis[index, 0] = 1.0
        basis[index, 1], basis[index, 2] = math.cos(t), math.sin(t)
        basis[index, 3], basis[index, 4] = math.cos(2.0 * t), math.sin(2.0 * t)
        sector[index] = int((t / (2.0 * math.pi) + 1.0) * bins) % bins
    state, most = np.uint64(88172645463325252), 0
    picked = np.empty(5, np.int64)
    for _ in range(tries):
        apart = True
        for k in range(5):
            state ^= (state << np.uint64(13)) & np.uint64(0xFFFFFFFFFFFFFFFF)
            state ^= state >> np.uint64(7)
            state ^= (state << np.uint64(17)) & np.uint64(0xFFFFFFFFFFFFFFFF)
            picked[k] = np.int64((state >> np.uint64(11)) % np.uint64(count))
            for other in range(k):
                apart = apart and abs(sector[picked[k]] - sector[picked[other]]) > 2
        if not apart:
            continue
        system, right = np.empty((5, 5)), np.empty(5)
        for k in range(5):
            right[k] = radii[picked[k]]
            for j in range(5):
                system[k, j] = basis[picked[k], j]
        if abs(np.linalg.det(system)) < 1e-3:
            continue
        shape = np.linalg.solve(system, right)
        if math.hypot(shape[1], shape[2]) > 0.2 * shape[0] or math.hypot(shape[3], shape[4]) > 0.12 * shape[0]:
            continue
        marks = np.zeros(bins, np.uint8)
        for index in range(count):
            fitted = 0.0
            for j in range(5):
                fitted += basis[index, j] * shape[j]
            if abs(radii[index] - fitted) < tolerance:
                marks[sector[index]] = 1
        agreeing = int(marks.sum())
        if agreeing > most:
            most = agreeing
            best[:] = shape
    return most
