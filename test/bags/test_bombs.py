"""Small files that ask for hours or gigabytes are refused or read in one line; large ones take little memory."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap import records as mcap_records
from mcap.data_stream import RecordBuilder
from mcap.writer import MCAP0_MAGIC as MAGIC
from mcap.writer import Writer

from magnetosuture_thread.bags.message_types import MessageDecoder
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.storage import Budget, MessageDefinition
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.settings.errors import BagError
from test.bags.bags import STRING, cdr, read, texts, write_mcap
from test.shared import run_python

PATH = "nav_msgs/msg/Path"


def encode_records(*records: mcap_records.McapRecord) -> bytes:
    """Return records as they are in a file."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return builder.end()


def nested(levels: int) -> str:
    """Return a definition of types in types, two of each in the next."""
    inner = (f"{'=' * 80}\nMSG: a/T{n}\nT{n - 1} x\nT{n - 1} y\n" for n in range(levels, 0, -1))
    return f"a/T{levels} x\n" + "".join(inner) + f"{'=' * 80}\nMSG: a/T0\n"


def chunk_of_zeros(path: Path, size: int) -> Path:
    """Write an mcap file with a chunk of zeros."""
    content = zstandard.ZstdCompressor(level=1).compress(bytes(size))
    chunk = mcap_records.Chunk("zstd", content, 1, 1, zlib.crc32(bytes(size)), size)
    end = (mcap_records.DataEnd(0), mcap_records.Footer(0, 0, 0))
    path.write_bytes(MAGIC + encode_records(mcap_records.Header("ros2", "bomb"), chunk, *end) + MAGIC)
    return path


def lone_records(path: Path, records: bytes) -> Path:
    """Write an mcap file with a message, after further records."""
    data = write_mcap(path, texts(1), {"/text": STRING}).read_bytes()
    first = struct.unpack_from("<Q", data, 9)[0] + 17  # where the header ends
    path.write_bytes(data[:first] + records + data[first:])
    return path


def one_large_definition(path: Path) -> Path:
    """Write an mcap file with a channel of half a million properties."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        schema = writer.register_schema(PATH, "ros2msg", b"")
        channel = writer.register_channel("/path", "cdr", schema, {f"{n:06x}": "" for n in range(500_000)})
        writer.add_message(channel, 1, cdr(STRING, "a"), 1)
        writer.finish()
    return path


BOMBS: dict[str, Callable[[Path], Path]] = {
    "one_large_definition": lambda p: one_large_definition(p / "a.mcap"),
    "lone_records": lambda p: lone_records(p / "a.mcap", struct.pack("<BQ", 0x80, 0) * 1_000_000),
    "chunk_of_zeros": lambda p: chunk_of_zeros(p / "a.mcap", 1 << 29),
}

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
    paths = [str(write_mcap(tmp_path / "sound.mcap", texts(5), {"/text": STRING}))]
    for name, make in BOMBS.items():
        (tmp_path / name).mkdir()
        paths.append(str(make(tmp_path / name)))
    lines = run_python("-c", CHECK, *paths, warns=True).splitlines()
    results = [line.split()[1:] for line in lines if line.startswith("RESULT")]
    assert len(results) == len(BOMBS)
    assert {code for code, _, _ in results} <= {"0", "1"}
    peaks = {name: int(peak) for name, (_, peak, _) in zip(BOMBS, results, strict=True)}
    assert max(peaks.values()) < MAX_MEGABYTES, peaks
    seconds = {name: float(spent) for name, (_, _, spent) in zip(BOMBS, results, strict=True)}
    assert max(seconds.values()) < MAX_SECONDS, seconds


IDL = "module nav_msgs { module msg { struct Path { %s }; }; };"


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (IDL % "string x[300000000];", "more than 4000 fields"),
        (nested(40), "types more than 32 deep"),
        (nested(30), "more than 4000 fields"),
        (IDL % "".join(f"long a{n};" for n in range(10_000)), "steps to parse"),
        ("int8 x\n" + "#" * 300_000, "300007 characters"),
        ("".join(f"int32 a{n}\n" for n in range(15_000)), "steps to parse"),
        ("a/E[] x\n" + "=" * 80 + "\nMSG: a/E\n", "a sequence of parts that hold nothing"),
    ],
)
def test_a_definition_past_its_budget_says_so_when_a_message_is_decoded(text: str, problem: str):
    encoding = "ros2idl" if text.startswith("module") else "ros2msg"
    decoder = MessageDecoder(MessageDefinition(PATH, encoding, text), Budget("bag", 0))
    assert not decoder.is_ours
    with pytest.raises(BagError, match=problem):
        decoder.decode("/path", b"\0\1\0\0")


def test_metadata_that_is_a_bomb_is_not_used_and_said(tmp_path: Path):
    write_mcap(tmp_path / "a.mcap", texts(5), {"/text": STRING})
    (tmp_path / "metadata.yaml").write_text("[" * 20_000)
    bag = Bag(tmp_path)
    assert read(bag) == texts(5)
    assert [remark.startswith("metadata.yaml is not used: ") for remark in bag.remarks] == [True]


LIMIT = 60.0  # MB above what a small bag takes

READER = """
import resource, sys
from pathlib import Path
from magnetosuture_thread.bags.reader import Bag
for folder in sys.argv[1:]:
    count = sum(1 for record in Bag(Path(folder)).records())
    print(count, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
"""


def write(folder: Path, size: int) -> Path:
    """Write a bag of so many bytes: the same frames again and again, which within a chunk are all different."""
    noise = np.random.default_rng(1)
    frames = [b"\0\1\0\0" + bytes(8) + (50_000).to_bytes(4, "little") + noise.bytes(50_000) for _ in range(40)]
    with BagWriter(folder) as bag:
        bag.add_topic("/noise", "std_msgs/msg/UInt8MultiArray")
        for index in range(size // 50_000):
            bag.write("/noise", 10**9 + index * 10**7, frames[index % len(frames)])
    return folder


def test_memory_is_flat(tmp_path: Path):
    folders = [write(tmp_path / name, size) for name, size in (("small", 500_000), ("large", 100_000_000))]
    said = run_python("-c", READER, *folders).split()
    assert said[2] == "2000"
    assert float(said[3]) < float(said[1]) + LIMIT
