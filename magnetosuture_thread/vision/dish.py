"""Finds the petri dish, how far the camera over it is tilted, and whether it moves.

Candidates are the rings of a dish, the edges of its wall and its lid: ellipses that edges of the image agree on in most
directions. A wall as dark as steel, on both sides of which the ground is seen, tells the inner edge to 0.35 px. Of any
other the innermost ring is taken, and by how much the others differ from it is the doubt of the scale. A tilt is one
that two rings agree on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache, cached_property

import cv2
import numpy as np

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.vision.images import Gray, measured_channel, median, middle, sampled, shrunk
from magnetosuture_thread.vision.settings import MIN_SIDE_PX, VisionTrackerSettings

COARSE_SIDE = 240  # rows or columns of the image in which candidates are looked for; four times as many for the dish
MIN_RADIUS, MAX_RADIUS = 0.12, 0.8  # of the shorter side
AGREEMENT, FINE_AGREEMENT = 0.012, 0.006  # of the radius, within which an edge agrees with an ellipse
RANGE = 0.21  # of a ring's radius, within which others of its wall and lid are: a lid is up to 18 % larger
PARALLAX = 0.08  # of the radius, that a lid's ring is shifted by: 15 mm above the floor of 90 mm, tilted by 13 degrees
SUPPORT = 0.6  # share of the directions in which a ring must be seen
MIN_SEEN = 0.4  # share of a dish's rim that the frame must show

RAYS = 180  # along which rings and a wall are measured
AGREEMENT_PX = 2.0
MIN_CONTRAST = 12.0  # grey levels; of the wall at least, and 0.15 of the floor's brightness
WALL = 0.0025  # m; breadth of a wall and its shadow at most; the two edges of a moulded one are half as far apart

MIN_ANGLE = math.radians(3.5)  # below, light from one side moves the rim as much
TILT_ERROR = math.radians(2.0)  # of a ring's tilt, by light and noise
CUT_TILT = math.radians(10.0)  # that a dish of which a part is seen does not tell

DARK_FLOOR = 130.0  # grey levels; a dish, or with a given view a frame, whose median is below may have a dark floor
# Of a radius by a dark wall: how far its light moves the edge at least, and in pixels, as in blurred rendered frames.
SCALE_ERROR, EDGE_ERROR_PX = 0.001, 0.35
RING_ERROR = 0.01  # of a radius and a centre by a ring of any other look; with the tolerances of a mould three times it

NO_DISH = "no dish in the image: show its whole rim in even light, limit the search by region_px, or give its view"


@cache
def unit_vectors(count: int) -> Points:
    """Return unit vectors in directions all around, shape (count, 2)."""
    turns = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    return np.column_stack([np.cos(turns), np.sin(turns)])


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

    def seen(self, shape: tuple[int, ...], count: int) -> np.ndarray:
        """Say which of a number of its points lie in an image of a shape (rows, columns), shape (count,)."""
        return _within(self.at(unit_vectors(count)), shape)

    def coordinates(self, points: Points) -> Points:
        """Return points along the shorter and the longer axis, in halves of them, shape (m, 2)."""
        return np.asarray((points - self.centre_px) @ self.axes.T / (self.minor, self.major))

    def at(self, coordinates: Points) -> Points:
        """Return the points of coordinates, the inverse of `coordinates` [px]."""
        return np.asarray(coordinates * (self.minor, self.major) @ self.axes + self.centre_px)

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


def find_rings(image: np.ndarray) -> list[Ellipse]:
    """Find the edges of a dish's wall and lid by gradients alone, the smallest first.

    In a small image edges vote for the centres of circles along their gradients; where no circle is certain the image
    is stretched in a few directions, in which the ellipse of a tilted camera is nearly a circle. Around the centres
    with the most votes rings of all sizes are looked for. Where they speak most for a dish, the image itself is
    searched in the same way.

    Args:
        image: shape (rows, columns) or (rows, columns, 3), uint8.
    """
    factor = max(1.0, min(image.shape[:2]) / COARSE_SIDE)
    size = (round(image.shape[1] / factor), round(image.shape[0] / factor))
    if max(size) > 4 * COARSE_SIDE:  # no frame of a camera
        return []
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if factor > 1.0 else image
    edges, found = _edges_of(small), list[tuple[float, float, Ellipse]]()
    for ratio, way in ((1.0, 0), *((0.9, way) for way in range(4))):  # the latter nearest to tilts of 26 degrees
        found += _candidates(measured_channel(small), edges, ratio, 0.25 * math.pi * way)
        if any(share >= 0.8 for _, share, _ in found):
            break
    if not found:
        return []
    at = max(found, key=lambda each: each[0])[2].scaled(image.shape[1] / small.shape[1])
    factor = max(1, round(min(image.shape[:2]) / (4 * COARSE_SIDE)))
    rings = _climbed(shrunk(measured_channel(image), factor), at.scaled(1.0 / factor), SUPPORT)
    return sorted((ring.scaled(float(factor)) for _, ring in rings), key=lambda ring: ring.major)


@dataclass(frozen=True)
class _Steps:
    """Where the light changes along directions from a centre.

    Attributes:
        at: the ellipse in whose axes they are told.
        radius: of each, in these axes, shape (m,).
        way: index of its direction, of `RAYS`, shape (m,).
        rises: whether it is brighter beyond, shape (m,).
    """

    at: Ellipse
    radius: np.ndarray
    way: np.ndarray
    rises: np.ndarray

    @staticmethod
    def around(gray: Gray, at: Ellipse) -> _Steps:
        """Find them as far as `RANGE` from an ellipse [px]."""
        step = max(1.0 / at.minor, 0.5 * FINE_AGREEMENT)
        radii = np.arange(1.0 - RANGE, 1.0 + RANGE, step)
        places = at.at(radii[:, None, None] * unit_vectors(RAYS))
        light = sampled(gray, places).astype(np.float32)
        light = cv2.GaussianBlur(np.hstack([light[:, -3:], light, light[:, :3]]), (0, 0), 1.0)[:, 3:-3]
        change = light[2:] - light[:-2]
        slopes = np.abs(change)
        slopes[~_within(places[2:], gray.shape) | ~_within(places[:-2], gray.shape)] = 0.0
        before, top, after = slopes[:-2], slopes[1:-1], slopes[2:]
        texture = middle(slopes[slopes > 0.0]) if slopes.any() else 0.0
        row, way = np.nonzero((top >= before) & (top > after) & (top > max(1.0, 3.0 * texture)))
        before, top, after = before[row, way], top[row, way], after[row, way]
        radius = radii[row + 2] + 0.5 * step * (before - after) / (before - 2.0 * top + after)
        return _Steps(at, radius, way, change[row + 1, way] > 0.0)

    @cached_property
    def _cells(self) -> np.ndarray:
        """Number of the cell of each for each of `_shifts()`; the last of a row for all beyond, shape (shifts, m)."""
        cells = np.floor((self.radius - _shifts() @ unit_vectors(RAYS)[self.way].T - 1.0 + RANGE) / self._cell)
        cells = np.where((cells >= 0.0) & (cells < self._count), cells, float(self._count)).astype(np.int32)
        first = np.arange(len(_shifts()), dtype=np.int32)[:, None] + len(_shifts()) * self.rises.astype(np.int32)
        return np.asarray(cells + (self._count + 1) * first)

    @property
    def _cell(self) -> float:
        """Breadth of a cell of radii, of the radius: half a pixel at least."""
        return max(FINE_AGREEMENT, 0.5 / self.at.minor)

    @property
    def _count(self) -> int:
        return int(2.0 * RANGE / self._cell) + 1

    def most_agreed(self, left: np.ndarray) -> tuple[Ellipse, np.ndarray, int]:
        """Return the ring that most of those left agree on, roughly, those within two cells of it, and their number.

            r = r_0 + a cos t + b sin t

        for r_0 in cells, and all shifts (a, b) up to `PARALLAX`. Rings that are next to each other rise and fall in
        turn: those that do the one and the other are not counted together.
        """
        shifts, count = _shifts(), self._count
        cells = self._cells[:, left].ravel()
        votes = np.bincount(cells, minlength=2 * (count + 1) * len(shifts)).reshape(2, len(shifts), count + 1)
        votes = votes[..., :-3] + votes[..., 1:-2] + votes[..., 2:-1]
        rises, best, first = np.unravel_index(int(votes.argmax()), votes.shape)
        radius = 1.0 - RANGE + self._cell * (first + 1.5)
        u, v = self.at.at(shifts[best])
        ring = replace(self.at, centre_px=(u, v), major=self.at.major * radius, minor=self.at.minor * radius)
        apart = np.abs(self.radius - unit_vectors(RAYS)[self.way] @ shifts[best] - radius)
        return ring, left & (self.rises == rises) & (apart < 2.0 * self._cell), int(votes[rises, best, first])


@cache
def _shifts() -> Points:
    """Return the shifts of a ring that are tried, of the radius, shape (m, 2)."""
    shift = np.linspace(-PARALLAX, PARALLAX, 11)
    return np.stack(np.meshgrid(shift, shift), axis=-1).reshape(-1, 2)


def _within(points: Points, shape: tuple[int, ...]) -> np.ndarray:
    """Say which points, of shape (..., 2), lie in an image of a shape (rows, columns), shape (...)."""
    u, v = points[..., 0], points[..., 1]  # numpy is slow along a short last axis
    return np.asarray((u >= 1.0) & (u <= shape[1] - 2.0) & (v >= 1.0) & (v <= shape[0] - 2.0))


def _evidence(rings: list[tuple[float, Ellipse]]) -> float:
    """Return how much rings speak for a dish: strong ones do, weak ones are there by chance."""
    return sum(support**4 for support, _ in rings)


def _climbed(gray: Gray, at: Ellipse, needed: float) -> list[tuple[float, Ellipse]]:
    """Return the rings near an ellipse, or near the strongest or the innermost of them, as long as they speak for more.

    See `_rings_around`. In units of a ring's own axes the others are more nearly circles.
    """
    best = _rings_around(gray, at, needed)
    while best:
        starts = max(best, key=lambda each: each[0])[1], min(best, key=lambda each: each[1].major)[1]
        rings = max((_rings_around(gray, each, needed) for each in dict.fromkeys(starts)), key=_evidence)
        if _evidence(rings) <= _evidence(best):
            break
        best = rings
    return best


def _rings_around(gray: Gray, at: Ellipse, needed: float) -> list[tuple[float, Ellipse]]:
    """Find the edges of wall and lid near an ellipse, each with the share of the directions in which it is seen.

    They are circles one above the other: in units of the ellipse's axes each is nearly a circle, shifted by what the
    camera sees of its height. The one that most changes of the light agree on is fitted by an ellipse and taken out,
    then the next. Of a dish that is cut off more than the needed share must be seen: of a short arc chance is more.
    """
    steps = _Steps.around(gray, at)
    points = at.at(steps.radius[:, None] * unit_vectors(RAYS)[steps.way])
    left, found = np.ones(len(steps.way), np.bool_), list[tuple[float, Ellipse]]()
    for _ in range(10):  # edges of wall and lid
        begin, own, votes = steps.most_agreed(left)
        left &= ~own
        if votes < 0.2 * RAYS:  # of a dish that is cut off
            break
        ellipse = fitted_robustly(points[own], begin)
        if ellipse is None:
            continue
        apart = np.abs(np.hypot(*ellipse.coordinates(points).T) - 1.0)
        left &= apart > max(AGREEMENT, 2.0 / ellipse.major)
        agree = np.unique(steps.way[apart < max(FINE_AGREEMENT, 1.0 / ellipse.major)])
        outline = ellipse.seen(gray.shape, RAYS)
        support = min(1.0, len(agree) / max(1, int(outline.sum())))
        if support >= needed + 0.5 * (1.0 - float(outline.mean())):
            found.append((support, ellipse))
    return found


def fitted_robustly(points: Points, begin: Ellipse) -> Ellipse | None:
    """Return the ellipse that most points agree on, near a first one; None if few do."""
    kept, at = points, begin
    for tolerance in (4.0 * FINE_AGREEMENT, 2.0 * FINE_AGREEMENT, FINE_AGREEMENT):
        if (fitted := _fitted(kept)) is None:
            return None
        at = fitted
        kept = points[np.abs(np.hypot(*at.coordinates(points).T) - 1.0) < max(tolerance, 1.0 / at.major)]
        if len(kept) < RAYS // 4:
            return None
    if math.dist(at.centre_px, begin.centre_px) > 0.05 * begin.major or abs(at.major / begin.major - 1.0) > 0.08:
        return None
    return at


def _edges_of(image: np.ndarray) -> _Edges:
    """Return the points of an image whose gradient is greatest along its own direction, at most 4500."""
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
    chosen = np.sort(chosen[np.argsort(value[chosen], kind="stable")[-4500:]])  # The weak ones are texture.
    return _Edges(
        np.column_stack([columns, rows])[chosen].astype(float), normals[chosen].astype(float), image.shape[:2]
    )


def _candidates(gray: Gray, edges: _Edges, ratio: float, direction: float) -> list[tuple[float, float, Ellipse]]:
    """Return the strongest ring around each centre that edges vote for, with what speaks for it and its own support.

    Args:
        gray: the small image.
        edges: of it.
        ratio: of the shorter axis to the longer one as the dish is seen.
        direction: of the shorter one [rad].
    """
    side, found = min(gray.shape), list[tuple[float, float, Ellipse]]()
    along = np.array([math.cos(direction), math.sin(direction)])
    stretch = np.eye(2) + (1.0 / ratio - 1.0) * np.outer(along, along)
    back = np.linalg.inv(stretch)
    normals = edges.normals @ back
    moved = _Edges(edges.points @ stretch, normals / np.hypot(*normals.T)[:, None], edges.shape)
    growth = (1.0 + RANGE) / (1.0 - RANGE)
    steps = np.arange(math.ceil(math.log(MAX_RADIUS / MIN_RADIUS) / math.log(growth)))
    for centre in _centres(moved, 1.0 / ratio):
        u, v = centre @ back
        for major in MIN_RADIUS * side * growth ** (steps + 0.5):
            # In the small image rings next to each other are blurred into one: less is needed than in the image itself.
            rings = _climbed(gray, Ellipse((u, v), major, ratio * major, direction), 0.5 * SUPPORT)
            support, ring = max(rings, key=lambda each: each[0], default=(0.0, None))
            if ring is None or support < 0.8 * SUPPORT:
                continue
            seen = float(ring.seen(gray.shape, RAYS).mean())
            if seen >= MIN_SEEN:
                found.append((_evidence(rings) * math.sqrt(seen) * (ring.major / side) ** 0.25, support, ring))
        if any(support > 0.95 for _, support, _ in found):
            break
    return found


def _centres(edges: _Edges, ratio: float) -> list[Points]:
    """Return the four places with the most votes of edges along their gradients, each of shape (2,).

    The image was stretched by a ratio in some direction.
    """
    side, size, cell = min(edges.shape), np.array(edges.shape[::-1]), 3.0  # px
    low = -0.15 * side - (ratio - 1.0) * size
    wide, tall = np.ceil((size + 0.15 * side + 2.0 * (ratio - 1.0) * size - low) / cell).astype(int)
    radii = np.arange(MIN_RADIUS * side, MAX_RADIUS * side, cell)
    steps = np.concatenate([-radii, radii])[:, None] / cell
    begin, ahead = (edges.points - low) / cell, edges.normals
    columns, rows = (np.floor(begin[:, axis] + steps * ahead[:, axis]).astype(int) for axis in (0, 1))
    inside = (columns >= 0) & (columns < wide) & (rows >= 0) & (rows < tall)
    votes = np.bincount(rows[inside] * wide + columns[inside], minlength=wide * tall).reshape(tall, wide)
    votes = cv2.GaussianBlur(votes.astype(np.float32), (0, 0), 1.5)
    votes -= cv2.blur(votes, (31, 31))
    found = []
    for _ in range(4):
        _, _, _, (column, row) = cv2.minMaxLoc(votes)
        votes[max(0, row - 4) : row + 5, max(0, column - 4) : column + 5] = -np.inf
        found.append(low + cell * (np.array([column, row]) + 0.5))
    return found


def _fitted(points: Points) -> Ellipse | None:
    """Return the least-squares ellipse of points; None where there is none near a circle."""
    if len(points) < 6:
        return None
    mean = points.mean(axis=0)
    (u, v), axes, angle = cv2.fitEllipseDirect((points - mean).astype(np.float32))
    minor, major = 0.5 * min(axes), 0.5 * max(axes)
    # A camera tilted by more than 45 degrees is none.
    if not (np.isfinite([u, v, minor, major]).all() and major > 1.0 and minor > 0.7 * major):
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
        radius: R of the dish [m], a tenth of d at most; more is hardly used over a dish.
    """
    aside = np.array([-heading[1], heading[0]])
    moved = np.outer(tail, tail) - radius**2 * np.eye(2)
    return np.vstack([moved, float(tail @ aside) * heading]) * (0.1 / radius)


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


