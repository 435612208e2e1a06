"""The command `campaign`: many runs of a procedure in the closed loop, and a folder with what came of them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from magnetosuture_thread import ConfigurationError
from magnetosuture_thread.campaign.run import RunResult, run_procedure
from magnetosuture_thread.campaign.variation import vary
from magnetosuture_thread.jobs.output import whole_folder
from magnetosuture_thread.planning.procedure import Procedure, read_procedure
from magnetosuture_thread.setups import Setup, read_setup
from magnetosuture_thread.workers import WorkerDiedError, WorkerPool

FILE = "campaign.json"

Log = Callable[[str], None]
Progress = Callable[[float], None]


@dataclass(frozen=True)
class CampaignResult:
    """What came of a campaign.

    Attributes:
        procedure: its name.
        setup: its name.
        camera: whether frames were rendered and tracked.
        follower: whether the setup's path follower ran in place of the procedure.
        runs: in the order of their seeds.
        died: seeds whose process ended early, and why.
    """

    procedure: str
    setup: str
    camera: bool
    follower: bool
    runs: tuple[RunResult, ...]
    died: dict[int, str]

    @property
    def successes(self) -> int:
        """Runs in which every goal was reached and every limit held."""
        return sum(run.success for run in self.runs)

    def to_json(self) -> dict[str, Any]:
        """Return the figures as plain values, in SI units unless a name ends otherwise."""
        runs = [{key: value for key, value in asdict(run).items() if key != "last_frames"} for run in self.runs]
        return {
            "procedure": self.procedure,
            "setup": self.setup,
            "camera": self.camera,
            "follower": self.follower,
            "simulated": True,
            "successes": self.successes,
            "runs": runs,
            "died": {str(seed): reason for seed, reason in self.died.items()},
        }


def simulate_campaign(
    name: str,
    seeds: range,
    output: Path,
    *,
    setup: str = "",
    camera: bool = False,
    follower: bool = False,
    workers: int = 1,
    log: Log = lambda text: None,
    progress: Progress = lambda share: None,
) -> CampaignResult:
    """Run a procedure once for each seed, and write `campaign.json` into a new folder.

    Args:
        name: of the procedure, or the path of its file.
        seeds: of the runs.
        output: folder to make.
        setup: name or file of the setup; empty for the procedure's own.
        camera: whether frames are rendered and tracked, else the tracker's noise is added to the truth.
        follower: whether the setup's path follower runs in place of the procedure, for comparison.
        workers: processes.
        log: called with a line for a person at each run's end.
        progress: called with the share done, 0 to 1.

    Raises:
        ConfigurationError: procedure or setup cannot be used, or do not fit each other.
        BagError: the output exists, or cannot be written.
    """
    procedure = read_procedure(name)
    if not (setup or procedure.setup):
        raise ConfigurationError("--setup", "nothing", f"a setup, as the procedure {procedure.name} names none")
    used = read_setup(setup or procedure.setup)
    runs: dict[int, RunResult] = {}
    died: dict[int, str] = {}
    with whole_folder(output) as folder, WorkerPool(partial(_run, procedure, used, camera, follower), workers) as pool:
        for index, found in pool.run(list(seeds), log, progress):
            seed = seeds[index]
            if isinstance(found, WorkerDiedError):
                died[seed] = str(found)
                log(f"seed {seed}: {found}")
                continue
            runs[seed] = found
            log(f"seed {seed}: {'success' if found.success else found.reason}")
        ordered = tuple(runs[seed] for seed in seeds if seed in runs)
        result = CampaignResult(procedure.name, used.name, camera, follower, ordered, died)
        (folder / FILE).write_text(json.dumps(result.to_json(), indent=1) + "\n", encoding="utf-8")
    return result


def _run(
    procedure: Procedure, setup: Setup, camera: bool, follower: bool, seed: int, log: Log, progress: Progress
) -> RunResult:
    """Run one seed; the last seconds of the frames stay in this process."""
    found = run_procedure(procedure, setup, vary(setup, seed), camera=camera, follower=follower)
    return replace(found, last_frames=())
