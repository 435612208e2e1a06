"""The one budget for input that nobody vouches for: bytes, nesting, elements and time of files, texts and messages.

A file of a few bytes may ask for hours or gigabytes: compressed zeros, lists in lists, types in types, aliases. Every
reader takes its bounds from here, and what is past them is refused in one line. With them the command reads or refuses
each such file within 5 s and 300 MB; a picture of `MAX_PIXELS` may take 550 MB where it has 16 bits a colour.
"""

from __future__ import annotations

import re
from typing import Any

import yaml

MAX_TEXT_BYTES = 1_000_000  # of a setup, scene, calibration or other text that is read whole
MAX_METADATA_BYTES = 4_000_000  # of a bag's metadata.yaml, which lists every topic
MAX_TABLE_BYTES = 20_000_000  # of measurements in a CSV file
MAX_FILE_BYTES = 1 << 26  # of a picture or reference trajectory
MAX_BLOCK_BYTES = 1 << 26  # of a message, or of a chunk of messages, packed or not
MAX_BLOCK_RECORDS = 500_000  # of a chunk
MAX_PIXELS = 25_000_000  # of a picture: with 16 bits for each of three colours 150 MB
MAX_YAML_DEPTH = 20
MAX_YAML_EVENTS = 500_000  # values, keys, beginnings and ends of lists
MAX_NESTING = 32  # of message types in each other
MAX_ELEMENTS = 4_000  # fields that a message has whatever its data, all nested ones counted: a decoder is made for each
MAX_DECODED = 1_000_000  # objects that the data of one message may become
MAX_DEFINITION_CHARS = 200_000
MAX_PARSER_STEPS = 40_000  # of a message definition's parser: a second; a usual definition takes 200 to 5,000
MAX_BAG_PARSER_STEPS = 100_000  # of all definitions of a bag
MAX_RECORD_BYTES = 1 << 22  # of a definition of a topic or type, or of another record that is parsed as a whole
MAX_KEPT_BYTES = 1 << 25  # of all different definitions and metadata records of a small bag, as they are in memory
# Numbers of YAML 1.1 that are not written in decimal digits alone: binary, octal, hexadecimal, in sixties, spaced by _.
_NOT_DECIMAL = re.compile(
    r"[-+]?(?:0b[01_]+|0[0-7_]+|0x[0-9a-fA-F_]+|[1-9][0-9]*_[0-9_:]*|[1-9][0-9]*(?::[0-5]?[0-9])+)"
)
LONE_RECORD = 10  # records in a chunk, which are read in the time of one outside of chunks


class BudgetError(Exception):
    """Input that asks for more than it may; the text says of what, and how much it may."""


class UnpackBudget:
    """What the files of a bag may become when they are unpacked and searched, by their size.

    A recorder's compression saves a factor of 2 to 50; a bomb's, many thousands. Each of these bounds of a small bag,
    and that of `ParserBudget`, takes a second or two: one that goes to all of them at once still ends within 5 s.

    Args:
        size: of all files [bytes].
    """

    def __init__(self, size: int) -> None:
        self._max_bytes = self._bytes = (1 << 29) + 200 * size
        self._max_records = self._records = 200_000 + size // 4  # a packed message takes 5 bytes or more
        self._max_kept = self._kept = MAX_KEPT_BYTES + 2 * size  # the parts of a split bag repeat them

    def spend(self, count: int, records: int = 0) -> None:
        """Count unpacked bytes, and records in them.

        Raises:
            BudgetError: there are more than the files may hold.
        """
        self._bytes -= count
        self._records -= records
        if self._bytes < 0:
            raise BudgetError(f"unpacks to more than {self._max_bytes} bytes, which no recording of its size does")
        if self._records < 0:
            raise BudgetError(f"holds more than {self._max_records} records, which no recording of its size does")

    def keep(self, count: int, entries: int = 0) -> None:
        """Count the bytes of a definition or metadata record that stays in memory, and its entries.

        Raises:
            BudgetError: the files have more of them than they may.
        """
        # In memory a record takes 500 bytes whatever its length, and 150 for each of its entries.
        self._kept -= count + 500 + 150 * entries
        if self._kept < 0:
            raise BudgetError(f"holds definitions and metadata that take more than {self._max_kept} bytes of memory")


class ParserBudget:
    """Steps that the message definitions of one bag may take to parse, each and together."""

    def __init__(self) -> None:
        self._left = MAX_BAG_PARSER_STEPS
        self._left_of_one = 0

    def begin(self) -> None:
        """Begin with another definition."""
        self._left_of_one = MAX_PARSER_STEPS

    def spend(self) -> None:
        """Count a step.

        Raises:
            BudgetError: there are more than may be.
        """
        self._left -= 1
        self._left_of_one -= 1
        if self._left_of_one < 0:
            raise BudgetError(f"a definition that takes more than {MAX_PARSER_STEPS} steps to parse")
        if self._left < 0:
            raise BudgetError(f"a definition past the {MAX_BAG_PARSER_STEPS} steps in which those of a bag are parsed")


def check_yaml(text: str, *, max_aliases: int = 0, plain: bool = False) -> None:
    """Refuse a YAML text that becomes much larger when it is read, or that nests too deep.

    Args:
        text: whatever was given.
        max_aliases: that are accepted; each may double what is read.
        plain: whether tags, and numbers that are not written in decimal digits, are refused too.

    Raises:
        BudgetError: with the line.
        yaml.YAMLError: it is no YAML.
    """
    depth = aliases = 0
    for count, event in enumerate(yaml.parse(text, Loader=yaml.CSafeLoader)):
        problem = ""
        if isinstance(event, (yaml.SequenceStartEvent, yaml.MappingStartEvent)):
            depth += 1
            problem = f"lists and mappings {depth} deep" if depth > MAX_YAML_DEPTH else ""
        elif isinstance(event, (yaml.SequenceEndEvent, yaml.MappingEndEvent)):
            depth -= 1
        if isinstance(event, yaml.AliasEvent) or (not max_aliases and getattr(event, "anchor", None) is not None):
            aliases += 1
            problem = "an anchor or alias (& or *)" if aliases > max_aliases else problem
        if plain and getattr(event, "tag", None) not in (None, "!"):
            problem = "a tag (!)"
        elif (
            plain and isinstance(event, yaml.ScalarEvent) and event.implicit[0] and _NOT_DECIMAL.fullmatch(event.value)
        ):
            problem = f"{event.value[:40]}, which is no decimal number"
        if count > MAX_YAML_EVENTS:
            problem = f"more than {MAX_YAML_EVENTS} values"
        if problem:
            raise BudgetError(problem + _line(event))


def _line(event: Any) -> str:
    return f" in line {event.start_mark.line + 1}" if event.start_mark else ""
