"""The calibration procedure: initial guesses, the fit to all that is unknown, what is identified, predictions by it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import stdtrit

from magnetosuture_thread.calibration.fit import (
    Array,
    FitSolution,
    Identifiability,
    Objective,
    assess_identifiability,
    initial_guesses,
    robust_scale,
)
from magnetosuture_thread.calibration.parameters import (
    OF_FORMULATION,
    STIFFNESS_OVER_DRAG,
    choose_parameters,
)
from magnetosuture_thread.calibration.recorded_run import BestSettings, RecordedRun, Replays, RunTasks, mean_across
from magnetosuture_thread.calibration.result import (
    FIXED,
    IDENTIFIED,
    STAND_IN,
    UNFINISHED,
    AttachmentDecision,
    BagFit,
    CalibrationResult,
    Estimate,
)
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.thread_model.session import ThreadSession
from magnetosuture_thread.thread_model.settings import ThreadModelSettings

MIN_IMPROVEMENT = 0.05  # % of length by which an attachment must fit better, besides the noise
GIVEN_WAY = 0.1  # % of length; a default that predicts worse by more gives way to what was fitted

Log = Callable[[str], None]
Progress = Callable[[float], None]


def calibrate(
    runs: Sequence[RecordedRun],
    settings: ThreadModelSettings,
    names: Sequence[str] = (),
    *,
    run_tasks: RunTasks | None = None,
    best: BestSettings | None = None,
    progress: Progress = lambda share: None,
    log: Log = lambda line: None,
) -> tuple[CalibrationResult, list[BagFit]]:
    """Fit a thread's parameters to recorded runs.

    1. Stiffnesses from a hundredth to a hundred times the material's are tried with each attachment, and the best
       of them fitted alone, by the whole distance of prediction and thread.
    2. All that is unknown is fitted, by the distance across the thread, with a robust loss.
    3. The attachment is the one that fits better, if the difference is beyond its own scatter over blocks of time.
    4. What cannot be identified is put back to what the setup says, and the rest is fitted again.
    5. With several runs, each is predicted by a fit to the others.

    Args:
        runs: recorded runs of one thread.
        settings: what the setup and the material say; where the fit starts.
        names: of settings to fit; all that the formulation has if empty.
        run_tasks: gives the predictions of tasks; here, one after the other, if None.
        best: is updated with the best so far at every moment.
        progress: called with the share done, 0 to 1.
        log: called with a line at the end of each stage.

    Returns:
        What was found, and each bag before and after.

    Raises:
        ConfigurationError: a name is unknown, the thread is not in a liquid, or an obstacle cannot be used.
    """
    parameters, both = choose_parameters(settings.formulation, names)
    if settings.medium != "liquid":
        raise ConfigurationError("thread_model.medium", settings.medium, "liquid: what is fitted is bending over drag")
    for scene in dict.fromkeys(run.scene for run in runs):
        ThreadSession(settings, scene)  # which says what is wrong with the obstacles, if anything is
    replays, count = Replays(runs, run_tasks, best, progress, log), len(runs)
    replays.error(settings)
    candidates = initial_guesses(replays, settings, parameters, both)
    with replays.stage("fitted all that is unknown", 0.4, count * len(candidates) * 6 * (len(parameters) + 1)):
        solutions = [_robust_fit(Objective(replays, candidate, parameters)) for candidate in candidates]
        solution, attachment = _choose_attachment(replays, solutions, settings) if both else (solutions[0], None)
    found = assess_identifiability(solution, runs)
    with replays.stage("fitted what can be identified", 0.15, count * 4 * len(parameters)):
        fitted, statuses = _fit_identified(replays, solution, found, settings)
    held_out: list[Points | None] = [None] * count
    if count > 1:
        free = [parameter for parameter, status in zip(parameters, statuses, strict=True) if status != FIXED]
        with replays.stage("predicted each bag by the others", 0.25, count * (count - 1) * 3 * (len(free) + 1)):
            for index in range(count):
                others = Objective(replays, fitted, free, [other for other in range(count) if other != index])
                held_out[index] = replays.of([others.fit(scale=solution.scale).settings], [index])[0][0]
    before, after = replays.of([settings, fitted])
    fits = [BagFit(*parts) for parts in zip(runs, before, after, held_out, strict=True)]
    estimates = []
    for index, (parameter, each, status) in enumerate(zip(parameters, found, statuses, strict=True)):
        value, low, high = parameter.read(fitted), math.nan, math.nan
        if np.isfinite(each.half):
            middle = parameter.to_fit(value) if status == IDENTIFIED else float(solution.x[index])
            low, high = parameter.interval(middle, each.half)
        values, effect = (value, parameter.read(settings), low, high), 100.0 * each.effect
        named = parameter.name, parameter.setting, parameter.unit
        estimates.append(Estimate(*named, *values, status, each.reason, effect, parameter.kind == "log"))
    progress(1.0)
    return CalibrationResult.of(fitted, fits, estimates, attachment, replays.best.replays), fits


def unfinished_result(
    runs: Sequence[RecordedRun], settings: ThreadModelSettings, best: BestSettings
) -> tuple[CalibrationResult, list[BagFit]]:
    """Return the best that an interrupted search had come to, without intervals.

    Args:
        runs: recorded runs.
        settings: where it started.
        best: of the search; its settings must be known.
    """
    found = best.settings or settings
    parameters = [p for p in OF_FORMULATION[settings.formulation] if p.read(found) != p.read(settings)]
    estimates = [
        Estimate(p.name, p.setting, p.unit, p.read(found), p.read(settings), status=UNFINISHED) for p in parameters
    ]
    attachment = None
    if found.attachment != settings.attachment:
        attachment = AttachmentDecision(found.attachment, settings.attachment, {}, looked=False)
    fits = [BagFit(*parts) for parts in zip(runs, best.first, best.vertices, strict=True)]
    return CalibrationResult.of(found, fits, estimates, attachment, best.replays, finished=False), fits


def _robust_fit(objective: Objective) -> FitSolution:
    """Return a robust fit, repeated where its outliers turn out to be much farther out than they seemed."""
    scale = robust_scale(objective.residuals(objective.start())[0])
    solution = objective.fit(scale=scale)
    narrower = robust_scale(solution.residuals)
    return objective.fit(solution.x, narrower) if narrower < 0.5 * scale else solution


def _choose_attachment(
    replays: Replays, solutions: Sequence[FitSolution], start: ThreadModelSettings
) -> tuple[FitSolution, AttachmentDecision]:
    """Return the solution whose attachment fits better, or the setup's where that cannot be told."""

    def blocks(solution: FitSolution) -> Array:
        """Return the mean distance across the thread in each block of time of each run [% of length]."""
        result = []
        for residual, run in zip(solution.residuals, replays.runs, strict=True):
            block, sizes = run.blocks, 100.0 * np.abs(residual)
            result += [float(sizes[block == k][run.known[block == k]].mean()) for k in np.unique(block)]
        return np.array(result)

    errors = {s.settings.attachment: replays.error(s.settings) for s in solutions}
    best, *others = sorted(solutions, key=lambda s: float(blocks(s).mean()))
    reason = ""
    for other in others:
        difference = blocks(other) - blocks(best)
        middle, count = float(difference.mean()), len(difference)
        half = float(stdtrit(count - 1, 0.975) * difference.std(ddof=1) / np.sqrt(count))
        if middle < max(MIN_IMPROVEMENT, half):
            reason = f"{other.settings.attachment} is worse by {middle:.2g} ± {half:.2g} % of the length only"
            best = next(s for s in solutions if s.settings.attachment == start.attachment)
    return best, AttachmentDecision(best.settings.attachment, start.attachment, errors, reason)


