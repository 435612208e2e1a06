"""The jobs `magnetosuture bag check` and `magnetosuture bag repair`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path

from magnetosuture_thread.bags.damage_report import pluralize
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.remap import parse_remap
from magnetosuture_thread.bags.repair import write_repaired_bag
from magnetosuture_thread.bags.report import BagReport, inspect_bag
from magnetosuture_thread.interface import DISH_FRAME
from magnetosuture_thread.jobs.output import whole_folder

__all__ = ["BagReport", "check_bag", "parse_remap", "repair_bag"]

Say = Callable[[str], None]
Progress = Callable[[float], None]


def check_bag(
    path: Path,
    *,
    remap: Mapping[str, str] | None = None,
    frame: str = DISH_FRAME,
    progress: Progress = lambda share: None,
) -> BagReport:
    """Look through a bag, its checksums first and then its messages, and say what it holds.

    Args:
        path: of the bag.
        remap: new name of a topic by its recorded name.
        frame: name of the bag's frame that is the dish's.
        progress: called with the share done, 0 to 1.

    Raises:
        BagError: nothing of it can be read, or there is no such topic to remap.
    """
    bag = Bag(path, remap=remap, progress=lambda share: progress(0.5 * share))
    return inspect_bag(bag, frame, lambda share: progress(0.5 + 0.5 * share))


def repair_bag(
    path: Path,
    output: Path,
    *,
    remap: Mapping[str, str] | None = None,
    say: Say = lambda text: None,
    progress: Progress = lambda share: None,
) -> int:
    """Write every intact message of a bag into a new one that is whole, and return how many there are.

    Args:
        path: of the bag.
        output: folder of the new bag; it is made whole or not at all.
        remap: new name of a topic by its recorded name.
        say: called with a line for a person on what is lost.
        progress: called with the share done, 0 to 1.

    Raises:
        BagError: nothing of the bag can be read, or the output exists or cannot be written.
    """
    bag = Bag(path, remap=remap, progress=lambda share: progress(0.5 * share))
    refused: Counter[str] = Counter()
    with whole_folder(output) as folder:
        count = write_repaired_bag(bag, folder, output.name, refused, lambda share: progress(0.5 + 0.5 * share))
    if bag.damage is not None:
        say(str(bag.damage))
    elif not refused:
        say(bag.unchecked or "is not damaged: the new bag holds the same")
    for reason, lost in refused.items():
        say(f"{reason}: {pluralize(lost, 'message')} lost")
    for place in bag.damage.regions if bag.damage is not None else ():
        say(f"  {place}{_times(place.first, place.last, bag.start)}")
    return count


def _times(first: int | None, last: int | None, start: int) -> str:
    """Return between which times messages are missing, if any are."""
    if first is None and last is None:
        return ""
    begin = "the beginning" if first is None else f"{(first - start) * 1e-9:.3f} s"
    end = "the end" if last is None else f"{(last - start) * 1e-9:.3f} s"
    return f"; messages between {begin} and {end}"
