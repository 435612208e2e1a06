"""Finds the petri dish, how far the camera over it is tilted, and whether it moves.

The dish is a bright disc within a dark rim; without one, as in a photograph, an ellipse that the edges of its wall
agree on, whatever is brighter. A wall and a lid have several edges, its rings: by how much they differ is the doubt of
the scale, and a tilt is one that two of them agree on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.vision.images import Gray, measured_channel, median, middle, sampled, shrunk
from magnetosuture_thread.vision.settings import VisionTrackerSettings

COARSE_SIDE = 160  # rows or columns of the image in which an ellipse is looked for
MIN_RADIUS, MAX_RADIUS = 0.12, 0.8  # of the shorter side
CELL = 2.0  # px; of votes
RING = 1.03  # ratio of radii of a ring
BINS = 72  # directions
ALIGNMENT = math.cos(math.radians(20.0))  # of an edge's gradient with the direction from the centre
AGREEMENT, FINE_AGREEMENT = 0.012, 0.006  # of the radius, within which an edge agrees with an ellipse
MIN_RATIO = 0.8  # of the axes: a camera tilted by 37 degrees
INNER_RADIUS = 0.82  # of one ring of a wall, that another one has at least
MAX_RINGS = 5  # edges of wall and lid
NORMALS, FINE_REACH = 180, 0.03  # along which the edge is measured; how far, of the radius

RAYS, RIM_RAYS = 180, 72  # along which the rim is looked for, and of the quick check
SHARE_OF_RAYS = 0.6  # of the rays must meet the fitted circle
REACH = 0.04  # of the radius, in which the rim is looked for once it is known
AGREEMENT_PX = 2.0
EDGE_LEVEL = 60  # of the circle transform, as of Canny's upper threshold; the lower one is half of it
MIN_CONTRAST = 12.0  # grey levels; of the rim at least, and 0.15 of the floor's brightness

MIN_ANGLE = math.radians(3.5)  # below, light from one side moves the rim as much
TILT_ERROR = math.radians(2.0)  # of a ring's tilt, by light and noise
NEAR = 0.1  # of its distance from the camera, that the dish's radius is at most; more is hardly used over a dish

DARK_FLOOR = 130.0  # grey levels; a dish, or with a given view a frame, whose median is below may have a dark floor
SCALE_ERROR = 0.001  # of a scale by a dark rim: how far its light moves the edge
RING_ERROR = 0.01  # of a radius and a centre by a ring of any other look
GIVEN_ERROR = 0.03  # of a given scale against the dish's diameter, that light and tolerances of a mould may make
WALL = 0.001  # m; thickness of a moulded dish's wall, of which one edge that is seen alone may be either
LONG_SEARCH = 4  # frames without a dish, in one of which it is looked for as in a photograph

NO_DISH = "no dish in the image: show its whole rim in even light, limit the search by region_px, or give its view"

Circle = tuple[float, float, float, int]  # u, v and radius [px], and how many points agree


@dataclass(frozen=True)
class Ellipse:
    """An ellipse in an image.

    Attributes:
        centre_px: u and v [px].
        major: half of the longer axis [px].
        minor: half of the shorter one [px].
        direction: of the shorter one [rad], from u towards v.
    """

    centre_px: tuple[float, float]
    major: float
    minor: float
    direction: float

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


@dataclass(frozen=True)
class Ring:
    """An edge of a dish's wall or lid: its ellipse [px], and the share of the directions in which it is seen."""

    ellipse: Ellipse
    support: float


def find_rings(image: np.ndarray, known: Ellipse | None = None) -> list[Ring]:
    """Find the edges of a dish's wall by gradients alone, the best supported one first.

    In a small image edges vote for the centres of circles along their gradients; where no circle is certain the image
    is stretched in a few directions, in which the ellipse of a tilted camera is nearly a circle. Around the centres
    with the most votes, random samples of five edges give ellipses, and the one is kept that edges in the most
    directions agree on, within a share of its radius; then others near it. In the full image each edge is measured
    along its normals.

    Args:
        image: shape (rows, columns) or (rows, columns, 3), uint8.
        known: an edge that was found before, which comes first [px].
    """
    factor = max(1.0, min(image.shape[:2]) / COARSE_SIDE)
    size = (round(image.shape[1] / factor), round(image.shape[0] / factor))
    if max(size) > 4 * COARSE_SIDE:  # no frame of a camera
        return []
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if factor > 1.0 else image
    factor = image.shape[1] / small.shape[1]
    edges = _edges_of(small)
    if len(edges.points) < 40:
        return []
    if known is not None:
        others = _rings_near(edges, Ring(known.scaled(1.0 / factor), 1.0))
        return [Ring(known, 1.0), *_refined(image, others, factor)]
    found = _candidates(edges, 1.0, 0.0)
    if not found or max(share for _, share, _ in found) < 0.8:
        found += [each for way in range(4) for each in _candidates(edges, 1.0 / 0.9, 0.25 * math.pi * way)]
    if not found:
        return []
    _, share, ellipse = max(found, key=lambda each: each[0])
    best = Ring(ellipse, share)
    return _refined(image, [best, *_rings_near(edges, best)], factor)


