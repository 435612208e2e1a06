"""The paper's thread-behavior tests in closed loop, by material: runs, figures, a table and a picture."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.table import Table

from magnetosuture_thread import Scene
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.reading import stamp_of
from magnetosuture_thread.commands.simulate import measure_loop, simulate
from magnetosuture_thread.evaluation.figures import AGAINST
from magnetosuture_thread.evaluation.frames import FrameResult
from magnetosuture_thread.evaluation.graph_outputs import LoopSummary
from magnetosuture_thread.evaluation.plots import FAINT, INK, SEEN, TRUTH, draw_threads, look_at, tidy
from magnetosuture_thread.evaluation.workers import Log, Progress
from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.rig.setups import Setup, read_setup
from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.settings.files import whole_folder
from magnetosuture_thread.settings.interface import COMPRESSED_IMAGE
from magnetosuture_thread.vision.images import decode_image

SHOWN = 4  # instants of each run


@dataclass(frozen=True)
class BehaviorRun:
    """One thread-behavior test.

    Attributes:
        name: for a person.
        summary: its figures.
        instants: the predicted frames, by time.
        frames: BGR pictures of the instants to show, by their stamps [ns].
        view: where the dish is in them.
        scene: that they show.
    """

    name: str
    summary: LoopSummary
    instants: Sequence[FrameResult]
    frames: dict[int, NDArray[np.uint8]]
    view: DishView
    scene: Scene


def thread_behavior(
    output: Path,
    scenarios: Sequence[str] = ("petri_35mm_polyamide", "petri_150mm_silk"),
    *,
    log: Log = lambda text: None,
    progress: Progress = lambda share: None,
) -> list[BehaviorRun]:
    """Run each setup in closed loop and compare prediction, measurement and ground truth.

    `output` is made at the end, whole or not at all: a bag for each scenario, `behaviour.json` and
    `behaviour.png`.

    Args:
        output: folder to make.
        scenarios: names or paths of setups with a path for the needle.
        log: called with a line for a person at each stage.
        progress: called with the share done, 0 to 1.

    Raises:
        BagError: the output exists or cannot be written, or a run holds no prediction.
        ConfigurationError: a scenario cannot be used.
        GraphError: a node ended or did not come.
    """
    setups = [read_setup(scenario) for scenario in scenarios]
    with whole_folder(output) as folder:
        runs = []
        for index, setup in enumerate(setups):

            def advance(share: float, done: int = index) -> None:
                progress((done + share) / len(setups))

            log(setup.name)
            simulate(str(setup.path), folder / setup.name, log=log, progress=advance)
            runs.append(_evaluated(folder / setup.name, setup))
        figures = [run.summary.to_json() for run in runs]
        (folder / "behaviour.json").write_text(json.dumps(figures, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        draw_behavior(folder / "behaviour.png", runs)
    return runs


def _evaluated(path: Path, setup: Setup) -> BehaviorRun:
    """Return a run's figures and the frames to show."""
    bag = Bag(path)
    collector = measure_loop(bag, setup)
    summary = collector.summary(setup.name)
    if not collector.instants:
        raise BagError(path, "holds no predicted thread")
    wanted = {instant.stamp for instant in chosen_instants(collector.instants)}
    frames = {}
    for record in bag.records({COMPRESSED_IMAGE.recorded}):
        if (stamp := stamp_of(record)) in wanted:
            frames[stamp] = decode_image(record.decode().data)
    model = setup.model
    name = (
        f"{model.material.replace('_', ' ', 1).replace('_', '-')}, {1e3 * model.thread_length:g} mm, "
        f"{model.segments} segments, {model.attachment} to the needle, dish of {1e3 * setup.scene.dish.diameter:g} mm"
    )
    return BehaviorRun(name, summary, collector.instants, frames, setup.rig.view(setup.scene), setup.scene)


def behavior_table(runs: Sequence[BehaviorRun]) -> Table:
    """Return the figures of the thread-behavior tests as a table."""
    table = Table(title="thread behaviour, closed loop, simulated", title_justify="left", title_style="bold")
    table.caption = (
        "errors against ground truth and against the measured thread:\n"
        "mean (maximum) over time, % of the thread's length; needle: RMS"
    )
    table.add_column("", no_wrap=True)
    for name in ("ground truth", "measured", "frames", "needle off path"):
        table.add_column(name, justify="right")
    for run in runs:
        summary = run.summary
        errors = [
            f"{figures['mean']:.3f} ({figures['maximum']:.3f})" if figures else "none"
            for figures in (summary.error_truth, summary.error_seen)
        ]
        table.add_row(
            summary.setup, *errors, f"{summary.predicted} of {summary.frames}", f"{1e3 * summary.path_error:.2f} mm"
        )
    return table


def chosen_instants(instants: Sequence[FrameResult]) -> list[FrameResult]:
    """Return the instants to show: spread evenly over the run, the last among them."""
    at = np.linspace(0, len(instants) - 1, SHOWN + 1).round().astype(int)[1:]
    return [instants[index] for index in at]


def draw_behavior(path: Path, runs: Sequence[BehaviorRun]) -> None:
    """Draw the tests below one another, each with some instants and its errors over time, and write the picture (.png).

    Args:
        path: of the picture.
        runs: the tests.
    """
    row = 2.9  # height of a run [inch]
    height = row * len(runs) + 0.72
    figure = Figure(figsize=(15.0, height), dpi=100, facecolor="white")
    words = (
        "wide and blue: measured by the camera; magenta: predicted from the needle's pose alone; "
        "teal, with nodes: estimated by both; dashed: ground truth"
    )
    top = 1.0 - 0.32 / height
    figure.text(0.012, top, "Thread behaviour in closed loop, simulated", fontsize=13, color=INK)
    figure.text(0.012, top - 0.26 / height, words, fontsize=9.5, color=FAINT)
    for index, run in enumerate(runs):
        bottom, tall = (row * (len(runs) - 1 - index) + 0.12) / height, (row - 0.42) / height
        figure.text(0.012, bottom + tall + 0.012, run.name, fontsize=10.5, color=INK)
        times = np.array([(instant.stamp - run.instants[0].stamp) * 1e-9 for instant in run.instants])
        for column, instant in enumerate(chosen_instants(run.instants)):
            axes = figure.add_axes((0.012 + 0.168 * column, bottom, 0.163, tall))
            draw_threads(axes, run.frames[instant.stamp], run.view, instant, run.scene.obstacles, magnified=0.8)
            look_at(axes, run.view.to_pixels(np.zeros(2)), 0.56 * run.scene.dish.diameter / run.view.metres_per_pixel)
            time = f"{(instant.stamp - run.instants[0].stamp) * 1e-9:.1f} s"
            axes.text(0.03, 0.97, time, transform=axes.transAxes, fontsize=9, color=INK, va="top")
        plot = figure.add_axes((0.725, bottom + 0.055, 0.262, tall - 0.06))
        for target, colour in (("seen", SEEN), ("truth", TRUTH)):
            errors = [instant.errors[target] for instant in run.instants]
            label = f"against {AGAINST[target]}, mean {np.nanmean(errors):.2f}"
            plot.plot(times, errors, color=colour, linewidth=1.2, label=label)
        plot.set_ylim(0.0, 1.35 * plot.get_ylim()[1])  # room for the legend
        plot.set_title("prediction error [% of the length]", fontsize=9.5, color=INK, loc="left")
        plot.set_xlabel("time [s]", fontsize=8.5, color=INK, labelpad=1)
        plot.legend(loc="upper right", fontsize=8.0, frameon=False, ncols=1)
        tidy(plot)
    figure.savefig(path)
