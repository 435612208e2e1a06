"""Lifecycle nodes: parameters are checked when a node is configured, and stay until it is cleaned up.

Those that a node can change while it runs are checked together with all that stay, by the configuration class, and are
in force once all of the node's callbacks have agreed.
"""

from __future__ import annotations

import gc
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Generic, TypeVar

from rcl_interfaces.msg import SetParametersResult
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.timer import Timer

from magnetosuture_thread import ConfigurationError, MagnetosutureError
from magnetosuture_thread.configuration import Configuration, configuration_fields, from_mapping, to_mapping
from magnetosuture_thread.errors import GraphError
from magnetosuture_thread.nodes.node import MAX_REASON_CHARS, MAX_REQUEST_ENTRIES, GuardedNode, reason_of
from magnetosuture_thread.nodes.parameters import as_declared, declare, given_parameters, plain_value
from magnetosuture_thread.texts import shortened

C = TypeVar("C", bound=Configuration)
E = TypeVar("E")  # a publisher, subscription, service or timer, or another part of a node with a method `destroy`

SUCCESS = TransitionCallbackReturn.SUCCESS
INACTIVE = "inactive: messages are not used until the node is activated"


class ManagedNode(GuardedNode, LifecycleNode, Generic[C]):
    """A lifecycle node with the states of ROS 2: unconfigured, inactive, active, finalized.

    It uses messages, answers requests and commands only while it is active: see `while_active` and `require_active`.
    What others wait for, as its publishers, enters the graph when it is configured, with everything loaded, and leaves
    when it is cleaned up: see `held`.

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
        self.is_active = False
        self.problem: Exception | None = None
        self._held: list[Any] = []
        self._agreed: tuple[C, Callable[[], None]] | None = None
        self._starts = False
        super().__init__(name, **options)
        self._class = settings
        every = dict.fromkeys((each.name for each in configuration_fields(settings)), "")
        self._fixed = every if fixed is None else fixed
        try:
            declare(self, settings, given_parameters(self, name, options), read_only=False, fixed=self._fixed)
        except ConfigurationError:
            self._leave()
            raise
        self.add_pre_set_parameters_callback(lambda parameters: as_declared(settings, parameters))
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
        """Give back what `allocate` took and is not held, also if that did not get to its end; must not fail."""

    def prepare(self, settings: C) -> Callable[[], None]:
        """Return what puts other settings in force, which must not fail; raise `MagnetosutureError` if they cannot be.

        Only called where some parameters are not fixed.
        """
        raise NotImplementedError

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
    def clock_is_fixed(self) -> bool:
        """Whether the node keeps the clock that it has: while it is configured."""
        return self.settings is not None

    def may_start(self) -> bool:
        """Return whether the node may become active by itself at its start."""
        return True

    def held(self, entity: E) -> E:
        """Return an entity of this node, after noting that it leaves the graph when the node is cleaned up."""
        self._held.append(entity)
        return entity

    def give_back(self, entity: Any) -> None:
        """Take an entity that is held out of the graph."""
        self._held.remove(entity)
        kinds = (
            (Publisher, self.destroy_publisher),
            (Subscription, self.destroy_subscription),
            (Service, self.destroy_service),
            (Timer, self.destroy_timer),
        )
        destroy = next((destroy for kind, destroy in kinds if isinstance(entity, kind)), type(entity).destroy)
        destroy(entity)

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
        try:
            settings = from_mapping(self._class, self._declared())
            self.allocate(settings)
            if not self._starts:  # as `run` does when the node has started
                gc.collect()
                gc.freeze()
        except Exception as error:  # rclpy would swallow it, and what was taken would stay
            self._release_all()
            self._stand_by(f"unconfigured: {error}")
            return self._failed(error)
        self.settings = settings
        self._stand_by(INACTIVE)
        return SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Become active."""
        self._stand_by("")
        try:
            self.activate()
        except Exception as error:
            self._stand_by(INACTIVE)
            return self._failed(error)
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
        """Give all back for good."""
        try:
            self.deactivate()
        except Exception as error:
            self._failed(error)
        return self.on_cleanup(state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """After an unexpected error, release everything; the node can be configured again."""
        return self.on_shutdown(state)

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

    def _release_all(self) -> None:
        self.release()
        for entity in tuple(self._held):
            self.give_back(entity)

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
        names = [each.name for each in configuration_fields(self._class)]
        return {name: plain_value(self.get_parameter(name)) for name in names}

    def _failed(self, error: Exception) -> TransitionCallbackReturn:
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
        asked = {each.name: plain_value(each) for each in parameters if each.name in in_force}
        asked = {name: value for name, value in asked.items() if value != in_force[name]}
        try:
            for name, value in asked.items():
                where, long = f"{self._class.GROUP}.{name}", isinstance(value, list) and len(value)
                if name in self._fixed:
                    shown = value[:10] if long else value  # a million entries take long to write
                    raise ConfigurationError(where, shown, "its value in force, until the node is cleaned up")
                if long > MAX_REQUEST_ENTRIES:
                    expected = f"at most {MAX_REQUEST_ENTRIES} while the node runs"
                    raise ConfigurationError(where, f"{long} entries", expected)
            if asked:
                settings = from_mapping(self._class, {**in_force, **asked})
                self._agreed = settings, self.prepare(settings)
        except MagnetosutureError as error:
            return SetParametersResult(successful=False, reason=_reason(error, asked))
        return SetParametersResult(successful=True)

    def _put_in_force(self, parameters: Sequence[Parameter]) -> None:
        if self._agreed is not None:
            (self.settings, put_in_force), self._agreed = self._agreed, None
            put_in_force()


def _reason(error: MagnetosutureError, asked: Mapping[str, Any]) -> str:
    """Return why a change was refused, in one line."""
    named = error.name.partition(".")[2] if isinstance(error, ConfigurationError) else ""
    together = "" if named in ("", *asked) else "; what belongs together is set at once, by set_parameters_atomically"
    return shortened(" ".join(str(error).split()), MAX_REASON_CHARS) + together
