"""Time the thread model on this machine, by number of segments, dimension, obstacles and solver.

One whole step (barriers, obstacles and solves) and the solve alone, with the largest residual beside every
time. Single thread, wall clock; the machine's other work shows in the 99th percentile.
"""

from __future__ import annotations

import argparse
from typing import Any

from rich.console import Console

from benchmarks.solver.measurements import measure_solver
from benchmarks.solver.table import solver_lines, solver_table
from magnetosuture_thread.cli.terminal import make_log, progress


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument(
        "--peers", action="store_true", help="time other solvers and simulators too (needs the extra `peers`)"
    )


def run(options: argparse.Namespace, console: Console) -> tuple[dict[str, Any], bool]:
    """Time steps and solves; return the figures."""
    with progress(console, "solver") as advance:
        report = measure_solver(with_baselines=options.peers, progress=advance)
    console.print(solver_table(report))
    for line in solver_lines(report):
        make_log(console)(line)
    return report.to_json(), True
