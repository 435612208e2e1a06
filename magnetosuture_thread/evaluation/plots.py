"""Pictures, drawn without pyplot: of a run, and of scenes; colours, axes and scale of all pictures."""

from __future__ import annotations

import io
import itertools
import math
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, PathPatch, Rectangle
from matplotlib.path import Path as Outline
from matplotlib.transforms import Affine2D
from numpy.typing import NDArray

from magnetosuture_thread.evaluation.frames import MARGIN, Array, FrameResult, WorstFrame, with_gaps
from magnetosuture_thread.evaluation.metrics import RunMetrics, compare_errors, target_points
from magnetosuture_thread.evaluation.tables import error_text, micrometres
from magnetosuture_thread.geometry.barrier import BUILT_IN
from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.obstacles import Disc, Polygon
from magnetosuture_thread.geometry.scene import KINDS, Scene
from magnetosuture_thread.settings.errors import printable
from magnetosuture_thread.thread.margins import SOLID

# Told apart by red-green blind readers too; as on the operator's page.
SEEN, TRUTH, PREDICTED, ESTIMATED = "#2f7bff", "#1d2833", "#99107f", "#00a3a8"
INK, FAINT, GOOD, BAD = TRUTH, "#7b8794", "#1f9d55", "#c8102e"
AGAINST = {"truth": "ground truth", "seen": "the measured centreline"}
# Of a shape in a scene: face and edge.
KIND_COLOURS = dict(tissue=("#f0b9b4", "#b8665f"), instrument=("#b9c6d2", "#56697a"), wall=("#cbbfa9", "#6f624c"))
MARGIN_COLOURS = LinearSegmentedColormap.from_list("margin", [BAD, "#f28c28", GOOD])  # from 0 to 1 mm
THREADS: tuple[tuple[str, str, float, float, Any], ...] = (
    ("measured", SEEN, 5.0, 0.45, "solid"),
    ("predicted from the needle's poses", PREDICTED, 3.0, 1.0, "solid"),
    ("estimated with the camera", ESTIMATED, 1.7, 1.0, "solid"),
    ("ground truth", TRUTH, 0.9, 1.0, (0, (4, 4))),
)  # name, colour, width, opacity and dashes of each thread, the lowest first


class Photo(NamedTuple):
    """A camera frame and where the dish is in it.

    Attributes:
        image: BGR or grey.
        view: of the dish.
    """

    image: NDArray[np.uint8]
    view: DishView


