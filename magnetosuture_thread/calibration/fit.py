"""Least squares over replays of recorded runs, and the initial guesses it starts from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, minimize

from magnetosuture_thread.calibration.parameters import (
    DAMPING,
    STIFFNESS_OVER_DRAG,
    STIFFNESS_WEIGHT,
    Parameter,
    stiffness_over_drag,
    with_stiffness_over_drag,
)
from magnetosuture_thread.calibration.residuals import Replays, across_residuals, mean_error, offset_residuals
from magnetosuture_thread.thread.material import Attachment
from magnetosuture_thread.thread_model.settings import ThreadModelSettings

Array = NDArray[np.float64]

STEP, ROUGH_STEP = 0.01, 0.5  # of the change that counts, in difference quotients; the second for `paper`
NO_GAIN, NO_STEP, FLAT = 1e-4, 1e-3, 1e-10  # of cost, numbers and gradient, where a fit ends
MAX_STEPS = 15
MAX_TRIED, NEAR_X, NEAR_ERROR = 60, 0.05, 0.005  # of the simplex; changes that count, and % of length, where it ends
OUTLIER = 3.0  # scatters; beyond, a residual counts by its size only, not by its square
STARTS = tuple(10.0 ** (power / 1.5) for power in range(-3, 4))  # of the material's stiffness
MAX_STARTS = 2  # of them, of each attachment, are fitted: the best local minima
DAMPINGS = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99)  # kappa
WEIGHTS = (1e-4, 1e-2, 1.0, 1e2, 1e4, 1e6)  # W_stiff
POOR, MUCH = 3.0, 1.0  # times the better error, and % of length more, where an attachment is given up after the starts
WORSE_TIMES, WORSE_BY = 2.0, 0.05  # the same once the stiffness of each has been fitted
MIN_SCALE = 1e-3  # of the thread's length, below which nothing is an outlier


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
    x: Array
    residuals: list[Array]
    jacobian: list[Array]
    scale: float
    cost: float

    @property
    def weights(self) -> list[Array]:
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
        self.which = tuple(range(len(replays.runs)) if which is None else which)
        self._replays, self._residuals = replays, offset_residuals if whole else across_residuals
        self._rough = base.formulation == "paper"
        self._units = np.array([parameter.counts(base) for parameter in parameters])
        bounds = [parameter.fit_bounds(base) for parameter in parameters]
        self.low, self.high = np.array([low for low, _ in bounds]), np.array([high for _, high in bounds])

    def start(self) -> Array:
        """Return the numbers of the base, moved inside of their bounds."""
        x = np.array([parameter.to_fit(parameter.read(self.base)) for parameter in self.parameters])
        margin = 0.01 * np.minimum(self._units, self.high - self.low)
        return np.asarray(np.clip(x, self.low + margin, self.high - margin))

    def settings(self, x: Array) -> ThreadModelSettings:
        """Return the settings of some numbers."""
        settings = self.base
        for parameter, number in zip(self.parameters, x.tolist(), strict=True):
            low, high = parameter.bounds(settings)  # of which a logarithm may miss the last bits
            settings = parameter.write(settings, min(max(parameter.from_fit(number), low), high))
        return settings

    def residuals(self, x: Array) -> list[Array]:
        """Return the residuals of each run that counts."""
        return self._many([x])[0]

    def jacobian(self, x: Array) -> list[Array]:
        """Return derivatives by difference quotients, away from the nearer bound; shape (K, n, P) of each run."""
        lengths = (ROUGH_STEP if self._rough else STEP) * self._units
        steps = lengths * np.where(x + lengths <= self.high, 1.0, -1.0)
        middle, *moved = self._many([x, *(x + step * row for step, row in zip(steps, np.eye(len(x)), strict=True))])
        slopes = [np.empty((*part.shape, len(x))) for part in middle]
        for column, (other, step) in enumerate(zip(moved, steps, strict=True)):
            for slope, end, begin in zip(slopes, other, middle, strict=True):
                slope[..., column] = (end - begin) / step
        return slopes

    def _many(self, points: Sequence[Array]) -> list[list[Array]]:
        settings = [self.settings(x) for x in points]
        found = self._replays.of(settings, self.which)
        runs = [self._replays.runs[index] for index in self.which]
        length = self.base.thread_length
        return [[self._residuals(v, p, length) for v, p in zip(vertices, runs, strict=True)] for vertices in found]

    def fit(self, start: Array | None = None, scale: float = np.inf) -> FitSolution:
        """Return the best numbers near a start.

            min over x  sum rho(r(x)^2 / scale^2),    rho(z) = 2 (sqrt(1 + z) - 1)

        Args:
            start: numbers to begin with; those of the base if None.
            scale: of the robust loss, as a share of the length; inf for plain least squares.

        For the formulation `paper`, whose predictions jump by 0.01 % of the length from one number to the next, the
        simplex of Nelder and Mead makes the mean prediction error least instead.

        Source: nonlinear least squares by scipy, trust region reflective; J. A. Nelder, R. Mead, Computer Journal 7
        (1965).
        """
        first = self.start() if start is None else np.clip(start, self.low, self.high)
        if not self.parameters:  # as where only the attachment is asked for
            return self._solution(first, 0.0, scale)
        if self._rough:
            return self._solution(*self._simplex(first), scale)
        units = self._units

        def flat(parts: list[Array], columns: int = 0) -> Array:
            return np.concatenate([part.reshape((-1, columns) if columns else -1) for part in parts])

        def residuals(y: Array) -> Array:
            return flat(self.residuals(first + units * y))

        def jacobian(y: Array) -> Array:
            return np.asarray(flat(self.jacobian(first + units * y), len(first)) * units)

        found = least_squares(
            residuals,
            np.zeros(len(first)),
            jac=jacobian,
            bounds=((self.low - first) / units - 1e-9, (self.high - first) / units + 1e-9),
            ftol=NO_GAIN,
            xtol=NO_STEP,
            gtol=FLAT,
            loss="linear" if np.isinf(scale) else "soft_l1",
            f_scale=1.0 if np.isinf(scale) else scale,
            max_nfev=MAX_STEPS,
        )
        x = np.clip(first + units * found.x, self.low, self.high)
        return self._solution(x, float(found.cost), scale)

    def _simplex(self, first: Array) -> tuple[Array, float]:
        corners = np.vstack(
            [first, first + np.diag(np.where(first + self._units <= self.high, 1.0, -1.0) * self._units)]
        )
        found = minimize(
            self._error,
            first,
            method="Nelder-Mead",
            bounds=list(zip(self.low.tolist(), self.high.tolist(), strict=True)),
            options={
                "initial_simplex": np.clip(corners, self.low, self.high),
                "maxfev": MAX_TRIED,
                "xatol": NEAR_X * float(self._units.min()),
                "fatol": NEAR_ERROR,
            },
        )
        return np.clip(found.x, self.low, self.high), float(found.fun)

    def _error(self, x: Array) -> float:
        """Return the mean over the runs of the prediction error [% of length]."""
        settings = self.settings(x)
        runs = [self._replays.runs[index] for index in self.which]
        pairs = zip(self._replays.of([settings], self.which)[0], runs, strict=True)
        return float(np.mean([mean_error(v, p.targets, settings.thread_length) for v, p in pairs]))

    def _solution(self, x: Array, cost: float, scale: float) -> FitSolution:
        return FitSolution(self.settings(x), self.parameters, x, self.residuals(x), self.jacobian(x), scale, cost)


def robust_scale(residuals: Sequence[Array]) -> float:
    """Return the scale of the robust loss: three times the scatter of the residuals, by their median size."""
    sizes = np.abs(np.concatenate([part[part != 0.0] for part in residuals]))
    middle = float(np.median(sizes)) if len(sizes) else 0.0
    return max(OUTLIER * 1.4826 * middle, MIN_SCALE)


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
    if start.formulation == "paper":
        return [_best_on_grid(replays, start, parameters)]
    if STIFFNESS_OVER_DRAG not in parameters:
        return bases
    count = len(replays.runs)
    replays.begin_stage("starts", count * len(bases) * (len(STARTS) + MAX_STARTS * 8))
    tried = [started for base in bases for started in _started(base)]
    replays.of(tried)  # at once, so that all cores have work
    errors = np.array([replays.error(settings) for settings in tried]).reshape(len(bases), -1)
    found = []
    for index in _not_much_worse(errors.min(axis=1).tolist(), POOR, MUCH):
        objectives = [
            Objective(replays, tried[index * len(STARTS) + place], [STIFFNESS_OVER_DRAG], whole=True)
            for place in local_minima(errors[index].tolist())[:MAX_STARTS]
        ]
        found.append(min((objective.fit() for objective in objectives), key=lambda fit: fit.cost).settings)
    replays.end_stage(f"tried {len(tried)} starts")
    return [found[i] for i in _not_much_worse([replays.error(s) for s in found], WORSE_TIMES, WORSE_BY)]


def _best_on_grid(replays: Replays, start: ThreadModelSettings, parameters: Sequence[Parameter]) -> ThreadModelSettings:
    """Return the best start of the formulation `paper`, whose error has several minima in kappa and W_stiff."""
    tried = [start]
    for parameter, values in ((DAMPING, DAMPINGS), (STIFFNESS_WEIGHT, WEIGHTS)):
        if parameter in parameters:
            tried = [parameter.write(settings, value) for settings in tried for value in values]
    replays.begin_stage("starts", len(replays.runs) * len(tried))
    replays.of(tried)
    best = min(tried, key=replays.error)
    replays.end_stage(f"tried {len(tried)} starts")
    return best


def _started(base: ThreadModelSettings) -> list[ThreadModelSettings]:
    """Return settings with each of the stiffnesses to start from."""
    low, high = STIFFNESS_OVER_DRAG.bounds(base)
    middle = stiffness_over_drag(base)
    return [with_stiffness_over_drag(base, float(np.clip(factor * middle, low, high))) for factor in STARTS]


def _not_much_worse(errors: Sequence[float], times: float, by: float) -> list[int]:
    """Return the indices of the least error, and of those not larger by a factor or by so much."""
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
