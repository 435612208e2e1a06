"""Pictures of the worst frames: the camera's frame, or a plan of the dish, with the threads in it."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from numpy.typing import NDArray

from magnetosuture_thread.evaluation.frames import FrameResult, WorstFrame
from magnetosuture_thread.evaluation.metrics import node_errors, target_points
from magnetosuture_thread.evaluation.plots import INK, draw_scale_bar, draw_threads, look_at
from magnetosuture_thread.evaluation.report.figures import AGAINST, format_number
from magnetosuture_thread.geometry.camera import DishView

PLAN = 620  # px; side of a plan
DISH_SHARE = 0.94  # of a plan's side
CLOSE_UP = 0.08  # of the thread's length: half of the side of what is magnified
OUTSIDE = "#d5d9dd"  # of what the picture is cut from
QUALITY = 84  # of the JPEG


@dataclass(frozen=True)
class Photo:
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
    shown = photo or _plan(dish_diameter)
    frame = worst.frame
    targets = target_points([frame.target_curve(target)], length, len(frame.vertices) - 1)[0][0]
    vertices = frame.vertices if worst.of == "prediction" or frame.estimate is None else frame.estimate.vertices
    errors = node_errors(vertices, targets, length)
    node = int(np.nanargmax(errors)) + 1
    figure = Figure(figsize=(12.0, 5.95), dpi=100, facecolor="#888e94")
    scene, close = (figure.add_axes((left, 0.0, 0.4985, 1.0)) for left in (0.0, 0.5015))
    ends = np.vstack([vertices[node], targets[node - 1]])
    half = max(CLOSE_UP * length, 0.0075 * length * float(np.nanmax(errors)))
    middle = shown.view.to_pixels(np.zeros(2))
    for axes, magnified in ((scene, 1.0), (close, 1.8)):
        axes.set_facecolor(OUTSIDE)
        draw_threads(axes, shown.image, shown.view, frame, frame.obstacles, magnified)
        if photo is None:
            radius = 0.5 * dish_diameter / shown.view.metres_per_pixel
            axes.add_patch(Circle(tuple(middle), radius, fill=False, color=INK, linewidth=1.6))
    height, width = shown.image.shape[:2]
    half_side = 0.5 * min(height, width)
    look_at(scene, np.clip(middle, half_side - 0.5, [width - half_side - 0.5, height - half_side - 0.5]), half_side)
    at = shown.view.to_pixels(ends.mean(axis=0))
    look_at(close, at, half / shown.view.metres_per_pixel)
    side = 2.0 * half / shown.view.metres_per_pixel
    corner = (at[0] - 0.5 * side, at[1] - 0.5 * side)
    scene.add_patch(Rectangle(corner, side, side, fill=False, color=INK, linewidth=1.0, linestyle=(0, (3, 2))))
    for axes, share in ((scene, 0.25), (close, 0.4)):
        draw_scale_bar(axes, shown.view, share)
    marked = shown.view.to_pixels(ends)
    close.plot(marked[:, 0], marked[:, 1], color="#c8102e", linewidth=1.6)
    kind = "Plan of the dish" if photo is None else "Simulated camera frame" if simulated else "Camera frame"
    if simulated:
        box = {"facecolor": "#fff3d6", "alpha": 0.85, "edgecolor": "none", "pad": 2.5}
        scene.text(0.02, 0.98, "simulated", transform=scene.transAxes, color="#5c4300", fontsize=11, va="top", bbox=box)
    words = (
        f"{kind} at {worst.time:.2f} s with {_threads_of(frame)}, and a close-up of node {node} of the {worst.of}, "
        f"which is {format_number(0.01 * float(np.nanmax(errors)) * length * 1e3)} mm from {AGAINST[target]}; "
        f"error of the {worst.of} {format_number(worst.error)} % of the length."
    )
    return ReportPicture(worst, _as_uri(figure), words, photo is None)


def _threads_of(frame: FrameResult) -> str:
    names = ["predicted"]
    names += ["estimated"] if frame.estimate is not None else []
    names += ["measured"] if len(frame.measured) > 1 else []
    names += ["true"] if len(frame.ground_truth) > 1 else []
    return f"{', '.join(names[:-1])} and {names[-1]} thread" if len(names) > 1 else "predicted thread"


def _plan(dish_diameter: float) -> Photo:
    middle = 0.5 * (PLAN - 1.0)
    view = DishView((middle, middle), dish_diameter / (DISH_SHARE * PLAN))
    return Photo(np.full((PLAN, PLAN), 244, np.uint8), view)


def _as_uri(figure: Figure) -> str:
    stream = io.BytesIO()
    figure.savefig(stream, format="jpeg", pil_kwargs={"quality": QUALITY, "optimize": True})
    return "data:image/jpeg;base64," + base64.b64encode(stream.getvalue()).decode()