def see_dish(image: np.ndarray, settings: VisionTrackerSettings, diameter: float) -> FoundDish | None:
    """Find the view: what of it is given, and the rest by the dish; None if none is seen.

    Args:
        image: frame, shape (rows, columns) or (rows, columns, 3), uint8.
        settings: what to look for.
        diameter: of the dish [m].
    """
    gray, fixed = measured_channel(image), settings.fixed_view()
    if fixed is not None:
        # Only a dark frame whose negative shows the dish has a dark floor: others are just dark.
        radius, error = 0.5 * diameter / fixed.metres_per_pixel, settings.scale_error
        if 2.0 * radius < MIN_SIDE_PX:
            return None
        ring = Ellipse(fixed.centre_px, radius, radius, 0.0)
        dark = middle(gray[::8, ::8]) < DARK_FLOOR and _by_wall(gray, [ring], settings, diameter, True) is not None
        return FoundDish(fixed, dark, None, error, remark=_scale_remark(error), homography=settings.homography())
    rings = find_rings(image)
    if not rings:
        return None
    ways = () if settings.rim == "outer" else (False, True)
    by_wall = filter(None, (_by_wall(gray, rings, settings, diameter, dark_field) for dark_field in ways))
    return _with_given(next(by_wall, None) or _by_ring(gray, rings, settings, diameter), settings)


