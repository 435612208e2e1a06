"""The report of a commissioning: one page, to print."""

from __future__ import annotations

import io
import json
import math
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from matplotlib.ticker import NullFormatter

from magnetosuture_thread.calibration.commission import MEDIAN_ERROR, WORST_ERROR, Commissioned
from magnetosuture_thread.calibration.commission_files import (
    REPORT_FILE,
    SUMMARY_FILE,
    Value,
    summary_of,
    values_of,
    write_setup,
)
from magnetosuture_thread.evaluation.plots import BAD, FAINT, GOOD, INK, PREDICTED, SEEN, make_figure, tidy
from magnetosuture_thread.rig.setups import Setup
from magnetosuture_thread.settings.files import whole_file

# Factor and unit in which a value is printed, by its SI unit.
SHOWN = {
    "rad": (math.degrees(1.0), "°"),
    "T/A": (1e3, "mT/A"),
    "m": (1e3, "mm"),
    "N s/m": (1e3, "mN s/m"),
    "N m s": (1e9, "nN m s"),
    "s": (1e3, "ms"),
    "T": (1e6, "µT"),
    "A m^2": (1e3, "mA m²"),
    "m^4/s": (1e12, "mm⁴/s"),
    "1/m": (1.0, "1/m"),
    "N": (1e6, "µN"),
    "": (1.0, ""),
}


def draw_report(result: Commissioned, setup: Setup, summary: Mapping[str, Any], date: str, kind: str) -> bytes:
    """Return the report.

    Args:
        result: of the commissioning.
        setup: that was believed.
        summary: see `summary_of`.
        date: of the report.
        kind: pdf, or png at 110 dpi.
    """
    figure = make_figure(8.27, 11.69)  # inch; A4
    passed = not result.failures
    verdict = "Verification passed" if passed else "Refused: no setup was written"
    text: dict[str, Any] = {"color": INK, "parse_math": False, "va": "top"}
    figure.text(0.06, 0.97, f"Commissioning of {setup.name}", fontsize=17, weight="bold", **text)
    figure.text(0.94, 0.967, date, fontsize=10, ha="right", **text)
    how = f"{summary['poses']}; rig: {summary['rig']}; {len(result.pulses)} pulses in {summary['rig_time']:.0f} s"
    figure.text(0.06, 0.945, f"{how}; at most {summary['largest_current']:.2f} A", fontsize=9, **text)
    figure.add_artist(Rectangle((0.06, 0.898), 0.88, 0.026, color=GOOD if passed else BAD))
    figure.text(0.07, 0.911, verdict, fontsize=12, weight="bold", color="white", va="center")
    lines = [f"refused: {words}" for words in result.failures] + [*result.findings]
    lines = lines or ["nothing differs from the setup but the values below."]
    wrapped = [textwrap.fill(line[:1].upper() + line[1:], 54, subsequent_indent="    ") for line in lines[:12]]
    figure.text(0.47, 0.878, "What was found", fontsize=11, weight="bold", **text)
    figure.text(0.47, 0.859, "\n".join(wrapped), fontsize=9.5, linespacing=1.5, **text)
    _draw_coils(figure.add_axes((0.05, 0.625, 0.40, 0.265)), result, setup)
    if result.model is None:
        _draw_ladder(figure, result, 0.60)
    else:
        _draw_verification(figure.add_axes((0.56, 0.645, 0.38, 0.085)), result)
        draw_table(figure, values_of(result, setup.coils), 0.60)
        _draw_history(figure.add_axes((0.10, 0.055, 0.84, 0.10)), result)
        notes = (
            "Gauge: a motion shows only field x moment / drag, so the mean field and the moment are held; one reading\n"
            "of a probe fixes teslas. Assumed: a bare needle does not show it; the thread's drag follows the "
            "needle's.\n"
            "Bold: more than 10 % (0.1 rad) off the setup. In the camera's frame: a coil is where it shows to be."
        )
        figure.text(0.06, 0.222, notes, fontsize=7.5, linespacing=1.35, **{**text, "color": FAINT})
    stream = io.BytesIO()
    metadata: dict[str, Any] = {"CreationDate": None} if kind == "pdf" else {"Software": None}
    figure.savefig(stream, format=kind, metadata=metadata)
    return stream.getvalue()


