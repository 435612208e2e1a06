"""The thread at the wall, among shapes that are hard on it, and among more of them than there is room for."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread import (
    Disc,
    NeedlePose,
    NeedleSafetyFilter,
    Polygon,
    Scene,
    SceneShape,
    SolverError,
    ThreadForecaster,
    ThreadPredictor,
)
from magnetosuture_thread.estimator.association import MeasuredPoints
from magnetosuture_thread.estimator.correction import Corrector, Prior
from magnetosuture_thread.geometry.obstacles import Workspace
from magnetosuture_thread.geometry.scene import Dish
from magnetosuture_thread.thread.material import Attachment
from magnetosuture_thread.thread.program import CONTACTS_PER_NODE
from magnetosuture_thread.thread.rod import RodFormulation
from test.shared import known
from test.thread.scenes import DT, east, followed, formulated, polyamide, straight
from test.thread.worlds import scene_with

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


@pytest.mark.parametrize("friction", [0.0, 0.3])
@pytest.mark.parametrize("name", SHAPES)
def test_on_random_motions_no_chord_is_in_a_shape(name: str, friction: float):
    """The needle is a point that heads for random places."""
    scene, random = scene_of(*SHAPES[name], friction=friction), np.random.default_rng(211)
    predictor = ThreadPredictor.create("silk_6_0", length=0.019, segments=SEGMENTS, scene=scene)
    needle = NeedleSafetyFilter(scene, keep_out=0.3e-3, approach_rate=20.0, hold_time=1.0 / RATE)
    near = Workspace(scene.obstacles, 3e-3, wall_radius=scene.dish.radius)
    tail, part = START.copy(), np.linspace(0.0, 1.0, 21)[:, None]
    predictor.start(NeedlePose(0.0, tail, EAST), tail + 1e-3 * np.array([(0, 0), (-1, 0), (-1, 18)]))
    goal = random.uniform(-11e-3, 11e-3, 2)
    # A chord between two nodes on a disc dips in by D^2 / 8 R.
    dip = (0.019 / SEGMENTS) ** 2 / (8.0 * 2e-3) if name == "gap" else 0.0
    for k in range(1, 251):
        away = goal - tail
        if np.linalg.norm(away) < 1e-3 or random.uniform() < 0.012:
            goal = random.uniform(-11e-3, 11e-3, 2)
        wanted = 6e-3 * away / np.linalg.norm(away) + 1.5e-3 * random.standard_normal(2)
        tail = tail + needle.filter(wanted, tail, EAST).filtered / RATE
        prediction = predictor.step(NeedlePose(k / RATE, tail, EAST))
        assert prediction.converged
        assert prediction.residual < 1e-6
        nodes = prediction.positions
        points = ((1.0 - part) * nodes[:-1, None] + part * nodes[1:, None]).reshape(-1, 2)
        gap = float(near.near(points).distance.min(initial=np.inf)) - 0.5 * predictor.thread.diameter
        assert -gap <= DEPTH + dip


CROWD = [Disc((-0.0095, 0.1001), 0.1)] * 100  # whose surfaces are within a segment of each node of the thread


def test_more_contacts_than_there_is_room_for_are_refused_and_the_thread_stays_where_it_was():
    """A step, a forecast and a correction have room for `CONTACTS_PER_NODE` a node; margins take any number."""
    thread = polyamide()
    predictor = ThreadPredictor(thread, Workspace(CROWD, 1e-3))
    start = NeedlePose(0.0, np.zeros(2), EAST)
    before = predictor.start(start)
    assert len(before.margins["obstacle"]) == 100 * (thread.segments + 1) > CONTACTS_PER_NODE * (thread.segments + 1)
    moved = NeedlePose(0.02, 1e-5 * EAST, EAST)
    with pytest.raises(SolverError, match=f"more than {CONTACTS_PER_NODE * (thread.segments + 1)} contacts at once"):
        predictor.step(moved)
    assert predictor.pose is start
    np.testing.assert_array_equal(known(predictor.state).positions, before.positions)

    few = ThreadPredictor(thread, Workspace(CROWD[:10], 1e-3))
    few.start(start)
    assert few.step(moved).converged

    scene = scene_with(*CROWD)
    forecaster = ThreadForecaster(thread, scene)
    found = forecaster.forecast(forecaster.straight(start), 1e-3 * EAST, 0.1)
    assert "contacts at once" in found.problem
    assert len(found.vertices) == 1

    crowded = ThreadPredictor(thread, scene)
    assert isinstance(crowded.formulation, RodFormulation)
    density = np.full(thread.segments + 1, 1e-4)
    prior = Prior(before.positions / thread.segment_length, EAST, density, density, 2.0, 1.0)
    points = MeasuredPoints(np.arange(1.0, 20.0), *np.full((2, 19), 1e-3), *np.ones((3, 19)))
    refused = Corrector(crowded, crowded.formulation).solve(prior, points)
    assert f"more than {CONTACTS_PER_NODE} contacts a node" in refused.problem


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
