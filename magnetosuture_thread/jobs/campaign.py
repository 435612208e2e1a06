"""The command `campaign`: many runs of a procedure in the closed loop, and a folder with what came of them."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import process_time
from typing import Any

from magnetosuture_thread import ConfigurationError
from magnetosuture_thread.campaign.bag import RunBag
from magnetosuture_thread.campaign.loop import START
from magnetosuture_thread.campaign.page import CampaignDetails, write_campaign_page
from magnetosuture_thread.campaign.run import RunResult, check_run, run_procedure, vary
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.jobs.output import whole_folder
from magnetosuture_thread.jobs.replay_inputs import SETUP_NOTE
from magnetosuture_thread.planning.procedure import Procedure, read_procedure
from magnetosuture_thread.setups import Setup, read_procedure_setup
from magnetosuture_thread.workers import WorkerDiedError, make_runner

FILE, PAGE = "campaign.json", "campaign.html"
BAGS = "bags"  # folder of the bags in the output

Log = Callable[[str], None]
Progress = Callable[[float], None]


@dataclass(frozen=True)
class CampaignResult:
    """What came of a campaign.

    Attributes:
        procedure: its name.
        setup: its name.
        camera: whether frames were rendered and tracked.
        runs: in the order of their seeds.
        died: seeds whose process ended early, and why.
    """

    procedure: str
    setup: str
    camera: bool
    runs: tuple[RunResult, ...]
    died: dict[int, str]

    @property
    def successes(self) -> int:
        """Runs in which every goal was reached and every limit held."""
        return sum(run.success for run in self.runs)

    def to_json(self) -> dict[str, Any]:
        """Return the figures as plain values, in the unit that each name ends with."""
        return {
            "procedure": self.procedure,
            "setup": self.setup,
            "camera": self.camera,
            "simulated": True,
            "successes": self.successes,
            "runs": [run.to_json() for run in self.runs],
            "died": {str(seed): reason for seed, reason in self.died.items()},
        }


@dataclass(frozen=True)
class _Task:
    """A run to make.

    Attributes:
        seed: of the run.
        bag: folder of its bag; None for none.
    """

    seed: int
    bag: Path | None


def simulate_campaign(
    name: str,
    seeds: range,
    output: Path,
    *,
    setup: str = "",
    camera: bool = False,
    bags: Collection[int] = (),
    workers: int = 1,
    scheduler: str = "",
    log: Log = lambda text: None,
    progress: Progress = lambda share: None,
) -> CampaignResult:
    """Run a procedure once for each seed, and write `campaign.json`, a report and bags into a new folder.

    The files are the same for the same seeds, however many processes run them.

    Args:
        name: of the procedure, or the path of its file.
        seeds: of the runs.
        output: folder to make.
        setup: name or file of the setup; empty for the procedure's own.
        camera: whether frames are rendered and tracked, else the tracker's noise is added to the truth.
        bags: seeds whose runs are recorded as bags.
        workers: processes.
        scheduler: address of a Dask scheduler, whose workers make the runs in place of those; for bags they must have
            the output's folder too.
        log: called with a line for a person at each run's end.
        progress: called with the share done, 0 to 1.

    Raises:
        ConfigurationError: procedure or setup cannot be used, or do not fit each other, or a bag is of no run.
        PlanningError: there is no way to a goal from where the first run begins.
        BagError: the output exists, or cannot be written.
    """
    procedure = read_procedure(name)
    if not set(bags) <= set(seeds):
        raise ConfigurationError("--bags", sorted(set(bags) - set(seeds)), f"seeds of {seeds[0]} to {seeds[-1]}")
    used = read_procedure_setup(procedure, setup)
    check_run(procedure, used, vary(used, seeds[0]))
    runs: dict[int, RunResult] = {}
    died: dict[int, str] = {}
    folders = {seed: f"{BAGS}/seed_{seed}" for seed in sorted(set(bags))}
    work = partial(_run, procedure, used, used.path.read_text(encoding="utf-8"), camera)
    with whole_folder(output) as folder, make_runner(work, workers, scheduler) as runner:
        tasks = [_Task(seed, folder / folders[seed] if seed in folders else None) for seed in seeds]
        for index, found in runner.run(tasks, log, progress):
            seed = seeds[index]
            if isinstance(found, WorkerDiedError):
                died[seed] = str(found)
                log(f"seed {seed}: {found}")
                continue
            runs[seed], used_time = found
            outcome = "success" if runs[seed].success else runs[seed].reason
            speed = runs[seed].simulated_s / used_time
            log(f"seed {seed}: {outcome} ({speed:.1f} times real time)")
        ordered = tuple(runs[seed] for seed in seeds if seed in runs)
        result = CampaignResult(procedure.name, used.name, camera, ordered, died)
        (folder / FILE).write_text(json.dumps(result.to_json(), indent=1) + "\n", encoding="utf-8")
        details = CampaignDetails(procedure, used, camera, died, folders)
        (folder / PAGE).write_text(write_campaign_page(details, ordered), encoding="utf-8")
    return result


def _run(
    procedure: Procedure,
    setup: Setup,
    text: str,
    camera: bool,
    task: _Task,
    log: Log,
    progress: Progress,
) -> tuple[RunResult, float]:
    """Run one seed; return what came of it, and the processor time that it took [s]."""
    began = process_time()
    if task.bag is not None and not task.bag.parents[1].is_dir():
        raise BagError(task.bag, "cannot be recorded: this worker does not have the output's folder")
    what = f"the closed loop in one process, procedure {procedure.name}, setup {setup.name}, seed {task.seed}"
    notes = {"setup": setup.name, SETUP_NOTE: text, "simulated": what}
    with nullcontext() if task.bag is None else RunBag(task.bag, setup, notes, START, camera=camera) as bag:
        variation = vary(setup, task.seed)
        found = run_procedure(procedure, setup, variation, camera=camera, recorder=bag)
    return found, process_time() - began
