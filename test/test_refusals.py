"""What the public constructors and calls refuse: by a name, the value and what is expected, whatever is given."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import magnetosuture_thread
from magnetosuture_thread import (
    MATERIALS,
    Attachment,
    ConfigurationError,
    Disc,
    EstimatorOptions,
    ForecastStart,
    InvalidInputError,
    MagnetosutureError,
    Medium,
    NeedlePose,
    NeedleSafetyFilter,
    Scene,
    Thread,
    ThreadForecaster,
    ThreadPredictor,
)
from test.coils.safety.test_user_barriers import HalfPlane

SCENE = Scene.create(dish_diameter=0.045, shapes={"post": Disc((-0.01, 0.0), 0.0015)})
EMPTY = Scene.create(dish_diameter=0.045)
EAST, STRAIGHT = np.array([1.0, 0.0]), np.array([[0.0, 0.0], [-0.019, 0.0]])
THREAD = Thread.of(MATERIALS["polyamide_7_0"], length=0.019, segments=25, attachment=Attachment.PINNED)
POSE = NeedlePose(0.0, np.zeros(2), EAST)
NODES = np.column_stack([np.linspace(0.0, -0.019, 26), np.zeros(26)])


def made(kind: Callable[..., Any], /, **arguments: Any) -> Callable[..., Any]:
    """Return what makes an object of arguments, of which some may be changed."""
    return lambda **changes: kind(**{**arguments, **changes})


CREATE = made(ThreadPredictor.create, material="polyamide_7_0", length=0.019, segments=25)
FILTER = made(NeedleSafetyFilter, scene=EMPTY, needle_length=0.004)
FORECASTER = made(ThreadForecaster, thread=THREAD, scene=EMPTY)


def of_call(**changes: Any) -> Any:
    """Filter a command."""
    given = {"commanded": 0.002 * EAST, "tail": np.zeros(2), "heading": EAST, **changes}
    return NeedleSafetyFilter(EMPTY, max_acceleration=0.5).filter(**given)


def of_start(pose: NeedlePose = POSE, scene: Scene = EMPTY, **changes: Any) -> Any:
    """Start a thread."""
    return ThreadPredictor(THREAD, scene).start(pose, **changes)


def of_step(**changes: Any) -> Any:
    """Start a thread at the origin, and follow the needle on."""
    predictor = ThreadPredictor(THREAD, EMPTY)
    predictor.start(POSE)
    return predictor.step(NeedlePose(**{"stamp": 0.02, "tail": (0.0, 1e-4), "heading": (1.0, 0.0), **changes}))


def of_forecast(**changes: Any) -> Any:
    """Forecast a thread that lies straight."""
    return FORECASTER().forecast(ForecastStart(**{"pose": POSE, "vertices": NODES, **changes}), np.zeros(2), 0.1)


def of_barrier(**changes: Any) -> Any:
    """Give a barrier to a filter."""
    barrier = HalfPlane(0.01)
    vars(barrier).update(changes)
    return NeedleSafetyFilter(EMPTY, [barrier])


TABLE: list[tuple[Callable[..., Any], dict[str, Any], str]] = [
    (FILTER, {"needle_curvature": 1e3}, "needle_curvature: got 1000.0, expected at most"),
    (of_start, {"pose": NeedlePose(0.0, np.array([5.0, 0.0]), EAST)}, "needle pose position: .* 0.0425 m from"),
    (of_start, {"centreline": STRAIGHT * 5.0 / 19.0}, "got 0.005 m long, expected 0.019 m, .* strict=False"),
    (of_start, {"scene": SCENE}, "centreline: got a thread that lies in post, expected one clear of wall and shapes"),
]  # fmt: skip


@pytest.mark.parametrize(("call", "given", "words"), TABLE)
def test_a_value_that_cannot_be_is_refused_by_name_value_and_expectation(
    call: Callable[..., Any], given: dict[str, Any], words: str
):
    pattern = re.sub(r"([()?])", r"\\\1", words)
    with pytest.raises((ConfigurationError, InvalidInputError), match=pattern) as refused:
        call(**given)
    assert "\n" not in str(refused.value)


def test_a_centreline_that_ends_early_is_continued_where_that_is_asked_for_and_only_there():
    found = of_start(centreline=STRAIGHT * 5.0 / 19.0, strict=False).positions
    np.testing.assert_allclose(found[-1], [-0.019, 0.0], atol=1e-9)
    assert of_start(scene=SCENE, strict=False).positions.shape == (26, 2)
    np.testing.assert_allclose(of_start(centreline=STRAIGHT * 1.05).positions[-1], [-0.019, 0.0], atol=1e-9)


# What is returned and not made by users, and what has no numbers.
RECORDS = {"BarrierMargins", "FilteredCommand", "Forecast", "Gradient", "Margins", "Prediction", "ThreadEstimate"}
OTHERS = {"MATERIALS", "Attachment", "ConfigurationError", "InvalidInputError", "MagnetosutureError", "SolverError"}
OF_FILES = {"calibrate_bags", "read_scene", "replay_offline"}  # test/jobs, test/scene
MADE: dict[str, tuple[Callable[..., Any] | dict[str, Any], str]] = {  # what is called, or with what that name is called
    "Barrier": (of_barrier, "gain slack_weight"),
    "Disc": ({"centre": (0.0, 0.0), "radius": 0.001}, "centre radius"),
    "Dish": ({}, "diameter depth wall_friction self_contact"),
    "EstimatorOptions": ({}, " ".join(EstimatorOptions.__dataclass_fields__)),
    "EstimatorSession": ({"estimator": 3}, "estimator"),
    "ForecastStart": (of_forecast, "pose vertices velocities interval tip_velocity needle_force"),
    "Material": (
        {"name": "x", "diameter": 6e-5, "elastic_modulus": 2e9, "source": ""},
        "diameter elastic_modulus stiffness_weight",
    ),
    "Medium": ({"drag_across": 1.0, "drag_along": 0.5}, " ".join(Medium.__dataclass_fields__)),
    "NeedlePose": (of_step, "stamp tail heading deviation"),
    "NeedleSafetyFilter": (
        FILTER,
        "scene barriers keep_out approach_rate hold_time max_speed max_acceleration needle_length "
        "needle_curvature",
    ),
    "PaperOptions": ({}, "damping gain stiffness_gain connectivity_weight stiffness_weight lead_ahead"),
    "Polygon": ({"outline": ((0, 0), (1, 0), (0, 1))}, "outline holes"),
    "Scene": ({}, "dish shapes"),
    "SceneShape": ({"name": "a", "kind": "wall", "geometry": Disc((0, 0), 1e-3)}, "geometry friction"),
    "Thread": (
        {name: getattr(THREAD, name) for name in Thread.__dataclass_fields__},
        "length segments diameter bending_stiffness medium attachment rest_curvature",
    ),
    "ThreadEstimator": ({"predictor": 3}, "predictor options"),
    "ThreadForecaster": (
        FORECASTER,
        "thread scene safety law friction_averaging attachment_offset step margin_range "
        "contact_tolerance residual_tolerance max_step max_substeps fixed_nodes",
    ),
    "ThreadPredictor": (
        CREATE,
        "material length segments attachment viscosity scene barriers formulation solver paper "
        "margin_range contact_tolerance residual_tolerance max_step max_substeps fixed_nodes",
    ),
    "Workspace": (
        {"shapes": (Disc((0, 0), 1e-3),), "reach": 0.01},
        "shapes reach dimension wall_radius friction wall_friction",
    ),
    "check_gradient": ({"barrier": HalfPlane(0.01), "positions": STRAIGHT}, "positions"),
    "NeedleSafetyFilter.filter": (
        of_call,
        "commanded tail heading slowdown max_speed previous elapsed time first_time",
    ),
    "ThreadPredictor.start": (of_start, "centreline"),
}  # fmt: skip
WRONG = [-1.0, -1e-3, math.nan, math.inf, -math.inf, 0, [], [1.0, 2.0, 3.0], [[0.0]], "seven", np.zeros((2, 2, 2)),
         10**400, True, {}, object()]  # fmt: skip


@pytest.mark.parametrize("name", MADE)
def test_whatever_a_public_constructor_is_given_it_says_what_is_wrong(name: str):
    given, arguments = MADE[name]
    make = given if callable(given) else made(getattr(magnetosuture_thread, name), **given)
    for argument in arguments.split():
        refused = []
        for value in WRONG:
            try:
                make(**{argument: value})
            except MagnetosutureError as error:
                refused.append(str(error))
        assert len(refused) >= 5
        assert all(re.fullmatch(".+: got .+, expected .+", text) for text in refused)  # in one line


def test_every_public_constructor_is_tried_and_documented():
    assert all(getattr(magnetosuture_thread, name).__doc__ for name in magnetosuture_thread.__all__)
    assert set(magnetosuture_thread.__all__) - RECORDS - OTHERS - OF_FILES <= set(MADE)
