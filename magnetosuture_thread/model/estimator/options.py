"""Options of the estimator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from magnetosuture_thread.arguments import bounded, checked_arguments
from magnetosuture_thread.errors import ConfigurationError

SLOW_PARAMETERS = ("stiffness_over_drag", "drag_anisotropy", "rest_curvature", "flow")
AUTOMATIC = "auto"
SHARE, LENGTH, TIME = bounded("", 1e-6, 100.0), bounded("m", 1e-9, 0.1), bounded("s", 1e-3, 1e5)


@checked_arguments("estimator")
@dataclass(frozen=True)
class EstimatorOptions:
    """How much the camera and the model are trusted.

    Attributes:
        error_correlation: distance along the thread over which the model's errors are alike, as a part of its length.
        point_correlation: distance along a measured piece over which the errors of its points are alike; points
            closer than this share one point's information [m].
        min_deviation: standard deviation of a measured point, at the least [m].
        noise_time: time over which the process noise is learned from innovations [s].
        initial_error: standard deviation of the free end of a thread whose shape nobody has seen, as a part of its
            length.
        disturbance_time: averaging time of the test for what the model does not know [s].
        history: how late an observation may come [s].
        slow_parameters: what is learned on line, some of `SLOW_PARAMETERS`, or nothing. By default `AUTOMATIC` alone:
            stiffness over drag, from the first time on that the thread moves as the model cannot explain.
        slow_time: time over which those may change [s].

    Raises:
        ConfigurationError: a value is not a positive number, or a parameter is unknown.
    """

    error_correlation: Annotated[float, SHARE] = 0.1
    point_correlation: Annotated[float, LENGTH] = 2.5e-4
    min_deviation: Annotated[float, LENGTH] = 5e-6
    noise_time: Annotated[float, TIME] = 1.0
    initial_error: Annotated[float, SHARE] = 0.2
    disturbance_time: Annotated[float, TIME] = 0.4
    history: Annotated[float, TIME] = 1.0
    slow_parameters: tuple[str, ...] = (AUTOMATIC,)
    slow_time: Annotated[float, TIME] = 10.0

    def __post_init__(self) -> None:
        """Check the names."""
        for name in self.slow_parameters if self.slow_parameters != (AUTOMATIC,) else ():
            if name not in SLOW_PARAMETERS:
                expected = f"some of {', '.join(SLOW_PARAMETERS)}, or {AUTOMATIC} alone"
                raise ConfigurationError("estimator.slow_parameters", name, expected)

    @property
    def automatic(self) -> bool:
        """Whether slow parameters are learned only where the model turns out to be wrong."""
        return self.slow_parameters == (AUTOMATIC,)
