"""A needle's two ends, tail and tip, and what covers or touches it: glare, a tool, a hand, another dark thing."""

from __future__ import annotations

import math

import cv2
import numpy as np

from magnetosuture_thread.vision.images import middle
from magnetosuture_thread.vision.needle.strip import STEP_ASIDE_PX, TAPER, Strip

TIP_LEVEL = 0.13  # of the body's width: a point thinner than this isn't seen
UNSEEN_TIP, UNSEEN_TIP_PX = 1.3, -0.55  # of the blur, and beside it: what of a point is too fine to be seen
FULL, FADED = 0.85, 0.4  # of the body's width; from one to the other an end fades
POINTEDNESS = 2.0  # how much longer the tip must take to fade than the tail
MIN_FADE = 0.25  # of the taper that the tip must take to fade
ACROSS_QUANTILE = 0.35  # of the darkness across a tail
TOWARD = 0.8  # cosine between a needle and where it must point

WIDTH_SLACK_PX, WIDTH_SLACK = 0.7, 0.2  # that the width may differ from row to row
THREAD_PX = 12.0  # from the tail on, beside which a thread that turns back sharply makes the body look wider
DARKNESS_SLACK = 0.16  # of the body's darkness, that it may differ by from row to row
EVEN_SHARE = 0.93  # of the body's rows must have its width and darkness
AS_DARK, DARK_ROWS = 0.8, 0.06  # of the body's darkness, beside the body; and in how many rows at most
GROUND_SLACK = 0.28  # of the ground's brightness, that it may differ by beside and beyond the needle
GLARE_SLACK = 0.07  # of the ground's brightness, that it may be brighter by at an end
GLARE_NOISES = 2.5  # and at least so many times the noise
NOISE_OF_STEPS = 1.05  # noise by the median step between neighbours: 1.4826 / sqrt 2


def turn_tail_first(strip: Strip, last: float, body: float, toward: np.ndarray | None) -> tuple[Strip, float] | None:
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


def find_tail(strip: Strip, body: float) -> tuple[float, float] | None:
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


def find_tip(strip: Strip, last: float, body: float) -> float:
    """Return the tip's position along the strip: where the steel gets too thin to detect."""
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


def is_glaring(strip: Strip, tail: float, tip: float, body: float) -> bool:
    """Return whether the lamp is reflected at an end."""
    wide = np.abs(strip.aside) < 0.5 * body + 3.0
    usual = middle(strip.ground[(strip.along > tail) & (strip.along < tip)])
    light = ((1.0 - strip.dark) * strip.ground.mean(axis=1, keepdims=True) / usual).astype(np.float32)
    noise = middle(np.abs(np.diff(light[:, wide], axis=0))) * NOISE_OF_STEPS
    bound = 1.0 + max(GLARE_SLACK, GLARE_NOISES * noise)
    return any(
        float(cv2.blur(light[np.ix_(np.abs(strip.along - at) < 5.0, wide)], (5, 3)).max()) > bound for at in (tail, tip)
    )


def find_cover(strip: Strip, tail: float, tip: float, body: float) -> str:
    """Return what covers or touches the needle; empty if nothing does."""
    along, length = strip.along, tip - tail
    rows = (along > tail + 2.0) & (along < tail + (1.0 - TAPER) * length - 2.0)
    core = np.abs(strip.aside) < max(0.42 * body, 0.6)
    if rows.sum() < 0.5 * length or along[0] > tail - 7.0 or along[-1] < tip + 4.0:
        return "an end out of place"
    even = np.abs(strip.width[rows] - body) < WIDTH_SLACK_PX + WIDTH_SLACK * body
    even |= (along[rows] < tail + min(THREAD_PX, 0.35 * length)) & (strip.width[rows] > body)
    # Steel is equally dark all along, at the darkest place across it: beside the gleam.
    darkest = strip.dark[np.ix_(rows, core)].max(axis=1) / strip.depth
    steel = np.abs(cv2.blur(darkest, (1, 5)).ravel() - 1.0) < DARKNESS_SLACK
    if (even & steel).mean() < EVEN_SHARE:
        return "something over it or against it"
    around = np.abs(np.abs(strip.aside) - 0.5 * body - 3.5) < 1.5
    dark = strip.dark[np.ix_((along > tail - 8.0) & (along < tip + 4.0), around)] > AS_DARK * strip.depth
    if dark.any(axis=1).mean() > DARK_ROWS:
        return "something dark against it"
    beside = strip.ground[(along > tail) & (along < tip)]
    usual = middle(beside)
    if (np.abs(beside / usual - 1.0) > GROUND_SLACK).mean() > 0.1:
        return "something beside it"
    wide = np.abs(strip.aside) < 0.5 * body + 3.0
    light = (1.0 - strip.dark) * strip.ground.mean(axis=1, keepdims=True) / usual
    for name, low, high in (("tail", tail - 7.0, tail - 3.0), ("tip", tip + 2.0, tip + 5.0)):
        if abs(middle(light[np.ix_((along > low) & (along < high), wide)]) - 1.0) > GROUND_SLACK:
            return f"something at its {name}"
    return ""
