"""The image along a needle, straightened: what is steel in it, and where its middle runs."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from magnetosuture_thread.vision.needle.arc import Arc
from magnetosuture_thread.vision.needle.edges import fit_edges
from magnetosuture_thread.vision.sampling import fit_middles, ground_beside, middle, straighten

BEYOND_PX = 15.0  # looked at beyond both ends of the dark component
ASIDE_PX = 7.0  # and beyond both edges of the body
STEP_ASIDE_PX = 0.5
FAINTEST = 0.3  # of the floor's brightness: a needle is darker than it by at least this
SHADOW, STEEL = 0.25, 0.65  # of the body's darkness: up to here shadow, from here on steel
OUTER_COLUMNS = 4  # on each side, that show the ground
GROUND_ROWS = 15  # of the running median along the ground on either side
# What no fit's residual tells of: most likely for the errors over hundreds of simulated poses, needles and image sizes.
TAIL_ERROR_PX, ASIDE_ERROR_PX, ANGLE_ERROR = 0.2, 0.095, math.radians(0.085)
TAPER = 0.2  # of the length, towards the tip
FEIGNED_TURN = 0.02  # rad over the body, that gleam and shadow alone can make
CORRELATED_ROWS = 3.0  # rows whose error is one and the same, by the lens' blur


@dataclass(frozen=True)
class Strip:
    """The image along an axis, straightened, as darkness."""

    arc: Arc
    along: np.ndarray
    aside: np.ndarray
    dark: np.ndarray  # share of the ground's brightness that is missing, shape (along, aside)
    ground: np.ndarray  # brightness on either side, shape (along, 2)
    depth: float  # darkness of the body
    steel: np.ndarray  # 0 for ground and shadow to 1 for steel, shape (along, aside)
    width: np.ndarray  # of the steel in each row [px]


def straight_strip(gray: np.ndarray, arc: Arc, last: float, width: float) -> Strip | None:
    """Straighten the image along an axis; None if nothing dark lies along it."""
    along = np.arange(-BEYOND_PX, last + BEYOND_PX + 0.5)
    half = 0.5 * width + ASIDE_PX
    aside = np.arange(-half, half + 0.1, STEP_ASIDE_PX)
    strip = np.empty((len(along), len(aside)), np.float32)
    straighten(gray, (float(arc.start[0]), float(arc.start[1]), arc.angle, arc.curvature), along, aside, strip)
    ground = np.empty((len(along), 2), np.float32)
    ground_beside(strip, OUTER_COLUMNS, GROUND_ROWS, ground)
    part = np.linspace(0.0, 1.0, len(aside), dtype=np.float32)
    dark = 1.0 - strip / np.maximum(ground[:, :1] * (1.0 - part) + ground[:, 1:] * part, 1.0)
    inner = (along > 0.2 * last) & (along < 0.8 * last)
    core = np.abs(aside) < 0.5 * width + 1.5
    depth = middle(dark[np.ix_(inner, core)].max(axis=1)) if inner.any() else 0.0
    if depth < FAINTEST:
        return None
    steel = np.clip((dark / depth - SHADOW) / (STEEL - SHADOW), 0.0, 1.0)
    steel[:, np.abs(aside) > 0.5 * width + 4.0] = 0.0
    return Strip(arc, along, aside, dark, ground, depth, steel, steel.sum(axis=1) * STEP_ASIDE_PX)


def fit_axis(
    strip: Strip,
    low: float,
    high: float,
    widths: tuple[float, float],
    tail: float | None = None,
    half: float | None = None,
) -> tuple[Arc, float, np.ndarray] | None:
    """Fit the axis through the middles of the steel.

    Args:
        strip: the image along the axis known so far.
        low: length along it from which the middles count [px].
        high: and to which [px].
        widths: least and greatest width of the steel of a row that counts [px].
        tail: where the tail is, if it is known: then the arc begins there, and a curvature so small that
            light from one side can feign it is made smaller still.
        half: half of the body's width, if it is known: then the axis lies half-way between the body's edges, one of
            which a thread may hide [px].

    Returns:
        The axis, how far it moved [px], and the covariance of the tail along and aside of the axis and of
        its angle; None if too few rows count.
    """
    at = 0.0 if tail is None else tail  # the polynomial is written from here
    scale = max(high - low, 1.0)
    span = (low, high, *widths, at)
    rows = strip.along, strip.aside, strip.steel, strip.width, span, scale
    if half is None:
        values, inverse = np.empty(3), np.empty((3, 3))
        even, kept, residual = fit_middles(*rows, values, inverse)
        taken = even
    else:
        values, inverse = np.empty(4), np.empty((4, 4))
        even, taken, kept, residual = fit_edges(*rows, half, values, inverse)
    if even < 0.4 * (high - low) or kept < 0.5 * taken:
        return None
    variance = residual * CORRELATED_ROWS
    inverse *= variance
    if tail is not None:
        values[:3] += _steadied(strip.arc.curvature + 2.0 * values[2] / scale**2, scale)
    c0, c1, c2 = values[0], values[1] / scale, 2.0 * values[2] / scale**2
    arc = strip.arc.moved(at, float(c0), float(c1), float(c2))
    covariance = np.zeros((3, 3))
    covariance[1:, 1:] = inverse[:2, :2] / np.array([[1.0, scale], [scale, scale**2]])
    covariance += np.diag([0.0, ASIDE_ERROR_PX**2, ANGLE_ERROR**2])
    # Where the tail is taken to lie farther along a bent needle, it points elsewhere.
    lengthwise = np.array([1.0, 0.0, arc.curvature])
    covariance += (TAIL_ERROR_PX**2 + variance) * np.outer(lengthwise, lengthwise)
    ends = (np.array([low, high]) - at) / scale
    moved = np.abs(values[0] + ends * (values[1] + ends * values[2])).max()
    return arc, float(moved), covariance


def _steadied(curvature: float, scale: float) -> np.ndarray:
    """Return what a fit's three values change by where a curvature feigned by light is made smaller."""
    turn = (curvature * scale) ** 2
    less = -curvature * FEIGNED_TURN**2 / (turn + FEIGNED_TURN**2)
    square = 0.5 * less * scale**2
    # Of t^2, over t from 0 to 1, the best line takes t - 1/6.
    return square * np.array([1.0 / 6.0, -1.0, 1.0])


def body_width(strip: Strip, last: float) -> float:
    """Return the body's width, a median over its middle."""
    return middle(strip.width[(strip.along > 0.3 * last) & (strip.along < 0.7 * last)])
