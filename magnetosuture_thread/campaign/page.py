"""The report of a campaign: a page of HTML with pictures of failed runs, which loads nothing and runs no script."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np

from magnetosuture_thread.campaign.run import (
    KEEP_OUT_TOLERANCE,
    MAX_REST,
    MAX_TIME_RATIO,
    PENETRATION_TOLERANCE,
    RunInstant,
    RunResult,
)
from magnetosuture_thread.evaluation.page import page_style, read_source, read_template
from magnetosuture_thread.geometry.obstacles import Disc, Polygon
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.planning.procedure import Procedure
from magnetosuture_thread.scene import Scene
from magnetosuture_thread.setups import Setup

MAX_STRIPS = 200  # failed runs with pictures
GOOD, BAD = "good", "bad"
NOT_REACHED = "not all goals reached"
NAMES = {
    "min_needle_clearance_m": "the needle came too close to wall or shape",
    "max_thread_penetration_m": "a node of the thread was in wall or shape",
    "longest_rest_s": "the needle rested too long",
    "max_tension_n": "the thread's tension was too high",
    "max_friction_nodes": "too many nodes were under friction",
    "time_s": "it took too long",
}
CLOSE_UP = 4.0  # lengths of the needle: side of a close-up
MIN_CLOSE_UP = 8e-3  # m
BORDER = 0.02  # of the dish's radius, around it
MIN_COMMAND = 1e-6  # m/s; a smaller command has no arrow


@dataclass(frozen=True)
class CampaignDetails:
    """What was run.

    Attributes:
        procedure: that was run.
        setup: what the nodes believe.
        camera: whether frames were rendered and tracked.
        died: seeds whose process ended early, and why.
        bags: seeds of which there is a bag, with its folder beside the page.
    """

    procedure: Procedure
    setup: Setup
    camera: bool
    died: dict[int, str]
    bags: dict[int, str]

    @property
    def min_clearance(self) -> float:
        """Clearance of the needle's axis that a run has to keep [m]."""
        return self.setup.coils.keep_out - KEEP_OUT_TOLERANCE


@dataclass(frozen=True)
class Tile:
    """A headline figure."""

    name: str
    value: str
    grade: str
    detail: str


@dataclass(frozen=True)
class RunRow:
    """A run as the table shows it.

    Attributes:
        result: of the run.
        broken: names of the figures beyond their limits.
        pictures: of its last seconds, if it failed; the first shows the whole dish.
        closest: when the needle was closest to wall or shape, if it came too close before the last seconds.
    """

    result: RunResult
    broken: frozenset[str]
    pictures: tuple[InstantPicture, ...]
    closest: InstantPicture | None


def write_campaign_page(details: CampaignDetails, runs: Sequence[RunResult]) -> str:
    """Return the page.

    Args:
        details: what was run.
        runs: what came of each seed, in order.
    """
    rows, shown = [], 0
    for run in runs:
        drawn = not run.success and shown < MAX_STRIPS
        shown += drawn
        rows.append(_row(details, run, drawn=drawn))
    scene = details.setup.scene
    spaced = {"spaced": lambda text: text.replace("_", " ")}
    return read_template(__package__, "page.html", spaced).render(
        details=details,
        runs=rows,
        failed=[row for row in rows if row.pictures],
        left_out=sum(not run.success for run in runs) - shown,
        tiles=_tiles(details, rows),
        reasons=_reasons(rows),
        shapes=outline_shapes(scene),
        dish_radius=1e3 * scene.dish.radius,
        needle_width=1e3 * details.setup.rig.needle_width,
        halo_width=2e3 * details.min_clearance,
        max_rest=MAX_REST,
        max_time_ratio=MAX_TIME_RATIO,
        max_penetration=PENETRATION_TOLERANCE,
        style=page_style() + read_source(__package__, "page.css"),
    )


def _row(details: CampaignDetails, run: RunResult, *, drawn: bool) -> RunRow:
    broken = frozenset(run.figures.beyond_limits(details.setup.coils.keep_out))
    if not drawn or not run.last_instants:
        return RunRow(run, broken, (), None)
    scene, speed = details.setup.scene, details.procedure.limits[0].speed
    pictures = [picture_instant(run.last_instants[-1], scene, speed, overview=True)]
    pictures += [picture_instant(instant, scene, speed) for instant in run.last_instants]
    closest = run.closest_instant
    begin = run.last_instants[0].frame.time
    if closest is None or closest.frame.time >= begin or "min_needle_clearance_m" not in broken:
        return RunRow(run, broken, tuple(pictures), None)
    return RunRow(run, broken, tuple(pictures), picture_instant(closest, scene, speed))


def _reasons(rows: Sequence[RunRow]) -> list[tuple[str, list[int]]]:
    """Return why runs failed, and the seeds of each reason, the most frequent first; a run may have several."""
    found: dict[str, list[int]] = {}
    for row in rows:
        names = [NAMES[name] for name in sorted(row.broken)]
        if not row.result.success and not row.result.reached:
            names.insert(0, NOT_REACHED)
        for name in names:
            found.setdefault(name, []).append(row.result.seed)
    return sorted(found.items(), key=lambda each: -len(each[1]))


