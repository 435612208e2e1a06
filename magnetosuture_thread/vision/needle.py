"""Finds and measures the needle: the one dark, slender thing in the dish whose two ends are a tail and a tip.

A dark component may hold the needle's thread too: beside, under or over it, and as dark as it.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace

import numpy as np

from magnetosuture_thread.vision.arc import Arc, MeasuredNeedle, NeedleSize
from magnetosuture_thread.vision.candidates import DARK_END, Candidate, Prior, find_candidates, is_unique
from magnetosuture_thread.vision.images import RIM_PX, Picture, SceneMask, median, middle, nearest
from magnetosuture_thread.vision.template import (
    BESIDE_PX,
    BLOOM_PX,
    FIRST_ROUNDS,
    STEP_PX,
    THIN,
    SteelMap,
    TemplateFit,
    drawn_needle,
    fit_template,
    tail_shift,
)

MAX_COST = 0.11  # of the length, in squared pixels, of what is no needle
HOPELESS = 4.0  # times the cost of one fit, that another has after its first rounds if it cannot be as good
CLEARLY = 1.25  # times the cost that the other way has if both could be
SAME_LENGTH = 0.015  # share of the length, that need no proof
MAX_MISSING_END, END_ROWS = 0.15, 3  # share of steel that the image may lack at an end, and its rows
MAX_BEYOND = 0.6  # of the body's width beyond an end that may be dark; beyond a tail more, where a thick thread leaves
BLUNT, TOO_BLUNT = 0.7, 1.2  # bluntness of a tail; where it is greater, something else is dark beside it
POINTED = 0.45  # bluntness of a tip
INSIDE = "inside of a shape of the scene"
NO_SHAPE = "no needle's shape"


def find_needles(
    picture: Picture, size: NeedleSize, toward: np.ndarray | None = None, prior: Prior | None = None
) -> tuple[list[MeasuredNeedle], list[str]]:
    """Find all that may be the needle.

    Args:
        picture: the frame or a part of it.
        size: of the needle in the picture.
        toward: where the needle's middle must point, u right and v down; settles which end is which where both look
            alike, as when the tip is blurred.
        prior: where its axis must be; None to search all over the picture.

    Returns:
        The needles, and in words why each of the other candidates is none.
    """
    fits: list[tuple[TemplateFit, SteelMap, int]] = []
    candidates = find_candidates(picture, size, prior)
    for candidate in candidates:
        steel = _steel_at(picture, candidate.arc, size)
        fits += [(fit, steel, candidate.thing) for fit in _rough_fits(steel, candidate, size)]
    needles = dict[int, MeasuredNeedle]()  # by the thing that each is in
    refused: list[str] = []
    tries = Counter[int]()
    for fit, steel, thing in sorted(fits, key=lambda each: each[0].cost):
        arc = fit.arc.shifted(steel.origin)
        # Of a dark thing the best three fits are looked at in full.
        if thing in needles or tries[thing] == 3 or any(_lies_on(one, arc, size) for one in needles.values()):
            continue
        tries[thing] += 1
        found = _measured(picture, steel, fit, size, toward)
        if isinstance(found, MeasuredNeedle):
            needles[thing] = found
        else:
            refused.append(found)
    is_known = any(each.heading_known for each in needles.values())
    if is_known or not is_unique(candidates, picture.wall, size):
        return list(needles.values()), refused
    axis = _axis_alone(candidates[0], size)
    if any(each.confidence > axis.confidence for each in needles.values()):
        return list(needles.values()), refused
    if picture.mask is not None and _is_inside(picture.mask, axis, size.width_px):
        return [], [*refused, INSIDE]
    if toward is None:
        return [axis.undirected()], refused
    return [axis if axis.middle_direction_px @ toward > 0.0 else axis.reversed()], refused


def _axis_alone(candidate: Candidate, size: NeedleSize) -> MeasuredNeedle:
    """Return a needle of which the axis alone is known, as under glare, against the wall or beside a dimple.

    Where an end is hidden, the answer slides along the axis, whatever is known of the length.
    """
    aside = 0.2 * size.width_px  # one deviation, as all of these
    along = math.hypot(aside, 0.5 * size.tolerance * size.length_px, 0.1 * size.length_px)
    covariance = np.diag([along, aside, 2.0 * math.sqrt(3.0) * aside / size.length_px]) ** 2
    needle = MeasuredNeedle(candidate.arc, size.length_px, size.width_px, direction_is_clear=False)
    return replace(needle, confidence=0.5 * candidate.score, covariance=covariance)


def _rough_fits(steel: SteelMap, candidate: Candidate, size: NeedleSize) -> list[TemplateFit]:
    """Return fits of a few rounds at a candidate, in both directions.

    Of a length that is not known, what an end that goes on in the dark hides is looked for there too.
    """
    length, slack = size.length_px, size.tolerance * size.length_px
    own = candidate.arc.shifted((-steel.origin[0], -steel.origin[1]))
    behind, ahead = (end > DARK_END for end in candidate.ends)
    slides = [0.0, *[-slack] * behind, *[slack] * ahead]
    axes = [own.moved(slide, 0.0, 0.0, 0.0) for slide in slides]
    ways = [way for axis in axes for way in (axis, axis.reversed_at(length))]
    # A ground point reaches farther than the rod that answers best.
    ways += [way.moved(0.035 * length, 0.0, 0.0, 0.0) for way in ways[:2]]
    return [fit_template(steel, way, length, size.width_px, rounds=FIRST_ROUNDS) for way in ways]


def _lies_on(needle: MeasuredNeedle, axis: Arc, size: NeedleSize) -> bool:
    """Say whether most of an axis lies on a needle."""
    points, width = axis.at(np.linspace(0.1, 0.9, 9) * size.length_px), size.width_px
    return float(needle.near(points, width, width, width).mean()) > 0.4


def _steel_at(picture: Picture, arc: Arc, size: NeedleSize) -> SteelMap:
    """Return how much of each pixel around an axis is steel, with nothing known beyond the wall and in shapes."""
    along, aside = size.length_px / 47.0 * np.arange(48.0), np.array([-0.25, 0.0, 0.25]) * size.width_px
    points = arc.at(np.tile(along, len(aside)), np.repeat(aside, len(along)))
    steel = SteelMap.around(points, picture, 12.0 + 0.2 * size.length_px)  # px
    steel = steel.hidden_where(picture.wall.beyond(steel.box, RIM_PX))
    if picture.mask is not None:
        steel = steel.hidden_where(picture.mask.depth[steel.box] > picture.mask.tolerance_px)
    return steel


def _measured(
    picture: Picture, steel: SteelMap, rough: TemplateFit, size: NeedleSize, toward: np.ndarray | None
) -> MeasuredNeedle | str:
    """Measure the needle at a rough fit; a shape of the scene that keeps it from that is cut out up to its outline."""
    found = measure_needle(steel, rough, size, toward)
    if picture.mask is None:
        return found
    depth = picture.mask.depth[steel.box]
    if not isinstance(found, MeasuredNeedle) and (depth > 0.0).any():
        found = measure_needle(steel.hidden_where(depth > 0.0), rough, size, toward)
    if isinstance(found, MeasuredNeedle) and _is_inside(picture.mask, found, size.width_px):
        return INSIDE
    return found


def _is_inside(mask: SceneMask, needle: MeasuredNeedle, width: float) -> bool:
    """Say whether a needle's axis lies in shapes: that of a real one stays half its width off their outlines [px]."""
    depths = nearest(mask.depth, needle.arc.at(needle.length_px / 14.0 * np.arange(15.0)))
    return middle(depths) > mask.tolerance_px - 0.5 * width


