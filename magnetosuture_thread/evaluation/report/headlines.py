"""The headlines of a report: figures with units, each with a grade and a verdict in words."""

from __future__ import annotations

import math
from dataclasses import dataclass

from magnetosuture_thread.evaluation.metrics import MinimumMargin, Percentiles
from magnetosuture_thread.evaluation.report.figures import BagDetails, BagFigures
from magnetosuture_thread.model.margins import SOLID

GOOD, MIDDLING, BAD, NONE = "good", "middling", "bad", "none"
CLOSE, FAIR = 1.0, 5.0  # % of the length
EXACT = 1e-3  # of a segment's length: what the solvers' tolerance leaves
TOUCH = 1e-6  # m; a node this deep in an obstacle still counts as touching it

AGAINST = {"truth": "the truth", "seen": "the seen centreline"}


@dataclass(frozen=True)
class Headline:
    """One figure of the page's head.

    Attributes:
        name: of the figure.
        value: with its unit.
        detail: more of it.
        grade: `good`, `middling`, `bad` or `none`.
        verdict: in plain words.
    """

    name: str
    value: str
    detail: str
    grade: str
    verdict: str


def headlines(about: BagDetails, figures: BagFigures) -> list[Headline]:
    """Return the figures of the page's head, in their order."""
    return [
        *(_error(about, figures, target) for target in AGAINST if target in figures.error),
        _frames(figures),
        *_margins(about, figures),
        _strain(figures),
        _speed("model step", figures.step_time, figures.interval, "one step of the thread model"),
        *([_speed("tracker", figures.processing, figures.interval, "one camera frame")] if figures.processing else []),
        _latency(figures),
    ]


def _error(about: BagDetails, figures: BagFigures, target: str) -> Headline:
    name = f"error against {AGAINST[target]}"
    found = figures.error[target]
    if found is None:
        missing = "not in this bag" if target == "truth" else "no frame shows half of the thread"
        return Headline(name, "none", missing, NONE, "not scored")
    millimetres = 10.0 * found["mean"] * about.length
    grades = ((CLOSE, GOOD, "close"), (FAIR, MIDDLING, "off, but usable"), (math.inf, BAD, "far off"))
    grade, words = next((grade, words) for limit, grade, words in grades if found["mean"] <= limit)
    greatest = f"Greatest {format_number(found['maximum'])} %"
    detail = f"mean over {_frames_of(found['count'])}; {format_number(millimetres)} mm. {greatest}"
    return Headline(name, f"{format_number(found['mean'])} %", detail, grade, words)


def _frames_of(count: float) -> str:
    return "1 frame" if count == 1 else f"{count:.0f} frames"


def _frames(figures: BagFigures) -> Headline:
    share = figures.predicted / figures.frames if figures.frames else 0.0
    grade, words = (GOOD, "nearly all") if share >= 0.95 else (MIDDLING, "with gaps") if share >= 0.5 else (BAD, "few")
    detail = f"{100.0 * share:.1f} %; needle found in {figures.tracked}"
    return Headline("frames predicted", f"{figures.predicted} of {figures.frames}", detail, grade, words)


def _margins(about: BagDetails, figures: BagFigures) -> list[Headline]:
    if not figures.minimum:
        return [Headline("least margin", "none", "no prediction converged", NONE, "not known")]
    worst = min(figures.minimum.values(), key=lambda least: least.clearance - _allowed(about, least))
    holds = [_holds(about, least) for least in figures.minimum.values()]
    solid = [figures.minimum[kind] for kind in SOLID if kind in figures.minimum]
    if all(holds) and solid:
        worst = min(solid, key=lambda least: least.clearance)
    touching = f"; touches in {_frames_of(figures.contact_frames)}" if figures.contact_frames else ""
    name = f"least margin, {worst.kind.replace('_', ' ')}"
    detail = f"at {worst.time:.2f} s, node {worst.node}{touching}"
    if all(holds):
        return [Headline(name, micrometres(worst.clearance), detail, GOOD, "every barrier holds")]
    broken = [
        least.kind.replace("_", " ") for least, held in zip(figures.minimum.values(), holds, strict=True) if not held
    ]
    return [Headline(name, micrometres(worst.clearance), detail, BAD, f"broken: {', '.join(broken)}")]


def _allowed(about: BagDetails, least: MinimumMargin) -> float:
    """Return what a margin may be at the least, within the solvers' tolerance [m]."""
    return -TOUCH if least.kind in SOLID else -EXACT * about.length / max(about.segments, 1)


def _holds(about: BagDetails, least: MinimumMargin) -> bool:
    return least.clearance >= _allowed(about, least)


def margin_verdict(about: BagDetails, least: MinimumMargin) -> str:
    """Return in words whether a barrier held."""
    if not _holds(about, least):
        return "broken"
    return "holds" if least.clearance >= -1e-9 else "holds within the tolerance"


def _strain(figures: BagFigures) -> Headline:
    name, detail = "greatest stretch", "of a segment, either way"
    if not math.isfinite(figures.strain):
        return Headline(name, "none", detail, NONE, "not known")
    grade, words = (GOOD, "inextensible") if figures.strain <= EXACT else (MIDDLING, "more than 0.1 %")
    if figures.strain > 10.0 * EXACT:
        grade, words = BAD, "more than 1 %"
    return Headline(name, f"{format_number(100.0 * figures.strain)} %", detail, grade, words)


def _speed(name: str, spread: Percentiles | None, interval: float, detail: str) -> Headline:
    if spread is None:
        return Headline(f"{name}, median", "none", detail, NONE, "not known")
    words = f"{detail}; 99th percentile {milliseconds(spread.p99)}"
    value = milliseconds(spread.median)
    if not math.isfinite(interval) or interval <= 0.0:
        return Headline(f"{name}, median", value, words, NONE, "frame rate not known")
    share = spread.p99 / interval
    if share <= 0.5:
        return Headline(f"{name}, median", value, words, GOOD, f"keeps up with {1.0 / interval:.3g} frames/s")
    verdict = "just keeps up" if share <= 1.0 else "slower than the frames, on this machine"
    return Headline(f"{name}, median", value, words, MIDDLING, verdict)


def _latency(figures: BagFigures) -> Headline:
    name, live = "latency, frame to prediction", figures.live
    spread = live.latency.get("frame to prediction")
    if spread is None:
        return Headline(name, "none", "measured only where the running graph was recorded", NONE, live.remark)
    detail = f"median; 99th percentile {milliseconds(spread.p99)}"
    ahead = spread.p99 <= 2.0 * figures.interval
    grade, words = (GOOD, "within two frames") if ahead else (MIDDLING, "longer than two frames")
    return Headline(name, milliseconds(spread.median), detail, grade, words)


def format_number(value: float) -> str:
    """Return a number with three figures, never in powers of ten unless it is very small or large."""
    if not math.isfinite(value):
        return "none"
    if value == 0.0:
        return "0"
    size = math.floor(math.log10(abs(value)))
    if not -5 <= size < 6:
        return f"{value:.1e}"
    return f"{value:.{max(0, 2 - size)}f}"


def milliseconds(seconds: float) -> str:
    """Return a time in ms."""
    return f"{format_number(1e3 * seconds)} ms"


def micrometres(metres: float) -> str:
    """Return a margin in the unit that suits it; what is 0 within the solvers' tolerance is written so."""
    if abs(metres) <= 1e-9:
        return "0 µm"
    if abs(metres) >= 1e-4:
        return f"{format_number(1e3 * metres)} mm"
    return f"{format_number(1e6 * metres)} µm"
