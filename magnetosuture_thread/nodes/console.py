"""The node `console`: serves the operator page for a running graph; states in, jog commands and services out.

What the page is told of each message is at the end: pure functions that return plain types.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped, Vector3
from magnetosuture_msgs import msg
from magnetosuture_msgs.srv import PlanProcedure
from nav_msgs.msg import Path
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.time import Time
from std_srvs.srv import SetBool, Trigger

from magnetosuture_thread import Disc, InvalidInputError, Scene, SceneShape, read_scene
from magnetosuture_thread.bags.packing import forecast_events, packed_header, packed_point, packed_twist
from magnetosuture_thread.bags.reading import constant_name, heading_known, margins_of, needle_pose, parse_scene_message
from magnetosuture_thread.console.server import ConsoleServer
from magnetosuture_thread.console.settings import ConsoleSettings
from magnetosuture_thread.estimator.disturbance import disturbance_text
from magnetosuture_thread.geometry.needle_arc import heading_angle
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.clients import ACTIONS, Inbox, Latest, Services
from magnetosuture_thread.nodes.executor import KeptWaitSetExecutor
from magnetosuture_thread.nodes.node import GuardedNode
from magnetosuture_thread.nodes.parameters import declare
from magnetosuture_thread.planning.procedure import read_procedure
from magnetosuture_thread.rig.camera import encode_jpeg
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.errors import MAX_REASON_CHARS, GraphError, shortened
from magnetosuture_thread.settings.files import shipped_names
from magnetosuture_thread.thread.margins import node_clearance
from magnetosuture_thread.vision.images import image_of

NAME = "console"
RIG = "rig_simulator"
DROP_TIMEOUT = 60.0  # s without diagnostics, after which a node that is none of ours is no longer shown
MAX_NODES = 32  # shown
MAX_THREAD_NODES = 2001  # with the most segments that thread_model accepts
MAX_LISTED = 24  # entries of a list of texts or figures that are sent to the page

PAUSES = (interface.Service.PAUSE_REPLAY, interface.Service.PAUSE_RIG)
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
        pressed = (name for name in interface.Service if name.node in offered_by and name != interface.Service.PULSE)
        self.services = Services(node, {name: name.type_name for name in pressed})
        self._action = 0  # number of the latest
        self._commands = topics.OPERATOR_COMMAND.publisher(node)
        self._holds = topics.PROCEDURE_HOLD.publisher(node)
        self._tips = topics.NEEDLE_TIP.publisher(node)
        self._procedures = {name: read_procedure(name).shape_names for name in shipped_names("procedure")}
        self._number = 0
        self._inboxes: list[Inbox] = []
        self.begin(settings)

    def begin(self, settings: ConsoleSettings) -> None:
        """Begin, or restart: drop all states, for a graph whose nodes were restarted.

        Raises:
            ConfigurationError: the settings' scene cannot be read; nothing is changed.
        """
        # To show until one is received.
        scene = shown_scene(read_scene(settings.scene)) if settings.scene else None
        for inbox in self._inboxes:
            inbox.close()
        self.settings, self._scene = settings, scene
        self._latest = {
            name: Latest(self.node, topic, read, period, max_bytes=1 << 18)
            for name, (topic, read, period, _) in READERS.items()
        }
        self._reports = Inbox(self.node, topics.DIAGNOSTICS, 50)
        self._diagnostics: dict[str, tuple[dict[str, Any], int]] = {}
        raw = settings.image_transport == "raw"
        self._camera = Latest(self.node, topics.IMAGE if raw else topics.COMPRESSED_IMAGE, _jpeg if raw else _bytes)
        self._inboxes = [*self._latest.values(), self._reports, self._camera]

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
            return await self._press(action, interface.SERVICES[f"procedure/{action}"], Trigger.Request())
        request = PlanProcedure.Request(procedure=procedure, hold_to_run=hold_to_run)
        # A long way takes some seconds, and is planned once.
        return await self.call(interface.Service.PLAN_PROCEDURE, request, timeout=60.0, retry_period=math.inf)

    async def execute_action(self, action: str) -> str:
        """Arm, disarm, stop or reset; return an empty text, or the reason of a refusal.

        The emergency stop is never blocked. The latest action cancels one that still waits for its answer.
        """
        if self.blocked and action != "stop":
            return self.blocked
        self._action += 1
        number = self._action
        return await self._press(action, *ACTIONS[action], is_wanted=lambda: number == self._action)

    async def _press(self, action: str, name: str, request: Any, **options: Any) -> str:
        """Call a service, as `call`, for as long as what was pressed counts."""
        within = interface.PRESS_TIMEOUT if action in interface.STARTS else math.inf
        return await self.call(name, request, call_within=within, **options)

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
        return "" if name in PAUSES else text  # that time is paused is no remark

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
            rest = {name: [0.0, 0.0] for name in ("commanded", "filtered", "applied")}
            why = {"active": [], "overridden": "", "reason": self.blocked}
            parts["filter"] = {"source": "", **rest, "slowdown": 1.0, **why, "age": 0.0}
        parts["scene"] = parts["scene"] or self._scene
        shapes = {shape["name"] for shape in parts["scene"]["shapes"]} if parts["scene"] else set()
        return {
            "time": self.now().nanoseconds * 1e-9,
            "needle_length": self.settings.needle_length,
            "needle_curvature": self.settings.needle_curvature,
            **parts,
            "camera": None if self._camera.value is None else {"age": self._camera.age},
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
                if name := _name_within(space, shortened(status.name.split(":")[0])):
                    self._diagnostics[name] = (node_state(status), arrived)
        arrivals = {name: arrived for name, (_, arrived) in self._diagnostics.items()}
        others = sorted(arrivals.keys() - set(interface.ALL_NODES), key=arrivals.__getitem__)
        surplus = max(0, len(others) + len(interface.ALL_NODES) - MAX_NODES)
        late = [name for name in others[surplus:] if now - arrivals[name] > DROP_TIMEOUT * 1e9]
        for name in (*others[:surplus], *late):
            del self._diagnostics[name]
        nodes: dict[str, dict[str, Any]] = {}
        for name, (state, arrived) in sorted(self._diagnostics.items()):
            age = max(0.0, (now - arrived) * 1e-9)
            nodes[name] = {**state, "level": "silent" if age > 3.0 else state["level"], "age": age}
        return nodes

    def is_active(self, name: str) -> bool:
        """Return whether a node publishes diagnostics now."""
        return self.nodes().get(name, {"level": "silent"})["level"] != "silent"

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


def _name_within(space: str, name: str) -> str:
    """Return a node's name without the namespace of the graph, empty for a node of a rig in another namespace.

    /diagnostics is one topic for all rigs of a ROS domain.
    """
    inside = name.removeprefix(f"{space}/") if space else name
    is_ours = inside.rpartition("/")[2] in (*interface.ALL_NODES, NAME)
    is_elsewhere = "/" in inside or (bool(space) and inside == name)
    return "" if is_ours and is_elsewhere else inside


def _bytes(message: Any) -> bytes:
    return bytes(message.data)


def _jpeg(message: Any) -> bytes:
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
        texts = {"mode": self.mode, "setup": "", "setups": [], "recording": "", "busy": ""}
        possible = {"can_pause": can_pause, "paused": self.paused, "can_record": False, "can_measure": False}
        return {**texts, **possible, "measurement": None, "simulated": self.graph.is_active(RIG)}

    async def select_setup(self, setup: str) -> str:
        """Refuse: this graph is not started from the page."""
        return f"setup: got {setup!r}, expected none, as this graph is not started from the page"

    async def set_paused(self, paused: bool) -> str:
        """Pause or resume time if a node of the graph can; return the reason of a refusal."""
        if not (name := self._pause_service()):
            return "no node of this graph can pause time"
        refusal = await self.graph.call(name, SetBool.Request(data=paused))
        if not refusal:
            self.paused = paused
        return refusal

    async def set_recording(self, recording: bool, operator: str) -> str:
        """Refuse: this node records no bags."""
        return "the node console writes no bags; `magnetosuture console --graph` does"

    async def measure(self, action: str, marks: tuple[float, ...]) -> str:
        """Refuse: this node knows no setup."""
        return "the node console measures nothing; `magnetosuture console SETUP --graph` does"

    def cancel(self) -> None:
        """Do nothing: nothing is measured."""

    def picture(self) -> bytes:
        """Return no picture."""
        return b""

    def _pause_service(self) -> str:
        """Return the service that pauses time; empty if there is none."""
        return next((name for name in PAUSES if self.graph.services.ready(name)), "")


class ConsoleNode(GuardedNode):
    """Serves the page for the graph that it is in."""

    def __init__(self, **options: Any) -> None:
        services = {"parameter_overrides": [Parameter("start_type_description_service", value=False)]}
        super().__init__(NAME, **{**services, **options})
        self._settings = declare(self, ConsoleSettings, options)

    def spin(self, executor: KeptWaitSetExecutor, is_over: Callable[[], bool]) -> None:
        """Serve the page, answer services and publish the node's health; at the end the needle is stopped first."""
        asyncio.run(self._serve(is_over))

    async def _serve(self, is_over: Callable[[], bool]) -> None:
        graph = ConsoleGraph(self, self._settings)
        server = ConsoleServer(self._settings, graph, GraphHost(graph))
        print(f"the operator's page: {await server.start()}", flush=True)
        self.health.ok(f"serving on {self._settings.address}")
        try:
            while not is_over():
                graph.spin()
                await asyncio.sleep(0.02)
        finally:
            await server.stop()


