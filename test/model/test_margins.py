"""The margins of a prediction as one table."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.model.barriers import BarrierRows
from magnetosuture_thread.model.barriers.rows import NO_OBSTACLE, BarrierKind
from magnetosuture_thread.model.margins import Margins


def rows(kind: BarrierKind, nodes: list[int], obstacle: list[int], clearance: list[float]) -> BarrierRows:
    """Return barriers whose values are twice their clearances."""
    table = np.array([[node - 1, node] for node in nodes], dtype=np.intp).reshape(-1, 2)
    away = np.array(clearance, dtype=float)
    return BarrierRows(kind, table, np.array(obstacle, dtype=np.intp), 2.0 * away, np.zeros((len(nodes), 2, 2)), away)


CONNECTIVITY = rows(BarrierKind.CONNECTIVITY, [1, 2, 3], [NO_OBSTACLE] * 3, [1e-9, -1e-9, 0.0])
OBSTACLE = rows(BarrierKind.OBSTACLE, [3, 7, 7, 5], [0, 0, 1, 2], [4e-5, 2e-3, 5e-5, -1e-6])
WALL = rows(BarrierKind.WALL, [6, 7], [NO_OBSTACLE] * 2, [3e-3, 2e-5])
NONE = rows(BarrierKind.OBSTACLE, [], [], [])


def test_the_kinds_come_one_after_another():
    found = Margins.of([CONNECTIVITY, OBSTACLE], 5e-5)
    assert found.kind.tolist() == [0, 0, 0, 2, 2, 2, 2]
    assert found.node.tolist() == [1, 2, 3, 3, 7, 7, 5]
    assert found.obstacle.tolist() == [-1, -1, -1, 0, 0, 1, 2]
    np.testing.assert_array_equal(found.value, 2.0 * found.clearance)
    assert found.clearance.tolist() == [1e-9, -1e-9, 0.0, 4e-5, 2e-3, 5e-5, -1e-6]


def test_the_least_of_each_kind_is_named():
    connectivity, obstacle = Margins.of([CONNECTIVITY, OBSTACLE], 5e-5).least
    assert (connectivity.kind, connectivity.node, connectivity.obstacle) == (0, 2, -1)
    assert (obstacle.kind, obstacle.node, obstacle.obstacle) == (2, 5, 2)
    assert (obstacle.value, obstacle.clearance) == (-2e-6, -1e-6)


@pytest.mark.parametrize(("tolerance", "touching"), [(5e-5, (3, 5, 7)), (1e-5, (5,)), (0.0, (5,)), (1.0, (3, 5, 7))])
def test_nodes_within_the_tolerance_touch(tolerance: float, touching: tuple[int, ...]):
    assert Margins.of([CONNECTIVITY, OBSTACLE], tolerance).touching == touching


def test_who_touches_the_wall_touches():
    found = Margins.of([CONNECTIVITY, OBSTACLE, WALL], 4.5e-5)
    assert found.touching == (3, 5, 7)
    assert [(least.kind, least.node, least.obstacle) for least in found.least] == [(0, 2, -1), (2, 5, 2), (5, 7, -1)]
    assert Margins.of([CONNECTIVITY, WALL], 1e-5).touching == ()


def test_a_kind_without_barriers_is_not_there():
    found = Margins.of([CONNECTIVITY, NONE], 5e-5)
    assert [least.kind for least in found.least] == [0]
    assert found.touching == ()
    assert len(found.kind) == 3


@pytest.mark.parametrize("barriers", [[], [NONE], [NONE, NONE]])
def test_there_may_be_no_barrier_at_all(barriers: list[BarrierRows]):
    found = Margins.of(barriers, 5e-5)
    assert (found.least, found.touching) == ((), ())
    assert [len(table) for table in (found.kind, found.node, found.obstacle, found.value, found.clearance)] == [0] * 5


@pytest.mark.parametrize("barriers", [[], [CONNECTIVITY, OBSTACLE]])
def test_the_tables_have_the_types_of_the_message(barriers: list[BarrierRows]):
    found = Margins.of(barriers, 5e-5)
    tables = (found.kind, found.node, found.obstacle, found.value, found.clearance)
    assert [table.dtype for table in tables] == [np.uint8, np.uint32, np.int32, np.float64, np.float64]
