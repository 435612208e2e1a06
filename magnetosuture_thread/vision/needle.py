"""Finds and measures the needle: the one dark, slender thing in the dish whose two ends are a tail and a tip.

A dark component may hold the needle's thread too: beside, under or over it, and as dark as it.
"""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np

from magnetosuture_thread.geometry.compiled import compiled
from magnetosuture_thread.vision.arc import Arc, MeasuredNeedle, NeedleSize, fit_arc
from magnetosuture_thread.vision.images import RIM_PX, Layer, Picture, SceneMask, median, middle
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

AT_WALL = "at the wall"
MIN_AREA = 0.33  # of the needle's own
AROUND_PX = 24.0  # around a dark thing, that is measured on
MAX_COST = 0.11  # of the length, in squared pixels, of what is no needle
HOPELESS = 4.0  # times the cost of one fit, that another has after its first rounds if it cannot be as good
CLEARLY = 1.25  # times the cost that the other way has if both could be
SAME_LENGTH = 0.015  # share of the length, that need no proof
MAX_MISSING_END, END_ROWS = 0.15, 3  # share of steel that the image may lack at an end, and its rows
MAX_BEYOND = 0.6  # of the body's width beyond an end that may be dark; beyond a tail more, where a thick thread leaves
BLUNT = 0.7  # bluntness of a tail at least
CORE = 0.33  # of the body's width: what lies deeper in the dark than this is no thin thread
NO_SHAPE = "no needle's shape"


def find_needles(
    picture: Picture, size: NeedleSize, toward: np.ndarray | None = None
) -> tuple[list[MeasuredNeedle], list[str]]:
    """Find all that may be the needle.

    Dark pixels in the dish form components; each of about the right area is measured.

    Args:
        picture: the frame or a part of it.
        size: of the needle in the picture.
        toward: where the needle must point, u right and v down; settles which end is which where both look
            alike, as when the tip is blurred.

    Returns:
        The needles, and in words why each of the other candidates is none.
    """
    needles, refused = _measured(picture, size, toward, tight=False)
    if not needles and refused:
        # What of a dark shape the tolerance leaves may have grown together with the needle, or the wall is beside it.
        needles, again = _measured(picture, size, toward, tight=True)
        refused = [reason for reason in refused if reason != AT_WALL] or again or refused
    if not needles and refused:
        dull, _ = _measured(_without_gleam(picture, size.width_px), size, toward, tight=False)
        needles = [_undirected(needle) if toward is None else needle.pointing(toward) for needle in dull]
    return needles, refused


def _undirected(needle: MeasuredNeedle) -> MeasuredNeedle:
    """Return a needle whose tail may be where its tip is taken to be."""
    chord, ahead = needle.tip_px - needle.tail_px, needle.direction_px
    tip = np.array([chord @ ahead, chord @ [-ahead[1], ahead[0]], 0.0])
    assert needle.covariance is not None
    covariance = needle.covariance + np.outer(tip, tip) + np.diag([0.0, 0.0, math.pi**2])
    confidence = 0.5 * needle.confidence
    return replace(needle, covariance=covariance, confidence=confidence, heading_known=False, tail_shift_px=0.0)


def _without_gleam(picture: Picture, width: float) -> Picture:
    """Return a picture without bright lines that are narrower than a needle [px], as of a lamp along a bare rod."""
    side = 2 * int(0.35 * width) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))

    def dull(layer: Layer) -> Layer:
        return replace(layer, pixels=np.asarray(cv2.morphologyEx(layer.pixels, cv2.MORPH_OPEN, kernel)))

    one, is_gray = dull(picture.brightest), picture.darkest is picture.brightest
    return replace(picture, brightest=one, darkest=one if is_gray else dull(picture.darkest))


