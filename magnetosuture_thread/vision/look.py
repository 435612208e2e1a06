"""One frame looked at: where the needle and the thread are in it, in a given view of the dish."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.polyline import Points, arc_lengths
from magnetosuture_thread.scene.scene import Scene
from magnetosuture_thread.thread_observation import ThreadObservation, ThreadPiece
from magnetosuture_thread.vision.dish.find import Tilt
from magnetosuture_thread.vision.dish.watch import FoundDish, see_dish
from magnetosuture_thread.vision.images import FLOOR_FACTOR, Picture, Wall, prepare
from magnetosuture_thread.vision.needle.arc import LengthEstimator, MeasuredNeedle
from magnetosuture_thread.vision.needle.find import find_needles, search_factor
from magnetosuture_thread.vision.scene_mask import SceneMask, scene_mask
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.thread.centreline import find_centreline
from magnetosuture_thread.vision.thread.observe import observe

UNKNOWN_HEADING = "a needle of which nothing tells which end is the tail"
MIN_FOLLOWED = 0.04  # of the thread's length, that is followed from a needle that has one
MAX_LENGTH_RATIO = 1.05  # of the thread's length, after which the walk ends


class State(Enum):
    """What is known of the needle in a frame."""

    SEARCHING = "searching"
    TRACKED = "tracked"
    LOST = "lost"


@dataclass(frozen=True)
class Track:
    """What one frame shows.

    Attributes:
        state: TRACKED when there is a pose; LOST when this frame gives none; SEARCHING while the needle is
            found anew, or seen but not yet often enough.
        reason: why there is no pose, or why its heading is unknown; empty when tracked.
        confidence: of the pose, 0 to 1; 0 without one.
        tail: the needle's blunt end, shape (2,) [m]; empty without a pose.
        tip: its point, shape (2,) [m]; empty without a pose.
        heading: unit tangent at the tail, towards the tip, shape (2,); empty without a pose.
        curvature: of the needle's axis, positive to the left of the heading [1/m]; 0 without a pose.
        covariance: of (x, y, heading angle), shape (3, 3) [m, m, rad]; empty without a pose. Where nothing tells which
            end is the tail, the state is not TRACKED, the variance of the angle is pi^2, and that along the needle its
            length squared.
        centreline: the thread from the tail on, shape (m, 2) [m]; fewer than 2 points if unseen.
        view: where the dish is in the image; None when it is not found.
        warning: what makes the measurement worse than it could be; empty if nothing does.
        needle_length: measured over the first frames [m]; None until it is, and of a frame looked at alone.
        observation: the pieces of the thread that are seen, in the dish frame.
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
    warning: str = ""
    needle_length: float | None = None
    observation: ThreadObservation = field(default_factory=ThreadObservation)


def no_pose(state: State, reason: str, view: DishView | None) -> Track:
    """Return what is said of a frame without a pose."""
    nothing = np.empty(0)
    return Track(state, reason, 0.0, nothing, nothing, nothing, 0.0, np.empty((0, 0)), np.empty((0, 2)), view)


def why_none(refused: list[str]) -> str:
    """Say in words why no needle was found."""
    return "no needle in the dish" + (f"; dark things: {', '.join(refused)}" if refused else "")


def mask_of(shape: tuple[int, ...], view: DishView, settings: VisionTrackerSettings, scene: Scene) -> SceneMask | None:
    """Return where the shapes of a scene are in a frame of a shape (rows, columns); None if it has none."""
    factor = search_factor(settings.needle_width / view.metres_per_pixel)
    return scene_mask(scene, view, shape[:2], factor, settings.outline_tolerance, FLOOR_FACTOR)


