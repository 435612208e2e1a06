"""Drawn photographs of petri dishes as people take them, whose ellipse is known, and how well the dish is found."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.rig.camera import encode_jpeg
from magnetosuture_thread.vision.dish import FoundDish, see_dish
from magnetosuture_thread.vision.settings import VisionTrackerSettings

Random = np.random.Generator
Image = NDArray[np.uint8]
Plane = NDArray[np.float32]

DIAMETER = 0.09  # m; of a usual dish
WALL = 0.3  # height of the wall, in radii
RIGHT = 0.04  # of the radius, that the ellipse may be off the wall's at the floor or at the top
FLOORS: dict[str, tuple[float, float, float] | None] = {
    "clear": None,
    "blood": (38.0, 28.0, 120.0),
    "yellow": (110.0, 190.0, 215.0),
    "dark": (45.0, 50.0, 45.0),
    "blue": (170.0, 120.0, 60.0),
}
GROUNDS = {  # colour, depth of the grain, and its length over its width
    "wood": ((90, 130, 175), 16.0, 12.0),
    "cloth": ((28, 28, 30), 5.0, 1.0),
    "light_box": ((252, 253, 252), 2.0, 1.0),
    "paper": ((215, 220, 222), 3.0, 1.0),
    "bench": ((150, 155, 150), 10.0, 1.0),
    "steel": ((130, 132, 135), 9.0, 25.0),
}
SKIN = (120.0, 150.0, 205.0)
OPACITY = 0.9  # of what is in a dish


@dataclass(frozen=True)
class Photograph:
    """A drawn photograph.

    Attributes:
        image: BGR.
        floor: points of the wall's inner edge at the floor, shape (n, 2) [px].
        top: the same at its top.
    """

    image: Image
    floor: NDArray[np.float64]
    top: NDArray[np.float64]


@dataclass(frozen=True)
class _Camera:
    """A pinhole camera over the origin of the table, lengths in radii of the dish."""

    size: tuple[int, int]
    focal: float
    distance: float
    turn: NDArray[np.float64]
    middle: tuple[float, float]

    def pixels(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return points of shape (n, 3), z up, in pixels."""
        seen = points * (1.0, 1.0, -1.0) @ self.turn.T + (0.0, 0.0, self.distance)
        return np.asarray(self.focal * seen[:, :2] / seen[:, 2:] + self.middle)

    @cached_property
    def _rays(self) -> list[Plane]:
        """Direction of each pixel's ray, by component."""
        width, rows = self.size
        u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(rows, dtype=np.float32))
        x, y = (u - self.middle[0]) / self.focal, (v - self.middle[1]) / self.focal
        return [self.turn[0, i] * x + self.turn[1, i] * y + self.turn[2, i] for i in range(3)]

    def plane(self, height: float) -> tuple[Plane, Plane]:
        """Return x and y of each pixel's ray at a height."""
        ray = self._rays
        begin = self.turn.T @ np.array([0.0, 0.0, -self.distance])
        length = (-height - begin[2]) / ray[2]
        return (begin[0] + length * ray[0]).astype(np.float32), (begin[1] + length * ray[1]).astype(np.float32)


def _texture(random: Random, x: Plane, y: Plane, stretch: float) -> Plane:
    """Return smooth noise of unit depth over the table."""
    side, size = 256, random.uniform(0.02, 0.06)
    rough = cv2.GaussianBlur(random.standard_normal((side, side)).astype(np.float32), (0, 0), 1.2)
    at = [np.mod(along / size + 1000.0, side - 2).astype(np.float32) for along in (x, y / stretch)]
    return np.asarray(cv2.remap(rough / rough.std(), *at, cv2.INTER_LINEAR), dtype=np.float32)


def _ground(random: Random, kind: str, x: Plane, y: Plane) -> Plane:
    """Return the table's colours, with a line of a grid or a sheet's edge on some."""
    level, depth, stretch = GROUNDS[kind]
    grain = depth * _texture(random, x, y, stretch) + random.uniform(-10.0, 10.0) * x + random.uniform(-10.0, 10.0) * y
    picture = np.array(level, np.float32) + grain[..., None]
    if kind in ("bench", "paper") and random.random() < 0.5:
        picture[np.abs(np.mod(x + 0.3 * y, 0.8) - 0.4) < 0.01] *= 0.6
    return np.asarray(picture, np.float32)


def _ring(away: Plane, radius: float, width: float = 0.012) -> Plane:
    return np.asarray(np.exp(-(((away - radius) / width) ** 2)), np.float32)


