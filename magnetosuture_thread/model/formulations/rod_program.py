"""The program of the formulation `rod`, in compiled code."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.obstacles import WorkspaceData
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model import mechanics
from magnetosuture_thread.model.barriers.connectivity import distance_barrier
from magnetosuture_thread.model.formulations.step import DEPTH_REACHED, StepBuffers, contact_rows
from magnetosuture_thread.model.program import Vector

STRETCH_REACHED = 1e-3  # of the segments; beyond it the barriers are linearised once more
COMPLIANCE = 1e-7  # of a segment
LONGEST_RATIO = 2.0  # of a step to the last one, for the second-order difference to stay stable


class Rod(NamedTuple):
    """What stays the same from step to step, for compiled code."""

    glued: bool
    unit: float
    radius: float
    bending_stiffness: float
    drag_across: float
    drag_along: float
    mass_per_length: float
    bending_damping: float
    gravity: Vector
    rest_turns: Vector
    weights: Vector
    bands: NDArray[np.float64]


@compiled
def assemble(
    solves: int,
    rod: Rod,
    memory: StepBuffers,
    workspace: WorkspaceData,
    about: Points,
    start: Points,
    before: Points,
    last: Points,
    known: NDArray[np.bool_],
    heading: Points,
    interval: float,
    last_interval: float,
) -> tuple[int, float]:
    """Write the program about a predicted end point; where that came from a solve and is exact, do not.

    Returns the number of contacts, -1 if there is no room for them, and how far off the barriers the point
    is: the stretch or the depth over what is allowed, 1 or less if it is exact.
    """
    segments = len(about) - 1
    mechanics.chord_lengths(about, heading, rod.glued, memory.chords)
    stretch = _segment_rows(memory, about, start, known, interval)
    contacts, depth = contact_rows(memory, segments, workspace, about, start, known, interval, rod.unit, rod.radius)
    off = max(stretch / STRETCH_REACHED, depth / DEPTH_REACHED)
    if contacts >= 0 and (solves == 0 or off > 1.0):
        _objective(rod, memory, about, start, before, last, heading, interval, last_interval)
    return contacts, off if solves > 0 else np.inf


@compiled
def _objective(
    rod: Rod,
    memory: StepBuffers,
    about: Points,
    start: Points,
    before: Points,
    last: Points,
    heading: Points,
    interval: float,
    last_interval: float,
) -> None:
    """Write P and q, with r the bending stiffness over the unit of the metric and D^4.

        P = a Z + r (dt + tau) K,    q = r (grad E(x) + tau K shift) - Z v

    and what `tension_stiffness` and `_taut` add. `shift` is the velocity of the driven nodes, which have
    moved already. In air a = 1, and of Z v only the inertia's part is left.
    """
    nodes, dimension = start.shape
    blocks, couplings, linear = memory.blocks, memory.couplings, memory.linear
    inertia = rod.mass_per_length / interval
    scale = inertia + rod.drag_across
    rate = rod.bending_stiffness / (scale * rod.unit**4)
    inertia = inertia / scale
    mechanics.metric(about, rod.weights, inertia, rod.drag_across / scale, rod.drag_along / scale, blocks)
    mechanics.bending_gradient(start, heading, rod.glued, rod.rest_turns, memory.work, linear)
    ratio = interval / last_interval if last_interval > 0.0 else 0.0
    if inertia > 0.0 or ratio > LONGEST_RATIO:
        ratio = 0.0
    leading, trailing = (1.0 + 2.0 * ratio) / (1.0 + ratio), ratio / (1.0 + ratio)
    stiffness = rate * (interval + rod.bending_damping)
    for i in range(nodes):
        for a in range(dimension):
            value = rate * linear[i, a]
            for b in range(dimension):
                value -= trailing * blocks[i, a, b] * last[i, b]
            value -= inertia * rod.weights[i] * (last[i, a] + interval / rod.unit * rod.gravity[a])
            linear[i, a] = value
        for a in range(dimension):
            for b in range(dimension):
                blocks[i, a, b] *= leading
            blocks[i, a, a] += stiffness * rod.bands[0, i]
        for apart in range(1, 4):
            couplings[apart - 1, i] = stiffness * rod.bands[apart, i]
    if rod.bending_damping > 0.0:
        weight = rate * rod.bending_damping / interval
        for i in range(nodes):
            for apart in range(-3, 4):
                if 0 <= i + apart < nodes:
                    band = weight * rod.bands[abs(apart), min(i, i + apart)]
                    for a in range(dimension):
                        linear[i, a] += band * (start[i + apart, a] - before[i + apart, a])
    mechanics.tension_stiffness(
        start, heading, rod.glued, memory.multipliers, -0.5 * rate, interval, (blocks, couplings, linear)
    )
    _taut(memory, about, start, interval)


@compiled
def _taut(memory: StepBuffers, about: Points, start: Points, interval: float) -> None:
    """Add the curvature of the constraints: that of -sum T_i h_i, for the segments that are pulled.

        1/2 dt sum_i T_i |w_i - w_{i-1}|^2,    w = u - (y - x) / dt

    With it each linearisation is a Newton step of Lagrange's function; without it the solves of a thread
    that is pulled hard, T dt > Z, swing from side to side and never end.
    """
    nodes, dimension = about.shape
    for i in range(nodes - 1):
        tension = max(memory.multipliers[i], 0.0)
        weight = interval * tension
        for a in range(dimension):
            moved = about[i + 1, a] - start[i + 1, a] - about[i, a] + start[i, a]
            memory.linear[i, a] += tension * moved
            memory.linear[i + 1, a] -= tension * moved
            memory.blocks[i, a, a] += weight
            memory.blocks[i + 1, a, a] += weight
        memory.couplings[0, i] -= weight


@compiled
def _segment_rows(
    memory: StepBuffers, about: Points, start: Points, known: NDArray[np.bool_], interval: float
) -> float:
    """Write the rows  grad h(y)' u = (-h(y) - grad h(y)' (x - y)) / dt; return the largest |h(y)|."""
    nodes, dimension = about.shape
    distance_barrier(about, 1, memory.chords, memory.value, memory.gradient)
    stretch = 0.0
    for i in range(nodes - 1):
        begin = min(i, nodes - 3)
        memory.first[i] = begin
        bound = -memory.value[i]
        for k in range(3):
            for a in range(dimension):
                bound -= memory.gradient[i, k, a] * (start[begin + k, a] - about[begin + k, a])
        memory.lower[i] = memory.upper[i] = bound / interval
        memory.compliance[i] = COMPLIANCE
        if known[i] and known[i + 1]:
            # Nothing in the program can change its length, and a tension that tries would bend its neighbours.
            memory.lower[i], memory.upper[i], memory.multipliers[i] = -np.inf, np.inf, 0.0
        else:
            stretch = max(stretch, abs(memory.value[i]))
    return stretch
