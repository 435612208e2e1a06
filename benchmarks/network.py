"""Run the graph over two hosts and pull the cable between them, as network namespaces of this machine.

Camera, rig and bridge are on one, thread model, path follower and operator's page on the other. The cable is pulled
at random moments while the coils are driven, of a network as it is and of one that delays and loses packets; measured
is when the coils are at zero, and when the needle goes on after the cable is back. It takes root's rights (TAP
devices), and about half an hour.
"""

from __future__ import annotations

import argparse
import random
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.hosts import two_hosts
from benchmarks.report import figures_table
from magnetosuture_thread.commands.command import Terminal, whole_number
from magnetosuture_thread.rig.setups import read_setup
from magnetosuture_thread.settings.errors import GraphError

if TYPE_CHECKING:
    from magnetosuture_thread.nodes.processes import NodeProcesses

DELAY, LOSS = 0.05, 0.05  # s, and share of packets
SETUP = "petri_35mm_polyamide"
DOMAIN = 1  # of ROS, on hosts that have no other graph
AT_THE_RIG = ("scene_server", "rig_simulator", "vision_tracker", "coil_bridge")
AT_THE_DESK = ("thread_model", "path_follower", "console")
# Not by TCP, whose packets wait for one that was lost.
ENVIRONMENT = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET", "FASTDDS_BUILTIN_TRANSPORTS": "DEFAULT"}
COMMAND_TIMEOUT = 0.2  # s, for a command that was on its way for 50 ms, and one after it that was lost
BRIDGE = {"driver": "simulated", "autostart": "armed", "command_timeout": str(COMMAND_TIMEOUT)}
# What is sent anew with every pose is not worth waiting for.
BEST_EFFORT = {
    f"{node}:qos_overrides./{topic}.{end}.reliability": "best_effort"
    for topic, sender in (("needle/servo_cv", "path_follower"), ("thread/margins", "thread_model"))
    for node, end in ((sender, "publisher"), ("coil_bridge", "subscription"))
}
DRIVEN_TIME = 0.3  # s for which the coils must be driven before the cable is pulled
STOP_EVERY = 10  # cuts of which in one the emergency stop is pressed at the rig while the cable is out
TIMEOUT = 60.0  # s for anything to happen ...
START_TIMEOUT = 300.0  # ... but for the first start on a machine, which compiles

Log = Callable[[str], None]
Progress = Callable[[float], None]


@dataclass
class CutReport:
    """What pulling the cable did on one network.

    Attributes:
        delay: of each packet [s].
        loss: share of packets that is lost.
        zero: of each cut, time until the last current that is not zero [s].
        resumed: of each cut without an emergency stop, time from plugging until the coils are driven again [s].
        late: cuts after which the coils were driven for longer than the command's timeout, or again while it was out.
        stops: cuts in which the emergency stop was pressed.
        stops_kept: those of them that stayed at zero until a reset.
    """

    delay: float
    loss: float
    zero: list[float] = field(default_factory=list)
    resumed: list[float] = field(default_factory=list)
    late: int = 0
    stops: int = 0
    stops_kept: int = 0

    def to_json(self) -> dict[str, Any]:
        """Return the figures for a file [s]."""
        figures = {**vars(self), "cuts": len(self.zero), "in_time": len(self.zero) - self.late}
        for name in ("zero", "resumed"):
            times = figures.pop(name)
            figures |= {f"{name}_median": float(np.median(times)), f"{name}_maximum": max(times)}
        return figures


class CableBench:
    """The graph over two hosts, the cable between them, and what the bridge gives to the simulated rig.

    Args:
        execute: executes a command of the cable.
        processes: none of which may end.

    Attributes:
        driven: when the bridge last gave currents that are not zero, by the system's clock [s]; -inf before the first.
        since: when it began to do so without a pause of `DRIVEN_TIME` [s].
        armed: whether the bridge is armed.
        reasons: why the currents are zero.
        spin: takes what comes for a while [s].
        close: leaves the graph.
    """

    def __init__(self, execute: Callable[[str], None], processes: Sequence[NodeProcesses]) -> None:
        from magnetosuture_thread.nodes import topics
        from magnetosuture_thread.nodes.clients import Recorder

        self._execute, self._processes, self._random = execute, processes, random.Random(1)
        self._state, self._currents = topics.BRIDGE_STATE, topics.RIG_CURRENTS
        taken = [self._currents, self._state]
        recorder = Recorder(DOMAIN, taken, simulated_clock=False, receive=self._receive)
        self.close, self.spin = recorder.close, recorder.spin
        self.driven = self.since = -np.inf
        self.armed, self.reasons = False, ""

    def pull_cable(self, report: CutReport, cuts: int, progress: Progress) -> None:
        """Pull the cable at random moments."""
        self._execute(f"impair {report.delay} {report.loss}")
        self._wait(self._is_driven, "the coils are not driven", START_TIMEOUT)
        for number in range(cuts):
            self._cut(report, stops=number % STOP_EVERY == STOP_EVERY - 1)
            progress((number + 1) / cuts)
        self._execute("impair 0 0")

    def _cut(self, report: CutReport, stops: bool) -> None:
        self._wait(self._is_driven, "the coils are not driven")
        self.spin(self._random.uniform(0.0, 1.0))
        self._wait(lambda: time.time() - self.driven < 0.1, "the coils are not driven")
        self._execute("pull")
        pulled = time.time()
        self.spin(self._random.uniform(0.3, 4.0))
        if stops:
            _press("stop")
        report.zero.append(max(0.0, self.driven - pulled))
        report.late += report.zero[-1] > COMMAND_TIMEOUT
        self._execute("plug")
        plugged, before = time.time(), self.driven
        if stops:
            self.spin(2.0)  # s for which it must stay at zero
            report.stops += 1
            report.stops_kept += self.driven == before and not self.armed
            _press("reset", "arm")
        else:
            self._wait(lambda: self.driven > plugged, "the coils are not driven again")
            report.resumed.append(self.driven - plugged)

    def _is_driven(self) -> bool:
        """Return whether the coils are driven, and have been for a while."""
        now = time.time()
        return now - self.driven < DRIVEN_TIME <= now - self.since

    def _wait(self, condition: Callable[[], bool], what: str, timeout: float = TIMEOUT) -> None:
        """Take what comes until a condition holds; raise `GraphError` if it does not within the timeout [s]."""
        end = time.monotonic() + timeout
        while not condition():
            for processes in self._processes:
                processes.check()
            if time.monotonic() > end:
                raise GraphError(f"after {timeout:g} s {what}; coil_bridge: {self.reasons or 'no reason'}")
            self.spin(0.02)

    def _receive(self, topic: str, arrival: int, data: bytes) -> None:
        if topic == self._state.channel.recorded:
            state = self._state.decode(data)
            self.armed, self.reasons = state.armed, "; ".join(state.reasons)
            return
        message = self._currents.decode(data)
        if np.any(np.abs(message.current) > 0.0):
            stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
            if stamp - self.driven > DRIVEN_TIME:
                self.since = stamp
            self.driven = stamp


