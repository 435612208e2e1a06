"""A step of the formulation `rod` in compiled code, for as long as the structured solver gets on with it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.obstacles import WorkspaceData
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.barriers.wall import moved_inside
from magnetosuture_thread.model.formulations.rod_program import LONGEST_RATIO, Rod, assemble
from magnetosuture_thread.model.formulations.step import StepBuffers, driven, remember_push
from magnetosuture_thread.model.program import ChainProgram, Vector
from magnetosuture_thread.model.solvers import banded

ENDED, NO_ROOM, UNSOLVED = range(3)  # how far `go_on` got


class Motion(NamedTuple):
    """A step under way, in units of the segment length; kept from step to step, so that none pays for memory.

    Attributes:
        before: where the nodes are, shape (n + 1, d).
        start: the same with the driven nodes moved.
        last: velocities over the last step.
        velocities: those of this step, better with each solve.
        about: where they lead.
        known: the driven nodes, shape (n + 1,).
    """

    before: Points
    start: Points
    last: Points
    velocities: Points
    about: Points
    known: NDArray[np.bool_]

    @classmethod
    def of(cls, nodes: int, dimension: int) -> Motion:
        """Return memory for every step of a thread."""
        before, start, last, velocities, about = np.zeros((5, nodes, dimension))
        return cls(before, start, last, velocities, about, np.zeros(nodes, dtype=np.bool_))


@compiled
def set_out(
    motion: Motion,
    positions: Points,
    velocities: Points,
    nodes: NDArray[np.int64],
    ends: Points,
    unit: float,
    interval: float,
    last_interval: float,
) -> None:
    """Begin a step, about where the thread would be if it moved on as it did: a guess of second order.

    Not after a step that was much shorter, where the velocities may be those of a sample's noise, and not
    farther than a segment: then the guess is where the thread is.

    Args:
        motion: written.
        positions: of all nodes, shape (n + 1, d) [m].
        velocities: over the last step [m/s].
        nodes: that are driven, shape (k,).
        ends: where these are at the end of the step, shape (k, d) [m].
        unit: D [m].
        interval: dt [s].
        last_interval: of the last step, 0 if there was none [s].
    """
    motion.before[:], motion.last[:] = positions / unit, velocities / unit
    motion.velocities[:] = motion.last
    motion.start[:], motion.known[:] = driven(motion.before, nodes, ends, unit)
    motion.about[:] = motion.start
    if not (last_interval > 0.0 and interval <= LONGEST_RATIO * last_interval):
        return
    for i in range(len(positions)):
        for a in range(positions.shape[1]):
            if not motion.known[i]:
                motion.about[i, a] = motion.start[i, a] + interval * motion.last[i, a]
                if not abs(motion.about[i, a] - motion.start[i, a]) <= 1.0:
                    motion.about[:] = motion.start
                    return


@compiled
def go_on(
    axes: tuple[int, ...],
    rod: Rod,
    memory: StepBuffers,
    workspace: WorkspaceData,
    buffers: banded.Buffers,
    motion: Motion,
    positions: Points,
    velocities: Points,
    nodes: NDArray[np.int64],
    ends: Points,
    heading: Points,
    interval: float,
    last_interval: float,
    tolerance: float,
    most_solves: int,
    solves: int,
) -> tuple[int, int, int, float, int, tuple[float, float, float]]:
    """Linearise and solve until the barriers are exact, or the solves are too many, or as far as it gets.

    Args:
        axes: 0 to d - 1.
        rod: the thread.
        memory: has the program in the end, and its multipliers.
        workspace: obstacles and wall [m].
        buffers: of the structured solver; one without iterations leaves every solve to the caller.
        motion: where the step has got to; written.
        positions: see `set_out`, as are the following.
        velocities: over the last step [m/s].
        nodes: that are driven, shape (k,).
        ends: where these are at the end of the step, shape (k, d) [m].
        heading: unit vector along the needle at the end of the step, shape (d,).
        interval: dt [s].
        last_interval: of the last step, 0 if there was none [s].
        tolerance: the largest residual with which a solution is accepted.
        most_solves: of a step.
        solves: how many this step has had; with none it sets out.

    Returns:
        `ENDED`, `NO_ROOM` for all contacts in the memory, or `UNSOLVED`, and then the program is there for
        another solver; the number of contacts; solves; how far off the barriers are, see `assemble`; the
        first status that is not 0, see `banded.STATUS`; the largest residual of each kind.
    """
    if solves == 0:
        set_out(motion, positions, velocities, nodes, ends, rod.unit, interval, last_interval)
    worst, status, segments = (0.0, 0.0, 0.0), 0, len(motion.about) - 1
    while True:
        contacts, off = assemble(
            solves,
            rod,
            memory,
            workspace,
            motion.about,
            motion.start,
            motion.before,
            motion.last,
            motion.known,
            heading,
            interval,
            last_interval,
        )
        if contacts < 0:
            return NO_ROOM, contacts, solves, off, status, worst
        if off <= 1.0 or solves == most_solves:
            if off > 1.0:  # whatever else holds, nothing passes the wall
                moved_inside(motion.about, motion.known, (workspace.wall_radius - rod.radius) / rod.unit)
            return ENDED, contacts, solves, off, status, worst
        if buffers.iterations == 0:
            return UNSOLVED, contacts, solves, off, status, worst
        rows = segments + contacts
        program = ChainProgram(
            memory.blocks,
            memory.couplings,
            memory.linear,
            motion.known,
            memory.first[:rows],
            memory.gradient[:rows],
            memory.lower[:rows],
            memory.upper[:rows],
            memory.compliance[:rows],
        )
        u, multipliers = motion.velocities.copy(), memory.multipliers[:rows].copy()
        word, _, found = banded.solve_and_judge(axes, program, u, multipliers, buffers)
        if not max(found) <= tolerance:
            return UNSOLVED, contacts, solves, off, status, worst
        take(memory, motion, u, multipliers, interval)
        worst = (max(worst[0], found[0]), max(worst[1], found[1]), max(worst[2], found[2]))
        status, solves = status if status != 0 else word, solves + 1


@compiled
def take(memory: StepBuffers, motion: Motion, velocities: Points, multipliers: Vector, interval: float) -> None:
    """Take a solution: its velocities, where they lead, and its multipliers as a guess for the next one."""
    segments = len(velocities) - 1
    memory.multipliers[: len(multipliers)] = multipliers
    remember_push(memory.node, multipliers[segments:], memory.push)
    motion.velocities[:] = velocities
    motion.about[:] = motion.start + interval * velocities  # known nodes have moved, and have no velocity
