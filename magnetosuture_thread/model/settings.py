"""Settings of the thread model."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from magnetosuture_thread.barrier import load_barriers
from magnetosuture_thread.configuration import Configuration, configuration_fields, quantity
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.model.factory import FORMULATIONS, SOLVERS, make_solver
from magnetosuture_thread.model.formulations import PaperOptions
from magnetosuture_thread.model.friction import FrictionLaw, NodeMotion
from magnetosuture_thread.model.medium import Medium
from magnetosuture_thread.model.predictor import NeedlePose, ThreadPredictor
from magnetosuture_thread.model.thread import MATERIALS, Attachment, Material, Thread
from magnetosuture_thread.scene import Scene
from magnetosuture_thread.shared_parameters import shared_parameter

MEDIA = ("liquid", "air")
OF_MEDIUM = {
    "viscosity": "liquid",
    "wetted_fraction": "liquid",
    "drag_anisotropy": "liquid",
    "mass_per_length": "air",
    "air_drag": "air",
    "bending_damping": "air",
    "gravity": "air",
}
FIXED = {  # why a node cannot change it
    "formulation": "what is compiled when it starts",
    "solver": "what is compiled when it starts",
    "barriers": "what is imported when it starts",
    "scene": "what it starts with; the topic scene changes it",
}
MAX_REST_ANGLE = 0.5  # rad; of a thread at rest at a node, beyond which its segments do not resolve it


@dataclass(frozen=True)
class ThreadModelSettings(Configuration):
    """What the thread model must know of the thread and the liquid; the scene itself is told apart."""

    GROUP: ClassVar[str] = "thread_model"

    scene: str = shared_parameter("scene")
    formulation: str = quantity(
        "rod", "how a step is written: rod is the accurate one, paper the one as printed", choices=FORMULATIONS
    )
    solver: str = quantity(
        "banded", "what solves a step's program: banded, osqp, or a solver that the package qpsolvers knows"
    )
    barriers: tuple[str, ...] = quantity((), "barriers of your own, each as module:class; see Barrier")
    material: str = quantity("polyamide_7_0", "the thread's material", choices=tuple(MATERIALS))
    diameter: float = quantity(0.0, "of the thread; 0 takes the material's", unit="m", minimum=0.0, maximum=0.01)
    elastic_modulus: float = quantity(
        0.0, "effective modulus of the thread in bending; 0 takes the material's", unit="Pa", minimum=0.0, maximum=1e12
    )
    thread_length: float = shared_parameter("thread_length")
    segments: int = quantity(25, "number of segments, n", minimum=3, maximum=2000)
    attachment: str = quantity(
        Attachment.PINNED.value,
        "how the thread is fixed to the needle: pinned turns freely, clamped leaves along the needle's axis; for rod",
        choices=tuple(kind.value for kind in Attachment),
    )
    rest_curvature: float = quantity(
        0.0,
        "curvature that the thread keeps in memory, positive to the left, seen from the needle along it",
        unit="1/m",
        minimum=-2000.0,
        maximum=2000.0,
    )
    fixed_nodes: tuple[int, ...] = quantity(
        (), "nodes that stay where they are, as where tissue holds the thread", minimum=1, maximum=2000
    )
    medium: str = quantity(
        "liquid",
        "what the thread moves in: liquid drags it, in air its inertia and weight count; for rod",
        choices=MEDIA,
    )
    viscosity: float = shared_parameter("viscosity")
    wetted_fraction: float = quantity(
        0.5, "part of the thread's surface in the liquid; half for a floating thread", minimum=0.05, maximum=1.0
    )
    drag_anisotropy: float = quantity(
        0.5,
        "drag of the liquid along the thread over that across it; half for a slender body",
        minimum=0.05,
        maximum=1.0,
    )
    attachment_offset: tuple[float, ...] = quantity(
        (),
        "where the thread is fixed, seen from the tracked tail: along the needle's heading, and to its left",
        unit="m",
        minimum=-0.01,
        maximum=0.01,
        multiple=2,
    )
    paper_damping: float = quantity(
        0.95, "kappa, part of its velocity that a node keeps from step to step; for paper", minimum=0.0, maximum=0.999
    )
    paper_stiffness_weight: float = quantity(
        0.0, "W_stiff; 0 takes the material's; for paper", minimum=0.0, maximum=1e12
    )
    mass_per_length: float = quantity(
        4e-6, "mass of the thread in air per length", unit="kg/m", minimum=1e-9, maximum=10.0
    )
    air_drag: float = quantity(
        1e-4, "drag of the thread in air per length and speed", unit="Pa s", minimum=0.0, maximum=10.0
    )
    bending_damping: float = quantity(
        0.0,
        "time in which bending in air is damped: its moment over its stiffness and rate",
        unit="s",
        minimum=0.0,
        maximum=10.0,
    )
    gravity: tuple[float, ...] = quantity(
        (),
        "weight in the plane of the camera, for a thread in air: x, y",
        unit="m/s^2",
        minimum=-20.0,
        maximum=20.0,
        multiple=2,
    )
    initial_shape: str = quantity(
        "measured",
        "where the thread starts: as the camera first measures it, or straight behind the needle",
        choices=("measured", "straight"),
    )
    max_step: float = quantity(
        0.02,
        "intervals between poses are divided into steps of at most this; at 60 Hz and faster each is one step",
        unit="s",
        minimum=1e-4,
        maximum=0.1,
    )
    margin_range: float = quantity(
        5e-3,
        "margins are published of nodes that are closer to an obstacle or the wall than this",
        unit="m",
        minimum=1e-4,
        maximum=1.0,
    )
    contact_tolerance: float = quantity(
        2e-6, "a node this close to an obstacle or the wall touches it", unit="m", minimum=0.0, maximum=1e-3
    )
    residual_tolerance: float = quantity(
        1e-6, "largest scaled residual with which a solution is accepted", minimum=1e-12, maximum=1e-2
    )

    friction_threshold: float = quantity(
        5e-4, "a node this close to two obstacles is under friction", unit="m", minimum=0.0, maximum=0.1
    )
    friction_slowdown: float = quantity(
        0.9, "beta: each node under friction slows the needle by this factor", minimum=0.01, maximum=1.0
    )
    stuck_speed: float = quantity(
        2e-4,
        "a thread under friction whose nodes there are not faster rests, and slows nothing",
        unit="m/s",
        minimum=0.0,
        maximum=1.0,
    )
    friction_averaging: float = quantity(
        0.2,
        "time over which the nodes' velocities are averaged for that, as tracked poses tremble",
        unit="s",
        minimum=0.0,
        maximum=10.0,
    )

    def check(self) -> None:
        """Refuse a thread thicker than a segment is long, and values that contradict each other."""
        if self.friction_threshold > self.margin_range:
            expected = f"at most {self.GROUP}.margin_range, {self.margin_range:g} m"
            raise ConfigurationError(f"{self.GROUP}.friction_threshold", self.friction_threshold, expected)
        diameter = self._material().diameter
        if self.thread_length / self.segments <= diameter:
            most = math.ceil(self.thread_length / diameter) - 1
            raise ConfigurationError(
                f"{self.GROUP}.segments", self.segments, f"at most {most}, so that a segment is longer than thick"
            )
        for name, pair, words in (
            ("attachment_offset", self.attachment_offset, "along and to the left"),
            ("gravity", self.gravity, "x and y"),
        ):
            if len(pair) not in (0, 2):
                raise ConfigurationError(f"{self.GROUP}.{name}", list(pair), f"two numbers, {words}, or none")
        if self.solver not in SOLVERS:
            try:
                make_solver(self.solver, self.residual_tolerance)
            except ConfigurationError as error:
                raise ConfigurationError(f"{self.GROUP}.solver", self.solver, error.expectation) from None
        if self.formulation == "paper" and self.medium != "liquid":
            raise ConfigurationError(
                f"{self.GROUP}.medium", self.medium, "liquid, as the formulation paper has no inertia"
            )
        turn = abs(self.rest_curvature) * self.thread_length / self.segments
        if turn > MAX_REST_ANGLE:
            sharpest = MAX_REST_ANGLE * self.segments / self.thread_length
            words = f"at most {sharpest:.0f} 1/m with {self.segments} segments, which turn by half a radian then"
            raise ConfigurationError(f"{self.GROUP}.rest_curvature", self.rest_curvature, words)
        for about in configuration_fields(type(self)):
            other = OF_MEDIUM.get(about.name, self.medium)
            if other != self.medium and getattr(self, about.name) != about.default:
                name, value = f"{self.GROUP}.{about.name}", getattr(self, about.name)
                raise ConfigurationError(
                    name, value, f"{about.default}, its default: it counts for medium: {other} only"
                )
        for node in self.fixed_nodes:
            if node > self.segments:
                raise ConfigurationError(f"{self.GROUP}.fixed_nodes", node, f"nodes from 1 to {self.segments}")

    def _material(self) -> Material:
        material = MATERIALS[self.material]
        return replace(
            material,
            diameter=self.diameter or material.diameter,
            elastic_modulus=self.elastic_modulus or material.elastic_modulus,
        )

    def thread(self) -> Thread:
        """Return the thread."""
        thread = Thread.of(
            self._material(),
            length=self.thread_length,
            segments=self.segments,
            attachment=Attachment(self.attachment),
            viscosity=self.viscosity,
            wetted_fraction=self.wetted_fraction,
            drag_anisotropy=self.drag_anisotropy,
            rest_curvature=self.rest_curvature,
        )
        if self.medium == "air":
            air = Medium.air(self.mass_per_length, self.gravity, self.air_drag, self.bending_damping)
            return replace(thread, medium=air)
        return thread

    def attachment_pose(self, pose: NeedlePose) -> NeedlePose:
        """Return the pose of the point where the thread is fixed, from that of the needle's tail, in the plane."""
        if not self.attachment_offset:
            return pose
        along, left = self.attachment_offset
        x, y = pose.heading
        return replace(pose, tail=pose.tail + np.array([along * x - left * y, along * y + left * x]))

    def predictor(self, scene: Scene | None) -> ThreadPredictor:
        """Return a predictor of this thread in a scene, its kernels compiled.

        Args:
            scene: dish and obstacles; None for neither.

        Raises:
            ConfigurationError: a shape is too small for the segments; see `check_scene`.
        """
        check_scene(self, scene)
        weight = self.paper_stiffness_weight or MATERIALS[self.material].stiffness_weight
        paper = replace(PaperOptions.tuned(weight), damping=self.paper_damping)
        predictor = ThreadPredictor(
            self.thread(),
            scene,
            load_barriers(self.barriers, f"{self.GROUP}.barriers"),
            formulation=self.formulation,
            solver=self.solver,
            paper=paper,
            margin_range=self.margin_range,
            contact_tolerance=self.contact_tolerance,
            residual_tolerance=self.residual_tolerance,
            max_step=self.max_step,
            fixed_nodes=self.fixed_nodes,
        )
        predictor.warm_up()
        return predictor

    def friction_law(self) -> FrictionLaw:
        """Return what tells friction."""
        return FrictionLaw(self.friction_threshold, self.friction_slowdown, self.stuck_speed)

    def node_motion(self) -> NodeMotion:
        """Return what follows the nodes' velocities."""
        return NodeMotion(self.friction_averaging)


def check_scene(settings: ThreadModelSettings, scene: Scene | None) -> None:
    """Refuse a scene that the segments of a thread do not resolve.

    A segment could lie across a shape that is smaller, with both of its nodes outside; in a dish that is narrower
    than two segments, no chain can turn.

    Args:
        settings: of the thread.
        scene: dish and obstacles; None for neither.

    Raises:
        ConfigurationError: the shape that is too small, or the dish.
    """
    if scene is None:
        return
    least = 0.5 * settings.thread_length / settings.segments
    if not scene.dish.radius > 2.0 * least:
        words = f"more than {4.0 * least:g} m, two segments of {settings.GROUP}"
        raise ConfigurationError("scene.dish.diameter", scene.dish.diameter, words)
    for shape in scene.shapes:
        name, words = f"scene.{shape.name}", f"of at least {least:g} m, half of a segment of {settings.GROUP}"
        if isinstance(shape.geometry, Disc):
            if shape.geometry.radius < least:
                raise ConfigurationError(name, shape.geometry.radius, f"a radius {words}")
        elif not shape.geometry.can_contain(least):
            raise ConfigurationError(name, "a shape", f"one with room for a disc of a radius {words}")
