"""The simulated hernia repair: a thread steered by hand around a ring, in the thread model alone.

The needle is a point, and goes as fast as the filter lets it. Here are the loop itself, recorded commands replayed in
it, the figures of such a run, and its pictures: six instants, the barriers over time, and an animation.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from matplotlib.animation import PillowWriter
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from numpy.typing import NDArray
from rich.table import Table

from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.recording import Recording
from magnetosuture_thread.commands.output import whole_folder
from magnetosuture_thread.errors import BagError, InvalidInputError, SolverError
from magnetosuture_thread.evaluation.plots import FAINT, INK, shape_patch, tidy
from magnetosuture_thread.geometry.obstacles import Disc, Workspace
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.interface import OPERATOR_COMMAND
from magnetosuture_thread.safety import FilteredCommand, NeedleSafetyFilter
from magnetosuture_thread.scene import Scene
from magnetosuture_thread.setups import Setup, read_setup
from magnetosuture_thread.thread.margins import Friction, FrictionState, Margins, friction_colour
from magnetosuture_thread.thread.prediction import NeedlePose, Prediction
from magnetosuture_thread.thread_model.session import ThreadSession
from magnetosuture_thread.thread_model.settings import ThreadModelSettings

RATE = 33.0  # Hz, of the paper's simulation
COMMAND_TIMEOUT = 0.1  # s; a command that no other follows ends, as at the coil bridge
SHOWN = (0.0, 12.0, 17.0, 27.0, 35.0, 55.0)  # s; the six instants of the paper's figure
FIRST_NODES = 5  # whose barriers the paper plots
_MAX_DISTANCE = 1.0  # m; farther than any obstacle of a dish
MAX_COMMAND = 1.0  # m/s; what commands more was meant in another unit
_AHEAD = np.array([1.0, 0.0])  # a point has no heading, and a thread that turns freely asks for none
START_POINTS = 200  # of the centreline at the start
PAPER_SEGMENTS = 40  # of the thread in the paper's figure
# Of the pictures.
FLOOR, RIM = "#f4f1ec", "#c9c3ba"
TISSUE, EDGE = "#f0b9b4", "#c98680"
RING, RING_EDGE = "#d9827f", "#a8504f"
MARGIN = 0.04  # of the dish's diameter, around it
REACH = 1.2  # s of its way, by which an arrow shows a velocity
NODE_COLOURS = ("#0b3c5d", "#1f77b4", "#2a9d8f", "#8ab17d", "#e9a03b")
TOP = 6.0e-3  # m; barriers beyond are not drawn
FASTER = 6  # than it happened
PICTURES = 8  # a second

Log = Callable[[str], None]
Progress = Callable[[float], None]


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
        began = perf_counter()
        if not (np.isfinite(commanded).all() and math.hypot(*commanded.tolist()) <= MAX_COMMAND):
            expected = f"finite numbers, at most {MAX_COMMAND:g} m/s"
            raise InvalidInputError("needle velocity", commanded.tolist(), expected)
        slowdown = self.now.margins.friction.slowdown
        command = self._needle.filter(commanded, self._tail, _AHEAD, slowdown=slowdown)
        self._tail = self._tail + interval * command.filtered
        self._stamp += round(interval * 1e9)
        self.now = self._advance(command, began)
        return self.now

    def _advance(self, command: FilteredCommand | None, began: float) -> SteeredInstant:
        outcome = self._session.on_pose(self._stamp, NeedlePose(self._stamp * 1e-9, self._tail, _AHEAD))
        if outcome.problem is not None:
            raise outcome.problem
        prediction, margins = outcome.prediction, outcome.margins
        assert prediction is not None
        if margins is None:
            raise SolverError(prediction.solver, prediction.status, prediction.residual, 0.0)
        took = perf_counter() - began if command is not None else 0.0
        return SteeredInstant(self._stamp * 1e-9, prediction, margins, command, took)


@dataclass(frozen=True)
class RecordedCommands:
    """Velocity commands that an operator gave.

    Attributes:
        times: of each command, rising, shape (m,) [s].
        velocities: shape (m, 2) [m/s].
    """

    times: NDArray[np.float64]
    velocities: NDArray[np.float64]

    @property
    def duration(self) -> float:
        """From the start to the last command [s]."""
        return float(self.times[-1]) if len(self.times) else 0.0

    def at(self, time: float) -> NDArray[np.float64]:
        """Return the velocity commanded at a time [s], shape (2,) [m/s]; zero where no command is valid."""
        index = int(np.searchsorted(self.times, time + 1e-9, side="right")) - 1
        if index < 0 or time - self.times[index] > COMMAND_TIMEOUT + 1e-9:
            return np.zeros(2)
        return np.asarray(self.velocities[index])


@dataclass(frozen=True)
class HerniaSummary:
    """The figures of a run.

    Attributes:
        setup: name of the setup.
        formulation: of the thread model.
        nodes: n.
        duration: [s].
        rate: of the steps [Hz].
        deepest: of a node or the needle in an obstacle, 0 if none ever was in one [m].
        chord_deepest: the same of the middle of a chord between two nodes [m].
        stretch: greatest of a segment, either way [-].
        most_friction: greatest number of nodes under friction at once.
        slowest: least factor on the needle's speed.
        median_step: wall-clock time of a whole step: filter, thread and margins [s].
        high_step: its 99th percentile [s].
        instants: what was so at the times that are shown.
    """

    setup: str
    formulation: str
    nodes: int
    duration: float
    rate: float
    deepest: float
    chord_deepest: float
    stretch: float
    most_friction: int
    slowest: float
    median_step: float
    high_step: float
    instants: tuple[dict[str, Any], ...]

    @property
    def real_time_factor(self) -> float:
        """How many times the median step fits into its period."""
        return 1.0 / (self.rate * self.median_step)

    def to_json(self) -> dict[str, Any]:
        """Return the figures, as JSON has them."""
        simulated = "the thread model alone, the needle a point"
        return {**asdict(self), "room": self.real_time_factor, "simulated": simulated}


@dataclass(frozen=True)
class HerniaRun:
    """A whole run.

    Attributes:
        settings: of the thread.
        scene: dish and shapes.
        instants: one a step, by time; the first is the start.
        barriers: h_obs of the first nodes, shape (steps + 1, nodes, obstacles) [m].
        chord_depths: how deep the middles of chords are at each step, negative outside, shape (steps + 1,) [m].
    """

    settings: ThreadModelSettings
    scene: Scene
    instants: Sequence[SteeredInstant]
    barriers: NDArray[np.float64]
    chord_depths: NDArray[np.float64]

    def nearest(self, time: float) -> SteeredInstant:
        """Return the instant nearest to a time [s]."""
        return min(self.instants, key=lambda instant: abs(instant.time - time))

    @property
    def shown(self) -> list[SteeredInstant]:
        """The instants to show: those of the paper, or as many spread evenly over a run that ends before."""
        end = self.instants[-1].time
        times = SHOWN if end >= SHOWN[-1] else np.linspace(0.0, end, len(SHOWN)).tolist()
        return [self.nearest(time) for time in times]

    def summary(self, setup: str) -> HerniaSummary:
        """Return the figures; `setup` is the setup's name."""
        steps = self.instants[1:]
        took = np.array([step.took for step in steps])
        radius = 0.5 * self.settings.thread().diameter
        nearest = min((step.margins["obstacle"].minimum for step in self.instants), default=math.inf)
        counts = [len(step.margins.friction.nodes) for step in steps]
        return HerniaSummary(
            setup=setup,
            formulation=self.settings.formulation,
            nodes=self.settings.segments,
            duration=self.instants[-1].time,
            rate=RATE,
            deepest=max(0.0, -(nearest + radius)),
            chord_deepest=max(0.0, float(self.chord_depths.max())),
            stretch=max(float(np.abs(step.prediction.strain).max()) for step in self.instants),
            most_friction=max(counts),
            slowest=min(step.margins.friction.slowdown for step in steps),
            median_step=float(np.median(took)),
            high_step=float(np.percentile(took, 99.0)),
            instants=tuple(map(_instant_figures, self.shown)),
        )


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
    progress: Callable[[float], None] = lambda share: None,
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
    around = Workspace(needle.scene.obstacles, _MAX_DISTANCE)
    instants = list(_steps(SteeredThread(settings, centreline, needle), commands, progress))
    radius, obstacles = 0.5 * settings.thread().diameter, len(around.shapes)
    barriers = np.array(
        [_distances(around, instant.prediction.positions[1 : 1 + FIRST_NODES], obstacles) for instant in instants]
    )
    middles = [0.5 * (i.prediction.positions[1:] + i.prediction.positions[:-1]) for i in instants]
    depths = np.array([-_distances(around, points, obstacles).min(initial=_MAX_DISTANCE) for points in middles])
    return HerniaRun(settings, needle.scene, instants, barriers - radius, depths)


