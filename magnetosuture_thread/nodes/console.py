"""The node `console`: serves the operator page for a running graph; states in, jog commands and services out."""

from __future__ import annotations

import asyncio
import math
import signal
import sys
import time
from typing import Any

import numpy as np
import rclpy
from magnetosuture_msgs.srv import PlanProcedure
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from rclpy.time import Time
from sensor_msgs.msg import CompressedImage, Image
from std_srvs.srv import SetBool, Trigger

from magnetosuture_thread import MagnetosutureError, read_scene
from magnetosuture_thread.bags.packing import packed_header, packed_point, packed_twist
from magnetosuture_thread.console.server import ConsoleServer, serve_until
from magnetosuture_thread.console.settings import ConsoleSettings
from magnetosuture_thread.nodes import console_state as page
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.clients import Inbox, Latest, Services
from magnetosuture_thread.nodes.executor import KeptWaitSetExecutor
from magnetosuture_thread.nodes.node import MAX_REASON_CHARS, GuardedNode
from magnetosuture_thread.nodes.parameters import declare, init
from magnetosuture_thread.nodes.program import end_signals
from magnetosuture_thread.planning.procedure import read_procedure
from magnetosuture_thread.rig.camera import encode_jpeg
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.errors import GraphError, shortened
from magnetosuture_thread.settings.files import shipped_names
from magnetosuture_thread.settings.interface import Service
from magnetosuture_thread.vision.images import image_of

NAME = "console"
RIG = "rig_simulator"
DROP_TIMEOUT = 60.0  # s without diagnostics, after which a node that is none of ours is no longer shown
MAX_NODES = 32  # shown

ACTIONS: dict[str, tuple[str, Any]] = {
    "arm": (Service.ARM, SetBool.Request(data=True)),
    "disarm": (Service.ARM, SetBool.Request(data=False)),
    "stop": (Service.EMERGENCY_STOP, Trigger.Request()),
    "reset": (Service.RESET, Trigger.Request()),
}
PROCEDURE_ACTIONS = {
    "resume": Service.RESUME_PROCEDURE,
    "pause": Service.PAUSE_PROCEDURE,
    "abort": Service.ABORT_PROCEDURE,
}
# Parts of the state: the topic, what reads its messages, how seldom [s], and whether the part has its age. Paths and
# forecasts take a millisecond to read, a large scene more.
READERS = {
    "tracker": (topics.TRACKER_STATE, page.tracker, 0.0, True),
    "needle": (topics.NEEDLE_POSE, page.needle, 0.0, True),
    "measured": (topics.MEASURED_THREAD, page.measured_thread, 0.1, False),
    "predicted": (topics.PREDICTED_THREAD, page.predicted, 0.0, True),
    "estimated": (topics.ESTIMATED_THREAD, page.estimated, 0.0, True),
    "forecast": (topics.FORECAST, page.forecast, 0.1, True),
    "margins": (topics.MARGINS, page.margins, 0.0, False),
    "scene": (topics.SCENE, page.scene, 0.5, False),
    "filter": (topics.FILTER_STATE, page.filter_state, 0.0, True),
    "bridge": (topics.BRIDGE_STATE, page.bridge, 0.0, True),
    "procedure": (topics.PROCEDURE_STATE, page.procedure, 0.0, False),
    "plan": (topics.PROCEDURE_PLAN, page.plan, 0.0, False),
}
RECORDED_TOPICS = tuple(
    dict.fromkeys((*topics.INPUTS, *topics.OUTPUTS, *topics.SIMULATED, *topics.SETTINGS, *topics.PROCEDURES))
)


