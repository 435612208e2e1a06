"""Bytes to pixels."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.vision.images import decode_image, glare_mask, prepare, unpack_image


def test_bytes_that_are_no_image_are_refused():
    for data in (b"", b"\xff\xd8 no jpeg", b"0" * 500):
        with pytest.raises(InvalidInputError, match="a JPEG or PNG image"):
            decode_image(data)


def test_raw_images_are_unpacked_with_their_padding():
    pixels = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3)
    padded = np.zeros((2, 12), np.uint8)
    padded[:, :9] = pixels.reshape(2, 9)
    assert (unpack_image(padded.tobytes(), 2, 3, 12, "bgr8") == pixels).all()
    assert (unpack_image(padded.tobytes(), 2, 3, 12, "rgb8") == pixels[:, :, ::-1]).all()
    assert (unpack_image(padded.tobytes(), 2, 9, 12, "mono8") == padded[:, :9]).all()


@pytest.mark.parametrize(
    ("height", "width", "step", "encoding", "words"),
    [
        (2, 3, 9, "bayer_rggb8", "bgr8, rgb8 or mono8"),
        (2, 3, 10, "bgr8", "height times step bytes"),
        (2, 4, 9, "bgr8", "height times step bytes"),
        (0, 3, 9, "bgr8", "height times step bytes"),
    ],
)
def test_raw_images_that_do_not_fit_are_refused(height: int, width: int, step: int, encoding: str, words: str):
    with pytest.raises(InvalidInputError, match=words):
        unpack_image(bytes(18), height, width, step, encoding)


def test_the_floor_is_what_is_behind_slender_things():
    gray = np.tile(np.linspace(120, 220, 320).astype(np.uint8), (240, 1))
    floor = gray.copy()
    gray[118:122, 60:200] = 40
    picture = prepare(gray, 2)
    assert np.abs(picture.floor.astype(float) - floor[::2, ::2]).max() < 6.0
    assert not glare_mask(picture).any()
    gray[40:60, 100:120] = 250
    assert glare_mask(prepare(gray, 2))[22:28, 52:58].all()
