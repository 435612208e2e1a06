"""Which numbers the data can tell, and why not the others.

A number cannot be identified where

- the fit ends at its bound;
- its estimate goes with another's: |correlation| > `COLLINEAR`; the one with less effect is given up;
- half of its 95 % interval is wider than `Parameter.widest`: a factor of 1.5 for what is positive;
- its effect is too small to build on: a change that counts, a factor of two for what is positive, moves the predicted
  thread by less than `FLOOR` of its length that no other number makes up for. That is what the whole chain of
  camera, tracker and model is wrong by (0.05 to 0.2 %, docs/results.md), so such an estimate may come from the chain
  itself;
- it is the stiffness, and acts within a small part of the thread only. Behind a needle of speed V bending and drag
  are in balance over the length

      l = (B / V)^(1/3)

  at its ends and in tight bends; elsewhere the thread goes where it is pulled, however stiff. Within a part l / L of
  less than `SHORTEST_BEND` how it is tied, its knot and the model's segments matter as much.

The effect that others make up for counts for nothing, because what they are is not known either.

Source: l by scaling, zeta_perp V ~ EI / l^3. Deviation: none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from magnetosuture_thread.calibration.fit import FitSolution
from magnetosuture_thread.calibration.parameters import STIFFNESS_OVER_DRAG
from magnetosuture_thread.calibration.passage import Passage
from magnetosuture_thread.calibration.uncertainty import uncertainty_of

COLLINEAR = 0.95
FLOOR = 2e-3  # of the length
MIN_BEND = 0.07  # of the length; silk of 150 mm has 0.03, polyamide of 19 mm 0.2 to 0.6


@dataclass(frozen=True)
class Identifiability:
    """What the data say of one number.

    Attributes:
        reason: why it cannot be identified; empty if it can.
        half: half of its 95 % interval, in the scale of the fit.
        effect: of a change that counts, as a share of the length.
    """

    reason: str
    half: float
    effect: float

    @property
    def identified(self) -> bool:
        """Whether the data tell the number."""
        return not self.reason


def assess_identifiability(solution: FitSolution, passages: Sequence[Passage]) -> list[Identifiability]:
    """Return what the data say of each of a solution's numbers.

    Args:
        solution: of a fit to all that is unknown.
        passages: that it was fitted to.
    """
    parameters, settings = solution.parameters, solution.settings
    counts = [parameter.counts(settings) for parameter in parameters]
    verdicts: dict[int, Identifiability] = {}
    left = list(range(len(parameters)))
    for index in list(left):
        if solution.at_bound(index):
            ending = f"the fit ends at its bound, {parameters[index].from_fit(float(solution.x[index])):.3g}"
            verdicts[index] = Identifiability(ending, np.inf, 0.0)
            left.remove(index)
    while left:
        uncertainty = uncertainty_of(solution, passages, left)
        pairs = np.abs(uncertainty.correlation - np.eye(len(left)))
        if pairs.max() <= COLLINEAR:
            break
        pair = np.unravel_index(int(pairs.argmax()), pairs.shape)
        one, other = sorted(pair, key=lambda place: uncertainty.effect[place] * counts[left[place]])
        name, value = parameters[left[other]].name, uncertainty.correlation[one, other]
        reason = f"cannot be told apart from {name}: correlation {value:.2f}"
        verdicts[left[one]] = Identifiability(
            reason, float(uncertainty.half[one]), float(uncertainty.effect[one] * counts[left[one]])
        )
        del left[one]
    for place, index in enumerate(left):
        effect, half = float(uncertainty.effect[place] * counts[index]), float(uncertainty.half[place])
        reason = _too_short(solution, index, passages) or _reason(solution, index, effect, half)
        verdicts[index] = Identifiability(reason, half, effect)
    return [verdicts[index] for index in range(len(parameters))]


def _reason(solution: FitSolution, index: int, effect: float, half: float) -> str:
    parameter, settings = solution.parameters[index], solution.settings
    if effect < FLOOR:
        change = (
            "a factor of two" if parameter.kind != "plain" else f"{parameter.counts(settings):.3g} {parameter.unit}"
        )
        moved = f"{change} moves the prediction by {100.0 * effect:.2g} % of the length only"
        return f"{moved}, less than the {100.0 * FLOOR:g} % that camera, tracker and model are wrong by"
    if half > parameter.widest(settings):
        low, high = parameter.interval(float(solution.x[index]), half)
        return f"its 95 % interval is {low:.3g} to {high:.3g} {parameter.unit}".rstrip() + ", too wide to be of use"
    return ""


def _too_short(solution: FitSolution, index: int, passages: Sequence[Passage]) -> str:
    """Return in words that the stiffness acts on too small a part of the thread; empty if it does not."""
    parameter, length = solution.parameters[index], solution.settings.thread_length
    speed = min(passage.speed for passage in passages)
    if parameter is not STIFFNESS_OVER_DRAG or speed <= 0.0:
        return ""
    bend = float(np.cbrt(parameter.from_fit(float(solution.x[index])) / speed))
    if bend >= MIN_BEND * length:
        return ""
    part = f"{1e3 * bend:.1f} mm, {bend / length:.1%} of the thread"
    return f"bending acts within {part} only; elsewhere it goes where it is pulled, however stiff"
