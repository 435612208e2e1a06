"""Settings of the estimator, which are among those of the thread model."""

from __future__ import annotations

from dataclasses import dataclass

from magnetosuture_thread.configuration import Configuration, quantity
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.estimator import EstimatorOptions


@dataclass(frozen=True)
class EstimatorSettings(Configuration):
    """Whether and how the thread is estimated; see `EstimatorOptions`."""

    estimator: bool = quantity(
        True, "whether the thread is estimated too: the model corrected by the camera; for rod in liquid"
    )
    estimator_path_deviation: float = quantity(
        2e-5,
        "standard deviation of the points of thread/measured, used where nobody publishes thread/observation",
        unit="m",
        minimum=1e-7,
        maximum=0.01,
    )
    estimator_history: float = quantity(
        EstimatorOptions.history, "how late an observation of the thread may come", unit="s", minimum=0.05, maximum=5.0
    )
    estimator_slow_parameters: tuple[str, ...] = quantity(
        EstimatorOptions.slow_parameters,
        "what the estimator learns of the thread as it runs: stiffness_over_drag, or nothing; auto: stiffness over "
        "drag, once the thread moves as the model cannot explain",
    )

    def estimator_options(self) -> EstimatorOptions:
        """Return the options of the estimator.

        Raises:
            ConfigurationError: a slow parameter is unknown.
        """
        try:
            return EstimatorOptions(self.estimator_history, self.estimator_slow_parameters)
        except ConfigurationError as error:
            name = error.name.replace("estimator.", f"{self.GROUP}.estimator_")
            raise ConfigurationError(name, error.value, error.expectation) from None
