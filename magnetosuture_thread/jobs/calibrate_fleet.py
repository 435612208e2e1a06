"""The job `magnetosuture calibrate --fleet`: one thread material from many bags, each fitted by itself."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from magnetosuture_thread import ConfigurationError, InvalidInputError
from magnetosuture_thread.calibration.fleet import FleetResult, calibrate_fleet
from magnetosuture_thread.calibration.output import fleet_yaml
from magnetosuture_thread.calibration.parameters import STIFFNESS_OVER_DRAG
from magnetosuture_thread.calibration.result import CalibrationResult
from magnetosuture_thread.calibration.search import calibrate as fit
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.jobs.calibrate import read_runs, write_figures
from magnetosuture_thread.jobs.output import whole_file
from magnetosuture_thread.jobs.replay_inputs import BagSelection, Log, Progress
from magnetosuture_thread.workers import WorkerDiedError, make_runner

if TYPE_CHECKING:
    from typing_extensions import Unpack


def calibrate_fleet_bags(
    bags: Sequence[Path],
    output: Path,
    *,
    material: str = "",
    formulation: str = "",
    against: str = "seen",
    parameters: Sequence[str] = (),
    workers: int = 1,
    scheduler: str = "",
    json_file: Path | None = None,
    log: Log = lambda line: None,
    progress: Progress = lambda share: None,
    **selection: Unpack[BagSelection],
) -> FleetResult:
    """Fit one thread's stiffness over drag, and the viscosity of each bag's liquid; see `calibration.fleet`.

    Each bag is read and fitted by itself, on a worker. The file does not depend on their number.

    Args:
        bags: recorded runs of one thread, in a liquid whose viscosity may differ from bag to bag.
        output: the YAML file to write.
        material: a name of `MATERIALS`, or the beginning of one; the setup's if empty.
        formulation: rod; the setup's if empty.
        against: what predictions are compared with, `seen` (measured) or `truth`.
        parameters: names of settings to fit to each bag, the elastic modulus among them; all if empty.
        workers: processes.
        scheduler: address of a Dask scheduler, whose workers read and fit the bags in place of those.
        json_file: to write all figures to, if any.
        log: called with a line for a person.
        progress: called with the share done, 0 to 1.
        selection: what of the bags is read.

    Raises:
        BagError: a bag cannot be used, or a file cannot be written.
        ConfigurationError: the setup, the material or a parameter cannot be used.
        InvalidInputError: the bags are of different threads, or too few tell the stiffness.
    """
    if parameters and STIFFNESS_OVER_DRAG.setting not in parameters:
        expected = f"{STIFFNESS_OVER_DRAG.setting} among them, which the bags share"
        raise ConfigurationError("--parameters", ",".join(parameters), expected)
    found: dict[int, CalibrationResult] = {}
    work = partial(_fit_bag, material, formulation, against, tuple(parameters), selection)
    with make_runner(work, workers, scheduler) as runner:
        for index, result in runner.run(list(bags), log, progress):
            if isinstance(result, WorkerDiedError):
                raise BagError(bags[index], f"could not be fitted: {result}")
            found[index] = result
    results = [found[index] for index in range(len(bags))]
    start = results[0].start
    for path, result in zip(bags, results, strict=True):
        if result.start != start:
            raise InvalidInputError(str(path), "another setup", f"that of {bags[0]}; name one by --setup")
    if start.formulation != "rod":
        raise ConfigurationError("--formulation", start.formulation, "rod: the other has no stiffness over drag")
    fleet = calibrate_fleet(results)
    with whole_file(output) as file:
        file.write_text(fleet_yaml(fleet, start), encoding="utf-8")
    if json_file is not None:
        write_figures(json_file, fleet.to_json())
    return fleet


def _fit_bag(
    material: str,
    formulation: str,
    against: str,
    parameters: Sequence[str],
    selection: BagSelection,
    bag: Path,
    log: Log,
    progress: Progress,
) -> CalibrationResult:
    runs, settings = read_runs(
        [bag], material, formulation, against, parameters, log, lambda share: progress(0.5 * share), selection
    )
    return fit(runs, settings, parameters, progress=lambda share: progress(0.5 + 0.5 * share))[0]
