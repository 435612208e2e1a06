"""Damages bags at random, and checks what reading and repairing make of them."""

from __future__ import annotations

import multiprocessing
import random
import resource
import shutil
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagWriter

from magnetosuture_thread.bags.message_types import typestore
from magnetosuture_thread.bags.packing import pack, packed_path, packed_pose
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.storage import METADATA_FILE
from magnetosuture_thread.bags.writer import BagWriter, write_repaired_bag
from magnetosuture_thread.settings.errors import MagnetosutureError

MAX_SECONDS, MAX_MEGABYTES = 5.0, 300.0
GRACE = 10.0  # s after `MAX_SECONDS`, after which a reader is ended
KINDS = ("flip", "zeros", "noise", "cut", "remove", "repeat", "swap")
OUTCOMES = ("whole", "damage_noticed", "refused", "altered_and_unchecked", "ended")
PROMISES = ("altered_as_sound", "silently_lost", "tracebacks", "too_slow", "too_large")
TYPES = {
    "/thread/measured": "nav_msgs/msg/Path",
    "/needle/measured_cp": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/note": "std_msgs/msg/String",
}

Message = tuple[str, int, bytes]


def attack_bags(count: int, seed: int, progress: Callable[[float], None]) -> tuple[dict[str, Any], list[str]]:
    """Damage bags of both formats in turn, and judge what becomes of each.

    Args:
        count: of damaged bags.
        seed: of the damage.
        progress: called with the share done, 0 to 1.

    Returns:
        Figures by format, with what was broken, and lines for a person.
    """
    totals: dict[str, Counter[str]] = {"mcap": Counter(), "sqlite3": Counter()}
    worst, broken, original = dict.fromkeys(totals, (0.0, 0.0)), list[str](), Counter(original_messages())
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for name in totals:
            _write_bag(folder / name, name)
        for index in range(count):
            name, target = list(totals)[index % len(totals)], folder / "damaged"
            kinds = _damaged_copy(folder / name, target, random.Random(f"{seed} {index}"))
            outcome, seconds, megabytes = check_bag(target, original)
            outcome["too_slow"] += seconds > MAX_SECONDS
            outcome["too_large"] += megabytes > MAX_MEGABYTES
            totals[name] += outcome
            worst[name] = max(worst[name][0], seconds), max(worst[name][1], megabytes)
            broken += [f"{name}, attack {index} ({kinds}): {promise}" for promise in PROMISES if outcome[promise]]
            progress((index + 1) / count)
    figures, lines = dict[str, Any](), list[str]()
    for name, total in totals.items():
        counts, (seconds, megabytes) = {key: total[key] for key in (*OUTCOMES, *PROMISES)}, worst[name]
        bags = sum(total[key] for key in OUTCOMES)
        figures[name] = {**counts, "bags": bags, "max_s": seconds, "max_mb": megabytes}
        shown = ", ".join(f"{number} {key.replace('_', ' ')}" for key, number in counts.items())
        lines.append(f"{name}: {bags} bags: {shown}; at most {seconds:.1f} s and {megabytes:.0f} MB")
    return {**figures, "broken": broken}, lines


def original_messages() -> list[Message]:
    """Return the messages of a bag: a needle that moves, its thread, and texts."""
    result: list[Message] = []
    for index in range(500):
        at = 10**9 + index * 33_000_000  # ns
        along = np.linspace(0.0, 0.015, 12)
        points = np.stack([along, 0.002 * np.sin(300.0 * along + 0.05 * index)], axis=1)
        pose, note = packed_pose(at, points[0], np.array([1.0, 0.0])), pack("text", f"note {index}")
        messages = zip(TYPES, (packed_path(at, points), pose, note), strict=True)
        result += [(topic, at, data) for topic, data in messages]
    return result


