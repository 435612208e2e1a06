"""The frames of a video file."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.settings.files import MAX_PIXELS

VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".m4v", ".webm", ".mpg", ".mpeg", ".wmv")  # endings


class Video:
    """A video file.

    Args:
        path: of the file.
        rate: frames a second; None for what the file says.

    Attributes:
        rate: frames a second.
        count: number of frames, by the file's header; 0 where that does not say.

    Raises:
        BagError: it cannot be read, has frames of more than `MAX_PIXELS`, or does not say its rate.
    """

    def __init__(self, path: Path, rate: float | None = None) -> None:
        self._path, self._is_timed = path, rate is None
        video = cv2.VideoCapture(str(path))
        if not video.isOpened():
            raise BagError(path, "cannot be read as a video; expected one that is whole, and that OpenCV can decode")
        self.rate = rate or float(video.get(cv2.CAP_PROP_FPS))
        if not 0.0 < self.rate < math.inf:
            raise BagError(path, "does not say its frame rate; give it by --rate")
        width, height = (int(video.get(side)) for side in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if width * height > MAX_PIXELS:
            raise BagError(path, f"has frames of {width} x {height} pixels; expected at most {MAX_PIXELS} pixels")
        self.count = max(0, int(video.get(cv2.CAP_PROP_FRAME_COUNT)))

    def frames(self) -> Iterator[tuple[float, np.ndarray]]:
        """Go through the frames that can be decoded, turned as players show them, as pictures are.

        Each has the time since the first one [s], that of the file where no rate was given: it may vary.
        """
        video = cv2.VideoCapture(str(self._path))
        number = 0
        while (taken := video.read())[0]:
            told = 1e-3 * video.get(cv2.CAP_PROP_POS_MSEC)
            yield told if self._is_timed and told > 0.0 else number / self.rate, np.asarray(taken[1])
            number += 1
