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

from magnetosuture_thread.vision.dish import FoundDish, see_dish
from magnetosuture_thread.vision.settings import VisionTrackerSettings

Image = NDArray[np.uint8]
Plane = NDArray[np.float32]

DIAMETER = 0.09  # m; of a usual dish
RIGHT = 0.04  # of the radius, that the ellipse may be off the wall's at the floor or at the top
FLOORS = {
    "clear": (None, 0.25),
    "blood": ((38.0, 28.0, 120.0), 0.95),
    "yellow": ((110.0, 190.0, 215.0), 0.8),
    "beige": ((165.0, 195.0, 210.0), 0.9),
    "dark": ((45.0, 50.0, 45.0), 0.95),
    "blue": ((170.0, 120.0, 60.0), 0.8),
}
SKIN = (120.0, 150.0, 205.0)
SATURATES = 10.0  # tanh is 1 from here on, in single precision
GROUNDS = ("wood", "cloth", "light_box", "paper", "bench", "steel")


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

    def box(self, centre: NDArray[np.float64], half: float) -> tuple[slice, slice]:
        """Return rows and columns of the pixels that see a square on the table."""
        corners = [[centre[0] + x * half, centre[1] + y * half, 0.0] for x in (-1.0, 1.0) for y in (-1.0, 1.0)]
        seen = self.pixels(np.array(corners))
        low, high = np.floor(seen.min(axis=0)).astype(int), np.ceil(seen.max(axis=0)).astype(int) + 1
        return slice(max(low[1], 0), max(high[1], 0)), slice(max(low[0], 0), max(high[0], 0))


def _texture(random: np.random.Generator, x: Plane, y: Plane, stretch: float, size: float) -> Plane:
    """Return smooth noise of unit depth over the table."""
    side = 256
    rough = cv2.GaussianBlur(random.standard_normal((side, side)).astype(np.float32), (0, 0), 1.2)
    rough /= float(rough.std())
    at_u = np.mod(x / size * 8.0 + 1000.0, side - 2).astype(np.float32)
    at_v = np.mod(y / size * 8.0 / stretch + 1000.0, side - 2).astype(np.float32)
    return np.asarray(cv2.remap(rough, at_u, at_v, cv2.INTER_LINEAR), dtype=np.float32)


def _ground(random: np.random.Generator, kind: str, x: Plane, y: Plane) -> Plane:
    """Return the table's colours."""
    level = {
        "wood": (90, 130, 175), "cloth": (28, 28, 30), "light_box": (252, 253, 252),
        "paper": (215, 220, 222), "bench": (150, 155, 150), "steel": (130, 132, 135),
    }[kind]  # fmt: skip
    depth = {"wood": 16.0, "cloth": 5.0, "light_box": 2.0, "paper": 3.0, "bench": 10.0, "steel": 9.0}[kind]
    stretch = {"wood": 12.0, "steel": 25.0}.get(kind, 1.0)
    grain = _texture(random, x, y, stretch, random.uniform(0.15, 0.5))
    shade = random.uniform(-18.0, 18.0) * x + random.uniform(-18.0, 18.0) * y
    picture = np.array(level, np.float32) + (depth * grain + (0.2 if kind == "light_box" else 1.0) * shade)[..., None]
    if kind in ("bench", "paper") and random.random() < 0.5:  # a line of a grid or a sheet's edge
        turned = x * math.cos(0.3) + y * math.sin(0.3)
        picture[np.abs(np.mod(turned, 0.8) - 0.4) < 0.01] *= 0.6
    return np.asarray(picture, np.float32)


def _ring(away: Plane, radius: float, width: float) -> Plane:
    return np.asarray(np.exp(-(((away - radius) / width) ** 2)), np.float32)


def _step(away: Plane, radius: float, soft: float) -> Plane:
    """Return 1 inside of a radius."""
    return np.asarray(0.5 - 0.5 * np.tanh((away - radius) / soft), np.float32)


