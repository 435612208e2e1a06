"""Run the graph over two hosts and pull the cable between them, as network namespaces of this machine.

Camera, rig and bridge are on one, thread model, path follower and operator's page on the other. The cable is pulled
at random moments while the coils are driven, of a network as it is and of one that delays and loses packets; measured
is when the coils are at zero, and when the needle goes on after the cable is back. It takes root's rights (TAP
devices), and about half an hour.
"""

from __future__ import annotations

import argparse
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.network.measurements import CutReport, measure_network
from magnetosuture_thread.cli.arguments import whole_number
from magnetosuture_thread.cli.terminal import make_log, progress

DELAY, LOSS = 0.05, 0.05  # s, and share of packets


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    for name, default, what in (
        ("cuts", 150, "cuts of a network as it is"),
        ("impaired-cuts", 50, f"cuts where packets are {1e3 * DELAY:g} ms late and {100.0 * LOSS:g} %% are lost"),
    ):
        parser.add_argument(
            f"--{name}", type=whole_number, default=default, metavar="N", help=f"{what} (default: {default})"
        )


def run(options: argparse.Namespace, console: Console) -> tuple[dict[str, Any], bool]:
    """Pull the cable; return the figures, and whether the coils were at zero in time after each cut."""
    networks = [(0.0, 0.0, options.cuts), (DELAY, LOSS, options.impaired_cuts)]
    with progress(console, "network") as advance:
        reports, bound = measure_network(networks, log=make_log(console), progress=advance)
    console.print(network_table(reports, bound))
    return {"bound": bound, "networks": [report.to_json() for report in reports]}, all(r.passed for r in reports)


def network_table(reports: list[CutReport], bound: float) -> Table:
    """Return the figures of each network as a table."""
    table = Table(title="Two hosts, simulated rig")
    for heading in ("network", "cuts", f"at zero within {bound:g} s", "median, greatest [s]"):
        table.add_column(heading)
    for heading in ("goes on, median, greatest [s]", "stops kept", "driven", "Mbit/s"):
        table.add_column(heading)
    for report in reports:
        figures = report.to_json()
        table.add_row(
            f"{1e3 * report.delay:g} ms, {100.0 * report.loss:g} % lost",
            str(figures["cuts"]),
            str(figures["cuts"] - report.late),
            f"{figures['zero_median']:.3f}, {figures['zero_maximum']:.3f}",
            f"{figures['resumed_median']:.2f}, {figures['resumed_maximum']:.2f}",
            f"{report.stopped[1]} of {report.stopped[0]}",
            f"{report.driven:.0%}",
            f"{report.megabits[0]:.1f}, {report.megabits[1]:.1f}",
        )
    return table
