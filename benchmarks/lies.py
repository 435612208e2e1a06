"""Lie to the coil bridge about the needle's pose, from a random moment on, and measure how the true needle moves.

The closed loop of campaigns runs a setup's path follower on a rig that differs from what the bridge believes, see
`vary` of `rig/campaign.py`. The poses of the tracker are then replaced by others. How fast and how far the needle goes,
and how close it comes to wall and shapes, is told by the rig and by shapely. Simulated.
"""

from __future__ import annotations

import argparse
import math
from collections import deque
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.closed_loop import PathControl
from benchmarks.keep_out import World
from benchmarks.report import figures_table
from magnetosuture_thread.commands.command import Terminal
from magnetosuture_thread.rig.campaign import vary
from magnetosuture_thread.rig.closed_loop import START, ClosedLoop, Measurement
from magnetosuture_thread.rig.rig import Rig, RigFrame
from magnetosuture_thread.rig.setups import Setup, read_setup

Vector = NDArray[np.float64]
SETUPS = ("hernia_ring", "dish_50mm", "petri_35mm_polyamide", "petri_35mm_polyamide_post", "petri_150mm_silk")
BEGIN, AFTER = (2.0, 8.0), 2.0  # s; when a lie begins, and for how long it is watched
AVERAGING = 10  # periods of the bridge over which a speed is taken
CLEAR = 2e-3  # m; from wall and shapes, for a lie that must not break the keep-out
STRAIGHT, HALF_TURN, QUARTER_TURN = np.eye(2), -np.eye(2), np.array([[0.0, -1.0], [1.0, 0.0]])

TIMES = {  # of honest poses, from the run's start: by how much later they arrive, and are stamped [s]
    "late by 0.1 s": (0.1, 0.0),
    "late by 0.2 s": (0.2, 0.0),
    "stamped 0.05 s too late": (0.05, 0.05),
    "stamped 0.05 s too early": (0.0, -0.05),
}

FAULTS: dict[str, Callable[[Vector], Vector]] = {  # of the coils: what flows where currents are set, shapes (m,) [A]
    "coil 0 reversed": lambda currents: currents * np.r_[-1.0, np.ones(len(currents) - 1)],
    "coil 0 without current": lambda currents: currents * np.r_[0.0, np.ones(len(currents) - 1)],
    "coils 0 and 1 exchanged": lambda currents: np.r_[currents[[1, 0]], currents[2:]],
    "coils 3 times as strong": lambda currents: 3.0 * currents,
    "coils 0.3 times as strong": lambda currents: 0.3 * currents,
    "coil 0 with 1 A more": lambda currents: currents + np.r_[1.0, np.zeros(len(currents) - 1)],
}


def _mapped(measured: Measurement, shift: Vector | float = 0.0, turn: Vector = STRAIGHT) -> Measurement:
    """Return a measurement turned about the dish's centre and shifted, shapes (2, 2) and (2,) [m]."""
    seen = measured.observation
    if seen is not None:
        seen = replace(seen, pieces=tuple(replace(p, points=p.points @ turn.T + shift) for p in seen.pieces))
    return replace(measured, tail=turn @ measured.tail + shift, heading=turn @ measured.heading, observation=seen)


class Liar:
    """Replaces measurements from a time on.

    Args:
        kind: of the lie, one of `LIES`.
        begin: time of the first lie [s].
        random: of its noise.
        setup: of the needle and the camera.

    Attributes:
        last: the last honest measurement.
        past: the last ten of them.
        walked: where a random walk is, shape (2,) [m].
        count: lies told.
        lever: half of the needle's chord [m].
        frame_rate: of the camera [Hz].
    """

    def __init__(self, kind: str, begin: float, random: np.random.Generator, setup: Setup) -> None:
        self.lever, self.frame_rate = 0.5 * setup.coils.needle().chord, setup.rig.frame_rate
        self._lie, self._begin, self.random = LIES[kind], begin, random
        self._delay, self._shift = TIMES.get(kind, (0.0, 0.0))
        self.past: deque[Measurement] = deque(maxlen=10)
        self.walked, self.count = np.zeros(2), 0

    def tell(self, measured: Measurement) -> Measurement | None:
        """Return a measurement as the bridge gets it; None for none."""
        measured = replace(measured, due=measured.due + self._delay, stamp=measured.stamp + self._shift)
        if measured.stamp - START < self._begin or not self.past:
            self.past.append(measured)
            self.last = measured
            return measured
        lie = self._lie(self, measured)
        self.count += 1
        return None if lie is None else replace(lie, due=measured.due, stamp=measured.stamp)


