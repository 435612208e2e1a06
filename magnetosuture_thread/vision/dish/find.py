"""Finds the petri dish: a bright disc within a dark rim."""

from __future__ import annotations

import cv2
import numpy as np

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.vision.dish.robust_fits import fit_circle
from magnetosuture_thread.vision.sampling import middle, rim_along_rays

RAYS = 180
SHARE_OF_RAYS = 0.6  # of the rays must meet the fitted circle
SHARE_OF_CUT_RAYS, MIN_INSIDE = 0.75, 0.4  # of the rays in the frame, where the dish is cut off; that these are of all
GUESS_REACH = 0.12  # of the radius, in which the rim is looked for by a first guess
AGREEMENT_PX = 2.0
GUESS_SIDES = (60, 120)  # the first guess is made in images of about this many rows; the second only if the first fails
EDGE_LEVEL = 60  # of the circle transform, as of Canny's upper threshold; the lower one is half of it
MAX_EDGE_SHARE = 0.3  # of the pixels; where more are edges all is texture, in which circles agree by chance
MIN_CONTRAST = 12.0  # grey levels
CONTRAST = 0.15  # of the floor's brightness, at least, between floor and rim
SATURATED, SATURATED_SHARE = 253, 0.15  # grey level, and share of a ring on the floor
INNER_SIDE = 0.7  # of the diameter: of a square within the dish
BAND = 0.02  # of the radius: beyond the inner edge, the rim is darkest within
REACH = 0.04  # of the radius, in which the rim is looked for once it is known
RIM_RAYS = 72  # of the quick check
RIM_REACH_PX = 7.0  # how far the quick check looks in and out
STILL_PX = 1.0  # a rim seen this near to where it was stands still
RIM_SHARE = 0.4  # of the quick check's rays must see the rim


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
    for side in GUESS_SIDES:
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
    if ring is None or ring[3] < SHARE_OF_CUT_RAYS * inside or inside < MIN_INSIDE * RAYS:
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
    edges, darkest = _edge_points(gray, *centre, radius, RIM_REACH_PX, 1.0, RIM_RAYS)
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
    if np.count_nonzero(cv2.Canny(small, EDGE_LEVEL // 2, EDGE_LEVEL)) > MAX_EDGE_SHARE * small.size:
        return None
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
    band = max(4.0, BAND * radius)
    counts = rim_along_rays(gray, (u, v, radius), reach, step, band, MIN_CONTRAST, CONTRAST, edges, darkest)
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
    half = 0.5 * INNER_SIDE * diameter / view.metres_per_pixel
    left, top = (max(0, round(centre - half)) for centre in view.centre_px)
    right, bottom = (max(4, round(centre + half)) for centre in view.centre_px)
    return middle(gray[top:bottom:4, left:right:4])


def _is_saturated(gray: np.ndarray, u: float, v: float, radius: float) -> bool:
    """Say whether the floor near the rim is as bright as the image can show."""
    angles = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
    at = np.column_stack([u + 0.93 * radius * np.cos(angles), v + 0.93 * radius * np.sin(angles)])
    columns, rows = np.clip(at.round().astype(int), 0, np.array(gray.shape[::-1]) - 1).T
    return float(np.mean(gray[rows, columns] >= SATURATED)) > SATURATED_SHARE


def _fit_circle(points: np.ndarray, agreement: float) -> tuple[float, float, float, int] | None:
    """Return centre and radius of a circle, and how many points agree on it; None if too few do. See `fit_circle`."""
    circle = np.empty(3)
    agreeing = fit_circle(points, agreement, circle)
    return (float(circle[0]), float(circle[1]), float(circle[2]), agreeing) if agreeing else None
