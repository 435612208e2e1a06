"""The simulated hernia repair as a table."""

from __future__ import annotations

import math

from rich.table import Table

from magnetosuture_thread.study.hernia.run import HerniaSummary


def hernia_table(summary: HerniaSummary) -> Table:
    """Return a row for each instant that is shown."""
    table = Table(title=f"{summary.setup}, simulated: the thread model alone, the needle a point")
    for name in ("time [s]", "thread", "nodes", "slowdown", "asked [mm/s]", "passed [mm/s]"):
        table.add_column(name, justify="left" if name == "thread" else "right", no_wrap=True)
    for instant in summary.instants:
        table.add_row(
            f"{instant['time']:.1f}",
            instant["state"],
            str(len(instant["friction_nodes"])),
            f"{instant['slowdown']:.2f}",
            f"{1e3 * math.hypot(*instant['asked']):.2f}",
            f"{1e3 * math.hypot(*instant['passed']):.2f}",
        )
    return table


def hernia_lines(summary: HerniaSummary) -> list[str]:
    """Return in words what the table does not say."""
    return [
        f"{summary.duration:.1f} s at {summary.rate:g} Hz, {summary.nodes} segments, formulation {summary.formulation}",
        f"deepest node in an obstacle {summary.deepest:.1e} m, middle of a chord {1e6 * summary.chord_deepest:.0f} um, "
        f"greatest stretch {100.0 * summary.stretch:.4f} %",
        f"a step takes {1e3 * summary.median_step:.2f} ms (99th percentile {1e3 * summary.high_step:.2f}): "
        f"{summary.room:.0f} times faster than its period",
    ]
