"""The thread of a commissioned rig: its drag by the balance of forces, its parameters, and the verdict."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.calibration.parameters import stiffness_over_drag
from magnetosuture_thread.calibration.simulated_thread import SimulatedThreadBench
from magnetosuture_thread.calibration.square import TipPath, pulls
from magnetosuture_thread.calibration.thread_drag import Pulls, measure_drag
from magnetosuture_thread.calibration.thread_report import write_thread
from magnetosuture_thread.calibration.thread_step import (
    BARE_DRAG,
    RUNS,
    ThreadCommissioning,
    drag_failures,
    read_commissioned,
)
from magnetosuture_thread.cli import main
from magnetosuture_thread.commands.evaluate import evaluate_bags
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.rig.dynamics import NeedleBody
from magnetosuture_thread.rig.settings import RigSettings
from magnetosuture_thread.rig.setups import Setup, read_setup
from magnetosuture_thread.rig.truth import with_rig
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.errors import ConfigurationError
from magnetosuture_thread.settings.files import find_file
from test.calibration.test_commission import SETUP, commission, true_values

OWN, ALONG, ACROSS = 0.019, 0.011, 0.022  # N s/m


def some_pulls(own: float = OWN, strength: float = 1.0, noise: float = 2e-7) -> Pulls:
    """Return pulls of a thread in all shapes, with coils that are stronger than believed and noise alike in a pull."""
    random, count, each = np.random.default_rng(5), 8, 60
    index = np.repeat(np.arange(count), each)
    speed = 2e-3 * (1.0 + 0.1 * random.standard_normal(count * each))
    thread = speed[:, None] * random.uniform(-1.0, 1.0, (count, 2))[index]
    force = (own * speed + thread @ [ALONG, ACROSS]) / strength + noise * random.standard_normal(count)[index]
    return Pulls(force, speed, thread, index)


def test_the_balance_of_forces_tells_the_drags_of_a_thread_in_any_shape():
    drag = measure_drag(some_pulls(), (OWN, 2e-4))
    for (value, interval), truth in (
        (drag.along, ALONG),
        (drag.across, ACROSS),
        (drag.total, OWN + ALONG),
    ):
        assert abs(value - truth) < interval
        assert interval < 0.1 * truth
    assert drag.needle == pytest.approx(OWN, rel=0.05)
    assert drag.pulls == 8


def test_what_all_coils_are_wrong_by_is_within_the_interval():
    drag = measure_drag(some_pulls(strength=1.05), (OWN / 1.05, 0.05 * OWN))  # as the bare needle's drag shows it
    assert abs(drag.along[0] - ALONG) < drag.along[1]
    assert drag.along[1] > 0.05 * ALONG
    pulls = some_pulls(strength=1.05)
    pulls.thread[:, 0] = pulls.speed * np.linspace(0.5, 0.95, 8)[pulls.index]  # nearly straight behind the needle
    force = (OWN * pulls.speed + pulls.thread @ [ALONG, ACROSS]) / 1.05
    total = measure_drag(replace(pulls, force=force), (OWN / 1.05, 0.05 * OWN)).total
    assert abs(total[0] - OWN - ALONG) < total[1]


def test_another_needle_and_a_drag_that_is_hardly_known_are_refused():
    other = measure_drag(some_pulls(own=1.5 * OWN), (OWN, 2e-4))
    assert other.needle == pytest.approx(1.5 * OWN, rel=0.05)
    assert "another needle, or liquid" in drag_failures(other, OWN)[-1]
    assert drag_failures(measure_drag(some_pulls(), (OWN, 2e-4)), OWN) == []
    (words,) = drag_failures(measure_drag(some_pulls(), (OWN, 0.5 * OWN)), OWN)
    assert "25% allowed" in words


def test_routes_of_pulls_stay_off_the_wall_and_the_way_out_of_the_first_pose_is_gentle():
    radius = 0.0175
    for left in (True, False):
        routes = pulls(radius, 3, left=left)
        assert max(float(np.hypot(*route.T).max()) for route in routes) < 0.75 * radius
        path = TipPath(0.006, *routes)
        velocities = [path.command(0.02 * k, np.array([2e-5 * k, 0.0, 0.0]), 0.0) for k in range(20)]
        assert all(velocity[0] >= 0.0 for velocity in velocities)  # ahead, and not back over the thread


class StuckBench:
    """A bench on which the needle follows no path."""

    def follow(self, path: TipPath, setup: Setup, bag: Path) -> tuple[float, str]:
        """Record nothing."""
        bag.mkdir()
        return math.inf, "needle does not follow"


def write_commissioned(folder: Path, verdict: str) -> None:
    """Write what a commissioning would leave."""
    shutil.copy(find_file("setup", SETUP), folder / "setup.yaml")
    values = [{"name": BARE_DRAG, "value": OWN, "interval": 2e-4}]
    how = {"setup": SETUP, "simulated": True, "poses": "none", "rig": SETUP}
    summary: dict[str, Any] = {"verdict": verdict, **how, "values": values}
    (folder / "summary.json").write_text(json.dumps(summary))


def test_a_needle_that_does_not_follow_gives_a_page_and_no_setup(tmp_path: Path):
    write_commissioned(tmp_path, "pass")
    before = (tmp_path / "setup.yaml").read_bytes()
    result = ThreadCommissioning(tmp_path, StuckBench(), lambda line: None).run()
    write_thread(tmp_path, result, read_commissioned(tmp_path)[0], "2026-01-01")
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["verdict"] == "pass"  # of the bare needle
    assert summary["thread"]["verdict"] == "refused"
    assert summary["thread"]["failures"] == ["fitted: needle does not follow"]
    assert (tmp_path / "thread.pdf").read_bytes().startswith(b"%PDF")
    assert (tmp_path / "setup.yaml").read_bytes() == before
    assert not (tmp_path / "thread.yaml").exists()


def test_a_run_that_is_refused_after_one_that_passed_leaves_what_that_found(tmp_path: Path):
    write_commissioned(tmp_path, "pass")
    path = tmp_path / "summary.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"thread": {"verdict": "pass", "values": [1]}}))
    result = ThreadCommissioning(tmp_path, StuckBench(), lambda line: None).run()
    part = write_thread(tmp_path, result, read_commissioned(tmp_path)[0], "2026-01-01")
    summary = json.loads(path.read_text())
    assert summary["thread"] == {"verdict": "pass", "values": [1]}
    assert summary["thread_refused"]["failures"] == ["fitted: needle does not follow"]
    assert part["page"] == "thread_refused.pdf"
    assert not (tmp_path / "thread.pdf").exists()


@pytest.mark.parametrize("name", ["hernia_ring", "petri_35mm_polyamide_post", "petri_150mm_silk"])
def test_a_thread_is_driven_in_the_empty_dish_of_every_setup(name: str, tmp_path: Path):
    setup = read_setup(name)
    empty = setup.with_scene(Scene(setup.scene.dish))

    class Ended(TipPath):
        """A path that is over at its first pose."""

        @property
        def done(self) -> bool:
            """Whether there was one."""
            return bool(self._tips)

    path = Ended(setup.coils.needle_length, np.array([[1e-3, 0.0], [2e-3, 0.0]]))
    SimulatedThreadBench(setup, drawn=True).follow(path, empty, tmp_path / "run")
    assert Bag(tmp_path / "run").damage is None


def test_a_commissioning_that_was_refused_has_no_thread(tmp_path: Path):
    write_commissioned(tmp_path, "refused")
    with pytest.raises(ConfigurationError, match="commission the bare needle first"):
        read_commissioned(tmp_path)
    assert main(["commission-thread", str(tmp_path)]) == 2


@pytest.mark.slow
def test_rendered_frames_are_tracked_and_not_kept(tmp_path: Path):
    setup = read_setup(SETUP)
    way = np.array([[0.011, -0.004], [0.013, -0.003]])
    bench = SimulatedThreadBench(setup)
    apart, problem = bench.follow(TipPath(setup.coils.needle_length, way), setup, tmp_path / "run")
    assert problem == ""
    assert apart < 1e-3
    counts = Bag(tmp_path / "run").counts
    assert interface.COMPRESSED_IMAGE.recorded not in counts
    frames = counts[interface.GROUND_TRUTH_NEEDLE.recorded]
    for channel in (interface.NEEDLE_POSE, interface.MEASURED_THREAD):
        assert 0.9 * frames < counts[channel.recorded] <= frames


@pytest.fixture(scope="module", params=[3])
def threaded(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, RigSettings]:
    """Return the folder of a commissioning with its thread, and the true rig."""
    name = f"random:{request.param}"
    folder = tmp_path_factory.mktemp("threaded") / "rig"
    assert commission(name, folder) == 0
    assert main(["commission-thread", str(folder)]) == 0
    return folder, with_rig(read_setup(SETUP), name).rig


@pytest.mark.slow
def test_a_thread_is_measured_within_its_intervals(threaded: tuple[Path, RigSettings]):
    folder, rig = threaded
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["thread"]["verdict"] == "pass"
    values = {value["name"]: value for value in summary["thread"]["values"]}
    believed = read_setup(SETUP)
    length = next(value["value"] for value in summary["values"] if value["name"] == "needle_length")
    bare = true_values(rig, believed, length)[BARE_DRAG]
    # In the gauge of the mean field and moment, in which the bare needle's drag is.
    share = bare / true_drag(rig)
    truth = {
        "thread_drag": share * rig.thread_drag_along * rig.thread_length,
        "thread_drag across": share * rig.thread_drag_across * rig.thread_length,
        "stiffness over drag": rig.thread_bending_stiffness / rig.thread_drag_across,
        "drag anisotropy": rig.thread_drag_along / rig.thread_drag_across,
        "rest curvature": 0.0,
    }
    truth["needle_drag"] = bare + truth["thread_drag"]
    for name, true in truth.items():
        assert abs(values[name]["value"] - true) < values[name]["interval"], name
    assert summary["thread"]["own_drag_by_pulls"] == pytest.approx(bare, rel=0.1)
    for name in ("thread_drag", "needle_drag", "stiffness over drag"):
        assert values[name]["kind"] == "measured"
        assert values[name]["interval"] < 0.1 * values[name]["value"]
    drag = next(value for value in summary["values"] if value["name"] == "thread_drag")
    assert (drag["kind"], drag["value"]) == ("measured", values["thread_drag"]["value"])


def true_drag(rig: RigSettings) -> float:
    """Return the bare needle's drag along its body in SI."""
    body = NeedleBody(rig.needle_length, rig.needle_width, 0.0, abs(rig.needle_magnetisation), rig.viscosity)
    return body.drag[0]


