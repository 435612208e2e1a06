"""A scene with every shape, for tests."""

from __future__ import annotations

from typing import Any

from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.geometry.scene_files import scene_from_mapping

SECTOR = {"center": [0.0, -0.005], "inner_radius": 0.0077, "outer_radius": 0.0111, "start_angle": 3.5, "end_angle": 6.0}
SQUARE = [[-0.004, 0.008], [0.004, 0.008], [0.0041, 0.014], [-0.004, 0.014]]
SHAPES: dict[str, Any] = {
    "post": {"disc": {"center": [0.0077, 0.0039], "radius": 0.0015}, "kind": "instrument"},
    "ring": {"annulus": {"center": [-0.008, 0.0], "inner_radius": 0.001, "outer_radius": 0.002}},
    "left side": {"annular_sector": {**SECTOR, "inset": 0.0004}, "corner_radius": 0.0006, "kind": "tissue"},
    "gripper": {"capsule": {"start": [0.01, 0.0], "end": [0.02, -0.001], "radius": 0.0004}, "kind": "instrument"},
    "Brücke": {"rectangle": {"center": [0.0, 0.0], "width": 0.003, "height": 0.001, "angle": 0.3}, "kind": "wall"},
    "block": {
        "polygon": {"outline": SQUARE, "holes": [[[0.001, 0.01], [0.002, 0.01], [0.001, 1.1e-2]]]},
        "corner_radius": 1e-4,
        "kind": "tissue",
    },
}


def every_shape() -> Scene:
    """Return a scene with one of each shape."""
    return scene_from_mapping({"dish": {"diameter": 0.05, "depth": 0.004}, "shapes": SHAPES})
