"""Finds the petri dish, a bright disc within a dark rim, and how far the camera over it is tilted."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.vision.sampling import middle, within

RAYS, RIM_RAYS = 180, 72  # along which the rim is looked for, and of the quick check
SHARE_OF_RAYS = 0.6  # of the rays must meet the fitted circle
GUESS_REACH, REACH = 0.12, 0.04  # of the radius, in which the rim is looked for by a first guess, and once it is known
AGREEMENT_PX = 2.0
EDGE_LEVEL = 60  # of the circle transform, as of Canny's upper threshold; the lower one is half of it
MIN_CONTRAST, CONTRAST = 12.0, 0.15  # grey levels, and share of the floor's brightness, of the rim at least
STILL_PX = 1.0  # a rim this near to where it was stands still
RIM_SHARE = 0.4  # of the quick check's rays must meet the rim

MIN_ANGLE = math.radians(3.5)  # below, light from one side moves the rim as much
ANGLE_ERROR = math.radians(2.0)  # by which light and noise change a tilt that is told
NEAR = 0.1  # of its distance from the camera, that the dish's radius is at most; more is hardly used over a dish

Guess = tuple[float, float, float]  # u, v and radius of a circle [px]


def find_dish(gray: np.ndarray, diameter: float, guesses: dict[int, Guess | None] | None = None) -> DishView | None:
    """Find the dish by the inner edge of its rim.

    A circle transform of a small image gives the first guess; then rays from its centre meet the edge
    where the brightness falls half-way to the rim's dark, with sub-pixel precision, and a circle is
    fitted to these points, those far from it left out. The edge gives the radius. The centre is that of
    the rim's darkest ring, which light from one side doesn't shift.

    Args:
        gray: image, shape (rows, columns), uint8.
        diameter: the dish's inner diameter [m], which gives the scale.
        guesses: first guesses by the rows of the small image; filled. Those of the negative are the same.

    Returns:
        The view, or None if no dish is seen: too few rays agree on a circle.
    """
    guesses = {} if guesses is None else guesses
    for side in (60, 120):  # rows of the small image; the second only if the first fails
        if side not in guesses:
            guesses[side] = _first_guess(gray, side)
        guess = guesses[side]
        if guess is None:
            continue
        u, v, radius = guess
        fitted = None
        for reach, step in ((GUESS_REACH, 1.0), (REACH, 0.5)):
            edges, darkest = _edge_points(gray, u, v, radius, reach * radius, step, RAYS)
            fitted = _fit_circle(edges, AGREEMENT_PX)
            if fitted is None:
                break
            u, v, radius, agreeing = fitted
        if fitted is None or agreeing < SHARE_OF_RAYS * RAYS:
            continue
        ring = _fit_circle(darkest, 0.5 * AGREEMENT_PX)
        if ring is not None and ring[3] >= SHARE_OF_RAYS * RAYS and np.hypot(ring[0] - u, ring[1] - v) < AGREEMENT_PX:
            u, v = ring[:2]
        elif _is_saturated(gray, u, v, radius):  # Then the edge lies where the light makes it seem to.
            continue
        return DishView((u, v), 0.5 * diameter / radius)
    return None


def find_cut_dish(gray: np.ndarray, guess: Guess | None, diameter: float) -> DishView | None:
    """Find a dish that the frame cuts off by what is seen of its rim: its darkest ring, and its inner edge around that.

    Args:
        gray: image, shape (rows, columns), uint8.
        guess: a circle near it [px]; None if none is known.
        diameter: the dish's inner diameter [m].

    Returns:
        The view, or None if too few rays agree on a circle, of those that meet it in the frame.
    """
    if guess is None:
        return None
    u, v, radius = guess
    edges = darkest = np.empty((0, 2))
    for reach, step in ((GUESS_REACH, 1.0), (REACH, 0.5)):
        edges, darkest = _edge_points(gray, u, v, radius, reach * radius, step, RAYS)
        fitted = _fit_circle(edges, AGREEMENT_PX)
        if fitted is None:
            return None
        u, v, radius, _ = fitted
    turns = 2.0 * np.pi * np.arange(RAYS) / RAYS
    rim = np.array([u, v]) + radius * np.column_stack([np.cos(turns), np.sin(turns)])
    inside = ((rim > 0.0) & (rim < np.array(gray.shape[::-1]) - 1.0)).all(axis=1).sum()
    ring = _fit_circle(darkest, 0.5 * AGREEMENT_PX)
    if ring is None or ring[3] < 0.75 * inside or inside < 0.4 * RAYS:
        return None
    # By an edge that light shifts, a part of a circle tells its centre and its radius apart badly.
    radius = middle(np.hypot(*(edges - ring[:2]).T))
    return DishView((ring[0], ring[1]), 0.5 * diameter / radius)


def rim_shift(gray: np.ndarray, centre: tuple[float, float], radius: float) -> tuple[float, int]:
    """Look quickly whether the rim is where it was.

    Args:
        gray: image, shape (rows, columns), uint8.
        centre: the dish's centre, as `find_dish` gave it [px].
        radius: and its radius [px].

    Returns:
        How far the rim's darkest ring has moved since, a median over the rays that see it, turned into a
        shift of its centre [px], and how many of the `RIM_RAYS` rays see it.
    """
    edges, darkest = _edge_points(gray, *centre, radius, 7.0, 1.0, RIM_RAYS)
    seen = darkest if len(darkest) >= len(edges) // 2 else edges
    if len(seen) < 8:
        return 0.0, len(seen)
    offset = seen - centre
    distance = np.hypot(*offset.T)
    ways = offset / distance[:, None]
    system = np.column_stack([ways, np.ones(len(ways))])
    kept = np.ones(len(ways), bool)
    for _ in range(3):
        normal = system[kept].T @ system[kept] + 1e-9 * np.eye(3)
        shift = np.linalg.solve(normal, system[kept].T @ distance[kept])
        residual = np.abs(distance - system @ shift)
        kept = residual < max(0.5, 2.0 * float(np.median(residual)))
    return float(np.hypot(shift[0], shift[1])), int(kept.sum())


def _first_guess(gray: np.ndarray, rows: int) -> Guess | None:
    """Return centre and radius of the strongest large circle, found in a small image of about so many rows."""
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


def _edge_points(
    gray: np.ndarray, u: float, v: float, radius: float, reach: float, step: float, rays: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return where rays from the centre meet the rim's inner edge, and its darkest ring, both of shape (m, 2)."""
    edges, darkest = np.empty((rays, 2)), np.empty((rays, 2))
    band = max(4.0, 0.02 * radius)
    counts = rim_along_rays(gray, (u, v, radius), reach, step, band, edges, darkest)
    return edges[: counts[0]], darkest[: counts[1]]