def inner_ring(rings: list[Ring], *, outer: bool = False) -> Ellipse:
    """Return the smallest of the rings that are about as well supported as the best, or the largest of them."""
    best = max(ring.support for ring in rings)
    ellipses = [ring.ellipse for ring in rings if ring.support >= 0.85 * best]
    return (max if outer else min)(ellipses, key=lambda each: each.major)


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


def _candidates(edges: _Edges, ratio: float, direction: float) -> list[tuple[float, float, Ellipse]]:
    """Return ellipses with their scores and supports, of edges stretched in a direction by a ratio."""
    along = np.array([math.cos(direction), math.sin(direction)])
    stretch = np.eye(2) + (ratio - 1.0) * np.outer(along, along)
    back = np.linalg.inv(stretch)
    normals = edges.normals @ back
    moved = _Edges(edges.points @ stretch, normals / np.hypot(*normals.T)[:, None], edges.shape)
    return [each for centre in _centres(moved, ratio) for each in _around(edges, moved, centre, back)]


def _centres(edges: _Edges, ratio: float) -> list[Points]:
    """Return the four places with the most votes of edges along their gradients, each of shape (2,).

    The image was stretched by a ratio in some direction.
    """
    side, size = min(edges.shape), np.array(edges.shape[::-1])
    low = -0.15 * side - (ratio - 1.0) * size
    wide, tall = np.ceil((size + 0.15 * side + 2.0 * (ratio - 1.0) * size - low) / CELL).astype(int)
    radii = np.arange(MIN_RADIUS * side, MAX_RADIUS * side, CELL)
    steps = np.concatenate([-radii, radii])[:, None, None]
    cells = np.floor((edges.points + steps * edges.normals - low) / CELL).astype(int).reshape(-1, 2)
    cells = cells[((cells >= 0) & (cells < (wide, tall))).all(axis=1)]
    votes = np.bincount(cells[:, 1] * wide + cells[:, 0], minlength=wide * tall).reshape(tall, wide)
    votes = cv2.GaussianBlur(votes.astype(np.float32), (0, 0), 1.5)
    votes -= cv2.blur(votes, (31, 31))
    found = []
    for _ in range(4):
        _, _, _, (column, row) = cv2.minMaxLoc(votes)
        votes[max(0, row - 4) : row + 5, max(0, column - 4) : column + 5] = -np.inf
        found.append(low + CELL * (np.array([column, row]) + 0.5))
    return found


def _around(edges: _Edges, moved: _Edges, centre: Points, back: np.ndarray) -> list[tuple[float, float, Ellipse]]:
    """Return the ellipses around a centre with their scores and supports.

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
            found.append((score, share, ellipse))
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


def _rings_near(edges: _Edges, best: Ring) -> list[Ring]:
    """Return other edges of a wall or a lid than the best supported one, about as large as it.

    Wall and lid are at different heights: seen by a tilted camera their edges are not concentric.
    """
    at, near = edges.radii(best.ellipse)
    away = np.hypot(*at.T)
    near &= (away > INNER_RADIUS) & (away < 2.0 - INNER_RADIUS)
    found = [best]
    while len(found) < MAX_RINGS:
        last = found[-1].ellipse
        own = np.abs(np.hypot(*edges.radii(last)[0].T) - 1.0) < max(1.5 * AGREEMENT, 2.0 / last.major)
        near &= ~own
        points = _through(at[near], max(0.8 / best.ellipse.major, AGREEMENT))
        ellipse = _fitted(best.ellipse.at(points)) if points is not None else None
        if ellipse is None:
            break
        share, seen = _support(edges, ellipse)
        if share < _needed(seen):
            break
        found.append(Ring(ellipse, share))
    return found[1:]


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
    basis, radii, sectors = (
        _harmonics(np.arctan2(offsets[:, 1], offsets[:, 0])),
        np.hypot(*offsets.T),
        _sectors(offsets),
    )
    picked = np.random.default_rng(0).integers(0, len(offsets), (1000, 5))
    spread = np.diff(np.sort(sectors[picked], axis=1), axis=1).min(axis=1) > 2  # directions apart
    picked = picked[spread][:400]
    systems = basis[picked]
    picked = picked[np.abs(np.linalg.det(systems)) > 1e-3]
    shapes = np.linalg.solve(basis[picked], radii[picked][..., None])[..., 0]
    eccentric, flat = np.hypot(shapes[:, 1], shapes[:, 2]), np.hypot(shapes[:, 3], shapes[:, 4])
    shapes = shapes[(eccentric < 0.2 * shapes[:, 0]) & (flat < 0.12 * shapes[:, 0])]
    if not len(shapes):
        return None
    sample, edge = np.nonzero(np.abs(shapes @ basis.T - radii) < tolerance)
    marks = np.zeros((len(shapes), BINS), np.bool_)
    marks[sample, sectors[edge]] = True
    turns = np.linspace(0.0, 2.0 * np.pi, BINS, endpoint=False)
    best = _harmonics(turns) @ shapes[marks.sum(axis=1).argmax()]
    return np.asarray(best[:, None] * np.column_stack([np.cos(turns), np.sin(turns)]))


def _harmonics(turns: np.ndarray) -> np.ndarray:
    """Return the functions of `_through` at some angles, shape (m, 5)."""
    return np.column_stack(
        [np.ones_like(turns), np.cos(turns), np.sin(turns), np.cos(2.0 * turns), np.sin(2.0 * turns)]
    )


def _refined(image: np.ndarray, rings: list[Ring], scale: float) -> list[Ring]:
    """Return rings of an image shrunk by a scale, measured along their normals in the image's own pixels."""
    gray = measured_channel(image)
    factor = max(1, round(min(gray.shape) / 960))  # rows or columns are enough to measure in
    gray, result = shrunk(gray, factor), []
    for ring in rings:
        at = ring.ellipse.scaled(scale / factor)
        for reach in (FINE_REACH, 0.5 * FINE_REACH):
            fitted = fitted_robustly(edge_along(gray, at, reach), at)
            if fitted is None:
                break
            at = fitted
        if at.minor > MIN_RATIO * at.major:
            result.append(Ring(at.scaled(float(factor)), ring.support))
    return result


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


