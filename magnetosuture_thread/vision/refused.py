"""Tells a user who gets no needle what was seen instead, and which settings would admit it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.vision.arc import SET_TOLERANCE
from magnetosuture_thread.vision.images import prepare, scene_mask, shrunk
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import Track


@dataclass(frozen=True)
class Refused:
    """A slender dark thing in the dish that was not taken for the needle.

    Attributes:
        outline_px: corners of the box around it, in the frame, shape (4, 2) [px].
        length: of it [m].
        width: of it [m].
        brightness: as a share of the floor's.
        admitted_by: the values of settings that differ from those that would admit it, by name.
    """

    outline_px: Points
    length: float
    width: float
    brightness: float
    admitted_by: dict[str, float]

    @property
    def reason(self) -> str:
        """Why it is none, and what to set where it is the needle."""
        seen = f"{1e3 * self.length:.2g} x {1e3 * self.width:.2g} mm, {self.brightness:.2f} as bright as the floor"
        wished = " and ".join(f"{name} {value:g}" for name, value in self.admitted_by.items())
        as_set = "its size and brightness are as set, its shape or its ends are not a needle's"
        return f"{seen}: {f'if it is the needle, set {wished}' if wished else as_set}"


def refused_needles(image: np.ndarray, track: Track, scene: Scene, settings: VisionTrackerSettings) -> list[Refused]:
    """Return the slender dark things in a dish, those that the fewest and smallest changes of settings admit first.

    A thing is measured by the box around it, once what is thinner than three pixels, as a thread, was taken off.

    Args:
        image: frame in which no needle was found, without the lens's distortion, BGR or grey, uint8.
        track: what was seen in it, with a view.
        scene: the dish, and the shapes in which no needle can be.
        settings: with which it was looked at.
    """
    assert track.view is not None
    image = track.prepared(image)
    factor = settings.working_factor(image.shape, scene.dish.diameter)
    small, part = track.view.shrunk(factor), np.ascontiguousarray(shrunk(image, factor))
    mask = scene_mask(scene, small, part.shape, settings.outline_tolerance)
    picture = prepare(part, small, scene.dish.radius, mask, settings.needle_colour)
    share = picture.brightest.pixels / np.maximum(picture.brightest.floor.astype(np.float32), 1.0)
    whole = slice(0, share.shape[0]), slice(0, share.shape[1])
    dark = (share < 0.88) & ~picture.wall.beyond(whole, 0.03 * picture.wall.radius)
    if mask is not None:
        dark &= mask.depth < -mask.band_px  # an outline looks like a thing
    dark = cv2.morphologyEx(dark.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    found, (_, labels, stats, _) = list[tuple[int, float, Refused]](), cv2.connectedComponentsWithStats(dark)
    for label in 1 + np.flatnonzero(stats[1:, cv2.CC_STAT_AREA] > 9):  # px; what is smaller has no length
        own = labels == label
        within = own & (share < 0.5 + 0.5 * np.percentile(share[own], 10.0))  # half-way to the floor
        box = cv2.minAreaRect(np.argwhere(within)[:, ::-1].astype(np.float32))
        width, length = sorted((side + 1.0) * small.metres_per_pixel for side in box[1])
        if length < 3.0 * width:  # of what may be a needle
            continue
        brightness, admitted = float(np.median(share[within])), dict[str, float]()
        off = abs(length / settings.needle_length - 1.0)
        if off > SET_TOLERANCE:
            admitted["needle_length"] = float(f"{length:.2g}")
        if abs(width / settings.needle_width - 1.0) > 0.4:  # within which a needle is found
            admitted["needle_width"] = float(f"{width:.2g}")
        if brightness + 0.05 > settings.max_needle_brightness:
            admitted["max_needle_brightness"] = round(min(0.95, 0.5 + 0.5 * brightness), 2)  # its edge is blurred
        outline = (cv2.boxPoints(box) + 0.5) * factor - 0.5
        found.append((len(admitted), off, Refused(outline, length, width, brightness, admitted)))
    return [refused for _, _, refused in sorted(found, key=lambda each: each[:2])[:5]]
