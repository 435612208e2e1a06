"""Tracks the needle and the thread over time: a needle that fits the motion is accepted, all else is refused."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.polyline import Points, arc_lengths, points_at
from magnetosuture_thread.scene.scene import Scene
from magnetosuture_thread.vision.dish import DishTracker, find_view, rim_shift
from magnetosuture_thread.vision.frame import (
    Frame,
    State,
    Track,
    explain_refusals,
    no_pose,
)
from magnetosuture_thread.vision.images import FLOOR_FACTOR, Picture, check_image, measured_channel
from magnetosuture_thread.vision.needle.body import MeasuredNeedle
from magnetosuture_thread.vision.needle.find import search_factor
from magnetosuture_thread.vision.scene_mask import SceneMask, make_scene_mask
from magnetosuture_thread.vision.settings import VisionTrackerSettings

JUMP_BACK = 1.0  # s; time that goes back by more begins anew, as a bag that was wound back
GATE_PX = 3.0  # that a needle may be off its prediction, beside what its greatest speed allows
GATE_ANGLE = math.radians(6.0)
MAX_PREDICTION = 0.2  # s; a motion is not extrapolated farther
SMOOTHING = 0.5  # weight of the newest velocity
MARGIN_PX = 32.0  # around the needle and the thread, that is looked at
BORDER_PX = 20.0  # a thread that ends so near to the region's border may go on
VIEW_STEP_PX = 0.5  # to which the view is rounded for a mask, much less than the tolerance of outlines
MASKS = 8  # kept
CENTRELINE_POINTS = 64  # of the published centreline; each is a whole pose in the message
MIN_SHARE = 0.9  # of the thread seen before; if less is seen in the region, the whole frame is looked at


@dataclass(frozen=True)
class _Pose:
    """A measured needle in the dish frame."""

    time: float
    tail: np.ndarray
    angle: float
    velocity: np.ndarray
    turn_rate: float

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
        self._settings = settings
        self._scene = scene
        self._dish = DishTracker(settings, scene.dish.diameter)
        self._masks: dict[tuple[DishView, tuple[int, ...]], SceneMask | None] = {}
        self._shape: tuple[int, ...] = ()
        self.reset()

    def set_scene(self, scene: Scene) -> None:
        """Replace the scene. The needle is still tracked, unless the dish has another size."""
        other_dish = scene.dish.diameter != self._scene.dish.diameter
        self._scene = scene
        self._masks.clear()
        if other_dish:
            self._dish = DishTracker(self._settings, scene.dish.diameter)
            self._forget()

    def reset(self) -> None:
        """Forget the needle and the dish."""
        self._time: float | None = None
        self._forget()

    def _forget(self) -> None:
        """Forget what was seen, not the time of the last frame."""
        self._dish.reset()
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
        gray = measured_channel(image)
        view = find_view(gray, self._settings, self._scene.dish.diameter)
        if view is None:
            return no_pose(State.LOST, "no dish in the image", None)
        frame = self._frame(gray, view)
        picture = frame.picture()
        needles, refused = frame.needles(picture)
        if len(needles) != 1:
            return no_pose(State.LOST, explain_refusals(len(needles), refused), view)
        return frame.track(picture, needles[0])

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
        gray = measured_channel(image)
        if gray.shape != self._shape:
            self.reset()
            self._shape, self._time = gray.shape, time_s
        if self._last is not None and time_s - self._last.time > self._settings.forget_after:
            self._last = None
        before = self._dish.view
        reason = self._dish.update(gray)
        view = self._dish.view
        if reason or view is None:
            self._anew = []
            return no_pose(self._missing(), reason, view)
        if before is not None and view is not before:  # The camera was bumped: what was seen before lies elsewhere.
            self._last, self._anew = None, []
        frame = self._frame(gray, view)
        chosen, picture, reason = self._choose(frame, time_s)
        if chosen is None or picture is None:
            return no_pose(self._missing(), reason, view)
        found = frame.track(picture, chosen)
        if picture.gray.shape != gray.shape and self._is_cut(found, picture):
            found = frame.track(frame.picture(), chosen.shifted(picture.origin))
        ends = np.array([found.tail, found.tip])
        self._thread = view.to_pixels(np.vstack([ends, found.centreline]))
        return found

    def _frame(self, gray: np.ndarray, view: DishView) -> Frame:
        """Return a frame, with the scene's mask made anew where scene, view or the frame's size changed.

        The mask's view is rounded, so that the noise of a dish found in every frame anew makes no new mask.
        """
        u, v = (round(value / VIEW_STEP_PX) * VIEW_STEP_PX for value in view.centre_px)
        settings, dish = self._settings, self._scene.dish
        radius = round(dish.radius / view.metres_per_pixel / VIEW_STEP_PX) * VIEW_STEP_PX
        rounded = DishView((u, v), dish.radius / radius, view.rotation)
        key = (rounded, gray.shape)
        if key not in self._masks:
            if len(self._masks) >= MASKS:
                self._masks.clear()
            factor = search_factor(settings.needle_width / rounded.metres_per_pixel)
            tolerance = settings.outline_tolerance
            self._masks[key] = make_scene_mask(self._scene, rounded, gray.shape, factor, tolerance, FLOOR_FACTOR)
        return Frame(gray, view, settings, 0.5 * dish.diameter, self._masks[key])

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
        """Return whether the thread may go on beyond the part of the frame that was looked at."""
        assert found.view is not None
        line = found.view.to_pixels(found.centreline)
        if _length(line) < MIN_SHARE * _length(self._thread[2:]):
            return True
        u, v = line[-1] - picture.origin
        rows, columns = picture.gray.shape
        return bool(min(u, v, columns - 1 - u, rows - 1 - v) < BORDER_PX)

    def _missing(self) -> State:
        return State.LOST if self._last is not None else State.SEARCHING

    def _choose(self, frame: Frame, time: float) -> tuple[MeasuredNeedle | None, Picture | None, str]:
        """Return the needle of this frame and the picture it is in, or why there is none."""
        view = frame.view
        if self._last is not None:
            _, angle = self._last.at(time)
            picture = frame.picture(self._region(frame, time))
            needles, _ = frame.needles(picture, view.directions_to_pixels(np.array([math.cos(angle), math.sin(angle)])))
            near = [needle for needle in needles if self._fits(_pose(needle, picture, view, time), self._last)]
            if len(near) == 1:
                self._accept(_pose(near[0], picture, view, time), self._last)
                return near[0], picture, ""
        picture = frame.picture()
        needles, refused = frame.needles(picture)
        if self._last is not None and len(needles) > 1:
            near = [needle for needle in needles if self._fits(_pose(needle, picture, view, time), self._last)]
            needles = near if len(near) == 1 else needles
        if len(needles) != 1:
            self._anew = []
            return None, None, explain_refusals(len(needles), refused)
        pose = _pose(needles[0], picture, view, time)
        if self._last is not None and self._fits(pose, self._last):
            self._accept(pose, self._last)
            return needles[0], picture, ""
        if self._anew and not self._fits(pose, self._anew[-1]):
            self._anew = []
        self._anew.append(pose)
        if len(self._anew) >= self._settings.confirm_frames:
            self._accept(pose, self._anew[-2] if len(self._anew) > 1 else None)
            return needles[0], picture, ""
        if self._last is not None:
            return None, None, "a needle farther from the last one than it can move"
        return None, None, f"a needle seen in {len(self._anew)} of {self._settings.confirm_frames} frames"

    def _fits(self, pose: _Pose, last: _Pose) -> bool:
        """Return whether a needle can have come from where it was last."""
        after = pose.time - last.time
        tail, angle = last.at(pose.time)
        assert self._dish.view is not None
        reach = self._settings.max_needle_speed * after + GATE_PX * self._dish.view.metres_per_pixel
        turn = abs((pose.angle - angle + math.pi) % (2.0 * math.pi) - math.pi)
        most = min(self._settings.max_turn_rate * after + GATE_ANGLE, 0.5 * math.pi)
        return math.dist(pose.tail, tail) < reach and turn < most

    def _accept(self, pose: _Pose, before: _Pose | None) -> None:
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
        self._last = _Pose(pose.time, pose.tail, pose.angle, velocity, turn_rate)
        self._anew = []

    def _region(self, frame: Frame, time: float) -> tuple[int, int, int, int]:
        """Return the box in which needle and thread should be: left, top, right, bottom [px]."""
        assert self._last is not None
        view, (rows, columns) = frame.view, frame.gray.shape
        moved = self._last.at(time)[0] - self._last.tail
        reach = MARGIN_PX + self._settings.max_needle_speed * (time - self._last.time) / view.metres_per_pixel
        corners = np.vstack([self._thread, self._thread[:2] + view.directions_to_pixels(moved / view.metres_per_pixel)])
        low, high = corners.min(axis=0) - reach, corners.max(axis=0) + reach
        left, top = (max(0, int(value) // FLOOR_FACTOR * FLOOR_FACTOR) for value in low)
        right = min(columns, (int(high[0]) // FLOOR_FACTOR + 1) * FLOOR_FACTOR)
        bottom = min(rows, (int(high[1]) // FLOOR_FACTOR + 1) * FLOOR_FACTOR)
        return left, top, right, bottom


@dataclass(frozen=True)
class FrameMeasurement:
    """What is measured in one frame, as it is published.

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
        """Whether there is a pose."""
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
        self._tracker = VisionTracker(settings, scene)
        self.frames = self.tracked = 0

    @property
    def missing(self) -> State:
        """State of a frame without a needle: lost, or searching if there never was one."""
        return State.LOST if self.tracked else State.SEARCHING

    def set_scene(self, scene: Scene) -> None:
        """Replace the scene; see `VisionTracker.set_scene`."""
        self._tracker.set_scene(scene)

    def on_image(self, time_s: float, image: np.ndarray) -> FrameMeasurement:
        """Look at the next frame, taken at a time [s]; see `VisionTracker.track`."""
        try:
            track = self._tracker.track(image, time_s)
        except InvalidInputError as error:
            return self.on_broken(error)
        self.frames += 1
        centreline = np.empty((0, 2))
        if track.state is State.TRACKED:
            self.tracked += 1
            if len(track.centreline) > 1:
                at = np.linspace(0.0, arc_lengths(track.centreline)[-1], CENTRELINE_POINTS)
                centreline = points_at(track.centreline, at)
        return FrameMeasurement(track, centreline)

    def on_broken(self, problem: InvalidInputError) -> FrameMeasurement:
        """Count a frame that cannot be decoded, and report why."""
        self.frames += 1
        return FrameMeasurement(no_pose(self.missing, str(problem), None), np.empty((0, 2)), problem)


def _pose(needle: MeasuredNeedle, picture: Picture, view: DishView, time: float) -> _Pose:
    heading = view.directions_to_dish(needle.direction_px)
    tail = view.to_dish(needle.tail_px + picture.origin)
    return _Pose(time, tail, math.atan2(heading[1], heading[0]), np.zeros(2), 0.0)


def _length(points: np.ndarray) -> float:
    return float(np.hypot(*np.diff(points, axis=0).T).sum()) if len(points) > 1 else 0.0


def warm_up() -> bool:
    """Track a drawn frame once; the first frame takes seconds where nothing is compiled yet.

    From now on OpenCV stays on one thread in this process: at these sizes it costs more to wake others.

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
    rim_shift(image, (320.0, 240.0), 218.0)
    return not VisionTracker(VisionTrackerSettings(), Scene()).look(image).reason
