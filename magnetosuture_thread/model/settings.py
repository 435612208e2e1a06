"""Settings of the thread model."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from magnetosuture_thread.configuration import described, quantity
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.obstacles import Disc, Polygon, Surroundings
from magnetosuture_thread.geometry.obstacles.lists import discs_from, polygons_from
from magnetosuture_thread.model.choices import FORMULATIONS, SOLVERS, make_formulation, make_solver
from magnetosuture_thread.model.formulations import PaperOptions
from magnetosuture_thread.model.friction_settings import FrictionSettings
from magnetosuture_thread.model.medium import Medium
from magnetosuture_thread.model.predictor import NeedlePose, ThreadPredictor
from magnetosuture_thread.model.thread import MATERIALS, Attachment, Material, Thread

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
FIXED = {name: "what is compiled when it starts" for name in ("formulation", "solver")}  # why a node cannot change it
SHARPEST_TURN = 0.5  # rad; of a thread at rest at a node, beyond which its segments do not resolve it


@dataclass(frozen=True)
class ThreadModelSettings(FrictionSettings):
    """What the thread model must know of the thread, the liquid and the obstacles."""

    GROUP: ClassVar[str] = "thread_model"

    formulation: str = quantity(
        "rod", "how a step is written: rod is the accurate one, paper the one as printed", choices=FORMULATIONS
    )
    solver: str = quantity("banded", "what solves a step's program", choices=SOLVERS)
    material: str = quantity("polyamide_7_0", "the thread's material", choices=tuple(MATERIALS))
    diameter: float = quantity(0.0, "of the thread; 0 takes the material's", unit="m", minimum=0.0, maximum=0.01)
    elastic_modulus: float = quantity(
        0.0, "effective modulus of the thread in bending; 0 takes the material's", unit="Pa", minimum=0.0, maximum=1e12
    )
    length: float = quantity(0.019, "rest length of the thread", unit="m", minimum=0.001, maximum=2.0)
    segments: int = quantity(25, "number of segments, n", minimum=3, maximum=2000)
    attachment: str = quantity(
        Attachment.PINNED.value,
        "how the thread is fixed to the needle: pinned turns freely, glued leaves along the needle's axis; for rod",
        choices=tuple(kind.value for kind in Attachment),
    )
    rest_curvature: float = quantity(
        0.0,
        "curvature that the thread keeps in memory, positive to the left, seen from the needle along it",
        unit="1/m",
        minimum=-2000.0,
        maximum=2000.0,
    )
    held_nodes: tuple[int, ...] = quantity(
        (), "nodes that stay where they are, as where tissue holds the thread", minimum=1, maximum=2000
    )
    medium: str = quantity(
        "liquid",
        "what the thread moves in: liquid drags it, in air its inertia and weight count; for rod",
        choices=MEDIA,
    )
    viscosity: float = quantity(
        1.0,
        "dynamic viscosity of the liquid; glycerin at room temperature is about 1",
        unit="Pa s",
        minimum=1e-4,
        maximum=1e2,
    )
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
        "seen",
        "where the thread starts: as the camera first sees it, or straight behind the needle",
        choices=("seen", "straight"),
    )
    longest_step: float = quantity(
        0.02,
        "intervals between poses are divided into steps of at most this; at 60 Hz and faster each is one step",
        unit="s",
        minimum=1e-4,
        maximum=0.1,
    )
    disc_obstacles: tuple[float, ...] = quantity(
        (),
        "round obstacles in the dish frame: x, y, radius of each in turn",
        unit="m",
        minimum=-1.0,
        maximum=1.0,
        multiple=3,
    )
    polygon_obstacles: tuple[float, ...] = quantity(
        (),
        "corners of polygons in the dish frame: x, y of each in turn, one outline after the other",
        unit="m",
        minimum=-1.0,
        maximum=1.0,
        multiple=2,
    )
    polygon_sizes: tuple[int, ...] = quantity(
        (),
        "number of corners of each outline in polygon_obstacles; negative for a hole in the polygon before it",
        minimum=-10000,
        maximum=10000,
    )
    corner_radius: float = quantity(
        2e-4, "sharp corners of polygons are rounded by this; 0 leaves them", unit="m", minimum=0.0, maximum=0.1
    )
    corner_angle: float = quantity(
        math.pi / 6.0,
        "a corner is sharp where the outline turns by more than this",
        unit="rad",
        minimum=0.05,
        maximum=3.1,
    )
    margin_range: float = quantity(
        5e-3,
        "margins are published of nodes and obstacles that are closer than this",
        unit="m",
        minimum=1e-4,
        maximum=1.0,
    )
    contact_tolerance: float = quantity(
        2e-6, "a node this close to an obstacle touches it", unit="m", minimum=0.0, maximum=1e-3
    )
    residual_tolerance: float = quantity(
        1e-6, "largest scaled residual with which a solution is accepted", minimum=1e-12, maximum=1e-2
    )

    def check(self) -> None:
        """Refuse a thread thicker than a segment is long, and obstacles too small for the segments.

        A segment could lie across such an obstacle with both of its nodes outside.
        """
        self.check_friction(self.GROUP, self.margin_range)
        least = 0.5 * self.length / self.segments
        for disc in self._discs:
            if disc.radius < least:
                name, words = f"{self.GROUP}.disc_obstacles", "as every third number a radius of at least"
                raise ConfigurationError(name, disc.radius, f"{words} {least:g} m, half of a segment")
        for index, polygon in enumerate(self._polygons):
            if not polygon.has_room_for(least):
                name, words = f"{self.GROUP}.polygon_obstacles", "polygons with room for a disc of a radius of at least"
                raise ConfigurationError(name, f"polygon {index}", f"{words} {least:g} m, half of a segment")
        diameter = self._material().diameter
        if self.length / self.segments <= diameter:
            most = math.ceil(self.length / diameter) - 1
            raise ConfigurationError(
                f"{self.GROUP}.segments", self.segments, f"at most {most}, so that a segment is longer than thick"
            )
        for name, pair, words in (
            ("attachment_offset", self.attachment_offset, "along and to the left"),
            ("gravity", self.gravity, "x and y"),
        ):
            if len(pair) not in (0, 2):
                raise ConfigurationError(f"{self.GROUP}.{name}", list(pair), f"two numbers, {words}, or none")
        if self.formulation == "paper" and self.medium != "liquid":
            raise ConfigurationError(
                f"{self.GROUP}.medium", self.medium, "liquid, as the formulation paper has no inertia"
            )
        turn = abs(self.rest_curvature) * self.length / self.segments
        if turn > SHARPEST_TURN:
            sharpest = SHARPEST_TURN * self.segments / self.length
            words = f"at most {sharpest:.0f} 1/m with {self.segments} segments, which turn by half a radian then"
            raise ConfigurationError(f"{self.GROUP}.rest_curvature", self.rest_curvature, words)
        for about in described(type(self)):
            other = OF_MEDIUM.get(about.name, self.medium)
            if other != self.medium and getattr(self, about.name) != about.default:
                name, value = f"{self.GROUP}.{about.name}", getattr(self, about.name)
                raise ConfigurationError(
                    name, value, f"{about.default}, its default: it counts for medium: {other} only"
                )
        for node in self.held_nodes:
            if node > self.segments:
                raise ConfigurationError(f"{self.GROUP}.held_nodes", node, f"nodes from 1 to {self.segments}")

    def obstacles(self) -> tuple[Disc | Polygon, ...]:
        """Return all obstacles: the discs, then the polygons, in the order in which margins number them."""
        return (*self._discs, *self._polygons)

    @cached_property
    def _discs(self) -> tuple[Disc, ...]:
        return discs_from(self.disc_obstacles)

    @cached_property
    def _polygons(self) -> tuple[Polygon, ...]:
        return polygons_from(
            self.GROUP, self.polygon_obstacles, self.polygon_sizes, self.corner_radius, self.corner_angle
        )

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
            length=self.length,
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

    def predictor(self) -> ThreadPredictor:
        """Return a predictor of this thread among these obstacles, its kernels compiled.

        Raises:
            ConfigurationError: an obstacle cannot be used; the message says why.
        """
        thread, surroundings = self.thread(), Surroundings(self.obstacles(), self.margin_range)
        tolerance = self.residual_tolerance
        weight = self.paper_stiffness_weight or MATERIALS[self.material].stiffness_weight
        paper = replace(PaperOptions.tuned(weight), damping=self.paper_damping)
        formulation = make_formulation(
            self.formulation, thread, surroundings, make_solver(self.solver, tolerance), tolerance, paper
        )
        predictor = ThreadPredictor(formulation, thread, longest_step=self.longest_step, held=self.held_nodes)
        predictor.warm_up()
        return predictor
