"""The command `magnetosuture calibrate`: fits a thread's parameters to recorded runs."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, cast

from magnetosuture_thread import MATERIALS, ConfigurationError, InvalidInputError
from magnetosuture_thread.calibration.parameters import choose_parameters
from magnetosuture_thread.calibration.recorded_run import BestSettings, RecordedRun, read_run, replay_pool
from magnetosuture_thread.calibration.result import (
    CalibrationResult,
    bag_table,
    calibration_lines,
    parameter_table,
    to_yaml,
)
from magnetosuture_thread.calibration.search import calibrate, unfinished_result
from magnetosuture_thread.commands.command import (
    DONE,
    Terminal,
    add_source,
    add_workers,
    bag_location,
    bag_selection,
    output_file,
    runs,
    write_json,
)
from magnetosuture_thread.commands.output import whole_file
from magnetosuture_thread.commands.recorded import BagInput, BagSelection, open_bag, setup_of_notes
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.setups import Setup
from magnetosuture_thread.thread_model.settings import ThreadModelSettings
from magnetosuture_thread.workers import Log, Progress

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from magnetosuture_thread.calibration.result import BagFit

READING_SHARE = 0.15  # share of the time for reading the bags, and tracking their frames
INTERRUPTED = 130  # exit code, as shells have it


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    runs(parser, run_calibrate)
    option = parser.add_argument
    option("bags", type=bag_location, nargs="+", metavar="BAG", help="an mcap file, or the folder of a bag, or its URL")
    option("--output", type=output_file, required=True, metavar="FILE", help="parameters to write (YAML)")
    option("--material", default="", metavar="NAME", help="where to start: silk, polyamide (default: the setup's)")
    option("--picture", type=output_file, metavar="FILE", help="picture to draw (.png; default: beside the output)")
    option("--json", type=output_file, metavar="FILE", help="write all figures to a file")
    option("--formulation", choices=("rod", "paper"), default="", help="(default: the setup's)")
    against = "fit to the measured thread (seen), or to ground truth (truth) of simulated bags (default: %(default)s)"
    option("--against", choices=("seen", "truth"), default="seen", help=against)
    option(
        "--parameters",
        type=lambda text: tuple(name.strip() for name in text.split(",") if name.strip()),
        default=(),
        metavar="A,B",
        help="settings of thread_model to fit (default: all that can be)",
    )
    note = ", one for each processor; the result does not depend on it"
    add_workers(parser, len(os.sched_getaffinity(0)), note)
    add_source(parser, "the bags")


def run_calibrate(options: argparse.Namespace, terminal: Terminal) -> int:
    """Fit the thread's parameters to recorded bags.

    The parameters are the thread's bending stiffness over the liquid's drag, the drag's anisotropy, the intrinsic
    curvature, how and where the thread is fixed to the needle; with --formulation paper, kappa and W_stiff. Each
    comes with a 95 % interval. Unidentifiable parameters are reported with the reason, and left as in the setup.
    Several bags are one fit, and each bag is also cross-validated against the rest.

    Bags with camera frames are tracked once; --source poses uses needle poses and measured threads as recorded. Only
    the ratio of stiffness and drag moves a thread, so elastic_modulus is written as the one that has the fitted ratio
    at the setup's viscosity.

    FILE gets the section thread_model, with what it rests on as comments. Put its lines into the setup's own section,
    or give a node both files. Beside it a picture shows residuals and intervals.

    Ctrl-C ends it at any moment: the best so far is written, marked as such and without intervals, and the exit code
    is 130. Before there is any, nothing is written, and it is 1.
    """
    chosen = FitOptions(**{field.name: getattr(options, field.name) for field in fields(FitOptions)})
    with terminal.progress("calibrate") as advance:
        fit = fit_bags(options.bags, chosen, cast(BagSelection, bag_selection(options)), terminal.log, advance)
    values = fit.result.to_json()
    write_json(options.json, values)
    fit.write(options.output, options.picture)
    terminal.print(parameter_table(values))
    terminal.print(bag_table(values))
    for line in calibration_lines(values):
        terminal.log(line)
    terminal.log(f"parameters: {options.output}")
    return DONE if fit.result.finished else INTERRUPTED


@dataclass(frozen=True)
class FitOptions:
    """What is fitted, from where, and by which processes.

    Attributes:
        material: a name of `MATERIALS`, or the beginning of one; the setup's if empty.
        formulation: rod or paper; the setup's if empty.
        against: what predictions are compared with, `seen` (measured) or `truth`.
        parameters: names of settings to fit; all that the formulation has if empty.
        workers: processes.
        scheduler: address of a Dask scheduler, whose workers replay the bags in place of those.
    """

    material: str = ""
    formulation: str = ""
    against: str = "seen"
    parameters: Sequence[str] = ()
    workers: int = 1
    scheduler: str = ""

    def settings_of(self, setup: Setup) -> ThreadModelSettings:
        """Return a setup's settings of the thread, with material and formulation where they are not empty.

        Another material than the setup's comes with its own diameter and modulus.

        Raises:
            ConfigurationError: there is no such material, or there are several.
        """
        settings = setup.model
        material = material_named(self.material) if self.material else settings.material
        if material != settings.material:
            settings = replace(settings, material=material, diameter=0.0, elastic_modulus=0.0)
        return replace(settings, formulation=self.formulation or settings.formulation)


@dataclass(frozen=True)
class ThreadFit:
    """A fit of a thread's parameters to bags.

    Attributes:
        result: parameters and figures.
        fits: of each run, to draw.
    """

    result: CalibrationResult
    fits: Sequence[BagFit]

    def write(self, output: Path, picture: Path | None = None) -> None:
        """Write the parameters as YAML, and a picture of fit and residuals (.png), beside them if None.

        Raises:
            BagError: a file cannot be written.
        """
        from magnetosuture_thread.calibration.plot import draw_calibration  # late, as it imports matplotlib

        with whole_file(output) as partial:
            partial.write_text(to_yaml(self.result), encoding="utf-8")
        with whole_file(picture or output.with_suffix(".png")) as partial:
            draw_calibration(partial, self.result, self.fits)


def calibrate_bags(
    bags: Sequence[Path],
    output: Path,
    *,
    material: str = "",
    formulation: str = "",
    against: str = "seen",
    parameters: Sequence[str] = (),
    workers: int = 1,
    scheduler: str = "",
    log: Log = lambda line: None,
    progress: Progress = lambda share: None,
    **selection: Unpack[BagSelection],
) -> CalibrationResult:
    """Fit a thread's parameters to bags, and write them as a file that `thread_model` loads, with a picture beside it.

    The file does not depend on the number of workers, nor on the time: the same bags give the same bytes. Ctrl-C ends
    the fit and writes the best so far, marked as such, once there is any.

    Args:
        bags: recorded runs of one thread.
        output: the YAML file to write.
        material: a name of `MATERIALS`, or the beginning of one; the setup's if empty.
        formulation: rod or paper; the setup's if empty.
        against: what predictions are compared with, `seen` (measured) or `truth`.
        parameters: names of settings to fit; all that the formulation has if empty.
        workers: processes.
        scheduler: address of a Dask scheduler, whose workers replay the bags in place of those.
        log: called with a line for a person at the end of each stage.
        progress: called with the share done, 0 to 1.
        selection: what of the bags is read.

    Raises:
        BagError: a bag cannot be used, or a file cannot be written.
        ConfigurationError: the setup, the material or a parameter cannot be used.
        InvalidInputError: the bags are of different threads.
    """
    options = FitOptions(material, formulation, against, parameters, workers, scheduler)
    fit = fit_bags(bags, options, selection, log, progress)
    fit.write(output)
    return fit.result


def fit_bags(
    bags: Sequence[Path], options: FitOptions, selection: BagSelection, log: Log, progress: Progress
) -> ThreadFit:
    """Fit a thread's parameters to bags; see `calibrate_bags`."""
    passages, settings = _read_runs(bags, options, selection, log, lambda share: progress(READING_SHARE * share))
    best = BestSettings()
    try:
        with replay_pool(passages, min(options.workers, os.cpu_count() or 1), options.scheduler) as run:
            found = calibrate(
                passages,
                settings,
                options.parameters,
                run_tasks=run,
                best=best,
                progress=lambda share: progress(READING_SHARE + (1.0 - READING_SHARE) * share),
                log=log,
            )
    except KeyboardInterrupt:
        if best.settings is None:
            raise
        log("interrupted; writing the best so far")
        found = unfinished_result(passages, settings, best)
    return ThreadFit(*found)


