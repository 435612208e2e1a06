"""The calibration procedure: initial guesses, the fit to all that is unknown, what is identified, predictions by it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

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
    Parameter,
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
    replays = Replays(runs, run_tasks, best, progress, log)
    for scene in dict.fromkeys(run.scene for run in runs):
        ThreadSession(settings, scene)  # which says what is wrong with the obstacles, if anything is
    result = _Search(replays, settings, parameters, both).go()
    progress(1.0)
    return result


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
    estimates = tuple(
        Estimate(p.name, p.setting, p.unit, p.read(found), p.read(settings), status=UNFINISHED) for p in parameters
    )
    attachment = None
    if found.attachment != settings.attachment:
        attachment = AttachmentDecision(found.attachment, settings.attachment, {}, looked=False)
    fits = [BagFit(*parts) for parts in zip(runs, best.first, best.vertices, strict=True)]
    return CalibrationResult.of(found, fits, estimates, attachment, best.replays, finished=False), fits


@dataclass
class _Search:
    replays: Replays
    start: ThreadModelSettings
    parameters: tuple[Parameter, ...]
    both: bool

    def go(self) -> tuple[CalibrationResult, list[BagFit]]:
        runs, count = self.replays.runs, len(self.replays.runs)
        self.replays.error(self.start)
        candidates = initial_guesses(self.replays, self.start, self.parameters, self.both)
        self.replays.begin_stage("fit", count * len(candidates) * 6 * (len(self.parameters) + 1))
        solutions = [self._fitted(Objective(self.replays, settings, self.parameters)) for settings in candidates]
        solution, attachment = self._attached(solutions)
        self.replays.end_stage("fitted all that is unknown")
        found = assess_identifiability(solution, runs)
        self.replays.begin_stage("identified", count * 4 * len(self.parameters))
        settings, statuses = self._identified(solution, found)
        self.replays.end_stage("fitted what can be identified")
        fitted = [p for p, status in zip(self.parameters, statuses, strict=True) if status != FIXED]
        held_out: list[Points | None] = [None] * count
        if count > 1:
            self.replays.begin_stage("held out", count * (count - 1) * 3 * (len(fitted) + 1))
            held_out = [self._held_out(settings, fitted, solution.scale, index) for index in range(count)]
            self.replays.end_stage("predicted each bag by the others")
        before, after = self.replays.of([self.start, settings])
        fits = [BagFit(*parts) for parts in zip(runs, before, after, held_out, strict=True)]
        estimates = tuple(
            self._estimate(solution, index, each, status, settings)
            for index, (each, status) in enumerate(zip(found, statuses, strict=True))
        )
        return CalibrationResult.of(settings, fits, estimates, attachment, self.replays.best.replays), fits

    def _fitted(self, objective: Objective) -> FitSolution:
        """Return a robust fit, repeated where its outliers turn out to be much farther out than they seemed."""
        scale = robust_scale(objective.residuals(objective.start())[0])
        solution = objective.fit(scale=scale)
        narrower = robust_scale(solution.residuals)
        return objective.fit(solution.x, narrower) if narrower < 0.5 * scale else solution

    def _attached(self, solutions: Sequence[FitSolution]) -> tuple[FitSolution, AttachmentDecision | None]:
        """Return the solution whose attachment fits better, or the setup's where that cannot be told."""
        if not self.both:
            return solutions[0], None
        errors = {s.settings.attachment: self.replays.error(s.settings) for s in solutions}
        best = min(solutions, key=lambda s: float(np.mean(self._blocks(s))))
        if len(solutions) == 1:
            return best, AttachmentDecision(best.settings.attachment, self.start.attachment, errors)
        other = next(s for s in solutions if s is not best)
        difference = self._blocks(other) - self._blocks(best)
        middle, count = float(difference.mean()), len(difference)
        half = float(stdtrit(count - 1, 0.975) * difference.std(ddof=1) / np.sqrt(count))
        reason = ""
        if middle < max(MIN_IMPROVEMENT, half):
            reason = f"{other.settings.attachment} is worse by {middle:.2g} ± {half:.2g} % of the length only"
            best = next(s for s in solutions if s.settings.attachment == self.start.attachment)
        return best, AttachmentDecision(best.settings.attachment, self.start.attachment, errors, reason)

    def _blocks(self, solution: FitSolution) -> Array:
        """Return the mean distance across the thread in each block of time of each run [% of length]."""
        result = []
        for residual, run in zip(solution.residuals, self.replays.runs, strict=True):
            block, sizes = run.blocks, 100.0 * np.abs(residual)
            result += [float(sizes[block == k][run.known[block == k]].mean()) for k in np.unique(block)]
        return np.array(result)

    def _identified(
        self, solution: FitSolution, found: Sequence[Identifiability]
    ) -> tuple[ThreadModelSettings, list[str]]:
        """Return the fit of what can be identified, and what became of each number."""
        statuses = [self._status(solution, index, each) for index, each in enumerate(found)]
        if not any(each.reason for each in found):
            return solution.settings, statuses
        spare = [index for index, status in enumerate(statuses) if status == FIXED]
        spare.sort(key=lambda i: (self.parameters[i] is not STIFFNESS_OVER_DRAG, -found[i].effect))
        most = self._error(solution.settings) + GIVEN_WAY
        while True:
            base = solution.settings
            for parameter, status in zip(self.parameters, statuses, strict=True):
                base = base if status != FIXED else parameter.reset(base, self.start)
            fitted = [p for p, status in zip(self.parameters, statuses, strict=True) if status != FIXED]
            settings = Objective(self.replays, base, fitted).fit(scale=solution.scale).settings if fitted else base
            if self._error(settings) <= most or not spare:
                return settings, statuses
            statuses[spare.pop(0)] = STAND_IN

    def _status(self, solution: FitSolution, index: int, each: Identifiability) -> str:
        """Return what becomes of a number at first: the setup's is kept unless the data contradict it."""
        if not each.reason:
            return IDENTIFIED
        parameter = self.parameters[index]
        off = abs(parameter.to_fit(parameter.read(self.start)) - float(solution.x[index]))
        return STAND_IN if off > each.half else FIXED

    def _error(self, settings: ThreadModelSettings) -> float:
        """Return the mean distance across the thread [% of length]."""
        pairs = zip(self.replays.of([settings])[0], self.replays.runs, strict=True)
        return float(np.mean([mean_across(v, p, settings.thread_length) for v, p in pairs]))

    def _held_out(self, settings: ThreadModelSettings, fitted: Sequence[Parameter], scale: float, index: int) -> Points:
        """Return what is predicted of a run by a fit to the others."""
        others = [other for other in range(len(self.replays.runs)) if other != index]
        if fitted:
            settings = Objective(self.replays, settings, fitted, others).fit(scale=scale).settings
        return self.replays.of([settings], [index])[0][0]

    def _estimate(
        self, solution: FitSolution, index: int, each: Identifiability, status: str, settings: ThreadModelSettings
    ) -> Estimate:
        parameter = self.parameters[index]
        value = parameter.read(settings)
        low = high = math.nan
        if np.isfinite(each.half):
            middle = parameter.to_fit(value) if status == IDENTIFIED else float(solution.x[index])
            low, high = parameter.interval(middle, each.half)
        start, effect = parameter.read(self.start), 100.0 * each.effect
        named = parameter.name, parameter.setting, parameter.unit
        return Estimate(*named, value, start, low, high, status, each.reason, effect, parameter.kind == "log")