def make_figure(width: float, height: float, dpi: float = 110.0) -> Figure:
    """Return an empty figure on a canvas of its own, whatever backend a notebook asks for [inch]."""
    figure = Figure(figsize=(width, height), dpi=dpi, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def draw_metrics(
    metrics: RunMetrics, title: str, dish_diameter: float, photo: Photo | None = None, simulated: str = ""
) -> bytes:
    """Return the picture of a run (PNG): its worst frame, its errors over time and along the thread, its margins.

    Args:
        metrics: of the run, with a prediction at least.
        title: of the picture.
        dish_diameter: [m]
        photo: camera image of the worst frame; without one a plan is drawn.
        simulated: what of the run is simulated.
    """
    worst, width, height = metrics.worst, 13.0, 13.9  # inch
    assert worst is not None
    figure = make_figure(width, height)

    def place(left: float, top: float, wide: float, tall: float) -> Axes:
        return figure.add_axes((left / width, 1.0 - (top + tall) / height, wide / width, tall / height))

    text: dict[str, Any] = {"color": INK, "parse_math": False, "va": "top"}  # with names from outside
    figure.text(0.25 / width, 1.0 - 0.12 / height, printable(title), fontsize=14, weight="bold", **text)
    lines = _facts(metrics) + (f"\nsimulated: {printable(simulated)}" if simulated else "")
    figure.text(0.25 / width, 1.0 - 0.42 / height, lines, fontsize=9.5, linespacing=1.45, **text)
    dish, close = place(0.25, 1.6, 6.2, 6.2), place(6.55, 1.6, 6.2, 6.2)
    _draw_frame(dish, close, worst, photo or draw_plan(dish_diameter), metrics, dish_diameter)
    _draw_key(figure, place(10.9, 7.97, 1.85, 0.12), height)
    panels = [place(0.75, 8.75 + 1.65 * row, 11.5, 1.2) for row in range(3)]
    _draw_errors(panels[0], metrics)
    _draw_along(panels[1], place(12.35, 10.4, 0.12, 1.2), metrics)
    _draw_margins(panels[2], metrics)
    times = np.concatenate([metrics.observed.times, metrics.series.times])
    for axes in panels:
        tidy(axes)
        axes.set_xlim(times.min(), max(times.max(), times.min() + 1e-3))
        axes.axvline(worst.time, color=INK, linewidth=0.9, linestyle=(0, (2, 2)))
    panels[2].set_xlabel("time since the start of the bag [s]; dashed: the frame above; grey: no needle", fontsize=9)
    return to_png(figure)


def to_png(figure: Figure) -> bytes:
    """Return a figure as PNG."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()


def _facts(metrics: RunMetrics) -> str:
    """Return frames, extremes and errors of a run, a line each."""
    facts = [f"thread predicted in {len(metrics.series)} frames"]
    if count := len(metrics.observed):
        facts.insert(0, f"needle found in {metrics.tracked} of {count} frames")
    facts.append(f"strain of a segment at most {100.0 * metrics.maximum('strain'):.2g} %")
    if math.isfinite(tension := metrics.maximum("tension")):
        facts.append(f"tension at most {1e6 * tension:.3g} µN")
    if metrics.minimum_margins:
        facts.append(f"an obstacle touched in {metrics.contact_frames} frames")
    lines = ["; ".join(facts)]
    for kind, errors in compare_errors(metrics.series).items():
        if text := error_text(errors, AGAINST["seen"]):
            lines.append(f"mean distance of the {kind}, in % of the length: {text}")
    return "\n".join(lines)


def _draw_frame(
    dish: Axes, close: Axes, worst: WorstFrame, photo: Photo, metrics: RunMetrics, dish_diameter: float
) -> None:
    """Draw the dish with the threads of a frame, and a close-up of the node that is farthest off."""
    frame, view = worst.frame, photo.view
    targets = target_points(frame.target_curve(metrics.target), metrics.length, len(frame.vertices) - 1)[0]
    errors = np.linalg.norm(frame.vertices[1:] - targets, axis=1)
    node = int(np.nanargmax(errors)) + 1 if np.isfinite(errors).any() else len(frame.vertices) - 1
    reach = 0.11 * metrics.length
    words = f"close-up of node {node}"
    ends = frame.vertices[node : node + 1]
    if metrics.target:
        words += f", {1e3 * errors[node - 1]:.3g} mm from {AGAINST[metrics.target]}"
        ends, reach = np.vstack([ends, targets[node - 1]]), max(reach, 0.75 * errors[node - 1])
    for axes, magnified in ((dish, 1.0), (close, 1.8)):
        draw_threads(axes, photo.image, view, frame, magnified)
    look_at(dish, view.to_pixels(np.zeros(2)), 0.52 * dish_diameter / view.metres_per_pixel)
    middle, half = view.to_pixels(ends.mean(axis=0)), reach / view.metres_per_pixel
    look_at(close, middle, half)
    close.plot(*view.to_pixels(ends).T, color=BAD, linewidth=1.8, zorder=4)
    frame_style: dict[str, Any] = {"fill": False, "color": INK, "linewidth": 1.0, "linestyle": (0, (3, 2))}
    dish.add_patch(Rectangle((middle[0] - half, middle[1] - half), 2.0 * half, 2.0 * half, **frame_style))
    whole = f"frame at {worst.time:.2f} s, with the greatest error of the prediction"
    for axes, share, title in ((dish, 0.25, whole), (close, 0.4, words)):
        draw_scale_bar(axes, view.metres_per_pixel, share)
        axes.set_title(title, fontsize=10, color=INK, loc="left", pad=4)


def _draw_key(figure: Figure, bar: Axes, height: float) -> None:
    """Draw what lines and colours of nodes mean, below the frame."""
    handles = [
        Line2D([], [], label=label, color=colour, linewidth=width, alpha=alpha, linestyle=dashes)
        for label, colour, width, alpha, dashes in THREADS
    ]
    place: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": (0.018, 1.0 - 7.85 / height), "ncols": 4}
    figure.legend(handles=handles, fontsize=9.5, frameon=False, labelcolor=INK, **place)
    colours = ScalarMappable(Normalize(0.0, 1.0), MARGIN_COLOURS)
    scale = figure.colorbar(colours, cax=bar, orientation="horizontal", ticks=(0.0, 0.5, 1.0))
    scale.set_label("nodes: to an obstacle [mm]", fontsize=8.5, color=INK, labelpad=1)
    scale.ax.tick_params(labelsize=8, colors=INK, length=2, pad=1)


def _title(axes: Axes, text: str) -> None:
    axes.set_title(printable(text), fontsize=9.5, color=INK, loc="left", parse_math=False)


def _draw_errors(axes: Axes, metrics: RunMetrics) -> None:
    """Draw the errors of prediction and estimate over time, in the colours of their threads."""
    for prefix, colour in (("recorded_error", FAINT), ("error", PREDICTED), ("estimate_error", ESTIMATED)):
        for target, dashes in (("truth", "solid"), ("seen", (0, (1, 1)))):
            times, errors = with_gaps(metrics.series.times, metrics.series.column(f"{prefix}_{target}"))
            axes.plot(times, errors, color=colour, linewidth=1.3, linestyle=dashes)
    observed, tracked = metrics.observed.times, metrics.observed.column("tracked")
    grey: dict[str, Any] = {"color": FAINT, "alpha": 0.25, "linewidth": 0.0, "step": "post"}
    axes.fill_between(observed, 0.0, 1.0, tracked == 0.0, transform=axes.get_xaxis_transform(), **grey)
    lines = f"solid: from {AGAINST['truth']}, dotted: from {AGAINST['seen']}"
    title = f"mean distance of the nodes [% of the length]; {lines}"
    if len(metrics.series.known("recorded_error_truth")) or len(metrics.series.known("recorded_error_seen")):
        title += "; grey lines: of the recorded prediction"
    _title(axes, title)
    axes.set_ylim(bottom=0.0)


def _draw_along(axes: Axes, bar: Axes, metrics: RunMetrics) -> None:
    """Draw the error of the prediction along the thread over time."""
    distance = f"distance of the prediction from {AGAINST.get(metrics.target, 'nothing that is known')}"
    _title(axes, f"{distance} [% of the length], by arc length from the needle's tail [mm]")
    grid = metrics.error_map.grid() if metrics.error_map is not None else None
    if grid is None or grid[2].shape[1] < 2:
        bar.set_axis_off()
        return
    times, lengths, values = grid
    colours = LinearSegmentedColormap.from_list("error", ["#f7f4f8", "#c994c7", PREDICTED, "#2b0726"])
    mesh = axes.pcolormesh(times, 1e3 * lengths, values, cmap=colours, vmin=0.0, shading="nearest")
    scale = axes.figure.colorbar(mesh, cax=bar)
    scale.ax.tick_params(labelsize=8, colors=INK, length=2, pad=1)


def _draw_margins(axes: Axes, metrics: RunMetrics) -> None:
    """Draw the least distance of obstacles and wall, and the margins of a user's barriers, over time."""
    minima = [
        f"{name.replace('_', ' ')} {micrometres(least.promised)}" for name, least in metrics.minimum_margins.items()
    ]
    _title(axes, "margins [mm], chords between nodes too; least of nodes: " + (", ".join(minima) or "not known"))
    added = [name for name in metrics.minimum_margins if name not in BUILT_IN]
    for name, colour in zip((*SOLID, *added), itertools.cycle((GOOD, "#56697a", "#f28c28", SEEN)), strict=False):
        times, margins = with_gaps(metrics.series.times, 1e3 * metrics.series.column(f"{MARGIN}{name}"))
        if np.isfinite(margins).any():
            axes.plot(times, margins, color=colour, linewidth=1.3, label=printable(name.replace("_", " ")))
    axes.axhline(0.0, color=BAD, linewidth=0.8)
    axes.margins(y=0.12)
    axes.set_yscale("symlog", linthresh=0.01)  # mm, so that a margin of a micrometre shows beside the dish's width
    axes.yaxis.set_major_formatter("{x:g}")
    if len(axes.lines) > 1:
        axes.legend(loc="lower right", ncols=4, fontsize=8.5, frameon=False, labelcolor=INK)


def draw_plan(dish_diameter: float) -> Photo:
    """Return a drawn dish, where no camera saw the real one."""
    side, share = 620, 0.94  # px; of it that the dish takes
    middle = 0.5 * (side - 1.0)
    from_middle = np.arange(side) - middle
    inside = np.hypot(from_middle, from_middle[:, None]) < 0.5 * share * side
    view = DishView((middle, middle), dish_diameter / (share * side))
    return Photo(np.where(inside, 244, 200).astype(np.uint8), view)


def draw_threads(
    axes: Axes, image: NDArray[np.uint8], view: DishView, frame: FrameResult, magnified: float = 1.0
) -> None:
    """Draw a camera frame, obstacles, and the threads that there are, without axes.

    The measured thread is wide, the predicted one a line below the estimated one, the ground truth dashed. The nodes
    of the estimated thread, else of the predicted one, have the colours of their margins.
    """
    axes.imshow(image[:, :, ::-1] if image.ndim == 3 else image, cmap="gray", vmin=0, vmax=255, aspect="equal")
    axes.set_axis_off()
    to_image = Affine2D().scale(1e-3 / view.metres_per_pixel).rotate(view.rotation).scale(1.0, -1.0)
    to_pixels = to_image.translate(*view.centre_px) + axes.transData
    for obstacle in frame.obstacles:
        if isinstance(obstacle, (Disc, Polygon)):
            axes.add_patch(shape_patch(obstacle, fill=False, edgecolor=INK, linewidth=0.9, transform=to_pixels))
    nodes = frame.vertices if frame.estimate is None else frame.estimate.vertices
    threads = (frame.measured, frame.vertices, nodes if frame.estimate is not None else nodes[:0], frame.ground_truth)
    for points, (_, colour, width, alpha, dashes) in zip(threads, THREADS, strict=True):
        style: dict[str, Any] = {"color": colour, "linewidth": width * magnified, "alpha": alpha, "linestyle": dashes}
        axes.plot(*view.to_pixels(points).T, solid_capstyle="round", **style)
    near = np.clip(1e3 * frame.clearance[: len(nodes)], 0.0, 1.0)
    u, v = view.to_pixels(nodes).T
    axes.scatter(u, v, s=9.0 * magnified**2, color=MARGIN_COLOURS(near), linewidths=0.0, zorder=2.5)


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


def tidy(axes: Axes) -> None:
    """Draw grid, ticks and frame of a plot as in all of ours."""
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
        figure = make_figure(7.0, 7.45, 150.0)
        _draw_scene(figure.add_axes((0.0, 0.0, 1.0, 7.0 / 7.45)), scene)
        dish = f"dish of {1e3 * scene.dish.diameter:g} mm, {1e3 * scene.dish.depth:g} mm deep"
        style: dict[str, Any] = {"color": INK, "parse_math": False, "va": "top"}
        figure.text(0.03, 0.972, name, fontsize=14, weight="bold", **style)
        figure.text(0.97, 0.968, f"{dish}, version {scene.version}", fontsize=9, ha="right", **style)
        figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)


