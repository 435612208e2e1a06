"""A short needle among tissue: what the hernia scenario shows to the camera."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from magnetosuture_thread.rig.setups import read_setup
from magnetosuture_thread.vision.tracker import State, VisionTracker

# Around the ring and out through the penetration path again, where the needle comes back beside it [um].
AROUND_AND_OUT = """
    1899 -1278  3384 -134  4704 1194  5641 2810  6041 4635  5864 6495  5129 8213  3905 9624  2308 10594  492 11031
    -1372 10893  -3104 10194  -4541 9000  -5545 7424  -6021 5617  -5922 3751  -5258 2005  -4144 500  -2844 -850
    -1568 -2223  -532 -3782  153 -5524  558 -7354  768 -9217  864 -11089  909 -12964
"""


def test_a_needle_whose_tip_touches_its_own_thread_is_never_reversed():
    """From a campaign: three such frames in a row were taken for a needle the other way round, which it then became."""
    setup = read_setup("hernia_ring")
    camera, tracker = setup.rig.camera(setup.scene), VisionTracker(setup.vision, setup.scene)
    tracked, begin, end = 0, np.array([0.00057, -0.002107, -1.8651]), np.array([0.000355, -0.002528, -1.7036])
    for frame in range(16):
        x, y, heading = begin + frame / 12 * (end - begin)
        tail = np.array([x, y])
        nodes = np.vstack([tail, 1e-6 * np.array(AROUND_AND_OUT.split(), float).reshape(-1, 2)])
        at = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(nodes, axis=0).T))])
        thread = CubicSpline(at, nodes)(np.linspace(0.0, at[-1], 161))
        seen = tracker.track(camera.render(tail, heading, thread), frame / 20)
        if seen.state is not State.TRACKED:
            continue
        tracked += 1
        turned = np.arctan2(seen.heading[1], seen.heading[0]) - heading
        assert abs(np.remainder(turned + np.pi, 2.0 * np.pi) - np.pi) < np.radians(10.0)
        assert np.linalg.norm(seen.tail - tail) < 3.0 * np.sqrt(np.trace(seen.covariance[:2, :2]))
    assert tracked >= 12
