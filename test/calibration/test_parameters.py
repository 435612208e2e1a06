"""How numbers enter the settings, and the file that comes of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from magnetosuture_thread.calibration.parameters import (
    OF_FORMULATION,
    STIFFNESS_OVER_DRAG,
    stiffness_over_drag,
    with_stiffness_over_drag,
)
from magnetosuture_thread.calibration.result import (
    FIXED,
    AttachmentDecision,
    BagErrors,
    CalibrationResult,
    Estimate,
    to_yaml,
)
from magnetosuture_thread.estimator.settings import ThreadModelSettings
from magnetosuture_thread.settings.parameter_files import load_setup

SETTINGS = ThreadModelSettings(thread_length=0.019, segments=12)
ALL = [(formulation, parameter) for formulation, many in OF_FORMULATION.items() for parameter in many]
FOUND = CalibrationResult(
    settings=replace(
        with_stiffness_over_drag(SETTINGS, 2e-9),
        rest_curvature=12.0,
        attachment="clamped",
        attachment_offset=(1e-4, 0.0),
    ),
    against="seen",
    estimates=(
        Estimate("stiffness over drag", "elastic_modulus", "m^4/s", 2e-9, 1.3e-9, 1.8e-9, 2.2e-9),
        Estimate("drag anisotropy", "drag_anisotropy", "", 0.5, 0.5, 0.2, 1.1, FIXED, "too wide to be of use"),
        Estimate("rest curvature", "rest_curvature", "1/m", 12.0, 0.0, 11.0, 13.0),
        Estimate("offset along", "attachment_offset", "m", 1e-4, 0.0, 5e-5, 1.5e-4),
        Estimate("offset left", "attachment_offset", "m", 0.0, 0.0, -1.0, 1.0, FIXED, "too little to be seen"),
    ),
    attachment=AttachmentDecision("clamped", "pinned", {"pinned": 9.0, "clamped": 0.4}),
    scores=(
        BagErrors("a/bag", 600, 3.0, 0.4, 0.5, 2.9, 0.1, 0.2, simulated="camera frames"),
        BagErrors("b", 100, 3.0, 0.4),
    ),
    replays=60,
)


@pytest.mark.parametrize(("formulation", "parameter"), ALL, ids=[parameter.name for _, parameter in ALL])
def test_a_number_goes_in_and_comes_out(formulation, parameter):
    settings = replace(SETTINGS, formulation=formulation)
    low, high = parameter.fit_bounds(settings)
    assert low < parameter.to_fit(parameter.read(settings)) <= high
    for part in (0.001, 0.3, 0.999):
        value = parameter.from_fit(low + part * (high - low))
        assert parameter.read(parameter.write(settings, value)) == pytest.approx(value, rel=1e-9, abs=1e-15)
    lower, upper = parameter.interval(parameter.to_fit(parameter.read(settings)), 1e-6)
    assert lower < parameter.read(settings) < upper


def test_only_the_ratio_of_stiffness_and_drag_counts():
    thick = replace(SETTINGS, viscosity=3.0, diameter=8e-5)
    one, other = (STIFFNESS_OVER_DRAG.write(settings, 2e-9).thread() for settings in (SETTINGS, thick))
    for thread in (one, other):
        assert thread.bending_stiffness / thread.medium.drag_across == pytest.approx(2e-9)
    assert other.bending_stiffness > 2.5 * one.bending_stiffness


def test_the_file_is_what_thread_model_loads(tmp_path: Path):
    text = to_yaml(FOUND)
    (path := tmp_path / "found.yaml").write_text(text, encoding="utf-8")
    settings = load_setup(path, [ThreadModelSettings])["thread_model"]
    assert isinstance(settings, ThreadModelSettings)
    assert stiffness_over_drag(settings) == pytest.approx(2e-9, rel=1e-5)
    assert replace(settings, elastic_modulus=1e9) == replace(FOUND.settings, elastic_modulus=1e9)
    for words in (
        "# drag anisotropy is left out, as this data cannot tell it: too wide to be of use",
        "# offset left stays 0 m, as this data cannot tell it: too little to be seen",
        "m^4/s [1.8e-09 to 2.2e-09]",
        "From a/bag (simulated: camera frames), 600 frames",
        "nothing in it says that it is simulated",
    ):
        assert words in text
    assert "drag_anisotropy:" not in text
    assert max(len(line) for line in text.splitlines()) <= 120


def test_what_cannot_be_told_or_is_not_finished_says_so():
    attachment = AttachmentDecision("pinned", "pinned", {"pinned": 0.4, "clamped": 0.41}, "worse by 0.01 only")
    text = to_yaml(replace(FOUND, attachment=attachment, finished=False))
    assert text.startswith("# BEST SO FAR, NOT FINISHED")
    assert "# attachment is left out, as this data cannot tell it: worse by 0.01 only" in text
    assert "    attachment: " not in text
