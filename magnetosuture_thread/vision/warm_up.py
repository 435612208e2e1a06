"""Gets everything compiled and loaded before the first frame comes."""

from __future__ import annotations

import cv2
import numpy as np

from magnetosuture_thread.scene.scene import Scene
from magnetosuture_thread.vision.dish.ellipse import find_ellipse
from magnetosuture_thread.vision.dish.find import rim_shift
from magnetosuture_thread.vision.images import Wall
from magnetosuture_thread.vision.look import look_once
from magnetosuture_thread.vision.needle.measure import axis_guesses
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.thread.pieces import fresh_parts
from magnetosuture_thread.vision.thread.walk import Ridge, walk_on, worth


def warm_up() -> bool:
    """Look at a drawn dish, needle and thread, and run what only other frames need.

    Where nothing is compiled yet this takes a minute, and no frame compiles anything later. From now on OpenCV stays on
    one thread in this process: at these sizes it costs more to wake others.

    Returns:
        Whether the drawn needle was found, as it must be.
    """
    cv2.setNumThreads(1)
    image = np.full((480, 640), 170, np.uint8)
    cv2.circle(image, (320, 240), 222, 60, 5, cv2.LINE_AA)
    cv2.circle(image, (320, 240), 218, 225, -1, cv2.LINE_AA)
    cv2.polylines(image, [np.array([[300, 240], [200, 240], [120, 280]])], False, 140, 1, cv2.LINE_AA)
    outline = [(300.0, 237.5), (370.0, 237.5), (387.5, 240.0), (370.0, 242.5), (300.0, 242.5)]
    cv2.fillPoly(image, [np.round(np.array(outline) * 16).astype(np.int32)], 45, cv2.LINE_AA, 4)
    image = cv2.GaussianBlur(image, (0, 0), 0.9)
    rim_shift(image, (320.0, 240.0), 218.0)
    _run_rare(image)
    return not look_once(image, VisionTrackerSettings(), Scene()).reason


def _run_rare(image: np.ndarray) -> None:
    """Run the compiled functions that a plain frame does not reach.

    They are for a dish without a rim, a needle at the wall or in one dark thing with its thread, crossings, and pieces
    behind covers.
    """
    find_ellipse(image)
    Wall((320.0, 240.0), 218.0).distances((slice(0, 2), slice(0, 2)))
    core = np.zeros((60, 60), np.uint8)
    core[10, 5:55] = core[10:50, 54] = core[49, 5:55] = 1  # long and winding
    axis_guesses(cv2.dilate(core, np.ones((5, 5), np.uint8)) > 0, 30.0, 5.0)
    line = np.array([[0.0, 0.0], [30.0, 0.0]])
    fresh_parts(line, [line])
    path, strong = np.zeros((8, 6)), np.zeros(8, np.bool_)
    nothing = np.zeros((16, 16), np.uint8)
    walk_on(Ridge(nothing, nothing, 1, 1.0, 1.0), (8.0, 8.0, 8.0), 4.0, path, strong, 1, 9.0, np.empty((0, 3)))
    worth(path, strong, 1)
