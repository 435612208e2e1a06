"""The figures of one evaluated bag, the facts about it, and the headlines that grade them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from magnetosuture_thread.evaluation.estimation import EstimationFigures, compare_errors
from magnetosuture_thread.evaluation.metrics import MinimumMargin, Percentiles, RunMetrics, SensorSilence
from magnetosuture_thread.thread.margins import SOLID

STAGES = ("frame to needle pose", "frame to prediction", "command to currents")
GOOD, MIDDLING, BAD, NONE = "good", "middling", "bad", "none"
CLOSE, FAIR = 1.0, 5.0  # % of the length
EXACT = 1e-3  # of a segment's length: what the solvers' tolerance leaves
TOUCH = 1e-6  # m; a node this deep in an obstacle still counts as touching it

AGAINST = {"truth": "the ground truth", "seen": "the measured centreline"}


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
    """How prediction and estimate did on one bag. Lengths in m, times in s.

    Attributes:
        frames: camera frames, or recorded poses.
        tracked: of these with a needle.
        predicted: of these with a predicted thread.
        error: prediction error by `truth` and `seen`: count, mean, median, p99, maximum [% of length]; None for none.
        recorded_error: the same of the predictions that the bag holds; empty without any.
        target: what the worst frames are compared with, `truth` or `seen`; empty if nothing could be scored.
        measured_share: part of the thread's length that is measured, mean over the predicted frames.
        strain: greatest absolute strain of a segment.
        residual: greatest scaled residual of a solve.
        tension: greatest tension of a segment [N]; nan where no force is known.
        pull: greatest force of the thread upon the needle [N]; nan where no force is known.
        pull_error: of that force against the ground truth, see `pull_error_percent`; nan without both [%].
        minimum: minimum margin of each kind.
        contact_frames: predicted frames in which the thread touches an obstacle.
        step_time: of the model's step [s].
        processing: of a frame in the tracker [s].
        interval: between frames, median [s].
        live: of the recorded graph.
        silence: time without frames, or poses.
        span: that is evaluated [s].
        estimate_error: of the estimate, as `error`.
        compared: errors of `prediction` and `estimate` under the same names; see `compare_errors`.
        estimation: what else there is of the estimate.
    """

    frames: int
    tracked: int
    predicted: int
    error: Mapping[str, Mapping[str, float] | None]
    recorded_error: Mapping[str, Mapping[str, float] | None]
    estimate_error: Mapping[str, Mapping[str, float] | None]
    compared: Mapping[str, Mapping[str, float | None]]
    estimation: EstimationFigures
    target: str
    measured_share: float
    strain: float
    residual: float
    tension: float
    pull: float
    pull_error: float
    minimum: Mapping[str, MinimumMargin]
    contact_frames: int
    step_time: Percentiles | None
    processing: Percentiles | None
    interval: float
    live: LiveFigures
    silence: SensorSilence
    span: float

    @property
    def silent_share(self) -> float:
        """Share of the time without frames, or poses."""
        return self.silence.total / self.span if self.span > 0.0 else 0.0

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
        steps = np.diff(times)
        return cls(
            frames=len(metrics.observed),
            tracked=metrics.tracked,
            predicted=len(metrics.series),
            error=metrics.errors(),
            recorded_error=metrics.errors("recorded_error"),
            target=metrics.target,
            measured_share=metrics.mean("seen_share"),
            strain=metrics.maximum("strain"),
            residual=metrics.maximum("residual"),
            tension=metrics.maximum("tension"),
            pull=metrics.maximum("pull"),
            pull_error=metrics.pull_error_percent,
            minimum=metrics.minimum_margins,
            contact_frames=metrics.contact_frames,
            step_time=metrics.percentiles("step_time"),
            processing=Percentiles.of(metrics.observed.column("processing")),
            interval=float(np.median(steps)) if len(steps) else math.nan,
            live=live or LiveFigures(),
            silence=SensorSilence.of(times, begin, end),
            span=end - begin,
            estimate_error=metrics.errors("estimate_error"),
            compared=compare_errors(metrics.series),
            estimation=metrics.estimation,
        )


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


@dataclass(frozen=True)
class Headline:
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
    estimation, interval = figures.estimation, figures.interval
    kinds = {"estimate": figures.estimate_error} if estimation.estimated else {}
    kinds["prediction"] = figures.error
    found = [
        _error(about, errors[target], f"{kind}, error against {against}", target)
        for target, against in AGAINST.items()
        for kind, errors in kinds.items()
        if target in errors
    ]
    if estimation.estimated:
        found += [_consistency(estimation), _hidden(estimation)]
    for parameter in estimation.learned:
        value, range_95 = str(parameter).split(", ", 1)
        name = parameter.name.replace("_", " ")
        found.append(Headline(name, value, range_95, NONE, "learned by the estimate"))
    found += [_frames(figures), _margin(about, figures), _strain(figures), _tension(figures)]
    found.append(_duration("model step", figures.step_time, interval, "one step of the thread model"))
    if figures.processing:
        found.append(_duration("tracker", figures.processing, interval, "one camera frame"))
    return [*found, _latency(figures)]


def _grade(value: float, *grades: tuple[float, str, str]) -> tuple[str, str]:
    """Return grade and words of the first upper limit that a value keeps."""
    return next((grade, words) for limit, grade, words in grades if value <= limit)


def _error(about: BagDetails, found: Mapping[str, float] | None, name: str, target: str) -> Headline:
    if found is None:
        missing = "not in this bag" if target == "truth" else "no frame shows half of the thread"
        return Headline(name, "none", missing, NONE, "not scored")
    grades = ((CLOSE, GOOD, "close"), (FAIR, MIDDLING, "off, but usable"), (math.inf, BAD, "far off"))
    millimetres = format_number(10.0 * found["mean"] * about.length)
    detail = f"mean over {_frames_of(found['count'])}; {millimetres} mm. Maximum {format_number(found['maximum'])} %"
    return Headline(name, f"{format_number(found['mean'])} %", detail, *_grade(found["mean"], *grades))


def _consistency(estimation: EstimationFigures) -> Headline:
    name, found = "normalised innovation squared", estimation.consistency
    if found is None:
        return Headline(name, "none", "no measurement went into the estimate", NONE, "a prediction only")
    grades = ((-0.9, GOOD, "consistent"), (-0.5, MIDDLING, "often off"), (0.0, BAD, "not consistent"))
    low, high = found.band
    windows = "1 window" if found.windows == 1 else f"{found.windows} windows"
    detail = f"mean; in its 95 % band, {low:.2f} to {high:.2f}, in {found.within} of {windows} of {found.width:.1f} s"
    return Headline(name, format_number(found.mean), detail, *_grade(-found.share, *grades))


def _hidden(estimation: EstimationFigures) -> Headline:
    found = estimation.hidden
    assert found is not None
    grades = ((0.0, GOOD, "never"), (1.0 - 1e-9, NONE, "at times"), (1.0, NONE, "always"))
    detail = f"of the time, in part or all; {100.0 * found.length:.1f} % of the length in the mean"
    if found.all_time > 0.0:
        detail += f"; nothing measured in {100.0 * found.all_time:.1f} % of the time"
    return Headline("thread hidden", f"{100.0 * found.time:.1f} %", detail, *_grade(found.time, *grades))


def _frames_of(count: float) -> str:
    return "1 frame" if count == 1 else f"{count:.0f} frames"


def _frames(figures: Figures) -> Headline:
    share = figures.predicted / figures.frames if figures.frames else 0.0
    grades = ((-0.95, GOOD, "nearly all"), (-0.5, MIDDLING, "with gaps"), (0.0, BAD, "few"))
    detail = f"{100.0 * share:.1f} %; needle found in {figures.tracked}"
    silence = figures.silence
    if silence.gaps:
        detail += f"; none at all for {format_number(silence.total)} s, the longest {format_number(silence.max_gap)} s"
        detail += f" at {silence.at:.1f} s"
        share *= 1.0 - figures.silent_share
    return Headline("frames predicted", f"{figures.predicted} of {figures.frames}", detail, *_grade(-share, *grades))


def _margin(about: BagDetails, figures: Figures) -> Headline:
    """Return the minimum margin: of something solid where all barriers hold, else the one that is broken most."""
    minima = figures.minimum.values()
    if not minima:
        return Headline("minimum margin", "none", "no prediction converged", NONE, "not known")
    broken = [least.kind.replace("_", " ") for least in minima if not _holds(about, least)]
    worst = min(minima, key=lambda least: least.clearance - _min_clearance(about, least))
    if not broken:
        worst = min((least for least in minima if least.kind in SOLID), key=lambda m: m.clearance, default=worst)
    touching = f"; touches in {_frames_of(figures.contact_frames)}" if figures.contact_frames else ""
    detail = f"at {worst.time:.2f} s, node {worst.node}{touching}"
    grade, words = (BAD, f"broken: {', '.join(broken)}") if broken else (GOOD, "every barrier holds")
    name = f"minimum margin, {worst.kind.replace('_', ' ')}"
    return Headline(name, micrometres(worst.clearance), detail, grade, words)


def _min_clearance(about: BagDetails, least: MinimumMargin) -> float:
    """Return what a margin may be at the least, within the solvers' tolerance [m]."""
    return -TOUCH if least.kind in SOLID else -EXACT * about.length / max(about.segments, 1)


