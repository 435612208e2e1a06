"""A thread that may not cross itself under random motions of the needle: how often it passes through itself."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from rich.table import Table

from benchmarks.report import figures_table
from magnetosuture_thread import NeedlePose, SolverError, ThreadPredictor
from magnetosuture_thread.geometry.obstacles import Workspace
from magnetosuture_thread.geometry.polyline import Points, chain_along
from magnetosuture_thread.rig.dynamics import NeedleBody, NeedleJoint, RigDynamics, Surface, ThreadProperties
from magnetosuture_thread.thread.barriers import SelfContact
from magnetosuture_thread.thread.material import Attachment, Medium, Thread
from magnetosuture_thread.thread.rod import RodFormulation
from magnetosuture_thread.thread.solvers import make_solver
from magnetosuture_thread.thread.step import PrescribedMotion, StepResult, ThreadState

RATE, SPEED = 60.0, 8e-3  # 1/s, m/s
LENGTH, SEGMENTS, DIAMETER = 0.019, 40, 60e-6  # m
STIFFNESS, DRAG = 2e-12, 1.0  # N m^2; Pa s across, half as much along: the thread stays where it was laid
DISH = 0.014  # m; narrow, so that the needle comes across its thread
INSTANTS = np.linspace(0.0, 1.0, 9)[1:]  # of each part of a step, when the thread may not cross itself


@dataclass
class RandomMotion:
    """What one motion came to.

    Attributes:
        steps: of the needle.
        crossed: steps in which the thread crossed itself at one of `INSTANTS`, on the way that its nodes took.
        touched: steps at whose end it touched itself.
        refused: steps that were refused.
        unconverged: steps that did not converge.
    """

    steps: int = 0
    crossed: int = 0
    touched: int = 0
    refused: int = 0
    unconverged: int = 0


def random_path(seed: int, steps: int) -> Iterator[tuple[Points, float]]:
    """Yield tails and headings [rad] of a needle on a path of random curvature that turns back at the wall."""
    random = np.random.default_rng(seed)
    at, angle, curvature = np.zeros(2), 0.0, 0.0
    keep = math.exp(-1.0 / RATE / 0.6)  # s; correlation time of the curvature, whose standard deviation is 600 /m
    for _ in range(steps):
        curvature = keep * curvature + math.sqrt(1.0 - keep * keep) * 600.0 * random.standard_normal()
        turn = curvature
        if np.hypot(*at) > 0.35 * DISH:  # towards the middle
            turn = math.copysign(800.0, math.remainder(math.atan2(-at[1], -at[0]) - angle, 2.0 * math.pi))
        angle += turn * SPEED / RATE
        at = at + SPEED / RATE * np.array([math.cos(angle), math.sin(angle)])
        yield at, angle


def start_nodes() -> Points:
    """Return the thread at the start, behind the needle along an arc, shape (n + 1, 2) [m]."""
    radius = 4.5e-3  # m
    turn = np.linspace(0.0, LENGTH / radius, 400)
    arc = radius * np.column_stack([-np.sin(turn), np.cos(turn) - 1.0])
    return chain_along(arc, SEGMENTS, LENGTH / SEGMENTS)


class RecordingFormulation(RodFormulation):
    """Records where the thread was at the end of each part of a step, as the predictor divides some.

    Attributes:
        path: all nodes at those instants, each of shape (n + 1, 2) [m].
    """

    path: list[Points]

    def step(self, state: ThreadState, drive: PrescribedMotion, interval: float) -> StepResult:
        """Record the step in place of one that the predictor divides, from whose end nothing goes on."""
        done = super().step(state, drive, interval)
        while self.path and self.path[-1] is not state.positions:
            self.path.pop()
        self.path.append(done.state.positions)
        return done


def move_model(seed: int, self_contact: bool, steps: int = 300) -> RandomMotion:
    """Return what a motion of the thread model comes to, in a scene where the thread touches itself or crosses."""
    thread = Thread("soft", LENGTH, SEGMENTS, DIAMETER, STIFFNESS, Medium(DRAG, 0.5 * DRAG), Attachment.PINNED)
    barriers = (SelfContact(thread),) if self_contact else ()
    dish, solver = Workspace((), 5e-3, wall_radius=0.5 * DISH), make_solver("banded", 1e-6)
    formulation = RecordingFormulation(thread, dish, solver, 1e-6, barriers)
    predictor = ThreadPredictor(thread, dish, formulation=formulation)
    predictor.start(NeedlePose(0.0, np.zeros(2), np.array([1.0, 0.0])), start_nodes())
    result = RandomMotion()

    def step(k: int, tail: Points, angle: float) -> tuple[list[Points], float]:
        formulation.path = []
        prediction = predictor.step(NeedlePose(k / RATE, tail, np.array([math.cos(angle), math.sin(angle)])))
        result.unconverged += not prediction.converged
        clearance = prediction.margins["self_contact"].minimum_clearance if self_contact else math.inf
        return formulation.path, clearance

    return _moved(result, step, seed, steps)


def move_rig(seed: int, self_contact: bool, steps: int = 300) -> RandomMotion:
    """Return what the same motion of the simulated rig's thread comes to."""
    rod = LENGTH, SEGMENTS, STIFFNESS, 5.65, DRAG, 0.5 * DRAG
    thread = ThreadProperties(*rod, NeedleJoint.PINNED, diameter=DIAMETER)
    surface, body = Surface(wall_radius=0.5 * DISH, self_contact=self_contact), NeedleBody(2e-4, 5e-5, 0.0, 0.0, 1.0)
    rig = RigDynamics(body, thread, surface, None, np.zeros(2), 0.0, start_nodes(), largest_step=4e-3)

    def step(k: int, tail: Points, angle: float) -> tuple[list[Points], float]:
        rig.drive(tail, angle, 1.0 / RATE)
        return [rig.thread], math.inf

    return _moved(RandomMotion(), step, seed, steps)


def _moved(
    result: RandomMotion, step: Callable[[int, Points, float], tuple[list[Points], float]], seed: int, steps: int
) -> RandomMotion:
    before = start_nodes()
    for k, (tail, angle) in enumerate(random_path(seed, steps), 1):
        result.steps += 1
        try:
            path, clearance = step(k, tail, angle)
        except SolverError:
            result.refused += 1
            continue
        result.touched += clearance < 1e-6  # m
        lines = [start + part * (end - start) for start, end in pairwise([before, *path]) for part in INSTANTS]
        before = path[-1]
        result.crossed += not shapely.is_simple(shapely.linestrings(lines)).all()
    return result


def measure_self_contact(motions: int) -> dict[str, Any]:
    """Return the figures of so many motions of the model, and a tenth as many of the rig."""
    some = range(0, motions, 10)
    kinds: dict[str, list[RandomMotion]] = {
        "model": [move_model(seed, True) for seed in range(motions)],
        "model, crossing allowed": [move_model(seed, False) for seed in some],
        "rig": [move_rig(seed, True) for seed in some],
    }
    figures = {}
    for name, results in kinds.items():
        sums = {field: sum(getattr(result, field) for result in results) for field in vars(results[0])}
        figures[name] = {"motions": len(results), "motions_crossed": sum(r.crossed > 0 for r in results), **sums}
    return figures


def self_contact_table(figures: dict[str, Any]) -> Table:
    """Return the figures as a table."""
    columns = {"thread": "{thread}"} | {name.replace("_", " "): f"{{{name}}}" for name in figures["model"]}
    rows = [{"thread": name, **row} for name, row in figures.items()]
    return figures_table("a thread that touches itself, random motions of the needle", rows, columns)
