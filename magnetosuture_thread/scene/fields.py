"""Validated access to the fields of a shape description."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.obstacles.polygon import Ring
from magnetosuture_thread.scene.errors import scene_error
from magnetosuture_thread.scene.scene import MAX_COORDINATE, MAX_HOLES, MAX_VERTICES, MIN_RADIUS
from magnetosuture_thread.scene.text import is_number


class ShapeFields:
    """Fields of one shape description, each read once; unknown fields are refused.

    Args:
        shape: name of the shape, for errors.
        type_name: what it is, for example `disc`.
        values: as the file has them.
        source: the file.
    """

    def __init__(self, shape: str, type_name: str, values: Any, source: str) -> None:
        name = f"{shape}.{type_name}"
        if not isinstance(values, Mapping):
            raise scene_error(name, values, "fields by name", source)
        self.shape, self.name, self.source = shape, name, source
        self._left = dict(values)
        self._known: list[str] = []

    def number(self, field: str, low: float, high: float, unit: str, default: float | None = None) -> float:
        """Read a number within bounds."""
        value = self._take(field, default)
        if not is_number(value) or not low <= float(value) <= high:
            raise self.error(field, value, f"a number from {low:g} to {high:g} {unit}")
        return float(value)

    def length(self, field: str, default: float | None = None) -> float:
        """Read a positive length [m]; with a default, 0 too."""
        low = 0.0 if default is not None else MIN_RADIUS
        return self.number(field, low, MAX_COORDINATE, "m", default)

    def point(self, field: str) -> tuple[float, float]:
        """Read a point x, y [m]."""
        return _point(self, field, self._take(field))

    def rings(self, field: str, default: Sequence[Any] | None = None) -> list[Ring]:
        """Read a list of rings of points."""
        given = self._take(field, default)
        if not isinstance(given, Sequence) or isinstance(given, str):
            raise self.error(field, given, "a list of outlines, each a list of points [m]")
        if len(given) > MAX_HOLES:
            raise self.error(field, f"{len(given)} outlines", f"at most {MAX_HOLES}")
        return [_ring(self, f"{field}[{index}]", ring) for index, ring in enumerate(given)]

    def ring(self, field: str) -> Ring:
        """Read a closed outline of points."""
        return _ring(self, field, self._take(field))

    def require_all_used(self) -> None:
        """Refuse fields that were not read."""
        for field, value in self._left.items():
            raise self.error(str(field), value, f"one of {', '.join(self._known)}")

    def corner_error(self, radius: float, expectation: str) -> ConfigurationError:
        """Return the error for the corner radius, which stands beside the shape's own fields."""
        return scene_error(f"{self.shape}.corner_radius", radius, expectation, self.source)

    def error(self, field: str, value: Any, expectation: str) -> ConfigurationError:
        """Return the error for a field."""
        return scene_error(f"{self.name}.{field}", value, expectation, self.source)

    def _take(self, field: str, default: Any = None) -> Any:
        self._known.append(field)
        if field not in self._left and default is None:
            given = ", ".join(str(name)[:40] for name in list(self._left)[:10])
            raise self.error(field, None, f"a value; what is left of the others is {given}" if given else "a value")
        return self._left.pop(field, default)


def _point(fields: ShapeFields, field: str, value: Any) -> tuple[float, float]:
    fits = isinstance(value, Sequence) and len(value) == 2 and all(map(is_number, value))
    if not fits or max(abs(part) for part in value) > MAX_COORDINATE:
        raise fields.error(field, value, f"two coordinates x, y of at most {MAX_COORDINATE:g}, in metres")
    return float(value[0]), float(value[1])


def _ring(fields: ShapeFields, field: str, value: Any) -> Ring:
    if not isinstance(value, Sequence) or isinstance(value, str) or len(value) < 3:
        raise fields.error(field, value, "at least 3 points x, y [m]")
    if len(value) > MAX_VERTICES:
        raise fields.error(field, f"{len(value)} points", f"at most {MAX_VERTICES}")
    return tuple(_point(fields, f"{field}[{index}]", point) for index, point in enumerate(value))
