"""Settings of the thread model: what they make, what they refuse, and what a material changes."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.estimator.settings import ThreadModelSettings, parse_material
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.settings.configuration import from_mapping, to_mapping
from magnetosuture_thread.settings.errors import ConfigurationError
from magnetosuture_thread.thread.prediction import NeedleMotion, NeedlePose
from test.shared import known
from test.thread.worlds import scene_with


def made(**values: Any) -> ThreadModelSettings:
    """Return settings from what a setup file would hold."""
    return from_mapping(ThreadModelSettings, values)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"fixed_nodes": [26]}, "nodes from 1 to 25"),
        ({"medium": "air", "gravity": [0.0, -9.8, 1.0, 2.0]}, "two numbers"),
        ({"gravity": [0.0, -9.81]}, "gravity.*medium: air only"),
        ({"medium": "air", "viscosity": 0.5}, "viscosity.*medium: liquid only"),
        ({"rest_curvature": 900.0}, "half a radian"),
        ({"attachment_offset": [1e-3, 0.0, 1e-3, 0.0]}, "attachment_offset.*two numbers, along and to the left"),
        ({"attachment_offset": [1.0, 0.0]}, "from -0.01 to 0.01 m"),
        ({"formulation": "paper", "medium": "air"}, "paper has no inertia"),
        ({"formulation": "paper", "flow": [1e-3, 0.0]}, "paper has no drag"),
        ({"segments": 400}, "longer than thick"),
        ({"elastic_modulus": 3.0}, "elastic_modulus: got 3.0, expected at least .* Pa"),
        ({"needle_curvature": 500.0}, "a half circle"),
    ],
)
def test_what_cannot_be_is_refused_by_name(values: dict[str, Any], words: str):
    with pytest.raises(ConfigurationError, match=words) as caught:
        made(**values)
    assert "thread_model." in str(caught.value)


def test_a_scene_that_the_segments_do_not_resolve_is_refused():
    with pytest.raises(ConfigurationError, match=r"scene\.shape_1: got 0\.0001, .* half of a segment"):
        made().predictor(scene_with(Disc((0.0, 0.0), 1e-3), Disc((0.01, 0.0), 1e-4)))


def test_the_attachments_velocity_is_the_rate_of_its_place():
    settings, velocity, rate, step = made(attachment_offset=[0.01, -0.005]), np.array([2e-3, -1e-3]), 3.0, 1e-6

    def after(time: float) -> NeedlePose:
        heading = np.array([np.cos(0.4 + rate * time), np.sin(0.4 + rate * time)])
        return settings.attachment_pose(
            NeedlePose(1.0 + time, time * velocity, heading, motion=NeedleMotion(velocity, rate))
        )

    motion = known(after(0.0).motion)
    np.testing.assert_allclose(motion.velocity, (after(step).tail - after(-step).tail) / (2.0 * step), rtol=1e-6)


def changed(values: dict[str, Any], **before: Any) -> ThreadModelSettings:
    """Return the settings after a change."""
    return from_mapping(ThreadModelSettings, {**to_mapping(from_mapping(ThreadModelSettings, before)), **values})


def material(**fields: Any) -> dict[str, Any]:
    """Return the settings that a ThreadMaterial with these fields changes."""
    empty = {"name": "", "rest_curvature": (), "attachment": "", "attachment_offset": ()}
    numbers = dict.fromkeys(("diameter", "elastic_modulus", "viscosity", "drag_anisotropy"), 0.0)
    return parse_material(SimpleNamespace(**{**empty, **numbers, **fields}))


def test_a_material_that_is_named_brings_its_own_figures():
    before = {"diameter": 7e-5, "elastic_modulus": 1e9, "paper_stiffness_weight": 3.0, "viscosity": 0.7}
    silk = changed(material(name="silk_6_0"), **before)
    assert silk == from_mapping(ThreadModelSettings, {"material": "silk_6_0", "viscosity": 0.7})
    thicker = changed(material(name="silk_6_0", diameter=9e-5), **before)
    assert (thicker.material, thicker.diameter, thicker.elastic_modulus) == ("silk_6_0", 9e-5, 0.0)


def test_what_may_be_zero_can_be_told_and_what_is_not_told_stays():
    nothing = dict.fromkeys(("diameter", "elastic_modulus", "viscosity", "drag_anisotropy"), math.nan)
    assert material() == material(**nothing) == {}
    before = {"rest_curvature": 5.0, "attachment_offset": [1e-3, 0.0], "attachment": "clamped"}
    told = material(rest_curvature=[0.0], attachment_offset=[0.0, 0.0], attachment="pinned")
    assert changed(told, **before) == from_mapping(ThreadModelSettings, {"attachment_offset": [0.0, 0.0]})
