"""Gets everything compiled and loaded before the first frame comes."""

from __future__ import annotations

import cv2
import numpy as np

from magnetosuture_thread.scene.scene import Scene
from magnetosuture_thread.vision.dish.find import rim_shift
from magnetosuture_thread.vision.look import look_once
from magnetosuture_thread.vision.settings import VisionTrackerSettings


def warm_up() -> bool:
    """Look at a drawn dish, needle and thread; the first look takes seconds where nothing is compiled yet.

    From now on OpenCV stays on one thread in this process: at these sizes it costs more to wake others.

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
    return not look_once(image, VisionTrackerSettings(), Scene()).reason
