"""The driver against simulated boards, through the maker's library and a pseudo-terminal."""

from __future__ import annotations

import math
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.coils.calibration import CoilCalibration
from magnetosuture_thread.coils.drivers.roboclaw import Board, RoboClawDriver
from magnetosuture_thread.coils.field import coils_around
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.rig import power as packets
from magnetosuture_thread.rig.power import RoboClawBoard
from magnetosuture_thread.settings.errors import DriverError

CURRENTS = (3.0, -6.0, 1.5, 0.0)
DUTIES = [(4095, -8191), (2047, 0)]
PATIENT = {"roboclaw_answer_timeout": 0.5}  # no loss that is only the busy machine's

ANOTHER = """
import sys, time
import numpy as np
from magnetosuture_thread.coils.drivers.roboclaw import RoboClawDriver
from magnetosuture_thread.coils.settings import CoilBridgeSettings

boards = {"roboclaw_ports": sys.argv[1:], "roboclaw_addresses": (128, 129)}
driver = RoboClawDriver(CoilBridgeSettings(**boards, driver_timeout=0.3))
driver.open()
while True:
    driver.apply(np.array([3.0, -6.0, 1.5, 0.0]), time.monotonic())
    time.sleep(0.005)
"""


def test_coils_stay_at_zero_until_currents_are_asked_for(bench):
    driver = bench.open()
    state = driver.state()
    assert (state.problem, state.warnings, state.voltages) == ("", (), (24.0, 24.0))
    for number in (0, 1):
        bench.heard(number)
        assert not bench.boards[number].timeline


def test_currents_get_to_the_coils_as_duties(bench):
    driver = bench.open()
    with bench.held(driver, *CURRENTS):
        bench.wait(lambda: [bench.duties(0), bench.duties(1)] == DUTIES, "the duties")

        def measured() -> bool:
            currents = driver.state().currents
            return currents is not None and np.allclose(currents, CURRENTS, atol=0.02)

        bench.wait(measured, "the currents")
    np.testing.assert_allclose(bench.boards[0].currents, CURRENTS[:2], atol=0.1)


def test_each_coil_is_driven_by_its_own_resistance(bench):
    coils = coils_around((0.0, 1.5, 3.0, 4.5), 0.05, 0.025, 1.2e-3)
    resistances = (0.5, 2.0, 0.0, 1.5)  # that of the third is not known
    measured = tuple(replace(coil, resistance=ohms) for coil, ohms in zip(coils, resistances, strict=True))
    file = bench.folder / "rig.yaml"
    file.write_text(CoilCalibration("rig", "", "", measured).to_yaml(), encoding="utf-8")
    driver = bench.open(calibration=str(file), coil_resistance=1.25)
    with bench.held(driver, 3.0, -6.0, 1.5, 2.0):
        expected = [(2047, -16383), (2559, 4095)]
        bench.wait(lambda: [bench.duties(0), bench.duties(1)] == expected, "the duties")


def test_without_being_asked_again_it_goes_to_zero_by_itself(bench):
    driver = bench.open(command_timeout=0.1, driver_timeout=1.0)
    bench.wait(lambda: driver.apply(np.array(CURRENTS), time.monotonic()) or bench.duties(0) == DUTIES[0], "the duties")
    bench.wait(lambda: bench.duties(0) == bench.duties(1) == (0, 0), "zero")
    (zero_at, _) = bench.boards[0].timeline[-1]
    assert zero_at < bench.boards[0].heard + 1.0  # it was told, and has not stopped by its own timeout
    assert any("coils at zero" in warning for warning in driver.state().warnings)
    assert driver.state().ready
    with bench.held(driver, *CURRENTS):
        bench.wait(lambda: bench.duties(0) == DUTIES[0], "the duties again")
        assert driver.state().warnings == ()


def test_boards_stop_by_themselves_where_the_process_is_killed(bench):
    bench.stage.open()
    process = subprocess.Popen([sys.executable, "-c", ANOTHER, *bench.settings().roboclaw_ports])
    try:
        bench.wait(lambda: [bench.duties(0), bench.duties(1)] == DUTIES, "the duties", 30.0)
        killed_at = time.monotonic()
        process.send_signal(signal.SIGKILL)
        process.wait()
        bench.wait(lambda: bench.duties(0) == bench.duties(1) == (0, 0), "zero")
    finally:
        process.kill()
        process.wait()
    for board in bench.boards:
        zero_at, duties = board.timeline[-1]
        assert duties == (0, 0)
        assert zero_at == pytest.approx(board.heard + 0.3)
        assert zero_at > killed_at


