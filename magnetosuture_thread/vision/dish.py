"""Finds the petri dish, a bright disc within a dark rim, how far the camera over it is tilted, and whether it moves.

The dish is found by its rim; without one, as in a photograph, by the edge of its wall, see `ellipse`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.vision.ellipse import FINE_AGREEMENT, Ellipse, edge_along, find_ellipse, fitted_robustly
from magnetosuture_thread.vision.images import Gray, measured_channel, middle, sampled
from magnetosuture_thread.vision.settings import VisionTrackerSettings

RAYS, RIM_RAYS = 180, 72  # along which the rim is looked for, and of the quick check
SHARE_OF_RAYS = 0.6  # of the rays must meet the fitted circle
REACH = 0.04  # of the radius, in which the rim is looked for once it is known
AGREEMENT_PX = 2.0
EDGE_LEVEL = 60  # of the circle transform, as of Canny's upper threshold; the lower one is half of it
MIN_CONTRAST = 12.0  # grey levels; of the rim at least, and 0.15 of the floor's brightness

MIN_ANGLE = math.radians(3.5)  # below, light from one side moves the rim as much
NEAR = 0.1  # of its distance from the camera, that the dish's radius is at most; more is hardly used over a dish

DARK_FLOOR = 130.0  # grey levels; a dish, or with a given view a frame, whose median is below may have a dark floor
SCALE_ERROR = 0.001  # of a scale by the dish's rim: how far its light moves the edge
AGREEING = 3  # frames in a row that must agree on a new view
LONG_SEARCH = 4  # frames without a dish, in one of which it is looked for as in a photograph


Guess = tuple[float, float, float]  # u, v and radius of a circle [px]


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
        # Light and noise change a tilt by 2 degrees.
        return np.outer(either, either) + unseen_tilt_covariance(tail, heading, math.radians(2.0), radius)

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
        total = np.zeros((3, 3))
        total[:2, :2] = self.scale_error**2 * np.outer(tail, tail)  # A wrong scale shifts what is far from the centre.
        if self.tilt is not None:
            total += self.tilt.covariance(tail, heading, radius)
        elif self.unseen_tilt:
            total += unseen_tilt_covariance(tail, heading, self.unseen_tilt, radius)
        return total

    @property
    def warning(self) -> str:
        """What makes the measurement worse than it could be; empty if nothing does."""
        tilted = f"the camera is tilted by {math.degrees(self.tilt.angle):.0f} degrees" if self.tilt is not None else ""
        return "; ".join(filter(None, (tilted, self.remark)))

    def prepared(self, image: np.ndarray) -> np.ndarray:
        """Return a frame with a bright floor and a round dish."""
        if self.dark_field:
            image = 255 - image
        if self.homography is not None:
            size = image.shape[1::-1]
            return np.asarray(cv2.warpPerspective(image, self.homography, size, borderMode=cv2.BORDER_REPLICATE))
        return image if self.tilt is None else self.tilt.corrected(image, self.view)


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
    guesses: dict[int, Guess | None] = {}
    fixed = settings.fixed_view()
    if fixed is not None:
        # Only a dark frame whose negative shows the dish has a dark floor: others are just dark.
        dark = middle(gray[::8, ::8]) < DARK_FLOOR and _with_given(find_dish(gray, diameter, guesses), settings) is None
        dark = dark and _with_given(find_dish(255 - gray, diameter, guesses), settings) is not None
        return FoundDish(fixed, dark, homography=settings.homography())
    for dark_field in (False, True):
        if dark_field:
            gray = 255 - gray
        found = _with_given(find_dish(gray, diameter, guesses), settings)
        if found is None:
            continue
        view, remark = found
        if dark_field and floor_level(gray, view, diameter) < 255.0 - DARK_FLOOR:
            continue  # A bright rim around a bright floor, as of clear walls.
        if settings.dish_centre_px or settings.metres_per_pixel:  # measured by a calibration
            error = 0.0 if settings.metres_per_pixel and not remark else SCALE_ERROR
            return FoundDish(view, dark_field, scale_error=error, remark=remark)
        tilt, view = find_tilt(gray, view, diameter)
        return FoundDish(view, dark_field, tilt, SCALE_ERROR, 0.0 if tilt is not None else MIN_ANGLE)
    return _photographed(image, settings, diameter) if photographed else None


def _with_given(found: DishView | None, settings: VisionTrackerSettings) -> tuple[DishView, str] | None:
    """Return a view that was found with what is given of it, and a remark; None if they don't fit at all.

    Where a given scale and the dish differ by more than a rim's light can make, all that is known of the scene is
    relative to its dish: the dish gives the scale.
    """
    if found is None:
        return None
    scale, remark = settings.metres_per_pixel or found.metres_per_pixel, ""
    apart = found.metres_per_pixel / scale - 1.0
    if abs(apart) > 0.1:  # It is another dish.
        return None
    if abs(apart) > 0.03:  # more than the rim's light can make
        scale = found.metres_per_pixel
        remark = f"metres_per_pixel is {100.0 * abs(apart):.0f} % off what the dish's diameter makes it, which is used"
    centre = settings.dish_centre_px
    return DishView((centre[0], centre[1]) if centre else found.centre_px, scale, settings.camera_rotation), remark


def _photographed(image: np.ndarray, settings: VisionTrackerSettings, diameter: float) -> FoundDish | None:
    """Find a dish by its ellipse alone, as in a photograph: cut, saturated, with a lid, on any ground."""
    ellipse = find_ellipse(image)
    if ellipse is None:
        return None
    gray, found = measured_channel(image), DishView(ellipse.centre_px, 0.5 * diameter / ellipse.major)
    tilt, unseen_tilt = tilt_of(ellipse, settings.camera_rotation), MIN_ANGLE
    if tilt is not None and ellipse.is_cut(image.shape):
        # A part of an ellipse does not determine its axes: an edge that is off by a pixel looks like a tilt.
        circle = fit_circle(edge_along(gray, ellipse), max(1.0, FINE_AGREEMENT * ellipse.major))
        cut = find_cut_dish(gray, circle[:3], diameter) if circle is not None else None
        if cut is None:
            return None
        found, tilt, unseen_tilt = cut, None, math.radians(10.0)
    if (given := _with_given(found, settings)) is None:
        return None
    view, remark = given
    dark_field = floor_level(gray, found, diameter) < 64.0
    tilt = None if settings.dish_centre_px or settings.metres_per_pixel else tilt
    # The scale is off by 1 %: which edge of the wall it is, and where light moves it.
    return FoundDish(view, dark_field, tilt, 0.01, 0.0 if tilt is not None else unseen_tilt, remark)


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
        self._settings = settings
        self._diameter = diameter
        self._fixed = settings.fixed_view()
        self.found: FoundDish | None = None
        self._anew: list[FoundDish] = []
        self._searched = 0  # frames in a row without a dish

    @property
    def view(self) -> DishView | None:
        """Where the dish is; None if it was not found yet."""
        return self._fixed or (self.found.view if self.found is not None else None)

    def forget(self) -> None:
        """Begin anew, as with a camera of another size."""
        self.found, self._anew, self._searched = None, [], 0

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
                return "no dish in the image", image
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
            return "too little of the dish is seen", prepared
        if self._agree(found, self.found):  # A rim that is not dark is seen by its ellipse only.
            self._anew = []
            return "", prepared
        if self._anew and not self._agree(found, self._anew[-1]):
            self._anew = []
        self._anew.append(found)
        if len(self._anew) < AGREEING:
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
        near = apart < max(1.0, slack * 0.5 * self._diameter / scale)
        return near and abs(scale / other.view.metres_per_pixel - 1.0) < max(0.005, slack)


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
        fitted = _fit_rim(gray, guess)
        if fitted is None or fitted[0][3] < SHARE_OF_RAYS * RAYS:
            continue
        (u, v, radius, _), _, darkest = fitted
        ring = fit_circle(darkest, 0.5 * AGREEMENT_PX)
        if ring is not None and ring[3] >= SHARE_OF_RAYS * RAYS and np.hypot(ring[0] - u, ring[1] - v) < AGREEMENT_PX:
            u, v = ring[:2]
        elif _is_saturated(gray, u, v, radius):  # Then the edge lies where the light makes it seem to.
            continue
        return DishView((u, v), 0.5 * diameter / radius)
    return None


def _fit_rim(gray: Gray, guess: Guess) -> tuple[tuple[float, float, float, int], Points, Points] | None:
    """Return the circle along a rim's inner edge, that edge and the darkest ring; None if too few rays agree."""
    edges = darkest = np.empty((0, 2))
    fitted = (*guess, 0)
    # In shares of the radius: by a first guess, and once it is known.
    for reach, step in ((0.12, 1.0), (REACH, 0.5)):
        u, v, radius, _ = fitted
        edges, darkest = rim_points(gray, (u, v), radius, reach * radius, step, RAYS)
        found = fit_circle(edges, AGREEMENT_PX)
        if found is None:
            return None
        fitted = found
    return fitted, edges, darkest


