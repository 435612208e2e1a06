"""The figures of one evaluated bag, and what stands about it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from magnetosuture_thread.study.replayed import LeastMargin, Spread

STAGES = ("frame to needle pose", "frame to prediction", "command to currents")


@dataclass(frozen=True)
class LiveFigures:
    """What a recording of the running graph says of it.

    Attributes:
        latency: of each stage, from stamp to the time of recording [s]; without one that is not in the bag.
        remark: why there are none, or none to be trusted.
    """

    latency: Mapping[str, Spread] = field(default_factory=dict)
    remark: str = "not in this bag"


@dataclass(frozen=True)
class Figures:
    """How the prediction did on one bag. Lengths in m, times in s.

    Attributes:
        frames: camera frames, or recorded poses.
        tracked: of these with a needle.
        predicted: of these with a predicted thread.
        error: prediction error by `truth` and `seen`: count, mean, median, p99, maximum [% of length]; None for none.
        recorded_error: the same of the predictions that the bag holds; empty without any.
        target: what the worst moments are held against, `truth` or `seen`; empty if nothing could be scored.
        seen_share: part of the thread's length that is seen, mean over the predicted frames.
        stretch: greatest absolute stretch of a segment.
        residual: greatest scaled residual of a solve.
        least: least margin of each kind.
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
    stretch: float
    residual: float
    least: Mapping[str, LeastMargin]
    contact_frames: int
    step_time: Spread | None
    processing: Spread | None
    interval: float
    live: LiveFigures = field(default_factory=LiveFigures)


@dataclass(frozen=True)
class About:
    """What stands about an evaluated bag.

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
