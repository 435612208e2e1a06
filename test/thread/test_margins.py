"""The margins of a prediction as one table."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.geometry.barrier import NO_OBSTACLE, BarrierRows
from magnetosuture_thread.thread.margins import BarrierMargins, Margins


def rows(barrier: str, nodes: list[int], obstacle: list[int], clearance: list[float]) -> BarrierRows:
    """Return barriers whose values are twice their clearances."""
    table = np.array([[node - 1, node] for node in nodes], dtype=np.intp).reshape(-1, 2)
    away = np.array(clearance, dtype=float)
    return BarrierRows(
        barrier, table, np.array(obstacle, dtype=np.intp), 2.0 * away, np.zeros((len(nodes), 2, 2)), away
    )


CONNECTIVITY = rows("connectivity", [1, 2, 3], [NO_OBSTACLE] * 3, [1e-9, -1e-9, 0.0])
OBSTACLE = rows("obstacle", [3, 7, 7, 5], [0, 0, 1, 2], [4e-5, 2e-3, 5e-5, -1e-6])
BARRIERS = [BarrierMargins.from_rows(each) for each in (CONNECTIVITY, OBSTACLE)]


def test_the_minimum_of_each_barrier_is_named():
    found = Margins.of(BARRIERS, 5e-5)
    connectivity, obstacle = found.minima
    assert (connectivity.barrier, connectivity.node[0], connectivity.obstacle[0]) == ("connectivity", 2, -1)
    assert (obstacle.barrier, obstacle.node[0], obstacle.obstacle[0]) == ("obstacle", 5, 2)
    assert (obstacle.minimum, obstacle.minimum_clearance) == (-2e-6, -1e-6)
    assert (found["obstacle"].minimum, found["obstacle"].minimum_clearance) == (-2e-6, -1e-6)


@pytest.mark.parametrize(("tolerance", "touching"), [(5e-5, (3, 5, 7)), (1e-5, (5,)), (0.0, (5,)), (1.0, (3, 5, 7))])
def test_nodes_within_the_tolerance_touch(tolerance: float, touching: tuple[int, ...]):
    assert Margins.of(BARRIERS, tolerance).in_contact == touching
