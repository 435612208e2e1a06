"""Coil currents whose motion of the needle the safety filter certifies."""

from __future__ import annotations

import math

import numpy as np
import pytest

from magnetosuture_thread.coils.certified_allocation import CertifiedAllocation
from magnetosuture_thread.coils.motion_observer import MotionDisturbance
from magnetosuture_thread.coils.pose_extrapolator import Pose
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.geometry.obstacles import Polygon
from magnetosuture_thread.scene import Dish, Scene, SceneShape

SETTINGS = CoilBridgeSettings(motion_compensation=True, needle_length=0.0025, keep_out=2.5e-4)
HEADING = 0.6  # rad; off the axes of the coils, where there is a force across the needle
E = np.array([math.cos(HEADING), math.sin(HEADING)])
LEFT = np.array([-E[1], E[0]])


def block(side: float) -> Scene:
    """Return a dish with a block beside the needle, which lies in the middle: on its left (1) or right (-1)."""
    corners = [a * E + side * b * LEFT for a, b in ((-4e-3, 0.0), (4e-3, 0.0), (4e-3, 2e-3), (-4e-3, 2e-3))]
    polygon = Polygon(tuple((float(x), float(y)) for x, y in corners))
    return Scene(Dish(0.05), (SceneShape("block", "wall", polygon),))


@pytest.mark.parametrize("pull", [0.0, 8e-4])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_needle_too_close_to_a_block_leaves_it_sideways_against_what_pulls_it(side: float, pull: float):
    scene = block(side)
    safety, coils = SETTINGS.safety_filter(scene), CertifiedAllocation(SETTINGS.allocation(), SETTINGS.max_speed)
    pose = Pose(-1.25e-3 * E - side * 2e-4 * LEFT, E)  # 0.05 mm closer than keep_out
    disturbance = MotionDisturbance(0.0, side * pull)
    found, _ = coils.allocate(1e-3 * E, pose, safety, coils.zero(), math.inf, disturbance, np.zeros(2))
    assert -side * (found.drift + disturbance.drift) > 5e-4
    share, _ = safety.safe_share(
        found.velocity + disturbance.velocity(E), pose.tail, pose.heading, found.drift + disturbance.drift
    )
    assert share == 1.0


def test_a_needle_that_has_enough_clearance_is_not_taken_off_sideways():
    safety, coils = SETTINGS.safety_filter(block(1.0)), CertifiedAllocation(SETTINGS.allocation(), SETTINGS.max_speed)
    pose = Pose(-1.25e-3 * E - 4e-4 * LEFT, E)
    found, _ = coils.allocate(1e-3 * E, pose, safety, coils.zero(), math.inf, MotionDisturbance(), np.zeros(2))
    assert abs(found.drift) < 1e-4