def measure_needle(
    steel: SteelMap, rough: TemplateFit, size: NeedleSize, toward: np.ndarray | None = None
) -> MeasuredNeedle | str:
    """Fit near a rough fit to the end, in both directions; return the needle if all looks like one, in one direction.

    Args:
        steel: the image around it.
        rough: to it.
        size: of the needle.
        toward: where its middle must point, u right and v down; see `find_needles`.

    Returns:
        The needle, in the picture's pixels, or in words why there is none.
    """
    if rough.cost > HOPELESS * MAX_COST * size.length_px:
        return NO_SHAPE
    guess = rough.arc
    width = size.width_px
    one, other, rod = _fits(steel, guess, size, size.tolerance)
    best = min((one, other, rod), key=lambda each: each.cost)
    if best.cost > CLEARLY * MAX_COST * best.length:  # Of the length as it is set it would cost more.
        return NO_SHAPE
    apart = abs(best.length / size.length_px - 1.0)
    shows_ends = size.tolerance > 0.0 and _shows_ends(steel, best, size)
    is_measured = shows_ends and _needs_length(steel, best, size)
    shown, as_rod = steel, rod.cost
    if size.tolerance > 0.0 and not is_measured:
        shown = steel.unknown_in_glare()
        one, other, rod = _fits(shown, guess, size, 0.0)
        as_rod = min(as_rod, rod.cost)
        best = min((one, other, rod), key=lambda each: each.cost)
    # An end that is hidden would make the needle look shorter: where it looks as long as it is set, it is so.
    agrees = shows_ends or apart < SAME_LENGTH
    length_error = 0.5 * (min(size.tolerance, max(SAME_LENGTH, apart)) if agrees else size.tolerance)
    if reason := _what_covers(steel, shown, best):
        return reason
    if steel.hidden is not None:
        points = best.arc.at(best.length / 99.0 * np.arange(100.0))
        if nearest(steel.hidden, points).mean() > 0.02:
            return "hidden"
    if abs(best.arc.curvature) * best.length > size.max_bend + 0.2:  # rad; error of a drawn needle's bend
        return "bent too far"
    excess = _excess(steel.surely, best, width)
    if excess[2] > 0.1:  # of the rows
        return "something dark against it"
    is_known, is_line = True, False
    pointed = min((one, other), key=lambda each: each.cost)
    is_rod = rod.cost < pointed.cost - 0.003 * rod.length * rod.width and _is_rod(steel, rod)
    # Where a rod fits clearly better, what makes an end look pointed is of something else.
    is_told_blunt = size.is_blunt or is_rod or CLEARLY * as_rod < pointed.cost
    fit = None if is_told_blunt else _pointed_way(steel, one, other)
    if fit is not None and as_rod < 1.1 * fit.cost:
        # A corner of a rod that a mark, the lamp or the wall takes; of a point with a thread over it a rod fits worse.
        is_doubtful = steel.is_glaring(fit.arc.at(np.array([0.0, fit.length])))
        looks_blunt = as_rod < fit.cost and _bluntness(steel.perhaps, fit)[1].max() > 0.6  # of a tip's blunter side
        fit = None if is_doubtful or looks_blunt else fit
    is_clear = is_rod or max(one.cost, other.cost) > CLEARLY * pointed.cost
    if fit is None:
        if rod.cost > HOPELESS * pointed.cost:  # and so was given up
            tolerance = size.tolerance if is_measured else 0.0
            rod = fit_template(steel, rod.arc, size.length_px, width, tolerance=tolerance, start=rod.length, rod=True)
        fit, is_known, is_line = _settled(steel, rod if is_rod else pointed, rod, toward, is_rod=is_rod)
    beyond_tip, beyond_tail, _ = excess if fit is best else _excess(steel.surely, fit, width)
    if reason := _what_prolongs(steel, fit, (beyond_tip, beyond_tail), is_known):
        return reason
    confidence = min(1.0, steel.depth / 0.6) * max(0.0, 1.0 - fit.cost / (MAX_COST * fit.length)) ** 0.5
    covariance = fit.covariance()
    confidence *= max(0.2, 1.0 - 2.0 * float(covariance[1, 1]))
    # A thread as wide as the needle draws a measured tail outwards by 1.5 px, one deviation.
    pull = 1.5 * beyond_tail
    if not is_measured:
        pull = math.hypot(pull, length_error * size.length_px)
    lengthwise = np.array([1.0, 0.0, fit.arc.curvature])
    covariance = covariance + pull**2 * np.outer(lengthwise, lengthwise)
    needle = MeasuredNeedle(
        arc=fit.arc,
        length_px=fit.length,
        width_px=fit.width,
        contrast=steel.depth,
        confidence=max(0.05, float(confidence)),
        covariance=covariance,
        size_measured=is_measured,
        tail_shift_px=tail_shift(steel, fit) or 0.0,
        direction_is_clear=is_clear,
        told_by_line=is_line,
    )
    needle = (needle if is_known else needle.undirected()).shifted(steel.origin)
    ends = needle.arc.at(np.array([0.0, needle.length_px]))
    if ends.min() < 3.0 or (ends > np.array(steel.size) - 4.0).any():
        return "cut by the image's border"
    return needle


