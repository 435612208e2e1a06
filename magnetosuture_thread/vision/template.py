"""Fits a drawn needle to the image, also where a thread beside, under or over it hides its edges.

The drawn needle is a body of one width whose last fifth tapers, or a rod, seen through the lens. Steel that it has and
the image lacks counts in full, as nothing makes steel bright; dark that the image has and it lacks may be a thread, and
counts up to a bound. A thread over the needle that is dark in one colour counts for neither.

The blunt end is then measured along the axis, where the darkness crosses half of the step at the end. Blur that is
symmetric and pixels that integrate over their area leave the half of a straight step in place, whatever the size of the
pixels. A thread that leaves the end makes the step lower in some lines along the axis, and none longer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.compiled import compiled, compiled_inline, compiled_inner
from magnetosuture_thread.vision.arc import Arc
from magnetosuture_thread.vision.images import NEXT, Layer, Picture, greatest_near, nearest

GLARE, GLARE_REACH_PX = 0.07, 4  # of the floor's light that a reflection is brighter by, fading over a reach
SHADOW, STEEL = 0.15, 0.8  # of the darkness of steel: up to here floor and shadow, from here on steel
TAPER = 0.2  # of the length, towards the tip
BLUR_PX = 1.03  # of an edge, lens and sensor together
STEEPNESS = 1.6 / BLUR_PX  # of the edge; with it, it differs least from a normal distribution
THIN = 0.12  # of the body's width, that a point is ground to
BESIDE_PX = 4.0  # beside and beyond the body, that is compared too
STEP_PX = 0.75  # between samples across; along it is 1 px
OTHER = 0.2  # of steel, at which dark beyond the drawn needle counts a quarter of steel that is missing
BLOOM_PX = 0.22  # that shadow and lens let an edge seem to lie outside of where it is
FIRST_ROUNDS = 4  # that tell which of several fits is worth more
PARAMETERS = 6
REACH_PX, LEVEL_PX = 4.5, 2.0  # to both sides of the end; from where on, two deviations of the blur, its step is over
EDGE_STEP_PX = 0.25  # between samples along the axis
MAX_SHIFT_PX = 1.0  # from where the end is drawn; beyond, and where lines differ more, something hides it


@dataclass(frozen=True)
class SteelMap:
    """How much of each pixel is steel, by its darkness as a share of the floor's brightness.

    Attributes:
        surely: by the brightest of the three colours, in which steel alone is dark, shape (rows, columns), 0 to 1.
        perhaps: by the darkest of them, in which a coloured thread is dark too; the same without colours.
        dark: darkness of the brightest of the three colours, as a share of the floor's brightness.
        depth: darkness of steel, 0 to 1.
        light: how much brighter than the floor, as a share of it, the brightest colour is around each pixel,
            shape (rows, columns).
        origin: (u, v) of the first pixel in the picture.
        size: width and height of the picture [px].
        hidden: where nothing is known; None: nowhere.
    """

    surely: NDArray[np.float32]
    perhaps: NDArray[np.float32]
    dark: NDArray[np.float32]
    depth: float
    light: NDArray[np.float32]
    origin: tuple[float, float]
    size: tuple[int, int]
    hidden: NDArray[np.bool_] | None = None

    def hidden_where(self, hidden: NDArray[np.bool_]) -> SteelMap:
        """Return the map with nothing known where something hides the needle, shape (rows, columns)."""
        if not hidden.any():
            return self
        surely, perhaps = self.surely.copy(), self.perhaps.copy()
        surely[hidden], perhaps[hidden] = 0.0, 1.0
        hidden = hidden if self.hidden is None else self.hidden | hidden
        return replace(self, surely=surely, perhaps=perhaps, hidden=hidden)

    def is_glaring(self, points: np.ndarray) -> bool:
        """Say whether the lamp is reflected within a few pixels of points, in the map's own pixels, shape (m, 2)."""
        return float(greatest_near(self.light, points, GLARE_REACH_PX).max()) > GLARE

    def unknown_in_glare(self) -> SteelMap:
        """Return the map in which steel may be anywhere that the lamp is reflected, and at the reflection's edge."""
        glare = (self.light > GLARE).astype(np.uint8)
        sides = (2 * GLARE_REACH_PX + 1,) * 2
        covered = cv2.dilate(glare, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, sides)) > 0
        return replace(self, perhaps=np.where(covered, np.float32(1.0), self.perhaps)) if covered.any() else self

    @property
    def box(self) -> tuple[slice, slice]:
        """Rows and columns of the picture."""
        (left, top), (rows, columns) = (round(value) for value in self.origin), self.surely.shape
        return slice(top, top + rows), slice(left, left + columns)

    @staticmethod
    def around(points: np.ndarray, picture: Picture, reach: float) -> SteelMap:
        """Return the map around the points of a dark thing, shape (m, 2), as far as a reach [px]."""
        rows, columns = picture.shape
        left, top = np.maximum(points.min(axis=0) - reach, 0.0).astype(int)
        right, bottom = np.minimum(points.max(axis=0) + reach, (columns, rows)).astype(int)
        box = slice(top, bottom), slice(left, right)
        dark = _darkness(picture.brightest, box)
        own = nearest(dark, points - (left, top))
        rank = round(0.9 * (len(own) - 1))
        depth = float(np.partition(own, rank)[rank])
        surely = _share(dark, depth)
        perhaps = surely
        if picture.darkest is not picture.brightest:
            perhaps = _share(_darkness(picture.darkest, box), depth)
        light = np.asarray(cv2.blur(-dark, (3, 3)), dtype=np.float32)
        return SteelMap(surely, perhaps, dark, depth, light, (float(left), float(top)), (columns, rows))


