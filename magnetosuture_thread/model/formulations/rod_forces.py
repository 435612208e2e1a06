"""Tension and pull of the rod at the end of a step, compiled; the equations are those of `ThreadForces`."""

from __future__ import annotations

import numpy as np

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model import mechanics
from magnetosuture_thread.model.formulations.rod_step import RodProperties
from magnetosuture_thread.model.program import Vector


@compiled
def write_forces(
    rod: RodProperties,
    positions: Points,
    velocities: Points,
    heading: Points,
    multipliers: Vector,
    scale: float,
    tension: Vector,
    force: Vector,
) -> float:
    """Write the tension of each segment [N] and the force upon the needle [N]; return the moment about its tail [N m].

    Args:
        rod: its properties.
        positions: of all nodes at the end of the step, in segment lengths, shape (n + 1, d).
        velocities: of all nodes [m/s].
        heading: unit vector along the needle, shape (d,).
        multipliers: of the segments' lengths, shape (n,).
        scale: force of a unit of a multiplier [N].
        tension: written, shape (n,).
        force: written, shape (d,).

    Returns:
        The moment, counter-clockwise; 0 of a pinned thread, NaN in space, where it is no single number.
    """
    nodes, dimension = positions.shape
    work, gradient = np.zeros((2, nodes, dimension)), np.zeros((nodes, dimension))
    mechanics.bending_gradient(positions, heading, rod.clamped, rod.rest_angles, work, gradient)
    bending = rod.bending_stiffness / rod.unit**2
    tangent, passed = np.zeros(dimension), np.zeros(dimension)
    load = rod.drag_across - rod.drag_along
    for i in range(nodes - 1):
        chord = 0.0
        for a in range(dimension):
            tangent[a] = positions[i + 1, a] - positions[i, a]
            chord += tangent[a] ** 2
        chord = np.sqrt(chord)
        tension[i] = scale * multipliers[i] * chord
        last = i == nodes - 2
        node = i + 1 if last else i
        slip = 0.0
        for a in range(dimension):
            tangent[a] /= chord
            slip += tangent[a] * (velocities[node, a] - rod.flow[a])
        if last:  # the end correction takes some of the load on the last segment from the node behind its middle
            along = -rod.drag_along * slip
            for a in range(dimension):
                along += rod.mass_per_length * rod.gravity[a] * tangent[a]
            tension[i] += mechanics.END_CORRECTION * rod.unit * along
        if i == 0:
            slip = 0.0
            for a in range(dimension):
                slip += tangent[a] * (velocities[0, a] - rod.flow[a])
            for a in range(dimension):
                drag = -rod.drag_across * (velocities[0, a] - rod.flow[a]) + load * slip * tangent[a]
                weight = rod.mass_per_length * rod.gravity[a]
                force[a] = tension[0] * tangent[a] - bending * gradient[0, a] + 0.5 * rod.unit * (weight + drag)
        for a in range(dimension):  # what bending passes on, besides the force that keeps the segment's length
            passed[a] -= bending * gradient[i, a]
            tension[i] += passed[a] * tangent[a]
    if not rod.clamped:
        return 0.0
    if dimension != 2:
        return np.nan
    return float(-2.0 * bending * rod.unit * (work[1, 0, 1] * heading[0] - work[1, 0, 0] * heading[1]))