def _fits(
    steel: SteelMap, guess: Arc, size: NeedleSize, tolerance: float
) -> tuple[TemplateFit, TemplateFit, TemplateFit]:
    """Fit a pointed needle, the same the other way round, and a rod."""
    length, width = size.length_px, size.width_px
    one = fit_template(steel, guess, length, width, tolerance=tolerance)
    bound = HOPELESS * one.cost
    other = fit_template(steel, one.reversed(), length, width, tolerance=tolerance, start=one.length, hopeless=bound)
    rod = fit_template(steel, one.arc, length, width, tolerance=tolerance, start=one.length, rod=True, hopeless=bound)
    return one, other, rod


def _needs_length(steel: SteelMap, fit: TemplateFit, size: NeedleSize) -> bool:
    """Say whether the image speaks for the length that was measured, and not as well for the one that is known."""
    if abs(fit.length - size.length_px) < SAME_LENGTH * size.length_px:
        return True
    is_rod = fit.thin == 1.0
    known = fit_template(steel, fit.arc, size.length_px, size.width_px, rod=is_rod)
    return known.cost - fit.cost > 0.1 * size.width_px


def _shows_ends(steel: SteelMap, fit: TemplateFit, size: NeedleSize) -> bool:
    """Say whether both ends of a needle are seen where its length says, so that the length is measured.

    Something as wide and dark that goes on from an end, or leaves the tail sideways, and the lamp's reflection hide it.
    """
    if abs(fit.length - size.length_px) > 1.2 * size.tolerance * size.length_px:
        return False
    if max(_excess(steel.perhaps, fit, size.width_px)[:2]) > 0.35 or _fading(steel.surely, fit) > 0.7:
        return False
    ends = fit.arc.at(np.array([-4.0, 0.0, fit.length, fit.length + 4.0]))
    return not _leaves_sideways(steel, fit) and not steel.is_glaring(ends)


