"""The picture of the thread-behaviour tests: prediction over what the camera sees, and its error, by material."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from magnetosuture_thread.evaluation.closed_loop import LoopSummary
from magnetosuture_thread.evaluation.frames import FrameResult as Instant
from magnetosuture_thread.evaluation.plots import FAINT, INK, SEEN, TRUTH, draw_threads, tidy
from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.obstacles import Obstacle

SHOWN = 4  # instants of each run
BORDER = 0.06  # of the dish's diameter, around it in a picture
ROW = 2.9  # height of a run [inch]


@dataclass(frozen=True)
class Run:
    """One thread-behaviour test.

    Attributes:
        name: for a person.
        summary: its figures.
        instants: the predicted frames, by time.
        frames: BGR pictures of the instants to show, by their stamps [ns].
        view: where the dish is in them.
        dish_diameter: [m]
        obstacles: in the dish.
    """

    name: str
    summary: LoopSummary
    instants: Sequence[Instant]
    frames: dict[int, NDArray[np.uint8]]
    view: DishView
    dish_diameter: float
    obstacles: Sequence[Obstacle] = ()


def chosen_instants(instants: Sequence[Instant]) -> list[Instant]:
    """Return the instants to show: spread evenly over the run, the last among them."""
    at = np.linspace(0, len(instants) - 1, SHOWN + 1).round().astype(int)[1:]
    return [instants[index] for index in at]


def draw_behaviour(path: Path, runs: Sequence[Run]) -> None:
    """Draw the tests below one another and write the picture as PNG.

    Args:
        path: of the picture.
        runs: the tests.
    """
    height = ROW * len(runs) + 0.72
    figure = Figure(figsize=(15.0, height), dpi=100, facecolor="white")
    figure.text(0.012, 1.0 - 0.32 / height, "Thread behaviour in closed loop, simulated", fontsize=13, color=INK)
    figure.text(
        0.012,
        1.0 - 0.58 / height,
        "wide and blue: what the camera sees; thin, with nodes: what the model predicts from the needle's pose alone",
        fontsize=9.5,
        color=FAINT,
    )
    for index, run in enumerate(runs):
        bottom = (ROW * (len(runs) - 1 - index) + 0.12) / height
        _draw_row(figure, run, bottom, (ROW - 0.42) / height)
    figure.savefig(path)


def _draw_row(figure: Figure, run: Run, bottom: float, height: float) -> None:
    figure.text(0.012, bottom + height + 0.012, run.name, fontsize=10.5, color=INK)
    began = run.instants[0].stamp
    for column, instant in enumerate(chosen_instants(run.instants)):
        axes = figure.add_axes((0.012 + 0.168 * column, bottom, 0.163, height))
        _draw_instant(axes, run, instant, (instant.stamp - began) * 1e-9)
    plot = figure.add_axes((0.725, bottom + 0.055, 0.262, height - 0.06))
    times = np.array([(instant.stamp - began) * 1e-9 for instant in run.instants])
    for label, colour, errors in (
        ("against the seen centreline", SEEN, [instant.error_seen for instant in run.instants]),
        ("against the truth", TRUTH, [instant.error_truth for instant in run.instants]),
    ):
        mean = float(np.nanmean(errors))
        plot.plot(times, errors, color=colour, linewidth=1.2, label=f"{label}, mean {mean:.2f}")
    plot.set_ylim(0.0, 1.35 * plot.get_ylim()[1])  # room for the legend
    plot.set_xlim(times[0], times[-1])
    plot.set_title("prediction error [% of the length]", fontsize=9.5, color=INK, loc="left")
    plot.set_xlabel("time [s]", fontsize=8.5, color=INK, labelpad=1)
    plot.legend(loc="upper right", fontsize=8.0, frameon=False, ncols=1)
    tidy(plot)


def _draw_instant(axes: Axes, run: Run, instant: Instant, time: float) -> None:
    draw_threads(axes, run.frames[instant.stamp], run.view, instant, run.obstacles, magnified=0.8)
    centre = run.view.to_pixels(np.zeros(2))
    half = (0.5 + BORDER) * run.dish_diameter / run.view.metres_per_pixel
    axes.set_xlim(centre[0] - half, centre[0] + half)
    axes.set_ylim(centre[1] + half, centre[1] - half)
    axes.text(0.03, 0.97, f"{time:.1f} s", transform=axes.transAxes, fontsize=9, color=INK, va="top")
    for side in axes.spines.values():
        side.set_visible(False)