def _draw_coils(axes: Axes, result: Commissioned, setup: Setup) -> None:
    """Draw where each coil shows to be, its strength and polarity, and where the setup had it."""
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.set_xlim(-1.75, 1.75)
    axes.set_ylim(-1.75, 1.75)
    axes.add_patch(Circle((0.0, 0.0), 1.0, facecolor="#f4f6f8", edgecolor=FAINT))
    arrow = {"arrowstyle": "->", "color": FAINT, "linewidth": 0.8}
    for name, x, y, side, height in (("x", 1.0, 0.0, "left", "center"), ("y", 0.0, 1.0, "center", "baseline")):
        axes.annotate("", (0.45 * x, 0.45 * y), (0.0, 0.0), arrowprops=arrow)
        axes.text(0.5 * x, 0.5 * y, name, fontsize=8, color=FAINT, ha=side, va=height)
    believed = setup.coils.coils_properties()
    for k, coil in enumerate(believed):
        x, y = math.cos(coil.angle), math.sin(coil.angle)
        axes.text(1.1 * x, 1.1 * y, str(k), fontsize=8, color=FAINT, ha="center", va="center")
    if result.model is None:
        fastest = max((answer.speed for answer in result.answers if answer.moved), default=1.0)
        places = [
            (k, answer.direction, (1.0 if answer.towards else -1.0) * answer.speed / fastest)
            for k, answer in enumerate(result.answers)
            if answer.moved
        ]
    else:
        rig = result.model.parameters
        strengths = rig.fields / np.abs(rig.fields).max()
        places = list(zip(range(len(believed)), rig.angles.tolist(), strengths.tolist(), strict=True))
    for k, angle, strength in places:
        along, across = np.array([math.cos(angle), math.sin(angle)]), np.array([-math.sin(angle), math.cos(angle)])
        colour, half = SEEN if strength > 0.0 else PREDICTED, 0.12 + 0.28 * abs(strength)
        ends = np.array([1.32 * along - half * across, 1.32 * along + half * across])
        axes.plot(*ends.T, color=colour, linewidth=7.0, solid_capstyle="butt")
        x, y = (1.58 * along).tolist()
        axes.text(x, y, f"{k}", fontsize=12, weight="bold", color=colour, ha="center", va="center")
    axes.text(
        -1.75, -1.72, "grey: as in the setup; bar: strength; purple: field away from the coil", fontsize=7, color=FAINT
    )


def _draw_verification(axes: Axes, result: Commissioned) -> None:
    """Draw the error of each pulse that was not fitted, with the limits of the verdict."""
    if not len(result.errors):
        axes.set_axis_off()
        return
    share = 100.0 * result.errors[:, 0]
    axes.bar(
        np.arange(1, len(share) + 1), share, color=[GOOD if e < 100.0 * WORST_ERROR else BAD for e in share], width=0.6
    )
    axes.axhline(100.0 * WORST_ERROR, color=BAD, linewidth=0.9, linestyle=(0, (4, 3)))
    axes.axhline(100.0 * MEDIAN_ERROR, color=FAINT, linewidth=0.9, linestyle=(0, (4, 3)))
    axes.set_ylim(0.0, max(22.0, 1.1 * float(share.max())))
    heading = math.degrees(float(result.errors[:, 1].max()))
    square = f"; square within {1e3 * result.square:.2f} mm" if math.isfinite(result.square) else ""
    words = f"{len(share)} pulses not fitted: median {np.median(share):.1f} %, {heading:.1f}°{square}"
    axes.set_title(words, fontsize=8.0, color=INK, loc="left")
    axes.set_ylabel("error [% of way]", fontsize=8, color=INK)
    tidy(axes)
    axes.tick_params(labelsize=7.5)


