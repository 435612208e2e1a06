"""Images: from bytes to pixels, what of them is measured on, and samples between pixels.

On masks by the scene:

Needle and thread lie outside of every shape of the scene. With d(p) the distance of a pixel p from the outlines,
positive inside of a shape, and a tolerance t for what the scene's outline and the visible one may differ by (camera
height, parallax, calibration):

    solid:    d > t              no needle, no thread
    outline:  |d| <= t + blur    a dark line may be the thread or the shape's own edge
"""

from __future__ import annotations

import io
import math
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray
from PIL import ExifTags, Image

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.compiled import compiled_inline, compiled_uncounted
from magnetosuture_thread.geometry.obstacles import Disc, Polygon
from magnetosuture_thread.geometry.polyline import Points, arc_lengths, points_at
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.settings.errors import InvalidInputError
from magnetosuture_thread.settings.files import MAX_PIXELS
from magnetosuture_thread.vision.settings import MIN_SIDE_PX

BLUR_PX = 2.0  # beyond the tolerance, up to which an edge still looks like a dark line

CELL_PX = 8  # side of a cell of the grid on which the floor's brightness is known
RIM_PX = 1.0  # by which the rim's blurred edge reaches into the dish
NEXT = np.uint64(1)  # Indices without a sign save compiled code the check for negative ones, which count from the end.

Gray = NDArray[np.uint8]


# Values a pixel and OpenCV's conversion to BGR, None of grey and BGR, by the names of sensor_msgs/image_encodings, and
# nv12 as drivers name it.
ENCODINGS: dict[str, tuple[int, int | None]] = {
    **dict.fromkeys(("yuv422", "uyvy"), (2, cv2.COLOR_YUV2BGR_UYVY)),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), (2, cv2.COLOR_YUV2BGR_YUYV)),
    "nv12": (1, cv2.COLOR_YUV2BGR_NV12),
    "nv21": (1, cv2.COLOR_YUV2BGR_NV21),
}
for _bits in (8, 16):
    ENCODINGS |= {
        **dict.fromkeys((f"mono{_bits}", f"{_bits}UC1"), (1, None)),
        **dict.fromkeys((f"bgr{_bits}", f"{_bits}UC3"), (3, None)),
        **dict.fromkeys((f"bgra{_bits}", f"{_bits}UC4"), (4, cv2.COLOR_BGRA2BGR)),
        f"rgb{_bits}": (3, cv2.COLOR_RGB2BGR),
        f"rgba{_bits}": (4, cv2.COLOR_RGBA2BGR),
        # OpenCV names a pattern by the second and third pixel of its second row.
        f"bayer_rggb{_bits}": (1, cv2.COLOR_BayerBG2BGR),
        f"bayer_bggr{_bits}": (1, cv2.COLOR_BayerRG2BGR),
        f"bayer_gbrg{_bits}": (1, cv2.COLOR_BayerGR2BGR),
        f"bayer_grbg{_bits}": (1, cv2.COLOR_BayerGB2BGR),
    }


