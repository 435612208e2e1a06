"""The picture of a calibration: distances along the thread before and after, and the parameters' intervals."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from magnetosuture_thread.calibration.recorded_run import across_residuals
from magnetosuture_thread.calibration.result import FIXED, BagFit, CalibrationResult, Estimate
from magnetosuture_thread.evaluation.plots import FAINT, INK, PREDICTED, tidy


def draw_calibration(path: Path, calibration: CalibrationResult, fits: Sequence[BagFit]) -> None:
    """Write the picture (.png).

    Args:
        path: of the picture.
        calibration: what was found.
        fits: each bag before and after.
    """
    rows = calibration.estimates
    figure = Figure(figsize=(8.0, 4.5 + 0.9 * len(rows)), dpi=120, facecolor="white", layout="constrained")
    along, *scales = figure.subplots(1 + len(rows), 1, squeeze=False, height_ratios=[8] + [1] * len(rows))[:, 0]
    state = "" if calibration.finished else ", best so far, not finished"
    name = f"{calibration.settings.material}, formulation {calibration.settings.formulation}: calibrated{state}"
    figure.suptitle(f"{name}\n{_summary(calibration)}", fontsize=10, color=INK)
    _draw_along(along, calibration.settings.thread_length, fits)
    for axes, estimate in zip(scales, rows, strict=True):
        _draw_parameter(axes, estimate)
    figure.savefig(path, format="png", metadata={"Software": None})


def _summary(calibration: CalibrationResult) -> str:
    before = np.mean([score.before for score in calibration.scores])
    count, bags = len(calibration.scores), "bag" if len(calibration.scores) == 1 else "bags"
    words = (
        f"{count} {bags}; mean prediction error {before:.2f} % of the length before, {calibration.error:.2f} % after"
    )
    held = [score.held_out for score in calibration.scores if np.isfinite(score.held_out)]
    if held:
        words += f", {np.mean(held):.2f} % for each bag by the others"
    simulated = sum(bool(score.simulated) for score in calibration.scores)
    if simulated:
        words += "; simulated" if simulated == count else f"; {simulated} simulated"
    return words


def _draw_along(axes: Axes, length: float, fits: Sequence[BagFit]) -> None:
    """Draw the distance across the thread from needle to end, mean over all bags and frames."""
    count = sum(fit.run.known.sum(axis=0) for fit in fits)
    for kind, colour in (("before", "#b4bcc4"), ("after", PREDICTED)):
        total = sum(np.abs(across_residuals(getattr(fit, kind), fit.run, length)).sum(axis=0) for fit in fits)
        mean = np.where(count > 0, np.maximum(100.0 * total / np.maximum(count, 1), 1e-3), np.nan)
        at = 1e3 * length * np.arange(1, len(mean) + 1) / len(mean)
        axes.semilogy(at, mean, color=colour, linewidth=1.3, marker="o", markersize=2.0, label=kind)
    axes.set_xlim(0.0, 1e3 * length)
    axes.set_xlabel("along the thread, from the needle [mm]", color=INK)
    axes.set_title("mean distance across the thread [% of the length]", fontsize=9.5, color=INK, loc="left")
    axes.legend(fontsize=8.5, frameon=False)
    tidy(axes)


def _draw_parameter(axes: Axes, estimate: Estimate) -> None:
    """Draw the fitted value of a parameter with its 95 % interval, and a tick at what the setup says."""
    fixed = estimate.status == FIXED
    scale, unit = {"m": (1e3, "mm"), "m^4/s": (1.0, "m⁴/s")}.get(estimate.unit, (1.0, estimate.unit))
    numbers = (estimate.value, estimate.start, estimate.low, estimate.high)
    value, start, low, high = (scale * number for number in numbers)
    words = "cannot be told" if fixed else f"{value:.3g} {unit}".rstrip() + (" ?" if estimate.reason else "")
    colour = FAINT if estimate.reason else PREDICTED
    axes.set_title(f"{estimate.name}: {words}; the tick is the setup's", fontsize=8.5, color=INK, loc="left")
    if np.isfinite(low):
        axes.plot([low, high], [0.0, 0.0], color=colour, linewidth=4.0, solid_capstyle="butt", alpha=0.45)
    if not fixed:
        axes.plot([value], [0.0], "o", color=colour, markersize=5)
    axes.plot([start], [0.0], "|", color=INK, markersize=11, markeredgewidth=1.4)
    if estimate.logarithmic:
        axes.set_xscale("log")
    axes.set_yticks([])
    tidy(axes)