FAULTS: dict[str, Callable[[bytes], bytes]] = {
    "silent": lambda answer: b"",
    "garbage": lambda answer: b"abcdefgh"[: len(answer) + 3],
    "wrong checksum": lambda answer: answer[:-1] + bytes((answer[-1] ^ 1,)),
    "lost bytes": lambda answer: answer[1:],
}


def break_line(board: RoboClawBoard, kind: str) -> None:
    """Let a board hear nothing, or its answers be changed on the way, until its `receive` is deleted again."""

    def receive(data: bytes, now: float) -> bytes:
        answer = b"" if kind == "deaf" else RoboClawBoard.receive(board, data, now)
        return FAULTS[kind](answer) if answer else b""

    vars(board)["receive"] = receive


@pytest.mark.parametrize("kind", ["deaf", *FAULTS])
def test_where_one_line_fails_all_coils_are_at_zero_until_it_is_back(bench, kind: str):
    driver = bench.open()
    with bench.held(driver, *CURRENTS):
        bench.wait(lambda: bench.duties(1) == DUTIES[1], "the duties")
        break_line(bench.boards[0], kind)
        bench.wait(lambda: not driver.state().ready, "the loss")
        assert "board 0" in driver.state().problem
        assert driver.state().losses >= 1
        bench.wait(lambda: bench.duties(0) == bench.duties(1) == (0, 0), "zero")
        bench.heard(1, 10)  # the other one is still written to
        assert bench.duties(1) == (0, 0)
        assert not driver.state().ready
        del vars(bench.boards[0])["receive"]
        bench.wait(lambda: [bench.duties(0), bench.duties(1)] == DUTIES, "the duties again")


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_thread_that_dies_is_a_loss_for_good(bench, monkeypatch: pytest.MonkeyPatch):
    driver = bench.open(**PATIENT)
    losses = driver.state().losses

    def die(board: Board) -> None:
        raise SystemExit  # all others are caught

    monkeypatch.setattr(Board, "poll", die)
    bench.wait(lambda: not any(line.is_alive() for line in driver._lines), "the threads to die")
    state = driver.state()
    assert not state.ready
    assert state.problem.count("its thread has ended") == 2
    assert state.losses == losses + 1


def test_a_port_that_goes_and_comes_back_begins_at_zero(bench):
    driver = bench.open()
    with bench.held(driver, *CURRENTS):
        bench.wait(lambda: bench.duties(0) == DUTIES[0], "the duties")
        bench.stage.lines[0].unplug()
        bench.wait(lambda: bench.duties(0) == bench.duties(1) == (0, 0), "zero")
        losses = driver.state().losses
        assert losses >= 1
        bench.wait(lambda: "there is no" in driver.state().problem, "the port to be missed")
    bench.boards[0].timeline.clear()
    bench.boards[1].timeline.clear()
    bench.stage.lines[0].plug()
    bench.wait(lambda: driver.state().ready, "the driver to be back")
    bench.heard(0)
    bench.heard(1)
    assert not bench.boards[0].timeline  # nothing that was asked for before, or meanwhile
    assert not bench.boards[1].timeline
    with bench.held(driver, *CURRENTS):
        bench.wait(lambda: [bench.duties(0), bench.duties(1)] == DUTIES, "the duties again")


@pytest.mark.parametrize(
    ("bits", "words"),
    [(0x0001, "Emergency Stop"), (0x0040, "Motor 1 Driver Fault"), (0x1002, "Temperature Sensor 1 Error, Motor 1 C")],
)
def test_errors_of_a_board_are_losses_in_the_makers_words(bench, bits: int, words: str):
    driver = bench.open()
    with bench.held(driver, *CURRENTS):
        bench.wait(lambda: bench.duties(1) == DUTIES[1], "the duties")
        bench.boards[0].errors = bits
        bench.wait(lambda: words in driver.state().problem, "the error")
        bench.wait(lambda: bench.duties(1) == (0, 0), "zero")
        bench.boards[0].errors = 0
        bench.wait(lambda: bench.duties(0) == DUTIES[0], "the duties again")


