"""The motion and the scene that are measured: a needle on a winding track, a silk thread behind it, obstacles.

The track winds with the angles

    theta(s) = 0.9 cos(2 pi s / 30 mm),    phi(s) = 0.4 sin(2 pi s / 47 mm)    (phi = 0 in the plane)

about a straight line, s its arc length from where the needle's tail begins. The obstacles lie on the inside
of three bends, where a pulled thread cuts the corner and leans on them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.obstacles import Disc, Obstacle, Polygon
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.thread.material import MATERIALS, Attachment, Thread

SEGMENT = 1.85e-3  # m; of the paper's thread
MAX_LENGTH = 2.0  # m; of a thread: longer chains have shorter segments
SPEED = 10e-3  # m/s
RATE = 66.0  # poses a second
TRIANGLES = 200  # of each obstacle
OBSTACLES = 3

WINDING, WAVE = 0.9, 30e-3  # rad, m
CLIMBING, CLIMB_WAVE = 0.4, 47e-3  # rad, m
GRID = 5e-6  # m; of arc length, for the integral of the heading
RADIUS, LOBES, BUMP = 2.5e-3, 5, 0.05  # of an obstacle: mean [m], number and height of the bumps
CLEARANCE = 0.15e-3  # m; between the track and an obstacle's highest bump


@dataclass(frozen=True, eq=False)
class Case:
    """One motion of one thread in one scene.

    Attributes:
        thread: of n segments.
        shapes: the obstacles.
        start: the thread before the first step, all chords as long as its segments' along the track,
            shape (n + 1, d) [m].
        tails: position of the needle's tail at the end of each step, shape (k, d) [m].
        headings: unit vector along the needle at the end of each step, shape (k, d).
        interval: duration of a step [s].
    """

    thread: Thread
    shapes: tuple[Obstacle, ...]
    start: Points
    tails: Points
    headings: Points
    interval: float

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return int(self.start.shape[1])


def case(segments: int, dimension: int, obstacles: bool, steps: int) -> Case:
    """Return a motion: the needle goes along the track, 0.15 mm a step.

    Args:
        segments: n; the thread is n * 1.85 mm long, and at most `MAX_LENGTH`.
        dimension: d, 2 or 3.
        obstacles: whether there are three obstacles of 200 triangles, or none.
        steps: k.
    """
    travel, segment = SPEED / RATE, min(SEGMENT, MAX_LENGTH / segments)
    arc = np.arange(1.0, steps + 1.0) * travel
    behind = -segment * np.arange(segments + 1.0)
    positions = _track(np.concatenate([behind, arc]), dimension)
    return Case(
        thread=Thread.of(
            MATERIALS["silk_6_0"], length=segments * segment, segments=segments, attachment=Attachment.PINNED
        ),
        shapes=_obstacles(dimension) if obstacles else (),
        start=positions[: segments + 1].copy(),
        tails=positions[segments + 1 :].copy(),
        headings=heading(arc, dimension),
        interval=1.0 / RATE,
    )


def heading(arc: NDArray[np.float64], dimension: int) -> Points:
    """Return unit vectors along the track, shape (k, d), at arc lengths s of shape (k,) [m]."""
    theta = WINDING * np.cos(2.0 * math.pi * arc / WAVE)
    if dimension == 2:
        return np.stack([np.cos(theta), np.sin(theta)], axis=1)
    phi = CLIMBING * np.sin(2.0 * math.pi * arc / CLIMB_WAVE)
    return np.stack([np.cos(theta) * np.cos(phi), np.sin(theta) * np.cos(phi), np.sin(phi)], axis=1)


def _track(arc: NDArray[np.float64], dimension: int) -> Points:
    """Return the positions at arc lengths, the integral of the heading from s = 0, shape (k, d) [m]."""
    first, last = math.floor(min(arc.min(), 0.0) / GRID), math.ceil(max(arc.max(), 0.0) / GRID)
    # Midpoints: exact to (GRID / WAVE)^2, far below what a segment may stretch.
    pieces = GRID * heading((np.arange(first, last) + 0.5) * GRID, dimension)
    walked = np.concatenate([np.zeros((1, dimension)), np.cumsum(pieces, axis=0)])
    walked -= walked[-first]
    grid = np.arange(first, last + 1) * GRID
    return np.stack([np.interp(arc, grid, walked[:, k]) for k in range(dimension)], axis=1)


def _obstacles(dimension: int) -> tuple[Obstacle, ...]:
    """Return an obstacle inside each of three bends: one that the thread begins in, two on the needle's way."""
    bends = (np.arange(float(OBSTACLES)) - 0.5) * 0.5 * WAVE
    apexes = _track(bends, dimension)
    turning = heading(bends + GRID, dimension) - heading(bends - GRID, dimension)
    inward = turning / np.linalg.norm(turning, axis=1, keepdims=True)
    centres = apexes + (RADIUS * (1.0 + BUMP) + CLEARANCE) * inward
    return tuple(_star(centre) if dimension == 2 else Disc(tuple(centre.tolist()), RADIUS) for centre in centres)


def _star(centre: NDArray[np.float64]) -> Polygon:
    """Return a smooth outline with five bumps of as many vertices as give 200 triangles: two more."""
    angle = 2.0 * math.pi * np.arange(TRIANGLES + 2) / (TRIANGLES + 2)
    radius = RADIUS * (1.0 + BUMP * np.cos(LOBES * angle))
    x, y = centre[:, None] + radius * np.stack([np.cos(angle), np.sin(angle)])
    return Polygon(tuple(zip(x.tolist(), y.tolist(), strict=True)))
