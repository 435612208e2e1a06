"""Time the operator's page in Chromium without a window, on the whole graph around the simulated rig.

From a key press to the filtered velocity at the bridge, and the pictures that the page draws, with 81 segments;
by the stamps of who sends. Needs chromium and playwright. Takes three minutes.
"""

from __future__ import annotations

import argparse
from typing import Any

from rich.console import Console

from benchmarks.page.measurements import measure_page
from benchmarks.page.report import page_lines, page_table
from magnetosuture_thread.cli.arguments import whole_number
from magnetosuture_thread.cli.terminal import make_log, progress


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--presses", type=whole_number, default=200, metavar="N", help="of a key (default: 200)")


def run(options: argparse.Namespace, console: Console) -> tuple[dict[str, Any], bool]:
    """Time the page; return the figures."""
    with progress(console, "page") as advance:
        report = measure_page(options.presses, log=make_log(console), progress=advance)
    console.print(page_table(report))
    for line in page_lines(report):
        make_log(console)(line)
    return report.to_json(), True