def _walk(liar: Liar, _: Measurement) -> Measurement:
    liar.walked = liar.walked + 2e-4 * liar.random.standard_normal(2)
    return _mapped(liar.last, liar.walked)


def _circle(liar: Liar, measured: Measurement) -> Measurement:
    angle = 3.0 * (measured.stamp - liar.last.stamp)
    return _mapped(liar.last, 1e-3 * np.array([math.cos(angle) - 1.0, math.sin(angle)]))


def _drift(liar: Liar, measured: Measurement) -> Measurement:
    return _mapped(measured, np.array([5e-3 * (measured.stamp - liar.last.stamp), 0.0]))


def _moved(liar: Liar, measured: Measurement, turn: Vector) -> Measurement:
    """Return a needle whose motion since the lie began is mapped, as by a turn."""
    moved = measured.tail - liar.last.tail
    return _mapped(measured, turn @ moved - moved)


def _turning(liar: Liar, measured: Measurement) -> Measurement:
    """Return a needle whose middle stands, and that turns as it does."""
    middle = liar.last.tail + liar.lever * liar.last.heading
    return replace(measured, tail=middle - liar.lever * measured.heading, observation=liar.last.observation)


def _sparse(liar: Liar, _: Measurement) -> Measurement | None:
    """Return the last honest pose 4.5 times a second."""
    return liar.last if liar.count % round(liar.frame_rate / 4.5) == 0 else None


LIES: dict[str, Callable[[Liar, Measurement], Measurement | None]] = {
    "frozen": lambda liar, _: liar.last,
    "frozen, 10 um of noise": lambda liar, _: _mapped(liar.last, 1e-5 * liar.random.standard_normal(2)),
    "the last ten frames": lambda liar, _: liar.past[liar.count % len(liar.past)],
    "heading turned by 180 degrees": lambda _, m: replace(m, heading=-m.heading),
    "image turned by 180 degrees": lambda _, m: _mapped(m, turn=HALF_TURN),
    "image turned by 90 degrees": lambda _, m: _mapped(m, turn=QUARTER_TURN),
    "image mirrored": lambda _, m: _mapped(m, turn=np.diag([-1.0, 1.0])),
    "moves oppositely": lambda liar, m: _moved(liar, m, HALF_TURN),
    "moves sideways": lambda liar, m: _moved(liar, m, QUARTER_TURN),
    "5 mm beside": lambda _, m: _mapped(m, np.array([5e-3, 0.0])),
    "walks at random": _walk,
    "goes in a circle": _circle,
    "drifts at 5 mm/s": _drift,
    "turns only": _turning,
    "frozen, at 4.5 frames/s": _sparse,
    "moves by 0.3 of its way": lambda liar, m: _moved(liar, m, 0.3 * STRAIGHT),
    "moves by 1.7 of its way": lambda liar, m: _moved(liar, m, 1.7 * STRAIGHT),
    "none": lambda _, m: m,
    **{kind: lambda _, m: m for kind in (*TIMES, *FAULTS)},
}


class FaultyRig(Rig):
    """A rig whose coils have a fault from a time on [s]."""

    fault: Callable[[Vector], Vector] | None
    begin: float

    def apply(self, currents: Vector, time: float) -> None:
        """Set other currents than those that are asked for."""
        super().apply(self.fault(currents) if self.fault is not None and time >= self.begin else currents, time)


class LyingLoop(ClosedLoop):
    """A closed loop whose measurements pass a liar."""

    liar: Liar

    def _measure(self, frame: RigFrame) -> Measurement | None:
        measured = super()._measure(frame)
        return None if measured is None else self.liar.tell(measured)


