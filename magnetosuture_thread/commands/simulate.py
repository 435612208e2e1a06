"""The command `magnetosuture simulate`: the whole graph around a simulated rig, in a closed loop. It needs ROS."""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from magnetosuture_thread import ConfigurationError, Scene
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.commands import command, live
from magnetosuture_thread.evaluation.metrics import finite_or_none
from magnetosuture_thread.evaluation.recorded import SETUP_NOTE
from magnetosuture_thread.evaluation.tables import LoopCollector, LoopSummary, loop_table, outcome_line
from magnetosuture_thread.evaluation.workers import Log, Progress
from magnetosuture_thread.geometry.polyline import arc_lengths
from magnetosuture_thread.geometry.scene_files import write_scene
from magnetosuture_thread.nodes import clients, topics
from magnetosuture_thread.planning.procedure import read_procedure
from magnetosuture_thread.rig.power import board_addresses
from magnetosuture_thread.rig.settings import RigSettings
from magnetosuture_thread.rig.setups import Setup, read_procedure_setup, read_setup
from magnetosuture_thread.rig.truth import bare_rig, changed_parameters, with_rig
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.errors import GraphError
from magnetosuture_thread.settings.files import find_file, whole_folder

SUMMARY_FILE = "summary.json"  # of a procedure's run, in the bag's folder
EXTRA_TIME = 20.0  # s of simulated time, beyond a path's or run's own
MIN_RATE = 0.5  # of real time; the least that the rig's setting `rate` takes
MAX_PAUSE = 30.0  # s; in which a person resumes a procedure that does not go on by itself, or nobody is there


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    option = parser.add_argument
    option("setup", metavar="SETUP", help="a setup's name or YAML file")
    option("--output", type=Path, required=True, metavar="BAG", help="folder of the bag to make")
    duration = "end after this many seconds (default: at the end of the path or procedure)"
    option("--duration", type=command.number_argument(0.1, 1e5), help=duration)
    task = parser.add_mutually_exclusive_group()
    task.add_argument("--procedure", default="", metavar="NAME", help="execute a procedure, by its name or YAML file")
    bare = "a needle without a thread in an empty dish, for commission --live: nothing steers, until Ctrl-C"
    task.add_argument("--bare", action="store_true", help=bare)
    threaded = "the same with the setup's thread, for commission-thread --live"
    task.add_argument("--threaded", action="store_true", help=threaded)
    command.add_rig(parser)
    clock = parser.add_mutually_exclusive_group()
    rate = "run with a simulated clock, this much faster than real time (default: in real time)"
    clock.add_argument("--rate", type=command.number_argument(MIN_RATE, 5.0), help=rate)
    boards = "drive simulated RoboClaw boards, by the driver for real ones"
    clock.add_argument("--boards", action="store_true", help=boards)
    option("--json", type=command.output_file, metavar="FILE", help="write the figures to a file")


def run_simulate(options: argparse.Namespace, terminal: command.Terminal) -> int | None:
    """Run the whole graph around a simulated rig.

    No robot is needed: rig_simulator stands in for coils, dish, needle, thread and camera; vision_tracker,
    thread_model and coil_bridge are the ones that run on a robot; path_follower commands needle velocities along
    the setup's path. All are processes of their own, on a ROS domain that nobody else uses. Everything is
    simulated, and the bag says so.

    With --bare and --threaded nothing steers: the dish waits to be commissioned. With --procedure, needle_planner
    executes it in place of path_follower. Whether it succeeded, or why it failed, is at the end of the table, and in
    summary.json in BAG; one that waits for a person fails after 30 s, unless somebody resumes it. Where the computer
    skips a tenth of the frames or more, that is the reason: a lower --rate gives it more time.

    SETUP is a setup with waypoints in its section path_follower, which a procedure needs not. BAG, which must not
    exist, records every topic, including ground truth, and the nodes' logs; `replay` takes it. Ctrl-C ends the run,
    and what was recorded stays. The first run on a machine compiles for a minute before it begins.
    """
    new = not options.output.exists()
    chosen = command.given(options, "duration", "rate", "boards", "rig")
    try:
        with terminal.progress("simulate") as advance:
            chosen |= {"log": terminal.log, "progress": advance}
            if options.bare or options.threaded:
                host_rig(options.setup, options.output, threaded=options.threaded, **chosen)
                return None
            summary = simulate(options.setup, options.output, procedure=options.procedure, **chosen)
    except (KeyboardInterrupt, GraphError):
        if new and options.output.exists():
            terminal.log(f"what was recorded is in {options.output}")
        raise
    terminal.print(loop_table(summary))
    if summary.too_slow:
        terminal.log(f"{live.TOO_SLOW}: {summary.too_slow}")
    terminal.log(f"bag: {options.output}")
    command.write_json(options.json, summary.to_json())
    outcome = summary.procedure
    return command.FAILED if outcome and outcome["state"] != "done" else command.DONE


