"""Who is in a graph beside its nodes: it hears and answers when it looks, some hundred times a second.

To wake up for each of hundreds of messages a second would cost as much as the nodes that send them. The middleware
keeps the latest messages and their time of arrival meanwhile.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from typing import Any, TypeAlias

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from magnetosuture_msgs.action import ExecuteProcedure
from magnetosuture_msgs.msg import CoilBridgeState, ProcedureState
from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from magnetosuture_thread import InvalidInputError
from magnetosuture_thread.bags.reading import constant_name
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.executor import KeptWaitSetExecutor
from magnetosuture_thread.nodes.node import GuardedNode, read_report
from magnetosuture_thread.nodes.parameters import start_ros
from magnetosuture_thread.settings.errors import MAX_REASON_CHARS, GraphError, shortened
from magnetosuture_thread.settings.interface import ALL_NODES, DIAGNOSTICS, EXECUTE_PROCEDURE, STARTS, Service

TIMEOUT = 10.0  # s for a service to be found and to answer
POLL_PERIOD = 0.005  # s between two looks at what has come
DISCOVERY_TIME = 1.0  # s after a node is found, for it to have discovered this client

ACTIONS: dict[str, tuple[Service, Any]] = {
    "arm": (Service.ARM, SetBool.Request(data=True)),
    "disarm": (Service.ARM, SetBool.Request(data=False)),
    "stop": (Service.EMERGENCY_STOP, Trigger.Request()),
    "reset": (Service.RESET, Trigger.Request()),
}
"""What switches the coil bridge: service and request."""
CHANGE, SET, GET = "change_state", "set_parameters_atomically", "get_parameters"  # services of a node
Receive: TypeAlias = "Callable[[str, int, bytes], None]"  # called with topic, time of arrival [ns] and CDR bytes


class _ClientNode(GuardedNode):
    """A node without services for its parameters: whoever made it may give it the clock of the graph."""

    @property
    def is_configured(self) -> bool:
        return False


class Participant(ExitStack):
    """A node in a graph, in a context of its own, until it is closed; a context manager too.

    Args:
        name: of the node.
        domain: the graph's ROS domain; the one that the environment names if None.
        namespace: of the graph, where it is in one.
        simulated_clock: whether its time is that of /clock.

    Attributes:
        node: as made.
        spin_some: takes what has come.
    """

    def __init__(
        self, name: str, *, domain: int | None = None, namespace: str = "", simulated_clock: bool = False
    ) -> None:
        super().__init__()
        context, no_handlers = Context(), SignalHandlerOptions.NO
        start_ros(context, domain_id=domain, args=[], signal_handler_options=no_handlers)
        self.callback(context.try_shutdown)
        values = {"start_type_description_service": False, "use_sim_time": simulated_clock}
        parameters = [Parameter(key, value=value) for key, value in values.items()]
        options: dict[str, Any] = {"parameter_overrides": parameters, "start_parameter_services": False}
        self.node = _ClientNode(name, context=context, namespace=namespace, **options)
        self.callback(self.node.destroy_node)
        executor = KeptWaitSetExecutor(context=context)
        self.callback(executor.shutdown)
        executor.add_node(self.node)
        self.spin_some = executor.spin_some


def listen(
    node: Node, topic: topics.Topic, depth: int, take: Callable[[bytes, Any], None], *, reliable: bool = False
) -> Subscription:
    """Subscribe to the messages of a topic as bytes.

    Args:
        node: that subscribes.
        topic: to subscribe.
        depth: of the middleware's queue; beyond it, the oldest messages are lost.
        take: called with the CDR bytes of each message, and what the middleware says of it.
        reliable: whether every publisher is reliable, whatever the topic's own quality of service.
    """
    reliability = ReliabilityPolicy.RELIABLE if reliable else topic.qos.reliability or ReliabilityPolicy.RELIABLE
    quality = QoSProfile(depth=depth, reliability=reliability, durability=topic.qos.durability)

    def received(data: bytes, info: Any) -> None:  # rclpy counts the arguments of a callback
        take(bytes(data), info)

    return node.create_subscription(topic.message, topic.name, received, quality, raw=True)


class Inbox:
    """Queue of the messages of a topic that have come since it was last read.

    Args:
        node: that subscribes.
        topic: to subscribe.
        depth: of the queue; beyond it, the oldest messages are lost.
    """

    def __init__(self, node: Node, topic: topics.Topic, depth: int) -> None:
        self.topic = topic
        self._messages: deque[tuple[bytes, int]] = deque(maxlen=depth)
        subscription = listen(node, topic, depth, self._take)
        self.close = partial(node.destroy_subscription, subscription)

    def take(self) -> Iterator[tuple[bytes, int]]:
        """Yield the queued messages: CDR bytes, and time of arrival [ns]."""
        while self._messages:
            yield self._messages.popleft()

    def read(self) -> Iterator[tuple[Any, int]]:
        """Yield the queued messages, and their time of arrival [ns]; invalid ones are skipped."""
        for data, arrived in self.take():
            with suppress(InvalidInputError):
                yield self.topic.decode(data), arrived

    def _take(self, data: bytes, info: Any) -> None:
        self._messages.append((data, info["received_timestamp"]))


class Latest(Inbox):
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
        super().__init__(node, topic, 1)
        self._convert, self._period, self._max_bytes = read, period, max_bytes
        self._next_read, self._arrived = 0.0, 0
        self.value: Any = None

    def poll(self) -> bool:
        """Read the latest message, if there is one; return whether there is a new value."""
        now = time.monotonic()
        for data, arrived in self.take() if now >= self._next_read else ():
            # Whatever is wrong with a message, the one before stays.
            with suppress(Exception):
                if len(data) <= self._max_bytes:
                    self.value = self._convert(self.topic.decode(data))
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


class Services:
    """Clients of services, created at once so that the emergency stop is discovered before it is needed.

    Args:
        node: that calls.
        kinds: type of each service, as `std_srvs/srv/Trigger`, by its name.
    """

    def __init__(self, node: Node, kinds: Mapping[str, str]) -> None:
        self._node = node
        self._clients = {name: node.create_client(topics.ros_class(kind), name) for name, kind in kinds.items()}

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
        call_within: float = math.inf,
        is_wanted: Callable[[], bool] = lambda: True,
    ) -> Any:
        """Return the answer of a service; None where it is not wanted any more.

        A service that may be called repeatedly is, so that a lost answer blocks nothing.

        Args:
            name: of the service.
            request: to it.
            timeout: for it to be found and to answer [s].
            retry_period: without an answer, after which it is called again [s].
            call_within: after which it is not called any more [s].
            is_wanted: whether to go on waiting.

        Raises:
            GraphError: it was not found, or did not answer in time.
        """
        client = self._clients[name]
        calls: list[Future] = []
        began, retry_at = time.monotonic(), 0.0
        last_call, deadline = began + call_within, began + timeout
        while (now := time.monotonic()) < (deadline if calls else min(deadline, last_call)):
            if not is_wanted():
                return None
            if retry_at <= now < last_call and client.service_is_ready():
                calls.append(client.call_async(request))
                retry_at = now + retry_period
            await asyncio.sleep(POLL_PERIOD)
            self._node.executor.spin_some()
            if answers := [call.result() for call in calls if call.done()]:
                return answers[0]
        problem = f"{name} did not answer within {timeout:g} s"
        raise GraphError(problem if calls else f"no service {name} within {min(timeout, call_within):g} s")


def services_to_restart(*nodes: str) -> dict[str, str]:
    """Return the services that `parameters_of` and `restart` call, and their types."""
    kinds = {
        CHANGE: "lifecycle_msgs/srv/ChangeState",
        SET: "rcl_interfaces/srv/SetParametersAtomically",
        GET: "rcl_interfaces/srv/GetParameters",
    }
    return {f"{node}/{name}": kind for node in nodes for name, kind in kinds.items()}


async def parameters_of(services: Services, node: str, names: Iterable[str]) -> dict[str, Any]:
    """Return values of a node's parameters, as `ros2 param get` does.

    Args:
        services: those of `services_to_restart` among them.
        node: its name.
        names: of the parameters.

    Raises:
        GraphError: it does not answer.
    """
    request = GetParameters.Request(names=list(names))
    answer = await services.call(f"{node}/{GET}", request, retry_period=math.inf)
    return dict(zip(request.names, map(parameter_value_to_python, answer.values), strict=True))


async def restart(services: Services, node: str, values: Mapping[str, Any]) -> bool:
    """Give a node other parameters by its lifecycle, as `ros2 lifecycle set` and `ros2 param set` do.

    Args:
        services: those of `services_to_restart` among them.
        node: its name.
        values: of its parameters.

    Returns:
        Whether it is active with them.

    Raises:
        GraphError: it does not answer, or refuses a parameter.
    """

    async def change(transition: int) -> bool:
        return bool((await call(CHANGE, ChangeState.Request(transition=Transition(id=transition)))).success)

    async def call(name: str, request: Any) -> Any:
        return await services.call(f"{node}/{name}", request, retry_period=math.inf)

    await change(Transition.TRANSITION_DEACTIVATE)
    await change(Transition.TRANSITION_CLEANUP)
    parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
    answer = (await call(SET, SetParametersAtomically.Request(parameters=parameters))).result
    if not answer.successful:
        raise GraphError(f"{node}: {answer.reason}")
    return await change(Transition.TRANSITION_CONFIGURE) and await change(Transition.TRANSITION_ACTIVATE)


class CoilClient(Participant):
    """Client of the coil bridge on the ROS domain of the environment.

    Args:
        namespace: of the bridge, where it is in one.
    """

    def __init__(self, namespace: str = "") -> None:
        super().__init__("coil_client", namespace=namespace)
        kinds: dict[str, str] = {service: service.type_name for service, _ in ACTIONS.values()}
        self._services = Services(self.node, {**kinds, f"coil_bridge/{CHANGE}": "lifecycle_msgs/srv/ChangeState"})
        self._state = Latest(self.node, topics.BRIDGE_STATE)

    def execute(self, action: str) -> str:
        """Execute a command: a lifecycle transition, arm, disarm, stop, or reset.

        Returns:
            What is wrong although it was executed, as an emergency stop that is not kept over a restart; or nothing.

        Raises:
            GraphError: no bridge was found, or it rejects the command.
        """
        message = ""
        if action in ACTIONS:
            # In 3 s nodes have found each other, on a busy machine too.
            answer = self._call(*ACTIONS[action], call_within=3.0 if action in STARTS else math.inf)
            message = shortened(answer.message, MAX_REASON_CHARS)
            if not answer.success:
                raise GraphError(message)
        else:
            # Called once, so the bridge must have discovered this client too, or its answer is lost.
            self._wait_for_state()
            time.sleep(DISCOVERY_TIME)
            transition = Transition(id=getattr(Transition, f"TRANSITION_{action.upper()}"))
            request = ChangeState.Request(transition=transition)
            if not self._call(f"coil_bridge/{CHANGE}", request, retry_period=math.inf).success:
                raise GraphError(f"the bridge rejected {action}: not possible in its state, or see its log")
        time.sleep(0.15)  # for the bridge to publish its new state
        return message

    def execute_within(self, seconds: float, *actions: str) -> None:
        """Execute commands one after another; where one is rejected, all again, until the time is over [s].

        Raises:
            GraphError: as `execute`.
        """
        deadline = time.monotonic() + seconds
        while True:
            try:
                for action in actions:
                    self.execute(action)
                return
            except GraphError:
                if time.monotonic() > deadline:
                    raise
            self.wait(0.2)

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

    def _wait_for_state(self) -> CoilBridgeState:
        problem = f"no coil_bridge state received on this ROS domain within {TIMEOUT:g} s"
        return self.wait_for(lambda: self._state.poll() and self._state.value, lambda: GraphError(problem))

    def _call(self, name: str, request: Any, **options: Any) -> Any:
        try:
            return asyncio.run(self._services.call(name, request, timeout=TIMEOUT, **options))
        except GraphError as error:
            if not str(error).startswith("no service"):  # a bridge that does not answer may hold currents
                raise
            raise GraphError(f"no coil_bridge on this ROS domain: {error}") from None

    def turn(self) -> None:
        """Wait for a moment, and take what has come."""
        time.sleep(POLL_PERIOD)
        self.spin_some()

    def wait(self, seconds: float) -> None:
        """Take what comes for a while [s]."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.turn()

    def wait_for(self, read: Callable[[], Any], failed: Callable[[], Exception], timeout: float = TIMEOUT) -> Any:
        """Return what a function returns, once that is true.

        Args:
            read: the function.
            failed: returns what is raised where that takes too long.
            timeout: that is too long [s].
        """
        deadline = time.monotonic() + timeout
        while True:
            self.turn()  # first: what has been waiting since is old
            if value := read():
                return value
            if time.monotonic() > deadline:
                raise failed()


