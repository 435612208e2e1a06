"""The rig simulator in a graph."""

from __future__ import annotations

import threading
import time
from concurrent.futures import wait

import cv2
import numpy as np
import pytest
from magnetosuture_msgs.msg import CoilCurrents
from std_msgs.msg import String
from std_srvs.srv import SetBool

from magnetosuture_thread.coils.drivers.roboclaw import RoboClawDriver
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.errors import ConfigurationError, SolverError
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.interface import PAUSE_RIG
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.messages import MESSAGES
from magnetosuture_thread.nodes.player import Timeline
from magnetosuture_thread.nodes.rig_simulator.node import RigSimulatorNode
from magnetosuture_thread.rig.mechanics.dynamics import RigDynamics
from magnetosuture_thread.rig.rig import Rig, RigFrame
from magnetosuture_thread.scene import Dish, Scene, SceneShape
from test.nodes.scenes import scene_told

SMALL = {"scene": "dish_35mm", "thread_segments": 12, "needle_start": [0.003, 0.0, 0.0]}


def currents(graph, *values: float) -> CoilCurrents:
    """Return currents from now on."""
    message = CoilCurrents(current=[float(value) for value in values])
    message.header = MESSAGES.header(graph.now())
    return message


def nanoseconds(stamp) -> int:
    """Return a stamp as a number."""
    return stamp.sec * 10**9 + stamp.nanosec


