"""Settings of the thread model."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from magnetosuture_thread.estimator.estimator import EstimatorOptions, EstimatorSession, ThreadEstimator
from magnetosuture_thread.geometry.barrier import Barrier, load_barriers
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.settings import shared_parameters as shared
from magnetosuture_thread.settings.configuration import configuration_fields, quantity
from magnetosuture_thread.thread.barriers import SelfContact
from magnetosuture_thread.thread.margins import FrictionLaw
from magnetosuture_thread.thread.material import (
    MATERIALS,
    MAX_ELASTIC_MODULUS,
    MAX_REST_ANGLE,
    MIN_ELASTIC_MODULUS,
    Attachment,
    Material,
    Medium,
    Thread,
)
from magnetosuture_thread.thread.paper import PaperOptions
from magnetosuture_thread.thread.prediction import NeedlePose
from magnetosuture_thread.thread.predictor import FORMULATIONS, ThreadPredictor
from magnetosuture_thread.thread.solvers import SOLVERS

OF_MEDIUM = {
    **dict.fromkeys(("viscosity", "wetted_fraction", "drag_anisotropy"), "liquid"),
    **dict.fromkeys(("mass_per_length", "air_drag", "bending_damping", "gravity"), "air"),
}
FIXED = {  # why a node cannot change it while it is configured
    "autostart": "read at the start",
    "formulation": "compiled when the node is configured",
    "solver": "compiled when the node is configured",
    "barriers": "imported when the node is configured",
    "scene": "read when the node is configured; the topic scene changes it",
    "forecast_horizon": "compiled when the node is configured",
}


@dataclass(frozen=True)
class ThreadModelSettings(
    shared.LifecycleSettings,
    shared.SceneName,
    shared.ThreadLength,
    shared.Viscosity,
    shared.CommandFilter,
    shared.NeedleArc,
):
    """Parameters of the thread model: thread, liquid and numerical settings; the scene is given apart."""

    GROUP: ClassVar[str] = "thread_model"

    formulation: str = quantity(
        "rod", "how a step is written: rod is the accurate one, paper the one as printed", choices=FORMULATIONS
    )
    solver: str = quantity("banded", "what solves a step's program", choices=SOLVERS)
    barriers: tuple[str, ...] = quantity((), "barriers of your own, each as module:class; see Barrier")
    material: str = quantity("polyamide_7_0", "the thread's material", choices=tuple(MATERIALS))
    diameter: float = quantity(0.0, "of the thread; 0 takes the material's", "m", 0.0, 0.01)
    elastic_modulus: float = quantity(
        0.0, "effective modulus of the thread in bending; 0 takes the material's", "Pa", 0.0, MAX_ELASTIC_MODULUS
    )
    segments: int = quantity(25, "number of segments, n", "", 3, 2000)
    attachment: str = quantity(
        Attachment.PINNED.value,
        "how the needle holds the thread: pinned turns freely, clamped leaves along its axis; for rod",
        choices=tuple(kind.value for kind in Attachment),
    )
    rest_curvature: float = quantity(
        0.0,
        "curvature of the unloaded thread, positive to the left, seen from the needle along it",
        "1/m",
        -2000.0,
        2000.0,
    )
    fixed_nodes: tuple[int, ...] = quantity(
        (), "nodes that stay where they are, as where tissue holds the thread", "", 1, 2000
    )
    medium: str = quantity(
        "liquid", "liquid drags the thread, in air its inertia and weight count; for rod", choices=("liquid", "air")
    )
    wetted_fraction: float = quantity(
        0.5, "part of the thread's surface in the liquid; half for a floating thread", "", 0.05, 1.0
    )
    drag_anisotropy: float = quantity(
        0.5, "drag of the liquid along the thread over that across it; half for a slender body", "", 0.05, 1.0
    )
    attachment_offset: tuple[float, ...] = quantity(
        (),
        "where the thread is fixed, from the tracked tail: along the heading, and to its left",
        "m",
        -0.01,
        0.01,
        multiple=2,
    )
    paper_damping: float = quantity(
        0.95, "kappa, part of its velocity that a node keeps from step to step; for paper", "", 0.0, 0.999
    )
    paper_stiffness_weight: float = quantity(0.0, "W_stiff; 0 takes the material's; for paper", "", 0.0, 1e12)
    mass_per_length: float = quantity(4e-6, "mass of the thread in air per length", "kg/m", 1e-9, 10.0)
    air_drag: float = quantity(1e-4, "drag of the thread in air per length and speed", "Pa s", 0.0, 10.0)
    bending_damping: float = quantity(
        0.0, "time in which bending in air is damped: its moment over its stiffness and rate", "s", 0.0, 10.0
    )
    gravity: tuple[float, ...] = quantity(
        (), "weight in the plane of the camera, for a thread in air: x, y", "m/s^2", -20.0, 20.0, multiple=2
    )
    flow: tuple[float, ...] = quantity(
        (),
        "velocity of the liquid or air in the camera's plane, the same everywhere; for rod",
        "m/s",
        -0.1,
        0.1,
        multiple=2,
    )
    initial_shape: str = quantity(
        "measured",
        "where the thread starts: as first measured, or straight behind the needle",
        choices=("measured", "straight"),
    )
    max_step: float = quantity(
        0.02, "longest step; a longer interval between poses is divided into steps", "s", 1e-4, 0.1
    )
    margin_range: float = quantity(
        5e-3, "margins are published of nodes that are closer to an obstacle or the wall than this", "m", 1e-4, 1.0
    )
    contact_tolerance: float = quantity(2e-6, "a node this close to an obstacle or the wall touches it", "m", 0.0, 1e-3)
    residual_tolerance: float = quantity(
        1e-6, "largest scaled residual with which a solution is accepted", "", 1e-12, 1e-2
    )
    friction_threshold: float = quantity(5e-4, "a node this close to two obstacles is under friction", "m", 0.0, 0.1)
    friction_slowdown: float = quantity(
        0.9, "beta: each node under friction slows the needle by this factor", "", 0.01, 1.0
    )
    stuck_speed: float = quantity(
        2e-4, "a thread under friction whose nodes there are not faster rests, and slows nothing", "m/s", 0.0, 1.0
    )
    friction_averaging: float = quantity(
        0.2, "time over which the nodes' velocities are averaged for that, as tracked poses tremble", "s", 0.0, 10.0
    )
    friction_by_bound: bool = quantity(
        False, "whether the 99 % bound of an estimated clearance counts for friction, in place of the clearance"
    )
    estimator: bool = quantity(
        True, "whether the thread is estimated too: the model corrected by the camera; for rod in liquid"
    )
    estimator_path_deviation: float = quantity(
        2e-5, "deviation of points of thread/measured, used where nobody publishes thread/observation", "m", 1e-7, 0.01
    )
    estimator_history: float = quantity(
        EstimatorOptions.history, "how late an observation of the thread may come", "s", 0.05, 5.0
    )
    forecast_horizon: float = quantity(
        0.0, "how far ahead thread/forecast looks, by the plan or the command held; 0 for none", "s", 0.0, 30.0
    )
    forecast_step: float = quantity(0.03, "duration of its steps", "s", 0.001, 0.5)
    forecast_period: float = quantity(
        0.0, "time between estimates that are forecast; 0 for every one, as time allows", "s", 0.0, 10.0
    )

    def check(self) -> None:
        """Refuse a thread thicker than a segment is long, and values that contradict each other."""
        length, segments = self.thread_length, self.segments
        diameter = self.diameter or MATERIALS[self.material].diameter
        most_segments, sharpest = math.ceil(length / diameter) - 1, MAX_REST_ANGLE * segments / length
        softest = f"at least {MIN_ELASTIC_MODULUS:g} Pa, or 0 for the material's; the softest materials have 1 MPa"
        pairs = {"attachment_offset": "along and to the left", "gravity": "x and y", "flow": "x and y"}
        horizon, step, is_paper = self.forecast_horizon, self.forecast_step, self.formulation == "paper"
        curled = f"at most {sharpest:.0f} 1/m with {segments} segments, which turn by half a radian then"
        reach = f"at most {self.GROUP}.margin_range, {self.margin_range:g} m"
        for wrong, name, expected in (
            (self.friction_threshold > self.margin_range, "friction_threshold", reach),
            (0.0 < self.elastic_modulus < MIN_ELASTIC_MODULUS, "elastic_modulus", softest),
            (segments > most_segments, "segments", f"at most {most_segments}, so that a segment is longer than thick"),
            *((len(getattr(self, name)) > 2, name, f"two numbers, {of}, or none") for name, of in pairs.items()),
            (is_paper and self.medium != "liquid", "medium", "liquid, as the formulation paper has no inertia"),
            (is_paper and self.flow, "flow", "none, as the formulation paper has no drag"),
            (abs(self.rest_curvature) > sharpest, "rest_curvature", curled),
            *self._of_another_medium(),
            (0.0 < horizon < step, "forecast_horizon", f"0, or at least forecast_step, {step:g} s"),
            (max(self.fixed_nodes, default=0) > segments, "fixed_nodes", f"nodes from 1 to {segments}"),
        ):
            if wrong:
                raise self.refused(name, expected)

    def _of_another_medium(self) -> Iterator[tuple[bool, str, str]]:
        """Yield of each setting whether it counts for another medium only, its name, and what is expected."""
        for field in configuration_fields(type(self)):
            medium = OF_MEDIUM.get(field.name, self.medium)
            set_for_nothing = medium != self.medium and getattr(self, field.name) != field.default
            yield set_for_nothing, field.name, f"{field.default}, its default: it counts for medium: {medium} only"

    def _material(self) -> Material:
        material = MATERIALS[self.material]
        modulus = self.elastic_modulus or material.elastic_modulus
        return replace(material, diameter=self.diameter or material.diameter, elastic_modulus=modulus)

    def thread(self) -> Thread:
        """Return the thread."""
        names = "segments", "viscosity", "wetted_fraction", "drag_anisotropy", "rest_curvature"
        numbers = {name: getattr(self, name) for name in names}
        kind = Attachment(self.attachment)
        thread = Thread.of(self._material(), length=self.thread_length, attachment=kind, **numbers)
        if self.medium == "air":
            air = Medium.air(self.mass_per_length, self.gravity, self.air_drag, self.bending_damping)
            thread = replace(thread, medium=air)
        return replace(thread, medium=replace(thread.medium, flow=self.flow)) if self.flow else thread

    def attachment_pose(self, pose: NeedlePose) -> NeedlePose:
        """Return the pose of the point where the thread is fixed, from that of the needle's tail, in the plane."""
        if not self.attachment_offset:
            return pose
        along, left = self.attachment_offset
        x, y = pose.heading
        lever, motion = np.array([along * x - left * y, along * y + left * x]), pose.motion
        if motion is not None:
            motion = motion._replace(velocity=motion.velocity + motion.turning * np.array([-lever[1], lever[0]]))
        return replace(pose, tail=pose.tail + lever, motion=motion)

    def predictor(self, scene: Scene | None) -> ThreadPredictor:
        """Return a predictor of this thread in a scene, its kernels compiled.

        They are loaded by steps where nothing is, as a scene may have no room for the thread of these steps.

        Args:
            scene: dish and obstacles; None for neither.

        Raises:
            ConfigurationError: a shape is too small for the segments; see `check_scene`.
        """
        self._predictor(scene, empty=True).warm_up()
        return self._predictor(scene)

    def _predictor(self, scene: Scene | None, *, empty: bool = False) -> ThreadPredictor:
        """Return a predictor; for a warm-up one with the kernels of a scene, without its wall, shapes and barriers."""
        thread, names = self.thread(), ("margin_range", "contact_tolerance", "residual_tolerance", "max_step")
        barriers: Sequence[Barrier] = ()
        if not empty:
            barriers = load_barriers(self.barriers, f"{self.GROUP}.barriers")
        elif scene is not None and scene.dish.has_self_contact(thread.diameter) and self.formulation == "rod":
            barriers = (SelfContact(thread),)
        weight = self.paper_stiffness_weight or MATERIALS[self.material].stiffness_weight
        return ThreadPredictor(
            thread,
            None if empty else scene,
            barriers,
            formulation=self.formulation,
            solver=self.solver,
            paper=replace(PaperOptions.tuned(weight), damping=self.paper_damping),
            fixed_nodes=self.fixed_nodes,
            **{name: getattr(self, name) for name in names},
        )

    @property
    def is_estimated(self) -> bool:
        """Whether the thread is estimated too."""
        return self.estimator and self.formulation == "rod" and self.medium == "liquid"

    def estimator_session(self, scene: Scene | None) -> EstimatorSession | None:
        """Return an estimator of this thread in a scene, its kernels compiled; None where it is not estimated.

        Args:
            scene: dish and obstacles; None for neither.

        Raises:
            ConfigurationError: see `predictor`.
        """
        if not self.is_estimated:
            return None
        options = EstimatorOptions(self.estimator_history)
        ThreadEstimator(self._predictor(scene, empty=True), options).warm_up()
        return EstimatorSession(ThreadEstimator(self._predictor(scene), options))

    def friction_law(self) -> FrictionLaw:
        """Return the friction law."""
        return FrictionLaw(self.friction_threshold, self.friction_slowdown, self.stuck_speed, self.friction_by_bound)


def parse_material(message: Any) -> dict[str, Any]:
    """Return the settings, by name, that a ThreadMaterial message changes.

    What is 0, not a number or empty stays as it is; but a material that is named brings its own diameter, modulus
    and weight of the stiffness. The message has the units of the settings.
    """
    values: dict[str, Any] = {}
    if message.name:
        values = {"material": message.name, "diameter": 0.0, "elastic_modulus": 0.0, "paper_stiffness_weight": 0.0}
    for name in ("diameter", "elastic_modulus", "viscosity", "drag_anisotropy"):
        number = getattr(message, name)
        if number != 0.0 and not math.isnan(number):
            values[name] = number
    if len(message.rest_curvature):
        values["rest_curvature"] = float(message.rest_curvature[0])
    if message.attachment:
        values["attachment"] = message.attachment
    if len(message.attachment_offset):
        values["attachment_offset"] = [float(part) for part in message.attachment_offset]
    return values
