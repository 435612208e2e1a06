"""A frame becomes a pose: finds needle and thread in camera frames and follows the needle over time.

What fits the needle's motion is taken, all else is refused.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any

import cv2
import numpy as np

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.polyline import Points, arc_lengths, points_at
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.geometry.thread_observation import ThreadObservation, ThreadPiece
from magnetosuture_thread.settings.errors import InvalidInputError
from magnetosuture_thread.vision.arc import SET_TOLERANCE, Arc, LengthEstimator, MeasuredNeedle, NeedleSize
from magnetosuture_thread.vision.candidates import Prior
from magnetosuture_thread.vision.centreline import find_centreline, without_needle
from magnetosuture_thread.vision.dish import DishWatch, FoundDish
from magnetosuture_thread.vision.images import (
    CELL_PX,
    Picture,
    SceneMask,
    check_image,
    prepare,
    sampled,
    scene_mask,
    shrunk,
)
from magnetosuture_thread.vision.lens import Lens
from magnetosuture_thread.vision.needle import find_needles
from magnetosuture_thread.vision.observe import observe
from magnetosuture_thread.vision.settings import VisionTrackerSettings, scaled_homography
from magnetosuture_thread.vision.walk import Ridge, smoothed, walk_on, worth

UNDIRECTED = "the needle's axis is found, but not which end is the tip: click it on the page, or by --tip or needle/tip"
NO_NEEDLE = "no needle in the dish"
TIP_LOST = "the point at the tip is too old, or farther from the needle's ends than a third of its length: point again"
REPEATED = "camera repeats frames"


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
        view: where the dish is in the image; None when it is not found.
        confidence: of the pose, 0 to 1; 0 without one.
        tail: the needle's blunt end, shape (2,) [m]; either end where the heading is unknown, empty without an axis.
        tip: its point, shape (2,) [m]; the other end.
        heading: unit tangent at the tail, towards the tip, shape (2,); empty without a pose.
        curvature: of the needle's axis, positive to the left of the heading [1/m]; 0 without a pose.
        covariance: of (x, y, heading angle), shape (3, 3) [m, m, rad]; empty without a pose. Where nothing tells which
            end is the tail, the state is not TRACKED, the variance of the angle is pi^2, and that along the needle its
            length squared.
        centreline: the thread from the tail on, shape (m, 2) [m]; fewer than 2 points if unseen.
        warning: what makes the measurement worse than it could be; empty if nothing does.
        needle_length: measured over the first frames [m]; None until it is, and of a frame looked at alone.
        observation: the pieces of the thread that are seen, in the dish frame.
        scale_error: standard deviation of the view's scale, as a share; 0 where the scale is given.
        straightening: homography from the frame to the one in which the view holds, shape (3, 3); None: the same.
        dark_field: whether the floor is dark, and the needle bright.
    """

    state: State
    reason: str = ""
    view: DishView | None = None
    confidence: float = 0.0
    tail: np.ndarray = field(default_factory=lambda: np.empty(0))
    tip: np.ndarray = field(default_factory=lambda: np.empty(0))
    heading: np.ndarray = field(default_factory=lambda: np.empty(0))
    curvature: float = 0.0
    covariance: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    centreline: np.ndarray = field(default_factory=lambda: np.empty((0, 2)))
    warning: str = ""
    needle_length: float | None = None
    observation: ThreadObservation = field(default_factory=ThreadObservation)
    scale_error: float = 0.0
    straightening: np.ndarray | None = None
    dark_field: bool = False

    def place_of(self, point_px: Points) -> Points:
        """Return where a point (u, v) of a frame is in its dish, of which there must be a view, shape (2,) [m]."""
        assert self.view is not None
        u, v, w = (np.eye(3) if self.straightening is None else self.straightening) @ [*point_px, 1.0]
        return self.view.to_dish(np.array([u / w, v / w]))

    def prepared(self, image: np.ndarray) -> np.ndarray:
        """Return the frame, without the lens's distortion, as the view holds in it, with a bright floor."""
        assert self.view is not None
        return FoundDish(self.view, self.dark_field, homography=self.straightening).prepared(image)

    @property
    def axis(self) -> Points:
        """Both ends of the needle, its tail first, which may be either if there is a reason, shape (2, 2) or (0, 2)."""
        return np.vstack([self.tail, self.tip]) if len(self.tail) else np.empty((0, 2))


PoseCallback = Callable[[Track], None]


