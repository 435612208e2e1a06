"""A graph for one test: its own nodes in its module's context, an executor in a thread, waits on conditions."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import pytest
import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter

from magnetosuture_thread.nodes.executor import KeptWaitSetExecutor
from magnetosuture_thread.nodes.processes import graph_environment, is_empty, reserved_domain
from magnetosuture_thread.nodes.topics import Topic
from magnetosuture_thread.settings.interface import PRESS_TIMEOUT
from test.nodes.programs import Programs


class Graph:
    """Nodes of one test and a probe that speaks and listens to them.

    Args:
        context: of all nodes, which the tests of a module share: in one context, nodes find each other at once.
        domain: of the context.
    """

    def __init__(self, context: Context, domain: int) -> None:
        self.context, self.domain = context, domain
        self.executor = KeptWaitSetExecutor(context=self.context)
        self.nodes: list[Node] = []
        self.probe = rclpy.create_node("probe", context=self.context)
        self.nodes.append(self.probe)
        self.executor.add_node(self.probe)
        self._subscriptions: dict[str, Any] = {}
        self._publishers: dict[str, Any] = {}
        self._failure: BaseException | None = None
        self._spinning = threading.Lock()
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def add(self, make: Callable[..., Any], *, namespace: str = "", **parameters: Any) -> Any:
        """Make a node of the package with parameters and add it to the graph."""
        overrides = [Parameter(name, value=value) for name, value in parameters.items()]
        node = make(context=self.context, namespace=namespace, parameter_overrides=overrides)
        self.nodes.append(node)
        self.executor.add_node(node)
        return node

    def between_callbacks(self) -> AbstractContextManager[Any]:
        """Return a context in which no callback is at work."""
        return self._spinning

    def listen(self, topic: Topic) -> list[Any]:
        """Return the list that grows with every message on a topic, once somebody publishes it."""
        messages = self.listen_later(topic)
        self.wait(lambda: self.matched(topic), f"a publisher of {topic.name}")
        return messages

    def listen_later(self, topic: Topic) -> list[Any]:
        """Return the list that grows with every message on a topic."""
        messages: list[Any] = []
        subscription = self.probe.create_subscription(topic.message, topic.name, messages.append, topic.qos)
        self._subscriptions[topic.name] = subscription
        return messages

    def matched(self, topic: Topic) -> bool:
        """Return whether a publisher of a topic that we listen to has been found."""
        return bool(self._subscriptions[topic.name].get_publisher_count())

    def publish(self, topic: Topic, message: Any) -> None:
        """Publish, once somebody listens."""
        if topic.name not in self._publishers:
            self._publishers[topic.name] = self.probe.create_publisher(topic.message, topic.name, topic.qos)
        publisher = self._publishers[topic.name]
        self.wait(lambda: publisher.get_subscription_count() > 0, f"a subscriber of {topic.name}")
        others = [s for node in self.nodes for s in node.subscriptions if s.topic_name == publisher.topic_name]
        self.wait(lambda: all(s.get_publisher_count() > 0 for s in others), f"{topic.name} to be found")
        publisher.publish(message)

    def call(self, kind: Any, name: str, timeout: float = 30.0, /, *, held: float = 0.0, **fields: Any) -> Any:
        """Call a service, while no callback runs for a time [s], and return its answer."""
        client = self.probe.create_client(kind, name)
        self.wait(client.service_is_ready, f"the service {name}")
        with self.between_callbacks():
            future = client.call_async(kind.Request(**fields))
            time.sleep(held)
        self.wait(future.done, f"an answer of {name}", timeout)
        self.probe.destroy_client(client)
        return future.result()

    def call_late(self, kind: Any, name: str, **fields: Any) -> Any:
        """Call a service so that it is answered later than what a person has pressed counts."""
        return self.call(kind, name, held=PRESS_TIMEOUT + 0.1, **fields)

    def change(self, node: str, *transitions: int) -> bool:
        """Make transitions of a node, as `ros2 lifecycle set` does; return whether all succeeded."""
        name = f"{node}/change_state"
        return all(self.call(ChangeState, name, transition=Transition(id=each)).success for each in transitions)

    def stage(self, node: str) -> str:
        """Return the name of a node's state, as `ros2 lifecycle get` does."""
        return str(self.call(GetState, f"{node}/get_state").current_state.label)

    def wait(self, condition: Callable[[], bool], what: str, timeout: float = 30.0) -> None:
        """Wait until a condition holds."""
        deadline = time.monotonic() + timeout
        while not condition():
            if self._failure is not None:
                raise self._failure
            assert time.monotonic() < deadline, f"waited {timeout:g} s for {what}"
            time.sleep(0.002)

    def now(self) -> Any:
        """Return the time as a stamp."""
        return self.probe.get_clock().now().to_msg()

    def close(self) -> None:
        """End everything, and raise what a callback raised."""
        self._ends.set()
        self._thread.join(10.0)
        # Not before: an executor that is shut down amid a spin comes upon guards that are gone.
        self.executor.shutdown()
        for node in self.nodes:
            node.destroy_node()
        if self._failure is not None:
            raise self._failure

    def _spin(self) -> None:
        try:
            while not self._ends.is_set():
                with self._spinning:
                    self.executor.spin_once(timeout_sec=0.05)
                time.sleep(1e-4)  # who waits to remove a node gets its turn
        except BaseException as error:
            self._failure = error


@contextmanager
def own_context(domain: int) -> Iterator[Context]:
    """Return a context on a ROS domain, ended after it."""
    context = Context()
    rclpy.init(context=context, domain_id=domain, args=[])
    yield context
    context.try_shutdown()


@pytest.fixture(scope="module")
def shared_context() -> Iterator[tuple[Context, int]]:
    """The context of a module's tests, on a ROS domain of its own."""
    with reserved_domain() as domain:
        with own_context(domain) as context:
            yield context, domain
        assert is_empty(domain), "a node is still in the graph; who gets this domain next would meet it"


@pytest.fixture
def graph(shared_context: tuple[Context, int]) -> Iterator[Graph]:
    """A graph of one test; its nodes are destroyed at the end."""
    made = Graph(*shared_context)
    yield made
    made.close()


@pytest.fixture(scope="session")
def all_programs(tmp_path_factory: pytest.TempPathFactory) -> Programs:
    """Start node programs, forked from one process."""
    return Programs(tmp_path_factory.mktemp("programs"))


@pytest.fixture
def programs(all_programs: Programs) -> Iterator[Programs]:
    """Start node programs, which are ended with the test."""
    yield all_programs
    all_programs.kill_all()


@pytest.fixture
def environment(state_home: Path) -> Iterator[dict[str, str]]:
    """An environment on a ROS domain of its own."""
    with reserved_domain() as domain:
        yield graph_environment(domain)
