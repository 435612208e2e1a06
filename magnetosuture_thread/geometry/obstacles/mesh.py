"""Meshes: solid obstacles in space, bounded by triangles."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.obstacles.polygon import check_metres
from magnetosuture_thread.geometry.polyline import Points


@dataclass(frozen=True, eq=False)
class Mesh:
    """A solid in space, bounded by a closed surface of triangles.

        volume = sum over the faces of a . (b x c) / 6

    Faces are kept counter-clockwise seen from outside; when all were given the other way, all are flipped.

    Attributes:
        vertices: shape (v, 3) [m].
        faces: indices of vertices, shape (f, 3).
        source: the file that the shape came from, for the error.

    Raises:
        ConfigurationError: when it bounds no solid: not finite, an index out of range, a face without
            area, an edge that is not between two faces in opposite directions, no volume, or coordinates
            that cannot be metres.
    """

    vertices: Points
    faces: NDArray[np.int64]
    source: str = field(default="", repr=False)

    def __post_init__(self) -> None:
        """Check and normalise what was given."""
        vertices = np.array(self.vertices, dtype=np.float64)
        faces = np.array(self.faces)
        if vertices.ndim != 2 or vertices.shape[1] != 3:
            self._refuse("vertices", f"shape {vertices.shape}", "shape (v, 3) [m]")
        if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0 or not np.issubdtype(faces.dtype, np.integer):
            self._refuse("faces", f"shape {faces.shape} of {faces.dtype}", "integers of shape (f, 3), f >= 1")
        faces = faces.astype(np.int64)
        check_metres("mesh.vertices", vertices, self.source)
        outside = np.flatnonzero(((faces < 0) | (faces >= len(vertices))).any(axis=1))
        if len(outside):
            self._refuse(
                f"faces[{outside[0]}]", faces[outside[0]].tolist(), f"indices of vertices, 0 to {len(vertices) - 1}"
            )
        self._check_faces(vertices, faces)
        self._check_edges(faces)
        a, b, c = np.moveaxis(vertices[faces] - vertices[faces[0, 0]], 1, 0)
        volume = float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6.0
        if abs(volume) <= 1e-12 * float(np.ptp(vertices[faces].reshape(-1, 3), axis=0).max()) ** 3:
            self._refuse("faces", f"a volume of {volume:.3g} m^3", "a surface around a volume")
        if volume < 0.0:
            faces = np.ascontiguousarray(faces[:, ::-1])
        for name, array in (("vertices", vertices), ("faces", faces)):
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    def _refuse(self, name: str, value: object, expectation: str) -> None:
        raise ConfigurationError(f"mesh.{name}", value, expectation, source=self.source)

    def _check_faces(self, vertices: Points, faces: NDArray[np.int64]) -> None:
        """Refuse a face without area, to rounding."""
        a, b, c = np.moveaxis(vertices[faces], 1, 0)
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        longest = np.max([np.sum((b - a) ** 2, axis=1), np.sum((c - b) ** 2, axis=1), np.sum((a - c) ** 2, axis=1)], 0)
        flat = np.flatnonzero(area <= 1e-10 * longest)
        if len(flat):
            self._refuse(f"faces[{flat[0]}]", faces[flat[0]].tolist(), "three vertices that are not on one line")

    def _check_edges(self, faces: NDArray[np.int64]) -> None:
        """Refuse a surface that is open, or whose faces do not agree on what is outside."""
        n = int(faces.max()) + 1
        tails, heads = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
        either, counts = np.unique(np.minimum(tails, heads) * n + np.maximum(tails, heads), return_counts=True)
        if (counts != 2).any():
            edge, count = int(either[counts != 2][0]), int(counts[counts != 2][0])
            self._refuse(
                "faces", f"{count} faces at the edge of vertices {edge // n} and {edge % n}", "a closed surface: 2 each"
            )
        edges, counts = np.unique(tails * n + heads, return_counts=True)
        if (counts != 1).any():
            edge = int(edges[counts != 1][0])
            self._refuse(
                "faces",
                f"two faces that both run from vertex {edge // n} to {edge % n}",
                "faces all counter-clockwise, or all clockwise, seen from outside",
            )
