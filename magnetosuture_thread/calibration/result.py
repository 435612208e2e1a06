"""The result of a calibration: estimates, errors of each bag, the parameter file, tables and text."""

from __future__ import annotations

import math
import textwrap
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

import numpy as np
import yaml

from magnetosuture_thread.bags.storage import MAX_SILENCE
from magnetosuture_thread.calibration.parameters import ATTACHMENT, OFFSET, stiffness_over_drag
from magnetosuture_thread.calibration.recorded_run import RecordedRun, mean_across, mean_error
from magnetosuture_thread.estimator.settings import ThreadModelSettings
from magnetosuture_thread.evaluation.metrics import SensorSilence, plain_values
from magnetosuture_thread.geometry.polyline import Points

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
        simulated: what of it is simulated; empty if nothing says so.
        silence: time without a needle in words; empty if it is never longer than `MAX_SILENCE`.
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
    simulated: str = field(default="", kw_only=True)
    silence: str = field(default="", kw_only=True)

    @property
    def warning(self) -> str:
        """Warning about a bag whose nodes fit worse than before; empty if there is none."""
        if not self.after > 1.05 * self.before:
            return ""
        better = self.across_after <= self.across_before
        end = "what is left lies along it, where noise moves the measured thread" if better else "do not use"
        nodes = f"the nodes are {self.after:.3g} % of the length off after the fit, {self.before:.3g} % before"
        across = f"{self.across_after:.3g} % after, {self.across_before:.3g} % before"
        return f"{self.name}: {nodes}; across the thread, which is what was fitted, {across}: {end}"


class BagFit(NamedTuple):
    """One bag before and after, for the picture.

    Attributes:
        run: the bag.
        before: predicted nodes with what the setup says, shape (K, n + 1, 2) [m].
        after: calibrated.
        held_out: calibrated by the other bags; None if there are none.
    """

    run: RecordedRun
    before: Points
    after: Points
    held_out: Points | None = None

    def errors(self, length: float) -> BagErrors:
        """Return the errors of the bag, of a thread of a length [m]."""
        run = self.run
        errors = [
            math.nan if vertices is None else mean_error(vertices, targets, length)
            for targets in (run.targets, run.ground_truths)
            for vertices in self[1:]
        ]
        across = [mean_across(vertices, run, length) for vertices in (self.before, self.after)]
        times = (run.stamps - run.stamps[0]) * 1e-9
        silence = SensorSilence.of(times, 0.0, float(times[-1]))
        words: dict[str, Any] = {
            "silence": str(silence) if silence.max_gap > MAX_SILENCE else "",
            "simulated": run.simulated,
        }
        return BagErrors(run.name, len(run.frames), *errors, *across, unverified=run.unverified, **words)


@dataclass(frozen=True)
class CalibrationResult:
    """What a calibration found.

    Attributes:
        settings: of the thread model, calibrated.
        against: `seen` or `truth`.
        estimates: of all numbers that were asked for.
        attachment: which fits better; None if it was not asked for.
        scores: of each bag.
        replays: how many runs were replayed.
        finished: whether it came to its end; else this is the best so far.
    """

    settings: ThreadModelSettings
    against: str
    estimates: tuple[Estimate, ...]
    attachment: AttachmentDecision | None
    scores: tuple[BagErrors, ...]
    replays: int
    finished: bool = True

    @property
    def warnings(self) -> list[str]:
        """Warnings for the user."""
        lines = []
        for estimate in (estimate for estimate in self.estimates if estimate.reason):
            value = f"{estimate.value:.4g} {estimate.unit}".rstrip()
            end = f"; {value} stands in, as it predicts better than what the setup says"
            words = f"{estimate.name} cannot be identified in this data: {estimate.reason}"
            lines.append(words + end * (estimate.status == STAND_IN))
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
            "parameters": [plain_values(estimate) for estimate in self.estimates],
            "attachment": asdict(self.attachment) if self.attachment is not None else None,
            "bags": [plain_values(score) for score in self.scores],
            "warnings": self.warnings,
            "replays": self.replays,
        }


def to_yaml(calibration: CalibrationResult) -> str:
    """Return the text of the file, the same for the same calibration."""
    lines, settings = [*_header(calibration), "/**/thread_model:", "  ros__parameters:"], calibration.settings
    if settings.formulation != "rod":
        lines.append(_entry("formulation", settings.formulation))
    # What gives the fitted numbers their meaning; with 0 the material's diameter counts.
    meaning = ("material", *(["diameter"] if settings.diameter else []), "thread_length", "segments", "viscosity")
    lines += [_entry(name, getattr(settings, name)) for name in (*meaning, "wetted_fraction")]
    if settings.formulation == "rod":
        lines += _attachment(calibration)
    for name in dict.fromkeys(estimate.setting for estimate in calibration.estimates):
        lines += _setting(name, [entry for entry in calibration.estimates if entry.setting == name], settings)
    return "\n".join(lines) + "\n"


