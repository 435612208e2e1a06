"""A thread that may not cross itself under random motions of the needle: how often it passes through itself."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import shapely

from magnetosuture_thread import NeedlePose, Scene, SolverError, ThreadPredictor
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.thread import Attachment, Medium, Thread
from magnetosuture_thread.scene import Dish

RATE = 60.0
LENGTH = 0.019  # m
SEGMENTS = 40
DIAMETER = 60e-6  # m
STIFFNESS = 2e-12  # N m^2; in a liquid of 1 Pa s it stays where it was laid
DISH = 0.014  # m; narrow, so that the needle comes across its thread
TURNS = (600.0, 0.6)  # standard deviation of the path's curvature [1/m] and its correlation time [s]
INSTANTS = np.linspace(0.0, 1.0, 9)[1:]  # of each step, at which the thread is looked at


@dataclass
class RandomMotion:
    """What one motion came to.

    Attributes:
        steps: of the needle.
        crossed: steps in which the thread crossed itself at one of `INSTANTS`.
        touched: steps at whose end it touched itself.
        refused: steps that the predictor refused.
        unconverged: steps that did not converge.
        times: of the steps, free and touching [s].
    """

    steps: int = 0
    crossed: int = 0
    touched: int = 0
    refused: int = 0
    unconverged: int = 0
    times: tuple[list[float], list[float]] = field(default_factory=lambda: ([], []))


def random_path(seed: int, steps: int, speed: float) -> Iterator[tuple[Points, Points]]:
    """Yield tails and headings of a needle on a path of random curvature that turns back at the wall."""
    random = np.random.default_rng(seed)
    at, angle, curvature = np.zeros(2), 0.0, 0.0
    keep = math.exp(-1.0 / RATE / TURNS[1])
    for _ in range(steps):
        curvature = keep * curvature + math.sqrt(1.0 - keep * keep) * TURNS[0] * random.standard_normal()
        inward = math.atan2(-at[1], -at[0])
        turn = curvature * speed / RATE
        if np.hypot(*at) > 0.35 * DISH:  # towards the middle
            turn = math.copysign(min(800.0 * speed / RATE, 1.0), math.remainder(inward - angle, 2.0 * math.pi))
        angle += turn
        heading = np.array([math.cos(angle), math.sin(angle)])
        at = at + speed / RATE * heading
        yield at, heading


def move_at_random(seed: int, self_contact: bool, steps: int = 300, speed: float = 8e-3) -> RandomMotion:
    """Return what a motion comes to, in a scene where the thread may cross itself or not."""
    scene = Scene(Dish(DISH, self_contact=self_contact))
    thread = Thread("soft", LENGTH, SEGMENTS, DIAMETER, STIFFNESS, Medium(1.0, 0.5), Attachment.PINNED)
    predictor = ThreadPredictor(thread, scene)
    turn = np.linspace(0.0, LENGTH / 0.0045, SEGMENTS + 1)  # behind the needle along a circle
    nodes = 0.0045 * np.column_stack([-np.sin(turn), np.cos(turn) - 1.0])
    predictor.start(NeedlePose(0.0, np.zeros(2), np.array([1.0, 0.0])), nodes)
    assert predictor.state is not None
    result, before = RandomMotion(), predictor.state.positions
    for k, (tail, heading) in enumerate(random_path(seed, steps, speed), 1):
        result.steps += 1
        began = time.process_time()
        try:
            prediction = predictor.step(NeedlePose(k / RATE, tail, heading))
        except SolverError:
            result.refused += 1
            continue
        spent = time.process_time() - began
        after = prediction.positions
        between = [before + part * (after - before) for part in INSTANTS]
        result.crossed += not shapely.is_simple(shapely.linestrings(between)).all()
        clearance = prediction.margins["self_contact"].minimum_clearance if self_contact else math.inf
        result.touched += clearance < 1e-6
        result.unconverged += not prediction.converged
        result.times[int(clearance < 1e-6)].append(spent)
        before = after
    return result