def run_lie(case: tuple[str, str, int]) -> dict[str, Any]:
    """Run one lie, from a setup's name, the lie's and a seed; return what the true needle did."""
    name, kind, seed = case
    setup, random = read_setup(name), np.random.default_rng([seed, 2])
    varied, begin = vary(setup, seed), float(random.uniform(*BEGIN))
    rig = FaultyRig(varied.setup.rig, setup.scene)
    rig.fault, rig.begin = FAULTS.get(kind), begin
    loop = LyingLoop(setup, rig, PathControl(setup), seed, losses=varied.losses)
    loop.liar = Liar(kind, begin, random, setup)
    world, kinematics, latch = World(setup.scene), setup.coils.needle().kinematics, loop.bridge.latch
    middles, clearances, stopped, travel, commanded = list[Vector](), list[float](), math.nan, math.nan, 0.0
    while rig.time < begin + AFTER and not (rig.time < begin and latch.fault):
        if (frame := loop.step()) is not None and rig.time >= begin:
            commanded = max(commanded, math.hypot(*frame.commanded))
        if rig.time < begin - AVERAGING / setup.coils.rate:
            continue
        at = rig.look(rig.time, rendered=False)
        heading = np.array([math.cos(at.heading), math.sin(at.heading)])
        ends = np.array([at.tail, kinematics.tip(at.tail, heading)])
        middles.append(ends.mean(axis=0))
        clearances.append(world.clearance([ends]))
        if latch.fault and math.isnan(stopped):
            stopped, travel = rig.time - begin, float(np.linalg.norm(middles[-1] - middles[AVERAGING]))
    case_of = {"setup": name, "lie": kind, "seed": seed}
    if not middles:
        return {**case_of, "stopped_before": latch.fault}
    path = np.array(middles)
    speeds = np.linalg.norm(path[AVERAGING:] - path[:-AVERAGING], axis=1) * setup.coils.rate / AVERAGING
    return {
        **case_of,
        "stopped_before": "",
        "fault": latch.fault,
        "stopped_s": None if math.isnan(stopped) else stopped,
        "travel_m": None if math.isnan(travel) else travel,
        "peak_speed_ratio": float(speeds.max()) / setup.coils.max_speed,
        "bound_ratio": float(speeds.max()) / (commanded + setup.coils.needle().max_pull_speed),
        "broken": bool(clearances[0] > CLEAR and min(clearances) < setup.coils.keep_out),
    }


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--seeds", type=int, default=20, help="runs of each lie on each setup")
    parser.add_argument("--setup", action="append", choices=SETUPS, help="one setup; all if none is named")
    parser.add_argument("--lie", action="append", choices=LIES, help="one lie; all if none is named")
    parser.add_argument("--workers", type=int, default=2, help="processes")


def run(options: argparse.Namespace, terminal: Terminal) -> tuple[dict[str, Any], bool]:
    """Run all lies; return the figures, and whether all but an honest tracker's ended in a fault, and none of those."""
    setups, lies = options.setup or SETUPS, options.lie or LIES
    with ProcessPoolExecutor(options.workers) as pool:
        runs = list(pool.map(run_lie, product(setups, lies, range(options.seeds))))
    lied = [run for run in runs if not run["stopped_before"]]
    columns = {"lie": "{lie}", "latched": "{latched}/{runs}", "after [s]": "{after}", "travel [mm]": "{travel}"}
    columns |= {"speed": "{speed:.2f}", "of bound": "{bound:.2f}", "broken": "{broken}"}
    caption = (
        "s, mm: until the fault is latched, time and true travel, median (maximum); speed: over max_speed; of bound: "
        "over what is commanded and max_pull over the drag; broken: keep_out, by lies that "
        f"began {1e3 * CLEAR:g} mm from a shape; {len(runs) - len(lied)} of {len(runs)} runs stopped before their lie"
    )
    for name in setups:
        rows = [_row(kind, [run for run in lied if (run["setup"], run["lie"]) == (name, kind)]) for kind in lies]
        terminal.print(figures_table(f"{name}: lies about the needle's pose, simulated", rows, columns, caption))
    return {"runs": runs}, all((run["stopped_s"] is None) == (run["lie"] in ("none", *TIMES)) for run in lied)


def _row(kind: str, runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the figures of a lie's runs."""
    latched = [run for run in runs if run["stopped_s"] is not None]
    values = {"after": [run["stopped_s"] for run in latched], "travel": [1e3 * run["travel_m"] for run in latched]}
    shown = {name: f"{np.median(times):.2f} ({max(times):.2f})" if times else "-" for name, times in values.items()}
    speed, bound = (max((run[name] for run in runs), default=0.0) for name in ("peak_speed_ratio", "bound_ratio"))
    counts = {"latched": len(latched), "runs": len(runs), "broken": sum(run["broken"] for run in runs)}
    return {"lie": kind, **shown, "speed": speed, "bound": bound, **counts}
