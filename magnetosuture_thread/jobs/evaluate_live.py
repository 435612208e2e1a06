"""What a recording of the running graph holds of it: latencies, and the predictions that were made."""

from __future__ import annotations

from array import array
from collections.abc import Iterator

import numpy as np

from magnetosuture_thread.bags.reader import RecordedMessage
from magnetosuture_thread.bags.recording import Recording
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.evaluation.metrics import Percentiles
from magnetosuture_thread.evaluation.report.figures import STAGES, LiveFigures
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.interface import CURRENTS, NEEDLE_POSE, PREDICTED_THREAD
from magnetosuture_thread.messages.reading import stamp_of

LATENT = dict(zip((NEEDLE_POSE, PREDICTED_THREAD, CURRENTS), STAGES, strict=True))
MAX_LATENCY = 10.0  # s; a median beyond is of two clocks
MAX_WAITING = 600  # recorded predictions that may wait for their frame


def live_figures(recording: Recording, start: float, duration: float | None) -> LiveFigures:
    """Return the latencies of a recorded graph: from a stamp to when the first message about it was recorded.

    Args:
        recording: the bag.
        start: seconds into the bag to begin at.
        duration: [s]; to the bag's end if None.

    Raises:
        BagError: the bag has changed since it was opened.
    """
    there = [channel for channel in LATENT if recording.counts.get(channel.recorded)]
    if not there:
        return LiveFigures()
    if "replayed" in recording.notes:
        return LiveFigures(remark="not measured: the bag was replayed")
    latencies = {channel.recorded: array("d") for channel in there}
    latest: dict[str, int] = {}
    for record in recording.records(there, start=start, duration=duration):
        stamp = _stamp(record)
        if stamp > latest.get(record.topic, 0):  # the first about each
            latest[record.topic] = stamp
            latencies[record.topic].append((record.time - stamp) * 1e-9)
    percentiles = {LATENT[channel]: Percentiles.of(latencies[channel.recorded]) for channel in there}
    found = {stage: each for stage, each in percentiles.items() if each is not None}
    if any(not 0.0 <= each.median <= MAX_LATENCY for each in found.values()):
        return LiveFigures(remark="not measured: stamps and times of recording are of two clocks")
    if all(each.maximum == 0.0 for each in found.values()):
        return LiveFigures(remark="not measured: the bag was made offline")
    return LiveFigures(found)


def _stamp(record: RecordedMessage) -> int:
    """Return the stamp of what a message answers [ns]; 0 for currents that answer no command or are broken."""
    if record.topic != CURRENTS.recorded:
        return stamp_of(record)
    try:
        message = record.decode()
    except BagError:
        return 0
    return 0 if message.stop else int(message.command.sec * 1_000_000_000 + message.command.nanosec)


class RecordedPredictions:
    """Gives the predictions that a bag holds, one by one, beside those made now; few are held at a time.

    Args:
        recording: the bag.
        start: seconds into the bag to begin at.
        duration: [s]; to the bag's end if None.
    """

    def __init__(self, recording: Recording, start: float, duration: float | None) -> None:
        there = bool(recording.counts.get(PREDICTED_THREAD.recorded))
        channels = [PREDICTED_THREAD] if there else []
        self._records: Iterator[RecordedMessage] = recording.records(channels, start=start, duration=duration)
        self._held: dict[int, RecordedMessage] = {}
        self._latest = -1

    def of(self, stamp: int) -> Points | None:
        """Return the recorded prediction of a frame, shape (n + 1, 2) [m]; None if there is none.

        Args:
            stamp: of the frame [ns], not before those asked for until now.
        """
        while self._latest < stamp and len(self._held) < MAX_WAITING:
            record = next(self._records, None)
            if record is None:
                break
            self._latest = max(self._latest, at := stamp_of(record))
            if at >= stamp:  # those before were of frames that nobody asked for
                self._held[at] = record
        found = self._held.pop(stamp, None)
        self._held = {at: record for at, record in self._held.items() if at > stamp}
        if found is None:
            return None
        try:
            vertices = np.array([[point.x, point.y] for point in found.decode().positions])
        except BagError:
            return None
        return vertices if vertices.shape[0] > 1 and np.isfinite(vertices).all() else None
