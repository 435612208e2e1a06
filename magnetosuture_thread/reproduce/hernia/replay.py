"""A recorded steering around a hernia, replayed in the thread model, with figures and pictures."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.table import Table

from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.recording import Recording
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.interface import OPERATOR_COMMAND
from magnetosuture_thread.jobs.output import whole_folder
from magnetosuture_thread.model.settings import ThreadModelSettings
from magnetosuture_thread.reproduce.hernia.pictures import draw_animation, draw_hernia
from magnetosuture_thread.reproduce.hernia.steering import (
    HerniaSummary,
    RecordedCommands,
    point_filter,
    replay_steering,
)
from magnetosuture_thread.setups import Setup, read_setup

START_POINTS = 200  # of the centreline at the start
PAPER_SEGMENTS = 40  # of the thread in the paper's figure

Log = Callable[[str], None]
Progress = Callable[[float], None]


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
