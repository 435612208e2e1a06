"""Follows the needle over time: what fits its motion is taken, all else is refused."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.scene.scene import Scene
from magnetosuture_thread.vision.dish.watch import DishWatch, FoundDish
from magnetosuture_thread.vision.images import FLOOR_FACTOR, Picture, check_image, shrunk
from magnetosuture_thread.vision.lens import Lens
from magnetosuture_thread.vision.look import FrameReader, State, Track, look_once, mask_of, no_pose, why_none
from magnetosuture_thread.vision.needle.arc import LengthEstimator, MeasuredNeedle
from magnetosuture_thread.vision.scene_mask import SceneMask
from magnetosuture_thread.vision.settings import VisionTrackerSettings

JUMP_BACK = 1.0  # s; time that goes back by more begins anew, as a bag that was wound back
GATE_PX, GATE_ANGLE = 3.0, math.radians(6.0)  # off the prediction, beside what the needle's greatest speed allows
MAX_PREDICTION = 0.2  # s; a motion is not extrapolated farther
SMOOTHING = 0.5  # weight of the newest velocity
MARGIN_PX, BORDER_PX = 32.0, 20.0  # around needle and thread, that is looked at; from its border, where one may go on
VIEW_STEP_PX = 0.5  # to which the view is rounded for a mask, much less than the tolerance of outlines
MIN_SHARE = 0.9  # of the thread before; if less is visible in the region, the whole frame is looked at


@dataclass(frozen=True)
class _Pose:
    """A needle that was seen, in the dish frame; its direction is clear if it was in one frame of those so far."""

    time: float
    tail: np.ndarray
    angle: float
    velocity: np.ndarray
    turn_rate: float
    direction_is_clear: bool

    def at(self, time: float) -> tuple[np.ndarray, float]:
        """Return tail and heading angle predicted with constant velocity."""
        after = min(time - self.time, MAX_PREDICTION)
        return self.tail + after * self.velocity, self.angle + after * self.turn_rate


class VisionTracker:
    """Tracks the needle and the thread.

    Args:
        settings: what to look for.
        scene: the dish, and the shapes in which neither needle nor thread can be.
    """

    def __init__(self, settings: VisionTrackerSettings, scene: Scene) -> None:
        self._given = settings
        self._factor = 1  # by which frames are shrunk
        self._settings = settings  # in shrunk frames
        self._scene = scene
        self._dish = DishWatch(settings, scene.dish.diameter)
        self._lens: Lens | None = None
        self._masks: dict[tuple[DishView, tuple[int, ...]], SceneMask | None] = {}
        self._shape: tuple[int, ...] = ()
        self.reset()

    @property
    def dish(self) -> FoundDish | None:
        """What was found of the dish over time, in pixels of shrunk frames; None if nothing was."""
        return self._dish.found

    def set_scene(self, scene: Scene) -> None:
        """Take another scene. The needle is still tracked, unless the dish has another size."""
        other_dish = scene.dish.diameter != self._scene.dish.diameter
        self._scene = scene
        self._masks.clear()
        if other_dish:
            self._rescale()

    def set_lens(self, lens: Lens | None) -> None:
        """Take the camera's lens, whose distortion is undone in every frame of its size; None if it is not known.

        The view is in the pixels of the frame without distortion. Another lens begins anew.
        """
        if lens is self._lens or (lens is not None and lens.same_as(self._lens)):
            return
        straight = all(each is None or each.is_straight for each in (lens, self._lens))
        self._lens = lens
        if not straight:
            self._masks.clear()
            self._rescale()

    def _straight(self, image: np.ndarray, factor: int) -> np.ndarray:
        """Return a frame shrunk, and without the lens's distortion."""
        small = shrunk(image, factor)
        if self._lens is None or self._lens.problem_with(image.shape) is not None:
            return small
        return self._lens.undistorted(small, factor)

    def _with_doubt(self, track: Track, image: np.ndarray) -> Track:
        """Return a track with a warning if the lens is not that of the frame."""
        problem = self._lens.problem_with(image.shape) if self._lens is not None else None
        if problem is None:
            return track
        return replace(track, warning="; ".join(filter(None, (track.warning, f"{problem}; it is not used"))))

    def _rescale(self) -> None:
        """Choose the size that frames are looked at in, and begin anew."""
        diameter = self._scene.dish.diameter
        self._factor = self._given.working_factor(self._shape, diameter) if self._shape else 1
        self._settings = self._given.shrunk(self._factor)
        self._dish = DishWatch(self._settings, diameter)
        self._length = LengthEstimator()
        self._forget()

    def reset(self) -> None:
        """Forget the needle and the dish."""
        self._time: float | None = None
        self._length = LengthEstimator()
        self._forget()

    def _forget(self) -> None:
        """Forget what was seen, not the time of the last frame."""
        self._dish.forget()
        self._last: _Pose | None = None
        self._anew: list[_Pose] = []
        self._thread: np.ndarray = np.empty((0, 2))  # in pixels, with the needle's ends

    def look(self, image: np.ndarray) -> Track:
        """Look at one frame alone; what other frames showed doesn't matter.

        Args:
            image: shape (rows, columns) or (rows, columns, 3) in BGR order, uint8.

        Raises:
            InvalidInputError: the image is not of this kind.
        """
        check_image(image)
        factor = self._given.working_factor(image.shape, self._scene.dish.diameter)
        small, settings = self._straight(image, factor), self._given.shrunk(factor)
        found = look_once(small, settings, self._scene, lambda view: self._mask_for(small, view))
        return self._with_doubt(_enlarged(found, factor), image)

    def track(self, image: np.ndarray, time_s: float) -> Track:
        """Look at the next frame.

        A needle near enough to where the last ones predict it is tracked at once. One found elsewhere
        is tracked only after `confirm_frames` frames in a row that agree. Time that goes back by more
        than a second begins anew.

        Args:
            image: shape (rows, columns) or (rows, columns, 3) in BGR order, uint8.
            time_s: when the frame was taken [s], on any clock.

        Raises:
            InvalidInputError: the image is not of this kind, or the frame is not newer than the last one.
        """
        check_image(image)
        self._advance(time_s)
        if image.shape[:2] != self._shape:
            self._shape = image.shape[:2]
            self._rescale()
        found = self._track(self._straight(image, self._factor), time_s)
        found = self._with_doubt(_enlarged(found, self._factor), image)
        return replace(found, needle_length=self._length.length)

    def _track(self, image: np.ndarray, time_s: float) -> Track:
        """Look at the next frame, shrunk."""
        if self._last is not None and time_s - self._last.time > self._settings.forget_after:
            self._last = None
        before = self._dish.view
        reason, image = self._dish.look(image)
        view = self._dish.view
        if reason or view is None:
            self._anew = []
            return no_pose(self._missing(), reason, view)
        if before is not None and view is not before:  # The camera was bumped: what was seen before lies elsewhere.
            self._last, self._anew = None, []
        assert self._dish.found is not None
        mask = self._mask_for(image, view)
        reader = FrameReader(self._settings, self._dish.found, self._scene.dish.radius, mask)
        chosen, picture, reason = self._choose(image, reader, time_s)
        if chosen is None or picture is None:
            return no_pose(self._missing(), reason, view)
        whole = picture.shape == image.shape[:2]
        found = self._read(reader, picture, chosen, search=whole)
        if not whole and self._is_cut(found, picture):
            chosen, picture = chosen.shifted(picture.origin), reader.picture(image)
            found = self._read(reader, picture, chosen, search=True)
        if not chosen.heading_known:
            return found
        if chosen.size_measured:
            length = chosen.length_px - chosen.tail_shift_px
            self._length.add(length * view.metres_per_pixel, chosen.confidence)
        ends = np.array([found.tail, found.tip])
        self._thread = view.to_pixels(np.vstack([ends, found.centreline]))
        return found

    def _read(self, reader: FrameReader, picture: Picture, needle: MeasuredNeedle, *, search: bool) -> Track:
        """Return what a frame shows whose needle is known."""
        return reader.track(picture, needle, reader.centreline(picture, needle), self._missing(), search=search)

    def _mask_for(self, image: np.ndarray, view: DishView) -> SceneMask | None:
        """Return where the scene's shapes are, made anew where scene, view or the frame's size changed.

        The view is rounded, so that the noise of a dish found in every frame anew makes no new mask.
        """
        u, v = (round(value / VIEW_STEP_PX) * VIEW_STEP_PX for value in view.centre_px)
        radius = round(self._scene.dish.radius / view.metres_per_pixel / VIEW_STEP_PX) * VIEW_STEP_PX
        rounded = DishView((u, v), self._scene.dish.radius / radius, view.rotation)
        key = (rounded, image.shape[:2])
        if key not in self._masks:
            if len(self._masks) >= 8:
                self._masks.clear()
            self._masks[key] = mask_of(image.shape, rounded, self._settings, self._scene)
        return self._masks[key]

    def _advance(self, time_s: float) -> None:
        """Take the time of the next frame."""
        if not math.isfinite(time_s):
            raise InvalidInputError("image.stamp", time_s, "a time [s]")
        if self._time is not None and time_s <= self._time:
            if time_s > self._time - JUMP_BACK:
                raise InvalidInputError("image.stamp", f"{time_s:.6f} s", f"a time after {self._time:.6f} s")
            self.reset()
        self._time = time_s

    def _is_cut(self, found: Track, picture: Picture) -> bool:
        """Say whether the thread may go on beyond the part of the frame that was looked at."""
        assert found.view is not None
        if found.reason:
            return False
        if not found.observation.complete:
            return True
        line = found.view.to_pixels(found.centreline)
        if _length(line) < MIN_SHARE * _length(self._thread[2:]):
            return True
        u, v = line[-1] - picture.origin
        rows, columns = picture.shape
        return bool(min(u, v, columns - 1 - u, rows - 1 - v) < BORDER_PX)

    def _missing(self) -> State:
        return State.LOST if self._last is not None else State.SEARCHING

    def _choose(
        self, image: np.ndarray, reader: FrameReader, time: float
    ) -> tuple[MeasuredNeedle | None, Picture | None, str]:
        """Return the needle of this frame and the picture it is in, or why there is none."""
        view, last = reader.dish.view, self._last
        if last is not None:
            _, angle = last.at(time)
            toward = view.directions_to_pixels(np.array([math.cos(angle), math.sin(angle)]))
            picture = reader.picture(image, self._region(image, view, time))
            needles, _ = reader.needles(picture, self._length, toward)
            needles = [self._as_before(needle, picture, view, time) for needle in needles]
            within = [needle for needle in needles if self._fits(_pose(needle, picture, view, time), last)]
            if len(within) == 1:
                self._take(_pose(within[0], picture, view, time), last)
                return within[0], picture, ""
        picture = reader.picture(image)
        needles, refused = reader.needles(picture, self._length)
        needles = [self._as_before(needle, picture, view, time) for needle in needles]
        within = [needle for needle in needles if self._fits(_pose(needle, picture, view, time), last)]
        if not needles:
            self._anew = []
            return None, None, why_none(refused)
        chosen, _, reason = (within[0], None, "") if len(within) == 1 else reader.with_thread(picture, needles)
        if chosen is None or not chosen.heading_known:
            self._anew = []
            return chosen, picture, reason
        pose = _pose(chosen, picture, view, time)
        if self._fits(pose, last):
            self._take(pose, last)
            return chosen, picture, ""
        if self._anew and not self._fits(pose, self._anew[-1]):
            self._anew = []
        self._anew.append(pose)
        if len(self._anew) >= self._settings.confirm_frames:
            self._take(pose, self._anew[-2] if len(self._anew) > 1 else None)
            return chosen, picture, ""
        if last is not None:
            return None, None, "a needle farther from the last one than it can move"
        return None, None, f"a needle seen in {len(self._anew)} of {self._settings.confirm_frames} frames"

    def _as_before(self, needle: MeasuredNeedle, picture: Picture, view: DishView, time: float) -> MeasuredNeedle:
        """Return a needle the other way round if it lies where the last one was, and its shape does not rule that out.

        Between two frames it cannot turn round, and a thread that touches the tip makes that look like a tail. But
        where no frame has been clear yet, the first ones may be those that were wrong.
        """
        if self._last is None or not self._last.direction_is_clear:
            return needle
        if needle.direction_is_clear or not needle.heading_known:
            return needle
        other = needle.reversed()
        fits = [self._fits(_pose(each, picture, view, time), self._last) for each in (needle, other)]
        return other if fits == [False, True] else needle

    def _fits(self, pose: _Pose, last: _Pose | None) -> bool:
        """Say whether a needle can have come from where it was last."""
        if last is None:
            return False
        after = pose.time - last.time
        tail, angle = last.at(pose.time)
        assert self._dish.view is not None
        reach = self._settings.max_needle_speed * after + GATE_PX * self._dish.view.metres_per_pixel
        turn = abs((pose.angle - angle + math.pi) % (2.0 * math.pi) - math.pi)
        max_shift = min(self._settings.max_turn_rate * after + GATE_ANGLE, 0.5 * math.pi)
        return math.dist(pose.tail, tail) < reach and turn < max_shift

    def _take(self, pose: _Pose, before: _Pose | None) -> None:
        """Keep a pose, with the velocity that the one before gives it, no greater than a needle's can be.

        Between frames a moment apart, noise alone looks like any speed.
        """
        velocity, turn_rate = np.zeros(2), 0.0
        if before is not None:
            after = pose.time - before.time
            velocity = before.velocity + SMOOTHING * ((pose.tail - before.tail) / after - before.velocity)
            turned = (pose.angle - before.angle + math.pi) % (2.0 * math.pi) - math.pi
            turn_rate = before.turn_rate + SMOOTHING * (turned / after - before.turn_rate)
            velocity *= min(1.0, self._settings.max_needle_speed / max(float(np.hypot(*velocity)), 1e-12))
            turn_rate = max(-self._settings.max_turn_rate, min(self._settings.max_turn_rate, turn_rate))
        direction_is_clear = pose.direction_is_clear or (before is not None and before.direction_is_clear)
        self._last = _Pose(pose.time, pose.tail, pose.angle, velocity, turn_rate, direction_is_clear)
        self._anew = []

    def _region(self, image: np.ndarray, view: DishView, time: float) -> tuple[int, int, int, int]:
        """Return the box in which needle and thread should be: left, top, right, bottom [px]."""
        assert self._last is not None
        moved = self._last.at(time)[0] - self._last.tail
        reach = MARGIN_PX + self._settings.max_needle_speed * (time - self._last.time) / view.metres_per_pixel
        corners = np.vstack([self._thread, self._thread[:2] + view.directions_to_pixels(moved / view.metres_per_pixel)])
        low, high = corners.min(axis=0) - reach, corners.max(axis=0) + reach
        left, top = (max(0, int(value) // FLOOR_FACTOR * FLOOR_FACTOR) for value in low)
        right = min(image.shape[1], (int(high[0]) // FLOOR_FACTOR + 1) * FLOOR_FACTOR)
        bottom = min(image.shape[0], (int(high[1]) // FLOOR_FACTOR + 1) * FLOOR_FACTOR)
        return left, top, right, bottom


def _enlarged(track: Track, factor: int) -> Track:
    """Return a track whose view is that of the frame before it was shrunk."""
    if track.view is None or factor == 1:
        return track
    return replace(track, view=track.view.shrunk(1.0 / factor))


def _pose(needle: MeasuredNeedle, picture: Picture, view: DishView, time: float) -> _Pose:
    heading = view.directions_to_dish(needle.direction_px)
    tail = view.to_dish(needle.tail_edge_px + picture.origin)
    return _Pose(time, tail, math.atan2(heading[1], heading[0]), np.zeros(2), 0.0, needle.direction_is_clear)


def _length(points: np.ndarray) -> float:
    return float(np.hypot(*np.diff(points, axis=0).T).sum()) if len(points) > 1 else 0.0
