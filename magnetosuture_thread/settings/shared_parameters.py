"""Parameters that several nodes have: each is declared once, in a class that the settings of these nodes inherit from.

Those of `SHARED` are written once in a setup under `/**`. Every node receives all parameters under `/**`. It uses those
of its settings and ignores the other shared ones. Any other unknown parameter is refused.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from magnetosuture_thread.settings.configuration import Configuration, configuration_fields, quantity
from magnetosuture_thread.settings.errors import ConfigurationError

MAX_NEEDLE_TURN = 1.02 * math.pi  # of a needle, tail to tip [rad]; a little more than what suture needles have


@dataclass(frozen=True)
class LifecycleSettings(Configuration):
    """The state that a lifecycle node enters; each node has its own value."""

    autostart: str = quantity(
        "active", "state that the node enters by itself at start", choices=("unconfigured", "inactive", "active")
    )


@dataclass(frozen=True)
class SceneName(Configuration):
    """The dish and the shapes in it."""

    scene: str = quantity("", "scene file: a path, or the name of one in config/scenes; none waits for the topic scene")


@dataclass(frozen=True)
class NeedleLength(Configuration):
    """The needle's size."""

    needle_length: float = quantity(0.007, "length of the needle along its body", "m", 0.001, 0.05)


@dataclass(frozen=True)
class NeedleArc(NeedleLength):
    """The needle's axis, an arc."""

    needle_curvature: float = quantity(
        0.0, "curvature of the needle's arc, positive to the left of its heading", "1/m", -1000.0, 1000.0
    )

    def check(self) -> None:
        """Refuse a coiled needle."""
        check_needle(self.GROUP, self.needle_length, self.needle_curvature)


@dataclass(frozen=True)
class NeedleWidth(Configuration):
    """The needle's thickness."""

    needle_width: float = quantity(0.0004, "width of the needle's body", "m", 5e-5, 0.005)


@dataclass(frozen=True)
class CommandFilter(Configuration):
    """How close to wall and shapes commands may bring the needle, and which of them friction slows."""

    keep_out: float = quantity(
        0.0005, "least clearance of the needle's axis to wall and shapes, half of its width included", "m", 2.5e-5, 0.05
    )
    pose_margin: float = quantity(
        0.0, "clearance beside keep_out, for the error of a pose that is extrapolated to the present", "m", 0.0, 0.005
    )
    friction_feedback: str = quantity(
        "all", "which commands the thread's friction slows: all, or the operator's alone", choices=("all", "operator")
    )


@dataclass(frozen=True)
class ThreadLength(Configuration):
    """The thread's size."""

    thread_length: float = quantity(0.019, "rest length of the thread", "m", 0.001, 2.0)


@dataclass(frozen=True)
class Viscosity(Configuration):
    """The liquid in the dish."""

    viscosity: float = quantity(
        1.0, "dynamic viscosity of the liquid; glycerin at room temperature is about 1", "Pa s", 1e-4, 100.0
    )


@dataclass(frozen=True)
class CoilDrivers(Configuration):
    """The coils, and the drivers of their currents."""

    coil_angles: tuple[float, ...] = quantity(
        (0.0, 0.5 * math.pi, math.pi, -0.5 * math.pi),
        "direction of each coil from the dish's centre, against the x axis",
        "rad",
        -2.0 * math.pi,
        2.0 * math.pi,
    )
    driver_timeout: float = quantity(
        0.2, "drivers switch off after this long without new currents; whole tenths for RoboClaw boards", "s", 0.05, 1.0
    )


SHARED = (SceneName, NeedleArc, NeedleWidth, CommandFilter, ThreadLength, Viscosity, CoilDrivers)
SHARED_PARAMETERS = tuple(setting.name for cls in SHARED for setting in configuration_fields(cls))
"""Names of the shared parameters."""


def check_needle(group: str, length: float, curvature: float) -> None:
    """Check that a needle is bent no more than a half circle, as its chord would not be along it any more.

    Args:
        group: section of the settings, for the error.
        length: of the arc [m].
        curvature: [1/m].

    Raises:
        ConfigurationError: the arc turns by more.
    """
    if abs(curvature) * length > MAX_NEEDLE_TURN:
        expectation = f"at most {MAX_NEEDLE_TURN / length:.0f} 1/m, a half circle for a needle of {length:g} m"
        raise ConfigurationError(f"{group}.needle_curvature", curvature, expectation)
