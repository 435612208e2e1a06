"""One thread material from many bags: a stiffness over drag that all share, and the viscosity of each bag's liquid.

Each bag k gives x_k = log B_k, B = EI / zeta_perp, with a standard error s_k by blocks of time. The thread is the same
in all, the liquid is not quite: its viscosity varies with temperature and mixture, and B_k goes with its inverse. With

    x_k = mu + u_k + e_k,    u_k ~ N(0, tau^2),    e_k ~ N(0, s_k^2)

exp(mu) is the stiffness over drag in the fleet's mean liquid, and exp(-u_k) the viscosity of bag k over that mean. The
mean itself cannot be told, as only the ratio of stiffness and drag moves a thread: it is taken to be the setup's
viscosity. u_k is estimated by x_k - mu, whose error does not depend on tau: drawn towards 0 by the estimate of tau, as
is usual for many bags, the intervals of eight held the true value in 82 % of the cases only.

Source: tau by moments, R. DerSimonian, N. Laird, Controlled Clinical Trials 7 (1986); the interval of mu by J. Hartung,
G. Knapp, Statistics in Medicine 20 (2001). Deviation: the variance of mu is never taken below that of the first source;
what camera, tracker and model are wrong by in all bags alike (`CHAIN`) comes on top, because no number of bags averages
it out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import ndtri, stdtrit

from magnetosuture_thread.calibration.fit import Array
from magnetosuture_thread.calibration.identifiability import CHAIN
from magnetosuture_thread.calibration.parameters import STIFFNESS_OVER_DRAG
from magnetosuture_thread.calibration.recorded_run import BLOCKS
from magnetosuture_thread.calibration.result import CalibrationResult, Estimate
from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.evaluation.metrics import finite_or_none

MIN_BAGS = 3  # with an interval; of two nobody can tell how much bags differ


@dataclass(frozen=True)
class FleetMean:
    """A mean that bags share, and how each differs from it.

    Attributes:
        mean: mu.
        half: half of its 95 % interval, without what all bags are wrong by alike.
        scatter: tau, the standard deviation of bags.
        offsets: u_k of each bag, shape (K,).
        offset_halves: half of the 95 % interval of each, shape (K,).
    """

    mean: float
    half: float
    scatter: float
    offsets: Array
    offset_halves: Array


def fleet_mean(values: Array, errors: Array) -> FleetMean:
    """Return the mean of bags that differ by more than their errors.

    Args:
        values: x_k, shape (K,), K >= 2.
        errors: s_k, shape (K,), positive.
    """
    count, variances = len(values), errors**2
    weights = 1.0 / variances
    fixed = float(np.average(values, weights=weights))
    excess = float((weights * (values - fixed) ** 2).sum()) - (count - 1)
    between = max(0.0, excess / float(weights.sum() - (weights**2).sum() / weights.sum()))
    weights = 1.0 / (variances + between)
    mean = float(np.average(values, weights=weights))
    spread = float((weights * (values - mean) ** 2).sum()) / (count - 1)
    variance = max(1.0, spread) / float(weights.sum())
    # Of e_k - (the error of mu), which e_k has a part in.
    offset_variance = variances * (1.0 - 2.0 * weights / weights.sum()) + variance
    return FleetMean(
        mean,
        float(stdtrit(count - 1, 0.975)) * math.sqrt(variance),
        math.sqrt(between),
        values - mean,
        float(ndtri(0.975)) * np.sqrt(offset_variance),
    )


@dataclass(frozen=True)
class FleetBag:
    """One bag of a fleet.

    Attributes:
        name: of the bag.
        simulated: what of it is simulated; empty if nothing says so, or it could not be fitted.
        stiffness_over_drag: B_k by this bag alone [m^4/s]; not a number where it tells none.
        viscosity: of its liquid over the fleet's mean, and the ends of its 95 % interval; None where it tells none.
        reason: why it tells none; else empty.
        error: of the prediction, calibrated by this bag alone, mean over time [% of length]; not a number where it
            could not be fitted.
    """

    name: str
    simulated: str
    stiffness_over_drag: float
    viscosity: tuple[float, float, float] | None
    reason: str
    error: float

    @classmethod
    def unfitted(cls, name: str, reason: str) -> FleetBag:
        """Return a bag that could not be read or fitted, with the reason."""
        return cls(name, "", math.nan, None, reason, math.nan)


@dataclass(frozen=True)
class FleetResult:
    """What a calibration over a fleet found.

    Attributes:
        estimate: of the stiffness over drag, with its 95 % interval.
        scatter: standard deviation of the bags' viscosities, as a share.
        bags: in the order in which they were given.
    """

    estimate: Estimate
    scatter: float
    bags: tuple[FleetBag, ...]

    def to_json(self) -> dict[str, Any]:
        """Return all as plain values; None for what is not known."""
        found = self.estimate
        return {
            "stiffness_over_drag": {"value": found.value, "low": found.low, "high": found.high, "start": found.start},
            "viscosity_scatter": self.scatter,
            "bags": [{name: finite_or_none(value) for name, value in vars(bag).items()} for bag in self.bags],
        }


def calibrate_fleet(fits: Sequence[CalibrationResult | FleetBag]) -> FleetResult:
    """Return what bags tell together, each of which was calibrated by itself.

    Args:
        fits: of one bag each, all from the same settings, with the stiffness over drag among what was fitted; for a
            bag that could not be fitted `FleetBag.unfitted`, which is kept as it is.

    Raises:
        InvalidInputError: fewer than `MIN_BAGS` bags tell a stiffness.
    """
    results = [fit for fit in fits if isinstance(fit, CalibrationResult)]
    found = [next(e for e in result.estimates if e.name == STIFFNESS_OVER_DRAG.name) for result in results]
    told = [index for index, estimate in enumerate(found) if math.isfinite(estimate.low) and estimate.low > 0.0]
    if len(told) < MIN_BAGS:
        unfitted = {bag.name: bag.reason for bag in fits if isinstance(bag, FleetBag)}
        told_none = {result.scores[0].name: each.reason for result, each in zip(results, found, strict=True)}
        reasons = _by_reason({**unfitted, **told_none})
        expected = f"at least {MIN_BAGS}" + (f": {reasons}" if reasons else "")
        raise InvalidInputError("bags", f"{len(told)} that tell the stiffness over drag", expected)
    low, high = (np.log([getattr(found[index], end) for index in told]) for end in ("low", "high"))
    settings = results[0].start
    change = STIFFNESS_OVER_DRAG.counts(settings)
    chain = np.array([CHAIN * change / max(1e-2 * found[index].effect_percent, 1e-9) for index in told])
    own = np.maximum(0.5 * (high - low) - chain, 1e-6)
    pooled = fleet_mean(0.5 * (low + high), own / float(stdtrit(BLOCKS - 1, 0.975)))
    half = pooled.half + float(chain.mean())
    ends = math.exp(pooled.mean - half), math.exp(pooled.mean + half)
    parameter = STIFFNESS_OVER_DRAG
    estimate = Estimate(
        parameter.name,
        parameter.setting,
        parameter.unit,
        math.exp(pooled.mean),
        found[0].start,
        *ends,
        logarithmic=True,
    )
    fitted = []
    for index, (result, each) in enumerate(zip(results, found, strict=True)):
        value, viscosity = math.nan, None
        if index in told:
            place = told.index(index)
            value = math.exp(0.5 * float(low[place] + high[place]))
            offset, around = float(pooled.offsets[place]), float(pooled.offset_halves[place])
            viscosity = (math.exp(-offset), math.exp(-offset - around), math.exp(around - offset))
        reason = "" if viscosity else each.reason
        fitted.append(FleetBag(result.scores[0].name, result.simulated[0], value, viscosity, reason, result.error))
    in_order = iter(fitted)
    bags = tuple(fit if isinstance(fit, FleetBag) else next(in_order) for fit in fits)
    return FleetResult(estimate, pooled.scatter, bags)


def _by_reason(reasons: Mapping[str, str]) -> str:
    """Return the reasons of bags in words, each once with the names of its bags; those without one are left out."""
    names: dict[str, list[str]] = {}
    for name, reason in reasons.items():
        if reason:
            names.setdefault(reason, []).append(name)
    return "; ".join(f"{', '.join(those)}: {reason}" for reason, those in names.items())
