"""Plots and pictures of worst frames, evaluated trajectories and scenes; and colours, axes and scale of all plots."""

from __future__ import annotations

import base64
import io
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch, PathPatch, Rectangle
from matplotlib.path import Path as Outline
from matplotlib.transforms import Affine2D
from numpy.typing import NDArray

from magnetosuture_thread.evaluation.figures import AGAINST, COLOURS, format_number
from magnetosuture_thread.evaluation.frames import FrameResult, WorstFrame
from magnetosuture_thread.evaluation.graph_outputs import ReplaySummary
from magnetosuture_thread.evaluation.metrics import node_errors, target_points
from magnetosuture_thread.evaluation.reference import CaseResult
from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.obstacles import Disc, Obstacle, Polygon
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.geometry.scene import KINDS, Scene
from magnetosuture_thread.settings.errors import printable

SEEN, TRUTH, PREDICTED, ESTIMATED = (light for light, _ in COLOURS.values())
INK, FAINT = TRUTH, "#7b8794"
KIND_COLOURS = {
    "tissue": ("#f0b9b4", "#b8665f"),
    "instrument": ("#b9c6d2", "#56697a"),
    "wall": ("#cbbfa9", "#6f624c"),
}  # of a shape in a scene: face and edge
BAD = "#c8102e"
MARGIN_COLOURS = LinearSegmentedColormap.from_list("margin", [BAD, "#f28c28", "#1f9d55"])  # from 0 to 1 mm


class Photo(NamedTuple):
    """A camera frame and where the dish is in it.

    Attributes:
        image: BGR or grey.
        view: of the dish.
    """

    image: NDArray[np.uint8]
    view: DishView


@dataclass(frozen=True)
class ReportPicture:
    """A picture of one of the worst frames.

    Attributes:
        worst: what is shown.
        source: the picture as a data URI.
        alt_text: what it shows, in words.
        is_plan: whether it is a plan and no camera frame.
    """

    worst: WorstFrame
    source: str
    alt_text: str
    is_plan: bool


def draw_summary(path: Path, photo: Photo, chosen: FrameResult, at: float, summary: ReplaySummary) -> None:
    """Write the picture of a replay (.png): the dish and a close-up of a frame, with the threads in it.

    Args:
        path: of the picture.
        photo: camera image of the chosen frame.
        chosen: the frame to show.
        at: its time since the bag's start [s].
        summary: the figures, for the title.
    """
    found = "frames tracked" if summary.source == "camera" else "recorded poses taken"
    title = f"{Path(summary.bag).name}, setup {summary.setup}: {summary.tracked} of {summary.frames} {found}"
    if summary.simulated:
        title += f"\nsimulated: {summary.simulated}"
    words = (
        f"frame at {at:.2f} s, where the prediction is farthest from the measured thread\nwide: measured; magenta: "
        "predicted; teal: estimated; dashed: ground truth; nodes: red at an obstacle to green 1 mm away"
    )
    figure = Figure(figsize=(14.0, 7.9), dpi=110, facecolor="white")
    nearest = int(np.argmin(chosen.clearance)) if np.isfinite(chosen.clearance).any() else len(chosen.vertices) - 1
    _draw_dish_and_close_up(figure, photo, chosen, chosen.vertices[nearest], 2e-3, height=0.86)
    # With names from outside, and no mathematics in them.
    lines = "\n".join(printable(line) for line in title.split("\n"))
    figure.text(0.01, 0.985, lines, fontsize=12, color=INK, parse_math=False, va="top")
    figure.text(0.01, 0.925, words, fontsize=9.5, color=INK, va="top")
    figure.savefig(path)