@pytest.mark.slow
def test_the_setup_has_what_was_measured_and_predicts_the_true_thread(threaded: tuple[Path, RigSettings]):
    folder, _ = threaded
    part = json.loads((folder / "summary.json").read_text())["thread"]
    values = {value["name"]: value["value"] for value in part["values"]}
    setup = read_setup(str(folder / "setup.yaml"))
    assert setup.coils.thread_drag == pytest.approx(values["thread_drag"])
    assert setup.coils.needle_drag == pytest.approx(values["needle_drag"])
    assert stiffness_over_drag(setup.model) == pytest.approx(values["stiffness over drag"], rel=1e-4)
    assert (folder / "thread.pdf").read_bytes().count(b"/Type /Page ") == 1
    (row,) = evaluate_bags([folder / part["bags"]["predicted"]], against="truth", setup_name=str(setup.path))
    assert row["problem"] == ""
    errors: Any = row["prediction"]
    assert errors["error_ground_truth_mean_percent"] < 0.5
    assert errors["error_ground_truth_max_percent"] < 2.0


@pytest.mark.slow
def test_the_true_tip_is_at_each_corner_of_the_square(threaded: tuple[Path, RigSettings]):
    folder, rig = threaded
    part = json.loads((folder / "summary.json").read_text())["thread"]
    assert part["square"] < 1e-3
    tips = []
    for record in Bag(folder / part["bags"]["square"]).records({interface.GROUND_TRUTH_NEEDLE.recorded}):
        pose = record.decode().pose
        angle = 2.0 * math.atan2(pose.orientation.z, pose.orientation.w)
        tips.append([pose.position.x + rig.needle_length * math.cos(angle), 0.0])
        tips[-1][1] = pose.position.y + rig.needle_length * math.sin(angle)
    for corner in 4e-3 * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]]):
        assert np.hypot(*(np.array(tips) - corner).T).min() < 1e-3
    assert (folder / RUNS / "000").is_dir()
