"""The job and the command `calibrate`: from bags to a file that thread_model loads."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.page import running
from magnetosuture_thread import cli
from magnetosuture_thread.calibration.bags import calibrate_bags
from magnetosuture_thread.calibration.parameters import stiffness_over_drag
from magnetosuture_thread.commands.render import render_bag
from magnetosuture_thread.evaluation.reference import ReferenceTrajectory
from magnetosuture_thread.rig.setups import read_setup
from magnetosuture_thread.settings.errors import InvalidInputError
from test.bags.bags import copy_with_notes
from test.calibration.runs import LENGTH, rig_run

TRUE = 1.6e-9  # m^4/s; the material's is 1.3e-9
SETUP = """\
/**:
  ros__parameters:
    scene: dish_150mm
    thread_length: 0.019

/**/thread_model:
  ros__parameters:
    material: polyamide_7_0
    segments: 12
    attachment: pinned
    max_step: 0.07
"""
ONE = ("--parameters", "elastic_modulus")


def trajectory(phase: float = 0.0, ratio: float = TRUE) -> ReferenceTrajectory:
    """Return a run of the rig's rod, of a stiffness over drag, as a reference trajectory."""
    sights = rig_run(ratio, phase=phase)
    headings = np.unwrap([math.atan2(sight.heading[1], sight.heading[0]) for sight in sights])
    times = np.array([(sight.stamp - sights[0].stamp) * 1e-9 for sight in sights])
    tails, threads = (np.array([getattr(sight, name) for sight in sights]) for name in ("tail", "ground_truth"))
    return ReferenceTrajectory("rig", times, tails, headings, threads, (), {"material": {"L_m": LENGTH}})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a setup and two bags of poses with noise."""
    folder = tmp_path_factory.mktemp("calibrate")
    setup = folder / "lab.yaml"
    setup.write_text(SETUP)
    for name, phase in (("one", 0.0), ("two", 1.5)):
        render_bag(trajectory(phase), read_setup(str(setup)), folder / name, rate=15.0, pose_noise=2e-5)
    return folder


def run(folder: Path, *arguments: str) -> int:
    """Run the command, in this process unless it is given workers: each takes seconds to start."""
    workers = () if "--workers" in arguments else ("--workers", "1")
    return cli.main(["calibrate", *arguments, *workers, "--setup", str(folder / "lab.yaml")])


@pytest.mark.slow
def test_bags_give_a_file_a_picture_and_figures_whatever_the_workers(folder: Path, tmp_path: Path, capsys):
    copy_with_notes(folder / "two", folder / "doubtful", unverified="salvaged without checksums")
    texts = []
    for workers in ("1", "2"):
        output, figures = tmp_path / f"{workers}.yaml", tmp_path / f"{workers}.json"
        bags = [str(folder / name) for name in ("one", "doubtful")]
        given = ["--material", "poly", "--output", str(output), "--workers", workers, "--json", str(figures)]
        code = run(folder, *bags, *ONE, *given)
        assert code == 0
        texts.append((output.read_bytes(), figures.read_bytes(), output.with_suffix(".png").read_bytes()))
    assert texts[0] == texts[1]
    shown = capsys.readouterr().out
    assert "stiffness over drag" in shown
    assert "simulated: " in shown
    assert "is unverified: salvaged without checksums" in " ".join(shown.split())
    assert b"UNVERIFIED: salvaged without checksums" in texts[0][0]
    values = json.loads(texts[0][1])
    assert values["finished"]
    assert values["parameters"][0]["value"] == pytest.approx(TRUE, rel=0.05)
    assert [row["unverified"] for row in values["bags"]] == ["", "salvaged without checksums"]
    for row in values["bags"]:
        assert row["truth_held_out"] < 0.5 < row["truth_before"]
    settings = read_setup(str(tmp_path / "1.yaml")).model
    assert stiffness_over_drag(settings) == pytest.approx(TRUE, rel=0.05)
    assert settings.attachment == "pinned"


def test_a_picture_that_fails_costs_no_fit(folder: Path, tmp_path: Path, monkeypatch, capsys):
    def fail(*given: object) -> None:
        raise RuntimeError("no font")

    monkeypatch.setattr("magnetosuture_thread.calibration.plot.draw_calibration", fail)
    assert run(folder, str(folder / "one"), *ONE, "--output", str(tmp_path / "found.yaml")) == 0
    assert "no picture: RuntimeError: no font" in capsys.readouterr().out
    assert [path.name for path in tmp_path.iterdir()] == ["found.yaml"]


def test_ctrl_c_leaves_the_best_so_far(folder: Path, tmp_path: Path):
    output = tmp_path / "best.yaml"
    options = ("--setup", folder / "lab.yaml", "--output", output, "--workers", "1")
    with running("calibrate", folder / "one", *options) as command:
        command.find("(^tried)")
        assert (command.end(), command.errors.read_text()) == (130, "")
        assert "interrupted; writing the best so far" in command.output.read_text()
    assert output.read_text().startswith("# BEST SO FAR, NOT FINISHED")
    assert stiffness_over_drag(read_setup(str(output)).model) == pytest.approx(TRUE, rel=0.2)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["best.png", "best.yaml"]


def test_bags_of_different_threads_are_refused(folder: Path, tmp_path: Path):
    setup = read_setup("petri_150mm_silk")
    still = replace(trajectory(), metadata={})
    render_bag(still, setup, tmp_path / "silk", rate=15.0, pose_noise=0.0)
    render_bag(still, read_setup("petri_35mm_polyamide"), tmp_path / "polyamide", rate=15.0, pose_noise=0.0)
    own = str(folder / "lab.yaml")
    with pytest.raises(
        InvalidInputError, match="silk: got a thread with material silk_6_0, expected polyamide_7_0, as"
    ):
        calibrate_bags([tmp_path / "polyamide", tmp_path / "silk"], tmp_path / "found.yaml", setup_name=own)
