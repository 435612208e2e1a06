"""What a bag says of obstacles and thread while it runs, as settings: as `thread_model` takes it."""

from __future__ import annotations

from typing import Any

from magnetosuture_thread.bags.reader import Record
from magnetosuture_thread.configuration import from_mapping, to_mapping
from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.interface import DISH_FRAME, MATERIAL, OBSTACLE_SET
from magnetosuture_thread.model import changes
from magnetosuture_thread.model.settings import ThreadModelSettings

CHANGING = (OBSTACLE_SET, MATERIAL)


def changed(settings: ThreadModelSettings, record: Record) -> ThreadModelSettings:
    """Return settings after a recorded message on one of these channels.

    Raises:
        BagError: it cannot be decoded.
        ConfigurationError: it cannot be used.
        InvalidInputError: it is of another frame.
    """
    message = record.decode()
    values = _obstacles(message) if record.topic == OBSTACLE_SET.recorded else _material(message)
    return from_mapping(ThreadModelSettings, {**to_mapping(settings), **values})


def _obstacles(message: Any) -> dict[str, Any]:
    if message.header.frame_id != DISH_FRAME:
        raise InvalidInputError(f"{OBSTACLE_SET.name}.header.frame_id", repr(message.header.frame_id), repr(DISH_FRAME))
    discs = [(disc.x, disc.y, disc.radius) for disc in message.discs]
    polygons = [
        [[(corner.x, corner.y) for corner in outline.corners] for outline in (polygon.outline, *polygon.holes)]
        for polygon in message.polygons
    ]
    return changes.of_obstacles(discs, polygons, [float(radius) for radius in message.corner_radius])


def _material(message: Any) -> dict[str, Any]:
    return changes.of_material(
        name=message.name,
        diameter=message.diameter,
        elastic_modulus=message.elastic_modulus,
        viscosity=message.viscosity,
        drag_anisotropy=message.drag_anisotropy,
        rest_curvature=[float(curvature) for curvature in message.rest_curvature],
        attachment=message.attachment,
        attachment_offset=[float(part) for part in message.attachment_offset],
    )