def _pointed_way(steel: SteelMap, one: TemplateFit, other: TemplateFit) -> TemplateFit | None:
    """Return which of two opposite needles has a blunt tail and a pointed tip; None unless the other clearly has not.

    A thread may lie over the point: each is held to its own fit. Where both fit alike, one end alone tells nothing.
    """
    for fit, against in ((one, other), (other, one)):
        if fit.cost > CLEARLY * against.cost:
            continue
        tail, tip = _bluntness(steel.perhaps, fit).min(axis=1).tolist()  # where a coloured thread may hide steel
        if not BLUNT < tail < TOO_BLUNT or tip > POINTED:
            continue
        their_tail, their_tip = _bluntness(steel.perhaps, against).min(axis=1).tolist()
        signs = (their_tail < 0.5) + (their_tip > 0.6)
        needed = (CLEARLY, 1.15, 0.0)[signs]  # times the cost, for as many signs against the other way
        if their_tail >= TOO_BLUNT and their_tip <= POINTED:  # The other way, too, both ends look as they should.
            needed = math.inf
        elif tip > 0.32:  # as the wall blunts a tip
            needed = HOPELESS if signs == 2 else math.inf
        if against.cost > needed * fit.cost:
            return fit
    return None


def _what_covers(steel: SteelMap, shown: SteelMap, fit: TemplateFit) -> str:
    """Say what covers a drawn needle; empty if nothing does. Glare, which `shown` leaves out, may hide the tail."""
    if fit.cost > MAX_COST * fit.length:
        return NO_SHAPE
    rows = _steel_rows(shown, fit, THIN)
    share, _, greatest = rows
    tip = int(0.8 * len(share))
    even = np.convolve(share[:tip], np.full(5, 0.2), "valid")
    if even.max() > 0.13 or share[:END_ROWS].mean() > MAX_MISSING_END:  # of the steel may be missing
        return "something over it or against it"
    if np.mean(greatest[:tip] > 0.75) < 0.97:
        return "no needle's darkness"
    missing, total, _ = rows if shown is steel else _steel_rows(steel, fit, THIN)
    if missing[tip:] @ total[tip:] > 0.2 * total[tip:].sum():
        return "something over it or against it"
    return ""


