"""A managed node: its parameters are checked when it is configured, and stay as they are while it is."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import SetParametersResult
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter

from magnetosuture_thread import ConfigurationError
from magnetosuture_thread.configuration import ROS_PARAMETERS, Configuration
from magnetosuture_thread.errors import GraphError
from magnetosuture_thread.nodes.node import PackageNode, reason_of
from magnetosuture_thread.nodes.parameter_files import node_options
from magnetosuture_thread.nodes.parameters import declare

C = TypeVar("C", bound=Configuration)

SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE
ERROR = TransitionCallbackReturn.ERROR


class ManagedNode(PackageNode, LifecycleNode, Generic[C]):
    """A lifecycle node with the states of ROS 2: unconfigured, inactive, active, finalized.

    Args:
        name: of the node.
        settings: its configuration class.
        options: for rclpy's node.

    Attributes:
        settings: in force; None while unconfigured.
        problem: why the last transition failed.
    """

    def __init__(self, name: str, settings: type[C], **options: Any) -> None:
        self.settings: C | None = None
        super().__init__(name, **node_options(name, options))
        self._class = settings
        self.problem: Exception | None = None
        # All can be set before the node is configured, which then says which of them are invalid.
        with suppress(ConfigurationError):
            declare(self, settings, read_only=False)
        self.add_on_set_parameters_callback(self._keep)

    @abstractmethod
    def begin(self, settings: C) -> None:
        """Allocate what the settings require; raise `MagnetosutureError` if that is impossible."""

    @abstractmethod
    def resume(self) -> None:
        """Become active; raise `MagnetosutureError` where that cannot be."""

    @abstractmethod
    def pause(self) -> None:
        """Become inactive; must not fail."""

    @abstractmethod
    def end(self) -> None:
        """Give all back that was taken in `begin`, also if that did not get to its end; must not fail."""

    @property
    def stage(self) -> str:
        """The state's name in ROS."""
        return str(self._state_machine.current_state[1])

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
        if self.get_parameter_or("autostart").value == "unconfigured":
            return
        try:
            self.require(self.trigger_configure)
            if self.get_parameter("autostart").value != "inactive" and self.may_start():
                self.require(self.trigger_activate)
        except BaseException:  # an interruption too: the driver may be open
            self.destroy_node()
            raise

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Check the parameters and allocate what they require."""
        try:
            settings = declare(self, self._class, read_only=False)
            self.begin(settings)
        except Exception as error:  # rclpy would swallow it, and what was taken would stay
            self.end()
            return self._failed(error)
        self.settings = settings
        return SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Become active."""
        try:
            self.resume()
        except Exception as error:
            return self._failed(error)
        return SUCCESS

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Become inactive; where even that fails, give all back."""
        try:
            self.pause()
        except Exception as error:
            self.on_cleanup(state)
            self._failed(error)
            return ERROR
        return SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Give all back; the parameters can be set again."""
        self.end()
        self.settings = None
        return SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Give all back for good."""
        try:
            self.pause()
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
            self.end()
        finally:
            super().destroy_node()
        # rclpy forgets it, and it keeps the node in the graph until garbage is collected.
        self._state_machine.destroy_when_not_in_use()

    def _failed(self, error: Exception) -> TransitionCallbackReturn:
        self.problem = error
        self.get_logger().error(reason_of(error))
        return FAILURE

    def _keep(self, parameters: list[Parameter]) -> SetParametersResult:
        """Refuse to change settings under a configured node."""
        held = [p.name for p in parameters if p.name.split(".")[0] not in ROS_PARAMETERS]
        if self.settings is None or not held:
            return SetParametersResult(successful=True)
        error = ConfigurationError(held[0], "a change while configured", "a cleaned-up node")
        return SetParametersResult(successful=False, reason=str(error))
