"""Reading takes the same memory for a small bag and for a large one."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.writer import BagWriter
from test.bags.bags import STRING, cdr

LIMIT = 60.0  # MB above what a small bag takes

READER = """
import resource, sys
from pathlib import Path
from magnetosuture_thread.bags.reader import Bag
count = sum(1 for record in Bag(Path(sys.argv[1])).records())
print(count, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
"""


def write(folder: Path, size: int) -> Path:
    """Write a bag of so many bytes: the same frames again and again, which within a chunk are all different."""
    noise = np.random.default_rng(1)
    frames = [b"\0\1\0\0" + bytes(8) + (50_000).to_bytes(4, "little") + noise.bytes(50_000) for _ in range(40)]
    with BagWriter(folder) as bag:
        bag.add_topic("/noise", "std_msgs/msg/UInt8MultiArray")
        bag.add_topic("/text", STRING)
        for index in range(size // 50_000):
            bag.write("/noise", 10**9 + index * 10**7, frames[index % len(frames)])
            bag.write("/text", 10**9 + index * 10**7 + 1, cdr(STRING, str(index)))
    return folder


def peak(folder: Path) -> tuple[int, float]:
    """Return number of messages and the greatest memory taken [MB] when a process of its own reads a bag."""
    command = [sys.executable, "-c", READER, str(folder)]
    said = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stdout.split()
    return int(said[0]), float(said[1])


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("large") / "large", 150_000_000)


def test_memory_is_flat(tmp_path: Path, large: Path):
    _, small = peak(write(tmp_path / "small", 500_000))
    count, taken = peak(large)
    assert count == 6000
    assert taken < small + LIMIT


def test_chunks_outside_of_the_window_are_not_even_read(large: Path, monkeypatch):
    """All other chunks may be broken by then."""
    bag = Bag(large)
    file = large / "large_0.mcap"
    with file.open("r+b") as stream:
        for place in (2_000_000, 140_000_000):
            stream.seek(place)
            stream.write(bytes(1000))
    records = list(bag.records({"/text"}, start=15.0, duration=0.1))
    assert [record.decode().data for record in records] == [str(index) for index in range(1500, 1510)]
