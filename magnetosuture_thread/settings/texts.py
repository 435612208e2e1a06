"""Texts from outside as they may be shown."""

from __future__ import annotations


def printable(text: str) -> str:
    r"""Return a text without control characters, characters that turn its direction, and what no encoding has.

    A name in a bag or of a file may hold any of them; each becomes its escape sequence. Line feeds and tabs stay.

    >>> printable("a\x1b[31m")
    'a\\x1b[31m'
    """
    if text.isprintable():
        return text
    return "".join(sign if sign.isprintable() or sign in "\n\t" else ascii(sign)[1:-1] for sign in text)


def one_line(text: str) -> str:
    """Return a name as `printable`, in one line."""
    return printable(text).replace("\n", "\\n").replace("\t", "\\t")


MAX_CHARS = 100  # of a text from outside, wherever it is stored, logged, published or drawn


def shortened(text: str, max_chars: int = MAX_CHARS) -> str:
    """Return a text from outside as `one_line`, of at most so many characters.

    >>> shortened("frame" * 1000, 12)
    'frameframef…'
    """
    line = one_line(text[: max_chars + 1])
    return line if len(line) <= max_chars else line[: max_chars - 1] + "…"
