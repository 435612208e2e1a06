"""The command `magnetosuture reproduce`: two results of the paper, simulated."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.reading import stamp_of
from magnetosuture_thread.commands.command import Terminal, add_actions, make_table, write_json
from magnetosuture_thread.commands.simulate import measure_loop, simulate
from magnetosuture_thread.evaluation.frames import FrameResult
from magnetosuture_thread.evaluation.recorded import read_image
from magnetosuture_thread.evaluation.replay import picture_or_log
from magnetosuture_thread.evaluation.tables import LoopSummary
from magnetosuture_thread.evaluation.workers import Log, Progress
from magnetosuture_thread.rig.setups import Setup, read_setup
from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.settings.files import whole_folder
from magnetosuture_thread.settings.interface import COMPRESSED_IMAGE


def add(parser: argparse.ArgumentParser) -> None:
    """Reproduce a result of the paper, simulated."""
    results = {"hernia": run_hernia, "thread_behavior": run_thread_behavior}
    hernia, behavior = add_actions(parser, "results", "RESULT", **results)
    hernia.add_argument("bag", type=Path, metavar="BAG", help="a bag with an operator's velocity commands")
    for result in (hernia, behavior):
        result.add_argument("--output", type=Path, required=True, metavar="DIR", help="folder to make")
    default = "(default: the bag's, with the paper's 40 segments)"
    hernia.add_argument("--setup", default="", metavar="NAME", help=f"setup or YAML file {default}")
    hernia.add_argument("--formulation", choices=("rod", "paper"), default="", help="(default: the setup's)")
    hernia.add_argument("--animation", action="store_true", help="draw hernia.gif as well")


def run_hernia(options: argparse.Namespace, terminal: Terminal) -> None:
    """Replay a recorded steering around a hernia.

    The paper's simulated hernia repair: a needle steered by hand draws a thread through a penetration path and
    around a ring. BAG holds the commanded velocities of the needle, on /operator/servo_cv; friction slows it and
    barriers keep it off the obstacles, as they do live. In the thread model alone, where the needle is a point;
    `magnetosuture console hernia_ring` is the same with a whole rig.
    DIR, which must not exist, gets hernia.json and hernia.png: six instants, and the barriers over time.
    """
    from magnetosuture_thread.evaluation.hernia import replay_hernia  # late, as it imports matplotlib

    settings = {"setup_name": options.setup, "formulation": options.formulation, "animation": options.animation}
    with terminal.progress("hernia") as advance:
        figures = replay_hernia(options.bag, options.output, log=terminal.log, progress=advance, **settings)
    columns = ("time [s]", "thread", "nodes", "slowdown", "commanded [mm/s]", "filtered [mm/s]")
    cells = []
    for instant in figures["instants"]:
        speeds = (f"{1e3 * math.hypot(*instant[name]):.2f}" for name in ("asked", "passed"))
        state = instant["state"], str(len(instant["friction_nodes"])), f"{instant['slowdown']:.2f}"
        cells.append((f"{instant['time']:.1f}", *state, *speeds))
    terminal.print(make_table(f"{figures['setup']}, simulated: {figures['simulated']}", columns, cells))
    for line in (
        "{duration:.1f} s at {rate:g} Hz, {nodes} segments, formulation {formulation}".format(**figures),
        f"deepest node in an obstacle {figures['deepest']:.1e} m, middle of a chord "
        f"{1e6 * figures['chord_deepest']:.0f} µm, maximum stretch {100.0 * figures['stretch']:.4f} %",
        f"a step takes {1e3 * figures['median_step']:.2f} ms (99th percentile {1e3 * figures['high_step']:.2f}): "
        f"{figures['room']:.0f} times faster than its period",
        f"results: {options.output}",
    ):
        terminal.log(line)


def run_thread_behavior(options: argparse.Namespace, terminal: Terminal) -> None:
    """Compare prediction and ground truth in closed loop, by material.

    The paper's two thread-behavior tests in a closed loop around the simulated rig, a polyamide thread of 19 mm and
    a silk thread of 150 mm in a larger dish: the predicted thread against ground truth and against what the camera
    measures. DIR, which must not exist, gets a bag of each, behaviour.json and behaviour.png. Everything is
    simulated. Takes two minutes.
    """
    with terminal.progress("thread-behavior") as advance:
        runs = thread_behavior(options.output, log=terminal.log, progress=advance)
    columns = ("setup", "ground truth", "measured", "frames", "needle off path")
    cells = []
    for summary in (run.summary for run in runs):
        errors = [
            f"{figures['mean']:.3f} ({figures['maximum']:.3f})" if figures else "none"
            for figures in (summary.error_truth, summary.error_seen)
        ]
        frames, off = f"{summary.predicted} of {summary.frames}", f"{1e3 * summary.path_error:.2f} mm"
        cells.append((summary.setup, *errors, frames, off))
    caption = "errors of the prediction, mean (maximum) over time in % of the thread's length; needle: RMS"
    terminal.print(make_table("thread behavior, closed loop, simulated", columns, cells, caption))
    terminal.log(f"results: {options.output}")


class BehaviorRun(NamedTuple):
    """One thread-behavior test.

    Attributes:
        setup: of the run.
        summary: its figures.
        instants: the predicted frames, by time.
        images: camera images of the instants to show, by their stamps [ns].
    """

    setup: Setup
    summary: LoopSummary
    instants: Sequence[FrameResult]
    images: dict[int, NDArray[np.uint8]]


def thread_behavior(
    output: Path,
    setups: Sequence[str] = ("petri_35mm_polyamide", "petri_150mm_silk"),
    *,
    log: Log = lambda text: None,
    progress: Progress = lambda share: None,
) -> list[BehaviorRun]:
    """Run each setup in closed loop and compare prediction, measurement and ground truth.

    `output` is made at the end, whole or not at all: a bag for each setup, `behaviour.json` and `behaviour.png`.

    Args:
        output: folder to make.
        setups: names or paths of setups with a path for the needle.
        log: called with a line for a person at each stage.
        progress: called with the share done, 0 to 1.

    Raises:
        BagError: the output exists or cannot be written, or a run holds no prediction.
        ConfigurationError: a setup cannot be used.
        GraphError: a node ended or did not come.
    """
    chosen, runs = [read_setup(name) for name in setups], []
    with whole_folder(output) as folder:
        for index, setup in enumerate(chosen):

            def advance(share: float, done: int = index) -> None:
                progress((done + share) / len(chosen))

            log(setup.name)
            path = folder / setup.name
            simulate(str(setup.path), path, log=log, progress=advance)
            bag = Bag(path)
            collector = measure_loop(bag, setup)
            summary, instants = collector.summary(setup.name), collector.instants
            if not instants:
                raise BagError(path, "holds no predicted thread")
            # Four are shown, spread evenly over the run, the last instant among them.
            at = np.linspace(0, len(instants) - 1, 5).round().astype(int)[1:]
            stamps = {instants[index].stamp for index in at}
            records = bag.records({COMPRESSED_IMAGE.recorded})
            images = {stamp: read_image(record) for record in records if (stamp := stamp_of(record)) in stamps}
            runs.append(BehaviorRun(setup, summary, instants, images))
        write_json(folder / "behaviour.json", [run.summary.to_json() for run in runs])
        if picture := picture_or_log(partial(draw_behavior, runs), log):
            (folder / "behaviour.png").write_bytes(picture)
    return runs


def draw_behavior(runs: Sequence[BehaviorRun]) -> bytes:
    """Return a picture of the tests below one another, each with some instants and its errors over time, as PNG."""
    from magnetosuture_thread.evaluation import plots  # late, as it imports matplotlib

    row = 2.9  # height of a run [inch]
    height = row * len(runs) + 0.72
    figure = plots.make_figure(15.0, height, 100.0)
    words = (
        "wide and blue: measured by the camera; magenta: predicted from the needle's pose alone; "
        "teal, with nodes: estimated by both; dashed: ground truth"
    )
    top = 1.0 - 0.32 / height
    figure.text(0.012, top, "Thread behaviour in closed loop, simulated", fontsize=13, color=plots.INK)
    figure.text(0.012, top - 0.26 / height, words, fontsize=9.5, color=plots.FAINT)
    for index, (setup, _, instants, images) in enumerate(runs):
        bottom, tall = (row * (len(runs) - 1 - index) + 0.12) / height, (row - 0.42) / height
        model, view, diameter = setup.model, setup.rig.view(setup.scene), setup.scene.dish.diameter
        name = (
            f"{model.material.replace('_', ' ', 1).replace('_', '-')}, {1e3 * model.thread_length:g} mm, "
            f"{model.segments} segments, {model.attachment} to the needle, dish of {1e3 * diameter:g} mm"
        )
        figure.text(0.012, bottom + tall + 0.012, name, fontsize=10.5, color=plots.INK)
        times = np.array([(instant.stamp - instants[0].stamp) * 1e-9 for instant in instants])
        for column, instant in enumerate(instant for instant in instants if instant.stamp in images):
            axes = figure.add_axes((0.012 + 0.168 * column, bottom, 0.163, tall))
            instant.obstacles = setup.scene.obstacles
            plots.draw_threads(axes, images[instant.stamp], view, instant, magnified=0.8)
            plots.look_at(axes, view.to_pixels(np.zeros(2)), 0.56 * diameter / view.metres_per_pixel)
            time = f"{(instant.stamp - instants[0].stamp) * 1e-9:.1f} s"
            axes.text(0.03, 0.97, time, transform=axes.transAxes, fontsize=9, color=plots.INK, va="top")
        plot = figure.add_axes((0.725, bottom + 0.055, 0.262, tall - 0.06))
        for target, colour in (("seen", plots.SEEN), ("truth", plots.TRUTH)):
            errors = [instant.errors[target] for instant in instants]
            label = f"from {plots.AGAINST[target]}, mean {np.nanmean(errors):.2f}"
            plot.plot(times, errors, color=colour, linewidth=1.2, label=label)
        plot.set_ylim(0.0, 1.35 * plot.get_ylim()[1])  # room for the legend
        plot.set_title("prediction error [% of the length]", fontsize=9.5, color=plots.INK, loc="left")
        plot.set_xlabel("time [s]", fontsize=8.5, color=plots.INK, labelpad=1)
        plot.legend(loc="upper right", fontsize=8.0, frameon=False, ncols=1)
        plots.tidy(plot)
    return plots.to_png(figure)