def _millimetres(vector: Any) -> str:
    return f"{1e3 * vector.x:.3f}, {1e3 * vector.y:.3f}"


def _numbers(values: Any) -> str:
    return ", ".join(f"{value:.2f}" for value in values) or "none"


def _listed(texts: Any) -> str:
    return shortened("; ".join(texts), MAX_REASON_CHARS)


def procedure_state(message: Any) -> str:
    """Return the state of a procedure, or of its result: planned, running, paused, done or failed; unknown if none."""
    name = constant_name(ProcedureState, message.state, "STATE_")
    return {"ready": "planned", "idle": "unknown"}.get(name, name)


class ProcedureClient:
    """Client of the needle planner.

    Args:
        node: in its graph, which somebody else spins.
        procedure: name, path or YAML text.

    Attributes:
        status: of the procedure; None before it has begun.
        result: of the procedure; None before its end.
        refusal: why it could not begin the last time, as the needle may not be tracked yet.
    """

    def __init__(self, node: Node, procedure: str) -> None:
        self._node, self._request = node, ExecuteProcedure.Goal(procedure=procedure)
        self._send_at: float | None = None  # None until the planner is found, infinite while it executes the goal
        self._client = ActionClient(node, ExecuteProcedure, EXECUTE_PROCEDURE)
        self.status: ProcedureState | None = None
        self.result: ExecuteProcedure.Result | None = None
        self.refusal = ""

    def poll(self) -> None:
        """Send the goal once the planner is there."""
        now = time.monotonic()
        if self._send_at is None:
            if self._client.server_is_ready():
                self._send_at = now + DISCOVERY_TIME
        elif now >= self._send_at:
            self._send_at, self._request.stamp = math.inf, self._node.get_clock().now().to_msg()
            sent = self._client.send_goal_async(self._request, self._on_feedback)
            sent.add_done_callback(lambda sent: sent.result().get_result_async().add_done_callback(self._on_result))

    def _on_feedback(self, message: Any) -> None:
        self.status = message.feedback.status

    def _on_result(self, ended: Future) -> None:
        result = ended.result().result
        if self.status is not None or result.state == ProcedureState.STATE_DONE:
            self.result = result
        else:
            self.refusal, self._send_at = result.reason, time.monotonic() + 2.0  # s; then it is sent again


