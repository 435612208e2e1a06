"""Measures where a needle's blunt end lies along its axis: where the darkness crosses half of the step at the end.

Blur that is symmetric and pixels that integrate over their area leave the half of a straight step in place, whatever
the size of the pixels. A thread that leaves the end makes the step lower in some lines along the axis, and none longer.
"""

from __future__ import annotations

import math

import numpy as np

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.vision.needle.steel_map import SteelMap
from magnetosuture_thread.vision.needle.template import TemplateFit
from magnetosuture_thread.vision.sampling import straighten

REACH_PX, LEVEL_PX = 4.5, 2.0  # to both sides of the end; from where on, two deviations of the blur, its step is over
STEP_PX, SIDE_PX = 0.25, 0.5  # between samples along the axis, and between lines
MIN_STEP, MIN_LINES = 0.3, 3  # of the darkness of steel, by which so many lines have to rise at least
BESIDE_PX = 1.25  # behind the end, from where on a thread is told from the end itself
THREAD = 0.02  # of the darkness of steel, by which a line is darker than another at half the weight
MAX_SHIFT_PX, MAX_SPREAD_PX = 1.0, 0.5  # from where the end is drawn, and between lines; beyond, something hides it


def tail_shift(steel: SteelMap, fit: TemplateFit) -> float | None:
    """Return how far along the axis a needle's tail lies from where it is drawn [px]; None where it is not visible.

        D(s_j, d_j) = (body(d_j) + behind(d_j)) / 2,    shift = sum w_j s_j / sum w_j

    over lines at distances d_j aside of the axis, with the darkness D along each. body is its mean within the needle,
    behind that of the floor, whose brightness may change linearly, as in a shadow, continued to the end. The weights w
    are small where a thread leaves the end. Where the lamp is reflected at the end, the step is the reflection's.
    """
    if steel.is_glaring(fit.arc.at(np.array([-REACH_PX, 0.0]))):
        return None
    along = np.arange(-REACH_PX - MAX_SHIFT_PX, REACH_PX + MAX_SHIFT_PX + 0.5 * STEP_PX, STEP_PX)
    count = max(1, int(0.5 * fit.width / SIDE_PX))
    dark = np.empty((len(along), 2 * count + 1))
    axis = float(fit.arc.start[0]), float(fit.arc.start[1]), fit.arc.angle, fit.arc.curvature
    straighten(steel.dark, axis, along, SIDE_PX * np.arange(-count, count + 1), dark)
    shift = float(_shift_of(along, dark, steel.depth))
    return None if math.isnan(shift) else shift


@compiled
def _shift_of(along, dark, depth):
    """Return the shift of `tail_shift` by the darkness at places along the lines, shape (places, lines); NaN: none."""
    lines = dark.shape[1]
    body, near = np.empty(lines), np.empty(lines)
    mean, slope, ends = np.empty(lines), np.empty(lines), np.empty(lines)
    shift = 0.0
    for _ in range(2):  # The second time by levels around the end that the first one found.
        body[:], near[:], mean[:], slope[:] = 0.0, -np.inf, 0.0, 0.0
        inside, outside, middle, square = 0, 0, 0.0, 0.0
        for row in range(len(along)):
            s = along[row]
            if shift + LEVEL_PX < s < shift + 2.0 * LEVEL_PX:
                inside += 1
                body += dark[row]
            if shift - REACH_PX < s < shift - LEVEL_PX:
                outside += 1
                middle += s
                mean += dark[row]
            if shift - REACH_PX < s < shift - BESIDE_PX:
                near = np.maximum(near, dark[row])
        body /= inside
        mean /= outside
        middle /= outside
        for row in range(len(along)):
            if shift - REACH_PX < along[row] < shift - LEVEL_PX:
                square += (along[row] - middle) ** 2
                slope += (along[row] - middle) * dark[row]
        behind = mean + slope / square * (shift - middle)
        rising, thread = 0, np.inf
        for line in range(lines):
            ends[line] = np.nan
            if body[line] - behind[line] > MIN_STEP * depth:
                rising += 1
                thread = min(thread, near[line])
                ends[line] = _crossing(along, dark[:, line], 0.5 * (body[line] + behind[line]))
                if math.isnan(ends[line]):
                    return np.nan
        if rising < MIN_LINES:
            return np.nan
        total, place = 0.0, 0.0
        weights = np.zeros(lines)
        for line in range(lines):
            if not math.isnan(ends[line]):
                more = (near[line] - thread) / (THREAD * depth)
                weights[line] = 1.0 / (1.0 + more * more)
                total += weights[line]
                place += weights[line] * ends[line]
        shift = place / total
        spread = 0.0
        for line in range(lines):
            if weights[line] > 0.0:
                spread += weights[line] * abs(ends[line] - shift) / total
        if not abs(shift) < MAX_SHIFT_PX or spread > MAX_SPREAD_PX:
            return np.nan
    return shift


@compiled
def _crossing(along, dark, half):
    """Return the last place at which the darkness rises above a level; NaN if it does not."""
    for row in range(len(dark) - 2, -1, -1):
        if dark[row] < half:
            if dark[row + 1] <= half:
                return np.nan
            return along[row] + STEP_PX * (half - dark[row]) / (dark[row + 1] - dark[row])
    return np.nan
