"""The command `magnetosuture bag`."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from textwrap import shorten
from typing import Any

from rich.table import Table

from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.recording import inspect_bag
from magnetosuture_thread.bags.storage import pluralize, silence_text
from magnetosuture_thread.bags.writer import write_repaired_bag
from magnetosuture_thread.commands import command
from magnetosuture_thread.settings.errors import one_line
from magnetosuture_thread.settings.files import whole_folder


def add(parser: argparse.ArgumentParser) -> None:
    """Check a recorded bag, or repair it.

    BAG is an mcap or sqlite3 file of any recorder, or the folder of a bag.
    """
    check, repair = command.add_actions(parser, "what to do", "ACTION", check=run_check, repair=run_repair)
    for action in (check, repair):
        action.add_argument("bag", type=Path, metavar="BAG", help="a bag's file or folder")
        command.add_remap(action)
    check.add_argument("--frame", default="dish", metavar="NAME", help="the bag's name of the dish frame")
    check.add_argument("--json", type=command.output_file, metavar="FILE", help="write what was found to a file")
    repair.add_argument("--output", type=Path, required=True, metavar="BAG", help="folder of the bag to make")


def run_check(options: argparse.Namespace, terminal: command.Terminal) -> int:
    """Report what a bag holds, and whether it is intact.

    The whole bag is read: every checksum, and every message's time and stamp. For each topic: its type, how
    many messages, their mean rate, when the first and the last came, the greatest gap, and how often a stamp
    went back; the types follow, and when nothing was recorded for more than 5 s. What is damaged is reported, with what
    is lost; all else is shown as it can be read.
    """
    with terminal.progress("bag check") as advance:
        bag = Bag(options.bag, remap=dict(options.remap), progress=lambda share: advance(0.5 * share))
        report = inspect_bag(bag, options.frame, lambda share: advance(0.5 + 0.5 * share))
    terminal.print(_table(report))
    for line in _lines(report):
        terminal.log(line)
    command.write_json(options.json, report)
    is_doubtful = report["damage"] or report["refused"] or report["salvaged_without_checksum"]
    return command.FAILED if is_doubtful else command.DONE


def run_repair(options: argparse.Namespace, terminal: command.Terminal) -> None:
    """Write every intact message of a bag into a new one.

    Messages, their times and numbers, definitions and notes stay as they are; chunks, indices and metadata.yaml are
    made anew. Attachments and metadata records of other recorders are counted and not kept. The command reports how
    many messages there are and what is lost or changed, where and when.

    A damaged bag without checksums (sqlite3) is refused: nothing tells its altered messages from the others.
    """
    with terminal.progress("bag repair") as advance:
        bag = Bag(options.bag, remap=dict(options.remap), progress=lambda share: advance(0.5 * share))
        with whole_folder(options.output) as folder:
            name = options.output.name
            report = write_repaired_bag(bag, folder, name, lambda share: advance(0.5 + 0.5 * share))
    places = bag.damage.regions if bag.damage is not None else ()
    doubts = [str(bag.damage or ""), bag.salvaged_without_checksum or bag.has_no_checksum, *bag.remarks]
    lines = [line for line in doubts if line]
    if report.is_same and not lines:
        lines.append("is not damaged: the new bag holds the same messages, definitions and notes")
    lines += [f"{reason}: {pluralize(lost, 'message')} lost" for reason, lost in report.refused.items()]
    lines += [f"not kept: {lost} of this: {reason}" for reason, lost in report.dropped.items()]
    if report.unpacked:
        lines.append(f"{pluralize(report.unpacked, 'message')} packed by the recorder, and unpacked in the new bag")
    if report.defined:
        lines.append(f"without a definition, now with ours: {', '.join(sorted(set(report.defined)))}")
    if report.rewritten:
        topics = ", ".join(one_line(topic) for topic in sorted(set(report.rewritten)))
        lines.append(f"quality of service written by name, as Jazzy reads it: {topics}")
    lines += _shown([f"{place}{_times(place.first, place.last, bag.start)}" for place in places])
    for line in (*lines, f"{report.messages} messages in {options.output}"):
        terminal.log(line)


def _times(first: int | None, last: int | None, start: int) -> str:
    """Return between which times messages are missing, if any are."""
    if first is None and last is None:
        return ""
    begin = "the beginning" if first is None else f"{(first - start) * 1e-9:.3f} s"
    end = "the end" if last is None else f"{(last - start) * 1e-9:.3f} s"
    return f"; messages between {begin} and {end}"


def _shown(places: list[str]) -> list[str]:
    """Return a line for each of 100 places, and how many are not shown; `--json` writes all."""
    others = len(places) - 100
    return [f"  {place}" for place in places[:100]] + ([f"  and {others} other places"] if others > 0 else [])


def _table(report: dict[str, Any]) -> Table:
    """Return a row for each topic."""
    rows = []
    for topic in report["topics"]:
        times = (topic[key] for key in ("rate_hz", "first_s", "last_s", "greatest_gap_s"))
        cells = ("-" if value is None else f"{value:.2f}" for value in times)
        name = one_line(topic["topic"]) + (" *" if topic["known"] else "")
        rows.append((name, str(topic["messages"]), *cells, str(topic["stamps_going_back"])))
    title = f"{report['messages']} messages in {report['duration_s']:.3f} s"
    caption = "times in s since the first message; * is taken by our graph"
    return command.make_table(title, ("topic", "messages", "Hz", "first", "last", "gap", "back"), rows, caption)


def _lines(report: dict[str, Any]) -> Iterator[str]:
    """Return in words what the table does not say."""
    for topic in report["topics"]:
        types = " and ".join(kind.replace("/msg/", "/") for kind in topic["types"])
        yield f"{one_line(topic['topic'])}: {one_line(types) or 'no type'}"
    for topic in report["topics"]:
        name = one_line(topic["topic"])
        if len(topic["types"]) > 1:
            yield f"{name} has two types"
        elif topic["problem"]:
            yield topic["problem"]
        if topic["stamps_going_back"]:
            yield f"{name}: {topic['stamps_going_back']} stamps are before the one before them"
        if topic["unreadable_stamps"]:
            yield f"{name}: {topic['unreadable_stamps']} stamps cannot be read"
    yield from _shown([silence_text(silence["begin_s"], silence["end_s"]) for silence in report["silences"]])
    for file in report["files"]:
        yield "; ".join(f"{key} {value}" for key, value in file.items())
    for key, value in report["notes"].items():
        yield f"{key}: {shorten(value, 200, placeholder=' ...')}"
    yield from report["remarks"]
    doubt = report["salvaged_without_checksum"] or report["has_no_checksum"]
    if doubt:
        yield doubt
    for reason, count in report["refused"].items():
        yield f"{reason}: {pluralize(count, 'message')} lost"
    if report["damage"] is not None:
        yield report["damage"]["text"]
        yield from _shown([place["text"] for place in report["damage"]["places"]])
    elif not (report["refused"] or doubt):
        yield "nothing is damaged"
