"""A rig that runs, as a bench: pulses through its coil bridge, and a needle that its own tracker follows."""

from __future__ import annotations

import asyncio
import math
import os
import signal
import socket
import time
from collections.abc import Callable, Coroutine, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from magnetosuture_msgs.msg import CoilBridgeState
from magnetosuture_msgs.srv import GivePulse
from numpy.typing import NDArray
from rclpy.parameter import Parameter

from magnetosuture_thread import ConfigurationError, InvalidInputError, Scene
from magnetosuture_thread.bags import reading
from magnetosuture_thread.bags.packing import packed_scene, packed_twist
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.calibration.commission import AFTER, BEFORE, PATIENCE
from magnetosuture_thread.calibration.needle_length import find_needle_length
from magnetosuture_thread.calibration.pulse_model import Pulse
from magnetosuture_thread.calibration.square import Square, TipPath
from magnetosuture_thread.calibration.stop_checks import RESTING, TO_REST, TRIES
from magnetosuture_thread.coils.pulses import IS_OVER, STOOD_STILL
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.evaluation.recorded import SETUP_NOTE
from magnetosuture_thread.geometry.needle_arc import heading_angle
from magnetosuture_thread.nodes import clients, topics
from magnetosuture_thread.nodes.coil_bridge import PROCESS
from magnetosuture_thread.nodes.node import read_report
from magnetosuture_thread.rig.setups import Setup
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.configuration import Configuration, to_mapping
from magnetosuture_thread.settings.errors import GraphError
from magnetosuture_thread.settings.files import whole_folder
from magnetosuture_thread.settings.interface import Service
from magnetosuture_thread.vision.images import image_of
from magnetosuture_thread.vision.lens import lens_of

Vector = NDArray[np.float64]

BRIDGE, TRACKER, MODEL = "coil_bridge", "vision_tracker", "thread_model"


