"""The command that runs a procedure many times in the closed loop: campaign."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.table import Table

from magnetosuture_thread.cli.arguments import DONE, FAILED, Subparsers, add_scheduler, command, count_argument
from magnetosuture_thread.cli.terminal import make_console, make_log, progress


def add(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = command(subparsers, "campaign", run_campaign)
    option = parser.add_argument
    option("procedure", metavar="PROCEDURE", help="a procedure's name or YAML file")
    option("--seeds", type=count_argument("runs", 1, 100_000), default=1, metavar="N", help="runs (default: 1)")
    first = count_argument("a seed", 0, 2**31 - 1)
    option("--first-seed", type=first, default=0, metavar="K", help="seed of the first run (default: 0)")
    option("--setup", default="", metavar="NAME", help="a setup's name or YAML file (default: the procedure's)")
    option("--camera", action="store_true", help="render and track frames (default: add the tracker's noise)")
    bags = "seeds whose runs are recorded as bags (default: none)"
    option("--bags", type=first, nargs="+", default=[], metavar="SEED", help=bags)
    workers = count_argument("processes", 1, 256)
    option("--workers", type=workers, default=1, metavar="W", help="processes (default: 1)")
    add_scheduler(parser)
    option("--output", type=Path, required=True, metavar="DIR", help="folder to make")


def run_campaign(options: argparse.Namespace) -> int:
    """Run an autonomous procedure in the simulated closed loop, once for each seed.

    Rig, the tracker's noise or the camera and tracker themselves, estimator, planner and coil bridge run in one process
    on simulated time, without ROS; a seed always gives the same run. Each seed varies start, viscosity, bending
    stiffness, coils, friction and noise; the nodes are told nothing of it. DIR, which must not exist, gets
      campaign.json   how many runs succeeded, and the figures of each
      campaign.html   the same as a page, with pictures of the last seconds of each run that failed
      bags/seed_N     for each seed of --bags: what all nodes would publish, with the ground truth; `replay` takes it
    With --scheduler and --bags, DIR must be a folder that all workers have.
    A run succeeds if all goals are reached and all limits hold. All of it is simulated.
    """
    from magnetosuture_thread.jobs import campaign as job

    console = make_console()
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    with progress(console, "campaign") as advance:
        result = job.simulate_campaign(
            options.procedure,
            seeds,
            options.output,
            setup=options.setup,
            camera=options.camera,
            bags=options.bags,
            workers=options.workers,
            scheduler=options.scheduler,
            log=make_log(console),
            progress=advance,
        )
    title = f"{result.procedure} on {result.setup}: {result.successes} of {len(seeds)} runs succeeded (simulated)"
    table = Table(title=title, title_justify="left", title_style="bold")
    for name in ("seed", "success", "goals", "time [s]", "ideal [s]", "clearance [mm]", "rest [s]", "wrap [deg]"):
        table.add_column(name, justify="right", no_wrap=True)
    for run in result.runs:
        figures = run.figures
        table.add_row(
            str(run.seed),
            "yes" if run.success else "no",
            str(run.goals_met),
            f"{figures.time_s:.1f}",
            f"{figures.ideal_time_s:.1f}",
            f"{1e3 * figures.min_needle_clearance_m:.3f}",
            f"{figures.longest_rest_s:.2f}",
            f"{figures.wrap_degrees:.0f}",
        )
    console.print(table)
    console.print(f"report: {options.output / job.PAGE}", soft_wrap=True)
    return FAILED if result.died else DONE
