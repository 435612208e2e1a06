"""Recording ends badly: the disk is full, or the recorder is killed. What was recorded stays readable."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.settings.errors import BagError
from test.bags.bags import STRING, cdr, read
from test.shared import run_python

# Writes messages that cannot be packed until something stops it, and says how many.
RECORDER = """
import os, resource, signal, sys
from pathlib import Path
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.settings.errors import BagError
folder, limit = Path(sys.argv[1]), int(sys.argv[2])
bag = BagWriter(folder, {"setup": "example"})
bag.add_topic("/noise", "std_msgs/msg/UInt8MultiArray")
if limit:
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
count = 0
try:
    while True:
        data = bytes([0, 1, 0, 0]) + bytes(8) + (40_000).to_bytes(4, "little") + os.urandom(40_000)
        bag.write("/noise", 10**9 + count * 10**7, data)
        count += 1
        if count % 20 == 0 and not limit:
            print(count, flush=True)
except BagError as error:
    print(error)
    bag.close()
    try:
        bag.write("/noise", 0, b"")
    except BagError as again:
        print(again)
"""


@pytest.mark.parametrize("limit", [1_000_000, 1_234_567, 3_000_000])
def test_a_disk_that_takes_no_more(tmp_path: Path, limit: int):
    folder = tmp_path / "full"
    first, second = run_python("-c", RECORDER, folder, limit).splitlines()
    bag = Bag(folder)
    assert f"full: the disk takes no larger file after {bag.counts['/noise']} messages; what was recorded" in first
    assert first.endswith(str(folder / "full_0.mcap"))
    assert "is closed" in second
    assert bag.counts["/noise"] >= limit // 40_100 - 7
    assert bag.counts["/noise"] == len(read(bag))
    assert bag.damage is None or bag.damage.chunks == 0


def test_a_killed_recorder_leaves_what_it_had_flushed(tmp_path: Path):
    folder = tmp_path / "killed"
    with subprocess.Popen(
        [sys.executable, "-c", RECORDER, str(folder), "0"], stdout=subprocess.PIPE, text=True
    ) as recorder:
        assert recorder.stdout is not None
        said = 0
        while said < 200:
            said = int(recorder.stdout.readline())
        recorder.send_signal(signal.SIGKILL)
        recorder.wait()
    bag = Bag(folder)
    assert bag.damage is not None
    assert "truncated" in str(bag.damage)
    # A chunk holds seven or eight: one is filled, one is on its way to the disk.
    assert bag.counts["/noise"] >= said - 16
    assert [each for _, each, _ in read(bag)] == [10**9 + k * 10**7 for k in range(bag.counts["/noise"])]


def test_whatever_interrupts_a_recorder_what_it_wrote_is_whole(tmp_path: Path):
    """An alarm, as Ctrl-C would, at any place in the writer; the bag is closed as the `with` block ends."""

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        for trial in range(40):
            written = 0
            with contextlib.suppress(KeyboardInterrupt), BagWriter(tmp_path / str(trial)) as bag:
                bag.add_topic("/text", STRING)
                bag.write("/text", 0, cdr(STRING, "0"))
                signal.setitimer(signal.ITIMER_REAL, 0.002 + 0.0005 * trial)
                while True:
                    written += 1
                    bag.write("/text", written * 10**8, cdr(STRING, str(written) * 1000))
            found = Bag(tmp_path / str(trial))
            assert found.damage is None, trial
            assert found.counts["/text"] in (written, written + 1)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def test_the_bytes_of_a_bag_do_not_depend_on_when_its_worker_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    write_chunk = BagWriter._write_chunk
    for name in ("early", "late"):
        known = threading.Event()

        def when_known(self: BagWriter, *chunk: Any, known: threading.Event = known) -> None:
            known.wait()
            write_chunk(self, *chunk)

        monkeypatch.setattr(BagWriter, "_write_chunk", when_known)
        with BagWriter(tmp_path / name, name="bag") as bag:
            bag.add_topic("/first", STRING)
            bag.write("/first", 0, cdr(STRING, "0"))
            if name == "early":
                known.set()
                while bag._taken < bag._handed:
                    time.sleep(0.001)
            bag.add_topic("/second", STRING)
            known.set()
            bag.write("/second", 1, cdr(STRING, "1"))
    for file in ("bag_0.mcap", "metadata.yaml"):
        assert (tmp_path / "early" / file).read_bytes() == (tmp_path / "late" / file).read_bytes()


def test_a_bag_that_nobody_closes_lets_its_process_end(tmp_path: Path):
    program = "import sys; from magnetosuture_thread.bags.writer import BagWriter; from pathlib import Path; "
    program += "bag = BagWriter(Path(sys.argv[1])); bag.add_topic('/text', 'std_msgs/msg/String')"
    run_python("-c", program, tmp_path / "bag")


@pytest.mark.parametrize(("received", "published"), [(-1, 0), (1, -1), (1, 1 << 64)])
def test_a_message_of_a_time_that_cannot_be_is_refused_and_costs_no_other(
    tmp_path: Path, received: int, published: int
):
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/text", STRING)
        bag.write("/text", 0, cdr(STRING, "0"))
        with pytest.raises(BagError, match="a message of the time"):
            bag.write_to(1, received, cdr(STRING, "1"), publish_time=published)
        bag.write("/text", 2, cdr(STRING, "2"))
    found = Bag(tmp_path / "bag")
    assert found.damage is None
    assert [each for _, each, _ in read(found)] == [0, 2]
