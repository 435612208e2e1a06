"""A scene: one dish with named shapes, identified by the hash of its content; collisions, and warnings."""

from __future__ import annotations

import hashlib
import math
import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations
from typing import Annotated, Any

import numpy as np
import shapely

from magnetosuture_thread.geometry.obstacles import MAX_FRICTION
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.geometry.shapes import Disc, Polygon
from magnetosuture_thread.settings.configuration import bounded, checked_arguments
from magnetosuture_thread.settings.errors import ConfigurationError

KINDS = ("tissue", "instrument", "wall")
"""What a shape is: tissue, an instrument or post, or a rigid wall inside of the dish."""

MAX_SHAPES = 200
# A coil bridge adopts a scene within 20 ms: that takes 4 us a vertex and 0.2 ms an outline.
MAX_VERTICES = 1500  # of all polygons of a scene together
MAX_OUTLINES = 40  # the same, holes included
MIN_EDGE = 2e-6  # m; a 30th of the thinnest thread, and what arcs and contacts may be off
MAX_NAME_CHARS = 64
MAX_COORDINATE = 1.0  # m; anything larger is in another unit
VERSION_CHARS = 16
WALL_NAME = "wall"  # in place of that of a shape


is_number = bounded().within
"""Return whether a value is a finite number, and not a boolean."""


@checked_arguments("dish")
@dataclass(frozen=True)
class Dish:
    """The round petri dish; its centre is the origin of the dish frame.

    Attributes:
        diameter: inner diameter [m].
        depth: of the liquid in it [m].
        wall_friction: Coulomb's coefficient of the thread on the wall.
        self_contact: whether a thread touches itself where it would cross itself; None where the depth decides, see
            `has_self_contact`.

    Raises:
        ConfigurationError: a value is not finite or not within its bounds.
    """

    diameter: Annotated[float, bounded("m", 0.005, 0.5)] = 0.035
    depth: Annotated[float, bounded("m", 1e-5, 0.1)] = 0.003
    wall_friction: Annotated[float, bounded("", 0.0, MAX_FRICTION)] = 0.0
    self_contact: bool | None = None

    def has_self_contact(self, thread_diameter: float) -> bool:
        """Return whether a thread touches itself where it would cross itself.

        It passes over itself where the liquid is two diameters deep or more, unless `self_contact` is set.

        Args:
            thread_diameter: [m].
        """
        if self.self_contact is not None:
            return self.self_contact
        # In a liquid two diameters deep the thread can pass over itself.
        return self.depth < 2.0 * thread_diameter

    @property
    def radius(self) -> float:
        """Inner radius [m]."""
        return 0.5 * self.diameter


@checked_arguments("shape")
@dataclass(frozen=True)
class SceneShape:
    """A named shape that stands in the dish.

    Attributes:
        name: unique within its scene.
        kind: one of `KINDS`.
        geometry: the shape itself, corners rounded already [m].
        definition: how a scene file describes it, for example `{"disc": {"center": [0.0, 0.0], "radius": 0.001}}`;
            empty where only the geometry is known, as of a message.
        friction: Coulomb's coefficient of the thread on it.

    Raises:
        ConfigurationError: the name or the kind cannot be used, or the geometry is out of bounds.
    """

    name: str
    kind: str
    geometry: Disc | Polygon
    definition: Mapping[str, Any] = field(default_factory=dict, compare=False, repr=False)
    friction: float = 0.0

    def __post_init__(self) -> None:
        """Check name, kind and bounds."""
        if not is_name(self.name):
            raise ConfigurationError("shape.name", self.name, f"1 to {MAX_NAME_CHARS} printable characters")
        if self.kind not in KINDS:
            raise ConfigurationError(f"{self.name}.kind", self.kind, f"one of {', '.join(KINDS)}")
        if not (is_number(self.friction) and 0.0 <= self.friction <= MAX_FRICTION):
            expectation = f"a coefficient of friction from 0 to {MAX_FRICTION:g}"
            raise ConfigurationError(f"{self.name}.friction", self.friction, expectation)
        if isinstance(self.geometry, Disc):
            if len(self.geometry.centre) != 2:
                raise ConfigurationError(f"{self.name}.disc.centre", self.geometry.centre, "two coordinates x, y [m]")
            return
        farthest = float(np.abs(self.geometry.outline).max())
        if farthest > MAX_COORDINATE:
            expectation = f"coordinates of at most {MAX_COORDINATE:g}, in metres"
            raise ConfigurationError(f"{self.name}.polygon.outline", farthest, expectation)
        shortest = min(float(np.hypot(*(ring - np.roll(ring, 1, axis=0)).T).min()) for ring in self.geometry.rings)
        if shortest < MIN_EDGE:
            raise ConfigurationError(f"{self.name}.polygon", shortest, f"edges of at least {MIN_EDGE:g} m")

    @cached_property
    def solid(self) -> shapely.Polygon:
        """The shape as a shapely geometry; a disc as a polygon of 256 vertices."""
        return self.geometry.solid

    @cached_property
    def label_point(self) -> tuple[float, float]:
        """A point inside of the shape, well away from its boundary: where its name can stand [m]."""
        if isinstance(self.geometry, Disc):
            return self.geometry.centre[0], self.geometry.centre[1]
        x, y = shapely.maximum_inscribed_circle(self.solid, tolerance=0.02 * math.sqrt(self.solid.area)).coords[0]
        return float(x), float(y)

    def outlines(self, tolerance: float) -> list[list[tuple[float, float]]]:
        """Return the outline, then the holes, with no more vertices than it takes to draw them.

        Args:
            tolerance: by which the boundary may be off [m].
        """
        drawn = self.solid.simplify(tolerance)
        return [[(x, y) for x, y in ring.coords[:-1]] for ring in (drawn.exterior, *drawn.interiors)]