def needle(message: PoseWithCovarianceStamped) -> dict[str, Any]:
    """Return the needle's tail [m], the angle of its heading there [rad], and whether that is not the opposite one.

    Raises:
        InvalidInputError: it is not a valid pose in the dish plane.
    """
    pose = needle_pose(message, directed=False)
    return {"tail": pose.tail.tolist(), "heading": heading_angle(pose.heading), "directed": heading_known(message)}


def tracker(message: msg.TrackerState) -> dict[str, Any]:
    """Return the tracker's state, and the dish's place in the image if known."""
    view, scale = None, message.metres_per_pixel
    if len(message.dish_centre) == 2 and scale > 0.0:
        view = {"centre": list(message.dish_centre), "scale": scale, "rotation": message.camera_rotation}
    return {**_plain(message, "state reason confidence", "searching"), "view": view}


def measured_thread(message: Path) -> list[list[float]]:
    """Return the vertices of the measured centreline [m]."""
    return _points(placed.pose.position for placed in message.poses)


def predicted(message: msg.PredictedThread) -> dict[str, Any]:
    """Return the predicted vertices [m], how they were found, and the forces [N]: tensions, pull on the needle.

    Raises:
        InvalidInputError: the tensions are not those of the segments between the vertices.
    """
    tension = list(message.tension)
    if tension and len(tension) + 1 != len(message.positions):
        content = f"{len(message.positions)} positions and {len(tension)} tensions"
        raise InvalidInputError("thread/predicted", content, "a tension for each segment, or none")
    return {
        "tension": tension,
        "needle_force": [message.needle_force.x, message.needle_force.y] if tension else None,
        "vertices": _points(message.positions),
        **_plain(message, "residual step_time"),
        "status": shortened(message.solver_status),
    }