def rim_points(gray: np.ndarray, centre: tuple[float, float], radius: float) -> np.ndarray:
    """Return points of the rim's darkest ring, or where few are seen of its inner edge, shape (m, 2) [px].

    Args:
        gray: image, shape (rows, columns), uint8.
        centre: of the dish, about [px].
        radius: of it, about [px].
    """
    edges, darkest = _edge_points(gray, *centre, radius, REACH * radius, 0.5, RAYS)
    return darkest if len(darkest) > len(edges) // 2 else edges


def floor_level(gray: np.ndarray, view: DishView, diameter: float) -> float:
    """Return how bright a dish's floor is, as the median of a square within it."""
    half = 0.35 * diameter / view.metres_per_pixel
    left, top = (max(0, round(centre - half)) for centre in view.centre_px)
    right, bottom = (max(4, round(centre + half)) for centre in view.centre_px)
    return middle(gray[top:bottom:4, left:right:4])


def _is_saturated(gray: np.ndarray, u: float, v: float, radius: float) -> bool:
    """Say whether the floor near the rim is as bright as the image can show."""
    angles = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
    at = np.column_stack([u + 0.93 * radius * np.cos(angles), v + 0.93 * radius * np.sin(angles)])
    columns, rows = np.clip(at.round().astype(int), 0, np.array(gray.shape[::-1]) - 1).T
    return float(np.mean(gray[rows, columns] >= 253)) > 0.15


