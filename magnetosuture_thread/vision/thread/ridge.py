"""How much darker, or brighter, each pixel is than what is near it: what the walk along a thread follows."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from magnetosuture_thread.vision.sampling import middle

FAINTEST = 3.0  # grey levels; a black-hat fainter than this is noise
FAINTEST_NOISES = 3.0  # and so is one fainter than so many times the median of all
BLUR_PX = 0.7  # before the black-hat: as wide as the thinnest thread looks
WINDOW_PX = 7  # wider than the thread looks
INNER_PX, OUTER_PX = 1.0, 3.0  # blurs whose difference is the faint ridge: the thread's own, and its surroundings'
LEVELS = 10.0  # of the coded faint ridge for each standard deviation of noise
ZERO = 128.0  # as which no difference is coded
MIN_DEVIATION = 0.25  # grey levels; less noise than this is rounding
FAINT_DEVIATIONS = 1.3  # of noise, above which a single point may show a thread
MIN_NOISE_SIDE = 0.7  # of the window, about its middle, where the noise is measured
DEVIATION = 1.4826  # of normal noise, by the median of its magnitude
_WINDOW = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (WINDOW_PX, WINDOW_PX))


@dataclass(frozen=True)
class Ridge:
    """How much darker, or brighter, each pixel is than what is near it.

    Attributes:
        strength: shape (rows, columns), uint8.
        hidden: where nothing can be seen, 255 there, `factor` times smaller.
        factor: see `hidden`.
        scale: how much smaller the ridge is than the picture.
        noise: strength where nothing is.
        faintest: a strength above noise that is no noise.
        signed: whether strengths below `noise` tell of the opposite: brighter instead of darker.
    """

    strength: np.ndarray
    hidden: np.ndarray
    factor: int
    scale: int
    noise: float
    faintest: float
    signed: bool = False


def shrunk_window(window: np.ndarray, hidden: np.ndarray, factor: int, scale: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Return a window, what is hidden in it and the factor of that, all shrunk by a scale."""
    if scale == 1:
        return window, hidden, factor
    size = (window.shape[1] // scale, window.shape[0] // scale)
    small = cv2.resize(window, size, interpolation=cv2.INTER_AREA)
    return small, cv2.resize(hidden, size, interpolation=cv2.INTER_NEAREST), 1


def black_hat(window: np.ndarray, hidden: np.ndarray, factor: int, scale: int) -> Ridge:
    """Return how much darker a window is than the brightest background within a few pixels, in grey levels.

    An edge has no black-hat, so that shadows, covers and the rim are no thread.
    """
    window, hidden, factor = shrunk_window(window, hidden, factor, scale)
    smooth = cv2.GaussianBlur(window, (5, 5), BLUR_PX)
    strength = cv2.morphologyEx(smooth, cv2.MORPH_BLACKHAT, _WINDOW)
    noise = middle(strength[::5, ::5])
    return Ridge(strength, hidden, factor, scale, noise, max(FAINTEST, FAINTEST_NOISES * noise))


def difference_of_gaussians(window: np.ndarray) -> tuple[np.ndarray, float]:
    """Return by how many grey levels a window is darker than its surroundings, and the standard deviation of noise.

        d = G_outer * I - G_inner * I

    The inner blur is the one with the most of a thin thread's light over noise: as wide as a thread looks through the
    lens. Noise has no mean in it, so that what is seen adds up along a thread and noise does not.
    """
    exact = window.astype(np.float32)
    inner = cv2.GaussianBlur(exact, (0, 0), INNER_PX)
    # The surroundings' blur goes over the inner one.
    outer = cv2.GaussianBlur(inner, (0, 0), float(np.sqrt(OUTER_PX**2 - INNER_PX**2)))
    difference = outer - inner
    rows, columns = (round(0.5 * (1.0 - MIN_NOISE_SIDE) * side) for side in difference.shape)
    inside = difference[rows : len(difference) - rows : 3, columns : difference.shape[1] - columns : 3]
    return difference, max(MIN_DEVIATION, DEVIATION * middle(np.abs(inside)))


def faint_ridge(
    difference: np.ndarray, deviation: float, hidden: np.ndarray, factor: int, scale: int, *, pale: bool
) -> Ridge:
    """Return a ridge in units of noise, of what is darker than its surroundings or what is paler; see above."""
    gain = LEVELS / deviation
    strength = cv2.convertScaleAbs(np.clip(ZERO + (-gain if pale else gain) * difference, 0.0, 255.0))
    return Ridge(strength, hidden, factor, scale, ZERO, FAINT_DEVIATIONS * LEVELS, signed=True)
