"""Draws a procedure of `simulate --procedure` as an animation: camera frames, plan, estimated thread and forecast."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image
from rosbags.highlevel import AnyReader

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.rig.setups import read_setup

EVERY, SPEED = 0.6, 6.0  # s of the run between two pictures, and how much faster they are shown
SIDE, MARGIN = 440, 12  # pixels of a picture, and of the frame around the dish
PLAN, PASSED, THREAD, INK = (40, 150, 20), (150, 200, 140), (210, 90, 0), (40, 40, 40)  # BGR
FORECAST = (215, 105, 150)
COLOURS = 64
DARK = 95  # grey levels, below which a pixel is the needle's, or the rim's
NOISE = 14  # grey levels by which a pixel differs from the empty dish by noise alone
IMAGE, PLANNED, ESTIMATED, FORECAST_TOPIC, STATE, SETPOINT = TOPICS = (
    "/camera/image_raw/compressed",
    "/procedure/plan",
    "/thread/estimated",
    "/thread/forecast",
    "/procedure/state",
    "/needle/setpoint_cp",
)
RUNNING = 2  # ProcedureState.STATE_RUNNING
WORDS = {0: "planned", 3: "keeps the needle in place", 4: "done", 5: "given up"}  # by other states


def draw_procedure(bag: Path, setup: str, file: Path) -> None:
    """Write the animation of a recorded procedure as GIF."""
    found = read_setup(setup)
    view, instants, shown_at = found.rig.view(found.scene), [], -np.inf
    latest: dict[str, Any] = {}
    with AnyReader([bag]) as reader:
        chosen = [each for each in reader.connections if each.topic in TOPICS]
        for connection, time, data in reader.messages(connections=chosen):
            latest[connection.topic] = reader.deserialize(data, connection.msgtype)
            now = 1e-9 * (time - reader.start_time)
            if connection.topic == IMAGE and STATE in latest and latest[STATE].goals and now >= shown_at + EVERY:
                shown_at = now
                frame = cv2.imdecode(np.frombuffer(latest[IMAGE].data, np.uint8), cv2.IMREAD_COLOR)
                instants.append((now, frame, dict(latest)))
    # What is nowhere for long is not in the median; with the same floor in all pictures the file is a tenth as large.
    floor = cv2.bilateralFilter(np.median([frame for _, frame, _ in instants[::4]], axis=0).astype(np.uint8), 7, 20, 5)
    pictures = []
    for now, frame, messages in instants:
        moved = cv2.absdiff(frame, floor).max(axis=2) > NOISE
        moved = cv2.morphologyEx(moved.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8)) > 0
        pictures.append(
            _picture(np.where(moved[..., None], frame, floor), messages, view, found.scene.dish.radius, now)
        )
    sample = pictures[len(pictures) // 2].copy()
    for k, colour in enumerate((PLAN, PASSED, THREAD, FORECAST, INK)):
        sample.paste(colour[::-1], (0, 30 * k, 60, 30 * k + 30))
    palette = sample.quantize(COLOURS)
    frames = [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in pictures]
    frames[0].save(file, save_all=True, append_images=frames[1:], duration=1e3 * EVERY / SPEED, loop=0, optimize=True)


def _picture(frame: np.ndarray, latest: dict[str, Any], view: DishView, radius: float, now: float) -> Image.Image:
    if PLANNED in latest:
        before, needle = frame.copy(), frame.max(axis=2) < DARK
        places = np.array([(pose.pose.position.x, pose.pose.position.y) for pose in latest[PLANNED].poses])
        passed = 0
        if SETPOINT in latest and len(places):
            at = latest[SETPOINT].pose.position
            passed = int(np.argmin(np.hypot(*(places - (at.x, at.y)).T)))
        _line(frame, view.to_pixels(places[: passed + 1]), PASSED, 2)
        _line(frame, view.to_pixels(places[passed:]), PLAN, 2)
        frame[needle] = before[needle]
    if FORECAST_TOPIC in latest:
        ahead = latest[FORECAST_TOPIC]
        nodes = len(ahead.positions) // max(len(ahead.time), 1)
        last = np.array([(each.x, each.y) for each in ahead.positions[-nodes:]])
        _line(frame, view.to_pixels(last), FORECAST, 2)
    if ESTIMATED in latest:
        _line(frame, view.to_pixels(np.array([(each.x, each.y) for each in latest[ESTIMATED].positions])), THREAD, 2)
    (u, v), reach = view.centre_px, radius / view.metres_per_pixel + MARGIN
    left, top = max(0, round(u - reach)), max(0, round(v - reach))
    cut = frame[top : round(v + reach), left : round(u + reach)]
    picture = cv2.resize(cut, (SIDE, round(SIDE * cut.shape[0] / cut.shape[1])), interpolation=cv2.INTER_AREA)
    state = latest[STATE]
    doing = f"goal {state.goal + 1}: {state.goals[state.goal].replace('_', ' ')}"
    words = doing if state.state == RUNNING else WORDS.get(state.state, "")
    for text, y in ((f"{now:.0f} s  {words}", 18), ("simulated", picture.shape[0] - 8)):
        cv2.putText(picture, text, (6, y), cv2.FONT_HERSHEY_SIMPLEX, 0.45, INK, 1, cv2.LINE_AA)
    return Image.fromarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB))


def _line(image: np.ndarray, points: np.ndarray, colour: tuple[int, int, int], width: int) -> None:
    if len(points) > 1:
        cv2.polylines(image, [np.round(16.0 * points).astype(np.int32)], False, colour, width, cv2.LINE_AA, 4)
