"""Which side of a tilted dish is nearer: two rings in one plane are seen about different centres."""

from __future__ import annotations

import math

import cv2
import numpy as np

from magnetosuture_thread.vision.dish.robust_fits import fit_rim

OUTWARDS = 0.1  # of the rim's radius, within which a second ring is looked for
BEYOND = 0.02  # of it, from which on a ring is another one
WINDOW = 0.016  # of it, to both sides of a ring's darkest line, in which its profile is compared
MIN_WINDOW_PX = 2.0
STEP_PX = 0.5
MIN_DEPTH = 12.0  # grey levels that a ring is darker than what is on both sides of it
MAX_SHIFT_PX = 1.5  # of a ring in one direction, which is linearised
MIN_SHARE = 0.6  # of the directions that must agree
RING_ERROR = 3e-4  # of the radius: how far light moves one ring against another
MIN_LIKELIHOOD = 0.01  # standard deviations beyond the bounds that are meant by it: 2.3


def second_ring(gray: np.ndarray, rim: np.ndarray, middle: np.ndarray, rays: int) -> tuple[float, np.ndarray] | None:
    """Find a ring around the rim, as a wall's two edges make one, and how far its centre is from the rim's.

    The profile across each ray, q(x), is compared with the median m(x) over all of them,

        q(x) = a + b x + g m(x - s),    linearised in s,

    so that neither light nor its slope moves the ring. The shifts s are fitted as a rim is, see `fit_rim`.

    Args:
        gray: frame, shape (rows, columns), uint8.
        rim: the rim's harmonics, shape (5,), see `fit_rim` [px].
        middle: its centre, shape (2,) [px].
        rays: number of directions.

    Returns:
        The ratio of the ring's radius to the rim's, and the offset of its centre, shape (2,) [px]; None without a ring.
    """
    turns = np.linspace(0.0, 2.0 * np.pi, rays, endpoint=False)
    ways = np.column_stack([np.cos(turns), np.sin(turns)])
    radii = rim[0] + rim[3] * np.cos(2.0 * turns) + rim[4] * np.sin(2.0 * turns)
    beyond = np.arange(0.0, OUTWARDS * rim[0], STEP_PX)
    ratios = 1.0 + beyond / rim[0]
    at = (middle + (radii[:, None] * ratios)[..., None] * ways[:, None]).astype(np.float32)
    profiles = cv2.remap(gray, at[..., 0].copy(), at[..., 1].copy(), cv2.INTER_CUBIC).astype(float)
    inside = ((at >= 0.0) & (at <= np.array(gray.shape[::-1], np.float32) - 1.0)).all(axis=(1, 2))
    if inside.sum() < MIN_SHARE * rays:
        return None
    usual = np.median(profiles[inside], axis=0)
    index = _darkest(usual, int(BEYOND * rim[0] / STEP_PX))
    if index is None:
        return None
    reach = round(max(WINDOW * rim[0], MIN_WINDOW_PX) / STEP_PX)
    window = slice(max(0, index - reach), index + reach + 1)
    slope = np.gradient(usual, STEP_PX)[window]
    system = np.column_stack([slope, usual[window], np.ones(len(slope)), beyond[window]])
    change, gain = np.linalg.lstsq(system, profiles[inside][:, window].T, rcond=None)[0][:2]
    shifts = -change / np.maximum(gain, 1e-3)
    clear = (gain > 0.0) & (np.abs(shifts) < MAX_SHIFT_PX)
    ring = radii[inside][clear] * ratios[index] + shifts[clear]
    fitted = np.empty(5)
    points = middle + ring[:, None] * ways[inside][clear]
    count, _ = fit_rim(points, (float(middle[0]), float(middle[1])), int(MIN_SHARE * rays), fitted)
    return (float(fitted[0] / rim[0]), fitted[1:3].copy()) if count else None


def _darkest(profile: np.ndarray, first: int) -> int | None:
    """Return where a profile from the rim outwards is darkest, from an index on, between brighter parts."""
    depths = np.minimum(np.maximum.accumulate(profile), np.maximum.accumulate(profile[::-1])[::-1]) - profile
    depths[:first] = 0.0
    index = int(np.argmax(depths))
    return index if depths[index] >= MIN_DEPTH else None


def perspective_by_rings(
    ratio: float, offset: float, radius: float, angle: float, greatest: float
) -> tuple[float, float] | None:
    """Estimate the share that a dish's radius R is of its distance d from the camera, positive where +x is nearer.

    Under a camera tilted by an angle t a circle's centre is seen R^2 sin t cos t / d towards the nearer side of the
    middle of its ellipse, so that a ring of the radius p R in the same plane is seen off by

        s = (p^2 - 1) R k sin t cos t,    k = R / d

    All k from -K to K are held to be as likely, so that it is the mean of a truncated normal distribution. Rings of
    different heights h are seen off by h sin t, to the other side and mostly much farther: they are not used.

    Args:
        ratio: p of the ring's radius to the rim's.
        offset: s, of the ring along the direction in which the dish looks shortened [px].
        radius: R of the rim [px].
        angle: t [rad].
        greatest: K.

    Returns:
        k and its standard deviation; None where the rings can't lie in one plane.
    """
    effect = (ratio**2 - 1.0) * math.sin(angle) * math.cos(angle)
    measured, deviation = offset / (radius * effect), RING_ERROR / effect
    low, high = (-greatest - measured) / deviation, (greatest - measured) / deviation
    likely = 0.5 * (math.erf(high / math.sqrt(2.0)) - math.erf(low / math.sqrt(2.0)))
    if likely < MIN_LIKELIHOOD:
        return None
    at_low, at_high = (math.exp(-0.5 * x * x) / math.sqrt(2.0 * math.pi) for x in (low, high))
    shift = (at_low - at_high) / likely
    variance = 1.0 + (low * at_low - high * at_high) / likely - shift**2
    return measured + deviation * shift, deviation * math.sqrt(max(variance, 0.0))
