"""Arrays of numbers from callers: converted, and checked in shape and bounds."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.settings.configuration import Quantity
from magnetosuture_thread.settings.errors import InvalidInputError, shortened


def as_numbers(name: str, value: Any) -> NDArray[np.float64]:
    """Return an array of a caller's numbers, itself where it is one.

    Raises:
        InvalidInputError: they are no numbers, or rows of different lengths.
    """
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InvalidInputError(name, shortened(repr(value)), "an array of numbers") from None


def finite_array(name: str, value: Any, shape: tuple[int | None, ...], limits: Quantity) -> NDArray[np.float64]:
    """Return an array of a caller's numbers that has a shape and is within limits.

    Args:
        name: of the array, for the error.
        value: as it was given.
        shape: that it must have; None for any length.
        limits: of each number.

    Raises:
        InvalidInputError: something is no number, not finite or out of the limits, or the shape is another.
    """
    array = as_numbers(name, value)
    words = str(shape).replace("None", "m")
    if array.ndim != len(shape) or any(size not in (None, got) for size, got in zip(shape, array.shape, strict=True)):
        raise InvalidInputError(name, f"shape {array.shape}", f"shape {words}")
    # Of a few numbers numpy takes longer to find the greatest.
    few = array.shape in ((2,), (3,))
    extremes = array.tolist() if few else [float(array.min(initial=0.0)), float(array.max(initial=0.0))]
    if not all(map(limits.within, extremes)):
        expected = limits.expectation(tuple, extremes).replace("a list", "numbers")
        raise InvalidInputError(name, extremes, f"finite {expected}, in shape {words}")
    return array