def estimated(message: msg.EstimatedThread) -> dict[str, Any]:
    """Return the estimated vertices with their deviations [m], how they were found, and the forces that were found.

    Raises:
        InvalidInputError: the deviations are not those of the vertices.
    """
    if len(message.deviation) != len(message.positions):
        content = f"{len(message.positions)} positions and {len(message.deviation)} deviations"
        raise InvalidInputError("thread/estimated", content, "a deviation for each position")
    return {
        "vertices": _points(message.positions),
        "deviation": list(message.deviation),
        **_plain(message, "prediction_only unmeasured_for hidden"),
        "disturbances": [_disturbance(force) for force in message.disturbances[:MAX_LISTED]],
    }


def _disturbance(message: msg.ThreadDisturbance) -> dict[str, Any]:
    direction = [message.direction.x, message.direction.y]
    text = disturbance_text(message.arc_length, message.force, direction)
    position = [message.position.x, message.position.y]
    return {"position": position, "direction": direction, "force": message.force, "text": text}


def forecast(message: msg.ThreadForecast) -> dict[str, Any]:
    """Return where the thread will be at some instants, the last that of the horizon, and what happens when.

    Raises:
        InvalidInputError: the positions are not those of equally many nodes at each instant.
    """
    instants, count = len(message.time), len(message.positions)
    if not instants or count % instants or count // instants > MAX_THREAD_NODES:
        content = f"{count} positions and {instants} instants"
        raise InvalidInputError("thread/forecast", content, "as many positions at each instant")
    nodes = count // instants
    shown = sorted({round(index) for index in np.linspace(0, instants - 1, 4)[1:]})
    vertices = {at: _points(message.positions[at * nodes : (at + 1) * nodes]) for at in shown}
    ghosts = [{"time": message.time[at], "vertices": vertices[at]} for at in shown]
    shape = shortened(message.contact_shape)
    events = forecast_events(message.contact_time, shape, message.friction_time, message.rest_time)
    return {"horizon": message.horizon, "ghosts": ghosts, "events": events, "problem": shortened(message.problem)}


