"""Polylines, which are open chains of vertices, an array of shape (m, d); and the check of arrays from callers."""

from __future__ import annotations

import cmath
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.settings.configuration import Quantity
from magnetosuture_thread.settings.errors import InvalidInputError, shortened

Points = NDArray[np.float64]
Vector = NDArray[np.float64]
Table = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]
MIN_TURN_RATIO = 0.3  # of the radius of a circle that a polyline turns in


def as_numbers(name: str, value: Any) -> NDArray[np.float64]:
    """Return an array of a caller's numbers, itself where it is one.

    Raises:
        InvalidInputError: they are not numbers, or rows of different lengths.
    """
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InvalidInputError(name, shortened(repr(value)), "an array of numbers") from None


def finite_array(name: str, value: Any, shape: tuple[int | None, ...], limits: Quantity) -> NDArray[np.float64]:
    """Return an array of a caller's numbers that has a shape and is within limits.

    Args:
        name: of the array, for the error.
        value: to check.
        shape: that it must have; None for any length.
        limits: of each number.

    Raises:
        InvalidInputError: something is not a number, not finite or out of the limits, or the shape is another.
    """
    array = as_numbers(name, value)
    if array.ndim != len(shape) or any(size not in (None, got) for size, got in zip(shape, array.shape, strict=True)):
        raise InvalidInputError(name, f"shape {array.shape}", f"shape {str(shape).replace('None', 'm')}")
    # Of a few numbers numpy takes longer to find the greatest.
    few = array.shape in ((2,), (3,))
    extremes = array.tolist() if few else [float(array.min(initial=0.0)), float(array.max(initial=0.0))]
    if not all(math.isfinite(number) and limits.minimum <= number <= limits.maximum for number in extremes):
        expected = limits.expectation(tuple, extremes).replace("a list", "numbers")
        raise InvalidInputError(name, extremes, f"finite {expected}, in shape {str(shape).replace('None', 'm')}")
    return array


def arc_lengths(points: Points) -> NDArray[np.float64]:
    """Return the arc length of each vertex from the first, shape (m,).

    >>> arc_lengths(np.array([[0.0, 0.0], [3.0, 4.0], [3.0, 6.0]]))
    array([0., 5., 7.])
    """
    steps, lengths = np.diff(points, axis=0), np.zeros(max(1, len(points)))
    np.cumsum(np.sqrt(np.einsum("ij,ij->i", steps, steps)), out=lengths[1:])
    return lengths


def points_at(points: Points, lengths: NDArray[np.float64]) -> Points:
    """Return the points at given arc lengths, shape (len(lengths), d).

    A length past either end gives that end: the polyline is never extrapolated.

    >>> points_at(np.array([[0.0, 0.0], [2.0, 0.0]]), np.array([0.5, 9.0]))
    array([[0.5, 0. ],
           [2. , 0. ]])
    """
    at = arc_lengths(points)
    return np.column_stack([np.interp(lengths, at, points[:, axis]) for axis in range(points.shape[1])])


def chain_along(points: Points, segments: int, segment_length: float) -> Points:
    """Lay a chain of equal segments along a polyline, starting at its first vertex.

    Every segment has exactly the given length, measured as a chord: each vertex is the first crossing
    of the polyline with a circle around the vertex before. Past the polyline's end the chain goes on
    along its last direction, so a thread that is seen only in part gets its full length.

    Args:
        points: polyline, shape (m, d), with at least two vertices that differ [m]; one that repeats the
            vertex before it is passed over.
        segments: number of segments n.
        segment_length: length of each [m].

    Returns:
        Vertices, shape (n + 1, d) [m].
    """
    moved = np.linalg.norm(np.diff(points, axis=0), axis=1) > 0.0
    points = points[np.concatenate([[True], moved])]
    last = points[-1] - points[-2]
    last = last / np.linalg.norm(last)
    # One segment more than the chain can need, so that every crossing exists.
    path = np.vstack([points, points[-1] + last * segment_length * (segments + 1)])
    chain = np.empty((segments + 1, points.shape[1]))
    chain[0] = path[0]
    edge, on_edge = 0, -1
    for index in range(1, segments + 1):
        centre = chain[index - 1]
        while float(np.linalg.norm(path[edge + 1] - centre)) < segment_length:
            edge += 1
        start = centre if edge == on_edge else path[edge]  # inside of the circle, and the edge's end is outside
        along, offset = path[edge + 1] - start, start - centre
        a, b, c = float(along @ along), float(along @ offset), float(offset @ offset) - segment_length * segment_length
        chain[index] = start + along * ((-b + np.sqrt(max(b * b - a * c, 0.0))) / a)
        on_edge = edge
    return chain


