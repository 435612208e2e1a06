"""The calibration: initial guesses, least squares over replays of recorded runs, and what is identified by them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.special import stdtrit

from magnetosuture_thread.calibration.parameters import (
    DAMPING,
    OF_FORMULATION,
    STIFFNESS_OVER_DRAG,
    STIFFNESS_WEIGHT,
    Parameter,
    choose_parameters,
    stiffness_over_drag,
    with_stiffness_over_drag,
)
from magnetosuture_thread.calibration.recorded_run import (
    RecordedRun,
    Replays,
    across_residuals,
    mean_across,
    offset_residuals,
    replay_task,
)
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
from magnetosuture_thread.estimator.settings import ThreadModelSettings
from magnetosuture_thread.estimator.thread_session import ThreadSession
from magnetosuture_thread.evaluation.workers import Log, Progress, TaskRunner
from magnetosuture_thread.geometry.polyline import Points, Table, Vector
from magnetosuture_thread.settings.errors import ConfigurationError
from magnetosuture_thread.thread.material import Attachment

STARTS = tuple(10.0 ** (power / 1.5) for power in range(-3, 4))  # of the material's stiffness
FLOOR = 2e-3  # of the length, which camera, tracker and model are wrong by
MIN_EFFECT = 1e-12  # effect of a number, as a share of the length, below which it has none


def calibrate(
    runs: Sequence[RecordedRun],
    settings: ThreadModelSettings,
    names: Sequence[str] = (),
    *,
    workers: int = 1,
    scheduler: str = "",
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

    Ctrl-C ends it with the best so far, without intervals, once there is any.

    Args:
        runs: recorded runs of one thread.
        settings: what the setup and the material say; where the fit starts.
        names: of settings to fit; all that the formulation has if empty.
        workers: processes that replay the runs; with one, no other process is started.
        scheduler: address of a Dask scheduler, whose workers replay in place of those; empty for none.
        progress: called with the share done, 0 to 1.
        log: called with a line at the end of each stage.

    Returns:
        What was found, and each bag before and after.

    Raises:
        ConfigurationError: a name is unknown, the thread is not in a liquid, or an obstacle cannot be used.
        GraphError: a process died.
    """
    parameters, both = choose_parameters(settings.formulation, names)
    if settings.medium != "liquid":
        raise ConfigurationError("thread_model.medium", settings.medium, "liquid: what is fitted is bending over drag")
    for scene in dict.fromkeys(run.scene for run in runs):
        ThreadSession(settings, scene)  # which says what is wrong with the obstacles, if anything is
    count, derivatives = len(runs), len(parameters) + 1
    expected = count * (60 + 10 * derivatives + 3 * (count - 1) * derivatives)
    with TaskRunner(partial(replay_task, tuple(runs)), workers, scheduler) as runner:
        replays = Replays(runs, runner, expected, progress, log)
        try:
            found = _search(replays, settings, parameters, both)
        except KeyboardInterrupt:
            if replays.best is None:
                raise
            log("interrupted; writing the best so far")
            return _unfinished_result(replays, settings)
    progress(1.0)
    return found


def _search(
    replays: Replays, settings: ThreadModelSettings, parameters: Sequence[Parameter], both: bool
) -> tuple[CalibrationResult, list[BagFit]]:
    """Return what `calibrate` finds; `both` attachments are tried where it is one of the parameters."""
    runs, count = replays.runs, len(replays.runs)
    replays.error(settings)
    candidates = initial_guesses(replays, settings, parameters, both)
    solutions = [_robust_fit(Objective(replays, candidate, parameters)) for candidate in candidates]
    solution, attachment = _choose_attachment(replays, solutions, settings) if both else (solutions[0], None)
    replays.report("fitted all that is unknown")
    found = assess_identifiability(solution, runs)
    fitted, statuses = _fit_identified(replays, solution, found, settings)
    replays.report("fitted what can be identified")
    held_out: list[Points | None] = [None] * count
    free = [parameter for parameter, status in zip(parameters, statuses, strict=True) if status != FIXED]
    for index in range(count) if count > 1 else ():
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
    scores = tuple(fit.errors(fitted.thread_length) for fit in fits)
    result = CalibrationResult(fitted, runs[0].against, tuple(estimates), attachment, scores, replays.count)
    return result, fits


