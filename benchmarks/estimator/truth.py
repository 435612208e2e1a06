"""Ground truth: the simulated rig's rod behind a needle that is driven along a path, and a camera without an image."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.geometry.polyline import Points, arc_lengths, lay_behind_needle, points_at
from magnetosuture_thread.geometry.thread_observation import PieceEnd, ThreadObservation, ThreadPiece
from magnetosuture_thread.rig.dynamics import NeedleBody, NeedleJoint, RigDynamics, Surface, ThreadProperties
from magnetosuture_thread.thread.material import MATERIALS, Attachment, Thread
from magnetosuture_thread.thread.prediction import NeedlePose

LENGTH = 0.019  # m; of the thread
RATE = 30.0  # 1/s; of the frames
SPEED = 1.5e-3  # m/s; of the needle
WALL_RADIUS = 0.0175  # m; of the dish
SPACING = 1.6e-4  # m; of the points along the thread, about two pixels
CORRELATION = 2.5e-4  # m; over which neighbouring points err alike


@dataclass(frozen=True)
class Run:
    """What happened: the needle and the thread at each frame.

    Attributes:
        thread: as the model should know it.
        poses: of the needle.
        threads: nodes of the rod, shape (T, m, 2) [m].
        posts: in the dish.
        wall_radius: of the dish [m].
    """

    thread: Thread
    poses: tuple[NeedlePose, ...]
    threads: NDArray[np.float64]
    posts: tuple[Disc, ...]
    wall_radius: float


def wander(seed: int, duration: float) -> tuple[Points, NDArray[np.float64]]:
    """Return tails, shape (T, 2) [m], and headings, shape (T,), of a needle that wanders through the dish.

    Its turn rate is a sum of slow sines, and close to the wall it turns away from it.
    """
    rng = np.random.default_rng(seed)
    frequencies, phases = rng.uniform(0.02, 0.12, 4), rng.uniform(0.0, 2.0 * math.pi, 4)
    amplitudes, steps = rng.uniform(0.15, 0.45, 4), 20
    h = 1.0 / (RATE * steps)
    place, heading = rng.uniform(-0.004, 0.004, 2), float(rng.uniform(0.0, 2.0 * math.pi))
    tails, headings = [], []
    for k in range(int(duration * RATE * steps)):
        if k % steps == 0:
            tails.append(place.copy())
            headings.append(heading)
        ahead = place + 0.003 * np.array([math.cos(heading), math.sin(heading)])
        turn = float(amplitudes @ np.sin(2.0 * math.pi * frequencies * k * h + phases))
        excess = float(np.linalg.norm(ahead)) - 0.0075
        if excess > 0.0:
            away = math.atan2(-place[1], -place[0])
            turn += math.copysign(1.2, math.remainder(away - heading, 2.0 * math.pi)) * min(excess / 0.003, 1.0)
        heading += h * turn
        place = place + h * SPEED * np.array([math.cos(heading), math.sin(heading)])
    return np.array(tails), np.array(headings)


def simulate(
    material: str,
    attachment: str,
    seed: int,
    duration: float,
    posts: tuple[Disc, ...] = (),
    *,
    stiffness: float = 1.0,
    viscosity: float = 1.0,
    flow: tuple[float, float] = (0.0, 0.0),
) -> Run:
    """Drive the rod's needle through the dish.

    Args:
        material: of the thread, in glycerin.
        attachment: to the needle.
        seed: of its way.
        duration: [s]
        posts: what stands in the dish.
        stiffness: factor on the bending stiffness of the true thread.
        viscosity: factor on its drag.
        flow: velocity of the liquid; only without posts and wall, as the rod is simulated in the liquid's frame [m/s].
    """
    thread = Thread.of(MATERIALS[material], length=LENGTH, segments=25, attachment=Attachment(attachment))
    properties = ThreadProperties(
        length=LENGTH,
        segments=114,
        bending_stiffness=stiffness * thread.bending_stiffness,
        stretching_stiffness=2.0,  # N; the drag of the needle then stretches it by 1e-5
        drag_across=viscosity * thread.medium.drag_across,
        drag_along=viscosity * thread.medium.drag_along,
        attachment=NeedleJoint(attachment),
        diameter=thread.diameter,
    )
    (tails, headings), moving = wander(seed, duration), np.array(flow)
    wall = math.inf if moving.any() else WALL_RADIUS
    unit = np.column_stack([np.cos(headings), np.sin(headings)])
    path = lay_behind_needle(tails[0], unit[0], 1.05 * LENGTH, WALL_RADIUS - 0.5 * thread.diameter - 1e-4)
    needle, surface = NeedleBody(2e-3, 4e-4, 0.0, 0.0, 1.0), Surface(posts, wall_radius=wall)
    rig = RigDynamics(needle, properties, surface, None, tails[0], float(headings[0]), path, largest_step=5e-3)
    threads = [rig.thread]
    for index in range(1, len(tails)):
        drift = moving * (index / RATE)
        rig.drive(tails[index] - drift, float(headings[index]), 1.0 / RATE)
        threads.append(rig.thread + drift)
    poses = tuple(NeedlePose(k / RATE, tails[k], unit[k]) for k in range(len(tails)))
    return Run(thread, poses, np.array(threads), posts, wall)


@dataclass(frozen=True)
class CameraModel:
    """What the camera does to the thread.

    Attributes:
        deviation: of the points across the thread [m].
        outliers: part of the points that lie 5 mm away.
        scale: factor on all lengths about the dish's middle.
        hidden: arc lengths between which the thread is covered [m].
        hidden_time: from when to when [s].
    """

    deviation: float = 2e-5  # a quarter of a pixel
    outliers: float = 0.0
    scale: float = 1.0
    hidden: tuple[float, float] = (0.0, 0.0)
    hidden_time: tuple[float, float] = (10.0, 15.0)

    def observe(
        self, nodes: Points, time: float, rng: np.random.Generator, others: tuple[Points, ...] = ()
    ) -> ThreadObservation:
        """Return what is seen of a thread, and of other threads in the dish.

        Args:
            nodes: of the thread [m].
            time: [s]
            rng: of the noise.
            others: polylines [m].
        """
        length = float(arc_lengths(nodes)[-1])
        stretches, (low, high) = [(0.0, length)], self.hidden
        if high > low and self.hidden_time[0] <= time < self.hidden_time[1]:
            stretches = [(a, b) for a, b in ((0.0, low), (high, length)) if b - a > 4.0 * SPACING]
        pieces = [self._piece(nodes, a, b, length, rng) for a, b in stretches]
        for other in others:
            points = points_at(other, np.arange(0.0, float(arc_lengths(other)[-1]), SPACING))
            noisy = points + rng.normal(0.0, self.deviation, points.shape)
            ends = PieceEnd.UNKNOWN, PieceEnd.UNKNOWN
            pieces.append(ThreadPiece(noisy, np.full(len(noisy), self.deviation), *ends, (np.nan, np.nan), False))
        return ThreadObservation(tuple(pieces), complete=stretches == [(0.0, length)])

    def _piece(self, nodes: Points, begin: float, end: float, length: float, rng: np.random.Generator) -> ThreadPiece:
        at = np.linspace(begin, end, max(int((end - begin) / SPACING), 2) + 1)
        points = points_at(nodes, at)
        along = np.gradient(points, axis=0)
        normal = np.column_stack([-along[:, 1], along[:, 0]]) / np.hypot(*along.T)[:, None]
        # Errors that are alike over a length: an Ornstein-Uhlenbeck process along the thread.
        keep = float(np.exp(-2.0 * SPACING / CORRELATION))
        error = rng.normal(0.0, self.deviation, len(points))
        for k in range(1, len(points)):
            error[k] = keep * error[k - 1] + (1.0 - keep * keep) ** 0.5 * error[k]
        noisy = points + error[:, None] * normal
        wrong, angle = rng.random(len(points)) < self.outliers, rng.uniform(0.0, 2.0 * np.pi, len(points))
        noisy += wrong[:, None] * 5e-3 * np.column_stack([np.cos(angle), np.sin(angle)])
        first = PieceEnd.TAIL if begin == 0.0 else PieceEnd.COVERED
        last = PieceEnd.FREE if end == length else PieceEnd.COVERED
        # What is known of the arc length: of the piece at the needle all, of one at the free end what is left.
        known = (0.0, 0.0) if begin == 0.0 else (0.98 * begin, min(1.02 * begin, length))
        return ThreadPiece(noisy * self.scale, np.full(len(noisy), self.deviation), first, last, known)