def _measured(
    picture: Picture, size: NeedleSize, toward: np.ndarray | None, *, tight: bool
) -> tuple[list[MeasuredNeedle], list[str]]:
    """Find the needles of a size, shapes and wall cut out up to their very outlines if `tight`."""
    mask, wall = picture.mask, picture.wall
    radius = wall.radius - RIM_PX if tight else 0.985 * wall.radius  # at first off the rim
    cut = 0.0 if tight or mask is None else mask.tolerance_px
    needles: list[MeasuredNeedle] = []
    refused: list[str] = []
    candidates = _dark_components(picture, radius, cut, size.length_px * size.width_px, size.max_brightness)
    if len(candidates) > 6:
        return [], [f"{len(candidates)} dark things"]
    for points in candidates:
        if not tight and np.hypot(*(points - wall.centre).T).max() > radius - 2.0:
            refused.append(AT_WALL)  # which may have cut off a part
            continue
        steel = SteelMap.around(points, picture)
        near = mask is not None and mask.deepest(points.min(axis=0) - AROUND_PX, points.max(axis=0) + AROUND_PX) > 0.0
        if mask is not None and near:
            steel = steel.hidden_where(mask.depth[steel.box] > cut)
        if tight:
            steel = steel.hidden_where(wall.distances(steel.box) > radius)
        found = measure_needle(steel, size, toward)
        if mask is not None and near and isinstance(found, MeasuredNeedle) and _is_inside(mask, found, size.width_px):
            found = "inside of a shape of the scene"
        if isinstance(found, MeasuredNeedle):
            needles.append(found)
        else:
            refused.append(found)
    return needles, refused


def _dark_components(picture: Picture, radius: float, cut: float, area: float, limit: float) -> list[np.ndarray]:
    """Return the pixels of each dark component of at least a part `MIN_AREA` of an area [px^2], shape (m, 2).

    Args:
        picture: the frame or a part of it.
        radius: around the dish's centre, beyond which nothing is searched [px].
        cut: depth in a shape of the scene from which on nothing is searched [px].
        area: of a needle [px^2].
        limit: share of the floor's brightness, below which a pixel is dark.
    """
    bound = cv2.convertScaleAbs(picture.brightest.floor, alpha=limit)
    dark = cv2.compare(picture.brightest.pixels, bound, cv2.CMP_LT)
    inside = np.zeros(picture.shape, np.uint8)
    u, v, reach = (round(16.0 * value) for value in (*picture.wall.centre, radius))
    cv2.circle(inside, (u, v), reach, 255, -1, cv2.LINE_8, 4)
    cv2.bitwise_and(dark, inside, dark)
    if picture.mask is not None:
        cv2.bitwise_and(dark, cv2.compare(picture.mask.depth, cut, cv2.CMP_LE), dark)
    outlines, _ = cv2.findContours(dark, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    result = []
    for outline in outlines:
        left, top, width, height = cv2.boundingRect(outline)
        if width * height < MIN_AREA * area:  # A component is no larger than its box, so most are passed over at once.
            continue
        own = np.zeros((height, width), np.uint8)
        cv2.drawContours(own, [outline], -1, 255, -1, cv2.LINE_8, offset=(-left, -top))
        rows, columns = np.nonzero(own & dark[top : top + height, left : left + width])
        if len(rows) >= MIN_AREA * area:
            result.append(np.column_stack([columns + left, rows + top]).astype(float))
    return result


def _is_inside(mask: SceneMask, needle: MeasuredNeedle, width: float) -> bool:
    """Say whether a needle's axis lies in shapes: that of a real one stays half its width off their outlines [px]."""
    depths = mask.depths(needle.arc.at(np.linspace(0.0, needle.length_px, 15)))
    return middle(depths) > mask.tolerance_px - 0.5 * width


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
        if fits and fits[0].cost < 0.03 * length:  # px^2: nothing else is better
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
    if reason := _what_covers(steel, shown, best):
        return reason
    if steel.share_hidden(best.arc.at(np.linspace(0.0, best.length, 100))) > 0.02:
        return "hidden"
    if abs(best.arc.curvature) * best.length > 1.25 * math.pi:
        return "bent beyond a half circle"
    excess = _excess(steel.surely, best, width)
    if excess[2] > 0.1:  # of the rows
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
        fit, is_known = _settled(steel, rod if is_rod else pointed, rod, toward, is_rod=is_rod)
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
    )
    return needle if is_known else _undirected(needle)


