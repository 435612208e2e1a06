"""The command `magnetosuture campaign`: many runs of a procedure in the closed loop, and what came of them."""

from __future__ import annotations

import argparse
import math
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from time import process_time
from typing import TYPE_CHECKING, Any

import numpy as np

from magnetosuture_thread import ConfigurationError
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.coils.needle_motion import NeedleTwist
from magnetosuture_thread.commands import command
from magnetosuture_thread.evaluation.recorded import SETUP_NOTE
from magnetosuture_thread.evaluation.replay import picture_or_log
from magnetosuture_thread.evaluation.tables import write_table
from magnetosuture_thread.evaluation.workers import Log, Progress, TaskRunner, WorkerDiedError
from magnetosuture_thread.planning.procedure import Procedure, read_procedure
from magnetosuture_thread.rig import campaign as run
from magnetosuture_thread.rig.closed_loop import LATENCY, RunBag
from magnetosuture_thread.rig.setups import Setup, read_procedure_setup
from magnetosuture_thread.rig.truth import with_rig
from magnetosuture_thread.settings.errors import BagError, shortened
from magnetosuture_thread.settings.files import whole_folder

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    option = parser.add_argument
    option("procedure", metavar="PROCEDURE", help="a procedure's name or YAML file")
    count, first = command.count_argument("runs", 1, 100_000), command.count_argument("a seed", 0, 2**31 - 1)
    option("--seeds", type=count, default=1, metavar="N", help="runs (default: 1)")
    option("--first-seed", type=first, default=0, metavar="K", help="seed of the first run (default: 0)")
    option("--setup", default="", metavar="NAME", help="a setup's name or YAML file (default: the procedure's)")
    command.add_rig(parser)
    latency = f"time from a frame to the command that follows from it [s] (default: {LATENCY:g})"
    option("--latency", type=command.number_argument(0.0, 1.0), default=LATENCY, metavar="S", help=latency)
    option("--camera", action="store_true", help="render and track frames (default: add the tracker's noise)")
    bags = "seeds whose runs are recorded as bags (default: none)"
    option("--bags", type=first, nargs="+", default=[], metavar="SEED", help=bags)
    command.add_workers(parser)
    option("--output", type=Path, required=True, metavar="DIR", help="folder to make")


def run_campaign(options: argparse.Namespace, terminal: command.Terminal) -> int:
    """Run an autonomous procedure in the simulated closed loop, once for each seed.

    Rig, the tracker's noise or the camera and tracker themselves, estimator, planner and coil bridge run in one process
    on simulated time, without ROS; a seed always gives the same run. Each seed varies start, viscosity, bending
    stiffness, coils, friction and noise about the setup's rig, or that of --rig; the nodes are told nothing of it. DIR,
    which must not exist, gets
      campaign.json   how many runs succeeded, and the figures of each
      campaign.csv    the figures of each run
      campaign.png    the figures of all runs, and the last seconds of those that failed
      bags/seed_N     for each seed of --bags: what all nodes would publish, with the ground truth; `replay` takes it
    With --scheduler and --bags, DIR must be a folder that all workers have.
    A run succeeds if all goals are reached and all limits hold. All of it is simulated.
    """
    seeds, bags = range(options.first_seed, options.first_seed + options.seeds), sorted(set(options.bags))
    procedure = read_procedure(options.procedure)
    if not set(bags) <= set(seeds):
        raise ConfigurationError("--bags", sorted(set(bags) - set(seeds)), f"seeds of {seeds[0]} to {seeds[-1]}")
    setup = with_rig(read_procedure_setup(procedure, options.setup), options.rig)
    run.check_run(procedure, setup, run.vary(setup, seeds[0]))
    result = CampaignResult(procedure, setup, options.camera, options.latency)
    work = partial(_run, result, setup.path.read_text(encoding="utf-8"))
    with (
        terminal.progress("campaign") as advance,
        whole_folder(options.output) as folder,
        TaskRunner(work, options.workers, options.scheduler) as runner,
    ):
        tasks = [(seed, folder / "bags" / f"seed_{seed}" if seed in bags else None) for seed in seeds]
        for index, outcome in runner.run(tasks, terminal.log, advance):
            seed = seeds[index]
            if isinstance(outcome, WorkerDiedError):
                result.died[seed] = str(outcome)
                terminal.log(f"seed {seed}: {outcome}")
                continue
            seed_run, used_time = outcome
            result.runs.append(seed_run)
            speed = seed_run.simulated_s / used_time
            terminal.log(f"seed {seed}: {seed_run.reason or 'success'} ({speed:.1f} times real time)")
        result.runs.sort(key=lambda seed_run: seed_run.seed)
        rows = [seed_run.to_json() for seed_run in result.runs]
        for ending in ("json", "csv"):
            write_table(folder / f"campaign.{ending}", rows, result.to_json())
        if picture := picture_or_log(partial(draw_campaign, result), terminal.log):
            (folder / "campaign.png").write_bytes(picture)
    columns = ("seed", "success", "goals", "time [s]", "ideal [s]", "clearance [mm]", "rest [s]", "wrap [deg]")
    cells = []
    for seed_run in result.runs:
        figures, clearance = seed_run.figures, f"{1e3 * seed_run.figures.min_needle_clearance_m:.3f}"
        times = (f"{figures.time_s:.1f}", f"{figures.ideal_time_s:.1f}", clearance, f"{figures.longest_rest_s:.2f}")
        counts = (str(seed_run.seed), "yes" if seed_run.success else "no", str(seed_run.goals_met))
        cells.append((*counts, *times, f"{figures.wrap_degrees:.0f}"))
    terminal.print(command.make_table(f"{result.title} (simulated)", columns, cells, left=0))
    terminal.log(f"results: {options.output}")
    return command.FAILED if result.died else command.DONE