def _fit_circle(points: np.ndarray, agreement: float) -> tuple[float, float, float, int] | None:
    """Return centre and radius of a circle, and how many points agree on it; None if too few do. See `fit_circle`."""
    circle = np.empty(3)
    agreeing = fit_circle(points, agreement, circle)
    return (float(circle[0]), float(circle[1]), float(circle[2]), agreeing) if agreeing else None


@dataclass(frozen=True)
class Tilt:
    """The camera's tilt.

    Attributes:
        angle: between its axis and the dish's normal [rad].
        direction: in the image, along which the dish looks shortened [rad], from u towards v.
        rotation: of the dish's x axis in the image [rad]; see `DishView`.
    """

    angle: float
    direction: float
    rotation: float = 0.0

    @property
    def direction_in_dish(self) -> np.ndarray:
        """Direction along which the dish looks shortened, in the dish frame, shape (2,)."""
        angle = -self.direction - self.rotation
        return np.array([math.cos(angle), math.sin(angle)])

    def covariance(self, tail: np.ndarray, heading: np.ndarray, radius: float) -> np.ndarray:
        """Return what perspective leaves unknown, shape (3, 3) [m, m, rad].

        An ellipse does not tell which side is nearer.

        Args:
            tail: in the dish frame, shape (2,) [m].
            heading: unit tangent there, shape (2,).
            radius: of the dish [m].
        """
        along = self.direction_in_dish
        change = perspective(tail, heading, radius)
        either = change @ (math.tan(self.angle) * along)
        return np.outer(either, either) + unseen_tilt_covariance(tail, heading, ANGLE_ERROR, radius)

    @property
    def warning(self) -> str:
        """What to tell of it."""
        return f"the camera is tilted by {math.degrees(self.angle):.0f} degrees"

    def corrected(self, image: np.ndarray, view: DishView) -> np.ndarray:
        """Return a frame in which the dish is a circle about its centre: stretched along the direction by 1 / cos."""
        along = np.array([math.cos(self.direction), math.sin(self.direction)])
        tilted = np.eye(3)
        tilted[:2, :2] += (math.cos(self.angle) - 1.0) * np.outer(along, along)
        to_centre = np.array([[1.0, 0.0, view.centre_px[0]], [0.0, 1.0, view.centre_px[1]], [0.0, 0.0, 1.0]])
        inverse = to_centre @ tilted @ np.linalg.inv(to_centre)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        size = image.shape[1::-1]
        return np.asarray(cv2.warpPerspective(image, inverse, size, flags=flags, borderMode=cv2.BORDER_REPLICATE))


def tilt_of(minor: float, major: float, direction: float, rotation: float) -> Tilt | None:
    """Return the tilt under which a circle is seen as an ellipse with these half axes; None below what one tells."""
    angle = math.acos(min(1.0, minor / major))
    return Tilt(angle, direction, rotation) if angle > MIN_ANGLE else None


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


