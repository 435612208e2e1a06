"""Writes below each table of the results the commit of its figures, as git has it; nothing without a history."""

from __future__ import annotations

import re
import subprocess
from itertools import pairwise
from pathlib import Path
from typing import Any

PAGE = "results"


def _git(*words: str) -> str:
    """Return what git prints, nothing where there is no repository or no git."""
    try:
        done = subprocess.run(
            ["git", *words], cwd=Path(__file__).parent, capture_output=True, text=True, check=False, encoding="utf-8"
        )
    except OSError:
        return ""
    return done.stdout if done.returncode == 0 else ""


def commits_of_lines(path: Path) -> list[str]:
    """Return the commit that last changed each line of a file, but for its white space and place."""
    if _git("rev-parse", "--is-shallow-repository").strip() != "false":
        return []
    lines = _git("blame", "-w", "-C", "-C", "-s", "--abbrev=9", "--", str(path)).splitlines()
    return [line.split()[0].lstrip("^")[:9] for line in lines]


def with_commits(text: str, commits: list[str], order: list[str]) -> str:
    """Return a page with a line below each table: the newest commit of its rows.

    Args:
        text: the page.
        commits: of each line.
        order: all commits, the newest first.
    """
    lines = text.splitlines()
    if len(commits) != len(lines):  # changed since, or no history
        return text
    age = {commit: number for number, commit in enumerate(order)}
    result: list[str] = []
    rows: list[str] = []
    for number, (line, after) in enumerate(pairwise([*lines, ""])):
        result.append(line)
        if line.lstrip().startswith("|"):
            rows.append(commits[number])
            if not after.lstrip().startswith("|"):
                newest = min(rows, key=lambda commit: age.get(commit, -1))
                known = newest in age
                indent = re.match(r" *", line)
                assert indent is not None
                result += ["", f"{indent[0]}*Commit {newest}.*" if known else f"{indent[0]}*Not committed yet.*"]
                rows = []
    return "\n".join(result) + "\n"


def setup(app: Any) -> dict[str, bool]:
    """Register at Sphinx."""

    def fill(_app: Any, page: str, source: list[str]) -> None:
        if page == PAGE:
            commits = commits_of_lines(Path(__file__).parent / f"{PAGE}.md")
            order = _git("log", "--format=%h", "--abbrev=9").split()
            source[0] = with_commits(source[0], commits, order)

    app.connect("source-read", fill)
    return {"parallel_read_safe": True}
