"""Bytes to pixels."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import pytest

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.vision.images import (
    decode_image,
    glare_mask,
    prepare,
    unpack_image,
)

VIEW = DishView((160.0, 120.0), 8e-5)


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
    picture = prepare(gray, VIEW, 0.02)
    assert np.abs(picture.brightest.floor.astype(float) - floor).max() < 6.0
    assert not glare_mask(picture).any()
    gray[40:60, 100:120] = 250
    assert glare_mask(prepare(gray, VIEW, 0.02))[44:56, 104:116].all()


def png(width: int, height: int) -> bytes:
    """Return a PNG of black pixels: some kilobytes, whatever its size."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    packer = zlib.compressobj(9)
    rows = b"".join(packer.compress(bytes(1 + (width + 7) // 8)) for _ in range(height)) + packer.flush()
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


@pytest.mark.parametrize(("side", "size"), [(4000, "4000 x 4000 pixels"), (30_000, "900000000 pixels")])
def test_a_picture_of_too_many_pixels_is_refused_before_it_is_decoded(
    side: int, size: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(cv2, "imdecode", lambda *given: pytest.fail("decoded"))
    with pytest.raises(InvalidInputError, match=f"{size}.* at most 10000000 pixels"):
        decode_image(png(side, side))


@pytest.mark.parametrize("ending", [".png", ".jpg", ".bmp", ".webp", ".tif"])
def test_pictures_are_decoded_and_damaged_ones_are_refused(ending: str):
    data = cv2.imencode(ending, np.random.default_rng(1).integers(0, 255, (48, 64, 3), np.uint8))[1]
    assert decode_image(data).shape == (48, 64, 3)
    for end in (0, 7, 14, 21):
        with pytest.raises(InvalidInputError, match="a JPEG or PNG image"):
            decode_image(data[:end])


def oriented_jpeg(image: np.ndarray, orientation: int) -> bytes:
    """Return a JPEG with an orientation in its EXIF data, as telephones write it."""
    data = cv2.imencode(".jpg", image)[1].tobytes()
    tags = b"MM\0*" + struct.pack(">IHHHIHHI", 8, 1, 274, 3, 1, orientation, 0, 0)
    exif = b"Exif\0\0" + tags
    return data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:]


@pytest.mark.parametrize("orientation", [3, 6, 8])
def test_pixels_are_read_as_they_are_stored_whatever_the_orientation(orientation: int):
    image = np.zeros((48, 64, 3), np.uint8)
    image[:10, :20] = 255
    turned = oriented_jpeg(image, orientation)
    assert (decode_image(turned) == decode_image(cv2.imencode(".jpg", image)[1])).all()
