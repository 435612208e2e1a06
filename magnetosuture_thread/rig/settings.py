"""Settings of the simulated rig, and the faults that may be asked of it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.needle_arc import needle_axis
from magnetosuture_thread.geometry.obstacles import Disc, Polygon
from magnetosuture_thread.geometry.polyline import Points, Vector
from magnetosuture_thread.geometry.scene import Scene, find_collision
from magnetosuture_thread.rig.camera import LOOKS, CameraScene, DishCamera, Lighting
from magnetosuture_thread.rig.contact import Surface
from magnetosuture_thread.rig.dynamics import CoilField, NeedleBody, RigDynamics
from magnetosuture_thread.rig.power import StageProcess
from magnetosuture_thread.rig.rod import NeedleJoint, ThreadProperties
from magnetosuture_thread.settings import shared_parameters as shared
from magnetosuture_thread.settings.configuration import quantity
from magnetosuture_thread.settings.errors import ConfigurationError, InvalidInputError

COVERS = ("glare", "hand", "tool")
KINDS = (*COVERS, "dim", "overexposed", "dropped_frames", "late_frames", "camera_stopped", "needle_out", "coil_stuck")


@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes:
        kind: one of `KINDS`.
        start: when it begins [s].
        duration: how long it lasts [s].
    """

    kind: str
    start: float
    duration: float

    @classmethod
    def parse(cls, text: str) -> Fault:
        """Read `KIND START DURATION`, in seconds.

        >>> Fault.parse("glare 2 0.5")
        Fault(kind='glare', start=2.0, duration=0.5)

        Raises:
            ConfigurationError: it is something else.
        """
        words = text.split()
        try:
            start, duration = (float(word) for word in words[1:])
        except ValueError:
            start = duration = float("nan")
        if not words or words[0] not in KINDS or not (0.0 <= start < 1e6 and 0.0 < duration < 1e6):
            expectation = f"KIND START DURATION in seconds, with a kind of {', '.join(KINDS)}"
            raise ConfigurationError("rig_simulator.faults", repr(text), expectation)
        return cls(words[0], start, duration)

    @classmethod
    def requested(cls, text: str, time: float) -> Fault:
        """Read `KIND DURATION` as a fault that begins at a time [s].

        >>> Fault.requested("glare 0.5", 7.0)
        Fault(kind='glare', start=7.0, duration=0.5)

        Raises:
            InvalidInputError: it is something else.
        """
        kind, _, duration = text.partition(" ")
        try:
            return cls.parse(f"{kind} {time!r} {duration}")
        except ConfigurationError:
            expectation = f"KIND DURATION, with a kind of {', '.join(KINDS)}"
            raise InvalidInputError("rig/fault", repr(text), expectation) from None

    def holds(self, time: float) -> bool:
        """Return whether the fault is in force at a time [s]."""
        return self.start <= time < self.start + self.duration