def _in_dish(needle: MeasuredNeedle, view: DishView) -> np.ndarray:
    """Return the covariance of tail and heading in the dish frame, shape (3, 3)."""
    along = view.directions_to_dish(needle.direction_px)
    aside = view.directions_to_dish(np.array([-needle.direction_px[1], needle.direction_px[0]]))
    scale = view.metres_per_pixel
    turn = np.zeros((3, 3))
    turn[:2, 0], turn[:2, 1], turn[2, 2] = scale * along, scale * aside, -1.0  # the dish's y goes up
    assert needle.covariance is not None
    return np.asarray(turn @ needle.covariance @ turn.T)


@dataclass(frozen=True)
class _Pose:
    """A needle that was seen, in the dish frame; its direction is clear if it was in one frame of those so far.

    In the image it turns by `bend` from its tail to its tip [rad], from u towards v.
    """

    time: float
    tail: np.ndarray
    angle: float
    velocity: np.ndarray
    turn_rate: float
    direction_is_clear: bool
    bend: float

    def at(self, time: float) -> tuple[np.ndarray, float]:
        """Return tail and heading angle predicted with constant velocity."""
        after = min(time - self.time, 0.2)  # s; a motion is not extrapolated farther
        return self.tail + after * self.velocity, self.angle + after * self.turn_rate


