"""Friction of the simulated rig's thread."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.friction import DRAG, RADIUS, RATE, SPEED, around_post
from magnetosuture_thread import Disc
from magnetosuture_thread.rig.dynamics import NeedleBody, NeedleJoint, RigDynamics, Surface, ThreadProperties


@pytest.mark.parametrize("friction", [0.1, 0.4])
def test_the_rigs_thread_around_a_post_has_the_tensions_of_a_capstan(friction: float):
    """T_2 = T_1 exp(mu theta) + f r (exp(mu theta) - 1) / mu, with the drag f per length of the part on the post."""
    lead, segment = 2e-3, math.pi * RADIUS / 20
    segments = round(lead / segment) + 20 + 60
    nodes, drag = around_post(segment * np.arange(segments + 1), math.pi, lead), (2.0 * DRAG, DRAG)
    thread = ThreadProperties(segments * segment, segments, 1e-14, 5.65, *drag, NeedleJoint.PINNED, diameter=60e-6)
    surface = Surface((Disc((0.0, 0.0), 1e-3),), stiffness=5000.0, friction=friction)
    rig = RigDynamics(NeedleBody(2e-4, 5e-5, 0.0, 0.0, 1.0), thread, surface, None, nodes[0], 0.0, nodes)
    for k in range(1, 21):
        rig.drive(nodes[0] + np.array([SPEED * k / RATE, 0.0]), 0.0, 1.0 / RATE)
    along = np.diff(rig.thread, axis=0)
    angles = np.unwrap(np.arctan2(along[:, 1], along[:, 0]))
    bent = np.flatnonzero(np.abs(np.diff(angles)) > 0.02)
    first, last = bent[0], bent[-1] + 1  # segments before and behind the post
    gain = math.exp(friction * abs(angles[last] - angles[first]))
    wanted = rig.tension[last] * gain + DRAG * SPEED * RADIUS * (gain - 1.0) / friction
    assert rig.tension[first] == pytest.approx(wanted, rel=0.02)