@dataclass(frozen=True)
class RigSettings(
    shared.SceneName, shared.Viscosity, shared.CoilDrivers, shared.NeedleArc, shared.NeedleWidth, shared.ThreadLength
):
    """The rig that is simulated: its scene, coils, needle, thread and camera, and what goes wrong.

    These are the truth of the simulation. What the other nodes believe is in their own sections.
    """

    GROUP: ClassVar[str] = "rig_simulator"

    rate: float = quantity(1.0, "how much faster /clock runs, where use_sim_time is set", minimum=0.5, maximum=5.0)
    seed: int = quantity(0, "of dust, sensor noise and faults", minimum=0, maximum=2**31 - 1)
    faults: tuple[str, ...] = quantity((), "what goes wrong: KIND START DURATION each, in s since the first current")

    obstacle_looks: tuple[str, ...] = quantity(
        (), f"of what each shape of the scene seems to be made, in order: {', '.join(LOOKS)}; none given: by its kind"
    )

    coil_distance: float = quantity(0.05, "of a coil's middle from the dish's", unit="m", minimum=0.01, maximum=1.0)
    coil_radius: float = quantity(0.025, "mean radius of the windings", unit="m", minimum=0.002, maximum=0.5)
    coil_length: float = quantity(0.03, "of the winding along its axis", unit="m", minimum=0.0, maximum=0.5)
    coil_turns: float = quantity(480.0, "of a coil", minimum=1.0, maximum=1e5)
    coil_max_current: float = quantity(30.0, "of the power stage, either way", unit="A", minimum=0.01, maximum=1000.0)
    coil_gains: tuple[float, ...] = quantity(
        (),
        "of each coil's field against that of its windings: negative is wound the other way, 0 is not connected; none "
        "given: 1 each",
        minimum=-10.0,
        maximum=10.0,
    )
    current_delay: float = quantity(0.0, "from a command to its currents", unit="s", minimum=0.0, maximum=1.0)
    residual_field: tuple[float, ...] = quantity(
        (), "x and y of the field without currents; none given: 0", unit="T", minimum=-0.01, maximum=0.01, multiple=2
    )

    power_stage: str = quantity(
        "topic",
        "where currents come from: a topic, or simulated RoboClaw boards at ports",
        choices=("topic", "roboclaw"),
    )
    power_stage_ports: tuple[str, ...] = quantity((), "path of each board, with two coils in a row, for roboclaw")
    coil_resistance: float = quantity(1.0, "of a coil on a board", unit="ohm", minimum=0.01, maximum=1000.0)
    coil_inductance: float = quantity(0.01, "of a coil on a board", unit="H", minimum=1e-6, maximum=10.0)
    supply_voltage: float = quantity(24.0, "of the boards", unit="V", minimum=1.0, maximum=80.0)

    needle_magnetisation: float = quantity(
        1e6, "along its body, of NdFeB; negative where the tail attracts", unit="A/m", minimum=-2e6, maximum=2e6
    )
    needle_start: tuple[float, ...] = quantity(
        (0.003, -0.004, 0.0), "x, y of the tail [m] and heading [rad] at first", minimum=-7.0, maximum=7.0, multiple=3
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
        0.0, "coefficient of the thread on shapes, wall and itself, whatever the scene says", minimum=0.0, maximum=2.0
    )
    thread_start_curvature: float = quantity(
        0.0, "of the arc in which the thread lies behind the needle at the start", unit="1/m", minimum=-1e4, maximum=1e4
    )

    camera_width: int = quantity(640, "of a frame", unit="px", minimum=64, maximum=4096)
    camera_height: int = quantity(480, "of a frame", unit="px", minimum=64, maximum=4096)
    camera_height_share: float = quantity(0.9115, "of a frame's height that the dish fills", minimum=0.1, maximum=2.0)
    camera_distance: float = quantity(0.3, "of the camera from the dish", unit="m", minimum=0.01, maximum=10.0)
    camera_rotation: float = quantity(
        0.0,
        "angle of the coils in the image, counter-clockwise as seen, against coil_angles; all else is as seen",
        unit="rad",
        minimum=-math.pi,
        maximum=math.pi,
    )
    camera_mirrored: bool = quantity(False, "whether the image is mirrored, about the x axis, before it is turned")
    frame_rate: float = quantity(60.0, "frames a second", unit="Hz", minimum=1.0, maximum=240.0)
    stamp_delay: float = quantity(
        0.0, "by which frames are stamped, and come, after they were taken", unit="s", minimum=0.0, maximum=1.0
    )
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
        if len(self.coil_gains) not in (0, len(self.coil_angles)):
            raise self.refused("coil_gains", f"one for each of the {len(self.coil_angles)} coils, or none")
        if len(self.residual_field) > 2:
            raise self.refused("residual_field", "x and y [T]")
        ports = len(self.power_stage_ports)
        if self.power_stage == "roboclaw" and (not ports or 2 * ports != len(self.coil_angles)):
            raise self.refused("power_stage_ports", f"a path for two of the {len(self.coil_angles)} coils")
        if abs(self.needle_magnetisation) < 1e3:
            raise self.refused("needle_magnetisation", "a magnet's: 1000 A/m or more, either way")
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
        if self.obstacle_looks and len(self.obstacle_looks) != len(scene.shapes):
            raise self.refused("obstacle_looks", f"one for each of the scene's {len(scene.shapes)} shapes, or none")
        at, most = np.linspace(0.0, 1.0, 100), 2.0 * math.pi / self.thread_length
        if abs(self.thread_start_curvature) >= most and scene.dish.has_self_contact(self.thread_diameter):
            expected = f"less than {most:.4g} 1/m to either side: the thread would lie on itself"
            raise self.refused("thread_start_curvature", expected)
        x, y, heading = self.needle_start
        needle, _ = needle_axis(np.array([x, y]), heading, self.needle_length, self.needle_curvature, at)
        for name, points in {"a needle": needle, "a thread": self.thread_at_start(at)}.items():
            if what := find_collision(scene, points, holes=False):
                start = f"{list(self.needle_start)}, thread curvature {self.thread_start_curvature:g}"
                expectation = f"{name} in the dish, off the obstacles: it would be in {what}"
                raise ConfigurationError(f"{self.GROUP}.needle_start", start, expectation)

    def thread_at_start(self, at: Vector) -> Points:
        """Return points along the thread as it lies at the start, `at` from 0 to 1, shape (m, 2) [m]."""
        *tail, heading = self.needle_start
        return needle_axis(np.array(tail), heading + math.pi, self.thread_length, self.thread_start_curvature, at)[0]

    def view(self, scene: Scene) -> DishView:
        """Return where the dish is in the image: a little off the middle, as in a real rig."""
        scale = scene.dish.diameter / (self.camera_height_share * self.camera_height)
        return DishView((0.5 * self.camera_width + 2.0, 0.5 * self.camera_height - 2.0), scale)

    def camera(self, scene: Scene) -> DishCamera:
        """Return the camera over the dish; shapes look as `obstacle_looks` says, else as their kind, or silicone."""
        names = self.obstacle_looks if len(self.obstacle_looks) == len(scene.shapes) else ()
        needle = self.needle_length, self.needle_width, self.needle_curvature
        looks = tuple(LOOKS.get(name, LOOKS["silicone"]) for name in names or [shape.kind for shape in scene.shapes])
        seen = CameraScene(scene.dish.diameter, *needle, self.thread_diameter, obstacles=scene.obstacles, looks=looks)
        lighting = Lighting(gain=self.light_gain, noise=self.noise)
        return DishCamera(seen, self.view(scene), (self.camera_width, self.camera_height), self.seed, lighting)

    def power(self) -> StageProcess | None:
        """Return the simulated boards, None where currents come as messages."""
        if self.power_stage == "topic":
            return None
        return StageProcess(self.power_stage_ports, self.supply_voltage, self.coil_resistance, self.coil_inductance)

    def surface(self, scene: Scene) -> Surface:
        """Return the surfaces that needle and thread can touch; the hole of a shape is drawn but has no contact."""
        discs = tuple(shape for shape in scene.obstacles if isinstance(shape, Disc))
        polygons = tuple(shape for shape in scene.obstacles if isinstance(shape, Polygon))
        touches = scene.dish.has_self_contact(self.thread_diameter)
        return Surface(discs, polygons, scene.dish.radius, friction=self.thread_friction, self_contact=touches)

    def coil_field(self) -> CoilField:
        """Return the coils' field as the camera sees it: the coils are mirrored and turned in place of its image."""
        seen = [(-a if self.camera_mirrored else a) + self.camera_rotation for a in self.coil_angles]
        winding = self.coil_distance, self.coil_radius, self.coil_length, self.coil_turns
        return CoilField(seen, *winding, gains=self.coil_gains, residual=self.residual_field or (0.0, 0.0))

    def dynamics(self, scene: Scene) -> RigDynamics:
        """Return needle and thread at their start, in the field of the coils."""
        x, y, heading = self.needle_start
        shape = self.needle_length, self.needle_width, self.needle_curvature
        stiffness = self.thread_bending_stiffness, self.thread_stretching_stiffness
        drag = self.thread_drag_across, self.thread_drag_along
        joint, size = NeedleJoint(self.thread_attachment), (self.thread_length, self.thread_segments)
        return RigDynamics(
            NeedleBody(*shape, self.needle_magnetisation, self.viscosity),
            ThreadProperties(*size, *stiffness, *drag, joint, self.thread_diameter),
            self.surface(scene),
            self.coil_field(),
            (x, y),
            heading,
            self.thread_at_start(np.linspace(0.0, 1.0, self.thread_segments + 1)),
            largest_step=4e-3,  # s; twice the usual costs half the time and is as exact to 0.01 % of the length
        )
