"""What goes on from a needle's ends: a thread, sideways or not, or more of a needle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from magnetosuture_thread.vision.needle.steel_map import SteelMap
from magnetosuture_thread.vision.needle.template import TemplateFit
from magnetosuture_thread.vision.sampling import middle, straighten

VISIBLE_PX = 0.25  # of a thread's width beyond an end, by which it is seen there
LONGER = 0.2  # of the length beyond a tail, before whose end what is as wide as the body is more of the needle
OFF_SIDE_PX = 1.7  # off the body's side, where what leaves a tail sideways is dark ...
AT_TAIL, WIDE = np.arange(-1.0, 3.1), 0.6  # ... at these places along it [px], over this share if it is as wide
OVER_PX = np.arange(2.0, 12.0)  # inside of an end, where a line that lies over it is another colour than steel ...
ACROSS_PX, OVER = np.array([-0.75, 0.0, 0.75]), 0.12  # ... at these places across, by this share of steel's darkness


def thread_offsets(steel: SteelMap, fit: TemplateFit) -> tuple[float | None, float | None]:
    """Return how far off the middle of the beginning and the end of an axis a thread goes on there; None: none does.

    A thread that leaves an end goes through its middle. One that lies over or under the needle passes beside it.
    """
    beyond = -np.arange(1.5, 6.0, 0.5)
    aside = np.arange(-0.5 * fit.width - 3.0, 0.5 * fit.width + 3.1, 0.5)
    result: list[float | None] = []
    for one in (fit, replace(fit, arc=fit.reversed())):
        dark = _darkness(steel.perhaps, one, beyond, aside)
        widths = 0.5 * dark.sum(axis=1)
        if middle(widths) < VISIBLE_PX:
            result.append(None)
            continue
        centres = (dark @ aside) / np.maximum(dark.sum(axis=1), 1e-6)
        result.append(abs(float(np.polyfit(beyond, centres, 1, w=np.minimum(widths, 1.0))[1])))
    return result[0], result[1]


def leaves_sideways(steel: SteelMap, fit: TemplateFit) -> bool:
    """Say whether something wide and dark lies beside a tail, whose edge may be taken for the tail's."""
    side = 0.5 * fit.width + OFF_SIDE_PX
    dark = _darkness(steel.perhaps, fit, AT_TAIL, np.array([-side, side]))
    return bool(dark.mean(axis=0).max() > WIDE)


def is_crossed(steel: SteelMap, fit: TemplateFit) -> bool:
    """Say whether a line lies over a needle right at its tail: it goes on beyond, and does not leave there."""
    left, centre, right = np.median(_darkness(steel.dark, fit, OVER_PX, ACROSS_PX), axis=0)
    return bool(max(abs(left - right), 0.5 * (left + right) - centre) > OVER * steel.depth)


def ends_beyond(steel: SteelMap, fit: TemplateFit) -> bool:
    """Say whether what goes on beyond a tail, as wide as the body, ends soon: more of a needle, and no thick thread.

    Half of the width of a thread that leaves sideways lies beyond the tail too.
    """
    if leaves_sideways(steel, fit):
        return False
    aside = np.arange(-1.5 * fit.width, 1.5 * fit.width + 0.1, 0.5)
    dark = _darkness(steel.surely, fit, -np.arange(1.0, LONGER * fit.length), aside)
    light = np.flatnonzero(dark[:-2, len(aside) // 2] < 0.5)  # A thick thread that bends away is dark beside it.
    return len(light) > 0 and bool(0.5 * (dark[light[0] + 2] > 0.5).sum() < 0.5 * fit.width)


def _darkness(dark: np.ndarray, fit: TemplateFit, along: np.ndarray, aside: np.ndarray) -> np.ndarray:
    """Return an image along and aside of an axis, shape (m, n)."""
    values = np.empty((len(along), len(aside)))
    axis = float(fit.arc.start[0]), float(fit.arc.start[1]), fit.arc.angle, fit.arc.curvature
    straighten(dark, axis, along, aside, values)
    return values
