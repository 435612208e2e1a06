"""The picture of an evaluated trajectory: the thread at some instants, and the error over time."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from magnetosuture_thread.evaluation.plots import FAINT, INK, SEEN, tidy
from magnetosuture_thread.evaluation.reference_scores import CaseResult

SAMPLES = 6
PREDICTED = "#d1495b"


def draw_case(path: Path, case: CaseResult, formulation: str) -> None:
    """Write a picture of one case (.png)."""
    figure = Figure(figsize=(11.0, 5.6), dpi=130, facecolor="white")
    scene, error = figure.subplots(
        1, 2, gridspec_kw={"width_ratios": [1.25, 1.0], "left": 0.06, "right": 0.985, "top": 0.83, "bottom": 0.1}
    )
    reference, score = case.reference, case.score
    figure.text(0.02, 0.945, f"{reference.name}, formulation {formulation}", fontsize=13, color=INK, weight="bold")
    words = (
        f"mean error {score.mean_error_percent:.3f} % of the length, greatest {score.max_error_percent:.3f} %; "
        f"n = {case.vertices.shape[1] - 1}; the reference is simulated, by another method"
    )
    figure.text(0.02, 0.9, words, fontsize=9.5, color=INK)
    _draw_scene(scene, case)
    error.plot(reference.times, case.error_percent, color=PREDICTED, linewidth=1.3)
    worst = int(case.error_percent.argmax())
    error.plot(reference.times[worst], case.error_percent[worst], "o", color=INK, markersize=4)
    error.set_ylim(0.0, 1.15 * max(float(case.error_percent.max()), 1e-6))
    error.set_xlim(reference.times[0], reference.times[-1])
    error.set_xlabel("time [s]", color=INK)
    error.set_title("mean distance of the nodes [% of the length]", fontsize=9.5, color=INK, loc="left")
    tidy(error)
    figure.savefig(path)


def _draw_scene(axes: Axes, case: CaseResult) -> None:
    """Draw the needle's way, and reference and prediction at instants evenly over time and at the worst one."""
    reference = case.reference
    chosen = set(np.linspace(0, len(reference.times) - 1, SAMPLES).astype(int).tolist())
    chosen.add(int(case.error_percent.argmax()))
    axes.plot(1e3 * reference.tails[:, 0], 1e3 * reference.tails[:, 1], color=FAINT, linewidth=0.7, alpha=0.6)
    for disc in reference.discs:
        centre = (1e3 * disc.centre[0], 1e3 * disc.centre[1])
        axes.add_patch(Circle(centre, 1e3 * disc.radius, facecolor="#e9d8d3", edgecolor=INK, linewidth=0.8))
    for index, k in enumerate(sorted(chosen)):
        truth, predicted = 1e3 * reference.threads[k], 1e3 * case.vertices[k]
        first = index == 0
        axes.plot(
            truth[:, 0],
            truth[:, 1],
            color=SEEN,
            linewidth=5.0,
            alpha=0.35,
            solid_capstyle="round",
            label="reference" if first else None,
        )
        axes.plot(
            predicted[:, 0],
            predicted[:, 1],
            color=PREDICTED,
            linewidth=1.0,
            marker="o",
            markersize=1.6,
            label="predicted" if first else None,
        )
        axes.plot(truth[0, 0], truth[0, 1], "o", color=INK, markersize=4, label="needle's tail" if first else None)
        axes.annotate(
            f"{reference.times[k]:.0f} s", truth[0], xytext=(5, 4), textcoords="offset points", fontsize=7.5, color=INK
        )
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x [mm]", color=INK)
    axes.set_ylabel("y [mm]", color=INK)
    axes.legend(loc="best", fontsize=8.5, frameon=False)
    tidy(axes)
