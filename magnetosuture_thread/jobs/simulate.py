"""The job `magnetosuture simulate`: the whole graph around a simulated rig, in a closed loop."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.errors import ConfigurationError, GraphError
from magnetosuture_thread.evaluation.graph_outputs import LoopCollector, LoopSummary
from magnetosuture_thread.geometry.polyline import arc_lengths
from magnetosuture_thread.interface import CAMERA, NODES, PROCESSES, SCENE, SCENE_MARKERS, SCENE_SERVER, TIP_SETPOINT
from magnetosuture_thread.jobs.output import whole_folder
from magnetosuture_thread.setups import Setup, read_setup

if TYPE_CHECKING:
    from magnetosuture_thread.nodes.coil_client import CoilClient
    from magnetosuture_thread.nodes.recorder import Recorder

SCENARIO_NOTE = "scenario"  # of the bag, which holds the set-up's text
ONCE = (SCENE.recorded, SCENE_MARKERS.recorded)  # what is told while nodes start, for the bag's beginning
INTERRUPTED = "interrupted"
START_TIMEOUT = 240.0  # s for all nodes to be there; the first start on a machine compiles
SETTLE = 1.0  # s for all nodes to have found each other
AFTERWARDS = 0.5  # s that go on once the path is done
TIMEOUT = 3.0  # times the path's own duration, and ...
SPARE = 20.0  # s of simulated time besides: then a run that never ends is ended
PATIENT = 15.0  # s for simulated boards to be ready
FAULT = "fault: "  # what a bridge says of itself that needs a reset
LOOK = 0.02  # s between two looks at the nodes

# Where two cores carry the whole graph and a recording besides, the bridge leaves them more of it.
SLOWER_BRIDGE = ("-p", "coil_bridge:rate:=100.0")
# On a busy machine the recorder finds who steers up to 3 s after the bridge does: the bag would lack the start.
BRIDGE_AND_RECORDER = ("-p", "path_follower:audience:=2")
SIMULATED_COILS = ("-p", "coil_bridge:driver:=simulated", "-p", "coil_bridge:autostart:=armed")

# Simulated boards share the processor with the graph, where real ones have their own. One that got no processor
# for 75 ms, as happens with two busy cores, would be taken for dead.
PATIENT_DRIVER = {"roboclaw_answer_timeout": 0.2, "driver_timeout": 0.5}

Log = Callable[[str], None]
Progress = Callable[[float], None]


def simulate(
    scenario: str,
    output: Path,
    *,
    duration: float | None = None,
    rate: float | None = None,
    boards: bool = False,
    log: Log = lambda text: None,
    progress: Progress = lambda share: None,
) -> LoopSummary:
    """Run rig, tracker, model, bridge and path follower as processes of their own, and judge the loop.

    `output` becomes a bag of all that was said, the truth included, with the nodes' `logs/` beside it; its
    notes hold the scenario and say that it is simulated, and `replay` takes it. It is made at the end, also
    of a run that was interrupted, or for which the disk was too small; of one that never began nothing is left.

    Args:
        scenario: name or path of a set-up with a path for the needle.
        output: the bag's folder.
        duration: the run ends after this many seconds of the scenario's time, wherever the needle is then;
            when the path is done if None.
        rate: how much faster than real time, with a simulated clock; in real time if None.
        boards: whether the bridge drives the rig through simulated RoboClaw boards on pseudo-terminals, by the
            driver for real ones; they keep real time, so not with `pace`.
        log: called with a line for a person at each stage.
        progress: called with the share done, 0 to 1.

    Raises:
        BagError: the output exists or cannot be written; where the disk was full, what was recorded is there.
        ConfigurationError: the scenario cannot be used.
        GraphError: a node ended or did not come, or the needle never got to the end of its path.
        KeyboardInterrupt: passed on; where the run had begun, its bag is there.
    """
    setup = read_setup(scenario)
    if not setup.follower.waypoints:
        raise ConfigurationError("path_follower.waypoints", [], "where the needle shall go", str(setup.path))
    if setup.vision.image_transport != "compressed":
        expectation = "compressed: the bag must hold what the tracker saw"
        raise ConfigurationError(
            "vision_tracker.image_transport", setup.vision.image_transport, expectation, str(setup.path)
        )
    with whole_folder(output, is_recording=True) as folder:
        problem = _run(setup, folder, output.name, duration, rate, boards, log, progress)
    if problem == INTERRUPTED:
        raise KeyboardInterrupt
    if problem:
        raise GraphError(f"{problem}; what was recorded is in {output}")
    log("judging the run")
    return measure_loop(Bag(output), setup).summary(setup.name)


def measure_loop(bag: Bag, setup: Setup) -> LoopCollector:
    """Return all that a simulated run's bag says, put side by side."""
    collector = LoopCollector(
        setup.model.thread_length, setup.rig.needle_length, setup.rig.needle_curvature, setup.rig.frame_rate
    )
    camera = {channel.recorded for channel in CAMERA.values()}
    for record in bag.records(set(bag.topics) - camera):
        collector.add(record.topic, record.time, record.decode())
    return collector


