"""Contacts in space, against closed formulas."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.geometry.obstacles import Disc, Mesh, Workspace
from magnetosuture_thread.geometry.obstacles.features import faces_of
from test.geometry.obstacles.triangles import closest_on_triangles

CORNERS = 0.01 * np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
     [1, 5, 7], [1, 7, 3]]
)  # fmt: skip
CUBE = Mesh(CORNERS, FACES)


def split(mesh: Mesh) -> Mesh:
    """Return the mesh with each face cut into four."""
    vertices, faces, halfway = mesh.vertices.tolist(), [], {}
    for a, b, c in mesh.faces.tolist():
        middle = []
        for edge in ((a, b), (b, c), (c, a)):
            key = tuple(sorted(edge))
            if key not in halfway:
                halfway[key] = len(vertices)
                vertices.append((0.5 * (mesh.vertices[edge[0]] + mesh.vertices[edge[1]])).tolist())
            middle.append(halfway[key])
        faces += [[a, middle[0], middle[2]], [middle[0], b, middle[1]], [middle[2], middle[1], c], middle]
    return Mesh(np.array(vertices), np.array(faces))


def ball(radius: float, splits: int) -> Mesh:
    """Return an icosahedron split and blown up to a sphere."""
    g = 0.5 * (1.0 + np.sqrt(5.0))
    corners = [(0, s, t * g) for s in (-1, 1) for t in (-1, 1)]
    vertices = np.array([np.roll(c, k) for k in range(3) for c in corners])
    near = np.isclose(np.linalg.norm(vertices[:, None] - vertices[None], axis=2), 2.0)
    faces = []
    for a in range(12):
        for b in range(a + 1, 12):
            for c in range(b + 1, 12):
                if near[a, b] and near[b, c] and near[a, c]:
                    out = np.linalg.det(vertices[[a, b, c]]) > 0.0
                    faces.append([a, b, c] if out else [a, c, b])
    mesh = Mesh(vertices, np.array(faces))
    for _ in range(splits):
        mesh = split(mesh)
    return Mesh(radius * mesh.vertices / np.linalg.norm(mesh.vertices, axis=1)[:, None], mesh.faces)


def cube_distance(points: np.ndarray) -> np.ndarray:
    q = np.abs(points - 0.005) - 0.005
    return np.linalg.norm(np.maximum(q, 0.0), axis=1) + np.minimum(q.max(axis=1), 0.0)


@pytest.mark.parametrize("reach", [0.0, 0.002, 0.02])
@pytest.mark.parametrize("splits", [0, 2])
def test_a_cube(reach: float, splits: int):
    mesh = CUBE
    for _ in range(splits):
        mesh = split(mesh)
    random = np.random.default_rng(0)
    # Also on a lattice: above edges, diagonals and vertices of faces.
    lattice = np.stack(np.meshgrid(*[np.linspace(-0.005, 0.015, 9)] * 3), axis=-1).reshape(-1, 3)
    points = np.vstack([random.uniform(-0.02, 0.03, (2000, 3)), lattice])
    contacts = Workspace([mesh], reach, 3).near(points)
    true = cube_distance(points)
    # A convex solid has one local minimum.
    assert contacts.node.tolist() == np.flatnonzero(true <= max(reach, 1e-12)).tolist()
    np.testing.assert_allclose(contacts.distance, true[contacts.node], atol=1e-15)
    assert contacts.nearest.all()
    np.testing.assert_allclose(np.linalg.norm(contacts.normal, axis=1), 1.0, atol=1e-12)
    foot = points[contacts.node] - contacts.distance[:, None] * contacts.normal
    np.testing.assert_allclose(cube_distance(foot), 0.0, atol=1e-12)
    off = contacts.distance > 1e-6
    step = 1e-7
    at = points[contacts.node[off]]
    slope = [(cube_distance(at + e) - cube_distance(at - e)) / (2.0 * step) for e in step * np.eye(3)]
    np.testing.assert_allclose(contacts.normal[off], np.stack(slope, axis=1), atol=1e-3)


@pytest.mark.parametrize("reach", [0.001, 0.02])
def test_a_ball(reach: float):
    mesh, radius = ball(0.01, 3), 0.01
    points = np.random.default_rng(1).uniform(-0.02, 0.02, (3000, 3))
    centre = np.linalg.norm(points, axis=1)
    contacts = Workspace([mesh], reach, 3).near(points)
    flat = radius * 0.006  # how far the faces are below the sphere at most
    assert set(np.flatnonzero(centre - radius < reach - flat).tolist()) <= set(contacts.node.tolist())
    assert ((centre - radius)[contacts.node] <= reach + flat).all()
    assert len(set(contacts.node.tolist())) == len(contacts)
    np.testing.assert_allclose(contacts.distance, (centre - radius)[contacts.node], atol=flat)
    # The exact ball beside it.
    exact = Workspace([Disc((0.0, 0.0, 0.0), radius)], reach, 3).near(points)
    distance, normal = Disc((0.0, 0.0, 0.0), radius).signed_distance(points[exact.node])
    np.testing.assert_allclose(exact.distance, distance, atol=1e-15)
    np.testing.assert_allclose(exact.normal, normal, atol=1e-12)


def test_an_inner_corner_is_two_contacts_and_an_inner_edge_none():
    # The L of the plane, as a prism.
    flat = 0.01 * np.array([[0, 0], [3, 0], [3, 1], [1, 1], [1, 3], [0, 3]], dtype=float)
    caps = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    vertices = np.vstack([np.hstack([flat, np.zeros((6, 1))]), np.hstack([flat, np.full((6, 1), 0.02)])])
    sides = [f for i in range(6) for j in [(i + 1) % 6] for f in ([i, j, j + 6], [i, j + 6, i + 6])]
    mesh = Mesh(vertices, np.vstack([caps[:, ::-1], caps + 6, sides]))
    workspace = Workspace([mesh], 0.005, 3)
    contacts = workspace.near(np.array([[0.013, 0.012, 0.0101], [0.009, 0.009, 0.01], [0.012, 0.02, 0.005]]))
    assert contacts.node.tolist() == [0, 0, 1, 2]
    assert sorted(np.round(contacts.distance[:2], 12).tolist()) == [0.002, 0.003]
    assert contacts.nearest.tolist().count(True) == 3
    # Inside, the inner edge is the nearest, and the way out goes to it.
    np.testing.assert_allclose(contacts.distance[2], -np.sqrt(2.0) * 0.001)
    np.testing.assert_allclose(contacts.normal[2], [np.sqrt(0.5), np.sqrt(0.5), 0.0], atol=1e-12)
    aslant = workspace.near(np.array([[0.0095, 0.009, 0.01]]))
    np.testing.assert_allclose(aslant.distance, -np.hypot(0.0005, 0.001))
    np.testing.assert_allclose(aslant.normal, [np.array([0.5, 1.0, 0.0]) / np.hypot(0.5, 1.0)], atol=1e-12)


def test_a_hollow_is_outside():
    shell = Mesh(
        np.vstack([3.0 * (CUBE.vertices - 0.005), CUBE.vertices - 0.005]),
        np.vstack([CUBE.faces, CUBE.faces[:, ::-1] + 8]),
    )
    workspace = Workspace([shell], 0.001, 3)
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0045], [0.0, 0.001, 0.009], [0.0, 0.0, 0.0155], [1.0, 1.0, 1.0]])
    contacts = workspace.near(points)
    assert contacts.node.tolist() == [1, 2, 3]
    np.testing.assert_allclose(contacts.distance, [0.0005, -0.004, 0.0005])


def winding(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    """Return how often the surface winds around each point: 1 inside, 0 outside."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]][None] - points[:, None] for i in range(3))
    x, y, z = (np.linalg.norm(v, axis=2) for v in (a, b, c))
    below = x * y * z + np.sum(a * b, 2) * z + np.sum(b * c, 2) * x + np.sum(c * a, 2) * y
    angles: np.ndarray = np.arctan2(np.sum(a * np.cross(b, c), 2), below)
    return angles.sum(axis=1) / (2.0 * np.pi)