class VisionTracker:
    """Tracks the needle and the thread.

    Args:
        settings: what to look for.
        scene: the dish, and the shapes in which neither needle nor thread can be.
    """

    def __init__(self, settings: VisionTrackerSettings, scene: Scene) -> None:
        self._given = settings
        self._scene = scene
        self._tip: tuple[Points, float] | None = None  # place, and the last time that it is of
        self._tip_loss = ""  # why it was not used
        self._lens: Lens | None = None
        self._mask: tuple[Any, SceneMask | None] = ((), None)  # what it was made for, and the mask
        self._shape: tuple[int, ...] = ()
        self.reset()

    def set_scene(self, scene: Scene) -> None:
        """Take another scene. The needle is still tracked, unless the dish has another size."""
        other_dish = scene.dish.diameter != self._scene.dish.diameter
        self._scene = scene
        self._mask = ((), None)
        if other_dish:
            self._begin_anew()

    def set_lens(self, lens: Lens | None) -> None:
        """Take the camera's lens, whose distortion is undone in every frame of its size; None if it is not known.

        The view is in the pixels of the frame without distortion. Another lens begins anew.
        """
        if lens == self._lens:
            return
        straight = all(each is None or each.is_straight for each in (lens, self._lens))
        self._lens = lens
        if not straight:
            self._begin_anew()

    def reset(self) -> None:
        """Forget the needle and the dish."""
        self._time: float | None = None
        self._begin_anew()

    def _begin_anew(self) -> None:
        """Choose the size that frames are looked at in, and forget what was seen, not the time of the last frame."""
        diameter = self._scene.dish.diameter
        box = self._given.region_in(self._shape) if self._shape else (0, 0, 0, 0)
        self._factor = self._given.working_factor((box[3] - box[1], box[2] - box[0]), diameter) if self._shape else 1
        self._region_px = [value // self._factor for value in box]
        self._settings = self._given.shrunk(self._factor, *self._region_px[:2])
        self._dish = DishWatch(self._settings, diameter)
        self._length = LengthEstimator()
        self._last: _Pose | None = None
        self._anew: list[_Pose] = []
        self._is_pointed_at = False  # whether a person told the direction of the poses that have to agree
        self._thread: Points = np.empty((0, 2))  # in pixels, with the needle's ends
        self._searched = -math.inf  # time of the last frame that was searched as a whole for the thread

    def point_at_tip(self, place: Points, until: float = math.inf) -> None:
        """Take a point near the needle's tip, as a person gives it.

        It is kept until a needle is tracked whose direction nothing else tells, and of which an end is nearer to the
        point than a third of its length. Where none is as near it is lost, which the frame's warning says. From then on
        the direction is carried from frame to frame as long as the needle cannot have turned round unseen.

        Args:
            place: shape (2,) [m].
            until: time of the last frame that it is of [s], by the clock of the frames.
        """
        self._tip = np.array(place, dtype=float), until
        self._last, self._anew, self._is_pointed_at = None, [], False

    def look(self, image: np.ndarray) -> Track:
        """Look at one frame alone; what other frames showed doesn't matter.

        Args:
            image: shape (rows, columns) or (rows, columns, 3) in BGR order, uint8.

        Raises:
            InvalidInputError: the image is not of this kind.
        """
        alone = VisionTracker(replace(self._given, confirm_frames=1), self._scene)
        alone._lens, alone._mask, alone._tip = self._lens, self._mask, self._tip
        found = alone.track(image, 0.0)
        self._mask, self._tip = alone._mask, alone._tip
        return replace(found, state=State.TRACKED if found.state is State.TRACKED else State.LOST, needle_length=None)

    def track(self, image: np.ndarray, time_s: float, on_pose: PoseCallback | None = None) -> Track:
        """Look at the next frame.

        A needle near enough to where the last ones predict it is tracked at once. One found elsewhere
        is tracked only after `confirm_frames` frames in a row that agree. Time that goes back by more
        than a second begins anew.

        Args:
            image: shape (rows, columns) or (rows, columns, 3) in BGR order, uint8.
            time_s: when the frame was taken [s], on any clock.
            on_pose: called once the needle is found, before the thread is measured, which takes longer: with what is
                returned, but without thread, view and warning.

        Raises:
            InvalidInputError: the image is not of this kind, or the frame is not newer than the last one.
        """
        check_image(image)
        self._advance(time_s)
        if image.shape[:2] != self._shape:
            self._given.region_in(image.shape)
            self._shape = image.shape[:2]
            self._begin_anew()
        small, problem = shrunk(image, self._factor), None
        if self._lens is not None:
            problem = self._lens.problem_with(image.shape)
            small = self._lens.undistorted(small, self._factor) if problem is None else small
        left, top, right, bottom = self._region_px
        track = self._track(np.ascontiguousarray(small[top:bottom, left:right]), time_s, on_pose)
        dish, view = self._dish.found, track.view
        lens = f"{problem}; it is not used" if problem is not None else ""
        warning = "; ".join(filter(None, (dish.warning if dish is not None else "", lens, self._tip_loss)))
        self._tip_loss = ""
        track = replace(track, warning=warning, needle_length=self._length.length)
        if view is not None:
            u, v = view.centre_px
            view = replace(view, centre_px=(u + left, v + top)).shrunk(1.0 / self._factor)
        if dish is None:
            return replace(track, view=view)
        straight = dish.straightening()
        if straight is not None:
            straight = scaled_homography(scaled_homography(straight, 1.0, -left, -top), 1.0 / self._factor)
        error, dark_field = dish.scale_error, dish.dark_field
        return replace(track, view=view, scale_error=error, straightening=straight, dark_field=dark_field)

    def _track(self, image: np.ndarray, time_s: float, on_pose: PoseCallback | None) -> Track:
        """Look at the next frame, shrunk."""
        if self._before is not None and time_s - self._before.time > self._settings.forget_after:
            self._last, self._anew, self._is_pointed_at = None, [], False
        before = self._dish.view
        reason, image = self._dish.look(image)
        view = self._dish.view
        if reason or view is None:
            self._anew = []
            return Track(self._missing(), reason, view)
        if before is not None and view is not before:  # The camera was bumped: what was seen before lies elsewhere.
            self._last, self._anew = None, []
        needle, picture, whole, reason = self._choose(image, time_s)
        if needle is None or picture is None:
            return Track(self._missing(), reason, view)
        pose = self._pose_of(needle, picture.view)
        if on_pose is not None:
            on_pose(pose)
        line, observation = self._measured(picture, needle, search=whole)
        # To search all of a frame for a thread that seems cut takes a frame's time: every 0.25 s is enough.
        if not whole and time_s - self._searched >= 0.25 and self._is_cut(needle, line, observation, picture):
            whole, complete = True, self._picture(image)
            needle = needle.shifted(np.subtract(complete.view.centre_px, picture.view.centre_px))
            line, observation = self._measured(complete, needle, search=True)
        if whole:
            self._searched = time_s
        if needle.size_measured:
            self._length.add((needle.length_px - needle.tail_shift_px) * view.metres_per_pixel, needle.confidence)
        if needle.heading_known:
            self._thread = view.to_pixels(np.vstack([pose.tail, pose.tip, line]))
        return replace(pose, centreline=line, view=view, observation=observation)

    def _advance(self, time_s: float) -> None:
        """Take the time of the next frame."""
        if not math.isfinite(time_s):
            raise InvalidInputError("image.stamp", time_s, "a time [s]")
        if self._time is not None and time_s <= self._time:
            if time_s > self._time - 1.0:  # s; as a bag that was wound back
                raise InvalidInputError("image.stamp", f"{time_s:.6f} s", f"a time after {self._time:.6f} s")
            self.reset()
        self._time = time_s

    def _missing(self) -> State:
        return State.LOST if self._last is not None else State.SEARCHING

    def _found_dish(self) -> FoundDish:
        """Return the dish of a frame in which it was found."""
        assert self._dish.found is not None
        return self._dish.found

    def _picture(self, image: np.ndarray, box: tuple[int, int, int, int] | None = None) -> Picture:
        """Make a part of a prepared frame ready to measure on.

        Args:
            image: the frame.
            box: left, top, right, bottom [px]; None for all of the dish.
        """
        view, radius = self._found_dish().view, self._scene.dish.radius
        if box is None:
            reach = radius / view.metres_per_pixel + 32.0  # with what tells the floor's light at the wall
            box = region(image, np.subtract(view.centre_px, reach), np.add(view.centre_px, reach))
        left, top, right, bottom = box
        mask = self._mask_for(image, view)
        part = mask.part(left, top, right, bottom) if mask is not None else None
        local = replace(view, centre_px=(view.centre_px[0] - left, view.centre_px[1] - top))
        return prepare(image[top:bottom, left:right], local, radius, part, self._settings.needle_colour)

    def _mask_for(self, image: np.ndarray, view: DishView) -> SceneMask | None:
        """Return where the scene's shapes are, made anew where scene, view or the frame's size changed.

        The view is rounded, so that the noise of a dish found in every frame anew makes no new mask.
        """
        step = 0.5  # px; much less than the tolerance of outlines
        u, v = (round(value / step) * step for value in view.centre_px)
        radius = round(self._scene.dish.radius / view.metres_per_pixel / step) * step
        rounded = DishView((u, v), self._scene.dish.radius / radius, view.rotation)
        if self._mask[0] != (rounded, image.shape[:2]):
            mask = scene_mask(self._scene, rounded, image.shape[:2], self._settings.outline_tolerance)
            self._mask = ((rounded, image.shape[:2]), mask)
        return self._mask[1]

    def _choose(self, image: np.ndarray, time: float) -> tuple[MeasuredNeedle | None, Picture | None, bool, str]:
        """Return the needle, the picture it is in, whether that shows all of the dish, and why there is none."""
        view, last, settings = self._found_dish().view, self._last, self._settings
        scale, measured = view.metres_per_pixel, self._length.length
        length, tolerance = (settings.needle_length, SET_TOLERANCE) if measured is None else (measured, 0.02)
        size = NeedleSize(
            length / scale,
            settings.needle_width / scale,
            tolerance,
            settings.max_needle_brightness,
            settings.needle_is_blunt,
            settings.max_needle_bend,
        )
        for whole in (False, True) if last is not None else (True,):
            picture = self._picture(image, None if whole else self._region(image, view, time))
            toward = self._toward(view, time)
            prior = None if whole else self._prior(picture.view, size.length_px, time)
            needles, refused = find_needles(picture, size, toward, prior)
            needles = [self._proven(needle, picture) for needle in needles]
            poses = [_pose(needle, picture, time) for needle in needles]
            if toward is None and (pointed := self._pointed_at(needles, picture, time)) is not None:
                needles, _ = find_needles(picture, size, pointed.middle_direction_px)
                needles = [each for each in needles if math.dist(each.tip_px, pointed.tip_px) < 0.5 * each.length_px]
            elif toward is not None and whole and not any(self._fits(each, self._before) for each in poses):
                needles, refused = find_needles(picture, size, None)  # it is elsewhere, and may have turned round
                needles = [self._proven(needle, picture) for needle in needles]
            needles = [self._as_before(needle, picture, time) for needle in needles]
            within = [needle for needle in needles if self._fits(_pose(needle, picture, time), last)]
            if len(within) == 1 and not (whole and not within[0].heading_known):
                if within[0].heading_known or toward is not None:  # else its ends are in any order
                    self._take(_pose(within[0], picture, time), last)
                return within[0], picture, whole, ""
        if not needles:
            self._anew = []
            remedy = "check light, needle_length, needle_width, max_needle_brightness"
            others = f"; dark things: {', '.join(refused)}" if refused else ""
            return None, None, True, f"{NO_NEEDLE}; {remedy}{others}"
        chosen = within[0] if len(within) == 1 else self._with_thread(picture, needles)
        if chosen is not None and not chosen.heading_known:  # It neither confirms a direction nor speaks against it.
            return chosen, picture, True, ""
        if chosen is None:
            self._anew = []
            remedy = "point at the tip of one, or limit region_px"
            return None, None, True, f"{len(needles)} needles in the dish: {remedy}"
        pose = _pose(chosen, picture, time)
        if self._fits(pose, last):
            self._take(pose, last)
            return chosen, picture, True, ""
        if self._anew and not self._fits(pose, self._anew[-1]):
            self._anew = []
        self._anew.append(pose)
        if len(self._anew) >= settings.confirm_frames:
            self._take(pose, self._anew[-2] if len(self._anew) > 1 else None)
            return chosen, picture, True, ""
        if last is not None:
            return None, None, True, "a needle farther from the last one than it can move"
        return None, None, True, f"a needle seen in {len(self._anew)} of {settings.confirm_frames} frames"

    def _proven(self, needle: MeasuredNeedle, picture: Picture) -> MeasuredNeedle:
        """Return a needle without a direction that a line alone tells, unless the line is its thread, and all of it.

        A line that is drawn on the floor leaves an end as a thread does, but is not as long, with an end of its own.
        """
        if not needle.told_by_line:
            return needle
        _, observation = self._measured(picture, needle, search=False)
        return needle if observation.complete else needle.undirected()

    @property
    def _before(self) -> _Pose | None:
        """The last pose, or that which the next frames have to agree with; None without any."""
        return self._last or (self._anew[-1] if self._anew else None)

    def _toward(self, view: DishView, time: float) -> Points | None:
        """Return where the needle's middle must point, u right and v down; None where it may have turned unseen."""
        before = self._before
        if before is None or self._most_turned(time - before.time) > 0.5 * math.pi:
            return None
        if self._last is None and not self._is_pointed_at:  # Each frame that confirms a direction must tell it itself.
            return None
        angle = before.at(time)[1] - 0.5 * before.bend  # of the middle; the dish's y goes up
        return view.directions_to_pixels(np.array([math.cos(angle), math.sin(angle)]))

    def _pointed_at(self, needles: list[MeasuredNeedle], picture: Picture, time: float) -> MeasuredNeedle | None:
        """Return the needle that a person points at, with its tip there; see `point_at_tip`."""
        if self._tip is None or not needles:
            return None
        place, until = self._tip
        tip = picture.view.to_pixels(place)
        ways = [way for needle in needles if not needle.heading_known for way in (needle, needle.reversed())]
        # The other end is then twice as far or more.
        near = [way for way in ways if math.dist(way.tip_px, tip) < way.length_px / 3.0]
        if near and time <= until:
            self._is_pointed_at = True
            return min(near, key=lambda way: math.dist(way.tip_px, tip))
        if ways or time > until:
            self._tip, self._tip_loss = None, TIP_LOST
        return None

    def _with_thread(self, picture: Picture, needles: list[MeasuredNeedle]) -> MeasuredNeedle | None:
        """Return the only needle that a thread leaves, of those that were found; one that is alone needs no thread."""
        if len(needles) == 1:
            return needles[0]
        least = 0.04 * self._settings.thread_length / picture.view.metres_per_pixel
        lines = [self._centreline(picture, without_needle(picture.darkest, needle), needle) for needle in needles]
        having = [needle for needle, line in zip(needles, lines, strict=True) if arc_lengths(line)[-1] >= least]
        return having[0] if len(having) == 1 else None

    def _centreline(self, picture: Picture, gray: np.ndarray, needle: MeasuredNeedle) -> Points:
        """Return the thread's centreline from a needle's tail on, shape (m, 2) [px]; m = 1 if none is visible.

        `gray` is the darkest colour without the needle.
        """
        if not needle.heading_known:
            return needle.tail_px[None]
        length = self._settings.thread_length / picture.view.metres_per_pixel
        return find_centreline(picture, gray, needle, 1.05 * length)  # beyond which a walk is of something else

    def _pose_of(self, needle: MeasuredNeedle, view: DishView) -> Track:
        """Return what a needle tells, without the thread.

        Args:
            needle: in the pixels of a picture.
            view: of that picture.
        """
        dish, radius = self._found_dish(), self._scene.dish.radius
        heading, tail = view.directions_to_dish(needle.direction_px), view.to_dish(needle.tail_edge_px)
        return Track(
            state=State.TRACKED if needle.heading_known else self._missing(),
            reason="" if needle.heading_known else UNDIRECTED,
            confidence=needle.confidence,
            tail=tail,
            tip=view.to_dish(needle.tip_px),
            heading=heading,
            curvature=-needle.arc.curvature / view.metres_per_pixel,
            covariance=_in_dish(needle, view) + dish.covariance(tail, heading, radius),
        )

    def _measured(self, picture: Picture, needle: MeasuredNeedle, *, search: bool) -> tuple[Points, ThreadObservation]:
        """Return the thread's centreline from the tail on, shape (m, 2) [m], and what a picture shows of the thread.

        Args:
            picture: the frame or a part of it.
            needle: in its pixels.
            search: whether to look for pieces of the thread that the centreline does not show; see `observe`.
        """
        dish = self._found_dish()
        gray = without_needle(picture.darkest, needle)
        line = self._centreline(picture, gray, needle)
        scale_known = self._settings.metres_per_pixel > 0.0
        length = self._settings.thread_length
        observation = observe(picture, smoothed(gray), needle, line, length, scale_known=scale_known, search=search)
        if dish.tilt is not None:  # What a straight camera's view leaves unknown moves all points alike.
            pieces = tuple(_less_sure(piece, dish, self._scene.dish.radius) for piece in observation.pieces)
            observation = replace(observation, pieces=pieces)
        return picture.view.to_dish(line), observation

    def _is_cut(
        self, needle: MeasuredNeedle, centreline: Points, observation: ThreadObservation, picture: Picture
    ) -> bool:
        """Say whether the thread may go on beyond the part of the frame that was looked at."""
        if not needle.heading_known:
            return False
        if not observation.complete:
            return True
        line = picture.view.to_pixels(centreline)
        if arc_lengths(line)[-1] < 0.9 * arc_lengths(self._thread[2:])[-1]:  # of the thread before
            return True
        (u, v), (rows, columns) = line[-1], picture.shape
        return bool(min(u, v, columns - 1 - u, rows - 1 - v) < 20.0)  # px from its border

    def _as_before(self, needle: MeasuredNeedle, picture: Picture, time: float) -> MeasuredNeedle:
        """Return a needle the other way round if it lies where the last one was, and its shape does not rule that out.

        Between two frames it cannot turn round, and a thread that touches the tip makes that look like a tail. But
        where no frame has been clear yet, the first ones may be those that were wrong.
        """
        if self._last is None or not self._last.direction_is_clear:
            return needle
        if needle.direction_is_clear or not needle.heading_known:
            return needle
        other = needle.reversed()
        fits = [self._fits(_pose(each, picture, time), self._last) for each in (needle, other)]
        return other if fits == [False, True] else needle

    def _fits(self, pose: _Pose, last: _Pose | None) -> bool:
        """Say whether a needle can have come from where it was last."""
        if last is None:
            return False
        after = pose.time - last.time
        tail, angle = last.at(pose.time)
        turn = abs(math.remainder(pose.angle - angle, math.tau))
        return math.dist(pose.tail, tail) < self._reach(after) and turn < min(self._most_turned(after), 0.5 * math.pi)

    def _reach(self, after: float) -> float:
        """Return how far a needle can have moved off the prediction after a time, with 3 px of error [m]."""
        return self._settings.max_needle_speed * after + 3.0 * self._found_dish().view.metres_per_pixel

    def _prior(self, view: DishView, length: float, time: float) -> Prior:
        """Return where a needle of a length [px] that fits the last pose has its axis."""
        assert self._last is not None
        after = time - self._last.time
        tail, angle = self._last.at(time)
        ahead = view.directions_to_pixels(np.array([math.cos(angle), math.sin(angle)]))
        axis = Arc(view.to_pixels(tail), math.atan2(ahead[1], ahead[0]), self._last.bend / length)
        turn = self._most_turned(after)
        reach = self._reach(after) / view.metres_per_pixel + length * math.sin(0.5 * min(turn, 0.5 * math.pi))
        return Prior(axis.point(0.5 * length), reach, axis.angle + 0.5 * self._last.bend, turn)

    def _most_turned(self, after: float) -> float:
        """Return by how much a needle can have turned off the prediction after a time, 6 degrees of error too [rad]."""
        return self._settings.max_turn_rate * after + math.radians(6.0)

    def _take(self, pose: _Pose, before: _Pose | None) -> None:
        """Keep a pose, with the velocity that the one before gives it, no greater than a needle's can be.

        Between frames a moment apart, noise alone looks like any speed.
        """
        velocity, turn_rate, newest = np.zeros(2), 0.0, 0.5  # weight of the newest velocity
        if before is not None:
            after = pose.time - before.time
            velocity = before.velocity + newest * ((pose.tail - before.tail) / after - before.velocity)
            turned = math.remainder(pose.angle - before.angle, math.tau)
            turn_rate = before.turn_rate + newest * (turned / after - before.turn_rate)
            velocity *= min(1.0, self._settings.max_needle_speed / max(float(np.hypot(*velocity)), 1e-12))
            turn_rate = max(-self._settings.max_turn_rate, min(self._settings.max_turn_rate, turn_rate))
        direction_is_clear = pose.direction_is_clear or (before is not None and before.direction_is_clear)
        self._tip = None
        self._last = _Pose(pose.time, pose.tail, pose.angle, velocity, turn_rate, direction_is_clear, pose.bend)
        self._anew, self._is_pointed_at = [], False

    def _region(self, image: np.ndarray, view: DishView, time: float) -> tuple[int, int, int, int]:
        """Return the box in which needle and thread should be: left, top, right, bottom [px]."""
        assert self._last is not None
        moved = self._last.at(time)[0] - self._last.tail
        reach = 32.0 + self._settings.max_needle_speed * (time - self._last.time) / view.metres_per_pixel
        corners = np.vstack([self._thread, self._thread[:2] + view.directions_to_pixels(moved / view.metres_per_pixel)])
        return region(image, corners.min(axis=0) - reach, corners.max(axis=0) + reach)


def _less_sure(piece: ThreadPiece, dish: FoundDish, radius: float) -> ThreadPiece:
    """Return a piece with what a tilt leaves unknown of where it is, as far out as it reaches."""
    farthest = piece.points[np.argmax(np.hypot(*piece.points.T))]
    unknown = dish.tilt_covariance(farthest, np.array([1.0, 0.0]), radius)[:2, :2]
    return replace(piece, deviation=np.sqrt(piece.deviation**2 + np.linalg.eigvalsh(unknown)[-1]))


def region(image: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[int, int, int, int]:
    """Return the box of whole cells of the floor's grid around two corners: left, top, right, bottom [px]."""
    corners = list[tuple[int, int]]()
    for begin, end, size in zip(low.tolist(), high.tolist(), image.shape[1::-1], strict=True):
        first = CELL_PX * min(max(int(begin // CELL_PX), 0), size // CELL_PX - 1)
        corners.append((first, min(max(CELL_PX * (int(end // CELL_PX) + 1), first + CELL_PX), size)))
    (left, right), (top, bottom) = corners
    return left, top, right, bottom


def _pose(needle: MeasuredNeedle, picture: Picture, time: float) -> _Pose:
    heading = picture.view.directions_to_dish(needle.direction_px)
    tail, bend = picture.view.to_dish(needle.tail_edge_px), needle.arc.curvature * needle.length_px
    return _Pose(time, tail, math.atan2(heading[1], heading[0]), np.zeros(2), 0.0, needle.direction_is_clear, bend)


class RepetitionDetector:
    """Finds frames that came before.

    No sensor gives the same noise twice: a frame that is equal, bit for bit, to one of the last 100 is not of this
    moment. Frames are compared by the hash of a sample of their pixels.
    """

    def __init__(self) -> None:
        self._seen: deque[tuple[float, int]] = deque(maxlen=100)

    def is_repeated(self, time_s: float, image: np.ndarray) -> bool:
        """Return whether a frame, taken at a time [s], was there before that time, and keep it."""
        # About 64 rows are compared, and as dense columns: what moves in a dish covers several.
        step = max(1, min(image.shape[:2]) // 64)
        sample = hash(image[::step, ::step].tobytes())
        # A bag that was wound back gives its frames again, at the same times.
        repeated = any(sample == other and before < time_s for before, other in self._seen)
        self._seen.append((time_s, sample))
        return repeated


@dataclass(frozen=True)
class FrameMeasurement:
    """What is told of one frame.

    Attributes:
        track: what was seen.
        centreline: of the thread, equally spaced from the needle's tail on, shape (64, 2) [m]; shape (0, 2) where
            there is none to tell.
        problem: why the frame was refused, if it was.
    """

    track: Track
    centreline: Points
    problem: InvalidInputError | None = None

    @property
    def tracked(self) -> bool:
        """Whether there is a pose to tell."""
        return self.track.state is State.TRACKED


class TrackerSession:
    """Tracks needle and thread over one run.

    The node `vision_tracker` and the replay without a graph are both a shell around this, so that the same
    frames give the same poses to the last bit.

    Args:
        settings: what to look for.
        scene: the dish, and the shapes in which neither needle nor thread can be.

    Attributes:
        frames: that came.
        tracked: those with a pose.
    """

    def __init__(self, settings: VisionTrackerSettings, scene: Scene) -> None:
        self._tracker, self._tip_age = VisionTracker(settings, scene), settings.forget_after
        self._repetition = RepetitionDetector()
        self.frames = self.tracked = 0

    @property
    def missing(self) -> State:
        """What to say of a frame that shows nothing: lost, or searching if there never was a needle."""
        return State.LOST if self.tracked else State.SEARCHING

    def set_scene(self, scene: Scene) -> None:
        """Take another scene; see `VisionTracker.set_scene`."""
        self._tracker.set_scene(scene)

    def point_at_tip(self, place: Points, taken: float) -> None:
        """Take a point near the needle's tip as of a time [s]; see `VisionTracker.point_at_tip`."""
        self._tracker.point_at_tip(place, taken + self._tip_age)

    def set_lens(self, lens: Lens | None) -> None:
        """Take the camera's lens; see `VisionTracker.set_lens`."""
        self._tracker.set_lens(lens)

    def on_image(self, time_s: float, image: np.ndarray, on_pose: PoseCallback | None = None) -> FrameMeasurement:
        """Look at the next frame, taken at a time [s]; see `VisionTracker.track`. One that came before has no pose."""
        try:
            check_image(image)
            repeated = self._repetition.is_repeated(time_s, image)
            track = self._tracker.track(image, time_s, None if repeated else on_pose)
        except InvalidInputError as error:
            return self.on_broken(error)
        if repeated and len(track.tail):
            track = Track(self.missing, REPEATED, track.view)
        self.frames += 1
        self.tracked += track.state is State.TRACKED
        return FrameMeasurement(track, published_centreline(track))

    def on_broken(self, problem: InvalidInputError) -> FrameMeasurement:
        """Count a frame that cannot be looked at, and say why."""
        self.frames += 1
        return FrameMeasurement(Track(self.missing, str(problem)), np.empty((0, 2)), problem)


def published_centreline(track: Track) -> Points:
    """Return what is told of a centreline: 64 vertices equally spaced, or none, shape (m, 2) [m]."""
    if len(track.centreline) < 2:
        return np.empty((0, 2))
    # Each is a whole pose in the message.
    return points_at(track.centreline, np.linspace(0.0, arc_lengths(track.centreline)[-1], 64))


def warm_up() -> bool:
    """Look at a drawn dish, needle and thread, and run what only other frames need.

    Where nothing is compiled yet this takes a minute, and no frame compiles anything later. From now on OpenCV stays on
    one thread in this process: at these sizes it costs more to wake others.

    Returns:
        Whether the drawn needle was found, as it must be.
    """
    cv2.setNumThreads(1)
    image = np.full((480, 640), 170, np.uint8)
    cv2.circle(image, (320, 240), 222, 60, 5, cv2.LINE_AA)
    cv2.circle(image, (320, 240), 218, 225, -1, cv2.LINE_AA)
    cv2.polylines(image, [np.array([[300, 240], [200, 240], [120, 280]])], False, 140, 1, cv2.LINE_AA)
    outline = [(300.0, 237.5), (370.0, 237.5), (387.5, 240.0), (370.0, 242.5), (300.0, 242.5)]
    cv2.fillPoly(image, [np.round(np.array(outline) * 16).astype(np.int32)], 45, cv2.LINE_AA, 4)
    image = cv2.GaussianBlur(image, (0, 0), 0.9)
    # What a plain frame does not reach: a needle in one dark thing with its thread, crossings, and other pieces.
    sampled(np.zeros((4, 4), np.float32), np.zeros((1, 2)))
    path, nothing = np.zeros((8, 7)), np.zeros((16, 16), np.uint8)
    walk_on(Ridge(nothing, nothing, 1.0, 1.0, (8.0, 8.0, 8.0)), 4.0, path, 1)
    worth(path, 1)
    return not VisionTracker(VisionTrackerSettings(), Scene()).look(image).reason