def find_tilt(gray: np.ndarray, view: DishView, diameter: float) -> tuple[Tilt | None, DishView]:
    """Find the camera's tilt.

        r(t) = r_0 + x cos t + y sin t + a cos 2t + b sin 2t,    cos(angle) = (r_0 - h) / (r_0 + h),  h = |(a, b)|

    of the rim, robustly; see `find_dish`.

    Args:
        gray: frame, shape (rows, columns), uint8.
        view: of the dish as a circle.
        diameter: of the dish [m].

    Returns:
        The tilt, None if there is none to be sure of, and the view of the corrected frame.
    """
    radius = 0.5 * diameter / view.metres_per_pixel
    points = rim_points(gray, view.centre_px, radius)
    fitted = np.empty(5)
    count, spread = fit_rim(points, view.centre_px, RAYS // 2, fitted)
    if not count:
        return None, view
    shape = fitted[3:]
    half = float(np.hypot(*shape))
    deviation = spread * math.sqrt(2.0 / count)
    angle = math.acos(min(1.0, (fitted[0] - half) / (fitted[0] + half)))
    if angle < MIN_ANGLE or half < 4.0 * deviation:
        return None, view
    # The greatest radius lies along the axis of the tilt, the least along the direction that is shortened.
    direction = 0.5 * math.atan2(float(shape[1]), float(shape[0])) + 0.5 * math.pi
    middle = (view.centre_px[0] + float(fitted[1]), view.centre_px[1] + float(fitted[2]))
    scale = view.metres_per_pixel * float(fitted[0]) / (float(fitted[0]) + half)
    return Tilt(angle, direction, view.rotation), DishView(middle, scale, view.rotation)


@compiled
def fit_circle(points, agreement, circle):
    """Fit a circle by least squares, leaving out what is far from it.

        minimise  sum (x^2 + y^2 - 2 u x - 2 v y - c)^2,    r^2 = c + u^2 + v^2

    three times, over the points within 8, 3 and 1 times an agreement of the last circle.

    Args:
        points: shape (m, 2) [px].
        agreement: how far a point may be from the circle [px].
        circle: filled with u, v and r, shape (3,) [px].

    Returns:
        How many points agree; 0 if too few do.
    """
    kept = np.ones(len(points), np.bool_)
    system, right = np.empty((3, 3)), np.empty(3)
    count = len(points)
    for tolerance in (8.0 * agreement, 3.0 * agreement, agreement):
        if count < 20:
            return 0
        # Around the mean, where the normal equations are well conditioned.
        mean_u = mean_v = 0.0
        for index in range(len(points)):
            if kept[index]:
                mean_u += points[index, 0] / count
                mean_v += points[index, 1] / count
        system[:], right[:] = 0.0, 0.0
        for index in range(len(points)):
            if not kept[index]:
                continue
            x, y = points[index, 0] - mean_u, points[index, 1] - mean_v
            z = x * x + y * y
            system[0, 0] += 4.0 * x * x
            system[0, 1] += 4.0 * x * y
            system[1, 1] += 4.0 * y * y
            right[0] += 2.0 * x * z
            right[1] += 2.0 * y * z
            right[2] += z
        system[1, 0], system[2, 2] = system[0, 1], count  # the sums of x and y are 0
        u, v, rest = np.linalg.solve(system, right)
        radius = np.sqrt(max(rest + u * u + v * v, 0.0))
        u, v = u + mean_u, v + mean_v
        count = 0
        for index in range(len(points)):
            away = np.hypot(points[index, 0] - u, points[index, 1] - v)
            kept[index] = abs(away - radius) < tolerance
            count += kept[index]
    circle[0], circle[1], circle[2] = u, v, radius
    return count


@compiled
def _small_median(values, count, ordered):
    """Return the median of the first few of some values, put in order into `ordered`, shape (count,)."""
    for index in range(count):
        place = index
        while place > 0 and ordered[place - 1] > values[index]:
            ordered[place] = ordered[place - 1]
            place -= 1
        ordered[place] = values[index]
    return 0.5 * (ordered[(count - 1) // 2] + ordered[count // 2])


@compiled
def rim_along_rays(gray, circle, reach, step, band, edges, darkest):
    """Find a dish's rim along rays from its centre.

    Args:
        gray: shape (rows, columns), uint8.
        circle: u, v and radius, about [px].
        reach: how far inside and outside of the radius to look [px].
        step: between samples [px].
        band: how far beyond its inner edge the rim is darkest [px].
        edges: filled with where the light falls half-way to the rim's dark, shape (rays, 2).
        darkest: filled with the rim's darkest points, shape (rays, 2).

    Returns:
        How many edges were found, and how many darkest points.
    """
    u, v, radius = circle
    rays, count = len(edges), int(2.0 * reach / step)
    profile = np.empty(count)
    ahead = int(band / step) + 1
    edge_count, dark_count = 0, 0
    inner = max(3, count // 8)
    ordered = np.empty(inner)
    for ray in range(rays):
        angle = 2.0 * math.pi * ray / rays
        x, y = math.cos(angle), math.sin(angle)
        for index in range(count):
            r = radius - reach + index * step
            profile[index] = within(gray, u + r * x, v + r * y)
        inside = _small_median(profile, inner, ordered)
        dark = profile.min()
        if inside - dark < max(MIN_CONTRAST, CONTRAST * inside):
            continue
        half, index = 0.5 * (inside + dark), 0
        while profile[index] >= half:
            index += 1
        if index == 0:
            continue
        part = (profile[index - 1] - half) / (profile[index - 1] - profile[index])
        r = radius - reach + (index - 1 + part) * step
        edges[edge_count, 0], edges[edge_count, 1] = u + r * x, v + r * y
        edge_count += 1
        end = min(index + ahead, count - 1)
        lowest = index
        for other in range(index, end + 1):
            if profile[other] < profile[lowest]:
                lowest = other
        if 0 < lowest < end:
            left, low, right = profile[lowest - 1], profile[lowest], profile[lowest + 1]
            bend = left - 2.0 * low + right
            # Beyond its darkest ring a rim is brighter again; a plain edge has no such ring.
            if bend > 0.0 and profile[lowest : end + 1].max() > low + 0.5 * MIN_CONTRAST:
                r = radius - reach + (lowest + 0.5 * (left - right) / bend) * step
                darkest[dark_count, 0], darkest[dark_count, 1] = u + r * x, v + r * y
                dark_count += 1
    return edge_count, dark_count


@compiled
def fit_rim(points, centre, min_points, rim):
    """Fit harmonics to a rim about a centre, leaving out what is far from it.

        r(t) = c_0 + c_1 cos t + c_2 sin t + c_3 cos 2t + c_4 sin 2t

    by least squares, over the points within three standard deviations of the last fit.

    Args:
        points: on the rim, shape (m, 2) [px].
        centre: u and v [px].
        min_points: that have to agree.
        rim: filled with c, shape (5,) [px].

    Returns:
        How many points agree, 0 if too few do, and the root mean square of their residuals [px].
    """
    total = len(points)
    basis, away, residual = np.empty((total, 5)), np.empty(total), np.empty(total)
    for index in range(total):
        x, y = points[index, 0] - centre[0], points[index, 1] - centre[1]
        away[index] = np.hypot(x, y)
        cosine, sine = x / max(away[index], 1e-9), y / max(away[index], 1e-9)
        basis[index, 0], basis[index, 1], basis[index, 2] = 1.0, cosine, sine
        basis[index, 3], basis[index, 4] = cosine * cosine - sine * sine, 2.0 * sine * cosine
    kept, count = np.ones(total, np.bool_), total
    system, right = np.empty((5, 5)), np.empty(5)
    for _ in range(4):
        if count < min_points:
            return 0, 0.0
        system[:], right[:] = 0.0, 0.0
        for index in range(total):
            if kept[index]:
                for i in range(5):
                    right[i] += basis[index, i] * away[index]
                    for j in range(5):
                        system[i, j] += basis[index, i] * basis[index, j]
        rim[:] = np.linalg.solve(system, right)
        for index in range(total):
            fitted = 0.0
            for i in range(5):
                fitted += basis[index, i] * rim[i]
            residual[index] = abs(away[index] - fitted)
        bound = max(0.3, 3.0 * 1.4826 * np.median(residual))
        square, count = 0.0, 0
        for index in range(total):
            kept[index] = residual[index] < bound
            if kept[index]:
                square += residual[index] ** 2
                count += 1
    return count, np.sqrt(square / max(count, 1))