def _write_bag(folder: Path, storage: str) -> None:
    if storage == "mcap":
        with BagWriter(folder, {"simulated": "all of it"}) as bag:
            for topic, kind in TYPES.items():
                bag.add_topic(topic, kind)
            for message in original_messages():
                bag.write(*message)
        return
    with RosbagWriter(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as rosbag:
        topics = {topic: rosbag.add_connection(topic, kind, typestore=typestore()) for topic, kind in TYPES.items()}
        for topic, at, data in original_messages():
            rosbag.write(topics[topic], at, data)


def _damaged_copy(bag: Path, target: Path, chance: random.Random) -> str:
    """Write a damaged copy of a bag; now and then without its metadata.yaml. Return the kinds of damage."""
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(bag, target)
    (file,) = (path for path in target.iterdir() if path.name != METADATA_FILE)
    data = bytearray(file.read_bytes())
    kinds = [chance.choice(KINDS) for _ in range(chance.choice((1, 1, 1, 2, 4)))]
    for kind in kinds:
        data = _damaged(data, kind, chance)
    file.write_bytes(data)
    if chance.random() < 0.3:
        (target / METADATA_FILE).unlink()
    return " and ".join(kinds)


def _damaged(data: bytearray, kind: str, chance: random.Random) -> bytearray:
    size = len(data)
    if not size:
        return data
    # Half of all damage is near the head or the end, where the structure of a file is.
    places = (chance.randrange(size), chance.randrange(4096), size - 1 - chance.randrange(4096))
    at = max(0, min(size - 1, chance.choice(places)))
    length = min(size - at, int(2 ** chance.uniform(0.0, 14.0)))
    other = chance.randrange(size)
    if kind == "flip":
        for _ in range(chance.choice((1, 1, 2, 8))):
            data[chance.choice((at, chance.randrange(size)))] ^= 1 << chance.randrange(8)
    elif kind == "zeros":
        data[at : at + length] = bytes(length)
    elif kind == "noise":
        data[at : at + length] = chance.randbytes(length)
    elif kind == "cut":
        del data[at:]
    elif kind == "remove":
        del data[at : at + length]
    elif kind == "repeat":
        data[other:other] = data[at : at + length]
    else:
        part = data[other : other + length]
        data[at : at + len(part)], data[other : other + len(part)] = part, data[at : at + len(part)]
    return data


def check_bag(bag: Path, original: Counter[Message]) -> tuple[Counter[str], float, float]:
    """Return what became of a bag, in a process of its own; and its time [s] and greatest memory [MB]."""
    forked, began = multiprocessing.get_context("fork"), time.monotonic()
    receiver, sender = forked.Pipe(duplex=False)
    child = forked.Process(target=_check_and_send, args=(sender, bag, original))
    child.start()
    sender.close()
    outcome, megabytes = {"ended": 1}, 0.0
    try:
        if receiver.poll(MAX_SECONDS + GRACE):
            outcome, megabytes = receiver.recv()
    except EOFError:  # it has printed why
        outcome["tracebacks"] = 1
    child.kill()
    child.join()
    return Counter(outcome), time.monotonic() - began, megabytes


def _check_and_send(sender: Connection, bag: Path, original: Counter[Message]) -> None:
    sender.send((_check(bag, original), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0))


def _check(bag: Path, original: Counter[Message]) -> dict[str, int]:
    """Return what reading and repairing make of a bag."""
    refused: Counter[str] = Counter()
    try:
        opened = Bag(bag)
        read = _messages(opened, refused)
    except MagnetosutureError:
        return {"refused": 1}
    altered, missing = (read - original).total(), (original - read).total()
    is_noticed = opened.damage is not None or bool(refused)
    is_doubted = is_noticed or bool(opened.has_no_checksum)
    outcome = {"damage_noticed" if is_noticed else "altered_and_unchecked" if altered or missing else "whole": 1}
    # Of a message that was altered unnoticed the original is missing, and the altered one is there in its place.
    outcome["silently_lost"] = int(missing > altered and not is_noticed)
    outcome["altered_as_sound"] = int(altered > 0 and (not is_doubted or is_noticed))
    output = bag.with_name("repaired")
    shutil.rmtree(output, ignore_errors=True)
    with suppress(MagnetosutureError):
        write_repaired_bag(opened, output, "repaired")
        new = Bag(output)
        is_marked = bool(new.has_no_checksum) and not is_noticed
        outcome["altered_as_sound"] += (_messages(new, Counter()) - original).total() > 0 and not is_marked
    return outcome


def _messages(bag: Bag, refused: Counter[str]) -> Counter[Message]:
    return Counter((record.topic, record.time, record.data) for _, record in bag.every_record(refused))
