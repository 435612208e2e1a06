"""Measures one camera frame: where the dish, the needle and the thread are in it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.vision.images import Picture, prepare
from magnetosuture_thread.vision.needle.body import MeasuredNeedle
from magnetosuture_thread.vision.needle.find import find_needles, search_factor
from magnetosuture_thread.vision.scene_mask import SceneMask
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.thread.centreline import find_centreline

MAX_LENGTH_RATIO = 1.05  # of the thread's length, after which the walk ends
WALL_PX = 4.0  # before which the walk ends
SCALE_ERROR = 0.001  # of a scale by the dish's rim: how far its light moves the edge


class State(Enum):
    """Whether the needle of a frame is tracked."""

    SEARCHING = "searching"
    TRACKED = "tracked"
    LOST = "lost"


@dataclass(frozen=True)
class Track:
    """The needle and the thread in one frame.

    Attributes:
        state: TRACKED when there is a pose; LOST when this frame gives none; SEARCHING while the needle is
            found anew, or seen but not yet often enough.
        reason: why there is no pose; empty when tracked.
        confidence: of the pose, 0 to 1; 0 without one.
        tail: the needle's blunt end, shape (2,) [m]; empty without a pose.
        tip: its point, shape (2,) [m]; empty without a pose.
        heading: unit tangent at the tail, towards the tip, shape (2,); empty without a pose.
        curvature: of the needle's axis, positive to the left of the heading [1/m]; 0 without a pose.
        covariance: of (x, y, heading angle), shape (3, 3) [m, m, rad]; empty without a pose.
        centreline: the thread from the tail on, shape (m, 2) [m]; fewer than 2 points if unseen.
        view: where the dish is in the image; None when it is not found.
    """

    state: State
    reason: str
    confidence: float
    tail: np.ndarray
    tip: np.ndarray
    heading: np.ndarray
    curvature: float
    covariance: np.ndarray
    centreline: np.ndarray
    view: DishView | None


def no_pose(state: State, reason: str, view: DishView | None) -> Track:
    """Return the track of a frame without a pose."""
    nothing = np.empty(0)
    return Track(state, reason, 0.0, nothing, nothing, nothing, 0.0, np.empty((0, 0)), np.empty((0, 2)), view)


def explain_refusals(count: int, refused: list[str]) -> str:
    """Return why there is no needle, or none of `count` is the one."""
    if count:
        return f"{count} needles in the dish"
    return "no needle in the dish" + (f"; dark things: {', '.join(refused)}" if refused else "")


@dataclass(frozen=True)
class Frame:
    """A frame whose view is known.

    Attributes:
        gray: the measured channel, shape (rows, columns), uint8.
        view: where the dish is in it.
        settings: what to look for.
        dish_radius: [m]
        mask: where the scene's shapes are; None if it has none.
    """

    gray: np.ndarray
    view: DishView
    settings: VisionTrackerSettings
    dish_radius: float
    mask: SceneMask | None

    def picture(self, box: tuple[int, int, int, int] | None = None) -> Picture:
        """Make the frame ready to measure on, or the part of it in a box (left, top, right, bottom) [px]."""
        factor = search_factor(self.settings.needle_width / self.view.metres_per_pixel)
        if box is None:
            return prepare(self.gray, factor, mask=self.mask)
        left, top, right, bottom = box
        part = self.mask.part(*box) if self.mask is not None else None
        # Copied: compiled code is compiled once more for each other layout of memory.
        return prepare(np.ascontiguousarray(self.gray[top:bottom, left:right]), factor, (left, top), part)

    def needles(self, picture: Picture, toward: np.ndarray | None = None) -> tuple[list[MeasuredNeedle], list[str]]:
        """Find the needles in a picture, in its own pixels; see `find_needles`."""
        length, width = self.settings.needle_length, self.settings.needle_width
        return find_needles(picture, self._view_in(picture), self.dish_radius, length, width, toward)

    def track(self, picture: Picture, needle: MeasuredNeedle) -> Track:
        """Measure the thread from a needle on, which is in the picture's own pixels, and return both."""
        local, scale = self._view_in(picture), self.view.metres_per_pixel
        max_length = MAX_LENGTH_RATIO * self.settings.thread_length / scale
        walk = find_centreline(picture, needle, max_length, local.centre_px, self.dish_radius / scale - WALL_PX)
        tail, heading = local.to_dish(needle.tail_px), self.view.directions_to_dish(needle.direction_px)
        aside = self.view.directions_to_dish(np.array([-needle.direction_px[1], needle.direction_px[0]]))
        turn = np.zeros((3, 3))
        turn[:2, 0], turn[:2, 1], turn[2, 2] = scale * heading, scale * aside, -1.0  # the dish's y goes up
        assert needle.covariance is not None
        covariance = np.asarray(turn @ needle.covariance @ turn.T)
        if not self.settings.metres_per_pixel:  # A wrong scale shifts what is far from the dish's centre.
            covariance[:2, :2] += SCALE_ERROR**2 * np.outer(tail, tail)
        return Track(
            state=State.TRACKED,
            reason="",
            confidence=needle.confidence,
            tail=tail,
            tip=local.to_dish(needle.tip_px),
            heading=heading,
            curvature=-needle.curvature_px / scale,
            covariance=covariance,
            centreline=local.to_dish(walk),
            view=self.view,
        )

    def _view_in(self, picture: Picture) -> DishView:
        """Return the view in a picture's pixels."""
        u, v = self.view.centre_px
        return replace(self.view, centre_px=(u - picture.origin[0], v - picture.origin[1]))
