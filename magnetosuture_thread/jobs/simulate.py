"""The job `magnetosuture simulate`: the whole graph around a simulated rig, in a closed loop. It needs ROS."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from magnetosuture_thread import ConfigurationError
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.errors import GraphError
from magnetosuture_thread.evaluation.graph_outputs import LoopCollector, LoopSummary
from magnetosuture_thread.geometry.polyline import arc_lengths
from magnetosuture_thread.interface import (
    CAMERA,
    NODES,
    PLANNER,
    PREDICTED_THREAD,
    PROCESSES,
    SCENE,
    SCENE_MARKERS,
    SCENE_SERVER,
    STANDBY_NODES,
    TIP_SETPOINT,
)
from magnetosuture_thread.jobs.output import whole_folder
from magnetosuture_thread.jobs.replay_inputs import SETUP_NOTE, Log, Progress
from magnetosuture_thread.jobs.simulate_procedure import ProcedureRun
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.clients import CoilClient
from magnetosuture_thread.nodes.diagnostics import COMPILING
from magnetosuture_thread.nodes.processes import NodeProcesses, environment_of, graph_environment, reserved_domain
from magnetosuture_thread.nodes.recorder import Recorder
from magnetosuture_thread.nodes.run import Interruption
from magnetosuture_thread.planning.procedure import read_procedure
from magnetosuture_thread.rig.power.stage import board_addresses
from magnetosuture_thread.setups import Setup, read_procedure_setup, read_setup

ONCE = (SCENE.recorded, SCENE_MARKERS.recorded)  # published while nodes start, for the bag's beginning
# Topics on which nothing may come before the run begins.
OPTIONAL = (
    topics.NEEDLE_COMMAND,
    topics.OPERATOR_COMMAND,
    topics.TIP_SETPOINT,
    topics.FAULT_REQUEST,
    topics.MATERIAL,
    *topics.ON_REQUEST,
    *topics.PROCEDURES,
)
INTERRUPTED = "interrupted"
SUMMARY_FILE = "summary.json"  # of a procedure's run, in the bag's folder
START_TIMEOUT = 240.0  # s for all nodes to be there; the first start on a machine compiles
SETTLING_TIME = 1.0  # s for all nodes to have found each other
PREDICTION_TIMEOUT = 10.0  # s for the first prediction: where the needle cannot be tracked, there is none
FINAL_TIME = 0.5  # s that go on once the path is done
TIMEOUT_FACTOR = 3.0  # times the path's own duration, and ...
EXTRA_TIME = 20.0  # s of simulated time besides: then a run that never ends is ended
BOARDS_TIMEOUT = 15.0  # s for simulated boards to be ready
FAULT = "fault: "  # what a bridge says of itself that needs a reset
POLL_PERIOD = 0.02  # s between two looks at the nodes

# Where two cores carry the whole graph and a recording besides, the bridge leaves them more of it.
SLOWER_BRIDGE = ("-p", "coil_bridge:rate:=100.0")
# Ahead in s, and between two forecasts: what page and recording show, without poses that come late for it.
FORECAST = ("-p", "thread_model:forecast_horizon:=3.0", "-p", "thread_model:forecast_period:=0.2")
# On a busy machine the recorder finds who steers up to 3 s after the bridge does: the bag would lack the start.
BRIDGE_AND_RECORDER = ("-p", "path_follower:audience:=2")
# Whatever a setup says for a launch: nobody would activate the nodes of a job.
ACTIVE = tuple(part for name in STANDBY_NODES for part in ("-p", f"{name}:autostart:=active"))
SIMULATED_COILS = ("-p", "coil_bridge:driver:=simulated", "-p", "coil_bridge:autostart:=armed")

# Simulated boards share the processor with the graph, where real ones have their own. One that got no processor
# for 75 ms, as happens with two busy cores, would be taken for dead.
SLOW_BOARD_TIMEOUTS = {"roboclaw_answer_timeout": 0.2, "driver_timeout": 0.5}


def simulate(
    setup_name: str,
    output: Path,
    *,
    duration: float | None = None,
    rate: float | None = None,
    boards: bool = False,
    procedure: str = "",
    log: Log = lambda text: None,
    progress: Progress = lambda share: None,
) -> LoopSummary:
    """Run rig, tracker, model, bridge and path follower as processes of their own, and evaluate the loop.

    With a procedure the needle planner executes it in place of the path follower, and the figures, with what came of
    the procedure, are in the folder too, as `summary.json`.

    `output` becomes a bag of every topic, including ground truth, with the nodes' `logs/` beside it; its
    notes hold the setup and say that it is simulated, and `replay` takes it. It is made at the end, also
    of a run that was interrupted, or for which the disk was too small; of one that never began nothing is left.

    Args:
        setup_name: name or path of a setup with a path for the needle, unless there is a procedure.
        output: the bag's folder.
        duration: the run ends after this many seconds of the setup's time, wherever the needle is then;
            when the path is done if None.
        rate: how much faster than real time, with a simulated clock; in real time if None.
        boards: whether the bridge drives the rig through simulated RoboClaw boards on pseudo-terminals, by the
            driver for real ones; they keep real time, so not with `rate`.
        procedure: name or path of a procedure; empty for the setup's path.
        log: called with a line for a person at each stage.
        progress: called with the share done, 0 to 1.

    Raises:
        BagError: the output exists or cannot be written; where the disk was full, what was recorded is there.
        ConfigurationError: the setup cannot be used, or the procedure does not fit its scene.
        GraphError: a node ended or did not come, the needle never got to the end of its path, or the procedure failed.
        KeyboardInterrupt: passed on; where the run had begun, its bag is there.
    """
    setup = read_procedure_setup(read_procedure(procedure), setup_name) if procedure else read_setup(setup_name)
    execution = ProcedureRun(procedure, setup) if procedure else None
    if execution is None and not setup.follower.waypoints:
        raise ConfigurationError("path_follower.waypoints", [], "where the needle shall go", str(setup.path))
    if setup.vision.image_transport != "compressed":
        name, expectation = "vision_tracker.image_transport", "compressed: the bag must hold what the tracker saw"
        raise ConfigurationError(name, setup.vision.image_transport, expectation, str(setup.path))
    with whole_folder(output, is_recording=True) as folder:
        problem = _run(setup, folder, output.name, duration, rate, boards, execution, log, progress)
    if problem == INTERRUPTED:
        raise KeyboardInterrupt
    if problem and execution is None:
        raise GraphError(f"{problem}; what was recorded is in {output}")
    log("evaluating the run")
    figures = None if execution is None else {"setup": setup.name, "procedure": execution.result}
    try:
        summary = measure_loop(Bag(output), setup).summary(setup.name)
        if execution is not None:
            summary = replace(summary, procedure=execution.result)
            figures = summary.to_json()
    except GraphError as error:
        raise GraphError(f"{problem}; {error}" if problem else str(error)) from None
    finally:
        if figures is not None:
            (output / SUMMARY_FILE).write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    if problem:
        raise GraphError(f"{problem}; what was recorded is in {output}")
    return summary


def measure_loop(bag: Bag, setup: Setup) -> LoopCollector:
    """Return what a simulated run's bag holds, compared by stamp."""
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
    execution: ProcedureRun | None,
    log: Log,
    progress: Progress,
) -> str:
    """Run the graph and record it; return what went wrong, so that the bag stays."""
    arguments = ["--params-file", str(setup.path.resolve()), *SLOWER_BRIDGE, *ACTIVE]
    if execution is not None:
        arguments += [*execution.scene_arguments, *FORECAST]
    if rate is not None:
        arguments += ["-p", "use_sim_time:=true", "-p", f"rig_simulator:rate:={float(rate)}"]
    notes = {
        "setup": setup.name,
        SETUP_NOTE: setup.path.read_text(encoding="utf-8"),
        "simulated": f"the whole rig, closed loop, setup {setup.name}",
    }
    procedures = () if execution is None else topics.PROCEDURES
    every = (*topics.INPUTS, *topics.OUTPUTS, *topics.SIMULATED, *topics.SETTINGS, *procedures)
    recorded = [topic for topic in every if topic is not topics.IMAGE]
    with reserved_domain() as domain, BagWriter(folder, notes, name=name) as bag, TemporaryDirectory() as ports:
        environment = graph_environment(domain)
        arguments += _wired(ports, len(setup.coils.coil_angles)) if boards else SIMULATED_COILS
        for topic in recorded:
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
                # While nodes start, only what is published once is kept, for the bag's start.
                if not running:
                    if topic in ONCE:
                        early[topic] = data
                    return
                if begin is None:
                    begin = arrival
                    for name, content in early.items():
                        bag.write(name, begin, content)
                # What waited elsewhere may have arrived before: the scene is the bag's first message all the same.
                bag.write(topic, max(arrival, begin + 1), data)

            def check() -> None:
                interruption.check()
                nodes.check()

            recorder = Recorder(domain, recorded, simulated_clock=rate is not None, receive=receive)
            try:
                with interruption:
                    _wait(recorder, check, log)
                if boards:
                    _arm()
                log("running" if rate is None else f"running at {rate:g} times the speed")
                running = True
                if execution is not None:
                    nodes.start(PLANNER, arguments=execution.arguments)
                    with interruption:
                        return execution.execute(recorder, check, duration, rate or 1.0, progress)
                nodes.start("path_follower", arguments=BRIDGE_AND_RECORDER)
                with interruption:
                    return _follow(recorder, check, setup, duration, rate or 1.0, progress)
            except KeyboardInterrupt:
                if not running:
                    raise
                return INTERRUPTED  # passed on once the bag is whole
            finally:
                recorder.close()