def too_slow(skipped: int, taken: int, rate: float) -> str:
    """Return that a run skipped a tenth of the frames or more, and what to do; empty if it did not.

    Then the needle is steered by another camera than the setup's.
    """
    if not skipped or skipped < 0.1 * (skipped + taken):
        return ""
    remedy = f"try --rate {max(MIN_RATE, 0.5 * rate):g}" if rate > MIN_RATE else "end other programs"
    return f"{skipped} of {skipped + taken} frames skipped; {remedy}"


def simulate(
    setup_name: str,
    output: Path,
    *,
    duration: float | None = None,
    rate: float | None = None,
    boards: bool = False,
    procedure: str = "",
    rig: str = "",
    log: Log = lambda text: None,
    progress: Progress = lambda share: None,
) -> LoopSummary:
    """Run rig, tracker, model, bridge and path follower as processes of their own, and evaluate the loop.

    With a procedure the needle planner executes it in place of the path follower, and the figures, with what came of
    the procedure, are in the folder too, as `summary.json`; also of one that failed.

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
        rig: what is simulated where it is not as the setup says, see `with_rig`.
        log: called with a line for a person at each stage.
        progress: called with the share done, 0 to 1.

    Raises:
        BagError: the output exists or cannot be written; where the disk was full, what was recorded is there.
        ConfigurationError: the setup cannot be used, or the procedure does not fit its scene.
        GraphError: a node ended or did not come, or the needle never got to the end of its path; its bag is there
            where the run had begun.
        KeyboardInterrupt: the same, passed on.
    """
    setup = read_procedure_setup(read_procedure(procedure), setup_name) if procedure else read_setup(setup_name)
    believed, setup = setup.rig, with_rig(setup, rig)
    task: _Task = _Procedure(procedure, setup) if procedure else _Path(setup, duration)
    problem = _Run(setup, believed, task, duration, rate, boards, log, progress).write(output)
    if problem and task.result is not None:
        task.result |= {"state": "failed" if task.stage else task.result["state"], "reason": problem}
    log("evaluating the run")
    figures = {"setup": setup.name, "procedure": task.result}
    try:
        summary = measure_loop(Bag(output), setup).summary(setup.name)
        slow = too_slow(summary.skipped, summary.frames, rate or 1.0)
        if slow and task.result is not None and task.result["state"] == "failed":  # which tells nothing of the planner
            task.result |= {"state": live.TOO_SLOW, "reason": f"{slow}; then {task.result['reason']}"}
        summary = replace(summary, procedure=task.result, too_slow=slow)
        figures = summary.to_json()
    except GraphError as error:
        words = "{}: {}, {}; ".format(*outcome_line(task.result)) if task.result else ""
        raise GraphError(f"{words}{error}") from None
    finally:
        if task.result is not None:
            (output / SUMMARY_FILE).write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    return summary


def host_rig(
    setup_name: str,
    output: Path,
    *,
    threaded: bool = False,
    duration: float | None = None,
    rate: float | None = None,
    boards: bool = False,
    rig: str = "",
    log: Log = lambda text: None,
    progress: Progress = lambda share: None,
) -> None:
    """Run rig, tracker, model and bridge around a needle that nothing steers, to be commissioned.

    Args:
        setup_name: name or path of a setup; its scene is without shapes here.
        output: as of `simulate`, as are the others.
        threaded: whether there is a thread; without one the bridge gives pulses.
        duration: it ends after this many seconds; with an interruption if None.
        rate: how much faster than real time.
        boards: whether there are simulated boards.
        rig: what is simulated.
        log: called with a line for a person at each stage.
        progress: called with the share done.

    Raises:
        BagError: the output exists or cannot be written.
        ConfigurationError: the setup cannot be used.
        GraphError: a node ended or did not come.
        KeyboardInterrupt: passed on; its bag is there.
    """
    believed = read_setup(setup_name)
    setup = with_rig(believed, rig).with_scene(Scene(believed.scene.dish))
    rig_of = setup.rig if threaded else bare_rig(setup.rig, np.random.default_rng(setup.rig.seed))
    setup = replace(setup, rig=replace(rig_of, obstacle_looks=())).with_scene(setup.scene)
    _Run(setup, believed.rig, _Waiting(gives_pulses=not threaded), duration, rate, boards, log, progress).write(output)


