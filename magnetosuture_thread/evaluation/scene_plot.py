"""A picture of a scene: dish, shapes in the colours of their kinds, names and scale."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch, PathPatch
from matplotlib.path import Path as Outline

from magnetosuture_thread.geometry.obstacles import Disc, Polygon
from magnetosuture_thread.scene import KINDS, Scene
from magnetosuture_thread.scene.labels import label_positions

INK, FAINT = "#22303c", "#7d8790"
LIQUID, WALL = "#f4f1ec", "#8f877b"
COLOURS = {"tissue": ("#f0b9b4", "#b8665f"), "instrument": ("#b9c6d2", "#56697a"), "wall": ("#cbbfa9", "#6f624c")}
SIDE = 7.0  # in
TITLE = 0.45  # in, above
BORDER = 0.06  # of the dish's diameter, around it
RESOLUTION = 150  # dots per inch
STEPS = (0.0001, 0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1)  # m; of the scale bar


def plot_scene(path: Path, scene: Scene, name: str) -> None:
    """Draw a scene into a file, PNG or SVG by its ending.

    Args:
        path: to write.
        scene: to draw.
        name: of the scene, for the title.
    """
    # The same scene gives the same bytes; in SVG, text stays text.
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": scene.version}), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph")  # of a name in a script that the font does not have
        figure = Figure(figsize=(SIDE, SIDE + TITLE), dpi=RESOLUTION)
        FigureCanvasAgg(figure)
        height = SIDE / (SIDE + TITLE)
        axes = figure.add_axes((0.0, 0.0, 1.0, height))
        _draw(axes, scene)
        dish = f"dish of {1e3 * scene.dish.diameter:g} mm, {1e3 * scene.dish.depth:g} mm deep"
        style: dict[str, Any] = {"color": INK, "parse_math": False}
        figure.text(0.03, 0.972, name, fontsize=14, va="top", weight="bold", **style)
        figure.text(0.97, 0.968, f"{dish}, version {scene.version}", fontsize=9, va="top", ha="right", **style)
        metadata = {"Date": None} if path.suffix == ".svg" else None
        figure.savefig(path, metadata=metadata)


def _draw(axes: Axes, scene: Scene) -> None:
    radius, reach = 1e3 * scene.dish.radius, 1e3 * (0.5 + BORDER) * scene.dish.diameter
    axes.add_patch(Circle((0.0, 0.0), radius, facecolor=LIQUID, edgecolor=WALL, linewidth=2.5, zorder=0))
    axes.plot([0.0], [0.0], "+", color=FAINT, markersize=9.0, markeredgewidth=0.8, zorder=1)
    for shape in scene.shapes:
        fill, edge = COLOURS[shape.kind]
        style: dict[str, Any] = {"facecolor": fill, "edgecolor": edge, "linewidth": 1.0, "zorder": 2, "alpha": 0.9}
        axes.add_patch(shape_patch(shape.geometry, **style))
    axes.set_aspect("equal")
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-reach, reach)
    axes.set_axis_off()
    _draw_names(axes, scene)
    _draw_scale(axes, scene.dish.diameter, reach)
    there = [kind for kind in KINDS if any(shape.kind == kind for shape in scene.shapes)]
    if there:
        patches = [Patch(facecolor=COLOURS[kind][0], edgecolor=COLOURS[kind][1], label=kind) for kind in there]
        axes.legend(handles=patches, loc="lower left", fontsize=9, frameon=False, labelcolor=INK)


def shape_patch(geometry: Disc | Polygon, **style: Any) -> Circle | PathPatch:
    """Return a shape as a patch in millimetres, its holes left open."""
    if isinstance(geometry, Disc):
        return Circle((1e3 * geometry.centre[0], 1e3 * geometry.centre[1]), 1e3 * geometry.radius, **style)
    rings = [Outline(1e3 * np.vstack([ring, ring[:1]]), closed=True) for ring in geometry.rings]
    return PathPatch(Outline.make_compound_path(*rings), **style)


def _draw_names(axes: Axes, scene: Scene) -> None:
    """Draw the names; one that stands beside its shape with a line to it."""
    ground = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.7}
    style: dict[str, Any] = {"bbox": ground, "ha": "center", "va": "center", "fontsize": 9.5, "parse_math": False}
    texts = [axes.text(0.0, 0.0, shape.name, zorder=5, color=INK, **style) for shape in scene.shapes]
    to_metres = axes.transData.inverted()
    boxes = [to_metres.transform_bbox(text.get_window_extent()) for text in texts]
    places = label_positions(scene, [(1e-3 * float(box.width), 1e-3 * float(box.height)) for box in boxes])
    for text, place in zip(texts, places, strict=True):
        text.set_position((1e3 * place.middle[0], 1e3 * place.middle[1]))
        if place.line:
            ends = 1e3 * np.array(place.line)
            axes.plot(*ends.T, color=INK, linewidth=0.8, zorder=4)


def _draw_scale(axes: Axes, diameter: float, reach: float) -> None:
    """Draw a bar of a round length in the lower right corner."""
    length = 1e3 * max(step for step in STEPS if step <= 0.2 * diameter)
    right, low = 0.96 * reach, -0.95 * reach
    axes.plot([right - length, right], [low, low], color=INK, linewidth=3.0, solid_capstyle="butt", zorder=5)
    label = f"{length:g} mm"
    axes.text(right - 0.5 * length, low + 0.015 * reach, label, ha="center", va="bottom", fontsize=9.5, color=INK)
