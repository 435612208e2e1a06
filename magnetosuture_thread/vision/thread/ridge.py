"""How much darker, or brighter, each pixel is than what is near it: what the walk along a thread follows."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from magnetosuture_thread.vision.images import shrunk
from magnetosuture_thread.vision.sampling import middle

FAINTEST = 3.0  # grey levels; a black-hat fainter than this is noise
FAINTEST_NOISES = 3.0  # and so is one fainter than so many times the median of all
BLUR_PX = 0.7  # before the black-hat: as wide as the thinnest thread looks
WINDOW_PX = 7  # wider than the thread looks
INNER_PX = 1.0  # blur of the faint ridge: the thread's own
CELL_PX, CELLS = 4, 5  # of the surroundings' median: their side, and how many of them a side
FINE = 64  # steps of a grey level that the faint ridge is computed in
LEVELS = 10.0  # of the coded faint ridge for each standard deviation of noise
ZERO = 128.0  # as which no difference is coded
MIN_DEVIATION = 0.25  # grey levels; less noise than this is rounding
FAINT_DEVIATIONS = 1.3  # of noise, above which points may show a thread
SINGLE_DEVIATIONS = 0.4  # and a single one of them, where a thread begins
NOISE_SIDE = 0.7  # of the window, about its middle, where the noise is measured
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
        single: the same of a single point among others that are stronger in the mean.
        signed: whether strengths below `noise` tell of the opposite: brighter instead of darker.
        stiffness: of the thread that is followed; see `walk_on`.
    """

    strength: np.ndarray
    hidden: np.ndarray
    factor: int
    scale: int
    noise: float
    faintest: float
    single: float
    signed: bool
    stiffness: float = 1.0


def shrunk_hidden(hidden: np.ndarray, factor: int, window: np.ndarray, scale: int) -> tuple[np.ndarray, int]:
    """Return what is hidden, and its factor, for a window that is shrunk by a scale."""
    if scale == 1:
        return hidden, factor
    return cv2.resize(hidden, window.shape[::-1], interpolation=cv2.INTER_NEAREST), 1


def black_hat(
    window: np.ndarray, hidden: np.ndarray, factor: int, scale: int, smooth: np.ndarray | None = None
) -> Ridge:
    """Return how much darker a window is than the brightest background within a few pixels, in grey levels.

    An edge has no black-hat, so that shadows, covers and the rim are no thread. `smooth` is the window smoothed, if it
    is known and not shrunk.
    """
    window = shrunk(window, scale)
    hidden, factor = shrunk_hidden(hidden, factor, window, scale)
    smooth = cv2.GaussianBlur(window, (5, 5), BLUR_PX) if smooth is None or scale > 1 else smooth
    strength = cv2.morphologyEx(smooth, cv2.MORPH_BLACKHAT, _WINDOW)
    noise = middle(strength[::5, ::5])
    faintest = max(FAINTEST, FAINTEST_NOISES * noise)
    return Ridge(strength, hidden, factor, scale, noise, faintest, faintest, signed=False)


def darker_than_around(window: np.ndarray) -> tuple[np.ndarray, float]:
    """Return by how many grey levels a window is darker than its surroundings, and the standard deviation of noise.

        d = median(I) - G * I

    The blur G is the one with the most of a thin thread's light over noise: as wide as a thread looks through the lens.
    The median is that of cells around a pixel, of which a thread fills less than half: so a slender thing, dark or
    bright, leaves no trace of the opposite beside itself. Noise has no mean in the difference: what is seen adds up
    along a thread, and noise does not.
    """
    exact = window.astype(np.uint16) * np.uint16(FINE)
    inner = cv2.GaussianBlur(exact, (0, 0), INNER_PX)
    rows, columns = (max(1, -(-side // CELL_PX)) for side in window.shape)
    cells = cv2.copyMakeBorder(
        exact,
        0,
        rows * CELL_PX - window.shape[0],
        0,
        columns * CELL_PX - window.shape[1],
        cv2.BORDER_REPLICATE,
    )
    around = cv2.medianBlur(cv2.resize(cells, (columns, rows), interpolation=cv2.INTER_AREA), CELLS)
    around = cv2.resize(around, (columns * CELL_PX, rows * CELL_PX), interpolation=cv2.INTER_LINEAR)
    around = around[: window.shape[0], : window.shape[1]]
    difference = cv2.subtract(around, inner, dtype=cv2.CV_32F) * np.float32(1.0 / FINE)
    skip_rows, skip_columns = (round(0.5 * (1.0 - NOISE_SIDE) * side) for side in difference.shape)
    inside = difference[skip_rows : len(difference) - skip_rows : 3, skip_columns : -skip_columns or None : 3]
    return difference, max(MIN_DEVIATION, DEVIATION * middle(np.abs(inside)))


def faint_ridge(
    difference: np.ndarray, deviation: float, hidden: np.ndarray, factor: int, scale: int, *, pale: bool
) -> Ridge:
    """Return a ridge in units of noise, of what is darker than its surroundings or what is paler; see above."""
    gain = LEVELS / deviation
    strength = cv2.convertScaleAbs(np.clip(ZERO + (-gain if pale else gain) * difference, 0.0, 255.0))
    faintest, single = FAINT_DEVIATIONS * LEVELS, SINGLE_DEVIATIONS * LEVELS
    return Ridge(strength, hidden, factor, scale, ZERO, faintest, single, signed=True)
