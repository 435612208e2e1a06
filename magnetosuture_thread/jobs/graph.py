"""A graph of a job's own: a ROS domain that nobody else uses, on this machine alone, and node processes in it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from magnetosuture_thread.interface import STANDBY_NODES
from magnetosuture_thread.jobs.replay_inputs import Log
from magnetosuture_thread.nodes.node import COMPILING
from magnetosuture_thread.nodes.processes import NodeProcesses, environment_of, graph_environment, reserved_domain
from magnetosuture_thread.nodes.run import Interruption

START_TIMEOUT = 240.0  # s for all nodes to be there; the first start on a machine compiles
POLL_PERIOD = 0.02  # s between two looks at the nodes

# Arguments for the nodes, after `--ros-args`. Where two cores carry the whole graph and a recording besides, the bridge
# leaves them more of it. Whatever a setup says for a launch, nobody would activate the nodes of a job.
JOB = ("-p", "coil_bridge:rate:=100.0", *(p for name in STANDBY_NODES for p in ("-p", f"{name}:autostart:=active")))
# Ahead in s, and between two forecasts: what page and recording show, without poses that come late for it.
FORECAST = ("-p", "thread_model:forecast_horizon:=3.0", "-p", "thread_model:forecast_period:=0.2")


@dataclass
class OwnGraph:
    """Nodes that run in a ROS domain of their own.

    Attributes:
        domain: the ROS domain.
        nodes: the processes.
        interruption: keeps Ctrl-C until `check` is called, while entered.
    """

    domain: int
    nodes: NodeProcesses
    interruption: Interruption

    def check(self) -> None:
        """Raise `KeyboardInterrupt` if a person has interrupted, and `GraphError` if a node has ended."""
        self.interruption.check()
        self.nodes.check()


@contextmanager
def own_domain() -> Iterator[tuple[int, dict[str, str]]]:
    """Yield a ROS domain that nobody else uses, and the environment for it, which this process has meanwhile.

    Raises:
        GraphError: all domains are in use.
    """
    with reserved_domain() as domain:
        environment = graph_environment(domain)
        with environment_of(environment):
            yield domain, environment


@contextmanager
def own_graph(
    processes: Sequence[str], arguments: Sequence[str], logs: Path, what: str, log: Log
) -> Iterator[OwnGraph]:
    """Start nodes in a ROS domain of their own; they are ended with the context.

    Args:
        processes: names of the nodes' programs.
        arguments: for each, after `--ros-args`.
        logs: folder that gets a log file of each.
        what: starts, as it is logged.
        log: called with a line for a person.

    Raises:
        GraphError: all domains are in use.
    """
    with own_domain() as (domain, environment):
        log(f"starting {what} (ROS domain {domain}, this machine only)")
        with NodeProcesses(processes, arguments, environment, logs) as nodes:
            yield OwnGraph(domain, nodes, Interruption())


def log_compiling(texts: Mapping[str, str], logged: set[str], log: Log) -> None:
    """Log, once of each node, that it compiles.

    Args:
        texts: state of each node.
        logged: nodes of which it was logged; grows.
        log: called with a line for a person.
    """
    for name, text in texts.items():
        if text.startswith(COMPILING) and name not in logged:
            logged.add(name)
            log(f"{name}: {text}")
