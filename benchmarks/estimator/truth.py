"""Ground truth: the simulated rig's rod behind a needle that is driven along a path, without a graph."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.geometry.polyline import Points, lay_behind_needle
from magnetosuture_thread.rig.mechanics.dynamics import NeedleJoint, RigDynamics, Surface, ThreadProperties
from magnetosuture_thread.rig.mechanics.needle import NeedleBody
from magnetosuture_thread.thread.material import MATERIALS, Attachment, Thread
from magnetosuture_thread.thread.prediction import NeedlePose

LENGTH = 0.019  # of the thread [m]
SEGMENTS = 114  # of the rod that is the truth
WALL_RADIUS = 0.0175  # of the dish [m]
STRAIN_STIFFNESS = 2.0  # EA of the rod [N]; the drag of the needle then stretches it by 1e-5


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


def model_thread(material: str, segments: int, attachment: str = "pinned") -> Thread:
    """Return a thread of a known material in glycerin."""
    return Thread.of(MATERIALS[material], length=LENGTH, segments=segments, attachment=Attachment(attachment))


def wander(seed: int, duration: float, rate: float, speed: float) -> tuple[Points, NDArray[np.float64]]:
    """Return tails, shape (T, 2) [m], and headings, shape (T,), of a needle that wanders through the dish.

    Its turn rate is a sum of slow sines, and close to the wall it turns away from it.
    """
    rng = np.random.default_rng(seed)
    frequencies, phases = rng.uniform(0.02, 0.12, 4), rng.uniform(0.0, 2.0 * math.pi, 4)
    amplitudes = rng.uniform(0.15, 0.45, 4) * speed / 1.5e-3
    steps = 20
    h = 1.0 / (rate * steps)
    place, heading = rng.uniform(-0.004, 0.004, 2), float(rng.uniform(0.0, 2.0 * math.pi))
    tails, headings = [], []
    for k in range(int(duration * rate * steps)):
        time = k * h
        if k % steps == 0:
            tails.append(place.copy())
            headings.append(heading)
        ahead = place + 0.003 * np.array([math.cos(heading), math.sin(heading)])
        turn = float(amplitudes @ np.sin(2.0 * math.pi * frequencies * time + phases))
        excess = float(np.linalg.norm(ahead)) - 0.0075
        if excess > 0.0:
            away = math.atan2(-place[1], -place[0])
            side = math.copysign(1.0, math.remainder(away - heading, 2.0 * math.pi))
            turn += side * min(excess / 0.003, 1.0) * 800.0 * speed
        heading += h * turn
        place = place + h * speed * np.array([math.cos(heading), math.sin(heading)])
    return np.array(tails), np.array(headings)


def simulate(
    thread: Thread,
    tails: Points,
    headings: NDArray[np.float64],
    rate: float,
    *,
    posts: tuple[Disc, ...] = (),
    stiffness: float = 1.0,
    viscosity: float = 1.0,
    flow: tuple[float, float] = (0.0, 0.0),
) -> Run:
    """Drive the rod's needle along tails and headings, one of each a frame.

    Args:
        thread: as the model knows it.
        tails: shape (T, 2) [m].
        headings: shape (T,) [rad].
        rate: of the frames [1/s].
        posts: what stands in the dish.
        stiffness: factor on the bending stiffness of the true thread.
        viscosity: factor on its drag.
        flow: velocity of the liquid; only without posts and wall, as the rod is simulated in the liquid's frame [m/s].
    """
    properties = ThreadProperties(
        length=thread.length,
        segments=SEGMENTS,
        bending_stiffness=stiffness * thread.bending_stiffness,
        stretching_stiffness=STRAIN_STIFFNESS,
        drag_across=viscosity * thread.medium.drag_across,
        drag_along=viscosity * thread.medium.drag_along,
        attachment=NeedleJoint(thread.attachment.value),
        diameter=thread.diameter,
    )
    moving = np.array(flow)
    still = not moving.any()
    wall_radius = WALL_RADIUS if still else math.inf
    heading = np.array([math.cos(headings[0]), math.sin(headings[0])])
    path = lay_behind_needle(tails[0], heading, 1.05 * thread.length, WALL_RADIUS - 0.5 * thread.diameter - 1e-4)
    rig = RigDynamics(
        NeedleBody(2e-3, 4e-4, 0.0, 0.0, 1.0),
        properties,
        Surface(posts, wall_radius=WALL_RADIUS if still else None),
        None,
        tails[0],
        float(headings[0]),
        path,
        largest_step=5e-3,
    )
    threads = [rig.thread]
    for index in range(1, len(tails)):
        drift = moving * (index / rate)
        rig.drive(tails[index] - drift, float(headings[index]), 1.0 / rate)
        threads.append(rig.thread + drift)
    unit = np.column_stack([np.cos(headings), np.sin(headings)])
    poses = tuple(NeedlePose(k / rate, tails[k], unit[k]) for k in range(len(tails)))
    return Run(thread, poses, np.array(threads), posts, wall_radius)