def _inside(away: Plane, radius: float, soft: float) -> Plane:
    """Return 1 inside of a radius."""
    return np.asarray(0.5 - 0.5 * np.tanh((away - radius) / soft), np.float32)


def _blend(picture: Plane, share: Plane, colour: Any) -> None:
    """Draw a colour over a picture where a share is above 0."""
    picture += share[..., None] * (np.asarray(colour, np.float32) - picture)


def _dish(random: Random, picture: Plane, camera: _Camera, at: tuple[float, float], floor: str, lid: bool) -> None:
    """Draw a dish with its shadow, its floor, colonies and writing on it, its wall and lid, and the lamp."""
    x, y = (plane - place for plane, place in zip(camera.plane(0.0), at, strict=True))
    away = np.hypot(x, y)
    picture *= 1.0 - random.uniform(0.1, 0.4) * _inside(np.hypot(x - 0.06, y - 0.05), 1.08, 0.05)[..., None]
    colour = FLOORS[floor]
    share = _inside(away, 1.0, 0.006)
    _blend(picture, share * (OPACITY if colour else 1.0), colour or 0.88 * picture + 14.0)
    scale = camera.focal / camera.distance
    for _ in range(int(random.integers(0, 60))):  # colonies
        place = camera.pixels(np.array([[*(at + random.uniform(-0.7, 0.7, 2)), 0.0]]))[0].round().astype(int)
        level = random.uniform(90.0, 235.0)
        cv2.circle(picture, place.tolist(), max(1, int(scale * random.uniform(0.01, 0.06))), (level,) * 3, -1)
    spot = camera.pixels(np.array([[at[0] - 0.3, at[1] + 0.2, 0.0]]))[0].astype(int)
    ink = np.zeros(picture.shape[:2], np.uint8)
    cv2.putText(ink, "A7 02.11.", spot.tolist(), cv2.FONT_HERSHEY_COMPLEX, scale / 180.0, 1, max(1, int(scale / 90.0)))
    picture[ink > 0] = (30.0, 30.0, 60.0)
    sign = random.choice((-1.0, 1.0))
    rims = [(0.0, 1.015, sign), (WALL, 1.03, -sign), (WALL, 1.06, sign)]
    rims += [(WALL + 0.06, 1.09, sign), (WALL + 0.06, 1.12, -sign)] if lid else []
    for level, radius, side in rims:
        x, y = (plane - place for plane, place in zip(camera.plane(level), at, strict=True))
        lit = 0.6 + 0.4 * np.cos(np.arctan2(y, x) - random.uniform(-np.pi, np.pi))
        picture += (side * random.uniform(20.0, 80.0) * lit * _ring(np.hypot(x, y), radius))[..., None]
    for _ in range(int(random.integers(0, 4))):  # the lamp's reflections
        place, axes = random.uniform(-0.9, 0.9, 2), random.uniform(0.03, 0.2, 2)
        spot_of = np.exp(-(((x - place[0]) / axes[0]) ** 2 + ((y - place[1]) / axes[1]) ** 2))
        picture += (spot_of * random.uniform(60.0, 250.0))[..., None]


