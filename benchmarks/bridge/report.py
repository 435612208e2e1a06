"""Figures of the bridge benchmark, and their table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from rich.table import Table


@dataclass(frozen=True)
class ZeroDelays:
    """Times from an event to zero duty on all boards.

    Attributes:
        event: what happened.
        count: how often the coils were driven then.
        median: [s]
        p99: [s]
        greatest: [s]
        bound: what they should not exceed [s].
        beyond: how many do.
    """

    event: str
    count: int
    median: float
    p99: float
    greatest: float
    bound: float
    beyond: int

    @classmethod
    def of(cls, event: str, delays: Sequence[float], bound: float) -> ZeroDelays:
        """Return the spread of some delays [s], of at least one."""
        found = np.array(delays)
        middle, high, most = np.percentile(found, [50.0, 99.0, 100.0])
        return cls(event, len(found), float(middle), float(high), float(most), bound, int(np.sum(found > bound)))

    @property
    def words(self) -> str:
        """The figures in a line for a person."""
        median, p99, greatest = (f"{1e3 * value:.1f}" for value in (self.median, self.p99, self.greatest))
        return f"  {self.event}: median {median}, 99th percentile {p99}, maximum {greatest} ms ({self.count} times)"


@dataclass(frozen=True)
class BridgeReport:
    """The figures of a bridge with simulated boards, while all cores of the machine are busy.

    Attributes:
        delays: for each event.
        loop: by how much an interval of the loop is off its period: median, 99th percentile, greatest [ms].
        scheduling: of the bridge's process.
        rate: of the loop [Hz].
        hostile: messages sent.
        greatest_current: asked of a board meanwhile [A].
        max_current: its limit [A].
        unheard: how often nobody who was started after a kill was heard, until the bridge was started anew.
    """

    delays: tuple[ZeroDelays, ...]
    loop: tuple[float, float, float]
    scheduling: str
    rate: float
    hostile: int
    greatest_current: float
    max_current: float
    unheard: int

    def to_json(self) -> dict[str, Any]:
        """Return the figures as plain values; units as above."""
        return asdict(self)


def bridge_table(report: BridgeReport) -> Table:
    """Return the figures as a table that fits 80 columns."""
    title = "coil bridge with simulated boards, all cores busy; times in ms"
    table = Table(title=title, title_justify="left", title_style="bold", caption_justify="left")
    table.caption = f"zero: of the duties of all boards; loop at {report.rate:g} Hz, {report.scheduling}"
    table.add_column("", no_wrap=True)
    for name in ("median", "p99", "maximum", "bound", "beyond"):
        table.add_column(name, justify="right", no_wrap=True)
    for each in report.delays:
        values = (each.median, each.p99, each.greatest, each.bound)
        table.add_row(each.event, *(f"{1e3 * value:.1f}" for value in values), f"{each.beyond}/{each.count}")
    table.add_row("loop off its period", *(f"{value:.2f}" for value in report.loop), "", "")
    table.add_section()
    found, limit = f"{report.greatest_current:.2f} A", f"{report.max_current:.2f} A"
    table.add_row(f"{report.hostile} hostile messages", "", "", found, limit, "alive")
    kills = sum(each.count for each in report.delays[1:])
    table.add_row("unheard after a kill", "", "", "", "", f"{report.unheard}/{kills}")
    return table