def _by_wall(
    gray: Gray, rings: list[Ellipse], settings: VisionTrackerSettings, diameter: float, dark_field: bool
) -> FoundDish | None:
    """Return the dish by a wall as dark as steel, of a dark floor as bright; None unless both of its sides are seen.

    The wall's inner edge gives the radius, and its darkest ring, which light from one side does not shift, the centre
    and the tilt. All other rings lie at the wall, and beyond it the ground is bright again: a clear dish on a dark
    bench looks the same from the inside.
    """
    light, guess = (255 - gray if dark_field else gray), rings[0]
    centre, radius = guess.centre_px, 0.5 * (guess.major + guess.minor)
    edges, darkest, count = np.empty((0, 2)), np.empty((0, 2)), 0
    for reach, step in ((0.12, 1.0), (0.04, 0.5)):  # in shares of the radius: by a first guess, and once it is known
        edges, darkest = rim_points(light, centre, radius, reach * radius, step, RAYS)
        circle = fit_circle(edges, AGREEMENT_PX)
        if circle is None:
            return None
        centre, radius, count = circle[:2], circle[2], circle[3]
    inner, ring = Ellipse(centre, radius, radius, 0.0), fit_circle(darkest, 0.5 * AGREEMENT_PX)
    seen, oval = inner.seen(gray.shape, RAYS), fitted_robustly(darkest, inner) or inner
    spread = np.hypot(*oval.coordinates(darkest).T) - 1.0
    spread = spread[np.abs(spread) < FINE_AGREEMENT]
    needed = SUPPORT * seen.sum()
    shares, farthest = [each.major / radius for each in rings], 1.0 + 2.0 * WALL / diameter
    beyond = replace(inner, major=farthest * radius, minor=farthest * radius).at(unit_vectors(RAYS))
    beyond = beyond[_within(beyond, gray.shape)]
    if max(count, len(spread)) < needed or seen.mean() < MIN_SEEN or not len(darkest) or not len(beyond):
        return None
    view = DishView(centre, 0.5 * diameter / radius)
    floor, wall, ground = floor_level(gray, view, diameter), *(middle(sampled(gray, at)) for at in (darkest, beyond))
    higher = wall - ground if dark_field else ground - wall
    is_dark = min(floor, wall) < settings.max_needle_brightness * max(floor, wall)
    is_alone = min(shares) > 1.0 - 2.0 * AGREEMENT and max(shares) < farthest
    if not (is_dark and is_alone and higher > max(MIN_CONTRAST, 0.15 * max(floor, wall))):
        return None
    by_edge = max(SCALE_ERROR, EDGE_ERROR_PX / radius)
    error = RING_ERROR if len(spread) < needed else by_edge
    if ring is not None and ring[3] >= needed:
        view, error = replace(view, centre_px=ring[:2]), by_edge
    if ring is not None and seen.mean() < 0.9:
        # By an edge that light shifts, a part of a circle tells its centre and its radius apart badly.
        scale = 0.5 * diameter / middle(np.hypot(*(edges - ring[:2]).T))
        return FoundDish(replace(view, metres_per_pixel=scale), dark_field, None, error, CUT_TILT)
    tilt, unseen = tilt_of(oval), MIN_ANGLE
    noise = math.sqrt(2.0 * float(np.mean(spread**2)) / len(spread)) if len(spread) >= RAYS // 2 else 1.0
    if tilt is not None and 0.5 * (1.0 - oval.minor / oval.major) > 4.0 * noise:
        if _is_confirmed(tilt, radius, rings):
            # The circle lies half-way between both axes, so that its scale becomes that of the longer one.
            scale = 0.5 * (1.0 + oval.minor / oval.major) * view.metres_per_pixel
            return FoundDish(DishView(oval.centre_px, scale), dark_field, tilt, error)
        unseen = tilt.angle
    return FoundDish(view, dark_field, None, error, unseen)


