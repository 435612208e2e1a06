"""Who is in a graph without an executor: messages are queued in the middleware, and polled.

Waiting for hundreds of messages a second in rclpy would cost as much as the nodes that send them. The middleware keeps
the latest messages and their time of arrival.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from typing import Any

import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from magnetosuture_msgs.action import ExecuteProcedure
from magnetosuture_msgs.msg import CoilBridgeState, ProcedureState
from rclpy.action import ActionClient
from rclpy.client import Client
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger
from typing_extensions import Self

from magnetosuture_thread import InvalidInputError
from magnetosuture_thread.bags.reading import clock_nanoseconds, constant_name
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.node import JITTER_KEYS, MAX_REASON_CHARS, SCHEDULING, GuardedNode, read_status
from magnetosuture_thread.settings.errors import GraphError, shortened
from magnetosuture_thread.settings.interface import ALL_NODES, DIAGNOSTICS, EXECUTE_PROCEDURE, Service

TIMEOUT = 10.0  # s for a service to be found and to answer
POLL_PERIOD = 0.005  # s between two looks at what has come
DISCOVERY_TIME = 1.0  # s after a node is found, for it to have discovered this client

TRANSITIONS = {
    "configure": Transition.TRANSITION_CONFIGURE,
    "activate": Transition.TRANSITION_ACTIVATE,
    "deactivate": Transition.TRANSITION_DEACTIVATE,
    "cleanup": Transition.TRANSITION_CLEANUP,
}
DONE = "done"


@contextmanager
def joined(
    *, name: str = "console", domain: int | None = None, namespace: str = "", simulated_clock: bool = False
) -> Iterator[GuardedNode]:
    """Create a node in a graph, in a context of its own.

    Args:
        name: of the node.
        domain: the graph's ROS domain; the one that the environment names if None.
        namespace: of the graph, where it is in one.
        simulated_clock: whether its time is that of /clock.
    """
    context = Context()
    rclpy.init(context=context, domain_id=domain, args=[], signal_handler_options=SignalHandlerOptions.NO)
    # rclpy's own service of types is answered by an executor only.
    parameters = [
        Parameter("start_type_description_service", value=False),
        Parameter("use_sim_time", value=simulated_clock),
    ]
    options: dict[str, Any] = {"parameter_overrides": parameters, "start_parameter_services": False}
    node = GuardedNode(name, context=context, namespace=namespace, **options)
    try:
        yield node
    finally:
        node.destroy_node()
        context.try_shutdown()


class Inbox:
    """Queue of the messages of a topic since the last poll.

    Args:
        node: that subscribes.
        topic: to subscribe.
        depth: of the queue; beyond it, the oldest messages are lost.
        reliable: whether every publisher is reliable, whatever the topic's own quality of service.
    """

    def __init__(self, node: Node, topic: topics.Topic, depth: int, *, reliable: bool = False) -> None:
        self.topic = topic
        own = ReliabilityPolicy.RELIABLE if reliable else topic.qos.reliability or ReliabilityPolicy.RELIABLE
        quality = QoSProfile(depth=depth, reliability=own, durability=topic.qos.durability)
        self._node, self._depth = node, depth
        self._subscription = node.create_subscription(topic.message, topic.name, _never, quality, raw=True)

    def messages(self) -> Iterator[tuple[bytes, dict[str, Any]]]:
        """Yield the queued messages, no more than the queue holds: CDR bytes, and what the middleware says of each.

        In a flood there would always be one more.
        """
        subscription = self._subscription
        with subscription.handle:
            for _ in range(self._depth):
                found = subscription.handle.take_message(subscription.msg_type, True)
                if found is None:
                    return
                yield bytes(found[0]), found[1]

    def take(self) -> Iterator[tuple[bytes, int]]:
        """Yield the queued messages: CDR bytes, and time of arrival [ns]."""
        for data, info in self.messages():
            yield data, info["received_timestamp"]

    def read(self) -> Iterator[tuple[Any, int]]:
        """Yield the queued messages, and their time of arrival [ns]; invalid ones are skipped."""
        for data, arrived in self.take():
            with suppress(InvalidInputError):
                yield self.topic.decode(data), arrived

    @property
    def has_publisher(self) -> bool:
        """Whether a publisher of the topic has been found."""
        return bool(self._subscription.get_publisher_count())

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
        max_bytes: of a message that is read, besides the topic's own bound.

    Attributes:
        value: content of the latest message that was read; None before the first.
    """

    def __init__(
        self,
        node: Node,
        topic: topics.Topic,
        read: Callable[[Any], Any] = lambda message: message,
        period: float = 0.0,
        max_bytes: float = math.inf,
    ) -> None:
        self._inbox = Inbox(node, topic, 1)
        self._read, self._period, self._max_bytes = read, period, max_bytes
        self._next_read, self._arrived = 0.0, 0
        self.value: Any = None
        self.close = self._inbox.close

    def poll(self) -> bool:
        """Read the latest message, if there is one; return whether there is a new value."""
        now = time.monotonic()
        if now < self._next_read:
            return False
        for data, arrived in self._inbox.take():
            if len(data) > self._max_bytes:
                return False
            try:
                self.value = self._read(self._inbox.topic.decode(data))
            except Exception:  # whatever is wrong with a message, who asks goes on with the one before
                return False
            self._arrived, self._next_read = arrived, now + self._period
            return True
        return False

    @property
    def age(self) -> float:
        """Return the age of the message [s]."""
        return max(0.0, time.time() - self._arrived * 1e-9)

    def aged(self) -> dict[str, Any] | None:
        """Return a copy of the latest content, with its age."""
        return None if self.value is None else {**self.value, "age": self.age}