def _what_prolongs(steel: SteelMap, fit: TemplateFit, beyond: tuple[float, float], is_known: bool) -> str:
    """Say at which end something goes on that is too wide for a thread; empty if nothing does. See `_excess`."""
    beyond_tip, beyond_tail = beyond
    if min(beyond_tip, beyond_tail) > 0.2:  # A thread leaves or passes at one only.
        return "something at both ends"
    if beyond_tip > MAX_BEYOND:
        return "something at its tip"
    if beyond_tail <= MAX_BEYOND:
        return ""
    is_thread = is_known and _bluntness(steel.surely, fit)[1].max() <= 0.2 and not _ends_beyond(steel, fit)
    return "" if is_thread else "something at its tail"


def _settled(
    steel: SteelMap, fit: TemplateFit, rod: TemplateFit, toward: np.ndarray | None, *, is_rod: bool
) -> tuple[TemplateFit, bool, bool]:
    """Return a needle whose shape does not tell tail and tip apart, whether something else does, and if it is a line.

    A thread leaves a rod's tail through its middle, and does not lie over the rod there. One that passes beside one end
    of a pointed needle hides the shape of that end; the other is the tail if it is blunt and no thread goes on there.
    """
    if toward is not None and abs(float(fit.arc.direction(0.5 * fit.length) @ toward)) > 0.8:
        return _pointing(fit, toward), True, False
    offsets = _thread_offsets(steel, rod)
    if not is_rod and offsets == (None, None) and rod.cost < fit.cost:
        fit = rod
    blunt = _bluntness(steel.surely, rod)
    bound = 0.3 * rod.width + 0.3
    is_pointed = rod.cost > CLEARLY * fit.cost
    for end, tail_first in ((0, rod.arc), (1, rod.reversed())):
        here, there = offsets[end], offsets[1 - end]
        leaves = is_rod and there is None and here is not None and here < bound
        leaves = leaves and not _lies_over_tail(steel, replace(rod, arc=tail_first))
        passes = is_pointed and here is None and there is not None and there > bound and blunt[end].min() > BLUNT
        if leaves or passes:
            return _pointing(fit, tail_first.direction(0.5 * rod.length)), True, True
    return fit, False, False


def _pointing(fit: TemplateFit, toward: np.ndarray) -> TemplateFit:
    """Return a fit, the other way round unless its middle points in a direction."""
    return fit if fit.arc.direction(0.5 * fit.length) @ toward > 0.0 else replace(fit, arc=fit.reversed())


def _is_rod(steel: SteelMap, fit: TemplateFit) -> bool:
    """Say whether a needle is blunt at both ends, and ends there."""
    if _bluntness(steel.surely, fit).min() < 0.87:
        return False
    missing, _, _ = _steel_rows(steel, fit, 1.0)
    ends = max(missing[:END_ROWS].mean(), missing[-END_ROWS:].mean())
    return bool(ends < MAX_MISSING_END and max(_excess(steel.surely, fit, fit.width)[:2]) < MAX_BEYOND)


def _across(fit: TemplateFit, half: float) -> tuple[np.ndarray, np.ndarray]:
    """Return places along and around a needle, and aside of it, at which it is compared with the image [px]."""
    columns = int((half + BESIDE_PX) / STEP_PX)
    return np.arange(int(fit.length + 2.0 * BESIDE_PX) + 1) - BESIDE_PX, STEP_PX * np.arange(-columns, columns + 1)