def _unfinished_result(replays: Replays, settings: ThreadModelSettings) -> tuple[CalibrationResult, list[BagFit]]:
    """Return the best that an interrupted search from some settings had come to, without intervals."""
    found, runs = replays.best or settings, replays.runs
    parameters = [p for p in OF_FORMULATION[settings.formulation] if p.read(found) != p.read(settings)]
    estimates = tuple(
        Estimate(p.name, p.setting, p.unit, p.read(found), p.read(settings), status=UNFINISHED) for p in parameters
    )
    attachment = None
    if found.attachment != settings.attachment:
        attachment = AttachmentDecision(found.attachment, settings.attachment, {}, looked=False)
    fits = [BagFit(*parts) for parts in zip(runs, replays.first_vertices, replays.best_vertices, strict=True)]
    scores = tuple(fit.errors(found.thread_length) for fit in fits)
    return CalibrationResult(found, runs[0].against, estimates, attachment, scores, replays.count, finished=False), fits


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

    def blocks(solution: FitSolution) -> Vector:
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
        if middle < max(0.05, half):  # % of the length, and the noise
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
    most = error(solution.settings) + 0.1  # % of the length; a default that is worse gives way to what was fitted
    while True:
        base = replace(start, attachment=solution.settings.attachment)
        fitted = [parameter for parameter, status in zip(parameters, statuses, strict=True) if status != FIXED]
        for parameter in fitted:
            base = parameter.write(base, parameter.read(solution.settings))
        settings = Objective(replays, base, fitted).fit(scale=solution.scale).settings if fitted else base
        if error(settings) <= most or not spare:
            return settings, statuses
        statuses[spare.pop(0)] = STAND_IN


@dataclass(frozen=True)
class FitSolution:
    """Where a fit ended.

    Attributes:
        settings: with the fitted numbers.
        parameters: that were fitted.
        x: their numbers, in the scale of the fit, shape (P,).
        residuals: of each run, shape (K, n).
        jacobian: of each run, d residual / d x, shape (K, n, P).
        scale: beyond which residuals count by their size only, as a share of the length; inf for none.
        cost: what was made least; comparable for the same scale only.
    """

    settings: ThreadModelSettings
    parameters: tuple[Parameter, ...]
    x: Vector
    residuals: list[Table]
    jacobian: list[Table]
    scale: float
    cost: float

    @property
    def weights(self) -> list[Table]:
        """Weight of each residual: rho'((r / scale)^2) of the robust loss, shape (K, n) for each run."""
        return [1.0 / np.sqrt(1.0 + (r / self.scale) ** 2) for r in self.residuals]

    def at_bound(self, index: int) -> bool:
        """Whether a number ended at a bound."""
        parameter = self.parameters[index]
        low, high = parameter.fit_bounds(self.settings)
        near = 0.02 * parameter.counts(self.settings)
        return not low + near < self.x[index] < high - near


