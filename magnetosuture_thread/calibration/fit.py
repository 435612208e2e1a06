"""Least squares over replays: the numbers with which the predictions are nearest to the threads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, minimize

from magnetosuture_thread.calibration.parameters import Parameter
from magnetosuture_thread.calibration.replays import Replays, across, apart, mean_error
from magnetosuture_thread.model.settings import ThreadModelSettings

Array = NDArray[np.float64]

STEP, ROUGH_STEP = 0.01, 0.5  # of the change that counts, in difference quotients; the second for `paper`
NO_GAIN, NO_STEP, FLAT = 1e-4, 1e-3, 1e-10  # of cost, numbers and gradient, where a fit ends
MAX_STEPS = 15
MOST_TRIED, NEAR_X, NEAR_ERROR = 60, 0.05, 0.005  # of the simplex; changes that count, and % of length, where it ends
OUTLIER = 3.0  # scatters; beyond, a residual counts by its size only, not by its square
MIN_SCALE = 1e-3  # of the thread's length, below which nothing is an outlier


@dataclass(frozen=True)
class FitSolution:
    """Where a fit ended.

    Attributes:
        settings: with the fitted numbers.
        parameters: that were fitted.
        x: their numbers, in the scale of the fit, shape (P,).
        residuals: of each passage, shape (K, n).
        jacobian: of each passage, d residual / d x, shape (K, n, P).
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
        """Weight of each residual: rho'((r / scale)^2) of the robust loss, shape (K, n) for each passage."""
        return [1.0 / np.sqrt(1.0 + (r / self.scale) ** 2) for r in self.residuals]

    def at_bound(self, index: int) -> bool:
        """Whether a number ended at a bound."""
        parameter = self.parameters[index]
        low, high = parameter.fit_bounds(self.settings)
        near = 0.02 * parameter.counts(self.settings)
        return not low + near < self.x[index] < high - near


class Objective:
    """Residuals and their derivatives over some parameters and passages.

    Args:
        replays: of all passages.
        base: settings that the parameters change.
        parameters: to fit.
        which: passages that count; all if None.
        whole: whether residuals are those of `apart`, in both directions, and not those of `across`.
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
        self.which = tuple(range(len(replays.passages)) if which is None else which)
        self._replays, self._distance = replays, apart if whole else across
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
        """Return the residuals of each passage that counts."""
        return self._many([x])[0]

    def jacobian(self, x: Array) -> list[Array]:
        """Return derivatives by difference quotients, away from the nearer bound; shape (K, n, P) of each passage."""
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
        passages = [self._replays.passages[index] for index in self.which]
        length = self.base.thread_length
        return [[self._distance(v, p, length) for v, p in zip(vertices, passages, strict=True)] for vertices in found]

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
                "maxfev": MOST_TRIED,
                "xatol": NEAR_X * float(self._units.min()),
                "fatol": NEAR_ERROR,
            },
        )
        return np.clip(found.x, self.low, self.high), float(found.fun)

    def _error(self, x: Array) -> float:
        """Return the mean over the passages of the prediction error [% of length]."""
        settings = self.settings(x)
        passages = [self._replays.passages[index] for index in self.which]
        pairs = zip(self._replays.of([settings], self.which)[0], passages, strict=True)
        return float(np.mean([mean_error(v, p.targets, settings.thread_length) for v, p in pairs]))

    def _solution(self, x: Array, cost: float, scale: float) -> FitSolution:
        return FitSolution(self.settings(x), self.parameters, x, self.residuals(x), self.jacobian(x), scale, cost)


def scale_of(residuals: Sequence[Array]) -> float:
    """Return the scale of the robust loss: three times the scatter of the residuals, by their median size."""
    sizes = np.abs(np.concatenate([part[part != 0.0] for part in residuals]))
    middle = float(np.median(sizes)) if len(sizes) else 0.0
    return max(OUTLIER * 1.4826 * middle, MIN_SCALE)
