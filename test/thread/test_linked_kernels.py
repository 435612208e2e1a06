"""Compiled functions that others call: their results and errors are those of calls from Python."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.compiled import compiled, compiled_inline, compiled_without_gil


@compiled_inline
def twice(x: float) -> float:
    return 2.0 * x


@compiled
def squares(count: int) -> np.ndarray:
    return np.arange(count) ** 2.0


@compiled
def checked_total(values: np.ndarray, factor: float = 3.0) -> float:
    if values[0] < 0.0:
        raise ValueError("below zero")
    return float(factor * values.sum() + twice(values[0]))


@compiled_without_gil
def total_of_squares(values: np.ndarray) -> float:
    return checked_total(values) + checked_total(squares(3), factor=1.0)


def test_a_function_that_others_call_is_the_same_function():
    values = np.array([1.0, 2.0])
    assert checked_total(values) == 11.0
    assert total_of_squares(values) == 11.0 + 5.0
    np.testing.assert_array_equal(squares(3), [0.0, 1.0, 4.0])


@pytest.mark.parametrize("function", [checked_total, total_of_squares])
def test_an_error_of_a_function_that_others_call_is_raised(function):
    with pytest.raises(ValueError, match="below zero"):
        function(np.array([-1.0]))