def _run(
    setup: Setup,
    folder: Path,
    name: str,
    duration: float | None,
    rate: float | None,
    boards: bool,
    log: Log,
    progress: Progress,
) -> str:
    """Run the graph and record it; return what went wrong, so that the bag stays."""
    # Only here, where it is needed: without ROS the other commands still work.
    from magnetosuture_thread.nodes import topics
    from magnetosuture_thread.nodes.coil_client import CoilClient
    from magnetosuture_thread.nodes.interruption import Interruption
    from magnetosuture_thread.nodes.processes import (
        NodeProcesses,
        environment_of,
        graph_environment,
        reserved_domain,
    )
    from magnetosuture_thread.nodes.recorder import Recorder

    arguments = ["--params-file", str(setup.path.resolve()), *SLOWER_BRIDGE]
    if rate is not None:
        arguments += ["-p", "use_sim_time:=true", "-p", f"rig_simulator:rate:={float(rate)}"]
    notes = {
        "setup": setup.name,
        SCENARIO_NOTE: setup.path.read_text(encoding="utf-8"),
        "simulated": f"the whole rig, closed loop, scenario {setup.name}",
    }
    said = (*topics.INPUTS, *topics.OUTPUTS, *topics.SIMULATED, *topics.SETTINGS)
    taken = [topic for topic in said if topic is not topics.IMAGE]
    with (
        reserved_domain() as domain,
        BagWriter(folder, notes, name=name) as bag,
        TemporaryDirectory() as ports,
    ):
        environment = graph_environment(domain)
        arguments += _wired(ports, len(setup.coils.coil_angles)) if boards else SIMULATED_COILS
        for topic in taken:
            bag.add_topic(topic.channel.recorded, topic.channel.type_name)
        log(f"starting {SCENE_SERVER}, rig_simulator, {', '.join(NODES)} (ROS domain {domain}, this machine only)")
        with (
            environment_of(environment),
            NodeProcesses(
                (SCENE_SERVER, "rig_simulator", *PROCESSES), arguments, environment, folder / "logs"
            ) as nodes,
        ):
            running, interruption = False, Interruption()
            early: dict[str, bytes] = {}
            begin: int | None = None

            def receive(topic: str, arrival: int, data: bytes) -> None:
                nonlocal begin
                # While nodes start, only what is said once and for all is worth keeping: for the bag's start.
                if not running:
                    early.update({topic: data} if topic in ONCE else {})
                    return
                if begin is None:
                    begin = arrival
                    for name, said_early in early.items():
                        bag.write(name, begin, said_early)
                # What waited elsewhere may have arrived before: the scene is the bag's first message all the same.
                bag.write(topic, max(arrival, begin + 1), data)

            def check() -> None:
                interruption.check()
                nodes.check()

            recorder = Recorder(domain, taken, simulated_clock=rate is not None, receive=receive)
            try:
                perhaps = (
                    topics.NEEDLE_COMMAND,
                    topics.OPERATOR_COMMAND,
                    topics.TIP_SETPOINT,
                    topics.FAULT_REQUEST,
                    topics.MATERIAL,
                )
                with interruption:
                    _wait(recorder, check, {topic.name for topic in perhaps})
                if boards:
                    _arm(CoilClient)
                log("running" if rate is None else f"running at {rate:g} times the speed")
                running = True
                nodes.start("path_follower", arguments=BRIDGE_AND_RECORDER)
                with interruption:
                    return _follow(recorder, check, setup, duration, rate or 1.0, progress)
            except KeyboardInterrupt:
                if not running:
                    raise
                return INTERRUPTED  # passed on once the bag is whole
            finally:
                recorder.close()


