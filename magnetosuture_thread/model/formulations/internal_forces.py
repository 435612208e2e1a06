"""What the thread's own segments push its nodes with, compiled: the balance of a solved program without its loads.

A solution balances at each free node what the segments, the medium and contacts do. What the segments do is P u + q
without the medium's part, and the multipliers of the segments' rows:

    f_i = lambda_i g_i(y) - (P - R) u - (q - r),    R u + r = the medium's part

So the forces of all nodes add up to nothing, and are in balance with the loads. Multipliers and bending taken at the
step's end, in place of y, are not: the bending stiffness of short segments makes much of tenths of a micrometer.

Source: Lagrange's multipliers. Deviation: none.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled_uncounted
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.formulations.step_buffers import StepBuffers
from magnetosuture_thread.model.program import SPAN, Vector


@compiled_uncounted
def keep_internal_forces(
    buffers: StepBuffers,
    known: NDArray[np.bool_],
    moved: Points,
    velocities: Points,
    multipliers: Vector,
    interval: float,
) -> None:
    """Keep what the segments push each node with, and what medium and contacts do at the needle's tail.

    Args:
        buffers: of the program that was solved; written.
        known: the prescribed nodes, shape (n + 1,).
        moved: way of node 0 in the step, shape (d,).
        velocities: the solution, shape (n + 1, d).
        multipliers: of all rows, shape (r,).
        interval: dt [s].
    """
    nodes, dimension = velocities.shape
    internal, load, couplings = buffers.internal, buffers.tail_load, buffers.couplings
    for i in range(nodes):
        for a in range(dimension):
            value = buffers.linear[i, a] - buffers.drag_linear[i, a]
            for b in range(dimension):
                value += (buffers.blocks[i, a, b] - buffers.drag[i, a, b]) * velocities[i, b]
            for apart in range(1, min(SPAN, nodes - 1 - i) + 1):
                value += couplings[apart - 1, i] * velocities[i + apart, a]
            for apart in range(1, min(SPAN, i) + 1):
                value += couplings[apart - 1, i - apart] * velocities[i - apart, a]
            internal[i, a] = -value
    for row in range(nodes - 1):
        for k in range(SPAN):
            for a in range(dimension):
                internal[buffers.first[row] + k, a] += multipliers[row] * buffers.gradient[row, k, a]
    for a in range(dimension):
        load[a] = buffers.contact_force[0, a] - buffers.drag_linear[0, a]
        for b in range(dimension):
            load[a] -= buffers.drag[0, a, b] * moved[b] / interval
    # A row of a contact has no gradient at a node that is known, whose share is with the needle.
    for row in range(nodes - 1, len(multipliers)):
        c = row - nodes + 1
        if known[0] and buffers.node[c] == 0 and buffers.limit[row] == np.inf:
            for a in range(dimension):
                load[a] += (1.0 - buffers.place[c]) * buffers.normal[c, a] * multipliers[row]
