"""Charts of a campaign: a figure of each run against its seed, and the limit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

WIDTH, HEIGHT = 380.0, 170.0  # of the drawing, in its own units
LEFT, RIGHT, TOP, BOTTOM = 44.0, 10.0, 12.0, 24.0  # borders
HEADROOM = 1.12  # of the greatest value or limit


@dataclass(frozen=True)
class RunMark:
    """A run in a chart.

    Attributes:
        x: place in the drawing.
        y: likewise.
        success: of the run.
        label: for a person.
    """

    x: float
    y: float
    success: bool
    label: str


@dataclass(frozen=True)
class RunChart:
    """A figure of each run.

    Attributes:
        name: of the figure, with its unit.
        marks: of the runs that have one.
        ticks: place and text of each line across.
        limit: place of the limit, and of the band of what is not allowed: y and height; None without one.
        limit_label: of the limit.
        seeds: place and text of the first and the last seed.
    """

    name: str
    marks: tuple[RunMark, ...]
    ticks: tuple[tuple[float, str], ...]
    limit: tuple[float, float, float] | None
    limit_label: str
    seeds: tuple[tuple[float, str], ...]


def draw_chart(
    name: str, unit: str, runs: Sequence[tuple[int, bool]], values: Sequence[float], limit: float, is_minimum: bool
) -> RunChart:
    """Return the chart of a figure, from zero on.

    Args:
        name: of the figure.
        unit: of the values; empty for none.
        runs: seed and success of each.
        values: of each run; NaN for none.
        limit: NaN for none.
        is_minimum: whether the limit is the least value allowed, not the greatest.
    """
    known = [value for value in (*values, limit) if math.isfinite(value)]
    top = HEADROOM * max(known, default=1.0) or 1.0
    inner_width, inner_height = WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM

    def place(value: float) -> float:
        return round(TOP + inner_height * (1.0 - min(value, top) / top), 2)

    def across(index: int) -> float:
        return round(LEFT + inner_width * (index + 0.5) / len(runs), 2)

    suffix = f" {unit}" if unit else ""
    marks = tuple(
        RunMark(across(index), place(value), success, f"seed {seed}: {value:.3g}{suffix}")
        for index, ((seed, success), value) in enumerate(zip(runs, values, strict=True))
        if math.isfinite(value)
    )
    step = _round_step(top / 4.0)
    ticks = tuple((place(k * step), f"{k * step:.3g}") for k in range(int(top / step) + 1))
    band = None
    if math.isfinite(limit):
        at = place(limit)
        band = (at, at, round(TOP + inner_height - at, 2)) if is_minimum else (at, TOP, round(at - TOP, 2))
    ends = sorted({0, len(runs) - 1}) if runs else []
    return RunChart(
        f"{name} [{unit}]" if unit else name,
        marks,
        ticks,
        band,
        f"{'at least' if is_minimum else 'at most'} {limit:.3g}{suffix}",
        tuple((across(index), str(runs[index][0])) for index in ends),
    )


def _round_step(size: float) -> float:
    """Return 1, 2 or 5 times a power of ten, at least as large as a size."""
    power = 10.0 ** math.floor(math.log10(size))
    return next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= size * (1.0 - 1e-9))
