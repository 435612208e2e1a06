"""What may be written over: new files and regular ones, never an input."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from magnetosuture_thread.settings.interface import STORAGE_SUFFIXES


def output_problem(path: Path) -> str:
    """Return why a file must not be written in the place of what a path names; empty where it may.

    A device, pipe or link would be replaced by a file: `--output /dev/null` as root would break the machine.
    """
    if path.is_symlink():
        return "is a symbolic link; expected a new file, or a regular one to replace"
    if path.exists() and not path.is_file():
        kind = "folder" if path.is_dir() else "device, pipe or socket"
        return f"is a {kind}; expected a new file, or a regular one to replace"
    return ""


def input_problem(output: Path, inputs: Iterable[Path]) -> str:
    """Return why an output would damage an input; empty where it does not.

    Args:
        output: a file or folder to write.
        inputs: files and folders that are read.
    """
    folders = [folder for folder in output.absolute().parents if folder.exists()]
    for source in inputs:
        try:
            if not source.exists():
                continue
            if output.exists() and os.path.samefile(output, source):
                return f"is the input {source}; expected another place"
            for index, folder in enumerate(folders):
                if os.path.samefile(folder, source):
                    # Beside several bags or other inputs in a folder there is room; within a bag there is none.
                    if any(_is_bag(each) for each in folders[: index + 1]):
                        return f"is inside of the input {source}; expected a place outside"
                    break
        except (OSError, ValueError):
            continue
    return ""


def _is_bag(folder: Path) -> bool:
    with os.scandir(folder) as entries:
        return any(entry.name.endswith(STORAGE_SUFFIXES) or entry.name == "metadata.yaml" for entry in entries)
