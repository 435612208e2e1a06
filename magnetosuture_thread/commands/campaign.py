"""The command `magnetosuture campaign`: many runs of a procedure in the closed loop, and what came of them.

The page loads nothing and runs no script. Its pictures are SVG: lengths in mm, y upwards.
"""

from __future__ import annotations

import argparse
import json
import math
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from statistics import median
from time import process_time
from typing import Any

import numpy as np

from magnetosuture_thread import ConfigurationError, Disc, Polygon, Scene
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.commands import command
from magnetosuture_thread.evaluation.page import page_style, read_source, read_template
from magnetosuture_thread.evaluation.recorded import SETUP_NOTE
from magnetosuture_thread.evaluation.workers import Log, Progress, TaskRunner, WorkerDiedError
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.planning.procedure import Procedure, read_procedure
from magnetosuture_thread.rig import campaign as run
from magnetosuture_thread.rig.closed_loop import RunBag
from magnetosuture_thread.rig.setups import Setup, read_procedure_setup
from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.settings.files import whole_folder

REASONS = {
    "min_needle_clearance_m": "the needle came too close to wall or shape",
    "max_thread_penetration_m": "a node of the thread was in wall or shape",
    "longest_rest_s": "the needle rested too long",
    "max_tension_n": "the thread's tension was too high",
    "max_friction_nodes": "too many nodes were under friction",
    "time_s": "it took too long",
}


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    command.runs(parser, run_campaign)
    option = parser.add_argument
    option("procedure", metavar="PROCEDURE", help="a procedure's name or YAML file")
    count, first = command.count_argument("runs", 1, 100_000), command.count_argument("a seed", 0, 2**31 - 1)
    option("--seeds", type=count, default=1, metavar="N", help="runs (default: 1)")
    option("--first-seed", type=first, default=0, metavar="K", help="seed of the first run (default: 0)")
    option("--setup", default="", metavar="NAME", help="a setup's name or YAML file (default: the procedure's)")
    option("--camera", action="store_true", help="render and track frames (default: add the tracker's noise)")
    bags = "seeds whose runs are recorded as bags (default: none)"
    option("--bags", type=first, nargs="+", default=[], metavar="SEED", help=bags)
    command.add_workers(parser)
    option("--output", type=Path, required=True, metavar="DIR", help="folder to make")


def run_campaign(options: argparse.Namespace, terminal: command.Terminal) -> int:
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
    seeds, bags = range(options.first_seed, options.first_seed + options.seeds), sorted(set(options.bags))
    procedure = read_procedure(options.procedure)
    if not set(bags) <= set(seeds):
        raise ConfigurationError("--bags", sorted(set(bags) - set(seeds)), f"seeds of {seeds[0]} to {seeds[-1]}")
    setup = read_procedure_setup(procedure, options.setup)
    run.check_run(procedure, setup, run.vary(setup, seeds[0]))
    result = CampaignResult(procedure, setup, options.camera, bags={seed: f"bags/seed_{seed}" for seed in bags})
    work = partial(_run, procedure, setup, setup.path.read_text(encoding="utf-8"), options.camera)
    with (
        terminal.progress("campaign") as advance,
        whole_folder(options.output) as folder,
        TaskRunner(work, options.workers, options.scheduler) as runner,
    ):
        tasks = [(seed, folder / result.bags[seed] if seed in bags else None) for seed in seeds]
        found: dict[int, run.RunResult] = {}
        for index, made in runner.run(tasks, terminal.log, advance):
            seed = seeds[index]
            if isinstance(made, WorkerDiedError):
                result.died[seed] = str(made)
                terminal.log(f"seed {seed}: {made}")
                continue
            found[seed], used_time = made
            speed = found[seed].simulated_s / used_time
            terminal.log(f"seed {seed}: {found[seed].reason or 'success'} ({speed:.1f} times real time)")
        result.runs.extend(found[seed] for seed in seeds if seed in found)
        (folder / "campaign.json").write_text(json.dumps(result.to_json(), indent=1) + "\n", encoding="utf-8")
        (folder / "campaign.html").write_text(write_page(result), encoding="utf-8")
    title = f"{result.procedure.name} on {result.setup.name}: {result.successes} of {len(seeds)} runs succeeded"
    columns = ("seed", "success", "goals", "time [s]", "ideal [s]", "clearance [mm]", "rest [s]", "wrap [deg]")
    cells = []
    for each in result.runs:
        figures, clearance = each.figures, 1e3 * each.figures.min_needle_clearance_m
        times = (f"{figures.time_s:.1f}", f"{figures.ideal_time_s:.1f}", f"{clearance:.3f}")
        others = (f"{figures.longest_rest_s:.2f}", f"{figures.wrap_degrees:.0f}")
        cells.append((str(each.seed), "yes" if each.success else "no", str(each.goals_met), *times, *others))
    terminal.print(command.make_table(f"{title} (simulated)", columns, cells, left=0))
    terminal.print(f"report: {options.output / 'campaign.html'}", soft_wrap=True)
    return command.FAILED if result.died else command.DONE