def measure_loop(bag: Bag, setup: Setup) -> LoopCollector:
    """Return what a simulated run's bag holds, compared by stamp."""
    collector = LoopCollector(
        setup.model.thread_length, setup.rig.needle_length, setup.rig.needle_curvature, setup.rig.frame_rate
    )
    camera = {channel.recorded for channel in interface.CAMERA.values()}
    for record in bag.records(set(bag.topics) - camera):
        collector.add(record.topic, record.time, record.decode())
    return collector


class _Task:
    """What the graph does in a run; by itself nothing, until somebody ends it.

    Attributes:
        node: that steers.
        arguments: for all nodes.
        recorded: topics that are recorded besides.
        time_limit: of the whole run [s of simulated time].
        stage: 0 before the node is there, 1 before the needle moves, 2 from then on.
        share: that is done, 0 to 1.
        ended: whether it is done.
        stuck: why it goes on no more by itself; empty while it does.
        result: what came of a procedure; None for a path.
    """

    node = ""
    arguments: Sequence[str] = ()
    recorded: tuple[topics.Topic, ...] = ()
    time_limit, stage, share, ended, stuck = math.inf, 0, 0.0, False, ""
    result: dict[str, Any] | None = None

    def poll(self, recorder: clients.Recorder) -> None:
        """Take what is new."""

    def problem(self, elapsed: float, recorder: clients.Recorder) -> str:
        """Return what to report of a run that does not end."""
        return ""


class _Waiting(_Task):
    """A rig that others commission. The bridge waits for a person to arm it."""

    stage = 2

    def __init__(self, *, gives_pulses: bool) -> None:
        self.arguments = live.arguments_of({"coil_bridge:commissioning": "true"}) if gives_pulses else ()


class _Path(_Task):
    """The setup's path, along which the path follower steers."""

    node = "path_follower"

    def __init__(self, setup: Setup, duration: float | None) -> None:
        if not setup.follower.waypoints:
            raise ConfigurationError("path_follower.waypoints", [], "where the needle shall go", str(setup.path))
        points = np.reshape((*setup.rig.needle_start[:2], *setup.follower.waypoints), (-1, 2))
        # One that never ends is ended after three times its own duration, and 20 s.
        self.time_limit = 3.0 * float(arc_lengths(points)[-1]) / setup.follower.speed + EXTRA_TIME + (duration or 0.0)
        self._duration = duration

    def poll(self, recorder: clients.Recorder) -> None:
        """Take what is new."""
        state, values = recorder.status_texts.get(self.node, ("", {}))
        self.stage = 2 if recorder.taken[interface.TIP_SETPOINT.recorded] else int(self.node in recorder.status_texts)
        self.share = float(values.get("progress", 0.0))
        self.ended = state == "done" and self._duration is None

    def problem(self, elapsed: float, recorder: clients.Recorder) -> str:
        """Return what to report of a run that does not end."""
        states = "; ".join(f"{node}: {text}" for node, (text, _) in sorted(recorder.status_texts.items()))
        return f"after {elapsed:.0f} s only {self.share:.0%} of the path is done; {states}"


class _Procedure(_Task):
    """A procedure that the needle planner executes.

    Attributes:
        result: name, state, reason, goals met, goals and minimum clearance of the needle's axis by its measured poses
            [m].

    Raises:
        ConfigurationError: there is no such procedure, or it does not fit the setup's scene.
    """

    node = interface.PLANNER
    recorded = topics.PROCEDURES
    time_limit = 600.0  # s of simulated time, as in a campaign

    def __init__(self, name: str, setup: Setup) -> None:
        procedure = read_procedure(name)
        setup.planner.planner(setup.scene).check(procedure)
        scene = ("-p", f"scene:={find_file('scene', procedure.scene).resolve()}") if procedure.scene else ()
        self.arguments = (*scene, *live.FORECAST)
        self.result: dict[str, Any] = {"procedure": procedure.name, "state": "not begun", "reason": "", "goals_met": 0}
        self.result |= {"goals": len(procedure.goals), "min_clearance_m": None}
        self._file = str(find_file("procedure", name).resolve())
        self._client: clients.ProcedureClient | None = None  # once the graph runs
        self._went_on = math.inf  # monotonic time until which it was not paused [s]

    def poll(self, recorder: clients.Recorder) -> None:
        """Take what is new."""
        if self._client is None:
            self._client = clients.ProcedureClient(recorder.node, self._file)
        self._client.poll()
        status, result = self._client.status, self._client.result
        if status is not None:
            self.stage = 2
            self.share = (status.goals_met + status.progress) / self.result["goals"]
            self.result["min_clearance_m"] = finite_or_none(status.clearance)
            if status.state != status.STATE_PAUSED or status.resumes:
                self._went_on = time.monotonic()
        for report in (status, result):
            if report is not None:
                state = clients.procedure_state(report)
                self.result |= {"state": state, "reason": report.reason, "goals_met": report.goals_met}
        if time.monotonic() > self._went_on + MAX_PAUSE:
            self.stuck = f"nobody resumes the procedure: {self.result['reason']}"
        self.ended = result is not None

    def problem(self, elapsed: float, recorder: clients.Recorder) -> str:
        """Return what to report of a run that does not end."""
        if self.stage == 0:
            return (self._client and self._client.refusal) or "no needle planner"
        reason = f": {self.result['reason']}" if self.result["reason"] else ""
        return f"{self.result['state']} after {elapsed:.0f} s{reason}"