def _darkness(layer: Layer, box: tuple[slice, slice]) -> NDArray[np.float32]:
    """Return 1 - I / F of some rows and columns."""
    return np.asarray(1.0 - layer.pixels[box] / np.maximum(layer.floor[box], 1).astype(np.float32))


def _share(dark: NDArray[np.float32], depth: float) -> NDArray[np.float32]:
    share = (dark / max(depth, 1e-3) - SHADOW) / (STEEL - SHADOW)
    return np.asarray(np.clip(share, 0.0, 1.0), dtype=np.float32)


@dataclass(frozen=True)
class TemplateFit:
    """A drawn needle where the image fits it best.

    Attributes:
        arc: axis, from the tail on.
        length: of it [px].
        width: of the body [px].
        cost: what the image differs by, robustly [px^2].
        normal: of (along, aside, angle, bend, half width, length) in the middle; see `_fit`.
        samples: number of them.
        thin: of the width, that its end tapers to; 1 for a rod.
    """

    arc: Arc
    length: float
    width: float
    cost: float
    normal: np.ndarray
    samples: int
    thin: float = THIN

    def reversed(self) -> Arc:
        """Return the axis from the tip on."""
        return self.arc.reversed_at(self.length)

    def covariance(self) -> np.ndarray:
        """Return that of tail along and aside of the axis and of its angle [px, px, rad], shape (3, 3)."""
        # The lens' blur makes the errors of three rows one and the same; a thread beside the needle pulls all rows to
        # one side, which is 3.5 times the variance by noise alone.
        inverse = np.linalg.inv(self.normal) * 3.5 * 3.0 * self.cost / self.samples
        middle = 0.5 * self.length  # to which the normal equations' place, angle and bend belong
        turn = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, -middle, middle**2 / 3.0], [0.0, 0.0, 1.0, -middle]])
        covariance = turn @ inverse[:4, :4] @ turn.T
        lengthwise = np.array([1.0, 0.0, self.arc.curvature])
        # What no fit's residual tells of: 0.1 px aside, 0.15 degrees and 0.27 px along are most likely for the errors
        # over hundreds of simulated poses, needles and sizes of images.
        covariance += np.diag([0.0, 0.1**2, math.radians(0.15) ** 2])
        return covariance + 0.27**2 * np.outer(lengthwise, lengthwise)


