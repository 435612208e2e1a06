"""The base of every node of this package: its status, its lifecycle, the scene that it goes by.

No request, message or time from outside ends a node. A lifecycle node checks its parameters when it is configured, and
they stay until it is cleaned up. Those that it can change while it runs are checked together with all that stay, by the
configuration class, and are in force once all of the node's callbacks have agreed.
"""

from __future__ import annotations

import gc
import threading
import time
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property, partial, partialmethod
from typing import Any, ClassVar, Generic, TypeVar
from weakref import ref

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from lifecycle_msgs.msg import Transition
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock as ClockMessage

from magnetosuture_thread import ConfigurationError, InvalidInputError, MagnetosutureError, Scene, read_scene
from magnetosuture_thread.bags import reading
from magnetosuture_thread.geometry.compiled import compilations
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.executor import KeptWaitSetExecutor
from magnetosuture_thread.nodes.parameters import declare, plain_value
from magnetosuture_thread.nodes.processes import raise_priority, without_priority
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.configuration import Configuration, configuration_fields, from_mapping, to_mapping
from magnetosuture_thread.settings.errors import MAX_REASON_CHARS, GraphError, shortened

C = TypeVar("C", bound=Configuration)

PERIOD = 1.0  # s between two reports of a node
COMPILING = "compiling"  # how the state of a node begins that does
SCHEDULING = "scheduling"  # key of a report on /diagnostics
MAX_REQUEST_ENTRIES = 1000  # of a list in a request: each takes its time, and nothing else runs meanwhile
SUCCESS = TransitionCallbackReturn.SUCCESS
INACTIVE = "inactive: messages are not used until the node is activated"


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
        node.create_timer(PERIOD, self._check_types, clock=self._clock)
        self._other_types: set[str] = set()
        self._late = node.create_timer(self.quiet, self.publish, clock=self._clock)
        self._late.cancel()

    def stand_by(self, text: str) -> None:
        """Report this at level WARN, whatever else there is to report; an empty text ends that."""
        if text != self._standby:
            self._standby = shortened(text, MAX_REASON_CHARS)
            self._publish_soon()

    def note(self, **values: object) -> None:
        """Keep values for the next report."""
        self._values.update(values)

    def refuse(self, problem: Exception, **values: object) -> None:
        """Report that an input was refused; the node itself goes on. An error that it has reported before stays."""
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

        worker = threading.Thread(target=repeat, daemon=True)
        worker.start()
        Health.loading += 1
        try:
            with without_priority():  # of a node that is configured while it runs
                yield
        finally:
            Health.loading -= 1
            done.set()
            worker.join()

    def publish(self) -> None:
        """Publish the state now."""
        self._late.cancel()
        values = {**self._values, "refused": self._refused, "last refusal": self._last_refusal or "none"}
        status = DiagnosticStatus(
            level=DiagnosticStatus.WARN if self._standby else self._level,
            name=f"{self._node.get_fully_qualified_name().lstrip('/')}: state",
            message=self._standby or self._text,
            hardware_id=self._node.get_namespace().strip("/") or "magnetosuture",  # a rig has a namespace
            values=[KeyValue(key=key, value=shortened(str(value), MAX_REASON_CHARS)) for key, value in values.items()],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)
        self._sent = self._clock.now().nanoseconds * 1e-9

    def report(self, level: bytes, text: str, **values: object) -> None:
        """Report a level of `DiagnosticStatus`, and values with it.

        OK: the node does its work; WARN: it goes on, but cannot do all of it; ERROR: it cannot do it.
        """
        text = shortened(text, MAX_REASON_CHARS)
        changed = (level, text) != (self._level, self._text)
        self._level, self._text = level, text
        self._values.update(values)
        if changed and not self._standby:
            self._publish_soon()

    ok = partialmethod(report, DiagnosticStatus.OK)
    warn = partialmethod(report, DiagnosticStatus.WARN)
    error = partialmethod(report, DiagnosticStatus.ERROR)

    def _check_types(self) -> None:
        """Report once what is published in another type on a topic of the node: the middleware drops it unsaid."""
        types, own = dict(self._node.get_topic_names_and_types()), {}
        for subscription in self._node.subscriptions:
            package, kind, *_ = subscription.msg_type.__module__.split(".")
            own[subscription.topic_name] = f"{package}/{kind}/{subscription.msg_type.__name__}"
        for topic, name in own.items():
            for other in self._node.get_publishers_info_by_topic(topic) if len(types.get(topic, ())) > 1 else ():
                publisher = f"{other.topic_type} from {other.node_namespace.rstrip('/')}/{other.node_name}"
                problem = InvalidInputError(topic, publisher, name)
                if other.topic_type != name and str(problem) not in self._other_types and len(self._other_types) < 100:
                    self._other_types.add(str(problem))
                    self._node.get_logger().warning(reason_of(problem))
                    self.refuse(problem)

    def _publish_soon(self) -> None:
        if self._clock.now().nanoseconds * 1e-9 - self._sent > self.quiet:
            self.publish()
        elif self._late.is_canceled():
            self._late.reset()