class Objective:
    """Residuals and their derivatives over some parameters and runs.

    Args:
        replays: of all runs.
        base: settings that the parameters change.
        parameters: to fit.
        which: runs that count; all if None.
        whole: whether residuals are those of `offset_residuals`, in both directions, and not of `across_residuals`.
    """

    def __init__(
        self,
        replays: Replays,
        base: ThreadModelSettings,
        parameters: Sequence[Parameter],
        which: Sequence[int] | None = None,
        *,
        whole: bool = False,
    ) -> None:
        self.base, self.parameters = base, tuple(parameters)
        self._which = tuple(range(len(replays.runs)) if which is None else which)
        self._replays, self._runs = replays, [replays.runs[index] for index in self._which]
        self._residuals = offset_residuals if whole else across_residuals
        self._units = np.array([parameter.counts(base) for parameter in parameters])
        self._low, self._high = np.array([parameter.fit_bounds(base) for parameter in parameters]).reshape(-1, 2).T

    def start(self) -> Vector:
        """Return the numbers of the base, moved inside of their bounds."""
        x = np.array([parameter.to_fit(parameter.read(self.base)) for parameter in self.parameters])
        margin = 0.01 * np.minimum(self._units, self._high - self._low)
        return np.asarray(np.clip(x, self._low + margin, self._high - margin))

    def settings(self, x: Vector) -> ThreadModelSettings:
        """Return the settings of some numbers."""
        settings = self.base
        for parameter, number in zip(self.parameters, x.tolist(), strict=True):
            low, high = parameter.bounds(settings)  # of which a logarithm may miss the last bits
            settings = parameter.write(settings, min(max(parameter.from_fit(number), low), high))
        return settings

    def residuals(self, *points: Vector) -> list[list[Table]]:
        """Return the residuals of each run that counts, at each point."""
        found, length = self._replays.of([self.settings(x) for x in points], self._which), self.base.thread_length
        return [
            [self._residuals(v, run, length) for v, run in zip(vertices, self._runs, strict=True)] for vertices in found
        ]

    def jacobian(self, x: Vector) -> list[Table]:
        """Return derivatives by difference quotients, away from the nearer bound; shape (K, n, P) of each run."""
        # Predictions of `paper` jump by 0.01 % of the length from one number to the next.
        lengths = (0.5 if self.base.formulation == "paper" else 0.01) * self._units
        steps = lengths * np.where(x + lengths <= self._high, 1.0, -1.0)
        middle, *moved = self.residuals(x, *(x + np.diag(steps)))
        return [
            np.array([(end[run] - begin) / step for end, step in zip(moved, steps, strict=True)])
            .reshape(-1, *begin.shape)
            .transpose(1, 2, 0)
            for run, begin in enumerate(middle)
        ]

    def fit(self, start: Vector | None = None, scale: float = np.inf) -> FitSolution:
        """Return the best numbers near a start.

            min over x  sum rho(r(x)^2 / scale^2),    rho(z) = 2 (sqrt(1 + z) - 1)

        Args:
            start: numbers to begin with; those of the base if None.
            scale: of the robust loss, as a share of the length; inf for plain least squares.

        Source: nonlinear least squares by scipy, trust region reflective.
        """
        first = self.start() if start is None else np.clip(start, self._low, self._high)
        x, cost = first, 0.0
        if self.parameters:  # else only the attachment is asked for
            units = self._units

            def residuals_at(y: Vector) -> Vector:
                return np.concatenate([part.ravel() for part in self.residuals(first + units * y)[0]])

            def jacobian_at(y: Vector) -> Vector:
                parts = [part.reshape(-1, len(first)) for part in self.jacobian(first + units * y)]
                return np.asarray(units * np.concatenate(parts))

            found = least_squares(
                residuals_at,
                np.zeros(len(first)),
                jac=jacobian_at,
                bounds=((self._low - first) / units - 1e-9, (self._high - first) / units + 1e-9),
                ftol=1e-4,
                xtol=1e-3,
                gtol=1e-10,
                loss="linear" if np.isinf(scale) else "soft_l1",
                f_scale=1.0 if np.isinf(scale) else scale,
                max_nfev=15,
            )
            x, cost = np.clip(first + units * found.x, self._low, self._high), float(found.cost)
        residuals = self.residuals(x)[0]
        return FitSolution(self.settings(x), self.parameters, x, residuals, self.jacobian(x), scale, cost)


def robust_scale(residuals: Sequence[Vector]) -> float:
    """Return the scale of the robust loss: three times the scatter of the residuals, by their median size."""
    sizes = np.abs(np.concatenate([part[part != 0.0] for part in residuals]))
    middle = float(np.median(sizes)) if len(sizes) else 0.0
    return max(3.0 * 1.4826 * middle, 1e-3)


