"""Tables for a terminal: of tracked frames, calibrated coils, and a scene."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

MAX_ROWS = 20  # of frames; beyond, only the summary is shown


def track_table(rows: Sequence[dict[str, Any]]) -> Table:
    """Return a row for each of the first frames, as `TrackedFrame.to_json` gives them."""
    table = Table(title=f"{len(rows)} frames")
    table.caption = "tail and thread's length in mm, heading in degrees, confidence, processor time"
    table.add_column("frame", overflow="fold", min_width=12)
    table.add_column("status")
    for name in ("tail", "heading", "thread", "sure", "ms"):
        table.add_column(name, justify="right", no_wrap=True)
    began = rows[0]["stamp_s"] if rows else None
    for row in rows[:MAX_ROWS]:
        name = row["file"] if began is None else f"at {row['stamp_s'] - began:.3f} s"
        time = f"{row['time_s'] * 1e3:.1f}"
        if row["reason"]:
            table.add_row(name, f"{row['status']}: {row['reason']}", "", "", "", "", time)
            continue
        steps = np.diff(np.array(row["thread_m"] or []).reshape(-1, 2), axis=0)
        length = 1e3 * float(np.hypot(steps[:, 0], steps[:, 1]).sum())
        heading, confidence = row["heading_rad"], row["confidence"]
        table.add_row(
            name,
            row["status"],
            ", ".join(f"{1e3 * value:.2f}" for value in row["tail_m"] or []),
            "" if heading is None else f"{math.degrees(heading):.1f}",
            "" if row["thread_m"] is None else f"{length:.1f}",
            "" if confidence is None else f"{confidence:.2f}",
            time,
        )
    if len(rows) > MAX_ROWS:
        table.add_row(f"and {len(rows) - MAX_ROWS} more", "", "", "", "", "", "")
    return table


def track_lines(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return a summary in words."""
    if not rows:
        return ["no frames"]
    counts = Counter(row["status"] for row in rows)
    times = np.array([row["time_s"] for row in rows]) * 1e3
    found = ", ".join(f"{count} {status}" for status, count in counts.most_common())
    return [f"{found}; {np.median(times):.1f} ms a frame in the median, {np.percentile(times, 95):.1f} ms in the 95th"]


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
