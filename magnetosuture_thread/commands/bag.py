"""The command `magnetosuture bag`."""

from __future__ import annotations

import argparse
from pathlib import Path
from textwrap import shorten
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from magnetosuture_thread.bags.check import inspect_bag, write_repaired_bag
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.storage import pluralize
from magnetosuture_thread.commands.command import (
    DONE,
    FAILED,
    Terminal,
    add_actions,
    add_remap,
    output_file,
    write_json,
)
from magnetosuture_thread.commands.output import whole_folder
from magnetosuture_thread.texts import one_line

MAX_NOTE_CHARS = 200  # of a note that are shown; one may hold a whole setup
MAX_PLACES = 100  # of damage that are shown; `--json` writes all

DESCRIPTION = """\
Check a recorded bag, or repair it.

BAG is an mcap or sqlite3 file of any recorder, or the folder of a bag.
"""


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    check, repair = add_actions(parser, DESCRIPTION, "what to do", "ACTION", check=run_check, repair=run_repair)
    for action in (check, repair):
        action.add_argument("bag", type=Path, metavar="BAG", help="a bag's file or folder")
        add_remap(action)
    check.add_argument("--frame", default="dish", metavar="NAME", help="the bag's name of the dish frame")
    check.add_argument("--json", type=output_file, metavar="FILE", help="write what was found to a file")
    repair.add_argument("--output", type=Path, required=True, metavar="BAG", help="folder of the bag to make")


def run_check(options: argparse.Namespace, terminal: Terminal) -> int:
    """Report what a bag holds, and whether it is intact.

    The whole bag is read: every checksum, and every message's time and stamp. For each topic: its type, how
    many messages, their mean rate, when the first and the last came, the greatest gap, and how often a stamp
    went back; the types follow. What is damaged is reported, with what is lost; all else is shown as it can be read.
    """
    with terminal.progress("bag check") as advance:
        bag = Bag(options.bag, remap=dict(options.remap), progress=lambda share: advance(0.5 * share))
        found = inspect_bag(bag, options.frame, lambda share: advance(0.5 + 0.5 * share))
    terminal.print(_table(found))
    for line in _lines(found):
        terminal.log(line)
    write_json(options.json, found)
    return FAILED if found["damage"] or found["refused"] or found["unverified"] else DONE


def run_repair(options: argparse.Namespace, terminal: Terminal) -> int:
    """Write every intact message of a bag into a new one.

    Messages, their times and numbers, definitions, attachments, metadata records and notes stay as they are; chunks,
    indices and metadata.yaml are made anew. The command reports how many messages there are and what is lost or
    changed, where and when.

    A damaged bag without checksums (sqlite3) is refused: nothing tells its altered messages from the others.
    """
    log = terminal.log
    with terminal.progress("bag repair") as advance:
        bag = Bag(options.bag, remap=dict(options.remap), progress=lambda share: advance(0.5 * share))
        with whole_folder(options.output) as folder:
            name = options.output.name
            report = write_repaired_bag(bag, folder, name, lambda share: advance(0.5 + 0.5 * share))
    if bag.damage is not None:
        log(str(bag.damage))
    for line in (f"unverified: {bag.unverified}" if bag.unverified else bag.unchecked, *bag.remarks):
        log(line) if line else None
    if report.is_same and not (bag.damage or bag.unverified or bag.unchecked or bag.remarks):
        log("is not damaged: the new bag holds the same messages, definitions, attachments, metadata records and notes")
    for reason, lost in report.refused.items():
        log(f"{reason}: {pluralize(lost, 'message')} lost")
    for reason, lost in report.dropped.items():
        log(f"not kept: {lost} of this: {reason}")
    if report.unpacked:
        log(f"{pluralize(report.unpacked, 'message')} packed by the recorder, and unpacked in the new bag")
    if report.defined:
        log(f"without a definition, now with ours: {', '.join(sorted(set(report.defined)))}")
    if report.rewritten:
        topics = ", ".join(one_line(topic) for topic in sorted(set(report.rewritten)))
        log(f"quality of service written by name, as Jazzy reads it: {topics}")
    places = bag.damage.regions if bag.damage is not None else ()
    for place in places[:MAX_PLACES]:
        log(f"  {place}{_times(place.first, place.last, bag.start)}")
    for line in _others(len(places)):
        log(line)
    log(f"{report.messages} messages in {options.output}")
    return DONE


def _times(first: int | None, last: int | None, start: int) -> str:
    """Return between which times messages are missing, if any are."""
    if first is None and last is None:
        return ""
    begin = "the beginning" if first is None else f"{(first - start) * 1e-9:.3f} s"
    end = "the end" if last is None else f"{(last - start) * 1e-9:.3f} s"
    return f"; messages between {begin} and {end}"


def _table(found: dict[str, Any]) -> Table:
    """Return a row for each topic."""
    table = Table(title=f"{found['messages']} messages in {found['duration_s']:.3f} s", box=SIMPLE_HEAD, padding=0)
    table.caption = "times in s since the first message; * is taken by our graph"
    for name in ("topic", "messages", "Hz", "first", "last", "gap", "back"):
        is_topic = name == "topic"
        table.add_column(name, justify="left" if is_topic else "right", overflow="fold", no_wrap=not is_topic)
    for topic in found["topics"]:
        times = (topic[key] for key in ("rate_hz", "first_s", "last_s", "greatest_gap_s"))
        table.add_row(
            Text(one_line(topic["topic"]) + (" *" if topic["known"] else "")),
            str(topic["messages"]),
            *("-" if value is None else f"{value:.2f}" for value in times),
            str(topic["stamps_going_back"]),
        )
    return table


def _lines(found: dict[str, Any]) -> list[str]:
    """Return in words what the table does not say."""
    lines = []
    for topic in found["topics"]:
        types = " and ".join(kind.replace("/msg/", "/") for kind in topic["types"])
        lines.append(f"{one_line(topic['topic'])}: {one_line(types) or 'no type'}")
    for topic in found["topics"]:
        name = one_line(topic["topic"])
        if len(topic["types"]) > 1:
            lines.append(f"{name} has two types")
        elif topic["problem"]:
            lines.append(topic["problem"])
        if topic["stamps_going_back"]:
            lines.append(f"{name}: {topic['stamps_going_back']} stamps are before the one before them")
        if topic["unreadable_stamps"]:
            lines.append(f"{name}: {topic['unreadable_stamps']} stamps cannot be read")
    lines += ["; ".join(f"{key} {value}" for key, value in file.items()) for file in found["files"]]
    lines += [f"{key}: {shorten(value, MAX_NOTE_CHARS, placeholder=' ...')}" for key, value in found["notes"].items()]
    lines += found["remarks"]
    if found["unverified"]:
        lines.append(f"unverified: {found['unverified']}")
    elif found["unchecked"]:
        lines.append(found["unchecked"])
    lines += [
        f"{reason}: {count} {'message' if count == 1 else 'messages'} lost"
        for reason, count in found["refused"].items()
    ]
    if found["damage"] is None:
        is_sure = not (found["refused"] or found["unchecked"] or found["unverified"])
        return [*lines, "nothing is damaged"] if is_sure else lines
    lines.append(found["damage"]["text"])
    places = found["damage"]["places"]
    lines += [
        f"  {place['file']}, bytes {place['start_byte']} to {place['end_byte']}: {place['what']}"
        for place in places[:MAX_PLACES]
    ]
    return [*lines, *_others(len(places))]


def _others(count: int) -> list[str]:
    """Return a line on the damaged places that are not shown, if there are any."""
    return [f"  and {count - MAX_PLACES} other places"] if count > MAX_PLACES else []
