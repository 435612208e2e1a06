"""The figures of one evaluated bag, the facts about it, the headlines that grade them, and how figures are written."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from magnetosuture_thread.evaluation.metrics import (
    Consistency,
    MinimumMargin,
    Percentiles,
    RunMetrics,
    SensorSilence,
)
from magnetosuture_thread.thread.margins import SOLID

STAGES = ("frame to needle pose", "frame to prediction", "command to currents")
AGAINST = {"truth": "the ground truth", "seen": "the measured centreline"}
EXACT = 1e-3  # of a segment's length: what the solvers' tolerance leaves
# Of threads on light and on dark ground, told apart by red-green blind readers too; as on the operator's page.
COLOURS = {
    "measured": ("#2f7bff", "#5b8cff"),
    "ground-truth": ("#1d2833", "#e3e9ee"),
    "predicted": ("#99107f", "#e83aae"),
    "estimated": ("#00a3a8", "#35e6cb"),
}


@dataclass(frozen=True)
class LiveFigures:
    """Figures of the running graph, from its recording.

    Attributes:
        latency: of each stage, from stamp to the time of recording [s]; without one that is not in the bag.
        remark: why there are none, or none to be trusted.
    """

    latency: Mapping[str, Percentiles] = field(default_factory=dict)
    remark: str = "not in this bag"


@dataclass(frozen=True)
class Figures:
    """How prediction and estimate did on one bag.

    Attributes:
        metrics: of all frames.
        live: of the recorded graph.
        silence: time without frames, or poses.
        span: that is evaluated [s].
    """

    metrics: RunMetrics
    live: LiveFigures
    silence: SensorSilence
    span: float

    @classmethod
    def of(
        cls, metrics: RunMetrics, live: LiveFigures | None = None, within: tuple[float, float] | None = None
    ) -> Figures:
        """Return the figures of a run.

        Args:
            metrics: of the run.
            live: what the recording itself says of the graph.
            within: seconds of the bag from and to which it is evaluated; from the first frame to the last if None [s].
        """
        times = metrics.observed.times
        begin, end = within or (float(times.min(initial=math.inf)), float(times.max(initial=-math.inf)))
        return cls(metrics, live or LiveFigures(), SensorSilence.of(times, begin, end), end - begin)

    @property
    def frames(self) -> int:
        """Number of camera frames, or recorded poses."""
        return len(self.metrics.observed)

    @property
    def tracked(self) -> int:
        """Number of these with a needle."""
        return self.metrics.tracked

    @property
    def predicted(self) -> int:
        """Number of these with a predicted thread."""
        return len(self.metrics.series)

    @property
    def interval(self) -> float:
        """Median time between frames [s]; nan where there are none."""
        steps = np.diff(self.metrics.observed.times)
        return float(np.median(steps)) if len(steps) else math.nan


@dataclass(frozen=True)
class BagDetails:
    """The facts about an evaluated bag.

    Attributes:
        name: of the report.
        path: of the bag.
        setup: name of the setup.
        simulated: what of the bag is simulated; empty if the bag does not say.
        source: `camera` or `poses`.
        formulation: of the model.
        length: of the thread [m].
        segments: of the model.
        dish_diameter: [m]
        start: when the bag begins [ns].
        begin: second of the bag that the evaluation begins at [s].
        duration: that was evaluated [s].
        damage: what is broken in the bag, a line each.
        unverified: why any message of the bag may be wrong; empty if nothing speaks against them.
        refused: messages that could not be used, by why.
        topics: type and number of messages of each topic in our graph's words.
        settings: in force at the start: name, value and unit.
        remarks: further lines that a reader must know.
        software: name and version of what made the report.
    """

    name: str
    path: str
    setup: str
    simulated: str = ""
    source: str = "camera"
    formulation: str = "rod"
    length: float = math.nan
    segments: int = 0
    dish_diameter: float = math.nan
    start: int = 0
    begin: float = 0.0
    duration: float = math.nan
    damage: tuple[str, ...] = ()
    unverified: str = ""
    refused: Mapping[str, int] = field(default_factory=dict)
    topics: Mapping[str, tuple[str, int]] = field(default_factory=dict)
    settings: tuple[tuple[str, str, str], ...] = ()
    remarks: tuple[str, ...] = ()
    software: tuple[tuple[str, str], ...] = ()


class Headline(NamedTuple):
    """One figure of the page's head.

    Attributes:
        name: of the figure.
        value: with its unit.
        detail: more of it.
        grade: `good`, `middling`, `bad` or `none`.
        assessment: in plain words.
    """

    name: str
    value: str
    detail: str
    grade: str
    assessment: str


def headlines(about: BagDetails, figures: Figures) -> list[Headline]:
    """Return the figures of the page's head, in their order."""
    metrics, estimation = figures.metrics, figures.metrics.estimation
    kinds = {"estimate": metrics.errors("estimate_error")} if estimation.estimated else {}
    kinds["prediction"] = metrics.errors()
    found = [
        _error(about, errors[target], f"{kind}, error against {against}", target)
        for target, against in AGAINST.items()
        for kind, errors in kinds.items()
        if target in errors
    ]
    if estimation.hidden is not None:
        found.append(_consistency(estimation.consistency))
    return [*found, _frames(figures), _margin(about, metrics), _strain(metrics.maximum("strain"))]