def _draw_history(axes: Axes, result: Commissioned) -> None:
    """Draw how the widest intervals shrank."""
    if not result.history:
        axes.set_axis_off()
        return
    count, angle, gain, drag, delay = np.array(result.history).T
    rows = (("directions [°]", np.degrees(angle)), ("strengths [%]", 100.0 * gain), ("drags [%]", 100.0 * drag))
    for (name, values), colour in zip((*rows, ("delay [ms]", 1e3 * delay)), (SEEN, PREDICTED, GOOD, INK), strict=True):
        axes.semilogy(count, values, color=colour, marker="o", markersize=3.0, linewidth=1.3, label=name)
    axes.set_title("widest 95 % interval after so many pulses", fontsize=8.5, color=INK, loc="left")
    tidy(axes)
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_yticks([0.1, 0.3, 1.0, 3.0, 10.0], minor=False)
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_ylim(0.05, 15.0)
    axes.tick_params(labelsize=7.5)
    axes.legend(fontsize=7.5, frameon=False, loc="upper right", ncol=4, borderaxespad=0.0, bbox_to_anchor=(1.0, 1.25))


def draw_table(figure: Figure, values: Sequence[Value], top: float) -> None:
    """Draw the values with their intervals, and what the setup said."""
    columns = (
        *((0.06, "value", "left"), (0.50, "found", "right"), (0.58, "± 95 %", "right"), (0.70, "setup", "right")),
        *((0.80, "change", "right"), (0.94, "known by", "right")),
    )
    rows = []
    for value in values:
        factor, unit = SHOWN[value.unit]
        cells = [value.name, f"{factor * value.value:.4g} {unit}"]
        cells.append("" if math.isnan(value.interval) else f"{factor * value.interval:.2g}")
        cells.append("" if math.isnan(value.change) else f"{factor * value.before:.4g}")
        rows.append((value.changed, [*cells, _change(value), value.kind]))
    draw_rows(figure, columns, rows, top)


def _draw_ladder(figure: Figure, result: Commissioned, top: float) -> None:
    """Draw what each coil did by itself."""
    columns = (
        *((0.06, "coil by itself", "left"), (0.30, "current", "right"), (0.48, "direction", "right")),
        *((0.62, "needle", "right"), (0.78, "speed", "right"), (0.94, "turn rate", "right")),
    )
    rows = []
    for k, answer in enumerate(result.answers):
        cells = [f"coil {k}", f"{answer.current:.2f} A", f"{math.degrees(answer.direction):.0f}°"]
        cells += ["towards" if answer.towards else "away", f"{1e3 * answer.speed:.2f} mm/s/A"]
        none = [f"coil {k}", "no answer", "", "", "", ""]
        rows.append((not answer.moved, [*cells, f"{answer.turn_rate:.1f} rad/s/A"] if answer.moved else none))
    draw_rows(figure, columns, rows, top)


def draw_rows(
    figure: Figure, columns: Sequence[tuple[float, str, str]], rows: Sequence[tuple[bool, list[str]]], top: float
) -> None:
    """Draw a table: place, name and side of each column, and of each row whether it is bold, and its cells."""
    step = min(0.0172, (top - 0.245) / (len(rows) + 1))
    for x, name, side in columns:
        figure.text(x, top, name, fontsize=8.5, weight="bold", color=INK, ha=side, va="top")
    for row, (is_bold, cells) in enumerate(rows, 1):
        y, weight = top - row * step, "bold" if is_bold else "normal"
        if row % 2:
            figure.add_artist(Rectangle((0.055, y - 0.0137), 0.89, step, color="#f4f6f8", zorder=-1))
        for (x, _, side), cell in zip(columns, cells, strict=True):
            figure.text(x, y - 0.009, cell, fontsize=8.2, weight=weight, color=INK, ha=side, parse_math=False)


def _change(value: Value) -> str:
    if not math.isfinite(value.change):
        return ""
    return f"{math.degrees(value.change):+.1f}°" if value.unit == "rad" else f"{100.0 * value.change:+.0f} %"


def write_results(
    folder: Path, result: Commissioned, setup: Setup, how: Mapping[str, Any], date: str
) -> dict[str, Any]:
    """Write setup (of a passed verification alone), report and summary, which is the last; return it."""
    summary = summary_of(result, setup, how)
    if not result.failures:
        write_setup(folder, result, setup, date)
    with whole_file(folder / REPORT_FILE) as partial:
        partial.write_bytes(draw_report(result, setup, summary, date, "pdf"))
    with whole_file(folder / SUMMARY_FILE) as partial:
        partial.write_text(json.dumps(summary, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return summary