def test_too_much_current_is_a_loss(bench):
    driver = bench.open()
    bench.boards[0].mismeasured = 11.9
    bench.heard(0, 30)
    bench.wait(lambda: driver.state().ready, "the driver to be ready")
    bench.boards[0].mismeasured = 12.5
    bench.wait(lambda: "a current of 12.50 A, more than 10 A" in driver.state().problem, "the excess")
    losses = driver.state().losses
    bench.heard(0, 5)  # it is tried again
    assert driver.state().losses == losses  # but not ready while it lasts
    bench.boards[0].mismeasured = 0.0
    bench.wait(lambda: driver.state().ready, "the driver to be back")


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (packets.Command.SET_TIMEOUT, "serial timeout in tenths of a second 0 instead of 2"),
        (packets.Command.SET_LIMIT_1, "current limit in 10 mA 3000 instead of 1000"),
    ],
)
def test_a_board_that_does_not_take_its_limits_is_never_ready(bench, command: int, words: str):
    bench.boards[0].ignored.add(command)
    driver = bench.open(ready=False)
    bench.wait(lambda: words in driver.state().problem, "the problem")
    bench.heard(0, 3)  # it is tried again
    assert not driver.state().ready
    assert driver.state().losses == 0
    assert bench.boards[1].timeout == 2


def test_a_board_that_acknowledges_duties_and_does_not_take_them_is_found(bench):
    driver = bench.open()
    bench.boards[0].ignored.add(packets.Command.SET_DUTIES)
    with bench.held(driver, *CURRENTS):
        bench.wait(lambda: "has duties (0, 0) instead of (4095, -8191)" in driver.state().problem, "the problem")
        bench.wait(lambda: bench.duties(1) == (0, 0), "zero")


def test_a_port_belongs_to_one_writer(bench):
    first = bench.open()
    with bench.held(first, *CURRENTS):
        second = bench.open(ready=False)
        bench.wait(lambda: "held by another process" in second.state().problem, "the refusal")
        bench.wait(lambda: bench.duties(0) == DUTIES[0], "the duties")
    first.close()
    bench.wait(lambda: second.state().ready, "the other one to be ready")


def tapped(board: RoboClawBoard, then: Callable[[bytes], bytes]) -> list[tuple[int, ...]]:
    """Return what a simulated board is told of duties; the first that are not zero are answered by `then`."""
    heard: list[tuple[int, ...]] = []
    receive = board.receive

    def hear(data: bytes, now: float) -> bytes:
        answer = receive(data, now)
        if data[:2] != bytes((board.address, packets.Command.SET_DUTIES)):
            return answer
        driven = any(any(pair) for pair in heard)
        heard.append(struct.unpack(">hh", data[2:6]))
        return then(answer) if any(heard[-1]) and not driven else answer

    vars(board)["receive"] = hear
    return heard


@pytest.mark.parametrize("shared", [False, True])
def test_a_stop_wins_over_what_was_asked_before_it(bench, shared: bool):
    if shared:
        bench.share()
    driver = bench.open(apply_timeout=60.0, **PATIENT)

    def stop(answer: bytes) -> bytes:
        driver.apply(np.zeros(4), time.monotonic())
        return answer if shared else b""  # lost: there is a second attempt

    told = tapped(bench.boards[0], stop)
    others = tapped(bench.boards[1], bytes)
    driver.apply(np.array(CURRENTS), time.monotonic())
    bench.wait(lambda: DUTIES[0] in told and told[-1] == (0, 0), "the duties, and zero")
    bench.heard(0)
    bench.heard(1)
    assert [duties for duties in told if any(duties)] == [DUTIES[0]]
    if shared:
        assert not any(any(duties) for duties in others)
    assert driver.state().losses == 0


def test_closing_leaves_zero_and_the_port_free(bench):
    driver = bench.open(driver_timeout=1.0)
    with bench.held(driver, *CURRENTS):
        bench.wait(lambda: [bench.duties(0), bench.duties(1)] == DUTIES, "the duties")
    driver.close()
    for board in bench.boards:
        zero_at, duties = board.timeline[-1]
        assert duties == (0, 0)
        assert zero_at <= board.heard  # it was told, maybe twice; its own timeout would come after the last word
    assert not driver.state().ready
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("roboclaw")]
    driver.close()
    driver.open()
    bench.wait(lambda: driver.state().ready, "the driver to be ready again")