def initial_guesses(
    replays: Replays, start: ThreadModelSettings, parameters: Sequence[Parameter], both: bool
) -> list[ThreadModelSettings]:
    """Return the best initial settings of each attachment that may be right.

    Stiffnesses from a hundredth to a hundred times the material's are tried with each attachment, and the best local
    minima fitted, all else as the setup has it, by the whole distance of prediction and thread.

    Args:
        replays: of all runs.
        start: what the setup says.
        parameters: that will be fitted.
        both: whether the attachment is asked for.
    """
    kinds = [kind.value for kind in Attachment] if both else [start.attachment]
    bases = [replace(start, attachment=kind) for kind in kinds]
    if start.formulation == "paper":  # whose error has several minima in kappa and W_stiff
        tried = [start]
        for parameter, values in (
            (DAMPING, (0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99)),
            (STIFFNESS_WEIGHT, (1e-4, 1e-2, 1.0, 1e2, 1e4, 1e6)),
        ):
            if parameter in parameters:
                tried = [parameter.write(settings, value) for settings in tried for value in values]
        replays.of(tried)
        replays.report(f"tried {len(tried)} starts")
        return [min(tried, key=replays.error)]
    if STIFFNESS_OVER_DRAG not in parameters:
        return bases
    tried = []
    for base in bases:
        low, high = STIFFNESS_OVER_DRAG.bounds(base)
        stiffnesses = np.clip(np.array(STARTS) * stiffness_over_drag(base), low, high).tolist()
        tried += [with_stiffness_over_drag(base, stiffness) for stiffness in stiffnesses]
    replays.of(tried)  # at once, so that all cores have work
    errors, found = np.reshape([replays.error(settings) for settings in tried], (len(bases), -1)), []
    for index in _not_much_worse(errors.min(axis=1).tolist(), 3.0, 1.0):
        objectives = [
            Objective(replays, tried[index * len(STARTS) + place], [STIFFNESS_OVER_DRAG], whole=True)
            for place in local_minima(errors[index].tolist())[:2]
        ]
        found.append(min((objective.fit() for objective in objectives), key=lambda fit: fit.cost).settings)
    replays.report(f"tried {len(tried)} starts")
    return [found[i] for i in _not_much_worse([replays.error(s) for s in found], 2.0, 0.05)]


def _not_much_worse(errors: Sequence[float], times: float, by: float) -> list[int]:
    """Return the indices of the least error, and of those not larger by a factor or by so much [% of length]."""
    least = min(errors)
    return [index for index, error in enumerate(errors) if error <= max(times * least, least + by)]


def local_minima(values: Sequence[float]) -> list[int]:
    """Return where a row of values has local minima, the least first.

    >>> local_minima([3.0, 1.0, 2.0, 0.5])
    [3, 1]
    """
    padded = [np.inf, *values, np.inf]
    lows = [i for i, value in enumerate(values) if value < padded[i] and value <= padded[i + 2]]
    return sorted(lows, key=lambda i: values[i]) or [0]


class Identifiability(NamedTuple):
    """Identifiability of one parameter, with its confidence interval.

    Attributes:
        reason: why it cannot be identified; empty if it can.
        half: half of its 95 % interval, in the scale of the fit.
        effect: of a change that counts, as a share of the length.
    """

    reason: str
    half: float
    effect: float


def estimate_uncertainty(
    solution: FitSolution, runs: Sequence[RecordedRun], columns: Sequence[int]
) -> tuple[Vector, Vector, Table]:
    """Return how well some of a solution's numbers are determined, the others taken as they are.

    Args:
        solution: of a fit.
        runs: that it was fitted to.
        columns: of the numbers.

    Returns:
        Half of the 95 % interval of each, in the scale of the fit, shape (P,); mean size of d residual / d x of each
        that no other makes up for, as a share of the length, shape (P,); and the correlation of their estimates, from
        J' W J, shape (P, P).
    """
    jacobian = [j[..., list(columns)] for j in solution.jacobian]
    flat = np.concatenate([j[run.known] for j, run in zip(jacobian, runs, strict=True)])
    weights = np.concatenate([w[run.known] for w, run in zip(solution.weights, runs, strict=True)])
    size = np.maximum(np.sqrt((weights[:, None] * flat**2).sum(axis=0)), MIN_EFFECT)
    inverse = np.linalg.pinv((flat / size).T @ (weights[:, None] * flat / size), rcond=1e-12, hermitian=True)
    deviation = np.sqrt(np.maximum(np.diag(inverse), 1e-300))
    correlation = np.clip(inverse / np.outer(deviation, deviation), -1.0, 1.0)
    effect = np.array([_own_effect(flat, weights, index) for index in range(len(columns))])
    blocks, whole = [], []  # J' W r of each block of time, and of each run
    for j, r, w, run in zip(jacobian, solution.residuals, solution.weights, runs, strict=True):
        by_frame, block = np.einsum("knp,kn->kp", j / size, w * r), run.blocks
        blocks += [by_frame[block == index].sum(axis=0) for index in np.unique(block)]
        whole.append(by_frame.sum(axis=0))
    half = _half(inverse, np.array(blocks))
    if len(runs) >= 3:
        half = np.maximum(half, _half(inverse, np.array(whole)))
    # All the time, camera, tracker and model may be wrong alike by 5e-4 of the length.
    return half / size + 5e-4 / np.maximum(effect, MIN_EFFECT), effect, correlation


