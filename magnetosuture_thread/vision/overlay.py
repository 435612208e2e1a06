"""Draws what was seen over the frame, for a person to judge."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.needle_arc import needle_axis
from magnetosuture_thread.geometry.thread_observation import PieceEnd, ThreadObservation
from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.settings.files import output_problem, whole_file
from magnetosuture_thread.vision.refused import Refused
from magnetosuture_thread.vision.teaching import Taught
from magnetosuture_thread.vision.tracker import State, Track

VIDEOS = {".mp4": "mp4v", ".avi": "MJPG"}
SHIFT = 4  # binary places of a coordinate
NEEDLE, THREAD, DISH = (40, 140, 255), (70, 190, 60), (200, 170, 60)
PLATES = {State.TRACKED: (70, 150, 50), State.LOST: (50, 50, 200), State.SEARCHING: (160, 120, 40)}
FONT = cv2.FONT_HERSHEY_SIMPLEX


def draw_overlay(image: np.ndarray, track: Track, needle_length: float, title: str = "") -> np.ndarray:
    """Draw dish, thread and needle over a frame, and the state as text.

    Pieces of the thread whose place along it is known are green, and joined by thin lines; others are red. A dot is the
    thread's end, a ring where it goes on unseen, and thin lines surround what may hide it. Of a needle whose direction
    is unknown both ends are rings.

    Args:
        image: shape (rows, columns) or (rows, columns, 3) in BGR order, uint8.
        track: what was seen in it.
        needle_length: [m]
        title: written at the top.

    Returns:
        A new BGR image of the same size.
    """
    drawn, unit = _canvas(image)
    view = track.view
    if view is not None:
        _circle(drawn, np.asarray(view.centre_px), 2.5 * unit, DISH, -1)
    if view is not None and len(track.tail):
        if track.observation.pieces:
            _pieces(drawn, view, track.observation, unit)
        elif len(track.centreline) > 1:
            _line(drawn, view.to_pixels(track.centreline), THREAD, unit)
        heading = float(np.arctan2(track.heading[1], track.heading[0]))
        points, _ = needle_axis(track.tail, heading, needle_length, track.curvature, np.linspace(0.0, 1.0, 25))
        axis = view.to_pixels(points)
        _line(drawn, axis, NEEDLE, unit)
        _circle(drawn, axis[0], 4.0 * unit, NEEDLE, unit)
        if track.reason:
            _circle(drawn, view.to_pixels(track.tip), 4.0 * unit, NEEDLE, unit)
        else:
            _circle(drawn, view.to_pixels(track.tip), 2.0 * unit, (40, 200, 255), -1)
    _plate(drawn, track, title, unit)
    return drawn


def _canvas(image: np.ndarray) -> tuple[np.ndarray, int]:
    """Return a BGR image to draw over, a copy, and the width of a line for its size [px]."""
    drawn = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image.copy()
    return drawn, max(1, round(min(drawn.shape[:2]) / 480))


def draw_dish(image: np.ndarray, centre_px: tuple[float, float], radius_px: float) -> None:
    """Draw the dish's circle into a BGR image."""
    _circle(image, np.asarray(centre_px), radius_px, DISH, 1)


def draw_refused(image: np.ndarray, refused: Sequence[Refused]) -> None:
    """Draw what was not taken for the needle into a BGR image, each with its reason below it."""
    unit = max(1, round(min(image.shape[:2]) / 480))
    for each in refused:
        _line(image, np.vstack([each.outline_px, each.outline_px[:1]]), PLATES[State.LOST], unit)
        at = 8 * unit, int(each.outline_px[:, 1].max()) + 16 * unit
        cv2.putText(image, each.reason, at, FONT, 0.42 * unit, PLATES[State.LOST], unit, cv2.LINE_AA)


def draw_taught(image: np.ndarray, taught: Taught) -> np.ndarray:
    """Return a BGR image of what was learnt: the frame with the needle's ends, beside it what the filter looks at.

    Its best answer is in the needle's colour with its score, all others are in that of refused things.
    """
    frame, unit = _canvas(image)
    mask = cv2.cvtColor(taught.dark, cv2.COLOR_GRAY2BGR)
    mask[taught.dark == 0] = DISH  # where nothing is looked for
    for index, (ends, score) in enumerate(taught.answers):
        colour = PLATES[State.LOST] if index else NEEDLE
        _line(mask, ends, colour, unit)
        u, v = (int(value) for value in ends.max(axis=0))
        cv2.putText(mask, f"{score:.2f}", (u + 4 * unit, v), FONT, 0.5 * unit, colour, unit, cv2.LINE_AA)
    _line(frame, taught.ends, NEEDLE, unit)
    _circle(frame, taught.ends[0], 4.0 * unit, NEEDLE, unit)
    _circle(frame, taught.ends[1], 2.0 * unit, (40, 200, 255), -1)
    return np.hstack([frame, mask])


def draw_region(image: np.ndarray, region_px: Sequence[float]) -> None:
    """Draw the part of the frame that is looked at, left, top, right and bottom [px], into a BGR image."""
    if region_px:
        left, top, right, bottom = (int(value) for value in region_px)
        cv2.rectangle(image, (left, top), (right - 1, bottom - 1), DISH, 1)


