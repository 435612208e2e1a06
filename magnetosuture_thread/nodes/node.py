"""The base of every node of this package: no request, message or time from outside ends it."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any
from weakref import WeakMethod

from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.service import Service
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock

from magnetosuture_thread import ConfigurationError, InvalidInputError
from magnetosuture_thread.messages import reading
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.diagnostics import Health
from magnetosuture_thread.texts import shortened

USE_SIM_TIME = "use_sim_time"
MAX_REQUEST_ENTRIES = 1000  # of a list in a request: each takes its time, and nothing else runs meanwhile
MAX_REASON_CHARS = 400
LOG_PERIOD = 1.0  # s between two lines about refused messages


class GuardedNode(Node):
    """A node of rclpy that answers a failed request by an error, and ignores an impossible time.

    What a service callback raises, those of rclpy for parameters, lifecycle and types included, would come out of
    `spin` and end the node; so would a time on /clock that rclpy cannot represent.
    """

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        for service in self.services:  # rclpy makes some by another way
            self._guard(service)
        # Where a constructor fails, nothing may keep the node: it would stay in the graph.
        self.add_on_set_parameters_callback(_weakly(self._check_parameters))

    @property
    def clock_is_fixed(self) -> bool:
        """Whether the node keeps the clock that it has: stamps of two clocks cannot be compared."""
        return True

    @property
    def has_ended(self) -> bool:
        """Whether the node was shut down for good, so that its process can end."""
        return False

    def refuse(self, problem: Exception) -> None:
        """Report a message that was refused."""
        self.get_logger().warning(f"refused: {problem}", throttle_duration_sec=LOG_PERIOD)

    def finish(self) -> None:
        """Publish what others must know before the node ends in order; the graph is still there."""

    def create_service(self, *arguments: Any, **options: Any) -> Service:
        """Create a service whose callback may raise."""
        return self._guard(super().create_service(*arguments, **options))

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., None], *arguments: Any, **options: Any
    ) -> Subscription:
        """Subscribe; of /clock, to which rclpy subscribes by itself, only a possible time is passed on."""
        if msg_type is Clock and not options.get("raw"):
            options["raw"], received, refuse = True, callback, _weakly(self.refuse)

            def callback(data: bytes) -> None:
                try:
                    message = topics.CLOCK.decode(data)
                    reading.clock_nanoseconds(message)
                except InvalidInputError as error:
                    refuse(error)
                else:
                    received(message)

        return super().create_subscription(msg_type, topic, callback, *arguments, **options)

    def _guard(self, service: Service) -> Service:
        if not isinstance(service.callback, _GuardedCallback):
            service.callback = _GuardedCallback(service, self.get_logger())
        return service

    def _check_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        for parameter in parameters:
            if not parameter.name:  # which rclpy would declare
                return SetParametersResult(successful=False, reason="a parameter without a name")
            if parameter.name == USE_SIM_TIME and self.clock_is_fixed:
                now = self.get_parameter(USE_SIM_TIME).value
                if parameter.value is not now:
                    error = ConfigurationError(USE_SIM_TIME, parameter.value, f"{now}, as the node has now")
                    return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)


class PackageNode(GuardedNode):
    """A guarded node that reports on /diagnostics."""

    @cached_property
    def health(self) -> Health:
        """Status of the node, published from its first use on."""
        return Health(self)

    def refuse(self, problem: Exception) -> None:
        """Report a message that was refused."""
        self.health.refuse(problem)


def _weakly(method: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return a function that calls a method but does not keep its object."""
    found = WeakMethod(method)

    def call(argument: Any) -> Any:
        bound = found()
        assert bound is not None  # who calls is part of the object
        return bound(argument)

    return call


class _GuardedCallback:
    """Callback of a service that answers an exception by an error in the service's own form."""

    def __init__(self, service: Service, logger: Any) -> None:
        self._call: Callable[[Any, Any], Any] = service.callback
        self._name, self._logger = service.srv_name, logger

    def __call__(self, request: Any, response: Any) -> Any:
        try:
            _check_lengths(request)
            if isinstance(request, SetParameters.Request):
                # Each for itself: one that fails must not hide what became of those before it.
                response.results = [self._set(parameter) for parameter in request.parameters]
                refused = [result.reason for result in response.results if not result.successful]
                # One line for all of them: rclpy takes long to find out who logs.
                if refused:
                    self._log(refused[0])
                return response
            return self._call(request, response)
        except Exception as error:
            self._log(reason := reason_of(error))
            return _refused(type(response)(), reason, request)

    def _set(self, parameter: Any) -> SetParametersResult:
        try:
            answer = self._call(SetParameters.Request(parameters=[parameter]), SetParameters.Response())
        except Exception as error:
            return SetParametersResult(successful=False, reason=reason_of(error))
        result = answer.results[0]
        result.reason = shortened(result.reason, 2 * MAX_REASON_CHARS)  # rclpy's own may hold a name from outside
        return result

    def _log(self, reason: str) -> None:
        self._logger.warning(f"{self._name} refused: {reason}", throttle_duration_sec=LOG_PERIOD)


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