class ConsoleGraph:
    """Implementation of `console.client.Graph` over ROS.

    Nothing runs between two calls: messages are queued in the middleware until `spin`.

    Args:
        node: in the graph, and in an executor that nobody else spins.
        settings: of the page.

    Attributes:
        node: as given.
        settings: in force.
        services: that the page calls.
        blocked: why commands are blocked now; empty if they are not.

    Raises:
        ConfigurationError: the settings' scene cannot be read.
    """

    def __init__(self, node: Node, settings: ConsoleSettings) -> None:
        self.node = node
        self.blocked = ""
        offered_by = ("coil_bridge", interface.PLANNER, "replay", RIG)
        called = [each for each in Service if each.node in offered_by]
        self.services = Services(node, {each: topics.ros_class(each.type_name) for each in called})
        self._action = 0  # number of the latest
        self._commands = topics.OPERATOR_COMMAND.publisher(node)
        self._holds = topics.PROCEDURE_HOLD.publisher(node)
        self._tips = topics.NEEDLE_TIP.publisher(node)
        self._procedures = {name: read_procedure(name).shape_names for name in shipped_names("procedure")}
        self._number = 0
        self._open(settings, _file_scene(settings))

    def begin(self, settings: ConsoleSettings) -> None:
        """Restart: drop all states, for a graph whose nodes were restarted.

        Raises:
            ConfigurationError: the settings' scene cannot be read; nothing is changed.
        """
        scene = _file_scene(settings)
        for latest in (*self._latest.values(), self._camera):
            latest.close()
        self._reports.close()
        self._open(settings, scene)

    def publish_velocity(self, velocity: tuple[float, float]) -> None:
        """Publish an operator velocity command; nothing while commands are blocked."""
        if not self.blocked:
            self._commands.publish(packed_twist(self.now().to_msg(), np.asarray(velocity, dtype=float)))

    def publish_hold(self) -> None:
        """Publish that the page is held; nothing while commands are blocked."""
        if not self.blocked:
            self._holds.publish(packed_header(self.now().to_msg()))

    async def point_at_tip(self, position: tuple[float, float]) -> str:
        """Tell the tracker of a point near the needle's tip [m]; return an empty text, or the reason of a refusal."""
        if not self.blocked:
            self._tips.publish(packed_point(self.now().to_msg(), np.asarray(position, dtype=float)))
        return self.blocked

    async def execute_procedure(self, action: str, procedure: str, hold_to_run: bool) -> str:
        """Plan, resume, pause or abort a procedure; return an empty text, or the reason of a refusal."""
        if self.blocked:
            return self.blocked
        if action != "plan":
            return await self.call(PROCEDURE_ACTIONS[action], Trigger.Request())
        request = PlanProcedure.Request(procedure=procedure, hold_to_run=hold_to_run)
        # A long way takes some seconds, and is planned once.
        return await self.call(Service.PLAN_PROCEDURE, request, timeout=60.0, retry_period=math.inf)

    async def execute_action(self, action: str) -> str:
        """Arm, disarm, stop or reset; return an empty text, or the reason of a refusal.

        The emergency stop is never blocked. The latest action cancels one that still waits for its answer.
        """
        if action not in ACTIONS:
            return f"action: got {action!r}, expected one of {', '.join(ACTIONS)}"
        if self.blocked and action != "stop":
            return self.blocked
        self._action += 1
        number = self._action
        return await self.call(*ACTIONS[action], is_wanted=lambda: number == self._action)

    async def call(self, name: str, request: Any, **options: Any) -> str:
        """Call a service; return an empty text, the reason of a refusal, or what is wrong all the same."""
        try:
            answer = await self.services.call(name, request, **options)
        except GraphError as error:
            return str(error)
        if answer is None:
            return "cancelled by a later action"
        text = shortened(str(answer.message), MAX_REASON_CHARS)
        if not answer.success:
            return text or "refused"
        return "" if name in (Service.PAUSE_REPLAY, Service.PAUSE_RIG) else text  # that time is paused is no remark

    def state(self) -> dict[str, Any]:
        """Return the present state; see `console.client.Graph`."""
        self.spin()
        parts: dict[str, Any] = {}
        for name, latest in self._latest.items():
            latest.poll()
            parts[name] = latest.aged() if READERS[name][3] else latest.value
        needle, parts["axis"] = parts["needle"], None
        if needle is not None and not needle.pop("directed"):
            parts["needle"], parts["axis"] = None, needle
        for name in ("measured", "plan"):
            parts[name] = parts[name] or []
        if self.blocked:
            rest = {"commanded": [0.0, 0.0], "filtered": [0.0, 0.0], "applied": [0.0, 0.0]}
            why = {"active": [], "overridden": "", "reason": self.blocked}
            parts["filter"] = {"source": "", **rest, "slowdown": 1.0, **why, "age": 0.0}
        shown_scene = parts["scene"] or self._scene
        shapes = {shape["name"] for shape in shown_scene["shapes"]} if shown_scene else set()
        return {
            "time": self.now().nanoseconds * 1e-9,
            "needle_length": self.settings.needle_length,
            "needle_curvature": self.settings.needle_curvature,
            **parts,
            "camera": None if self._camera.value is None else {"age": self._camera.age},
            "scene": shown_scene,
            "procedures": [name for name, needed in self._procedures.items() if needed <= shapes],
            "nodes": self.nodes(),
        }

    def nodes(self) -> dict[str, dict[str, Any]]:
        """Return the last diagnostics of each node by its name in this graph's namespace, and their age.

        The nodes of this package stay, but for those of other rigs, which are left out; of all others the latest are
        kept, for a while.
        """
        self.spin()
        space, now = self.node.get_namespace().strip("/"), time.time_ns()
        for report, arrived in self._reports.read():
            for status in report.status[:MAX_NODES]:
                name = _name_within(space, shortened(status.name.split(":")[0]))
                if name:
                    self._diagnostics[name] = (page.node_state(status), arrived)
        others = sorted(
            self._diagnostics.keys() - set(interface.ALL_NODES), key=lambda name: self._diagnostics[name][1]
        )
        for number, name in enumerate(others):
            too_many = number < len(others) + len(interface.ALL_NODES) - MAX_NODES
            if too_many or now - self._diagnostics[name][1] > DROP_TIMEOUT * 1e9:
                del self._diagnostics[name]
        found: dict[str, dict[str, Any]] = {}
        for name, (status, arrived) in sorted(self._diagnostics.items()):
            age = max(0.0, (now - arrived) * 1e-9)
            found[name] = {**status, "level": "silent" if age > 3.0 else status["level"], "age": age}
        return found

    def is_active(self, name: str) -> bool:
        """Return whether a node publishes diagnostics now."""
        return any(node == name and about["level"] != "silent" for node, about in self.nodes().items())

    def frame(self) -> tuple[int, bytes] | None:
        """Return number and JPEG or PNG bytes of the latest camera frame; a raw one is encoded here."""
        self.spin()
        if self._camera.poll():
            self._number += 1
        return None if self._camera.value is None else (self._number, self._camera.value)

    def now(self) -> Time:
        """Return the graph's time."""
        return self.node.get_clock().now()

    def spin(self) -> None:
        """Take what has come, and answer requests."""
        self.node.executor.spin_some()

    def _open(self, settings: ConsoleSettings, scene: dict[str, Any] | None) -> None:
        self.settings, self._scene = settings, scene
        self._latest = {
            name: Latest(self.node, topic, read, period, max_bytes=1 << 18)
            for name, (topic, read, period, _) in READERS.items()
        }
        self._reports = Inbox(self.node, topics.DIAGNOSTICS, 50)
        self._diagnostics: dict[str, tuple[dict[str, Any], int]] = {}
        raw = settings.image_transport == "raw"
        image, read = (topics.IMAGE, _encoded) if raw else (topics.COMPRESSED_IMAGE, _compressed)
        self._camera = Latest(self.node, image, read)