def write_png(path: Path, image: np.ndarray) -> None:
    """Write a BGR picture as PNG, as a whole or not at all."""
    with whole_file(path) as partial:
        partial.write_bytes(cv2.imencode(".png", image)[1].tobytes())


class OverlayWriter:
    """Writes overlays as a video or as PNG files in a folder.

    Args:
        path: a video's file if it ends like one, else a folder.
        rate: frames a second, of a video.

    Raises:
        BagError: the folder or the video cannot be written.
    """

    def __init__(self, path: Path, rate: float = 30.0) -> None:
        self._path, self._rate = path, rate
        self._video: cv2.VideoWriter | None = None
        self._size = (0, 0)
        if path.suffix.lower() in VIDEOS:
            problem = output_problem(path) or ("" if path.parent.is_dir() else "is in no folder that exists")
            if problem:
                raise BagError(path, problem)
            return
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise BagError(path, f"cannot be made: {error.strerror}") from None

    def write(self, name: str, image: np.ndarray) -> None:
        """Write one picture.

        Args:
            name: of its file in a folder, without its ending.
            image: BGR, uint8; in a video, a picture of another size than the first is fitted into it.
        """
        if self._path.suffix.lower() not in VIDEOS:
            write_png(self._path / f"{name}.png", image)
            return
        if self._video is None:
            self._size = (image.shape[1] // 2 * 2, image.shape[0] // 2 * 2)  # which every codec takes
            code = cv2.VideoWriter.fourcc(*VIDEOS[self._path.suffix.lower()])
            self._video = cv2.VideoWriter(str(self._path), code, self._rate, self._size)
            if not self._video.isOpened():
                raise BagError(self._path, "cannot be written as a video here; name a folder for PNG files")
        if image.shape[1::-1] != self._size:
            image = cv2.resize(image, self._size, interpolation=cv2.INTER_AREA)
        self._video.write(image)

    def __enter__(self) -> OverlayWriter:
        """Return the writer."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the video."""
        if self._video is not None:
            self._video.release()


def _pieces(image: np.ndarray, view: DishView, observation: ThreadObservation, unit: int) -> None:
    """Draw what is seen of the thread, and what may hide the rest of it."""
    if not observation.complete:
        for outline in observation.hidden:
            _line(image, view.to_pixels(np.vstack([outline, outline[:1]])), (170, 130, 170), 1)
    before: np.ndarray | None = None
    for piece in observation.pieces:
        line = view.to_pixels(piece.points)
        placed = bool(np.isfinite(piece.arc_length[0]))
        colour = THREAD if placed else (60, 60, 220)
        if placed and before is not None:
            _line(image, np.array([before, line[0]]), THREAD, 1)
        before = line[-1] if placed else None
        _line(image, line, colour, unit)
        for end, at in ((piece.first_end, line[0]), (piece.last_end, line[-1])):
            if end is not PieceEnd.TAIL:
                _circle(image, at, 2.5 * unit, colour, -1 if end is PieceEnd.FREE else unit)


def _plate(image: np.ndarray, track: Track, title: str, unit: int) -> None:
    """Write the state on a half-transparent plate along the lower border."""
    text = track.state.value
    if track.reason:
        text += f": {track.reason}"
    else:
        angle = np.degrees(np.arctan2(track.heading[1], track.heading[0]))
        x, y = track.tail * 1e3
        text += f"   tail {x:+.2f} {y:+.2f} mm   heading {angle:+.1f} deg   confidence {track.confidence:.2f}"
    high = 22 * unit
    band = image[-high:]
    band[:] = cv2.addWeighted(band, 0.25, np.full_like(band, PLATES[track.state]), 0.75, 0.0)
    scale = 0.42 * unit
    widest = image.shape[1] - 16 * unit
    while len(text) > 8 and cv2.getTextSize(text, FONT, scale, unit)[0][0] > widest:
        text = text[:-4] + "..."
    at = (8 * unit, image.shape[0] - 7 * unit)
    cv2.putText(image, text, at, FONT, scale, (255, 255, 255), unit, cv2.LINE_AA)
    if title:
        cv2.putText(image, title, (8 * unit, 16 * unit), FONT, scale, (60, 60, 60), unit, cv2.LINE_AA)


def _fixed(points: np.ndarray) -> np.ndarray:
    return np.round(points * 2**SHIFT).astype(np.int32)


def _line(image: np.ndarray, points: np.ndarray, colour: tuple[int, int, int], thickness: int) -> None:
    cv2.polylines(image, [_fixed(points)], False, colour, thickness, cv2.LINE_AA, SHIFT)


def _circle(image: np.ndarray, at: np.ndarray, radius: float, colour: tuple[int, int, int], thickness: int) -> None:
    u, v = (int(value) for value in _fixed(at))
    cv2.circle(image, (u, v), round(radius * 2**SHIFT), colour, thickness, cv2.LINE_AA, SHIFT)
