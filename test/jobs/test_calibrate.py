"""The job and the command `calibrate`: from bags to a file that thread_model loads."""

from __future__ import annotations

import json
import math
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magnetosuture_thread import cli
from magnetosuture_thread.calibration.parameters import stiffness_over_drag
from magnetosuture_thread.errors import BagError, ConfigurationError, InvalidInputError
from magnetosuture_thread.evaluation.reference import ReferenceTrajectory
from magnetosuture_thread.jobs import calibrate_fleet as fleet_job
from magnetosuture_thread.jobs.calibrate import calibrate_bags, material_named, settings_of
from magnetosuture_thread.jobs.render import render_bag
from magnetosuture_thread.setups import read_setup
from magnetosuture_thread.workers import WorkerDiedError
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
        render_bag(trajectory(phase), read_setup(str(setup)), folder / name, rate=15.0, poses=True, noise=2e-5)
    return folder


def run(folder: Path, *arguments: str) -> int:
    """Run the command, in this process unless it is given workers: each takes seconds to start."""
    workers = () if "--workers" in arguments else ("--workers", "1")
    return cli.main(["calibrate", *arguments, *workers, "--setup", str(folder / "lab.yaml")])


def test_bags_give_a_file_a_picture_and_figures_whatever_the_workers(folder: Path, tmp_path: Path, capsys):
    texts = []
    for workers in ("1", "2"):
        output, figures = tmp_path / f"{workers}.yaml", tmp_path / f"{workers}.json"
        bags = [str(folder / name) for name in ("one", "two")]
        code = run(
            folder,
            *bags,
            *ONE,
            "--material",
            "poly",
            "--output",
            str(output),
            "--workers",
            workers,
            "--json",
            str(figures),
        )
        assert code == 0
        texts.append((output.read_bytes(), figures.read_bytes(), output.with_suffix(".png").read_bytes()))
    assert texts[0] == texts[1]
    shown = capsys.readouterr().out
    assert "stiffness over drag" in shown
    assert "simulated: " in shown
    values = json.loads(texts[0][1])
    assert values["finished"]
    assert values["parameters"][0]["value"] == pytest.approx(TRUE, rel=0.05)
    assert [row["truth_held_out"] < 0.5 for row in values["bags"]] == [True, True]
    settings = read_setup(str(tmp_path / "1.yaml")).model
    assert stiffness_over_drag(settings) == pytest.approx(TRUE, rel=0.05)
    assert settings.attachment == "pinned"
    assert {path.name for path in tmp_path.iterdir()} == {
        f"{n}.{end}" for n in (1, 2) for end in ("yaml", "json", "png")
    }


def test_an_unverified_bag_says_so_in_file_figures_and_text(folder: Path, tmp_path: Path, capsys):
    copy_with_notes(folder / "one", tmp_path / "bag", unverified="salvaged without checksums")
    output, figures = tmp_path / "found.yaml", tmp_path / "found.json"
    assert run(folder, str(tmp_path / "bag"), *ONE, "--output", str(output), "--json", str(figures)) == 0
    assert "UNVERIFIED: salvaged without checksums" in output.read_text()
    found = json.loads(figures.read_text())
    assert [row["unverified"] for row in found["bags"]] == ["salvaged without checksums"]
    assert "is unverified: salvaged without checksums" in " ".join(capsys.readouterr().out.split())