@dataclass(frozen=True)
class Tilt:
    """The camera's tilt.

    Attributes:
        angle: between its axis and the dish's normal [rad].
        direction: in the image, along which the dish looks shortened [rad], from u towards v.
    """

    angle: float
    direction: float

    def apart(self, other: Tilt) -> float:
        """Return by how much another tilt differs [rad]; a direction and its opposite are one."""
        ends = [each.angle * np.exp(2j * each.direction) for each in (self, other)]
        return float(abs(ends[0] - ends[1]))


def perspective(tail: np.ndarray, heading: np.ndarray, radius: float) -> np.ndarray:
    """Return how a tail and a heading angle in a dish change with a small tilt of the camera, shape (3, 2) [m, m, rad].

    Under a camera at a distance d, a tilt t (its angle, along the direction that is nearer) moves a point p of the dish
    by p (t . p) / d, and so the centre of the rim's ellipse by R^2 t / d, from which points are measured:

        dp = (p p^T - R^2 I) t / d,    d(angle) = (p . n) (h . t) / d,    n = h turned by a right angle

    Args:
        tail: p, shape (2,) [m].
        heading: h, shape (2,).
        radius: R of the dish [m], the share `NEAR` of d.
    """
    aside = np.array([-heading[1], heading[0]])
    moved = np.outer(tail, tail) - radius**2 * np.eye(2)
    return np.vstack([moved, float(tail @ aside) * heading]) * (NEAR / radius)


def unseen_tilt_covariance(tail: np.ndarray, heading: np.ndarray, angle: float, radius: float) -> np.ndarray:
    """Return what a tilt that no ellipse tells leaves unknown, shape (3, 3) [m, m, rad].

    All tilts up to an angle are held to be as likely: along each axis a variance of angle^2 / 4. See `perspective`.
    """
    change = perspective(tail, heading, radius)
    short = 0.5 * (1.0 - math.cos(angle))  # foreshortening, of second order
    lengths = np.array([np.hypot(*tail), np.hypot(*tail), 1.0])
    return np.asarray(0.25 * angle**2 * change @ change.T + np.diag((short * lengths) ** 2))


