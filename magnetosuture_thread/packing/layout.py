"""Formats of CDR bytes: plain CDR, little endian, each field at a multiple of its size."""

from __future__ import annotations

import struct
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from magnetosuture_thread.interface import DISH_FRAME

BEGIN = b"\x00\x01\x00\x00"  # plain CDR, little endian; places count from behind it
KEPT = 256  # formats and texts; a run has a few
REAL = np.dtype("<f8")

Text = tuple[int, bytes]  # as a message has it: its length and its bytes
Time = tuple[int, int]  # seconds and nanoseconds


def time_of(stamp: int) -> Time:
    """Return a time [ns] as a message has it."""
    return divmod(stamp, 10**9)


@lru_cache(KEPT)
def text(value: str) -> Text:
    """Return a text as a message has it."""
    data = value.encode() + b"\0"
    return len(data), data


def numbers(values: ArrayLike, kind: np.dtype[np.generic]) -> bytes:
    """Return numbers as a sequence's bytes."""
    return np.asarray(values, kind).tobytes()


def points_of(vertices: ArrayLike) -> bytes:
    """Return points of shape (m, 2) [m] as the bytes of a sequence of Point."""
    flat = np.asarray(vertices)
    points = np.zeros((len(flat), 3), REAL)
    points[:, :2] = flat
    return points.tobytes()


def text_codes(length: int) -> tuple[str, ...]:
    """Return the codes of a text of this length."""
    return "I", f"{length}s"


def array_codes(count: int, kind: str, width: int = 1) -> tuple[str, ...]:
    """Return the codes of a sequence, whose numbers come as bytes; of an empty one only the count is there."""
    aligned = (f"0{kind}",) if count else ()
    return "I", *aligned, f"{count * width * struct.calcsize('<' + kind)}s"


def form(*codes: str) -> struct.Struct:
    """Return the format of fields behind each other, each at a multiple of its size; `0d` only goes to such a place."""
    whole = "<"
    for code in codes:
        whole += f"{-struct.calcsize(whole) % struct.calcsize('<' + code[-1])}x{code}"
    return struct.Struct(whole)


DISH, EMPTY = text(DISH_FRAME), text("")
HEADER = ("i", "I", *text_codes(DISH[0]))