def read_report(report: DiagnosticArray) -> dict[str, tuple[str, dict[str, str]]]:
    """Return message and values of each node in a report, of anybody, by its name, with texts of bounded length."""
    texts = {}
    for status in report.status:
        values = {shortened(pair.key): shortened(pair.value, MAX_REASON_CHARS) for pair in status.values[:100]}
        texts[shortened(status.name.split(":")[0])] = shortened(status.message, MAX_REASON_CHARS), values
    return texts


class GuardedNode(Node):
    """A node that reports on /diagnostics, answers a failed request by an error, and ignores an impossible time.

    What a service callback raises, those of rclpy for parameters, lifecycle and types included, would come out of
    `spin` and end the node; so would a time on /clock that rclpy cannot represent.
    """

    input_errors: ClassVar[tuple[type[Exception], ...]] = (InvalidInputError,)  # of messages that are refused

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        for service in self.services:  # those of rclpy itself
            service.callback = partial(_answer, self.get_logger(), service.srv_name, service.callback)
        # A weak reference: where a constructor fails, nothing may keep the node, which would stay in the graph.
        self.add_on_set_parameters_callback(partial(_check_parameters, ref(self)))

    @cached_property
    def health(self) -> Health:
        """Status of the node, published from its first use on."""
        return Health(self)

    @property
    def is_configured(self) -> bool:
        """Whether the node goes by what it has: by its scene, and its clock, as stamps of two cannot be compared."""
        return True

    @property
    def has_ended(self) -> bool:
        """Whether the node was shut down for good, so that its process can end."""
        return False

    def spin(self, executor: KeptWaitSetExecutor, is_over: Callable[[], bool]) -> None:
        """Do the work of this node, and of all others in its executor, until it is over."""
        executor.spin_until(is_over)

    def take_priority(self) -> None:
        """Give the process the real-time priority that a parameter of this node says, and report what it got."""
        if self.has_parameter("realtime_priority"):
            scheduling = raise_priority(self.get_parameter("realtime_priority").value)
            self.health.note(**{SCHEDULING: scheduling})
            self.get_logger().info(f"{SCHEDULING}: {scheduling}")

    def refuse(self, problem: Exception) -> None:
        """Report a message that was refused."""
        self.health.refuse(problem)

    def finish(self) -> None:
        """Publish what others must know before the node ends in order; the graph is still there."""

    def serve(
        self,
        service: interface.Service,
        execute: Callable[[Any], str | Mapping[str, Any]],
        starts: Callable[[Any], bool] = lambda request: False,
    ) -> None:
        """Offer a service, whose answer says whether it succeeded.

        Args:
            service: to offer.
            execute: executes a request; returns the message of the answer, or its fields by name. An error that it
                raises is the answer's reason of a failure.
            starts: whether a request may let the needle move, and is refused where it comes late.
        """

        def respond(request: Any, response: Any) -> Any:
            if starts(request) and offered.sent:  # set by `KeptWaitSetExecutor` alone
                check_pressed(service, offered.sent * 1e-9, time.time())
            result = execute(request)
            fields = {"message": result} if isinstance(result, str) else result
            for name, value in {"success": True, **fields}.items():
                setattr(response, name, value)
            return response

        answer = partial(_answer, self.get_logger(), service, respond)
        offered: Any = self.create_service(topics.ros_class(service.type_name), service, answer)
        offered.sent = 0

    def every(self, period: float, callback: Callable[[], object]) -> None:
        """Call back each period [s] of a steady clock: simulated time may stand still."""
        self.create_timer(period, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., object], *arguments: Any, **options: Any
    ) -> Subscription:
        """Subscribe; of /clock, to which rclpy subscribes by itself, only a possible time is passed on."""
        if msg_type is ClockMessage and not options.get("raw"):
            options["raw"], callback = True, partial(_take_clock, ref(self), callback)
        return super().create_subscription(msg_type, topic, callback, *arguments, **options)


