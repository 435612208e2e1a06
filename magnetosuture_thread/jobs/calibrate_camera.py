"""The job `magnetosuture calibrate-camera`: where the dish is in the camera's image, written as parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from magnetosuture_thread.errors import BagError
from magnetosuture_thread.jobs.frames import FrameSource
from magnetosuture_thread.vision.calibration import Calibration, calibrate_by_dish, calibrate_by_markers

MOST_FRAMES = 50  # spread over a long bag


def calibrate_camera(
    paths: Sequence[Path],
    dish_diameter: float,
    output: Path,
    markers: tuple[float, float] | None = None,
    *,
    remap: Mapping[str, str] | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> Calibration:
    """Calibrate from frames and write a section `vision_tracker` of a ROS 2 parameter file.

    Args:
        paths: picture files, one folder of pictures, or one bag.
        dish_diameter: inner diameter of the dish [m].
        output: the file to write.
        markers: spacing and side of the ArUco markers [m]; None to calibrate by the dish's rim.
        remap: new name of a bag's topic by its recorded name.
        say: called with a line for a person on what of a bag is damaged or not checked.

    Raises:
        BagError: there are no frames that can be read, or the file cannot be written.
        InvalidInputError: the frames don't show what they must.
    """
    source = FrameSource(paths, remap=remap)
    for doubt in source.doubts:
        say(f"{paths[0]} {doubt}")
    every = -(-source.count // MOST_FRAMES)
    images = [np.asarray(f.image) for i, f in enumerate(source) if i % every == 0 and f.image is not None]
    for line in source.refused:
        say(line)
    if not images:
        raise BagError(paths[0], "holds no frame that can be read")
    if markers is None:
        calibration = calibrate_by_dish(images, dish_diameter)
    else:
        calibration = calibrate_by_markers(images, dish_diameter, *markers)
    try:
        output.write_text(calibration.to_yaml(), encoding="utf-8")
    except OSError as error:
        raise BagError(output, f"cannot be written: {error.strerror}") from None
    return calibration
