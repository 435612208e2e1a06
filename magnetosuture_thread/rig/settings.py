"""Settings of the simulated rig."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.needle_arc import needle_axis
from magnetosuture_thread.geometry.obstacles import Disc, Polygon
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.geometry.scene import Scene, find_collision
from magnetosuture_thread.rig.camera import LOOK_OF_KIND, LOOKS, CameraScene, DishCamera, Lighting, Look
from magnetosuture_thread.rig.contact import Surface
from magnetosuture_thread.rig.dynamics import CoilField, NeedleBody, RigDynamics
from magnetosuture_thread.rig.faults import Fault, FaultSchedule
from magnetosuture_thread.rig.power import StageProcess
from magnetosuture_thread.rig.rod import NeedleJoint, ThreadProperties
from magnetosuture_thread.settings import shared_parameters as shared
from magnetosuture_thread.settings.configuration import quantity
from magnetosuture_thread.settings.errors import ConfigurationError


@dataclass(frozen=True)
class RigSettings(
    shared.SceneName, shared.Viscosity, shared.CoilDrivers, shared.NeedleArc, shared.NeedleWidth, shared.ThreadLength
):
    """The rig that is simulated: its scene, coils, needle, thread and camera, and what goes wrong.

    These are the truth of the simulation. What the other nodes believe is in their own sections.
    """

    GROUP: ClassVar[str] = "rig_simulator"

    rate: float = quantity(
        1.0, "how much faster than real time /clock runs, where use_sim_time is set", minimum=0.5, maximum=5.0
    )
    seed: int = quantity(0, "of dust, sensor noise and faults", minimum=0, maximum=2**31 - 1)
    faults: tuple[str, ...] = quantity(
        (), "what goes wrong: KIND START DURATION each, in seconds since the first current"
    )

    obstacle_looks: tuple[str, ...] = quantity(
        (), f"of what each shape of the scene seems to be made, in order: {', '.join(LOOKS)}; none given: by its kind"
    )

    coil_distance: float = quantity(
        0.05, "from the dish's centre to the middle of a coil", unit="m", minimum=0.01, maximum=1.0
    )
    coil_radius: float = quantity(0.025, "mean radius of the windings", unit="m", minimum=0.002, maximum=0.5)
    coil_length: float = quantity(0.03, "of the winding along its axis", unit="m", minimum=0.0, maximum=0.5)
    coil_turns: float = quantity(480.0, "of a coil", minimum=1.0, maximum=1e5)
    coil_max_current: float = quantity(
        30.0, "that the power stage gives, in either direction", unit="A", minimum=0.01, maximum=1000.0
    )

    power_stage: str = quantity(
        "topic",
        "where the currents come from: a topic, or simulated RoboClaw boards, which a driver finds at ports",
        choices=("topic", "roboclaw"),
    )
    power_stage_ports: tuple[str, ...] = quantity(
        (), "path at which each board is to be found, with two coils in a row; for power_stage roboclaw"
    )
    coil_resistance: float = quantity(1.0, "of a coil on a board", unit="ohm", minimum=0.01, maximum=1000.0)
    coil_inductance: float = quantity(0.01, "of a coil on a board", unit="H", minimum=1e-6, maximum=10.0)
    supply_voltage: float = quantity(24.0, "of the boards", unit="V", minimum=1.0, maximum=80.0)

    needle_magnetisation: float = quantity(
        1.0e6, "of the needle, NdFeB, along its body", unit="A/m", minimum=1e3, maximum=2e6
    )
    needle_start: tuple[float, ...] = quantity(
        (0.003, -0.004, 0.0),
        "x [m], y [m] of the tail and heading [rad] at the start",
        minimum=-7.0,
        maximum=7.0,
        multiple=3,
    )

    thread_diameter: float = quantity(60e-6, "of the thread", unit="m", minimum=1e-6, maximum=0.005)
    thread_segments: int = quantity(60, "that the simulated thread is cut into", minimum=8, maximum=400)
    thread_attachment: str = quantity("pinned", "to the needle", choices=("pinned", "clamped"))
    thread_bending_stiffness: float = quantity(1.2723e-9, "E I of the thread", unit="N m^2", minimum=0.0, maximum=1e-3)
    thread_stretching_stiffness: float = quantity(5.65, "E A of the thread", unit="N", minimum=1e-3, maximum=1e6)
    thread_drag_across: float = quantity(
        0.974, "force across a length of thread for each speed", unit="Pa s", minimum=1e-6, maximum=1e3
    )
    thread_drag_along: float = quantity(0.487, "the same along it", unit="Pa s", minimum=1e-6, maximum=1e3)
    thread_friction: float = quantity(
        0.0,
        "coefficient of friction of the thread on shapes, wall and itself, whatever the scene says",
        minimum=0.0,
        maximum=2.0,
    )
    thread_start_curvature: float = quantity(
        0.0, "of the arc in which the thread lies behind the needle at the start", unit="1/m", minimum=-1e4, maximum=1e4
    )

    camera_width: int = quantity(640, "of a frame", unit="px", minimum=64, maximum=4096)
    camera_height: int = quantity(480, "of a frame", unit="px", minimum=64, maximum=4096)
    camera_height_share: float = quantity(0.9115, "of a frame's height that the dish fills", minimum=0.1, maximum=2.0)
    camera_distance: float = quantity(0.3, "of the camera from the dish", unit="m", minimum=0.01, maximum=10.0)
    frame_rate: float = quantity(60.0, "frames a second", unit="Hz", minimum=1.0, maximum=240.0)
    jpeg_quality: int = quantity(85, "of the compressed frames", minimum=1, maximum=100)
    light_gain: float = quantity(1.0, "of the exposure, 1 is well exposed", minimum=0.05, maximum=5.0)
    noise: float = quantity(1.0, "of the sensor, in units of the usual", minimum=0.0, maximum=20.0)

    def check(self) -> None:
        """Refuse what does not fit together."""
        if len(self.needle_start) != 3:
            raise self.refused("needle_start", "x, y and heading")
        if not set(self.obstacle_looks) <= set(LOOKS):
            raise self.refused("obstacle_looks", f"each one of {', '.join(LOOKS)}")
        if len(self.coil_angles) < 1:
            raise self.refused("coil_angles", "at least one coil's angle [rad]")
        ports = len(self.power_stage_ports)
        if self.power_stage == "roboclaw" and (not ports or 2 * ports != len(self.coil_angles)):
            raise self.refused("power_stage_ports", f"a path for two of the {len(self.coil_angles)} coils")
        if self.needle_length < 2.0 * self.needle_width:
            raise self.refused("needle_length", "at least two widths [m]")
        if self.thread_diameter >= self.thread_length:
            raise self.refused("thread_diameter", "less than its length [m]")
        for fault in self.faults:
            Fault.parse(fault)

    def check_scene(self, scene: Scene) -> None:
        """Refuse a scene for which the start or the looks do not fit.

        Raises:
            ConfigurationError: needle or thread would start in the wall or in a shape, or the looks are those of
                another number of shapes, or the thread would start on itself where the scene does not allow it.
        """
        count = len(scene.shapes)
        if self.obstacle_looks and len(self.obstacle_looks) != count:
            raise self.refused("obstacle_looks", f"one for each of the scene's {count} shapes, or none")
        at = np.linspace(0.0, 1.0, 100)
        turn = abs(self.thread_start_curvature) * self.thread_length
        if turn >= 2.0 * math.pi and scene.dish.has_self_contact(self.thread_diameter):
            most = 2.0 * math.pi / self.thread_length
            expected = f"less than {most:.4g} 1/m to either side: the thread would lie on itself"
            raise self.refused("thread_start_curvature", expected)
        x, y, heading = self.needle_start
        needle, _ = needle_axis(np.array([x, y]), heading, self.needle_length, self.needle_curvature, at)
        for name, points in {"a needle": needle, "a thread": self.thread_at_start(at)}.items():
            what = find_collision(scene, points, holes=False)
            if what:
                start = f"{list(self.needle_start)}, thread curvature {self.thread_start_curvature:g}"
                expectation = f"{name} in the dish, off the obstacles: it would be in {what}"
                raise ConfigurationError(f"{self.GROUP}.needle_start", start, expectation)

    def thread_at_start(self, at: NDArray[np.float64]) -> Points:
        """Return points along the thread as it lies at the start, `at` from 0 to 1, shape (m, 2) [m]."""
        x, y, heading = self.needle_start
        tail = np.array([x, y])
        return needle_axis(tail, heading + math.pi, self.thread_length, self.thread_start_curvature, at)[0]

    def view(self, scene: Scene) -> DishView:
        """Return where the dish is in the image: a little off the middle, as in a real rig."""
        scale = scene.dish.diameter / (self.camera_height_share * self.camera_height)
        return DishView((0.5 * self.camera_width + 2.0, 0.5 * self.camera_height - 2.0), scale)

    def camera(self, scene: Scene) -> DishCamera:
        """Return the camera over the dish."""
        seen = CameraScene(
            dish_diameter=scene.dish.diameter,
            needle_length=self.needle_length,
            needle_width=self.needle_width,
            needle_curvature=self.needle_curvature,
            thread_diameter=self.thread_diameter,
            obstacles=scene.obstacles,
            looks=self._looks(scene),
        )
        lighting = Lighting(gain=self.light_gain, noise=self.noise)
        return DishCamera(seen, self.view(scene), (self.camera_width, self.camera_height), self.seed, lighting)

    def _looks(self, scene: Scene) -> tuple[Look, ...]:
        """Return how each shape looks: as told, where that is told of all; else by its kind."""
        told = self.obstacle_looks if len(self.obstacle_looks) == len(scene.shapes) else ()
        return tuple(LOOKS[name] for name in told or [LOOK_OF_KIND[shape.kind] for shape in scene.shapes])

    def schedule(self, scene: Scene) -> FaultSchedule:
        """Return what goes wrong and when."""
        faults = [Fault.parse(text) for text in self.faults]
        return FaultSchedule(faults, scene.dish.diameter, self.needle_length, self.seed)

    def field(self) -> CoilField:
        """Return the coils' field."""
        return CoilField(self.coil_angles, self.coil_distance, self.coil_radius, self.coil_length, self.coil_turns)

    def power(self) -> StageProcess | None:
        """Return the simulated boards, None where currents come as messages."""
        if self.power_stage == "topic":
            return None
        return StageProcess(self.power_stage_ports, self.supply_voltage, self.coil_resistance, self.coil_inductance)

    def surface(self, scene: Scene) -> Surface:
        """Return the surfaces that needle and thread can touch; the hole of a shape is drawn but has no contact."""
        return Surface(
            discs=tuple(o for o in scene.obstacles if isinstance(o, Disc)),
            polygons=tuple(o for o in scene.obstacles if isinstance(o, Polygon)),
            wall_radius=scene.dish.radius,
            friction=self.thread_friction,
            self_contact=scene.dish.has_self_contact(self.thread_diameter),
        )

    def dynamics(self, scene: Scene) -> RigDynamics:
        """Return needle and thread at their start, in the field of the coils."""
        x, y, heading = self.needle_start
        tail = np.array([x, y])
        behind = self.thread_at_start(np.linspace(0.0, 1.0, self.thread_segments + 1))
        return RigDynamics(
            needle=NeedleBody(
                length=self.needle_length,
                diameter=self.needle_width,
                curvature=self.needle_curvature,
                magnetisation=self.needle_magnetisation,
                viscosity=self.viscosity,
            ),
            thread=ThreadProperties(
                length=self.thread_length,
                segments=self.thread_segments,
                bending_stiffness=self.thread_bending_stiffness,
                stretching_stiffness=self.thread_stretching_stiffness,
                drag_across=self.thread_drag_across,
                drag_along=self.thread_drag_along,
                attachment=NeedleJoint(self.thread_attachment),
                diameter=self.thread_diameter,
            ),
            surface=self.surface(scene),
            field=self.field(),
            tail=tail,
            heading=heading,
            thread_points=behind,
            # Twice the usual step costs half the time and is as exact to 0.01 % of the length.
            largest_step=4e-3,
        )
