"""Friction of the thread at contacts by itself: capstans, a thread that is held, and the time of a step."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
from rich.table import Table

from magnetosuture_thread import Disc, NeedlePose, ThreadPredictor, Workspace
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.thread import Attachment, Medium, Thread

RATE = 60.0
POST = 1e-3  # m
DIAMETER = 60e-6  # m, of the thread
SPEED = 1e-3  # m/s
DRAG = 0.5  # Pa s, along the thread; twice as much across
LEAD = 4e-3  # m, of thread before the post
PER_TURN = 40  # segments
STEPS = 40
MEASURED = 20  # of these steps, the last ones
EAST = np.array([1.0, 0.0])


def measure_friction() -> dict[str, Any]:
    """Return the figures."""
    capstans = [
        {"friction": friction, "turns": turns, "error_percent": capstan_error(friction, 2.0 * math.pi * turns)}
        for friction in (0.1, 0.2, 0.3, 0.4, 0.5)
        for turns in (0.25, 0.5, 1.0, 2.0)
    ]
    times = {f"{friction:g}": step_time(friction) for friction in (0.0, 0.3)}
    return {"capstans": capstans, "creep_m": creep(0.5), "step": times}


def friction_table(figures: dict[str, Any]) -> Table:
    """Return the figures as a table."""
    table = Table(title="friction by itself")
    table.add_column("case")
    table.add_column("figure", justify="right")
    for case in figures["capstans"]:
        name = f"capstan, mu = {case['friction']:g}, {case['turns']:g} turns: T2 / T1 over theory, less 1"
        table.add_row(name, f"{case['error_percent']:+.2f} %")
    table.add_row("thread held around a post, slip in 60 s", f"{1e6 * figures['creep_m']:.4f} µm")
    for friction, step in figures["step"].items():
        name = f"step, n = 81, {step['contacts']:.0f} nodes in contact, mu = {friction}"
        table.add_row(name, f"{step['median_us']:.0f} µs, {step['solves']:.1f} solves")
    return table


def capstan(friction: float, angle: float, free: int) -> tuple[ThreadPredictor, Points]:
    """Return a flexible thread around a post: from the needle to the east, `angle` counter-clockwise, then straight."""
    radius = POST + 0.5 * DIAMETER
    segment = 2.0 * math.pi * radius / PER_TURN
    segments = round((LEAD + angle * radius) / segment) + free
    at = segment * np.arange(segments + 1)
    turned = math.pi / 2 + np.clip((at - LEAD) / radius, 0.0, angle)
    tail = np.clip(at - LEAD - angle * radius, 0.0, None)
    x = radius * np.cos(turned) - tail * np.sin(turned) + np.clip(LEAD - at, 0.0, None)
    nodes = np.column_stack([x, radius * np.sin(turned) + tail * np.cos(turned)])
    medium = Medium(2.0 * DRAG, DRAG)
    thread = Thread("flexible", segments * segment, segments, DIAMETER, 0.0, medium, Attachment.PINNED)
    predictor = ThreadPredictor(thread, Workspace((Disc((0.0, 0.0), POST),), 2e-3, friction=(friction,)))
    predictor.start_at(NeedlePose(0.0, nodes[0], EAST), nodes)
    return predictor, nodes


def capstan_error(friction: float, angle: float) -> float:
    """Return by how much T_2 / T_1 differs from exp(mu theta), the drag on the post's part taken off [%]."""
    predictor, nodes = capstan(friction, angle, 250)
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


def creep(friction: float) -> float:
    """Return how far a thread slips around a post in a minute, while a flow draws at both of its ends [m]."""
    medium = Medium(1.0, 0.5, flow=(1e-3, 0.0))
    thread = Thread("thread", 0.0195, 90, DIAMETER, 1e-13, medium, Attachment.PINNED)
    predictor = ThreadPredictor(thread, Workspace((Disc((0.0, 0.0), POST),), 2e-3, friction=(friction,)))
    turned, radius = np.linspace(math.pi / 2, 1.5 * math.pi, 40), POST + 0.5 * DIAMETER
    around = radius * np.column_stack([np.cos(turned), np.sin(turned)])
    path = np.vstack([[(4e-3, 3e-3), (5e-3, 2.5e-3), (5e-3, 1.6e-3)], around, [(0.03, -radius)]])
    rest = NeedlePose(0.0, path[0], np.array([-1.0, 0.0]))
    predictor.start(rest, path)
    ends = [predictor.step(NeedlePose(0.1 * k, rest.tail, rest.heading)).positions[-1, 0] for k in range(1, 701)]
    return abs(float(ends[-1] - ends[100]))  # ten seconds to settle


def step_time(friction: float) -> dict[str, float]:
    """Return processor time and solves of a step of 81 segments, of which about 40 nodes touch a post."""
    predictor, nodes = capstan(friction, 2.0 * math.pi, 81 - 40 - round(LEAD * PER_TURN / (2.0 * math.pi * POST)))
    solves: list[int] = []
    times, contacts = [], []
    inner = predictor.formulation.step

    def counted(*given: Any) -> Any:
        result = inner(*given)
        solves.append(result.solves)
        return result

    vars(predictor.formulation)["step"] = counted
    for k in range(1, 121):
        pose = NeedlePose(k / RATE, nodes[0] + SPEED * k / RATE * EAST, EAST)
        began = time.process_time()
        prediction = predictor.step(pose)
        times.append(time.process_time() - began)
        assert prediction.forces is not None
        contacts.append(np.count_nonzero(prediction.forces.contact.any(axis=1)))
    figures = 1e6 * float(np.median(times[20:])), float(np.mean(contacts)), float(np.mean(solves[20:]))
    return dict(zip(("median_us", "contacts", "solves"), figures, strict=True))
