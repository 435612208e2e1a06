"""The base of every node of this package: its status, and that no request, message or time from outside ends it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import Any, ClassVar
from weakref import ref

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.service import Service
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock as ClockMessage

from magnetosuture_thread import ConfigurationError, InvalidInputError
from magnetosuture_thread.compiled import compilations
from magnetosuture_thread.messages import reading
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.texts import shortened

PERIOD = 1.0  # s between two reports of a node
# Keys of the coil bridge's report, which its clients read.
SCHEDULING = "scheduling"
JITTER_KEYS = tuple(f"loop jitter, {name} [ms]" for name in ("median", "99th percentile", "maximum"))
COMPILING = "compiling"  # how the state of a node begins that does
MAX_REASON_CHARS = 400  # of a reason, a status or a value, whatever is in it
MAX_REQUEST_ENTRIES = 1000  # of a list in a request: each takes its time, and nothing else runs meanwhile


class Health:
    """Publishes a node's state once a second, and at once when it changes.

    Changes are not published more often than `quiet` seconds apart, so that a flood of bad messages
    does not become a flood of reports: one that comes sooner waits, and the last of those that wait is
    published. The count of refusals goes on all the same.

    Args:
        node: whose health it is.

    Attributes:
        loading: how many nodes of this process load; no driver may be open then, as a signal ends the process.
    """

    quiet = 0.05
    loading: ClassVar[int] = 0

    def __init__(self, node: Node) -> None:
        self._node = node
        self._clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._publisher = topics.DIAGNOSTICS.publisher(node)
        self._level, self._text, self._standby = DiagnosticStatus.OK, "starting", ""
        self._refused = 0
        self._last_refusal = ""
        self._values: dict[str, object] = {}
        self._sent = -1.0
        node.create_timer(PERIOD, self.publish, clock=self._clock)
        self._late = node.create_timer(self.quiet, self.publish, clock=self._clock)
        self._late.cancel()

    def ok(self, text: str, **values: object) -> None:
        """Report level OK."""
        self._set(DiagnosticStatus.OK, text, values)

    def warn(self, text: str, **values: object) -> None:
        """Report level WARN: the node continues but cannot do all of its work."""
        self._set(DiagnosticStatus.WARN, text, values)

    def error(self, text: str, **values: object) -> None:
        """Report level ERROR: the node cannot do its work."""
        self._set(DiagnosticStatus.ERROR, text, values)

    def stand_by(self, text: str) -> None:
        """Report this at level WARN, whatever else there is to report; an empty text ends that."""
        if text != self._standby:
            self._standby = shortened(text, MAX_REASON_CHARS)
            self._publish_soon()

    def note(self, **values: object) -> None:
        """Keep values for the next report."""
        self._values.update(values)

    def refuse(self, problem: Exception, **values: object) -> None:
        """Say that an input was refused; the node itself goes on. An error that it has said before stays said."""
        self._refused += 1
        self._last_refusal = shortened(str(problem), MAX_REASON_CHARS)
        if self._level == DiagnosticStatus.ERROR:
            self.note(**values)
        else:
            self.warn(f"refused: {self._last_refusal}", **values)

    @contextmanager
    def load(self, what: str) -> Iterator[None]:
        """Report once a second, at level WARN, that the node loads, or compiles what no cache has, while it does."""
        before, compiling, done = compilations(), f"{COMPILING} {what}, once on this machine", threading.Event()
        self.warn(f"loading {what}")
        self._node.get_logger().info(self._text)

        def repeat() -> None:
            while not done.wait(PERIOD):
                if compilations() > before and self._text != compiling:
                    self.warn(compiling)
                    self._node.get_logger().info(compiling)
                self.publish()

        thread = threading.Thread(target=repeat, daemon=True)
        thread.start()
        Health.loading += 1
        try:
            yield
        finally:
            Health.loading -= 1
            done.set()
            thread.join()

    def publish(self) -> None:
        """Publish the state now."""
        self._late.cancel()
        values = {**self._values, "refused": self._refused, "last refusal": self._last_refusal or "none"}
        status = DiagnosticStatus(
            level=DiagnosticStatus.WARN if self._standby else self._level,
            name=f"{self._node.get_fully_qualified_name().lstrip('/')}: state",
            message=self._standby or self._text,
            hardware_id="magnetosuture",
            values=[KeyValue(key=key, value=shortened(str(value), MAX_REASON_CHARS)) for key, value in values.items()],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)
        self._sent = self._clock.now().nanoseconds * 1e-9

    def _set(self, level: bytes, text: str, values: dict[str, object]) -> None:
        text = shortened(text, MAX_REASON_CHARS)
        changed = (level, text) != (self._level, self._text)
        self._level, self._text = level, text
        self._values.update(values)
        if changed and not self._standby:
            self._publish_soon()

    def _publish_soon(self) -> None:
        if self._clock.now().nanoseconds * 1e-9 - self._sent > self.quiet:
            self.publish()
        elif self._late.is_canceled():
            self._late.reset()


def read_status(status: DiagnosticStatus) -> tuple[str, dict[str, str]]:
    """Return message and values of a status, of anybody, with texts of bounded length."""
    values = {shortened(each.key): shortened(each.value, MAX_REASON_CHARS) for each in status.values[:100]}
    return shortened(status.message, MAX_REASON_CHARS), values


class GuardedNode(Node):
    """A node that reports on /diagnostics, answers a failed request by an error, and ignores an impossible time.

    What a service callback raises, those of rclpy for parameters, lifecycle and types included, would come out of
    `spin` and end the node; so would a time on /clock that rclpy cannot represent.
    """

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        for service in self.services:  # rclpy makes some by another way
            self._guard(service)
        node = ref(self)  # where a constructor fails, nothing may keep the node: it would stay in the graph
        self.add_on_set_parameters_callback(lambda parameters: _check_parameters(node(), parameters))

    @cached_property
    def health(self) -> Health:
        """Status of the node, published from its first use on."""
        return Health(self)

    @property
    def clock_is_fixed(self) -> bool:
        """Whether the node keeps the clock that it has: stamps of two clocks cannot be compared."""
        return True

    @property
    def has_ended(self) -> bool:
        """Whether the node was shut down for good, so that its process can end."""
        return False

    def own_process(self) -> None:
        """Do what concerns the whole process, where the node is alone in it."""

    def refuse(self, problem: Exception) -> None:
        """Report a message that was refused."""
        self.health.refuse(problem)

    def finish(self) -> None:
        """Publish what others must know before the node ends in order; the graph is still there."""

    def create_service(self, *arguments: Any, **options: Any) -> Service:
        """Create a service whose callback may raise."""
        return self._guard(super().create_service(*arguments, **options))

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., None], *arguments: Any, **options: Any
    ) -> Subscription:
        """Subscribe; of /clock, to which rclpy subscribes by itself, only a possible time is passed on."""
        if msg_type is ClockMessage and not options.get("raw"):
            found: Callable[[], Any] = ref(self)
            options["raw"], received = True, callback

            def callback(data: bytes) -> None:
                try:
                    message = topics.CLOCK.decode(data)
                    reading.clock_nanoseconds(message)
                except InvalidInputError as error:
                    found().refuse(error)
                else:
                    received(message)

        return super().create_subscription(msg_type, topic, callback, *arguments, **options)

    def _guard(self, service: Service) -> Service:
        if not isinstance(service.callback, _GuardedCallback):
            service.callback = _GuardedCallback(service, self.get_logger())
        return service


def _check_parameters(node: Any, parameters: list[Parameter]) -> SetParametersResult:
    """Refuse a parameter without a name, which rclpy would declare, and another clock for a node that keeps its own."""
    reason, now = "", node.get_parameter("use_sim_time").value
    for parameter in parameters:
        if not parameter.name:
            reason = "a parameter without a name"
        elif parameter.name == "use_sim_time" and node.clock_is_fixed and parameter.value is not now:
            reason = str(ConfigurationError("use_sim_time", parameter.value, f"{now}, as the node has now"))
    return SetParametersResult(successful=not reason, reason=reason)


class _GuardedCallback:
    """Callback of a service that answers an exception by an error in the service's own form."""

    def __init__(self, service: Service, logger: Any) -> None:
        self._call: Callable[[Any, Any], Any] = service.callback
        self._name, self._logger = service.srv_name, logger

    def __call__(self, request: Any, response: Any) -> Any:
        reason = ""
        try:
            _check_lengths(request)
            if not isinstance(request, SetParameters.Request):
                return self._call(request, response)
            # Each for itself: one that fails must not hide what became of those before it.
            response.results = [self._set(parameter) for parameter in request.parameters]
            reason = next((result.reason for result in response.results if not result.successful), "")
        except Exception as error:
            reason = reason_of(error)
            response = _refused(type(response)(), reason, request)
        if reason:  # one line for all of a request: rclpy takes long to find out who logs
            self._logger.warning(f"{self._name} refused: {reason}", throttle_duration_sec=PERIOD)
        return response

    def _set(self, parameter: Any) -> SetParametersResult:
        try:
            answer = self._call(SetParameters.Request(parameters=[parameter]), SetParameters.Response())
        except Exception as error:
            return SetParametersResult(successful=False, reason=reason_of(error))
        result = answer.results[0]
        result.reason = shortened(result.reason, 2 * MAX_REASON_CHARS)  # rclpy's own may hold a name from outside
        return result


def reason_of(error: Exception) -> str:
    """Return the text of an error as it may be logged and answered."""
    return shortened(str(error) or type(error).__name__, MAX_REASON_CHARS)


def _check_lengths(request: Any) -> None:
    """Refuse a request whose lists would take long to go through."""
    for name in request.get_fields_and_field_types():
        value = getattr(request, name)
        if isinstance(value, (list, tuple)) and len(value) > MAX_REQUEST_ENTRIES:
            raise InvalidInputError(name, f"{len(value)} entries", f"at most {MAX_REQUEST_ENTRIES}")


def _refused(response: Any, reason: str, request: Any) -> Any:
    """Write into the default response of a service that the request has failed, where it has a field for that."""
    failed = SetParametersResult(successful=False, reason=reason)
    fields = {
        "success": False,
        "message": reason,
        "successful": False,
        "failure_reason": reason,
        "result": failed,
        "results": [failed] * min(len(getattr(request, "parameters", ())), MAX_REQUEST_ENTRIES),
    }
    for name, kind in response.get_fields_and_field_types().items():
        if name in fields and (name not in ("result", "results") or "SetParametersResult" in kind):
            setattr(response, name, fields[name])
    return response
