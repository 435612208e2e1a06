"""The picture of a calibration: fit, residuals over time and along the thread, and the parameters' intervals."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator
from numpy.typing import NDArray

from magnetosuture_thread.calibration.residuals import across_residuals
from magnetosuture_thread.calibration.result import FIXED, BagFit, CalibrationResult, Estimate
from magnetosuture_thread.evaluation.plots import FAINT, INK, INSTANTS, PREDICTED, WIDE, draw_instants, tidy
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.texts import printable

BEFORE = "#b4bcc4"
MIN_SHOWN = 1e-3  # % of length
CLOSE = 0.06  # of the length, within which a second instant gets no label


def draw_calibration(path: Path, calibration: CalibrationResult, fits: Sequence[BagFit]) -> None:
    """Write the picture (.png).

    Args:
        path: of the picture.
        calibration: what was found.
        fits: each bag before and after.
    """
    figure = Figure(figsize=(14.0, 8.2), dpi=120, facecolor="white")
    scores = calibration.scores
    worst = max(range(len(fits)), key=lambda index: scores[index].after)
    state = "" if calibration.finished else ", best so far, not finished"
    title = f"{calibration.settings.material}, formulation {calibration.settings.formulation}: calibrated{state}"
    figure.text(0.02, 0.957, title, fontsize=14, color=INK, weight="bold")
    figure.text(0.02, 0.928, _summary(calibration), fontsize=10, color=INK)
    _draw_scene(figure.add_axes((0.04, 0.075, 0.43, 0.80)), calibration, fits[worst])
    _draw_time(figure.add_axes((0.53, 0.655, 0.455, 0.225)), calibration, fits)
    _draw_along(figure.add_axes((0.53, 0.375, 0.455, 0.19)), calibration, fits)
    _draw_parameters(figure, calibration, (0.53, 0.045, 0.455, 0.25))
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
    simulated = sum(bool(text) for text in calibration.simulated)
    if simulated:
        words += "; simulated" if simulated == count else f"; {simulated} simulated"
    return words


def _draw_scene(axes: Axes, calibration: CalibrationResult, fit: BagFit) -> None:
    """Draw the thread as it was, as the setup has it and as calibrated, at instants evenly over the bag."""
    run, length = fit.run, calibration.settings.thread_length
    whole = np.flatnonzero(run.known.mean(axis=1) >= np.quantile(run.known.mean(axis=1), 0.5))
    chosen = whole[np.linspace(0, len(whole) - 1, min(INSTANTS, len(whole))).astype(int)]
    styles = [
        ("measured by the camera" if run.against == "seen" else "the ground truth", {**WIDE, "linewidth": 6.0}),
        ("as the setup has it", {"color": INK, "linewidth": 0.9, "linestyle": (0, (4, 2))}),
        ("calibrated", {"color": PREDICTED, "linewidth": 1.4}),
    ]
    labelled: list[Points] = []
    instants = []
    for k in chosen:
        tail, label = run.tails[run.frames[k]], ""
        if all(float(np.linalg.norm(tail - other)) > CLOSE * length for other in labelled):
            labelled.append(tail)
            label = f"{run.times[k]:.0f} s"
        instants.append((label, (np.vstack([tail, run.targets[k]]), fit.before[k], fit.after[k])))
    draw_instants(axes, run.tails, run.scene.obstacles if run.scene is not None else (), styles, instants)
    name = printable(Path(run.name).name)
    if len(calibration.scores) > 1:
        score = next(score for score in calibration.scores if score.name == run.name)
        name += f", the bag with the maximum error: {score.after:.2f} %"
    axes.set_title(name, fontsize=10, color=INK, loc="left", parse_math=False)


def _draw_time(axes: Axes, calibration: CalibrationResult, fits: Sequence[BagFit]) -> None:
    """Draw the prediction error over time, one bag after the other."""
    length, begin = calibration.settings.thread_length, 0.0
    style: dict[str, Any] = {"transform": axes.get_xaxis_transform(), "fontsize": 7.5, "color": FAINT, "va": "top"}
    shown = []
    for index, fit in enumerate(fits):
        if index:
            axes.axvline(begin, color=FAINT, linewidth=0.8, linestyle=(0, (2, 2)))
        if len(fits) > 1:
            axes.text(begin, 1.0, f" {printable(Path(fit.run.name).name)}", parse_math=False, **style)
        for vertices, colour, label in ((fit.before, BEFORE, "before"), (fit.after, PREDICTED, "after")):
            error = np.maximum(fit.error(vertices, length), MIN_SHOWN)
            axes.plot(begin + fit.run.times, error, color=colour, linewidth=1.3, label=None if index else label)
            shown.append(error)
        begin += fit.run.duration
    _percent_axis(axes, np.concatenate(shown))
    axes.set_xlim(0.0, begin)
    axes.set_xlabel("time [s]", color=INK, labelpad=1)
    axes.set_title("prediction error [% of the length]", fontsize=9.5, color=INK, loc="left")
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), fontsize=8.5, frameon=False, ncols=2)


def _draw_along(axes: Axes, calibration: CalibrationResult, fits: Sequence[BagFit]) -> None:
    """Draw the distance across the thread from needle to end, mean over all bags and frames."""
    length = calibration.settings.thread_length
    count = sum(fit.run.known.sum(axis=0) for fit in fits)
    shown = []
    for kind, colour in (("before", BEFORE), ("after", PREDICTED)):
        total = sum(np.abs(across_residuals(getattr(fit, kind), fit.run, length)).sum(axis=0) for fit in fits)
        mean = np.where(count > 0, np.maximum(100.0 * total / np.maximum(count, 1), MIN_SHOWN), np.nan)
        at = 1e3 * length * np.arange(1, len(mean) + 1) / len(mean)
        axes.plot(at, mean, color=colour, linewidth=1.3, marker="o", markersize=2.0)
        shown.append(mean)
    _percent_axis(axes, np.concatenate(shown))
    axes.set_xlim(0.0, 1e3 * length)
    axes.set_xlabel("along the thread, from the needle [mm]", color=INK, labelpad=1)
    axes.set_title("mean distance across the thread [% of the length]", fontsize=9.5, color=INK, loc="left")


def _percent_axis(axes: Axes, values: NDArray[np.float64]) -> None:
    axes.set_yscale("log")
    axes.set_ylim(float(np.nanmin(values)) / 1.3, float(np.nanmax(values)) * 1.4)
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, place: f"{value:g}"))
    axes.yaxis.set_minor_locator(NullLocator())
    tidy(axes)


def _draw_parameters(figure: Figure, calibration: CalibrationResult, box: tuple[float, float, float, float]) -> None:
    """Draw a scale for each parameter: fitted value with its interval, and what the setup says."""
    left, low, width, height = box
    title = "parameters with 95 % intervals; the tick is what the setup says"
    figure.text(left, low + height, title, fontsize=9.5, color=INK, va="bottom")
    rows, attachment = calibration.estimates, calibration.attachment
    step = min(height / max(1, len(rows) + (attachment is not None)), 0.062)
    for index, estimate in enumerate(rows):
        _draw_parameter(figure, estimate, (left, low + height - (index + 1) * step, width, step))
    if attachment is not None:
        top = low + height - (len(rows) + 0.38) * step
        figure.text(left, top, "attachment", fontsize=8.5, color=INK, va="center")
        words = attachment.value + (": cannot be told" if attachment.reason else "")
        figure.text(left + width, top, words, fontsize=8.5, color=FAINT if attachment.reason else INK, **_RIGHT)


_RIGHT: dict[str, Any] = {"ha": "right", "va": "center"}


def _draw_parameter(figure: Figure, estimate: Estimate, box: tuple[float, float, float, float]) -> None:
    left, low, width, height = box
    fixed = estimate.status == FIXED
    scale, unit = {"m": (1e3, "mm"), "m^4/s": (1.0, "m⁴/s")}.get(estimate.unit, (1.0, estimate.unit))
    numbers = (estimate.value, estimate.start, estimate.low, estimate.high)
    value, start, first, last = (scale * number for number in numbers)
    figure.text(left, low + 0.62 * height, estimate.name, fontsize=8.5, color=INK, va="center")
    words = "cannot be told" if fixed else f"{value:.3g} {unit}".rstrip() + (" ?" if estimate.reason else "")
    colour = FAINT if estimate.reason else PREDICTED
    figure.text(left + width, low + 0.62 * height, words, fontsize=8.5, color=FAINT if fixed else INK, **_RIGHT)
    axes = figure.add_axes((left + 0.115, low + 0.42 * height, width - 0.225, 0.36 * height))
    shown = [number for number in (value, start, first, last) if np.isfinite(number)]
    least, greatest = min(shown), max(shown)
    if estimate.logarithmic:
        axes.set_xscale("log")
        room = max(greatest / least, 1.01) ** 0.12
        axes.set_xlim(least / room, greatest * room)
        axes.set_xticks([least, greatest], [f"{end:.3g}" for end in (least, greatest)])
    else:
        room = 0.15 * (greatest - least) or 1e-9
        axes.set_xlim(least - room, greatest + room)
        axes.xaxis.set_major_locator(MaxNLocator(3))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda number, place: f"{number:.3g}"))
    axes.xaxis.set_minor_locator(NullLocator())
    if np.isfinite(first):
        axes.plot([first, last], [0.0, 0.0], color=colour, linewidth=4.0, solid_capstyle="butt", alpha=0.45)
    if not fixed:
        axes.plot([value], [0.0], "o", color=colour, markersize=5)
    axes.plot([start], [0.0], "|", color=INK, markersize=11, markeredgewidth=1.4)
    axes.set_ylim(-1.0, 1.0)
    axes.set_yticks([])
    axes.tick_params(labelsize=6.5, colors=FAINT, length=2, pad=1)
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
    axes.spines["bottom"].set_color("#d5dae0")
