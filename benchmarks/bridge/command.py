"""Time the coil bridge: how long until the duties of two simulated RoboClaw boards are zero.

The boards are on pseudo-terminals. Measured after a commander fell silent and after kill -9 of commander,
tracker and bridge; also how even the bridge's loop is, and what hostile messages can do. Meanwhile all cores
are kept busy. Takes nine minutes.
"""

from __future__ import annotations

import argparse
from typing import Any

from rich.console import Console

from benchmarks.bridge.measurements import measure_bridge
from benchmarks.bridge.report import bridge_table
from magnetosuture_thread.cli.arguments import whole_number
from magnetosuture_thread.cli.terminal import make_log, progress


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    for name, default, what in (
        ("trials", 500, "a commander that falls silent"),
        ("kills", 20, "kill -9 of each process"),
        ("hostile", 10_000, "hostile messages"),
    ):
        parser.add_argument(
            f"--{name}", type=whole_number, default=default, metavar="N", help=f"{what} (default: {default})"
        )


def run(options: argparse.Namespace, console: Console) -> tuple[dict[str, Any], bool]:
    """Time the bridge; return the figures."""
    with progress(console, "bridge") as advance:
        report = measure_bridge(options.trials, options.kills, options.hostile, log=make_log(console), progress=advance)
    console.print(bridge_table(report))
    return report.to_json(), True