@dataclass(frozen=True)
class CampaignResult:
    """What came of a campaign.

    Attributes:
        procedure: that was run.
        setup: what the nodes believe.
        camera: whether frames were rendered and tracked.
        runs: in the order of their seeds.
        died: seeds whose process ended early, and why.
        bags: seeds of which there is a bag, with its folder beside the page.
    """

    procedure: Procedure
    setup: Setup
    camera: bool
    runs: list[run.RunResult] = field(default_factory=list)
    died: dict[int, str] = field(default_factory=dict)
    bags: dict[int, str] = field(default_factory=dict)

    @property
    def successes(self) -> int:
        """Runs in which every goal was reached and every limit held."""
        return sum(each.success for each in self.runs)

    @property
    def min_clearance(self) -> float:
        """Clearance of the needle's axis that a run has to keep [m]."""
        return self.setup.coils.keep_out - run.KEEP_OUT_TOLERANCE

    def to_json(self) -> dict[str, Any]:
        """Return the figures as plain values, in the unit that each name ends with."""
        return {
            "procedure": self.procedure.name,
            "setup": self.setup.name,
            "camera": self.camera,
            "simulated": True,
            "successes": self.successes,
            "runs": [each.to_json() for each in self.runs],
            "died": {str(seed): reason for seed, reason in self.died.items()},
        }


def _run(
    procedure: Procedure,
    setup: Setup,
    text: str,
    camera: bool,
    task: tuple[int, Path | None],
    log: Log,
    progress: Progress,
) -> tuple[run.RunResult, float]:
    """Run one seed, with the folder of its bag if any; return what came of it, and its processor time [s]."""
    began, (seed, folder) = process_time(), task
    if folder is not None and not folder.parents[1].is_dir():
        raise BagError(folder, "cannot be recorded: this worker does not have the output's folder")
    what = f"the closed loop in one process, procedure {procedure.name}, setup {setup.name}, seed {seed}"
    notes = {"setup": setup.name, SETUP_NOTE: text, "simulated": what}
    with ExitStack() as stack:
        bag = None if folder is None else stack.enter_context(BagWriter(folder, notes))
        recorder = None if bag is None else RunBag(bag, setup, camera=camera)
        found = run.run_procedure(procedure, setup, run.vary(setup, seed), camera=camera, recorder=recorder)
    return found, process_time() - began


