"""What covers a needle or touches it: glare, a tool, a hand, another dark thing."""

from __future__ import annotations

import cv2
import numpy as np

from magnetosuture_thread.vision.needle.strip import TAPER, Strip
from magnetosuture_thread.vision.sampling import middle

WIDTH_SLACK_PX, WIDTH_SLACK = 0.7, 0.2  # that the width may differ from row to row
THREAD_PX = 12.0  # from the tail on, beside which a thread that turns back sharply makes the body look wider
DARKNESS_SLACK = 0.16  # of the body's darkness, that it may differ by from row to row
EVEN_SHARE = 0.93  # of the body's rows must have its width and darkness
AS_DARK, DARK_ROWS = 0.8, 0.06  # of the body's darkness, beside the body; and in how many rows at most
GROUND_SLACK = 0.28  # of the ground's brightness, that it may differ by beside and beyond the needle
GLARE_SLACK = 0.07  # of the ground's brightness, that it may be brighter by at an end
GLARE_NOISES = 2.5  # and at least so many times the noise
NOISE_OF_STEPS = 1.05  # noise by the median step between neighbours: 1.4826 / sqrt 2


def is_glaring(strip: Strip, tail: float, tip: float, body: float) -> bool:
    """Say whether the lamp is reflected at an end."""
    wide = np.abs(strip.aside) < 0.5 * body + 3.0
    usual = middle(strip.ground[(strip.along > tail) & (strip.along < tip)])
    light = ((1.0 - strip.dark) * strip.ground.mean(axis=1, keepdims=True) / usual).astype(np.float32)
    noise = middle(np.abs(np.diff(light[:, wide], axis=0))) * NOISE_OF_STEPS
    bound = 1.0 + max(GLARE_SLACK, GLARE_NOISES * noise)
    return any(
        float(cv2.blur(light[np.ix_(np.abs(strip.along - at) < 5.0, wide)], (5, 3)).max()) > bound for at in (tail, tip)
    )


def what_covers(strip: Strip, tail: float, tip: float, body: float) -> str:
    """Say what covers or touches the needle; empty if nothing does."""
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