@pytest.mark.parametrize("reach", [0.0005, 0.005])
def test_a_body_of_bumps_and_dents_by_definition(reach: float):
    round_ = ball(0.01, 2)
    x, y, z = round_.vertices.T
    mesh = Mesh(
        round_.vertices * (1.0 + 0.3 * np.sin(5.0 * np.arctan2(y, x)) * np.cos(300.0 * z))[:, None], round_.faces
    )
    points = np.random.default_rng(2).uniform(-0.016, 0.016, (400, 3))
    contacts = Workspace([mesh], reach, 3).near(points)
    feet = closest_on_triangles(points, mesh.vertices, mesh.faces)
    distance = np.linalg.norm(points[:, None] - feet, axis=2)
    inside = winding(mesh, points) > 0.5
    signed = np.where(inside, -1.0, 1.0) * distance.min(axis=1)
    assert set(contacts.node.tolist()) == set(np.flatnonzero(signed <= reach).tolist())
    np.testing.assert_allclose(contacts.distance[contacts.nearest], signed[contacts.node[contacts.nearest]], atol=1e-14)
    for i in np.flatnonzero(~inside).tolist():
        # A local minimum: the closest point of every face that it is on, seen from outside.
        near = np.flatnonzero(distance[i] <= reach)
        expected: list[np.ndarray] = []
        for foot in feet[i, near]:
            on = np.linalg.norm(closest_on_triangles(foot[None], mesh.vertices, mesh.faces)[0] - foot, axis=1) < 1e-12
            known = any(np.linalg.norm(foot - other) < 1e-10 for other in expected)
            if not known and (np.linalg.norm(feet[i, on] - foot, axis=1) < 1e-12).all():
                away = foot + 1e-7 * (points[i] - foot) / np.linalg.norm(points[i] - foot)
                if winding(mesh, away[None])[0] < 0.5:
                    expected.append(foot)
        rows = contacts.node == i
        found = points[i] - contacts.distance[rows, None] * contacts.normal[rows]
        assert len(found) == len(expected)
        for foot in expected:
            assert np.linalg.norm(found - foot, axis=1).min() < 1e-12


def test_each_edge_and_vertex_belongs_to_one_face():
    marks = faces_of(CUBE).marks
    assert marks[:, :3].sum() == 18
    assert (marks[:, 3:6] >= 0).sum() == 8
    assert (marks[:, 6:] - marks[:, 3:6])[marks[:, 3:6] >= 0].sum() == 36