@dataclass
class _Run:
    """One run of the graph; see `simulate`."""

    setup: Setup
    believed: RigSettings
    task: _Task
    duration: float | None
    rate: float | None
    boards: bool
    log: Log
    progress: Progress

    def write(self, output: Path) -> str:
        """Run the graph into a bag, which stays whatever comes of it; return why a task with a result did not end.

        Raises:
            ConfigurationError: the camera's frames are not compressed.
            GraphError: another task did not end.
            KeyboardInterrupt: interrupted.
        """
        transport = self.setup.vision.image_transport
        if transport != "compressed":
            expectation = "compressed: the bag must hold what the tracker saw"
            raise ConfigurationError("vision_tracker.image_transport", transport, expectation, str(self.setup.path))
        with whole_folder(output, is_recording=True) as folder:
            problem = self._record(folder, output.name)
        if problem is None:
            raise KeyboardInterrupt
        if problem and self.task.result is None:
            raise GraphError(problem)
        return problem

    def _record(self, folder: Path, name: str) -> str | None:
        """Run the graph and record it; return what went wrong, empty if nothing did, None if interrupted."""
        setup, task = self.setup, self.task
        arguments = ["--params-file", str(setup.path.resolve()), *live.OWN, *task.arguments]
        arguments += live.arguments_of(changed_parameters(setup.rig, self.believed))
        if self.rate is not None:
            arguments += live.arguments_of({"use_sim_time": "true", "rig_simulator:rate": float(self.rate)})
        text, what = setup.path.read_text(encoding="utf-8"), f"the whole rig, closed loop, setup {setup.name}"
        notes = {"setup": setup.name, SETUP_NOTE: text, "simulated": what}
        every = (*topics.INPUTS, *topics.OUTPUTS, *topics.SIMULATED, *topics.SETTINGS, *task.recorded)
        recorded = [topic for topic in every if topic is not topics.IMAGE]
        rig = (interface.SCENE_SERVER, "rig_simulator")
        nodes, processes = ", ".join((*rig, *interface.NODES)), (*rig, *interface.PROCESSES)
        with BagWriter(folder, notes, name=name) as bag, TemporaryDirectory() as ports:
            bridge = {"coil_bridge:driver": "simulated", "coil_bridge:autostart": "armed"}
            bridge = _wired(ports, len(setup.coils.coil_angles)) if self.boards else bridge
            if not task.node:
                write_scene(setup.scene, Path(ports) / "scene.yaml")
                bridge |= {"scene": f"{ports}/scene.yaml", "coil_bridge:autostart": "active"}
            arguments += live.arguments_of(bridge)
            for topic in recorded:
                bag.add_topic(topic.channel.recorded, topic.channel.type_name)
            with live.own_graph(processes, arguments, folder / "logs", nodes, self.log) as graph:
                sink = _Sink(bag)
                with clients.Recorder(graph.domain, recorded, sink.receive, self.rate is not None) as recorder:
                    return self._run(graph, recorder, sink)

    def _run(self, graph: live.OwnGraph, recorder: clients.Recorder, sink: _Sink) -> str | None:
        with graph.interruption:
            _wait(recorder, graph.check, self.log)
        if self.boards and self.task.node:
            _arm()
        if not self.task.node:
            self.log(f"for others: export ROS_DOMAIN_ID={graph.domain} ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST")
        self.log("running" if self.rate is None else f"running at {self.rate:g} times the speed")
        sink.running = True
        try:
            # For bridge and recorder: on a busy machine the recorder finds who steers up to 3 s after the bridge does,
            # and the bag would lack the start.
            if self.task.node:
                graph.nodes.start(self.task.node, arguments=("-p", f"{self.task.node}:audience:=2"))
            with graph.interruption:
                return self._steer(recorder, graph.check)
        except KeyboardInterrupt:
            return None  # passed on once the bag is whole

    def _steer(self, recorder: clients.Recorder, check: Callable[[], None]) -> str:
        """Record until the path or procedure is done, or the time is over; return what went wrong."""
        task, rate, duration = self.task, self.rate or 1.0, self.duration
        stage, began = 0, time.monotonic()
        while True:
            check()
            recorder.spin(live.POLL_PERIOD)
            task.poll(recorder)
            if task.stage > stage:
                stage, began = task.stage, time.monotonic()
            elapsed = (time.monotonic() - began) * (rate if stage else 1.0)
            self.progress(task.share if duration is None else min(1.0, elapsed / duration) * bool(stage))
            fault = recorder.status_texts.get("coil_bridge", ("", {}))[0]
            stuck = f"coil_bridge: {fault}" if task.node and fault.startswith("fault: ") else task.stuck
            if task.ended or stuck:  # after which the needle rests for good
                recorder.spin(0.5 / rate)
                return "" if task.ended else stuck
            if duration is not None and stage and elapsed > duration + (EXTRA_TIME if stage == 1 else 0.0):
                return ""
            if elapsed > (task.time_limit if stage else live.START_TIMEOUT):
                return task.problem(elapsed, recorder)


