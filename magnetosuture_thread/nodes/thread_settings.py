"""Settings of the node `thread_model` as they change while it runs: by parameters and by ThreadMaterial messages."""

from __future__ import annotations

from collections.abc import Callable

from magnetosuture_thread import MagnetosutureError
from magnetosuture_thread.configuration import configuration_fields
from magnetosuture_thread.model.session import ThreadSession
from magnetosuture_thread.model.settings import ThreadModelSettings, parse_material
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.diagnostics import Health
from magnetosuture_thread.nodes.node import PackageNode
from magnetosuture_thread.nodes.parameters import Changeable


class ThreadSettings:
    """Changes a session's settings by the node's parameters.

    A message becomes parameters, so that these always tell what is in force, and there is one way to refuse.

    Args:
        node: has the session's settings declared as its parameters.
        session: whose settings they are.
        health: where a message is said to be refused; who calls a service is told.
    """

    def __init__(self, node: PackageNode, session: ThreadSession, health: Health) -> None:
        self._node, self._session, self._health = node, session, health
        self._names = [about.name for about in configuration_fields(ThreadModelSettings)]
        self._parameters = Changeable(node, session.settings, self._prepare)

    def close(self) -> None:
        """Change the settings no more."""
        self._parameters.close()

    def on_material(self, data: bytes) -> None:
        """Apply a ThreadMaterial message, or report why it is refused."""
        try:
            self._parameters.set(parse_material(topics.MATERIAL.decode(data)))
        except MagnetosutureError as error:
            self._health.refuse(error)

    def _prepare(self, settings: ThreadModelSettings) -> Callable[[], None]:
        put_in_force = self._session.prepare(settings, self._session.scene)

        def change() -> None:
            before = self._session.settings
            put_in_force()
            changed = [name for name in self._names if getattr(settings, name) != getattr(before, name)]
            if changed:
                self._node.get_logger().info(f"changed: {', '.join(changed)}")

        return change
