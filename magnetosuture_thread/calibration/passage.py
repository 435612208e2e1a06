"""One recorded run as arrays: what the needle did, and where the thread was seen."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.errors import BagError, InvalidInputError
from magnetosuture_thread.evaluation.frames import Observation
from magnetosuture_thread.evaluation.metrics import MIN_KNOWN_SHARE, target_points
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.settings import ThreadModelSettings
from magnetosuture_thread.scene import Scene

AGAINST = ("seen", "truth")
SETTLING = 1.0  # s after the start that are not compared: the noise of the first centreline straightens out in it
MAX_FRAMES = 600  # compared, evenly over the run; every pose is replayed
MIN_DURATION = 3.0  # s
MIN_FRAMES = 20  # compared
GAP = 500_000_000  # ns without a needle, after which the thread's way is not known
BACK = 1_000_000_000  # ns; stamps that go back by more begin another run
SMOOTHED, STEPS = 1.0, 0.5  # s; over which the thread is averaged to tell whether it moves, and the needle how fast
STILL, SLOW = 0.02, 0.15  # of the thread's length, by which some point of it moves

Stamps = NDArray[np.int64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Passage:
    """One recorded run, from the frame in which the thread is first seen.

    Where the needle was lost for more than `GAP` a new leg begins, from the thread as it is seen then: nobody knows
    which way the needle went, and what is predicted after it would tell of that and not of the thread.

    Attributes:
        name: of the bag.
        stamps: of the poses, increasing, shape (T,) [ns].
        tails: the needle's tail, shape (T, 2) [m].
        headings: unit vectors from tail to tip, shape (T, 2).
        legs: the first pose of each leg.
        initials: the thread as it was seen at these, each of shape (m, 2) [m].
        frames: poses at which the prediction is compared, shape (K,).
        targets: where the thread's nodes 1 ... n were, X(s_i), shape (K, n, 2) [m]; not a number where unknown.
        truths: the same of the truth, if the bag says it; else not a number.
        against: what the targets are, `seen` or `truth`.
        simulated: what of it is simulated; empty if nothing says so.
        scene: that the thread moves in; None if it is not known.
    """

    name: str
    stamps: Stamps
    tails: Points
    headings: Points
    legs: tuple[int, ...]
    initials: tuple[Points, ...]
    frames: NDArray[np.int64]
    targets: Points
    truths: Points
    against: str = "seen"
    simulated: str = ""
    scene: Scene | None = None

    @property
    def known(self) -> Flags:
        """Where the targets are known, shape (K, n)."""
        return np.isfinite(self.targets[..., 0])

    @property
    def times(self) -> NDArray[np.float64]:
        """Return the time of each compared frame since the first pose [s], shape (K,)."""
        return np.asarray((self.stamps[self.frames] - self.stamps[0]) * 1e-9)

    @property
    def speed(self) -> float:
        """Speed of the needle's tail while it moves, the camera's noise averaged out [m/s].

        The upper quartile over steps of half a second, so that a needle that stops now and then counts as it goes.
        """
        parts = ((self.stamps - self.stamps[0]) * 1e-9 / STEPS).astype(int)
        means = np.array([self.tails[parts == part].mean(axis=0) for part in np.unique(parts)])
        steps = np.linalg.norm(np.diff(means, axis=0), axis=1) / STEPS
        return float(np.percentile(steps, 75.0)) if len(steps) else 0.0

    @property
    def duration(self) -> float:
        """From the first pose to the last [s]."""
        return float(self.stamps[-1] - self.stamps[0]) * 1e-9


@dataclass
class _Run:
    stamps: list[int] = field(default_factory=list)
    tails: list[Points] = field(default_factory=list)
    headings: list[Points] = field(default_factory=list)
    curves: list[tuple[int, Points, Points]] = field(default_factory=list)
    legs: list[int] = field(default_factory=list)
    initials: list[Points] = field(default_factory=list)


def passage_of(
    name: str,
    sights: Iterable[Observation],
    settings: ThreadModelSettings,
    against: str = "seen",
    simulated: str = "",
    scene: Scene | None = None,
) -> Passage:
    """Return what one bag's sights say, as arrays.

    Args:
        name: of the bag, for errors and tables.
        sights: by time; they are gone through once.
        settings: the thread's length and number of nodes.
        against: what the prediction is to be compared with, `seen` or `truth`.
        simulated: what of it is simulated.
        scene: that the thread moves in.

    Raises:
        BagError: there is no needle, no thread, no truth where it is asked for, too little of them, or nothing moves.
        InvalidInputError: time goes back.
    """
    run = _gathered(name, sights, settings, against)
    ends = [*run.legs[1:], len(run.stamps)]
    duration = sum(run.stamps[end - 1] - run.stamps[leg] for leg, end in zip(run.legs, ends, strict=True)) * 1e-9
    if duration < MIN_DURATION:
        raise BagError(
            name, f"is too short: {duration:.1f} s with needle and thread, expected at least {MIN_DURATION:g} s"
        )
    compared = [entry for entry in run.curves if _settled(run, entry[0])]
    if len(compared) < MIN_FRAMES:
        words = f"in {len(compared)} frames, the first second left out, is half of the thread or more {_word(against)}"
        raise BagError(name, f"is of no use: {words}, expected at least {MIN_FRAMES}")
    chosen = np.unique(np.linspace(0, len(compared) - 1, min(MAX_FRAMES, len(compared))).round().astype(int))
    kept = [compared[index] for index in chosen]
    passage = Passage(
        name,
        np.array(run.stamps, dtype=np.int64),
        np.array(run.tails),
        np.array(run.headings),
        tuple(run.legs),
        tuple(run.initials),
        np.array([index for index, _, _ in kept], dtype=np.int64),
        np.array([curve for _, curve, _ in kept]),
        np.array([truth for _, _, truth in kept]),
        against,
        simulated,
        scene,
    )
    _check_motion(passage, settings.thread_length)
    return passage


def _gathered(name: str, sights: Iterable[Observation], settings: ThreadModelSettings, against: str) -> _Run:
    run, needles, threads, truths = _Run(), 0, 0, 0
    enough = MIN_KNOWN_SHARE * settings.thread_length
    for sight in sights:
        if not sight.found:
            continue
        needles += 1
        threads += len(sight.seen) > 1
        truths += len(sight.truth) > 1
        curves = [sight.seen, sight.truth]
        (seen, truth), (seen_length, true_length) = target_points(curves, settings.thread_length, settings.segments)
        if run.stamps and sight.stamp <= run.stamps[-1]:
            if sight.stamp < run.stamps[-1] - BACK:
                back = (run.stamps[-1] - sight.stamp) * 1e-9
                raise InvalidInputError(name, f"a time {back:.1f} s before the last", "one run, by time, in each bag")
            continue
        if not run.stamps or sight.stamp > run.stamps[-1] + GAP:
            if seen_length < enough:
                continue
            run.legs.append(len(run.stamps))
            run.initials.append(sight.seen)
        if (seen_length if against == "seen" else true_length) >= enough:
            run.curves.append((len(run.stamps), seen if against == "seen" else truth, truth))
        run.stamps.append(sight.stamp)
        run.tails.append(sight.tail)
        run.headings.append(sight.heading)
    if not needles:
        raise BagError(name, "shows no needle in any frame; is it another set-up's?")
    if not threads:
        raise BagError(name, "shows no thread in any frame: nothing to start from or to compare with")
    if not run.stamps:
        raise BagError(name, "never shows half of the thread or more: nothing to start from")
    if against == "truth" and not truths:
        raise BagError(name, "holds no truth (ground_truth/thread), as bags of a robot do; compare against seen")
    return run


def _settled(run: _Run, index: int) -> bool:
    """Return whether the noise of its leg's first centreline has straightened out at a pose."""
    leg = max(begin for begin in run.legs if begin <= index)
    return run.stamps[index] >= run.stamps[leg] + round(SETTLING * 1e9)