def _draw_scene(axes: Axes, scene: Scene) -> None:
    draw_shapes(axes, scene, 0.12)
    axes.plot([0.0], [0.0], "+", color=FAINT, markersize=9.0, markeredgewidth=0.8, zorder=1)
    ground = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.7}
    text: dict[str, Any] = {"bbox": ground, "ha": "center", "fontsize": 9.5, "color": INK, "parse_math": False}
    for shape in scene.shapes:
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


def draw_shapes(axes: Axes, scene: Scene, border: float = 0.08) -> None:
    """Draw dish and shapes in millimetres, without axes, with a border around the dish as a share of its radius."""
    radius = 1e3 * scene.dish.radius
    axes.add_patch(Circle((0.0, 0.0), radius, facecolor="#f4f1ec", edgecolor="#8f877b", linewidth=2.0, zorder=0))
    for shape in scene.shapes:
        face, edge = KIND_COLOURS[shape.kind]
        axes.add_patch(shape_patch(shape.geometry, facecolor=face, edgecolor=edge, linewidth=1.0, alpha=0.9))
    reach = (1.0 + border) * radius
    axes.set(aspect="equal", xlim=(-reach, reach), ylim=(-reach, reach))
    axes.set_axis_off()


def draw_arrow(axes: Axes, at: Array, along: Array, style: Any = "solid") -> None:
    """Draw an arrow from a point along a vector, in the units of the axes; none where that is zero."""
    if along.any():
        arrow = {"arrowstyle": "-|>", "color": INK, "linewidth": 1.1, "linestyle": style}
        axes.annotate("", xy=tuple(at + along), xytext=tuple(at), arrowprops=arrow)


def shape_patch(geometry: Disc | Polygon, **style: Any) -> Circle | PathPatch:
    """Return a shape as a patch in millimetres, its holes left open."""
    if isinstance(geometry, Disc):
        return Circle((1e3 * geometry.centre[0], 1e3 * geometry.centre[1]), 1e3 * geometry.radius, **style)
    rings = [Outline(1e3 * np.vstack([ring, ring[:1]]), closed=True) for ring in geometry.rings]
    return PathPatch(Outline.make_compound_path(*rings), **style)