def test_frames_come_with_their_truth_and_the_camera(graph):
    frames, infos = graph.listen_later(topics.COMPRESSED_IMAGE), graph.listen_later(topics.CAMERA_INFO)
    needles, threads, pulls = (graph.listen_later(topic) for topic in topics.GROUND_TRUTH)
    rig = graph.add(RigSimulatorNode, **SMALL).rig
    graph.wait(lambda: min(map(len, (frames, infos, needles, threads, pulls))) > 3, "frames and truth")
    image = cv2.imdecode(np.frombuffer(bytes(frames[-1].data), np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    assert image.shape == (480, 640, 3)
    assert (infos[-1].width, infos[-1].height) == (640, 480)
    stamp = nanoseconds(frames[-1].header.stamp)
    for truth in (needles, threads, pulls):
        graph.wait(lambda t=truth: stamp in [nanoseconds(each.header.stamp) for each in t], "the truth of a frame")
    assert needles[-1].pose.position.x == pytest.approx(0.003)
    assert needles[-1].header.frame_id == "dish"
    assert len(threads[-1].poses) == 13
    assert pulls[-1].header.frame_id == "dish"
    with graph.between_callbacks():
        frame = rig.look(rig.time, rendered=False)
    wrench = pulls[-1].wrench
    assert [wrench.force.x, wrench.force.y, wrench.torque.z] == [*frame.pull.tolist(), frame.moment]


def test_a_frame_period_is_kept_in_the_stamps(graph):
    needles = graph.listen_later(topics.GROUND_TRUTH_NEEDLE)
    graph.add(RigSimulatorNode, frame_rate=50.0, **SMALL)

    def periods() -> np.ndarray:
        return np.diff([nanoseconds(needle.header.stamp) for needle in needles]) * 50e-9

    graph.wait(lambda: len(needles) > 10 and np.any(np.abs(periods() - 1.0) < 0.05), "frames, and two in a row")
    found = periods()
    # A frame that nobody had time for is left out; the first may come late, by what a tick may come early.
    assert found.min() > 0.89
    assert np.abs(found - np.rint(found)).max() < 0.11


def test_a_tick_that_comes_late_leaves_no_frame_out_and_moves_none(graph, monkeypatch):
    needles = graph.listen_later(topics.GROUND_TRUTH_NEEDLE)
    late = [0.0, 0.05, 0.0, 0.6, 0.02, 0.0, 0.3, 0.85, 0.0]  # of a period
    ticks = iter([0.02 * (1 + number + part) for number, part in enumerate(late)])
    monkeypatch.setattr(Timeline, "running", lambda timeline: next(ticks, 1.0))
    node = graph.add(RigSimulatorNode, frame_rate=50.0, **SMALL)
    graph.wait(lambda: len(needles) > len(late), "a frame for each tick, and one much later")
    steps = np.diff([nanoseconds(needle.header.stamp) for needle in needles[: len(late) + 1]])
    assert steps[:-1] == pytest.approx(2e7, rel=1e-6)
    assert steps[-1] == pytest.approx(1e9 - 0.18e9, rel=1e-6)
    assert node._skipped == 40


def test_nothing_moves_without_a_current_then_the_needle_is_pulled(graph):
    needles = graph.listen_later(topics.GROUND_TRUTH_NEEDLE)
    graph.add(RigSimulatorNode, faults=["dim 0.0 60.0"], **SMALL)
    diagnostics = graph.listen(topics.DIAGNOSTICS)
    graph.publish(topics.RIG_CURRENTS, currents(graph, 0, 0, 0, 0))
    graph.wait(lambda: len(needles) > 5, "frames")
    assert needles[-1].pose.position.x == pytest.approx(0.003, abs=1e-8)

    def pulled() -> bool:
        graph.publish(topics.RIG_CURRENTS, currents(graph, 5, 0, -2, 0))
        return needles[-1].pose.position.x > 0.0035

    graph.wait(pulled, "the needle to move")
    graph.wait(lambda: any("running, with dim" in d.status[0].message for d in diagnostics), "the fault's name")


def refusals(diagnostics) -> list[str]:
    """Return what was refused."""
    values = [value for array in diagnostics for value in array.status[0].values]
    return [value.value for value in values if value.key == "last refusal" and value.value != "none"]


@pytest.mark.parametrize("bad", [(1.0, 2.0), (np.nan, 0, 0, 0)])
def test_bad_currents_are_refused_and_said(graph, bad):
    diagnostics = graph.listen_later(topics.DIAGNOSTICS)
    graph.add(RigSimulatorNode, **SMALL)
    graph.publish(topics.RIG_CURRENTS, currents(graph, *bad))
    graph.wait(lambda: any("4 finite numbers" in text for text in refusals(diagnostics)), "a refusal")


def test_currents_beyond_all_measure_end_nothing(graph):
    node = graph.add(RigSimulatorNode, **SMALL)
    needles = graph.listen(topics.GROUND_TRUTH_NEEDLE)
    graph.publish(topics.RIG_CURRENTS, currents(graph, 1e160, -1e300, 0, 0))
    graph.wait(lambda: node.rig.running > 0.05, "the currents")
    count = len(needles)
    graph.wait(lambda: len(needles) > count + 3, "frames")
    assert np.abs(node.rig.currents).max() <= 30.0
    assert np.hypot(needles[-1].pose.position.x, needles[-1].pose.position.y) < 0.0176


def test_currents_are_in_force_while_a_frame_is_rendered(graph, monkeypatch):
    node = graph.add(RigSimulatorNode, **SMALL)
    render, begun, go_on = node.rig.render, threading.Event(), threading.Event()

    def slow(frame: RigFrame) -> RigFrame:
        begun.set()
        assert go_on.wait(30.0)
        return render(frame)

    monkeypatch.setattr(node.rig, "render", slow)
    graph.wait(begun.is_set, "a frame")
    graph.publish(topics.RIG_CURRENTS, currents(graph, 3, 0, 0, 0))
    graph.wait(lambda: node.rig.currents.any(), "the currents")
    assert node.rig.currents.tolist() == [3.0, 0.0, 0.0, 0.0]
    frames = graph.listen(topics.COMPRESSED_IMAGE)
    go_on.set()
    graph.wait(lambda: len(frames) > 2, "frames")


def test_an_error_while_a_frame_is_rendered_is_not_lost(graph, monkeypatch):
    node = graph.add(RigSimulatorNode, **SMALL)

    def fail(frame: RigFrame) -> RigFrame:
        raise RuntimeError("no paint")

    with graph.between_callbacks():
        monkeypatch.setattr(node.rig, "render", fail)
        wait(node._rendering)
        node._take(node.time.elapsed())
        wait(node._rendering)
        with pytest.raises(RuntimeError, match="no paint"):
            node.on_frame()
        monkeypatch.undo()
        node._rendering.clear()


def test_where_the_simulation_fails_the_coils_go_off_and_it_is_said(graph, monkeypatch):
    node = graph.add(RigSimulatorNode, **SMALL)
    diagnostics = graph.listen(topics.DIAGNOSTICS)
    graph.publish(topics.RIG_CURRENTS, currents(graph, 3, 0, 0, 0))
    graph.wait(lambda: node.rig.running > 0.0, "the currents")

    def fail(*_: object, **__: object) -> None:
        raise SolverError("rig", "no convergence", 1.0, 1e-8)

    monkeypatch.setattr(node.rig, "look", fail)
    graph.wait(lambda: any("no convergence" in d.status[0].message for d in diagnostics), "the error")
    assert node.rig.currents.tolist() == [0.0] * 4


@pytest.mark.parametrize("simulated", [False, True])
def test_a_rig_that_is_too_slow_lags_and_says_so_while_frames_go_on(graph, monkeypatch, simulated: bool):
    """A needle that is wedged moves by a tenth of the time; no callback makes up for what was missed before."""
    needles, clocks = graph.listen_later(topics.GROUND_TRUTH_NEEDLE), graph.listen_later(topics.CLOCK)
    spans: list[float] = []

    def move(dynamics: RigDynamics, currents: object, dt: float, most: float) -> float:
        spans.append(dt)
        return 0.1 * dt

    monkeypatch.setattr(RigDynamics, "step", move)
    monkeypatch.setattr(Rig, "warm_up", lambda made: None)
    node = graph.add(RigSimulatorNode, use_sim_time=simulated, **SMALL)
    diagnostics = graph.listen(topics.DIAGNOSTICS)

    def late() -> bool:
        graph.publish(topics.RIG_CURRENTS, currents(graph, 1, 0, 0, 0))
        texts = [d.status[0].message for d in diagnostics]
        return any("late: simulated time runs at" in text for text in texts) and len(needles) > 20

    graph.wait(late, "the lag to be reported", timeout=30.0)
    assert 0.0 < max(spans) < 0.1 + 1e-9
    values = {value.key: value.value for value in diagnostics[-1].status[0].values}
    assert float(values["lag [s]"]) > 0.0
    assert float(values["real_time_factor"]) < 0.9
    stamps = [nanoseconds(message.header.stamp) for message in needles]
    assert stamps == sorted(stamps)
    times = [nanoseconds(message.clock) for message in clocks]
    assert times == sorted(times)
    if simulated:  # the clock waits for the rig
        assert times[-1] < node.time.stamp(node.rig.time) + 0.2e9
    else:  # what is shown is of now
        assert abs(stamps[-1] - node.get_clock().now().nanoseconds) < 5e9


def test_a_fault_can_be_asked_for_now(graph):
    node = graph.add(RigSimulatorNode, **SMALL)
    diagnostics = graph.listen(topics.DIAGNOSTICS)
    graph.publish(topics.RIG_CURRENTS, currents(graph, 0.01, 0, 0, 0))
    graph.publish(topics.FAULT_REQUEST, String(data="glare 60"))
    graph.wait(lambda: any("with glare" in d.status[0].message for d in diagnostics), "the fault")
    graph.publish(topics.FAULT_REQUEST, String(data="sunshine 60"))
    graph.wait(lambda: any("expected KIND DURATION" in text for text in refusals(diagnostics)), "a refusal")
    assert [fault.kind for fault in node.rig.faults.faults] == ["glare"]


def test_late_frames_come_late_with_their_own_stamps(graph):
    frames, needles = graph.listen_later(topics.COMPRESSED_IMAGE), graph.listen_later(topics.GROUND_TRUTH_NEEDLE)
    node = graph.add(RigSimulatorNode, faults=["late_frames 0 60"], **SMALL)
    graph.publish(topics.RIG_CURRENTS, currents(graph, 0.01, 0, 0, 0))
    graph.wait(lambda: node.rig.running > 0.0, "the fault's time")
    frames.clear()
    graph.wait(lambda: len(frames) > 2 and len(needles) > 2, "frames")
    assert node.get_clock().now().nanoseconds - nanoseconds(frames[-1].header.stamp) > 0.05e9


def test_a_driver_moves_the_needle_through_simulated_boards(graph, tmp_path):
    needles = graph.listen_later(topics.GROUND_TRUTH_NEEDLE)
    ports = (str(tmp_path / "a"), str(tmp_path / "b"))
    node = graph.add(RigSimulatorNode, power_stage="roboclaw", power_stage_ports=list(ports), **SMALL)
    driver = RoboClawDriver(CoilBridgeSettings(roboclaw_ports=ports, roboclaw_addresses=(128, 129)))
    driver.open()
    try:
        graph.wait(lambda: driver.state().ready and len(needles) > 3, "the boards")
        assert needles[-1].pose.position.x == pytest.approx(0.003, abs=1e-8)

        def pulled() -> bool:
            driver.apply(np.array([5.0, 0.0, -2.0, 0.0]), time.monotonic())
            return bool(needles[-1].pose.position.x > 0.0035)

        graph.wait(pulled, "the needle to move")
    finally:
        driver.close()
    graph.wait(lambda: bool(np.abs(node.rig.currents).max() < 1e-3), "the currents to go")
    graph.remove(node)
    assert not list(tmp_path.iterdir())


def test_a_simulated_clock_runs_at_its_pace(graph):
    node = graph.add(RigSimulatorNode, use_sim_time=True, rate=3.0, **SMALL)
    real, elapsed = time.perf_counter(), node.time.elapsed()
    clocks, needles = graph.listen(topics.CLOCK), graph.listen(topics.GROUND_TRUTH_NEEDLE)
    graph.wait(lambda: len(clocks) > 20 and len(needles) > 5, "clocks and frames")
    simulated = (nanoseconds(clocks[-1].clock) - nanoseconds(clocks[0].clock)) * 1e-9
    assert simulated > 0.0
    assert nanoseconds(clocks[-1].clock) < 1000e9  # it began near zero
    assert abs(nanoseconds(needles[-1].header.stamp) - nanoseconds(clocks[-1].clock)) < 1e9
    assert nanoseconds(clocks[-1].clock) <= node.time.stamp(node.time.elapsed())
    assert node.time.elapsed() - elapsed == pytest.approx(3.0 * (time.perf_counter() - real), rel=0.3)


def test_a_paused_rig_stands_still_and_goes_on_from_there_with_stamps_of_now(graph):
    needles = graph.listen_later(topics.GROUND_TRUTH_NEEDLE)
    node = graph.add(RigSimulatorNode, **SMALL)
    console = graph.probe.create_client(SetBool, PAUSE_RIG)

    def pulled(distance: float) -> bool:
        graph.publish(topics.RIG_CURRENTS, currents(graph, 5, 0, -2, 0))
        return bool(needles and needles[-1].pose.position.x > 0.003 + distance)

    def pause(still: bool) -> None:
        answer = console.call_async(SetBool.Request(data=still))
        graph.wait(answer.done, "an answer")
        assert answer.result().success

    graph.wait(console.service_is_ready, "the service")
    graph.wait(lambda: pulled(2e-4), "the needle to move")
    pause(True)
    elapsed, taken = node.time.elapsed(), node.rig.time
    graph.wait(lambda: len(needles) == later(graph, needles), "no more frames")
    paused_at, where = graph.probe.get_clock().now().nanoseconds, needles[-1].pose.position.x
    graph.publish(topics.RIG_CURRENTS, currents(graph, 5, 0, -2, 0))
    graph.wait(lambda: graph.probe.get_clock().now().nanoseconds - paused_at > 3e8, "a while")
    count = len(needles)
    assert (node.time.elapsed(), node.rig.time) == (elapsed, pytest.approx(taken, abs=0.1))
    pause(False)
    graph.wait(lambda: len(needles) > count, "frames again")
    first = needles[count]
    assert first.pose.position.x == pytest.approx(where, abs=5e-4)
    assert nanoseconds(first.header.stamp) > paused_at + 2e8
    assert nanoseconds(first.header.stamp) <= graph.probe.get_clock().now().nanoseconds
    graph.wait(lambda: pulled(8e-4), "the needle to move on")


def later(graph, needles) -> int:
    """Return how many there are once three frames more could have come."""
    until = graph.probe.get_clock().now().nanoseconds + 1e8
    graph.wait(lambda: graph.probe.get_clock().now().nanoseconds > until, "three frames' time")
    return len(needles)


def test_a_paused_simulated_clock_stands_still(graph):
    node = graph.add(RigSimulatorNode, use_sim_time=True, **SMALL)
    clocks = graph.listen(topics.CLOCK)
    graph.wait(lambda: len(clocks) > 5, "/clock")
    node.time.pause(True)
    still = node.time.stamp(node.time.elapsed())
    graph.wait(lambda: nanoseconds(clocks[-1].clock) == still, "the clock to stand still")
    count = len(clocks)
    graph.wait(lambda: len(clocks) > count + 20, "more of it")
    assert {nanoseconds(message.clock) for message in clocks[count:]} == {still}
    node.time.pause(False)
    graph.wait(lambda: nanoseconds(clocks[-1].clock) > still, "the clock to go on")
    assert nanoseconds(clocks[-1].clock) < still + 60e9


def test_rig_draws_a_new_scene_and_rejects_an_invalid_one(graph):
    node = graph.add(RigSimulatorNode, **SMALL)
    frames, diagnostics = graph.listen(topics.CAMERA_INFO), graph.listen(topics.DIAGNOSTICS)
    graph.wait(lambda: bool(frames), "a frame")
    before = frames[-1].k[0]
    other = Scene(Dish(0.04), (SceneShape("post", "instrument", Disc((0.0, 0.01), 0.002)),))
    graph.publish(topics.SCENE, scene_told(other))
    graph.wait(lambda: node.rig.scene.version == other.version, "the other scene")
    graph.wait(lambda: frames[-1].k[0] < 0.9 * before, "a frame of the wider dish")
    on_needle = Scene(Dish(0.04), (SceneShape("post", "instrument", Disc((0.006, 0.0), 0.002)),))
    graph.publish(topics.SCENE, scene_told(on_needle))
    refusal = "refused: scene: got post where the needle is"
    graph.wait(lambda: any(refusal in d.status[0].message for d in diagnostics), "the refusal")
    assert node.rig.scene.version == other.version


def test_without_a_scene_there_is_nothing_to_simulate(graph):
    with pytest.raises(ConfigurationError, match=r"rig_simulator\.scene: got '', expected a scene file"):
        graph.add(RigSimulatorNode, needle_start=[0.003, 0.0, 0.0])
