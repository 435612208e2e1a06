"""Drawn videos of a blunt rod in a dish without a dark rim, into which a program has drawn the way that it shall go."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from benchmarks.vision.cases import winding_line
from benchmarks.vision.photographs import DIAMETER, RIGHT, Photograph, Plane, ellipse_error, photograph, straightened
from magnetosuture_thread.geometry.polyline import Points, points_at
from magnetosuture_thread.rig.camera import STEEL_BGR
from magnetosuture_thread.scene import Scene
from magnetosuture_thread.scene.scene import Dish
from magnetosuture_thread.vision.look import FoundDish, Track
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import VisionTracker

GROUNDS, FLOORS = ("paper", "bench", "steel", "wood", "light_box"), ("clear", "beige", "yellow")
ROWS, RADIUS = (480, 600, 720), (0.36, 0.46)  # of a frame; of the dish, as a share of its shorter side
FRAME_RATE, FRAMES = 15.0, 24  # Hz, and frames of a video
LENGTH, WIDTH = 0.17, 0.023  # of the rod, in diameters of the dish
SPEED, WITHIN = 0.12, 0.6  # of its middle, in radii a second; radius in which it and its way lie
MAX_SPIN = 0.3  # rad / s
NOISE = 2.0  # grey levels, of each frame besides the camera's
RIGHT_PX, RIGHT_ANGLE = 3.0, math.radians(5.0)  # of the rod's middle and its axis, in a frame of 480 rows
SUBPIXEL_BITS = 4  # of the outlines that are drawn
SETTINGS = VisionTrackerSettings(needle_length=LENGTH * DIAMETER, needle_width=WIDTH * DIAMETER)


@dataclass(frozen=True)
class RodVideoFigures:
    """What the tracker found in drawn videos.

    Attributes:
        frames: number of them, over all videos.
        dish: frames with a dish that is right.
        needle: frames with a needle whose middle and axis are right; a rod without a thread has no heading.
        both: frames with both.
        wrong: frames with a needle elsewhere.
        median_ms: CPU time of a frame.
    """

    frames: int
    dish: int
    needle: int
    both: int
    wrong: int
    median_ms: float


@dataclass(frozen=True)
class RodVideo:
    """A drawn video.

    Attributes:
        seed: of the dish and what it stands on.
        ground: that it stands on.
        floor: what is in it.
        rows: of a frame.
        way: of the rod's middle, shape (m, 2) [radii of the dish].
        turn: of its axis at first [rad].
        spin: how fast it turns [rad / s].
        line: that is drawn into the frames, shape (m, 2) [radii].
        bgr: its colour.
        thickness: of it [px].
    """

    seed: int
    ground: str
    floor: str
    rows: int
    way: Points
    turn: float
    spin: float
    line: Points
    bgr: tuple[int, ...]
    thickness: int

    def rod(self, frame: int) -> Points:
        """Return both ends of the rod in a frame, shape (2, 2) [radii]."""
        after = frame / FRAME_RATE
        angle, middle = self.turn + self.spin * after, points_at(self.way, np.array([SPEED * after]))[0]
        return np.asarray(middle + np.array([[-LENGTH], [LENGTH]]) * (math.cos(angle), math.sin(angle)))

    def image(self, frame: int) -> tuple[Photograph, Points]:
        """Return a frame, and both ends of the rod in it [px]."""
        ends: list[Points] = []

        def draw(picture: Plane, pixels: Callable[[Points], Points]) -> None:
            rod = self.rod(frame)
            along = (rod[1] - rod[0]) / np.linalg.norm(rod[1] - rod[0])
            aside = WIDTH * np.array([-along[1], along[0]])
            _draw(picture, pixels(_on_floor(np.vstack([rod - aside, rod[::-1] + aside]))), STEEL_BGR, 0)
            _draw(picture, pixels(_on_floor(self.line)), self.bgr, self.thickness)
            picture += np.random.default_rng([self.seed, frame]).normal(0.0, NOISE, picture.shape).astype(np.float32)
            ends.append(pixels(_on_floor(rod)))

        random = np.random.default_rng(self.seed)
        photo = photograph(random, self.ground, self.floor, (0.0, 6.0), rows=self.rows, radius=RADIUS, draw=draw)
        return photo, ends[0]


def rod_video(index: int, seed: int) -> RodVideo:
    """Return a video with a number."""
    random = np.random.default_rng([seed, index])
    return RodVideo(
        seed=int(random.integers(2**31)),
        ground=str(random.choice(GROUNDS)),
        floor=str(random.choice(FLOORS)),
        rows=int(random.choice(ROWS)),
        way=_way(random, SPEED * (FRAMES + 1) / FRAME_RATE),
        turn=random.uniform(-math.pi, math.pi),
        spin=random.uniform(-MAX_SPIN, MAX_SPIN),
        line=_way(random, 2.0 * WITHIN),
        bgr=tuple(int(value) for value in random.integers(40, 220, 3)),
        thickness=int(random.integers(1, 4)),
    )


def _way(random: np.random.Generator, length: float) -> Points:
    """Return a line of a length that winds within the dish [radii]."""
    while True:
        start = random.uniform(-WITHIN, WITHIN, 2)
        line = winding_line(random, start, random.uniform(-math.pi, math.pi), length, 3.0)
        if np.hypot(*line.T).max() < WITHIN:
            return line


def _on_floor(points: Points) -> Points:
    return np.column_stack([points, np.zeros(len(points))])


def _draw(picture: Plane, points: Points, bgr: tuple[float, ...], thickness: int) -> None:
    """Draw a line of a thickness over a picture, or fill an outline if it is 0 [px]."""
    mask = np.zeros(picture.shape[:2], np.uint8)
    at = [np.round(points * 2**SUBPIXEL_BITS).astype(np.int32)]
    if thickness:
        cv2.polylines(mask, at, False, 255, thickness, cv2.LINE_AA, SUBPIXEL_BITS)
    else:
        cv2.fillPoly(mask, at, 255, cv2.LINE_AA, SUBPIXEL_BITS)
    picture += (mask / np.float32(255.0))[..., None] * (np.array(bgr, np.float32) - picture)


def is_right(track: Track, dish: FoundDish, ends: Points, rows: int) -> bool:
    """Say whether a rod was found where its ends are in the frame [px].

    Args:
        track: of the frame.
        dish: that was found, with its tilt.
        ends: of the rod, shape (2, 2) [px].
        rows: of the frame.
    """
    if track.view is None or not len(track.tail):
        return False
    dish = replace(dish, view=track.view)  # in pixels of the whole frame
    found = track.view.to_pixels(np.array([track.tail, track.tip]))
    ends = straightened(dish, ends)
    off = float(np.hypot(*(found.mean(axis=0) - ends.mean(axis=0))))
    ways = [(each[1] - each[0]) / np.linalg.norm(each[1] - each[0]) for each in (found, ends)]
    turned = math.acos(min(1.0, abs(float(ways[0] @ ways[1]))))
    return off < RIGHT_PX * rows / min(ROWS) and turned < RIGHT_ANGLE


def measure_rod_videos(count: int, seed: int) -> RodVideoFigures:
    """Track some videos over time; return what was found in their frames."""
    dishes, needles, both, wrong, times = 0, 0, 0, 0, []
    for index in range(count):
        video = rod_video(index, seed)
        tracker = VisionTracker(SETTINGS, Scene(dish=Dish(DIAMETER)))
        for frame in range(FRAMES):
            photo, ends = video.image(frame)
            began = time.process_time()
            track = tracker.track(photo.image, frame / FRAME_RATE)
            times.append(1e3 * (time.process_time() - began))
            dish = replace(tracker.dish, view=track.view) if tracker.dish and track.view else None  # of the whole frame
            found = (
                dish is not None and min(ellipse_error(dish, DIAMETER, at) for at in (photo.floor, photo.top)) < RIGHT
            )
            right = dish is not None and is_right(track, dish, ends, video.rows)
            dishes, needles, both = dishes + found, needles + right, both + (found and right)
            wrong += len(track.tail) > 0 and not right
    return RodVideoFigures(count * FRAMES, dishes, needles, both, wrong, float(np.median(times)))