def _draw_use(
    random: np.random.Generator, picture: Plane, camera: _Camera, at: tuple[float, float], place_of: tuple[Plane, Plane]
) -> None:
    """Draw what grows on a dish's floor, and a label or writing."""
    x, y = place_of
    soft = 0.008
    for _ in range(int(random.integers(0, 60))):  # colonies
        radius, place = random.uniform(0.01, 0.06), random.uniform(-0.7, 0.7, 2)
        box = camera.box(at + place, radius + SATURATES * soft)
        blob = _step(np.hypot(x[box] - place[0], y[box] - place[1]), radius, soft)
        picture[box] += 0.8 * blob[..., None] * (random.uniform(90.0, 235.0) - picture[box])
    if random.random() < 0.4:  # a label, stuck off the middle
        where, turn = random.uniform(-0.5, 0.5, 2), random.uniform(0.0, 3.0)
        along = (x - where[0]) * math.cos(turn) + (y - where[1]) * math.sin(turn)
        aside = (y - where[1]) * math.cos(turn) - (x - where[0]) * math.sin(turn)
        label = (np.abs(along) < 0.3) & (np.abs(aside) < 0.15)
        picture[label] = 225.0
        picture[label & (np.abs(np.mod(aside, 0.08) - 0.04) < 0.012) & (np.abs(along) < 0.25)] = 40.0
    else:  # writing
        spot = camera.pixels(np.array([[at[0] - 0.3, at[1] + 0.2, 0.0]]))[0]
        scale = camera.focal / camera.distance / 90.0
        ink = np.zeros(picture.shape[:2], np.uint8)
        cv2.putText(ink, "A7 02.11.", (int(spot[0]), int(spot[1])), 3, scale, 255, max(1, int(2 * scale)), cv2.LINE_AA)
        picture += (ink / np.float32(255.0))[..., None] * (np.array((30.0, 30.0, 60.0), np.float32) - picture)


def _dish(
    random: np.random.Generator,
    picture: Plane,
    camera: _Camera,
    at: tuple[float, float],
    floor: str,
    height: float,
    lid: bool,
) -> None:
    """Draw a dish with its shadow, its floor, what grows and is written on it, its wall and lid."""
    x, y = camera.plane(0.0)
    x, y = x - at[0], y - at[1]
    away, around = np.hypot(x, y), np.arctan2(y, x)
    soft = 0.006
    shadow = _step(np.hypot(x - 0.06, y - 0.05), 1.08, 0.05)
    picture *= 1.0 - random.uniform(0.1, 0.4) * shadow[..., None]
    colour, opacity = FLOORS[floor]
    inside = _step(away, 1.0, soft)
    if colour is None:
        tone = picture * 0.88 + 14.0
    else:
        tone = np.asarray(colour, np.float32) * (1.0 + 0.06 * _texture(random, x, y, 1.0, 1.0)[..., None])
    picture += (opacity if colour else 1.0) * inside[..., None] * (tone - picture)
    _draw_use(random, picture, camera, at, (x, y))
    bright = random.uniform(25.0, 90.0)
    sign = -1.0 if random.random() < 0.5 else 1.0
    modulation = 0.65 + 0.35 * np.cos(around - random.uniform(-np.pi, np.pi))
    picture += (sign * bright * modulation * _ring(away, 1.015, 0.012))[..., None]
    rims = [(height, 1.03, -sign), (height, 1.06, sign)]
    if lid:
        rims += [(height + 0.06, 1.09, sign), (height + 0.06, 1.12, -sign)]
    for level, radius, side in rims:
        x, y = camera.plane(level)
        x, y = x - at[0], y - at[1]
        lit = 0.6 + 0.4 * np.cos(np.arctan2(y, x) - random.uniform(-np.pi, np.pi))
        depth = random.uniform(20.0, 80.0)
        picture += (side * depth * lit * _ring(np.hypot(x, y), radius, 0.012))[..., None]
    for _ in range(int(random.integers(0, 4))):  # the lamp's reflections
        place, axes = random.uniform(-0.9, 0.9, 2), random.uniform(0.03, 0.2, 2)
        spot = np.exp(-(((x - place[0]) / axes[0]) ** 2 + ((y - place[1]) / axes[1]) ** 2))
        picture += (spot * random.uniform(60.0, 250.0))[..., None]
    arc = _ring(np.hypot(x, y), random.uniform(0.8, 1.05), 0.02) * np.exp(
        -((np.mod(np.arctan2(y, x) - random.uniform(0.0, 6.3), 2.0 * np.pi) - np.pi) ** 2) / 0.06
    )
    picture += (arc * random.uniform(0.0, 200.0))[..., None]


