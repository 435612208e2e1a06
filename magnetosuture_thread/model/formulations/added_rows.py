"""The rows of the barriers that users add, as rows of a step's program."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.barrier import Barrier, BarrierRows
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.program import SPAN, ChainProgram, Vector, WideRows

DISTANCE_TOLERANCE = 1e-7  # m; a row that is met but for this much of its nodes' way holds
UNMET_COMPLIANCE = 1e-7  # compliance of a hard row that has to be met from outside; something else may hold against it


@dataclass(frozen=True)
class LinearRows:
    """Linearised rows of all added barriers, in units of the segment length.

    Attributes:
        nodes: the nodes of each row, padded by repeating the last with gradient 0, shape (r, k).
        gradient: a_r at these nodes, a unit vector over all of them, shape (r, k, d).
        lower: of a_r' u, shape (r,).
        compliance: shape (r,).
        off: how far the hard rows are from being met over what is allowed; 1 or less if they hold.
    """

    nodes: NDArray[np.int64]
    gradient: NDArray[np.float64]
    lower: Vector
    compliance: Vector
    off: float

    def joined(self, program: ChainProgram) -> tuple[ChainProgram, WideRows | None]:
        """Return a program with the rows that fit into its band at its end, and the others."""
        count, nodes = len(self.lower), len(program.linear)
        narrow = self._narrow()
        first = np.minimum(self.nodes.min(axis=1, initial=nodes), nodes - SPAN)[narrow]
        gradient = np.zeros((len(first), SPAN, program.linear.shape[1]))
        row = np.arange(len(first))[:, None]
        np.add.at(gradient, (row, self.nodes[narrow] - first[:, None]), self.gradient[narrow])
        program = program._replace(
            first=np.concatenate([program.first, first]),
            gradient=np.concatenate([program.gradient, gradient]),
            lower=np.concatenate([program.lower, self.lower[narrow]]),
            upper=np.concatenate([program.upper, np.full(len(first), np.inf)]),
            compliance=np.concatenate([program.compliance, self.compliance[narrow]]),
            limit=np.concatenate([program.limit, np.full(len(first), np.inf)]),
        )
        if len(first) == count:
            return program, None
        rest = ~narrow
        return program, WideRows(self.nodes[rest], self.gradient[rest], self.lower[rest], self.compliance[rest])

    def force(self, multipliers: Vector, shape: tuple[int, ...]) -> Points:
        """Return sum_r a_r lambda_r, shape (n + 1, d), with the multipliers in the order of `joined`."""
        order, force = np.argsort(~self._narrow(), kind="stable"), np.zeros(shape)
        np.add.at(force, self.nodes[order], self.gradient[order] * multipliers[:, None, None])
        return force

    def _narrow(self) -> NDArray[np.bool_]:
        """Return which rows fit into the band."""
        low, high = self.nodes.min(axis=1, initial=np.iinfo(np.int64).max), self.nodes.max(axis=1, initial=0)
        return np.asarray(high - low < SPAN)


class AddedBarriers:
    """The barriers that a user has added to a formulation, over one step after the other.

    Args:
        barriers: in the order in which margins list them.
        segment_length: D [m].

    Attributes:
        first_time: stamp of the needle's first pose [s].
    """

    def __init__(self, barriers: Sequence[Barrier], segment_length: float) -> None:
        self._barriers, self._unit = tuple(barriers), segment_length
        self._before: list[Vector | None] = [None] * len(self._barriers)
        self._start = np.empty((0, 0))
        self.first_time = math.inf

    def __bool__(self) -> bool:
        """Return whether there are any."""
        return bool(self._barriers)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the barriers, in their order."""
        return tuple(barrier.name for barrier in self._barriers)

    def rows(self, positions: Points) -> list[BarrierRows]:
        """Return the rows of each barrier at positions of shape (n + 1, d) [m]."""
        return [barrier.rows(positions) for barrier in self._barriers]

    def set_time(self, time: float) -> None:
        """Set the time of the next evaluation, a stamp [s]."""
        for barrier in self._barriers:
            barrier.move_to(time, self.first_time)

    def begin(self, positions: Points, time: float, interval: float) -> None:
        """Begin a step: keep h(x) of the barriers whose gain does not let it fall to 0 within it.

        Args:
            positions: of all nodes before the step, shape (n + 1, d) [m].
            time: at the end of the step [s].
            interval: dt [s].
        """
        self._start = positions
        self.set_time(time - interval)
        for index, barrier in enumerate(self._barriers):
            slow = barrier.gain * interval < 1.0
            self._before[index] = np.asarray(barrier.value(positions), dtype=np.float64) if slow else None
        self.set_time(time)

    def linearised(self, about: Points, start: Points, known: NDArray[np.bool_], interval: float) -> LinearRows:
        """Return the rows of all barriers about a predicted end point.

            a' u >= ((1 - alpha dt) h(x) - h(y) - grad h(y)' (start - y)) / (|grad h| dt),    a = grad h / |grad h|

        A row that no unknown can change is left out.

        Args:
            about: y, shape (n + 1, d) [D].
            start: where the nodes are once those of a known motion have moved, shape (n + 1, d) [D].
            known: those of a known motion, shape (n + 1,).
            interval: dt [s].
        """
        found = [self._of(barrier, before, about, start, known, interval) for barrier, before in self._pairs()]
        if len(found) == 1:
            return found[0]
        width = max((rows.nodes.shape[1] for rows in found), default=1)
        padded = [np.pad(rows.nodes, ((0, 0), (0, width - rows.nodes.shape[1])), mode="edge") for rows in found]
        zeros = [np.pad(rows.gradient, ((0, 0), (0, width - rows.nodes.shape[1]), (0, 0))) for rows in found]
        return LinearRows(
            np.concatenate(padded),
            np.concatenate(zeros),
            np.concatenate([rows.lower for rows in found]),
            np.concatenate([rows.compliance for rows in found]),
            max(rows.off for rows in found),
        )

    def _pairs(self) -> list[tuple[Barrier, Vector | None]]:
        return list(zip(self._barriers, self._before, strict=True))

    def _of(
        self,
        barrier: Barrier,
        before: Vector | None,
        about: Points,
        start: Points,
        known: NDArray[np.bool_],
        interval: float,
    ) -> LinearRows:
        rows = barrier.rows_after(self._start, about * self._unit)
        gradient = np.where(known[rows.nodes][:, :, None], 0.0, rows.gradient)
        slope = np.sqrt(np.einsum("rkd,rkd->r", gradient, gradient))
        free = slope > 0.0
        nodes, gradient, slope = rows.nodes[free], gradient[free], slope[free]
        wanted = np.zeros(len(slope))
        # A barrier whose number of rows changes with time decays as fast as a step allows.
        if before is not None and before.shape == rows.value.shape:
            wanted = (1.0 - barrier.gain * interval) * before[free]
        missing = (wanted - rows.value[free]) / slope  # m
        gradient = gradient / slope[:, None, None]
        moved = np.einsum("rkd,rkd->r", gradient, (start - about)[nodes])
        lower = (missing / self._unit - moved) / interval
        soft = 1.0 / barrier.slack_weight
        compliance = np.where(lower > 0.0, max(soft, UNMET_COMPLIANCE), soft)
        off = float(missing.max(initial=0.0)) / DISTANCE_TOLERANCE if math.isinf(barrier.slack_weight) else 0.0
        return LinearRows(nodes.astype(np.int64), gradient, lower, compliance, off)
