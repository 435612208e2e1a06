"""What goes on from a needle's ends: a thread, sideways or not, or more of a needle."""

from __future__ import annotations

import math

import numpy as np

from magnetosuture_thread.vision.needle.arc import Arc
from magnetosuture_thread.vision.needle.steel_map import SteelMap
from magnetosuture_thread.vision.needle.template import TemplateFit
from magnetosuture_thread.vision.sampling import middle, straighten

VISIBLE_PX = 0.25  # of a thread's width beyond an end, by which it is seen there
LONGER, LONGER_PX = 0.2, 4.0  # of the length, and more, beyond a tail: what is as wide and ends before is the needle
OFF_SIDE_PX = 1.7  # off the body's side, where what leaves a tail sideways is dark ...
AT_TAIL, WIDE = np.arange(-1.0, 3.1), 0.6  # ... at these places along it [px], over this share if it is as wide
RING, RING_PX, VISIBLE = (
    96,
    np.array([3.5, 5.0]),
    0.1,
)  # places around a tail, off its corners; darkness of a line there
OVER_PX = np.arange(2.0, 12.0)  # inside of an end, where a line that lies over it is another colour than steel ...
ASIDE, MIDDLE_PX = 0.35, 0.75  # ... at one side, at this share of the width, or in the middle, but not so far beside
OVER = 0.12  # ... by this share of steel's darkness


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
        if middle(widths) < VISIBLE_PX:
            result.append(None)
            continue
        centres = (dark @ aside) / np.maximum(dark.sum(axis=1), 1e-6)
        result.append(abs(float(np.polyfit(beyond, centres, 1, w=np.minimum(widths, 1.0))[1])))
    return result[0], result[1]


def leaves_sideways(steel: SteelMap, fit: TemplateFit) -> bool:
    """Say whether something wide and dark lies beside a tail, whose edge may be taken for the tail's."""
    side = 0.5 * fit.width + OFF_SIDE_PX
    dark = _darkness(steel.surely, fit.arc, AT_TAIL, np.array([-side, side]))
    return bool(dark.mean(axis=0).max() > WIDE)


def leaves_tail(steel: SteelMap, fit: TemplateFit) -> bool:
    """Say whether one line goes away from a tail: not what lies over the needle there, or passes on two sides."""
    across = np.array([-ASIDE * fit.width, -MIDDLE_PX, 0.0, MIDDLE_PX, ASIDE * fit.width])
    left, beside, centre, other, right = np.median(_darkness(steel.dark, fit.arc, OVER_PX, across), axis=0)
    if max(abs(left - right), abs(beside - other), 0.5 * (beside + other) - centre) > OVER * steel.depth:
        return False
    arms = []
    for radius in 0.5 * fit.width + RING_PX:
        begin = fit.arc.start + radius * fit.arc.direction()
        ring = Arc(begin, fit.arc.angle + 0.5 * math.pi, 1.0 / radius)
        along = np.arange(0.5 * fit.width + OFF_SIDE_PX, 2.0 * math.pi * radius - 0.5 * fit.width - OFF_SIDE_PX, 0.5)
        visible = _darkness(steel.perhaps, ring, along, np.zeros(1))[:, 0] > VISIBLE
        arms.append(int(visible[0]) + int((visible[1:] & ~visible[:-1]).sum()))
    return min(arms) == 1


def ends_beyond(steel: SteelMap, fit: TemplateFit) -> bool:
    """Say whether what goes on beyond a tail, as wide as the body, ends soon: more of a needle, and no thick thread.

    Half of the width of a thread that leaves sideways lies beyond the tail too.
    """
    aside = np.arange(-1.5 * fit.width, 1.5 * fit.width + 0.1, 0.5)
    dark = _darkness(steel.surely, fit.arc, -np.arange(1.0, LONGER * fit.length + LONGER_PX), aside)
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