@dataclass(frozen=True)
class FrameReader:
    """Finds needle and thread in frames with one view of the dish.

    Needles and lines are in the pixels of the picture that they were found in; tracks are in the dish frame.

    Attributes:
        settings: what to look for.
        dish: where it is in the frame.
        radius: of the dish [m].
        mask: where the scene's shapes are in the frame; None if it has none.
    """

    settings: VisionTrackerSettings
    dish: FoundDish
    radius: float
    mask: SceneMask | None

    def picture(self, image: np.ndarray, box: tuple[int, int, int, int] | None = None) -> Picture:
        """Make a prepared frame ready to measure on, or the part of it in a box (left, top, right, bottom) [px]."""
        factor = search_factor(self.settings.needle_width / self.dish.view.metres_per_pixel)
        if box is None:
            return prepare(image, factor, mask=self.mask)
        left, top, right, bottom = box
        part = self.mask.part(left, top, right, bottom) if self.mask is not None else None
        return prepare(image[top:bottom, left:right], factor, (left, top), part)

    def needles(
        self, picture: Picture, estimator: LengthEstimator, toward: np.ndarray | None = None
    ) -> tuple[list[MeasuredNeedle], list[str]]:
        """Find the needles in a picture, by the length as it is set or measured; see `find_needles`."""
        settings, scale = self.settings, self.dish.view.metres_per_pixel
        size = estimator.size(settings.needle_length, settings.needle_width, scale)
        return find_needles(picture, self._local(picture), self.radius, size, toward)

    def centreline(self, picture: Picture, needle: MeasuredNeedle) -> Points:
        """Return the thread's centreline from a needle's tail on, shape (m, 2) [px]; m = 1 if none is visible."""
        if not needle.heading_known:
            return needle.tail_px[None]
        scale = self.dish.view.metres_per_pixel
        wall = Wall(self._local(picture).centre_px, self.radius / scale)
        return find_centreline(picture, needle, MAX_LENGTH_RATIO * self.settings.thread_length / scale, wall)

    def with_thread(self, picture: Picture, needles: list[MeasuredNeedle]) -> tuple[MeasuredNeedle | None, Points, str]:
        """Return the needle that a thread leaves, the thread's centreline [px], and why there is none if there is none.

        `needles` are all that were found, at least one. A needle that is alone needs no thread.
        """
        lines = [self.centreline(picture, needle) for needle in needles]
        lengths = [float(arc_lengths(line)[-1]) for line in lines]
        best = int(np.argmax(lengths))
        thread = self.settings.thread_length / self.dish.view.metres_per_pixel
        followed = sum(length >= MIN_FOLLOWED * thread for length in lengths)
        if len(needles) > 1 and followed != 1:
            return None, lines[best], f"{len(needles)} needles in the dish"
        return needles[best], lines[best], ""

    def track(
        self,
        picture: Picture,
        needle: MeasuredNeedle,
        line: Points,
        otherwise: State = State.LOST,
        *,
        search: bool = True,
    ) -> Track:
        """Return what a frame shows whose needle and centreline are known.

        Args:
            picture: the frame or a part of it.
            needle: in its pixels.
            line: the centreline in its pixels.
            otherwise: the state if it is unknown which end is the tail.
            search: whether to look for pieces of the thread that the centreline does not show; see `observe`.
        """
        view, local = self.dish.view, self._local(picture)
        heading, tail = view.directions_to_dish(needle.direction_px), local.to_dish(needle.tail_edge_px)
        given = self.settings.metres_per_pixel > 0.0
        length = self.settings.thread_length
        observation = observe(picture, needle, line, local, self.radius, length, scale_known=given, search=search)
        if self.dish.tilt is not None:  # What a straight camera's view leaves unknown moves all points alike.
            pieces = tuple(_less_sure(piece, self.dish.tilt, self.radius) for piece in observation.pieces)
            observation = replace(observation, pieces=pieces)
        return Track(
            state=State.TRACKED if needle.heading_known else otherwise,
            reason="" if needle.heading_known else UNKNOWN_HEADING,
            confidence=needle.confidence,
            tail=tail,
            tip=local.to_dish(needle.tip_px),
            heading=heading,
            curvature=-needle.curvature_px / view.metres_per_pixel,
            covariance=_in_dish(needle, view) + self.dish.covariance(tail, heading, self.radius),
            centreline=local.to_dish(line),
            view=view,
            warning=self.dish.warning,
            observation=observation,
        )

    def _local(self, picture: Picture) -> DishView:
        """Return the view in the pixels of a picture."""
        return replace(self.dish.view, centre_px=tuple(np.subtract(self.dish.view.centre_px, picture.origin).tolist()))


def look_once(
    image: np.ndarray,
    settings: VisionTrackerSettings,
    scene: Scene,
    mask_for: Callable[[DishView], SceneMask | None] | None = None,
) -> Track:
    """Look at one frame alone; `mask_for` gives the scene's mask for a view, if somebody keeps it."""
    dish = see_dish(image, settings, scene.dish.diameter)
    if dish is None:
        return no_pose(State.LOST, "no dish in the image", None)
    image, view = dish.prepared(image), dish.view
    mask = mask_for(view) if mask_for is not None else mask_of(image.shape, view, settings, scene)
    reader = FrameReader(settings, dish, scene.dish.radius, mask)
    picture = reader.picture(image)
    needles, refused = reader.needles(picture, LengthEstimator())
    if not needles:
        return no_pose(State.LOST, why_none(refused), view)
    needle, line, reason = reader.with_thread(picture, needles)
    if needle is None:
        return no_pose(State.LOST, reason, view)
    return reader.track(picture, needle, line)


def _less_sure(piece: ThreadPiece, tilt: Tilt, radius: float) -> ThreadPiece:
    """Return a piece with what a tilt leaves unknown of where it is, as far out as it reaches."""
    farthest = piece.points[np.argmax(np.hypot(*piece.points.T))]
    view = tilt.covariance(farthest, np.array([1.0, 0.0]), radius)[:2, :2]
    return replace(piece, deviation=np.sqrt(piece.deviation**2 + np.linalg.eigvalsh(view)[-1]))


def _in_dish(needle: MeasuredNeedle, view: DishView) -> np.ndarray:
    """Return the covariance of tail and heading in the dish frame, shape (3, 3)."""
    along = view.directions_to_dish(needle.direction_px)
    aside = view.directions_to_dish(np.array([-needle.direction_px[1], needle.direction_px[0]]))
    scale = view.metres_per_pixel
    turn = np.zeros((3, 3))
    turn[:2, 0], turn[:2, 1], turn[2, 2] = scale * along, scale * aside, -1.0  # the dish's y goes up
    assert needle.covariance is not None
    return np.asarray(turn @ needle.covariance @ turn.T)