def _read_runs(
    bags: Sequence[Path], options: FitOptions, selection: BagSelection, log: Log, progress: Progress
) -> tuple[list[RecordedRun], ThreadModelSettings]:
    """Return recorded runs of one thread, and the settings of the thread that a fit starts from."""
    passages: list[RecordedRun] = []
    own: list[Setup] = []
    settings: ThreadModelSettings | None = None
    for index, path in enumerate(bags):

        def advance(share: float, index: int = index) -> None:
            progress((index + share) / len(bags))

        with open_bag(path, log, **selection) as given:
            its = options.settings_of(given.setup)
            choose_parameters(its.formulation, options.parameters)  # refuses wrong names before the bag is read
            own.append(_own_setup(given))
            for name in ("material", "thread_length"):
                value, expected = getattr(own[-1].model, name), getattr(own[0].model, name)
                if value != expected:
                    raise InvalidInputError(str(path), f"a thread with {name} {value}", f"{expected}, as in {bags[0]}")
            if settings is not None and its != settings:
                same = f"that of {bags[0]}, {own[0].name}; name one by --setup"
                raise InvalidInputError(str(path), f"setup {given.setup.name}", same)
            settings = its
            measured = given.observations(advance)
            simulated = given.recording.notes.get("simulated", "")
            try:
                passage = read_run(str(path), measured, its, options.against, simulated, given.setup.scene)
            except BagError:
                if problem := measured.thread_problem():
                    raise BagError(path, problem) from None
                raise
            passages.append(replace(passage, unverified=given.recording.unverified))
        advance(1.0)
    assert settings is not None
    return passages, settings


def material_named(text: str) -> str:
    """Return the name of the one material that begins so.

    >>> material_named("silk")
    'silk_6_0'

    Raises:
        ConfigurationError: there is none, or there are several.
    """
    found = [name for name in MATERIALS if name.startswith(text)]
    if text in MATERIALS:
        return text
    if len(found) != 1:
        which = ", ".join(found) if found else "no material"
        raise ConfigurationError("material", text, f"one of {', '.join(MATERIALS)}, or how it begins; {which} does so")
    return found[0]


def _own_setup(given: BagInput) -> Setup:
    """Return the setup that a bag was recorded with, or else the one that it is read with."""
    try:
        with TemporaryDirectory() as folder:
            return setup_of_notes(given.recording.notes, Path(folder))
    except ConfigurationError:
        return given.setup