@dataclass(frozen=True)
class SceneMask:
    """Where the shapes of a scene are in a frame or in a part of it.

    Attributes:
        depth: distance from the outlines, positive inside of a shape, shape (rows, columns), float32 [px].
        tolerance_px: see the module [px].
        rim: points along the outlines and the index of their shape, shape (m, 3) [px].
        floor_cells: for each cell of the floor's grid the column and row of the nearest one that no shape covers,
            shape (rows, columns, 2), int16.
    """

    depth: NDArray[np.float32]
    tolerance_px: float
    rim: Points
    floor_cells: NDArray[np.int16]

    def part(self, left: int, top: int, right: int, bottom: int) -> SceneMask:
        """Return the mask of a part of the frame; left and top are multiples of `CELL_PX` [px]."""
        cell = CELL_PX
        cells = self.floor_cells[top // cell : -(-bottom // cell), left // cell : -(-right // cell)]
        return replace(
            self,
            depth=self.depth[top:bottom, left:right],
            rim=self.rim - (left, top, 0.0),
            floor_cells=cells - np.array([left // cell, top // cell], np.int16),
        )

    @property
    def band_px(self) -> float:
        """Distance from an outline up to which a dark line may be the shape's own edge [px]."""
        return self.tolerance_px + BLUR_PX

    def show_floor(self, cells: Gray) -> Gray:
        """Return the brightness of cells, of those that a shape covers that of the nearest one that shows the floor."""
        rows, columns = cells.shape
        floor = self.floor_cells[:rows, :columns]
        shown = cv2.remap(cells, floor, np.empty(0), cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(shown, dtype=np.uint8)


def scene_mask(scene: Scene, view: DishView, shape: tuple[int, ...], tolerance: float) -> SceneMask | None:
    """Return the mask of a frame; None for a scene without shapes.

    Args:
        scene: dish and shapes.
        view: where the dish is in the frame.
        shape: rows and columns of the frame.
        tolerance: what the scene's outline and the visible one may differ by [m].
    """
    if not scene.shapes:
        return None
    rows, columns = shape[:2]
    inside, rim = np.zeros((rows, columns), np.uint8), list[Points]()
    for index, geometry in enumerate(scene.obstacles):
        rings = [view.to_pixels(ring) for ring in _outlines(geometry)]
        own = np.zeros_like(inside)  # Shapes may overlap, and even-odd filling of all at once would undo it.
        cv2.fillPoly(own, [np.round(ring * 16.0).astype(np.int32) for ring in rings], 255, cv2.LINE_8, 4)
        cv2.bitwise_or(inside, own, inside)
        for ring in rings:
            closed = np.vstack([ring, ring[:1]])
            points = points_at(closed, np.arange(0.0, arc_lengths(closed)[-1], 4.0))
            rim.append(np.column_stack([points, np.full(len(points), float(index))]))
    # Filling takes every pixel that an edge touches: half a pixel too many, as blur makes a dark shape look too.
    depth = _distance(inside) - _distance(cv2.bitwise_not(inside))
    cells = cv2.resize(inside, (max(2, columns // CELL_PX), max(2, rows // CELL_PX)), interpolation=cv2.INTER_AREA)
    floor_cells = _nearest_uncovered(cells > 0.1 * 255.0)
    return SceneMask(depth, tolerance / view.metres_per_pixel, np.vstack(rim), floor_cells)


def _outlines(geometry: Disc | Polygon) -> list[Points]:
    """Return the rings of a shape, a disc as a polygon, each of shape (m, 2) [m]."""
    if isinstance(geometry, Disc):
        turn = np.linspace(0.0, 2.0 * np.pi, 128, endpoint=False)
        return [np.asarray(geometry.centre) + geometry.radius * np.column_stack([np.cos(turn), np.sin(turn)])]
    return geometry.rings


def _nearest_uncovered(covered: NDArray[np.bool_]) -> NDArray[np.int16]:
    """Return column and row of the nearest uncovered cell to each, its own where all are covered."""
    rows, columns = np.indices(covered.shape).astype(np.int16)
    itself = np.stack([columns, rows], axis=-1)
    if covered.all():
        return itself
    _, labels = cv2.distanceTransformWithLabels(
        covered.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    owner = np.zeros((int(labels.max()) + 1, 2), np.int16)
    owner[labels[~covered]] = itself[~covered]
    return owner[labels]


def _distance(inside: Gray) -> NDArray[np.float32]:
    """Return the distance of each pixel of a mask from its edge, half a pixel from the next one; 0 outside [px]."""
    if inside.all():
        return np.full(inside.shape, 1e4, np.float32)  # px; deeper than any image is wide
    apart = cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(np.maximum(apart - 0.5, 0.0), dtype=np.float32)


@dataclass(frozen=True)
class Wall:
    """The dish's wall in a picture: its centre (u, v) and its radius [px]."""

    centre: tuple[float, float]
    radius: float

    def inside(self, shape: tuple[int, int], depth: float) -> Gray:
        """Return which pixels of a picture lie deeper than a depth inside of the wall [px], 255 there."""
        inside = np.zeros(shape, np.uint8)
        u, v, reach = (round(16.0 * value) for value in (*self.centre, self.radius - depth))
        return np.asarray(cv2.circle(inside, (u, v), reach, 255, -1, cv2.LINE_8, 4), dtype=np.uint8)

    def beyond(self, box: tuple[slice, slice], depth: float) -> NDArray[np.bool_]:
        """Say which pixels of some rows and columns lie farther out than a depth inside of the wall [px]."""
        rows, columns = box
        u = np.arange(columns.start, columns.stop) - self.centre[0]
        v = np.arange(rows.start, rows.stop)[:, None] - self.centre[1]
        return np.asarray(u * u + v * v > (self.radius - depth) ** 2)


@dataclass(frozen=True)
class Layer:
    """One brightness of each pixel, and of the floor behind it, both of shape (rows, columns), uint8."""

    pixels: Gray
    floor: Gray


@dataclass(frozen=True)
class Picture:
    """A frame or a part of it, made ready to measure on.

    Attributes:
        brightest: the greatest of the three colours of each pixel, or their weighted sum. Steel is dark in all of them,
            a coloured thread in some only.
        darkest: the least of them. A thread of any colour is dark in one.
        view: where the dish is, in the picture's pixels.
        wall: of the dish, in the picture's pixels.
        mask: where the scene's shapes are; None if it has none.
        image: as it came, grey or BGR.
    """

    brightest: Layer
    darkest: Layer
    view: DishView
    wall: Wall
    mask: SceneMask | None
    image: np.ndarray

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows, columns = self.brightest.pixels.shape
        return rows, columns


def shrunk(image: np.ndarray, factor: int) -> np.ndarray:
    """Return a frame shrunk by area, whose last rows and columns may be lost."""
    if factor == 1:
        return image
    rows, columns = (size // factor for size in image.shape[:2])
    whole = image[: rows * factor, : columns * factor]
    return np.asarray(cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA))


def prepare(
    image: np.ndarray,
    view: DishView,
    dish_radius: float,
    mask: SceneMask | None = None,
    weights: tuple[float, ...] = (),
) -> Picture:
    """Make an image ready to measure on.

    Args:
        image: shape (rows, columns) or (rows, columns, 3) in BGR order, uint8.
        view: where the dish is in it.
        dish_radius: [m]
        mask: where the scene's shapes are in it; None if there are none.
        weights: of blue, green and red, whose sum is taken for the brightest colour; none: the brightest is.
    """
    wall = Wall(view.centre_px, dish_radius / view.metres_per_pixel)
    places = _floor_places(image.shape[:2], wall)
    if image.ndim == 2:
        # Copied where need be: compiled code is compiled once more for each other layout of memory.
        both = _layer(np.ascontiguousarray(image), places, mask)
        return Picture(both, both, view, wall, mask, image)
    one, two, three = cv2.split(image)
    brightest = cv2.transform(image, np.array([weights])) if weights else cv2.max(cv2.max(one, two), three)
    darkest = cv2.min(cv2.min(one, two), three)
    light, dark = (_layer(np.asarray(pixels), places, mask) for pixels in (brightest, darkest))
    return Picture(light, dark, view, wall, mask, image)


def _floor_places(shape: tuple[int, ...], wall: Wall) -> NDArray[np.float32]:
    """Return for each cell the place (u, v) among the cells where its floor is taken from, shape (rows, columns, 2).

    Near the wall and beyond it, where the floor is mixed with the rim's dark, it is that of the place 40 px inside of
    the wall on the way to the centre.
    """
    rows, columns = (max(2, size // CELL_PX) for size in shape)
    down, right = shape[0] / rows, shape[1] / columns  # px a cell
    u = ((np.arange(columns) + 0.5) * right - 0.5 - wall.centre[0]).astype(np.float32)
    v = ((np.arange(rows) + 0.5) * down - 0.5 - wall.centre[1]).astype(np.float32)[:, None]
    # Not hypot, which takes several times as long.
    share = np.minimum(1.0, max(0.0, wall.radius - 40.0) / np.maximum(np.sqrt(u * u + v * v), 1.0))
    at = np.empty((rows, columns, 2), np.float32)
    at[..., 0] = (share * u + (wall.centre[0] + 0.5)) / right - 0.5
    at[..., 1] = (share * v + (wall.centre[1] + 0.5)) / down - 0.5
    return at


def _layer(pixels: Gray, places: NDArray[np.float32], mask: SceneMask | None) -> Layer:
    """Estimate the floor behind what lies on it.

    The floor is the median over a window that all slender things fill by less than half, so that light that changes
    over the dish doesn't matter. What a shape of the scene covers shows no floor.
    """
    rough = cv2.resize(pixels, places.shape[1::-1], interpolation=cv2.INTER_AREA)
    if mask is not None:
        rough = mask.show_floor(rough)
    floor = cv2.medianBlur(rough, 9)  # cells: wider than a needle, a thread, a speck
    floor = cv2.remap(floor, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return Layer(pixels, np.asarray(cv2.resize(floor, pixels.shape[::-1], interpolation=cv2.INTER_LINEAR)))


def glare_mask(picture: Picture) -> Gray:
    """Return where the lamp is reflected, 255 there."""
    bound = cv2.convertScaleAbs(picture.brightest.floor, alpha=1.07, beta=2.0)  # of the floor's brightness
    bright = cv2.compare(picture.brightest.pixels, bound, cv2.CMP_GT)
    # Most of 5 x 5 pixels are, as of a median, which takes five times as long.
    return np.asarray(cv2.compare(cv2.blur(bright, (5, 5)), 127.0, cv2.CMP_GT))


def image_of(message: Any) -> np.ndarray:
    """Return the image of a sensor_msgs/Image or CompressedImage as BGR or grey array, uint8.

    Raises:
        InvalidInputError: see `unpack_image` and `decode_image`.
    """
    if hasattr(message, "format"):
        return decode_image(message.data)
    size = message.height, message.width, message.step
    return unpack_image(message.data, *size, message.encoding, big_endian=bool(message.is_bigendian))


def decode_image(data: bytes | bytearray | memoryview | np.ndarray) -> np.ndarray:
    """Decode a JPEG, PNG, BMP, TIFF or WebP image to BGR, its pixels as they are stored; 16 bits by `eight_bits`.

    An orientation in its EXIF data is ignored, as in frames of a camera: pixels stay where the sensor has them. Size
    and kind are read from the header before any pixel is decoded: a megabyte may decode to gigabytes. A JPEG of which
    bytes are lost is refused: what follows them is decoded to wrong places. Its end marker may be missing.

    Raises:
        InvalidInputError: the bytes are no image, a damaged one, or one of more than `MAX_PIXELS`.
    """
    buffer = np.frombuffer(data, dtype=np.uint8)
    width, height = _size_of(buffer)
    if width * height > MAX_PIXELS:
        raise InvalidInputError("image.size", f"{width} x {height} pixels", f"at most {MAX_PIXELS} pixels")
    image = None
    with suppress(cv2.error, ValueError):  # some headers promise more than can be made
        if width and buffer[:2].tobytes() == b"\xff\xd8":  # a JPEG, of which OpenCV only prints that bytes are missing
            image = simplejpeg.decode_jpeg(buffer.tobytes() + b"\xff\xd9", "BGR")  # an end marker more does no harm
        elif width:
            flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
            image = cv2.imdecode(buffer, flags)
    if image is None or image.dtype not in (np.uint8, np.uint16):
        raise InvalidInputError("image.data", "damaged bytes", "a JPEG or PNG image, or BMP, TIFF, WebP, as a whole")
    return eight_bits(image)


def upright(image: np.ndarray, data: bytes) -> np.ndarray:
    """Return an image turned as its EXIF data say, as every viewer shows it; of a camera's frame they say nothing.

    Args:
        image: as it was decoded.
        data: the bytes of the picture file, which can be decoded.
    """
    turns = {3: cv2.ROTATE_180, 6: cv2.ROTATE_90_CLOCKWISE, 8: cv2.ROTATE_90_COUNTERCLOCKWISE}
    turn = turns.get(Image.open(io.BytesIO(data)).getexif().get(ExifTags.Base.Orientation, 1))
    return image if turn is None else np.asarray(cv2.rotate(image, turn))


def eight_bits(image: np.ndarray) -> np.ndarray:
    """Return pixels of 16 bits scaled by the greatest, as sensors of 10 or 12 bits use a part of them; others as is."""
    if image.dtype == np.uint8:
        return image
    return np.asarray(cv2.convertScaleAbs(image, alpha=255.0 / max(1, int(image.max()))))


def _size_of(buffer: np.ndarray) -> tuple[int, int]:
    """Return width and height by a picture's header, 0 and 0 where the bytes are none."""
    try:
        with Image.open(io.BytesIO(buffer.tobytes()), formats=("JPEG", "PNG", "BMP", "TIFF", "WEBP")) as picture:
            return picture.size
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:  # far more pixels than we take
        raise InvalidInputError("image.size", str(error), f"at most {MAX_PIXELS} pixels") from None
    except Exception:  # a damaged picture raises whatever its reader did not expect
        return 0, 0


def unpack_image(
    data: bytes | bytearray | memoryview | np.ndarray,
    height: int,
    width: int,
    step: int,
    encoding: str,
    *,
    big_endian: bool = False,
) -> np.ndarray:
    """Return a raw image as BGR or grey array, uint8; 16 bits by `eight_bits`.

    Args:
        data: rows of `step` bytes each; of nv12 and nv21 half as many rows of colours follow those of brightness.
        height: rows.
        width: columns.
        step: bytes in a row, padding included.
        encoding: one of `ENCODINGS`.
        big_endian: whether the high byte of 16 bits comes first.

    Raises:
        InvalidInputError: the encoding is another, or the sizes don't fit the data.
    """
    if encoding not in ENCODINGS:
        expected = "one that OpenCV converts to BGR, as bgr8, mono16, bayer_rggb8, yuv422 or nv12"
        raise InvalidInputError("image.encoding", repr(encoding), expected)
    (values, conversion), is_wide = ENCODINGS[encoding], "16" in encoding
    pixel, planar = values * (1 + is_wide), encoding.startswith("nv")
    buffer = np.frombuffer(data, dtype=np.uint8)
    rows = height * 3 // 2 if planar else height
    whole = not (planar and height % 2) and not ((planar or values == 2) and width % 2)  # colours of two pixels
    if height < 1 or width < 1 or step < width * pixel or buffer.size != rows * step or not whole:
        sizes = f"{buffer.size} bytes for {width} x {height}, step {step}"
        expected = f"{rows} rows of step bytes, {pixel} for each of {width} pixels"
        raise InvalidInputError("image.step", sizes, expected)
    pixels = buffer.reshape(rows, step)[:, : width * pixel]
    if is_wide:
        pixels = np.ascontiguousarray(pixels).view(">u2" if big_endian else "<u2").astype(np.uint16, copy=False)
    if values > 1:
        pixels = pixels.reshape(height, width, values)
    return eight_bits(pixels if conversion is None else np.asarray(cv2.cvtColor(pixels, conversion)))


def check_image(image: np.ndarray) -> None:
    """Raise `InvalidInputError` unless an array is an image to look at."""
    if image.dtype != np.uint8 or image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
        raise InvalidInputError("image", f"{image.dtype} of shape {image.shape}", "8-bit grey or BGR pixels")
    if min(image.shape[:2]) < MIN_SIDE_PX:
        expected = f"at least {MIN_SIDE_PX} x {MIN_SIDE_PX} pixels"
        raise InvalidInputError("image", f"{image.shape[1]} x {image.shape[0]} pixels", expected)


def measured_channel(image: np.ndarray) -> np.ndarray:
    """Return the channel to measure on: green, which a colour sensor samples twice as densely."""
    return np.ascontiguousarray(image if image.ndim == 2 else cv2.extractChannel(image, 1))


def nearest(image: NDArray[Any], points: Points) -> NDArray[Any]:
    """Return an image at the pixels nearest to points of shape (..., 2); outside, to those of its border."""
    rows, columns = image.shape
    at = np.rint(points).astype(np.intp)
    # numpy's clip takes ten times as long for few of them.
    row, column = np.minimum(np.maximum(at[..., 1], 0), rows - 1), np.minimum(np.maximum(at[..., 0], 0), columns - 1)
    return np.asarray(image[row, column])


def greatest_near(image: NDArray[Any], points: Points, reach: int) -> NDArray[Any]:
    """Return the greatest value of an image up to a reach [px] to all sides of points, shape (m,)."""
    return np.asarray(nearest(image, np.rint(points)[:, None] + _square(reach)).max(axis=1))


@cache
def _square(reach: int) -> Points:
    """Return the pixels of a square around a place, shape (m, 2) [px]."""
    return np.indices((2 * reach + 1, 2 * reach + 1)).reshape(2, -1).T - float(reach)


def middle(values: np.ndarray) -> float:
    """Return the median of values of any shape, the upper one of two; numpy's own takes ten times as long."""
    ordered = values.astype(np.result_type(values, np.float32)).ravel()  # numpy sorts bytes four times as slowly
    half = ordered.size // 2
    ordered.partition(half)
    return float(ordered[half])


def median(values: NDArray[Any], axis: int = -1) -> NDArray[Any]:
    """Return the medians of finite floating-point values along an axis; numpy's own takes four times as long."""
    count = values.shape[axis]
    low, high = (count - 1) // 2, count // 2
    ordered = np.partition(values, (low, high), axis)
    return np.asarray(0.5 * (ordered.take(low, axis) + ordered.take(high, axis)))


def runs(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return first index and the one after the last of each run of true flags."""
    padded = np.zeros(len(flags) + 2, np.bool_)
    padded[1:-1] = flags
    edges = np.flatnonzero(padded[1:] != padded[:-1]).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def sampled(image: NDArray[Any], points: Points) -> NDArray[np.float64]:
    """Return an image at points of shape (..., 2), bilinear; outside, at the nearest point of its border.

    Its shape is (...), for an image with colours (..., colours).
    """
    at, colours = np.ascontiguousarray(points).reshape(-1, 2), image if image.ndim == 3 else image[..., None]
    if not colours.flags.c_contiguous:  # Of a part of a frame no more is copied than the points need.
        corner = np.minimum(np.maximum(at.min(axis=0), 0.0), np.array(image.shape[1::-1]) - 2.0).astype(int)
        (left, top), (right, bottom) = corner, np.maximum(at.max(axis=0), corner).astype(int) + 2
        colours, at = np.ascontiguousarray(colours[top:bottom, left:right]), at - corner
    values = np.empty((*points.shape[:-1], colours.shape[2]))
    sample_all(colours, at, values.reshape(-1, colours.shape[2]))
    return values if image.ndim == 3 else values[..., 0]


@compiled_inline
def sample(image, u, v):
    """Return an image at a point, bilinear; 0 outside."""
    if not (0.0 <= u < image.shape[1] - 1 and 0.0 <= v < image.shape[0] - 1):
        return 0.0
    column, row = int(u), int(v)
    x, y = u - column, v - row
    left, above = np.uint64(column), np.uint64(row)
    upper = image[above, left] * (1.0 - x) + image[above, left + NEXT] * x
    lower = image[above + NEXT, left] * (1.0 - x) + image[above + NEXT, left + NEXT] * x
    return upper * (1.0 - y) + lower * y


@compiled_inline
def within(image, u, v):
    """Return an image at a point, bilinear; outside, at the nearest point of its border."""
    u = min(max(u, 0.0), image.shape[1] - 1.001)
    v = min(max(v, 0.0), image.shape[0] - 1.001)
    return sample(image, u, v)


@compiled_uncounted
def sample_all(image, points, values):
    """Fill in an image with n colours at points, shape (m, 2), its values of shape (m, n); see `within`."""
    for colour in range(image.shape[2]):
        plane = image[:, :, colour]
        for index in range(len(points)):
            values[index, colour] = within(plane, points[index, 0], points[index, 1])


@compiled_uncounted
def sample_across(image, points, tangents, aside, values):
    """Fill in an image at distances aside of points, shape (m, n); see `within`."""
    for row in range(len(points)):
        u, v, along, down = points[row, 0], points[row, 1], tangents[row, 0], tangents[row, 1]
        for column in range(len(aside)):
            values[row, column] = within(image, u - aside[column] * down, v + aside[column] * along)


@compiled_uncounted
def straighten(gray, start, along, aside, strip):
    """Fill a strip with the image along an arc; see `Arc.at`.

    Args:
        gray: shape (rows, columns), uint8.
        start: u, v, angle and curvature of the arc [px, px, rad, 1/px].
        along: lengths along the arc, shape (n,) [px].
        aside: distances aside of it, shape (m,) [px].
        strip: filled, shape (n, m).
    """
    u, v, angle, curvature = start
    for row in range(len(along)):
        s = along[row]
        half = 0.5 * curvature * s
        chord = s if abs(half) < 1e-9 else s * math.sin(half) / half
        x, y = u + chord * math.cos(angle + half), v + chord * math.sin(angle + half)
        across, down = -math.sin(angle + 2.0 * half), math.cos(angle + 2.0 * half)
        for column in range(len(aside)):
            strip[row, column] = within(gray, x + aside[column] * across, y + aside[column] * down)
