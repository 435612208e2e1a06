"""What was tracked in frames, as a table."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.table import Table

MOST_ROWS = 20  # beyond, only the summary is shown


def track_table(rows: Sequence[dict[str, Any]]) -> Table:
    """Return a row for each of the first frames, as `TrackedFrame.to_json` gives them."""
    table = Table(title=f"{len(rows)} frames")
    table.caption = "tail and thread's length in mm, heading in degrees, confidence, processor time"
    table.add_column("frame", overflow="fold", min_width=12)
    table.add_column("status")
    for name in ("tail", "heading", "thread", "sure", "ms"):
        table.add_column(name, justify="right", no_wrap=True)
    began = rows[0]["stamp_s"] if rows else None
    for row in rows[:MOST_ROWS]:
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
    if len(rows) > MOST_ROWS:
        table.add_row(f"and {len(rows) - MOST_ROWS} more", "", "", "", "", "", "")
    return table


def track_lines(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return a summary in words."""
    if not rows:
        return ["no frames"]
    counts = Counter(row["status"] for row in rows)
    times = np.array([row["time_s"] for row in rows]) * 1e3
    found = ", ".join(f"{count} {status}" for status, count in counts.most_common())
    return [f"{found}; {np.median(times):.1f} ms a frame in the median, {np.percentile(times, 95):.1f} ms in the 95th"]