def _never(data: bytes) -> None:
    """Stand in for a callback: no executor calls any."""


class Services:
    """Clients of services, created at once so that the emergency stop is discovered before it is needed.

    Args:
        node: that calls.
        kinds: type of each service, by its name.
    """

    def __init__(self, node: Node, kinds: Mapping[str, Any]) -> None:
        self._clients = {name: node.create_client(kind, name) for name, kind in kinds.items()}

    def ready(self, name: str) -> bool:
        """Return whether a service is available."""
        return bool(self._clients[name].service_is_ready())

    async def call(
        self,
        name: str,
        request: Any,
        *,
        timeout: float = TIMEOUT,
        retry_period: float = 0.5,
        is_wanted: Callable[[], bool] = lambda: True,
    ) -> Any:
        """Return the answer of a service; None where it is not wanted any more.

        A service that may be called repeatedly is, so that a lost answer blocks nothing.

        Args:
            name: of the service.
            request: to it.
            timeout: for it to be found and to answer [s].
            retry_period: without an answer, after which it is called again [s].
            is_wanted: whether to go on waiting.

        Raises:
            GraphError: it was not found, or did not answer in time.
        """
        client = self._clients[name]
        calls: list[Future] = []
        deadline, retry_at = time.monotonic() + timeout, 0.0
        while (now := time.monotonic()) < deadline:
            if not is_wanted():
                return None
            if now >= retry_at and client.service_is_ready():
                calls.append(client.call_async(request))
                retry_at = now + retry_period
            await asyncio.sleep(POLL_PERIOD)
            _take_answers(client)
            for call in calls:
                if call.done():
                    return call.result()
        raise GraphError(
            f"{name} did not answer within {timeout:g} s" if calls else f"no service {name} within {timeout:g} s"
        )


def _take_answers(client: Client) -> None:
    """Take the answers to all calls of a client, as an executor does."""
    with client.handle:
        while (found := client.handle.take_response(client.srv_type.Response))[0] is not None:
            with suppress(KeyError):  # somebody else has answered already
                client.get_pending_request(found[0].request_id.sequence_number).set_result(found[1])


def answer_requests(node: Node) -> None:
    """Answer what waits at a node's services."""
    for service in node.services:
        with service.handle:
            request, header = service.handle.service_take_request(service.srv_type.Request)
            if header is not None:
                service.send_response(service.callback(request, service.srv_type.Response()), header)


class _Client:
    """A client that is in the graph while it is entered.

    Args:
        name: of its node.
        namespace: of the graph, where it is in one.
    """

    def __init__(self, name: str, namespace: str = "") -> None:
        self._name, self._namespace, self._stack = name, namespace, ExitStack()

    def __enter__(self) -> Self:
        """Join the graph."""
        self._open(self._stack.enter_context(joined(name=self._name, namespace=self._namespace)))
        return self

    def __exit__(self, *error: object) -> None:
        """Leave the graph."""
        self._stack.close()

    def _open(self, node: Node) -> None:
        raise NotImplementedError


