"""Plots of replayed bags and evaluated trajectories, and what all plots share: colours, axes, threads in a frame."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from numpy.typing import NDArray

from magnetosuture_thread.evaluation import colours
from magnetosuture_thread.evaluation.estimation import Consistency
from magnetosuture_thread.evaluation.frames import FrameResult, TimeSeries
from magnetosuture_thread.evaluation.graph_outputs import ReplaySummary
from magnetosuture_thread.evaluation.reference_scores import CaseResult
from magnetosuture_thread.evaluation.scene_plot import shape_patch
from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.obstacles import Disc, Obstacle, Polygon
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.margins import SOLID
from magnetosuture_thread.texts import printable

INK, FAINT = colours.INK.light, "#7b8794"
SEEN, TRUTH = colours.MEASURED.light, colours.GROUND_TRUTH.light
PREDICTED, ESTIMATED = colours.PREDICTED.light, colours.ESTIMATED.light
WIDE = {"color": SEEN, "alpha": 0.35, "solid_capstyle": "round"}  # where a thread was, beside what is predicted
OBSTACLE = "#e9d8d3"
MARGIN_COLOURS = LinearSegmentedColormap.from_list("margin", ["#c8102e", "#f28c28", "#1f9d55"])
FULL_CLEARANCE_MM = 1.0
CLOSE_UP = 2e-3  # m; half of the side of what is magnified
INSTANTS = 6  # of a trajectory
BARS = (0.5e-3, 1e-3, 2e-3, 5e-3, 10e-3, 20e-3, 50e-3)  # m


def draw_summary(
    path: Path,
    frame: NDArray[np.uint8],
    view: DishView,
    chosen: FrameResult,
    at: float,
    series: TimeSeries,
    obstacles: Sequence[Obstacle],
    summary: ReplaySummary,
) -> None:
    """Draw the summary and write it as PNG.

    Args:
        path: of the picture.
        frame: BGR or grey camera image of the chosen frame.
        view: where the dish is in it.
        chosen: the frame to show.
        at: its time since the bag's start [s].
        series: of all predicted frames.
        obstacles: discs and polygons [m].
        summary: the figures.
    """
    figure = Figure(figsize=(14.0, 7.2), dpi=110, facecolor="white")
    scene = figure.add_axes((0.015, 0.115, 0.44, 0.775))
    nodes = _draw_frame(scene, frame, view, chosen, obstacles)
    _draw_close_up(scene, frame, view, chosen, obstacles)
    _draw_colours(figure, nodes, chosen)
    words = f"frame at {at:.2f} s, where the prediction is farthest from the measured thread"
    figure.text(0.015, 0.905, words, fontsize=9.5, color=INK)
    consistency = Consistency.of(series)
    panels = (
        [_draw_error, _draw_clearance, _draw_strain]
        if consistency is None
        else [_draw_error, _draw_consistency, _draw_clearance, _draw_strain]
    )
    layout = {"left": 0.51, "right": 0.985, "top": 0.87, "bottom": 0.085, "hspace": 0.38}
    plots = figure.subplots(len(panels), 1, sharex=True, gridspec_kw=layout)
    for axes, draw in zip(plots, panels, strict=True):
        draw(axes, series)
    for axes in plots:
        axes.axvline(at, color=FAINT, linewidth=0.9, linestyle=(0, (2, 2)), zorder=0)
        tidy(axes)
    plots[-1].set_xlim(series.times[0], series.times[-1])
    plots[-1].set_xlabel("time since the bag's start [s]", color=INK)
    title = printable(_title(summary))  # with names from outside, and no mathematics in them
    figure.text(0.015, 0.938, title, fontsize=12, color=INK, linespacing=1.4, parse_math=False)
    figure.savefig(path)


def _title(summary: ReplaySummary) -> str:
    found = "frames tracked" if summary.source == "camera" else "recorded poses taken"
    words = f"{Path(summary.bag).name}, setup {summary.setup}: {summary.tracked} of {summary.frames} {found}"
    if summary.simulated:
        words += "\nsimulated: " + summary.simulated
    return words


def _draw_frame(
    axes: Axes, frame: NDArray[np.uint8], view: DishView, chosen: FrameResult, obstacles: Sequence[Obstacle]
) -> PathCollection:
    """Draw the dish, filling the axes, and return the thread's nodes."""
    nodes = draw_threads(axes, frame, view, chosen, obstacles, magnified=1.0)
    if len(chosen.tail):
        _draw_heading(axes, view, chosen)
    height, width = frame.shape[:2]
    middle, half = view.to_pixels(np.zeros(2)), 0.5 * min(height, width)
    axes.set_xlim(max(-0.5, middle[0] - half), min(width - 0.5, middle[0] + half))
    axes.set_ylim(height - 0.5, -0.5)
    draw_scale_bar(axes, view, 0.15)
    return nodes


