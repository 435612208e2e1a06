"""Process noise: learned from innovations, and what errors that are left say of it."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.model.estimator.noise import SURE, WINDOWS, NoiseBank, intensity_with_excess


def bank_with(errors: np.ndarray, deviation: float) -> NoiseBank:
    """Return a bank that expects an error of the estimate in each window, with a standard deviation [m]."""
    bank = NoiseBank.of(WINDOWS)
    bank.error[:] = errors[:, None]
    bank.variance[:] = deviation**2
    return bank


def intensity_of(bank: NoiseBank, *, settled: bool = True) -> np.ndarray:
    intensity = np.empty(WINDOWS)
    intensity_with_excess(bank, np.zeros(WINDOWS), 0.1, settled, intensity)
    return intensity


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_errors_of_all_windows_together_raise_the_noise_of_all(side: float) -> None:
    """None of them alone would be sure: the thread as a whole is wrong by little."""
    errors = side * np.linspace(0.5, 2.5, WINDOWS)
    assert np.abs(errors).max() < SURE
    bank = bank_with(1e-5 * errors, 1e-5)
    expected = 1e-10 * np.maximum(errors**2 - 1.0, 0.0).mean() / 0.1
    np.testing.assert_allclose(intensity_of(bank), expected, rtol=1e-12)
    np.testing.assert_array_equal(intensity_of(bank, settled=False), bank.intensity)


def test_errors_as_expected_raise_nothing() -> None:
    errors = np.random.default_rng(1).normal(0.0, 1.0, WINDOWS)
    bank = bank_with(1e-5 * errors, 1e-5)
    assert (errors**2).mean() < 2.0
    np.testing.assert_array_equal(intensity_of(bank), bank.intensity)


def test_an_error_of_one_window_that_is_sure_raises_the_noise_there() -> None:
    errors = np.zeros(WINDOWS)
    errors[4] = 4.0
    bank = bank_with(1e-5 * errors, 1e-5)
    raised = intensity_of(bank)
    assert raised[4] == pytest.approx(bank.intensity[4] + 1e-10 * (16.0 - 9.0) / 0.1)
    np.testing.assert_array_equal(np.delete(raised, 4), np.delete(bank.intensity, 4))
