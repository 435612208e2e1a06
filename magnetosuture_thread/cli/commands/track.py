"""The command `magnetosuture track`."""

from __future__ import annotations

import argparse
import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

from magnetosuture_thread.cli.arguments import add_remap, number_argument, output_file
from magnetosuture_thread.cli.command import DONE, Subparsers, command
from magnetosuture_thread.cli.terminal import make_console, make_log, progress, write_json

MAX_ROWS = 20  # beyond, only the summary is shown

DESCRIPTION = """\
Find needle and thread in camera frames, without a graph. FRAMES are pictures, a folder of them, or a bag.
Pictures are looked at one by one; a bag's frames are followed over time, as the node vision_tracker does.

--json writes a list with an entry for each frame: file (for a bag, topic and stamp), status (tracked, lost
or searching) and its reason, tail_m, tip_m and heading_rad (the tangent at the tail), curvature_per_m
(positive to the left), thread_m from the tail on, all in the dish frame, confidence from 0 to 1, stamp_s,
and time_s, the processor time to look at the frame, on one core, without reading and decoding it; all is
compiled before. What has no value is null.
"""


def add(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = command(subparsers, "track", "find needle and thread in camera frames", DESCRIPTION, run)
    parser.add_argument("frames", type=Path, nargs="+", metavar="FRAMES", help="pictures, a folder of them, or a bag")
    parser.add_argument(
        "--setup",
        default="petri_35mm_polyamide",
        metavar="NAME",
        help="a set-up's name or YAML file (default: %(default)s)",
    )
    parser.add_argument("--scene", default="", metavar="NAME", help="a scene's name or file (default: the set-up's)")
    parser.add_argument(
        "--metres-per-pixel",
        type=number_argument(1e-7, 1e-2),
        metavar="S",
        help="the scale (default: the set-up's, or from the dish's diameter)",
    )
    parser.add_argument(
        "--centre",
        type=number_argument(0.0, 1e5),
        nargs=2,
        metavar=("U", "V"),
        help="the dish's centre [px] (default: the set-up's, or found)",
    )
    add_remap(parser)
    parser.add_argument("--json", type=output_file, metavar="FILE", help="write what was found to a file")
    parser.add_argument(
        "--overlay", type=Path, metavar="PATH", help="draw it over the frames: a video (.mp4, .avi), or a folder of PNG"
    )


def run(options: argparse.Namespace) -> int:
    """Track the needle in camera frames."""
    from magnetosuture_thread.jobs.track import settings_with, track
    from magnetosuture_thread.scene import read_scene
    from magnetosuture_thread.setups import read_setup

    console = make_console()
    log = make_log(console)
    setup = read_setup(options.setup, read_scene(options.scene) if options.scene else None)
    settings = settings_with(setup.vision, options.metres_per_pixel, options.centre)
    with progress(console, "track") as advance:
        frames = track(
            options.frames,
            settings,
            setup.scene,
            overlay=options.overlay,
            remap=dict(options.remap),
            log=log,
            progress=advance,
        )
    rows = [frame.to_json() for frame in frames]
    console.print(track_table(rows))
    for line in track_lines(rows):
        log(line)
    write_json(options.json, rows)
    return DONE


def track_table(rows: Sequence[dict[str, Any]]) -> Table:
    """Return a row for each of the first frames, as `TrackedFrame.to_json` gives them."""
    import numpy as np

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
    import numpy as np

    if not rows:
        return ["no frames"]
    counts = Counter(row["status"] for row in rows)
    times = np.array([row["time_s"] for row in rows]) * 1e3
    found = ", ".join(f"{count} {status}" for status, count in counts.most_common())
    return [f"{found}; {np.median(times):.1f} ms a frame in the median, {np.percentile(times, 95):.1f} ms in the 95th"]