@dataclass(frozen=True)
class FoundDish:
    """The dish in a frame.

    Attributes:
        view: where it is, once the frame is prepared.
        dark_field: whether the floor is dark, and needle, thread and rim are bright.
        tilt: of the camera; None if there is none to be sure of.
        scale_error: standard deviation of the view's scale, as a share; 0 where the scale is given.
        unseen_tilt: angle of a tilt that the rim would not tell [rad].
        remark: what a user should know of the view; empty if nothing.
        homography: from the frame to the one in which the view holds, shape (3, 3); None where they are the same.
    """

    view: DishView
    dark_field: bool = False
    tilt: Tilt | None = None
    scale_error: float = 0.0
    unseen_tilt: float = 0.0
    remark: str = ""
    homography: np.ndarray | None = None

    def covariance(self, tail: np.ndarray, heading: np.ndarray, radius: float) -> np.ndarray:
        """Return what the view leaves unknown of a tail and a heading in a dish, shape (3, 3) [m, m, rad]."""
        total = self.tilt_covariance(tail, heading, radius)
        total[:2, :2] += self.scale_error**2 * np.outer(tail, tail)  # A wrong scale shifts what is far from the centre.
        return total

    def tilt_covariance(self, tail: np.ndarray, heading: np.ndarray, radius: float) -> np.ndarray:
        """Return what the camera's tilt leaves unknown, shape (3, 3) [m, m, rad]; see `perspective`.

        An ellipse does not tell which side is nearer. Below the angle `unseen_tilt` there is no ellipse.
        """
        if self.tilt is None:
            return unseen_tilt_covariance(tail, heading, self.unseen_tilt, radius)
        angle = -self.tilt.direction - self.view.rotation
        along = np.array([math.cos(angle), math.sin(angle)])  # in the dish frame
        either = perspective(tail, heading, radius) @ (math.tan(self.tilt.angle) * along)
        return np.outer(either, either) + unseen_tilt_covariance(tail, heading, TILT_ERROR, radius)

    @property
    def warning(self) -> str:
        """What makes the measurement worse than it could be; empty if nothing does."""
        tilted = f"the camera is tilted by {math.degrees(self.tilt.angle):.0f} degrees" if self.tilt is not None else ""
        return "; ".join(filter(None, (tilted, self.remark)))

    def straightening(self) -> np.ndarray | None:
        """Return the homography to the frame in which the dish is round: a tilted one is stretched by 1 / cos."""
        if self.tilt is None:
            return self.homography
        along = np.array([math.cos(self.tilt.direction), math.sin(self.tilt.direction)])
        homography = np.eye(3)
        homography[:2, :2] += (1.0 / math.cos(self.tilt.angle) - 1.0) * np.outer(along, along)
        centre = np.array(self.view.centre_px)
        homography[:2, 2] = centre - homography[:2, :2] @ centre
        return homography

    def prepared(self, image: np.ndarray) -> np.ndarray:
        """Return a frame with a bright floor and a round dish."""
        if self.dark_field:
            image = 255 - image
        homography = self.straightening()
        if homography is None:
            return image
        size = image.shape[1::-1]
        return np.asarray(cv2.warpPerspective(image, homography, size, borderMode=cv2.BORDER_REPLICATE))


def see_dish(
    image: np.ndarray, settings: VisionTrackerSettings, diameter: float, *, photographed: bool = True
) -> FoundDish | None:
    """Find the view: what of it is given, and the rest by the dish; None if none is seen.

    Args:
        image: frame, shape (rows, columns) or (rows, columns, 3), uint8.
        settings: what to look for.
        diameter: of the dish [m].
        photographed: whether to look for a dish as in a photograph where there is no other, which takes long.
    """
    gray = measured_channel(image)
    fixed = settings.fixed_view()
    if fixed is not None:
        # Only a dark frame whose negative shows the dish has a dark floor: others are just dark.
        dark = middle(gray[::8, ::8]) < DARK_FLOOR and not _fits(find_dish(gray, diameter), fixed)
        dark = dark and _fits(find_dish(255 - gray, diameter), fixed)
        error = settings.scale_error
        return FoundDish(fixed, dark, None, error, remark=_scale_remark(error), homography=settings.homography())
    for dark_field in (False, True):
        if dark_field:
            gray = 255 - gray
        view = find_dish(gray, diameter)
        if view is None or (dark_field and floor_level(gray, view, diameter) < 255.0 - DARK_FLOOR):
            continue  # A bright rim around a bright floor, as of clear walls.
        radius = 0.5 * diameter / view.metres_per_pixel
        circle = Ellipse(view.centre_px, radius, radius, 0.0)
        rings = find_rings(image, circle)
        edge = inner_ring(rings, outer=settings.rim == "outer") if settings.rim and rings else circle
        if edge is circle:
            found = _by_dark_rim(gray, view, rings, settings, diameter)
        else:
            found = _by_ring(edge, rings, settings, diameter)
        given = _with_given(replace(found, dark_field=dark_field), settings)
        if given is not None:
            return given
    return _photographed(image, settings, diameter) if photographed else None


def _fits(found: DishView | None, given: DishView) -> bool:
    return found is not None and abs(found.metres_per_pixel / given.metres_per_pixel - 1.0) < 1.0 - INNER_RADIUS


def _by_dark_rim(
    gray: Gray, view: DishView, rings: list[Ring], settings: VisionTrackerSettings, diameter: float
) -> FoundDish:
    """Return the dish by a dark rim's inner edge; in doubt as any ring's, unless the wall is as dark as steel."""
    radius = 0.5 * diameter / view.metres_per_pixel
    _, darkest = rim_points(gray, view.centre_px, radius, REACH * radius, 0.5, RIM_RAYS)
    level = settings.max_needle_brightness * floor_level(gray, view, diameter)
    is_wall = len(darkest) > 0 and middle(sampled(gray, darkest)) < level
    error = SCALE_ERROR if is_wall else _doubt(rings, radius, settings, diameter)
    tilt, straight = find_tilt(gray, view, diameter)
    if tilt is not None and not _is_confirmed(tilt, radius, rings):
        return FoundDish(view, scale_error=error, unseen_tilt=tilt.angle)
    return FoundDish(straight, tilt=tilt, scale_error=error, unseen_tilt=0.0 if tilt is not None else MIN_ANGLE)