def _half(inverse: Table, scores: Table) -> Vector:
    """Return half of each 95 % interval by the scores of blocks, shape (G, P)."""
    count = len(scores)
    if count < 2:
        return np.full(scores.shape[1], np.inf)
    middle = count / (count - 1.0) * scores.T @ scores
    variance = np.maximum(np.diag(inverse @ middle @ inverse), 0.0)
    return np.asarray(stdtrit(count - 1, 0.975) * np.sqrt(variance))


def _own_effect(flat: Table, weights: Vector, index: int) -> float:
    """Return the mean size of a column of the Jacobian, less what the other columns make up for."""
    own, others = flat[:, index], np.delete(flat, index, axis=1)
    if others.shape[1]:
        root = np.sqrt(weights)[:, None]
        scale = np.maximum(np.linalg.norm(root * others, axis=0), MIN_EFFECT)
        own = own - (others / scale) @ np.linalg.lstsq(root * others / scale, root[:, 0] * own, rcond=None)[0]
    return float(np.abs(own).mean())


def assess_identifiability(solution: FitSolution, runs: Sequence[RecordedRun]) -> list[Identifiability]:
    """Return the identifiability of each parameter of a solution.

    Args:
        solution: of a fit to all that is unknown.
        runs: that it was fitted to.
    """
    parameters, settings = solution.parameters, solution.settings
    counts = np.array([parameter.counts(settings) for parameter in parameters])
    found: dict[int, Identifiability] = {}
    for index, parameter in enumerate(parameters):
        if solution.at_bound(index):
            reason = f"the fit ends at its bound, {parameter.from_fit(float(solution.x[index])):.3g}"
            found[index] = Identifiability(reason, np.inf, 0.0)
    left = [index for index in range(len(parameters)) if index not in found]
    while left:
        halves, effects, correlation = estimate_uncertainty(solution, runs, left)
        half, effect = halves.tolist(), (effects * counts[left]).tolist()
        pairs = np.abs(correlation - np.eye(len(left)))
        if pairs.max() <= 0.95:
            for index, own_half, own_effect in zip(left, half, effect, strict=True):
                reason = _reason(solution, index, own_effect, own_half, runs)
                found[index] = Identifiability(reason, own_half, own_effect)
            break
        one, other = sorted(np.unravel_index(int(pairs.argmax()), pairs.shape), key=lambda place: effect[place])
        name, value = parameters[left[other]].name, correlation[one, other]
        reason = f"cannot be told apart from {name}: correlation {value:.2f}"
        found[left.pop(one)] = Identifiability(reason, half[one], effect[one])
    return [found[index] for index in range(len(parameters))]


def _reason(solution: FitSolution, index: int, effect: float, half: float, runs: Sequence[RecordedRun]) -> str:
    """Return why a parameter cannot be identified; empty if it can."""
    parameter, settings, x = solution.parameters[index], solution.settings, float(solution.x[index])
    length, speed, is_plain = settings.thread_length, min(run.speed for run in runs), parameter.kind == "plain"
    if parameter is STIFFNESS_OVER_DRAG and speed > 0.0:
        bend = float(np.cbrt(parameter.from_fit(x) / speed))
        if bend < 0.07 * length:  # silk of 150 mm has 0.03, polyamide of 19 mm 0.2 to 0.6
            part = f"{1e3 * bend:.1f} mm, {bend / length:.1%} of the thread"
            return f"bending acts within {part} only; elsewhere it goes where it is pulled, however stiff"
    if effect < FLOOR:
        change = f"{parameter.counts(settings):.3g} {parameter.unit}" if is_plain else "a factor of two"
        moved = f"{change} moves the prediction by {100.0 * effect:.2g} % of the length only"
        return f"{moved}, less than the {100.0 * FLOOR:g} % that camera, tracker and model are wrong by"
    if half > (parameter.counts(settings) if is_plain else np.log(1.5)):
        low, high = parameter.interval(x, half)
        return f"its 95 % interval is {low:.3g} to {high:.3g} {parameter.unit}".rstrip() + ", too wide to be of use"
    return ""