def _arm(make: type[CoilClient]) -> None:
    """Arm the bridge as soon as its boards are ready."""
    deadline = time.monotonic() + PATIENT
    while True:
        try:
            with make() as client:
                return client.execute("arm")
        except GraphError as error:
            if time.monotonic() > deadline:
                raise GraphError(f"the bridge cannot be armed: {error}") from None


def _wired(folder: str, coils: int) -> list[str]:
    """Return the arguments under which bridge and rig meet at simulated boards, of two coils each."""
    ports = json.dumps([f"{folder}/board_{index}" for index in range(coils // 2)])
    both: dict[str, dict[str, object]] = {
        "coil_bridge": {"driver": "roboclaw", "autostart": "active", "roboclaw_ports": ports, **PATIENT_DRIVER},
        "rig_simulator": {"power_stage": "roboclaw", "power_stage_ports": ports},
    }
    given = [f"{node}:{name}:={value}" for node, values in both.items() for name, value in values.items()]
    return [part for each in given for part in ("-p", each)]


def _wait(recorder: Recorder, check: Callable[[], None], later: set[str]) -> None:
    """Wait until somebody publishes every topic, but those that come later."""
    deadline = time.monotonic() + START_TIMEOUT
    while missing := [name for name in recorder.silent() if name not in later]:
        check()
        if time.monotonic() > deadline:
            raise GraphError(f"after {START_TIMEOUT:g} s nobody is at {', '.join(missing)}")
        recorder.spin(LOOK)
    recorder.spin(SETTLE)


def _follow(
    recorder: Recorder,
    check: Callable[[], None],
    setup: Setup,
    duration: float | None,
    rate: float,
    progress: Progress,
) -> str:
    """Record until the needle is at the end of its path, or the time is over; return what went wrong."""
    points = np.reshape((*setup.rig.needle_start[:2], *setup.follower.waypoints), (-1, 2))
    longest = TIMEOUT * float(arc_lengths(points)[-1]) / setup.follower.speed + SPARE + (duration or 0.0)
    began = time.monotonic()
    following, started = False, began
    while True:
        check()
        recorder.spin(LOOK)
        if not following and recorder.taken[TIP_SETPOINT.recorded]:
            following, began = True, time.monotonic()
        if "path_follower" not in recorder.said and time.monotonic() - started < START_TIMEOUT:
            began = time.monotonic()  # its process is still loading
        said, values = recorder.said.get("path_follower", ("", {}))
        elapsed = (time.monotonic() - began) * rate
        done = float(values.get("progress", 0.0))
        progress(done if duration is None else min(1.0, elapsed / duration))
        if duration is not None and elapsed > duration + (0.0 if following else SPARE):
            return ""
        if duration is None and said == "done":
            recorder.spin(AFTERWARDS / rate)
            return ""
        held = recorder.said.get("coil_bridge", ("", {}))[0]
        if held.startswith(FAULT):
            return f"coil_bridge: {held}"
        if elapsed > longest:
            states = "; ".join(f"{node}: {text}" for node, (text, _) in sorted(recorder.said.items()))
            return f"after {elapsed:.0f} s only {done:.0%} of the path is done; {states}"