def write_page(result: CampaignResult) -> str:
    """Return the report as a page of HTML, with pictures of failed runs."""
    rows: list[dict[str, Any]] = [
        {
            "result": each,
            "broken": set(each.figures.beyond_limits(result.setup.coils.keep_out)),
            "pictures": [],
            "closest": None,
        }
        for each in result.runs
    ]
    failed = [row for row in rows if not row["result"].success]
    for row in failed[:200]:  # of the others the figures are in the table
        _add_pictures(row, result)
    reasons: dict[str, list[int]] = {}
    for row in failed:
        not_reached = [] if row["result"].reached else ["not all goals reached"]
        for why in (*not_reached, *(REASONS[name] for name in sorted(row["broken"]))):
            reasons.setdefault(why, []).append(row["result"].seed)
    scene, reached = result.setup.scene, [each.figures for each in result.runs if each.reached]
    return read_template(__package__, "campaign.html", {"spaced": lambda text: text.replace("_", " ")}).render(
        details=result,
        runs=rows,
        failed=[row for row in failed if row["pictures"]],
        left_out=len(failed[200:]),
        reached=len(reached),
        ratios=[each.time_s / each.ideal_time_s for each in reached if each.ideal_time_s > 0.0],
        median=median,
        reasons=sorted(reasons.items(), key=lambda each: -len(each[1])),
        shapes=[{"kind": shape.kind, "path": _outline(shape.geometry)} for shape in scene.shapes],
        dish_radius=1e3 * scene.dish.radius,
        needle_width=1e3 * result.setup.rig.needle_width,
        halo_width=2e3 * result.min_clearance,
        limits=run,
        style=page_style() + read_source(__package__, "campaign.css"),
    )


def _add_pictures(row: dict[str, Any], result: CampaignResult) -> None:
    """Add the pictures of a failed run: the whole dish at its end, its last seconds, and its closest instant.

    The closest is there if the needle came too close, before the last seconds.
    """
    instants, closest = row["result"].last_instants, row["result"].closest_instant
    if not instants:
        return
    scene, speed = result.setup.scene, result.procedure.limits[0].speed
    row["pictures"] = [_picture(instants[-1], scene, speed, overview=True)]
    row["pictures"] += [_picture(instant, scene, speed) for instant in instants]
    if closest and closest.frame.time < instants[0].frame.time and "min_needle_clearance_m" in row["broken"]:
        row["closest"] = _picture(closest, scene, speed)


def _picture(instant: run.RunInstant, scene: Scene, speed: float, *, overview: bool = False) -> dict[str, Any]:
    """Return an instant as an SVG shows it, the whole dish or the surroundings of the needle.

    Args:
        instant: to show.
        scene: around it.
        speed: at which the arrow of the command has the needle's length [m/s].
        overview: whether the whole dish is shown.
    """
    axis, frame = instant.axis, instant.frame
    length = float(np.linalg.norm(axis[-1] - axis[0]))
    # A close-up is four needles wide, and 8 mm at least.
    half, centre = 0.5 * max(4.0 * length, 8e-3), 0.5 * (axis[0] + axis[-1])
    if overview:
        half, centre = 1.02 * scene.dish.radius, np.zeros(2)
    command: list[float] = []
    if math.hypot(*frame.commanded) > 1e-6:
        command = np.round(1e3 * np.append(axis[-1], axis[-1] + length / speed * frame.commanded), 3).tolist()
    return {
        "instant": instant,
        "box": np.round(1e3 * np.append(centre - half, (2.0 * half, 2.0 * half)), 3).tolist(),
        "thread": _points(frame.thread),
        "needle": _points(axis),
        "path": "" if instant.path is None else _points(instant.path),
        "command": command,
        "is_overview": overview,
    }


def _points(vertices: Points) -> str:
    return " ".join(f"{1e3 * x:.3f},{1e3 * y:.3f}" for x, y in vertices.tolist())


def _outline(geometry: Disc | Polygon) -> str:
    """Return a shape's outline and holes as the path of an SVG."""
    if isinstance(geometry, Disc):
        x, y, r = (1e3 * value for value in (*geometry.centre, geometry.radius))
        return f"M{x - r:.3f},{y:.3f}a{r:.3f},{r:.3f} 0 1 0 {2 * r:.3f},0a{r:.3f},{r:.3f} 0 1 0 {-2 * r:.3f},0z"
    return "".join(f"M{_points(ring).replace(' ', 'L')}z" for ring in geometry.rings)
