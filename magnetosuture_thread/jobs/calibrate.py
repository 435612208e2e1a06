"""The job `magnetosuture calibrate`: fits a thread's parameters to recorded runs."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from magnetosuture_thread import MATERIALS, ConfigurationError, InvalidInputError
from magnetosuture_thread.calibration.parameters import choose_parameters
from magnetosuture_thread.calibration.plot import draw_calibration
from magnetosuture_thread.calibration.recorded_run import BestSettings, RecordedRun, read_run, replay_pool
from magnetosuture_thread.calibration.result import CalibrationResult, to_yaml
from magnetosuture_thread.calibration.search import calibrate as fit
from magnetosuture_thread.calibration.search import unfinished_result
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.jobs.output import whole_file
from magnetosuture_thread.jobs.replay_inputs import (
    BagInput,
    BagSelection,
    Log,
    Progress,
    open_bag,
    setup_of_notes,
)
from magnetosuture_thread.offline.predictions import read_observations
from magnetosuture_thread.setups import Setup
from magnetosuture_thread.thread_model.settings import ThreadModelSettings

if TYPE_CHECKING:
    from typing_extensions import Unpack

READING_SHARE = 0.15  # share of the time for reading the bags, and tracking their frames


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
    picture: Path | None = None,
    json_file: Path | None = None,
    log: Log = lambda line: None,
    progress: Progress = lambda share: None,
    **selection: Unpack[BagSelection],
) -> CalibrationResult:
    """Fit a thread's parameters to bags, and write them as a file that `thread_model` loads.

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
        picture: of fit and residuals, to draw (.png); beside the output if None.
        json_file: to write all figures to, if any.
        log: called with a line for a person at the end of each stage.
        progress: called with the share done, 0 to 1.
        selection: what of the bags is read.

    Raises:
        BagError: a bag cannot be used, or a file cannot be written.
        ConfigurationError: the setup, the material or a parameter cannot be used.
        InvalidInputError: the bags are of different threads.
    """
    passages, settings = read_runs(
        bags, material, formulation, against, parameters, log, lambda share: progress(READING_SHARE * share), selection
    )
    best = BestSettings()
    try:
        with replay_pool(passages, min(workers, os.cpu_count() or 1), scheduler) as run:
            calibration, fits = fit(
                passages,
                settings,
                parameters,
                run_tasks=run,
                best=best,
                progress=lambda share: progress(READING_SHARE + (1.0 - READING_SHARE) * share),
                log=log,
            )
    except KeyboardInterrupt:
        if best.settings is None:
            raise
        log("interrupted; writing the best so far")
        calibration, fits = unfinished_result(passages, settings, best)
    with whole_file(output) as partial:
        partial.write_text(to_yaml(calibration), encoding="utf-8")
    if json_file is not None:
        with whole_file(json_file) as partial:
            text = json.dumps(calibration.to_json(), indent=1, allow_nan=False)
            partial.write_text(f"{text}\n", encoding="utf-8")
    with whole_file(picture or output.with_suffix(".png")) as partial:
        draw_calibration(partial, calibration, fits)
    return calibration


def read_runs(
    bags: Sequence[Path],
    material: str,
    formulation: str,
    against: str,
    parameters: Sequence[str],
    log: Log,
    progress: Progress,
    selection: BagSelection,
) -> tuple[list[RecordedRun], ThreadModelSettings]:
    """Return recorded runs of one thread, and the settings of the thread that a fit starts from.

    Args:
        bags: that hold the runs.
        material: a name of `MATERIALS`, or the beginning of one; the setup's if empty.
        formulation: rod or paper; the setup's if empty.
        against: what predictions are compared with, `seen` (measured) or `truth`.
        parameters: names of settings to fit; all that the formulation has if empty.
        log: called with a line for a person.
        progress: called with the share done, 0 to 1.
        selection: what of the bags is read.

    Raises:
        BagError: a bag cannot be used.
        ConfigurationError: the setup, the material or a parameter cannot be used.
        InvalidInputError: the bags are of different threads.
    """
    passages: list[RecordedRun] = []
    own: list[Setup] = []
    settings: ThreadModelSettings | None = None
    for index, path in enumerate(bags):

        def advance(share: float, index: int = index) -> None:
            progress((index + share) / len(bags))

        with open_bag(path, log, **selection) as given:
            its = settings_of(given.setup, material, formulation)
            choose_parameters(its.formulation, parameters)  # refuses wrong names before the bag is read
            own.append(_own_setup(given) or given.setup)
            _check_same_thread(bags, own)
            if settings is not None and its != settings:
                expected = f"that of {bags[0]}, {own[0].name}; name one by --setup"
                raise InvalidInputError(str(path), f"setup {given.setup.name}", expected)
            settings = its
            measured = read_observations(given.recording, given.setup, source=given.source, progress=advance)
            simulated = given.recording.notes.get("simulated", "")
            try:
                passage = read_run(str(path), measured, its, against, simulated, given.setup.scene)
                passages.append(replace(passage, unverified=given.recording.unverified))
            except BagError:
                if problem := measured.thread_problem():
                    raise BagError(path, problem) from None
                raise
        advance(1.0)
    assert settings is not None
    return passages, settings


def settings_of(setup: Setup, material: str, formulation: str) -> ThreadModelSettings:
    """Return a setup's settings of the thread, with another material and formulation where these are not empty.

    Another material than the setup's comes with its own diameter and modulus.

    Raises:
        ConfigurationError: there is no such material, or there are several.
    """
    settings = setup.model
    material = material_named(material) if material else settings.material
    if material != settings.material:
        settings = replace(settings, material=material, diameter=0.0, elastic_modulus=0.0)
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


def _own_setup(given: BagInput) -> Setup | None:
    """Return the setup that a bag was recorded with, None if that cannot be read."""
    try:
        with TemporaryDirectory() as folder:
            return setup_of_notes(given.recording.notes, Path(folder))
    except ConfigurationError:
        return None


def _check_same_thread(bags: Sequence[Path], setups: Sequence[Setup]) -> None:
    """Refuse the last bag if its thread is another than that of the first."""
    for name in ("material", "thread_length"):
        value, expected = getattr(setups[-1].model, name), getattr(setups[0].model, name)
        if value != expected:
            problem = f"a thread with {name} {value}"
            raise InvalidInputError(str(bags[len(setups) - 1]), problem, f"{expected}, as in {bags[0]}")