class LiveBench(clients.CoilClient):
    """See `Bench` and `StopBench`. While it is open the bridge is armed; at its end all is as it was, and disarmed.

    Nodes are changed by their lifecycle and parameters, as by `ros2 lifecycle set` and `ros2 param set`.

    Args:
        setup: what is believed, and what the nodes were started with.
        check: called all the time; raises what interrupts.
        namespace: of the graph.

    Attributes:
        needle_length: as the camera measures it [m].
        driver_timeout: after which the boards stop by themselves [s].

    Raises:
        ConfigurationError: the bridge does not commission.
        GraphError: bridge, tracker or camera are not there, or something stops the coils.
        InvalidInputError: no needle is seen.
    """

    def __init__(self, setup: Setup, check: Callable[[], None], namespace: str = "") -> None:
        super().__init__(namespace)
        self._setup, self._check = setup, check
        self._poses: list[tuple[float, Vector]] = []  # stamp and pose
        self._texts: dict[str, tuple[str, dict[str, str]]] = {}  # state of each node, and its values
        self._before: dict[str, dict[str, Any]] = {}  # parameters of nodes that were changed
        kinds = clients.services_to_restart(BRIDGE, TRACKER, MODEL)
        self._calls = clients.Services(self.node, {**kinds, Service.PULSE: Service.PULSE.type_name})
        self._measured = clients.Inbox(self.node, topics.NEEDLE_POSE, 1000)
        self._given = clients.Inbox(self.node, topics.CURRENTS, 1000)
        self._reports = clients.Inbox(self.node, topics.DIAGNOSTICS, 100)
        self._commands = topics.NEEDLE_COMMAND.publisher(self.node)
        try:
            self._begin()
        except BaseException:
            self.close()
            raise

    def pulse(self, currents: Vector, seconds: float) -> Pulse:
        """Give currents for a time, then zeros; see `Bench`.

        Raises:
            GraphError: the bridge has disarmed, and why; or it stood still again and again.
        """
        for _ in range(TRIES):
            pulse = self._pulse(currents, seconds)
            state = self._wait_for_state()
            if not state.armed:
                raise GraphError(f"coil_bridge: {pulse.ended or '; '.join(state.reasons)}")
            if not pulse.ended.startswith(STOOD_STILL):  # for then nobody knows when the boards stopped
                return pulse
        raise GraphError(f"coil_bridge: {pulse.ended}")

    def follow_square(self, coils: CoilBridgeSettings) -> tuple[float, str]:
        """Steer the needle's tip slowly around a square; see `Bench`. After it the bridge gives no pulses."""
        square = Square(coils, self._setup.scene.dish.radius)
        self._restart(BRIDGE, {**_changes(self._setup.coils, square.settings), "commissioning": False})
        return self._steer(square)

    def _steer(self, path: TipPath, each: Callable[[], None] = lambda: None) -> tuple[float, str]:
        """Steer the needle's tip along a path, armed; return `TipPath.result`. `each` is called all the time."""
        self._await_pose(self._now())
        # The clock of a simulated rig may go at half the speed.
        fault, last, end = "", self._now(), time.monotonic() + 2.0 * path.time_limit
        try:
            self.execute("arm")
            while not (path.done or fault or time.monotonic() > end):
                self.turn()
                each()
                for stamp, pose in [entry for entry in self._poses[-8:] if entry[0] > last]:
                    last = stamp
                    velocity = path.command(stamp, pose, self._now() - stamp)
                    self._commands.publish(packed_twist(self.node.get_clock().now().to_msg(), velocity))
                if self._state.poll() and self._state.value.state == CoilBridgeState.STATE_FAULT:
                    fault = "; ".join(self._state.value.reasons)
        finally:
            self.execute("disarm")
        return path.result(fault)

    def disturbed_pulse(
        self, currents: Vector, seconds: float, after: float, disturbance: Any, hold: float
    ) -> tuple[Pulse, float, float]:
        """Give currents, and disturb for a while once they have flowed for a time; see `StopBench`."""
        times = [0.0, 0.0]

        def disturb() -> None:
            self.wait(after)
            with disturbance:
                times[0] = self._now()
                self.wait(hold)
                times[1] = self._now()

        return self._pulse(currents, seconds, disturb, hold + TO_REST + RESTING), times[0], times[1]

    @contextmanager
    def stopped(self) -> Iterator[None]:
        """Press the emergency stop."""
        self.execute("stop")
        yield

    @contextmanager
    def blind(self) -> Iterator[None]:
        """Let no poses come."""
        try:
            self._change(TRACKER, Transition.TRANSITION_DEACTIVATE)
            yield
        finally:
            self._change(TRACKER, Transition.TRANSITION_ACTIVATE)

    def frozen(self) -> Any:
        """Let the bridge's process stand still; None where it runs on another computer."""
        host, _, process = self._report(BRIDGE)[1].get(PROCESS, "").rpartition(" ")
        command = Path("/proc") / process / "cmdline"
        with suppress(OSError):
            if host == socket.gethostname() and process.isdigit() and BRIDGE.encode() in command.read_bytes():
                return _stopped(int(process))
        return None

    def recover(self, causes: tuple[str, ...]) -> None:
        """Reset what a check has latched, and arm; see `StopBench`.

        Raises:
            GraphError: something else is latched, or somebody has disarmed.
        """
        state = self._wait_for_state()
        if state.armed:
            return
        if not any(reason.startswith(cause) for reason in state.reasons for cause in causes):
            raise GraphError(f"coil_bridge: {'; '.join(state.reasons)}")
        self.execute_within(clients.TIMEOUT, "reset", "arm")  # boards that were lost are connected again

    def _begin(self) -> None:
        """Check what has to be, measure the needle, and arm."""
        state = self._wait_for_state()
        self.wait(clients.DISCOVERY_TIME)
        commissioning, self.driver_timeout = self._parameters(BRIDGE, "commissioning", "driver_timeout")
        if not commissioning:
            name, expected = f"{BRIDGE}.commissioning", "true: start the bridge by -p coil_bridge:commissioning:=true"
            raise ConfigurationError(name, False, expected)
        self._make_ready(state)
        self.needle_length = self._measure_needle()
        for node in (BRIDGE, TRACKER):
            share = float(self._parameters(node, "needle_length")[0]) / self.needle_length
            if abs(share - 1.0) > 1e-3:  # less is not worth another start of the nodes
                self._restart(node, {"needle_length": self.needle_length})
        self._await_pose(self._now())
        self.execute("arm")

    def _make_ready(self, state: CoilBridgeState) -> None:
        """Let the bridge be ready to be armed, in a state that it reports.

        Raises:
            GraphError: something is latched.
        """
        if state.state == CoilBridgeState.STATE_FAULT:
            raise GraphError(f"coil_bridge: {'; '.join(state.reasons)}")
        if state.state == CoilBridgeState.STATE_INACTIVE:  # as after a fault in a run before
            self._change(BRIDGE, Transition.TRANSITION_ACTIVATE)
        self._await_driver()
        self.callback(self._leave)

    def _leave(self) -> None:
        """Disarm, and let the nodes be as they were."""
        with suppress(GraphError):
            self.execute("disarm")
        for node in [*self._before]:
            with suppress(GraphError):
                self._set(node, self._before.pop(node))

    def _measure_needle(self) -> float:
        """Return the length of the needle by frames of the camera [m]."""
        settings = self._setup.vision
        topic = topics.COMPRESSED_IMAGE if settings.image_transport == "compressed" else topics.IMAGE
        camera, images = clients.Inbox(self.node, topic, 2), list[Any]()
        lens = clients.Latest(self.node, topics.CAMERA_INFO, lens_of)

        def look() -> bool:
            lens.poll()
            new = [image_of(message) for message, _ in camera.read()]
            images.extend(new if lens.value is None else [lens.value.undistorted(image) for image in new])
            return len(images) >= 24

        self.wait_for(look, lambda: GraphError(f"{len(images)} frames of the camera within {clients.TIMEOUT:g} s"))
        for inbox in (camera, lens):
            inbox.close()
        return find_needle_length(images, settings, Scene(self._setup.scene.dish))

    def _pulse(
        self, currents: Vector, seconds: float, during: Callable[[], None] = lambda: None, longer: float = 0.0
    ) -> Pulse:
        """Give currents; `during` is called once they flow, after which the needle is watched for longer [s]."""
        self._await_pose(self._now() - BEFORE)
        self._poses = self._poses[-30:]
        on, ended = self._now(), ""
        if currents.any():
            self._ask_for(currents, seconds)
            during()
            on, off, ended = self._await_end(seconds)
        else:
            self.wait(seconds)
            off = self._now()
        self._await_pose((max(off, self._now()) if longer else off) + max(AFTER, longer))
        frames = [(stamp, pose) for stamp, pose in self._poses if stamp > on - BEFORE]
        times, poses = zip(*frames, strict=True)
        return Pulse(np.array(currents), on, off, np.array(times), np.array(poses), "" if ended == IS_OVER else ended)

    def _ask_for(self, currents: Vector, seconds: float) -> None:
        """Let the bridge begin a pulse; a needle that has turned fast may have no pose for a moment, and coils rest.

        Raises:
            GraphError: it is refused for something else, or somebody has stopped or disarmed the bridge.
        """
        deadline = time.monotonic() + clients.TIMEOUT
        for _ in self._given.take():
            pass
        while True:
            request = GivePulse.Request(current=currents.tolist(), duration=seconds)
            answer = self._ask(Service.PULSE, request)
            if answer.success:
                return
            if time.monotonic() > deadline or not self._wait_for_state().armed:  # somebody wants the coils to stay off
                refused = self._report(BRIDGE)[1].get("last refusal", "")
                raise GraphError(answer.message + (f"; refused last: {refused}" if "pose" in answer.message else ""))
            self._await_pose(self._now())

    def _await_end(self, seconds: float) -> tuple[float, float, str]:
        """Return when currents began and ended by the bridge's clock [s], and why."""
        on, patience = list[float](), seconds + PATIENCE

        def end() -> tuple[float, float, str] | None:
            for message, _ in self._given.read():
                stamp = 1e-9 * reading.nanoseconds(message.header.stamp)
                if np.any(message.current):
                    on.append(stamp)
                elif on:
                    return on[0], stamp, message.stop
            return None

        problem = f"{Service.PULSE}: no end of the currents within {patience:g} s"
        return self.wait_for(end, lambda: GraphError(problem), patience)

    def _await_pose(self, since: float) -> None:
        """Wait for a pose of after a time [s]."""

        def failed() -> InvalidInputError:
            reason = self._report(TRACKER)[0]
            return InvalidInputError("needle", f"no pose for {PATIENCE:g} s: {reason}", "one in every frame")

        patience = PATIENCE + max(0.0, since - self._now())
        self.wait_for(lambda: self._poses and self._poses[-1][0] > since, failed, patience)

    def turn(self) -> None:
        """Wait for a moment, and take what has come."""
        self._check()
        super().turn()
        for report, _ in self._reports.read():
            self._texts |= read_report(report)
        for message, _ in self._measured.read():
            with suppress(InvalidInputError):
                pose = reading.needle_pose(message)
                angle = heading_angle(pose.heading)
                if self._poses:
                    last = self._poses[-1][1][2]
                    angle = last + math.remainder(angle - last, math.tau)
                self._poses.append((pose.stamp, np.array([*pose.tail, angle])))

    def _report(self, node: str) -> tuple[str, dict[str, str]]:
        """Return the state of a node and its values, as it reported them."""
        name = f"{self.node.get_namespace()}/{node}".strip("/")
        return self._texts.get(name, (f"no {name}", {}))

    def _now(self) -> float:
        return float(self.node.get_clock().now().nanoseconds) * 1e-9

    def _run(self, calls: Coroutine[Any, Any, Any]) -> Any:
        """Return what comes of calls of services, unless somebody interrupts."""
        result = asyncio.run(calls)
        self._check()
        return result

    def _ask(self, name: str, request: Any) -> Any:
        """Return the answer of a service, which is called once."""
        return self._run(self._calls.call(name, request, timeout=clients.TIMEOUT, retry_period=math.inf))

    def _parameters(self, node: str, *names: str) -> list[Any]:
        return [*self._run(clients.parameters_of(self._calls, node, names)).values()]

    def _restart(self, node: str, values: Mapping[str, Any]) -> None:
        """Give a node other parameters, by its lifecycle."""
        if not values:
            return
        before = dict(zip(values, self._parameters(node, *values), strict=True))
        self._before[node] = before | self._before.get(node, {})
        self._set(node, values)

    def _set(self, node: str, values: Mapping[str, Any]) -> None:
        self._require(self._run(clients.restart(self._calls, node, values)), node)
        if node == BRIDGE:
            self._await_driver()

    def _await_driver(self) -> None:
        """Wait until the bridge can be armed."""

        def is_ready() -> bool:
            if not self._state.poll():
                return False
            state = self._state.value
            return state.state == CoilBridgeState.STATE_ACTIVE and bool(state.driver_ready and state.scene_version)

        self.wait_for(is_ready, lambda: GraphError(f"coil_bridge: {self._report(BRIDGE)[0]}"))

    def _change(self, node: str, transition: int) -> None:
        """Make a transition of a node.

        Raises:
            GraphError: it was refused.
        """
        request = ChangeState.Request(transition=Transition(id=transition))
        self._require(self._ask(f"{node}/{clients.CHANGE}", request).success, node)

    def _require(self, success: bool, node: str) -> None:
        """Raise a `GraphError` with what a node reports of itself where it has refused something."""
        if not success:
            self.wait(0.2)  # for the reason, on /diagnostics
            raise GraphError(f"{node}: {self._report(node)[0]}")