def _by_ring(gray: Gray, rings: list[Ellipse], settings: VisionTrackerSettings, diameter: float) -> FoundDish:
    """Return the dish by one of its rings; where none was named, all of them make the doubt of the scale."""
    edge = rings[-1 if settings.rim == "outer" else 0]
    tilt, radius, unseen = tilt_of(edge), edge.major, MIN_ANGLE
    error = RING_ERROR
    if len(rings) == 1:
        error = max(error, WALL / diameter)
    elif not settings.rim:
        error = max(error, *(abs(ring.major / radius - 1.0) for ring in rings))
    is_cut = not edge.seen(gray.shape, RAYS).all()
    if tilt is not None and (is_cut or not _is_confirmed(tilt, radius, rings)):
        # One edge that is no circle may be a tilted one, or two edges of which each is seen in a part.
        radius, unseen = 0.5 * (edge.major + edge.minor), max(tilt.angle, CUT_TILT if is_cut else 0.0)
        error, tilt = max(error, edge.major / radius - 1.0), None
    view = DishView(edge.centre_px, 0.5 * diameter / radius)
    dark_field = floor_level(gray, view, diameter) < 0.5 * DARK_FLOOR
    return FoundDish(view, dark_field, tilt, error, unseen if tilt is None else 0.0)


