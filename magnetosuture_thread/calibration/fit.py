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
        self._which = tuple(range(len(replays.runs)) if which is None else which)
        self._replays, self._runs = replays, [replays.runs[index] for index in self._which]
        self._residuals = offset_residuals if whole else across_residuals
        self._rough = base.formulation == "paper"
        self._units = np.array([parameter.counts(base) for parameter in parameters])
        self._low, self._high = np.array([parameter.fit_bounds(base) for parameter in parameters]).reshape(-1, 2).T

    def start(self) -> Array:
        """Return the numbers of the base, moved inside of their bounds."""
        x = np.array([parameter.to_fit(parameter.read(self.base)) for parameter in self.parameters])
        margin = 0.01 * np.minimum(self._units, self._high - self._low)
        return np.asarray(np.clip(x, self._low + margin, self._high - margin))

    def settings(self, x: Array) -> ThreadModelSettings:
        """Return the settings of some numbers."""
        settings = self.base
        for parameter, number in zip(self.parameters, x.tolist(), strict=True):
            low, high = parameter.bounds(settings)  # of which a logarithm may miss the last bits
            settings = parameter.write(settings, min(max(parameter.from_fit(number), low), high))
        return settings

    def residuals(self, *points: Array) -> list[list[Array]]:
        """Return the residuals of each run that counts, at each point."""
        found, length = self._replays.of([self.settings(x) for x in points], self._which), self.base.thread_length
        return [
            [self._residuals(v, run, length) for v, run in zip(vertices, self._runs, strict=True)] for vertices in found
        ]

    def jacobian(self, x: Array) -> list[Array]:
        """Return derivatives by difference quotients, away from the nearer bound; shape (K, n, P) of each run."""
        lengths = (ROUGH_STEP if self._rough else STEP) * self._units
        steps = lengths * np.where(x + lengths <= self._high, 1.0, -1.0)
        middle, *moved = self.residuals(x, *(x + np.diag(steps)))
        return [
            np.stack([(end[run] - begin) / step for end, step in zip(moved, steps, strict=True)], axis=-1)
            if moved
            else np.empty((*begin.shape, 0))
            for run, begin in enumerate(middle)
        ]

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
        first = self.start() if start is None else np.clip(start, self._low, self._high)
        x, cost = first, 0.0
        if self._rough and self.parameters:
            x, cost = self._simplex(first)
        elif self.parameters:  # else only the attachment is asked for
            units = self._units
            found = least_squares(
                lambda y: np.concatenate([part.ravel() for part in self.residuals(first + units * y)[0]]),
                np.zeros(len(first)),
                jac=lambda y: (
                    units * np.concatenate([part.reshape(-1, len(first)) for part in self.jacobian(first + units * y)])
                ),
                bounds=((self._low - first) / units - 1e-9, (self._high - first) / units + 1e-9),
                ftol=NO_GAIN,
                xtol=NO_STEP,
                gtol=FLAT,
                loss="linear" if np.isinf(scale) else "soft_l1",
                f_scale=1.0 if np.isinf(scale) else scale,
                max_nfev=MAX_STEPS,
            )
            x, cost = np.clip(first + units * found.x, self._low, self._high), float(found.cost)
        residuals = self.residuals(x)[0]
        return FitSolution(self.settings(x), self.parameters, x, residuals, self.jacobian(x), scale, cost)

    def _simplex(self, first: Array) -> tuple[Array, float]:
        """Return where the mean over the runs of the prediction error is least, and the error [% of length]."""
        low, high, units = self._low, self._high, self._units
        corners = np.vstack([first, first + np.diag(np.where(first + units <= high, units, -units))])

        def error(x: Array) -> float:
            (vertices,), length = self._replays.of([self.settings(x)], self._which), self.base.thread_length
            pairs = zip(vertices, self._runs, strict=True)
            return float(np.mean([mean_error(v, run.targets, length) for v, run in pairs]))

        found = minimize(
            error,
            first,
            method="Nelder-Mead",
            bounds=list(zip(low.tolist(), high.tolist(), strict=True)),
            options={
                "initial_simplex": np.clip(corners, low, high),
                "maxfev": MAX_TRIED,
                "xatol": NEAR_X * float(units.min()),
                "fatol": NEAR_ERROR,
            },
        )
        return np.clip(found.x, low, high), float(found.fun)


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
    bases, count = [replace(start, attachment=kind) for kind in kinds], len(replays.runs)
    if start.formulation == "paper":  # whose error has several minima in kappa and W_stiff
        tried = [start]
        for parameter, values in ((DAMPING, DAMPINGS), (STIFFNESS_WEIGHT, WEIGHTS)):
            if parameter in parameters:
                tried = [parameter.write(settings, value) for settings in tried for value in values]
        replays.begin_stage("starts", count * len(tried))
        replays.of(tried)
        found = [min(tried, key=replays.error)]
    elif STIFFNESS_OVER_DRAG in parameters:
        tried = []
        for base in bases:
            low, high = STIFFNESS_OVER_DRAG.bounds(base)
            stiffnesses = np.clip(np.array(STARTS) * stiffness_over_drag(base), low, high).tolist()
            tried += [with_stiffness_over_drag(base, stiffness) for stiffness in stiffnesses]
        replays.begin_stage("starts", count * len(bases) * (len(STARTS) + MAX_STARTS * 8))
        replays.of(tried)  # at once, so that all cores have work
        errors = np.array([replays.error(settings) for settings in tried]).reshape(len(bases), -1)
        found = []
        for index in _not_much_worse(errors.min(axis=1).tolist(), POOR, MUCH):
            objectives = [
                Objective(replays, tried[index * len(STARTS) + place], [STIFFNESS_OVER_DRAG], whole=True)
                for place in local_minima(errors[index].tolist())[:MAX_STARTS]
            ]
            found.append(min((objective.fit() for objective in objectives), key=lambda fit: fit.cost).settings)
        found = [found[i] for i in _not_much_worse([replays.error(s) for s in found], WORSE_TIMES, WORSE_BY)]
    else:
        return bases
    replays.end_stage(f"tried {len(tried)} starts")
    return found


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