@checked_arguments("scene")
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
            raise ConfigurationError("shapes", f"{len(self.shapes)} shapes", f"at most {MAX_SHAPES}")
        polygons = [shape.geometry for shape in self.shapes if isinstance(shape.geometry, Polygon)]
        rings = [ring for polygon in polygons for ring in (polygon.outline, *polygon.holes)]
        if len(rings) > MAX_OUTLINES:
            raise ConfigurationError("shapes", f"{len(rings)} outlines and holes", f"at most {MAX_OUTLINES} in all")
        if (vertices := sum(map(len, rings))) > MAX_VERTICES:
            raise ConfigurationError("shapes", f"{vertices} vertices", f"at most {MAX_VERTICES} in all")
        names = Counter(shape.name for shape in self.shapes)
        for shape in self.shapes:
            if names[shape.name] > 1:
                raise ConfigurationError(shape.name, "a name given twice", "a name of its own for each shape")
            near, covers = _distance_and_coverage(shape, self.dish.radius)
            if near >= self.dish.radius:
                problem = f"a shape outside of the dish, {near:.4g} m from its centre"
                expectation = f"a part of it within the dish, less than {self.dish.radius:g} m"
                raise ConfigurationError(shape.name, problem, expectation)
            if covers:
                problem = "a shape that covers the whole dish"
                raise ConfigurationError(shape.name, problem, "room in the dish; lengths in metres")

    @classmethod
    @checked_arguments("scene")
    def create(cls, *, dish_diameter: float = 0.035, shapes: Mapping[str, Disc | Polygon] | None = None) -> Scene:
        """Return a scene with named shapes, all of them tissue.

        >>> Scene.create(dish_diameter=0.035, shapes={"post": Disc((0.0, 0.0), 0.0025)}).names
        ('post',)

        Args:
            dish_diameter: inner diameter of the dish [m].
            shapes: by name.

        Raises:
            ConfigurationError: a shape cannot be used.
        """
        named = (shapes or {}).items()
        return cls(Dish(dish_diameter), tuple(SceneShape(name, KINDS[0], geometry) for name, geometry in named))

    @cached_property
    def version(self) -> str:
        """Hash of the content: equal for scenes with the same dish, names, kinds, geometry and friction, bit for bit.

        A scene without friction, and where the depth decides on self-contact, has the version of before there was any.
        """
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
        coefficients = (self.dish.wall_friction, *self.friction)
        if any(coefficients):
            digest.update(struct.pack(f"<B{len(coefficients)}d", 2, *coefficients))
        if self.dish.self_contact is not None:
            digest.update(struct.pack("<B?", 3, self.dish.self_contact))
        return digest.hexdigest()[:VERSION_CHARS]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the shapes, in their order."""
        return tuple(shape.name for shape in self.shapes)

    @property
    def obstacles(self) -> tuple[Disc | Polygon, ...]:
        """Geometry of the shapes, in their order."""
        return tuple(shape.geometry for shape in self.shapes)

    @property
    def friction(self) -> tuple[float, ...]:
        """Coulomb's coefficient of each shape, in their order."""
        return tuple(shape.friction for shape in self.shapes)

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
            raise ConfigurationError("shape.name", name, f"one of {known}"[:400])


def is_name(text: Any) -> bool:
    """Return whether a text can name a shape."""
    return isinstance(text, str) and 0 < len(text) <= MAX_NAME_CHARS and text.isprintable() and text == text.strip()


def _distance_and_coverage(shape: SceneShape, dish_radius: float) -> tuple[float, bool]:
    """Return a shape's distance from the dish's centre [m], and whether it covers all of the dish."""
    geometry, solid = shape.geometry, shape.solid
    if isinstance(geometry, Disc):
        away = math.hypot(*geometry.centre)
        return max(0.0, away - geometry.radius), away + dish_radius <= geometry.radius
    near = float(solid.distance(shapely.Point(0.0, 0.0)))
    return near, near == 0.0 and solid.covers(shapely.Point(0.0, 0.0).buffer(dish_radius, quad_segs=32))


