"""Parameters that several nodes share, written once in a setup under `/**`.

Every node receives all parameters under `/**`. It uses those of its settings and ignores the other shared ones. Any
other unknown parameter is refused.
"""

from __future__ import annotations

import math
from copy import copy
from typing import Any

from magnetosuture_thread.settings.configuration import quantity

_PARAMETERS: dict[str, Any] = {
    "scene": quantity("", "scene file: a path, or the name of one in config/scenes; none waits for the topic scene"),
    "needle_length": quantity(0.007, "length of the needle along its body", "m", 0.001, 0.05),
    "needle_width": quantity(0.0004, "width of the needle's body", "m", 5e-5, 0.005),
    "needle_curvature": quantity(
        0.0, "curvature of the needle's arc, positive to the left of its heading", "1/m", -1000.0, 1000.0
    ),
    "keep_out": quantity(
        0.0005,
        "minimum clearance of the needle's axis to wall and obstacles, half of its width included",
        "m",
        2.5e-5,
        0.05,
    ),
    "pose_margin": quantity(
        0.0,
        "clearance kept in addition to keep_out, for the error of a needle pose that is extrapolated to the present",
        "m",
        0.0,
        0.005,
    ),
    "thread_length": quantity(0.019, "rest length of the thread", "m", 0.001, 2.0),
    "viscosity": quantity(
        1.0, "dynamic viscosity of the liquid; glycerin at room temperature is about 1", "Pa s", 1e-4, 100.0
    ),
    "coil_angles": quantity(
        (0.0, 0.5 * math.pi, math.pi, -0.5 * math.pi),
        "direction of each coil from the dish's centre, against the x axis",
        "rad",
        -2.0 * math.pi,
        2.0 * math.pi,
    ),
    "friction_feedback": quantity(
        "all",
        "which commands the thread's friction slows: all, or those of the operator only, while procedures and paths "
        "keep limits of their own",
        choices=("all", "operator"),
    ),
    "driver_timeout": quantity(
        0.2,
        "without new currents for this long the coil drivers switch off by themselves; "
        "whole tenths for RoboClaw boards",
        "s",
        0.05,
        1.0,
    ),
}

SHARED_PARAMETERS = tuple(_PARAMETERS)
"""Names of the shared parameters."""


def shared_parameter(name: str) -> Any:
    """Return the dataclass field of a shared parameter."""
    return copy(_PARAMETERS[name])
