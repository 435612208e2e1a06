"""What is in a scene, as a table."""

from __future__ import annotations

from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text


def scene_table(report: dict[str, Any]) -> Table:
    """Return a row for each shape, as `SceneReport.to_json` gives them."""
    dish = report["dish"]
    table = Table(
        box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        title=f"dish of {1e3 * dish['diameter']:g} mm, {1e3 * dish['depth']:g} mm deep",
    )
    table.caption = f"version {report['version']}; least and greatest x, y in mm, area in mm^2"
    table.add_column("", justify="right")
    table.add_column("name", overflow="fold", min_width=12)
    for name in ("kind", "shape"):
        table.add_column(name, no_wrap=True)
    for name in ("from", "to", "area"):
        table.add_column(name, justify="right", no_wrap=True)
    for index, shape in enumerate(report["shapes"]):
        left, bottom, right, top = (1e3 * value for value in shape["bounds_m"])
        table.add_row(
            str(index),
            Text(shape["name"]),
            shape["kind"],
            shape["type"],
            f"{left:.2f}, {bottom:.2f}",
            f"{right:.2f}, {top:.2f}",
            f"{1e6 * shape['area_m2']:.2f}",
        )
    return table