def check_pressed(what: str, pressed: float, now: float) -> None:
    """Refuse what a person has pressed too long ago, or by a clock that is ahead by as much.

    Args:
        what: was pressed.
        pressed: when [s].
        now: the same clock now [s].

    Raises:
        InvalidInputError: it does not count any more.
    """
    if abs(now - pressed) > interface.PRESS_TIMEOUT:
        raise InvalidInputError(what, f"a request {now - pressed:.1f} s old", f"at most {interface.PRESS_TIMEOUT:g} s")


def _take_clock(node: Callable[[], Any], callback: Callable[..., object], data: bytes) -> None:
    def take(message: ClockMessage) -> None:
        reading.clock_nanoseconds(message)
        callback(message)

    topics.CLOCK.decoded(node(), data, take)


def _check_parameters(reference: Callable[[], Any], parameters: list[Parameter]) -> SetParametersResult:
    """Refuse a parameter without a name, which rclpy would declare, and another clock for a node that keeps its own."""
    node, reason = reference(), ""
    now = node.get_parameter("use_sim_time").value
    for parameter in parameters:
        if not parameter.name:
            reason = "a parameter without a name"
        elif parameter.name == "use_sim_time" and node.is_configured and parameter.value is not now:
            reason = str(ConfigurationError("use_sim_time", parameter.value, f"{now}, as the node has now"))
    return SetParametersResult(successful=not reason, reason=reason)


def _answer(logger: Any, name: str, callback: Callable[[Any, Any], Any], request: Any, response: Any) -> Any:
    """Return the answer of a service's callback; of one that raises, an error in the service's own form."""
    reason = ""
    try:
        for field in request.get_fields_and_field_types():  # lists that would take long to go through
            value = getattr(request, field)
            if isinstance(value, (list, tuple)) and len(value) > MAX_REQUEST_ENTRIES:
                raise InvalidInputError(field, f"{len(value)} entries", f"at most {MAX_REQUEST_ENTRIES}")
        if isinstance(request, SetParameters.Request):
            # Each for itself: one that fails must not hide what became of those before it.
            response.results = [_set_parameter(callback, parameter) for parameter in request.parameters]
            reason = next((result.reason for result in response.results if not result.successful), "")
        else:
            response = callback(request, response)
    except Exception as error:
        reason = reason_of(error)
        response = _refused(type(response)(), reason, request)
    if reason:  # one line for all of a request: rclpy takes long to find out who logs
        logger.warning(f"{name} refused: {reason}", throttle_duration_sec=PERIOD)
    return response


def _set_parameter(callback: Callable[[Any, Any], Any], parameter: Any) -> SetParametersResult:
    try:
        answer = callback(SetParameters.Request(parameters=[parameter]), SetParameters.Response())
    except Exception as error:
        return SetParametersResult(successful=False, reason=reason_of(error))
    result = answer.results[0]
    result.reason = shortened(result.reason, 2 * MAX_REASON_CHARS)  # rclpy's own may hold a name from outside
    return result


def reason_of(error: Exception) -> str:
    """Return the text of an error as it may be logged and answered."""
    return shortened(str(error) or type(error).__name__, MAX_REASON_CHARS)


def _refused(response: Any, reason: str, request: Any) -> Any:
    """Write into the default response of a service that the request has failed, where it has a field for that."""
    failed = SetParametersResult(successful=False, reason=reason)
    count = min(len(getattr(request, "parameters", ())), MAX_REQUEST_ENTRIES)
    fields = {"success": False, "message": reason, "successful": False, "failure_reason": reason}
    fields |= {"result": failed, "results": [failed] * count}
    for name, kind in response.get_fields_and_field_types().items():
        if name in fields and (not name.startswith("result") or "SetParametersResult" in kind):
            setattr(response, name, fields[name])
    return response


