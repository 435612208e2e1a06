"""Centres a walk between the two edges of the thread, whose colour and width it takes from the walk itself."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.vision.needle.measured_needle import MeasuredNeedle
from magnetosuture_thread.vision.sampling import middle
from magnetosuture_thread.vision.thread.appearance import across, respaced, sampled, sampled_colours, tangents_of
from magnetosuture_thread.vision.thread.ridge import DEVIATION, Ridge

SPACING_PX = 2.0  # of the vertices
STEP_PX = 0.5  # of samples across, and of shifts
EDGE_PX = 0.7  # standard deviation of the Gaussian whose derivative shows an edge: what a lens makes of a sharp one
HALF_WIDTHS_PX = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0)  # tried; a thinner thread looks like one of the first
ASIDE = 1.75  # of half a width, that a walk may be off the middle: along an edge, or along the shadow beside it
FLOOR_PX = 3.0  # beyond a thread's edge, up to which the floor beside it is sampled
EDGE_VERTICES = 3  # to both sides, over which an edge is averaged
COLOUR_VERTICES = 20  # the same of the thread's colour
BEND_PRICE = 1.0  # of a change of the shift by one step from vertex to vertex, in units of the log-likelihood
MAX_CHANGE = 3  # steps, by which the shift may change from vertex to vertex
WINDOW = 4  # vertices to both sides of a stretch, in which floor has to be the better explanation for a thread to end
BEGINNING = 2 * WINDOW + 1  # vertices where a thread comes out
MIN_FLOOR = 1.0  # mean evidence against a thread in a stretch, where it ends ...
GAP, SAME = 10, 0.5  # ... unless so few vertices on it shows this share of its usual contrast again
SHADOW = 0.5  # of a thread's usual contrast, that its shadow may show, whose edges are no sharp ones
EVEN = 2  # vertices to both sides, over which shifts are averaged
ROUNDS = 2  # of measuring the colour and then the shift
OUTLIER = 4.0  # deviations, beyond which a difference on the floor is none of noise
MIN_NOISE = 0.1  # grey levels of a derivative, by rounding
MIN_WIDTH_PX, MAX_WIDTH_PX = 7.0, 26.0  # between the two dark edges of something as bright as the floor
EDGE_SHOWN, EDGE_SHARE = 0.5, 0.7  # of one's strength, that the other has; share of the way over which it has it
NEEDLE_PX = 3.0  # beside the needle and beyond its ends, where its own edges are

Values = NDArray[np.float64]


@dataclass(frozen=True)
class CrossSection:
    """A walk in the middle between the two edges of a thread.

    Attributes:
        points: vertices, `SPACING_PX` apart, shape (m, 2) [px].
        half_width: of the thread [px].
        evidence: log-likelihood ratio of a thread against bare floor at each vertex, 0 where it is hidden, shape (m,).
        visible: which are not hidden, shape (m,).
        edges: of the two edges what each adds to c . D, shape (m, 2), see `centred_between_edges`.
    """

    points: Points
    half_width: float
    evidence: Values
    visible: NDArray[np.bool_]
    edges: Values

    @property
    def beginning(self) -> float:
        """Mean evidence where the thread comes out."""
        return _mean_of(self.evidence[self.visible][:BEGINNING])

    @property
    def mean(self) -> float:
        """Mean evidence."""
        return _mean_of(self.evidence[self.visible])

    @property
    def weakest(self) -> float:
        """The least mean evidence of a stretch."""
        return float(_mean(self.evidence[self.visible][:, None], WINDOW).min()) if self.visible.any() else 0.0

    @property
    def fainter_edge(self) -> float:
        """The share of c . D that the fainter edge has, where the thread comes out and of all of it, whichever is less.

        It is a half of an even thread, and 0 along the border of something else.
        """
        shares = []
        for edges in (self.edges[self.visible][:BEGINNING], self.edges[self.visible]):
            sums = edges.sum(axis=0)
            shares.append(float(sums.min() / max(sums.sum(), 1e-9)))
        return min(shares)

    def up_to_its_end(self) -> CrossSection:
        """Return the part up to where the thread ends.

        It is seen no farther than up to where floor explains a whole stretch better, and it does not show again soon
        after, as beyond a reflection of the lamp beside it; of that part, the evidence up to the end is the greatest
        (maximum likelihood). A last part as weak as a thread's shadow may be no more than that.
        """
        stretches = _mean(self.evidence[:, None], WINDOW)[:, 0]
        searched = self.evidence
        for first in np.flatnonzero(stretches < -MIN_FLOOR):
            usual = float(np.median(stretches[: first + 1]))
            if stretches[first : first + GAP].max() < max(MIN_FLOOR, SAME**2 * usual):
                searched = self.evidence[: first + 1]
                break
        count = int(np.argmax(np.cumsum(searched))) + 1
        strong = np.flatnonzero(stretches[:count] > SHADOW**2 * float(np.median(stretches[:count])))
        count = int(strong[-1]) + 1 if len(strong) else 1
        return CrossSection(
            self.points[:count],
            self.half_width,
            self.evidence[:count],
            self.visible[:count],
            self.edges[:count],
        )


def centred_between_edges(
    image: NDArray[np.uint8], needle: MeasuredNeedle, walk: Points, hidden: Callable[[Points], NDArray[np.bool_]]
) -> CrossSection:
    """Shift each vertex of a walk to the middle between the thread's edges.

    A thread of half width h at a shift s has, across it, the edges

        D(s) = W (g(s - h) - g(s + h))

    with the derivative g of each colour, and W that makes the noise on the floor beside the thread white. That leaves
    out what all colours share there, as shadows and smears do, the more the more there is of it. The thread's own D,
    the mean c of those along the walk nearby, is what a vertex is compared with: the shifts maximise

        sum_i c_i . D_i(s_i) - k (s_i - s_(i-1))^2

    (Viterbi), and the ratio c . D - |c|^2 / 2 is the evidence. A thread's shadow has no sharp edges, so the middle is
    the thread's and not that of both.

    Args:
        image: shape (rows, columns) or (rows, columns, 3), uint8.
        needle: in the image's pixels; its edges do not count.
        walk: along the thread from the needle's tail on, shape (m, 2) [px].
        hidden: returns which of some points are hidden, shape (m,).
    """
    points = respaced(walk, SPACING_PX)
    reach = round(((1.0 + ASIDE) * HALF_WIDTHS_PX[-1] + FLOOR_PX) / STEP_PX)
    aside = np.asarray(STEP_PX * np.arange(-reach, reach + 1), dtype=np.float64)
    white, on_needle = _white_edges(image, needle, points, aside)
    best: tuple[float, float, Values, NDArray[np.int64]] | None = None
    for half_width in HALF_WIDTHS_PX:
        difference = _differences(white, half_width)
        power = (_mean(difference, EDGE_VERTICES) ** 2).sum(axis=2)
        shifts = smoothest(power, BEND_PRICE, MAX_CHANGE)
        total = float(np.sqrt(_at(power, shifts)).sum())
        if best is None or total > best[0]:
            best = total, half_width, difference, shifts
    assert best is not None
    _, half_width, difference, shifts = best
    near = _mean(difference, EDGE_VERTICES)
    for _ in range(ROUNDS):
        own = _mean(_at(difference, shifts), COLOUR_VERTICES)
        likeness = np.einsum("isc,ic->is", near, own)
        shifts = smoothest(2.0 * likeness, BEND_PRICE, MAX_CHANGE)
    found = _at(difference, shifts)
    own = _mean(found, COLOUR_VERTICES)
    visible = ~(hidden(points) | on_needle[:, np.abs(aside) <= half_width].any(axis=1))
    evidence = np.where(visible, (found * own).sum(axis=1) - 0.5 * (own**2).sum(axis=1), 0.0)
    each = np.einsum("iec,ic->ie", _edges_at(white, half_width, shifts), own)
    exact = shifts + _vertex(likeness, shifts) - difference.shape[1] // 2
    shift = cv2.blur(exact * STEP_PX, (1, 2 * EVEN + 1), borderType=cv2.BORDER_REPLICATE)
    along = tangents_of(points)
    points = points + shift.reshape(-1, 1) * np.column_stack([-along[:, 1], along[:, 0]])
    return CrossSection(points, half_width, evidence, visible, each)


def between_dark_edges(
    walk: Points, ridge: Ridge, origin: tuple[int, int], strength: float
) -> tuple[Points, float] | None:
    """Shift a walk along one edge of something wide, as bright as the floor between its edges, to its middle.

    Args:
        walk: vertices, shape (m, 2) [px].
        ridge: that was followed.
        origin: of the ridge in the picture [px].
        strength: of the ridge along the walk.

    Returns:
        Vertices, shape (m, 2) [px], and half of the width [px]; None if no other edge runs beside the walk all along.
    """
    aside = np.arange(-MAX_WIDTH_PX, MAX_WIDTH_PX + 1.0)
    at = (across(walk, aside) - origin - 0.5 * (ridge.scale - 1)) / ridge.scale
    strong = sampled(ridge.strength, at) - ridge.noise > EDGE_SHOWN * strength
    share = strong.mean(axis=0)
    apart = int(np.argmax(np.where(np.abs(aside) < MIN_WIDTH_PX, 0.0, share)))
    inside = np.abs(2.0 * aside - aside[apart]) < abs(aside[apart])
    if share[apart] < EDGE_SHARE or share[inside].min() > 1.0 - EDGE_SHARE:
        return None
    return across(walk, 0.5 * aside[apart : apart + 1])[:, 0], 0.5 * abs(float(aside[apart]))


def _white_edges(
    image: NDArray[np.uint8], needle: MeasuredNeedle, points: Points, aside: Values
) -> tuple[Values, NDArray[np.bool_]]:
    """Return the derivative of each colour across a walk, of unit noise, 0 at the needle, and where the needle is.

    Returns:
        Derivatives, shape (m, n, colours), and flags, shape (m, n).
    """
    at = across(points, aside)
    profiles = sampled_colours(image, at)
    count = len(aside)
    apart = STEP_PX * (np.arange(count)[:, None] - np.arange(count)[None])
    kernel = apart * np.exp(-0.5 * (apart / EDGE_PX) ** 2) / (EDGE_PX**3 * math.sqrt(2.0 * math.pi)) * STEP_PX
    edges = np.matmul((kernel - np.diag(kernel.sum(axis=1))).astype(np.float32), profiles)
    along, beside = needle.arc.coordinates(points)
    reach = aside[-1] + NEEDLE_PX + 0.5 * needle.width_px
    close = (along > -reach) & (along < needle.length_px + reach) & (np.abs(beside) < reach)
    along, beside = needle.arc.coordinates(at[close].reshape(-1, 2))
    near = (along > -NEEDLE_PX) & (along < needle.length_px + NEEDLE_PX)
    near &= np.abs(beside) < 0.5 * needle.width_px + NEEDLE_PX
    on_needle = np.zeros(at.shape[:2], np.bool_)
    on_needle[close] = near.reshape(-1, count)
    edges[on_needle] = 0.0
    border = round(2.0 * EDGE_PX / STEP_PX)
    edges[:, :border] = edges[:, -border:] = 0.0
    quarter = count // 4
    floor = np.concatenate([edges[:, border:quarter], edges[:, -quarter:-border]], axis=1).reshape(-1, edges.shape[2])
    deviation = np.array([DEVIATION * middle(np.abs(colour)) for colour in floor[::3].T]) + MIN_NOISE
    floor = floor[(np.abs(floor) < OUTLIER * deviation).all(axis=1)]
    covariance = floor.T @ floor / max(1, len(floor)) + MIN_NOISE**2 * np.eye(len(deviation))
    return np.asarray(edges @ np.linalg.cholesky(np.linalg.inv(covariance)), dtype=np.float64), on_needle


def _differences(white: Values, half_width: float) -> Values:
    """Return the edges on both sides of each shift, up to `ASIDE` of half a width, shape (m, shifts, colours)."""
    centre, half = white.shape[1] // 2, round(half_width / STEP_PX)
    most = round(ASIDE * half_width / STEP_PX)
    first, last = centre - most, centre + most + 1
    return np.asarray(white[:, first - half : last - half] - white[:, first + half : last + half])


def _edges_at(white: Values, half_width: float, shifts: NDArray[np.int64]) -> Values:
    """Return the two edges whose sum is `_differences` at a shift in each row, shape (m, 2, colours)."""
    half = round(half_width / STEP_PX)
    middle_at = white.shape[1] // 2 - round(ASIDE * half_width / STEP_PX) + shifts
    return np.stack([_at(white, middle_at - half), -_at(white, middle_at + half)], axis=1)


def _mean(values: Values, half: int) -> Values:
    """Return means over so many vertices to both sides."""
    flat = np.ascontiguousarray(values.reshape(len(values), -1))
    return np.asarray(cv2.blur(flat, (1, 2 * half + 1), borderType=cv2.BORDER_REPLICATE)).reshape(values.shape)


def _mean_of(values: Values) -> float:
    return float(values.mean()) if len(values) else 0.0


def _at(values: Values, shifts: NDArray[np.int64]) -> Values:
    return np.asarray(values[np.arange(len(shifts)), shifts])


def _vertex(values: Values, columns: NDArray[np.int64]) -> Values:
    """Return how far the vertex of the parabola through a column and its neighbours lies from it, shape (m,)."""
    inside = np.clip(columns, 1, values.shape[1] - 2)
    left, peak, right = (_at(values, inside + offset) for offset in (-1, 0, 1))
    bend = left - 2.0 * peak + right
    return np.asarray(np.where(bend < 0.0, np.clip(0.5 * (left - right) / np.minimum(bend, -1e-9), -0.5, 0.5), 0.0))


@compiled
def smoothest(score, price, max_change):
    """Return the column in each row that maximises the sum of scores less a price of squared changes, shape (rows,).

    The first row's is the middle one. Source: [Viterbi1967] A. Viterbi, "Error bounds for convolutional codes and an
    asymptotically optimum decoding algorithm", IEEE T-IT 13(2). Deviation: changes up to `max_change` only.
    """
    rows, columns = score.shape
    best, new = np.full(columns, -1e12), np.empty(columns)
    best[columns // 2] = 0.0
    before = np.zeros((rows, columns), np.int64)
    for row in range(1, rows):
        for column in range(columns):
            value, chosen = -1e15, column
            for other in range(max(0, column - max_change), min(columns, column + max_change + 1)):
                tried = best[other] - price * (other - column) ** 2
                if tried > value:
                    value, chosen = tried, other
            new[column] = value + score[row, column]
            before[row, column] = chosen
        best[:] = new
    result = np.empty(rows, np.int64)
    result[rows - 1] = best.argmax()
    for row in range(rows - 1, 0, -1):
        result[row - 1] = before[row, result[row]]
    return result
