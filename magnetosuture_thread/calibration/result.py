"""The result of a calibration: estimates, attachment, and errors of each bag before and after."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from magnetosuture_thread.calibration.recorded_run import RecordedRun
from magnetosuture_thread.calibration.residuals import mean_across, mean_error
from magnetosuture_thread.evaluation.metrics import finite_or_none
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.thread_model.settings import ThreadModelSettings

WORSE = 1.05  # times the error before, from which on a person should know
IDENTIFIED, FIXED, STAND_IN, UNFINISHED = "identified", "fixed", "stand-in", "unfinished"


@dataclass(frozen=True)
class Estimate:
    """Identifiability of one parameter, with its confidence interval.

    Attributes:
        name: for a person.
        setting: the field of the settings that it belongs to.
        unit: of the values.
        value: that is used from now on.
        start: what the setup and the material say.
        low: lower end of the 95 % interval of the fit to all that is unknown; not a number where there is none.
        high: upper end.
        status: `identified`; `fixed` at what the setup says, as the data cannot tell; `stand-in`: the data cannot
            tell it, but contradict what the setup says, or it predicts worse, so that the fitted one stands in; or
            `unfinished`.
        reason: why it cannot be identified; else empty.
        effect_percent: how far a change that counts moves the prediction, what others make up for left out
            [% of length].
        logarithmic: whether a logarithmic scale shows it best.
    """

    name: str
    setting: str
    unit: str
    value: float
    start: float
    low: float = math.nan
    high: float = math.nan
    status: str = IDENTIFIED
    reason: str = ""
    effect_percent: float = math.nan
    logarithmic: bool = False


@dataclass(frozen=True)
class AttachmentDecision:
    """Which attachment fits better.

    Attributes:
        value: that is used.
        start: what the setup says.
        errors: mean distance across the thread with each that was fitted [% of length].
        reason: why they cannot be told apart; empty where they can.
        looked: whether both were fitted.
    """

    value: str
    start: str
    errors: dict[str, float]
    reason: str = ""
    looked: bool = True


@dataclass(frozen=True)
class BagErrors:
    """Prediction errors of one bag, mean over time [% of length]; not a number where there is none.

    Attributes:
        name: of the bag.
        frames: that were compared.
        before: with what the setup says, against what was fitted to.
        after: calibrated.
        held_out: calibrated by the other bags.
        truth_before: against the truth, with what the setup says.
        truth_after: calibrated.
        truth_held_out: calibrated by the other bags.
        across_before: mean distance across the thread, with what the setup says.
        across_after: calibrated; this is what was made least.
        unverified: why any message of the bag may be wrong; empty if nothing speaks against them.
    """

    name: str
    frames: int
    before: float
    after: float
    held_out: float = math.nan
    truth_before: float = math.nan
    truth_after: float = math.nan
    truth_held_out: float = math.nan
    across_before: float = math.nan
    across_after: float = math.nan
    unverified: str = field(default="", kw_only=True)

    @property
    def warning(self) -> str:
        """Warning about a bag whose nodes fit worse than before; empty if there is none."""
        if not self.after > WORSE * self.before:
            return ""
        better = self.across_after <= self.across_before
        end = "what is left lies along it, where noise moves the measured thread" if better else "do not use"
        nodes = f"the nodes are {self.after:.3g} % of the length off after the fit, {self.before:.3g} % before"
        across = f"{self.across_after:.3g} % after, {self.across_before:.3g} % before"
        return f"{self.name}: {nodes}; across the thread, which is what was fitted, {across}: {end}"


@dataclass(frozen=True)
class BagFit:
    """One bag before and after, for the picture.

    Attributes:
        run: the bag.
        before: predicted nodes with what the setup says, shape (K, n + 1, 2) [m].
        after: calibrated.
    """

    run: RecordedRun
    before: Points
    after: Points


@dataclass(frozen=True)
class CalibrationResult:
    """What a calibration found.

    Attributes:
        settings: of the thread model, calibrated.
        start: what the setup and the material say.
        against: `seen` or `truth`.
        estimates: of all numbers that were asked for.
        attachment: which fits better; None if it was not asked for.
        scores: of each bag.
        simulated: what of each bag is simulated; empty for what nothing says so of.
        replays: how many runs were replayed.
        finished: whether it came to its end; else this is the best so far.
    """

    settings: ThreadModelSettings
    start: ThreadModelSettings
    against: str
    estimates: tuple[Estimate, ...]
    attachment: AttachmentDecision | None
    scores: tuple[BagErrors, ...]
    simulated: tuple[str, ...]
    replays: int
    finished: bool = True

    @classmethod
    def of(
        cls,
        settings: ThreadModelSettings,
        start: ThreadModelSettings,
        fits: Sequence[BagFit],
        estimates: tuple[Estimate, ...],
        attachment: AttachmentDecision | None,
        replays: int,
        held_out: Sequence[Points | None] | None = None,
        finished: bool = True,
    ) -> CalibrationResult:
        """Return the result of fits of some bags; `held_out` as in `bag_errors`."""
        scores, simulated = bag_errors(fits, start.thread_length, held_out), tuple(fit.run.simulated for fit in fits)
        against = fits[0].run.against
        return cls(settings, start, against, estimates, attachment, scores, simulated, replays, finished)

    @property
    def warnings(self) -> list[str]:
        """Warnings for the user."""
        lines = []
        for estimate in self.estimates:
            if estimate.status == STAND_IN:
                lines.append(
                    f"{estimate.name} cannot be identified in this data: {estimate.reason}; {estimate.value:.4g} "
                    f"{estimate.unit}".rstrip()
                    + " stands in, as it predicts better than what the setup says"
                )
            elif estimate.reason:
                lines.append(f"{estimate.name} cannot be identified in this data: {estimate.reason}")
        if self.attachment is not None and self.attachment.reason:
            lines.append(f"the attachment cannot be told: {self.attachment.reason}")
        lines += [f"{score.name} is unverified: {score.unverified}" for score in self.scores if score.unverified]
        return lines + [score.warning for score in self.scores if score.warning]

    @property
    def error(self) -> float:
        """Mean over the bags of the prediction error, calibrated [% of length]."""
        return float(np.mean([score.after for score in self.scores]))

    def to_json(self) -> dict[str, Any]:
        """Return all as plain values; None for what is not known."""
        return {
            "finished": self.finished,
            "material": self.settings.material,
            "formulation": self.settings.formulation,
            "against": self.against,
            "parameters": [_plain(estimate) for estimate in self.estimates],
            "attachment": asdict(self.attachment) if self.attachment is not None else None,
            "bags": [
                {**_plain(score), "simulated": words} for score, words in zip(self.scores, self.simulated, strict=True)
            ],
            "warnings": self.warnings,
            "replays": self.replays,
        }


def _plain(values: Any) -> dict[str, Any]:
    return {key: finite_or_none(value) for key, value in asdict(values).items()}


def bag_errors(
    fits: Sequence[BagFit], length: float, held_out: Sequence[Points | None] | None = None
) -> tuple[BagErrors, ...]:
    """Return the errors of all bags.

    Args:
        fits: each bag before and after.
        length: of the thread [m].
        held_out: predicted nodes of each, calibrated by the other bags.
    """
    scores = []
    for fit, held in zip(fits, held_out or [None] * len(fits), strict=True):
        run = fit.run
        errors = [
            math.nan if vertices is None else mean_error(vertices, targets, length)
            for targets in (run.targets, run.ground_truths)
            for vertices in (fit.before, fit.after, held)
        ]
        off = [mean_across(vertices, run, length) for vertices in (fit.before, fit.after)]
        scores.append(BagErrors(run.name, len(run.frames), *errors, *off, unverified=run.unverified))
    return tuple(scores)