def _excess(dark: np.ndarray, fit: TemplateFit, width: float) -> tuple[float, float, float]:
    """Return how much darker than a drawn needle the image is around it, as shares of what it could be.

    Args:
        dark: share of steel; see `SteelMap`.
        fit: the drawn needle.
        width: of its body, within which dark goes on beyond its ends [px].

    Returns:
        What goes on beyond the tip, and beyond the tail; and which share of the rows is dark on one side from the body
        on, at the side where more are: what is as wide is no thread.
    """
    half = 0.5 * width
    along, aside = _across(fit, half)
    drawn = drawn_needle(along, aside, fit.length, half, 0.5 * fit.width + BLOOM_PX - half, THIN)
    more = np.maximum(fit.arc.strip(dark, along, aside) - drawn, 0.0)
    outside, beside = int((np.abs(aside) >= half + 0.5).sum()) // 2, int((aside > half + 1.5).sum())
    tail, last = np.searchsorted(along, (-1.5, fit.length))
    first, tip = np.searchsorted(along, (0.0, fit.length + 1.0), "right")
    ends = np.s_[tip:, outside : len(aside) - outside], np.s_[:tail, outside : len(aside) - outside]
    beyond_tip, beyond_tail = (more[end].sum() / max((1.0 - drawn[end]).sum(), 1e-9) for end in ends)
    body = more[first:last]
    sides = [side.min(axis=1, initial=1.0) > 0.5 for side in (body[:, :beside], body[:, len(aside) - beside :])]
    return float(beyond_tip), float(beyond_tail), float(max(side.mean() for side in sides))