def fit_template(
    steel: SteelMap,
    guess: Arc,
    length: float,
    width: float,
    *,
    tolerance: float = 0.0,
    start: float = 0.0,
    rod: bool = False,
    rounds: int = 12,
    hopeless: float = math.inf,
) -> TemplateFit:
    """Fit a drawn needle to an image of steel.

        minimise  sum w(r) r^2,    r = min(perhaps(x(s, d)) - drawn(s, d), 0) + max(surely(x(s, d)) - drawn(s, d), 0),
        w = 1 where r < 0,  1 / (1 + (r / `OTHER`)^2) elsewhere

    by Gauss-Newton steps, over the place along and aside of the axis, its angle, its curvature, the width and the
    length.

    Args:
        steel: the image.
        guess: axis from the tail on, at most some 2 px off.
        length: of the needle, as far as it is known [px].
        width: of its body [px].
        tolerance: share of the length that it may be off, two standard deviations; 0: it is kept.
        start: length to begin with [px]; 0: as known.
        rod: whether both ends are blunt.
        rounds: steps at most.
        hopeless: cost above which, after `FIRST_ROUNDS`, the fit is given up: what it then is, is no minimum.
    """
    half = 0.5 * width
    state = np.array([guess.start[0], guess.start[1], guess.angle, guess.curvature, half + BLOOM_PX, start or length])
    normal = np.zeros((PARAMETERS, PARAMETERS))
    # Standard deviations: of the body's width 0.2 px and 3 % of it, half of that for half the width.
    deviations = 0.5 * (0.2 + 0.03 * width), 0.5 * tolerance * length
    thin = 1.0 if rod else THIN
    cost, count = _fit(steel.surely, steel.perhaps, state, length, half, deviations, thin, rounds, hopeless, normal)
    arc, fitted = Arc(state[:2].copy(), float(state[2]), float(state[3])), float(state[5])
    return TemplateFit(arc, fitted, 2.0 * (float(state[4]) - BLOOM_PX), cost, normal, count, thin)


@compiled_inline
def edge(x):
    """Return how much of a blurred edge is covered at a distance inside of it, about a normal distribution."""
    return 1.0 / (1.0 + math.exp(-STEEPNESS * x))


@compiled_inner
def _half_width(s, length, half, thin):
    """Return half of a needle's width at a place along it, and its derivative by the length."""
    part = (s - (1.0 - TAPER) * length) / (TAPER * length)
    if part <= 0.0:
        return half, 0.0
    if part >= 1.0:
        return half * thin, 0.0
    return half * (1.0 - (1.0 - thin) * part), half * (1.0 - thin) * s / (TAPER * length * length)


