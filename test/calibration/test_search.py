"""A calibration finds what was put in, and says what cannot be found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from magnetosuture_thread.calibration.parameters import stiffness_over_drag
from magnetosuture_thread.calibration.recorded_run import BestSettings, read_run
from magnetosuture_thread.calibration.result import FIXED, IDENTIFIED, CalibrationResult, Estimate
from magnetosuture_thread.calibration.search import calibrate, unfinished_result
from test.calibration.runs import SETTINGS, SILK, model_run, noisy, rig_passage, rig_run, stiff

TRUE = 1.3e-9  # m^4/s


def of(found: CalibrationResult, name: str) -> Estimate:
    """Return an estimate by its name."""
    return next(estimate for estimate in found.estimates if estimate.name == name)


@pytest.mark.parametrize(("start", "noise"), [(0.2, 0.0), (5.0, 3e-5)])
def test_the_stiffness_of_the_rigs_own_rod_is_found_from_a_wrong_start(start: float, noise: float):
    shares: list[float] = []
    found, fits = calibrate(
        [rig_passage(TRUE, noise)],
        stiff(start * TRUE),
        ["elastic_modulus", "drag_anisotropy", "rest_curvature"],
        progress=shares.append,
    )
    stiffness = of(found, "stiffness over drag")
    assert stiffness.status == IDENTIFIED
    assert stiffness.value == pytest.approx(TRUE, rel=0.05)
    assert stiffness.low < TRUE < stiffness.high
    assert stiffness.high / stiffness.low < 1.5
    assert stiffness_over_drag(found.settings) == pytest.approx(stiffness.value, rel=1e-9)
    score = found.scores[0]
    assert score.truth_after < 0.3 < score.truth_before
    assert len(fits[0].after) == score.frames
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


def test_bags_are_one_fit_and_each_is_predicted_by_the_others():
    passages = [rig_passage(TRUE, 2e-5, phase, name=str(phase)) for phase in (0.0, 1.5)]
    found, _ = calibrate(passages, stiff(3.0 * TRUE), ["elastic_modulus"])
    assert of(found, "stiffness over drag").value == pytest.approx(TRUE, rel=0.05)
    for score in found.scores:
        assert score.truth_held_out < 0.3 < score.truth_before
        assert score.truth_held_out == pytest.approx(score.truth_after, abs=0.05)


@pytest.mark.parametrize("clamped", [False, True])
def test_the_attachment_is_told_from_how_the_thread_moves(clamped: bool):
    wrong = replace(stiff(TRUE), attachment="pinned" if clamped else "clamped")
    found, _ = calibrate([rig_passage(TRUE, 2e-5, clamped=clamped)], wrong, ["attachment", "elastic_modulus"])
    assert found.settings.attachment == ("clamped" if clamped else "pinned")
    assert found.attachment is not None
    assert found.attachment.reason == ""
    assert of(found, "stiffness over drag").value == pytest.approx(TRUE, rel=0.05)


def test_of_silk_the_stiffness_cannot_be_told():
    sights = model_run(SILK, 8.0, scale=0.04, period=40.0)
    passage = read_run("silk", noisy(sights, 4e-5), SILK)
    found, _ = calibrate([passage], SILK, ["elastic_modulus", "drag_anisotropy"])
    stiffness = of(found, "stiffness over drag")
    assert stiffness.status == FIXED
    assert "elsewhere it goes where it is pulled" in stiffness.reason
    assert found.settings.elastic_modulus == SILK.elastic_modulus
    assert any("stiffness over drag cannot be identified" in warning for warning in found.warnings)


def test_what_the_set_up_says_gives_way_where_it_predicts_worse_though_it_cannot_be_told():
    sights = model_run(SILK, 8.0, scale=0.012, period=12.0)
    found, _ = calibrate(
        [read_run("silk", sights, SILK)], stiff(100.0 * stiffness_over_drag(SILK), SILK), ["elastic_modulus"]
    )
    stiffness = of(found, "stiffness over drag")
    assert stiffness.status == "stand-in"
    assert found.scores[0].after < found.scores[0].before - 0.1
    assert any("stands in" in warning for warning in found.warnings)


def test_the_paper_s_numbers_are_fitted_too():
    settings = replace(SETTINGS, formulation="paper", paper_damping=0.999)
    found, _ = calibrate([read_run("run", rig_run(TRUE, 4.5), settings)], settings, ["paper_damping"])
    assert [estimate.setting for estimate in found.estimates] == ["paper_damping"]
    assert found.scores[0].after < found.scores[0].before - 1.0


def test_an_interrupted_search_has_its_best():
    class InterruptError(Exception):
        pass

    best, passage = BestSettings(), rig_passage(TRUE)

    def stop(share: float) -> None:
        if best.replays > 18:
            raise InterruptError

    with pytest.raises(InterruptError):
        calibrate([passage], stiff(5.0 * TRUE), best=best, progress=stop)
    found, fits = unfinished_result([passage], stiff(5.0 * TRUE), best)
    assert not found.finished
    assert found.error < found.scores[0].before
    assert found.error == pytest.approx(best.error)
    assert {estimate.status for estimate in found.estimates} == {"unfinished"}
    assert np.isfinite(fits[0].after).all()