def find_cut_dish(gray: np.ndarray, guess: Guess, diameter: float) -> DishView | None:
    """Find a dish that the frame cuts off by what is seen of its rim: its darkest ring, and its inner edge around that.

    Args:
        gray: image, shape (rows, columns), uint8.
        guess: a circle near it [px].
        diameter: the dish's inner diameter [m].

    Returns:
        The view, or None if too few rays agree on a circle, of those that meet it in the frame.
    """
    fitted = _fit_rim(gray, guess)
    if fitted is None:
        return None
    (u, v, radius, _), edges, darkest = fitted
    turns = 2.0 * np.pi * np.arange(RAYS) / RAYS
    rim = np.array([u, v]) + radius * np.column_stack([np.cos(turns), np.sin(turns)])
    inside = ((rim > 0.0) & (rim < np.array(gray.shape[::-1]) - 1.0)).all(axis=1).sum()
    ring = fit_circle(darkest, 0.5 * AGREEMENT_PX)
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
    edges, darkest = rim_points(gray, centre, radius, 7.0, 1.0, RIM_RAYS)
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
    inside, dark = np.median(profiles[:, : max(3, count // 8)], axis=1), profiles.min(axis=1)
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


def _is_saturated(gray: np.ndarray, u: float, v: float, radius: float) -> bool:
    """Say whether the floor near the rim is as bright as the image can show."""
    angles = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
    at = np.column_stack([u + 0.93 * radius * np.cos(angles), v + 0.93 * radius * np.sin(angles)])
    columns, rows = np.clip(at.round().astype(int), 0, np.array(gray.shape[::-1]) - 1).T
    return float(np.mean(gray[rows, columns] >= 253)) > 0.15


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
        mean = kept.mean(axis=0)  # around which the equations are well conditioned
        x, y = (kept - mean).T
        basis = np.stack([2.0 * x, 2.0 * y, np.ones_like(x)])
        u, v, c = np.linalg.solve(basis @ basis.T + 1e-9 * np.eye(3), basis @ (x * x + y * y))
        radius, centre = math.sqrt(max(c + u * u + v * v, 0.0)), mean + np.array([u, v])
        kept = points[np.abs(np.hypot(*(points - centre).T) - radius) < tolerance]
    return float(centre[0]), float(centre[1]), radius, len(kept)


def tilt_of(ellipse: Ellipse, rotation: float) -> Tilt | None:
    """Return the tilt under which a circle is seen as an ellipse; None below what one tells."""
    angle = math.acos(min(1.0, ellipse.minor / ellipse.major))
    return Tilt(angle, ellipse.direction, rotation) if angle > MIN_ANGLE else None


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
    tilt = tilt_of(ellipse, view.rotation)
    if tilt is None or near.sum() < RAYS // 2 or 0.5 * (1.0 - ellipse.minor / ellipse.major) < 4.0 * noise:
        return None, view
    # The circle lies half-way between both axes, so that its scale becomes that of the longer one.
    scale = view.metres_per_pixel * 0.5 * (1.0 + ellipse.minor / ellipse.major)
    return tilt, DishView(ellipse.centre_px, scale, view.rotation)