def test_nothing_waits_for_a_board(bench):
    driver = bench.open()
    for board in bench.boards:
        break_line(board, "deaf")
    longest = 0.0
    for _ in range(200):
        began = time.perf_counter()
        driver.apply(np.array(CURRENTS), time.monotonic())
        driver.state()
        longest = max(longest, time.perf_counter() - began)
        time.sleep(0.001)
    assert not driver.state().ready
    assert longest < 1.0  # of 200 calls, each of which would have waited


def test_what_is_no_current_is_refused(bench):
    driver = bench.open()
    for currents in (np.zeros(3), np.array([math.nan, 0.0, 0.0, 0.0]), np.full(4, math.inf)):
        with pytest.raises(ValueError, match="4 finite currents"):
            driver.apply(currents, time.monotonic())
    assert driver.state().ready


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, "roboclaw_ports is empty"),
        ({"roboclaw_ports": ("/dev/a",)}, "has 1, expected one for two of the 4 coils"),
        (
            {"roboclaw_ports": ("/dev/a", "/dev/b"), "roboclaw_addresses": (128,)},
            "has 1, expected one for each of the 2",
        ),
        ({"roboclaw_ports": ("/dev/a", "/dev/a")}, "two boards on /dev/a have address 128"),
        ({"roboclaw_ports": ("/dev/ttyACM0", "/dev/ttyACM1")}, "ttyACM0 and another port have boards of address 128"),
        ({"roboclaw_ports": ("/dev/null", "/dev/zero")}, "expected different addresses, or a path of each"),
        ({"roboclaw_ports": ("/dev/a", "/dev/b"), "driver_timeout": 0.25}, "0.25, expected tenths of a second"),
        ({"roboclaw_ports": ("/dev/a", "/dev/b"), "roboclaw_baud_rate": 9600}, "9600, expected at least 38400"),
    ],
)
def test_settings_that_can_never_work_are_refused(changes: dict[str, Any], words: str):
    with pytest.raises(DriverError, match=words):
        RoboClawDriver(CoilBridgeSettings(**changes))


def failures(driver: RoboClawDriver) -> list[int]:
    """Return a list that gets the number of the line with each of its failures from now on."""
    mailbox, found = driver._mailbox, list[int]()
    assert mailbox is not None
    real = mailbox.set_failed

    def fail(line: int, problem: str) -> None:
        found.append(line)
        real(line, problem)

    vars(mailbox)["set_failed"] = fail
    return found


def test_boards_that_are_exchanged_when_they_are_plugged_again_are_never_ready(bench):
    driver = bench.open()
    first, second = bench.stage.lines
    with bench.held(driver, *CURRENTS):
        bench.wait(lambda: bench.duties(0) == DUTIES[0], "the duties")
        first.unplug()
        second.unplug()
        first.path, second.path = second.path, first.path
        for board in bench.boards:
            board.power_cycle()
            board.timeline.clear()
        heard = [board.heard for board in bench.boards]
        first.plug()
        second.plug()
        tried = failures(driver)
        bench.wait(lambda: min(tried.count(0), tried.count(1)) >= 3, "three attempts at each")
        problem = driver.state().problem
        assert f"board 0 ({second.path}, address 128): no valid answer" in problem
        assert "ports are exchanged" in problem
        assert not driver.state().ready
    assert [board.heard for board in bench.boards] == heard
    assert not any(board.timeline for board in bench.boards)


@pytest.mark.parametrize("stable", [True, False])
def test_boards_that_answer_to_any_address_need_paths_that_stay(bench, stable: bool):
    """As all do over USB, where the board's address is not looked at."""

    def usb(board: RoboClawBoard) -> Callable[[bytes, float], bytes]:
        def receive(data: bytes, now: float) -> bytes:
            board.address = data[0]
            return RoboClawBoard.receive(board, data, now)

        return receive

    for board in bench.boards:
        vars(board)["receive"] = usb(board)
    bench.stage.open()
    ports = [str(line.path if stable else line.path.resolve()) for line in bench.stage.lines]
    driver = bench.open(ready=stable, roboclaw_ports=ports, **PATIENT)
    if not stable:
        bench.wait(lambda: "address 128): answers to address 129 too" in driver.state().problem, "the refusal")
        tried = failures(driver)
        bench.wait(lambda: min(tried.count(0), tried.count(1)) >= 3, "three attempts at each")
        assert not driver.state().ready


def test_a_supply_that_breaks_down_is_a_loss(bench):
    driver = bench.open()
    bench.boards[0].supply = 3.0
    bench.wait(lambda: "a supply of 3 V" in driver.state().problem, "the problem")