@compiled_inner
def _across(own, aside, share, slope):
    """Fill in the share of steel across a body of half a width, and its derivative by that; `aside` is symmetric.

    It is edge(own - d) - edge(-own - d), where edge(-x) = 1 - edge(x).
    """
    last = len(aside) - 1
    for column in range(last + 1):
        share[column] = edge(own - aside[column])
    for column in range(last // 2 + 1):
        one, other = share[column], share[last - column]
        share[column] = share[last - column] = one + other - 1.0
        slope[column] = slope[last - column] = STEEPNESS * (one * (1.0 - one) + other * (1.0 - other))


def drawn_needle(
    along: np.ndarray, aside: np.ndarray, length: float, half: float, bloom: float, thin: float
) -> np.ndarray:
    """Return the share of steel of a drawn needle at places along and aside of its axis, shape (m, n)."""
    drawn, wider, longer = np.empty((3, len(along), len(aside)))
    _draw_needle(along, aside, length, half, bloom, thin, drawn, wider, longer)
    return drawn


@compiled
def _draw_needle(along, aside, length, half, bloom, thin, drawn, wider, longer):
    """Fill in the share of steel of a drawn needle, and its derivatives by half the width and by the length."""
    across, slope = np.empty(len(aside)), np.empty(len(aside))
    before = -1.0
    scale = 1.0 / (STEEL - SHADOW)
    for row in range(len(along)):
        s = along[row]
        tapered, by_length = _half_width(s, length, half, thin)
        own = tapered + bloom
        if own != before:
            _across(own, aside, across, slope)
            before = own
        tail, tip = edge(s + bloom), edge(length - s + bloom)
        ends, at_tip = tail * tip, STEEPNESS * tail * tip * (1.0 - tip)
        at_ends = at_tip + STEEPNESS * tail * (1.0 - tail) * tip
        for column in range(len(aside)):
            share = (across[column] * ends - SHADOW) * scale
            if 0.0 < share < 1.0:
                drawn[row, column] = share
                wider[row, column] = (slope[column] * ends + across[column] * at_ends) * scale
                longer[row, column] = (slope[column] * by_length * ends + across[column] * at_tip) * scale
            else:
                drawn[row, column] = 0.0 if share <= 0.0 else 1.0
                wider[row, column] = longer[row, column] = 0.0


@compiled_inner
def _add_row(own, right, turned, bent, sums, rest):
    """Add a row's sums to the lower half of the normal equations.

    The sums are of products of the four slopes, along, aside, by the width and by the length; those by the angle and by
    the bend are multiples of the one aside.
    """
    slopes, factors = (0, 1, 1, 1, 2, 3), (1.0, 1.0, turned, bent, 1.0, 1.0)
    for i in range(PARAMETERS):
        right[i] += factors[i] * rest[slopes[i]]
        for j in range(i + 1):
            own[i, j] += factors[i] * factors[j] * sums[slopes[i]][slopes[j]]


@compiled
def _solve(normal, right, result):
    """Solve normal equations by a Cholesky decomposition; so small a system takes LAPACK longer to begin with."""
    size = len(right)
    lower = np.zeros((size, size))
    for i in range(size):
        for j in range(i + 1):
            total = normal[i, j]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            lower[i, j] = math.sqrt(max(total, 1e-12)) if i == j else total / lower[j, j]
    for i in range(size):
        total = right[i]
        for k in range(i):
            total -= lower[i, k] * result[k]
        result[i] = total / lower[i, i]
    for i in range(size - 1, -1, -1):
        total = result[i]
        for k in range(i + 1, size):
            total -= lower[k, i] * result[k]
        result[i] = total / lower[i, i]


@compiled_inner
def straighten_both(one, other, start, first, aside, strip, other_strip):
    """Fill two strips with two images along an arc at steps of a pixel; see `Arc.strip`.

    The arc's direction is turned on from row to row, and both images are sampled at once: half the time.

    Args:
        one: shape (rows, columns).
        other: of the same shape.
        start: u, v, angle and curvature of the arc [px, px, rad, 1/px].
        first: length along the arc of the first row [px].
        aside: distances aside of it, shape (m,) [px].
        strip: filled, shape (n, m).
        other_strip: filled, of the same shape.
    """
    u, v, angle, curvature = start
    rows, columns = one.shape
    last_u, last_v = columns - 1.001, rows - 1.001
    half = 0.5 * curvature * first
    chord = first if abs(half) < 1e-9 else first * math.sin(half) / half
    x, y = u + chord * math.cos(angle + half), v + chord * math.sin(angle + half)
    ahead, down = math.cos(angle + 2.0 * half), math.sin(angle + 2.0 * half)
    half = 0.5 * curvature
    cosine, sine = math.cos(half), math.sin(half)
    chord = 1.0 if abs(half) < 1e-9 else sine / half
    for index in range(len(strip)):
        for place in range(len(aside)):
            at_u = min(max(x - aside[place] * down, 0.0), last_u)
            at_v = min(max(y + aside[place] * ahead, 0.0), last_v)
            column, row = np.uint64(int(at_u)), np.uint64(int(at_v))
            right, below = at_u - column, at_v - row
            left, above = 1.0 - right, 1.0 - below
            upper = left * one[row, column] + right * one[row, column + NEXT]
            lower = left * one[row + NEXT, column] + right * one[row + NEXT, column + NEXT]
            strip[index, place] = above * upper + below * lower
            upper = left * other[row, column] + right * other[row, column + NEXT]
            lower = left * other[row + NEXT, column] + right * other[row + NEXT, column + NEXT]
            other_strip[index, place] = above * upper + below * lower
        # A chord of an arc is turned by half of the arc's turn, what follows it by the other half.
        ahead, down = ahead * cosine - down * sine, down * cosine + ahead * sine
        x, y = x + chord * ahead, y + chord * down
        ahead, down = ahead * cosine - down * sine, down * cosine + ahead * sine


@compiled
def _fit(surely, perhaps, state, length, half, deviations, thin, rounds, hopeless, normal):
    """Fit; `state` (u, v, angle, curvature, half width, length) is changed, `normal` filled.

    The latter is that of (along, aside, angle, bend, half width, length).

    Place, angle and bend are those of the arc's middle, where they depend least on each other.

    Returns:
        Cost [px^2], and the number of samples.
    """
    longest = length + 1.25 * 2.0 * deviations[1]  # times the tolerance of the length
    shortest = 2.0 * length - longest
    free = deviations[1] > 0.0
    columns = 2 * int((half + BESIDE_PX) / STEP_PX) + 1
    most_rows = int(longest + 2.0 * BESIDE_PX) + 1
    aside = (np.arange(columns) - columns // 2) * STEP_PX
    all_least, all_most = np.empty((most_rows, columns)), np.empty((most_rows, columns))
    all_drawn, all_wider = np.empty((most_rows, columns)), np.empty((most_rows, columns))
    all_longer = np.empty((most_rows, columns))
    right, change, own = np.empty(PARAMETERS), np.empty(PARAMETERS), np.empty((PARAMETERS, PARAMETERS))
    best, best_state, samples = np.inf, state.copy(), 1
    prior = OTHER * OTHER / (deviations[0] * deviations[0])
    length_prior = OTHER * OTHER / (deviations[1] * deviations[1]) if free else 1.0
    for done in range(rounds):
        bloom, own_length = state[4] - half, state[5]
        middle = 0.5 * own_length
        rows = min(int(own_length + 2.0 * BESIDE_PX) + 1, most_rows)
        along = np.arange(rows) - BESIDE_PX
        least, most, drawn = all_least[:rows], all_most[:rows], all_drawn[:rows]
        wider, longer = all_wider[:rows], all_longer[:rows]
        straighten_both(surely, perhaps, (state[0], state[1], state[2], state[3]), along[0], aside, least, most)
        _draw_needle(along, aside, own_length, half, bloom, thin, drawn, wider, longer)
        own[:], right[:] = 0.0, 0.0
        cost = 0.0
        for row in range(1, rows - 1):
            # Slopes along (a), aside (b), by the width (w) and by the end of the length (e).
            aa = ab = bb = aw = bw = ww = ae = be = we = ee = ra = rb = rw = re = 0.0
            for column in range(1, columns - 1):
                weight = 1.0
                apart = least[row, column] - drawn[row, column]
                if apart > 0.0:
                    share = 1.0 / (1.0 + apart * apart * (1.0 / OTHER**2))
                    weight = share * share
                    cost += share * apart * apart
                    a = least[row + 1, column] - least[row - 1, column]
                    b = least[row, column + 1] - least[row, column - 1]
                else:
                    apart = min(most[row, column] - drawn[row, column], 0.0)
                    cost += apart * apart
                    a = most[row + 1, column] - most[row - 1, column]
                    b = most[row, column + 1] - most[row, column - 1]
                a, b, w = 0.5 * a, b * (0.5 / STEP_PX), -wider[row, column]
                if a == 0.0 and b == 0.0 and w == 0.0:
                    continue  # as on most of the floor, and in the middle of the body
                by_a, by_b, by_w = weight * a, weight * b, weight * w
                aa, ab, aw, ra = aa + by_a * a, ab + by_a * b, aw + by_a * w, ra - by_a * apart
                bb, bw, rb = bb + by_b * b, bw + by_b * w, rb - by_b * apart
                ww, rw = ww + by_w * w, rw - by_w * apart
                if free:
                    e = -longer[row, column]
                    ae, be, we, ee = ae + by_a * e, be + by_b * e, we + by_w * e, ee + weight * e * e
                    re -= weight * e * apart
            t = along[row] - middle
            turned, bent = t, 0.5 * (t * t - middle * middle / 3.0)  # times b: slopes by the angle and by the bend
            sums = (aa, ab, aw, ae), (ab, bb, bw, be), (aw, bw, ww, we), (ae, be, we, ee)
            _add_row(own, right, turned, bent, sums, (ra, rb, rw, re))
        for i in range(PARAMETERS):
            right[i] *= STEP_PX
            for j in range(i + 1):
                own[i, j] *= STEP_PX
                own[j, i] = own[i, j]
        own[4, 4] += prior
        right[4] -= prior * (bloom - BLOOM_PX)
        own[5, 5] += length_prior
        right[5] -= length_prior * (own_length - length) if free else 0.0
        damping = 0.05  # of places along and aside, that of all others accordingly
        own[0, 0] += damping
        own[1, 1] += damping
        own[2, 2] += damping * middle**2 / 3.0
        own[3, 3] += damping * middle**4 / 45.0
        cost = cost * STEP_PX + prior * (bloom - BLOOM_PX) ** 2
        if free:
            cost += length_prior * (own_length - length) ** 2
        if cost < best:
            best, samples = cost, rows * columns
            for i in range(PARAMETERS):  # to copy an array at once takes seconds to compile
                best_state[i] = state[i]
                for j in range(PARAMETERS):
                    normal[i, j] = own[i, j]
        # A round lowers the cost of a fit that begins at the axis of another by half at most.
        if best > hopeless * max(1.0, 1.5 ** (FIRST_ROUNDS - done)):
            break
        _solve(own, right, change)
        largest = max(abs(change[0]), abs(change[1]), abs(change[2]) * middle, abs(change[3]) * 0.5 * middle * middle)
        largest = max(largest, abs(change[5]))
        change *= min(1.0, 1.5 / largest)  # px, of a round
        # What the middle is turned and bent by moves the tail, where the arc begins.
        shift = change[1] - change[2] * middle + change[3] * middle * middle / 3.0
        angle = state[2]
        state[0] += change[0] * math.cos(angle) - shift * math.sin(angle)
        state[1] += change[0] * math.sin(angle) + shift * math.cos(angle)
        state[2] += change[2] - change[3] * middle + change[0] * state[3]
        state[3] += change[3]
        state[4] = min(max(state[4] + change[4], 0.6 * half), 1.6 * half + BLOOM_PX)
        state[5] = min(max(state[5] + change[5], shortest), longest)
        if largest < 0.02:  # px
            break
    for i in range(PARAMETERS):
        state[i] = best_state[i]
    return best, samples


def tail_shift(steel: SteelMap, fit: TemplateFit) -> float | None:
    """Return how far along the axis a needle's tail lies from where it is drawn [px]; None where it is not visible.

        D(s_j, d_j) = (body(d_j) + behind(d_j)) / 2,    shift = sum w_j s_j / sum w_j

    over lines at distances d_j aside of the axis, with the darkness D along each. body is its mean within the needle,
    behind that of the floor, whose brightness may change linearly, as in a shadow, continued to the end. The weights w
    are small where a thread leaves the end. Where the lamp is reflected at the end, the step is the reflection's.
    """
    if steel.is_glaring(fit.arc.at(np.array([-REACH_PX, 0.0]))):
        return None
    along = np.arange(-REACH_PX - MAX_SHIFT_PX, REACH_PX + MAX_SHIFT_PX + 0.5 * EDGE_STEP_PX, EDGE_STEP_PX)
    count = max(1, int(fit.width))  # lines every half a pixel to each side
    dark = fit.arc.strip(steel.dark, along, 0.5 * np.arange(-count, count + 1))
    shift = float(_shift_of(along, dark, steel.depth))
    return None if math.isnan(shift) else shift


@compiled
def _shift_of(along, dark, depth):
    """Return the shift of `tail_shift` by the darkness at places along the lines, shape (places, lines); NaN: none."""
    lines = dark.shape[1]
    ends, near = np.empty(lines), np.empty(lines)
    shift = 0.0
    for _ in range(2):  # The second time by levels around the end that the first one found.
        rising, thread = 0, np.inf
        for line in range(lines):
            body, behind, near[line] = _levels(along, dark, line, shift)
            ends[line] = np.nan
            if body - behind > 0.3 * depth:  # of the darkness of steel
                rising += 1
                thread = min(thread, near[line])
                ends[line] = _crossing(along, dark, line, 0.5 * (body + behind))
                if math.isnan(ends[line]):
                    return np.nan
        if rising < 3:
            return np.nan
        total, place, spread = 0.0, 0.0, 0.0
        for line in range(lines):
            near[line] = 1.0 / (1.0 + ((near[line] - thread) / (0.02 * depth)) ** 2)  # the line's weight
            if not math.isnan(ends[line]):
                total += near[line]
                place += near[line] * ends[line]
        shift = place / total
        for line in range(lines):
            if not math.isnan(ends[line]):
                spread += near[line] * abs(ends[line] - shift) / total
        if not abs(shift) < MAX_SHIFT_PX or spread > 0.5:
            return np.nan
    return shift


@compiled_inner
def _levels(along, dark, line, shift):
    """Return the mean darkness within the needle, that of the floor at its end, and the greatest behind it."""
    inside, outside, body, near = 0, 0, 0.0, -np.inf
    places, squares, levels, products = 0.0, 0.0, 0.0, 0.0
    for row in range(len(along)):
        s, value = along[row] - shift, dark[row, line]
        if LEVEL_PX < s < 2.0 * LEVEL_PX:
            inside += 1
            body += value
        if -REACH_PX < s < -LEVEL_PX:  # where a line is fitted to the floor
            outside += 1
            places, squares = places + s, squares + s * s
            levels, products = levels + value, products + s * value
        if -REACH_PX < s < -1.25:  # px; a thread is told from the end itself
            near = max(near, value)
    slope = (outside * products - places * levels) / (outside * squares - places * places)
    return body / inside, (levels - slope * places) / outside, near


@compiled_inner
def _crossing(along, dark, line, half):
    """Return the last place at which the darkness rises along a line above a level; NaN if it does not."""
    for row in range(len(dark) - 2, -1, -1):
        if dark[row, line] < half:
            if dark[row + 1, line] <= half:
                return np.nan
            return along[row] + EDGE_STEP_PX * (half - dark[row, line]) / (dark[row + 1, line] - dark[row, line])
    return np.nan