def _arm() -> None:
    """Arm the bridge as soon as its boards are ready."""
    deadline = time.monotonic() + BOARDS_TIMEOUT
    while True:
        try:
            with CoilClient() as client:
                client.execute("arm")
                return
        except GraphError as error:
            if time.monotonic() > deadline:
                raise GraphError(f"the bridge cannot be armed: {error}") from None


def _wired(folder: str, coils: int) -> list[str]:
    """Return the arguments under which bridge and rig meet at simulated boards, of two coils each."""
    ports = json.dumps([f"{folder}/board_{index}" for index in range(coils // 2)])
    boards = {"roboclaw_ports": ports, "roboclaw_addresses": json.dumps(board_addresses(coils // 2))}
    parameters: dict[str, dict[str, object]] = {
        "coil_bridge": {"driver": "roboclaw", "autostart": "active", **boards, **SLOW_BOARD_TIMEOUTS},
        "rig_simulator": {"power_stage": "roboclaw", "power_stage_ports": ports},
    }
    given = [f"{node}:{name}:={value}" for node, values in parameters.items() for name, value in values.items()]
    return [part for each in given for part in ("-p", each)]


def log_compiling(texts: Mapping[str, str], logged: set[str], log: Log) -> None:
    """Log, once of each node, that it compiles.

    Args:
        texts: state of each node.
        logged: nodes of which it was logged.
        log: called with a line for a person.
    """
    for name, text in texts.items():
        if text.startswith(COMPILING) and name not in logged:
            logged.add(name)
            log(f"{name}: {text}")


def _wait(recorder: Recorder, check: Callable[[], None], log: Log) -> None:
    """Wait until every topic has a publisher, except those in `OPTIONAL`, and for the first prediction.

    On a busy machine the first frames take tracker and model a second or more; a run that had begun would lack them.
    """
    optional = {topic.name for topic in OPTIONAL}
    deadline, logged = time.monotonic() + START_TIMEOUT, set[str]()
    while missing := [name for name in recorder.silent() if name not in optional]:
        check()
        log_compiling({name: text for name, (text, _) in recorder.status_texts.items()}, logged, log)
        if time.monotonic() > deadline:
            raise GraphError(f"after {START_TIMEOUT:g} s nobody is at {', '.join(missing)}")
        recorder.spin(POLL_PERIOD)
    deadline = time.monotonic() + PREDICTION_TIMEOUT
    while not recorder.taken[PREDICTED_THREAD.recorded] and time.monotonic() < deadline:
        check()
        recorder.spin(POLL_PERIOD)
    recorder.spin(SETTLING_TIME)


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
    timeout = TIMEOUT_FACTOR * float(arc_lengths(points)[-1]) / setup.follower.speed + EXTRA_TIME + (duration or 0.0)
    began = time.monotonic()
    following, started = False, began
    while True:
        check()
        recorder.spin(POLL_PERIOD)
        if not following and recorder.taken[TIP_SETPOINT.recorded]:
            following, began = True, time.monotonic()
        if "path_follower" not in recorder.status_texts and time.monotonic() - started < START_TIMEOUT:
            began = time.monotonic()  # its process is still loading
        state, values = recorder.status_texts.get("path_follower", ("", {}))
        elapsed = (time.monotonic() - began) * rate
        done = float(values.get("progress", 0.0))
        progress(done if duration is None else min(1.0, elapsed / duration))
        if duration is not None and elapsed > duration + (0.0 if following else EXTRA_TIME):
            return ""
        if duration is None and state == "done":
            recorder.spin(FINAL_TIME / rate)
            return ""
        bridge = recorder.status_texts.get("coil_bridge", ("", {}))[0]
        if bridge.startswith(FAULT):
            return f"coil_bridge: {bridge}"
        if elapsed > timeout:
            states = "; ".join(f"{node}: {text}" for node, (text, _) in sorted(recorder.status_texts.items()))
            return f"after {elapsed:.0f} s only {done:.0%} of the path is done; {states}"
