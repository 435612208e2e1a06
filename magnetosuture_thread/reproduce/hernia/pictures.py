"""The pictures of the simulated hernia repair: six instants, the barriers over time, and an animation."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from matplotlib.animation import PillowWriter
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from magnetosuture_thread.evaluation.plots import FAINT, INK, shape_patch, tidy
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.model.margins import Friction, FrictionState, friction_colour
from magnetosuture_thread.reproduce.hernia.steering import HerniaRun, SteeredInstant
from magnetosuture_thread.scene import Scene

FLOOR, RIM = "#f4f1ec", "#c9c3ba"
TISSUE, EDGE = "#f0b9b4", "#c98680"
RING, RING_EDGE = "#d9827f", "#a8504f"
MARGIN = 0.04  # of the dish's diameter, around it
REACH = 1.2  # s of its way, by which an arrow shows a velocity
NODE_COLOURS = ("#0b3c5d", "#1f77b4", "#2a9d8f", "#8ab17d", "#e9a03b")
TOP = 6.0e-3  # m; barriers beyond are not drawn
FASTER = 6  # than it happened
PICTURES = 8  # a second


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
        draw_hernia_dish(axes, run.scene)
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
        (Friction(FrictionState.SLIDING, (1,), 1.0), "friction at one node"),
        (Friction(FrictionState.SLIDING, tuple(range(20)), 1.0), "at twenty and more"),
        (Friction(FrictionState.STUCK, (1,), 1.0), "between obstacles, not pulled"),
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


def draw_animation(path: Path, run: HerniaRun) -> None:
    """Draw the run, faster than it happened, and write it as GIF.

    Args:
        path: of the file.
        run: what to draw.
    """
    figure = Figure(figsize=(4.6, 5.0), dpi=96, facecolor="white")
    count = math.floor(run.instants[-1].time / FASTER * PICTURES) + 1
    writer = PillowWriter(fps=PICTURES)
    with writer.saving(figure, str(path), 96):
        for k in range(count):
            instant = run.nearest(k * FASTER / PICTURES)
            figure.clear()
            axes = figure.add_axes((0.0, 0.0, 1.0, 0.9))
            draw_hernia_dish(axes, run.scene)
            draw_thread(axes, instant)
            figure.text(0.03, 0.955, caption(instant), fontsize=10.5, color=INK)
            words = f"{instant.time:.0f} s, shown {FASTER} times as fast; simulated, the thread model alone"
            figure.text(0.03, 0.915, words, fontsize=8, color=FAINT)
            writer.grab_frame()


def draw_hernia_dish(axes: Axes, scene: Scene) -> None:
    """Draw the dish and its shapes, in millimetres; a shape with a hole is a ring, and darker."""
    radius = 1e3 * scene.dish.radius
    axes.add_patch(Circle((0.0, 0.0), radius, facecolor=FLOOR, edgecolor=RIM, linewidth=1.4))
    for obstacle in scene.obstacles:
        is_ring = not isinstance(obstacle, Disc) and bool(obstacle.holes)
        fill, edge = (RING, RING_EDGE) if is_ring else (TISSUE, EDGE)
        width = 1.0 if isinstance(obstacle, Disc) else 0.8
        axes.add_patch(shape_patch(obstacle, facecolor=fill, edgecolor=edge, linewidth=width))
    axes.set_aspect("equal")
    reach = radius * (1.0 + 2.0 * MARGIN)
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-reach, reach)
    axes.set_axis_off()


def draw_thread(axes: Axes, instant: SteeredInstant) -> None:
    """Draw the thread in the colour of its friction, and the needle as a point with its commanded velocity."""
    points, friction = 1e3 * instant.prediction.positions, instant.margins.friction
    colour = friction_colour(friction)
    axes.plot(points[:, 0], points[:, 1], color="white", linewidth=4.0, solid_capstyle="round", alpha=0.8)
    axes.plot(points[:, 0], points[:, 1], color=colour, linewidth=2.0, solid_capstyle="round")
    axes.plot(points[1:, 0], points[1:, 1], "o", color=colour, markersize=2.4, markeredgewidth=0.0)
    if friction.nodes:
        under = points[list(friction.nodes)]
        axes.plot(*under.T, "o", color=colour, markersize=4.6, markeredgecolor="white", markeredgewidth=0.7)
    x, y = points[0]
    if instant.command is not None:
        for velocity, style in ((instant.command.commanded, (0, (1.5, 1.2))), (instant.command.filtered, "solid")):
            if velocity.any():
                dx, dy = REACH * 1e3 * velocity
                arrow = {"arrowstyle": "-|>", "color": INK, "linewidth": 1.1, "linestyle": style}
                axes.annotate("", xy=(x + dx, y + dy), xytext=(x, y), arrowprops=arrow)
    axes.plot([x], [y], "o", color=INK, markersize=5.0, markeredgecolor="white", markeredgewidth=0.8)


def caption(instant: SteeredInstant) -> str:
    """Return the friction state at an instant as text."""
    friction = instant.margins.friction
    count = f"{len(friction.nodes)} node{'s' if len(friction.nodes) != 1 else ''}"
    return {
        FrictionState.UNKNOWN: "unknown",
        FrictionState.FREE: "free",
        FrictionState.SLIDING: f"friction at {count}, needle slowed to {100.0 * friction.slowdown:.0f} %",
        FrictionState.STUCK: f"{count} between obstacles, not pulled",
    }[friction.state]
