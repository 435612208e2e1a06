"""Parameters that several nodes share, written once in a setup under `/**`.

Every node receives all parameters under `/**`. It uses those of its settings and ignores the other shared ones. Any
other unknown parameter is refused.
"""

from __future__ import annotations

import math
from dataclasses import field
from typing import Any

from magnetosuture_thread.configuration import Quantity

_SCENE = "scene file: a path, or the name of one in config/scenes; none waits for the topic scene"
_CURVATURE = "curvature of the needle's arc, positive to the left of its heading"
_KEEP_OUT = "minimum clearance of the needle's axis to wall and obstacles, half of its width included"
_POSE_MARGIN = (
    "clearance kept in addition to keep_out, for the error of a needle pose that is extrapolated to the present"
)
_VISCOSITY = "dynamic viscosity of the liquid; glycerin at room temperature is about 1"
_ANGLES = "direction of each coil from the dish's centre, against the x axis"
_FEEDBACK = (
    "which commands the thread's friction slows: all, or those of the operator only, while procedures and paths "
    "keep limits of their own"
)
_TIMEOUT = (
    "without new currents for this long the coil drivers switch off by themselves; whole tenths for RoboClaw boards"
)

# Default and quantity.
_PARAMETERS: dict[str, tuple[Any, Quantity]] = {
    "scene": ("", Quantity(_SCENE)),
    "needle_length": (0.007, Quantity("length of the needle along its body", "m", 0.001, 0.05)),
    "needle_width": (0.0004, Quantity("width of the needle's body", "m", 5e-5, 0.005)),
    "needle_curvature": (0.0, Quantity(_CURVATURE, "1/m", -1000.0, 1000.0)),
    "keep_out": (0.0005, Quantity(_KEEP_OUT, "m", 2.5e-5, 0.05)),
    "pose_margin": (0.0, Quantity(_POSE_MARGIN, "m", 0.0, 0.005)),
    "thread_length": (0.019, Quantity("rest length of the thread", "m", 0.001, 2.0)),
    "viscosity": (1.0, Quantity(_VISCOSITY, "Pa s", 1e-4, 100.0)),
    "coil_angles": (
        (0.0, 0.5 * math.pi, math.pi, -0.5 * math.pi),
        Quantity(_ANGLES, "rad", -2.0 * math.pi, 2.0 * math.pi),
    ),
    "friction_feedback": ("all", Quantity(_FEEDBACK, choices=("all", "operator"))),
    "driver_timeout": (0.2, Quantity(_TIMEOUT, "s", 0.05, 1.0)),
}

SHARED_PARAMETERS = tuple(_PARAMETERS)
"""Names of the shared parameters."""


def shared_parameter(name: str) -> Any:
    """Return the dataclass field of a shared parameter."""
    default, quantity = _PARAMETERS[name]
    return field(default=default, metadata={"quantity": quantity})
