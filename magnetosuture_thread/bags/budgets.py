"""What bags may ask for: bytes, records, nesting and time of chunks, messages and definitions.

A bag of a few bytes may ask for hours or gigabytes: compressed zeros, types in types. With these bounds the command
reads or refuses each such bag within 5 s and 300 MB.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO, cast

from magnetosuture_thread.settings.files import MAX_FILE_BYTES, BudgetError, is_url

MAX_BLOCK_BYTES = MAX_FILE_BYTES  # of a message, or of a chunk of messages, packed or not
RANGE_BYTES = 1 << 20  # read at once, at least, of a file that a URL names
MAX_BLOCK_RECORDS = 500_000  # of a chunk
MAX_NESTING = 32  # of message types in each other
MAX_ELEMENTS = 4_000  # fields that a message has whatever its data, all nested ones counted: a decoder is made for each
MAX_DECODED = 1_000_000  # objects that the data of one message may become
MAX_DEFINITION_CHARS = 200_000
MAX_PARSER_STEPS = 40_000  # of a message definition's parser: a second; a usual definition takes 200 to 5,000
MAX_BAG_PARSER_STEPS = 100_000  # of all definitions of a bag
MAX_RECORD_BYTES = 1 << 22  # of a definition of a topic or type, or of another record that is parsed as a whole
MAX_KEPT_BYTES = 1 << 25  # of all different definitions and metadata records of a small bag, as they are in memory
LONE_RECORD = 10  # records in a chunk, which are read in the time of one outside of chunks


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


def open_ranges(path: Path) -> BinaryIO:
    """Open a file that is read in parts; of a URL only ranges are fetched, of `RANGE_BYTES` beyond what is asked for.

    Raises:
        OSError: it cannot be opened.
    """
    if not is_url(path):
        return path.open("rb")
    opened: BinaryIO = cast(Any, path).open("rb", block_size=RANGE_BYTES, cache_type="readahead")
    return opened
