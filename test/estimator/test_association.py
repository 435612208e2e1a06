"""Points are put where they belong along the thread, or refused."""

from __future__ import annotations

import math

import numpy as np
import pytest

from magnetosuture_thread import Disc
from magnetosuture_thread.estimator.association import (
    measured_points,
    place_pieces,
    project,
)
from magnetosuture_thread.geometry.obstacles import Workspace
from magnetosuture_thread.thread_observation import PieceEnd, ThreadObservation, ThreadPiece
from test.estimator.threads import (
    DEVIATION,
    LENGTH,
    error_percent,
    estimator_of,
    piece_of,
    poses,
    thread_of,
    true_shapes,
    whole,
)

NAN = (float("nan"), float("nan"))


@pytest.mark.parametrize("turn", [0.1, -0.1])
def test_points_on_the_arc_that_the_thread_bends_in_have_no_innovation(turn: float) -> None:
    """Nodes on a circle, one unit of its arc apart; between two of them it is up to 0.0125 beside their chord."""
    centre = np.array([0.0, 1.0 / turn])

    def on_arc(arcs: np.ndarray, outwards: float = 0.0) -> np.ndarray:
        return centre + (1.0 / turn - outwards) * np.column_stack([np.sin(turn * arcs), -np.cos(turn * arcs)])

    nodes, arcs = on_arc(np.arange(20.0)), np.arange(0.0, 12.0, 0.23)
    for left in (0.0, 0.02, -0.02):
        place, innovation = project(nodes, on_arc(3.1 + arcs, left), arcs, 3.1, 0.1)
        np.testing.assert_allclose(place, 3.1 + arcs, atol=0.01)
        np.testing.assert_allclose(innovation, left, atol=1e-4)


@pytest.mark.parametrize("beyond", [0.4, -0.3])
def test_a_piece_is_placed_from_either_end_and_its_free_end_is_measured_along_the_thread(beyond: float) -> None:
    turn = 0.1 * np.arange(25.0)
    nodes = np.vstack([np.zeros(2), np.cumsum(np.column_stack([np.cos(turn), np.sin(turn)]), axis=0)])
    along = nodes[-1] - nodes[-2]
    points = np.vstack([nodes[8:], nodes[-1] + beyond * along]) * 1e-3
    found = []
    for turned in (False, True):
        ends = (PieceEnd.UNKNOWN, PieceEnd.FREE)
        ends, given = (ends[::-1], points[::-1]) if turned else (ends, points)
        piece = ThreadPiece(given, np.full(len(points), 1e-5), *ends, NAN, direction_known=False)
        placed, problems = place_pieces(ThreadObservation((piece,)), nodes, np.ones(26), 1e-3)
        assert not problems
        measured, _ = measured_points(placed, nodes, 0.01, 1.0, 1e-3, (Workspace((), 5e-3), 0.0))
        assert measured is not None
        assert measured.end[0] == pytest.approx(beyond)
        found.append(placed[0])
    for name in ("points", "variance", "share", "arcs", "start"):
        np.testing.assert_allclose(getattr(found[0], name), getattr(found[1], name), atol=1e-6, err_msg=name)


def run_with(pieces_at, count: int = 60, **options):
    """Return estimates of a thread that starts as it lies, with pieces made from its true nodes at each pose."""
    way, thread = poses(count), thread_of(**options)
    truth = true_shapes(thread, way)
    estimator = estimator_of(thread_of(viscosity=1.3))
    estimator.start(way[0])
    found = [estimator.step(pose, pieces_at(truth[k], k)) for k, pose in enumerate(way[1:], 1)]
    return found, truth


def test_a_piece_of_unknown_place_and_direction_is_placed() -> None:
    def seen(nodes: np.ndarray, k: int) -> ThreadObservation:
        piece = piece_of(nodes, k, 0.4 * LENGTH, 0.8 * LENGTH)
        turned = piece.points[::-1] if k % 2 else piece.points
        return ThreadObservation(
            (ThreadPiece(turned, piece.deviation, PieceEnd.UNKNOWN, PieceEnd.UNKNOWN, NAN, direction_known=False),)
        )

    found, truth = run_with(seen)
    assert all(each.corrected and not each.problems for each in found)
    assert found[-1].hidden == pytest.approx(0.6, abs=0.1)
    assert error_percent(found[-1].positions, truth[-1]) < 0.2


