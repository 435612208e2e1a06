"""Bytes to pixels."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import pytest

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.vision.image_header import ImageHeader, image_header
from magnetosuture_thread.vision.images import (
    FLOOR_DEPTH_PX,
    Layer,
    Wall,
    decode_image,
    glare_mask,
    prepare,
    unpack_image,
)
from magnetosuture_thread.vision.needle.arc import Arc
from magnetosuture_thread.vision.sampling import median_of_windows, straighten, straighten_both


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
    assert np.abs(picture.brightest.floor.astype(float) - floor[::2, ::2]).max() < 6.0
    assert not glare_mask(picture).any()
    gray[40:60, 100:120] = 250
    assert glare_mask(prepare(gray, 2))[22:28, 52:58].all()


def png(width: int, height: int) -> bytes:
    """Return a PNG of black pixels: some kilobytes, whatever its size."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    packer = zlib.compressobj(9)
    rows = b"".join(packer.compress(bytes(1 + (width + 7) // 8)) for _ in range(height)) + packer.flush()
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def test_a_picture_of_too_many_pixels_is_refused_before_it_is_decoded(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(cv2, "imdecode", lambda *given: pytest.fail("decoded"))
    with pytest.raises(InvalidInputError, match="30000 x 30000 pixels, expected at most"):
        decode_image(png(30_000, 30_000))


@pytest.mark.parametrize("kind", [0xC4, 0xCC, 0xDB])
def test_tables_before_the_size_of_a_jpeg_are_skipped(kind: int):
    data = cv2.imencode(".jpg", np.zeros((48, 64, 3), np.uint8))[1].tobytes()
    table = struct.pack(">BBH", 0xFF, kind, 19) + bytes(range(1, 18))
    assert image_header(data[:2] + table + data[2:]) == ImageHeader(64, 48)


@pytest.mark.parametrize("ending", [".png", ".jpg", ".bmp", ".webp", ".tif"])
def test_size_and_orientation_are_read_from_the_header(ending: str):
    image = np.random.default_rng(1).integers(0, 255, (48, 64, 3), np.uint8)
    done, data = cv2.imencode(ending, image)
    assert done
    assert image_header(data.tobytes()) == ImageHeader(64, 48)
    assert decode_image(data).shape == (48, 64, 3)
    for end in range(0, len(data), 7):
        image_header(data[:end].tobytes())


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
    assert image_header(turned) == ImageHeader(64, 48, orientation)
    assert (decode_image(turned) == decode_image(cv2.imencode(".jpg", image)[1])).all()


@pytest.mark.parametrize("shape", [(60, 80), (9, 5), (2, 2)])
@pytest.mark.parametrize("greatest", [255, 3])
def test_median_of_windows_is_opencvs(shape: tuple[int, int], greatest: int):
    image = np.random.default_rng(5).integers(0, greatest, shape, np.uint8, endpoint=True)
    result = np.empty_like(image)
    median_of_windows(image, 4, result)
    np.testing.assert_array_equal(result, cv2.medianBlur(image, 9))


def slanted(rows: int, columns: int) -> np.ndarray:
    """Return an image 1 + 2 u + 3 v, which is the same between its pixels."""
    return (1.0 + 2.0 * np.arange(columns) + 3.0 * np.arange(rows)[:, None]).astype(np.uint8)


@pytest.mark.parametrize("curvature", [0.0, 0.03, -0.02])
def test_a_strip_along_an_arc_is_the_image_there_and_beyond_its_border_the_nearest_pixels(curvature: float):
    image, start = slanted(40, 50), (20.0, 15.0, 0.4, curvature)
    along, aside = np.arange(-6.0, 51.0), np.linspace(-25.0, 25.0, 11)
    arc = Arc(np.array(start[:2]), *start[2:])
    at = np.stack([arc.at(along, each) for each in aside], axis=1)
    expected = 1.0 + at.clip(0.0, (49.0, 39.0)) @ (2.0, 3.0)
    strip, other = np.empty(expected.shape), np.empty(expected.shape)
    straighten(image, start, along, aside, strip)
    np.testing.assert_allclose(strip, expected, atol=0.01)
    exact = image.astype(np.float32)
    straighten_both(exact, 2.0 * exact, start, along[0], aside, strip, other)
    np.testing.assert_allclose(strip, expected, atol=0.01)
    np.testing.assert_allclose(other, 2.0 * expected, atol=0.02)


@pytest.mark.parametrize("factor", [1, 2])
def test_the_floor_beyond_the_wall_is_the_one_that_lies_towards_the_centre(factor: int):
    """The pixel i of a shrunk image has its middle at factor i + (factor - 1) / 2."""
    u, v = (factor * np.arange(side // factor) + 0.5 * (factor - 1) for side in (50, 40))
    floor = (10.0 + 2.0 * u + 2.0 * v[:, None]).astype(np.uint8)
    wall, box = Wall((24.0, 19.0), FLOOR_DEPTH_PX + 15.0), (slice(3, 37), slice(5, 45))
    offset = np.stack(np.meshgrid(np.arange(5, 45), np.arange(3, 37)), axis=-1) - wall.centre
    away = np.linalg.norm(offset, axis=-1)
    at = offset * np.minimum(1.0, 15.0 / np.maximum(away, 1.0))[..., None] + wall.centre
    found = wall.floor(Layer(floor, floor, floor), factor, box)
    assert np.abs(found - (10.0 + 2.0 * at.sum(axis=-1))).max() < 0.51
    np.testing.assert_allclose(wall.distances(box), away, rtol=1e-5)
