"""One recorded run as arrays: needle poses, and the measured thread at the frames that are compared."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.errors import BagError, InvalidInputError
from magnetosuture_thread.evaluation.frames import Observation
from magnetosuture_thread.evaluation.metrics import MIN_KNOWN_SHARE, mean_over_nodes, target_points
from magnetosuture_thread.geometry.polyline import Points, arc_lengths
from magnetosuture_thread.scene import Scene
from magnetosuture_thread.thread_model.session import InitialObservation
from magnetosuture_thread.thread_model.settings import ThreadModelSettings

AGAINST = ("seen", "truth")
SETTLING = 1.0  # s after the start that are not compared: the noise of the first centreline straightens out in it
MAX_FRAMES = 600  # compared, evenly over the run; every pose is replayed
MIN_DURATION = 3.0  # s
MIN_FRAMES = 20  # compared
GAP = 500_000_000  # ns without a needle, after which the thread's way is not known
BACK = 1_000_000_000  # ns; stamps that go back by more begin another run
SMOOTHED, STEPS = 1.0, 0.5  # s; over which the thread is averaged to tell whether it moves, and the needle how fast
BLOCKS = 10  # of time, in each of which residuals are taken to be alike
STILL, SLOW = 0.02, 0.15  # of the thread's length, by which some point of it moves


@dataclass(frozen=True)
class RecordedRun:
    """One recorded run, from the frame in which the thread is first measured.

    Where the needle was lost for more than `GAP` a new leg begins, from the thread as it is seen then: nobody knows
    which way the needle went, and what is predicted after it would tell of that and not of the thread.

    Attributes:
        name: of the bag.
        stamps: of the poses, increasing, shape (T,) [ns].
        tails: the needle's tail, shape (T, 2) [m].
        headings: unit vectors from tail to tip, shape (T, 2).
        legs: the first pose of each leg.
        initials: the thread as it was seen at these, each of shape (m, 2) [m]; see `InitialObservation`.
        frames: poses at which the prediction is compared, shape (K,).
        targets: where the thread's nodes 1 ... n were, X(s_i), shape (K, n, 2) [m]; not a number where unknown.
        ground_truths: the same of the ground truth, if the bag holds it; else not a number.
        against: what the targets are, `seen` or `truth`.
        simulated: what of it is simulated; empty if nothing says so.
        scene: that the thread moves in; None if it is not known.
        unverified: why any message of the bag may be wrong; empty if nothing speaks against them.
    """

    name: str
    stamps: NDArray[np.int64]
    tails: Points
    headings: Points
    legs: tuple[int, ...]
    initials: tuple[Points, ...]
    frames: NDArray[np.int64]
    targets: Points
    ground_truths: Points
    against: str = "seen"
    simulated: str = ""
    scene: Scene | None = None
    unverified: str = ""

    @property
    def known(self) -> NDArray[np.bool_]:
        """Where the targets are known, shape (K, n)."""
        return np.isfinite(self.targets[..., 0])

    @property
    def times(self) -> NDArray[np.float64]:
        """Return the time of each compared frame since the first pose [s], shape (K,)."""
        return np.asarray((self.stamps[self.frames] - self.stamps[0]) * 1e-9)

    @property
    def blocks(self) -> NDArray[np.int64]:
        """Which block of time each compared frame is in, 0 to `BLOCKS` - 1, shape (K,)."""
        share = self.times / max(float(self.times[-1]), 1e-9)
        return np.asarray(np.minimum((BLOCKS * share).astype(int), BLOCKS - 1))

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


def read_run(
    name: str,
    observations: Iterable[Observation],
    settings: ThreadModelSettings,
    against: str = "seen",
    simulated: str = "",
    scene: Scene | None = None,
) -> RecordedRun:
    """Return the observations of one bag as arrays.

    Args:
        name: of the bag, for errors and tables.
        observations: by time; they are gone through once.
        settings: the thread's length and number of nodes.
        against: what the prediction is to be compared with, `seen` or `truth`.
        simulated: what of it is simulated.
        scene: that the thread moves in.

    Raises:
        BagError: there is no needle, no thread, no truth where it is asked for, too little of them, or nothing moves.
        InvalidInputError: time goes back.
    """
    counts: Counter[str] = Counter()
    poses: list[tuple[int, Points, Points]] = []
    legs: list[int] = []
    initials: list[Points] = []
    compared: list[tuple[int, Points, Points]] = []
    length, enough = settings.thread_length, MIN_KNOWN_SHARE * settings.thread_length
    start = InitialObservation()
    for observation in observations:
        if not observation.found:
            continue
        stamp, last = observation.stamp, poses[-1][0] if poses else None
        counts.update(needle=1, seen=len(observation.measured) > 1, truth=len(observation.ground_truth) > 1)
        curves = [observation.measured, observation.ground_truth]
        (measured, true), lengths = target_points(curves, length, settings.segments)
        if last is not None and stamp <= last:
            if stamp < last - BACK:
                back = (last - stamp) * 1e-9
                raise InvalidInputError(name, f"a time {back:.1f} s before the last", "one run, by time, in each bag")
            continue
        if last is None or stamp > last + GAP:
            # As a thread of the node starts; where it does not from this frame, there is no shape.
            told = observation.observation
            initial = observation.measured if told is None else start.shape(stamp, told)
            if initial is None or len(initial) < 2 or arc_lengths(initial)[-1] < enough:
                continue
            legs.append(len(poses))
            initials.append(initial)
        poses.append((stamp, observation.tail, observation.heading))
        # Before, the noise of the leg's first centreline has not straightened out.
        is_settled = stamp >= poses[legs[-1]][0] + round(SETTLING * 1e9)
        if is_settled and lengths[AGAINST.index(against)] >= enough:
            compared.append((len(poses) - 1, measured if against == "seen" else true, true))
    problem = ""
    if not counts["needle"]:
        problem = "shows no needle in any frame; is it another setup's?"
    elif not counts["seen"]:
        problem = "shows no thread in any frame: nothing to start from or to compare with"
    elif not poses:
        problem = "never shows half of the thread or more: nothing to start from"
    elif against == "truth" and not counts["truth"]:
        problem = "holds no ground truth (ground_truth/thread), as bags of a robot do; compare against seen"
    if problem:
        raise BagError(name, problem)
    ends = [*legs[1:], len(poses)]
    duration = sum(poses[end - 1][0] - poses[leg][0] for leg, end in zip(legs, ends, strict=True)) * 1e-9
    if duration < MIN_DURATION:
        expected = f"expected at least {MIN_DURATION:g} s"
        raise BagError(name, f"is too short: {duration:.1f} s with needle and thread, {expected}")
    if len(compared) < MIN_FRAMES:
        known = "measured" if against == "seen" else "known from ground truth"
        words = f"in {len(compared)} frames, the first second left out, is half of the thread or more {known}"
        raise BagError(name, f"is of no use: {words}, expected at least {MIN_FRAMES}")
    chosen = np.unique(np.linspace(0, len(compared) - 1, min(MAX_FRAMES, len(compared))).round().astype(int))
    stamps, tails, headings = zip(*poses, strict=True)
    frames, targets, truths = zip(*(compared[index] for index in chosen), strict=True)
    run = RecordedRun(
        name=name,
        stamps=np.array(stamps, dtype=np.int64),
        tails=np.array(tails),
        headings=np.array(headings),
        legs=tuple(legs),
        initials=tuple(initials),
        frames=np.array(frames, dtype=np.int64),
        targets=np.array(targets),
        ground_truths=np.array(truths),
        against=against,
        simulated=simulated,
        scene=scene,
    )
    moved = _moved(run) / length
    if moved < STILL:
        raise BagError(name, f"nothing moves: {moved:.1%} of the thread's length, expected {SLOW:.0%} and more")
    if moved < SLOW:
        words = f"needle and thread move by {moved:.1%} of the thread's length in {run.duration:.0f} s"
        raise BagError(name, f"the needle is too slow: {words}, expected {SLOW:.0%} and more")
    return run


def _moved(run: RecordedRun) -> float:
    """Return the diagonal of the box that the needle or a node moves in [m]; means over a second leave noise out."""
    parts = (run.times / SMOOTHED).astype(int)
    nodes = np.concatenate([run.tails[run.frames][:, None], run.targets], axis=1)
    blocks = (np.moveaxis(nodes[parts == part], 0, -1) for part in np.unique(parts))
    means = np.array([mean_over_nodes(block, np.isfinite(block)) for block in blocks])
    way = means[:, np.isfinite(means[..., 0]).sum(axis=0) > 1]
    extent = np.nanmax(way, axis=0) - np.nanmin(way, axis=0)
    return float(np.hypot(extent[:, 0], extent[:, 1]).max())
