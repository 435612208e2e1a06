"""All classes of frames with a needle, by name; ropes and photographs have their own tables."""

from __future__ import annotations

from benchmarks.vision.cases import BASIC_CLASSES, MakeCase
from benchmarks.vision.covers import COVERED_CLASSES
from benchmarks.vision.second_threads import SECOND_THREAD_CLASSES

CLASSES: dict[str, MakeCase] = BASIC_CLASSES | COVERED_CLASSES | SECOND_THREAD_CLASSES
