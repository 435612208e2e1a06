"""The picture of the simulated hernia repair: six instants, and the barriers over time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from magnetosuture_thread.evaluation.plots import FAINT, tidy
from magnetosuture_thread.model.friction import Friction, FrictionState, friction_colour
from magnetosuture_thread.study.hernia.run import HerniaRun
from magnetosuture_thread.study.hernia.scene import INK, caption, draw_dish, draw_thread

NODE_COLOURS = ("#0b3c5d", "#1f77b4", "#2a9d8f", "#8ab17d", "#e9a03b")
TOP = 6.0e-3  # m; barriers beyond are not drawn


def draw_hernia(path: Path, run: HerniaRun) -> None:
    """Draw the picture and write it as PNG.

    Args:
        path: of the picture.
        run: what to draw.
    """
    figure = Figure(figsize=(13.2, 13.2), dpi=100, facecolor="white")
    figure.text(0.03, 0.975, "A needle steered by hand around a hernia, simulated", fontsize=14, color=INK)
    figure.text(
        0.03,
        0.957,
        "the thread model alone, the needle a point; solid arrow: where the needle goes, dotted: what was asked of it",
        fontsize=10,
        color=FAINT,
    )
    _draw_key(figure)
    times = [instant.time for instant in run.shown]
    for index, instant in enumerate(run.shown):
        column, row = index % 3, index // 3
        axes = figure.add_axes((0.02 + 0.325 * column, 0.618 - 0.315 * row, 0.31, 0.295))
        draw_dish(axes, run.scene)
        draw_thread(axes, instant)
        axes.set_title(f"{instant.time:.0f} s: {caption(instant)}", fontsize=10, color=INK, pad=2)
    for index, shape in enumerate(run.scene.shapes):
        axes = figure.add_axes((0.045 + 0.325 * index, 0.15, 0.275, 0.125))
        _draw_barriers(axes, run, index, shape.name.replace("_", " "), times)
    _draw_friction(figure.add_axes((0.045, 0.04, 0.925, 0.07)), run, times)
    figure.savefig(path)


def _draw_key(figure: Figure) -> None:
    """Draw what the colours mean."""
    states = (
        (Friction(FrictionState.FREE, (), 1.0), "free"),
        (Friction(FrictionState.PULLED, (1,), 1.0), "friction at one node"),
        (Friction(FrictionState.PULLED, tuple(range(20)), 1.0), "at twenty and more"),
        (Friction(FrictionState.RESTING, (1,), 1.0), "between obstacles, not pulled"),
    )
    lines = [Line2D([], [], color=friction_colour(friction), linewidth=3.0, label=label) for friction, label in states]
    figure.legend(
        handles=lines, loc="upper left", bbox_to_anchor=(0.022, 0.954), ncols=len(lines), frameon=False, fontsize=9.5
    )


def _draw_barriers(axes: Axes, run: HerniaRun, obstacle: int, name: str, times: list[float]) -> None:
    """Draw h_obs of the first nodes for one obstacle."""
    at = [instant.time for instant in run.instants]
    for node, colour in enumerate(NODE_COLOURS):
        axes.plot(at, 1e3 * run.barriers[:, node, obstacle], color=colour, linewidth=1.2, label=f"node {node + 1}")
    axes.axhline(1e3 * run.settings.friction_threshold, color=FAINT, linewidth=0.9, linestyle=(0, (4, 3)))
    axes.set_ylim(-0.2, 1e3 * TOP)
    axes.set_title(f"h_obs of the first nodes, {name} [mm]", fontsize=10, color=INK, loc="left")
    if obstacle == 0:
        axes.legend(loc="upper right", fontsize=7.5, frameon=False, ncols=2, columnspacing=1.0, handlelength=1.4)
    _finish(axes, at[-1], times)


def _draw_friction(axes: Axes, run: HerniaRun, times: list[float]) -> None:
    """Draw how many nodes are under friction, in the thread's colour."""
    at = np.array([instant.time for instant in run.instants])
    frictions = [instant.margins.friction for instant in run.instants]
    counts = np.array([len(friction.nodes) for friction in frictions])
    colours = [friction_colour(friction) for friction in frictions]
    axes.bar(at, np.maximum(counts, 0.4), width=1.02 * float(np.diff(at).mean()), color=colours, linewidth=0.0)
    axes.set_title("nodes under friction, in the thread's colour", fontsize=10, color=INK, loc="left")
    axes.set_xlabel("time [s]", fontsize=9, color=INK, labelpad=1)
    _finish(axes, float(at[-1]), times)


def _finish(axes: Axes, end: float, times: list[float]) -> None:
    for time in times:
        axes.axvline(time, color=FAINT, linewidth=0.7, linestyle=(0, (1, 3)), zorder=0)
    axes.set_xlim(0.0, end)
    tidy(axes)