def _doubt(rings: list[Ring], radius: float, settings: VisionTrackerSettings, diameter: float) -> float:
    """Return the doubt of a scale by a ring of a radius [px]: that of another ring, if the user names none."""
    if len(rings) == 1:
        return max(RING_ERROR, 2.0 * WALL / diameter)
    return max(RING_ERROR, *(abs(ring.ellipse.major / radius - 1.0) for ring in rings if not settings.rim), 0.0)


def _by_ring(edge: Ellipse, rings: list[Ring], settings: VisionTrackerSettings, diameter: float) -> FoundDish:
    """Return the dish by one of its rings; where none was named, all of them make the doubt of the scale."""
    error = _doubt(rings, edge.major, settings, diameter)
    tilt = tilt_of(edge)
    if tilt is not None and not _is_confirmed(tilt, edge.major, rings):
        # One edge that is no circle may be a tilted one, or two edges of which each is seen in a part.
        radius = 0.5 * (edge.major + edge.minor)
        error = max(error, edge.major / radius - 1.0)
        return FoundDish(DishView(edge.centre_px, 0.5 * diameter / radius), False, None, error, tilt.angle)
    view = DishView(edge.centre_px, 0.5 * diameter / edge.major)
    return FoundDish(view, False, tilt, error, MIN_ANGLE if tilt is None else 0.0)


def _is_confirmed(tilt: Tilt, radius: float, rings: list[Ring]) -> bool:
    """Say whether another ring than that of a radius [px] has the same tilt."""
    for ring in rings:
        other = tilt_of(ring.ellipse)
        if other is not None and abs(ring.ellipse.major / radius - 1.0) > AGREEMENT and tilt.apart(other) < TILT_ERROR:
            return True
    return False


def _scale_remark(error: float) -> str:
    """Return what a user should know of a scale of a standard deviation, given as a share; empty if nothing."""
    remedy = "name the wall's edge by rim, or measure metres_per_pixel"
    return f"the scale is known to {100.0 * error:.0f} % only: {remedy}" if error > RING_ERROR else ""


def _with_given(found: FoundDish, settings: VisionTrackerSettings) -> FoundDish | None:
    """Return a dish with what is given of its view, as by a calibration; None if it is another one."""
    centre, scale = settings.dish_centre_px, settings.metres_per_pixel
    view = replace(found.view, rotation=settings.camera_rotation)
    remark = ""
    if not (centre or scale):
        return replace(found, view=view, remark=_scale_remark(found.scale_error))
    error = found.scale_error
    if scale:
        apart = abs(view.metres_per_pixel / scale - 1.0)
        if apart > 1.0 - INNER_RADIUS:
            return None
        if apart > max(error, GIVEN_ERROR):
            remark = f"metres_per_pixel, which is used, is {apart:.0%} off the dish's diameter: one of them is wrong"
        error = apart if remark else settings.scale_error
        view = replace(view, metres_per_pixel=scale)
    if centre:
        view = replace(view, centre_px=(centre[0], centre[1]))
    unseen_tilt = found.unseen_tilt if found.unseen_tilt > MIN_ANGLE else 0.0
    return replace(found, view=view, tilt=None, scale_error=error, unseen_tilt=unseen_tilt, remark=remark)


def _photographed(image: np.ndarray, settings: VisionTrackerSettings, diameter: float) -> FoundDish | None:
    """Find a dish by its rings alone, as in a photograph: cut, saturated, with a lid, on any ground."""
    rings = find_rings(image)
    if not rings:
        return None
    gray, edge = measured_channel(image), inner_ring(rings, outer=settings.rim == "outer")
    found = _by_ring(edge, rings, settings, diameter)
    if tilt_of(edge) is not None and edge.is_cut(image.shape):
        view = _find_cut_dish(gray, edge, diameter)
        if view is None:
            return None
        found = replace(found, view=view, tilt=None, unseen_tilt=math.radians(10.0))
    dark_field = floor_level(gray, found.view, diameter) < 64.0
    return _with_given(replace(found, dark_field=dark_field), settings)


