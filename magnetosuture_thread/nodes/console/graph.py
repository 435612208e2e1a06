"""The running graph as the operator page sees it: states in, jog commands and services out.

No executor runs: waiting for hundreds of messages a second in rclpy would cost as much as the nodes that send them.
Messages are queued in the middleware, which keeps the latest and their time of arrival, and polled.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import numpy as np
from magnetosuture_msgs.srv import PlanProcedure
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.time import Time
from sensor_msgs.msg import CompressedImage, Image
from std_srvs.srv import SetBool, Trigger

from magnetosuture_thread import InvalidInputError, read_scene
from magnetosuture_thread.console.settings import ConsoleSettings
from magnetosuture_thread.interface import (
    ABORT_PROCEDURE,
    ALL_NODES,
    ARM,
    EMERGENCY_STOP,
    PAUSE_PROCEDURE,
    PAUSE_REPLAY,
    PAUSE_RIG,
    PLAN_PROCEDURE,
    RESET,
    RESUME_PROCEDURE,
)
from magnetosuture_thread.messages import reading
from magnetosuture_thread.messages.packing import packed_header, packed_twist
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.console import messages
from magnetosuture_thread.nodes.node import MAX_REASON_CHARS
from magnetosuture_thread.planning.procedure import read_procedure
from magnetosuture_thread.resources import shipped_procedures
from magnetosuture_thread.rig.camera import encode_jpeg
from magnetosuture_thread.texts import shortened
from magnetosuture_thread.vision.images import unpack_image

TIMEOUT = 10.0  # s for a service to be found and to answer
PLAN_TIMEOUT = 60.0  # s; a long way takes some seconds, and is planned once
RETRY_PERIOD = 0.5  # s without an answer, after which a service is called again
POLL_PERIOD = 0.005  # s between two checks for an answer

NODE_TIMEOUT = 3.0  # s without diagnostics, after which a node is silent
DROP_TIMEOUT = 60.0  # s without diagnostics, after which a node that is none of ours is no longer shown
LONG_PERIOD, SCENE_PERIOD = 0.1, 0.5  # s; paths and forecasts take a millisecond to read, a large scene more
PACKAGE_NODES = (*ALL_NODES, "console")
MAX_DIAGNOSTICS = 50  # queued messages of /diagnostics
MAX_NODES = 32  # shown
MAX_SHOWN_BYTES = 1 << 18  # of a message that becomes a part of the state
JPEG_QUALITY = 80

SERVICES: dict[str, Any] = {
    **dict.fromkeys((ARM, PAUSE_REPLAY, PAUSE_RIG), SetBool),
    **dict.fromkeys((EMERGENCY_STOP, RESET, RESUME_PROCEDURE, PAUSE_PROCEDURE, ABORT_PROCEDURE), Trigger),
    PLAN_PROCEDURE: PlanProcedure,
}
PROCEDURE_ACTIONS = {"resume": RESUME_PROCEDURE, "pause": PAUSE_PROCEDURE, "abort": ABORT_PROCEDURE}
ACTIONS: dict[str, tuple[str, Any]] = {
    "arm": (ARM, SetBool.Request(data=True)),
    "disarm": (ARM, SetBool.Request(data=False)),
    "stop": (EMERGENCY_STOP, Trigger.Request()),
    "reset": (RESET, Trigger.Request()),
}
READERS = {
    "tracker": (topics.TRACKER_STATE, messages.tracker, 0.0),
    "needle": (topics.NEEDLE_POSE, messages.needle, 0.0),
    "measured": (topics.MEASURED_THREAD, messages.measured_thread, LONG_PERIOD),
    "predicted": (topics.PREDICTED_THREAD, messages.predicted, 0.0),
    "estimated": (topics.ESTIMATED_THREAD, messages.estimated, 0.0),
    "forecast": (topics.FORECAST, messages.forecast, LONG_PERIOD),
    "margins": (topics.MARGINS, messages.margins, 0.0),
    "scene": (topics.SCENE, messages.scene, SCENE_PERIOD),
    "filter": (topics.FILTER_STATE, messages.filter_state, 0.0),
    "bridge": (topics.BRIDGE_STATE, messages.bridge, 0.0),
    "procedure": (topics.PROCEDURE_STATE, messages.procedure, 0.0),
    "plan": (topics.PROCEDURE_PLAN, messages.plan, 0.0),
}
REST = {"commanded": [0.0, 0.0], "filtered": [0.0, 0.0], "applied": [0.0, 0.0]}
BLOCKED_FILTER = {"source": "", **REST, "slowdown": 1.0, "active": [], "overridden": "", "age": 0.0}
LISTED_PARTS = ("measured", "plan")
AGED_PARTS = ("tracker", "needle", "predicted", "estimated", "forecast", "filter", "bridge")
_RECORDED = (topics.INPUTS, topics.OUTPUTS, topics.SIMULATED, topics.SETTINGS, topics.PROCEDURES)
RECORDED_TOPICS = tuple({topic.name: topic for kind in _RECORDED for topic in kind}.values())


class Inbox:
    """Queue of the messages of a topic since the last poll.

    Args:
        node: that subscribes.
        topic: to subscribe.
        depth: of the queue; beyond it, the oldest messages are lost.
    """

    def __init__(self, node: Node, topic: topics.Topic, depth: int) -> None:
        self.topic = topic
        quality = QoSProfile(
            depth=depth,
            reliability=topic.qos.reliability or ReliabilityPolicy.RELIABLE,
            durability=topic.qos.durability,
        )
        self._node, self._depth = node, depth
        self._subscription = node.create_subscription(topic.message, topic.name, _never, quality, raw=True)

    def take(self) -> Iterator[tuple[bytes, int]]:
        """Yield the queued messages, no more than the queue holds: CDR bytes, and time of arrival [ns].

        In a flood there would always be one more.
        """
        subscription = self._subscription
        with subscription.handle:
            for _ in range(self._depth):
                found = subscription.handle.take_message(subscription.msg_type, True)
                if found is None:
                    return
                data, info = found
                yield bytes(data), info["received_timestamp"]

    def read(self) -> Iterator[tuple[Any, int]]:
        """Yield the queued messages, and their time of arrival [ns]; invalid ones are skipped."""
        for data, arrived in self.take():
            try:
                yield self.topic.decode(data), arrived
            except InvalidInputError:
                continue

    def close(self) -> None:
        """Unsubscribe."""
        self._node.destroy_subscription(self._subscription)


class Latest:
    """Content of the latest message of a topic.

    Args:
        node: that subscribes.
        topic: to subscribe.
        read: converts a message; where it fails, the previous value stays.
        period: minimum between two messages that are read [s].
        max_bytes: of a message that is read; the topic's own bound if None.

    Attributes:
        value: content of the latest message that was read; None before the first.
    """

    def __init__(
        self,
        node: Node,
        topic: topics.Topic,
        read: Callable[[Any], Any],
        period: float = 0.0,
        *,
        max_bytes: int | None = None,
    ) -> None:
        self._inbox = Inbox(node, topic, 1)
        self._max_bytes = topic.max_bytes if max_bytes is None else max_bytes
        self._read = read
        self._period = period
        self._next_read = 0.0
        self._arrived = 0
        self.value: Any = None

    def poll(self) -> bool:
        """Read the latest message, if there is one; return whether there is a new value."""
        now = time.monotonic()
        if now < self._next_read:
            return False
        waiting = list(self._inbox.take())
        if not waiting:
            return False
        data, arrived = waiting[-1]
        if len(data) > self._max_bytes:
            return False
        try:
            self.value = self._read(self._inbox.topic.decode(data))
        except Exception:  # whatever is wrong with a message, the page goes on with the one before
            return False
        self._arrived, self._next_read = arrived, now + self._period
        return True

    @property
    def age(self) -> float:
        """Return the age of the message [s]."""
        return max(0.0, time.time() - self._arrived * 1e-9)

    def aged(self) -> dict[str, Any] | None:
        """Return a copy of the latest content, with its age."""
        return None if self.value is None else {**self.value, "age": self.age}

    def close(self) -> None:
        """Unsubscribe."""
        self._inbox.close()


def _never(data: bytes) -> None:
    """Unused callback: there is no executor."""


class ConsoleServices:
    """Clients of the services of the coil bridge, of the needle planner, and of those that pause time.

    The clients are created at once, so that the emergency stop is discovered before it is needed.

    Args:
        node: that calls.
    """

    def __init__(self, node: Node) -> None:
        self._clients = {name: node.create_client(kind, name) for name, kind in SERVICES.items()}
        self._answers: dict[str, dict[int, Any]] = {name: {} for name in SERVICES}
        self._action = 0  # number of the latest

    def ready(self, name: str) -> bool:
        """Return whether a service is available."""
        return bool(self._clients[name].service_is_ready())

    async def call(self, name: str, request: Any, *, is_action: bool = False) -> str:
        """Call a service; return an empty text, the reason of a refusal, or what is wrong all the same.

        A service may be called repeatedly, so that a lost answer blocks nothing; only a plan is requested once.

        Args:
            name: of the service.
            request: to it.
            is_action: whether it is one of `ACTIONS`, of which the latest cancels one that still waits for its answer.
        """
        self._action += is_action
        action, client, answers = self._action, self._clients[name], self._answers[name]
        timeout, retry_period = (PLAN_TIMEOUT, math.inf) if name == PLAN_PROCEDURE else (TIMEOUT, RETRY_PERIOD)
        calls: list[int] = []
        deadline, retry_at = time.monotonic() + timeout, 0.0
        while (now := time.monotonic()) < deadline:
            if is_action and action != self._action:
                return "cancelled by a later action"
            with client.handle:
                if now >= retry_at and client.service_is_ready():
                    calls.append(client.handle.send_request(request))
                    retry_at = now + retry_period
            await asyncio.sleep(POLL_PERIOD)
            with client.handle:  # take the answers to all calls
                while (found := client.handle.take_response(client.srv_type.Response))[0] is not None:
                    answers[found[0].request_id.sequence_number] = found[1]
            for answer in [answers.pop(number) for number in calls if number in answers]:
                text = shortened(str(answer.message), MAX_REASON_CHARS)
                if answer.success:  # where time is paused, that is all the message says
                    return "" if name in (PAUSE_REPLAY, PAUSE_RIG) else text
                return text or "refused"
        return f"{name} did not answer within {timeout:g} s" if calls else f"no service {name} within {timeout:g} s"


class ConsoleGraph:
    """Implementation of `console.graph.Graph` over ROS.

    Nothing runs between two calls: messages are queued in the middleware.

    Args:
        node: in the graph; no executor spins it. With `use_sim_time` its time is that of /clock.
        settings: of the page.

    Attributes:
        node: as given.
        settings: in force.
        blocked: why commands are blocked now; empty if they are not.

    Raises:
        ConfigurationError: the settings' scene cannot be read.
    """

    def __init__(self, node: Node, settings: ConsoleSettings) -> None:
        self.node = node
        self.blocked = ""
        self.services = ConsoleServices(node)
        self._commands = topics.OPERATOR_COMMAND.publisher(node)
        self._holds = topics.PROCEDURE_HOLD.publisher(node)
        self._procedures = {name: read_procedure(name).shape_names for name in shipped_procedures()}
        self._clock = Inbox(node, topics.CLOCK, 1) if node.get_parameter("use_sim_time").value else None
        self._number = 0
        self._open(settings, _file_scene(settings))

    def begin(self, settings: ConsoleSettings) -> None:
        """Restart: drop all states, for a graph whose nodes were restarted.

        Raises:
            ConfigurationError: the settings' scene cannot be read; nothing is changed.
        """
        scene = _file_scene(settings)
        for latest in self._latest.values():
            latest.close()
        self._camera.close()
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

    async def execute_procedure(self, action: str, procedure: str, hold_to_run: bool) -> str:
        """Plan, resume, pause or abort a procedure; return an empty text, or the reason of a refusal."""
        if self.blocked:
            return self.blocked
        if action == "plan":
            request = PlanProcedure.Request(procedure=procedure, hold_to_run=hold_to_run)
            return await self.services.call(PLAN_PROCEDURE, request)
        return await self.services.call(PROCEDURE_ACTIONS[action], Trigger.Request())

    async def execute_action(self, action: str) -> str:
        """Arm, disarm, stop or reset; return an empty text, or the reason of a refusal.

        The emergency stop is never blocked.
        """
        if action not in ACTIONS:
            return f"action: got {action!r}, expected one of {', '.join(ACTIONS)}"
        if self.blocked and action != "stop":
            return self.blocked
        return await self.services.call(*ACTIONS[action], is_action=True)

    def state(self) -> dict[str, Any]:
        """Return the present state; see `console.graph`."""
        for latest in self._latest.values():
            latest.poll()
        settings = self.settings
        parts: dict[str, Any] = {
            name: latest.aged() if name in AGED_PARTS else latest.value or ([] if name in LISTED_PARTS else None)
            for name, latest in self._latest.items()
        }
        if self.blocked:
            parts["filter"] = {**BLOCKED_FILTER, "reason": self.blocked}
        shown_scene = parts["scene"] or self._scene
        shapes = {shape["name"] for shape in shown_scene["shapes"]} if shown_scene else set()
        return {
            "time": self.now().nanoseconds * 1e-9,
            "needle_length": settings.needle_length,
            "needle_curvature": settings.needle_curvature,
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
        space = self.node.get_namespace().strip("/")
        for report, arrived in self._reports.read():
            for status in report.status[:MAX_NODES]:
                name = _name_within(space, shortened(status.name.split(":")[0]))
                if name:
                    self._diagnostics[name] = (messages.node_state(status), arrived)
        own = set(ALL_NODES)
        others = sorted(self._diagnostics.keys() - own, key=lambda name: self._diagnostics[name][1])
        oldest = time.time_ns() - round(DROP_TIMEOUT * 1e9)
        too_many = len(others) + len(own) - MAX_NODES
        for number, name in enumerate(others):
            if number < too_many or self._diagnostics[name][1] < oldest:
                del self._diagnostics[name]
        return dict(self._aged_nodes())

    def is_active(self, name: str) -> bool:
        """Return whether a node publishes diagnostics now."""
        return any(node == name and about["level"] != "silent" for node, about in self.nodes().items())

    def frame(self) -> tuple[int, bytes] | None:
        """Return number and JPEG or PNG bytes of the latest camera frame; a raw one is encoded here."""
        if self._camera.poll():
            self._number += 1
        return None if self._camera.value is None else (self._number, self._camera.value)

    def now(self) -> Time:
        """Return the graph's time."""
        clock = self.node.get_clock()
        for message, _ in self._clock.read() if self._clock is not None else ():
            with suppress(InvalidInputError):  # no time at all
                reading.clock_nanoseconds(message)
                clock.set_ros_time_override(Time.from_msg(message.clock, clock_type=clock.clock_type))
        return clock.now()

    def _open(self, settings: ConsoleSettings, scene: dict[str, Any] | None) -> None:
        self.settings, self._scene = settings, scene
        self._latest = {name: Latest(self.node, *reader, max_bytes=MAX_SHOWN_BYTES) for name, reader in READERS.items()}
        self._reports = Inbox(self.node, topics.DIAGNOSTICS, MAX_DIAGNOSTICS)
        self._diagnostics: dict[str, tuple[dict[str, Any], int]] = {}
        raw = settings.image_transport == "raw"
        image, read = (topics.IMAGE, _encoded) if raw else (topics.COMPRESSED_IMAGE, _compressed)
        self._camera = Latest(self.node, image, read)

    def _aged_nodes(self) -> Iterator[tuple[str, dict[str, Any]]]:
        for name, (status, arrived) in sorted(self._diagnostics.items()):
            age = max(0.0, time.time() - arrived * 1e-9)
            yield name, {**status, "level": "silent" if age > NODE_TIMEOUT else status["level"], "age": age}


def _name_within(space: str, name: str) -> str:
    """Return a node's name without the namespace of the graph, empty for a node of a rig in another namespace.

    /diagnostics is one topic for all rigs of a ROS domain.
    """
    inside = name.removeprefix(f"{space}/") if space else name
    is_ours = inside.rpartition("/")[2] in PACKAGE_NODES
    is_elsewhere = "/" in inside or (bool(space) and inside == name)
    return "" if is_ours and is_elsewhere else inside


def _file_scene(settings: ConsoleSettings) -> dict[str, Any] | None:
    """Return the scene to show until one is received; None where the settings name none."""
    return messages.shown_scene(read_scene(settings.scene)) if settings.scene else None


def _compressed(message: CompressedImage) -> bytes:
    return bytes(message.data)


def _encoded(message: Image) -> bytes:
    image = unpack_image(message.data, message.height, message.width, message.step, message.encoding)
    return encode_jpeg(image, JPEG_QUALITY).tobytes()