def _steps(
    thread: SteeredThread, commands: RecordedCommands, progress: Callable[[float], None]
) -> Iterator[SteeredInstant]:
    yield thread.now
    count = math.ceil((commands.duration + COMMAND_TIMEOUT) * RATE)
    for k in range(count):
        yield thread.step(1.0 / RATE, commands.at(k / RATE))
        progress((k + 1) / count)


def _distances(around: Workspace, points: Points, obstacles: int) -> NDArray[np.float64]:
    """Return the signed distance of each point from each obstacle, shape (m, obstacles) [m]."""
    near = around.near(points)
    distances = np.full((len(points), obstacles), _MAX_DISTANCE)
    np.minimum.at(distances, (near.node, near.obstacle), near.distance)
    return distances


def _instant_figures(instant: SteeredInstant) -> dict[str, Any]:
    friction, command = instant.margins.friction, instant.command
    return {
        "time": instant.time,
        "state": friction.state.name.lower(),
        "friction_nodes": list(friction.nodes),
        "slowdown": friction.slowdown,
        "asked": command.commanded.tolist() if command else [0.0, 0.0],
        "passed": command.filtered.tolist() if command else [0.0, 0.0],
        "needle": instant.prediction.positions[0].tolist(),
    }


def replay_hernia(
    bag_path: Path,
    output: Path,
    *,
    setup_name: str = "",
    formulation: str = "",
    animation: bool = False,
    log: Log = lambda text: None,
    progress: Progress = lambda share: None,
) -> HerniaSummary:
    """Replay a recorded steering in the thread model and draw what the thread does.

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
        log(f"steering {steering.duration:.0f} s in setup {setup.name}")
        needle = point_filter(setup.scene, setup.coils.keep_out, setup.coils.approach_rate)
        run = replay_steering(settings, start_centreline(setup), steering, needle, progress)
        summary = run.summary(setup.name)
        figures = json.dumps(summary.to_json(), indent=2, allow_nan=False)
        (folder / "hernia.json").write_text(figures + "\n", encoding="utf-8")
        draw_hernia(folder / "hernia.png", run)
        if animation:
            log("drawing the animation")
            draw_animation(folder / "hernia.gif", run)
    return summary


def read_steering(bag: Bag) -> RecordedCommands:
    """Return the operator's velocity commands recorded in a bag.

    Raises:
        BagError: it holds none, or one that cannot be used.
    """
    Recording(bag).require(OPERATOR_COMMAND)
    stamps, velocities = [], []
    for record in bag.records({OPERATOR_COMMAND.recorded}):
        message = record.decode()
        stamps.append(message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec)
        velocities.append((message.twist.linear.x, message.twist.linear.y))
    times = np.array(stamps) - stamps[0] if stamps else np.empty(0)
    if not len(times):
        raise BagError(bag.path, f"holds no message on {OPERATOR_COMMAND.recorded}")
    if not (np.diff(times) >= 0.0).all():
        raise BagError(bag.path, f"has stamps on {OPERATOR_COMMAND.recorded} that do not rise")
    return RecordedCommands(times, np.array(velocities))


def paper_model(setup: Setup) -> ThreadModelSettings:
    """Return the thread model of a setup with the number of segments of the paper's figure."""
    return replace(setup.model, segments=PAPER_SEGMENTS)


