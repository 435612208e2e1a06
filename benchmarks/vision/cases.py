"""The classes of frames: what is varied in each, and how its frames are rendered from the simulated rig's camera.

Every frame is simulated. What the camera cannot draw (a tilted view, a lens's distortion, a rod in place of the needle)
is made from its pictures.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.rig.camera.dish_camera import STEEL_BGR, Cover, DishCamera
from magnetosuture_thread.rig.camera.scene import CameraScene, Lighting

Image = NDArray[np.uint8]
Random = np.random.Generator
Bgr = tuple[float, float, float]

DISH = 0.035  # inner diameter [m]
THREAD_LENGTH = 0.019  # m
USUAL_SIZE, USUAL_SCALE = (640, 480), 8e-5  # px, m a pixel
WITHIN = 0.0150  # of the dish's centre, in which needle and thread lie [m]
CAMERA_DISTANCE = 0.3  # m, of a tilted camera
CAMERAS = 3  # of a class
BORDER_PX = 8.0  # of the image, off which needle and thread lie
NOWHERE = np.array([0.5, 0.5])  # m, where a needle that is not to be seen lies
THREADS: dict[str, Bgr] = {
    "violet": (132.0, 78.0, 100.0),
    "black": (40.0, 38.0, 36.0),
    "white": (246.0, 246.0, 246.0),
    "undyed": (205.0, 222.0, 232.0),
}
SKIN: Bgr = (120.0, 150.0, 200.0)
SILICONE: Bgr = (168.0, 176.0, 205.0)
INK: Bgr = (60.0, 60.0, 60.0)


@dataclass(frozen=True)
class Frame:
    """A rendered frame and its ground truth, in the dish frame.

    Attributes:
        image: BGR, shape (height, width, 3).
        scale: of the ideal camera [m a pixel].
        tail: of the needle, shape (2,) [m].
        heading: of the needle at its tail [rad].
        needle_length: in m.
        needle_width: in m.
        thread: centreline from the tail on, shape (m, 2) [m].
        visible: which of its points nothing covers, shape (m,).
        thread_width: as it is drawn [m].
    """

    image: Image
    scale: float
    tail: Points
    heading: float
    needle_length: float
    needle_width: float
    thread: Points
    visible: NDArray[np.bool_]
    thread_width: float


@dataclass(frozen=True)
class FrameClass:
    """What the frames of a class have in common.

    Attributes:
        size: of the image [px].
        needle_length: in m.
        needle_width: in m.
        thread: name of its colour, see `THREADS`.
        thread_px: its width; that of a thread of 60 um if 0 [px].
        fold: least and greatest angle between the thread where it leaves and the needle's heading [rad].
        crossing: whether the thread crosses itself.
        over_needle: whether the thread runs under its own needle farther on.
        lighting: changes it, by random.
        covers: what lies above, made of random, tail, heading and thread.
        after: changes the picture, made of random and the ideal view.
        shift: of the dish up or down from the image's centre, as a share of its height.
        blunt: whether a rod of one width takes the needle's place.
    """

    size: tuple[int, int] = USUAL_SIZE
    needle_length: float = 0.007
    needle_width: float = 0.0004
    thread: str = "violet"
    thread_px: float = 0.0
    fold: tuple[float, float] = (0.6 * math.pi, math.pi)
    crossing: bool = False
    over_needle: bool = False
    lighting: Callable[[Random], Lighting] = field(default=lambda random: _usual_light(random))
    covers: Callable[[Random, Points, float, Points], tuple[Cover, ...]] = field(default=lambda *given: ())
    after: Callable[[Image, Random, DishView], Image] = field(default=lambda image, random, view: image)
    shift: float = 0.0
    blunt: bool = False


def render(kind: FrameClass, random: Random) -> Frame:
    """Render a frame of a class."""
    scale = USUAL_SCALE * USUAL_SIZE[0] / kind.size[0]
    # A camera takes as long to make as many frames: a class has a few.
    variant = int(random.integers(CAMERAS))
    own = np.random.default_rng(variant)
    shift = np.array([own.uniform(-4.0, 4.0), own.choice((-1.0, 1.0)) * kind.shift * kind.size[1]])
    middle = 0.5 * np.array(kind.size) + shift
    view = DishView((float(middle[0]), float(middle[1])), scale)
    for _ in range(100):
        tail, heading = _pose(kind, random)
        thread = _thread(kind, random, tail, heading)
        pixels = view.to_pixels(np.vstack([thread, tail + kind.needle_length * _unit(heading)]))
        if np.all(pixels > BORDER_PX) and np.all(pixels < np.array(kind.size) - 1.0 - BORDER_PX):
            break
    covers = kind.covers(random, tail, heading, thread)
    width = (kind.thread_px * scale / 1.3) or 60e-6  # the liquid's edge makes it look 1.3 times as wide
    scene = CameraScene(
        dish_diameter=DISH,
        needle_length=kind.needle_length,
        needle_width=kind.needle_width,
        thread_diameter=width,
        thread_bgr=THREADS[kind.thread],
    )
    camera = _camera(scene, view, kind.size, variant, kind.lighting(own))
    above = (*covers, *((needle_cover(tail, heading, kind.needle_length, kind.needle_width, 1.0),) * kind.blunt))
    image = camera.render(NOWHERE if kind.blunt else tail, heading, thread, above)
    image = kind.after(image, random, view)
    visible = np.array([not any(_covers(cover, point) for cover in covers) for point in thread])
    return Frame(
        image, scale, tail, heading, kind.needle_length, kind.needle_width, thread, visible, max(1.3 * width, scale)
    )


def _pose(kind: FrameClass, random: Random) -> tuple[Points, float]:
    while True:
        tail, heading = random.uniform(-WITHIN, WITHIN, 2), random.uniform(-math.pi, math.pi)
        tip = tail + kind.needle_length * _unit(heading)
        if max(np.hypot(*tail), np.hypot(*tip)) < WITHIN:
            return tail, float(heading)


def _unit(angle: float) -> Points:
    return np.array([math.cos(angle), math.sin(angle)])


def _thread(kind: FrameClass, random: Random, tail: Points, heading: float) -> Points:
    """Return a thread that leaves the tail by the class's fold and winds on within the dish, shape (m, 2)."""
    steps = 240
    s = np.linspace(0.0, THREAD_LENGTH, steps)
    best, least = np.empty((0, 2)), math.inf
    for _ in range(400):
        turned = heading + random.choice((-1.0, 1.0)) * random.uniform(*kind.fold)
        bends = random.uniform(-250.0, 250.0, 6)
        bends[0] = random.uniform(-40.0, 40.0)  # so that it leaves as the fold says
        if kind.crossing:
            bends[2:5] = random.choice((-1.0, 1.0)) * random.uniform(480.0, 620.0)
        angle = turned + np.cumsum(np.interp(s, np.linspace(0.0, THREAD_LENGTH, 6), bends)) * THREAD_LENGTH / steps
        moves = THREAD_LENGTH / steps * np.column_stack([np.cos(angle), np.sin(angle)])
        line = np.vstack([tail, tail + np.cumsum(moves, axis=0)])
        if kind.over_needle:
            line = _across_needle(line, tail, heading, kind.needle_length, random)
        reach = float(np.hypot(*line.T).max())
        if reach < least:
            best, least = line, reach
        if reach < WITHIN + 0.0015 and _crossings(line) == int(kind.crossing):
            return line
    return best


