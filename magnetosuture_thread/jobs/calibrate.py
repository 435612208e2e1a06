"""The job `magnetosuture calibrate`: what recorded runs tell of a thread, as parameters for `thread_model`."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from magnetosuture_thread.calibration.output import to_yaml
from magnetosuture_thread.calibration.parameters import choose_parameters
from magnetosuture_thread.calibration.plot import draw_calibration
from magnetosuture_thread.calibration.pool import pool
from magnetosuture_thread.calibration.recorded_run import RecordedRun, read_run
from magnetosuture_thread.calibration.residuals import BestSettings
from magnetosuture_thread.calibration.result import BagFit, CalibrationResult
from magnetosuture_thread.calibration.search import calibrate as fit
from magnetosuture_thread.calibration.search import unfinished_result
from magnetosuture_thread.errors import BagError, ConfigurationError, InvalidInputError
from magnetosuture_thread.jobs.output import whole_file
from magnetosuture_thread.jobs.replay_inputs import Given, opened
from magnetosuture_thread.jobs.simulate import SCENARIO_NOTE
from magnetosuture_thread.model.settings import ThreadModelSettings
from magnetosuture_thread.model.thread import MATERIALS
from magnetosuture_thread.offline.predictions import read_observations
from magnetosuture_thread.setups import Setup, read_setup

READING = 0.15  # share of the time for reading the bags, and tracking their frames

Log = Callable[[str], None]
Progress = Callable[[float], None]


@dataclass(frozen=True)
class Request:
    """What to calibrate, and how.

    Attributes:
        setup: name or path of the set-up; the one that the bags name if empty.
        material: a name of `MATERIALS`, or the beginning of one; the set-up's if empty.
        formulation: rod or paper; the set-up's if empty.
        against: what predictions are held against, `seen` or `truth`.
        parameters: names of settings to fit; all that the formulation has if empty.
        workers: processes.
        source: `auto`, `camera` or `poses`.
        remap: other names for topics of the bags, each as old name and new.
        frame: the bags' name of the dish frame.
    """

    setup: str = ""
    material: str = ""
    formulation: str = ""
    against: str = "seen"
    parameters: Sequence[str] = ()
    workers: int = 1
    source: str = "auto"
    remap: Sequence[tuple[str, str]] = ()
    frame: str = "dish"


def calibrate_bags(
    bags: Sequence[Path],
    output: Path,
    request: Request,
    *,
    picture: Path | None = None,
    json_file: Path | None = None,
    log: Log = lambda line: None,
    progress: Progress = lambda share: None,
) -> CalibrationResult:
    """Fit a thread's parameters to bags, and write them as a file that `thread_model` loads.

    The file does not depend on the number of workers, nor on the time: the same bags give the same bytes. Ctrl-C ends
    the fit and writes the best so far, marked as such, once there is any.

    Args:
        bags: recorded runs of one thread.
        output: the YAML file to write.
        request: what to calibrate.
        picture: of fit and residuals, to draw (.png); beside the output if None.
        json_file: to write all figures to, if any.
        log: is told a line at the end of each stage.
        progress: is told the share done.

    Raises:
        BagError: a bag cannot be used, or a file cannot be written.
        ConfigurationError: the set-up, the material or a parameter cannot be used.
        InvalidInputError: the bags are of different threads.
    """
    passages, settings = _read(bags, request, log, lambda share: progress(READING * share))
    best = BestSettings()
    try:
        with pool(passages, min(request.workers, os.cpu_count() or 1)) as run:
            calibration, fits = fit(
                passages,
                settings,
                request.parameters,
                run_tasks=run,
                best=best,
                progress=lambda share: progress(READING + (1.0 - READING) * share),
                log=log,
            )
    except KeyboardInterrupt:
        if best.settings is None:
            raise
        log("interrupted; writing the best so far")
        calibration, fits = unfinished_result(passages, settings, best)
    _write(calibration, fits, output, picture or output.with_suffix(".png"), json_file)
    return calibration


def _write(
    calibration: CalibrationResult, fits: Sequence[BagFit], output: Path, picture: Path, json_file: Path | None
) -> None:
    with whole_file(output) as partial:
        partial.write_text(to_yaml(calibration), encoding="utf-8")
    if json_file is not None:
        with whole_file(json_file) as partial:
            partial.write_text(json.dumps(calibration.to_json(), indent=1, allow_nan=False) + "\n", encoding="utf-8")
    with whole_file(picture) as partial:
        draw_calibration(partial, calibration, fits)


def _read(
    bags: Sequence[Path], request: Request, log: Log, progress: Progress
) -> tuple[list[RecordedRun], ThreadModelSettings]:
    """Read all bags, their frames tracked once, and return what the set-up says of the thread."""
    passages: list[RecordedRun] = []
    settings: ThreadModelSettings | None = None
    threads: list[tuple[Path, Setup]] = []
    for index, path in enumerate(bags):

        def share(part: float, index: int = index) -> None:
            progress((index + part) / len(bags))

        with opened(
            path,
            setup_name=request.setup,
            source=request.source,
            start=0.0,
            duration=None,
            remap=dict(request.remap),
            frame=request.frame,
            log=log,
        ) as given:
            own = settings_of(given.setup, request)
            choose_parameters(own.formulation, request.parameters)  # what is wrong is said before the bag is read
            _check_same(threads, path, _named(given) or given.setup)
            if settings is not None and own != settings:
                name, first = given.setup.name, threads[0][1].name
                raise InvalidInputError(str(path), f"set-up {name}", f"that of {bags[0]}, {first}; name one by --setup")
            threads.append((path, _named(given) or given.setup))
            settings = own
            seen = read_observations(given.recording, given.setup, source=given.source, progress=share)
            simulated = given.recording.notes.get("simulated", "")
            try:
                passages.append(read_run(str(path), seen, own, request.against, simulated, given.setup.scene))
            except BagError:
                if problem := seen.thread_problem():
                    raise BagError(path, problem) from None
                raise
        share(1.0)
    assert settings is not None
    return passages, settings


def settings_of(setup: Setup, request: Request) -> ThreadModelSettings:
    """Return what the set-up says of the thread, with material and formulation as asked for.

    Another material than the set-up's comes with its own diameter and modulus.

    Raises:
        ConfigurationError: there is no such material, or there are several.
    """
    settings = setup.model
    material = material_named(request.material) if request.material else settings.material
    if material != settings.material:
        settings = replace(settings, material=material, diameter=0.0, elastic_modulus=0.0)
    return replace(settings, formulation=request.formulation or settings.formulation)


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


def _named(given: Given) -> Setup | None:
    """Return the set-up that a bag was recorded with, where it can be had."""
    notes = given.recording.notes
    try:
        if text := notes.get(SCENARIO_NOTE, ""):
            with tempfile.TemporaryDirectory() as spare:
                path = Path(spare) / "scenario.yaml"
                path.write_text(text, encoding="utf-8")
                return read_setup(str(path))
        return read_setup(notes["setup"]) if notes.get("setup") else None
    except ConfigurationError:
        return None


def _check_same(before: Sequence[tuple[Path, Setup]], path: Path, setup: Setup) -> None:
    """Refuse a bag whose thread is another than that of the bags before."""
    for other, known in before:
        for name in ("material", "thread_length"):
            value, expected = getattr(setup.model, name), getattr(known.model, name)
            if value != expected:
                raise InvalidInputError(str(path), f"a thread with {name} {value}", f"{expected}, as in {other}")