def start_centreline(setup: Setup) -> np.ndarray:
    """Return where the thread lies at the start of a simulated run, from the needle on, shape (m, 2) [m]."""
    return setup.rig.thread_at_start(np.linspace(0.0, 1.0, START_POINTS))


def hernia_table(summary: HerniaSummary) -> Table:
    """Return a row for each instant that is shown."""
    table = Table(title=f"{summary.setup}, simulated: the thread model alone, the needle a point")
    for name in ("time [s]", "thread", "nodes", "slowdown", "asked [mm/s]", "passed [mm/s]"):
        table.add_column(name, justify="left" if name == "thread" else "right", no_wrap=True)
    for instant in summary.instants:
        table.add_row(
            f"{instant['time']:.1f}",
            instant["state"],
            str(len(instant["friction_nodes"])),
            f"{instant['slowdown']:.2f}",
            f"{1e3 * math.hypot(*instant['asked']):.2f}",
            f"{1e3 * math.hypot(*instant['passed']):.2f}",
        )
    return table


def hernia_lines(summary: HerniaSummary) -> list[str]:
    """Return in words what the table does not say."""
    return [
        f"{summary.duration:.1f} s at {summary.rate:g} Hz, {summary.nodes} segments, formulation {summary.formulation}",
        f"deepest node in an obstacle {summary.deepest:.1e} m, middle of a chord {1e6 * summary.chord_deepest:.0f} um, "
        f"maximum stretch {100.0 * summary.stretch:.4f} %",
        f"a step takes {1e3 * summary.median_step:.2f} ms (99th percentile {1e3 * summary.high_step:.2f}): "
        f"{summary.real_time_factor:.0f} times faster than its period",
    ]


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
