"""How a thread goes on from where another was."""

from __future__ import annotations

import numpy as np

from magnetosuture_thread.geometry.polyline import chain_along
from magnetosuture_thread.model.formulations import ThreadState
from magnetosuture_thread.model.thread import Thread


def resample_state(state: ThreadState, before: Thread, thread: Thread) -> ThreadState:
    """Return the state of a thread that takes another's place: it lies where that lay and moves as that moved.

    A longer one goes on straight at its end. Where segments and length are the same, nothing changes.

    Args:
        state: of the thread before.
        before: the thread before.
        thread: the thread that takes its place.
    """
    if (thread.segments, thread.length) == (before.segments, before.length):
        return state
    positions = chain_along(state.positions, thread.segments, thread.segment_length)
    at = thread.segment_length * np.arange(thread.segments + 1)
    nodes = before.segment_length * np.arange(before.segments + 1)
    velocities = np.column_stack([np.interp(at, nodes, along) for along in state.velocities.T])
    return ThreadState(positions, velocities, state.interval)