class LiveThreadBench(LiveBench):
    """See `ThreadBench`: a rig that runs with the setup of its commissioning, a thread at the needle, in an empty dish.

    Its clock is the rig's, also where that is a simulated one.

    Raises:
        ConfigurationError: the scene of the rig is not the setup's.
        GraphError: bridge, tracker or thread model are not there, or something stops the coils.
    """

    def follow(self, path: TipPath, setup: Setup, bag: Path) -> tuple[float, str]:
        """Steer the tip along a path with a setup, and record it; see `ThreadBench`."""
        self._restart(BRIDGE, _changes(self._setup.coils, setup.coils))
        self._restart(MODEL, _changes(self._setup.model, setup.model))
        topic_names = topics.NEEDLE_POSE, topics.MEASURED_THREAD, topics.CURRENTS
        inboxes = [clients.Inbox(self.node, topic, 1000) for topic in topic_names]
        notes = {"setup": setup.name, SETUP_NOTE: setup.path.read_text(encoding="utf-8")}
        with whole_folder(bag) as folder, BagWriter(folder, notes, name=bag.name) as writer:
            for channel in (interface.SCENE, *(inbox.topic.channel for inbox in inboxes)):
                writer.add_topic(channel.recorded, channel.type_name)
            now = self.node.get_clock().now().nanoseconds
            writer.write(interface.SCENE.recorded, now, packed_scene(now, setup.scene))

            def keep() -> None:
                for inbox in inboxes:
                    for data, arrived in inbox.take():
                        when = self.node.get_clock().now().nanoseconds if self._is_simulated else arrived
                        writer.write(inbox.topic.channel.recorded, when, data)

            try:
                return self._steer(path, keep)
            finally:
                for inbox in inboxes:
                    inbox.close()

    def _begin(self) -> None:
        state = self._wait_for_state()
        self.wait(clients.DISCOVERY_TIME)
        self._is_simulated = bool(self._parameters(BRIDGE, "use_sim_time")[0])
        self.node.set_parameters([Parameter("use_sim_time", value=self._is_simulated)])
        self.wait_for(lambda: self._now() > 0.0, lambda: GraphError("clock: no time of the rig"))
        self._make_ready(state)
        found, version = self._state.value.scene_version, self._setup.scene.version
        if found != version:
            raise ConfigurationError("scene of the rig", found, f"{version}, the setup's dish without shapes")
        self.needle_length = self._setup.coils.needle_length


def _changes(before: Configuration, after: Configuration) -> dict[str, Any]:
    """Return the parameters of a node that differ, as they are after."""
    believed = to_mapping(before)
    return {name: value for name, value in to_mapping(after).items() if value != believed[name]}


@contextmanager
def _stopped(process: int) -> Iterator[None]:
    """Let a process stand still."""
    os.kill(process, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(process, signal.SIGCONT)