def _header(calibration: CalibrationResult) -> list[str]:
    words = [
        "A thread calibrated by `magnetosuture calibrate`, for the node thread_model: put the lines into the setup's "
        "own section, or give the node both files, this one last."
    ]
    if not calibration.finished:
        words.insert(0, "BEST SO FAR, NOT FINISHED: the calibration was interrupted. There are no intervals.")
    for score in calibration.scores:
        source = f"simulated: {score.simulated}" if score.simulated else "nothing in it says that it is simulated"
        figures = _before_and_after(score.before, score.after, score.held_out)
        words.append(f"From {score.name} ({source}), {score.frames} frames: prediction error {figures} of the length.")
        if score.unverified:
            words.append(f"  UNVERIFIED: {score.unverified}.")
        if not math.isnan(score.truth_after):
            figures = _before_and_after(score.truth_before, score.truth_after, score.truth_held_out)
            words.append(f"  Against the ground truth: {figures}.")
    compared = "the measured centreline" if calibration.against == "seen" else "the ground truth"
    if calibration.finished:
        words.append(f"Fitted to {compared}. Intervals are of 95 %.")
    if any(estimate.setting == "elastic_modulus" for estimate in calibration.estimates):
        words.append(
            "Only the ratio B = EI / zeta_perp of bending stiffness and drag across the thread moves it. "
            "elastic_modulus is the one that has the fitted ratio at the viscosity, diameter, thread_length and "
            "wetted_fraction below; it is the thread's own as far as these are true."
        )
    return [line for text in words for line in _comment(text)]


def _before_and_after(before: float, after: float, held_out: float) -> str:
    held = "" if math.isnan(held_out) else f", by the other bags {held_out:.3g}"
    return f"{before:.3g} before, {after:.3g} after{held} %"


def _comment(text: str, indent: str = "") -> list[str]:
    return textwrap.wrap(text, 118, initial_indent=f"{indent}# ", subsequent_indent=f"{indent}#   ")


def _entry(name: str, value: Any, note: str = "") -> str:
    """Return a line of the section: a float has its point, as ROS and any YAML reader take it, and six digits."""
    if isinstance(value, tuple):
        value = [float(f"{estimate:.6g}") for estimate in value]
    elif isinstance(value, float):
        value = float(f"{value:.6g}")
    text = yaml.safe_dump({name: value}, default_flow_style=None if isinstance(value, list) else False).strip()
    return f"    {text}" + (f" # {note}" if note else "")


def _attachment(calibration: CalibrationResult) -> list[str]:
    decision, value = calibration.attachment, calibration.settings.attachment
    if decision is None:
        return [_entry(ATTACHMENT, value, "as in the setup")]
    if decision.reason:
        return _comment(f"{ATTACHMENT} is left out, as this data cannot tell it: {decision.reason}", "    ")
    errors = ", ".join(f"{kind} {error:.3g} %" for kind, error in sorted(decision.errors.items()))
    return [_entry(ATTACHMENT, value, f"best fits: {errors}" if len(decision.errors) > 1 else "")]


def _setting(name: str, estimates: list[Estimate], settings: ThreadModelSettings) -> list[str]:
    """Return the lines of one setting, with why it is left out or what stands in."""
    lines, is_fixed = [], all(estimate.status == FIXED for estimate in estimates)
    for estimate in (estimate for estimate in estimates if estimate.reason):
        what = "is left out" if is_fixed else f"stays {estimate.start:.4g} {estimate.unit}"
        what = what if estimate.status == FIXED else "is no measurement but what predicts best"
        lines += _comment(f"{estimate.name} {what}, as this data cannot tell it: {estimate.reason}", "    ")
    if is_fixed:
        return lines
    known = [estimate for estimate in estimates if estimate.status == IDENTIFIED]
    intervals = "; ".join(f"{estimate.low:.3g} to {estimate.high:.3g}" for estimate in known)
    units = {"rest_curvature": "1/m", OFFSET: "m, along and left"}
    if name == "elastic_modulus":
        units[name] = f"Pa; B = {stiffness_over_drag(settings):.4g} m^4/s"
    value = getattr(settings, name) or ((0.0, 0.0) if name == OFFSET else 0.0)
    return [*lines, _entry(name, value, " ".join(filter(None, (units.get(name), intervals and f"[{intervals}]"))))]
