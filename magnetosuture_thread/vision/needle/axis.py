"""Fits a needle's axis to its straightened image, robustly."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.vision.needle.arc import Arc
from magnetosuture_thread.vision.needle.strip import Strip

MIN_POINTS = 6  # of a fit
RESIDUAL_PX = 0.25  # that an edge or a middle may lie off its fit
REACH_PX = 2.0  # beyond half the width, that belongs to an edge
HALF_WEIGHT = 4.0  # of the width known before, in edges
MIDDLE_ROUNDS, EDGE_ROUNDS = 3, 6
# What no fit's residual tells of: most likely for the errors over hundreds of simulated poses, needles and image sizes.
TAIL_ERROR_PX, ASIDE_ERROR_PX, ANGLE_ERROR = 0.2, 0.095, math.radians(0.085)
FEIGNED_TURN = 0.02  # rad over the body, that gleam and shadow alone can make
CORRELATED_ROWS = 3.0  # rows whose error is one and the same, by the lens' blur


class AxisFit(NamedTuple):
    """A parabola through a strip, c_0 + c_1 t + c_2 t^2 with t = (s - at) / scale.

    Attributes:
        rows: of one width.
        taken: points, which are middles or edges of rows.
        kept: of them, 0 if too few.
        square: mean square of the kept points' residuals [px^2].
        values: c, and half of the body's width where edges are fitted, shape (3,) or (4,) [px].
        inverse: of the normal matrix.
    """

    rows: int
    taken: int
    kept: int
    square: float
    values: np.ndarray
    inverse: np.ndarray


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
    span = (low, high, *widths)
    fit = fit_middles(strip, span, at, scale) if half is None else fit_edges(strip, span, at, scale, half)
    if fit.rows < 0.4 * (high - low) or fit.kept < 0.5 * fit.taken:
        return None
    values, variance = fit.values, fit.square * CORRELATED_ROWS
    if tail is not None:
        values[:3] += _steadied(strip.arc.curvature + 2.0 * values[2] / scale**2, scale)
    c0, c1, c2 = values[0], values[1] / scale, 2.0 * values[2] / scale**2
    arc = strip.arc.moved(at, float(c0), float(c1), float(c2))
    covariance = np.zeros((3, 3))
    covariance[1:, 1:] = variance * fit.inverse[:2, :2] / np.array([[1.0, scale], [scale, scale**2]])
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


def fit_middles(strip: Strip, span: tuple[float, float, float, float], at: float, scale: float) -> AxisFit:
    """Fit a parabola through the middles of a strip's steel.

    Args:
        strip: the image along an axis.
        span: first and last length to take, least and greatest width of the steel [px].
        at: length at which t is 0 [px].
        scale: of t [px].
    """
    low, high, narrowest, widest = span
    rows = (strip.along > low) & (strip.along < high) & (strip.width > narrowest) & (strip.width < widest)
    steel, t = strip.steel[rows].astype(float), (strip.along[rows] - at) / scale
    middles = steel @ strip.aside / np.maximum(steel.sum(axis=1), 1e-9)
    basis, kept = np.column_stack([np.ones(len(t)), t, t * t]), np.ones(len(t), bool)
    values, inverse, residual, good = fit_robustly(basis, middles, kept, 0.0, 0.0, MIDDLE_ROUNDS, np.inf)
    square = float(np.sum(residual[kept] ** 2)) / max(good, 1)
    return AxisFit(len(t), len(t), good if good >= MIN_POINTS else 0, square, values, inverse)


def fit_edges(strip: Strip, span: tuple[float, float, float, float], at: float, scale: float, half: float) -> AxisFit:
    """Fit a parabola half-way between a strip's two edges: one shows where it runs if the other is hidden.

        left(t) = d(t) - h,    right(t) = d(t) + h,    d(t) = c_0 + c_1 t + c_2 t^2,    t = (s - at) / scale

    A thread beside the body hides one edge only. Three fits begin, from the rows of one width, from all left edges
    and from all right ones; each then takes whichever edges are near it. The one with the least sum of squared
    residuals, none counted beyond `RESIDUAL_PX`, is kept.

    Args:
        strip: the image along an axis, with 0 aside within the body.
        span: first and last length to take, least and greatest width of a row of one width; a wider row still has
            two edges, of which one may count [px].
        at: length at which t is 0 [px].
        scale: of t [px].
        half: half of the body's width, about [px].
    """
    low, high, narrowest, widest = span
    rows = (strip.along > low) & (strip.along < high) & (strip.width > narrowest)
    near = np.abs(strip.aside) < half + REACH_PX
    aside, step = strip.aside[near], strip.aside[1] - strip.aside[0]
    part = step * np.clip(0.5 + aside / step, 0.0, 1.0)  # of a column that is right of the middle
    steel, t = strip.steel[np.ix_(rows, near)].astype(float), (strip.along[rows] - at) / scale
    edge = np.column_stack([steel @ (part - step), steel @ part]).ravel()
    t, side = np.repeat(t, 2), np.tile([-1.0, 1.0], len(t))
    basis, even = np.column_stack([np.ones(len(t)), t, t * t, side]), np.repeat(strip.width[rows] < widest, 2)
    best, least = AxisFit(int(even.sum()) // 2, len(t), 0, 0.0, np.zeros(4), np.zeros((4, 4))), np.inf
    for kept in (even.copy(), side < 0.0, side > 0.0):
        values, inverse, residual, good = fit_robustly(
            basis, edge, kept, HALF_WEIGHT, half, EDGE_ROUNDS, 3.0 * RESIDUAL_PX
        )
        missed = float(np.sum(np.minimum(residual**2, RESIDUAL_PX**2)))
        if good >= MIN_POINTS and missed < least:
            least = missed
            square = float(np.sum(residual[kept] ** 2)) / good
            best = best._replace(kept=good, square=square, values=values, inverse=inverse)
    return best


@compiled
def fit_robustly(basis, target, kept, weight, last, rounds, widest):
    """Fit to the kept points by least squares, keep those near the fit instead, and so on.

    Args:
        basis: shape (m, k).
        target: shape (m,).
        kept: which points to begin with; replaced by those kept at the end, shape (m,).
        weight: of the value that the last coefficient is expected to have, in points.
        last: this value.
        rounds: at most.
        widest: bound of a kept point's residual, at most.

    Returns:
        Coefficients, inverse of the normal matrix, residuals, and how many points are kept.
    """
    size = basis.shape[1]
    values, inverse, residual = np.zeros(size), np.zeros((size, size)), np.zeros(len(target))
    good = kept.sum()
    for _ in range(rounds):
        if good < MIN_POINTS:
            break
        chosen = basis[kept]
        normal, right = chosen.T @ chosen, chosen.T @ target[kept]
        normal[-1, -1] += weight
        right[-1] += weight * last
        inverse = np.linalg.inv(normal)
        values = inverse @ right
        residual = target - basis @ values
        spread = 1.4826 * np.median(np.abs(residual)[kept])
        kept[:] = np.abs(residual) < min(max(RESIDUAL_PX, 3.0 * spread), widest)
        good = kept.sum()
    return values, inverse, residual, good