def draw_worst_frame(
    worst: WorstFrame,
    photo: Photo | None,
    *,
    target: str,
    length: float,
    dish_diameter: float,
    simulated: bool = False,
) -> ReportPicture:
    """Draw one of the worst frames: the whole dish, and close by where prediction or estimate is farthest off.

    Args:
        worst: what to show.
        photo: the camera's frame; without one a plan is drawn.
        target: what the prediction is compared with, `truth` or `seen`.
        length: of the thread [m].
        dish_diameter: [m]
        simulated: whether the frame is rendered.
    """
    shown, frame = photo or draw_plan(dish_diameter), worst.frame
    targets = target_points(frame.target_curve(target), length, len(frame.vertices) - 1)[0]
    vertices = frame.vertices if worst.of == "prediction" or frame.estimate is None else frame.estimate.vertices
    errors = node_errors(vertices, targets, length)
    node = int(np.nanargmax(errors)) + 1
    greatest = 0.01 * float(np.nanmax(errors)) * length
    ends = np.vstack([vertices[node], targets[node - 1]])
    figure = Figure(figsize=(12.0, 5.95), dpi=100, facecolor="#888e94")
    half = max(0.08 * length, 0.75 * greatest)
    scene, close = _draw_dish_and_close_up(figure, shown, frame, ends.mean(axis=0), half)
    close.plot(*shown.view.to_pixels(ends).T, color=BAD, linewidth=1.6)
    if simulated:
        box = {"facecolor": "#fff3d6", "alpha": 0.85, "edgecolor": "none", "pad": 2.5}
        scene.text(0.02, 0.98, "simulated", transform=scene.transAxes, color="#5c4300", fontsize=11, va="top", bbox=box)
    kind = "Plan of the dish" if photo is None else "Simulated camera frame" if simulated else "Camera frame"
    words = (
        f"{kind} at {worst.time:.2f} s with the threads, and a close-up of node {node} of the {worst.of}, "
        f"which is {format_number(1e3 * greatest)} mm from {AGAINST[target]}; "
        f"error of the {worst.of} {format_number(worst.error)} % of the length."
    )
    stream = io.BytesIO()
    figure.savefig(stream, format="jpeg", pil_kwargs={"quality": 84, "optimize": True})
    source = "data:image/jpeg;base64," + base64.b64encode(stream.getvalue()).decode()
    return ReportPicture(worst, source, words, photo is None)


def _draw_dish_and_close_up(
    figure: Figure, photo: Photo, frame: FrameResult, middle: Points, half: float, height: float = 1.0
) -> tuple[Axes, Axes]:
    """Draw the whole dish to the left and a square about a point to the right, with half of its side in metres."""
    view, (rows, columns) = photo.view, photo.image.shape[:2]
    scene, close = (figure.add_axes((left, 0.0, 0.4985, height)) for left in (0.0, 0.5015))
    for axes, magnified in ((scene, 1.0), (close, 1.8)):
        draw_threads(axes, photo.image, view, frame, frame.obstacles, magnified)
    half_side = 0.5 * min(rows, columns)
    edge = half_side - 0.5
    look_at(scene, np.clip(view.to_pixels(np.zeros(2)), edge, [columns - 1.0 - edge, rows - 1.0 - edge]), half_side)
    at, reach = view.to_pixels(middle), half / view.metres_per_pixel
    look_at(close, at, reach)
    box: dict[str, Any] = {"fill": False, "color": INK, "linewidth": 1.0, "linestyle": (0, (3, 2))}
    scene.add_patch(Rectangle((at[0] - reach, at[1] - reach), 2.0 * reach, 2.0 * reach, **box))
    for axes, share in ((scene, 0.25), (close, 0.4)):
        draw_scale_bar(axes, view.metres_per_pixel, share)
    return scene, close


def draw_plan(dish_diameter: float) -> Photo:
    """Return a drawn dish, where no camera saw the real one."""
    side, share = 620, 0.94  # px; of it that the dish takes
    middle = 0.5 * (side - 1.0)
    from_middle = np.arange(side) - middle
    inside = np.hypot(from_middle, from_middle[:, None]) < 0.5 * share * side
    view = DishView((middle, middle), dish_diameter / (share * side))
    return Photo(np.where(inside, 244, 200).astype(np.uint8), view)