class CoilClient(_Client):
    """Client of the coil bridge on the ROS domain of the environment.

    Args:
        namespace: of the bridge, where it is in one.
    """

    def __init__(self, namespace: str = "") -> None:
        super().__init__("coil_client", namespace)

    def _open(self, node: Node) -> None:
        switches: dict[str, Any] = {Service.ARM: SetBool, Service.EMERGENCY_STOP: Trigger, Service.RESET: Trigger}
        self._services = Services(node, {**switches, "coil_bridge/change_state": ChangeState})
        self._state = Latest(node, topics.BRIDGE_STATE)
        self._reports = Inbox(node, topics.DIAGNOSTICS, 10)
        self._bridge = f"{node.get_namespace()}/coil_bridge".lstrip("/")

    def execute(self, action: str) -> str:
        """Execute a command: a lifecycle transition, arm, disarm, stop, or reset.

        Returns:
            What is wrong although it was executed, as an emergency stop that is not kept over a restart; or nothing.

        Raises:
            GraphError: no bridge was found, or it rejects the command.
        """
        message = ""
        if action in TRANSITIONS:
            # Called once, so the bridge must have discovered this client too, or its answer is lost.
            self._wait_for_state()
            time.sleep(DISCOVERY_TIME)
            request = ChangeState.Request(transition=Transition(id=TRANSITIONS[action]))
            if not self._call("coil_bridge/change_state", request, retry_period=math.inf).success:
                raise GraphError(f"the bridge rejected {action}: not possible in its state, or see its log")
        else:
            name = {"stop": Service.EMERGENCY_STOP, "reset": Service.RESET}.get(action, Service.ARM)
            answer = self._call(
                name, SetBool.Request(data=action == "arm") if name == Service.ARM else Trigger.Request()
            )
            message = shortened(answer.message, MAX_REASON_CHARS)
            if not answer.success:
                raise GraphError(message)
        time.sleep(0.15)  # for the bridge to publish its new state
        return message

    def state(self) -> dict[str, Any]:
        """Return the state of the bridge as text for display.

        Raises:
            GraphError: no state was received.
        """
        state = self._wait_for_state()
        return {
            "state": constant_name(state, state.state, "STATE_", "unknown") + (", armed" if state.armed else ""),
            "currents are zero because": _listed(state.reasons) or "they are not: a command is followed",
            "velocity commanded [mm/s]": _millimetres(state.commanded),
            "velocity filtered [mm/s]": _millimetres(state.filtered),
            "velocity applied [mm/s]": _millimetres(state.applied) + (", saturated" if state.saturated else ""),
            "currents [A]": _numbers(state.current),
            "measured currents [A]": _numbers(state.measured_current),
            "supplies [V]": _numbers(state.supply_voltage),
            "driver": shortened(state.driver) + (", ready" if state.driver_ready else ", not ready"),
            "driver warnings": _listed(state.driver_warnings) or "none",
            "messages refused": str(state.refused),
        }

    def loop_timing(self) -> tuple[tuple[float, float, float], str]:
        """Return the jitter of the bridge's loop, and how its process is scheduled.

        Returns:
            Median, 99th percentile and maximum over the last intervals [ms]; scheduling as text.

        Raises:
            GraphError: no diagnostics were received.
        """
        values = _wait_for(self._timing_values, "no coil_bridge diagnostics received")
        median, p99, maximum = (float(values[name]) for name in JITTER_KEYS)
        return (median, p99, maximum), values[SCHEDULING]

    def _timing_values(self) -> dict[str, str] | None:
        for report, _ in self._reports.read():
            for status in report.status:
                values = read_status(status)[1] if status.name.startswith(f"{self._bridge}:") else {}
                if SCHEDULING in values:
                    return values
        return None

    def _wait_for_state(self) -> CoilBridgeState:
        def latest() -> Any:
            self._state.poll()
            return self._state.value

        return _wait_for(latest, "no coil_bridge state received on this ROS domain")

    def _call(self, name: str, request: Any, **options: Any) -> Any:
        try:
            return asyncio.run(self._services.call(name, request, timeout=TIMEOUT, **options))
        except GraphError as error:
            if not str(error).startswith("no service"):  # a bridge that does not answer may hold currents
                raise
            raise GraphError(f"no coil_bridge on this ROS domain: {error}") from None


def _wait_for(read: Callable[[], Any], problem: str) -> Any:
    """Return what a function returns, once that is not None; raise `GraphError` if that takes too long."""
    deadline = time.monotonic() + TIMEOUT
    while (found := read()) is None:
        if time.monotonic() > deadline:
            raise GraphError(f"{problem} within {TIMEOUT:g} s")
        time.sleep(POLL_PERIOD)
    return found


def _millimetres(vector: Any) -> str:
    return f"{1e3 * vector.x:.3f}, {1e3 * vector.y:.3f}"


def _numbers(values: Any) -> str:
    return ", ".join(f"{value:.2f}" for value in values) or "none"


def _listed(texts: Any) -> str:
    return shortened("; ".join(texts), MAX_REASON_CHARS)


@dataclass(frozen=True)
class ProcedureReport:
    """What the planner reports of a procedure.

    Attributes:
        state: planned, running, paused, done or failed; unknown where there is none.
        reason: why it is paused or has failed; empty else.
        goals_met: how many goals are met.
        progress: completed share of the present goal's path, 0 to 1.
        clearance: minimum distance of the needle's axis from wall and shapes so far [m]; NaN if unknown.
    """

    state: str
    reason: str
    goals_met: int
    progress: float = 0.0
    clearance: float = math.nan


