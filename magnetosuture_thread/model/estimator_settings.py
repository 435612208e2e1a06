"""Settings of the estimator, which are among those of the thread model."""

from __future__ import annotations

from dataclasses import dataclass, fields

from magnetosuture_thread.configuration import Configuration, quantity
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.model.estimator import EstimatorOptions
from magnetosuture_thread.model.estimator.options import SLOW_PARAMETERS

_OPTIONS = EstimatorOptions()  # their defaults


@dataclass(frozen=True)
class EstimatorSettings(Configuration):
    """Whether the thread is estimated, and how much camera and model are trusted; see `EstimatorOptions`."""

    estimator: bool = quantity(
        True, "whether the thread is estimated too: the model corrected by the camera; for rod in liquid"
    )
    estimator_error_correlation: float = quantity(
        _OPTIONS.error_correlation,
        "distance along the thread over which the model's errors are alike, as a part of its length",
        minimum=0.01,
        maximum=1.0,
    )
    estimator_point_correlation: float = quantity(
        _OPTIONS.point_correlation,
        "distance along the thread over which the errors of measured points are alike",
        unit="m",
        minimum=1e-6,
        maximum=0.1,
    )
    estimator_min_deviation: float = quantity(
        _OPTIONS.min_deviation,
        "standard deviation of a measured point, at the least",
        unit="m",
        minimum=1e-7,
        maximum=0.01,
    )
    estimator_path_deviation: float = quantity(
        2e-5,
        "standard deviation of the points of thread/measured, used where nobody publishes thread/observation",
        unit="m",
        minimum=1e-7,
        maximum=0.01,
    )
    estimator_noise_time: float = quantity(
        _OPTIONS.noise_time,
        "time over which it is learned by how much the model errs",
        unit="s",
        minimum=0.05,
        maximum=100.0,
    )
    estimator_initial_error: float = quantity(
        _OPTIONS.initial_error,
        "standard deviation of the free end before it is measured, as a part of the thread's length",
        minimum=1e-3,
        maximum=2.0,
    )
    estimator_disturbance_time: float = quantity(
        _OPTIONS.disturbance_time,
        "averaging time of the test for forces that the model does not know",
        unit="s",
        minimum=0.05,
        maximum=10.0,
    )
    estimator_history: float = quantity(
        _OPTIONS.history, "how late an observation of the thread may come", unit="s", minimum=0.05, maximum=5.0
    )
    estimator_slow_parameters: tuple[str, ...] = quantity(
        _OPTIONS.slow_parameters,
        f"what the estimator learns of the thread as it runs, some of {', '.join(SLOW_PARAMETERS)}, or nothing; "
        "auto: stiffness over drag, once the thread moves as the model cannot explain",
    )
    estimator_slow_time: float = quantity(
        _OPTIONS.slow_time, "time over which those may change", unit="s", minimum=0.1, maximum=1e5
    )

    def estimator_options(self) -> EstimatorOptions:
        """Return the options of the estimator.

        Raises:
            ConfigurationError: a slow parameter is unknown.
        """
        values = {about.name: getattr(self, f"estimator_{about.name}") for about in fields(EstimatorOptions)}
        try:
            return EstimatorOptions(**values)
        except ConfigurationError as error:
            name = error.name.replace("estimator.", f"{self.GROUP}.estimator_")
            raise ConfigurationError(name, error.value, error.expectation) from None