@dataclass(frozen=True)
class CampaignResult:
    """What came of a campaign.

    Attributes:
        procedure: that was run.
        setup: what the nodes believe.
        camera: whether frames were rendered and tracked.
        latency: from a frame to the command that followed from it [s].
        runs: in the order of their seeds.
        died: seeds whose process ended early, and why.
    """

    procedure: Procedure
    setup: Setup
    camera: bool
    latency: float
    runs: list[run.RunResult] = field(default_factory=list)
    died: dict[int, str] = field(default_factory=dict)

    @property
    def successes(self) -> int:
        """Runs in which every goal was reached and every limit held."""
        return sum(outcome.success for outcome in self.runs)

    @property
    def title(self) -> str:
        """What was run, and how often it succeeded."""
        count = len(self.runs) + len(self.died)
        return f"{self.procedure.name} on {self.setup.name}: {self.successes} of {count} runs succeeded"

    def to_json(self) -> dict[str, Any]:
        """Return the figures as plain values, in the unit that each name ends with."""
        return {
            "procedure": self.procedure.name,
            "setup": self.setup.name,
            "camera": self.camera,
            "latency_s": self.latency,
            "simulated": True,
            "successes": self.successes,
            "runs": [outcome.to_json() for outcome in self.runs],
            "died": {str(seed): reason for seed, reason in self.died.items()},
        }


Task = tuple[int, Path | None]  # seed, and folder of the bag if any


def _run(campaign: CampaignResult, text: str, task: Task, log: Log, progress: Progress) -> tuple[run.RunResult, float]:
    """Run one seed, with the folder of its bag if any; return what came of it, and its processor time [s].

    Args:
        campaign: that it is of; what its other runs came to does not matter.
        text: of the setup's file, which a worker may not have.
        task: the seed and the folder.
        log: not called.
        progress: not called.
    """
    began, (seed, folder) = process_time(), task
    procedure, setup, camera = campaign.procedure, campaign.setup, campaign.camera
    if folder is not None and not folder.parents[1].is_dir():
        raise BagError(folder, "cannot be recorded: this worker does not have the output's folder")
    what = f"the closed loop in one process, procedure {procedure.name}, setup {setup.name}"
    what += f", latency {campaign.latency:g} s, seed {seed}"
    notes = {"setup": setup.name, SETUP_NOTE: text, "simulated": what}
    with ExitStack() as stack:
        bag = None if folder is None else stack.enter_context(BagWriter(folder, notes))
        recorder = None if bag is None else RunBag(bag, setup, camera=camera)
        variation = replace(run.vary(setup, seed), latency=campaign.latency)
        result = run.run_procedure(procedure, setup, variation, camera=camera, recorder=recorder)
    return result, process_time() - began


