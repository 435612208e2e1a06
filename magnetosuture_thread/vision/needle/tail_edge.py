"""Measures where a needle's blunt end lies along its axis: where the darkness crosses half of the step at the end.

Blur that is symmetric and pixels that integrate over their area leave the half of a straight step in place, whatever
the size of the pixels. A thread that leaves the end makes the step lower in some lines along the axis, and none longer.
"""

from __future__ import annotations

import numpy as np

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
    are small where a thread leaves the end.
    """
    along = np.arange(-REACH_PX - MAX_SHIFT_PX, REACH_PX + MAX_SHIFT_PX + 0.5 * STEP_PX, STEP_PX)
    count = max(1, int(0.5 * fit.width / SIDE_PX))
    dark = np.empty((len(along), 2 * count + 1))
    axis = float(fit.arc.start[0]), float(fit.arc.start[1]), fit.arc.angle, fit.arc.curvature
    straighten(steel.dark, axis, along, SIDE_PX * np.arange(-count, count + 1), dark)
    shift = 0.0
    for _ in range(2):  # The second time by levels around the end that the first one found.
        body = dark[(along > shift + LEVEL_PX) & (along < shift + 2.0 * LEVEL_PX)].mean(axis=0)
        outside = (along > shift - REACH_PX) & (along < shift - LEVEL_PX)
        places = along[outside] - along[outside].mean()
        slopes = places @ dark[outside] / (places @ places)
        behind = dark[outside].mean(axis=0) + slopes * (shift - along[outside].mean())
        lines = np.flatnonzero(body - behind > MIN_STEP * steel.depth)
        if len(lines) < MIN_LINES:
            return None
        half = 0.5 * (body + behind)
        ends = np.array([_crossing(along, dark[:, line], half[line]) for line in lines])
        near = dark[(along > shift - REACH_PX) & (along < shift - BESIDE_PX)][:, lines].max(axis=0)
        more = (near - near.min()) / (THREAD * steel.depth)
        weights = 1.0 / (1.0 + more * more)
        weights /= weights.sum()
        shift = float(weights @ ends)
        if not abs(shift) < MAX_SHIFT_PX or weights @ np.abs(ends - shift) > MAX_SPREAD_PX:
            return None
    return shift


def _crossing(along: np.ndarray, dark: np.ndarray, half: float) -> float:
    """Return the last place at which the darkness rises above a level; NaN if it does not."""
    below = np.flatnonzero(dark[:-1] < half)
    if not len(below) or dark[below[-1] + 1] <= half:
        return float("nan")
    last = below[-1]
    return float(along[last] + STEP_PX * (half - dark[last]) / (dark[last + 1] - dark[last]))