def margins(message: msg.SafetyMargins) -> dict[str, Any]:
    """Return the margins by node and by kind, as distances [m]; no number of a message that is not valid."""
    bounds = [barrier.clearance_bound for barrier in message.minimum if np.isfinite(barrier.clearance_bound)]
    friction = constant_name(message, message.friction_state, "FRICTION_")
    return {
        "valid": message.valid,
        "of": constant_name(message, message.source, "OF_", "nothing"),
        "reason": shortened(message.reason),
        "clearance": clearances(message) if message.valid else [],
        "least": {shortened(barrier.barrier): barrier.clearance for barrier in message.minimum[:MAX_LISTED]},
        "bound": min(bounds, default=None),
        "contact": list(message.contact_nodes),
        "friction": {"state": friction, "nodes": list(message.friction_nodes), "slowdown": message.slowdown},
    }


def clearances(message: msg.SafetyMargins) -> list[float | None]:
    """Return each node's minimum clearance of the wall and any shape [m]; None where none is near.

    Raises:
        InvalidInputError: a node that no thread has.
    """
    count = max(message.node, default=-1) + 1
    if count > MAX_THREAD_NODES:
        raise InvalidInputError("thread/margins.node", count - 1, f"less than {MAX_THREAD_NODES}")
    return [value if value < np.inf else None for value in node_clearance(margins_of(message), count).tolist()]


def scene(message: msg.Scene) -> dict[str, Any]:
    """Return the scene of a message as the page draws it.

    Raises:
        InvalidInputError: the message is damaged.
    """
    return shown_scene(parse_scene_message(message))


def shown_scene(shown: Scene) -> dict[str, Any]:
    """Return a scene as the page draws it: discs as x, y and radius, others as outline and holes [m]."""
    tolerance = 2e-4 * shown.dish.diameter  # a fifth of a pixel
    dish = {"dish_diameter": shown.dish.diameter, "dish_depth": shown.dish.depth}
    return {"version": shown.version, **dish, "shapes": [_shown_shape(shape, tolerance) for shape in shown.shapes]}


