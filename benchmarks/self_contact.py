"""A thread that may not cross itself under random motions of the needle: how often it passes through itself."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely
from rich.table import Table

from benchmarks.report import figures_table
from magnetosuture_thread import NeedlePose, SolverError, ThreadPredictor
from magnetosuture_thread.geometry.obstacles import Workspace
from magnetosuture_thread.geometry.polyline import Points, chain_along
from magnetosuture_thread.rig.mechanics.dynamics import NeedleJoint, RigDynamics, Surface, ThreadProperties
from magnetosuture_thread.rig.mechanics.needle import NeedleBody
from magnetosuture_thread.thread.barriers import SelfContact
from magnetosuture_thread.thread.material import Attachment, Medium, Thread
from magnetosuture_thread.thread.rod import RodFormulation
from magnetosuture_thread.thread.solvers import make_solver
from magnetosuture_thread.thread.step import PrescribedMotion, StepResult, ThreadState

RATE = 60.0
LENGTH = 0.019  # m
SEGMENTS = 40
DIAMETER = 60e-6  # m
STIFFNESS = 2e-12  # N m^2; in a liquid of 1 Pa s it stays where it was laid
STRETCHING = 5.65  # N
DRAG = 1.0  # Pa s, across; half as much along
DISH = 0.014  # m; narrow, so that the needle comes across its thread
START_RADIUS = 4.5e-3  # m, of the arc in which the thread lies
PATH = (600.0, 0.6)  # standard deviation of the path's curvature [1/m] and its correlation time [s]
MAX_CURVATURE = 800.0  # 1/m, of the path where it turns back from the wall
SPEED = 8e-3  # m/s
STEPS = 300
TOLERANCE = 1e-6  # of residuals
INSTANTS = np.linspace(0.0, 1.0, 9)[1:]  # of each part of a step, when the thread may not cross itself
TOUCHING = 1e-6  # m
RIG_SHARE = 10  # of the motions, one in so many is the rig's too


@dataclass
class RandomMotion:
    """What one motion came to.

    Attributes:
        steps: of the needle.
        crossed: steps in which the thread crossed itself at one of `INSTANTS`, on the way that its nodes took.
        touched: steps at whose end it touched itself.
        refused: steps that were refused.
        unconverged: steps that did not converge.
        times: of the steps, free and touching [s].
    """

    steps: int = 0
    crossed: int = 0
    touched: int = 0
    refused: int = 0
    unconverged: int = 0
    times: tuple[list[float], list[float]] = field(default_factory=lambda: ([], []))


def random_path(seed: int, steps: int) -> Iterator[tuple[Points, float]]:
    """Yield tails and headings [rad] of a needle on a path of random curvature that turns back at the wall."""
    random = np.random.default_rng(seed)
    at, angle, curvature = np.zeros(2), 0.0, 0.0
    keep = math.exp(-1.0 / RATE / PATH[1])
    for _ in range(steps):
        curvature = keep * curvature + math.sqrt(1.0 - keep * keep) * PATH[0] * random.standard_normal()
        turn = curvature
        if np.hypot(*at) > 0.35 * DISH:  # towards the middle
            turn = math.copysign(MAX_CURVATURE, math.remainder(math.atan2(-at[1], -at[0]) - angle, 2.0 * math.pi))
        angle += turn * SPEED / RATE
        at = at + SPEED / RATE * np.array([math.cos(angle), math.sin(angle)])
        yield at, angle


def start_nodes() -> Points:
    """Return the thread at the start, behind the needle along an arc, shape (n + 1, 2) [m]."""
    turn = np.linspace(0.0, LENGTH / START_RADIUS, 400)
    arc = START_RADIUS * np.column_stack([-np.sin(turn), np.cos(turn) - 1.0])
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


def move_model(seed: int, self_contact: bool, steps: int = STEPS) -> RandomMotion:
    """Return what a motion of the thread model comes to, in a scene where the thread touches itself or crosses."""
    thread = Thread("soft", LENGTH, SEGMENTS, DIAMETER, STIFFNESS, Medium(DRAG, 0.5 * DRAG), Attachment.PINNED)
    barriers = (SelfContact(thread),) if self_contact else ()
    dish, solver = Workspace((), 5e-3, wall_radius=0.5 * DISH), make_solver("banded", TOLERANCE)
    formulation = RecordingFormulation(thread, dish, solver, TOLERANCE, barriers)
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


def move_rig(seed: int, self_contact: bool, steps: int = STEPS) -> RandomMotion:
    """Return what the same motion of the simulated rig's thread comes to."""
    rod = LENGTH, SEGMENTS, STIFFNESS, STRETCHING, DRAG, 0.5 * DRAG
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
        began = time.process_time()
        try:
            path, clearance = step(k, tail, angle)
        except SolverError:
            result.refused += 1
            continue
        touches = clearance < TOUCHING
        result.times[int(touches)].append(time.process_time() - began)
        result.touched += touches
        between = []
        for after in path:
            between += [before + part * (after - before) for part in INSTANTS]
            before = after
        result.crossed += not shapely.is_simple(shapely.linestrings(between)).all()
    return result


def measure_self_contact(motions: int) -> dict[str, Any]:
    """Return the figures of so many motions of the model, and a tenth as many of the rig."""
    return {
        "model": _sum([move_model(seed, True) for seed in range(motions)]),
        "model, crossing allowed": _sum([move_model(seed, False) for seed in range(0, motions, RIG_SHARE)]),
        "rig": _sum([move_rig(seed, True) for seed in range(0, motions, RIG_SHARE)]),
    }


def _sum(done: list[RandomMotion]) -> dict[str, Any]:
    free, touching = ([spent for each in done for spent in each.times[kind]] for kind in (0, 1))
    return {
        "motions": len(done),
        **{name: sum(getattr(each, name) for each in done) for name in ("steps", "crossed", "touched", "refused")},
        "not_converged": sum(each.unconverged for each in done),
        "motions_crossed": sum(each.crossed > 0 for each in done),
        "free_us": 1e6 * float(np.median(free)),
        "touching_us": 1e6 * float(np.median(touching or [0.0])),
    }


def self_contact_table(figures: dict[str, Any]) -> Table:
    """Return the figures as a table."""
    names = ("motions", "motions_crossed", "steps", "touched", "refused", "not_converged", "free_us", "touching_us")
    columns = {"thread": "{thread}"} | {name.replace("_", " "): f"{{{name}:.0f}}" for name in names}
    rows = [{"thread": name, **row} for name, row in figures.items()]
    return figures_table("a thread that touches itself, random motions of the needle", rows, columns)