def _holds(about: BagDetails, least: MinimumMargin) -> bool:
    # What the program keeps outside of something solid is h, of nodes; on a disc the chord between two lies deeper.
    return (least.value if least.kind in SOLID else least.clearance) >= _min_clearance(about, least)


def margin_state(about: BagDetails, margin: MinimumMargin) -> str:
    """Return as text whether a barrier held."""
    if not _holds(about, margin):
        return "broken"
    return "holds" if margin.clearance >= -1e-9 else "holds within the tolerance"


def _strain(figures: Figures) -> Headline:
    name, detail = "maximum stretch", "of a segment, either way"
    if not math.isfinite(figures.strain):
        return Headline(name, "none", detail, NONE, "not known")
    grades = ((EXACT, GOOD, "inextensible"), (0.01, MIDDLING, "more than 0.1 %"), (math.inf, BAD, "more than 1 %"))
    return Headline(name, f"{format_number(100.0 * figures.strain)} %", detail, *_grade(figures.strain, *grades))


def _tension(figures: Figures) -> Headline:
    if not math.isfinite(figures.tension):
        return Headline("peak tension", "none", "of a segment, by the model", NONE, "no force is known")
    detail = f"of a segment, by the model; the thread pulls the needle with at most {micronewtons(figures.pull)}"
    return Headline("peak tension", micronewtons(figures.tension), detail, NONE, "by the model's multipliers")


def _duration(name: str, found: Percentiles | None, interval: float, detail: str) -> Headline:
    if found is None:
        return Headline(f"{name}, median", "none", detail, NONE, "not known")
    grade = NONE, "frame rate not known"
    if interval > 0.0:
        slow = math.inf, MIDDLING, "slower than the frames, on this machine"
        fast = 0.5, GOOD, f"keeps up with {1.0 / interval:.3g} frames/s"
        grade = _grade(found.p99 / interval, fast, (1.0, MIDDLING, "just keeps up"), slow)
    detail = f"{detail}; 99th percentile {milliseconds(found.p99)}"
    return Headline(f"{name}, median", milliseconds(found.median), detail, *grade)


def _latency(figures: Figures) -> Headline:
    name, live = "latency, frame to prediction", figures.live
    found = live.latency.get("frame to prediction")
    if found is None:
        return Headline(name, "none", "measured only where the running graph was recorded", NONE, live.remark)
    detail = f"median; 99th percentile {milliseconds(found.p99)}"
    soon = found.p99 <= 2.0 * figures.interval
    grade, words = (GOOD, "within two frames") if soon else (MIDDLING, "longer than two frames")
    return Headline(name, milliseconds(found.median), detail, grade, words)


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
