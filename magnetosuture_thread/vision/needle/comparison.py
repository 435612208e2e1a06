"""Compares an image with a drawn needle: what is missing, what is too much, and what goes on from its ends."""

from __future__ import annotations

import numpy as np

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.vision.needle.arc import Arc
from magnetosuture_thread.vision.needle.steel_map import SteelMap
from magnetosuture_thread.vision.needle.template import (
    BESIDE_PX,
    STEP_PX,
    TAPER,
    THIN,
    TemplateFit,
    draw_needle,
    sample_along,
)
from magnetosuture_thread.vision.sampling import middle, straighten


@compiled
def excess(surely, start, length, half, result):
    """Fill in how much darker than a drawn needle the image is around it, as shares of what it could be.

    Args:
        surely: see `SteelMap`.
        start: u, v, angle, curvature of the axis and half of the drawn width.
        length: of the needle [px].
        half: of its body's width [px].
        result: filled, shape (6,): left and right of the taper, within the body's width; beyond the tip and beyond the
            tail; rows that are dark from the body on, left and right: what is as wide is no thread.
    """
    rows, columns = int(length + 2.0 * BESIDE_PX) + 1, 2 * int((half + BESIDE_PX) / STEP_PX) + 1
    along, aside = np.arange(rows) - BESIDE_PX, (np.arange(columns) - columns // 2) * STEP_PX
    seen, drawn = np.empty((rows, columns)), np.empty((rows, columns))
    sample_along(surely, start, along, aside, seen)
    draw_needle(along, aside, length, half, start[4] - half, THIN, drawn)
    total = np.zeros(6)
    result[:] = 0.0
    for row in range(rows):
        s = along[row]
        least = np.ones(2)
        for column in range(columns):
            d = aside[column]
            side = 0 if d < 0.0 else 1
            more = max(seen[row, column] - drawn[row, column], 0.0)
            zone = -1
            if abs(d) < half + 0.5:
                if s > length + 1.0:
                    zone = 2
                elif s < -1.5:
                    zone = 3
                elif s > (1.0 - 0.8 * TAPER) * length and drawn[row, column] < 0.5:
                    zone = side
            elif abs(d) > half + 1.5:
                least[side] = min(least[side], more)
            if zone >= 0:
                result[zone] += more
                total[zone] += 1.0 - drawn[row, column]
        if 0.0 < s < length:
            for side in range(2):
                result[4 + side] += least[side] > 0.5
                total[4 + side] += 1.0
    result /= np.maximum(total, 1e-9)


@compiled
def steel_rows(surely, perhaps, start, length, half, thin, result):
    """Fill in what of its steel each row of a drawn needle has in the image, from tail to tip.

    Args:
        surely: see `SteelMap`.
        perhaps: see there.
        start: u, v, angle, curvature of the axis and half of the drawn width.
        length: of the needle [px].
        half: of its body's width [px].
        thin: of it, to which its end tapers; 1 for a rod.
        result: filled, shape (rows, 3): which share is missing, how much there should be [px], and the greatest share
            of any place of the row, for sure.
    """
    rows, columns = len(result), 2 * int((half + BESIDE_PX) / STEP_PX) + 1
    along, aside = np.arange(rows) + 0.5, (np.arange(columns) - columns // 2) * STEP_PX
    least, most = np.empty((rows, columns)), np.empty((rows, columns))
    drawn = np.empty((rows, columns))
    sample_along(surely, start, along, aside, least)
    sample_along(perhaps, start, along, aside, most)
    draw_needle(along, aside, length, half, start[4] - half, thin, drawn)
    for row in range(rows):
        missing, total, greatest = 0.0, 0.0, 0.0
        for column in range(columns):
            missing += max(drawn[row, column] - most[row, column], 0.0)
            total += drawn[row, column]
            if abs(aside[column]) < half:
                greatest = max(greatest, least[row, column])
        result[row, 0], result[row, 1], result[row, 2] = missing / max(total, 1e-9), total * STEP_PX, greatest


@compiled
def bluntness(surely, start, length, half, result):
    """Fill in how blunt both ends of a needle look, on either side of its axis.

        b = sum w (surely - tapered) / sum w (blunt - tapered),    w = blunt - tapered

    over the corners that a blunt end has and a tapered one lacks: 0 for a point, 1 for a blunt end. A thread that
    leaves an end, or lies over it, makes one side look blunter than it is; so the lesser one tells.

    Args:
        surely: see `SteelMap`.
        start: u, v, angle, curvature of the axis and half of the drawn width.
        length: of the needle [px].
        half: of its body's width [px].
        result: filled, shape (2, 2): at the axis' start and its end, left and right.
    """
    rows, columns = int(length + 2.0 * BESIDE_PX) + 1, 2 * int((half + BESIDE_PX) / STEP_PX) + 1
    along, aside = np.arange(rows) - BESIDE_PX, (np.arange(columns) - columns // 2) * STEP_PX
    seen, blunt = np.empty((rows, columns)), np.empty((rows, columns))
    forward, backward = np.empty((rows, columns)), np.empty((rows, columns))
    bloom = start[4] - half
    sample_along(surely, start, along, aside, seen)
    draw_needle(along, aside, length, half, bloom, 1.0, blunt)
    draw_needle(along, aside, length, half, bloom, THIN, forward)
    draw_needle(length - along, aside, length, half, bloom, THIN, backward)
    more, total = np.zeros((2, 2)), np.zeros((2, 2))
    for row in range(rows):
        end = 0 if along[row] < 0.5 * length else 1
        for column in range(columns):
            if column == columns // 2:
                continue
            tapered = backward[row, column] if end == 0 else forward[row, column]
            weight = blunt[row, column] - tapered
            side = 0 if column < columns // 2 else 1
            more[end, side] += weight * (seen[row, column] - tapered)
            total[end, side] += weight * weight
    result[:] = more / np.maximum(total, 1e-9)


@compiled
def fading(surely, start, length, width):
    """Return over how much more length the steel fades at a tail than at the body's sides [px].

    Glare over a tail ends it less sharply than lens and sensor do.

    Args:
        surely: see `SteelMap`.
        start: u, v, angle and curvature of the axis.
        length: of the needle [px].
        width: of its body [px].
    """
    beyond, share = np.arange(-4.0, 4.1, 0.25), np.empty((33, 5))
    sample_along(surely, start, beyond, np.linspace(-0.3, 0.3, 5) * width, share)
    least = np.empty(len(beyond))
    for row in range(len(beyond)):
        # A thread that leaves the tail is thinner than the needle: the least across it is the floor behind the tail.
        least[row] = share[row].min()
    tail = _fade(beyond, least)
    body, outside = np.linspace(0.3, 0.6, 12) * length, np.arange(0.5 * width + 4.0, 0.0, -0.25)
    across, usual, sides = np.empty((len(body), len(outside))), np.empty(len(outside)), np.inf
    for side in (-1.0, 1.0):
        sample_along(surely, start, body, side * outside, across)
        for place in range(len(outside)):
            usual[place] = np.median(across[:, place])
        sides = min(sides, _fade(-outside, usual))
    return tail - sides


@compiled
def _fade(along, share):
    """Return the length over which a share rises from 0.2 to 0.8."""
    low, high, last = -1, -1, len(along) - 1
    for index in range(len(along)):
        if low < 0 and share[index] >= 0.2:
            low = index
        if share[index] >= 0.8:
            high = index
            break
    return along[last if high < 0 else high] - along[last if low < 0 else low]


def thread_offsets(steel: SteelMap, fit: TemplateFit) -> tuple[float | None, float | None]:
    """Return how far off the middle of the beginning and the end of an axis a thread goes on there; None: none does.

    A thread that leaves an end goes through its middle. One that lies over or under the needle passes beside it.
    """
    beyond = -np.arange(1.5, 6.0, 0.5)
    aside = np.arange(-0.5 * fit.width - 3.0, 0.5 * fit.width + 3.1, 0.5)
    result: list[float | None] = []
    for arc in (fit.arc, fit.reversed()):
        dark = _darkness(steel.perhaps, arc, beyond, aside)
        widths = 0.5 * dark.sum(axis=1)
        if middle(widths) < 0.25:
            result.append(None)
            continue
        centres = (dark @ aside) / np.maximum(dark.sum(axis=1), 1e-6)
        result.append(abs(float(np.polyfit(beyond, centres, 1, w=np.minimum(widths, 1.0))[1])))
    return result[0], result[1]


def leaves_sideways(steel: SteelMap, fit: TemplateFit) -> bool:
    """Say whether something wide and dark lies beside a tail, whose edge may be taken for the tail's."""
    side = 0.5 * fit.width + 1.7
    dark = _darkness(steel.surely, fit.arc, np.arange(-1.0, 3.1), np.array([-side, side]))
    return bool(dark.mean(axis=0).max() > 0.6)


def lies_over_tail(steel: SteelMap, fit: TemplateFit) -> bool:
    """Say whether a line lies over the needle at its tail: it makes one side, or the middle, another colour than steel.

    A thread that is as dark as steel there does not lie over it, or hides nothing.
    """
    aside = 0.35 * fit.width
    across = np.array([-aside, -0.75, 0.0, 0.75, aside])
    left, beside, centre, other, right = np.median(_darkness(steel.dark, fit.arc, np.arange(2.0, 12.0), across), axis=0)
    most = max(abs(left - right), abs(beside - other), 0.5 * (beside + other) - centre)
    return bool(most > 0.12 * steel.depth)


def ends_beyond(steel: SteelMap, fit: TemplateFit) -> bool:
    """Say whether what goes on beyond a tail, as wide as the body, ends soon: more of a needle, and no thick thread.

    Half of the width of a thread that leaves sideways lies beyond the tail too.
    """
    aside = np.arange(-1.5 * fit.width, 1.5 * fit.width + 0.1, 0.5)
    dark = _darkness(steel.surely, fit.arc, -np.arange(1.0, 0.2 * fit.length + 4.0), aside)
    light = np.flatnonzero(dark[:-2, len(aside) // 2] < 0.5)  # A thick thread that bends away is dark beside it.
    if len(light) and light[0] < fit.width and leaves_sideways(steel, fit):
        return False
    return len(light) > 0 and bool(0.5 * (dark[light[0] + 2] > 0.5).sum() < 0.5 * fit.width)


def _darkness(dark: np.ndarray, arc: Arc, along: np.ndarray, aside: np.ndarray) -> np.ndarray:
    """Return an image along and aside of an axis, shape (m, n)."""
    values = np.empty((len(along), len(aside)))
    axis = float(arc.start[0]), float(arc.start[1]), arc.angle, arc.curvature
    straighten(dark, axis, along, aside, values)
    return values
