"""Friction: between which obstacles a thread is squeezed, and what slows the needle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from magnetosuture_thread.geometry.barrier import BarrierRows
from magnetosuture_thread.geometry.obstacles import Disc, Workspace
from magnetosuture_thread.thread.barriers import Connectivity, ObstacleAvoidance, WallAvoidance
from magnetosuture_thread.thread.margins import (
    BarrierMargins,
    Friction,
    FrictionLaw,
    FrictionState,
    Margins,
)

LAW = FrictionLaw(threshold=1e-3, beta=0.9, stuck_speed=2e-4)
NODES = np.column_stack([np.arange(0.0, -8e-3, -1e-3), np.zeros(8)])  # 0 is the needle


def barriers(*discs: tuple[float, float, float], others: tuple[BarrierRows, ...] = ()) -> Margins:
    """Return the margins of the nodes among discs x, y, radius."""
    around = Workspace([Disc((x, y), radius) for x, y, radius in discs], 5e-3)
    rows = Connectivity(1e-3).rows(NODES), ObstacleAvoidance(around, 0.0).rows(NODES), *others
    return Margins.of([BarrierMargins.from_rows(each) for each in rows], 0.0)


# Two discs 0.9 mm above and below the nodes 3 and 4, and no other node.
GATE = ((-3.5e-3, 1.9e-3, 1e-3), (-3.5e-3, -1.9e-3, 1e-3))


def test_nodes_close_to_two_obstacles_slow_the_needle_while_pulled():
    assert LAW.classify(barriers(*GATE), np.full(8, 1e-3)) == Friction(FrictionState.SLIDING, (3, 4), 0.9**2)
    third = (-3.5e-3, 1.85e-3, 1e-3)
    assert LAW.classify(barriers(*GATE, third), np.full(8, 1e-3)).nodes == (3, 4)


def test_who_moves_elsewhere_pulls_nothing():
    speeds = np.full(8, 1e-3)
    speeds[[3, 4]] = 2e-4
    assert LAW.classify(barriers(*GATE), speeds) == Friction(FrictionState.STUCK, (3, 4), 1.0)
    speeds[4] = 2.1e-4  # one is enough
    assert LAW.classify(barriers(*GATE), speeds) == Friction(FrictionState.SLIDING, (3, 4), 0.9**2)


def test_the_bound_counts_where_it_is_to_and_where_there_is_one():
    margins, by_bound = barriers(*GATE), replace(LAW, threshold=0.95e-3, by_bound=True)
    avoided = margins["obstacle"]
    assert by_bound.classify(margins, np.ones(8)).nodes == ()
    bounded = margins.with_bounds({"obstacle": avoided.clearance - 2e-5})
    assert by_bound.classify(bounded, np.ones(8)).nodes == (3, 4)
    assert replace(by_bound, by_bound=False).classify(bounded, np.ones(8)).nodes == ()


def test_between_an_obstacle_and_the_wall_is_no_friction_as_the_paper_counts_it():
    close = WallAvoidance(Workspace([], 5e-3, 2, 7.5e-3), 0.0).rows(NODES)
    assert (close.clearance < 1e-3).any()
    disc = (-7e-3, 1.5e-3, 1e-3)
    assert LAW.classify(barriers(disc, others=(close,)), np.full(8, 1e-3)) == Friction(FrictionState.FREE, (), 1.0)
