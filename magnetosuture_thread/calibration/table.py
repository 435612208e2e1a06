"""What a calibration found, as tables and in words."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from rich.table import Table


def parameter_table(found: Mapping[str, Any]) -> Table:
    """Return a row for each number, as `Calibration.to_json` gives them."""
    title = f"{found['material']}, formulation {found['formulation']}"
    table = Table(title=title if found["finished"] else f"{title}: best so far, not finished")
    table.caption = "? cannot be identified in this data"
    for name in ("parameter", "value", "95 % interval", "set-up"):
        table.add_column(name, justify="left" if name == "parameter" else "right", no_wrap=True)
    for row in found["parameters"]:
        scale, unit = (1e3, "mm") if row["unit"] == "m" else (1.0, row["unit"])
        interval = "-" if row["low"] is None else f"{scale * row['low']:.3g} to {scale * row['high']:.3g}"
        value = f"{scale * row['value']:.4g}" + (" ?" if row["reason"] else "")
        name = f"{row['name']} \\[{unit}]" if unit else row["name"]
        table.add_row(name, value, interval, f"{scale * row['start']:.4g}")
    attachment = found["attachment"]
    if attachment is not None:
        value = attachment["value"] + (" ?" if attachment["reason"] else "")
        table.add_row("attachment", value, "-", attachment["start"])
    return table


def bag_table(found: Mapping[str, Any]) -> Table:
    """Return a row for each bag: prediction errors before and after, and by the other bags."""
    several, truth = len(found["bags"]) > 1, any(row["truth_after"] is not None for row in found["bags"])
    table = Table(
        title=f"prediction error, fitted to what is {found['against'] if found['against'] == 'seen' else 'true'}"
    )
    table.caption = "mean over time of the mean distance of the nodes, % of the length"
    table.add_column("bag", overflow="fold", min_width=12)
    table.add_column("frames", justify="right")
    # On a line of its own, as eight columns must fit into a terminal's 80.
    kinds = ["", *(["truth\n"] if truth and found["against"] == "seen" else [])]
    for kind in kinds:
        for name in ("before", "after", *(["held out"] if several else [])):
            table.add_column(f"{kind}{name}" if kind else name.replace(" ", "\n"), justify="right", no_wrap=True)
    for row in found["bags"]:
        cells = []
        for kind in kinds:
            keys = ("before", "after", *(["held_out"] if several else []))
            cells += [_percent(row[("truth_" if kind else "") + key]) for key in keys]
        table.add_row(row["name"], str(row["frames"]), *cells)
    return table


def calibration_lines(found: Mapping[str, Any]) -> list[str]:
    """Return in words what the tables do not say."""
    simulated = [row["name"] for row in found["bags"] if row["simulated"]]
    lines = [f"warning: {warning}" for warning in found["warnings"]]
    if simulated:
        lines.append(f"simulated: {', '.join(simulated)}")
    return lines


def _percent(value: float | None) -> str:
    return "-" if value is None or math.isnan(value) else f"{value:.3f}"
