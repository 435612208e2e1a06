"""What an operator asks of the needle, filtered by the thread model into commands for the coil bridge."""

from __future__ import annotations

from geometry_msgs.msg import TwistStamped
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from magnetosuture_thread.coils.sources import SourceWatch
from magnetosuture_thread.errors import InvalidInputError, SolverError
from magnetosuture_thread.interface import OPERATOR_COMMAND
from magnetosuture_thread.model.session import ThreadSession
from magnetosuture_thread.model.steering import at_rest
from magnetosuture_thread.nodes import messages, thread_messages, topics
from magnetosuture_thread.nodes.diagnostics import Health


class ThreadSteering:
    """Answers every velocity that an operator asks for by one that the thread and the obstacles allow.

    It never speaks by itself: an operator who falls silent is followed by silence, and the bridge stops. The command
    keeps the stamp of what was asked, so that the bridge counts how old that is. Of two operators at once neither is
    answered: the bridge, which hears one publisher only, could not tell.

    Args:
        node: has the topics.
        session: knows the thread.
        health: where a message is said to be refused.
    """

    def __init__(self, node: Node, session: ThreadSession, health: Health) -> None:
        self._session, self._health = session, health
        self._commands = topics.NEEDLE_COMMAND.publisher(node)
        self._states = topics.STEERING_STATE.publisher(node)
        self._sources = SourceWatch()
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        topics.OPERATOR_COMMAND.subscribe_numbered(node, self.on_asked)

    def on_asked(self, message: TwistStamped, number: int) -> None:
        """Pass on what is allowed of a velocity; one that cannot be used is refused, and the needle told nothing."""
        speaking = self._sources.hear(number, self._steady.now().nanoseconds * 1e-9)
        try:
            asked = messages.plane_velocity(message, OPERATOR_COMMAND.name)
            stamp = messages.checked_nanoseconds(message.header.stamp, OPERATOR_COMMAND.name)
            if speaking > 1:
                raise InvalidInputError(OPERATOR_COMMAND.name, f"{speaking} publishers at once", "one")
            try:
                what = self._session.on_asked(stamp, asked)
            except SolverError as error:
                what = at_rest(asked, str(error))
        except InvalidInputError as error:
            self._health.refuse(error)
            return
        self._commands.publish(messages.twist_message(message.header.stamp, what.passed))
        self._states.publish(thread_messages.steering_state(message.header.stamp, what))
