"""What is newly known of the thread, as values of settings: there is one way to change them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any


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


def parse_material(message: Any) -> dict[str, Any]:
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