class DishWatch:
    """Gives the view for each frame.

    The dish is found once. In every frame its rim is looked at again: as long as it is where it was, the
    view stays as it is. Where it is not, there is no view until several frames in a row agree on a new one.

    Args:
        settings: what to look for.
        diameter: inner diameter of the dish [m].

    Attributes:
        found: the dish as it was found; None if it was not yet.
    """

    def __init__(self, settings: VisionTrackerSettings, diameter: float) -> None:
        self._settings, self._diameter, self._fixed = settings, diameter, settings.fixed_view()
        self.found: FoundDish | None = None
        self._anew: list[FoundDish] = []
        self._searched = 0  # frames in a row without a dish

    @property
    def view(self) -> DishView | None:
        """Where the dish is; None if it was not found yet."""
        return self._fixed or (self.found.view if self.found is not None else None)

    @property
    def scale_error(self) -> float:
        """Standard deviation of the view's scale, as a share; see `FoundDish`."""
        return self.found.scale_error if self.found is not None else 0.0

    def look(self, image: np.ndarray) -> tuple[str, np.ndarray]:
        """Look at the rim in a frame.

        Args:
            image: shape (rows, columns) or (rows, columns, 3), uint8.

        Returns:
            Why the view must not be used in this frame, empty if it may; and the frame as it is measured on, see
            `FoundDish.prepared`.
        """
        if self._fixed is not None or self.found is None:
            self.found = self._search(image)
            if self.found is None:
                given = "; or correct metres_per_pixel, by which the dish has another size"
                return NO_DISH + (given if self._settings.metres_per_pixel else ""), image
            return "", self.found.prepared(image)
        prepared = self.found.prepared(image)
        gray, view = measured_channel(prepared), self.found.view
        shift, rays = rim_shift(gray, view.centre_px, 0.5 * self._diameter / view.metres_per_pixel)
        if rays >= 0.4 * RIM_RAYS and shift < 1.0:  # px
            self._anew, self._searched = [], 0
            return "", prepared
        found = self._search(image)
        if found is None:
            self._anew = []
            return "too little of the dish is seen: uncover its rim, or give its view", prepared
        if self._agree(found, self.found):  # A rim that is not dark is seen by its ellipse only.
            self._anew = []
            return "", prepared
        if self._anew and not self._agree(found, self._anew[-1]):
            self._anew = []
        self._anew.append(found)
        if len(self._anew) < 3:  # frames in a row that must agree on a new view
            return "the dish is not where it was", prepared
        self.found, self._anew = found, []
        return "", found.prepared(image)

    def _search(self, image: np.ndarray) -> FoundDish | None:
        """Look for the dish; in most frames only as long as a live node has time for, until one was found."""
        long = bool(self._anew) or self._searched % LONG_SEARCH == 0
        found = see_dish(image, self._settings, self._diameter, photographed=long)
        self._searched = 0 if found is not None else self._searched + 1
        return found

    def _agree(self, one: FoundDish, other: FoundDish) -> bool:
        """Say whether two dishes are one: within 1 px and 0.5 % of scale, or within two standard deviations."""
        slack = 2.0 * max(one.scale_error, other.scale_error)
        scale = one.view.metres_per_pixel
        apart = math.dist(one.view.centre_px, other.view.centre_px)
        near = apart < max(1.0, min(slack, 2.0 * RING_ERROR) * 0.5 * self._diameter / scale)
        return near and abs(scale / other.view.metres_per_pixel - 1.0) < max(0.005, slack)


def find_dish(gray: np.ndarray, diameter: float) -> DishView | None:
    """Find the dish by the inner edge of its rim.

    A circle transform of a small image gives the first guess; then rays from its centre meet the edge
    where the brightness falls half-way to the rim's dark, with sub-pixel precision, and a circle is
    fitted to these points, those far from it left out. The edge gives the radius. The centre is that of
    the rim's darkest ring, which light from one side doesn't shift.

    Args:
        gray: image, shape (rows, columns), uint8.
        diameter: the dish's inner diameter [m], which gives the scale.

    Returns:
        The view, or None if no dish is seen: too few rays agree on a circle.
    """
    for rows in (60, 120):  # of the small image; the second only if the first fails
        guess = _first_guess(gray, rows)
        fitted = _fit_rim(gray, guess) if guess is not None else None
        if fitted is None or fitted[0][3] < SHARE_OF_RAYS * RAYS:
            continue
        (u, v, radius, _), _, ring = fitted
        if ring is not None and ring[3] >= SHARE_OF_RAYS * RAYS and math.dist(ring[:2], (u, v)) < AGREEMENT_PX:
            u, v = ring[:2]
        elif _is_saturated(gray, (u, v), radius):  # Then the edge lies where the light makes it seem to.
            continue
        return DishView((u, v), 0.5 * diameter / radius)
    return None


def _is_saturated(gray: Gray, centre: tuple[float, float], radius: float) -> bool:
    """Say whether the floor near the rim is as bright as the image can show."""
    points, _ = Ellipse(centre, 0.93 * radius, 0.93 * radius, 0.0).points(64)
    columns, rows = np.clip(np.rint(points).astype(int), 0, np.array(gray.shape[::-1]) - 1).T
    return float(np.mean(gray[rows, columns] >= 253)) > 0.15


