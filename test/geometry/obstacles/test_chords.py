"""Contacts of segments between their nodes: against distances by shapely."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely

from magnetosuture_thread.geometry.chords import find_chord_contacts
from magnetosuture_thread.geometry.obstacles import Contacts, Obstacle, Polygon, Workspace

SQUARE = Polygon(((0.0, 0.0), (0.01, 0.0), (0.01, 0.01), (0.0, 0.01)))
REACH = 0.02  # of nodes; chords have a part of it
SEGMENT = 0.004


def rounded(radius: float, corners: int) -> Polygon:
    """Return a square with rounded corners, each of many vertices."""
    around = shapely.Polygon(SQUARE.outline).buffer(-radius).buffer(radius, quad_segs=corners)
    return Polygon(tuple(map(tuple, shapely.normalize(around).exterior.coords[:-1])))


def contacts(obstacle: Obstacle, start: np.ndarray, end: np.ndarray) -> list[tuple[float, float, np.ndarray]]:
    """Return distance, place and normal of every contact of one segment, the nearest first."""
    points, to = np.array([start, end]), Contacts.room(50, 2)
    data, clearance = Workspace((obstacle,), REACH).data, np.full(2, -np.inf)
    assert find_chord_contacts(points, data, SEGMENT, 0.0, -clearance, 0, to) == 0
    found = find_chord_contacts(points, data, SEGMENT, 0.0, clearance, 0, to)
    assert found >= 0
    return sorted(((to.distance[c], to.place[c], to.normal[c].copy()) for c in range(found)), key=lambda c: c[0])


@pytest.mark.parametrize("polygon", [SQUARE, rounded(0.003, 8), rounded(0.0005, 5)])
def test_a_chord_past_a_corner_has_its_distance(polygon: Polygon):
    shape = shapely.Polygon(polygon.outline)
    rng = np.random.default_rng(3)
    tried = 0
    for _ in range(400):
        middle = np.array([0.01, 0.01]) + rng.uniform(-0.0015, 0.001, 2)
        angle = rng.uniform(0.0, math.pi)
        along = 0.5 * SEGMENT * np.array([math.cos(angle), math.sin(angle)])
        start, end = middle - along, middle + along
        line = shapely.LineString([start, end])
        ends_out = min(shape.distance(shapely.Point(p)) for p in (start, end))
        true = shape.distance(line)
        if line.intersects(shape) or not 0.0 < true < min(2e-3, ends_out - 1e-6):
            continue  # crosses the shape, is far from it, or is nearest at an end
        tried += 1
        found = contacts(polygon, start, end)
        assert found[0][0] == pytest.approx(true, abs=1e-12)
        nearest = np.array(start) + found[0][1] * (end - start) - found[0][0] * found[0][2]
        assert shape.exterior.distance(shapely.Point(nearest)) < 1e-12
    assert tried > 20


DENTED = Polygon((*SQUARE.outline[:3], (0.005, 0.0099), SQUARE.outline[3]))


@pytest.mark.parametrize(
    ("polygon", "middle", "degrees"),
    [
        (SQUARE, (0.006, 0.0105), 0.0),  # ends before the corner
        (SQUARE, (0.0098, 0.0105), 20.0),  # its lower end is the nearest, to the edge on top ...
        (SQUARE, (0.0105, 0.0098), 70.0),  # ... and to the right one
        (SQUARE, (0.00845, 0.00845), -45.0),  # deeper than half of its length
        (DENTED, (0.005, 0.0101), 0.0),  # over a shallow dent
    ],
)
def test_a_corner_that_is_not_the_nearest_of_a_chord_is_no_contact(
    polygon: Polygon, middle: tuple[float, float], degrees: float
):
    along = 0.5 * SEGMENT * np.array([math.cos(math.radians(degrees)), math.sin(math.radians(degrees))])
    assert not contacts(polygon, np.array(middle) - along, np.array(middle) + along)