def draw_threads(
    axes: Axes,
    frame: NDArray[np.uint8],
    view: DishView,
    chosen: FrameResult,
    obstacles: Sequence[Obstacle],
    magnified: float,
) -> None:
    """Draw a frame, obstacles, and the threads that there are, without axes.

    The measured thread is wide, the predicted one a line below the estimated one, the ground truth dashed. The nodes
    of the estimated thread, else of the predicted one, have the colours of their margins.
    """
    axes.imshow(frame[:, :, ::-1] if frame.ndim == 3 else frame, cmap="gray", vmin=0, vmax=255, aspect="equal")
    axes.set_axis_off()
    to_frame = Affine2D().scale(1e-3 / view.metres_per_pixel).rotate(view.rotation).scale(1.0, -1.0)
    to_pixels = to_frame.translate(*view.centre_px) + axes.transData
    for obstacle in obstacles:
        if isinstance(obstacle, (Disc, Polygon)):
            axes.add_patch(shape_patch(obstacle, fill=False, edgecolor=INK, linewidth=0.9, transform=to_pixels))
    nodes = chosen.vertices if chosen.estimate is None else chosen.estimate.vertices
    for points, colour, width, alpha, dashes in (
        (chosen.measured, SEEN, 5.0, 0.45, "solid"),
        (chosen.vertices, PREDICTED, 3.0, 1.0, "solid"),
        (nodes if chosen.estimate is not None else nodes[:0], ESTIMATED, 1.7, 1.0, "solid"),
        (chosen.ground_truth, TRUTH, 0.9, 1.0, (0, (4, 4))),
    ):
        style: dict[str, Any] = {"color": colour, "linewidth": width * magnified, "alpha": alpha, "linestyle": dashes}
        axes.plot(*view.to_pixels(points).T, solid_capstyle="round", **style)
    close = np.clip(1e3 * chosen.clearance[: len(nodes)], 0.0, 1.0)
    u, v = view.to_pixels(nodes).T
    axes.scatter(u, v, s=9.0 * magnified**2, color=MARGIN_COLOURS(close), linewidths=0.0, zorder=2.5)


def look_at(axes: Axes, centre: NDArray[np.float64], half: float) -> None:
    """Show a square of a picture, by its middle and half of its side [px]."""
    axes.set(xlim=(centre[0] - half, centre[0] + half), ylim=(centre[1] + half, centre[1] - half))


def draw_scale_bar(axes: Axes, metres: float, share: float) -> None:
    """Draw a scale bar of a round length, at most a share of the picture's width.

    Args:
        axes: to draw in, with limits.
        metres: that a unit of the axes is long [m].
        share: of the width.
    """
    left, right = axes.get_xlim()
    low, high = axes.get_ylim()
    lengths = [figure * 10.0**power for power in range(-4, 0) for figure in (1, 2, 5)]  # m
    bar = max((bar for bar in lengths if bar / metres <= share * (right - left)), default=lengths[0])
    x, y = left + 0.04 * (right - left), low + 0.04 * (high - low)
    for colour, width in (("white", 6.0), (INK, 3.0)):
        axes.plot([x, x + bar / metres], [y, y], color=colour, linewidth=width, solid_capstyle="butt", zorder=5)
    box = {"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 1.5}
    y += 0.015 * (high - low)
    axes.text(x, y, f"{1e3 * bar:g} mm", color=INK, fontsize=11, ha="left", va="bottom", bbox=box)


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
        f"wide: the reference, simulated by another method; magenta: predicted, n = {case.vertices.shape[1] - 1}; "
        f"mean error {score.mean_error_percent:.3f} % of the length, maximum {score.max_error_percent:.3f} %"
    )
    figure.text(0.02, 0.9, words, fontsize=9.5, color=INK)
    scene.plot(*(1e3 * reference.tails.T), color=FAINT, linewidth=0.7, alpha=0.6)
    for disc in reference.discs:
        scene.add_patch(shape_patch(disc, facecolor="#e9d8d3", edgecolor=INK, linewidth=0.8))
    for k in sorted({*np.linspace(0, len(reference.times) - 1, 6).astype(int).tolist(), worst}):
        measured, tail = 1e3 * reference.threads[k], 1e3 * reference.threads[k][0]
        scene.plot(*measured.T, color=SEEN, alpha=0.35, linewidth=5.0, solid_capstyle="round")
        scene.plot(*(1e3 * case.vertices[k].T), color=PREDICTED, linewidth=1.0, marker="o", markersize=1.6)
        scene.plot(*tail, "o", color=INK, markersize=4)
        label = f"{reference.times[k]:.0f} s"
        scene.annotate(label, tail, xytext=(5, 4), textcoords="offset points", fontsize=8, color=INK)
    scene.set_aspect("equal", adjustable="datalim")
    scene.set_title("threads and the needle's way [mm]", fontsize=9.5, color=INK, loc="left")
    error.plot(reference.times, case.error_percent, color=PREDICTED, linewidth=1.3)
    error.plot(reference.times[worst], case.error_percent[worst], "o", color=INK, markersize=4)
    error.set_ylim(0.0, 1.15 * max(float(case.error_percent.max()), 1e-6))
    error.set_xlabel("time [s]", color=INK)
    error.set_title("mean distance of the nodes [% of the length]", fontsize=9.5, color=INK, loc="left")
    for axes in (scene, error):
        tidy(axes)
    figure.savefig(path)


