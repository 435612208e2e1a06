"""A bag that somebody begins and ends while the graph runs."""

from __future__ import annotations

import asyncio
import queue
import threading
from collections.abc import Iterable, Mapping
from concurrent.futures import Future
from datetime import datetime
from pathlib import Path

from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.errors import MagnetosutureError
from magnetosuture_thread.interface import Channel
from magnetosuture_thread.jobs.output import whole_folder


class BagRecording:
    """Writes a bag in a thread of its own, so that a slow disk keeps nobody from steering and stopping.

    Args:
        output: the bag's folder; it is there, whole, once the recording has ended.
        notes: of the bag.
        channels: that it gets messages of.
    """

    def __init__(self, output: Path, notes: Mapping[str, str], channels: Iterable[Channel]) -> None:
        self.output = output
        self._notes = notes
        self._channels = tuple(channels)
        self._waiting: queue.SimpleQueue[tuple[str, int, bytes] | None] = queue.SimpleQueue()
        self._begun: Future[None] = Future()
        self._ended: Future[None] = Future()

    @property
    def ended(self) -> bool:
        """Whether it has ended, by itself or because it was asked to."""
        return self._ended.done()

    async def begin(self) -> None:
        """Begin.

        Raises:
            BagError: the output exists or cannot be written.
        """
        threading.Thread(target=self._run, name="recording").start()
        await asyncio.wrap_future(self._begun)

    def add(self, topic: str, arrival: int, data: bytes) -> None:
        """Take a message: topic with its leading slash, when it came [ns], CDR bytes."""
        if not self.ended:
            self._waiting.put((topic, arrival, data))

    async def end(self) -> None:
        """End, once all messages are written.

        Raises:
            BagError: the disk is full or fails; what was recorded before is there.
        """
        self._waiting.put(None)
        await asyncio.wrap_future(self._ended)

    def _run(self) -> None:
        try:
            self._write()
        except MagnetosutureError as error:
            if not self._begun.done():
                self._begun.set_exception(error)
            self._ended.set_exception(error)
        else:
            self._ended.set_result(None)

    def _write(self) -> None:
        with (
            whole_folder(self.output, is_recording=True) as folder,
            BagWriter(folder, self._notes, name=self.output.name) as bag,
        ):
            for channel in self._channels:
                bag.add_topic(channel.recorded, channel.type_name)
            self._begun.set_result(None)
            while (message := self._waiting.get()) is not None:
                bag.write(*message)


def new_name(folder: Path, name: str) -> Path:
    """Return a folder for a recording that is not there yet: named by the time of the day, and what is recorded."""
    stem = f"{datetime.now():%Y-%m-%d_%H-%M-%S}_{name}".rstrip("_")
    output, count = folder / stem, 1
    while output.exists():
        count += 1
        output = folder / f"{stem}_{count}"
    return output
