"""Fits a thread's parameters to recorded bags."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, cast

from magnetosuture_thread.calibration.parameters import choose_parameters
from magnetosuture_thread.calibration.recorded_run import RecordedRun, read_run
from magnetosuture_thread.calibration.result import CalibrationResult, to_yaml
from magnetosuture_thread.calibration.search import calibrate
from magnetosuture_thread.estimator.settings import ThreadModelSettings
from magnetosuture_thread.evaluation.recorded import BagInput, BagSelection, ObservationReader, open_bag, setup_of_notes
from magnetosuture_thread.evaluation.replay import picture_or_log
from magnetosuture_thread.evaluation.workers import Log, Progress
from magnetosuture_thread.rig.setups import Setup
from magnetosuture_thread.settings.errors import BagError, ConfigurationError, InvalidInputError
from magnetosuture_thread.settings.files import whole_file
from magnetosuture_thread.thread.material import MATERIALS

if TYPE_CHECKING:
    from typing_extensions import Unpack

READING = 0.15  # share of the time for reading the bags, and tracking their frames


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
    picture = selection.pop("picture", None) or output.with_suffix(".png")

    def advance(index: int, share: float) -> None:
        progress(READING * (index + share) / len(bags))

    runs: list[RecordedRun] = []
    first: dict[str, tuple[Any, str]] = {}  # what all bags must have in common, and its words
    for index, path in enumerate(bags):
        with open_bag(path, log, **cast(BagSelection, selection)) as bag:
            settings = thread_settings(bag.setup, material, formulation)
            choose_parameters(settings.formulation, parameters)  # refuses wrong names before the bag is read
            thread = _recorded_setup(bag).model
            for name, value, words in (
                ("material", thread.material, thread.material),
                ("thread_length", thread.thread_length, f"{thread.thread_length} m"),
                ("setup", settings, bag.setup.name),
            ):
                expected, expected_words = first.setdefault(name, (value, words))
                if value != expected:
                    expectation = f"{expected_words}, as in {bags[0]}; --setup names one for all"
                    raise InvalidInputError(str(path), f"a thread with {name} {words}", expectation)
            runs.append(_read_run(path, bag, settings, against, partial(advance, index)))
        advance(index, 1.0)
    workers = min(workers, os.cpu_count() or 1)
    stages: dict[str, Any] = {"progress": lambda share: progress(READING + (1.0 - READING) * share), "log": log}
    result, fits = calibrate(runs, settings, parameters, workers=workers, scheduler=scheduler, **stages)
    with whole_file(output) as partial_file:
        partial_file.write_text(to_yaml(result), encoding="utf-8")

    def draw() -> bytes:
        from magnetosuture_thread.calibration.plot import draw_calibration  # late, as it imports matplotlib

        with whole_file(picture) as partial_file:
            draw_calibration(partial_file, result, fits)
        return b""

    picture_or_log(draw, log)
    return result


def _read_run(path: Path, bag: BagInput, settings: ThreadModelSettings, against: str, advance: Progress) -> RecordedRun:
    """Return a bag as arrays.

    Raises:
        BagError: it cannot be used.
    """
    observations, simulated = ObservationReader(bag, advance), bag.recording.notes.get("simulated", "")
    try:
        run = read_run(str(path), observations, settings, against, simulated, bag.setup.scene)
    except BagError:
        if problem := observations.thread_problem():
            raise BagError(path, problem) from None
        raise
    return replace(run, unverified=bag.recording.salvaged_without_checksum)


def thread_settings(setup: Setup, material: str = "", formulation: str = "") -> ThreadModelSettings:
    """Return a setup's settings of the thread, with material and formulation where they are not empty.

    Another material than the setup's comes with its own diameter and modulus.

    Args:
        setup: where the settings are from.
        material: a name of `MATERIALS`, or how one alone begins.
        formulation: rod or paper.

    Raises:
        ConfigurationError: there is no such material, or there are several.
    """
    settings = setup.model
    names = [name for name in MATERIALS if name.startswith(material or settings.material)]
    if len(names) != 1:
        raise ConfigurationError("material", material, f"one of {', '.join(MATERIALS)}, or how one alone begins")
    if names[0] != settings.material:
        settings = replace(settings, material=names[0], diameter=0.0, elastic_modulus=0.0)
    return replace(settings, formulation=formulation or settings.formulation)


def _recorded_setup(bag: BagInput) -> Setup:
    """Return the setup that a bag was recorded with, or else the one that it is read with."""
    try:
        with TemporaryDirectory() as folder:
            return setup_of_notes(bag.recording.notes, Path(folder))
    except ConfigurationError:
        return bag.setup
