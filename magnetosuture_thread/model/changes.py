"""What is newly known of obstacles or thread, as values of settings: there is one way to change them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

Ring = Sequence[tuple[float, float]]


def of_obstacles(
    discs: Iterable[tuple[float, float, float]], polygons: Iterable[Sequence[Ring]], corner_radius: Sequence[float] = ()
) -> dict[str, Any]:
    """Return the settings, by name, of obstacles that take the place of all others.

    Args:
        discs: x, y and radius of each [m].
        polygons: of each its outline, then its holes: the corners x, y of each [m].
        corner_radius: by which sharp corners are rounded [m]; none leaves it as it is.

    >>> of_obstacles([(0.01, 0.0, 0.002)], [[[(0.0, 0.0), (0.01, 0.0), (0.0, 0.01)]]])
    {'disc_obstacles': [0.01, 0.0, 0.002], 'polygon_obstacles': [0.0, 0.0, 0.01, 0.0, 0.0, 0.01], 'polygon_sizes': [3]}
    """
    corners: list[float] = []
    sizes: list[int] = []
    for rings in polygons:
        for index, ring in enumerate(rings):
            sizes.append(-len(ring) if index else len(ring))
            corners.extend(number for corner in ring for number in corner)
    values: dict[str, Any] = {
        "disc_obstacles": [number for disc in discs for number in disc],
        "polygon_obstacles": corners,
        "polygon_sizes": sizes,
    }
    return values | ({"corner_radius": corner_radius[0]} if len(corner_radius) else {})


def of_material(
    *,
    name: str = "",
    diameter: float = 0.0,
    elastic_modulus: float = 0.0,
    viscosity: float = 0.0,
    drag_anisotropy: float = 0.0,
    rest_curvature: Sequence[float] = (),
    attachment: str = "",
    attachment_offset: Sequence[float] = (),
) -> dict[str, Any]:
    """Return the settings, by name, that a calibration of the thread changes.

    What is 0, not a number or empty stays as it is; but a material that is named brings its own diameter, modulus
    and weight of the stiffness. The arguments have the units of the settings.

    >>> of_material(viscosity=0.9)
    {'viscosity': 0.9}
    """
    values: dict[str, Any] = {}
    if name:
        values = {"material": name, "diameter": 0.0, "elastic_modulus": 0.0, "paper_stiffness_weight": 0.0}
    numbers = {
        "diameter": diameter,
        "elastic_modulus": elastic_modulus,
        "viscosity": viscosity,
        "drag_anisotropy": drag_anisotropy,
    }
    values.update({field: number for field, number in numbers.items() if number != 0.0 and not math.isnan(number)})
    if len(rest_curvature):
        values["rest_curvature"] = rest_curvature[0]
    if attachment:
        values["attachment"] = attachment
    if len(attachment_offset):
        values["attachment_offset"] = list(attachment_offset)
    return values


def told_obstacles(message: Any) -> dict[str, Any]:
    """Return `of_obstacles` for an ObstacleSet, whoever decoded it: rclpy's and the bags' have the same fields."""
    discs = [(disc.x, disc.y, disc.radius) for disc in message.discs]
    polygons = [[_ring(outline) for outline in (polygon.outline, *polygon.holes)] for polygon in message.polygons]
    return of_obstacles(discs, polygons, [float(radius) for radius in message.corner_radius])


def told_material(message: Any) -> dict[str, Any]:
    """Return `of_material` for a ThreadMaterial, whoever decoded it."""
    return of_material(
        name=message.name,
        diameter=message.diameter,
        elastic_modulus=message.elastic_modulus,
        viscosity=message.viscosity,
        drag_anisotropy=message.drag_anisotropy,
        rest_curvature=[float(curvature) for curvature in message.rest_curvature],
        attachment=message.attachment,
        attachment_offset=[float(part) for part in message.attachment_offset],
    )


def _ring(outline: Any) -> Ring:
    return [(corner.x, corner.y) for corner in outline.corners]