def draw_threads(
    axes: Axes,
    frame: NDArray[np.uint8],
    view: DishView,
    chosen: FrameResult,
    obstacles: Sequence[Obstacle],
    magnified: float,
) -> PathCollection:
    """Draw a frame, obstacles, and the threads that there are, without axes.

    The measured thread is wide, the predicted one a line below the estimated one, the ground truth dashed. The nodes
    of the estimated thread, else of the predicted one, have the colours of their margins.

    Returns:
        The nodes.
    """
    axes.imshow(frame[:, :, ::-1] if frame.ndim == 3 else frame, cmap="gray", vmin=0, vmax=255, aspect="equal")
    axes.set_xticks([])
    axes.set_yticks([])
    for side in axes.spines.values():
        side.set_visible(False)
    for obstacle in obstacles:
        if isinstance(obstacle, Disc):
            centre = view.to_pixels(np.asarray(obstacle.centre))
            radius = obstacle.radius / view.metres_per_pixel
            axes.add_patch(Circle((centre[0], centre[1]), radius, fill=False, color=INK, linewidth=0.9))
        elif isinstance(obstacle, Polygon):
            for ring in obstacle.rings:
                corners = view.to_pixels(np.vstack([ring, ring[:1]]))
                axes.plot(corners[:, 0], corners[:, 1], color=INK, linewidth=0.9)
    if len(chosen.measured) > 1:
        measured = view.to_pixels(chosen.measured)
        axes.plot(
            measured[:, 0], measured[:, 1], color=SEEN, linewidth=5.0 * magnified, alpha=0.45, solid_capstyle="round"
        )
    nodes = view.to_pixels(chosen.vertices)
    axes.plot(nodes[:, 0], nodes[:, 1], color=PREDICTED, linewidth=3.0 * magnified, solid_capstyle="round")
    if chosen.estimate is not None:
        nodes = view.to_pixels(chosen.estimate.vertices)
        axes.plot(nodes[:, 0], nodes[:, 1], color=ESTIMATED, linewidth=1.7 * magnified, solid_capstyle="round")
    if len(chosen.ground_truth) > 1:
        points = view.to_pixels(chosen.ground_truth).T
        axes.plot(*points, color=TRUTH, linewidth=0.9 * magnified, linestyle=(0, (4, 4)))
    clearance = np.clip(1e3 * chosen.clearance[: len(nodes)], 0.0, FULL_CLEARANCE_MM)
    norm = Normalize(0.0, FULL_CLEARANCE_MM)
    size = 9.0 * magnified**2
    return axes.scatter(
        nodes[:, 0], nodes[:, 1], s=size, c=clearance, cmap=MARGIN_COLOURS, norm=norm, linewidths=0.0, zorder=2.5
    )


