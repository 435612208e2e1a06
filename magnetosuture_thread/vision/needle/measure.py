"""Measures the needle in a dark component, which may hold its thread too: beside, under or over it, as dark as it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from magnetosuture_thread.vision.needle.arc import Arc
from magnetosuture_thread.vision.needle.axis_guesses import axis_guesses
from magnetosuture_thread.vision.needle.comparison import bluntness, excess, fading, steel_rows
from magnetosuture_thread.vision.needle.ends import ends_beyond, leaves_sideways, leaves_tail, thread_offsets
from magnetosuture_thread.vision.needle.measured_needle import MeasuredNeedle
from magnetosuture_thread.vision.needle.size import NeedleSize
from magnetosuture_thread.vision.needle.steel_map import SteelMap
from magnetosuture_thread.vision.needle.tail_edge import tail_shift
from magnetosuture_thread.vision.needle.template import BLOOM_PX, FIRST_ROUNDS, THIN, TemplateFit, fit_template
from magnetosuture_thread.vision.sampling import straighten

FAINTEST = 0.3  # of the floor's brightness: a needle is darker than it by at least this
LEVELS = (0.5, 0.7)  # share of steel that is dark: more of a thread over the needle is, less of one beside it
MAX_FITS = 3
MAX_OFF = 1.2  # times the tolerance of the length, that a measured one may be off
GOES_ON = 0.35  # of the body's width beyond an end that is dark where the needle may go on
MIN_CHANGE = 0.4  # of the tolerance, by which what is dark is longer or shorter where another length is tried too
GLARE_PX = 4.0  # beyond an end, that the lamp may not be reflected at
ROUGH, MORE_PX = 0.08, 3.0  # of the length, that a first guess may be off; more than is dark, to begin a fit with
SAME_PX = 1.5  # that both ends of two guesses may differ by
MAX_COST = 0.11  # of the length, in squared pixels
MAX_MISSING, MISSING_ROWS = 0.13, 5  # of the steel of so many rows, that the image may lack
MAX_MISSING_TAIL, TAIL_ROWS = 0.15, 3  # of these, next to the tail
MAX_MISSING_TIP, TIP = 0.2, 0.2  # of the steel of this last part of the length
SURE, SURE_ROWS = 0.75, 0.97  # share of steel that some place of a row has, and of the rows that have one
MAX_BEYOND = 0.6  # of the body's width beyond an end that may be dark; beyond a tail more, where a thick thread leaves
MAX_BOTH = 0.2  # of it beyond both ends, which a thread leaves or passes at one only
SHARP = 0.2  # bluntness of both sides of a tip if the thread is so thick
AXIS_POINTS, MAX_HIDDEN = 100, 0.02  # along the axis, and the share of them that wall and shapes may hide
MAX_BESIDE = 0.1  # of the rows with something as dark as steel off the body's side
BLUNT, POINTED = 0.7, 0.32  # bluntness of a tail at least, and of a tip at most
NEARLY_POINTED = 0.45  # bluntness of a tip at most, of a needle that can only point this way
NOT_BLUNT, NOT_POINTED = 0.5, 0.6  # bluntness of what is no tail at most, and of what is no tip at least
HOPELESS = 4.0  # times the cost of one fit, that another has after its first rounds if it cannot be as good
CLEAR_COST = 0.03  # of the length, in squared pixels: a needle that nothing else can be better than
CLEARLY, DEARER = 1.25, 1.15  # times the cost that the other way has if both could be; if one end speaks against it
ROD = 0.87  # bluntness of both ends of a rod
ROD_GAIN = 0.003  # of the body's area, by which a rod costs less; corners of a small tip tell less
SAME_LENGTH = 0.015  # share of the length, that need no proof
LENGTH_GAIN = 0.1  # px; times the width, that the fit of another length must cost less by
FADES_PX = 0.7  # over which a tail may fade more than the sides do
PULL_PX = 1.5  # that a thread as wide as the needle draws a measured tail outwards by, one deviation
PASSES, PASSES_PX = 0.3, 0.3  # of the width, and more, off an end's middle: a thread passes, and does not leave
ALIKE, NO_SHAPE = "ends that look alike", "no needle's shape"
TOWARD = 0.8  # cosine between a needle and where it must point


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
    if steel.depth < FAINTEST:
        return "too faint"
    length, width = size.length_px, size.width_px
    ends = np.array([0.0, length])
    guesses: list[np.ndarray] = []  # both ends of each
    fits: list[TemplateFit] = []
    for level in LEVELS:
        for guess in axis_guesses(steel.surely > level, length, width):
            at = guess.at(ends)
            if not any(np.abs(at - other).max() < SAME_PX for other in guesses):
                guesses.append(at)
                fits.append(fit_template(steel, guess, length, width, rounds=FIRST_ROUNDS))
        fits.sort(key=lambda fit: fit.cost)
        if fits and fits[0].cost < CLEAR_COST * length:
            break
    found: MeasuredNeedle | str = NO_SHAPE if fits else "no arc"
    for rough in fits[:MAX_FITS]:
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


def _checked(
    steel: SteelMap,
    rough: TemplateFit,
    size: NeedleSize,
    toward: np.ndarray | None,
) -> MeasuredNeedle | str:
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
    if steel.share_hidden(best.arc.at(np.linspace(0.0, best.length, AXIS_POINTS))) > MAX_HIDDEN:
        return "hidden"
    if abs(best.arc.curvature) * best.length > 1.25 * math.pi:
        return "bent beyond a half circle"
    around = _excess(steel.surely, best, width)
    if max(around[4], around[5]) > MAX_BESIDE:
        return "something dark against it"
    is_known = True
    pointed = min((one, other), key=lambda each: each.cost)
    is_rod = rod.cost < pointed.cost - ROD_GAIN * rod.length * rod.width and _is_rod(steel, rod)
    fit = None if is_rod else _pointed_way(steel, one, other)
    is_clear = is_rod or max(one.cost, other.cost) > CLEARLY * pointed.cost
    if fit is None:
        if rod.cost > HOPELESS * pointed.cost:  # and so was given up
            tolerance = size.tolerance if is_measured else 0.0
            rod = fit_template(steel, rod.arc, size.length_px, width, tolerance=tolerance, start=rod.length, rod=True)
        settled = _settled(steel, rod if is_rod else pointed, rod, size, toward, is_rod=is_rod)
        if settled is None:
            return ALIKE
        fit, is_known = settled
    if steel.is_bridged:  # What lies over it may hide the shape of an end, or look like a thread that leaves one.
        is_known = toward is not None and abs(float(fit.arc.direction() @ toward)) > TOWARD
        fit = _pointing(fit, toward) if toward is not None and is_known else fit
    if reason := _what_prolongs(steel, fit, width, is_known):
        return reason
    confidence = min(1.0, steel.depth / 0.6) * max(0.0, 1.0 - fit.cost / (MAX_COST * fit.length)) ** 0.5
    covariance = fit.covariance()
    confidence *= max(0.2, 1.0 - 2.0 * float(covariance[1, 1]))
    pull = PULL_PX * max(0.0, float(_excess(steel.surely, fit, width)[3]))
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
        if abs(part[1] - length) > MIN_CHANGE * tolerance * length:
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
    return known.cost - fit.cost > LENGTH_GAIN * size.width_px


def _dark_part(steel: SteelMap, arc: Arc, size: NeedleSize) -> tuple[Arc, float]:
    """Return the part of an axis that is dark, with a little more: what a fit lacks draws it in from farther away."""
    length, slack = size.length_px, (size.tolerance + ROUGH) * size.length_px
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
    return arc.moved(float(first), 0.0, 0.0, 0.0), min(float(last - first) + MORE_PX, (1.0 + size.tolerance) * length)


def _shows_ends(steel: SteelMap, fit: TemplateFit, size: NeedleSize) -> bool:
    """Say whether both ends of a needle are seen where its length says, so that the length is measured.

    Something as wide and dark that goes on from an end, or leaves the tail sideways, and the lamp's reflection hide it.
    """
    if abs(fit.length - size.length_px) > MAX_OFF * size.tolerance * size.length_px:
        return False
    beyond, state = _excess(steel.perhaps, fit, size.width_px)[2:4], _state(fit.arc, fit.width)
    if beyond.max() > GOES_ON or fading(steel.surely, state, fit.length, fit.width) > FADES_PX:
        return False
    ends = fit.arc.at(np.array([-GLARE_PX, 0.0, fit.length, fit.length + GLARE_PX]))
    return not leaves_sideways(steel, fit) and not steel.is_glaring(ends)


def _pointed_way(steel: SteelMap, one: TemplateFit, other: TemplateFit) -> TemplateFit | None:
    """Return which of two opposite needles has a blunt tail and a pointed tip; None unless the other clearly has not.

    A thread may lie over the point: each is held to its own fit. Where both fit alike, one end alone tells nothing.
    """
    for fit, against in ((one, other), (other, one)):
        if fit.cost > CLEARLY * against.cost:
            continue
        tail, tip = _bluntness(steel, fit.arc, fit.length, fit.width)
        if tail < BLUNT or tip > NEARLY_POINTED:
            continue
        their_tail, their_tip = _bluntness(steel, against.arc, against.length, against.width)
        signs = (their_tail < NOT_BLUNT) + (their_tip > NOT_POINTED)
        needed = (CLEARLY, DEARER, 0.0)[signs]  # times the cost, for as many signs against the other way
        if tip > POINTED:  # as the wall blunts a tip
            needed = HOPELESS if signs == 2 else math.inf
        if against.cost > needed * fit.cost:
            return fit
    return None


def _bluntness(steel: SteelMap, arc: Arc, length: float, width: float) -> tuple[float, float]:
    """Return how blunt tail and tip may be, what is below something coloured counted as steel; see `bluntness`."""
    result = np.empty((2, 2))
    bluntness(steel.below, _state(arc, width), length, 0.5 * width, result)
    return float(result[0].min()), float(result[1].min())


def _what_covers(steel: SteelMap, shown: SteelMap, fit: TemplateFit, width: float) -> str:
    """Say what covers a drawn needle; empty if nothing does. Glare, which `shown` leaves out, may hide the tail."""
    if fit.cost > MAX_COST * fit.length:
        return NO_SHAPE
    rows, state = np.empty((int(fit.length), 3)), _state(fit.arc, fit.width)
    tip = int((1.0 - TIP) * len(rows))
    steel_rows(steel.surely, steel.perhaps, state, fit.length, 0.5 * fit.width, THIN, rows)
    at_tip = rows[tip:].copy()
    steel_rows(shown.surely, shown.perhaps, state, fit.length, 0.5 * fit.width, THIN, rows)
    share, greatest = rows[:, 0], rows[:, 2]
    even = np.convolve(share[:tip], np.full(MISSING_ROWS, 1.0 / MISSING_ROWS), "valid")
    if even.max() > MAX_MISSING or share[:TAIL_ROWS].mean() > MAX_MISSING_TAIL:
        return "something over it or against it"
    if np.mean(greatest[:tip] > SURE) < SURE_ROWS:
        return "no needle's darkness"
    if at_tip[:, 0] @ at_tip[:, 1] > MAX_MISSING_TIP * at_tip[:, 1].sum():
        return "something over it or against it"
    return ""


def _what_prolongs(steel: SteelMap, fit: TemplateFit, width: float, is_known: bool) -> str:
    """Say at which end something goes on that is too wide for a thread; empty if nothing does."""
    beyond_tip, beyond_tail = _excess(steel.surely, fit, width)[2:4]
    if min(beyond_tip, beyond_tail) > MAX_BOTH:
        return "something at both ends"
    if beyond_tip > MAX_BEYOND:
        return "something at its tip"
    if beyond_tail > MAX_BEYOND:
        blunt = np.empty((2, 2))
        bluntness(steel.surely, _state(fit.arc, fit.width), fit.length, 0.5 * fit.width, blunt)
        if not is_known or blunt[1].max() > SHARP or ends_beyond(steel, fit):
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
    steel: SteelMap, fit: TemplateFit, rod: TemplateFit, size: NeedleSize, toward: np.ndarray | None, *, is_rod: bool
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
    bound = PASSES * rod.width + PASSES_PX
    is_pointed = _is_pointed(steel, fit, rod, size)
    for end, tail_first in ((0, rod.arc), (1, rod.reversed())):
        here, there = offsets[end], offsets[1 - end]
        leaves = is_rod and there is None and here is not None and here < bound
        leaves = leaves and leaves_tail(steel, replace(rod, arc=tail_first))
        passes = is_pointed and here is None and there is not None and there > bound and blunt[end].min() > BLUNT
        if leaves or passes:
            return _pointing(fit, tail_first.direction(0.5 * rod.length)), True
    if toward is not None and abs(float(fit.arc.direction() @ toward)) > TOWARD:
        return _pointing(fit, toward), True
    return fit, False


def _is_pointed(steel: SteelMap, fit: TemplateFit, rod: TemplateFit, size: NeedleSize) -> bool:
    """Say whether a needle is no rod that something beside or over it makes look pointed, however pale that is.

    Of the set length, which may be wrong, a rod could look like a worse fit than a needle that tapers.
    """
    if rod.cost <= CLEARLY * fit.cost:
        return False
    one, other, blunt = _fits(replace(steel, perhaps=steel.below), rod, size, size.tolerance)
    return blunt.cost > CLEARLY * min(one.cost, other.cost)


def _pointing(fit: TemplateFit, toward: np.ndarray) -> TemplateFit:
    """Return a fit, the other way round unless its middle points in a direction."""
    return fit if fit.arc.direction(0.5 * fit.length) @ toward > 0.0 else replace(fit, arc=fit.reversed())


def _is_rod(steel: SteelMap, fit: TemplateFit) -> bool:
    """Say whether a needle is blunt at both ends, and ends there."""
    blunt = np.empty((2, 2))
    state = _state(fit.arc, fit.width)
    bluntness(steel.surely, state, fit.length, 0.5 * fit.width, blunt)
    if blunt.min() < ROD:
        return False
    around = _excess(steel.surely, fit, fit.width)
    rows = np.empty((int(fit.length), 3))
    steel_rows(steel.surely, steel.perhaps, state, fit.length, 0.5 * fit.width, 1.0, rows)
    ends = max(rows[:TAIL_ROWS, 0].mean(), rows[-TAIL_ROWS:, 0].mean())
    return bool(ends < MAX_MISSING_TAIL and max(around[2], around[3]) < MAX_BEYOND)
