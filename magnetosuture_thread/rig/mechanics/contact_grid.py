"""A grid over all that can be touched, which tells what is near a place without comparing it with everything."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled_inline


class Bins(NamedTuple):
    """What is in each cell of a grid.

    Attributes:
        starts: where the content of each cell begins in `content`, and the end, shape (h w + 1,).
        content: indices.
    """

    starts: NDArray[np.int64]
    content: NDArray[np.int64]


def bin_boxes(
    low: NDArray[np.float64], high: NDArray[np.float64], grid: NDArray[np.float64], shape: tuple[int, ...]
) -> Bins:
    """Return which boxes reach into each cell; those that are not finite reach into none."""
    cells: list[list[int]] = [[] for _ in range(shape[0] * shape[1])]
    for index, ends in enumerate(np.stack([low, high], axis=1)):
        if np.isfinite(ends).all():
            # Rounded as `cells_around` does, so that a point is in one cell, and boxes that meet share one.
            first, last = np.clip(((ends - grid[:2]) / grid[2]).astype(int), 0, (shape[1] - 1, shape[0] - 1))
            for row in range(first[1], last[1] + 1):
                for column in range(first[0], last[0] + 1):
                    cells[row * shape[1] + column].append(index)
    counts = [len(cell) for cell in cells]
    return Bins(np.cumsum([0, *counts]), np.array([index for cell in cells for index in cell], dtype=np.int64))


@compiled_inline
def cells_around(
    low_x: float, low_y: float, high_x: float, high_y: float, grid: NDArray[np.float64], shape: tuple[int, int]
) -> tuple[int, int, int, int]:
    """Return the first and last row, and the first and last column, of the cells that a box reaches into."""
    x, y, side = grid[0], grid[1], grid[2]
    rows, columns = shape[0] - 1.0, shape[1] - 1.0
    return (
        int(min(max((low_y - y) / side, 0.0), rows)),
        int(min(max((high_y - y) / side, 0.0), rows)),
        int(min(max((low_x - x) / side, 0.0), columns)),
        int(min(max((high_x - x) / side, 0.0), columns)),
    )


@compiled_inline
def clear(x: float, y: float, reach: float, grid: NDArray[np.float64], clearances: NDArray[np.float64]) -> bool:
    """Return whether nothing is within reach, as far as the grid tells; from beyond the grid all is as far or farther.

    All but the wall, that is, which is in the cells at the border already.
    """
    rows, columns = clearances.shape
    i = int(min(max((y - grid[1]) / grid[2], 0.0), rows - 1.0))
    j = int(min(max((x - grid[0]) / grid[2], 0.0), columns - 1.0))
    return bool(clearances[i, j] > reach)