def measure_network(networks: Sequence[tuple[float, float, int]], log: Log, progress: Progress) -> list[CutReport]:
    """Run the graph over two hosts and pull the cable between them; return a report of each network.

    Args:
        networks: delay [s], share of packets lost, and cuts of each; those without cuts are left out.
        log: called with a line for a person at each stage.
        progress: called with the share of a stage done, 0 to 1.

    Raises:
        GraphError: the hosts cannot be made, a node ended, or the coils are not driven.
    """
    setup, reports = read_setup(SETUP), list[CutReport]()
    with two_hosts() as (execute, desk_prefix), tempfile.TemporaryDirectory() as folder:
        # Imported here: threads that it starts have to be on the rig's host.
        from magnetosuture_thread.nodes.processes import NodeProcesses, environment_of, graph_environment

        environment = {**graph_environment(DOMAIN), **ENVIRONMENT}
        path = ",".join(map(str, (*setup.follower.waypoints,) * 500))  # so that it does not end
        shared = ["--params-file", str(setup.path.resolve()), *_parameters(BEST_EFFORT)]
        at_the_rig = [*shared, *_parameters({f"coil_bridge:{name}": value for name, value in BRIDGE.items()})]
        at_the_desk = [*shared, *_parameters({"path_follower:waypoints": f"[{path}]", "console:port": "0"})]
        log("starting the nodes at the rig and at the desk")
        rig = NodeProcesses(AT_THE_RIG, at_the_rig, environment, Path(folder, "rig"))
        desk = NodeProcesses(AT_THE_DESK, at_the_desk, environment, Path(folder, "desk"))
        desk.prefix = desk_prefix
        with environment_of(environment), rig, desk, closing(CableBench(execute, (rig, desk))) as bench:
            for delay, loss, cuts in filter(lambda network: network[2], networks):
                log(f"{cuts} cuts, with packets {1e3 * delay:g} ms late and {100.0 * loss:g} % lost")
                reports.append(CutReport(delay, loss))
                bench.pull_cable(reports[-1], cuts, progress)
    return reports


def _parameters(values: Mapping[str, str]) -> list[str]:
    return [part for name, value in values.items() for part in ("-p", f"{name}:={value}")]


def _press(*switches: str) -> None:
    """Press switches of the bridge, at the rig."""
    from magnetosuture_thread.nodes.clients import CoilClient

    with CoilClient() as client:
        for switch in switches:
            client.execute(switch)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    option, late = parser.add_argument, f"packets are {1e3 * DELAY:g} ms late and {100.0 * LOSS:g} %% are lost"
    option("--cuts", type=whole_number, default=150, metavar="N", help="cuts of a network as it is (default: 150)")
    text = f"cuts where {late} (default: 50)"
    option("--impaired-cuts", type=whole_number, default=50, metavar="N", help=text)


def run(options: argparse.Namespace, terminal: Terminal) -> tuple[dict[str, Any], bool]:
    """Pull the cable; return the figures, and whether the coils were at zero in time after each cut."""
    networks = [(0.0, 0.0, options.cuts), (DELAY, LOSS, options.impaired_cuts)]
    with terminal.progress("network") as advance:
        reports = measure_network(networks, terminal.log, advance)
    figures = [report.to_json() for report in reports]
    columns = {
        "network": "{delay:g} s, {loss:.0%} lost",
        f"at zero within {COMMAND_TIMEOUT:g} s": "{in_time} of {cuts}",
        "median, maximum [s]": "{zero_median:.3f}, {zero_maximum:.3f}",
        "goes on [s]": "{resumed_median:.3f}, {resumed_maximum:.3f}",
        "stops kept": "{stops_kept} of {stops}",
    }
    terminal.print(figures_table("Two hosts, simulated rig", figures, columns))
    # No stopped bridge may go on by itself either.
    passed = all(report.late == 0 and report.stops == report.stops_kept for report in reports)
    return {"bound": COMMAND_TIMEOUT, "networks": figures}, passed