def _fit_rim(gray: Gray, guess: tuple[float, float, float]) -> tuple[Circle, Points, Circle | None] | None:
    """Return the circle along a rim's inner edge, that edge, and the circle along the rim's darkest ring.

    None if too few rays agree on the first.
    """
    circle, edges, darkest = (*guess, 0), np.empty((0, 2)), np.empty((0, 2))
    # In shares of the radius: by a first guess, and once it is known.
    for reach, step in ((0.12, 1.0), (REACH, 0.5)):
        u, v, radius, _ = circle
        edges, darkest = rim_points(gray, (u, v), radius, reach * radius, step, RAYS)
        found = fit_circle(edges, AGREEMENT_PX)
        if found is None:
            return None
        circle = found
    return circle, edges, fit_circle(darkest, 0.5 * AGREEMENT_PX)


def _find_cut_dish(gray: Gray, ellipse: Ellipse, diameter: float) -> DishView | None:
    """Find a dish that the frame cuts off, near an ellipse, by what is seen of its rim; None if too few rays agree.

    A part of an ellipse does not determine its axes: an edge that is off by a pixel looks like a tilt.
    """
    fitted = _fit_rim(gray, (*ellipse.centre_px, 0.5 * (ellipse.major + ellipse.minor)))
    if fitted is None:
        return None
    (u, v, radius, _), edges, ring = fitted
    points, _ = Ellipse((u, v), radius, radius, 0.0).points(RAYS)
    inside = ((points > 0.0) & (points < np.array(gray.shape[::-1]) - 1.0)).all(axis=1).sum()
    if ring is None or ring[3] < 0.75 * inside or inside < 0.4 * RAYS:
        return None
    # By an edge that light shifts, a part of a circle tells its centre and its radius apart badly.
    return DishView(ring[:2], 0.5 * diameter / middle(np.hypot(*(edges - ring[:2]).T)))


