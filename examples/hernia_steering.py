"""Makes the bag `examples/hernia_steering`: what an operator asks of the needle around a hernia.

No person steered it: this script presses arrow keys towards points around the ring, at the speeds and times below, and
watches where the needle goes in the thread model. Run it from the top: python examples/hernia_steering.py
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from magnetosuture_thread.bags.packing import packed_twist
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.evaluation.hernia import RATE, SteeredThread, point_filter, start_centreline
from magnetosuture_thread.rig.setups import read_setup
from magnetosuture_thread.settings.interface import OPERATOR_COMMAND

BAG = Path(__file__).parent / "hernia_steering"
SETUP = "hernia_ring"
CENTRE, AROUND = np.array([0.0, 5e-3]), 6.7e-3  # m; of the ring, and the way around it
END = 72.0  # s
REACHED = 6e-4  # m; near enough to a point to go for the next
STOPPED = 1.5e-4  # m; the same for the last point of a stage
KEYS = [np.array([x, y]) / np.hypot(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y]  # one arrow, or two


def around(begin: float, end: float) -> list[tuple[float, float]]:
    """Return points around the ring, clockwise, by their angles in degrees."""
    angles = np.radians(np.arange(begin, end, -10.0))
    return [(float(x), float(y)) for x, y in CENTRE + AROUND * np.column_stack([np.cos(angles), np.sin(angles)])]


# When a stage begins [s], the speed [m/s], and the points to go for [m].
STAGES = [
    (4.1, 2.5e-3, [(4e-3, -1.05e-2), (0.0, -7.5e-3), (0.0, -1.6e-3)]),  # to the penetration path and through
    (14.2, 2.0e-3, [(0.0, -2.6e-3)]),  # back a little: the thread is slack
    (15.2, 0.2e-3, [(-1.6e-3, -2.4e-3)]),  # to the left, pulling nothing yet
    (18.0, 5.0e-3, around(255.0, -115.0)),  # around the ring
]


def keys(thread: SteeredThread) -> Iterator[tuple[float, np.ndarray]]:
    """Yield what is asked for at each time, steering the thread by it."""
    stage, points, speed = 0, [], 0.0
    for k in range(round(END * RATE)):
        time, needle = k / RATE, thread.now.prediction.positions[0]
        if stage < len(STAGES) and time >= STAGES[stage][0]:
            _, speed, points = STAGES[stage]
            stage += 1
        while points and np.linalg.norm(points[0] - needle) < (REACHED if len(points) > 1 else STOPPED):
            points = points[1:]
        asked = np.zeros(2)
        if points:
            way = np.array(points[0]) - needle
            asked = speed * max(KEYS, key=lambda key: float(key @ way))
        thread.step(1.0 / RATE, asked)
        yield time, asked


def main() -> None:
    """Write the bag anew."""
    setup = read_setup(SETUP)
    shutil.rmtree(BAG, ignore_errors=True)
    notes = {"setup": SETUP, "simulated": "arrow keys pressed by a script, steering the thread model alone"}
    with BagWriter(BAG, notes) as bag:
        bag.add_topic(OPERATOR_COMMAND.recorded, OPERATOR_COMMAND.type_name)
        needle = point_filter(setup.scene, setup.coils.keep_out, setup.coils.approach_rate)
        for time, (x, y) in keys(SteeredThread(setup.model, start_centreline(setup), needle)):
            stamp = 1_000_000_000 + round(time * 1e9)
            bag.write(OPERATOR_COMMAND.recorded, stamp, packed_twist(stamp, np.array([x, y])))


if __name__ == "__main__":
    main()