def _fits(
    steel: SteelMap, rough: TemplateFit, size: NeedleSize, tolerance: float
) -> tuple[TemplateFit, TemplateFit, TemplateFit]:
    """Fit a pointed needle, the same the other way round, and a rod."""
    length, width = size.length_px, size.width_px
    one = fit_template(steel, rough.arc, length, width, tolerance=tolerance, start=length)
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
        if tail < BLUNT or tip > 0.45:
            continue
        their_tail, their_tip = _bluntness(steel.perhaps, against).min(axis=1).tolist()
        signs = (their_tail < 0.5) + (their_tip > 0.6)
        needed = (CLEARLY, 1.15, 0.0)[signs]  # times the cost, for as many signs against the other way
        if tip > 0.32:  # as the wall blunts a tip
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
) -> tuple[TemplateFit, bool]:
    """Return a needle whose shape does not tell tail and tip apart, and whether something else does.

    A thread leaves a rod's tail through its middle, and does not lie over the rod there. One that passes beside one end
    of a pointed needle hides the shape of that end; the other is the tail if it is blunt and no thread goes on there.
    """
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
            return _pointing(fit, tail_first.direction(0.5 * rod.length)), True
    if toward is not None and abs(float(fit.arc.direction() @ toward)) > 0.8:
        return _pointing(fit, toward), True
    return fit, False


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
    _walk(own, rows[0], columns[0], steps)
    last = int(np.argmax(steps))
    _walk(own, last // own.shape[1], last % own.shape[1], steps)
    size = 2 * int(0.5 * width + 2.0) + 1
    highest = cv2.dilate(steps.astype(np.float32), np.ones((size, size), np.uint8))
    at = np.argwhere((steps == highest) & (own > 0))
    ends = [np.array([last // own.shape[1], last % own.shape[1]])]
    for place in at[np.argsort(-steps[at[:, 0], at[:, 1]])]:
        if len(ends) < 5 and min(np.abs(place - other).max() for other in ends) > size:
            ends.append(place)
    for row, column in ends:
        _walk(own, row, column, steps)
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
def _walk(own, row, column, steps):
    """Fill in how many steps from a pixel each pixel of its component is, -1 elsewhere."""
    steps[:] = -1
    rows, columns = own.shape
    queue = np.empty((rows * columns, 2), np.int32)
    queue[0, 0], queue[0, 1], steps[row, column] = row, column, 0
    head, tail = 0, 1
    while head < tail:
        r, c = queue[head]
        head += 1
        for y in range(max(0, r - 1), min(rows, r + 2)):
            for x in range(max(0, c - 1), min(columns, c + 2)):
                if own[y, x] != 0 and steps[y, x] < 0:
                    steps[y, x] = steps[r, c] + 1
                    queue[tail, 0], queue[tail, 1] = y, x
                    tail += 1


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
    across, tip, tail = slice(outside, len(aside) - outside), along > fit.length + 1.0, along < -1.5
    beyond_tip, beyond_tail = (more[e, across].sum() / max((1.0 - drawn[e, across]).sum(), 1e-9) for e in (tip, tail))
    body = more[(along > 0.0) & (along < fit.length)]
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
    blunt = drawn_needle(along, aside, fit.length, half, BLOOM_PX, 1.0)
    forward = drawn_needle(along, aside, fit.length, half, BLOOM_PX, THIN)
    backward = drawn_needle(fit.length - along, aside, fit.length, half, BLOOM_PX, THIN)
    result = np.empty((2, 2))
    for index, (end, tapered) in enumerate(
        ((along < 0.5 * fit.length, backward), (along >= 0.5 * fit.length, forward))
    ):
        weight = blunt - tapered
        more, total = (weight * (seen - tapered))[end], (weight * weight)[end]
        for side, beside in enumerate((aside < 0.0, aside > 0.0)):
            result[index, side] = more[:, beside].sum() / max(total[:, beside].sum(), 1e-9)
    return result


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
    beyond, across = np.arange(-4.0, 4.1, 0.25), np.linspace(-0.3, 0.3, 5) * fit.width
    # A thread that leaves the tail is thinner than the needle: the least across it is the floor behind the tail.
    tail = _fade(beyond, fit.arc.strip(surely, beyond, across).min(axis=1))
    body, outside = np.linspace(0.3, 0.6, 12) * fit.length, np.arange(0.5 * fit.width + 4.0, 0.0, -0.25)
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