class _Sink:
    """Writes what comes while the run is on; of before, only what is published once, at the bag's start."""

    def __init__(self, bag: BagWriter) -> None:
        self.running = False
        self._bag = bag
        self._early: dict[str, bytes] = {}
        self._begin: int | None = None

    def receive(self, topic: str, arrival: int, data: bytes) -> None:
        """Take a message."""
        if not self.running:
            if topic in (interface.SCENE.recorded, interface.SCENE_MARKERS.recorded):
                self._early[topic] = data
            return
        if self._begin is None:
            self._begin = arrival
            for name, content in self._early.items():
                self._bag.write(name, arrival, content)
        # What waited elsewhere may have arrived before: the scene is the bag's first message all the same.
        self._bag.write(topic, max(arrival, self._begin + 1), data)


def _arm() -> None:
    """Arm the bridge as soon as its boards are ready."""
    try:
        with clients.CoilClient() as client:
            client.execute_within(15.0, "arm")
    except GraphError as error:
        raise GraphError(f"the bridge cannot be armed: {error}") from None


def _wired(folder: str, coils: int) -> dict[str, str]:
    """Return the parameters under which bridge and rig meet at simulated boards, of two coils each."""
    ports = json.dumps([f"{folder}/board_{index}" for index in range(coils // 2)])
    return {
        "coil_bridge:driver": "roboclaw",
        "coil_bridge:autostart": "active",
        "coil_bridge:roboclaw_ports": ports,
        "coil_bridge:roboclaw_addresses": json.dumps(board_addresses(coils // 2)),
        # Simulated boards share the processor with the graph, where real ones have their own. One that got no
        # processor for 75 ms, as happens with two busy cores, would be taken for dead.
        "coil_bridge:roboclaw_answer_timeout": "0.2",
        "coil_bridge:driver_timeout": "0.5",
        "rig_simulator:power_stage": "roboclaw",
        "rig_simulator:power_stage_ports": ports,
    }


def _wait(recorder: clients.Recorder, check: Callable[[], None], log: Log) -> None:
    """Wait until every topic on which something comes before a run begins has a publisher, then for a prediction.

    On a busy machine the first frames take tracker and model a second or more; a run that had begun would lack them.
    """
    commanded = (topics.NEEDLE_COMMAND, topics.OPERATOR_COMMAND, topics.NEEDLE_TIP, topics.FAULT_REQUEST)
    others = (topics.TIP_SETPOINT, topics.MATERIAL, topics.FORECAST, *topics.PROCEDURES)
    optional = {topic.name for topic in (*commanded, *others)}
    deadline, logged = time.monotonic() + live.START_TIMEOUT, set[str]()
    while missing := [name for name in recorder.silent() if name not in optional]:
        check()
        live.log_compiling({name: text for name, (text, _) in recorder.status_texts.items()}, logged, log)
        if time.monotonic() > deadline:
            raise GraphError(f"after {live.START_TIMEOUT:g} s nobody is at {', '.join(missing)}")
        recorder.spin(live.POLL_PERIOD)
    deadline = time.monotonic() + 10.0  # where the needle cannot be tracked, there is none
    while not recorder.taken[interface.PREDICTED_THREAD.recorded] and time.monotonic() < deadline:
        check()
        recorder.spin(live.POLL_PERIOD)
    recorder.spin(1.0)  # for all nodes to have found each other