def photograph(
    random: np.random.Generator,
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
    ground = ground or str(random.choice(GROUNDS))
    floor = floor or str(random.choice(list(FLOORS)))
    rows = int(random.choice((240, 320, 480, 600, 768, 1080, 1440)))
    width = int(rows * random.choice((1.0, 1.333, 1.5, 1.778)))
    size = (rows, width) if random.random() < 0.2 else (width, rows)
    distance = random.uniform(5.0, 10.0)
    radius_px = random.uniform(0.22, 0.46) * min(size) / (1.4 if dishes > 1 else 1.0)
    angle, about = math.radians(random.uniform(*tilt)), random.uniform(-np.pi, np.pi)
    turn = cv2.Rodrigues(angle * np.array([math.cos(about), math.sin(about), 0.0]))[0]
    middle = np.array(size) * 0.5
    free = np.maximum(0.5 * np.array(size) - 1.15 * radius_px, 0.0)
    middle = middle + random.uniform(-0.9, 0.9, 2) * free
    if cut:
        side = int(random.integers(2))
        middle[side] = (
            (2.0 * cut - 1.0) * -radius_px if random.random() < 0.5 else size[side] + (2.0 * cut - 1.0) * radius_px
        )
    camera = _Camera(size, radius_px * distance, distance, turn, (float(middle[0]), float(middle[1])))
    x, y = camera.plane(0.0)
    picture = _ground(random, ground, x, y)
    height = random.uniform(0.2, 0.4)
    way = random.uniform(-np.pi, np.pi)
    for other in range(1, dishes):
        where = 2.5 * np.array([math.cos(way + 1.3 * other), math.sin(way + 1.3 * other)])
        _dish(
            random,
            picture,
            camera,
            (float(where[0]), float(where[1])),
            str(random.choice(list(FLOORS))),
            height,
            lid=False,
        )
    _dish(random, picture, camera, (0.0, 0.0), floor, height, bool(random.random() < 0.5))
    if hand:
        for _ in range(int(random.integers(1, 4))):
            direction = random.uniform(-np.pi, np.pi)
            begin = camera.pixels(np.array([[0.85 * math.cos(direction), 0.85 * math.sin(direction), 0.3]]))[0]
            end = camera.pixels(np.array([[4.0 * math.cos(direction + 0.2), 4.0 * math.sin(direction + 0.2), 0.3]]))[0]
            finger = np.zeros(picture.shape[:2], np.uint8)
            ends = [(int(p[0]), int(p[1])) for p in (begin, end)]
            cv2.line(finger, ends[0], ends[1], 255, max(1, int(0.35 * radius_px)), cv2.LINE_AA)
            picture += (finger / np.float32(255.0))[..., None] * (np.array(SKIN, np.float32) - picture)
    picture = cv2.GaussianBlur(picture * exposure, (0, 0), random.uniform(0.6, 1.2) * max(1.0, rows / 600.0))
    picture += random.standard_normal(picture.shape).astype(np.float32) * random.uniform(1.0, 4.0)
    image = np.clip(picture, 0.0, 255.0).astype(np.uint8)
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, int(random.integers(60, 95))])[1]
    turns = np.linspace(0.0, 2.0 * np.pi, 180, endpoint=False)
    circle = np.column_stack([np.cos(turns), np.sin(turns), np.zeros(180)])
    top = circle * (1.045, 1.045, 0.0) + (0.0, 0.0, height)
    return Photograph(
        np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8), camera.pixels(circle), camera.pixels(top)
    )


PHOTOGRAPHS: dict[str, Callable[[np.random.Generator], Photograph]] = {
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