class Recorder(Participant):
    """A node that records the serialised messages of some topics.

    Args:
        domain: the graph's ROS domain.
        recorded: topics to record.
        receive: called with topic, time of arrival [ns] and CDR bytes of every message.
        simulated_clock: whether the time is that of /clock.

    Attributes:
        taken: messages of each topic so far, by its name with a leading slash.
        status_texts: of each node of this package, message and values of its last status.
    """

    def __init__(self, domain: int, recorded: Sequence[topics.Topic], receive: Receive, simulated_clock: bool) -> None:
        super().__init__("recorder", domain=domain, simulated_clock=simulated_clock)
        self._receive, self._is_simulated = receive, simulated_clock
        self.taken: Counter[str] = Counter()
        self.status_texts: dict[str, tuple[str, dict[str, str]]] = {}
        self._subscriptions = {
            topic.name: listen(self.node, topic, 1000, partial(self._take, topic)) for topic in recorded
        }

    def silent(self) -> list[str]:
        """Return the topics without a publisher."""
        return [name for name, subscription in self._subscriptions.items() if not subscription.get_publisher_count()]

    def spin(self, duration: float) -> None:
        """Receive messages for a time [s]."""
        end = time.monotonic() + duration
        while (left := end - time.monotonic()) > 0.0:
            self.spin_some()
            time.sleep(min(left, 2.0 * POLL_PERIOD))

    def _take(self, topic: topics.Topic, data: bytes, info: Any) -> None:
        now = self.node.get_clock().now().nanoseconds if self._is_simulated else info["received_timestamp"]
        self.taken[topic.channel.recorded] += 1
        self._receive(topic.channel.recorded, now, data)
        if topic.channel is DIAGNOSTICS:
            with suppress(InvalidInputError):
                report = read_report(topic.decode(data))
                self.status_texts |= {name: report[name] for name in ALL_NODES if name in report}
