"""What a calibration of the coils found, as a table."""

from __future__ import annotations

import math
from typing import Any

from rich.table import Table


def coil_table(fit: dict[str, Any]) -> Table:
    """Return a row for each coil, as `CalibrationFit.to_json` gives them."""
    table = Table(title=f"coils as {fit['model']}")
    table.caption = "with standard deviations; ? is poorly determined"
    for name in ("coil", "angle [deg]", "distance [mm]", "radius [mm]", "field [mT/A]", "residual [uT]"):
        table.add_column(name, justify="left" if name == "coil" else "right", no_wrap=True)
    for coil in fit["coils"]:
        table.add_row(
            coil["name"],
            _value(coil, "angle", 180.0 / math.pi, 2),
            _value(coil, "distance", 1e3, 2),
            _value(coil, "radius", 1e3, 2),
            _value(coil, "field_per_current", 1e3, 4),
            f"{1e6 * coil['residual']:.1f}",
        )
    return table


def coil_lines(fit: dict[str, Any]) -> list[str]:
    """Return in words what the table does not say."""
    x, y = (1e6 * value for value in fit["background"])
    line, worst = fit["worst"]
    lines = [
        f"{fit['readings']} readings, residual {1e6 * fit['residual']:.1f} uT, background {x:.1f}, {y:.1f} uT",
        f"the largest difference, {1e6 * worst:.1f} uT, is in line {line}",
    ]
    for coil in fit["coils"]:
        if coil["poor"]:
            lines.append(f"{coil['name']}: poorly determined {', '.join(coil['poor'])}; measure all over the dish")
    return lines


def _value(coil: dict[str, Any], key: str, scale: float, digits: int) -> str:
    deviation = coil["deviations"][key]
    if math.isnan(deviation):
        return "-"
    mark = " ?" if key in coil["poor"] else ""
    return f"{scale * coil[key]:.{digits}f} ± {scale * deviation:.{digits}f}{mark}"