def _across_needle(line: Points, tail: Points, heading: float, length: float, random: Random) -> Points:
    """Return a thread that loops around from the tail and crosses the needle's body."""
    side = random.choice((-1.0, 1.0))
    along = _unit(heading)
    aside = side * np.array([-along[1], along[0]])
    through = tail + random.uniform(0.25, 0.75) * length * along
    reach = random.uniform(0.0025, 0.004)
    knots = np.array(
        [
            tail,
            tail - reach * along + 0.4 * reach * aside,
            tail + 1.1 * reach * aside,
            through + 0.5 * reach * aside,
            through - 0.5 * reach * aside,
            through - 1.6 * reach * aside,
            through - 2.4 * reach * aside + reach * along,
        ]
    )
    dense = [knots[0]]
    padded = np.vstack([2 * knots[0] - knots[1], knots, 2 * knots[-1] - knots[-2]])
    for k in range(1, len(padded) - 2):  # Catmull-Rom
        p0, p1, p2, p3 = padded[k - 1 : k + 3]
        for t in np.linspace(0.0, 1.0, 30)[1:]:
            value = 2 * p1 + (p2 - p0) * t + (2 * p0 - 5 * p1 + 4 * p2 - p3) * t**2 + (3 * p1 - p0 - 3 * p2 + p3) * t**3
            dense.append(0.5 * value)
    return np.array(dense)


def _crossings(line: Points) -> int:
    """Return whether a line crosses itself, 0 or 1."""
    coarse = line[::4]
    first, second = coarse[:-1], coarse[1:]
    step = second - first

    def turned(a: Points, b: Points) -> NDArray[np.float64]:
        return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])

    between = first[None, :] - first[:, None]
    base = turned(step[:, None], step[None, :])
    with np.errstate(divide="ignore", invalid="ignore"):
        t, u = turned(between, step[None, :]) / base, turned(between, step[:, None]) / base
    meets = (t > 0.0) & (t < 1.0) & (u > 0.0) & (u < 1.0)
    apart = np.abs(np.arange(len(step))[:, None] - np.arange(len(step))[None, :]) > 2
    return int(bool((meets & apart).any()))