def _steel_rows(steel: SteelMap, fit: TemplateFit, thin: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what of its steel each row of a drawn needle has in the image, from tail to tip.

    Args:
        steel: the image.
        fit: the drawn needle.
        thin: share of its width to which its end tapers; 1 for a rod.

    Returns:
        Which share is missing, how much there should be [px], and the greatest share of any place, for sure.
    """
    half = 0.5 * fit.width
    along, aside = np.arange(int(fit.length)) + 0.5, _across(fit, half)[1]
    drawn = drawn_needle(along, aside, fit.length, half, BLOOM_PX, thin)
    missing = np.maximum(drawn - fit.arc.strip(steel.perhaps, along, aside), 0.0).sum(axis=1)
    surely = fit.arc.strip(steel.surely, along, aside[np.abs(aside) < half])
    total = drawn.sum(axis=1)
    return missing / np.maximum(total, 1e-9), STEP_PX * total, surely.max(axis=1)


def _bluntness(dark: np.ndarray, fit: TemplateFit) -> np.ndarray:
    """Return how blunt tail and tip of a needle look on either side, shape (2, 2): 0 for a point, 1 for a blunt end.

        b = sum w (dark - tapered) / sum w (blunt - tapered),    w = blunt - tapered

    over the corners that a blunt end has and a tapered one lacks. A thread that leaves an end, or lies over it, makes
    one side look blunter than it is; so the lesser one tells.
    """
    half = 0.5 * fit.width
    along, aside = _across(fit, half)
    seen = fit.arc.strip(dark, along, aside)
    middle_row, middle_column = int(np.searchsorted(along, 0.5 * fit.length)), len(aside) // 2
    blunt = drawn_needle(along, aside, fit.length, half, BLOOM_PX, 1.0)
    tapered = drawn_needle(np.maximum(along, fit.length - along), aside, fit.length, half, BLOOM_PX, THIN)
    weight = blunt - tapered
    more, total = weight * (seen - tapered), weight * weight
    ends, sides = np.s_[:middle_row, middle_row:], np.s_[:middle_column, middle_column + 1 :]
    parts = [[(end, side) for side in sides] for end in ends]
    return np.array([[more[part].sum() / max(total[part].sum(), 1e-9) for part in both] for both in parts])


def _thread_offsets(steel: SteelMap, fit: TemplateFit) -> tuple[float | None, float | None]:
    """Return how far off the middle of the beginning and the end of an axis a thread goes on there; None: none does.

    A thread that leaves an end goes through its middle. One that lies over or under the needle passes beside it.
    """
    beyond = -np.arange(1.5, 6.0, 0.5)
    aside = np.arange(-0.5 * fit.width - 3.0, 0.5 * fit.width + 3.1, 0.5)
    result: list[float | None] = []
    for arc in (fit.arc, fit.reversed()):
        dark = arc.strip(steel.perhaps, beyond, aside)
        widths = 0.5 * dark.sum(axis=1)
        if middle(widths) < 0.25:
            result.append(None)
            continue
        centres = (dark @ aside) / np.maximum(dark.sum(axis=1), 1e-6)
        result.append(abs(float(np.polyfit(beyond, centres, 1, w=np.minimum(widths, 1.0))[1])))
    return result[0], result[1]


def _ends_beyond(steel: SteelMap, fit: TemplateFit) -> bool:
    """Say whether what goes on beyond a tail, as wide as the body, ends soon: more of a needle, and no thick thread.

    Half of the width of a thread that leaves sideways lies beyond the tail too.
    """
    aside = np.arange(-1.5 * fit.width, 1.5 * fit.width + 0.1, 0.5)
    dark = fit.arc.strip(steel.surely, -np.arange(1.0, 0.2 * fit.length + 4.0), aside)
    light = np.flatnonzero(dark[:-2, len(aside) // 2] < 0.5)  # A thick thread that bends away is dark beside it.
    if len(light) and light[0] < fit.width and _leaves_sideways(steel, fit):
        return False
    return len(light) > 0 and bool(0.5 * (dark[light[0] + 2] > 0.5).sum() < 0.5 * fit.width)


def _fading(surely: np.ndarray, fit: TemplateFit) -> float:
    """Return over how much more length the steel fades at a tail than at the body's sides [px].

    Glare over a tail ends it less sharply than lens and sensor do.
    """
    beyond, across = np.arange(-4.0, 4.1, 0.25), np.array([-0.3, -0.15, 0.0, 0.15, 0.3]) * fit.width
    # A thread that leaves the tail is thinner than the needle: the least across it is the floor behind the tail.
    tail = _fade(beyond, fit.arc.strip(surely, beyond, across).min(axis=1))
    body, outside = (0.3 + 0.3 / 11.0 * np.arange(12)) * fit.length, np.arange(0.5 * fit.width + 4.0, 0.0, -0.25)
    sides = (median(fit.arc.strip(surely, body, side * outside), axis=0) for side in (-1.0, 1.0))
    return tail - min(_fade(-outside, usual) for usual in sides)


def _fade(along: np.ndarray, share: np.ndarray) -> float:
    """Return the length over which a share rises from 0.2 to 0.8."""
    low, high = (int((share >= level).argmax()) if (share >= level).any() else -1 for level in (0.2, 0.8))
    return float(along[high] - along[low])


def _leaves_sideways(steel: SteelMap, fit: TemplateFit) -> bool:
    """Say whether something wide and dark lies beside a tail, whose edge may be taken for the tail's."""
    side = 0.5 * fit.width + 1.7
    dark = fit.arc.strip(steel.surely, np.arange(-1.0, 3.1), np.array([-side, side]))
    return bool(dark.mean(axis=0).max() > 0.6)


def _lies_over_tail(steel: SteelMap, fit: TemplateFit) -> bool:
    """Say whether a line lies over the needle at its tail: it makes one side, or the middle, another colour than steel.

    A thread that is as dark as steel there does not lie over it, or hides nothing.
    """
    aside = 0.35 * fit.width
    across = np.array([-aside, -0.75, 0.0, 0.75, aside])
    left, beside, centre, other, right = median(fit.arc.strip(steel.dark, np.arange(2.0, 12.0), across), axis=0)
    most = max(abs(left - right), abs(beside - other), 0.5 * (beside + other) - centre)
    return bool(most > 0.12 * steel.depth)
