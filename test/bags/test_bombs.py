"""Small files that ask for hours or gigabytes are refused or read in one line; large ones take little memory."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from magnetosuture_thread.bags.message_types import DecoderCache
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.storage import MessageDefinition
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.errors import BagError
from test.bags.bags import STRING, cdr, read, texts
from test.bags.bombs import ALIASES, BOMBS, metadata_bomb

MAX_MEGABYTES, MAX_SECONDS = 300, 5.0
# Processor time, which other work on the machine does not change. VmHWM, as the greatest memory by getrusage begins
# with that of the process that started this one.
CHECK = """
import sys
import time
from pathlib import Path
from magnetosuture_thread import cli
for index, path in enumerate(sys.argv[1:]):
    began = time.process_time()
    code = cli.main(["bag", "check", path])
    (peak,) = (line.split()[1] for line in Path("/proc/self/status").read_text().splitlines() if "VmHWM" in line)
    if index:
        print("RESULT", code, int(peak) // 1024, time.process_time() - began, flush=True)
"""


@pytest.mark.slow
def test_no_bomb_takes_more_than_it_may(tmp_path: Path):
    """The first bag is a sound one: what is imported for it is not the others' time."""
    paths = [str(metadata_bomb(tmp_path / "sound", ""))]
    for name, make in BOMBS.items():
        (tmp_path / name).mkdir()
        paths.append(str(make(tmp_path / name)))
    done = subprocess.run([sys.executable, "-c", CHECK, *paths], capture_output=True, text=True, timeout=900)
    assert "Traceback" not in done.stderr
    results = [line.split()[1:] for line in done.stdout.splitlines() if line.startswith("RESULT")]
    assert len(results) == len(BOMBS), done.stderr
    assert {code for code, _, _ in results} <= {"0", "1"}
    peaks = {name: int(peak) for name, (_, peak, _) in zip(BOMBS, results, strict=True)}
    assert max(peaks.values()) < MAX_MEGABYTES, peaks
    seconds = {name: float(spent) for name, (_, _, spent) in zip(BOMBS, results, strict=True)}
    assert max(seconds.values()) < MAX_SECONDS, seconds


@pytest.mark.parametrize(
    ("text", "encoding", "problem"),
    [
        ("geometry_msgs/Point[300000000] x\n", "ros2msg", "more than 10000 fields"),
        ("int8 x\n" + "#" * 300_000, "ros2msg", "300007 characters"),
        ("".join(f"int32 a{n}\n" for n in range(20_000)), "ros2msg", "steps to parse|characters"),
    ],
)
def test_a_definition_past_its_budget_says_so_when_a_message_is_decoded(text: str, encoding: str, problem: str):
    decoder = DecoderCache().decoder_of(MessageDefinition("nav_msgs/msg/Path", encoding, text))
    assert not decoder.is_ours
    with pytest.raises(BagError, match=problem):
        decoder.decode("/path", b"\0\1\0\0")


def test_metadata_past_its_budget_is_not_used_and_said(tmp_path: Path):
    bag = Bag(metadata_bomb(tmp_path / "bag", ALIASES))
    assert read(bag) == texts(5)
    assert bag.remarks == ["metadata.yaml is not used: has an anchor or alias (& or *) in line 3"]


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


def test_memory_is_flat(tmp_path: Path):
    _, small = peak(write(tmp_path / "small", 500_000))
    count, taken = peak(write(tmp_path / "large", 100_000_000))
    assert count == 4000
    assert taken < small + LIMIT
