"""Where a calibration starts: numbers tried all over what is possible, and the best of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from magnetosuture_thread.calibration.fit import Objective
from magnetosuture_thread.calibration.parameters import (
    DAMPING,
    STIFFNESS_OVER_DRAG,
    STIFFNESS_WEIGHT,
    Parameter,
    stiffness_over_drag,
    with_stiffness_over_drag,
)
from magnetosuture_thread.calibration.replays import Replays
from magnetosuture_thread.calibration.stages import Stages
from magnetosuture_thread.model.settings import ThreadModelSettings
from magnetosuture_thread.model.thread import Attachment

STARTS = tuple(10.0 ** (power / 1.5) for power in range(-3, 4))  # of the material's stiffness
MAX_STARTS = 2  # of them, of each attachment, are fitted: the best local minima
DAMPINGS = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99)  # kappa
WEIGHTS = (1e-4, 1e-2, 1.0, 1e2, 1e4, 1e6)  # W_stiff
POOR, MUCH = 3.0, 1.0  # times the better error, and % of length more, where an attachment is given up after the starts
WORSE_TIMES, WORSE_BY = 2.0, 0.05  # the same once the stiffness of each has been fitted


def starts(
    replays: Replays, start: ThreadModelSettings, parameters: Sequence[Parameter], both: bool, stages: Stages
) -> list[ThreadModelSettings]:
    """Return the best start of each attachment that may be right.

    Stiffnesses from a hundredth to a hundred times the material's are tried with each attachment, and the best local
    minima fitted, all else as the set-up has it, by the whole distance of prediction and thread.

    Args:
        replays: of all passages.
        start: what the set-up says.
        parameters: that will be fitted.
        both: whether the attachment is asked for.
        stages: is told how far it is.
    """
    kinds = [kind.value for kind in Attachment] if both else [start.attachment]
    bases = [replace(start, attachment=kind) for kind in kinds]
    if start.formulation == "paper":
        return [_best_on_grid(replays, start, parameters, stages)]
    if STIFFNESS_OVER_DRAG not in parameters:
        return bases
    count = len(replays.passages)
    stages.begin("starts", count * len(bases) * (len(STARTS) + MAX_STARTS * 8))
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
    stages.end(f"tried {len(tried)} starts")
    return [found[i] for i in _not_much_worse([replays.error(s) for s in found], WORSE_TIMES, WORSE_BY)]


def _best_on_grid(
    replays: Replays, start: ThreadModelSettings, parameters: Sequence[Parameter], stages: Stages
) -> ThreadModelSettings:
    """Return the best start of the formulation `paper`, whose error has several minima in kappa and W_stiff."""
    tried = [start]
    for parameter, values in ((DAMPING, DAMPINGS), (STIFFNESS_WEIGHT, WEIGHTS)):
        if parameter in parameters:
            tried = [parameter.write(settings, value) for settings in tried for value in values]
    stages.begin("starts", len(replays.passages) * len(tried))
    replays.of(tried)
    best = min(tried, key=replays.error)
    stages.end(f"tried {len(tried)} starts")
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