def find_collision(scene: Scene, points: Points, depth: float = 0.0, *, holes: bool = True) -> str:
    """Return the name of what a line through points collides with: `wall`, a shape, or empty for nothing.

    It collides with the wall at or beyond it.

    Args:
        scene: dish and shapes.
        points: of the line; of a point alone, shape (1, 2); shape (m, 2) [m].
        depth: by which it may lie in the wall or a shape [m].
        holes: whether the holes of a shape are open; else they are taken for part of it.
    """
    if (np.linalg.norm(points, axis=1) >= scene.dish.radius + depth).any():
        return WALL_NAME
    line = shapely.LineString(points) if len(points) > 1 else shapely.Point(points[0])
    for shape in scene.shapes:
        solid = shape.solid if holes else shapely.Polygon(shapely.get_exterior_ring(shape.solid))
        if (solid.buffer(-depth) if depth else solid).intersects(line):
            return shape.name
    return ""


@dataclass(frozen=True)
class SceneWarning:
    """A warning on a scene that is valid but may be a mistake.

    Attributes:
        what: overlap, gap, hole or wall.
        shapes: names of the shapes that it is about.
        value: the gap's width, or how far a shape reaches beyond the wall [m]; of an overlap its area [m^2].
        place: where [m].
        text: the same in words.
    """

    what: str
    shapes: tuple[str, ...]
    value: float
    place: tuple[float, float]
    text: str


def scene_warnings(scene: Scene, needle_width: float) -> list[SceneWarning]:
    """Return the warnings on a scene, shape by shape, then pair by pair.

    Args:
        scene: to look through.
        needle_width: a gap or a hole narrower than this lets no needle pass [m].
    """
    warnings = [w for shape in scene.shapes for w in _shape_warnings(shape, scene.dish.radius, needle_width)]
    for first, second in combinations(scene.shapes, 2):
        if shapely.box(*first.solid.bounds).distance(shapely.box(*second.solid.bounds)) < needle_width:
            warnings += _pair_warnings(first, second, needle_width)
    return warnings


def _shape_warnings(shape: SceneShape, dish_radius: float, needle_width: float) -> Iterator[SceneWarning]:
    outline = shapely.get_coordinates(shape.solid.exterior)
    x, y = outline[np.argmax(np.hypot(*outline.T))].tolist()  # the point that is farthest from the dish's centre
    room = dish_radius - math.hypot(x, y)
    if room < 0.0:
        text = f"{shape.name} lies across the wall: it reaches {_mm(-room)} mm beyond"
        yield SceneWarning("wall", (shape.name,), -room, (x, y), text)
    elif room < needle_width:
        yield SceneWarning("gap", (shape.name,), room, (x, y), _gap(f"{shape.name} and the wall", room, (x, y)))
    for hole in map(shapely.Polygon, shape.solid.interiors):
        tolerance = 0.01 * needle_width
        circle = shapely.maximum_inscribed_circle(hole, tolerance)
        (x, y), width = circle.coords[0], 2.0 * circle.length
        if width < needle_width - tolerance:
            text = f"a hole of {shape.name} at {_at((x, y))} is {_mm(width)} mm wide: narrower than the needle"
            yield SceneWarning("hole", (shape.name,), width, (x, y), text)


def _pair_warnings(first: SceneShape, second: SceneShape, needle_width: float) -> Iterator[SceneWarning]:
    names = (first.name, second.name)
    common = first.solid.intersection(second.solid)
    gap = float(first.solid.distance(second.solid))
    # Shapes that share a boundary do not overlap.
    if common.area > 1e-12:
        (place,) = common.representative_point().coords
        text = f"{first.name} and {second.name} overlap by {1e6 * common.area:.3g} mm^2 at {_at(place)}"
        yield SceneWarning("overlap", names, float(common.area), place, text)
    elif gap < needle_width:
        middle = shapely.shortest_line(first.solid, second.solid).interpolate(0.5, normalized=True)
        (place,) = middle.coords
        yield SceneWarning("gap", names, gap, place, _gap(f"{first.name} and {second.name}", gap, place))


def _gap(between: str, width: float, place: tuple[float, float]) -> str:
    return f"the gap between {between} at {_at(place)} is {_mm(width)} mm wide: narrower than the needle"


def _mm(length: float) -> str:
    return f"{1e3 * length:.3g}"


def _at(place: tuple[float, float]) -> str:
    return f"({1e3 * place[0]:.2f}, {1e3 * place[1]:.2f}) mm"
