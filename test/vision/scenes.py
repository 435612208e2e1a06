"""Rendered frames whose truth is known."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.needle_arc import needle_axis
from magnetosuture_thread.geometry.polyline import arc_lengths, points_at
from magnetosuture_thread.geometry.scene import Scene as TrackedScene
from magnetosuture_thread.rig.camera import CameraScene, Cover, DishCamera
from magnetosuture_thread.vision.tracker import Track

SCENE = TrackedScene()  # a dish of 35 mm with nothing in it
VIEW = DishView((322.0, 238.0), 8e-5)
PIXEL = VIEW.metres_per_pixel
NOWHERE = np.array([[0.5, 0.5], [0.51, 0.5]])
RIGHT_PX, RIGHT_ANGLE = 2.0, np.radians(3.0)


@dataclass(frozen=True)
class Pose:
    """Where a needle is drawn: tail [m], heading [rad], curvature [1/m]."""

    tail: np.ndarray
    heading: float
    curvature: float = 0.0

    def at(self, share: float) -> np.ndarray:
        """Return the point of the axis at a share of its length, shape (2,)."""
        return needle_axis(self.tail, self.heading, 0.007, self.curvature, np.array([share]))[0][0]

    def error(self, seen: Track) -> tuple[float, float]:
        """Return how far a tail [px] and a heading [rad] that were seen are off."""
        turned = float(np.arctan2(seen.heading[1], seen.heading[0])) - self.heading
        return float(np.linalg.norm(seen.tail - self.tail)) / PIXEL, float((turned + np.pi) % (2.0 * np.pi) - np.pi)

    def is_right(self, seen: Track) -> bool:
        """Say whether a pose that was seen is near enough for a needle to be steered by."""
        apart, turned = self.error(seen)
        return apart < RIGHT_PX and abs(turned) < RIGHT_ANGLE


CURVATURES = (-440.0, -190.0, 110.0, 400.0)


def random_pose(random: np.random.Generator, *, curved: bool) -> Pose:
    """Draw a pose whose needle lies within a circle of 15.8 mm around the dish's centre."""
    while True:
        curvature = float(random.choice(CURVATURES)) if curved else 0.0
        pose = Pose(random.uniform(-0.0158, 0.0158, 2), random.uniform(-np.pi, np.pi), curvature)
        axis = needle_axis(pose.tail, pose.heading, 0.007, curvature, np.linspace(0.0, 1.0, 9))[0]
        if np.linalg.norm(axis, axis=1).max() < 0.0158:
            return pose


def random_thread(random: np.random.Generator, pose: Pose) -> np.ndarray:
    """Draw a thread that winds away from a needle's tail and stays in the dish, shape (m, 2) [m]."""
    steps, length = 200, 0.019
    for _ in range(100):
        bend = np.interp(np.linspace(0.0, 1.0, steps), np.linspace(0.0, 1.0, 6), random.uniform(-350.0, 350.0, 6))
        angle = pose.heading + np.pi + random.normal(0.0, 0.3) + np.cumsum(bend) * length / steps
        walk = np.cumsum(length / steps * np.column_stack([np.cos(angle), np.sin(angle)]), axis=0)
        thread = np.vstack([pose.tail, pose.tail + walk])
        if np.linalg.norm(thread, axis=1).max() < 0.0168:
            return thread
    return thread[:40]


@lru_cache(maxsize=6)  # a camera holds some 50 MB
def camera_for(seed: int) -> DishCamera:
    """Return a camera; making one takes as long as ten frames."""
    return DishCamera(CameraScene(), VIEW, seed=seed)


def render(
    pose: Pose,
    thread: np.ndarray = NOWHERE,
    *,
    seed: int = 5,
    covers: tuple[Cover, ...] = (),
    gain: float = 1.0,
) -> np.ndarray:
    """Draw a frame."""
    camera = camera_for(seed)
    camera._scene = CameraScene(needle_curvature=pose.curvature)  # needle and thread are drawn in each frame anew
    camera._random = np.random.default_rng(seed)  # a frame is the same whatever was drawn before it
    return camera.render(pose.tail, pose.heading, thread, covers, gain)


def line_error(found: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Return the mean distance of a line from the true one, and the share of the true one that it follows.

    Both lines in one unit, pixels; within 2 px it follows.
    """
    dense = points_at(truth, np.linspace(0.0, arc_lengths(truth)[-1], 400))
    own = points_at(found, np.linspace(0.0, arc_lengths(found)[-1], 400))
    apart = np.linalg.norm(own[:, None] - dense[None], axis=2)
    return float(apart.min(axis=1).mean()), float((apart.min(axis=0) < 2.0).mean())


def blob(centre: np.ndarray, radius: float, bgr: tuple[float, float, float], opacity: float = 1.0) -> Cover:
    """Return a round cover [m]."""
    turn = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
    outline = centre + radius * np.column_stack([np.cos(turn), np.sin(turn)])
    return Cover(outline, bgr, blur_px=1.5, opacity=opacity)


def finger(end: np.ndarray, angle: float, width: float, bgr: tuple[float, float, float]) -> Cover:
    """Return a strip that comes in from the border at an angle and ends, rounded, at a place [m]."""
    inwards = -np.array([np.cos(angle), np.sin(angle)])
    across = np.array([-inwards[1], inwards[0]])
    turn = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 20)
    middle = end - 0.5 * width * inwards
    cap = middle + 0.5 * width * (np.cos(turn)[:, None] * inwards + np.sin(turn)[:, None] * across)
    back = middle - 0.1 * inwards
    return Cover(np.vstack([back - 0.5 * width * across, cap, back + 0.5 * width * across]), bgr)


def rod(ends: np.ndarray, level: int = 50) -> np.ndarray:
    """Draw a blunt rod without a thread, from one end to the other, in a dish; shape (2, 2) [m]."""
    frame = render(Pose(np.array([0.5, 0.5]), 0.0))
    (x, y), (x_end, _) = VIEW.to_pixels(ends)
    outline = np.array([(x, y - 2.5), (x_end, y - 2.5), (x_end, y + 2.5), (x, y + 2.5)])
    cv2.fillPoly(frame, [np.round(outline * 16).astype(np.int32)], (level,) * 3, cv2.LINE_AA, 4)
    return cv2.GaussianBlur(frame, (0, 0), 0.8)
