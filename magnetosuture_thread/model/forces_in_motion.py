"""Forces of the thread while the needle moves with a given velocity, in place of the mean one of a step."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from magnetosuture_thread.errors import SolverError
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.forces import ThreadForces
from magnetosuture_thread.model.formulations import Formulation, PrescribedMotion, ThreadState
from magnetosuture_thread.model.formulations.step import WarmStart
from magnetosuture_thread.model.prediction import NeedlePose

MOTION_TIME = 4e-3  # s; shorter, what the pose's noise bends counts for more, and longer, the thread has gone on


def forces_in_motion(
    formulation: Formulation,
    state: ThreadState,
    pose: NeedlePose,
    prescribed: Sequence[tuple[int, Points]],
    warm_start: WarmStart,
) -> ThreadForces | None:
    """Return the forces at a pose while the needle moves as `pose.motion` says; None where a step finds none.

    They are those of a short step of first order on from the state: the drag is that of the present velocity, and not
    of the way since the last pose, which has the noise of two poses. Nothing is changed by it.

    Args:
        formulation: that has led to the state.
        state: of the thread at the pose.
        pose: in the plane, with its motion.
        prescribed: prescribed nodes, each with its mean velocity over the last step [m/s]; that of node 0 is not used.
        warm_start: of the formulation after the step to the state.
    """
    motion = pose.motion
    assert motion is not None
    angle = math.atan2(pose.heading[1], pose.heading[0]) + motion.turning * MOTION_TIME
    heading = np.array([math.cos(angle), math.sin(angle)])
    nodes = tuple(node for node, _ in prescribed)
    velocities = np.array([motion.velocity if node == 0 else velocity for node, velocity in prescribed])
    moved = PrescribedMotion(nodes, state.positions[list(nodes)] + MOTION_TIME * velocities, heading, pose.stamp)
    # After a much shorter step nothing is extrapolated from the last velocities.
    begin = ThreadState(state.positions, state.velocities, 0.1 * MOTION_TIME)
    kept = formulation.warm_start()
    formulation.restore(warm_start)
    try:
        done = formulation.step(begin, moved, MOTION_TIME)
    except SolverError:
        return None
    finally:
        formulation.restore(kept)
    return formulation.forces(done, heading) if done.converged else None
