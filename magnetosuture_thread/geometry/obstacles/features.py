"""Boundary features of obstacles, as flat tables for the compiled search.

A row holds all numbers of one edge of a polygon, or of one face of a mesh with its edges and vertices, so that the
search reads memory in order. The constants are the offsets in a row.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.obstacles.shapes import Mesh, Polygon
from magnetosuture_thread.geometry.polyline import Points

EDGE_WIDTH = 14
"""Numbers of an edge: start, end, unit direction (2 each), length, unit direction of the edge before (2),
pseudo-normals at start and end (2 each), and one to fill."""

FACE_WIDTH = 39
"""Numbers of a face: vertices a, b, c, normal (3 each), then for the edges ab, bc, ca the direction from the
edge into the neighbour (3 each), the pseudo-normals of the edges, and those of the vertices."""

FACE_MARKS = 9
"""Integers of a face: for each edge whether its row is this face's to give; for each vertex the first of its
spokes, or -1 when its row is not this face's to give; for each vertex the one after its last spoke."""


@dataclass(frozen=True)
class Features:
    """Features of one obstacle.

    Attributes:
        numbers: rows of EDGE_WIDTH or FACE_WIDTH, shape (f, width).
        marks: rows of FACE_MARKS, shape (f, 9); for edges none, shape (0, 9).
        spokes: unit vectors from a vertex along each of its edges, shape (s, 3); for edges none.
        corners: vertices of the features, shape (f, 2, 2) or (f, 3, 3) [m].
    """

    numbers: Points
    marks: NDArray[np.int64]
    spokes: Points
    corners: NDArray[np.float64]


def edges_of(polygon: Polygon) -> Features:
    """Return the edges of a polygon.

        n = (d_y, -d_x)    outward normal of an edge with direction d, as the solid is to the left

    A vertex's pseudo-normal is the mean of the normals of its two edges.

    Source: J. A. Baerentzen, H. Aanaes 2005, the plane's counterpart of angle-weighted normals.
    """
    tables, corners = [], []
    for start in polygon.rings:
        end = np.roll(start, -1, axis=0)
        length = np.hypot(*(end - start).T)
        along = (end - start) / length[:, None]
        before = np.roll(along, 1, axis=0)
        pseudo = np.stack([along[:, 1] + before[:, 1], -along[:, 0] - before[:, 0]], axis=1)
        # At a needle's tip the two normals nearly cancel; the way there points out of the tip as well, or
        # at the tip of a needle-shaped notch into it.
        left = before[:, 0] * along[:, 1] - before[:, 1] * along[:, 0] > 0.0
        tip = np.linalg.norm(pseudo, axis=1) < 1e-6
        pseudo[tip] = np.where(left[tip, None], 1.0, -1.0) * (before - along)[tip]
        pseudo /= np.linalg.norm(pseudo, axis=1)[:, None]
        tables.append(
            np.hstack(
                [start, end, along, length[:, None], before, pseudo, np.roll(pseudo, -1, axis=0), 0.0 * length[:, None]]
            )
        )
        corners.append(np.stack([start, end], axis=1))
    return Features(np.vstack(tables), np.empty((0, FACE_MARKS), np.int64), np.empty((0, 3)), np.concatenate(corners))


def faces_of(mesh: Mesh) -> Features:
    """Return the faces of a mesh, with its edges and vertices.

        n_edge ~ n_1 + n_2,    n_vertex ~ sum over its faces of (angle of the face there) n_face

    Source: J. A. Baerentzen, H. Aanaes 2005, angle-weighted pseudo-normals.
    """
    faces, f = mesh.faces, len(mesh.faces)
    corners = mesh.vertices[faces]
    ways = np.roll(corners, -1, axis=1) - corners
    ways /= np.linalg.norm(ways, axis=2)[:, :, None]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    # From each edge into its own face; the neighbour has the same edge the other way round.
    into = np.cross(normal[:, None, :], ways)
    v = len(mesh.vertices)
    tails, heads = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    keys = tails * v + heads
    order = np.argsort(keys)
    twin = order[np.searchsorted(keys[order], heads * v + tails)]
    across = into.reshape(-1, 3)[twin].reshape(f, 3, 3)
    edge_normal = _unit(normal[:, None, :] + normal[twin // 3].reshape(f, 3, 3), across)
    back = -np.roll(ways, 1, axis=1)
    angle = np.arctan2(np.linalg.norm(np.cross(ways, back), axis=2), np.sum(ways * back, axis=2))
    weighted = np.zeros((v, 3))
    np.add.at(weighted, faces, angle[:, :, None] * normal[:, None, :])
    vertex_normal = _unit(weighted[faces], np.broadcast_to(normal[:, None, :], (f, 3, 3)))

    # Each directed edge is a spoke of its tail; on a closed surface these are all the edges of a vertex.
    by_tail = np.argsort(tails, kind="stable")
    first = np.searchsorted(tails[by_tail], faces, side="left")
    last = np.searchsorted(tails[by_tail], faces, side="right")
    # One face of each vertex gives its row: the one whose corner comes first.
    given = by_tail[first] == np.arange(3 * f).reshape(f, 3)
    marks = np.hstack([tails.reshape(f, 3) < heads.reshape(f, 3), np.where(given, first, -1), last])
    numbers = np.hstack(
        [corners.reshape(f, 9), normal, *(a.reshape(f, 9) for a in (across, edge_normal, vertex_normal))]
    )
    return Features(numbers, marks.astype(np.int64), ways.reshape(-1, 3)[by_tail], corners)


def _unit(vectors: NDArray[np.float64], otherwise: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return vectors of unit length, and another direction where they have no direction."""
    length = np.linalg.norm(vectors, axis=-1)[..., None]
    return np.where(length > 1e-12, vectors / np.where(length > 1e-12, length, 1.0), otherwise)
