"""The drag of a thread, by the currents that draw it: the balance of forces upon needle and thread in straight pulls.

Nothing of the thread's own forces is in it: stiffness and tension are inside of it, and its end is free. So

    q (B_tip - B_tail) . e - D v = T A + C N,    T = zeta_par L,    C = zeta_perp L,
    A = mean over s of (x' . t) (t . e),         N = mean over s of x' . e - A

with the needle's direction e, its velocity v along it and its own drag D, and the thread's measured velocity x' and
tangent t along its length. Straight behind the needle A = v and N = 0: T is what the needle needs more than a bare one
for the same speed, `thread_drag`.

Source: resistive force theory of a slender body without inertia. Deviation: friction on the dish's floor, which would
not grow with the speed, counts as drag at the one speed of the pulls.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.special import stdtrit

from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.reading import read_path, read_pose, stamp_of
from magnetosuture_thread.calibration.square import SPEED
from magnetosuture_thread.geometry.polyline import Indices, Points, Vector, arc_lengths, points_at
from magnetosuture_thread.rig.setups import Setup
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.errors import BagError

HALF_WINDOW = 0.15  # s; a velocity is the slope of a line over twice that: of an end tracked to 10 um, 1 % of it
POINTS = 25  # of the thread
WHOLE = 0.99  # of the thread's length, which has to be seen: an end that comes and goes would be a motion
TURN_RATE = 0.4  # rad/s; a needle that turns faster is on no straight pull
WALL_CLEARANCE = 4e-4  # m; of all of the thread: the wall's force upon it is not measured
LEAST_PULL = 0.5  # s
LEAST_PULLS = 4  # by whose scatter the interval is
LENGTH_ERROR = 0.02  # of the thread's length; one that is 3 % longer than set gives 30 % less drag


@dataclass(frozen=True, eq=False)
class Pulls:
    """What was measured in straight pulls.

    Attributes:
        force: of the coils upon the needle, along it, shape (k,) [N].
        speed: v, shape (k,) [m/s].
        thread: A and N, shape (k, 2) [m/s].
        index: of the pull that each frame is of, shape (k,).
    """

    force: Vector
    speed: Vector
    thread: Vector
    index: Indices


@dataclass(frozen=True)
class ThreadDrag:
    """Drags of a thread, with half of their 95 % intervals [N s/m].

    Attributes:
        along: T, and its interval.
        across: C, and its interval.
        total: D + T, and its interval: of the needle with a straight thread.
        needle: D as these pulls alone tell it, to some percent: the needle moves much as the thread does.
        pulls: how many.
    """

    along: tuple[float, float]
    across: tuple[float, float]
    total: tuple[float, float]
    needle: float
    pulls: int


def read_pulls(path: Path, setup: Setup) -> Pulls:
    """Return the straight pulls of a run: frames in which the needle goes ahead, and the thread is off the wall.

    Args:
        path: of a bag with currents, poses and measured threads.
        setup: with the coils, the delay and the thread's length.

    Raises:
        BagError: the bag cannot be used, or has fewer than `LEAST_PULLS` pulls.
    """
    length = setup.model.thread_length
    commanded, poses, threads = list[list[float]](), dict[float, Vector](), dict[float, Points]()
    lengths = list[float]()
    channels = interface.CURRENTS, interface.NEEDLE_POSE, interface.MEASURED_THREAD
    for record in Bag(path).records({channel.recorded for channel in channels}):
        stamp = 1e-9 * stamp_of(record)
        if record.topic == interface.CURRENTS.recorded:
            commanded.append([stamp, *record.decode().current])
        elif record.topic == interface.NEEDLE_POSE.recorded:
            poses[stamp] = np.concatenate(read_pose(record)[:2])
        elif len(curve := read_path(record)) > 1:
            lengths.append(seen := float(arc_lengths(curve)[-1]))
            if seen > WHOLE * length:
                threads[stamp] = points_at(curve, np.minimum(seen, np.linspace(0.0, length, POINTS + 1)))
    # A hand or glare hides a part of it in some frames; nothing makes it longer.
    if lengths and abs((seen := float(np.quantile(lengths, 0.9))) / length - 1.0) > LENGTH_ERROR:
        raise BagError(
            path, f"shows a thread of {1e3 * seen:.1f} mm; thread_length is {1e3 * length:.1f} mm: measure it"
        )
    times = np.array(sorted(poses.keys() & threads.keys()))
    if len(commanded) < 2 or len(times) < 20:
        raise BagError(path, f"has {len(commanded)} currents, and {len(times)} frames with needle and whole thread")
    pose, nodes = np.array([poses[t] for t in times]), np.array([threads[t] for t in times])
    w = max(1, round(HALF_WINDOW / float(np.median(np.diff(times)))))
    span, inside = times[2 * w :] - times[: -2 * w], slice(w, -w)
    velocity = _slopes(nodes, times, w)
    angle = np.unwrap(np.arctan2(pose[:, 3], pose[:, 2]))
    turn_rate = (angle[2 * w :] - angle[: -2 * w]) / span
    times, pose, nodes = times[inside], pose[inside], nodes[inside]
    e = pose[:, 2:] / np.linalg.norm(pose[:, 2:], axis=1)[:, None]
    speed, middle = np.einsum("ki,ki->k", velocity[:, 0], e), 0.5 * (velocity[:, 1:] + velocity[:, :-1])
    tangent = np.diff(nodes, axis=1)
    tangent /= np.linalg.norm(tangent, axis=2)[..., None]
    along = (np.einsum("kni,kni->kn", middle, tangent) * np.einsum("kni,ki->kn", tangent, e)).mean(axis=1)
    thread = np.column_stack([along, np.einsum("kni,ki->kn", middle, e).mean(axis=1) - along])
    clear = setup.scene.dish.radius - np.linalg.norm(nodes, axis=2).max(axis=1) > WALL_CLEARANCE
    good = (speed > 0.5 * SPEED) & (np.abs(turn_rate) < TURN_RATE) & clear & (span < 4.0 * HALF_WINDOW)
    ids = np.flatnonzero(good)
    runs = np.split(ids, np.flatnonzero(np.diff(ids) > 1) + 1)
    kept = [run for run in runs if len(run) and times[run[-1]] - times[run[0]] > LEAST_PULL]
    if len(kept) < LEAST_PULLS:
        raise BagError(path, f"has {len(kept)} straight pulls with the thread off the wall, of {LEAST_PULLS} at least")
    chosen = np.concatenate(kept)
    force = _force(np.array(commanded), times[chosen], pose[chosen, :2], e[chosen], setup)
    index = np.repeat(np.arange(len(kept)), [len(run) for run in kept])
    return Pulls(force, speed[chosen], thread[chosen], index)


def _slopes(values: Vector, times: Vector, w: int) -> Vector:
    """Return the slope of the line through 2 w + 1 values around each but the first and last w of them."""
    count = len(times) - 2 * w
    numbers = np.array([times[k : k + count] for k in range(2 * w + 1)])
    numbers -= numbers.mean(axis=0)
    numbers /= (numbers**2).sum(axis=0)
    return np.asarray(sum(np.einsum("k,k...->k...", numbers[k], values[k : k + count]) for k in range(2 * w + 1)))


def _force(commanded: Vector, times: Vector, tails: Points, e: Points, setup: Setup) -> Vector:
    """Return the force of the coils upon the needle along it, by the mean currents around each time, shape (k,) [N].

    Args:
        commanded: stamps and currents, shape (j, 1 + m) [s, A].
        times: of frames; what they show was commanded `motion_delay` before, shape (k,) [s].
        tails: of the needle, shape (k, 2) [m].
        e: its direction, shape (k, 2).
        setup: with the coils.
    """
    needle, field = setup.coils.needle(), setup.coils.coil_field()
    steps = np.diff(commanded[:, 0])[:, None] * 0.5 * (commanded[1:, 1:] + commanded[:-1, 1:])
    charge, at = np.vstack([np.zeros(steps.shape[1]), np.cumsum(steps, axis=0)]), times - setup.coils.motion_delay
    ends = [
        [np.interp(at + side * HALF_WINDOW, commanded[:, 0], column) for column in charge.T] for side in (-1.0, 1.0)
    ]
    currents = (np.array(ends[1]) - np.array(ends[0])).T / (2.0 * HALF_WINDOW)
    gradients = [field.per_current(t + needle.length * d) - field.per_current(t) for t, d in zip(tails, e, strict=True)]
    return np.asarray(needle.pole * np.einsum("kim,km,ki->k", np.array(gradients), currents, e))


def measure_drag(pulls: Pulls, bare: tuple[float, float]) -> ThreadDrag:
    """Return the drags of a thread, by least squares over all frames.

    Intervals are of the scatter from pull to pull (White's estimate, clustered by pull, t-distributed), and of how well
    D is known: it may be wrong by itself, or with the strength of all coils, and T is then wrong by the same share.

    Args:
        pulls: at least `LEAST_PULLS`.
        bare: D of the bare needle, and half of its 95 % interval [N s/m].
    """
    value, interval = bare
    drags, spread, inverse = _fit(pulls.thread, pulls.force - value * pulls.speed, pulls.index)
    by_own = inverse @ pulls.thread.T @ pulls.speed  # - d drag / d D
    wide = np.sqrt(spread**2 + (interval * by_own) ** 2 + (interval / value * drags) ** 2)
    # Of the sum, an error of D by itself counts by what T does not take up, and one of all coils by the same share.
    shares = interval * (1.0 - by_own[0]), interval / value * (value + drags[0])
    total = float(np.sqrt(spread[0] ** 2 + shares[0] ** 2 + shares[1] ** 2))
    all_three = np.column_stack([pulls.thread, pulls.speed])
    own_by_pulls = float(_fit(all_three, pulls.force, pulls.index)[0][2])
    along, across = zip(drags.tolist(), wide.tolist(), strict=True)
    count = int(pulls.index[-1]) + 1
    return ThreadDrag(along, across, (value + along[0], total), own_by_pulls, count)


def _fit(rows: Vector, values: Vector, index: Indices) -> tuple[Vector, Vector, Vector]:
    """Return least-squares numbers, half of their 95 % intervals by clusters, and (X' X)^-1."""
    inverse = np.linalg.inv(rows.T @ rows)
    drags = inverse @ rows.T @ values
    left, count = values - rows @ drags, int(index[-1]) + 1
    scores = np.array([rows[index == k].T @ left[index == k] for k in range(count)])
    variance = np.diag(inverse @ scores.T @ scores @ inverse) * count / (count - 1.0)
    return drags, stdtrit(max(1, count - rows.shape[1]), 0.975) * np.sqrt(variance), inverse


def lines_of(pulls: Pulls, drag: ThreadDrag, own: float) -> Sequence[tuple[float, float]]:
    """Return, of each pull, the mean force on the thread as measured and as by its drags [N]."""
    measured = pulls.force - own * pulls.speed
    by_drags = pulls.thread @ [drag.along[0], drag.across[0]]
    of_each = [pulls.index == k for k in range(drag.pulls)]
    return [(float(measured[mask].mean()), float(by_drags[mask].mean())) for mask in of_each]
