"""The dish, its tissue and the steered thread in a plot."""

from __future__ import annotations

import matplotlib

matplotlib.use("Agg")

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, PathPatch
from matplotlib.path import Path as Outline

from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.model.friction import FrictionState, friction_colour
from magnetosuture_thread.scene import Scene
from magnetosuture_thread.study.hernia.steered import SteeredInstant

FLOOR, RIM = "#f4f1ec", "#c9c3ba"
TISSUE, EDGE = "#f0b9b4", "#c98680"
RING, RING_EDGE = "#d9827f", "#a8504f"
INK = "#22303c"
ROOM = 0.04  # of the dish's diameter, around it
REACH = 1.2  # s of its way, by which an arrow shows a velocity


def draw_dish(axes: Axes, scene: Scene) -> None:
    """Draw the dish and its shapes, in millimetres; a shape with a hole is a ring, and darker."""
    radius = 1e3 * scene.dish.radius
    axes.add_patch(Circle((0.0, 0.0), radius, facecolor=FLOOR, edgecolor=RIM, linewidth=1.4))
    for obstacle in scene.obstacles:
        if isinstance(obstacle, Disc):
            centre = (1e3 * obstacle.centre[0], 1e3 * obstacle.centre[1])
            axes.add_patch(Circle(centre, 1e3 * obstacle.radius, facecolor=TISSUE, edgecolor=EDGE))
            continue
        outlines = [Outline(1e3 * np.vstack([ring, ring[:1]]), closed=True) for ring in obstacle.rings]
        fill, edge = (RING, RING_EDGE) if obstacle.holes else (TISSUE, EDGE)
        shape = Outline.make_compound_path(*outlines)
        axes.add_patch(PathPatch(shape, facecolor=fill, edgecolor=edge, linewidth=0.8))
    axes.set_aspect("equal")
    reach = radius * (1.0 + 2.0 * ROOM)
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-reach, reach)
    axes.set_axis_off()


def draw_thread(axes: Axes, instant: SteeredInstant, scale: float = 1.0) -> None:
    """Draw the thread in the colour of its friction, and the needle as a point with what is asked of it."""
    points, friction = 1e3 * instant.prediction.vertices, instant.margins.friction
    colour = friction_colour(friction)
    axes.plot(points[:, 0], points[:, 1], color="white", linewidth=4.0 * scale, solid_capstyle="round", alpha=0.8)
    axes.plot(points[:, 0], points[:, 1], color=colour, linewidth=2.0 * scale, solid_capstyle="round")
    axes.plot(points[1:, 0], points[1:, 1], "o", color=colour, markersize=2.4 * scale, markeredgewidth=0.0)
    if friction.nodes:
        under = points[list(friction.nodes)]
        axes.plot(
            *under.T, "o", color=colour, markersize=4.6 * scale, markeredgecolor="white", markeredgewidth=0.7 * scale
        )
    x, y = points[0]
    if instant.command is not None:
        for velocity, style in ((instant.command.commanded, (0, (1.5, 1.2))), (instant.command.filtered, "solid")):
            if velocity.any():
                dx, dy = REACH * 1e3 * velocity
                arrow = {"arrowstyle": "-|>", "color": INK, "linewidth": 1.1 * scale, "linestyle": style}
                axes.annotate("", xy=(x + dx, y + dy), xytext=(x, y), arrowprops=arrow)
    axes.plot([x], [y], "o", color=INK, markersize=5.0 * scale, markeredgecolor="white", markeredgewidth=0.8 * scale)


def caption(instant: SteeredInstant) -> str:
    """Say an instant for a person."""
    friction = instant.margins.friction
    count = f"{len(friction.nodes)} node{'s' if len(friction.nodes) != 1 else ''}"
    return {
        FrictionState.UNKNOWN: "unknown",
        FrictionState.FREE: "free",
        FrictionState.PULLED: f"friction at {count}, needle slowed to {100.0 * friction.slowdown:.0f} %",
        FrictionState.RESTING: f"{count} between obstacles, not pulled",
    }[friction.state]
