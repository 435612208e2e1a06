"""The wall of the dish: nothing passes it, and what slides along it is where a finer rod is."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.thread.material import Attachment
from test.thread.scenes import DT, east, followed, formulated, polyamide, straight

RADIUS = 0.0175
OUTSIDE = 1e-6  # m; farther outside of the dish no node may be


@pytest.mark.parametrize("attachment", Attachment)
@pytest.mark.parametrize("name", ["rod", "paper"])
@pytest.mark.parametrize("speed", [0.005, 0.1])
def test_a_thread_pushed_sideways_into_the_wall_slides_along_it(name: str, attachment: Attachment, speed: float):
    thread = polyamide(attachment)
    formulation = formulated(thread, name=name, wall=RADIUS)
    begin = straight(thread) + np.array([0.004, 0.012])
    steps = followed(formulation, begin, lambda k: begin[0] + min(k * speed * DT, 0.0045) * np.array([0.2, 1.0]), 100)
    distance = max(float(np.linalg.norm(done.state.positions[1:], axis=1).max()) for done in steps)
    assert -2e-5 < distance + 0.5 * thread.diameter - RADIUS < OUTSIDE
    assert all(done.converged for done in steps)
    wall = formulation.margins(steps[-1].state.positions, east())[-1]
    assert wall.barrier == "wall"
    assert wall.clearance[wall.node > 0].min() > -OUTSIDE
