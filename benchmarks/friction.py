"""Friction of the thread at contacts by itself: capstans of flexible and of stiff threads."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from rich.table import Table
from scipy.optimize import brentq

from benchmarks.report import figures_table
from magnetosuture_thread import Disc, NeedlePose, ThreadPredictor, Workspace
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.thread.material import Attachment, Medium, Thread

RATE = 60.0
POST = 1e-3  # m
DIAMETER = 60e-6  # m, of the thread
SPEED = 1e-3  # m/s
DRAG = 0.5  # Pa s, along the thread; twice as much across
LEAD = 4e-3  # m, of thread before the post
PER_TURN = 40  # segments
STEPS = 40
MEASURED = 20  # of these steps, the last ones
SETTLING = 80  # steps until the ends of a stiff thread's contact have found their places
STIFFNESSES = (0.2, 0.4)  # E I / (T_1 R^2) of stiff threads
EAST = np.array([1.0, 0.0])


def measure_friction() -> dict[str, Any]:
    """Return the figures."""
    capstans = [
        {"friction": friction, "turns": turns, "error_percent": capstan_error(friction, 2.0 * math.pi * turns)}
        for friction in (0.1, 0.2, 0.3, 0.4, 0.5)
        for turns in (0.25, 0.5, 1.0, 2.0)
    ]
    stiff = [
        {"friction": friction, "stiffness": stiffness, **stiff_capstan(friction, stiffness)._asdict()}
        for friction in (0.3, 0.5)
        for stiffness in STIFFNESSES
    ]
    return {"capstans": capstans, "stiff_capstans": stiff}


def friction_tables(figures: dict[str, Any]) -> tuple[Table, Table]:
    """Return the figures as tables."""
    error = {"mu": "{friction:g}", "turns": "{turns:g}", "off [%]": "{error_percent:+.2f}"}
    ratios = {"mu": "{friction:g}", "E I [T1 R^2]": "{stiffness:g}", "T2 / T1": "{measured:.3f}"}
    ratios |= {"by elastica theory": "{elastica:.3f}", "flexible": "{flexible:.3f}"}
    return (
        figures_table("capstans: T2 / T1 over exp(mu theta), less 1", figures["capstans"], error),
        figures_table("stiff capstans, 0.5 turns", figures["stiff_capstans"], ratios),
    )


def capstan(friction: float, angle: float, free: int, stiffness: float = 0.0) -> tuple[ThreadPredictor, Points]:
    """Return a thread around a post: from the needle to the east, `angle` counter-clockwise, then straight.

    Args:
        friction: mu.
        angle: of the post around which it lies [rad].
        free: segments behind the post.
        stiffness: E I [N m^2].
    """
    radius = POST + 0.5 * DIAMETER
    segment = 2.0 * math.pi * radius / PER_TURN
    segments = round((LEAD + angle * radius) / segment) + free
    at = segment * np.arange(segments + 1)
    turned = math.pi / 2 + np.clip((at - LEAD) / radius, 0.0, angle)
    tail = np.clip(at - LEAD - angle * radius, 0.0, None)
    x = radius * np.cos(turned) - tail * np.sin(turned) + np.clip(LEAD - at, 0.0, None)
    nodes = np.column_stack([x, radius * np.sin(turned) + tail * np.cos(turned)])
    medium = Medium(2.0 * DRAG, DRAG)
    thread = Thread("capstan", segments * segment, segments, DIAMETER, stiffness, medium, Attachment.PINNED)
    predictor = ThreadPredictor(thread, Workspace((Disc((0.0, 0.0), POST),), 2e-3, friction=(friction,)))
    predictor.start_at(NeedlePose(0.0, nodes[0], EAST), nodes)
    return predictor, nodes


def capstan_error(friction: float, angle: float, free: int = 250) -> float:
    """Return by how much T_2 / T_1 differs from exp(mu theta), the drag on the post's part taken off [%]."""
    predictor, nodes = capstan(friction, angle, free)
    radius, ratios = POST + 0.5 * DIAMETER, []
    for k in range(1, STEPS + 1):
        prediction = predictor.step(NeedlePose(k / RATE, nodes[0] + SPEED * k / RATE * EAST, EAST))
        forces, along = prediction.forces, np.diff(prediction.positions, axis=0)
        assert forces is not None
        touching = np.flatnonzero(forces.friction_use > 0.0)
        first, last = touching[0] - 1, touching[-1]  # segments before and behind the post
        theta = np.ptp(np.unwrap(np.arctan2(along[:, 1], along[:, 0]))[first : last + 1])
        gain = math.exp(friction * theta)
        drag = DRAG * SPEED * radius * (gain - 1.0) / friction
        ratios.append((forces.tension[first] - drag) / (forces.tension[last] * gain))
    return 100.0 * (float(np.mean(ratios[-MEASURED:])) - 1.0)


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
    radius = POST + 0.5 * DIAMETER
    segment = 2.0 * math.pi * radius / PER_TURN
    predictor, nodes = capstan(friction, math.pi, free, stiffness * DRAG * SPEED * free * segment * radius**2)
    layer, found = math.ceil(4.0 * math.sqrt(stiffness) * radius / segment), []  # segments in which an end is bent
    for k in range(1, SETTLING + STEPS + 1):
        prediction = predictor.step(NeedlePose(k / RATE, nodes[0] + SPEED * k / RATE * EAST, EAST))
        if k <= SETTLING:
            continue
        forces, along = prediction.forces, np.diff(prediction.positions, axis=0)
        assert forces is not None
        touching = np.flatnonzero(forces.friction_use > 0.0)
        first, last = touching[0] - 1, touching[-1]  # segments before and behind the post
        theta = np.ptp(np.unwrap(np.arctan2(along[:, 1], along[:, 0]))[[2, -free // 2]])
        # Drag makes the tension of a straight part linear: it is taken at the post, from where the thread is straight.
        before, behind = np.arange(2, first - layer // 2), np.arange(last + layer, last + free // 2)
        high, low = (
            np.polyval(np.polyfit(part, forces.tension[part], 1), end)
            for part, end in ((before, first), (behind, last))
        )
        gain = math.exp(friction * theta)
        ratio = float((high - DRAG * SPEED * radius * (gain - 1.0) / friction) / low)
        bent = predictor.thread.bending_stiffness / (low * radius**2)
        found.append((ratio, elastica_ratio(friction, float(theta), float(bent)), gain))
    return StiffCapstan(*np.mean(found, axis=0).tolist())
