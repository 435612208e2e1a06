"""Threads and motions that the tests of the formulations share."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from magnetosuture_thread.geometry.obstacles import Obstacle, Workspace
from magnetosuture_thread.thread.material import MATERIALS, Attachment, Medium, Thread
from magnetosuture_thread.thread.paper import PaperFormulation, PaperOptions
from magnetosuture_thread.thread.rod import RodFormulation
from magnetosuture_thread.thread.solvers import make_solver
from magnetosuture_thread.thread.step import Formulation, PrescribedMotion, StepResult, ThreadState

DT = 1.0 / 66.0
TOLERANCE = 1e-6


def polyamide(attachment: Attachment = Attachment.PINNED, segments: int = 25, rest_curvature: float = 0.0) -> Thread:
    """Return the paper's polyamide thread."""
    return Thread.of(
        MATERIALS["polyamide_7_0"],
        length=0.019,
        segments=segments,
        attachment=attachment,
        rest_curvature=rest_curvature,
    )


def silk(attachment: Attachment = Attachment.PINNED, segments: int = 81) -> Thread:
    """Return the paper's silk thread."""
    return Thread.of(MATERIALS["silk_6_0"], length=0.15, segments=segments, attachment=attachment)


def in_air(length: float, segments: int, gravity: Sequence[float], stiffness: float = 0.0, drag: float = 0.0) -> Thread:
    """Return a rope of 10 g/m in air."""
    rope = replace(polyamide(segments=segments), length=length, diameter=1e-3, bending_stiffness=stiffness)
    return replace(rope, medium=Medium.air(0.01, tuple(gravity), drag))


def formulated(
    thread: Thread,
    obstacles: Sequence[Obstacle] = (),
    *,
    name: str = "rod",
    solver: str = "banded",
    dimension: int = 2,
    paper: PaperOptions | None = None,
    wall: float = math.inf,
) -> Formulation:
    """Return a formulation of a thread among obstacles, in a dish of a radius; margins reach 5 cm."""
    workspace = Workspace(obstacles, 0.05, dimension, wall)
    parts = thread, workspace, make_solver(solver, TOLERANCE), TOLERANCE
    return RodFormulation(*parts) if name == "rod" else PaperFormulation(*parts, paper)


def east(dimension: int = 2) -> np.ndarray:
    """Return the first axis."""
    return np.asarray(np.eye(dimension)[0])


def straight(thread: Thread, dimension: int = 2) -> np.ndarray:
    """Return a thread that lies straight behind a needle at the origin which points east."""
    return -thread.segment_length * np.arange(thread.segments + 1)[:, None] * east(dimension)


def lead(tail: np.ndarray, heading: np.ndarray | None = None) -> PrescribedMotion:
    """Return a drive of the needle alone."""
    tail = np.asarray(tail, dtype=float)
    return PrescribedMotion((0,), tail[None, :], east(len(tail)) if heading is None else heading)


def followed(
    formulation: Formulation,
    positions: np.ndarray,
    way: Callable[[int], np.ndarray],
    steps: int,
    interval: float = DT,
    heading: np.ndarray | None = None,
) -> list[StepResult]:
    """Lead the needle along a way, a function of the step's number, and return every step."""
    state, done = ThreadState.at_rest(positions), []
    for step in range(1, steps + 1):
        done.append(formulation.step(state, lead(way(step), heading), interval))
        state = done[-1].state
    return done


def stretch(thread: Thread, positions: np.ndarray) -> float:
    """Return the greatest length of a segment over its rest length, less one."""
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).max()) / thread.segment_length - 1.0
