"""Obstacles from flat lists of numbers."""

from __future__ import annotations

import pytest

from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.geometry.obstacles.lists import discs_from, polygons_from

SQUARE = [0.0, 0.0, 0.01, 0.0, 0.01, 0.01, 0.0, 0.01]
HOLE = [0.004, 0.004, 0.006, 0.004, 0.006, 0.006, 0.004, 0.006]
TRIANGLE = [0.02, 0.0, 0.03, 0.0, 0.02, 0.01]


def test_discs_are_x_y_and_radius_in_turn():
    assert discs_from((0.01, 0.02, 0.001, 0.0, 0.0, 0.002)) == (Disc((0.01, 0.02), 0.001), Disc((0.0, 0.0), 0.002))
    assert discs_from(()) == ()


def test_polygons_have_the_holes_after_them():
    first, second = polygons_from("node", [*SQUARE, *HOLE, *TRIANGLE], [4, -4, 3])
    assert first.area == pytest.approx(0.96e-4)
    assert len(first.holes) == 1
    assert second.area == pytest.approx(0.5e-4)


def test_corners_are_rounded_where_that_is_asked_for():
    (sharp,), (rounded,) = (polygons_from("node", SQUARE, [4], radius, 0.5) for radius in (0.0, 1e-3))
    assert len(sharp.outline) == 4
    assert len(rounded.outline) > 20


@pytest.mark.parametrize(
    ("corners", "sizes", "words"),
    [
        (SQUARE, [], r"node\.polygon_sizes: .* 4 in all"),
        (SQUARE, [3], "4 in all"),
        (SQUARE, [-4], "an outline before its holes"),
        (SQUARE[:4], [2], r"node\.polygon_obstacles, polygon 0.outline: .*at least 3 points"),
        ([*SQUARE, 0.0, 0.0, 0.01, 0.01, 0.01, 0.0, 0.0, 0.01], [4, 4], "polygon 1"),
    ],
)
def test_lists_that_make_no_polygons_are_refused_by_name(corners: list[float], sizes: list[int], words: str):
    with pytest.raises(ConfigurationError, match=words):
        polygons_from("node", corners, sizes)
