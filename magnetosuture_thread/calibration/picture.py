"""The picture of a calibration: fit, residuals over time and along the thread, and the parameters' intervals."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from magnetosuture_thread.calibration.replays import across
from magnetosuture_thread.calibration.result import FIXED, BagFit, CalibrationResult, Estimate
from magnetosuture_thread.evaluation.plots import FAINT, INK, SEEN, tidy
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.geometry.polyline import Points

INSTANTS = 6
AFTER = "#d1495b"
BEFORE = "#b4bcc4"
MIN_SHOWN = 1e-3  # % of length
OBSTACLE = "#e9d8d3"
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
    scene = figure.add_axes((0.04, 0.075, 0.43, 0.80))
    _draw_scene(scene, calibration, fits[worst])
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
    """Draw the thread as it was, as the set-up has it and as calibrated, at instants evenly over the bag."""
    passage = fit.passage
    whole = np.flatnonzero(passage.known.mean(axis=1) >= np.quantile(passage.known.mean(axis=1), 0.5))
    chosen = whole[np.linspace(0, len(whole) - 1, min(INSTANTS, len(whole))).astype(int)]
    for shape in passage.scene.obstacles if passage.scene is not None else ():
        if isinstance(shape, Disc):
            centre, radius = (1e3 * shape.centre[0], 1e3 * shape.centre[1]), 1e3 * shape.radius
            axes.add_patch(Circle(centre, radius, facecolor=OBSTACLE, edgecolor=INK, linewidth=0.8))
    axes.plot(1e3 * passage.tails[:, 0], 1e3 * passage.tails[:, 1], color=FAINT, linewidth=0.7, alpha=0.5)
    names = {"seen": "seen by the camera", "truth": "the truth"}
    labelled: list[Points] = []
    for index, k in enumerate(chosen):
        tail = passage.tails[passage.frames[k]]
        target = 1e3 * np.vstack([tail, passage.targets[k]])
        labels = (names[passage.against], "as the set-up has it", "calibrated") if index == 0 else (None,) * 3
        wide: dict[str, Any] = {"color": SEEN, "linewidth": 6.0, "alpha": 0.35, "solid_capstyle": "round"}
        axes.plot(target[:, 0], target[:, 1], label=labels[0], **wide)
        before, after = 1e3 * fit.before[k], 1e3 * fit.after[k]
        axes.plot(before[:, 0], before[:, 1], color=INK, linewidth=0.9, linestyle=(0, (4, 2)), label=labels[1])
        axes.plot(after[:, 0], after[:, 1], color=AFTER, linewidth=1.4, label=labels[2])
        axes.plot(1e3 * tail[0], 1e3 * tail[1], "o", color=INK, markersize=4)
        if all(float(np.linalg.norm(tail - other)) > CLOSE * calibration.settings.thread_length for other in labelled):
            labelled.append(tail)
            text = f"{passage.times[k]:.0f} s"
            axes.annotate(text, 1e3 * tail, xytext=(5, 4), textcoords="offset points", fontsize=8, color=INK)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x [mm]", color=INK)
    axes.set_ylabel("y [mm]", color=INK)
    score = next(score for score in calibration.scores if score.name == passage.name)
    title = f"{Path(passage.name).name}, the bag with the greatest error: {score.after:.2f} %"
    if len(calibration.scores) == 1:
        title = Path(passage.name).name
    axes.set_title(title, fontsize=10, color=INK, loc="left")
    axes.legend(loc="best", fontsize=8.5, frameon=True, framealpha=0.8, edgecolor="none")
    tidy(axes)


def _draw_time(axes: Axes, calibration: CalibrationResult, fits: Sequence[BagFit]) -> None:
    """Draw the prediction error over time, one bag after the other."""
    length, begin = calibration.settings.thread_length, 0.0
    lowest, highest = np.inf, 0.0
    for index, fit in enumerate(fits):
        times = begin + fit.passage.times
        for vertices, colour, label in ((fit.before, BEFORE, "before"), (fit.after, AFTER, "after")):
            error = np.maximum(fit.error(vertices, length), MIN_SHOWN)
            axes.plot(times, error, color=colour, linewidth=1.3, label=label if index == 0 else None)
            lowest, highest = min(lowest, float(error.min())), max(highest, float(error.max()))
        begin += fit.passage.duration
        if index < len(fits) - 1:
            axes.axvline(begin, color=FAINT, linewidth=0.8, linestyle=(0, (2, 2)))
    begin = 0.0
    for fit in fits if len(fits) > 1 else ():
        name = Path(fit.passage.name).name
        axes.text(begin, 1.0, f" {name}", transform=axes.get_xaxis_transform(), fontsize=7.5, color=FAINT, va="top")
        begin += fit.passage.duration
    _percent_axis(axes, lowest, highest)
    axes.set_xlim(0.0, sum(fit.passage.duration for fit in fits))
    axes.set_xlabel("time [s]", color=INK, labelpad=1)
    axes.set_title("prediction error [% of the length]", fontsize=9.5, color=INK, loc="left")
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), fontsize=8.5, frameon=False, ncols=2)


def _draw_along(axes: Axes, calibration: CalibrationResult, fits: Sequence[BagFit]) -> None:
    """Draw the distance across the thread from needle to end, mean over all bags and frames."""
    length = calibration.settings.thread_length
    lowest, highest = np.inf, 0.0
    for kind, colour in (("before", BEFORE), ("after", AFTER)):
        total, count = 0.0, 0
        for fit in fits:
            size = np.abs(across(getattr(fit, kind), fit.passage, length))
            total, count = total + size.sum(axis=0), count + fit.passage.known.sum(axis=0)
        mean = np.maximum(100.0 * total / np.maximum(count, 1), MIN_SHOWN)
        mean = np.where(count > 0, mean, np.nan)
        at = 1e3 * length * np.arange(1, len(mean) + 1) / len(mean)
        axes.plot(at, mean, color=colour, linewidth=1.3, marker="o", markersize=2.0)
        lowest, highest = min(lowest, float(np.nanmin(mean))), max(highest, float(np.nanmax(mean)))
    _percent_axis(axes, lowest, highest)
    axes.set_xlim(0.0, 1e3 * length)
    axes.set_xlabel("along the thread, from the needle [mm]", color=INK, labelpad=1)
    axes.set_title("mean distance across the thread [% of the length]", fontsize=9.5, color=INK, loc="left")


def _percent_axis(axes: Axes, lowest: float, highest: float) -> None:
    axes.set_yscale("log")
    axes.set_ylim(lowest / 1.3, highest * 1.4)
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, place: f"{value:g}"))
    axes.yaxis.set_minor_locator(NullLocator())
    tidy(axes)


def _draw_parameters(figure: Figure, calibration: CalibrationResult, box: tuple[float, float, float, float]) -> None:
    """Draw a scale for each parameter: fitted value with its interval, and what the set-up says."""
    left, low, width, height = box
    figure.text(
        left,
        low + height,
        "parameters with 95 % intervals; the tick is what the set-up says",
        fontsize=9.5,
        color=INK,
        va="bottom",
    )
    rows = list(calibration.estimates)
    attachment = calibration.attachment
    count = max(1, len(rows) + (attachment is not None))
    step = min(height / count, 0.062)
    for index, estimate in enumerate(rows):
        top = low + height - (index + 1) * step
        _draw_parameter(figure, estimate, (left, top, width, step))
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
    value, start, first, last = (
        scale * number for number in (estimate.value, estimate.start, estimate.low, estimate.high)
    )
    figure.text(left, low + 0.62 * height, estimate.name, fontsize=8.5, color=INK, va="center")
    words = "cannot be told" if fixed else f"{value:.3g} {unit}".rstrip() + (" ?" if estimate.reason else "")
    colour = FAINT if estimate.reason else AFTER
    figure.text(left + width, low + 0.62 * height, words, fontsize=8.5, color=FAINT if fixed else INK, **_RIGHT)
    axes = figure.add_axes((left + 0.115, low + 0.42 * height, width - 0.225, 0.36 * height))
    shown = [number for number in (value, start, first, last) if np.isfinite(number)]
    if estimate.logarithmic:
        axes.set_xscale("log")
        room = max(max(shown) / min(shown), 1.01) ** 0.12
        axes.set_xlim(min(shown) / room, max(shown) * room)
        axes.set_xticks([min(shown), max(shown)], [f"{end:.3g}" for end in (min(shown), max(shown))])
    else:
        least = min(shown)
        room = 0.15 * (max(shown) - least) or 1e-9
        axes.set_xlim(least - room, max(shown) + room)
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
