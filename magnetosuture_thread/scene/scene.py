"""A scene: one dish with named shapes, identified by the hash of its content."""

from __future__ import annotations

import hashlib
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import shapely

from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.obstacles import Disc, Polygon

KINDS = ("tissue", "instrument", "wall")
"""What a shape is: tissue, an instrument or post, or a rigid wall inside of the dish."""

MAX_SHAPES = 200
MAX_VERTICES = 10_000  # of all polygons of a scene together
MAX_NAME_CHARS = 64
VERSION_CHARS = 16


@dataclass(frozen=True)
class Dish:
    """The round petri dish; its centre is the origin of the dish frame.

    Attributes:
        diameter: inner diameter [m].
        depth: of the liquid in it [m].

    Raises:
        ConfigurationError: a value is not finite or not within its bounds.
    """

    diameter: float = 0.035
    depth: float = 0.003

    def __post_init__(self) -> None:
        """Check the bounds."""
        for name, low, high in (("diameter", 0.005, 0.5), ("depth", 1e-5, 0.1)):
            value = getattr(self, name)
            if not (math.isfinite(value) and low <= value <= high):
                raise ConfigurationError(f"dish.{name}", value, f"a number from {low:g} to {high:g} m")

    @property
    def radius(self) -> float:
        """Inner radius [m]."""
        return 0.5 * self.diameter


@dataclass(frozen=True)
class SceneShape:
    """A named shape that stands in the dish.

    Attributes:
        name: unique within its scene.
        kind: one of `KINDS`.
        geometry: the shape itself, corners rounded already [m].
        definition: how a scene file describes it, for example `{"disc": {"center": [0.0, 0.0], "radius": 0.001}}`;
            empty where only the geometry is known, as of a message.

    Raises:
        ConfigurationError: the name or the kind cannot be used.
    """

    name: str
    kind: str
    geometry: Disc | Polygon
    definition: Mapping[str, Any] = field(default_factory=dict, compare=False, repr=False)

    def __post_init__(self) -> None:
        """Check name and kind."""
        if not self.name or len(self.name) > MAX_NAME_CHARS or not self.name.isprintable():
            raise ConfigurationError("shape.name", self.name[:100], f"1 to {MAX_NAME_CHARS} printable characters")
        if self.kind not in KINDS:
            raise ConfigurationError(f"{self.name}.kind", self.kind, f"one of {', '.join(KINDS)}")

    @property
    def solid(self) -> shapely.Geometry:
        """The shape as a shapely geometry; a disc as a polygon of 256 vertices."""
        if isinstance(self.geometry, Disc):
            return shapely.Point(self.geometry.centre).buffer(self.geometry.radius, quad_segs=64)
        return shapely.Polygon(self.geometry.outline, self.geometry.holes)


@dataclass(frozen=True)
class Scene:
    """The dish and the shapes in it. Shapes are numbered in their order; margins name them by that index.

    Attributes:
        dish: the dish.
        shapes: in order, names unique.

    Raises:
        ConfigurationError: two shapes have one name, a shape is outside of the dish, or there are too many.
    """

    dish: Dish = Dish()
    shapes: tuple[SceneShape, ...] = ()

    def __post_init__(self) -> None:
        """Check the shapes together."""
        if len(self.shapes) > MAX_SHAPES:
            raise ConfigurationError("scene.shapes", f"{len(self.shapes)} shapes", f"at most {MAX_SHAPES}")
        vertices = sum(
            sum(map(len, shape.geometry.rings)) for shape in self.shapes if isinstance(shape.geometry, Polygon)
        )
        if vertices > MAX_VERTICES:
            raise ConfigurationError("scene.shapes", f"{vertices} vertices", f"at most {MAX_VERTICES} in all")
        names = [shape.name for shape in self.shapes]
        for index, shape in enumerate(self.shapes):
            if shape.name in names[:index]:
                raise ConfigurationError(f"scene.{shape.name}", "a name given twice", "a name for each shape")
            if _distance_from_centre(shape.geometry) >= self.dish.radius:
                raise ConfigurationError(
                    f"scene.{shape.name}", "a shape outside of the dish", f"within {self.dish.radius:g} m of its centre"
                )

    @cached_property
    def version(self) -> str:
        """Hash of the content: equal for scenes with the same dish, names, kinds and geometry, bit for bit."""
        digest = hashlib.sha256(struct.pack("<2d", self.dish.diameter, self.dish.depth))
        for shape in self.shapes:
            for text in (shape.name, shape.kind):
                encoded = text.encode()
                digest.update(struct.pack("<I", len(encoded)) + encoded)
            if isinstance(shape.geometry, Disc):
                digest.update(struct.pack("<B3d", 0, *shape.geometry.centre, shape.geometry.radius))
                continue
            for ring in shape.geometry.rings:
                digest.update(struct.pack("<BI", 1, len(ring)) + np.asarray(ring, dtype="<f8").tobytes())
        return digest.hexdigest()[:VERSION_CHARS]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the shapes, in their order."""
        return tuple(shape.name for shape in self.shapes)

    @property
    def obstacles(self) -> tuple[Disc | Polygon, ...]:
        """Geometry of the shapes, in their order."""
        return tuple(shape.geometry for shape in self.shapes)

    def add(self, shape: SceneShape) -> Scene:
        """Return the scene with one more shape, at the end."""
        return replace(self, shapes=(*self.shapes, shape))

    def remove(self, name: str) -> Scene:
        """Return the scene without a shape.

        Raises:
            ConfigurationError: there is no shape of this name.
        """
        self._require(name)
        return replace(self, shapes=tuple(shape for shape in self.shapes if shape.name != name))

    def replace(self, shape: SceneShape) -> Scene:
        """Return the scene with another shape in the place of the one of the same name.

        Raises:
            ConfigurationError: there is no shape of this name.
        """
        self._require(shape.name)
        return replace(self, shapes=tuple(shape if old.name == shape.name else old for old in self.shapes))

    def _require(self, name: str) -> None:
        if name not in self.names:
            known = ", ".join(self.names) or "none: the scene has no shapes"
            raise ConfigurationError("shape.name", name[:100], f"one of {known}")


def _distance_from_centre(geometry: Disc | Polygon) -> float:
    """Return the distance of a shape from the dish's centre, 0 where it covers it [m]."""
    if isinstance(geometry, Disc):
        return max(0.0, math.hypot(*geometry.centre) - geometry.radius)
    return float(shapely.Polygon(geometry.outline, geometry.holes).distance(shapely.Point(0.0, 0.0)))
