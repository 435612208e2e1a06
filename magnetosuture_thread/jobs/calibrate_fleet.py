"""The job `magnetosuture calibrate --fleet`: one thread material from many bags, each fitted by itself."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from magnetosuture_thread import ConfigurationError, InvalidInputError, MagnetosutureError
from magnetosuture_thread.calibration.fleet import FleetBag, FleetResult, calibrate_fleet
from magnetosuture_thread.calibration.output import fleet_yaml
from magnetosuture_thread.calibration.parameters import STIFFNESS_OVER_DRAG
from magnetosuture_thread.calibration.result import CalibrationResult
from magnetosuture_thread.calibration.search import calibrate as fit
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.jobs.calibrate import read_runs, write_figures
from magnetosuture_thread.jobs.output import whole_file
from magnetosuture_thread.jobs.replay_inputs import BagSelection, Log, Progress
from magnetosuture_thread.texts import one_line
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

    Each bag is read and fitted by itself, on a worker. The file does not depend on their number. A bag that cannot be
    read or fitted, or that ends its worker, is left out: the result and the file have the reason.

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
        BagError: a file cannot be written.
        ConfigurationError: the setup, the material or a parameter cannot be used.
        InvalidInputError: the bags are of different threads, or fewer than `MIN_BAGS` are left that tell the
            stiffness; it names the others with their reasons.
    """
    if parameters and STIFFNESS_OVER_DRAG.setting not in parameters:
        expected = f"{STIFFNESS_OVER_DRAG.setting} among them, which the bags share"
        raise ConfigurationError("--parameters", ",".join(parameters), expected)
    found: dict[int, CalibrationResult | FleetBag] = {}
    work = partial(_fit_bag, material, formulation, against, tuple(parameters), selection)
    with make_runner(work, workers, scheduler) as runner:
        for index, result in runner.run(list(bags), log, progress):
            if isinstance(result, WorkerDiedError):
                result = _unfitted(bags[index], str(result))
            if isinstance(result, FleetBag):
                log(f"{result.name} is left out: {result.reason}")
            found[index] = result
    results = [found[index] for index in range(len(bags))]
    fitted = [(path, each) for path, each in zip(bags, results, strict=True) if isinstance(each, CalibrationResult)]
    for path, each in fitted:
        if each.start != fitted[0][1].start:
            raise InvalidInputError(str(path), "another setup", f"that of {fitted[0][0]}; name one by --setup")
        if each.start.formulation != "rod":
            raise ConfigurationError(
                "--formulation", each.start.formulation, "rod: the other has no stiffness over drag"
            )
    fleet = calibrate_fleet(results)
    start = fitted[0][1].start
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
) -> CalibrationResult | FleetBag:
    try:
        runs, settings = read_runs(
            [bag], material, formulation, against, parameters, log, lambda share: progress(0.5 * share), selection
        )
        return fit(runs, settings, parameters, progress=lambda share: progress(0.5 + 0.5 * share))[0]
    except ConfigurationError:  # of the call, or for --setup to mend
        raise
    except BagError as error:
        return _unfitted(bag, error.problem if error.path == str(bag) else str(error))
    except MagnetosutureError as error:
        return _unfitted(bag, str(error))
    except Exception as error:  # A mistake of ours, or of a package, or a network's failure: this bag's alone.
        return _unfitted(bag, f"{type(error).__name__}: {error}")


def _unfitted(bag: Path, reason: str) -> FleetBag:
    return FleetBag.unfitted(str(bag), one_line(" ".join(reason.split())))
