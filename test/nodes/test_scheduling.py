"""Priority over other processes."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator

import pytest

from magnetosuture_thread.nodes.run import raise_priority

PRIORITY = 3
SLEEPER = "import threading, sys; threading.Thread(target=sys.stdin.read).start(); print(flush=True)"


@pytest.fixture
def sleeper() -> Iterator[int]:
    """Return the number of a process of two threads."""
    with subprocess.Popen([sys.executable, "-c", SLEEPER], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        yield process.pid
        assert process.stdin is not None
        process.stdin.close()


def policies(process: int) -> set[tuple[int, int]]:
    """Return policy and priority of every thread."""
    threads = [int(name) for name in os.listdir(f"/proc/{process}/task")]
    return {(os.sched_getscheduler(thread), os.sched_getparam(thread).sched_priority) for thread in threads}


def test_every_thread_of_another_process_gets_the_priority_or_it_says_why_not(sleeper: int):
    own = policies(os.getpid())
    said = raise_priority(PRIORITY, sleeper)
    if said.startswith("ordinary; "):
        assert said == f"ordinary; real-time priority {PRIORITY} refused (Operation not permitted), see `ulimit -r`"
        assert policies(sleeper) == {(os.SCHED_OTHER, 0)}
    else:
        assert said == f"real time, priority {PRIORITY}"
        assert policies(sleeper) == {(os.SCHED_FIFO, PRIORITY)}
    assert policies(os.getpid()) == own


def test_a_process_that_has_ended_is_no_error():
    with subprocess.Popen([sys.executable, "-c", ""]) as process:
        process.wait()
    assert raise_priority(PRIORITY, process.pid).startswith("ordinary; real-time priority 3 refused (No such file")
