"""A rig measures itself: what is found of rigs that the setup says nothing of, and what is refused, by ground truth."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.calibration.commission import Commissioned, Commissioning, find_wiring
from magnetosuture_thread.calibration.commission_files import PULSES, RecordedBench, read_rig
from magnetosuture_thread.calibration.needle_length import find_needle_length
from magnetosuture_thread.calibration.pulse_model import Pulse
from magnetosuture_thread.calibration.simulated_bench import SimulatedBench
from magnetosuture_thread.cli import main
from magnetosuture_thread.coils.pulses import MotionGuard
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.rig.dynamics import NeedleBody
from magnetosuture_thread.rig.rig import Rig
from magnetosuture_thread.rig.settings import RigSettings
from magnetosuture_thread.rig.setups import Setup, read_setup
from magnetosuture_thread.rig.truth import with_rig
from magnetosuture_thread.settings.errors import InvalidInputError

pytestmark = pytest.mark.slow

SETUP = "petri_35mm_polyamide"


@pytest.fixture(scope="module")
def believed() -> Setup:
    """Return what is believed."""
    return read_setup(SETUP)


def true_values(rig: RigSettings, believed: Setup, length: float) -> dict[str, float]:
    """Return the true values by their names in a summary, in the gauge of the setup's mean field and moment."""
    seen = np.array([(-a if rig.camera_mirrored else a) + rig.camera_rotation for a in rig.coil_angles])
    field, way = rig.coil_field().per_current(np.zeros(2)), math.copysign(1.0, rig.needle_magnetisation)
    strengths = way * (field * [np.cos(seen), np.sin(seen)]).sum(axis=0)
    body = NeedleBody(rig.needle_length, rig.needle_width, 0.0, abs(rig.needle_magnetisation), rig.viscosity)
    mean, nominal = math.exp(np.log(np.abs(strengths)).mean()), believed.coils.field_per_current
    moment = believed.coils.needle_moment * length / believed.coils.needle_length
    share = moment * nominal / (body.pole * rig.needle_length * mean)
    names = ("needle_drag without thread", "needle_drag_across", "needle_turning_drag")
    values = dict(zip(names, (share * np.array(body.drag)).tolist(), strict=True))
    values |= {"light x": 0.0, "light y": 0.0}  # where poses are drawn
    values |= {"needle_length": rig.needle_length, "motion_delay": rig.current_delay + rig.stamp_delay}
    for axis, residual in zip("xy", rig.residual_field, strict=True):
        values[f"residual field {axis}"] = way * residual * nominal / mean
    for k, (angle, strength) in enumerate(zip(seen, strengths, strict=True)):
        values |= {f"coil_{k} angle": float(angle), f"coil_{k} field_per_current": float(strength * nominal / mean)}
    return values


def outside(summary: dict[str, Any], truth: dict[str, float]) -> list[str]:
    """Return the measured values whose interval does not hold the truth."""
    missed = []
    for value in summary["values"]:
        if value["kind"] == "measured" and value["name"] in truth:
            error = value["value"] - truth[value["name"]]
            error = math.remainder(error, math.tau) if value["unit"] == "rad" else error
            if abs(error) > value["interval"]:
                missed.append(value["name"])
    return missed


def commission(rig: str, folder: Path, *options: str) -> int:
    """Run the command with poses that are drawn."""
    return main(["commission", SETUP, "--rig", rig, "--drawn-poses", "--output", str(folder), *options])