def test_another_thread_is_refused() -> None:
    other = np.column_stack([np.linspace(-0.012, 0.004, 60), np.full(60, 0.002)])

    def seen(nodes: np.ndarray, k: int) -> ThreadObservation:
        piece = ThreadPiece(other, np.full(60, DEVIATION), PieceEnd.UNKNOWN, PieceEnd.UNKNOWN, NAN, False)
        return ThreadObservation((piece, piece_of(nodes, k)))

    found, truth = run_with(seen)
    assert all(any("another" in problem for problem in each.problems) for each in found)
    assert error_percent(found[-1].positions, truth[-1]) < 0.15


def test_outliers_do_not_move_the_thread() -> None:
    def seen(nodes: np.ndarray, k: int) -> ThreadObservation:
        rng, piece = np.random.default_rng(k), piece_of(nodes, k)
        wrong = rng.random(len(piece.points)) < 0.1
        angle = rng.uniform(0.0, 2.0 * np.pi, wrong.sum())
        piece.points[wrong] += 5e-3 * np.column_stack([np.cos(angle), np.sin(angle)])
        return ThreadObservation((piece,))

    found, truth = run_with(seen)
    assert max(error_percent(each.positions, nodes) for each, nodes in zip(found, truth[1:], strict=True)) < 0.5
    assert error_percent(found[-1].positions, truth[-1]) < 0.15


def test_points_beyond_an_obstacle_are_refused() -> None:
    disc, way = Disc((-0.01, 0.0021), 2e-3), poses(3, turn=0.0)
    estimator = estimator_of(thread_of(), (disc,))
    estimator.start(way[0])
    nodes = np.column_stack([-np.linspace(0.0, LENGTH, 26), np.zeros(26)]) + way[1].tail
    piece = piece_of(nodes, 1)
    beyond = (piece.points[:, 0] < -0.0094) & (piece.points[:, 0] > -0.0106)
    piece.points[beyond, 1] = 0.0045
    estimate = estimator.step(way[1], ThreadObservation((piece,)))
    assert (
        any("obstacle" in problem or "path" in problem for problem in estimate.problems)
        or np.abs(estimate.positions[:, 1]).max() < 1e-4
    )
    assert np.abs(estimate.positions[:, 1]).max() < 1e-4


@pytest.mark.parametrize("start", ["straight", "wrong"])
def test_unknown_start_is_found_at_once(start: str) -> None:
    way = poses(90)
    truth = true_shapes(thread_of(), way)
    estimator = estimator_of(thread_of())
    bent = truth[40] + np.linspace(0.0, 1.0, 26)[:, None] * np.array([0.0, 0.2 * LENGTH])
    estimator.start(way[40], bent if start == "wrong" else None)
    for k in range(41, 71):
        estimate = estimator.step(way[k], whole(truth[k], k))
    assert error_percent(estimate.positions, truth[70]) < 0.3


def test_a_thread_that_lies_elsewhere_is_believed_when_a_second_frame_shows_it() -> None:
    way = poses(14)
    truth = true_shapes(thread_of(), way)
    estimator = estimator_of(thread_of())
    estimator.start_observed(way[0], whole(truth[0], 0))
    for k in range(1, 12):
        estimator.step(way[k], whole(truth[k], k))
    turn = np.array([[math.cos(1.2), math.sin(1.2)], [-math.sin(1.2), math.cos(1.2)]])
    elsewhere = [way[k].tail + (truth[k] - way[k].tail) @ turn for k in (12, 13)]
    first, second = (estimator.step(way[k], whole(elsewhere[k - 12], k)) for k in (12, 13))
    assert error_percent(first.positions, elsewhere[0]) > 1.0
    assert error_percent(second.positions, elsewhere[1]) < 0.1
