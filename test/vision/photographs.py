"""Drawn photographs of petri dishes as people take them, whose ellipse is known, and how well the dish is found."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.vision.dish import FoundDish

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
GROUNDS = {  # colour, and depth of the texture
    "wood": ((90.0, 130.0, 175.0), 16.0),
    "cloth": ((28.0, 28.0, 30.0), 5.0),
    "light_box": ((252.0, 253.0, 252.0), 2.0),
    "paper": ((215.0, 220.0, 222.0), 3.0),
    "steel": ((130.0, 132.0, 135.0), 9.0),
}


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


def _texture(random: np.random.Generator, x: Plane, y: Plane) -> Plane:
    """Return smooth noise of unit depth over the table."""
    side = 256
    rough = cv2.GaussianBlur(random.standard_normal((side, side)).astype(np.float32), (0, 0), 1.2)
    size = random.uniform(0.15, 0.5)
    u, v = (np.mod(values / size * 8.0 + 1000.0, side - 2).astype(np.float32) for values in (x, y))
    return np.asarray(cv2.remap(rough / float(rough.std()), u, v, cv2.INTER_LINEAR), dtype=np.float32)


def _ring(away: Plane, radius: float) -> Plane:
    return np.asarray(np.exp(-(((away - radius) / 0.012) ** 2)), np.float32)


def _step(away: Plane, radius: float, soft: float) -> Plane:
    """Return 1 inside of a radius."""
    return np.asarray(0.5 - 0.5 * np.tanh((away - radius) / soft), np.float32)


def _draw_dish(
    random: np.random.Generator,
    picture: NDArray[Any],
    camera: _Camera,
    floor: str,
    height: float,
) -> None:
    """Draw a dish with its shadow, its floor, its wall, sometimes a lid, and the lamp's reflections."""
    x, y = camera.plane(0.0)
    away, around = np.hypot(x, y), np.arctan2(y, x)
    picture *= 1.0 - random.uniform(0.1, 0.4) * _step(np.hypot(x - 0.06, y - 0.05), 1.08, 0.05)[..., None]
    colour, opacity = FLOORS[floor]
    tone = picture * 0.88 + 14.0
    if colour is not None:
        tone = np.asarray(colour, np.float32) * (1.0 + 0.06 * _texture(random, x, y)[..., None])
    picture += (opacity if colour else 1.0) * _step(away, 1.0, 0.006)[..., None] * (tone - picture)
    sign = random.choice((-1.0, 1.0))
    lit = 0.65 + 0.35 * np.cos(around - random.uniform(-np.pi, np.pi))
    picture += (sign * random.uniform(25.0, 90.0) * lit * _ring(away, 1.015))[..., None]
    rims = [(height, 1.03, -sign), (height, 1.06, sign)]
    if random.random() < 0.5:
        rims += [(height + 0.06, 1.09, sign), (height + 0.06, 1.12, -sign)]
    for level, radius, side in rims:
        x, y = camera.plane(level)
        lit = 0.6 + 0.4 * np.cos(np.arctan2(y, x) - random.uniform(-np.pi, np.pi))
        picture += (side * random.uniform(20.0, 80.0) * lit * _ring(np.hypot(x, y), radius))[..., None]
    for _ in range(int(random.integers(0, 4))):
        place, axes = random.uniform(-0.9, 0.9, 2), random.uniform(0.03, 0.2, 2)
        spot = np.exp(-(((x - place[0]) / axes[0]) ** 2 + ((y - place[1]) / axes[1]) ** 2))
        picture += (spot * random.uniform(60.0, 250.0))[..., None]


def photograph(
    random: np.random.Generator,
    ground: str | None = None,
    floor: str | None = None,
    tilt: tuple[float, float] = (0.0, 12.0),
) -> Photograph:
    """Draw a photograph.

    Args:
        random: of what is not given.
        ground: what the dish stands on.
        floor: what is in it.
        tilt: least and greatest, of the camera [degrees].
    """
    ground = ground or str(random.choice(list(GROUNDS)))
    rows = int(random.choice((240, 480, 768, 1080)))
    size = (int(rows * random.choice((1.0, 1.333, 1.778))), rows)
    distance = random.uniform(5.0, 10.0)
    radius_px = random.uniform(0.22, 0.46) * min(size)
    angle, about = math.radians(random.uniform(*tilt)), random.uniform(-np.pi, np.pi)
    turn = cv2.Rodrigues(angle * np.array([math.cos(about), math.sin(about), 0.0]))[0]
    middle = np.array(size) * 0.5
    middle += random.uniform(-0.9, 0.9, 2) * np.maximum(middle - 1.15 * radius_px, 0.0)
    camera = _Camera(size, radius_px * distance, distance, turn, (float(middle[0]), float(middle[1])))
    x, y = camera.plane(0.0)
    level, depth = GROUNDS[ground]
    shade = random.uniform(-18.0, 18.0) * x + random.uniform(-18.0, 18.0) * y
    picture = np.array(level, np.float32) + (depth * _texture(random, x, y) + 0.5 * shade)[..., None]
    height = random.uniform(0.2, 0.4)
    _draw_dish(random, picture, camera, floor or str(random.choice(list(FLOORS))), height)
    picture = cv2.GaussianBlur(picture, (0, 0), random.uniform(0.6, 1.2) * max(1.0, rows / 600.0))
    picture += random.standard_normal(picture.shape).astype(np.float32) * random.uniform(1.0, 4.0)
    data = cv2.imencode(".jpg", np.clip(picture, 0.0, 255.0).astype(np.uint8))[1]
    turns = np.linspace(0.0, 2.0 * np.pi, 180, endpoint=False)
    circle = np.column_stack([np.cos(turns), np.sin(turns), np.zeros(180)])
    top = circle * (1.045, 1.045, 0.0) + (0.0, 0.0, height)
    return Photograph(
        np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8), camera.pixels(circle), camera.pixels(top)
    )


PHOTOGRAPHS: dict[str, Callable[[np.random.Generator], Photograph]] = {
    **{f"photo_on_{ground}": partial(photograph, ground=ground) for ground in ("cloth", "light_box", "wood")},
    "photo_blood": partial(photograph, floor="blood"),
    "photo_tilted": partial(photograph, tilt=(12.0, 28.0)),
}


def straightened(dish: FoundDish, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points of a photograph where they are once the tilt that was found is taken out, shape (m, 2) [px]."""
    if dish.tilt is None:
        return points
    along = np.array([math.cos(dish.tilt.direction), math.sin(dish.tilt.direction)])
    offset = points - np.array(dish.view.centre_px)
    return np.asarray(points + (1.0 / math.cos(dish.tilt.angle) - 1.0) * np.outer(offset @ along, along))


def ellipse_error(dish: FoundDish, diameter: float, points: NDArray[np.float64]) -> float:
    """Return the mean distance of points from the ellipse that was found, in its radii."""
    radius = 0.5 * diameter / dish.view.metres_per_pixel
    offset = straightened(dish, points) - np.array(dish.view.centre_px)
    return float(np.mean(np.abs(np.hypot(*offset.T) / radius - 1.0)))


def photo_of(name: str, index: int, seed: int) -> Photograph:
    """Return a photograph of a class with a number."""
    return PHOTOGRAPHS[name](np.random.default_rng([seed, index, len(name), *name.encode()]))