def _name_within(space: str, name: str) -> str:
    """Return a node's name without the namespace of the graph, empty for a node of a rig in another namespace.

    /diagnostics is one topic for all rigs of a ROS domain.
    """
    inside = name.removeprefix(f"{space}/") if space else name
    is_ours = inside.rpartition("/")[2] in (*interface.ALL_NODES, NAME)
    is_elsewhere = "/" in inside or (bool(space) and inside == name)
    return "" if is_ours and is_elsewhere else inside


def _file_scene(settings: ConsoleSettings) -> dict[str, Any] | None:
    """Return the scene to show until one is received; None where the settings name none."""
    return page.shown_scene(read_scene(settings.scene)) if settings.scene else None


def _compressed(message: CompressedImage) -> bytes:
    return bytes(message.data)


def _encoded(message: Image) -> bytes:
    return encode_jpeg(image_of(message), 80).tobytes()


class GraphHost:
    """Host of a graph that is already running: setups cannot be selected, and time pauses only if its nodes can.

    Args:
        graph: to serve.
    """

    mode = "graph"

    def __init__(self, graph: ConsoleGraph) -> None:
        self.graph = graph
        self.paused = False

    def state(self) -> dict[str, Any]:
        """Return what is running and which requests are possible; see `console.client.Host`."""
        can_pause = bool(self._pause_service())
        self.paused = self.paused and can_pause
        return {
            "mode": self.mode,
            "setup": "",
            "setups": [],
            "can_pause": can_pause,
            "paused": self.paused,
            "can_record": False,
            "recording": "",
            "busy": "",
            "simulated": self.graph.is_active(RIG),
        }

    async def select_setup(self, setup: str) -> str:
        """Refuse: this graph is not started from the page."""
        return f"setup: got {setup!r}, expected none, as this graph is not started from the page"

    async def set_paused(self, paused: bool) -> str:
        """Pause or resume time if a node of the graph can; return the reason of a refusal."""
        name = self._pause_service()
        if not name:
            return "no node of this graph can pause time"
        refusal = await self.graph.call(name, SetBool.Request(data=paused))
        if not refusal:
            self.paused = paused
        return refusal

    async def set_recording(self, recording: bool, operator: str) -> str:
        """Refuse: this node records no bags."""
        return "the node console writes no bags; `magnetosuture console --graph` does"

    def _pause_service(self) -> str:
        """Return the service that pauses time; empty if there is none."""
        return next(
            (name for name in (Service.PAUSE_REPLAY, Service.PAUSE_RIG) if self.graph.services.ready(name)),
            "",
        )


