"""Settings of the coil bridge: what fits together, and where the needle may be."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.obstacles import Disc, Polygon

SQUARE = (0.004, 0.004, 0.008, 0.004, 0.008, 0.008, 0.004, 0.008)
HOLE = (0.005, 0.005, 0.007, 0.005, 0.007, 0.007, 0.005, 0.007)


def test_obstacles_are_discs_then_polygons_with_their_holes():
    settings = CoilBridgeSettings(
        disc_obstacles=(-0.005, 0.0, 0.001), polygon_obstacles=SQUARE + HOLE, polygon_sizes=(4, -4)
    )
    disc, polygon = settings.obstacles()
    assert disc == Disc((-0.005, 0.0), 0.001)
    assert isinstance(polygon, Polygon)
    assert len(polygon.outline) == 4  # sharp, as it is no thread that lies against it
    assert len(polygon.holes) == 1


def test_the_workspace_has_dish_obstacles_and_clearance():
    settings = CoilBridgeSettings(disc_obstacles=(-0.005, 0.0, 0.001), keep_out=0.001, approach_rate=5.0)
    workspace, east = settings.workspace(), np.array([1.0, 0.0])
    assert workspace.clearance(np.array([0.0, 0.0]), east) == pytest.approx(0.004)
    found = workspace.safe_velocity(np.array([0.02, 0.0]), np.array([0.0085, 0.0]), east)
    np.testing.assert_allclose(found, [5.0 * 0.001, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"polygon_obstacles": SQUARE}, r"coil_bridge\.polygon_sizes: .* 4 in all"),
        ({"polygon_obstacles": SQUARE, "polygon_sizes": (-4,)}, "an outline before its holes"),
        ({"disc_obstacles": (0.0, 0.0, -0.001)}, r"coil_bridge\.disc_obstacles: got -0\.001, .* positive radius"),
        ({"keep_out": 0.0145}, r"coil_bridge\.keep_out: got 0\.0145, expected less than 0\.014 m"),
        ({"approach_rate": 250.0}, r"coil_bridge\.approach_rate: got 250\.0, expected at most .* 200 1/s"),
        ({"coil_angles": (0.0, 1.0)}, "at least 3 coils"),
        ({"coil_model": "points"}, "one of loops, dipoles"),
        ({"calibration": "nowhere.yaml"}, r"coil_bridge\.calibration, nowhere\.yaml: coil calibration: .*No such file"),
        ({"calibration": "~nobody_of_this_name/rig.yaml"}, r"coil_bridge\.calibration"),
    ],
)
def test_what_does_not_fit_together_is_refused(change: dict, words: str):
    with pytest.raises(ConfigurationError, match=words):
        CoilBridgeSettings(**change)