def _grade(value: float, good: float, middling: float, *words: str) -> tuple[str, str]:
    """Return the grade of a value by two upper limits, and its words."""
    rank = 0 if value <= good else 1 if value <= middling else 2
    return ("good", "middling", "bad")[rank], words[rank]


def _error(about: BagDetails, found: Mapping[str, float] | None, name: str, target: str) -> Headline:
    if found is None:
        missing = "not in this bag" if target == "truth" else "no frame shows half of the thread"
        return Headline(name, "none", missing, "none", "not scored")
    millimetres = format_number(10.0 * found["mean"] * about.length)
    detail = (
        f"mean over {_count(found['count'], 'frame')}; {millimetres} mm. Maximum {format_number(found['maximum'])} %"
    )
    grade = _grade(found["mean"], 1.0, 5.0, "close", "off, but usable", "far off")
    return Headline(name, f"{format_number(found['mean'])} %", detail, *grade)


def _consistency(found: Consistency | None) -> Headline:
    name = "normalised innovation squared"
    if found is None:
        return Headline(name, "none", "no measurement went into the estimate", "none", "a prediction only")
    low, high = found.band
    within = f"{found.within} of {_count(found.windows, 'window')} of {found.width:.1f} s"
    detail = f"mean; in its 95 % band, {low:.2f} to {high:.2f}, in {within}"
    grade = _grade(-found.within / found.windows, -0.9, -0.5, "consistent", "often off", "not consistent")
    return Headline(name, format_number(found.mean), detail, *grade)


def _count(count: float, thing: str) -> str:
    return f"1 {thing}" if count == 1 else f"{count:.0f} {thing}s"


def _frames(figures: Figures) -> Headline:
    share = figures.predicted / figures.frames if figures.frames else 0.0
    detail = f"{100.0 * share:.1f} %; needle found in {figures.tracked}"
    silence = figures.silence
    if silence.gaps:
        detail += f"; none at all for {format_number(silence.total)} s, the longest {format_number(silence.max_gap)} s"
        detail += f" at {silence.at:.1f} s"
        share *= 1.0 - (silence.total / figures.span if figures.span > 0.0 else 0.0)
    grade = _grade(-share, -0.95, -0.5, "nearly all", "with gaps", "few")
    return Headline("frames predicted", f"{figures.predicted} of {figures.frames}", detail, *grade)


def _margin(about: BagDetails, metrics: RunMetrics) -> Headline:
    """Return the minimum margin: of something solid where all barriers hold, else the one that is broken most."""
    minima = metrics.minimum_margins.values()
    if not minima:
        return Headline("minimum margin", "none", "no prediction converged", "none", "not known")
    broken = [least.kind.replace("_", " ") for least in minima if not _holds(about, least)]
    worst = min(minima, key=lambda least: least.clearance - _min_clearance(about, least))
    if not broken:
        worst = min((least for least in minima if least.kind in SOLID), key=lambda m: m.promised, default=worst)
    touching = f"; touches in {_count(metrics.contact_frames, 'frame')}" if metrics.contact_frames else ""
    detail = f"at {worst.time:.2f} s, node {worst.node}{touching}"
    if worst.chord is not None:
        detail = f"of nodes; a chord between two, {micrometres(worst.chord)}, {detail}"
    grade = ("bad", f"broken: {', '.join(broken)}") if broken else ("good", "every barrier holds")
    name = f"minimum margin, {worst.kind.replace('_', ' ')}"
    return Headline(name, micrometres(worst.promised), detail, *grade)


def _min_clearance(about: BagDetails, least: MinimumMargin) -> float:
    """Return what a margin may be at the least, within the solvers' tolerance [m]."""
    return -1e-6 if least.kind in SOLID else -EXACT * about.length / max(about.segments, 1)


def _holds(about: BagDetails, least: MinimumMargin) -> bool:
    return least.promised >= _min_clearance(about, least)


def margin_state(about: BagDetails, margin: MinimumMargin) -> str:
    """Return as text whether a barrier held."""
    if not _holds(about, margin):
        return "broken"
    return "holds" if margin.promised >= -1e-9 else "holds within the tolerance"


def _strain(strain: float) -> Headline:
    grade = _grade(strain, EXACT, 0.01, "inextensible", "more than 0.1 %", "more than 1 %")
    return Headline("maximum stretch", f"{format_number(100.0 * strain)} %", "of a segment, either way", *grade)


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


def micronewtons(newtons: float) -> str:
    """Return a force as text."""
    return f"{format_number(1e6 * newtons)} µN"


def micrometres(metres: float) -> str:
    """Return a margin in the unit that suits it; what is 0 within the solvers' tolerance is written so."""
    if abs(metres) <= 1e-9:
        return "0 µm"
    if abs(metres) >= 1e-4:
        return f"{format_number(1e3 * metres)} mm"
    return f"{format_number(1e6 * metres)} µm"
