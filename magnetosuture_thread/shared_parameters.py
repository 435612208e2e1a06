"""Parameters that several nodes share, written once in a setup under `/**`.

Every node receives all parameters under `/**`. It uses those of its settings and ignores the other shared ones. Any
other unknown parameter is refused.
"""

from __future__ import annotations

from typing import Any

from magnetosuture_thread.configuration import quantity

_QUANTITIES: dict[str, dict[str, Any]] = {
    "scene": {
        "default": "",
        "description": "scene file: a path, or the name of one in config/scenes; none waits for the topic scene",
    },
    "needle_length": {
        "default": 0.007,
        "description": "length of the needle along its body",
        "unit": "m",
        "minimum": 0.001,
        "maximum": 0.05,
    },
    "needle_width": {
        "default": 0.0004,
        "description": "width of the needle's body",
        "unit": "m",
        "minimum": 5e-5,
        "maximum": 0.005,
    },
    "needle_curvature": {
        "default": 0.0,
        "description": "curvature of the needle's arc, positive to the left of its heading",
        "unit": "1/m",
        "minimum": -1000.0,
        "maximum": 1000.0,
    },
    "thread_length": {
        "default": 0.019,
        "description": "rest length of the thread",
        "unit": "m",
        "minimum": 0.001,
        "maximum": 2.0,
    },
    "viscosity": {
        "default": 1.0,
        "description": "dynamic viscosity of the liquid; glycerin at room temperature is about 1",
        "unit": "Pa s",
        "minimum": 1e-4,
        "maximum": 100.0,
    },
    "driver_timeout": {
        "default": 0.2,
        "description": "without new currents for this long the coil drivers switch off by themselves; whole tenths "
        "for RoboClaw boards",
        "unit": "s",
        "minimum": 0.05,
        "maximum": 1.0,
    },
}

SHARED_PARAMETERS = tuple(_QUANTITIES)
"""Names of the shared parameters."""


def shared_parameter(name: str) -> Any:
    """Return the dataclass field of a shared parameter."""
    about = dict(_QUANTITIES[name])
    return quantity(about.pop("default"), about.pop("description"), **about)
