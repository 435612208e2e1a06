"""The command `magnetosuture calibrate`: fits a thread's parameters to recorded runs."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from dataclasses import replace
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
from magnetosuture_thread.commands import command
from magnetosuture_thread.commands.output import whole_file
from magnetosuture_thread.commands.recorded import BagInput, BagSelection, open_bag, setup_of_notes
from magnetosuture_thread.estimator.settings import ThreadModelSettings
from magnetosuture_thread.rig.setups import Setup
from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.workers import Log, Progress

if TYPE_CHECKING:
    from typing_extensions import Unpack


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    command.runs(parser, run_calibrate)
    option, file = parser.add_argument, command.output_file
    bags = "an mcap file, or the folder of a bag, or its URL"
    option("bags", type=command.bag_location, nargs="+", metavar="BAG", help=bags)
    option("--output", type=file, required=True, metavar="FILE", help="parameters to write (YAML)")
    option("--material", default="", metavar="NAME", help="where to start: silk, polyamide (default: the setup's)")
    option("--picture", type=file, metavar="FILE", help="picture to draw (.png; default: beside the output)")
    option("--json", type=file, metavar="FILE", help="write all figures to a file")
    option("--formulation", choices=("rod", "paper"), default="", help="(default: the setup's)")
    against = "fit to the measured thread (seen), or to ground truth (truth) of simulated bags (default: %(default)s)"
    option("--against", choices=("seen", "truth"), default="seen", help=against)
    text = "settings of thread_model to fit (default: all that can be)"
    option("--parameters", type=_names, default=(), metavar="A,B", help=text)
    note = ", one for each processor; the result does not depend on it"
    command.add_workers(parser, len(os.sched_getaffinity(0)), note)
    command.add_source(parser, "the bags")


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


def run_calibrate(options: argparse.Namespace, terminal: command.Terminal) -> int:
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
    names = ("bags", "output", "picture", "material", "formulation", "against", "parameters", "workers", "scheduler")
    given = {**command.given(options, *names), **command.bag_selection(options)}
    with terminal.progress("calibrate") as advance:
        result = calibrate_bags(**given, log=terminal.log, progress=advance)
    values = result.to_json()
    command.write_json(options.json, values)
    terminal.print(parameter_table(values))
    terminal.print(bag_table(values))
    for line in calibration_lines(values):
        terminal.log(line)
    terminal.log(f"parameters: {options.output}")
    return command.DONE if result.finished else 130  # as shells have it


class FitSelection(BagSelection, total=False):
    """What of the bags is read, and `picture`: of the fit and its residuals (.png); beside the output if None."""

    picture: Path | None


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
    **selection: Unpack[FitSelection],
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
        selection: what of the bags is read, and `picture`.

    Raises:
        BagError: a bag cannot be used, or a file cannot be written.
        ConfigurationError: the setup, the material or a parameter cannot be used.
        InvalidInputError: the bags are of different threads.
    """
    from magnetosuture_thread.calibration.plot import draw_calibration  # late, as it imports matplotlib

    picture = selection.pop("picture", None)
    reading = 0.15  # share of the time for reading the bags, and tracking their frames
    passages: list[RecordedRun] = []
    first: tuple[str, Setup, ThreadModelSettings] | None = None  # bag, its own setup, and where the fit starts
    for index, path in enumerate(bags):

        def advance(share: float, index: int = index) -> None:
            progress(reading * (index + share) / len(bags))

        with open_bag(path, log, **cast(BagSelection, selection)) as given:
            settings = thread_settings(given.setup, material, formulation)
            choose_parameters(settings.formulation, parameters)  # refuses wrong names before the bag is read
            own = _own_setup(given)
            first = first or (str(path), own, settings)
            for name in ("material", "thread_length"):
                value, expected = getattr(own.model, name), getattr(first[1].model, name)
                if value != expected:
                    raise InvalidInputError(str(path), f"a thread with {name} {value}", f"{expected}, as in {first[0]}")
            if settings != first[2]:
                same = f"that of {first[0]}, {first[1].name}; name one by --setup"
                raise InvalidInputError(str(path), f"setup {given.setup.name}", same)
            measured, notes = given.observations(advance), given.recording.notes
            try:
                simulated = notes.get("simulated", "")
                passage = read_run(str(path), measured, settings, against, simulated, given.setup.scene)
            except BagError:
                if problem := measured.thread_problem():
                    raise BagError(path, problem) from None
                raise
            passages.append(replace(passage, unverified=given.recording.salvaged_without_checksum))
        advance(1.0)
    best = BestSettings()

    def search(share: float) -> None:
        progress(reading + (1.0 - reading) * share)

    try:
        with replay_pool(passages, min(workers, os.cpu_count() or 1), scheduler) as run:
            found = calibrate(passages, settings, parameters, run_tasks=run, best=best, progress=search, log=log)
    except KeyboardInterrupt:
        if best.settings is None:
            raise
        log("interrupted; writing the best so far")
        found = unfinished_result(passages, settings, best)
    result, fits = found
    with whole_file(output) as partial:
        partial.write_text(to_yaml(result), encoding="utf-8")
    with whole_file(picture or output.with_suffix(".png")) as partial:
        draw_calibration(partial, result, fits)
    return result


def thread_settings(setup: Setup, material: str = "", formulation: str = "") -> ThreadModelSettings:
    """Return a setup's settings of the thread, with material and formulation where they are not empty.

    Another material than the setup's comes with its own diameter and modulus.

    Raises:
        ConfigurationError: there is no such material, or there are several.
    """
    settings = setup.model
    name = material_named(material) if material else settings.material
    if name != settings.material:
        settings = replace(settings, material=name, diameter=0.0, elastic_modulus=0.0)
    return replace(settings, formulation=formulation or settings.formulation)


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
