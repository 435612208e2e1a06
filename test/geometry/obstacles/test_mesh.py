"""Meshes: what is refused, and which side is outside."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.obstacles import Mesh

CORNERS = 0.01 * np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
     [1, 5, 7], [1, 7, 3]]
)  # fmt: skip


def volume(mesh: Mesh) -> float:
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return float(np.sum(a * np.cross(b, c)) / 6.0)


@pytest.mark.parametrize("flip", [False, True])
def test_faces_end_up_counter_clockwise(flip: bool):
    mesh = Mesh(CORNERS, FACES[:, ::-1] if flip else FACES)
    assert volume(mesh) == pytest.approx(1e-6)
    with pytest.raises(ValueError, match="read-only"):
        mesh.vertices[0, 0] = 1.0


def changed(array: np.ndarray, place: tuple[int, ...], value: float) -> np.ndarray:
    copy = array.copy()
    copy[place] = value
    return copy


@pytest.mark.parametrize(
    ("vertices", "faces", "reason"),
    [
        (changed(CORNERS, (3, 1), np.nan), FACES, r"vertices\[3\].*finite"),
        (CORNERS * 2000.0, FACES, "is it in metres"),
        (CORNERS * 1e-5, FACES, "is it in metres"),
        (CORNERS[:, :2], FACES, r"shape \(v, 3\)"),
        (CORNERS, FACES.astype(float), "integers"),
        (CORNERS, FACES[:0], "f >= 1"),
        (CORNERS, changed(FACES, (4, 2), 8), r"faces\[4\].*0 to 7"),
        (CORNERS, changed(FACES, (4, 2), -1), r"faces\[4\].*0 to 7"),
        (CORNERS, changed(FACES, (4, 2), 0), r"faces\[4\].*not on one line"),
        (CORNERS, FACES[1:], "1 faces at the edge of vertices 0 and 1.*closed"),
        (CORNERS, np.vstack([FACES, FACES[:1]]), "3 faces at the edge"),
        (CORNERS, np.vstack([FACES[:1, ::-1], FACES[1:]]), "two faces that both run"),
        (CORNERS, np.array([[0, 1, 3], [3, 1, 0]]), "volume"),
    ],
)
def test_a_bad_mesh_is_refused_with_its_reason(vertices, faces, reason: str):
    with pytest.raises(ConfigurationError, match=reason):
        Mesh(vertices, faces)
