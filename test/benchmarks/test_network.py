"""The benchmark of two hosts: the cable between them, and what counts as passed."""

from __future__ import annotations

import os
import socket
import threading
from queue import Queue

from benchmarks.network.command import CutReport, network_table
from benchmarks.network.hosts import carry


def test_frames_pass_late_and_in_their_order_and_none_while_the_cable_is_pulled():
    pairs = [socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET) for _ in range(2)]
    hosts, ends = zip(*pairs, strict=True)
    for each in ends:
        each.setblocking(False)
    answers, carrier = Queue[str](), list[bool]()
    reading, writing = os.pipe()
    given = (ends[0].fileno(), ends[1].fileno()), reading, carrier.append, answers.put
    thread = threading.Thread(target=carry, args=given)
    thread.start()

    def execute(command: str) -> None:
        os.write(writing, f"{command}\n".encode())
        answers.get(timeout=10.0)

    hosts[0].settimeout(10.0)
    try:
        hosts[0].send(b"a" * 100)
        assert hosts[1].recv(2048) == b"a" * 100
        execute("pull")
        hosts[0].send(b"lost")
        execute("plug")
        hosts[0].send(b"next")
        assert hosts[1].recv(2048) == b"next"
        assert carrier == [False, True]
        execute("impair 0.2 0.0")
        for number in range(3):
            hosts[1].send(bytes([number]))
        assert [hosts[0].recv(10) for _ in range(3)] == [b"\0", b"\1", b"\2"]
    finally:
        os.close(writing)
        thread.join()
        os.close(reading)
        for each in (*hosts, *ends):
            each.close()


def test_a_cut_that_is_late_or_a_stop_that_is_not_kept_does_not_pass():
    good = CutReport(0.05, 0.05, zero=[0.1, 0.19], resumed=[0.5], stops=2, stops_kept=2)
    assert good.passed
    assert not CutReport(0.0, 0.0, zero=[0.3], resumed=[0.5], late=1).passed
    assert not CutReport(0.0, 0.0, zero=[0.1], resumed=[0.5], stops=2, stops_kept=1).passed
    assert good.to_json()["zero_maximum"] == 0.19
    assert network_table([good]).row_count == 1
