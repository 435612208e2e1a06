"""Priority over other processes, for a node that may not wait for them."""

from __future__ import annotations

import os
from pathlib import Path

ORDINARY = "ordinary"


def raise_priority(priority: int, process: int | None = None) -> str:
    """Give all threads of a process a real-time priority, and say what came of it.

    Under the ordinary scheduling a process that wakes up waits for others that are busy, here by up to some
    milliseconds. Threads that begin later inherit the priority.

    Args:
        priority: of SCHED_FIFO, 1 to 99; with 0 all stays as it is.
        process: its number; this one if None.

    Returns:
        How the process is scheduled now, for a person.
    """
    if not priority:
        return ORDINARY
    try:
        for thread in Path(f"/proc/{process or 'self'}/task").iterdir():
            os.sched_setscheduler(int(thread.name), os.SCHED_FIFO, os.sched_param(priority))
    except ProcessLookupError:
        pass  # a thread that has just ended
    except OSError as error:
        return f"{ORDINARY}; real-time priority {priority} refused ({error.strerror}), see `ulimit -r`"
    return f"real time, priority {priority}"