@lru_cache(maxsize=4)  # one holds some 50 MB
def _camera(scene: CameraScene, view: DishView, size: tuple[int, int], seed: int, light: Lighting) -> DishCamera:
    return DishCamera(scene, view, size, seed=seed, lighting=light)


def _usual_light(random: Random) -> Lighting:
    return Lighting(
        gain=float(random.uniform(0.75, 1.1)),
        slope=float(random.uniform(-2.0, 2.0)),
        noise=float(random.uniform(0.5, 1.5)),
    )


def needle_cover(tail: Points, heading: float, length: float, width: float, tip_share: float = 0.12) -> Cover:
    """Return something that looks like a needle, or with a `tip_share` of 1 like a rod."""
    along = _unit(heading)
    aside = 0.5 * width * np.array([-along[1], along[0]])
    shoulder, tip = tail + 0.8 * length * along, tail + length * along
    outline = [tail + aside, shoulder + aside, tip + tip_share * aside, tip - tip_share * aside, shoulder - aside]
    return Cover(np.array([*outline, tail - aside]), STEEL_BGR, blur_px=0.4)


def _covers(cover: Cover, point: Points) -> bool:
    outline = np.asarray(1e6 * cover.outline, dtype=np.float32)
    return cv2.pointPolygonTest(outline, (float(1e6 * point[0]), float(1e6 * point[1])), False) >= 0


def _bar(random: Random, tail: Points, heading: float, thread: Points) -> tuple[Cover, ...]:
    """Return an instrument over the thread, 1.5 to 10 mm wide along it, and off the needle."""
    width = random.uniform(0.0015, 0.010)
    s = np.linspace(0.0, THREAD_LENGTH, len(thread))
    at = int(np.searchsorted(s, random.uniform(0.002 + 0.5 * width, THREAD_LENGTH - 0.002 - 0.3 * width)))
    at = min(max(at, 1), len(thread) - 2)
    along = thread[at + 1] - thread[at - 1]
    along /= np.hypot(*along)
    aside = np.array([-along[1], along[0]])
    half, long = 0.5 * width * along, 0.0014 * aside
    corners = [thread[at] - half - long, thread[at] + half - long, thread[at] + half + long, thread[at] - half + long]
    cover = Cover(np.array(corners), SILICONE)
    body = tail + np.linspace(0.0, 0.007, 15)[:, None] * _unit(heading)
    return () if any(_covers(cover, point) for point in body) else (cover,)


def _second_needle(random: Random, tail: Points, heading: float, thread: Points) -> tuple[Cover, ...]:
    own = tail + 0.0035 * _unit(heading)
    for _ in range(200):
        other, turned = random.uniform(-0.011, 0.011, 2), random.uniform(-math.pi, math.pi)
        cover = needle_cover(other, turned, 0.007, 0.0004)
        middle = cover.outline.mean(axis=0)
        if np.hypot(*(middle - own)) > 0.008 and np.hypot(*(thread - middle).T).min() > 0.0042:
            return (cover,)
    return ()


def _decoy(random: Random, tail: Points, heading: float, thread: Points) -> tuple[Cover, ...]:
    """Return a second needle, and glare over a part of the real one."""
    turn = np.linspace(0.0, 2.0 * math.pi, 40, endpoint=False)
    place = tail + random.uniform(0.0005, 0.0065) * _unit(heading)
    outline = place + random.uniform(0.0006, 0.0015) * np.column_stack([np.cos(turn), np.sin(turn)])
    return (*_second_needle(random, tail, heading, thread), Cover(outline, (252.0, 252.0, 252.0)))


def _hand(random: Random, tail: Points, heading: float, thread: Points) -> tuple[Cover, ...]:
    """Return a hand that reaches in from a side and ends off needle and thread."""
    points = np.vstack([tail, thread])
    for _ in range(100):
        angle = random.uniform(-math.pi, math.pi)
        end = random.uniform(0.006, 0.015) * _unit(angle)
        away = _unit(angle)
        across = 0.5 * random.uniform(0.004, 0.012) * np.array([-away[1], away[0]])
        cover = Cover(
            np.array([end - across, end + across, end + across + 0.05 * away, end - across + 0.05 * away]), SKIN
        )
        near = (points - end) @ away
        if not ((near > -0.002) & (np.abs((points - end) @ across) < 2.0 * across @ across)).any():
            return (cover,)
    return ()


