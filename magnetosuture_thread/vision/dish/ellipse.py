"""Finds a dish in a photograph: an ellipse that the edges of its wall agree on, whatever is brighter."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.vision.dish.find import fit_circle
from magnetosuture_thread.vision.images import measured_channel
from magnetosuture_thread.vision.sampling import within

COARSE_SIDE, FINE_SIDE = 160, 960  # rows or columns of the image in which an ellipse is looked for, and measured
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

    def points(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return points of the ellipse and its outward normals, both of shape (count, 2)."""
        turns = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
        circle = np.column_stack([np.cos(turns), np.sin(turns)])
        points = circle * (self.minor, self.major) @ self.axes + self.centre_px
        normals = circle * (self.major, self.minor) @ self.axes
        return points, normals / np.hypot(*normals.T)[:, None]

    def is_cut(self, shape: tuple[int, ...]) -> bool:
        """Say whether a part of it lies outside of an image of a shape (rows, columns)."""
        points, _ = self.points(60)
        return not ((points > 0.0) & (points < np.array(shape[1::-1]) - 1.0)).all()

    def scaled(self, factor: float) -> Ellipse:
        """Return the ellipse in an image enlarged by a factor."""
        shift = 0.5 * (factor - 1.0)
        u, v = (value * factor + shift for value in self.centre_px)
        return Ellipse((u, v), self.major * factor, self.minor * factor, self.direction, self.support)


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
    side = min(image.shape[:2])
    factor = max(1.0, side / COARSE_SIDE)
    size = (round(image.shape[1] / factor), round(image.shape[0] / factor))
    if max(size) > 4 * COARSE_SIDE:  # no frame of a camera
        return None
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if factor > 1.0 else image
    edges = _edges(small)
    if len(edges) < 40:
        return None
    best: tuple[float, Ellipse] | None = None
    for ratio, ways in ((1.0, 1), (1.0 / 0.9, 4)):
        for way in range(ways):
            for score, ellipse in _candidates(edges, small.shape[:2], ratio, math.pi * way / ways):
                if best is None or score > best[0]:
                    best = score, ellipse
        if best is not None and best[1].support > 0.8:
            break
    if best is None:
        return None
    inner = _innermost(edges, small.shape[:2], best[1])
    scaled = image.shape[1] / small.shape[1]
    return _refined(image, inner.scaled(scaled))


def circle_through(image: np.ndarray, cut: Ellipse) -> tuple[float, float, float] | None:
    """Return u, v and radius of the circle that most of an ellipse's edge lies on [px]; None if there is none.

    A part of an ellipse does not determine its axes: an edge that is off by a pixel looks like a tilt.

    Args:
        image: in which the ellipse was found, uint8.
        cut: the ellipse, a part of which the frame cuts off [px].
    """
    points = _edge_along(measured_channel(image), cut, FINE_REACH * cut.major)
    circle = np.empty(3)
    if not fit_circle(points, max(1.0, FINE_AGREEMENT * cut.major), circle):
        return None
    return float(circle[0]), float(circle[1]), float(circle[2])