class ManagedNode(GuardedNode, LifecycleNode, Generic[C]):
    """A lifecycle node with the states of ROS 2: unconfigured, inactive, active, finalized.

    It uses messages, answers requests and commands only while it is active: see `while_active` and `require_active`.
    What others wait for, as its publishers, enters the graph when it is configured, with everything loaded, and leaves
    when it is cleaned up: all that was created meanwhile.

    Args:
        name: of the node.
        settings: its configuration class.
        fixed: parameters that stay while the node is configured, and why; all if None.
        options: for rclpy's node.

    Attributes:
        stands_by: whether its state on /diagnostics is that of its lifecycle while it is not active.
        is_active: whether it is active.
        settings: as the node was configured with them; None while unconfigured.
        problem: why the last transition failed.

    Raises:
        ConfigurationError: a parameter is invalid, or a parameter file cannot be used.
    """

    stands_by: ClassVar[bool] = True

    def __init__(self, name: str, settings: type[C], *, fixed: Mapping[str, str] | None = None, **options: Any) -> None:
        self.settings: C | None = None
        self.is_active = self._starts = False
        self.problem: Exception | None = None
        self._lasting: set[Any] | None = None  # what stays in the graph when the node is cleaned up
        self._agreed: tuple[C, Callable[[], None]] | None = None
        super().__init__(name, **options)
        self._class, self._names = settings, [field.name for field in configuration_fields(settings)]
        self._fixed = dict.fromkeys(self._names, "") if fixed is None else fixed
        try:
            declare(self, settings, options, fixed=self._fixed)
        except ConfigurationError:
            self._leave()
            raise
        self._service_change_state.callback = partial(self._change_state, self._service_change_state.callback)
        self.add_on_set_parameters_callback(self._check_change)
        self.add_post_set_parameters_callback(self._put_in_force)

    @abstractmethod
    def allocate(self, settings: C) -> None:
        """Allocate what the settings require; raise `MagnetosutureError` if that is impossible."""

    def activate(self) -> None:
        """Become active; raise `MagnetosutureError` where that cannot be."""

    def deactivate(self) -> None:
        """Become inactive; must not fail."""

    def release(self) -> None:
        """Give back what `allocate` took outside of the graph, also if it did not get to its end; must not fail."""

    def prepare(self, settings: C) -> Callable[[], None]:
        """Return what puts other settings in force, which must not fail; raise `MagnetosutureError` if they cannot be.

        Only called where some parameters are not fixed.
        """
        raise NotImplementedError

    def may_start(self) -> bool:
        """Return whether the node may become active by itself at its start."""
        return True

    @property
    def configured_settings(self) -> C:
        """The settings of a node that is configured."""
        assert self.settings is not None
        return self.settings

    @property
    def stage(self) -> str:
        """The state's name in ROS."""
        return str(self._state_machine.current_state[1])

    @property
    def is_shutting_down(self) -> bool:
        """Whether the node is being finalized, and not only made inactive."""
        return self.stage == "shuttingdown"

    @property
    def has_ended(self) -> bool:
        """Whether the node is finalized."""
        return self.stage == "finalized"

    @property
    def is_configured(self) -> bool:
        """Whether the node is configured."""
        return self.settings is not None

    def while_active(self, callback: Callable[..., None]) -> Callable[..., None]:
        """Return a callback of a subscription or timer that is called only while the node is active."""

        def call(*arguments: Any) -> None:
            if self.is_active:
                callback(*arguments)

        return call

    def require_active(self) -> None:
        """Refuse a request that only an active node can answer.

        Raises:
            GraphError: the node is not active.
        """
        if not self.is_active:
            raise GraphError(f"{self.get_name()} is {self.stage}; activate it first")

    def require(self, go: Callable[[], TransitionCallbackReturn]) -> None:
        """Make a transition.

        Raises:
            MagnetosutureError: it failed; the node stays before it.
        """
        self.problem = None
        if go() is not SUCCESS:
            raise self.problem or GraphError(f"{self.get_name()}: the transition from {self.stage} failed")

    def start(self) -> None:
        """Go as far as the parameter `autostart` says: unconfigured, inactive, or else active.

        Raises:
            MagnetosutureError: a transition failed; the node is destroyed.
        """
        until = self.get_parameter("autostart").value
        self._starts = True
        try:
            if until != "unconfigured":
                self.require(self.trigger_configure)
                if until != "inactive" and self.may_start():
                    self.require(self.trigger_activate)
        except BaseException:  # an interruption too: the driver may be open
            self.destroy_node()
            raise
        finally:
            self._starts = False
        if not self.is_active:
            self._stand_by("unconfigured" if self.settings is None else INACTIVE)

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Check the parameters and allocate what they require."""
        _ = self.health  # whose publisher stays
        self._lasting = set(self._entities())
        try:
            settings = from_mapping(self._class, self._declared())
            self.allocate(settings)
            if not self._starts:  # as `run` does when the node has started
                gc.collect()
                gc.freeze()
        except Exception as error:  # rclpy would swallow it, and what was taken would stay
            self._release_all()
            return self._failed(error, f"unconfigured: {error}")
        self.settings = settings
        self._stand_by(INACTIVE)
        return SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Become active."""
        self._stand_by("")
        try:
            self.activate()
        except Exception as error:
            return self._failed(error, INACTIVE)
        self.is_active = True
        return SUCCESS

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Become inactive; where even that fails, give all back."""
        try:
            self.deactivate()
        except Exception as error:
            self.on_cleanup(state)
            self._failed(error)
            return TransitionCallbackReturn.ERROR
        self.is_active = False
        self._stand_by(INACTIVE)
        return SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Give all back; the parameters can be set again."""
        self.is_active = False
        self._release_all()
        self.settings = None
        self._stand_by("finalized" if self.is_shutting_down else "unconfigured")
        return SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Give all back for good; after an unexpected error, until the node is configured again."""
        try:
            self.deactivate()
        except Exception as error:
            self._failed(error)
        return self.on_cleanup(state)

    on_error = on_shutdown

    def finish(self) -> None:
        """Shut down by the lifecycle, so that everything is given back while the graph is still there."""
        if not self.has_ended:
            self.trigger_shutdown()

    def destroy_node(self) -> None:
        """Give all back, and leave the graph at once."""
        try:
            self._release_all()
        finally:
            self._leave()

    def change(self, values: Mapping[str, Any]) -> None:
        """Set parameters together, as the service does.

        Raises:
            MagnetosutureError: they are refused; nothing has changed.
        """
        if values:
            if self.settings is None:  # then `_check_change` leaves it to `on_configure`
                from_mapping(self._class, {**self._declared(), **values})
            result = self.set_parameters_atomically([Parameter(name, value=value) for name, value in values.items()])
            if not result.successful:
                raise MagnetosutureError(result.reason)

    def _change_state(self, change: Callable[[Any, Any], Any], request: Any, response: Any) -> Any:
        """Make a transition; a lifecycle manager, as that of nav2, also configures what `autostart` has configured."""
        response.success = request.transition.id == Transition.TRANSITION_CONFIGURE and self.stage == "inactive"
        return response if response.success else change(request, response)

    def _entities(self) -> dict[Any, Callable[[Any], object]]:
        """Return what the node has in the graph, and what takes each out of it."""
        kinds = ("publisher", "subscription", "service", "timer")
        return {entity: getattr(self, f"destroy_{kind}") for kind in kinds for entity in getattr(self, f"{kind}s")}

    def _release_all(self) -> None:
        try:
            self.release()
        finally:
            for entity, destroy in self._entities().items():
                if self._lasting is not None and entity not in self._lasting:
                    destroy(entity)

    def _leave(self) -> None:
        super().destroy_node()
        # rclpy forgets it, and it keeps the node in the graph until garbage is collected.
        self._state_machine.destroy_when_not_in_use()

    def _stand_by(self, text: str) -> None:
        """Report the state of the lifecycle on /diagnostics; at the start, once the node has got as far as it goes."""
        if self.stands_by and self.context.ok() and (not self._starts or not text):
            self.health.stand_by(text)

    def _declared(self) -> dict[str, Any]:
        """Return the values of the parameters."""
        return {name: plain_value(self.get_parameter(name)) for name in self._names}

    def _failed(self, error: Exception, state: str = "") -> TransitionCallbackReturn:
        if state:
            self._stand_by(state)
        self.problem = error
        if not self._starts:  # at its start the node ends by this error
            self.get_logger().error(reason_of(error))
        return TransitionCallbackReturn.FAILURE

    def _check_change(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        """Refuse to change fixed settings of a configured node, and prepare others; the value in force is no change."""
        self._agreed = None
        if self.settings is None:
            return SetParametersResult(successful=True)
        in_force = to_mapping(self.settings)
        values = {parameter.name: plain_value(parameter) for parameter in parameters}
        changes = {name: value for name, value in values.items() if name in in_force and value != in_force[name]}
        try:
            for name, value in changes.items():
                where, length = f"{self._class.GROUP}.{name}", len(value) if isinstance(value, list) else 0
                if name in self._fixed:
                    shown = value[:10] if length else value  # a million entries take long to write
                    raise ConfigurationError(where, shown, "its value in force, until the node is cleaned up")
                if length > MAX_REQUEST_ENTRIES:
                    expected = f"at most {MAX_REQUEST_ENTRIES} while the node runs"
                    raise ConfigurationError(where, f"{length} entries", expected)
            if changes:
                settings = from_mapping(self._class, {**in_force, **changes})
                self._agreed = settings, self.prepare(settings)
        except MagnetosutureError as error:
            name = error.name.partition(".")[2] if isinstance(error, ConfigurationError) else ""
            reason = shortened(" ".join(str(error).split()), MAX_REASON_CHARS)
            if name not in ("", *changes):
                reason += "; what belongs together is set at once, by set_parameters_atomically"
            return SetParametersResult(successful=False, reason=reason)
        return SetParametersResult(successful=True)

    def _put_in_force(self, parameters: Sequence[Parameter]) -> None:
        if self._agreed is not None:
            (self.settings, put_in_force), self._agreed = self._agreed, None
            put_in_force()


class SceneFollower:
    """The scene that a node goes by.

    Of a message that is damaged, or whose scene the node cannot use, the reason is reported to the node's health and
    kept in `problem` until a good one comes; the scene before stays in force.

    Args:
        node: that subscribes.
        changed: called while the node is configured, with a scene of the topic that is another than the one in force,
            before it is; raises a `MagnetosutureError`, for example a `ConfigurationError`, where the node cannot use
            it.
        scene: in force at first; None if it is not known yet.

    Attributes:
        scene: in force; None until one is known.
        problem: why the scene that came last is not in force; empty where it is, or none came.
    """

    def __init__(self, node: GuardedNode, changed: Callable[[Scene], None], scene: Scene | None = None) -> None:
        self.scene, self.problem = scene, ""
        self._heard: Scene | None = None  # the last of the topic, also where it was refused; None if it was damaged
        self._node, self._changed = node, changed
        topics.SCENE.subscribe(node, self.on_scene, raw=True)

    @property
    def version(self) -> str:
        """Version of the scene in force; empty for none."""
        return "" if self.scene is None else self.scene.version

    def load(self, name: str) -> Scene | None:
        """Return the scene for a node that is configured now: the topic's if one has come, else that of a parameter.

        Raises:
            ConfigurationError: there is no such file, or it holds anything invalid.
        """
        if self._heard is None:
            self.scene = read_scene(name) if name else None
        else:
            self.scene, self.problem = self._heard, ""
            if name:
                self._node.get_logger().info(f"scene {self.version} of the topic, and not that of the parameter")
        return self.scene

    def on_scene(self, data: bytes) -> None:
        """Handle the bytes of a published scene."""
        self._heard = None
        try:
            self._heard = scene = reading.parse_scene_message(topics.SCENE.decode(data))
            if self._node.is_configured and scene.version != self.version:
                self._changed(scene)
        except MagnetosutureError as error:
            self.problem = f"scene refused: {shortened(str(error))}"
            self._node.health.refuse(error, **{"scene problem": self.problem})
        else:
            self.scene, self.problem = scene, ""
            self._node.health.note(**{"scene problem": "none"})