def _fit_identified(
    replays: Replays, solution: FitSolution, found: Sequence[Identifiability], start: ThreadModelSettings
) -> tuple[ThreadModelSettings, list[str]]:
    """Return the fit of what can be identified, and what became of each number.

    What cannot be identified stays as the setup has it, unless the data contradict that, or predictions get worse.
    """
    parameters, statuses = solution.parameters, []
    for parameter, x, each in zip(parameters, solution.x.tolist(), found, strict=True):
        is_contradicted = abs(parameter.to_fit(parameter.read(start)) - x) > each.half
        statuses.append(IDENTIFIED if not each.reason else STAND_IN if is_contradicted else FIXED)
    if not any(each.reason for each in found):
        return solution.settings, statuses

    def error(settings: ThreadModelSettings) -> float:
        """Return the mean distance across the thread [% of length]."""
        pairs = zip(replays.of([settings])[0], replays.runs, strict=True)
        return float(np.mean([mean_across(v, run, settings.thread_length) for v, run in pairs]))

    spare = [index for index, status in enumerate(statuses) if status == FIXED]
    spare.sort(key=lambda i: (parameters[i] is not STIFFNESS_OVER_DRAG, -found[i].effect))
    most = error(solution.settings) + GIVEN_WAY
    while True:
        base = replace(start, attachment=solution.settings.attachment)
        fitted = [parameter for parameter, status in zip(parameters, statuses, strict=True) if status != FIXED]
        for parameter in fitted:
            base = parameter.write(base, parameter.read(solution.settings))
        settings = Objective(replays, base, fitted).fit(scale=solution.scale).settings if fitted else base
        if error(settings) <= most or not spare:
            return settings, statuses
        statuses[spare.pop(0)] = STAND_IN