def _state_name(state: int) -> str:
    name = constant_name(ProcedureState, state, "STATE_")
    return {"ready": "planned", "idle": "unknown"}.get(name, name)


class ProcedureClient(_Client):
    """Client of the needle planner on the ROS domain of the environment; nothing happens but in `poll`.

    Args:
        procedure: name, path or YAML text.

    Attributes:
        status: of the procedure; None before it has begun.
        result: of the procedure; None before its end.
        refusal: why it could not begin the last time, as the needle may not be tracked yet.
    """

    def __init__(self, procedure: str) -> None:
        super().__init__("procedure_client")
        self._request = ExecuteProcedure.Goal(procedure=procedure)
        self._send_at: float | None = None  # None until the planner is found, infinite while it executes the goal
        self.status: ProcedureReport | None = None
        self.result: ProcedureReport | None = None
        self.refusal = ""

    def _open(self, node: Node) -> None:
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        self._client = ActionClient(node, ExecuteProcedure, EXECUTE_PROCEDURE)
        self._stack.callback(self._client.destroy)
        self._stack.callback(self._executor.shutdown)

    def poll(self) -> None:
        """Send the goal once the planner is there, and take what has come."""
        for _ in range(20):
            self._executor.spin_once(timeout_sec=0.0)
        now = time.monotonic()
        if self._send_at is None:
            if self._client.server_is_ready():
                self._send_at = now + DISCOVERY_TIME
        elif now >= self._send_at:
            self._send_at = math.inf
            sent = self._client.send_goal_async(self._request, self._on_feedback)
            sent.add_done_callback(lambda sent: sent.result().get_result_async().add_done_callback(self._on_result))

    def _on_feedback(self, message: Any) -> None:
        status = message.feedback.status
        figures = status.goals_met, status.progress, status.clearance
        self.status = ProcedureReport(_state_name(status.state), status.reason, *figures)

    def _on_result(self, ended: Future) -> None:
        result = ended.result().result
        if self.status is not None or result.state == ProcedureState.STATE_DONE:
            self.result = ProcedureReport(_state_name(result.state), result.reason, result.goals_met)
        else:
            self.refusal, self._send_at = result.reason, time.monotonic() + 2.0  # s; then it is sent again


class Recorder:
    """A node that records the serialised messages of some topics.

    Args:
        domain: the graph's ROS domain.
        taken: topics to take.
        simulated_clock: whether the time is that of /clock.
        receive: called with topic, time of arrival [ns] and CDR bytes of every message.

    Attributes:
        taken: messages of each topic so far, by its name with a leading slash.
        status_texts: of each node of this package, message and values of its last status.
    """

    def __init__(
        self,
        domain: int,
        taken: Sequence[topics.Topic],
        *,
        simulated_clock: bool,
        receive: Callable[[str, int, bytes], None],
    ) -> None:
        self._receive = receive
        self._now = 0 if simulated_clock else None
        self.taken: Counter[str] = Counter()
        self.status_texts: dict[str, tuple[str, dict[str, str]]] = {}
        self._stack = ExitStack()
        node = self._stack.enter_context(joined(name="recorder", domain=domain))
        followed = (topics.CLOCK, *taken) if simulated_clock else taken
        self._inboxes = [Inbox(node, topic, 1000) for topic in followed]

    def close(self) -> None:
        """Leave the graph."""
        self._stack.close()

    def silent(self) -> list[str]:
        """Return the topics without a publisher."""
        return [inbox.topic.name for inbox in self._inboxes if not inbox.has_publisher]

    def spin(self, duration: float) -> None:
        """Receive messages for a time [s]."""
        end = time.monotonic() + duration
        while time.monotonic() < end:
            for inbox in self._inboxes:
                for data, arrived in inbox.take():
                    self._take(inbox.topic, data, arrived)
            time.sleep(POLL_PERIOD)

    def _take(self, topic: topics.Topic, data: bytes, arrived: int) -> None:
        if topic is topics.CLOCK:
            with suppress(InvalidInputError):  # no time at all
                self._now = clock_nanoseconds(topic.decode(data))
            return
        self.taken[topic.channel.recorded] += 1
        self._receive(topic.channel.recorded, arrived if self._now is None else self._now, data)
        if topic.channel is DIAGNOSTICS:
            with suppress(InvalidInputError):
                for status in topic.decode(data).status:
                    name = status.name.split(":")[0]
                    if name in ALL_NODES:
                        self.status_texts[name] = read_status(status)
