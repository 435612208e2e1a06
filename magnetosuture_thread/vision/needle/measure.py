"""Measures the needle in a dark component, which may hold its thread too: beside, under or over it, as dark as it."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.vision.needle.arc import Arc, MeasuredNeedle, NeedleSize, fit_arc
from magnetosuture_thread.vision.needle.comparison import (
    bluntness,
    ends_beyond,
    excess,
    fading,
    leaves_sideways,
    lies_over_tail,
    steel_rows,
    thread_offsets,
)
from magnetosuture_thread.vision.needle.steel_map import SteelMap
from magnetosuture_thread.vision.needle.tail_edge import tail_shift
from magnetosuture_thread.vision.needle.template import BLOOM_PX, FIRST_ROUNDS, THIN, TemplateFit, fit_template
from magnetosuture_thread.vision.sampling import middle, straighten

CLEAR_COST, MAX_COST = 0.03, 0.11  # of the length, in squared pixels: nothing else is better; it is no needle
HOPELESS = 4.0  # times the cost of one fit, that another has after its first rounds if it cannot be as good
CLEARLY, DEARER = 1.25, 1.15  # times the cost that the other way has if both could be; if one end speaks against it
SAME_LENGTH = 0.015  # share of the length, that need no proof
MAX_MISSING, MAX_MISSING_END, END_ROWS = 0.13, 0.15, 3  # share of steel that the image may lack; at an end, in rows
MAX_BEYOND = 0.6  # of the body's width beyond an end that may be dark; beyond a tail more, where a thick thread leaves
BLUNT, POINTED = 0.7, 0.32  # bluntness of a tail at least, and of a tip at most
TOWARD = 0.8  # cosine between a needle and where it must point
CORE = 0.33  # of the body's width: what lies deeper in the dark than this is no thin thread
ALIKE, NO_SHAPE = "ends that look alike", "no needle's shape"


def measure_needle(steel: SteelMap, size: NeedleSize, toward: np.ndarray | None = None) -> MeasuredNeedle | str:
    """Measure the needle in a dark component.

    Axes are guessed by what is as deep in the dark as the body's middle, and by its ends; a drawn needle is fitted from
    each. Of the best fits the first is taken that nothing covers and of which tail and tip can be told apart.

    Args:
        steel: the image around it.
        size: of the needle.
        toward: where it must point, u right and v down; see `find_needles`.

    Returns:
        The needle, in the picture's pixels, or in words why there is none.
    """
    if steel.depth < 0.3:  # of the floor's brightness
        return "too faint"
    length, width = size.length_px, size.width_px
    ends = np.array([0.0, length])
    guesses: list[np.ndarray] = []  # both ends of each
    fits: list[TemplateFit] = []
    for level in (0.5, 0.7):  # share of steel: more of a thread over the needle is dark, less of one beside it
        for guess in axis_guesses(steel.surely > level, length, width):
            at = guess.at(ends)
            if not any(np.abs(at - other).max() < 1.5 for other in guesses):
                guesses.append(at)
                fits.append(fit_template(steel, guess, length, width, rounds=FIRST_ROUNDS))
        fits.sort(key=lambda fit: fit.cost)
        if fits and fits[0].cost < CLEAR_COST * length:
            break
    found: MeasuredNeedle | str = NO_SHAPE if fits else "no arc"
    for rough in fits[:3]:
        if rough.cost > HOPELESS * MAX_COST * length:
            break
        found = _checked(steel, rough, size, toward)
        if isinstance(found, MeasuredNeedle):
            found = found.shifted(steel.origin)
            corners = found.arc.at(np.array([0.0, found.length_px]))
            if corners.min() < 3.0 or (corners > np.array(steel.size) - 4.0).any():
                return "cut by the image's border"
            return found
        if found == ALIKE:
            return found  # A worse fit of the same needle must not tell what this one does not.
    return found


def _checked(steel: SteelMap, rough: TemplateFit, size: NeedleSize, toward: np.ndarray | None) -> MeasuredNeedle | str:
    """Fit to the end, in both directions; return the needle if all looks like one, in one direction."""
    width = size.width_px
    one, other, rod = _fits(steel, rough, size, size.tolerance)
    best = min((one, other, rod), key=lambda each: each.cost)
    if best.cost > CLEARLY * MAX_COST * best.length:  # Of the length as it is set it would cost more.
        return NO_SHAPE
    apart = abs(best.length / size.length_px - 1.0)
    shows_ends = size.tolerance > 0.0 and _shows_ends(steel, best, size)
    is_measured = shows_ends and _needs_length(steel, best, size)
    shown = steel
    if size.tolerance > 0.0 and not is_measured:
        shown = steel.unknown_in_glare()
        one, other, rod = _fits(shown, rough, size, 0.0)
        best = min((one, other, rod), key=lambda each: each.cost)
    # An end that is hidden would make the needle look shorter: where it looks as long as it is set, it is so.
    agrees = shows_ends or apart < SAME_LENGTH
    length_error = 0.5 * (min(size.tolerance, max(SAME_LENGTH, apart)) if agrees else size.tolerance)
    if reason := _what_covers(steel, shown, best, width):
        return reason
    if steel.share_hidden(best.arc.at(np.linspace(0.0, best.length, 100))) > 0.02:
        return "hidden"
    if abs(best.arc.curvature) * best.length > 1.25 * math.pi:
        return "bent beyond a half circle"
    around = _excess(steel.surely, best, width)
    if max(around[4], around[5]) > 0.1:  # of the rows
        return "something dark against it"
    is_known = True
    pointed = min((one, other), key=lambda each: each.cost)
    is_rod = rod.cost < pointed.cost - 0.003 * rod.length * rod.width and _is_rod(steel, rod)
    fit = None if is_rod else _pointed_way(steel, one, other)
    is_clear = is_rod or max(one.cost, other.cost) > CLEARLY * pointed.cost
    if fit is None:
        if rod.cost > HOPELESS * pointed.cost:  # and so was given up
            tolerance = size.tolerance if is_measured else 0.0
            rod = fit_template(steel, rod.arc, size.length_px, width, tolerance=tolerance, start=rod.length, rod=True)
        settled = _settled(steel, rod if is_rod else pointed, rod, toward, is_rod=is_rod)
        if settled is None:
            return ALIKE
        fit, is_known = settled
    if reason := _what_prolongs(steel, fit, width, is_known):
        return reason
    confidence = min(1.0, steel.depth / 0.6) * max(0.0, 1.0 - fit.cost / (MAX_COST * fit.length)) ** 0.5
    covariance = fit.covariance()
    confidence *= max(0.2, 1.0 - 2.0 * float(covariance[1, 1]))
    # A thread as wide as the needle draws a measured tail outwards by 1.5 px, one deviation.
    pull = 1.5 * max(0.0, float(_excess(steel.surely, fit, width)[3]))
    if not is_measured:
        pull = math.hypot(pull, length_error * size.length_px)
    lengthwise = np.array([1.0, 0.0, fit.arc.curvature])
    covariance = covariance + pull**2 * np.outer(lengthwise, lengthwise)
    if not is_known:
        # The tail may be where the tip is taken to be.
        chord, ahead = fit.arc.at(fit.length) - fit.arc.start, fit.arc.direction()
        tip = np.array([chord @ ahead, chord @ [-ahead[1], ahead[0]], 0.0])
        covariance = covariance + np.outer(tip, tip) + np.diag([0.0, 0.0, math.pi**2])
        confidence *= 0.5
    return MeasuredNeedle(
        arc=fit.arc,
        length_px=fit.length,
        width_px=fit.width,
        contrast=steel.depth,
        confidence=max(0.05, float(confidence)),
        covariance=covariance,
        heading_known=is_known,
        size_measured=is_measured,
        tail_shift_px=(tail_shift(steel, fit) or 0.0) if is_known else 0.0,
        direction_is_clear=is_clear,
    )


def _fits(
    steel: SteelMap, rough: TemplateFit, size: NeedleSize, tolerance: float
) -> tuple[TemplateFit, TemplateFit, TemplateFit]:
    """Fit a pointed needle, the same the other way round, and a rod."""
    length, width = size.length_px, size.width_px
    starts = [(rough.arc, length)]
    if tolerance:
        part = _dark_part(steel, rough.arc, size)
        if abs(part[1] - length) > 0.4 * tolerance * length:
            starts.append(part)
    ones = [fit_template(steel, arc, length, width, tolerance=tolerance, start=start) for arc, start in starts]
    one = min(ones, key=lambda each: each.cost)
    bound = HOPELESS * one.cost
    other = fit_template(steel, one.reversed(), length, width, tolerance=tolerance, start=one.length, hopeless=bound)
    if other.cost < one.cost:  # which then may be caught beside the best place
        again = fit_template(steel, other.reversed(), length, width, tolerance=tolerance, start=other.length)
        one = min((one, again), key=lambda each: each.cost)
    rod = fit_template(steel, one.arc, length, width, tolerance=tolerance, start=one.length, rod=True, hopeless=bound)
    return one, other, rod


def _needs_length(steel: SteelMap, fit: TemplateFit, size: NeedleSize) -> bool:
    """Say whether the image speaks for the length that was measured, and not as well for the one that is known."""
    if abs(fit.length - size.length_px) < SAME_LENGTH * size.length_px:
        return True
    is_rod = fit.thin == 1.0
    known = fit_template(steel, fit.arc, size.length_px, size.width_px, rod=is_rod)
    return known.cost - fit.cost > 0.1 * size.width_px


def _dark_part(steel: SteelMap, arc: Arc, size: NeedleSize) -> tuple[Arc, float]:
    """Return the part of an axis that is dark, with a little more: what a fit lacks draws it in from farther away."""
    length, slack = size.length_px, (size.tolerance + 0.08) * size.length_px
    along = np.arange(-slack, length + slack)
    dark = np.empty((len(along), 3))
    axis = float(arc.start[0]), float(arc.start[1]), arc.angle, arc.curvature
    straighten(steel.surely, axis, along, np.array([-0.2, 0.0, 0.2]) * size.width_px, dark)
    light = np.flatnonzero(dark.min(axis=1) < 0.5)
    half = len(along) // 2
    first = along[light[light < half].max(initial=-1) + 1]
    last = along[light[light >= half].min(initial=len(along)) - 1]
    if last - first > (1.0 + size.tolerance) * length:
        return arc, length
    return arc.moved(float(first), 0.0, 0.0, 0.0), min(float(last - first) + 3.0, (1.0 + size.tolerance) * length)


def _shows_ends(steel: SteelMap, fit: TemplateFit, size: NeedleSize) -> bool:
    """Say whether both ends of a needle are seen where its length says, so that the length is measured.

    Something as wide and dark that goes on from an end, or leaves the tail sideways, and the lamp's reflection hide it.
    """
    if abs(fit.length - size.length_px) > 1.2 * size.tolerance * size.length_px:
        return False
    beyond, state = _excess(steel.perhaps, fit, size.width_px)[2:4], _state(fit.arc, fit.width)
    if beyond.max() > 0.35 or fading(steel.surely, state, fit.length, fit.width) > 0.7:
        return False
    ends = fit.arc.at(np.array([-4.0, 0.0, fit.length, fit.length + 4.0]))
    return not leaves_sideways(steel, fit) and not steel.is_glaring(ends)


def _pointed_way(steel: SteelMap, one: TemplateFit, other: TemplateFit) -> TemplateFit | None:
    """Return which of two opposite needles has a blunt tail and a pointed tip; None unless the other clearly has not.

    A thread may lie over the point: each is held to its own fit. Where both fit alike, one end alone tells nothing.
    """
    for fit, against in ((one, other), (other, one)):
        if fit.cost > CLEARLY * against.cost:
            continue
        tail, tip = _bluntness(steel, fit.arc, fit.length, fit.width)
        if tail < BLUNT or tip > 0.45:
            continue
        their_tail, their_tip = _bluntness(steel, against.arc, against.length, against.width)
        signs = (their_tail < 0.5) + (their_tip > 0.6)
        needed = (CLEARLY, DEARER, 0.0)[signs]  # times the cost, for as many signs against the other way
        if tip > POINTED:  # as the wall blunts a tip
            needed = HOPELESS if signs == 2 else math.inf
        if against.cost > needed * fit.cost:
            return fit
    return None


def _bluntness(steel: SteelMap, arc: Arc, length: float, width: float) -> tuple[float, float]:
    """Return how blunt tail and tip may be, where a coloured thread may hide steel; see `bluntness`."""
    result = np.empty((2, 2))
    bluntness(steel.perhaps, _state(arc, width), length, 0.5 * width, result)
    return float(result[0].min()), float(result[1].min())


def _what_covers(steel: SteelMap, shown: SteelMap, fit: TemplateFit, width: float) -> str:
    """Say what covers a drawn needle; empty if nothing does. Glare, which `shown` leaves out, may hide the tail."""
    if fit.cost > MAX_COST * fit.length:
        return NO_SHAPE
    rows, state = np.empty((int(fit.length), 3)), _state(fit.arc, fit.width)
    tip = int(0.8 * len(rows))
    steel_rows(steel.surely, steel.perhaps, state, fit.length, 0.5 * fit.width, THIN, rows)
    at_tip = rows[tip:].copy()
    steel_rows(shown.surely, shown.perhaps, state, fit.length, 0.5 * fit.width, THIN, rows)
    share, greatest = rows[:, 0], rows[:, 2]
    even = np.convolve(share[:tip], np.full(5, 0.2), "valid")
    if even.max() > MAX_MISSING or share[:END_ROWS].mean() > MAX_MISSING_END:
        return "something over it or against it"
    if np.mean(greatest[:tip] > 0.75) < 0.97:
        return "no needle's darkness"
    if at_tip[:, 0] @ at_tip[:, 1] > 0.2 * at_tip[:, 1].sum():
        return "something over it or against it"
    return ""


def _what_prolongs(steel: SteelMap, fit: TemplateFit, width: float, is_known: bool) -> str:
    """Say at which end something goes on that is too wide for a thread; empty if nothing does."""
    beyond_tip, beyond_tail = _excess(steel.surely, fit, width)[2:4]
    if min(beyond_tip, beyond_tail) > 0.2:  # A thread leaves or passes at one only.
        return "something at both ends"
    if beyond_tip > MAX_BEYOND:
        return "something at its tip"
    if beyond_tail > MAX_BEYOND:
        blunt = np.empty((2, 2))
        bluntness(steel.surely, _state(fit.arc, fit.width), fit.length, 0.5 * fit.width, blunt)
        if not is_known or blunt[1].max() > 0.2 or ends_beyond(steel, fit):
            return "something at its tail"
    return ""


def _state(arc: Arc, width: float) -> np.ndarray:
    """Return an axis and half of the drawn width as compiled code takes them."""
    return np.array([arc.start[0], arc.start[1], arc.angle, arc.curvature, 0.5 * width + BLOOM_PX])


def _excess(dark: np.ndarray, fit: TemplateFit, width: float) -> np.ndarray:
    """Return what is dark around a drawn needle; see `excess`."""
    result = np.empty(6)
    excess(dark, _state(fit.arc, fit.width), fit.length, 0.5 * width, result)
    return result


def _settled(
    steel: SteelMap, fit: TemplateFit, rod: TemplateFit, toward: np.ndarray | None, *, is_rod: bool
) -> tuple[TemplateFit, bool] | None:
    """Return a needle whose shape does not tell tail and tip apart, and whether something else does.

    A thread leaves a rod's tail through its middle, and does not lie over the rod there. One that passes beside one end
    of a pointed needle hides the shape of that end; the other is the tail if it is blunt and no thread goes on there.
    Where no thread is seen at either end of what is no rod, and does not look more like one, None: the length may be
    another's.
    """
    offsets = thread_offsets(steel, rod)
    if not is_rod and offsets == (None, None):
        is_blunt = CLEARLY * rod.cost < fit.cost or (rod.cost < fit.cost and _is_rod(steel, rod))
        return (rod, False) if is_blunt else None
    blunt = np.empty((2, 2))
    bluntness(steel.surely, _state(rod.arc, rod.width), rod.length, 0.5 * rod.width, blunt)
    bound = 0.3 * rod.width + 0.3
    is_pointed = rod.cost > CLEARLY * fit.cost
    for end, tail_first in ((0, rod.arc), (1, rod.reversed())):
        here, there = offsets[end], offsets[1 - end]
        leaves = is_rod and there is None and here is not None and here < bound
        leaves = leaves and not lies_over_tail(steel, replace(rod, arc=tail_first))
        passes = is_pointed and here is None and there is not None and there > bound and blunt[end].min() > BLUNT
        if leaves or passes:
            return _pointing(fit, tail_first.direction(0.5 * rod.length)), True
    if toward is not None and abs(float(fit.arc.direction() @ toward)) > TOWARD:
        return _pointing(fit, toward), True
    return fit, False


def _pointing(fit: TemplateFit, toward: np.ndarray) -> TemplateFit:
    """Return a fit, the other way round unless its middle points in a direction."""
    return fit if fit.arc.direction(0.5 * fit.length) @ toward > 0.0 else replace(fit, arc=fit.reversed())


def _is_rod(steel: SteelMap, fit: TemplateFit) -> bool:
    """Say whether a needle is blunt at both ends, and ends there."""
    blunt = np.empty((2, 2))
    state = _state(fit.arc, fit.width)
    bluntness(steel.surely, state, fit.length, 0.5 * fit.width, blunt)
    if blunt.min() < 0.87:
        return False
    around = _excess(steel.surely, fit, fit.width)
    rows = np.empty((int(fit.length), 3))
    steel_rows(steel.surely, steel.perhaps, state, fit.length, 0.5 * fit.width, 1.0, rows)
    ends = max(rows[:END_ROWS, 0].mean(), rows[-END_ROWS:, 0].mean())
    return bool(ends < MAX_MISSING_END and max(around[2], around[3]) < MAX_BEYOND)


def axis_guesses(dark: np.ndarray, length: float, width: float) -> list[Arc]:
    """Return axes, from the tail on, that a needle may have in a dark component.

    What lies as deep in the dark as the middle of the body is followed: it is either about as long as the needle, which
    then lies along it, or holds a thread too, and the needle begins or ends at one of its ends.

    Args:
        dark: where the image is dark, shape (rows, columns), bool.
        length: of the needle [px].
        width: of its body [px].
    """
    deep = cv2.distanceTransform(dark.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    if deep.max() > 0.5 * 2.6 * width + 1.0:
        return []
    inset = CORE * width
    core = (deep > inset).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(core, connectivity=8)
    result: list[Arc] = []
    areas = stats[1:, cv2.CC_STAT_AREA]
    for label in 1 + np.argsort(-areas)[:3]:
        if stats[label, cv2.CC_STAT_AREA] < 0.25 * (1.0 - 2.0 * CORE) * length * width:
            continue
        own = (labels == label).astype(np.uint8)
        rows, columns = np.nonzero(own)
        guess = _axis_of(np.column_stack([columns, rows]).astype(float), width)
        if guess is None:
            continue
        arc, first, last = guess
        if last - first < 0.5 * length:
            continue
        if last - first < 1.35 * length:
            result += _both(arc, first - inset, last + inset, length)
        else:
            result += _from_ends(own, length, width)
    return result


def _both(arc: Arc, first: float, last: float, length: float) -> list[Arc]:
    """Return an axis in both directions, its tail where the dark begins, and if that goes on for too long, its tip."""
    forward, backward = arc.moved(first, 0.0, 0.0, 0.0), arc.reversed_at(last)
    if last - first < length:
        return [forward, backward]
    return [forward, backward, forward.reversed_at(length), backward.reversed_at(length)]


def _from_ends(own: np.ndarray, length: float, width: float) -> list[Arc]:
    """Return axes that begin or end at the ends of a long, winding core."""
    result: list[Arc] = []
    rows, columns = np.nonzero(own)
    steps = np.empty(own.shape, np.int32)
    _walk(own, _pixel(own, rows[0], columns[0]), steps)
    last = int(np.argmax(steps))
    _walk(own, _pixel(own, last // own.shape[1], last % own.shape[1]), steps)
    size = 2 * int(0.5 * width + 2.0) + 1
    highest = cv2.dilate(steps.astype(np.float32), np.ones((size, size), np.uint8))
    at = np.argwhere((steps == highest) & (own > 0))
    ends = [np.array([last // own.shape[1], last % own.shape[1]])]
    for place in at[np.argsort(-steps[at[:, 0], at[:, 1]])]:
        if len(ends) < 5 and min(np.abs(place - other).max() for other in ends) > size:
            ends.append(place)
    for row, column in ends:
        _walk(own, _pixel(own, row, column), steps)
        rows, columns = np.nonzero((steps >= 0) & (steps < 0.8 * length))
        guess = _axis_of(np.column_stack([columns, rows]).astype(float), width)
        if guess is None:
            continue
        arc, first, final = guess
        end = float(arc.coordinates(np.array([[column, row]], float))[0][0])
        # From the end inwards; a point reaches farther than its core, by the part that is too thin for it.
        inwards = arc.moved(first, 0.0, 0.0, 0.0) if end - first < final - end else arc.reversed_at(final)
        for beyond in (0.1 * length, 0.03 * length):
            result.append(inwards.moved(-beyond, 0.0, 0.0, 0.0).reversed_at(length))
        result.append(inwards.moved(-CORE * width, 0.0, 0.0, 0.0))
    return result


def _pixel(own: np.ndarray, row: int, column: int) -> np.ndarray:
    """Return an image of one pixel."""
    result = np.zeros_like(own)
    result[row, column] = 1
    return result


def _axis_of(points: np.ndarray, width: float) -> tuple[Arc, float, float] | None:
    """Return an arc through most of the points, and the lengths along it between which these lie."""
    kept = points
    for _ in range(4):
        if len(kept) < 8:
            return None
        arc = fit_arc(kept)
        along, aside = arc.coordinates(points)
        near = np.abs(aside) < max(0.5 * width, 1.5 * middle(np.abs(aside)))
        if near.sum() == len(kept):
            break
        kept = points[near]
    return arc, float(along[near].min()), float(along[near].max())


@compiled
def _walk(own, start, steps):
    """Fill in how many steps from the nearest pixel of a start each pixel of its components is, -1 elsewhere."""
    steps[:] = -1
    rows, columns = own.shape
    queue = np.empty((rows * columns, 2), np.int32)
    head, tail = 0, 0
    for y in range(rows):
        for x in range(columns):
            if start[y, x] != 0:
                steps[y, x] = 0
                queue[tail, 0], queue[tail, 1] = y, x
                tail += 1
    while head < tail:
        r, c = queue[head]
        head += 1
        for i in range(-1, 2):
            for j in range(-1, 2):
                y, x = r + i, c + j
                if 0 <= y < rows and 0 <= x < columns and own[y, x] != 0 and steps[y, x] < 0:
                    steps[y, x] = steps[r, c] + 1
                    queue[tail, 0], queue[tail, 1] = y, x
                    tail += 1
