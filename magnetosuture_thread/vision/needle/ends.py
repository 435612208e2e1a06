"""A needle's two ends: which is the blunt tail, which the pointed tip, and where each is."""

from __future__ import annotations

import math

import numpy as np

from magnetosuture_thread.vision.needle.strip import STEP_ASIDE_PX, TAPER, Strip
from magnetosuture_thread.vision.sampling import middle

TIP_LEVEL = 0.13  # of the body's width: a point thinner than this isn't seen
UNSEEN_TIP, UNSEEN_TIP_PX = 1.3, -0.55  # of the blur, and beside it: what of a point is too fine to be seen
FULL, FADED = 0.85, 0.4  # of the body's width; from one to the other an end fades
POINTEDNESS = 2.0  # how much longer the tip must take to fade than the tail
MIN_FADE = 0.25  # of the taper that the tip must take to fade
ACROSS_QUANTILE = 0.35  # of the darkness across a tail
TOWARD = 0.8  # cosine between a needle and where it must point


def turned_tail_first(strip: Strip, last: float, body: float, toward: np.ndarray | None) -> tuple[Strip, float] | None:
    """Turn a strip so that its blunt end comes first; None unless the other takes much longer to fade."""
    middle = int(np.searchsorted(strip.along, 0.5 * last))
    halves = ((strip.along[middle::-1], strip.width[middle::-1]), (strip.along[middle:], strip.width[middle:]))
    fades = [
        abs(_falls_below(along, width, FADED * body) - _falls_below(along, width, FULL * body))
        for along, width in halves
    ]
    if max(fades) < POINTEDNESS * min(fades) or max(fades) < MIN_FADE * TAPER * last:
        if toward is None:
            return None
        fades = [0.0, float(strip.arc.direction() @ toward)]
        if abs(fades[1]) < TOWARD:
            return None
    if fades[0] < fades[1]:
        return strip, last
    # Copied into memory in order: compiled code is compiled once more for each other layout.
    turned = Strip(
        strip.arc.reversed_at(last),
        np.ascontiguousarray(last - strip.along[::-1]),
        strip.aside,
        np.ascontiguousarray(strip.dark[::-1, ::-1]),
        np.ascontiguousarray(strip.ground[::-1, ::-1]),
        strip.depth,
        np.ascontiguousarray(strip.steel[::-1, ::-1]),
        np.ascontiguousarray(strip.width[::-1]),
    )
    return turned, last


def tail_at(strip: Strip, body: float) -> tuple[float, float] | None:
    """Return where the tail is along the strip, half-way from steel to what lies behind, and how far it fades.

    A low quantile across the axis passes over the thread, which is thinner than the needle.
    """
    core = np.abs(strip.aside) < max(0.38 * body, 0.6)
    across = np.sort(strip.dark[:, core], axis=1)
    darkness = across[:, round(ACROSS_QUANTILE * (across.shape[1] - 1))]
    inside = middle(darkness[(strip.along > 3.0) & (strip.along < 10.0)])
    behind = middle(darkness[(strip.along > -8.0) & (strip.along < -3.0)])
    if inside - behind < 0.5 * strip.depth:
        return None
    share = (darkness - behind) / (inside - behind)
    start = int(np.searchsorted(strip.along, 5.0))
    crossings = [_falls_below(strip.along[start::-1], share[start::-1], level) for level in (0.8, 0.5, 0.25)]
    return crossings[1], crossings[0] - crossings[2]


def tip_at(strip: Strip, last: float, body: float) -> float:
    """Return where the tip is along the strip: where the steel gets too thin to be seen."""
    start = int(np.searchsorted(strip.along, (1.0 - TAPER) * last))
    core = np.abs(strip.aside) < 0.3 * body + 1.0
    width = strip.steel[start:, core].sum(axis=1) * STEP_ASIDE_PX
    return _falls_below(strip.along[start:], width, TIP_LEVEL * body) + _unseen_tip(strip, last)


def _unseen_tip(strip: Strip, last: float) -> float:
    """Return how much of a point is too fine to be seen [px], by the blur of the body's edges."""
    body = (strip.along > 0.2 * last) & (strip.along < 0.7 * last)
    across = strip.dark[body].mean(axis=0) / strip.depth
    steepest = np.diff(across) / STEP_ASIDE_PX
    slope = 0.5 * (float(steepest.max()) - float(steepest.min()))
    blur = 1.0 / (math.sqrt(2.0 * math.pi) * max(slope, 0.05))  # the slope of a blurred edge
    return min(max(UNSEEN_TIP * blur + UNSEEN_TIP_PX, 0.0), 2.5)


def _falls_below(along: np.ndarray, profile: np.ndarray, level: float) -> float:
    """Return where a profile first falls below a level, interpolated."""
    after = int(np.argmax(profile < level))
    if after == 0:
        return float(along[-1] if profile[0] >= level else along[0])
    part = (profile[after - 1] - level) / max(float(profile[after - 1] - profile[after]), 1e-9)
    return float(along[after - 1] + part * (along[after] - along[after - 1]))