def chain_inside(points: Points, segments: int, segment_length: float, radius: float) -> Points:
    """Lay a chain of equal segments along a polyline in the plane, and inside of a circle about the origin.

    Where `chain_along` leads outside, as a thread does that is seen with some error or longer than there is room
    for, the chain follows the circle instead. Only its first vertex stays where it is in any case.

    Args:
        points: see `chain_along`, as are the two following.
        segments: number of segments n.
        segment_length: length of each, less than the radius [m].
        radius: of the circle; inf for none [m].

    Returns:
        Vertices, shape (n + 1, 2) [m].
    """
    chain = chain_along(points, segments, segment_length)
    away = np.linalg.norm(chain, axis=1)
    if not (away[1:] > radius).any():
        return chain
    targets = chain * np.minimum(1.0, radius / np.maximum(away, radius))[:, None]
    step, follows = chain[1] - chain[0], False
    for index in range(1, segments + 1):
        centre = chain[index - 1]
        toward = targets[index] - centre
        size = float(np.linalg.norm(toward))
        # What lies outside was moved in to about one place: there the chain goes on along the circle.
        if not (follows and away[index] > radius) and size > 0.5 * segment_length:
            step = toward * (segment_length / size)
        follows = float(np.linalg.norm(centre + step)) > radius
        if follows:
            step = _along_circle(centre, step, segment_length, radius)
        chain[index] = centre + step
    return chain


def lay_behind_needle(tail: Points, heading: Points, length: float, radius: float) -> Points:
    """Return a polyline of a length behind a needle in the plane: straight, and where a circle is in the way, turning.

    It turns by arcs of `MIN_TURN_RATIO` of the circle's radius, so early that it comes to lie along the circle.

    Args:
        tail: of the needle, shape (2,) [m].
        heading: unit vector along it, shape (2,).
        length: of the polyline [m].
        radius: of the circle about the origin; inf for none [m].

    Returns:
        Vertices, shape (m, 2) [m].
    """
    if not math.hypot(*(tail - length * heading).tolist()) > radius:
        return np.array([tail, tail - length * heading])
    arc = MIN_TURN_RATIO * radius
    spacing = 0.05 * arc
    # In complex numbers: to turn is to multiply. The origin is to the left where the side is 1.
    way, place = complex(*(-heading).tolist()), complex(*tail.tolist())
    side = 1.0 if (way.conjugate() * -place).imag >= 0.0 else -1.0
    turn = cmath.exp(1j * side * spacing / arc)
    laid = [place]
    while len(laid) <= length / spacing + 1.0:
        ahead = place + spacing * way
        if abs(ahead + 1j * side * arc * way) > radius - arc:  # from there it could not turn in any more
            way *= turn
        place += spacing * way
        laid.append(place)
    return np.array([[point.real, point.imag] for point in laid])


def _along_circle(centre: Points, step: Points, length: float, radius: float) -> Points:
    """Return the step of a length that ends on a circle about the origin, the nearer one to a step that leaves it."""
    away = float(np.linalg.norm(centre))
    inward = -centre / away
    cosine = min(max((away * away + length * length - radius * radius) / (2.0 * away * length), -1.0), 1.0)
    aside = float(np.sqrt(1.0 - cosine * cosine)) * np.array([-inward[1], inward[0]])
    return np.asarray(length * (cosine * inward + (aside if float(aside @ step) >= 0.0 else -aside)))