def _shown_shape(shape: SceneShape, tolerance: float) -> dict[str, Any]:
    shown: dict[str, Any] = {"name": shape.name, "kind": shape.kind, "label": list(shape.label_point)}
    if isinstance(shape.geometry, Disc):
        return {**shown, "disc": [*shape.geometry.centre, shape.geometry.radius]}
    # 30 times a second, for every page: no digit too many.
    outline, *holes = [np.round(ring, 7).tolist() for ring in shape.outlines(tolerance)]
    return {**shown, "outline": outline, "holes": holes}


def filter_state(message: msg.FilterState) -> dict[str, Any]:
    """Return what the bridge made of the last velocity command [m/s]."""
    return _plain(message, "source commanded filtered applied slowdown active overridden reason")


def bridge(message: msg.CoilBridgeState) -> dict[str, Any]:
    """Return what the coil bridge does and why: velocities [m/s], currents [A]."""
    motion = "state armed emergency_stopped reasons commanded filtered applied saturated"
    driver = "driver driver_ready driver_warnings current measured_current refused"
    return _plain(message, f"{motion} {driver}", "fault")


def procedure(message: msg.ProcedureState) -> dict[str, Any]:
    """Return what the needle planner does."""
    return {
        "name": shortened(message.procedure),
        **_plain(message, "state goals goal goals_met progress resumes hold_to_run", "failed"),
        "reason": shortened(message.reason, MAX_REASON_CHARS),
        "clearance": message.clearance if np.isfinite(message.clearance) else None,
    }


def plan(message: Path) -> list[list[float]]:
    """Return where the middle of the needle is to go [m]; of a long way every second place, or fewer."""
    points = measured_thread(message)
    return points[:: 1 + len(points) // 400]


def node_state(status: DiagnosticStatus) -> dict[str, Any]:
    """Return a node's diagnostic status."""
    levels = {DiagnosticStatus.OK: "ok", DiagnosticStatus.WARN: "warn", DiagnosticStatus.STALE: "silent"}
    return {
        "level": levels.get(status.level, "error"),
        "message": shortened(status.message),
        "values": {shortened(pair.key): shortened(pair.value) for pair in status.values[:MAX_LISTED]},
    }


def _plain(message: Any, names: str, unknown: str = "") -> dict[str, Any]:
    """Return fields of a message, by their names, as plain values: texts and lists shortened, vectors in the plane.

    A `state` becomes the name of its constant, or `unknown` where it has none.
    """

    def plain(value: Any) -> Any:
        if isinstance(value, str):
            return shortened(value)
        if isinstance(value, Vector3):
            return [value.x, value.y]
        return value if isinstance(value, (bool, int, float)) else [plain(entry) for entry in value[:MAX_LISTED]]

    fields = {name: plain(getattr(message, name)) for name in names.split()}
    return fields | ({"state": constant_name(message, message.state, "STATE_", unknown)} if unknown else {})


def _points(positions: Any) -> list[list[float]]:
    return [[place.x, place.y] for place in positions]


# Parts of the state: the topic, what reads its messages, how seldom [s], and whether the part has its age. Paths and
# forecasts take a millisecond to read, a large scene more.
READERS = {
    "tracker": (topics.TRACKER_STATE, tracker, 0.0, True),
    "needle": (topics.NEEDLE_POSE, needle, 0.0, True),
    "measured": (topics.MEASURED_THREAD, measured_thread, 0.1, False),
    "predicted": (topics.PREDICTED_THREAD, predicted, 0.0, True),
    "estimated": (topics.ESTIMATED_THREAD, estimated, 0.0, True),
    "forecast": (topics.FORECAST, forecast, 0.1, True),
    "margins": (topics.MARGINS, margins, 0.0, False),
    "scene": (topics.SCENE, scene, 0.5, False),
    "filter": (topics.FILTER_STATE, filter_state, 0.0, True),
    "bridge": (topics.BRIDGE_STATE, bridge, 0.0, True),
    "procedure": (topics.PROCEDURE_STATE, procedure, 0.0, False),
    "plan": (topics.PROCEDURE_PLAN, plan, 0.0, False),
}