def _draw_close_up(
    scene: Axes, frame: NDArray[np.uint8], view: DishView, chosen: FrameResult, obstacles: Sequence[Obstacle]
) -> None:
    """Draw the workspace of the node nearest to an obstacle, or of the thread's end, magnified."""
    vertices = view.to_pixels(chosen.vertices)
    clearance = chosen.clearance
    nearest = int(np.argmin(clearance)) if np.isfinite(clearance).any() else len(vertices) - 1
    centre, half = vertices[nearest], CLOSE_UP / view.metres_per_pixel
    # Into the corner of the picture that is farthest from the thread.
    left, right = scene.get_xlim()
    bottom, top = scene.get_ylim()
    everything = np.vstack([vertices, view.to_pixels(chosen.tail[None])])
    corners = [(x, y) for x in (0.0, 0.62) for y in (0.0, 0.62)]
    middles = [np.array([left + (x + 0.19) * (right - left), bottom + (y + 0.19) * (top - bottom)]) for x, y in corners]
    room = [np.linalg.norm(everything - middle, axis=1).min() for middle in middles]
    x, y = corners[int(np.argmax(room))]
    x, y = (at + (0.01 if at == 0.0 else -0.01) for at in (x, y))
    inset = scene.inset_axes((x, y, 0.38, 0.38))
    draw_threads(inset, frame, view, chosen, obstacles, magnified=1.8)
    look_at(inset, centre, half)
    for side in inset.spines.values():
        side.set_visible(True)
        side.set_color(INK)
        side.set_linewidth(0.8)
    box = (centre[0] - half, centre[1] - half, 2.0 * half, 2.0 * half)
    scene.indicate_inset(box, inset, edgecolor=INK, alpha=0.7, linewidth=0.7)


def _draw_colours(figure: Figure, nodes: PathCollection, chosen: FrameResult) -> None:
    """Draw the key: what each line is, and the colours of the margin."""
    axes = figure.add_axes((0.015, 0.035, 0.24, 0.06))
    lines: list[tuple[str, dict[str, Any]]] = [("predicted", {"color": PREDICTED, "linewidth": 2.2})]
    if chosen.estimate is not None:
        lines.append(("estimated", {"color": ESTIMATED, "linewidth": 1.6}))
    if len(chosen.measured) > 1:
        lines.append(("measured by the camera", {"color": SEEN, "linewidth": 5.0, "alpha": 0.45}))
    if len(chosen.ground_truth) > 1:
        lines.append(("ground truth", {"color": TRUTH, "linewidth": 1.3, "linestyle": (0, (4, 2.5))}))
    handles = [Line2D([], [], label=name, **style) for name, style in lines]
    axes.legend(handles=handles, loc="center left", ncols=2, fontsize=8.5, frameon=False, borderpad=0.0)
    axes.set_axis_off()
    bar = figure.colorbar(nodes, cax=figure.add_axes((0.285, 0.062, 0.17, 0.014)), orientation="horizontal")
    bar.set_label("nodes, by distance from the obstacles [mm]", fontsize=8.5, color=INK)
    bar.ax.tick_params(labelsize=8, colors=INK, length=2)
    bar.outline.set_visible(False)


def _draw_heading(axes: Axes, view: DishView, chosen: FrameResult) -> None:
    tail = view.to_pixels(chosen.tail)
    ahead = 34.0 * np.array([np.cos(chosen.heading), -np.sin(chosen.heading)])
    outline = [patheffects.withStroke(linewidth=3.0, foreground="white")]
    style: dict[str, Any] = {"arrowstyle": "-|>", "color": INK, "linewidth": 1.3, "path_effects": outline}
    axes.annotate("", xy=tuple(tail + ahead), xytext=tuple(tail), arrowprops=style)


def look_at(axes: Axes, centre: NDArray[np.float64], half: float) -> None:
    """Show a square of a picture, by its middle and half of its side [px]."""
    axes.set_xlim(centre[0] - half, centre[0] + half)
    axes.set_ylim(centre[1] + half, centre[1] - half)