def draw_campaign(result: CampaignResult) -> bytes:
    """Return the picture of a campaign (PNG): figures by seed with their limits, and the last seconds of failed runs.

    Of each failed run the dish is drawn at its end, with the needle of the last seconds ever fainter, and in red where
    the needle's axis was closest to wall or shape. All of it is the simulation's ground truth.
    """
    from magnetosuture_thread.evaluation import plots  # late, as it imports matplotlib

    failed = [outcome for outcome in result.runs if not outcome.success][:12]  # the figures of all are in the table
    rows = -(-len(failed) // 4)
    height = 3.3 + 3.6 * rows
    figure = plots.make_figure(14.0, height)
    title, words = f"{result.title}, simulated", "green: succeeded, red: failed; dashed: limit"
    if failed:
        words += (
            "; below: failed runs at their end, magenta: thread, black: needle of the last seconds,\n"
            "red: where it was closest to wall or shape, orange: planned way of its middle, arrow: commanded velocity"
        )
    for text, below, size in ((title, 0.15, 14), (words, 0.5, 9.5)):
        figure.text(0.015, 1.0 - below / height, text, fontsize=size, color=plots.INK, va="top", parse_math=False)
    colours = [plots.GOOD if outcome.success else plots.BAD for outcome in result.runs]
    seeds = [outcome.seed for outcome in result.runs]
    keep_out = result.setup.coils.keep_out - run.KEEP_OUT_TOLERANCE
    panels = (
        ("clearance of the needle's axis [mm]", "min_needle_clearance_m", 1e3, keep_out),
        ("longest rest [s]", "longest_rest_s", 1.0, run.MAX_REST),
        ("depth of a node in wall or shape [µm]", "max_thread_penetration_m", 1e6, run.PENETRATION_TOLERANCE),
        ("peak tension [mN]", "max_tension_n", 1e3, np.nan),
    )
    for column, (title, name, scale, limit) in enumerate(panels):
        axes = figure.add_axes((0.035 + 0.25 * column, 1.0 - 2.8 / height, 0.2, 1.7 / height))
        axes.scatter(seeds, [scale * getattr(outcome.figures, name) for outcome in result.runs], c=colours, s=22)
        axes.axhline(scale * limit, color=plots.FAINT, linewidth=0.9, linestyle=(0, (4, 3)))
        axes.set_title(title, fontsize=9.5, color=plots.INK, loc="left")
        axes.set_xlabel("seed", fontsize=8.5, color=plots.INK, labelpad=1)
        plots.tidy(axes)
    for index, outcome in enumerate(failed):
        row, column = divmod(index, 4)
        axes = figure.add_axes((0.01 + 0.2475 * column, (3.6 * (rows - 1 - row) + 0.05) / height, 0.24, 3.1 / height))
        axes.set_title(f"seed {outcome.seed}: {shortened(outcome.reason, 38)}", fontsize=9, color=plots.INK, loc="left")
        _draw_failed_run(axes, outcome, result)
    return plots.to_png(figure)


def _draw_failed_run(axes: Axes, failed: run.RunResult, result: CampaignResult) -> None:
    """Draw the dish with a failed run's end, its last seconds, and where its needle was closest to wall or shape."""
    from magnetosuture_thread.evaluation import plots

    plots.draw_shapes(axes, result.setup.scene)
    for age, instant in enumerate(reversed(failed.last_instants)):
        axes.plot(*(1e3 * instant.axis.T), color=plots.INK, linewidth=2.4, alpha=0.8 * 0.55**age)
    if failed.closest_instant is not None:
        axes.plot(*(1e3 * failed.closest_instant.axis.T), color=plots.BAD, linewidth=1.2)
    if failed.last_instants:
        end = failed.last_instants[-1]
        axes.plot(*(1e3 * end.frame.thread.T), color=plots.PREDICTED, linewidth=1.4)
        if end.path is not None:
            axes.plot(*(1e3 * end.path.T), color="#f28c28", linewidth=1.0, linestyle=(0, (4, 2)))
        length = float(np.linalg.norm(end.axis[-1] - end.axis[0]))  # of the arrow at the allowed speed
        scale = 1e3 * length / result.procedure.limits[0].speed
        heading = np.array([math.cos(end.frame.heading), math.sin(end.frame.heading)])
        velocity = result.setup.coils.needle().kinematics.tip_velocity(heading, NeedleTwist(*end.frame.commanded))
        plots.draw_arrow(axes, 1e3 * end.axis[-1], scale * velocity)
