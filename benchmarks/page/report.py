"""Figures of the page benchmark, and their table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from rich.table import Table

BOUND = 0.05  # s from a key press to the filtered velocity at the bridge, at the 99th percentile
LOST = 1.0  # s after a key press, after which no velocity counts as its answer
PICTURES = 30.0  # a second, that the page should draw


@dataclass(frozen=True)
class KeyDelays:
    """Times from a key press to a velocity.

    Attributes:
        station: where the velocity came.
        count: of key presses that did.
        lost: of those that did not.
        median: [s]
        p99: [s]
        greatest: [s]
    """

    station: str
    count: int
    lost: int
    median: float
    p99: float
    greatest: float

    @classmethod
    def between(cls, station: str, keys: Sequence[float], moving: Sequence[float]) -> KeyDelays:
        """Return the times from each key press to the first velocity after it.

        Args:
            station: where the velocity came.
            keys: when a key was pressed, rising [s].
            moving: when a velocity that is not zero came, rising [s]; at least one within a second of a key.
        """
        first = np.searchsorted(moving, keys)
        answers = [moving[index] if index < len(moving) else np.inf for index in first]
        delays = np.subtract(answers, keys)
        found = delays[delays < LOST]
        middle, high, most = np.percentile(found, [50.0, 99.0, 100.0])
        return cls(station, len(found), len(keys) - len(found), float(middle), float(high), float(most))


@dataclass(frozen=True)
class PageReport:
    """The figures of a page, while the graph runs on the same machine.

    Attributes:
        scenario: of the simulated rig.
        segments: n of its thread.
        delays: at each station.
        drawn: pictures that the page drew [1/s].
        states: of the graph that it was told [1/s].
        frames: of the camera that it showed [1/s].
    """

    scenario: str
    segments: int
    delays: tuple[KeyDelays, ...]
    drawn: float
    states: float
    frames: float

    def to_json(self) -> dict[str, Any]:
        """Return the figures as plain values; units as above."""
        return asdict(self)


def page_table(report: PageReport) -> Table:
    """Return the figures as a table that fits 80 columns."""
    title = f"operator's page, simulated rig, n = {report.segments}; ms from a key press"
    table = Table(title=title, title_justify="left", title_style="bold")
    table.add_column("", no_wrap=True)
    for name in ("median", "p99", "maximum", "keys", "lost"):
        table.add_column(name, justify="right", no_wrap=True)
    for each in report.delays:
        values = (f"{1e3 * value:.1f}" for value in (each.median, each.p99, each.greatest))
        table.add_row(each.station, *values, str(each.count), str(each.lost))
    return table


def page_lines(report: PageReport) -> list[str]:
    """Return in words what the table does not say."""
    return [
        f"wanted: at most {1e3 * BOUND:g} ms at the bridge, 99th percentile; {PICTURES:g} pictures a second",
        f"the page drew {report.drawn:.1f} pictures a second, of {report.states:.1f} states and {report.frames:.1f} "
        "camera frames",
    ]