def rim_shift(gray: np.ndarray, centre: tuple[float, float], radius: float) -> tuple[float, int]:
    """Look quickly whether the rim is where it was.

    Args:
        gray: image, shape (rows, columns), uint8.
        centre: the dish's centre, as `find_dish` gave it [px].
        radius: and its radius [px].

    Returns:
        How far the circle through the rim's darkest ring has moved since [px], and how many of the `RIM_RAYS` rays
        agree on it.
    """
    edges, darkest = rim_points(gray, centre, radius, 7.0, 1.0, RIM_RAYS)
    circle = fit_circle(darkest if len(darkest) >= len(edges) // 2 else edges, 0.5 * AGREEMENT_PX)
    return (math.dist(circle[:2], centre), circle[3]) if circle is not None else (0.0, 0)


def _first_guess(gray: np.ndarray, rows: int) -> tuple[float, float, float] | None:
    """Return centre and radius of the strongest large circle, found in a small image of about so many rows [px]."""
    factor = max(1, round(min(gray.shape) / rows))
    half = cv2.resize(gray, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) if factor > 1 else gray
    size = (gray.shape[1] // factor, gray.shape[0] // factor)
    small = cv2.resize(half, size, interpolation=cv2.INTER_AREA)
    if np.count_nonzero(cv2.Canny(small, EDGE_LEVEL // 2, EDGE_LEVEL)) > 0.3 * small.size:
        return None  # All is texture, in which circles agree by chance.
    minimum = min(small.shape)
    circles = cv2.HoughCircles(
        small,
        cv2.HOUGH_GRADIENT,
        dp=1,
        minDist=minimum,
        param1=EDGE_LEVEL,
        param2=0.2 * rows,
        minRadius=int(0.25 * minimum),
        maxRadius=int(0.55 * minimum),
    )
    if circles is None:
        return None
    u, v, radius = (float(value) for value in np.asarray(circles).reshape(-1, 3)[0])
    offset = 0.5 * (factor - 1)
    return u * factor + offset, v * factor + offset, radius * factor


def rim_points(
    gray: Gray, centre: tuple[float, float], radius: float, reach: float, step: float, rays: int
) -> tuple[Points, Points]:
    """Return where rays from a dish's centre meet its rim: its inner edge, and its darkest ring, both of shape (m, 2).

    The edge is where the light falls half-way to the rim's dark. Beyond its darkest ring a rim is brighter again; a
    plain edge has no such ring.

    Args:
        gray: shape (rows, columns), uint8.
        centre: u and v, about [px].
        radius: about [px].
        reach: how far inside and outside of the radius to look [px].
        step: between samples [px].
        rays: how many there are.
    """
    turns = 2.0 * np.pi * np.arange(rays) / rays
    ways, count = np.column_stack([np.cos(turns), np.sin(turns)]), int(2.0 * reach / step)
    radii, places = radius - reach + step * np.arange(count), np.arange(count)
    profiles = sampled(gray, centre + radii[:, None] * ways[:, None])
    inside, dark = median(profiles[:, : max(3, count // 8)], axis=1), profiles.min(axis=1)
    half = 0.5 * (inside + dark)
    index = (profiles < half[:, None]).argmax(axis=1)
    seen = (inside - dark >= np.maximum(MIN_CONTRAST, 0.15 * inside)) & (index > 0)
    profiles, ways, index, half = profiles[seen], ways[seen], index[seen], half[seen]
    row = np.arange(len(profiles))
    part = (profiles[row, index - 1] - half) / (profiles[row, index - 1] - profiles[row, index])
    edges = centre + (radii[index - 1] + part * step)[:, None] * ways
    end = np.minimum(index + int(max(4.0, 0.02 * radius) / step) + 1, count - 1)  # the rim's breadth
    ahead = (places >= index[:, None]) & (places <= end[:, None])
    lowest = np.where(ahead, profiles, np.inf).argmin(axis=1)
    beyond = np.where(ahead & (places >= lowest[:, None]), profiles, -np.inf).max(axis=1)
    is_ring = (lowest > 0) & (lowest < end) & (beyond > profiles[row, lowest] + 0.5 * MIN_CONTRAST)
    row, lowest, ways = row[is_ring], lowest[is_ring], ways[is_ring]
    left, low, right = (profiles[row, lowest + apart] for apart in (-1, 0, 1))
    bend = left - 2.0 * low + right
    curved = bend > 0.0
    at = radii[lowest] + 0.5 * step * (left - right) / np.where(curved, bend, 1.0)
    return np.asarray(edges), np.asarray((centre + at[:, None] * ways)[curved])


def floor_level(gray: np.ndarray, view: DishView, diameter: float) -> float:
    """Return how bright a dish's floor is, as the median of a square within it."""
    half = 0.35 * diameter / view.metres_per_pixel
    left, top = (max(0, round(centre - half)) for centre in view.centre_px)
    right, bottom = (max(4, round(centre + half)) for centre in view.centre_px)
    return middle(gray[top:bottom:4, left:right:4])


def fit_circle(points: Points, agreement: float) -> Circle | None:
    """Fit a circle by least squares, leaving out what is far from it.

        minimise  sum (x^2 + y^2 - 2 u x - 2 v y - c)^2,    r^2 = c + u^2 + v^2

    three times, over the points within 8, 3 and 1 times an agreement of the last circle.

    Args:
        points: shape (m, 2) [px].
        agreement: how far a point may be from the circle [px].

    Returns:
        u, v and r [px], and how many points agree; None if fewer than 20 do.
    """
    kept = points
    for tolerance in (8.0 * agreement, 3.0 * agreement, agreement):
        if len(kept) < 20:
            return None
        mean = kept.mean(axis=0)  # around which the equations are well conditioned, and that of c stands alone
        x, y = (kept - mean).T
        squares = x * x + y * y
        xx, xy, yy, xs, ys = x @ x, x @ y, y @ y, x @ squares, y @ squares
        determinant = 2.0 * max(xx * yy - xy * xy, 1e-9)
        u, v = (yy * xs - xy * ys) / determinant, (xx * ys - xy * xs) / determinant
        radius, centre = math.sqrt(float(squares.mean()) + u * u + v * v), mean + np.array([u, v])
        kept = points[np.abs(np.hypot(*(points - centre).T) - radius) < tolerance]
    return float(centre[0]), float(centre[1]), radius, len(kept)


def tilt_of(ellipse: Ellipse) -> Tilt | None:
    """Return the tilt under which a circle is seen as an ellipse; None below what one tells."""
    angle = math.acos(min(1.0, ellipse.minor / ellipse.major))
    return Tilt(angle, ellipse.direction) if angle > MIN_ANGLE else None


def find_tilt(gray: Gray, view: DishView, diameter: float) -> tuple[Tilt | None, DishView]:
    """Find the camera's tilt by the ellipse of a rim's darkest ring, or where few of it are seen of its inner edge.

    Args:
        gray: frame, shape (rows, columns), uint8.
        view: of the dish as a circle.
        diameter: of the dish [m].

    Returns:
        The tilt, None if there is none to be sure of, and the view of the corrected frame.
    """
    radius = 0.5 * diameter / view.metres_per_pixel
    edges, darkest = rim_points(gray, view.centre_px, radius, REACH * radius, 0.5, RAYS)
    points = darkest if len(darkest) > len(edges) // 2 else edges
    ellipse = fitted_robustly(points, Ellipse(view.centre_px, radius, radius, 0.0))
    if ellipse is None:
        return None, view
    spread = np.hypot(*ellipse.coordinates(points).T) - 1.0
    near = np.abs(spread) < FINE_AGREEMENT
    noise = float(np.sqrt(np.mean(spread[near] ** 2) * 2.0 / near.sum()))
    tilt = tilt_of(ellipse)
    if tilt is None or near.sum() < RAYS // 2 or 0.5 * (1.0 - ellipse.minor / ellipse.major) < 4.0 * noise:
        return None, view
    # The circle lies half-way between both axes, so that its scale becomes that of the longer one.
    scale = view.metres_per_pixel * 0.5 * (1.0 + ellipse.minor / ellipse.major)
    return tilt, DishView(ellipse.centre_px, scale, view.rotation)
