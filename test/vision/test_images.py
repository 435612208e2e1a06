"""Bytes to pixels."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import pytest

from magnetosuture_thread.settings.errors import InvalidInputError
from magnetosuture_thread.vision.images import decode_image, unpack_image

BLUE, GREEN, RED = 40, 120, 200
# What a pixel of this colour is in YUV, by ITU-R BT.601 with 16 to 235 for black to white.
Y = round(16 + 0.257 * RED + 0.504 * GREEN + 0.098 * BLUE)
U = round(128 - 0.148 * RED - 0.291 * GREEN + 0.439 * BLUE)
V = round(128 + 0.439 * RED - 0.368 * GREEN - 0.071 * BLUE)
SQUARES = {
    "bgra": [[BLUE, GREEN, RED, 9] * 2] * 2,
    "rgba": [[RED, GREEN, BLUE, 9] * 2] * 2,
    "rgb": [[RED, GREEN, BLUE] * 2] * 2,
    "bgr": [[BLUE, GREEN, RED] * 2] * 2,
    "bayer_rggb": [[RED, GREEN], [GREEN, BLUE]],
    "bayer_bggr": [[BLUE, GREEN], [GREEN, RED]],
    "bayer_gbrg": [[GREEN, BLUE], [RED, GREEN]],
    "bayer_grbg": [[GREEN, RED], [BLUE, GREEN]],
}


OF_8_BITS = {"8UC3": SQUARES["bgr"], "8UC4": SQUARES["bgra"]}
OF_8_BITS |= {"yuv422": [[U, Y, V, Y]] * 2, "yuv422_yuy2": [[Y, U, Y, V]] * 2}
OF_8_BITS |= {"uyvy": OF_8_BITS["yuv422"], "yuyv": OF_8_BITS["yuv422_yuy2"]}
OF_8_BITS |= {"nv12": [[Y, Y], [Y, Y], [U, V]], "nv21": [[Y, Y], [Y, Y], [V, U]]}
CASES = [
    (f"{name}{8 * int(kind[-1])}", square, kind) for name, square in SQUARES.items() for kind in ("u1", "<u2", ">u2")
]
CASES += [(name, square, "u1") for name, square in OF_8_BITS.items()]


@pytest.mark.parametrize(("encoding", "square", "kind"), CASES)
def test_raw_images_of_every_encoding_have_their_colours(encoding: str, square: list[list[int]], kind: str):
    planes = np.vstack([np.tile(plane, (4, 4)) for plane in (square[:2], square[2:]) if plane])
    # 12 of 16 bits: the greatest value becomes 255.
    scale, shown = (1, 1.0) if kind == "u1" else (16, 255.0 / RED)
    rows = (planes * scale).astype(kind).view(np.uint8)
    padded = np.pad(rows, ((0, 0), (0, 6)), constant_values=255)
    image = unpack_image(padded.tobytes(), 8, 8, padded.shape[1], encoding, big_endian=kind[0] == ">")
    assert image.shape == (8, 8, 3)
    assert image.dtype == np.uint8
    np.testing.assert_allclose(image[3:5, 3:5].reshape(-1, 3), [np.multiply((BLUE, GREEN, RED), shown)] * 4, atol=3)


@pytest.mark.parametrize("name", ["mono16", "16UC1"])
def test_pixels_of_16_bits_are_scaled_by_the_greatest(name: str):
    values = np.array([[0, 1000, 4000], [2000, 3000, 4000]], "<u2")
    assert unpack_image(values.tobytes(), 2, 3, 6, name).tolist() == [[0, 64, 255], [128, 191, 255]]
    assert not unpack_image(bytes(12), 2, 3, 6, name).any()
    packed = cv2.imencode(".png", values)[1]
    assert decode_image(packed)[:, :, 1].tolist() == [[0, 64, 255], [128, 191, 255]]


@pytest.mark.parametrize(
    ("height", "width", "step", "encoding", "words"),
    [
        (2, 3, 9, "nv24", "image.encoding: got 'nv24'"),
        (2, 3, 10, "bgr8", "rows of step bytes"),
        (0, 3, 9, "bgr8", "rows of step bytes"),
        (3, 3, 6, "yuyv", "rows of step bytes"),
    ],
)
def test_raw_images_that_do_not_fit_are_refused(height: int, width: int, step: int, encoding: str, words: str):
    with pytest.raises(InvalidInputError, match=words):
        unpack_image(bytes(18), height, width, step, encoding)


def png(width: int, height: int) -> bytes:
    """Return a PNG of black pixels: some kilobytes, whatever its size."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    packer = zlib.compressobj(9)
    rows = b"".join(packer.compress(bytes(1 + (width + 7) // 8)) for _ in range(height)) + packer.flush()
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


@pytest.mark.parametrize(("side", "size"), [(6000, "6000 x 6000 pixels"), (30_000, "900000000 pixels")])
def test_a_picture_of_too_many_pixels_is_refused_before_it_is_decoded(
    side: int, size: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(cv2, "imdecode", lambda *given: pytest.fail("decoded"))
    with pytest.raises(InvalidInputError, match=f"{size}.* at most 25000000 pixels"):
        decode_image(png(side, side))


@pytest.mark.parametrize("ending", [".png", ".jpg", ".bmp", ".webp", ".tif"])
def test_pictures_are_decoded_and_damaged_ones_are_refused(ending: str):
    data = cv2.imencode(ending, np.random.default_rng(1).integers(0, 255, (48, 64, 3), np.uint8))[1]
    assert decode_image(data).shape == (48, 64, 3)
    for end in (0, 7, 14, 21):
        with pytest.raises(InvalidInputError, match="a JPEG or PNG image"):
            decode_image(data[:end])


CODINGS = {
    "usual": [],
    "restart markers": [cv2.IMWRITE_JPEG_RST_INTERVAL, 4],
    "progressive": [cv2.IMWRITE_JPEG_PROGRESSIVE, 1],
}


@pytest.mark.parametrize("coding", CODINGS)
def test_a_jpeg_that_lost_bytes_is_refused_and_one_without_its_end_marker_is_not(coding: str):
    image = cv2.GaussianBlur(np.random.default_rng(2).integers(0, 255, (240, 320, 3), np.uint8), (0, 0), 2.0)
    data = cv2.imencode(".jpg", image, CODINGS[coding])[1].tobytes()
    whole = decode_image(data)
    assert np.abs(whole.astype(int) - image).mean() < 4.0
    assert (decode_image(data[:-2]) == whole).all()
    assert (decode_image(data + bytes(100)) == whole).all()  # as some cameras pad their frames
    begin = data.index(b"\xff\xda") + 20
    for at in np.linspace(begin, len(data) - 520, 12, dtype=int):
        for damaged in (data[:at] + data[at + 512 :], data[:at]):
            with pytest.raises(InvalidInputError, match="damaged"):
                decode_image(damaged)


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
