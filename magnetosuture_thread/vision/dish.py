"""Finds the petri dish: a bright disc within a dark rim."""

from __future__ import annotations

import cv2
import numpy as np

from magnetosuture_thread.geometry.camera import DishView

RAYS = 360
SHARE_OF_RAYS = 0.6  # of the rays must meet the fitted circle
AGREEMENT_PX = 2.0


def find_dish(gray: np.ndarray, diameter: float) -> DishView | None:
    """Find the dish by the inner edge of its rim.

    A circle transform gives the first guess; then rays from its centre meet the edge where the
    brightness falls half-way to the rim's dark, with sub-pixel precision, and a circle is fitted to
    these points, those far from it left out.

    Args:
        gray: image, shape (rows, columns), uint8.
        diameter: the dish's inner diameter [m], which gives the scale.

    Returns:
        The view, or None if no dish is seen: too few rays agree on a circle.
    """
    guess = _first_guess(gray)
    if guess is None:
        return None
    u, v, radius = guess
    for reach in (0.12, 0.06):
        points = _edge_points(gray, u, v, radius, reach)
        fitted = _fit_circle(points, AGREEMENT_PX)
        if fitted is None:
            return None
        u, v, radius, agreeing = fitted
    if agreeing < SHARE_OF_RAYS * RAYS:
        return None
    return DishView((u, v), 0.5 * diameter / radius)


def _first_guess(gray: np.ndarray) -> tuple[float, float, float] | None:
    """Return centre and radius of the strongest large circle, found at a quarter of the size."""
    factor = 4
    small = cv2.resize(
        cv2.GaussianBlur(gray, (0, 0), 2.0), None, fx=1 / factor, fy=1 / factor, interpolation=cv2.INTER_AREA
    )
    side = min(small.shape)
    circles = cv2.HoughCircles(
        small,
        cv2.HOUGH_GRADIENT,
        dp=1,
        minDist=side,
        param1=60,
        param2=20,
        minRadius=int(0.25 * side),
        maxRadius=int(0.55 * side),
    )
    if circles is None:
        return None
    u, v, radius = (float(value) for value in np.asarray(circles).reshape(-1, 3)[0])
    offset = 0.5 * (factor - 1)
    return u * factor + offset, v * factor + offset, radius * factor


def _edge_points(gray: np.ndarray, u: float, v: float, radius: float, reach: float) -> np.ndarray:
    """Return where rays from the centre meet the inner edge of the dark rim, shape (m, 2)."""
    angles = np.linspace(0.0, 2.0 * np.pi, RAYS, endpoint=False)
    radii = np.arange((1.0 - reach) * radius, (1.0 + reach) * radius, 0.5)
    across = np.stack([np.cos(angles), np.sin(angles)])
    samples = np.array([u, v])[:, None, None] + across[:, :, None] * radii
    profile = cv2.remap(
        gray,
        samples[0].astype(np.float32),
        samples[1].astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    ).astype(float)
    inside = np.median(profile[:, : max(3, len(radii) // 8)], axis=1)
    dark = profile.min(axis=1)
    contrast = inside - dark
    half = 0.5 * (inside + dark)
    below = profile < half[:, None]
    index = below.argmax(axis=1)
    good = below.any(axis=1) & (index > 0) & (contrast > 30.0)
    rows = np.flatnonzero(good)
    index = index[good]
    before, after = profile[rows, index - 1], profile[rows, index]
    part = (before - half[rows]) / np.maximum(before - after, 1e-6)
    at = radii[index - 1] + part * (radii[1] - radii[0])
    return np.column_stack([u + at * across[0, rows], v + at * across[1, rows]])


def _fit_circle(points: np.ndarray, agreement: float) -> tuple[float, float, float, int] | None:
    """Fit a circle by least squares, leaving out what is far from it; None with too few points."""
    kept = points
    for tolerance in (8.0 * agreement, 3.0 * agreement, agreement):
        if len(kept) < 20:
            return None
        system = np.column_stack([2.0 * kept, np.ones(len(kept))])
        (u, v, rest), *_ = np.linalg.lstsq(system, (kept**2).sum(axis=1), rcond=None)
        radius = float(np.sqrt(max(rest + u * u + v * v, 0.0)))
        distance = np.abs(np.hypot(points[:, 0] - u, points[:, 1] - v) - radius)
        kept = points[distance < tolerance]
    return float(u), float(v), radius, len(kept)