def photograph(
    random: Random,
    *,
    ground: str | None = None,
    floor: str | None = None,
    tilt: tuple[float, float] = (0.0, 12.0),
    cut: float = 0.0,
    dishes: int = 1,
    hand: bool = False,
    exposure: float = 1.0,
) -> Photograph:
    """Draw a photograph.

    Args:
        random: of what is not given.
        ground: what the dish stands on.
        floor: what is in it.
        tilt: least and greatest, of the camera [degrees].
        cut: share of the dish's diameter that the frame cuts off.
        dishes: how many there are.
        hand: whether fingers hold it.
        exposure: 1 is well exposed.
    """
    ground, floor = ground or str(random.choice(list(GROUNDS))), floor or str(random.choice(list(FLOORS)))
    rows = int(random.choice((240, 480, 768, 1080)))
    width = int(rows * random.choice((1.0, 1.333, 1.778)))
    size = (rows, width) if random.random() < 0.2 else (width, rows)
    distance = random.uniform(5.0, 10.0)
    radius_px = random.uniform(0.22, 0.46) * min(size) / (1.4 if dishes > 1 else 1.0)
    angle, about = math.radians(random.uniform(*tilt)), random.uniform(-np.pi, np.pi)
    turn = cv2.Rodrigues(angle * np.array([math.cos(about), math.sin(about), 0.0]))[0]
    middle = 0.5 * np.array(size)
    middle += random.uniform(-0.9, 0.9, 2) * np.maximum(middle - 1.15 * radius_px, 0.0)
    if cut:
        side, inside = int(random.integers(2)), (1.0 - 2.0 * cut) * radius_px
        middle[side] = random.choice((inside, size[side] - inside))
    camera = _Camera(size, radius_px * distance, distance, turn, (float(middle[0]), float(middle[1])))
    picture = _ground(random, ground, *camera.plane(0.0))
    way = random.uniform(-np.pi, np.pi)
    for other in range(1, dishes):
        place = 2.5 * math.cos(way + 1.3 * other), 2.5 * math.sin(way + 1.3 * other)
        _dish(random, picture, camera, place, str(random.choice(list(FLOORS))), lid=False)
    _dish(random, picture, camera, (0.0, 0.0), floor, lid=bool(random.random() < 0.5))
    for direction in random.uniform(-np.pi, np.pi, 3 if hand else 0):
        way_out = np.array([math.cos(direction), math.sin(direction), 0.0])
        ends = camera.pixels(np.outer((0.85, 4.0), way_out) + np.array([0.0, 0.0, WALL])).astype(int).tolist()
        cv2.line(picture, ends[0], ends[1], SKIN, max(1, int(0.35 * radius_px)))
    picture = cv2.GaussianBlur(picture * exposure, (0, 0), random.uniform(0.6, 1.2) * max(1.0, rows / 600.0))
    picture += random.standard_normal(picture.shape).astype(np.float32) * random.uniform(1.0, 4.0)
    image = np.clip(picture, 0.0, 255.0).astype(np.uint8)
    data = encode_jpeg(image, int(random.integers(60, 95)))
    turns = np.linspace(0.0, 2.0 * np.pi, 180, endpoint=False)
    circle = np.column_stack([np.cos(turns), np.sin(turns), np.zeros(180)])
    top = camera.pixels(circle * (1.045, 1.045, 0.0) + (0.0, 0.0, WALL))
    return Photograph(np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8), camera.pixels(circle), top)


PHOTOGRAPHS: dict[str, Callable[[Random], Photograph]] = {
    "photo_any": photograph,
    **{f"photo_on_{ground}": partial(photograph, ground=ground) for ground in GROUNDS},
    **{f"photo_{floor}": partial(photograph, floor=floor) for floor in FLOORS},
    "photo_tilted": partial(photograph, tilt=(12.0, 28.0)),
    "photo_cut": partial(photograph, cut=0.2),
    "photo_cut_40": partial(photograph, cut=0.4),
    "photo_several": partial(photograph, dishes=3),
    "photo_hand": partial(photograph, hand=True),
    "photo_bright": partial(photograph, ground="light_box", exposure=1.25),
}


def straightened(found: FoundDish, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points of a photograph where they are once the tilt that was found is taken out, shape (m, 2) [px]."""
    if found.tilt is None:
        return points
    along = np.array([math.cos(found.tilt.direction), math.sin(found.tilt.direction)])
    offset = points - np.array(found.view.centre_px)
    return np.asarray(points + (1.0 / math.cos(found.tilt.angle) - 1.0) * np.outer(offset @ along, along))


def ellipse_error(found: FoundDish, diameter: float, points: NDArray[np.float64]) -> float:
    """Return the mean distance of points from the ellipse that was found, in its radii."""
    radius = 0.5 * diameter / found.view.metres_per_pixel
    offset = straightened(found, points) - np.array(found.view.centre_px)
    return float(np.mean(np.abs(np.hypot(*offset.T) / radius - 1.0)))


def photo_of(name: str, index: int, seed: int) -> Photograph:
    """Return a photograph of a class with a number."""
    return PHOTOGRAPHS[name](np.random.default_rng([seed, index, len(name), *name.encode()]))


def measure_photographs(names: list[str], count: int, seed: int) -> dict[str, Any]:
    """Look for the dish in photographs of each class.

    Returns:
        A row of figures of each class: in how many a dish is found, and of these, how many with an ellipse within
        `RIGHT` of the wall's inner edge, at the floor or at the top; and the CPU time of a frame.
    """
    rows = []
    settings = VisionTrackerSettings()
    for name in names:
        found, right, times = 0, 0, []
        for index in range(count):
            photo = photo_of(name, index, seed)
            began = time.process_time()
            dish = see_dish(photo.image, settings, DIAMETER)
            times.append(1e3 * (time.process_time() - began))
            if dish is not None:
                found += 1
                right += min(ellipse_error(dish, DIAMETER, at) for at in (photo.floor, photo.top)) < RIGHT
        figures = {"found": found, "right": right, "median_ms": float(np.median(times)), "max_ms": max(times)}
        rows.append({"name": name, "count": count, **figures})
    return {"count": count, "seed": seed, "rows": rows}
