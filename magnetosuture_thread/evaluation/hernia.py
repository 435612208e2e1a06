"""The simulated hernia repair: a thread steered by hand around a ring, in the thread model alone.

The needle is a point, and goes as fast as the filter lets it. Here are the loop itself, recorded commands replayed in
it, the figures of such a run, and its pictures: six instants, the barriers over time, and an animation.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray
from PIL import Image

from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.reading import plane_points, seconds
from magnetosuture_thread.bags.recording import Recording
from magnetosuture_thread.coils.filter import FilteredCommand, NeedleSafetyFilter
from magnetosuture_thread.estimator.settings import ThreadModelSettings
from magnetosuture_thread.estimator.thread_session import ThreadSession
from magnetosuture_thread.evaluation.plots import FAINT, INK, draw_arrow, draw_shapes, make_figure, tidy, to_png
from magnetosuture_thread.evaluation.replay import picture_or_log
from magnetosuture_thread.evaluation.workers import Log, Progress
from magnetosuture_thread.geometry.obstacles import Workspace
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.rig.setups import Setup, read_setup
from magnetosuture_thread.settings.errors import BagError, InvalidInputError, SolverError
from magnetosuture_thread.settings.files import whole_folder
from magnetosuture_thread.settings.interface import OPERATOR_COMMAND
from magnetosuture_thread.thread.margins import FrictionState, Margins, friction_colour
from magnetosuture_thread.thread.prediction import NeedlePose, Prediction

RATE = 33.0  # Hz, of the paper's simulation
COMMAND_TIMEOUT = 0.1  # s; a command that no other follows ends, as at the coil bridge
PAPER_SEGMENTS = 40  # of the thread in the paper's figure
NODE_COLOURS = ("#0b3c5d", "#1f77b4", "#2a9d8f", "#8ab17d", "#e9a03b")  # of the first nodes, whose barriers are drawn
_AHEAD = np.array([1.0, 0.0])  # a point has no heading, and a thread that turns freely asks for none


@dataclass(frozen=True)
class SteeredInstant:
    """A steered thread at one instant.

    Attributes:
        time: since the start [s].
        prediction: of the thread.
        margins: of the prediction.
        command: that led here, filtered; None at the start.
        took: wall-clock time of the whole step, filter, prediction and margins [s].
    """

    time: float
    prediction: Prediction
    margins: Margins
    command: FilteredCommand | None
    took: float

    def figures(self) -> dict[str, Any]:
        """Return the figures, as JSON has them."""
        friction, command = self.margins.friction, self.command
        return {
            "time": self.time,
            "state": friction.state.name.lower(),
            "friction_nodes": list(friction.nodes),
            "slowdown": friction.slowdown,
            "asked": command.commanded.tolist() if command else [0.0, 0.0],
            "passed": command.filtered.tolist() if command else [0.0, 0.0],
            "needle": self.prediction.positions[0].tolist(),
        }


class SteeredThread:
    """The loop of an operator, the needle's filter and the thread, without a rig.

        u_0 = filter(beta^count v_0),    x_0 <- x_0 + dt u_0,    then the thread's step

    Source: [Forghani2025], algorithm "Real-Time Thread Sim with Visual Feedback". Deviation: the friction by which
    v_0 is slowed is that of the thread where it is now, as in the source; the thread's step sees the needle where it
    has moved to.

    Args:
        settings: of the thread among its obstacles.
        centreline: where the thread lies at the start, from the needle on, shape (m, 2) [m].
        needle: the filter of a needle that is a point.

    Raises:
        ConfigurationError: an obstacle cannot be used.
        InvalidInputError: the thread cannot begin there.
    """

    def __init__(self, settings: ThreadModelSettings, centreline: Points, needle: NeedleSafetyFilter) -> None:
        self._session = ThreadSession(replace(settings, initial_shape="measured", estimator=False), needle.scene)
        self._needle = needle
        self._stamp = 0
        self._tail = np.asarray(centreline[0], dtype=np.float64)
        for _ in self._session.on_measured_thread(0, centreline):
            pass
        self.now = self._advance(None, 0.0)

    def step(self, interval: float, commanded: NDArray[np.float64]) -> SteeredInstant:
        """Move the needle as it is commanded, as far as it may, and let the thread follow.

        Args:
            interval: dt [s].
            commanded: v_0, shape (2,) [m/s].

        Raises:
            InvalidInputError: the velocity is not finite, or beyond 1 m/s.
            SolverError: a program had no solution, or its linearisation did not converge.
        """
        began, slowdown = perf_counter(), self.now.margins.friction.slowdown
        if not math.hypot(*commanded.tolist()) <= 1.0:  # what commands more was meant in another unit
            raise InvalidInputError("needle velocity", commanded.tolist(), "finite numbers, at most 1 m/s")
        command = self._needle.filter(commanded, self._tail, _AHEAD, slowdown=slowdown)
        self._tail = self._tail + interval * command.filtered
        self._stamp += round(interval * 1e9)
        self.now = self._advance(command, began)
        return self.now

    def _advance(self, command: FilteredCommand | None, began: float) -> SteeredInstant:
        outcome = self._session.on_pose(self._stamp, NeedlePose(self._stamp * 1e-9, self._tail, _AHEAD))
        if outcome.problem is not None:
            raise outcome.problem
        prediction = outcome.prediction
        assert prediction is not None
        if outcome.margins is None:
            raise SolverError(prediction.solver, prediction.status, prediction.residual, 0.0)
        took = perf_counter() - began if command is not None else 0.0
        return SteeredInstant(self._stamp * 1e-9, prediction, outcome.margins, command, took)


class RecordedCommands(NamedTuple):
    """Velocity commands that an operator gave.

    Attributes:
        times: of each command, rising, shape (m,) [s].
        velocities: shape (m, 2) [m/s].
    """

    times: NDArray[np.float64]
    velocities: NDArray[np.float64]

    def at(self, time: float) -> NDArray[np.float64]:
        """Return the velocity commanded at a time [s], shape (2,) [m/s]; zero where no command is valid."""
        index = int(np.searchsorted(self.times, time + 1e-9, side="right")) - 1
        is_valid = index >= 0 and time - self.times[index] <= COMMAND_TIMEOUT + 1e-9
        return np.asarray(self.velocities[index]) if is_valid else np.zeros(2)


@dataclass(frozen=True)
class HerniaRun:
    """A whole run.

    Attributes:
        settings: of the thread.
        scene: dish and shapes.
        instants: one a step, by time; the first is the start.
        barriers: h_obs of the first nodes, shape (steps + 1, nodes, obstacles) [m].
        chord_depth: how deep the middle of a chord between two nodes ever is in an obstacle, 0 if never [m].
    """

    settings: ThreadModelSettings
    scene: Scene
    instants: Sequence[SteeredInstant]
    barriers: NDArray[np.float64]
    chord_depth: float

    def nearest(self, time: float) -> SteeredInstant:
        """Return the instant nearest to a time [s]."""
        return min(self.instants, key=lambda instant: abs(instant.time - time))

    @property
    def shown(self) -> list[SteeredInstant]:
        """The instants to show: those of the paper, or as many spread evenly over a run that ends before."""
        end, paper = self.instants[-1].time, (0.0, 12.0, 17.0, 27.0, 35.0, 55.0)  # s
        return [self.nearest(time) for time in (paper if end >= paper[-1] else np.linspace(0.0, end, 6).tolist())]

    def figures(self, setup: str) -> dict[str, Any]:
        """Return the figures, as JSON has them, in SI units; `setup` is the setup's name.

        `deepest` is of a node or the needle in an obstacle, `chord_deepest` of the middle of a chord, `stretch` of a
        segment, either way; `slowest` is the least factor on the needle's speed; `median_step` and `high_step`, the
        99th percentile, are wall-clock times of a whole step; and `room` says how many fit into its period.
        """
        steps = self.instants[1:]
        median, high = np.percentile([step.took for step in steps], (50.0, 99.0)).tolist()
        nearest = min(step.margins["obstacle"].minimum for step in self.instants)
        return {
            "setup": setup,
            "formulation": self.settings.formulation,
            "nodes": self.settings.segments,
            "duration": self.instants[-1].time,
            "rate": RATE,
            "deepest": max(0.0, -(nearest + 0.5 * self.settings.thread().diameter)),
            "chord_deepest": self.chord_depth,
            "stretch": max(float(np.abs(step.prediction.strain).max()) for step in self.instants),
            "most_friction": max(len(step.margins.friction.nodes) for step in steps),
            "slowest": min(step.margins.friction.slowdown for step in steps),
            "median_step": median,
            "high_step": high,
            "instants": [instant.figures() for instant in self.shown],
            "room": 1.0 / (RATE * median),
            "simulated": "the thread model alone, the needle a point",
        }


def point_filter(scene: Scene, keep_out: float, approach_rate: float) -> NeedleSafetyFilter:
    """Return the filter of a needle that is a point and gets a new command in every step.

    Args:
        scene: dish and shapes.
        keep_out: least distance of the needle from wall and shapes [m].
        approach_rate: share of that distance by which it may approach [1/s].
    """
    return NeedleSafetyFilter(scene, keep_out=keep_out, approach_rate=approach_rate, hold_time=1.0 / RATE)


def replay_steering(
    settings: ThreadModelSettings,
    centreline: Points,
    commands: RecordedCommands,
    needle: NeedleSafetyFilter,
    progress: Progress = lambda share: None,
) -> HerniaRun:
    """Steer a thread as recorded.

    Args:
        settings: of thread and obstacles.
        centreline: where the thread lies at the start, from the needle on, shape (m, 2) [m].
        commands: of the operator.
        needle: see `point_filter`.
        progress: called with the share done, 0 to 1.

    Raises:
        ConfigurationError: an obstacle cannot be used.
        InvalidInputError: the thread cannot begin there, or a velocity cannot be used.
        SolverError: a step had no solution.
    """
    thread = SteeredThread(settings, centreline, needle)
    instants = [thread.now]
    count = math.ceil((commands.times[-1] + COMMAND_TIMEOUT) * RATE) if len(commands.times) else 0
    for k in range(count):
        instants.append(thread.step(1.0 / RATE, commands.at(k / RATE)))
        progress((k + 1) / count)
    farthest = 1.0  # m; farther than any obstacle of a dish
    around = Workspace(needle.scene.obstacles, farthest)

    def distances(points: Points) -> NDArray[np.float64]:  # of each from each obstacle, signed [m]
        near, distances = around.near(points), np.full((len(points), len(around.shapes)), farthest)
        np.minimum.at(distances, (near.node, near.obstacle), near.distance)
        return distances

    positions = [instant.prediction.positions for instant in instants]
    barriers = np.array([distances(points[1 : 1 + len(NODE_COLOURS)]) for points in positions])
    nearest = min(distances(0.5 * (points[1:] + points[:-1])).min(initial=farthest) for points in positions)
    radius = 0.5 * settings.thread().diameter
    return HerniaRun(settings, needle.scene, instants, barriers - radius, max(0.0, -float(nearest)))


def replay_hernia(
    bag_path: Path,
    output: Path,
    *,
    setup_name: str = "",
    formulation: str = "",
    animation: bool = False,
    log: Log = lambda text: None,
    progress: Progress = lambda share: None,
) -> dict[str, Any]:
    """Replay a recorded steering in the thread model, draw what the thread does, and return the figures.

    The needle is a point, as in the paper, and goes where it is told once friction has slowed it and the obstacles'
    barriers have bent its way. `output` is made at the end, whole or not at all: `hernia.json`, `hernia.png`, and
    `hernia.gif` if asked for.

    Args:
        bag_path: a bag with velocities that an operator asked for.
        output: folder to make.
        setup_name: name or path of the setup; the one the bag names, with the paper's number of segments, if empty.
        formulation: of the thread model; the setup's if empty.
        animation: whether to draw one.
        log: called with a line for a person at each stage.
        progress: called with the share done, 0 to 1.

    Raises:
        BagError: the bag cannot be used, or the output exists or cannot be written.
        ConfigurationError: the setup cannot be used.
        SolverError: a step had no solution.
    """
    bag = Bag(bag_path)
    setup = read_setup(setup_name or bag.notes.get("setup", "hernia_ring"))
    model = setup.model if setup_name else paper_model(setup)
    settings = replace(model, formulation=formulation or model.formulation)
    steering = read_steering(bag)
    with whole_folder(output) as folder:
        log(f"steering {steering.times[-1]:.0f} s in setup {setup.name}")
        needle = point_filter(setup.scene, setup.coils.keep_out, setup.coils.approach_rate)
        run = replay_steering(settings, start_centreline(setup), steering, needle, progress)
        figures = run.figures(setup.name)
        (folder / "hernia.json").write_text(json.dumps(figures, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        pictures = {"hernia.png": draw_hernia, "hernia.gif": draw_animation if animation else None}
        for name, draw in pictures.items():
            if draw is not None and (picture := picture_or_log(partial(draw, run), log)):
                (folder / name).write_bytes(picture)
    return figures


def read_steering(bag: Bag) -> RecordedCommands:
    """Return the operator's velocity commands recorded in a bag.

    Raises:
        BagError: it holds none, or one that cannot be used.
    """
    Recording(bag).require(OPERATOR_COMMAND)
    messages = [record.decode() for record in bag.records({OPERATOR_COMMAND.recorded})]
    stamps = np.array([seconds(message.header.stamp) for message in messages])
    if not (np.diff(stamps) >= 0.0).all():
        raise BagError(bag.path, f"has stamps on {OPERATOR_COMMAND.recorded} that do not rise")
    return RecordedCommands(stamps - stamps[0], plane_points(message.twist.linear for message in messages))


def paper_model(setup: Setup) -> ThreadModelSettings:
    """Return the thread model of a setup with the number of segments of the paper's figure."""
    return replace(setup.model, segments=PAPER_SEGMENTS)