def _tiles(details: CampaignDetails, rows: Sequence[RunRow]) -> list[Tile]:
    if not rows:
        return []
    count, required = len(rows) + len(details.died), details.min_clearance
    successes, reached = sum(row.result.success for row in rows), sum(row.result.reached for row in rows)
    figures = [row.result.figures for row in rows]
    clearance = min(found.min_needle_clearance_m for found in figures)
    penetration = max(found.max_thread_penetration_m for found in figures)
    rest = max(found.longest_rest_s for found in figures)
    ratios = [ratio for row in rows if row.result.reached and math.isfinite(ratio := _time_ratio(row.result))]
    tiles = [
        Tile("runs that succeeded", f"{successes} of {count}", _grade(successes == count), "all goals, all limits"),
        Tile("runs that reached all goals", f"{reached} of {count}", _grade(reached == count), "limits apart"),
        Tile(
            "closest needle",
            f"{1e3 * clearance:.3f} mm",
            _grade(clearance >= required),
            f"of all runs; at least {1e3 * required:.3f} mm",
        ),
        Tile(
            "deepest node of the thread",
            f"{1e6 * penetration:.1f} µm",
            _grade(penetration <= PENETRATION_TOLERANCE),
            f"of all runs; at most {1e6 * PENETRATION_TOLERANCE:g} µm",
        ),
        Tile("longest rest", f"{rest:.1f} s", _grade(rest <= MAX_REST), f"of all runs; at most {MAX_REST:g} s"),
    ]
    if ratios:
        middle, most = median(ratios), max(ratios)
        detail = f"median of runs that reached all goals; maximum {most:.2f}, at most {MAX_TIME_RATIO:g}"
        tiles.append(Tile("time over ideal time", f"{middle:.2f}", _grade(most <= MAX_TIME_RATIO), detail))
    return tiles


def _time_ratio(run: RunResult) -> float:
    """Return time over ideal time; NaN without an ideal time."""
    figures = run.figures
    return figures.time_s / figures.ideal_time_s if figures.ideal_time_s > 0.0 else math.nan


def _grade(is_good: bool) -> str:
    return GOOD if is_good else BAD


@dataclass(frozen=True)
class ShapeOutline:
    """A shape as the path of an SVG.

    Attributes:
        kind: of the shape.
        path: of its outline and holes [mm].
    """

    kind: str
    path: str


@dataclass(frozen=True)
class InstantPicture:
    """An instant as an SVG shows it: lengths in mm, y upwards.

    Attributes:
        instant: what is shown.
        box: left, lower end, width and height of what is shown.
        thread: vertices, as an SVG's list of points.
        needle: its axis, likewise.
        path: planned way of its middle, likewise; empty without one.
        command: ends of an arrow from the tip, x1, y1, x2, y2; empty where nothing is commanded.
        is_overview: whether the whole dish is shown.
    """

    instant: RunInstant
    box: tuple[float, float, float, float]
    thread: str
    needle: str
    path: str
    command: tuple[float, ...]
    is_overview: bool


def outline_shapes(scene: Scene) -> list[ShapeOutline]:
    """Return the shapes of a scene."""
    return [ShapeOutline(shape.kind, _outline(shape.geometry)) for shape in scene.shapes]


def picture_instant(instant: RunInstant, scene: Scene, speed: float, *, overview: bool = False) -> InstantPicture:
    """Return the picture of an instant, the whole dish or the surroundings of the needle.

    Args:
        instant: to show.
        scene: around it.
        speed: at which the arrow of the command has the needle's length [m/s].
        overview: whether the whole dish is shown.
    """
    axis, frame = instant.axis, instant.frame
    length = float(np.linalg.norm(axis[-1] - axis[0]))
    if overview:
        half = (1.0 + BORDER) * scene.dish.radius
        centre = np.zeros(2)
    else:
        half = 0.5 * max(CLOSE_UP * length, MIN_CLOSE_UP)
        centre = 0.5 * (axis[0] + axis[-1])
    low = 1e3 * (centre - half)
    command: tuple[float, ...] = ()
    if math.hypot(*frame.commanded) > MIN_COMMAND:
        ends = np.concatenate([axis[-1], axis[-1] + length / speed * frame.commanded])
        command = tuple(round(1e3 * value, 3) for value in ends.tolist())
    return InstantPicture(
        instant,
        (round(float(low[0]), 3), round(float(low[1]), 3), round(2e3 * half, 3), round(2e3 * half, 3)),
        _points(frame.thread),
        _points(axis),
        "" if instant.path is None else _points(instant.path),
        command,
        overview,
    )


def _points(vertices: Points) -> str:
    return " ".join(f"{1e3 * x:.3f},{1e3 * y:.3f}" for x, y in vertices.tolist())


def _outline(geometry: Disc | Polygon) -> str:
    if isinstance(geometry, Disc):
        x, y, r = (1e3 * value for value in (*geometry.centre, geometry.radius))
        return f"M{x - r:.3f},{y:.3f}a{r:.3f},{r:.3f} 0 1 0 {2 * r:.3f},0a{r:.3f},{r:.3f} 0 1 0 {-2 * r:.3f},0z"
    return "".join(f"M{_points(ring).replace(' ', 'L')}z" for ring in geometry.rings)