def draw_scale_bar(axes: Axes, view: DishView, share: float) -> None:
    """Draw a scale bar of a round length, at most a share of the picture's width."""
    left, right = axes.get_xlim()
    low, high = axes.get_ylim()
    fitting = [bar for bar in BARS if bar / view.metres_per_pixel <= share * (right - left)]
    bar = fitting[-1] if fitting else BARS[0]
    x, y = left + 0.04 * (right - left), low + 0.04 * (high - low)
    axes.plot([x, x + bar / view.metres_per_pixel], [y, y], color="white", linewidth=6.0, solid_capstyle="butt")
    axes.plot([x, x + bar / view.metres_per_pixel], [y, y], color=INK, linewidth=3.0, solid_capstyle="butt")
    box = {"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 1.5}
    axes.text(
        x, y + 0.015 * (high - low), f"{1e3 * bar:g} mm", color=INK, fontsize=11, ha="left", va="bottom", bbox=box
    )


def _draw_error(axes: Axes, series: TimeSeries) -> None:
    for kind, column, colour in (("prediction", "error", PREDICTED), ("estimate", "estimate_error", ESTIMATED)):
        for target, name, dashes in (("truth", "ground truth", "-"), ("seen", "measured centreline", ":")):
            if series.has(f"{column}_{target}"):
                errors, label = series.column(f"{column}_{target}"), f"{kind}, against the {name}"
                axes.plot(series.times, errors, color=colour, linewidth=1.4, linestyle=dashes, label=label)
    axes.set_ylim(0.0, 1.5 * axes.get_ylim()[1])  # room for the legend
    axes.set_title("error [% of the thread's length]", fontsize=9.5, color=INK, loc="left")
    if axes.get_lines():
        axes.legend(loc="upper right", fontsize=8.5, frameon=False, ncols=2)


def _draw_consistency(axes: Axes, series: TimeSeries) -> None:
    found = Consistency.of(series)
    title = "normalised innovation squared, its mean in windows, and the 95 % band of such means"
    axes.set_title(title, fontsize=9.5, color=INK, loc="left")
    squared = series.column("innovation_squared")
    axes.plot(series.times, squared, ".", color=FAINT, markersize=2.0, alpha=0.5)
    if found is None:
        return
    axes.set_ylim(0.0, max(2.5, float(np.nanpercentile(squared, 98))))
    for begin, end, mean, low, high in zip(found.begins, found.ends, found.means, found.low, found.high, strict=True):
        axes.fill_between([begin, end], low, high, color=ESTIMATED, alpha=0.3, linewidth=0)
        axes.plot([begin, end], [mean, mean], color=INK, linewidth=1.8)


def _draw_clearance(axes: Axes, series: TimeSeries) -> None:
    clearance = 1e3 * np.fmin.reduce([series.column(f"margin_{kind}") for kind in SOLID])
    axes.set_title("minimum clearance from an obstacle [mm]", fontsize=9.5, color=INK, loc="left")
    if not np.isfinite(clearance).any():
        axes.text(0.5, 0.5, "no obstacle near the thread", transform=axes.transAxes, ha="center", color=FAINT)
        return
    axes.plot(series.times, clearance, color="#1f9d55", linewidth=1.4)
    top = max(1.05 * float(np.nanmax(clearance)), 1e-3)
    axes.set_ylim(-0.06 * top, top)
    axes.axhspan(-0.06 * top, 0.0, color="#c8102e", alpha=0.15, linewidth=0)


def _draw_strain(axes: Axes, series: TimeSeries) -> None:
    values = np.maximum(100.0 * series.column("strain"), 1e-7)
    axes.set_yscale("log")
    axes.set_ylim(values.min() / 3.0, values.max() * 3.0)
    axes.plot(series.times, values, color=INK, linewidth=1.2)
    axes.set_title("maximum stretch or compression of a segment [%]", fontsize=9.5, color=INK, loc="left")


def draw_case(path: Path, case: CaseResult, formulation: str) -> None:
    """Write the picture of one evaluated trajectory (.png): the thread at some instants, and the error over time."""
    figure = Figure(figsize=(11.0, 5.6), dpi=130, facecolor="white")
    scene, error = figure.subplots(
        1, 2, gridspec_kw={"width_ratios": [1.25, 1.0], "left": 0.06, "right": 0.985, "top": 0.83, "bottom": 0.1}
    )
    reference, score, worst = case.reference, case.score, int(case.error_percent.argmax())
    title = printable(f"{reference.name}, formulation {formulation}")
    figure.text(0.02, 0.945, title, fontsize=13, color=INK, weight="bold", parse_math=False)
    words = (
        f"mean error {score.mean_error_percent:.3f} % of the length, maximum {score.max_error_percent:.3f} %; "
        f"n = {case.vertices.shape[1] - 1}; the reference is simulated, by another method"
    )
    figure.text(0.02, 0.9, words, fontsize=9.5, color=INK)
    chosen = sorted({*np.linspace(0, len(reference.times) - 1, INSTANTS).astype(int).tolist(), worst})
    draw_instants(
        scene,
        reference.tails,
        reference.discs,
        [
            ("reference", {**WIDE, "linewidth": 5.0}),
            ("predicted", {"color": PREDICTED, "marker": "o", "markersize": 1.6}),
        ],
        [(f"{reference.times[k]:.0f} s", (reference.threads[k], case.vertices[k])) for k in chosen],
    )
    error.plot(reference.times, case.error_percent, color=PREDICTED, linewidth=1.3)
    error.plot(reference.times[worst], case.error_percent[worst], "o", color=INK, markersize=4)
    error.set_ylim(0.0, 1.15 * max(float(case.error_percent.max()), 1e-6))
    error.set_xlim(reference.times[0], reference.times[-1])
    error.set_xlabel("time [s]", color=INK)
    error.set_title("mean distance of the nodes [% of the length]", fontsize=9.5, color=INK, loc="left")
    tidy(error)
    figure.savefig(path)


def draw_instants(
    axes: Axes,
    tails: Points,
    obstacles: Sequence[Obstacle],
    styles: Sequence[tuple[str, dict[str, Any]]],
    instants: Iterable[tuple[str, Sequence[Points]]],
) -> None:
    """Draw the needle's way, obstacles, and threads at some instants, in millimetres.

    Args:
        axes: to draw in.
        tails: the needle's tail over time, shape (T, 2) [m].
        obstacles: discs and polygons [m].
        styles: name and line of each thread of an instant.
        instants: label, empty for none, and threads from the needle's tail on, each of shape (m, 2) [m].
    """
    axes.plot(*(1e3 * tails.T), color=FAINT, linewidth=0.7, alpha=0.6)
    for shape in obstacles:
        if isinstance(shape, Disc | Polygon):
            axes.add_patch(shape_patch(shape, facecolor=OBSTACLE, edgecolor=INK, linewidth=0.8))
    for index, (label, threads) in enumerate(instants):
        for (name, style), points in zip(styles, threads, strict=True):
            axes.plot(*(1e3 * points.T), label=name if index == 0 else None, **{"linewidth": 1.0, **style})
        tail = 1e3 * threads[0][0]
        axes.plot(*tail, "o", color=INK, markersize=4, label="needle's tail" if index == 0 else None)
        axes.annotate(label, tail, xytext=(5, 4), textcoords="offset points", fontsize=8, color=INK)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x [mm]", color=INK)
    axes.set_ylabel("y [mm]", color=INK)
    axes.legend(loc="best", fontsize=8.5, frameon=True, framealpha=0.8, edgecolor="none")
    tidy(axes)


def tidy(axes: Axes) -> None:
    """Give a plot the look of all of ours."""
    axes.grid(True, color="#e4e8ec", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=8.5, colors=INK, length=3)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(FAINT)