def test_ctrl_c_leaves_the_best_so_far(folder: Path, tmp_path: Path):
    output = tmp_path / "best.yaml"
    command = [sys.executable, "-m", "magnetosuture_thread.cli", "calibrate", str(folder / "one")]
    command += ["--setup", str(folder / "lab.yaml"), "--output", str(output), "--workers", "2"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        for line in process.stdout:
            if line.startswith("tried"):
                process.send_signal(signal.SIGINT)
                break
        rest, errors = process.communicate(timeout=120)
    assert (process.returncode, errors) == (130, "")
    assert "interrupted; writing the best so far" in rest
    assert output.read_text().startswith("# BEST SO FAR, NOT FINISHED")
    assert stiffness_over_drag(read_setup(str(output)).model) == pytest.approx(TRUE, rel=0.2)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["best.png", "best.yaml"]


def test_ctrl_c_before_anything_is_known_leaves_nothing(folder: Path, tmp_path: Path, monkeypatch, capsys):
    def stop(*given: object, **more: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("magnetosuture_thread.jobs.calibrate.fit", stop)
    assert run(folder, str(folder / "one"), "--output", str(tmp_path / "none.yaml")) == 1
    assert "interrupted" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["nowhere"], 1, "nowhere: does not exist"),
        (["one", "--parameters", "elastic_module"], 2, "did you mean elastic_modulus"),
        (["one", "--material", "steel"], 2, "material: got 'steel', expected one of polyamide_7_0, silk_6_0"),
        (["one", "--against", "truth", "--remap", "/ground_truth/thread:=/elsewhere"], 1, "holds no ground truth"),
        (["one", "--source", "camera"], 1, "camera/image_raw"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(
    folder: Path, tmp_path: Path, capsys, arguments: list[str], code: int, words: str
):
    name, *more = arguments
    assert run(folder, str(folder / name), *more, "--output", str(tmp_path / "found.yaml")) == code
    errors = " ".join(capsys.readouterr().err.split())
    assert errors.startswith("error: ")
    assert words in errors
    assert list(tmp_path.iterdir()) == []


def test_bags_of_different_threads_are_refused(folder: Path, tmp_path: Path):
    setup = read_setup("petri_150mm_silk")
    still = replace(trajectory(), metadata={})
    render_bag(still, setup, tmp_path / "silk", rate=15.0, poses=True)
    render_bag(still, read_setup("petri_35mm_polyamide"), tmp_path / "polyamide", rate=15.0, poses=True)
    own = str(folder / "lab.yaml")
    with pytest.raises(
        InvalidInputError, match="silk: got a thread with material silk_6_0, expected polyamide_7_0, as"
    ):
        calibrate_bags([tmp_path / "polyamide", tmp_path / "silk"], tmp_path / "found.yaml", setup_name=own)


def test_a_bag_of_another_length_is_refused(folder: Path, tmp_path: Path):
    setup = tmp_path / "long.yaml"
    setup.write_text(SETUP.replace("0.019", "0.15"))
    with pytest.raises(BagError, match="is it another thread"):
        calibrate_bags([folder / "one"], tmp_path / "found.yaml", setup_name=str(setup))


def test_a_material_is_told_by_how_it_begins():
    assert material_named("silk") == "silk_6_0"
    assert material_named("polyamide_7_0") == "polyamide_7_0"
    for text in ("", "steel"):
        with pytest.raises(ConfigurationError, match="or how it begins"):
            material_named(text)


def test_another_material_comes_with_its_own_numbers():
    setup = read_setup("petri_35mm_polyamide")
    own = replace(setup, model=replace(setup.model, elastic_modulus=3e9, diameter=7e-5))
    assert settings_of(own, "polyamide", "") == own.model
    silk = settings_of(own, "silk", "paper")
    assert (silk.material, silk.elastic_modulus, silk.diameter, silk.formulation) == ("silk_6_0", 0.0, 0.0, "paper")


def fleet_bags(folder: Path, factors: tuple[float, ...]) -> list[str]:
    """Render bags of one thread in liquids of different viscosity, over the mean; return their paths."""
    (folder / "lab.yaml").write_text(SETUP)
    paths = []
    for index, factor in enumerate(factors):
        paths.append(str(folder / f"bag_{index}"))
        run_of = trajectory(0.4 * index, TRUE / factor)
        setup = read_setup(str(folder / "lab.yaml"))
        render_bag(run_of, setup, Path(paths[-1]), rate=15.0, poses=True, noise=2e-5, seed=index)
    return paths


def test_a_fleet_shares_its_stiffness_and_each_bag_has_its_viscosity(tmp_path: Path):
    factors = (0.8, 1.0, 1.25, 0.9)
    bags = fleet_bags(tmp_path, factors)
    texts = []
    for workers in ("1", "2"):
        output, figures = tmp_path / f"{workers}.yaml", tmp_path / f"{workers}.json"
        options = ("--fleet", *ONE, "--workers", workers, "--output", str(output), "--json", str(figures))
        assert run(tmp_path, *bags, *options) == 0
        texts.append((output.read_bytes(), figures.read_bytes()))
    assert texts[0] == texts[1]
    found = json.loads(texts[0][1])
    mean = TRUE / math.exp(float(np.mean(np.log(factors))))
    shared = found["stiffness_over_drag"]
    assert shared["low"] < mean < shared["high"]
    assert shared["value"] == pytest.approx(mean, rel=0.05)
    relative = [factor * mean / TRUE for factor in factors]
    for bag, true in zip(found["bags"], relative, strict=True):
        value, low, high = bag["viscosity"]
        assert low < true < high
        assert value == pytest.approx(true, rel=0.06)
    text = texts[0][0].decode()
    assert "viscosities scatter by" in text.lower()
    both = read_setup(str(tmp_path / "lab.yaml")).model
    modulus = float(text.split("elastic_modulus: ")[1].split()[0])
    assert stiffness_over_drag(replace(both, elastic_modulus=modulus)) == pytest.approx(shared["value"], rel=1e-4)


def test_a_fleet_goes_on_without_a_bag_that_cannot_be_read_or_ends_its_worker(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
):
    first, *others = fleet_bags(tmp_path, (0.8, 1.0, 1.25))
    broken, fatal = tmp_path / "broken.mcap", tmp_path / "fatal"
    broken.write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    fit_bag = fleet_job._fit_bag

    def ended_by_one(*given: Any) -> Any:
        return WorkerDiedError("its process ended with -9") if fatal in given else fit_bag(*given)

    monkeypatch.setattr(fleet_job, "_fit_bag", ended_by_one)
    output, figures = tmp_path / "found.yaml", tmp_path / "found.json"
    bags = [first, str(broken), *others, str(fatal)]
    assert run(tmp_path, *bags, "--fleet", *ONE, "--output", str(output), "--json", str(figures)) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "is left out: its process ended with -9" in shown
    found = json.loads(figures.read_text())["bags"]
    assert [bag["name"] for bag in found] == bags
    assert [bag["viscosity"] is None for bag in found] == [False, True, False, False, True]
    assert "nothing intact" in found[1]["reason"]
    assert (found[4]["reason"], found[4]["error"]) == ("its process ended with -9", None)
    text = " ".join(line.strip("# ") for line in output.read_text().splitlines())
    assert f"{fatal}: not used: its process ended with -9." in text


def test_a_fleet_of_which_too_few_bags_are_left_names_the_others(folder: Path, tmp_path: Path, capsys):
    broken = [tmp_path / "broken.mcap", tmp_path / "nowhere.mcap"]
    broken[0].write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    output = tmp_path / "x.yaml"
    bags = [*broken, folder / "one", folder / "two"]
    assert run(folder, *map(str, bags), *ONE, "--fleet", "--output", str(output), "--workers", "2") == 1
    shown = capsys.readouterr().err
    assert "2 that tell the stiffness over drag, expected at least 3: " in shown
    assert f"{broken[0]}: " in shown
    assert f"{broken[1]}: does not exist" in shown
    assert not output.exists()


def test_a_fleet_of_too_few_bags_or_without_what_they_share_is_refused(folder: Path, tmp_path: Path, capsys):
    bags = [str(folder / name) for name in ("one", "two")]
    output = ("--fleet", "--output", str(tmp_path / "x.yaml"))
    assert run(folder, *bags, *ONE, *output) == 1
    assert "2 that tell the stiffness over drag, expected at least 3" in capsys.readouterr().err
    assert run(folder, *bags, *output, "--parameters", "drag_anisotropy") == 2
    assert "elastic_modulus among them" in capsys.readouterr().err
    assert not (tmp_path / "x.yaml").exists()