def _edges(image: np.ndarray) -> np.ndarray:
    """Return the edges of an image, u, v and the gradient's unit direction, shape (m, 4)."""
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
    along_u = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=0.125)
    along_v = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=0.125)
    strength = cv2.magnitude(along_u.reshape(-1), along_v.reshape(-1)).reshape(along_u.shape)
    if image.ndim == 3:  # of the colour that changes most
        most = strength.argmax(axis=2)[..., None]
        along_u, along_v, strength = (
            np.ascontiguousarray(np.take_along_axis(each, most, axis=2)[..., 0])
            for each in (along_u, along_v, strength)
        )
    edges = np.empty((image.shape[0] * image.shape[1] // 2, 4))
    edges = edges[: thin_edges(along_u, along_v, strength, 4.0, edges)]
    if len(edges) > 3000:  # The weak ones are texture.
        columns, rows = edges[:, :2].T.astype(int)
        strongest = np.argsort(strength[rows, columns], kind="stable")[-3000:]
        edges = edges[np.sort(strongest)]
    return edges.copy()


def _candidates(
    edges: np.ndarray, shape: tuple[int, ...], ratio: float, direction: float
) -> list[tuple[float, Ellipse]]:
    """Return ellipses with their scores, of edges stretched in a direction by a ratio."""
    along = np.array([math.cos(direction), math.sin(direction)])
    stretch = np.eye(2) + (ratio - 1.0) * np.outer(along, along)
    back = np.linalg.inv(stretch)
    moved = np.empty_like(edges)
    moved[:, :2] = edges[:, :2] @ stretch
    normals = edges[:, 2:] @ back
    moved[:, 2:] = normals / np.hypot(*normals.T)[:, None]
    side = min(shape[:2])
    smallest, largest = MIN_RADIUS * side, MAX_RADIUS * side
    corners = np.array([(0, 0), (shape[1], 0), (0, shape[0]), (shape[1], shape[0])], float) @ stretch
    low, high = corners.min(axis=0) - 0.15 * side, corners.max(axis=0) + 0.15 * side
    cells = np.ceil((high - low) / CELL).astype(int)
    votes = np.zeros((cells[1], cells[0]), np.float32)
    vote(moved, smallest, largest, low, CELL, votes)
    votes = cv2.GaussianBlur(votes, (0, 0), 1.5)
    votes -= cv2.blur(votes, (31, 31))
    found = []
    for _ in range(4):
        _, _, _, (column, row) = cv2.minMaxLoc(votes)
        votes[max(0, row - 4) : row + 5, max(0, column - 4) : column + 5] = -np.inf
        centre = low + CELL * (np.array([column, row]) + 0.5)
        found += _around(edges, moved, centre, back, shape)
    return found


def _around(
    edges: np.ndarray, moved: np.ndarray, centre: np.ndarray, back: np.ndarray, shape: tuple[int, ...]
) -> list[tuple[float, Ellipse]]:
    """Return the ellipses around a centre in the stretched image, with their scores.

    Args:
        edges: see `_edges`.
        moved: the same in the stretched image.
        centre: in the stretched image, shape (2,) [px].
        back: matrix that takes points of the stretched image back, shape (2, 2).
        shape: rows and columns of the image.
    """
    smallest, largest = MIN_RADIUS * min(shape), MAX_RADIUS * min(shape)
    rings = int(math.log(largest / smallest) / math.log(RING)) + 2
    marks = np.zeros((rings, BINS), np.uint8)
    ring_support(moved, centre, smallest, RING, ALIGNMENT, marks)
    spread = marks.copy()  # An ellipse is no circle: it lies in several rings.
    for shift in (1, 2):
        spread[shift:] |= marks[:-shift]
        spread[:-shift] |= marks[shift:]
    support = spread.sum(axis=1).astype(float)
    found = []
    offset = moved[:, :2] - centre
    away = np.hypot(*offset.T)
    facing = np.abs((offset * moved[:, 2:]).sum(axis=1)) > ALIGNMENT * away
    for _ in range(2):
        ring = int(support.argmax())
        if support[ring] < 0.35 * BINS:
            break
        support[max(0, ring - 4) : ring + 5] = 0.0
        radius = smallest * RING ** (ring + 0.5)
        near = facing & (np.abs(away - radius) < 0.14 * radius)
        if near.sum() < 20:
            continue
        some = np.flatnonzero(near)
        some = some[:: 1 + len(some) // 300]
        points = _through(offset[some], max(0.8, AGREEMENT * radius))
        ellipse = _fitted((centre + points) @ back) if points is not None else None
        if ellipse is None:
            continue
        support_of, seen = _support(edges, shape, ellipse)
        if seen < 0.5 or support_of < _needed(seen):
            continue
        score = support_of * math.sqrt(seen) * (ellipse.major / min(shape)) ** 0.25
        found.append((score, replace(ellipse, support=support_of)))
    return found


def _support(edges: np.ndarray, shape: tuple[int, ...], ellipse: Ellipse) -> tuple[float, float]:
    """Return in which share of the directions in the frame edges agree with an ellipse, and the share in the frame."""
    points, _ = ellipse.points(BINS)
    rows, columns = shape[:2]
    inside = (points[:, 0] > 1) & (points[:, 1] > 1) & (points[:, 0] < columns - 2) & (points[:, 1] < rows - 2)
    if not inside.any():
        return 0.0, 0.0
    x, y, facing = _facing(edges, ellipse)
    agree = facing & (np.abs(np.hypot(x, y) - 1.0) < max(0.8 / ellipse.major, AGREEMENT))
    bins = ((np.arctan2(y[agree], x[agree]) / (2.0 * np.pi) + 1.0) * BINS).astype(int) % BINS
    marks = np.zeros(BINS, bool)
    marks[bins] = True
    return float((marks & inside).sum() / inside.sum()), float(inside.mean())


def _innermost(edges: np.ndarray, shape: tuple[int, ...], best: Ellipse) -> Ellipse:
    """Return the innermost of the edges within the best that are about as well supported.

    Wall and lid are at different heights: seen by a tilted camera their edges are not concentric.
    """
    enough = 0.85 * best.support
    inner = best
    for _ in range(4):  # edges of wall and lid
        x, y, facing = _facing(edges, inner)
        away = np.hypot(x, y)
        outer = 1.0 - max(1.5 * AGREEMENT, 2.0 / inner.major)
        least = INNER_RADIUS * best.major / inner.major
        near = facing & (away > least) & (away < 1.0 + INNER_RADIUS - least)
        near &= (away < outer) | (away > 2.0 - outer)  # not those of the one that is known
        if near.sum() < 20:
            break
        points = _through(np.column_stack([x, y])[near], max(0.8 / inner.major, AGREEMENT))
        found = (
            _fitted(points * (inner.minor, inner.major) @ inner.axes + inner.centre_px) if points is not None else None
        )
        if found is None or not INNER_RADIUS * best.major < found.major < 0.99 * inner.major:
            break
        support, seen = _support(edges, shape, found)
        if support < max(enough, _needed(seen)):
            break
        inner = replace(found, support=support)
    return inner


def _needed(seen: float) -> float:
    """Return the support that an ellipse needs of which a share lies in the frame: of a short arc chance is more."""
    return 0.6 + 0.5 * (1.0 - seen)


def _through(offsets: np.ndarray, tolerance: float) -> np.ndarray | None:
    """Return points of the curve around a centre that most offsets from it agree on, shape (BINS, 2); None for none."""
    best, turns = np.zeros(5), np.linspace(0.0, 2.0 * np.pi, BINS, endpoint=False)
    angles = np.arctan2(offsets[:, 1], offsets[:, 0])
    if not fit_harmonics(angles, np.hypot(*offsets.T), tolerance, 200, BINS, best):
        return None
    cosine, sine = np.cos(turns), np.sin(turns)
    radii = np.column_stack([np.ones(BINS), cosine, sine, np.cos(2 * turns), np.sin(2 * turns)]) @ best
    return np.asarray(radii[:, None] * np.column_stack([cosine, sine]))


def _facing(edges: np.ndarray, ellipse: Ellipse) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return edges along the axes of an ellipse, see `_in_axes`, and whether their gradients lie along its normals."""
    x, y = _in_axes(edges[:, :2], ellipse)
    normal = np.column_stack([x / ellipse.minor, y / ellipse.major])
    along = (normal * (edges[:, 2:] @ ellipse.axes.T)).sum(axis=1)
    return x, y, np.abs(along) > ALIGNMENT * np.hypot(*normal.T)


def _in_axes(points: np.ndarray, ellipse: Ellipse) -> tuple[np.ndarray, np.ndarray]:
    """Return points along the shorter and the longer axis, in halves of them."""
    x, y = ((points - ellipse.centre_px) @ ellipse.axes.T).T
    return x / ellipse.minor, y / ellipse.major


def _refined(image: np.ndarray, ellipse: Ellipse) -> Ellipse | None:
    """Return an ellipse measured along its normals, in the image's own pixels."""
    gray = measured_channel(image)
    factor = max(1, round(min(gray.shape) / FINE_SIDE))
    if factor > 1:
        size = (gray.shape[1] // factor, gray.shape[0] // factor)
        gray = cv2.resize(gray[: size[1] * factor, : size[0] * factor], size, interpolation=cv2.INTER_AREA)
    at = ellipse.scaled(1.0 / factor)
    for share in (FINE_REACH, 0.5 * FINE_REACH):
        points = _edge_along(gray, at, share * at.major)
        fitted = _fitted_robustly(points, at)
        if fitted is None:
            break
        at = fitted
    at = Ellipse(at.centre_px, at.major, at.minor, at.direction, ellipse.support)
    return at.scaled(float(factor)) if at.minor > MIN_RATIO * at.major else None


def _edge_along(gray: np.ndarray, at: Ellipse, reach: float) -> np.ndarray:
    """Return where an image changes most along the normals of an ellipse, in the stronger sign, shape (m, 2)."""
    reach = max(4.0, reach)
    points, normals = at.points(NORMALS)
    found = np.zeros((NORMALS, 2))
    steepest(gray, points, normals, reach, 0.5, 0, found)
    sign = 1 if np.sum(np.sign(found[:, 1]) * np.sqrt(np.abs(found[:, 1]))) > 0.0 else -1
    steepest(gray, points, normals, reach, 0.5, sign, found)
    seen = np.abs(found[:, 1]) > 0.5
    return np.asarray(points[seen] + found[seen, :1] * normals[seen])


def _fitted_robustly(points: np.ndarray, begin: Ellipse) -> Ellipse | None:
    """Return the ellipse that most points agree on, near a first one; None if few do."""
    kept, at = points, begin
    for tolerance in (4.0 * FINE_AGREEMENT, 2.0 * FINE_AGREEMENT, FINE_AGREEMENT):
        at_or_none = _fitted(kept)
        if at_or_none is None:
            return None
        at = at_or_none
        away = np.hypot(*_in_axes(points, at))
        kept = points[np.abs(away - 1.0) < max(tolerance, 1.0 / at.major)]
        if len(kept) < NORMALS // 4:
            return None
    if math.dist(at.centre_px, begin.centre_px) > 0.05 * begin.major or abs(at.major / begin.major - 1.0) > 0.08:
        return None
    return at


def _fitted(points: np.ndarray) -> Ellipse | None:
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
def thin_edges(along_u, along_v, strength, minimum, edges):
    """Fill in the points whose gradient is greatest along its own direction.

    Args:
        along_u: gradient along u, shape (rows, columns).
        along_v: gradient along v.
        strength: its length.
        minimum: that it has at least.
        edges: filled with u, v and the gradient's unit direction, shape (n, 4).

    Returns:
        How many there are, at most n.
    """
    rows, columns = strength.shape
    count = 0
    for row in range(1, rows - 1):
        for column in range(1, columns - 1):
            value = strength[row, column]
            if value < minimum:
                continue
            x, y = along_u[row, column] / value, along_v[row, column] / value
            step_u, step_v = int(np.rint(x)), int(np.rint(y))
            if value < strength[row + step_v, column + step_u] or value <= strength[row - step_v, column - step_u]:
                continue
            if count == len(edges):
                return count
            edges[count, 0], edges[count, 1], edges[count, 2], edges[count, 3] = column, row, x, y
            count += 1
    return count


@compiled
def vote(edges, smallest, largest, origin, cell, votes):
    """Let each edge vote for the centres of the circles that it may be of: both ways along its gradient.

    Args:
        edges: see `thin_edges`.
        smallest: radius [px].
        largest: radius [px].
        origin: u and v of the first cell's corner [px].
        cell: side of a cell [px].
        votes: counted up, shape (rows, columns).
    """
    rows, columns = votes.shape
    count = int((largest - smallest) / cell) + 1
    for index in range(len(edges)):
        for sign in (-1.0, 1.0):
            for step in range(count):
                r = sign * (smallest + step * cell)
                column = int((edges[index, 0] + r * edges[index, 2] - origin[0]) / cell)
                row = int((edges[index, 1] + r * edges[index, 3] - origin[1]) / cell)
                if 0 <= row < rows and 0 <= column < columns:
                    votes[row, column] += 1.0


@compiled
def ring_support(edges, centre, smallest, ratio, alignment, directions):
    """Mark in which directions from a centre, and in which rings of radii, there are edges that face it.

    Args:
        edges: see `thin_edges`.
        centre: u and v [px].
        smallest: radius of the first ring [px].
        ratio: of a ring's outer radius to its inner one.
        alignment: least cosine between gradient and direction.
        directions: filled, shape (rings, directions).
    """
    rings, bins = directions.shape
    scale = 1.0 / math.log(ratio)
    for index in range(len(edges)):
        x, y = edges[index, 0] - centre[0], edges[index, 1] - centre[1]
        r = math.hypot(x, y)
        if r < smallest or abs(x * edges[index, 2] + y * edges[index, 3]) < alignment * r:
            continue
        ring = int(math.log(r / smallest) * scale)
        if ring < rings:
            directions[ring, int((math.atan2(y, x) / (2.0 * math.pi) + 1.0) * bins) % bins] = 1


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


@compiled
def steepest(gray, points, normals, reach, step, sign, found):
    """Find the steepest rise or fall of an image along normals.

    Args:
        gray: shape (rows, columns), uint8.
        points: where the normals begin, shape (n, 2) [px].
        normals: unit vectors, shape (n, 2).
        reach: how far to look to both sides [px].
        step: between samples [px].
        sign: 1 for rises, -1 for falls, 0 for both.
        found: filled with the offset along the normal [px] and the slope there, shape (n, 2); a slope of 0: none.
    """
    count = 2 * int(reach / step) + 1
    profile = np.empty(count)
    half = count // 2
    for index in range(len(points)):
        found[index, 1] = 0.0
        u, v = points[index]
        if u < 1.0 or v < 1.0 or u > gray.shape[1] - 2.0 or v > gray.shape[0] - 2.0:
            continue
        for k in range(count):
            s = (k - half) * step
            profile[k] = within(gray, u + s * normals[index, 0], v + s * normals[index, 1])
        best, at = 0.0, -1
        for k in range(2, count - 2):
            slope = (2.0 * (profile[k + 2] - profile[k - 2]) + profile[k + 1] - profile[k - 1]) / (10.0 * step)
            score = abs(slope) if sign == 0 else sign * slope
            if score > best:
                best, at = score, k
        if at < 3 or at > count - 4:
            continue
        near = np.empty(3)
        for j in range(3):
            k = at - 1 + j
            near[j] = abs(2.0 * (profile[k + 2] - profile[k - 2]) + profile[k + 1] - profile[k - 1]) / (10.0 * step)
        bend = near[0] - 2.0 * near[1] + near[2]
        part = 0.5 * (near[0] - near[2]) / bend if bend < 0.0 else 0.0
        found[index, 0] = (at - half + part) * step
        found[index, 1] = (profile[at + 1] - profile[at - 1]) / (2.0 * step)
