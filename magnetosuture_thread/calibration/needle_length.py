"""The length of a needle that nobody has measured, by frames of it at rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.settings.errors import InvalidInputError
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import VisionTracker


def find_needle_length(images: Sequence[NDArray[np.uint8]], settings: VisionTrackerSettings, scene: Scene) -> float:
    """Return the length of a needle as frames of it at rest show it, whatever length the settings say [m].

    Raises:
        InvalidInputError: no length fits both ends.
    """
    best, length, reason = 0.0, 0.0, "no frames"
    for tried in (settings.needle_length, *(2e-3 * 1.1 ** np.arange(16))):  # m
        tracker = VisionTracker(replace(settings, needle_length=float(tried)), scene)
        for index, image in enumerate(images):
            track = tracker.track(image, 0.1 * index)
            reason = track.reason or reason
            if track.needle_length is not None and track.confidence > best:
                best, length = track.confidence, track.needle_length
                break
        if length and tried == settings.needle_length:
            break
    if not length:
        raise InvalidInputError("needle", reason, "a straight needle of 2 to 9 mm, both ends of which are seen")
    return length