async def _serve(node: GuardedNode, settings: ConsoleSettings) -> None:
    """Serve the page until the process is asked to end; answer the node's services and publish its health."""
    graph = ConsoleGraph(node, settings)
    node.health.ok(f"serving on {settings.address}")

    async def watch() -> None:
        graph.spin()

    def report(url: str) -> None:
        print(f"the operator's page: {url}", flush=True)

    await serve_until(end_signals(), ConsoleServer(settings, graph, GraphHost(graph)), watch, 0.05, report)


def main(arguments: list[str] | None = None) -> int:
    """Run the node as a program; return 0 when it was terminated, 1 when it could not start."""
    node = None
    for which in end_signals():  # also amid the start
        signal.signal(which, signal.default_int_handler)
    try:
        init(arguments, signal_handler_options=SignalHandlerOptions.NO)
        options = {"parameter_overrides": [Parameter("start_type_description_service", value=False)]}
        node, executor = GuardedNode(NAME, **options), KeptWaitSetExecutor()
        executor.add_node(node)
        asyncio.run(_serve(node, declare(node, ConsoleSettings, options)))
    except KeyboardInterrupt:
        return 0
    except (MagnetosutureError, ParameterException, OSError) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    finally:
        for which in end_signals():  # a second one must not interrupt what follows
            signal.signal(which, signal.SIG_IGN)
        if node is not None:
            if node.executor is not None:
                node.executor.shutdown()
            node.destroy_node()
        rclpy.try_shutdown()
    return 0
