"""The figures of one evaluated bag, and the facts about it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from magnetosuture_thread.evaluation.metrics import MinimumMargin, Percentiles, RunMetrics

STAGES = ("frame to needle pose", "frame to prediction", "command to currents")


@dataclass(frozen=True)
class LiveFigures:
    """What a recording of the running graph says of it.

    Attributes:
        latency: of each stage, from stamp to the time of recording [s]; without one that is not in the bag.
        remark: why there are none, or none to be trusted.
    """

    latency: Mapping[str, Percentiles] = field(default_factory=dict)
    remark: str = "not in this bag"


@dataclass(frozen=True)
class BagFigures:
    """How the prediction did on one bag. Lengths in m, times in s.

    Attributes:
        frames: camera frames, or recorded poses.
        tracked: of these with a needle.
        predicted: of these with a predicted thread.
        error: prediction error by `truth` and `seen`: count, mean, median, p99, maximum [% of length]; None for none.
        recorded_error: the same of the predictions that the bag holds; empty without any.
        target: what the worst frames are compared with, `truth` or `seen`; empty if nothing could be scored.
        seen_share: part of the thread's length that is seen, mean over the predicted frames.
        strain: greatest absolute strain of a segment.
        residual: greatest scaled residual of a solve.
        minimum: minimum margin of each kind.
        contact_frames: predicted frames in which the thread touches an obstacle.
        step_time: of the model's step [s].
        processing: of a frame in the tracker [s].
        interval: between frames, median [s].
        live: of the recorded graph.
    """

    frames: int
    tracked: int
    predicted: int
    error: Mapping[str, Mapping[str, float] | None]
    recorded_error: Mapping[str, Mapping[str, float] | None]
    target: str
    seen_share: float
    strain: float
    residual: float
    minimum: Mapping[str, MinimumMargin]
    contact_frames: int
    step_time: Percentiles | None
    processing: Percentiles | None
    interval: float
    live: LiveFigures = field(default_factory=LiveFigures)

    @classmethod
    def of(cls, metrics: RunMetrics, live: LiveFigures | None = None) -> BagFigures:
        """Return the figures of a run.

        Args:
            metrics: of the run.
            live: what the recording itself says of the graph.
        """
        steps = np.diff(metrics.observed.times)
        return cls(
            frames=len(metrics.observed),
            tracked=metrics.tracked,
            predicted=len(metrics.series),
            error=metrics.errors(),
            recorded_error=metrics.errors("recorded_error"),
            target=metrics.target,
            seen_share=metrics.mean("seen_share"),
            strain=metrics.maximum("strain"),
            residual=metrics.maximum("residual"),
            minimum=metrics.minimum_margins,
            contact_frames=metrics.contact_frames,
            step_time=metrics.percentiles("step_time"),
            processing=Percentiles.of(metrics.observed.column("processing")),
            interval=float(np.median(steps)) if len(steps) else math.nan,
            live=live or LiveFigures(),
        )


@dataclass(frozen=True)
class BagDetails:
    """The facts about an evaluated bag.

    Attributes:
        name: of the report.
        path: of the bag.
        setup: name of the set-up.
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
    refused: Mapping[str, int] = field(default_factory=dict)
    topics: Mapping[str, tuple[str, int]] = field(default_factory=dict)
    settings: tuple[tuple[str, str, str], ...] = ()
    remarks: tuple[str, ...] = ()
    software: tuple[tuple[str, str], ...] = ()
