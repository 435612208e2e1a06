"""What is newly known, as values of settings."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

from magnetosuture_thread.estimator.settings import ThreadModelSettings, parse_material
from magnetosuture_thread.settings.configuration import from_mapping, to_mapping


def changed(values: dict[str, Any], **before: Any) -> ThreadModelSettings:
    """Return the settings after a change."""
    return from_mapping(ThreadModelSettings, {**to_mapping(from_mapping(ThreadModelSettings, before)), **values})


def material(**fields: Any) -> dict[str, Any]:
    """Return the settings that a ThreadMaterial with these fields changes."""
    empty = {"name": "", "rest_curvature": (), "attachment": "", "attachment_offset": ()}
    numbers = dict.fromkeys(("diameter", "elastic_modulus", "viscosity", "drag_anisotropy"), 0.0)
    return parse_material(SimpleNamespace(**{**empty, **numbers, **fields}))


def test_what_is_not_told_of_a_material_stays():
    assert material() == {}
    assert material(diameter=math.nan, elastic_modulus=math.nan, viscosity=math.nan, drag_anisotropy=math.nan) == {}
    before: dict[str, Any] = {"diameter": 7e-5, "elastic_modulus": 1e9, "rest_curvature": 5.0, "attachment": "clamped"}
    after = changed(material(viscosity=0.8, drag_anisotropy=0.6), **before)
    assert after == from_mapping(ThreadModelSettings, {**before, "viscosity": 0.8, "drag_anisotropy": 0.6})


def test_a_material_that_is_named_brings_its_own_figures():
    before = {"diameter": 7e-5, "elastic_modulus": 1e9, "paper_stiffness_weight": 3.0, "viscosity": 0.7}
    silk = changed(material(name="silk_6_0"), **before)
    assert silk == from_mapping(ThreadModelSettings, {"material": "silk_6_0", "viscosity": 0.7})
    thicker = changed(material(name="silk_6_0", diameter=9e-5), **before)
    assert (thicker.material, thicker.diameter, thicker.elastic_modulus) == ("silk_6_0", 9e-5, 0.0)


def test_what_may_be_zero_can_be_told():
    before = {"rest_curvature": 5.0, "attachment_offset": [1e-3, 0.0], "attachment": "clamped"}
    told = material(rest_curvature=[0.0], attachment_offset=[0.0, 0.0], attachment="pinned")
    assert changed(told, **before) == from_mapping(ThreadModelSettings, {"attachment_offset": [0.0, 0.0]})
