"""Settings of the vision tracker."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from magnetosuture_thread.configuration import Configuration, quantity


@dataclass(frozen=True)
class VisionTrackerSettings(Configuration):
    """What the vision tracker must know of the dish, the needle and the camera."""

    GROUP: ClassVar[str] = "vision_tracker"

    image_transport: str = quantity("compressed", "which camera topic to take", choices=("raw", "compressed"))
    dish_diameter: float = quantity(
        0.035, "inner diameter of the petri dish, which gives the scale", unit="m", minimum=0.005, maximum=0.5
    )
    needle_length: float = quantity(0.007, "length of the needle", unit="m", minimum=0.001, maximum=0.05)
    needle_width: float = quantity(0.0004, "width of the needle's body", unit="m", minimum=5e-5, maximum=0.005)
    thread_length: float = quantity(0.019, "length of the thread", unit="m", minimum=0.001, maximum=2.0)
