"""One frame looked at: where the dish, the needle and the thread are in it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import Enum

import cv2
import numpy as np

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.polyline import arc_lengths
from magnetosuture_thread.scene.scene import Scene
from magnetosuture_thread.thread_observation import ThreadObservation, ThreadPiece
from magnetosuture_thread.vision.dish.ellipse import circle_through, find_ellipse
from magnetosuture_thread.vision.dish.find import Guess, find_cut_dish, find_dish, floor_level
from magnetosuture_thread.vision.dish.tilt import MIN_ANGLE, Tilt, find_tilt, tilt_of, unseen_tilt_covariance
from magnetosuture_thread.vision.images import FLOOR_FACTOR, Picture, Wall, measured_channel, prepare
from magnetosuture_thread.vision.needle.find import find_needles, search_factor
from magnetosuture_thread.vision.needle.measured_needle import MeasuredNeedle
from magnetosuture_thread.vision.needle.size import LengthEstimator
from magnetosuture_thread.vision.sampling import middle
from magnetosuture_thread.vision.scene_mask import SceneMask, scene_mask
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.thread.centreline import certain_points, walk_from
from magnetosuture_thread.vision.thread.loose import has_loose_thread
from magnetosuture_thread.vision.thread.observe import observe
from magnetosuture_thread.vision.thread.search import Walk

UNKNOWN_HEADING = "a needle of which nothing tells which end is the tail"
MIN_FOLLOWED, MIN_LOOSE = 0.04, 0.5  # of the thread's length: followed from a needle that has one; lying elsewhere
MAX_LENGTH_RATIO = 1.05  # of the thread's length, after which the walk ends
DARK_FLOOR = 130.0  # grey levels; a dish, or with a given view a frame, whose median is below may have a dark floor
SCALE_ERROR = 0.001  # of a scale by the dish's rim: how far its light moves the edge
ELLIPSE_ERROR = 0.01  # of a scale by an edge of the wall in a photograph: which one it is, and where light moves it
SCALE_SLACK = 0.03  # that a dish found may differ from the size that a given scale makes of it
MAX_SCALE_SLACK = 0.1  # the same, beyond which it is another dish; between, the dish's own size gives the scale
MAX_TILT = math.radians(10.0)  # of a camera over a dish that is seen in part, and looks tilted
DARK_ELLIPSE = 64.0  # grey levels; a floor whose median is below is dark: steel is no darker


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


@dataclass(frozen=True)
class FoundDish:
    """The dish in a frame.

    Attributes:
        view: where it is, once the frame is prepared.
        dark_field: whether the floor is dark, and needle, thread and rim are bright.
        tilt: of the camera; None if there is none to be sure of.
        scale_error: standard deviation of the view's scale, as a share; 0 where the scale is given.
        unseen_tilt: angle of a tilt that the rim would not tell [rad].
        remark: what a user should know of the view; empty if nothing.
        homography: from the frame to the one in which the view holds, shape (3, 3); None where they are the same.
    """

    view: DishView
    dark_field: bool = False
    tilt: Tilt | None = None
    scale_error: float = 0.0
    unseen_tilt: float = 0.0
    remark: str = ""
    homography: np.ndarray | None = None

    def covariance(self, tail: np.ndarray, heading: np.ndarray, radius: float) -> np.ndarray:
        """Return what the view leaves unknown of a tail and a heading in a dish, shape (3, 3) [m, m, rad]."""
        total = np.zeros((3, 3))
        total[:2, :2] = self.scale_error**2 * np.outer(tail, tail)  # A wrong scale shifts what is far from the centre.
        if self.tilt is not None:
            total += self.tilt.covariance(tail, heading, radius)
        elif self.unseen_tilt:
            total += unseen_tilt_covariance(tail, heading, self.unseen_tilt, radius)
        return total

    @property
    def warning(self) -> str:
        """What makes the measurement worse than it could be; empty if nothing does."""
        return "; ".join(filter(None, (self.tilt.warning if self.tilt is not None else "", self.remark)))

    def prepared(self, image: np.ndarray) -> np.ndarray:
        """Return a frame with a bright floor and a round dish."""
        if self.dark_field:
            image = 255 - image
        if self.homography is not None:
            size = image.shape[1::-1]
            return np.asarray(cv2.warpPerspective(image, self.homography, size, borderMode=cv2.BORDER_REPLICATE))
        return image if self.tilt is None else self.tilt.corrected(image, self.view)


def see_dish(
    image: np.ndarray, settings: VisionTrackerSettings, diameter: float, *, photographed: bool = True
) -> FoundDish | None:
    """Find the view: what of it is given, and the rest by the dish; None if none is seen.

    Args:
        image: frame, shape (rows, columns) or (rows, columns, 3), uint8.
        settings: what to look for.
        diameter: of the dish [m].
        photographed: whether to look for a dish as in a photograph where there is no other, which takes long.
    """
    gray = measured_channel(image)
    guesses: dict[int, Guess | None] = {}
    fixed = settings.fixed_view()
    if fixed is not None:
        # Only a dark frame whose negative shows the dish has a dark floor: others are just dark.
        dark = middle(gray[::8, ::8]) < DARK_FLOOR and _found_view(gray, settings, diameter, guesses) is None
        dark = dark and _found_view(255 - gray, settings, diameter, guesses) is not None
        return FoundDish(fixed, dark, homography=settings.homography())
    for dark_field in (False, True):
        if dark_field:
            gray = 255 - gray
        found = _found_view(gray, settings, diameter, guesses)
        if found is None:
            continue
        view, remark = found
        if dark_field and floor_level(gray, view, diameter) < 255.0 - DARK_FLOOR:
            continue  # A bright rim around a bright floor, as of clear walls.
        if settings.dish_centre_px or settings.metres_per_pixel:  # measured by a calibration
            error = 0.0 if settings.metres_per_pixel and not remark else SCALE_ERROR
            return FoundDish(view, dark_field, scale_error=error, remark=remark)
        tilt, view = find_tilt(gray, view, diameter)
        return FoundDish(view, dark_field, tilt, SCALE_ERROR, 0.0 if tilt is not None else MIN_ANGLE)
    return _photographed(image, settings, diameter) if photographed else None


def _found_view(
    gray: np.ndarray, settings: VisionTrackerSettings, diameter: float, guesses: dict[int, Guess | None]
) -> tuple[DishView, str] | None:
    """Return the view by a dish with a bright floor, and a remark on its scale; None if none is seen."""
    found = find_dish(gray, diameter, guesses)
    return _with_given(found, settings) if found is not None else None


def _with_given(found: DishView, settings: VisionTrackerSettings) -> tuple[DishView, str] | None:
    """Return a view that was found with what is given of it, and a remark; None if they don't fit at all.

    Where a given scale and the dish differ by more than a rim's light can make, all that is known of the scene is
    relative to its dish: the dish gives the scale.
    """
    scale, remark = settings.metres_per_pixel or found.metres_per_pixel, ""
    apart = found.metres_per_pixel / scale - 1.0
    if abs(apart) > MAX_SCALE_SLACK:
        return None
    if abs(apart) > SCALE_SLACK:
        scale = found.metres_per_pixel
        remark = f"metres_per_pixel is {100.0 * abs(apart):.0f} % off what the dish's diameter makes it, which is used"
    centre = settings.dish_centre_px
    return DishView((centre[0], centre[1]) if centre else found.centre_px, scale, settings.camera_rotation), remark


def _photographed(image: np.ndarray, settings: VisionTrackerSettings, diameter: float) -> FoundDish | None:
    """Find a dish by its ellipse alone, as in a photograph: cut, saturated, with a lid, on any ground."""
    ellipse = find_ellipse(image)
    if ellipse is None:
        return None
    gray, found = measured_channel(image), DishView(ellipse.centre_px, 0.5 * diameter / ellipse.major)
    tilt, unseen_tilt = tilt_of(ellipse, settings.camera_rotation), MIN_ANGLE
    if tilt is not None and ellipse.is_cut(image.shape):  # The part that is seen does not determine a tilt.
        cut = find_cut_dish(gray, circle_through(image, ellipse), diameter)
        if cut is None:
            return None
        found, tilt, unseen_tilt = cut, None, MAX_TILT
    if (given := _with_given(found, settings)) is None:
        return None
    view, remark = given
    dark_field = floor_level(gray, found, diameter) < DARK_ELLIPSE
    tilt = None if settings.dish_centre_px or settings.metres_per_pixel else tilt
    return FoundDish(view, dark_field, tilt, ELLIPSE_ERROR, 0.0 if tilt is not None else unseen_tilt, remark)


def picture_of(
    image: np.ndarray,
    view: DishView,
    settings: VisionTrackerSettings,
    mask: SceneMask | None,
    box: tuple[int, int, int, int] | None = None,
) -> Picture:
    """Make a frame ready to measure on, or the part of it in a box (left, top, right, bottom) [px]."""
    factor = search_factor(settings.needle_width / view.metres_per_pixel)
    if box is None:
        return prepare(image, factor, mask=mask)
    left, top, right, bottom = box
    part = mask.part(left, top, right, bottom) if mask is not None else None
    return prepare(image[top:bottom, left:right], factor, (left, top), part)


def mask_of(image: np.ndarray, view: DishView, settings: VisionTrackerSettings, scene: Scene) -> SceneMask | None:
    """Return where the shapes of a scene are in a frame; None if it has none."""
    factor = search_factor(settings.needle_width / view.metres_per_pixel)
    return scene_mask(scene, view, image.shape[:2], factor, settings.outline_tolerance, FLOOR_FACTOR)


def needles_in(
    picture: Picture,
    view: DishView,
    settings: VisionTrackerSettings,
    diameter: float,
    toward: np.ndarray | None = None,
    estimator: LengthEstimator | None = None,
) -> tuple[list[MeasuredNeedle], list[str]]:
    """Find the needles in a picture, in its own pixels, by the length as it is set or measured; see `find_needles`."""
    estimator = LengthEstimator() if estimator is None else estimator
    size = estimator.size(settings.needle_length, settings.needle_width, view.metres_per_pixel)
    return find_needles(picture, _local(view, picture), 0.5 * diameter, size, toward)


def why_none(refused: list[str]) -> str:
    """Say in words why no needle was found."""
    return "no needle in the dish" + (f"; dark things: {', '.join(refused)}" if refused else "")


def with_thread(
    picture: Picture, view: DishView, settings: VisionTrackerSettings, diameter: float, needles: list[MeasuredNeedle]
) -> tuple[MeasuredNeedle | None, np.ndarray, str]:
    """Return the needle that a thread leaves, the thread's centreline [px], and why there is none where there is none.

    `needles` are all that were found, at least one; see `look_once`.
    """
    found = [centreline_of(picture, view, settings, diameter, needle) for needle in needles]
    lengths = [float(arc_lengths(line)[-1]) for line, _ in found]
    best = int(np.argmax(lengths))
    needle, (line, walk) = needles[best], found[best]
    thread = settings.thread_length / view.metres_per_pixel
    followed = sum(length >= MIN_FOLLOWED * thread for length in lengths)
    if len(needles) > 1 and followed != 1:
        return None, line, f"{len(needles)} needles in the dish"
    if walk is None or (followed and not walk.ridge.signed):
        return needle, line, ""
    # What is faint or pale, as glare, is no thread either while one that is dark beyond doubt lies elsewhere.
    wall = Wall(_local(view, picture).centre_px, 0.5 * diameter / view.metres_per_pixel)
    if walk.passes or has_loose_thread(picture, needle, wall, MIN_LOOSE * thread, line if followed else None):
        return None, line, "a needle that no thread leaves, and a thread beside it"
    return needle, line, ""


def centreline_of(
    picture: Picture, view: DishView, settings: VisionTrackerSettings, diameter: float, needle: MeasuredNeedle
) -> tuple[np.ndarray, Walk | None]:
    """Return the thread's centreline from a needle's tail on, in the picture's pixels; one point if none is seen.

    The other value is the walk that gave it, None if nothing tells where the tail is.
    """
    if not needle.heading_known:
        return needle.tail_px[None], None
    wall = 0.5 * diameter / view.metres_per_pixel
    max_length = MAX_LENGTH_RATIO * settings.thread_length / view.metres_per_pixel
    walk = walk_from(picture, needle, max_length, _local(view, picture).centre_px, wall, doubted=True)
    return certain_points(walk), walk


def tracked(
    picture: Picture,
    view: DishView,
    settings: VisionTrackerSettings,
    needle: MeasuredNeedle,
    walk: np.ndarray,
    diameter: float,
    otherwise: State = State.LOST,
    *,
    search: bool = True,
) -> Track:
    """Return what a frame shows whose needle and centreline are known, in the picture's own pixels.

    `otherwise` is the state if it is unknown which end is the tail; `search` is that of `observe`.
    """
    local = _local(view, picture)
    heading, tail = view.directions_to_dish(needle.direction_px), local.to_dish(needle.tail_edge_px)
    covariance = _in_dish(needle, view)
    return Track(
        state=State.TRACKED if needle.heading_known else otherwise,
        reason="" if needle.heading_known else UNKNOWN_HEADING,
        confidence=needle.confidence,
        tail=tail,
        tip=local.to_dish(needle.tip_px),
        heading=heading,
        curvature=-needle.curvature_px / view.metres_per_pixel,
        covariance=covariance,
        centreline=local.to_dish(walk),
        view=view,
        observation=observe(
            picture,
            needle,
            walk,
            local,
            0.5 * diameter,
            settings.thread_length,
            scale_known=settings.metres_per_pixel > 0.0,
            search=search,
        ),
    )


def look_once(
    image: np.ndarray,
    settings: VisionTrackerSettings,
    scene: Scene,
    mask_for: Callable[[DishView], SceneMask | None] | None = None,
) -> Track:
    """Look at one frame alone; `mask_for` gives the scene's mask for a view, if somebody keeps it."""
    diameter = scene.dish.diameter
    dish = see_dish(image, settings, diameter)
    if dish is None:
        return no_pose(State.LOST, "no dish in the image", None)
    image, view = dish.prepared(image), dish.view
    mask = mask_for(view) if mask_for is not None else mask_of(image, view, settings, scene)
    picture = picture_of(image, view, settings, mask)
    needles, refused = needles_in(picture, view, settings, diameter)
    if not needles:
        return no_pose(State.LOST, why_none(refused), view)
    needle, walk, reason = with_thread(picture, view, settings, diameter, needles)
    if needle is None:
        return no_pose(State.LOST, reason, view)
    return tilted(tracked(picture, view, settings, needle, walk, diameter), dish, 0.5 * diameter)


