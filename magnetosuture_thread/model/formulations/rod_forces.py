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
    internal: Points,
    tail_load: Vector,
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
        internal: what the segments push each node with, see `keep_internal_forces`, shape (n + 1, d).
        tail_load: what medium and contacts push node 0 with, shape (d,).
        scale: force of a unit of these [N].
        tension: written, shape (n,).
        force: written, shape (d,).

    Returns:
        The moment, counter-clockwise; 0 of a pinned thread, NaN in space, where it is no single number.
    """
    nodes, dimension = positions.shape
    tangent, passed = np.zeros(dimension), np.zeros(dimension)
    for a in range(dimension):
        force[a] = scale * (internal[0, a] + tail_load[a])
    for i in range(nodes - 1):
        chord = 0.0
        for a in range(dimension):
            tangent[a] = positions[i + 1, a] - positions[i, a]
            chord += tangent[a] ** 2
        chord = np.sqrt(chord)
        tension[i] = 0.0
        for a in range(dimension):
            tangent[a] /= chord
            passed[a] += internal[i, a]  # what the thread behind pulls at that before
            tension[i] += scale * passed[a] * tangent[a]
    # The end correction takes some of the load on the last segment from the node behind its middle.
    along = 0.0
    for a in range(dimension):
        slip = velocities[nodes - 1, a] - rod.flow[a]
        along += tangent[a] * (rod.mass_per_length * rod.gravity[a] - rod.drag_along * slip)
    tension[nodes - 2] += mechanics.END_CORRECTION * rod.unit * along
    if not rod.clamped:
        return 0.0
    if dimension != 2:
        return np.nan
    work, gradient = np.zeros((2, nodes, dimension)), np.zeros((nodes, dimension))
    mechanics.bending_gradient(positions, heading, rod.clamped, rod.rest_angles, work, gradient)
    bending = rod.bending_stiffness / rod.unit
    return float(-2.0 * bending * (work[1, 0, 1] * heading[0] - work[1, 0, 0] * heading[1]))
