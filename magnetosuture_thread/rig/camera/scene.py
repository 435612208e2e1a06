"""What stands before the simulated camera, and the light on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from magnetosuture_thread.geometry.obstacles import Obstacle


@dataclass(frozen=True)
class Look:
    """How an obstacle looks. A tracker measures on green, so that soft tissue differs from the floor in the others.

    Attributes:
        bgr: its colour, blue, green, red from 0 to 255.
        edge_bgr: the colour at its outline, into which the other fades.
        rounding: how far inwards that reaches, and the edge is rounded [m].
        relief: how much brighter the rounded edge is towards the lamp, and darker away from it.
        mottle: depth of its light and dark patches.
    """

    bgr: tuple[float, float, float]
    edge_bgr: tuple[float, float, float]
    rounding: float = 0.0
    relief: float = 0.0
    mottle: float = 0.0


SILICONE = Look((168.0, 176.0, 205.0), (168.0, 176.0, 205.0))
LOOKS = {
    "silicone": SILICONE,
    "tissue": Look((196.0, 194.0, 242.0), (178.0, 184.0, 236.0), 0.7e-3, 9.0, 8.0),
    "hernia": Look((164.0, 166.0, 226.0), (150.0, 162.0, 212.0), 0.5e-3, 6.0, 4.0),
}


LOOK_OF_KIND = {"tissue": "tissue", "instrument": "silicone", "wall": "silicone"}  # of a scene's shapes


@dataclass(frozen=True)
class CameraScene:
    """The things before the camera, all in the dish frame [m].

    Attributes:
        dish_diameter: inner diameter of the dish.
        needle_length: length of the needle along its body.
        needle_width: width of its body.
        needle_curvature: of its arc, positive to the left of the heading [1/m].
        thread_diameter: diameter of the thread.
        thread_bgr: the thread's colour, blue, green, red from 0 to 255.
        obstacles: seen from above.
        looks: of each of them; none given: pale silicone.
    """

    dish_diameter: float = 0.035
    needle_length: float = 0.007
    needle_width: float = 0.0004
    needle_curvature: float = 0.0
    thread_diameter: float = 60e-6
    thread_bgr: tuple[float, float, float] = (132.0, 78.0, 100.0)
    obstacles: Sequence[Obstacle] = ()
    looks: Sequence[Look] = ()


@dataclass(frozen=True)
class Lighting:
    """The light, the lens and the sensor.

    Attributes:
        gain: of the exposure; 1 is well exposed.
        slope: how much darker one corner is than the opposite one, in units of the usual.
        tint_bgr: colour of the light.
        glare: strength of the lamp's reflections in the liquid, 0 for none.
        noise: standard deviation of the sensor's noise, in units of the usual.
        blur_px: the lens's, as the standard deviation of a Gaussian.
    """

    gain: float = 1.0
    slope: float = 1.0
    tint_bgr: tuple[float, float, float] = (0.955, 0.985, 1.0)
    glare: float = 1.0
    noise: float = 1.0
    blur_px: float = 0.75