def _word(against: str) -> str:
    return "seen" if against == "seen" else "known by the truth"


def _check_motion(passage: Passage, length: float) -> None:
    """Refuse a run in which the thread hardly moves; averages over a second leave the camera's noise out."""
    parts = (passage.times / SMOOTHED).astype(int)
    tail = passage.tails[passage.frames][:, None]
    nodes = np.concatenate([tail, passage.targets], axis=1)
    means = np.array([_mean(nodes[parts == part]) for part in np.unique(parts)])
    known = np.isfinite(means[..., 0]).sum(axis=0) > 1
    way = means[:, known]
    extent = np.nanmax(way, axis=0) - np.nanmin(way, axis=0)
    moved = float(np.hypot(extent[:, 0], extent[:, 1]).max()) / length
    if moved < STILL:
        raise BagError(passage.name, f"nothing moves: {moved:.1%} of the thread's length, expected {SLOW:.0%} and more")
    if moved < SLOW:
        words = f"needle and thread move by {moved:.1%} of the thread's length in {passage.duration:.0f} s"
        raise BagError(passage.name, f"the needle is too slow: {words}, expected {SLOW:.0%} and more")


def _mean(values: Points) -> Points:
    """Return the mean over the first axis of what is known."""
    known = np.isfinite(values)
    count = known.sum(axis=0)
    total = np.where(known, values, 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