def tilted(track: Track, dish: FoundDish, radius: float) -> Track:
    """Return a track with what scale and tilt of the camera leave unknown, and a warning of it."""
    covariance = track.covariance + dish.covariance(track.tail, track.heading, radius)
    observation = track.observation
    if dish.tilt is not None:  # What a straight camera's view leaves unknown moves the needle and all points alike.
        pieces = tuple(_less_sure(piece, dish.tilt, radius) for piece in observation.pieces)
        observation = replace(observation, pieces=pieces)
    return replace(track, covariance=covariance, warning=dish.warning, observation=observation)


def _less_sure(piece: ThreadPiece, tilt: Tilt, radius: float) -> ThreadPiece:
    """Return a piece with what a tilt leaves unknown of where it is, as far out as it reaches."""
    farthest = piece.points[np.argmax(np.hypot(*piece.points.T))]
    view = tilt.covariance(farthest, np.array([1.0, 0.0]), radius)[:2, :2]
    return replace(piece, deviation=np.sqrt(piece.deviation**2 + np.linalg.eigvalsh(view)[-1]))


def _local(view: DishView, picture: Picture) -> DishView:
    """Return the view in the pixels of a part of the frame."""
    u, v = view.centre_px
    return DishView((u - picture.origin[0], v - picture.origin[1]), view.metres_per_pixel, view.rotation)


def _in_dish(needle: MeasuredNeedle, view: DishView) -> np.ndarray:
    """Return the covariance of tail and heading in the dish frame, shape (3, 3)."""
    along = view.directions_to_dish(needle.direction_px)
    aside = view.directions_to_dish(np.array([-needle.direction_px[1], needle.direction_px[0]]))
    scale = view.metres_per_pixel
    turn = np.zeros((3, 3))
    turn[:2, 0], turn[:2, 1], turn[2, 2] = scale * along, scale * aside, -1.0  # the dish's y goes up
    assert needle.covariance is not None
    return np.asarray(turn @ needle.covariance @ turn.T)