def tidy(axes: Axes) -> None:
    """Give a plot the look of all of ours."""
    axes.grid(True, color="#e4e8ec", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=8.5, colors=INK, length=3)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(FAINT)


def plot_scene(path: Path, scene: Scene, name: str) -> None:
    """Draw a scene into a file, PNG or SVG by its ending: dish, shapes in the colours of their kinds, names and scale.

    Args:
        path: to write.
        scene: to draw.
        name: of the scene, for the title.
    """
    # The same scene gives the same bytes; in SVG, text stays text.
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": scene.version}), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph")  # of a name in a script that the font does not have
        figure = Figure(figsize=(7.0, 7.45), dpi=150)
        FigureCanvasAgg(figure)
        _draw_scene(figure.add_axes((0.0, 0.0, 1.0, 7.0 / 7.45)), scene)
        dish = f"dish of {1e3 * scene.dish.diameter:g} mm, {1e3 * scene.dish.depth:g} mm deep"
        style: dict[str, Any] = {"color": INK, "parse_math": False, "va": "top"}
        figure.text(0.03, 0.972, name, fontsize=14, weight="bold", **style)
        figure.text(0.97, 0.968, f"{dish}, version {scene.version}", fontsize=9, ha="right", **style)
        figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)


def _draw_scene(axes: Axes, scene: Scene) -> None:
    draw_empty_dish(axes, scene, 0.12)
    axes.plot([0.0], [0.0], "+", color=FAINT, markersize=9.0, markeredgewidth=0.8, zorder=1)
    ground = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.7}
    text: dict[str, Any] = {"bbox": ground, "ha": "center", "fontsize": 9.5, "color": INK, "parse_math": False}
    for shape in scene.shapes:
        face, edge = KIND_COLOURS[shape.kind]
        axes.add_patch(shape_patch(shape.geometry, facecolor=face, edgecolor=edge, linewidth=1.0, zorder=2, alpha=0.9))
        left, bottom, right, top = (1e3 * value for value in shape.solid.bounds)
        x, y = (1e3 * value for value in shape.label_point)
        name = axes.text(x, y, shape.name, va="center", zorder=5, **text)
        room = axes.transData.inverted().transform_bbox(name.get_window_extent())
        if room.width > right - left or room.height > top - bottom:  # does not fit into the shape: above it
            name.set(position=(0.5 * (left + right), top + 5.0 * scene.dish.diameter), verticalalignment="bottom")
    draw_scale_bar(axes, 1e-3, 0.2)
    there = [kind for kind in KINDS if any(shape.kind == kind for shape in scene.shapes)]
    if there:
        faces = [Patch(facecolor=KIND_COLOURS[kind][0], edgecolor=KIND_COLOURS[kind][1], label=kind) for kind in there]
        axes.legend(handles=faces, loc="lower right", fontsize=9, frameon=False, labelcolor=INK)


def draw_empty_dish(axes: Axes, scene: Scene, border: float) -> None:
    """Draw an empty dish in millimetres, without axes, with a border around it as a share of its radius."""
    radius = 1e3 * scene.dish.radius
    axes.add_patch(Circle((0.0, 0.0), radius, facecolor="#f4f1ec", edgecolor="#8f877b", linewidth=2.0, zorder=0))
    reach = (1.0 + border) * radius
    axes.set(aspect="equal", xlim=(-reach, reach), ylim=(-reach, reach))
    axes.set_axis_off()


def shape_patch(geometry: Disc | Polygon, **style: Any) -> Circle | PathPatch:
    """Return a shape as a patch in millimetres, its holes left open."""
    if isinstance(geometry, Disc):
        return Circle((1e3 * geometry.centre[0], 1e3 * geometry.centre[1]), 1e3 * geometry.radius, **style)
    rings = [Outline(1e3 * np.vstack([ring, ring[:1]]), closed=True) for ring in geometry.rings]
    return PathPatch(Outline.make_compound_path(*rings), **style)