def _drawn_path(image: Image, random: Random, view: DishView) -> Image:
    """Draw a path into the dish, as laboratories do for a needle to follow."""
    result = image.copy()
    a, b = random.uniform(0.006, 0.010, 2)
    turn = np.linspace(0.0, 2.0 * math.pi, 200)
    line = view.to_pixels(np.column_stack([a * np.cos(turn), b * np.sin(2.0 * turn)]))
    cv2.polylines(result, [np.round(16 * line).astype(np.int32)], True, INK, 2, cv2.LINE_AA, 4)
    return np.asarray(cv2.addWeighted(result, 0.6, image, 0.4, 0.0), dtype=np.uint8)


def tilted(degrees: float) -> Callable[[Image, Random, DishView], Image]:
    """Return what shows a picture as a pinhole camera sees it that looks at the dish's centre from a slope."""

    def tilt(image: Image, random: Random, view: DishView) -> Image:
        axis, slope = random.uniform(-math.pi, math.pi), math.radians(degrees)
        turn, _ = cv2.Rodrigues(slope * np.array([[math.cos(axis)], [math.sin(axis)], [0.0]]))
        camera = view.intrinsics(CAMERA_DISTANCE)
        plane = np.column_stack([turn[:, 0], turn[:, 1], [0.0, 0.0, CAMERA_DISTANCE]])
        u, v = view.centre_px
        to_plane = view.metres_per_pixel * np.array(
            [[1.0, 0.0, -u], [0.0, 1.0, -v], [0.0, 0.0, 1.0 / view.metres_per_pixel]]
        )
        warp = camera @ plane @ to_plane
        size = (image.shape[1], image.shape[0])
        return np.asarray(
            cv2.warpPerspective(image, warp, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE),
            dtype=np.uint8,
        )

    return tilt


def _distorted(image: Image, random: Random, view: DishView) -> Image:
    """Return a picture as a lens with up to 3 % of barrel or pincushion distortion at the rim draws it."""
    share, radius = random.uniform(-0.03, 0.03), 0.5 * DISH / view.metres_per_pixel
    v, u = np.mgrid[: image.shape[0], : image.shape[1]].astype(np.float32)
    across, down = u - view.centre_px[0], v - view.centre_px[1]
    factor = 1.0 + share * ((across**2 + down**2) / radius**2 - 1.0)
    at_u, at_v = (
        (across * factor + view.centre_px[0]).astype(np.float32),
        (down * factor + view.centre_px[1]).astype(np.float32),
    )
    return np.asarray(cv2.remap(image, at_u, at_v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), dtype=np.uint8)


def _inverted(image: Image, random: Random, view: DishView) -> Image:
    return np.asarray(255 - image, dtype=np.uint8)


def _degrees(low: float, high: float) -> tuple[float, float]:
    return math.radians(low), math.radians(high)


def _classes() -> dict[str, FrameClass]:
    usual = FrameClass()
    short = FrameClass(needle_length=0.0025, needle_width=0.0003)
    found = {"usual": usual, "usual_2.5mm": short}
    for low, high in ((0, 4), (4, 15), (15, 26), (26, 50)):
        for name, kind in (("2.5mm", short), ("7mm", usual)):
            found[f"fold_{low:02}_{high:02}_{name}"] = replace(kind, fold=_degrees(low, high))
    found["crossing"] = replace(usual, crossing=True)
    found["over_needle"] = replace(usual, over_needle=True)
    for size in ((320, 240), (1280, 960), (1920, 1440)):
        found[f"width_{size[0]}"] = replace(usual, size=size)
    for colour in THREADS:
        for size in ((640, 480), (1920, 1440)):
            for width in (0.75, 1.5, 2.0, 4.0):
                found[f"{colour}_{width:g}px_at_{size[0]}"] = replace(usual, thread=colour, thread_px=width, size=size)
    for width in (6.0, 12.0):
        found[f"thick_{width:g}px"] = replace(usual, thread_px=width)
    found["cover"] = replace(usual, covers=_bar)
    found["second_needle"] = replace(usual, covers=_second_needle)
    found["decoy_and_glare"] = replace(usual, covers=_decoy)
    found["hand"] = replace(usual, covers=_hand)
    for degrees in (3, 6, 10):
        found[f"tilt_{degrees:02}"] = replace(usual, after=tilted(degrees))
    found["distortion"] = replace(usual, after=_distorted)
    found["dish_cut"] = replace(usual, shift=0.2)
    found["saturated"] = replace(
        usual, lighting=lambda random: Lighting(gain=float(random.uniform(1.2, 1.4)), glare=1.5)
    )
    found["dark_field"] = replace(usual, after=_inverted)
    found["rod"] = replace(usual, blunt=True)
    found["drawn_path"] = replace(usual, after=_drawn_path)
    return found


CLASSES = _classes()
