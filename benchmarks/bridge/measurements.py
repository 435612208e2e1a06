"""Measures how soon the coils are at zero after a commander falls silent or a process is killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import yaml

from benchmarks.bridge.report import BridgeReport, ZeroDelays
from magnetosuture_thread.coils.watchdog import SILENCE_TIMEOUT
from magnetosuture_thread.errors import GraphError
from magnetosuture_thread.rig.power.stage import PowerStage
from magnetosuture_thread.rig.power.watch import DriveWatch
from magnetosuture_thread.setups import read_setup

if TYPE_CHECKING:
    from magnetosuture_thread.nodes.clients import CoilClient
    from magnetosuture_thread.nodes.processes import NodeProcesses

SETUP = "petri_35mm_polyamide"
BURST, PAUSE = 0.2, 0.3  # s of commands, and of silence on average
MOVING = 0.3  # s for which the coils must be driven before something is killed
ATTEMPTS = 7  # to arm
HEARD = 10.0  # s for a process to start and to be heard
TIMEOUT = 30.0  # s for anything to happen
LOOP = 12.0  # s over which the loop's period is looked at; the bridge keeps the last 2000 intervals
FULL = 32767
SUPPLY, RESISTANCE, INDUCTANCE = 24.0, 1.0, 0.005  # V, ohm, H of the simulated boards and coils

Log = Callable[[str], None]


class BridgeBench:
    """A bridge with simulated boards on serial lines, and all that can fail around it, as processes.

    Args:
        stage: the boards.
        nodes: the processes.
        client: makes one for the bridge's switches.
        logs: folder of what the processes print.
        bound: the command's timeout and one period of the loop [s].

    Attributes:
        unheard: how often nobody who was started after a kill was heard, until the bridge was started anew.
    """

    def __init__(
        self, stage: PowerStage, nodes: NodeProcesses, client: Callable[[], CoilClient], logs: Path, bound: float
    ) -> None:
        self._watch = DriveWatch(stage)
        self._nodes = nodes
        self._client = client
        self._logs = logs
        self._bound = bound
        self.unheard = 0

    def start(self, name: str, **parameters: float | str) -> None:
        """Start the bridge, or a stand-in for a commander, a tracker or a fuzzer."""
        if name == "coil_bridge":
            self._nodes.start(name)
            self._arm()
            return
        given = [f"kind:={name}", *(f"{key}:={value}" for key, value in parameters.items())]
        arguments = ["-r", f"__node:={name}", *(part for each in given for part in ("-p", each))]
        self._nodes.start(name, module="benchmarks.bridge.traffic", arguments=arguments)

    def stop_trials(self, trials: int, progress: Callable[[float], None]) -> ZeroDelays:
        """Let a commander fall silent again and again; return the times from its last command to zero."""
        self.start("commander")
        self._drive()
        self._nodes.kill("commander")
        self._wait(lambda: not self._driven(), "zero")
        self.start("commander", burst=BURST, pause=PAUSE)
        log = self._logs / "commander.log"
        delays: list[float] = []
        rearmed = 0
        last = time.monotonic()
        while len(delays) < trials:
            time.sleep(0.2)
            # The last line may be half written.
            stops = [float(line) for line in log.read_text().split("\n")[:-1]]
            if self._driven():
                last = time.monotonic()
            elif time.monotonic() - last > HEARD and rearmed < ATTEMPTS:
                # Where the machine stands still for longer than a board may take to answer, the bridge is in fault, as
                # it should; the trials go on after a person has armed it again.
                rearmed += 1
                self._arm()
                last = time.monotonic()
            delays = self._watch.to_zero(stops)
            progress(len(delays) / trials)
            self._check(last + TIMEOUT)
        self._nodes.kill("commander")
        return ZeroDelays.of("last command", delays[:trials], self._bound)

    def kills(self, name: str, times: int, progress: Callable[[float], None]) -> ZeroDelays:
        """Kill a process again and again while the coils are driven; return the times to zero."""
        delays = []
        for done in range(times):
            self._drive()
            began = time.monotonic()
            self._nodes.kill(name)
            self._wait(lambda: not self._driven(), f"zero after {name} was killed")
            delays += self._watch.to_zero([began])
            progress((done + 1) / times)
            self.start(name)
        return ZeroDelays.of(f"kill -9 of {name}", delays, 0.25)

    def fuzz(self, count: int) -> float:
        """Publish hostile messages and see that the bridge works afterwards.

        Returns:
            The greatest current asked of a board meanwhile [A].

        Raises:
            GraphError: it does not.
        """
        # While the bridge still counts those that were killed as speaking, it would refuse all without looking.
        self._wait(lambda: not self._driven(), "zero")
        time.sleep(2.0 * SILENCE_TIMEOUT)
        self._watch.forget()
        self.start("fuzzer", count=count)
        self._wait(lambda: self._nodes.ended("fuzzer"), "the fuzzer to end", TIMEOUT + count / 200.0)
        self._nodes.kill("fuzzer")  # whose work is done
        self._watch.look()
        greatest = self._watch.largest / FULL * SUPPLY / RESISTANCE
        self._arm()
        self.start("tracker")
        self.start("commander")
        self._drive()
        return greatest

    def _drive(self) -> None:
        """Wait until the coils have been driven for a while, and start all anew where they are not."""
        for _ in range(ATTEMPTS):
            try:
                self._wait(self._driven_for_a_while, "the coils to be driven", HEARD)
                return
            except GraphError:
                # Who is killed may leave Fast DDS's shared memory such that nobody who starts later is heard; and where
                # the machine stands still for longer than a board may take to answer, the bridge is in fault.
                self.unheard += 1
                for name in ("commander", "tracker", "coil_bridge"):
                    self._nodes.kill(name)
                for name in ("coil_bridge", "tracker", "commander"):
                    self.start(name)
        self._wait(self._driven_for_a_while, "the coils to be driven")

    def _arm(self) -> None:
        """Arm the bridge; start it anew where it is not heard."""
        for attempt in range(ATTEMPTS):
            try:
                # Another each time: the one that is not heard may be the client.
                with self._client() as client:
                    client.execute("reset")  # one that was killed while armed waits for it
                    client.execute("arm")
                return
            except GraphError as error:
                self._nodes.check()
                if attempt == ATTEMPTS - 1:
                    raise GraphError(f"the bridge cannot be armed: {error}") from None
                if attempt % 2:
                    self.unheard += 1
                    self._nodes.kill("coil_bridge")
                    self._nodes.start("coil_bridge")

    def _driven(self) -> bool:
        self._watch.look()
        return self._watch.driven

    def _driven_for_a_while(self) -> bool:
        return self._driven() and time.monotonic() - self._watch.turns[-1][0] > MOVING

    def _wait(self, condition: Callable[[], bool], what: str, patience: float = TIMEOUT) -> None:
        deadline = time.monotonic() + patience
        while not condition():
            time.sleep(0.01)
            self._check(deadline, what)

    def _check(self, deadline: float, what: str = "the trials") -> None:
        if time.monotonic() > deadline:
            with self._client() as client:
                raise GraphError(f"waited in vain for {what}; the bridge says: {client.state()}")


def measure_bridge(
    trials: int,
    kills: int,
    hostile: int,
    busy: bool = True,
    log: Log = lambda text: None,
    progress: Callable[[float], None] = lambda s: None,
) -> BridgeReport:
    """Measure a coil bridge that drives simulated RoboClaw boards, on a machine all of whose cores are busy.

    Args:
        trials: of a commander that falls silent.
        kills: of each process.
        hostile: messages.
        busy: whether to keep all cores busy meanwhile.
        log: called with a line for a person at each stage.
        progress: called with the share of a stage done, 0 to 1.
    """
    # Only here, where it is needed: without ROS the other commands still work.
    from magnetosuture_thread.nodes.clients import CoilClient
    from magnetosuture_thread.nodes.processes import (
        NodeProcesses,
        environment_of,
        graph_environment,
        reserved_domain,
    )

    settings = read_setup(SETUP).coils
    with tempfile.TemporaryDirectory() as name, reserved_domain() as domain:
        folder = Path(name)
        ports = [str(folder / f"board_{index}") for index in range(2)]
        stage = PowerStage(ports, SUPPLY, RESISTANCE, INDUCTANCE)
        # No thread is predicted here, and nothing shall go slower for that; there is no needle that could follow.
        alone = {"without_prediction": "slow", "speed_without_prediction": settings.max_speed, "pose_uncertainty": 0.01}
        boards = {"roboclaw_ports": ports, "roboclaw_addresses": [board.address for board in stage.boards]}
        parameters = {"driver": "roboclaw", **boards, "coil_resistance": RESISTANCE, **alone}
        file = folder / "parameters.yaml"
        file.write_text(yaml.safe_dump({"/**/coil_bridge": {"ros__parameters": parameters}}), encoding="utf-8")
        arguments = ["--params-file", str(read_setup(SETUP).path), "--params-file", str(file)]
        environment = graph_environment(domain)
        stage.open()
        try:
            with (
                environment_of(environment),
                NodeProcesses((), arguments, environment, folder / "logs") as nodes,
                _load(busy),
            ):
                bound = settings.command_timeout + 1.0 / settings.rate
                bench = BridgeBench(stage, nodes, CoilClient, folder / "logs", bound)
                bench.start("coil_bridge")
                bench.start("tracker")
                log(f"{trials} times a commander that falls silent")
                delays = [bench.stop_trials(trials, progress)]
                log(delays[-1].words)
                with CoilClient() as client:
                    loop, scheduling = client.loop_timing()
                bench.start("commander")
                for victim in ("commander", "tracker", "coil_bridge"):
                    log(f"{kills} times kill -9 of the {victim}")
                    delays.append(bench.kills(victim, kills, progress))
                    log(delays[-1].words)
                log(f"{hostile} hostile messages")
                nodes.kill("commander")
                nodes.kill("tracker")
                greatest = bench.fuzz(hostile)
        finally:
            stage.close()
    limit = settings.max_current
    return BridgeReport(tuple(delays), loop, scheduling, settings.rate, hostile, greatest, limit, bench.unheard)


@contextmanager
def _load(busy: bool) -> Iterator[None]:
    """Keep every core busy, if asked to."""
    work = [sys.executable, "-c", "while True: pass"]
    hogs = [subprocess.Popen(work, start_new_session=True) for _ in range((os.cpu_count() or 1) * busy)]
    try:
        yield
    finally:
        for hog in hogs:
            hog.send_signal(signal.SIGKILL)
            hog.wait()
