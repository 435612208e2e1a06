"""Smoothing: arcs in the place of sharp corners."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

Vertex = tuple[float, float]

# Of an edge between two sharp corners each arc may use just under half, so that a piece of the edge
# remains: vertices nearly on top of each other would be an edge without a direction.
_SHARE = 0.49


def turn(before: Vertex, corner: Vertex, after: Vertex) -> float:
    """Return by how much the way turns at a corner, in (-pi, pi], positive to the left [rad]."""
    ax, ay = corner[0] - before[0], corner[1] - before[1]
    bx, by = after[0] - corner[0], after[1] - corner[1]
    return math.atan2(ax * by - ay * bx, ax * bx + ay * by)


def rounded(ring: Sequence[Vertex], radius: float, angle: float, step: float) -> Iterator[Vertex]:
    """Yield the vertices of a ring whose corners sharper than an angle are arcs.

        t = r tan(turn / 2)

    Args:
        ring: vertices in order, not closed [m].
        radius: r of the arcs, where the edges are long enough for t [m].
        angle: greatest turn that is left alone [rad].
        step: greatest turn between two chords [rad].

    Yields:
        The vertices; those that are not sharp are the very same values.
    """
    n = len(ring)
    turns = [turn(ring[i - 1], ring[i], ring[(i + 1) % n]) for i in range(n)]
    sharp = [abs(value) > angle for value in turns]
    lengths = [math.dist(ring[i], ring[(i + 1) % n]) for i in range(n)]
    for i, corner in enumerate(ring):
        if not sharp[i]:
            yield corner
            continue
        before = lengths[i - 1] * (_SHARE if sharp[i - 1] else 2.0 * _SHARE)
        after = lengths[i] * (_SHARE if sharp[(i + 1) % n] else 2.0 * _SHARE)
        tangent = min(radius * math.tan(0.5 * abs(turns[i])), before, after)
        yield from _arc(ring[i - 1], corner, ring[(i + 1) % n], turns[i], tangent, step)


def _arc(before: Vertex, corner: Vertex, after: Vertex, turned: float, tangent: float, step: float) -> Iterator[Vertex]:
    """Yield points on the arc that leaves both edges at the tangent length from their corner."""
    length = math.dist(before, corner)
    ux, uy = (corner[0] - before[0]) / length, (corner[1] - before[1]) / length
    radius = tangent / math.tan(0.5 * abs(turned))
    side = math.copysign(1.0, turned)
    x, y = corner[0] - tangent * ux, corner[1] - tangent * uy
    pieces = max(math.ceil(abs(turned) / step - 1e-9), 1)
    for k in range(pieces):
        along = radius * math.sin(abs(turned) * k / pieces)
        across = side * radius * (1.0 - math.cos(abs(turned) * k / pieces))
        yield x + along * ux - across * uy, y + along * uy + across * ux
    # The last point from its own edge: rounding in the arc must not bend that edge.
    length = math.dist(corner, after)
    yield (
        corner[0] + tangent * (after[0] - corner[0]) / length,
        corner[1] + tangent * (after[1] - corner[1]) / length,
    )
