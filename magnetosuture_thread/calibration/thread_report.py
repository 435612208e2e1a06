"""The page of a thread: what was found, and how the run that was not fitted was predicted."""

from __future__ import annotations

import io
import json
import math
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from magnetosuture_thread.calibration import commission_files as files
from magnetosuture_thread.calibration.commission import SQUARE_ERROR
from magnetosuture_thread.calibration.commission_report import draw_rows, draw_table
from magnetosuture_thread.calibration.thread_drag import lines_of
from magnetosuture_thread.calibration.thread_step import (
    DRAG_INTERVAL,
    MEAN_ERROR,
    OWN_DRAG_ERROR,
    WORST_ERROR,
    Prediction,
    ThreadResult,
)
from magnetosuture_thread.evaluation.metrics import plain_values
from magnetosuture_thread.evaluation.plots import BAD, FAINT, GOOD, INK, PREDICTED, SEEN, draw_shapes, make_figure, tidy
from magnetosuture_thread.rig.setups import Setup
from magnetosuture_thread.settings.files import whole_file

PAGE_FILE, REFUSED_FILE = "thread.pdf", "thread_refused.pdf"


def write_thread(folder: Path, result: ThreadResult, setup: Setup, date: str) -> dict[str, Any]:
    """Write the page, and what was found into the summary, which is the last; return that and the page's name.

    Args:
        folder: of the commissioning.
        result: of the thread.
        setup: from before.
        date: of the page.
    """
    path = folder / files.SUMMARY_FILE
    summary = json.loads(path.read_text(encoding="utf-8"))
    part: dict[str, Any] = {"verdict": "refused" if result.failures else "pass", "failures": list(result.failures)}
    # What the setup has from a run that passed stays beside one that did not.
    kept = bool(result.failures) and summary.get("thread", {}).get("verdict") == "pass"
    page, key = (REFUSED_FILE, "thread_refused") if kept else (PAGE_FILE, "thread")
    part |= {name: summary[name] for name in ("setup", "poses", "rig")}
    part |= {"date": date, "bags": dict(result.bags), "values": [plain_values(value) for value in result.values]}
    limits = {"mean_error_percent": MEAN_ERROR, "worst_error_percent": WORST_ERROR, "square": SQUARE_ERROR}
    part["limits"] = limits | {"thread_drag_interval": DRAG_INTERVAL, "own_drag_error": OWN_DRAG_ERROR}
    if result.fit is not None:
        part["warnings"] = result.fit.warnings
    if result.drag is not None:
        part |= {"pulls": result.drag.pulls, "own_drag_by_pulls": result.drag.needle}
    if result.prediction is not None:
        part["prediction"] = {"before": result.prediction.before, "after": result.prediction.after}
    if math.isfinite(result.square):
        part["square"] = result.square
    with whole_file(folder / page) as partial:
        partial.write_bytes(draw_thread(result, setup, part))
    found = {value.name: plain_values(value) | {"changed": value.changed} for value in result.values}
    if not result.failures:
        summary["values"] = [found.get(value["name"], value) for value in summary["values"]]
    with whole_file(path) as partial:
        partial.write_text(json.dumps(summary | {key: part}, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return part | {"page": page}


def draw_thread(result: ThreadResult, setup: Setup, part: Mapping[str, Any]) -> bytes:
    """Return the page (PDF).

    Args:
        result: of the thread.
        setup: from before.
        part: of the summary, see `write_thread`.
    """
    figure = make_figure(8.27, 11.69)  # inch; A4
    text: dict[str, Any] = {"color": INK, "parse_math": False, "va": "top"}
    figure.text(0.06, 0.982, f"Thread of {part['setup']}", fontsize=17, weight="bold", **text)
    figure.text(0.94, 0.979, part["date"], fontsize=10, ha="right", **text)
    how = f"{part['poses']}; rig: {part['rig']}; {part.get('pulls', 0)} straight pulls, thread off the wall"
    figure.text(0.06, 0.957, how, fontsize=9, **text)
    words = "Refused: no setup was written" if result.failures else "Verification passed"
    figure.add_artist(Rectangle((0.06, 0.918), 0.88, 0.026, color=BAD if result.failures else GOOD))
    figure.text(0.07, 0.931, words, fontsize=12, weight="bold", color="white", va="center")
    lines = [*result.failures, *part.get("warnings", [])]
    wrapped = [textwrap.fill(line[:1].upper() + line[1:], 125, subsequent_indent="    ") for line in lines[:6]]
    figure.text(0.06, 0.908, "\n".join(wrapped), fontsize=8.0, linespacing=1.4, **text)
    if result.values:
        draw_table(figure, result.values, 0.80)
    if result.prediction is not None:
        _draw_errors(figure, result, result.prediction, 0.565)
        _draw_instants(figure, setup, result.prediction)
        _draw_series(figure.add_axes((0.09, 0.07, 0.50, 0.14)), result.prediction)
    if result.drag is not None and result.pulls is not None:
        own = setup.coils.needle_drag - setup.coils.thread_drag
        _draw_forces(
            figure.add_axes((0.70, 0.07, 0.24, 0.14)), 1e6 * np.array(lines_of(result.pulls, result.drag, own))
        )
    stream = io.BytesIO()
    figure.savefig(stream, format="pdf", metadata={"CreationDate": None})
    return stream.getvalue()


def _draw_errors(figure: Figure, result: ThreadResult, prediction: Prediction, top: float) -> None:
    """Draw the paper's table: errors of the prediction by poses alone, before and after."""
    columns = (
        *((0.06, "run that was not fitted, % of the thread's length", "left"), (0.62, "mean", "right")),
        *((0.70, "limit", "right"), (0.82, "maximum", "right"), (0.94, "limit", "right")),
    )
    rows, places = [], {"seen": "the measured thread", "truth": "ground truth (simulated)"}
    for kind, errors in (("calibrated", prediction.after), ("as assumed before", prediction.before)):
        for target, place in places.items():
            if figures := errors.get(target):
                judged = kind == "calibrated" and target == "seen"
                limits = (f"{MEAN_ERROR:g}", f"{WORST_ERROR:g}") if judged else ("", "")
                cells = [f"{kind}, against {place}", f"{figures['mean']:.3f}", limits[0]]
                rows.append((judged, [*cells, f"{figures['maximum']:.3f}", limits[1]]))
    square = f"{1e3 * result.square:.2f} mm", f"{1e3 * SQUARE_ERROR:g} mm"
    draw_rows(figure, columns, [*rows, (True, ["square, largest distance of the tip", "", "", *square])], top)


def _draw_instants(figure: Figure, setup: Setup, prediction: Prediction) -> None:
    """Draw predicted and measured threads."""
    for index, (predicted, measured) in enumerate(prediction.instants):
        axes = figure.add_axes((0.06 + 0.148 * index, 0.27, 0.142, 0.12))
        draw_shapes(axes, setup.scene)
        axes.plot(*(1e3 * measured.T), color=SEEN, linewidth=3.2, alpha=0.5)
        axes.plot(*(1e3 * predicted.T), color=PREDICTED, linewidth=1.1)
    words = "blue and wide: measured by the camera; magenta: predicted from the needle's poses alone"
    figure.text(0.06, 0.405, words, fontsize=8.5, color=INK)


def _draw_series(axes: Axes, prediction: Prediction) -> None:
    """Draw the error over time."""
    series = prediction.metrics.series
    axes.plot(series.times - series.times.min(), series.column("error_seen"), color=PREDICTED, linewidth=1.2)
    axes.axhline(MEAN_ERROR, color=FAINT, linewidth=0.9, linestyle=(0, (4, 3)))
    axes.set_ylim(bottom=0.0)
    axes.set_title("prediction error over time [% of the length]; dashed: limit of the mean", fontsize=8.5, loc="left")
    axes.set_xlabel("time [s]", fontsize=8)
    tidy(axes)


def _draw_forces(axes: Axes, forces: np.ndarray[Any, np.dtype[np.float64]]) -> None:
    """Draw the force on the thread in each pull, by its drags and as measured, shape (k, 2) [uN]."""
    ends = [forces.min(), forces.max()]
    axes.plot(ends, ends, color=FAINT, linewidth=0.9)
    axes.plot(forces[:, 1], forces[:, 0], "o", color=SEEN, markersize=4.0)
    axes.set_title("force on the thread, each pull [µN]", fontsize=8.5, loc="left")
    axes.set_xlabel("by its drags", fontsize=8)
    axes.set_ylabel("by the coils", fontsize=8)
    tidy(axes)