@pytest.fixture(scope="module")
def commissioned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a commissioning: a short needle, a coil reversed, cables exchanged, a camera turned."""
    folder = tmp_path_factory.mktemp("commissioned") / "rig"
    assert commission("random:1", folder) == 0
    return folder


def test_a_rig_that_nobody_described_is_measured_within_its_intervals(commissioned: Path, believed: Setup):
    summary = json.loads((commissioned / "summary.json").read_text())
    assert (summary["verdict"], summary["failures"]) == ("pass", [])
    rig = with_rig(believed, "random:1").rig
    truth = true_values(rig, believed, summary["values"][8]["value"])
    assert summary["values"][8]["name"] == "needle_length"
    assert len(outside(summary, truth)) <= 2  # of 15
    assert summary["rig_time"] < 90.0
    assert summary["largest_current"] <= 3.0
    assert summary["verification"]["square"] < 1e-3
    reversed_coil = int(np.argmin(rig.coil_gains))
    assert f"coil {reversed_coil} is wound the other way" in summary["findings"]
    assert "cables 0 and 3 are exchanged" in summary["findings"]
    kinds = {value["name"]: value["kind"] for value in summary["values"]}
    assert (kinds["needle_moment"], kinds["mean field_per_current"]) == ("gauge", "gauge")
    assert kinds["thread_drag"] == "assumed"
    changed = {value["name"] for value in summary["values"] if value["changed"]}
    assert {"needle_length", "coil_0 angle", "coil_3 angle"} <= changed


def test_the_setup_that_is_written_is_complete_and_knows_nothing_of_the_truth(commissioned: Path, believed: Setup):
    setup = read_setup(str(commissioned / "setup.yaml"))
    summary = json.loads((commissioned / "summary.json").read_text())
    values = {value["name"]: value["value"] for value in summary["values"]}
    for k, coil in enumerate(setup.coils.coils_properties()):
        assert coil.angle == pytest.approx(values[f"coil_{k} angle"], abs=1e-6)
        assert coil.field_per_current == pytest.approx(values[f"coil_{k} field_per_current"], rel=1e-6)
        assert coil.distance == pytest.approx(values["coil_distance"], rel=1e-6)
    assert setup.coils.needle_length == setup.vision.needle_length == pytest.approx(values["needle_length"], abs=1e-7)
    assert setup.coils.motion_delay == values["motion_delay"]
    before, after = believed.coils, setup.coils
    assert after.max_pull / before.max_pull == pytest.approx(after.thread_drag / before.thread_drag)
    assert setup.rig == believed.rig
    assert setup.model.material == believed.model.material


def test_there_is_a_bag_of_every_pulse_and_one_page_of_report(commissioned: Path):
    summary = json.loads((commissioned / "summary.json").read_text())
    bags = sorted((commissioned / PULSES).iterdir())
    assert len(bags) == summary["pulses"]
    assert Bag(bags[-1]).counts["/coils/currents"] == 2
    assert Bag(bags[-1]).counts["/needle/measured_cp"] > 20
    report = (commissioned / "report.pdf").read_bytes()
    assert report.startswith(b"%PDF")
    assert report.count(b"/Type /Page\n") + report.count(b"/Type /Page ") == 1


def test_the_same_pulses_give_the_same_again(commissioned: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    before = json.loads((commissioned / "summary.json").read_text())
    (commissioned / "summary.json").rename(tmp_path / "summary.json")
    try:
        assert commission("random:1", commissioned) == 0
        after = json.loads((commissioned / "summary.json").read_text())
    finally:
        (tmp_path / "summary.json").rename(commissioned / "summary.json")
    assert f"{before['pulses']} pulses were there" in capsys.readouterr().out
    for key in ("verdict", "findings", "pulses"):
        assert after[key] == before[key]
    for one, other in zip(after["values"], before["values"], strict=True):
        assert one["value"] == pytest.approx(other["value"], rel=1e-6, abs=1e-12)
    assert commission("random:1", commissioned) == 1
    assert commission("random:2", commissioned) == 1


def check(setup: Setup, believed: Setup, commissioned: Path) -> list[str]:
    """Return what a check finds of a rig."""
    bench = SimulatedBench(setup, drawn=True, seed=3)
    radius = believed.scene.dish.radius
    return Commissioning(bench, believed.coils, radius, lambda line: None).check(read_rig(commissioned, believed.coils))


@pytest.mark.parametrize("what", ["cables", "a coil at 0.8", "a turned camera", "another needle", "nothing"])
def test_a_check_tells_whether_the_rig_is_still_the_one(what: str, commissioned: Path, believed: Setup):
    setup = with_rig(believed, "random:1")
    rig = setup.rig
    angles, gains = [*rig.coil_angles], [*rig.coil_gains]
    exchanged = {"coil_angles": (*angles[:2], angles[3], angles[2]), "coil_gains": (*gains[:2], gains[3], gains[2])}
    changes: dict[str, dict[str, Any]] = {
        "cables": exchanged,
        "a coil at 0.8": {"coil_gains": (*gains[:3], 0.8 * gains[3])},
        "a turned camera": {"camera_rotation": rig.camera_rotation + 0.2},
        "another needle": {"needle_length": 1.2 * rig.needle_length},
        "nothing": {"seed": 9},
    }
    true = replace(setup, rig=replace(rig, **changes[what])).with_scene(setup.scene)
    found = check(true, believed, commissioned)
    coils = {words.split()[1] for words in found}
    expected = {"cables": {"2", "3"}, "a coil at 0.8": {"3"}, "nothing": set[str]()}
    assert coils == expected[what] if what in expected else coils


def test_the_command_checks_the_rig(commissioned: Path, capsys: pytest.CaptureFixture[str]):
    assert commission("random:1", commissioned, "--check") == 0
    assert "the rig is still the one that was measured" in capsys.readouterr().out
    assert commission("random:2", commissioned, "--check") == 1
    assert main(["commission", SETUP, "--check", "--drawn-poses", "--output", str(commissioned / "nowhere")]) == 2


class Interrupted(SimulatedBench):
    """A bench at which somebody presses Ctrl-C in the middle of a pulse."""

    left = 12

    def _drive(self, currents: np.ndarray, seconds: float, guard: MotionGuard | None = None) -> str:
        self.left -= bool(np.any(currents))
        if not self.left:
            super()._drive(currents, 0.5 * seconds, guard)
            raise KeyboardInterrupt
        return super()._drive(currents, seconds, guard)


def test_an_interrupt_ends_the_currents_and_the_next_run_goes_on(believed: Setup, tmp_path: Path):
    setup = with_rig(believed, "random:3")
    bench = Interrupted(setup, drawn=True)
    with pytest.raises(KeyboardInterrupt):
        run(RecordedBench(bench, tmp_path, {}), believed)
    rig: Rig = bench._rig
    assert rig.currents.any() or rig._commands  # they were on, and zeros are on their way
    rig.advance(rig.time + 0.09)
    assert not rig.currents.any()
    again = RecordedBench(SimulatedBench(setup, drawn=True, seed=4), tmp_path, {})
    result = run(again, believed)
    assert again.reused == 12  # the rest, and eleven of the ladder
    assert not result.failures


def run(bench: Any, believed: Setup) -> Commissioned:
    """Commission a bench."""
    return Commissioning(bench, believed.coils, believed.scene.dish.radius, lambda line: None).run()


def changed(believed: Setup, **changes: Any) -> Setup:
    """Return a setup with another true rig."""
    return replace(believed, rig=replace(believed.rig, **changes)).with_scene(believed.scene)


def test_a_coil_that_is_not_connected_is_named(believed: Setup):
    result = run(SimulatedBench(changed(believed, coil_gains=(1.0, 0.0, 1.0, 1.0)), drawn=True), believed)
    assert result.failures == ("coil 1 does not answer: it is not connected",)
    assert [answer.moved for answer in result.answers] == [True, False, True, True]


def test_a_needle_that_nothing_moves_is_named(believed: Setup):
    result = run(SimulatedBench(changed(believed, viscosity=100.0), drawn=True), believed)
    assert result.failures == ("no coil moves the needle: it is stuck, or the boards are not connected",)


def test_a_camera_that_stops_ends_it_by_name(believed: Setup):
    bench = SimulatedBench(changed(believed, faults=("camera_stopped 6 1000",)), drawn=True)
    with pytest.raises(InvalidInputError, match="no frames come"):
        run(bench, believed)
    assert not bench._rig.currents.any()


class LooseContact(SimulatedBench):
    """A bench on which coil 2 gets half of its current in every third pulse."""

    count = 0

    def pulse(self, currents: np.ndarray, seconds: float) -> Pulse:
        """Give a pulse."""
        self.count += 1
        given = currents * np.where(np.arange(4) == 2, 0.5 if self.count % 3 == 0 else 1.0, 1.0)
        return replace(super().pulse(given, seconds), currents=currents.copy())


def test_what_no_model_explains_is_refused(believed: Setup):
    result = run(LooseContact(believed, drawn=True), believed)
    assert result.failures
    assert "of the displacement" in result.failures[0] or "heading" in result.failures[0]


def test_a_square_with_a_wrong_setup_is_no_square(believed: Setup):
    bench = SimulatedBench(changed(believed, coil_gains=(1.0, -1.0, 1.0, 1.0)), drawn=True)
    apart, problem = bench.follow_square(believed.coils)
    assert apart > 1e-3
    assert problem.startswith("needle does not follow")
    apart, problem = SimulatedBench(believed, drawn=True).follow_square(believed.coils)
    assert problem == ""
    assert apart < 5e-4


def test_a_delay_that_the_bridge_is_told_keeps_the_needle_on_its_square(believed: Setup):
    late = changed(believed, current_delay=0.1)
    _, problem = SimulatedBench(late, drawn=True).follow_square(believed.coils)
    assert problem.startswith("needle does not follow")
    apart, problem = SimulatedBench(late, drawn=True).follow_square(replace(believed.coils, motion_delay=0.1))
    assert problem == ""
    assert apart < 5e-4


@pytest.mark.parametrize(
    ("angles", "signs", "expected"),
    [
        ([0.0, 1.57, 3.14, -1.57], [1, 1, 1, 1], []),
        ([0.1, 1.5, 3.2, -1.7], [1, 1, -1, 1], ["coil 2 is wound the other way"]),
        ([0.7, 2.3, 3.9, 5.4], [1, 1, 1, 1], ["the camera is turned by 41 degrees against the coils"]),
        ([1.57, 0.0, 3.14, -1.57], [1, 1, 1, 1], ["cables 0 and 1 are exchanged"]),
        (
            [0.0, 1.57, 3.14, -1.57],
            [-1, -1, 1, -1],
            ["the needle is magnetised the other way", "coil 2 is wound the other way"],
        ),
    ],
)
def test_what_is_wrong_is_said_in_the_words_of_the_bench(angles: list[float], signs: list[int], expected: list[str]):
    assert find_wiring(CoilBridgeSettings(), np.array(angles), np.array(signs, dtype=float)) == expected


def test_a_mirror_image_is_told_from_exchanged_cables_where_the_coils_tell():
    lopsided = CoilBridgeSettings(coil_angles=(0.0, 1.0, 2.5, 4.4, 5.2))
    angles = np.array([0.3 - angle for angle in lopsided.coil_angles])
    assert find_wiring(lopsided, angles, np.ones(5))[0] == "the camera shows a mirror image"
    square = CoilBridgeSettings()  # of four coils in a square, a mirror image is an exchange of two
    (words, *_) = find_wiring(square, np.array([0.0, -1.57, 3.14, 1.57]), np.ones(4))
    assert "cables 1 and 3 are exchanged" in words
    assert "the camera shows a mirror image" in words


def test_the_length_of_a_needle_is_measured_whatever_the_setup_says(believed: Setup):
    length, scene = 3.2e-3, Scene(believed.scene.dish)
    rig = Rig(replace(believed.rig, needle_length=length, needle_start=(0.001, 0.002, 0.5)), scene)
    images = [frame.image for k in range(16) if (frame := rig.look(k / 60)).image is not None]
    assert find_needle_length(images, believed.vision, scene) == pytest.approx(length, rel=0.02)
    empty = [np.full_like(images[0], 200)] * 3
    with pytest.raises(InvalidInputError):
        find_needle_length(empty, believed.vision, scene)


@pytest.mark.parametrize("seed", [2, 7])
def test_a_rig_is_measured_by_rendered_frames_and_the_tracker(seed: int, believed: Setup, tmp_path: Path):
    folder = tmp_path / "rig"
    assert main(["commission", SETUP, "--rig", f"random:{seed}", "--output", str(folder)]) == 0
    summary = json.loads((folder / "summary.json").read_text())
    truth = true_values(with_rig(believed, f"random:{seed}").rig, believed, summary["values"][8]["value"])
    assert len(outside(summary, truth)) <= 2
    assert summary["verification"]["square"] < 1e-3