def _is_confirmed(tilt: Tilt, radius: float, rings: list[Ellipse]) -> bool:
    """Say whether another ring than that of a radius [px] has the same tilt."""
    others = (tilt_of(ring) for ring in rings if abs(ring.major / radius - 1.0) > AGREEMENT)
    return any(other is not None and tilt.apart(other) < TILT_ERROR for other in others)


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
        if apart > RANGE:
            return None
        if apart > max(error, 3.0 * RING_ERROR):
            remark = f"metres_per_pixel, which is used, is {apart:.0%} off the dish's diameter: one of them is wrong"
        error = apart if remark else settings.scale_error
        view = replace(view, metres_per_pixel=scale)
    if centre:
        view = replace(view, centre_px=(centre[0], centre[1]))
    unseen_tilt = found.unseen_tilt if found.unseen_tilt > MIN_ANGLE else 0.0
    return replace(found, view=view, tilt=None, scale_error=error, unseen_tilt=unseen_tilt, remark=remark)


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

    @property
    def view(self) -> DishView | None:
        """Where the dish is; None if it was not found yet."""
        return self._fixed or (self.found.view if self.found is not None else None)

    def look(self, image: np.ndarray) -> tuple[str, np.ndarray]:
        """Look at the rim in a frame.

        Args:
            image: shape (rows, columns) or (rows, columns, 3), uint8.

        Returns:
            Why the view must not be used in this frame, empty if it may; and the frame as it is measured on, see
            `FoundDish.prepared`.
        """
        if self._fixed is not None or self.found is None:
            self.found = see_dish(image, self._settings, self._diameter)
            if self.found is None:
                given = "; or correct metres_per_pixel, by which the dish has another size"
                return NO_DISH + (given if self._settings.metres_per_pixel else ""), image
            return "", self.found.prepared(image)
        prepared = self.found.prepared(image)
        view = self.found.view
        radius = 0.5 * self._diameter / view.metres_per_pixel
        rays = 72  # fewer than where it is found: this is done in each frame
        edges, darkest = rim_points(prepared, view.centre_px, radius, 7.0, 1.0, rays)
        circle = fit_circle(darkest if len(darkest) >= len(edges) // 2 else edges, 0.5 * AGREEMENT_PX)
        before, self._anew = self._anew, []
        if circle is not None and circle[3] >= 0.4 * rays and math.dist(circle[:2], view.centre_px) < 1.0:  # px
            return "", prepared
        found = see_dish(image, self._settings, self._diameter)
        if found is None:
            return "too little of the dish is seen: uncover its rim, or give its view", prepared
        if self._agree(found, self.found):  # A rim that is not dark is seen by its ellipse only.
            return "", prepared
        anew = [*before, found] if before and self._agree(found, before[-1]) else [found]
        if len(anew) < 3:  # frames in a row that must agree on a new view
            self._anew = anew
            return "the dish is not where it was", prepared
        self.found = found
        return "", found.prepared(image)

    def _agree(self, one: FoundDish, other: FoundDish) -> bool:
        """Say whether two dishes are one: within 1 px and 0.5 % of scale, or within two standard deviations."""
        slack = 2.0 * max(one.scale_error, other.scale_error)
        scale = one.view.metres_per_pixel
        apart = math.dist(one.view.centre_px, other.view.centre_px)
        near = apart < max(1.0, min(slack, 2.0 * RING_ERROR) * 0.5 * self._diameter / scale)
        return near and abs(scale / other.view.metres_per_pixel - 1.0) < max(0.005, slack)


def rim_points(
    image: np.ndarray, centre: tuple[float, float], radius: float, reach: float, step: float, rays: int
) -> tuple[Points, Points]:
    """Return where rays from a dish's centre meet its rim: its inner edge, and its darkest ring, both of shape (m, 2).

    The edge is where the light falls half-way to the rim's dark. Beyond its darkest ring a rim is brighter again; a
    plain edge has no such ring.

    Args:
        image: shape (rows, columns) or (rows, columns, 3), uint8.
        centre: u and v, about [px].
        radius: about [px].
        reach: how far inside and outside of the radius to look [px].
        step: between samples [px].
        rays: how many there are.
    """
    ways, count = unit_vectors(rays), int(2.0 * reach / step)
    radii, places = radius - reach + step * np.arange(count), np.arange(count)
    profiles = sampled(image, centre + radii[:, None] * ways[:, None])
    profiles = profiles[..., 1] if image.ndim == 3 else profiles  # To extract the channel first takes longer.
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


def fit_circle(points: Points, agreement: float) -> tuple[float, float, float, int] | None:
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
