"""Friction of the thread at contacts by itself: capstans of flexible and of stiff threads."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from magnetosuture_thread import Disc, NeedlePose, ThreadPredictor, Workspace
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.thread.material import Attachment, Medium, Thread

RATE = 60.0
POST, DIAMETER = 1e-3, 60e-6  # m; radius of the post, and of the thread
RADIUS = POST + 0.5 * DIAMETER  # m, of the thread's centreline on the post
SPEED = 1e-3  # m/s
DRAG = 0.5  # Pa s, along the thread; twice as much across
LEAD = 4e-3  # m, of thread before the post
PER_TURN = 40  # segments
EAST = np.array([1.0, 0.0])

Vector = NDArray[np.float64]


def measure_friction() -> list[dict[str, float]]:
    """Return the figures of flexible threads."""
    return [
        {"friction": friction, "turns": turns, "error_percent": capstan_error(friction, 2.0 * math.pi * turns)}
        for friction in (0.1, 0.2, 0.3, 0.4, 0.5)
        for turns in (0.25, 0.5, 1.0, 2.0)
    ]


def around_post(at: NDArray[np.floating[Any]], angle: float, lead: float = LEAD) -> Points:
    """Return the points at arc lengths of a thread from the east around the post by an angle, then straight [m]."""
    turned = math.pi / 2 + np.clip((at - lead) / RADIUS, 0.0, angle)
    tail = np.clip(at - lead - angle * RADIUS, 0.0, None)
    x = RADIUS * np.cos(turned) - tail * np.sin(turned) + np.clip(lead - at, 0.0, None)
    return np.column_stack([x, RADIUS * np.sin(turned) + tail * np.cos(turned)])


def capstan(friction: float, angle: float, free: int, stiffness: float = 0.0) -> tuple[ThreadPredictor, Points]:
    """Return a thread around a post: from the needle to the east, `angle` counter-clockwise, then straight.

    Args:
        friction: mu.
        angle: of the post around which it lies [rad].
        free: segments behind the post.
        stiffness: E I [N m^2].
    """
    segment = 2.0 * math.pi * RADIUS / PER_TURN
    segments = round((LEAD + angle * RADIUS) / segment) + free
    nodes, medium = around_post(segment * np.arange(segments + 1), angle), Medium(2.0 * DRAG, DRAG)
    thread = Thread("capstan", segments * segment, segments, DIAMETER, stiffness, medium, Attachment.PINNED)
    predictor = ThreadPredictor(thread, Workspace((Disc((0.0, 0.0), POST),), 2e-3, friction=(friction,)))
    predictor.start_at(NeedlePose(0.0, nodes[0], EAST), nodes)
    return predictor, nodes


def _slide(
    predictor: ThreadPredictor, nodes: Points, skipped: int, steps: int
) -> Iterator[tuple[Vector, Vector, int, int]]:
    """Draw a thread around its post; yield tensions and angles of the segments, and those before and behind the post.

    Args:
        predictor: that has the thread.
        nodes: at its start.
        skipped: steps before the first that is yielded.
        steps: that are yielded.
    """
    for k in range(1, skipped + steps + 1):
        prediction = predictor.step(NeedlePose(k / RATE, nodes[0] + SPEED * k / RATE * EAST, EAST))
        if k > skipped:
            forces, along = prediction.forces, np.diff(prediction.positions, axis=0)
            assert forces is not None
            touching = np.flatnonzero(forces.friction_use > 0.0)
            yield forces.tension, np.unwrap(np.arctan2(along[:, 1], along[:, 0])), touching[0] - 1, touching[-1]


def capstan_error(friction: float, angle: float, free: int = 250) -> float:
    """Return by how much T_2 / T_1 differs from exp(mu theta), the drag on the post's part taken off [%]."""
    predictor, nodes = capstan(friction, angle, free)
    ratios = []
    for tension, angles, first, last in _slide(predictor, nodes, 20, 20):
        gain = math.exp(friction * np.ptp(angles[first : last + 1]))
        ratios.append((tension[first] - _drag(friction, gain)) / (tension[last] * gain))
    return 100.0 * (float(np.mean(ratios)) - 1.0)


def _drag(friction: float, gain: float) -> float:
    """Return what drag on the post's part adds to the tension before it [N]."""
    return DRAG * SPEED * RADIUS * (gain - 1.0) / friction


class StiffCapstan(NamedTuple):
    """T_2 / T_1 of a stiff thread around a post: measured, by elastica theory, and of a flexible thread."""

    measured: float
    elastica: float
    flexible: float


def elastica_ratio(friction: float, angle: float, stiffness: float) -> float:
    """Return T_2 / T_1 of a thread with bending stiffness that slides around a post.

    With B = E I / R^2, each free end leaves the post at the angle phi = acos(1 - B / 2 T) against its far direction, by
    the elastica's first integral. There the post pushes with T sin(phi); between these places the thread has the post's
    curvature and no shear force, and is a capstan as a flexible one is:

        T_2 (cos(phi_2) - mu sin(phi_2)) = T_1 (cos(phi_1) + mu sin(phi_1)) exp(mu (angle - phi_1 - phi_2))

    Args:
        friction: mu.
        angle: between the far directions [rad].
        stiffness: B / T_1.
    """

    def lift_off(tension: float) -> float:
        return math.acos(1.0 - 0.5 * stiffness / tension)

    low = lift_off(1.0)

    def balance(tension: float) -> float:
        high = lift_off(tension)
        pushed = (math.cos(low) + friction * math.sin(low)) * math.exp(friction * (angle - low - high))
        return tension * (math.cos(high) - friction * math.sin(high)) - pushed

    return float(brentq(balance, 1.0, 3.0 * math.exp(friction * angle)))


def stiff_capstan(friction: float, stiffness: float, free: int = 250) -> StiffCapstan:
    """Return what a thread with E I = `stiffness` T_1 R^2 that slides around half a post comes to."""
    segment = 2.0 * math.pi * RADIUS / PER_TURN
    predictor, nodes = capstan(friction, math.pi, free, stiffness * DRAG * SPEED * free * segment * RADIUS**2)
    layer, ratios = math.ceil(4.0 * math.sqrt(stiffness) * RADIUS / segment), []  # segments in which an end is bent
    # 80 steps go by until the ends of the contact have found their places.
    for tension, angles, first, last in _slide(predictor, nodes, 80, 40):
        theta = float(np.ptp(angles[[2, -free // 2]]))
        # Drag makes the tension of a straight part linear: it is taken at the post, from where the thread is straight.
        before, behind = np.arange(2, first - layer // 2), np.arange(last + layer, last + free // 2)
        high, low = (
            float(np.polyval(np.polyfit(part, tension[part], 1), end))
            for part, end in ((before, first), (behind, last))
        )
        gain = math.exp(friction * theta)
        bent = predictor.thread.bending_stiffness / (low * RADIUS**2)
        ratios.append(((high - _drag(friction, gain)) / low, elastica_ratio(friction, theta, bent), gain))
    return StiffCapstan(*np.mean(ratios, axis=0).tolist())
