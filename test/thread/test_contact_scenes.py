"""The thread among shapes that are hard on it, on random motions, and input about contact that is bad."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pytest

from magnetosuture_thread import Disc, NeedlePose, NeedleSafetyFilter, Polygon, Scene, ThreadPredictor
from magnetosuture_thread.geometry.obstacles import Workspace
from magnetosuture_thread.geometry.scene import Dish, SceneShape

RATE = 60.0
DEPTH = 1.01e-7  # m; the tolerance to which a step ends
EAST = np.array([1.0, 0.0])
START = np.array([-9e-3, -9e-3])
SEGMENTS = 30


def scene_of(*shapes: Disc | Polygon, friction: float = 0.0) -> Scene:
    named = tuple(SceneShape(f"shape_{k}", "tissue", shape, friction=friction) for k, shape in enumerate(shapes))
    return Scene(Dish(0.035, 0.003, self_contact=False, wall_friction=friction), named)


def polygon(*corners: tuple[float, float]) -> Polygon:
    """Return a polygon from corners in millimetres."""
    return Polygon(tuple((1e-3 * x, 1e-3 * y) for x, y in corners))


SHAPES: dict[str, tuple[Disc | Polygon, ...]] = {
    "concave_corner": (polygon((3, -6), (9, -6), (9, 6), (5, 6), (5, -2), (3, -2)),),
    "thin_wedge": (polygon((0, 2), (9, 1.9), (9, 2.9)),),
    "gap": (Disc((5e-3, 2.04e-3), 2e-3), Disc((5e-3, -2.04e-3), 2e-3)),
    "corner_at_the_wall": (polygon((10, -20), (20, -20), (20, 20), (10, 20), (10, 14)),),
}


class Motion(NamedTuple):
    """What a random motion comes to: deepest point of a chord [m], greatest residual, steps without convergence."""

    depth: float
    residual: float
    unconverged: int


def moved_among(scene: Scene, seed: int, steps: int) -> Motion:
    """Return what a needle, a point that heads for random places, makes of its thread."""
    random = np.random.default_rng(seed)
    predictor = ThreadPredictor.create("silk_6_0", length=0.019, segments=SEGMENTS, scene=scene)
    needle = NeedleSafetyFilter(scene, keep_out=0.3e-3, approach_rate=20.0, hold_time=1.0 / RATE)
    near = Workspace(scene.obstacles, 3e-3, wall_radius=scene.dish.radius)
    tail, part = START.copy(), np.linspace(0.0, 1.0, 21)[:, None]
    predictor.start(NeedlePose(0.0, tail, EAST), tail + 1e-3 * np.array([(0, 0), (-1, 0), (-1, 18)]))
    goal, depth, residual, unconverged = random.uniform(-11e-3, 11e-3, 2), -math.inf, 0.0, 0
    for k in range(1, steps + 1):
        away = goal - tail
        if np.linalg.norm(away) < 1e-3 or random.uniform() < 0.012:
            goal = random.uniform(-11e-3, 11e-3, 2)
        wanted = 6e-3 * away / np.linalg.norm(away) + 1.5e-3 * random.standard_normal(2)
        tail = tail + needle.filter(wanted, tail, EAST).filtered / RATE
        prediction = predictor.step(NeedlePose(k / RATE, tail, EAST))
        residual, unconverged = max(residual, prediction.residual), unconverged + (not prediction.converged)
        nodes = prediction.positions
        points = ((1.0 - part) * nodes[:-1, None] + part * nodes[1:, None]).reshape(-1, 2)
        gap = float(near.near(points).distance.min(initial=np.inf)) - 0.5 * predictor.thread.diameter
        depth = max(depth, -gap)
    return Motion(depth, residual, unconverged)


@pytest.mark.parametrize("friction", [0.0, 0.3])
@pytest.mark.parametrize("name", SHAPES)
def test_on_random_motions_no_chord_is_in_a_shape(name: str, friction: float):
    done = moved_among(scene_of(*SHAPES[name], friction=friction), 211, 250)
    # A chord between two nodes on a disc dips in by D^2 / 8 R.
    dip = (0.019 / SEGMENTS) ** 2 / (8.0 * 2e-3) if name == "gap" else 0.0
    assert done.depth <= DEPTH + dip
    assert done.residual < 1e-6
    assert done.unconverged == 0