def start_centreline(setup: Setup) -> np.ndarray:
    """Return where the thread lies at the start of a simulated run, from the needle on, shape (200, 2) [m]."""
    return setup.rig.thread_at_start(np.linspace(0.0, 1.0, 200))


def draw_hernia(run: HerniaRun) -> bytes:
    """Return a picture of six instants, and of the barriers of the first nodes and the friction over time, as PNG."""
    figure = make_figure(13.2, 13.2, 100.0)
    figure.text(0.03, 0.975, "A needle steered by hand around a hernia, simulated", fontsize=14, color=INK)
    words = (
        "the thread model alone, the needle a point; solid arrow: where the needle goes, dotted: what was asked of it\n"
        "green: a free thread; orange: friction, deeper with each node; blue: between obstacles and not pulled"
    )
    figure.text(0.03, 0.969, words, fontsize=10, color=FAINT, va="top")
    for index, instant in enumerate(run.shown):
        axes = figure.add_axes((0.02 + 0.325 * (index % 3), 0.618 - 0.315 * (index // 3), 0.31, 0.295))
        draw_instant(axes, run.scene, instant)
        axes.set_title(f"{instant.time:.0f} s: {caption(instant)}", fontsize=10, color=INK, pad=2)
    at = np.array([instant.time for instant in run.instants])
    plots = [figure.add_axes((0.045 + 0.325 * k, 0.15, 0.275, 0.125)) for k in range(len(run.scene.shapes))]
    for index, (axes, shape) in enumerate(zip(plots, run.scene.shapes, strict=True)):
        for node, colour in enumerate(NODE_COLOURS):
            axes.plot(at, 1e3 * run.barriers[:, node, index], color=colour, linewidth=1.2, label=f"node {node + 1}")
        axes.axhline(1e3 * run.settings.friction_threshold, color=FAINT, linewidth=0.9, linestyle=(0, (4, 3)))
        axes.set_ylim(-0.2, 6.0)
        axes.set_title(f"h_obs of the first nodes, {shape.name.replace('_', ' ')} [mm]", fontsize=10, loc="left")
    if plots:
        plots[0].legend(loc="upper right", fontsize=7.5, frameon=False, ncols=2, columnspacing=1.0, handlelength=1.4)
    plots.append(bars := figure.add_axes((0.045, 0.04, 0.925, 0.07)))
    frictions = [instant.margins.friction for instant in run.instants]
    counts = np.maximum([len(friction.nodes) for friction in frictions], 0.4)
    bars.bar(at, counts, width=1.02 * float(np.diff(at).mean()), color=list(map(friction_colour, frictions)))
    bars.set_title("nodes under friction, in the thread's colour", fontsize=10, loc="left")
    bars.set_xlabel("time [s]", fontsize=9, color=INK, labelpad=1)
    for axes in plots:
        for instant in run.shown:
            axes.axvline(instant.time, color=FAINT, linewidth=0.7, linestyle=(0, (1, 3)), zorder=0)
        axes.set_xlim(0.0, at[-1])
        tidy(axes)
    return to_png(figure)


def draw_animation(run: HerniaRun) -> bytes:
    """Return the run, faster than it happened, as GIF."""
    faster, rate = 6, 8  # than it happened; pictures a second
    pictures = []
    for k in range(math.floor(run.instants[-1].time / faster * rate) + 1):
        figure, instant = make_figure(4.6, 5.0, 96.0), run.nearest(k * faster / rate)
        draw_instant(figure.add_axes((0.0, 0.0, 1.0, 0.9)), run.scene, instant)
        figure.text(0.03, 0.955, caption(instant), fontsize=10.5, color=INK)
        words = f"{instant.time:.0f} s, shown {faster} times as fast; simulated, the thread model alone"
        figure.text(0.03, 0.915, words, fontsize=8, color=FAINT)
        pictures.append(Image.open(io.BytesIO(to_png(figure))).convert("RGB"))
    stream = io.BytesIO()
    pictures[0].save(stream, "GIF", save_all=True, append_images=pictures[1:], duration=1000 // rate, loop=0)
    return stream.getvalue()


def draw_instant(axes: Axes, scene: Scene, instant: SteeredInstant) -> None:
    """Draw the dish, the thread in the colour of its friction, and the needle with its commanded velocity, in mm."""
    draw_shapes(axes, scene)
    points, friction = 1e3 * instant.prediction.positions, instant.margins.friction
    colour = friction_colour(friction)
    axes.plot(*points.T, color="white", linewidth=4.0, solid_capstyle="round", alpha=0.8)
    axes.plot(*points.T, color=colour, linewidth=2.0, marker="o", markersize=2.4, markeredgewidth=0.0)
    under = points[list(friction.nodes)]
    axes.plot(*under.T, "o", color=colour, markersize=4.6, markeredgecolor="white", markeredgewidth=0.7)
    if instant.command is not None:
        for velocity, style in ((instant.command.commanded, (0, (1.5, 1.2))), (instant.command.filtered, "solid")):
            draw_arrow(axes, points[0], 1.2e3 * velocity, style)  # the way of 1.2 s
    axes.plot(*points[0], "o", color=INK, markersize=5.0, markeredgecolor="white", markeredgewidth=0.8)


def caption(instant: SteeredInstant) -> str:
    """Return the friction state at an instant as text."""
    friction = instant.margins.friction
    count = "1 node" if len(friction.nodes) == 1 else f"{len(friction.nodes)} nodes"
    return {
        FrictionState.UNKNOWN: "unknown",
        FrictionState.FREE: "free",
        FrictionState.SLIDING: f"friction at {count}, needle slowed to {100.0 * friction.slowdown:.0f} %",
        FrictionState.STUCK: f"{count} between obstacles, not pulled",
    }[friction.state]
