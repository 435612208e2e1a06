"""Where steel is in the image around a dark thing: for sure, and perhaps, where a coloured thread may lie over it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.vision.images import Layer, Wall

AROUND_PX = 12.0  # around a dark thing, that is measured on
GLARE = 0.07  # of the floor's brightness, that the lamp's reflection is brighter by
GLARE_REACH_PX = 4  # around a place, that it is looked for, and over which it fades
SHADOW, STEEL = 0.15, 0.8  # of the darkness of steel: up to here floor and shadow, from here on steel


@dataclass(frozen=True)
class SteelMap:
    """How much of each pixel is steel, by its darkness as a share of the floor's brightness.

    Attributes:
        surely: by the brightest of the three colours, in which steel alone is dark, shape (rows, columns), 0 to 1.
        perhaps: by the darkest of them, in which a coloured thread is dark too; the same without colours.
        dark: darkness of the brightest of the three colours, as a share of the floor's brightness.
        depth: darkness of steel, 0 to 1.
        light: how much brighter than the floor, as a share of it, the brightest colour is around each pixel,
            shape (rows, columns).
        origin: (u, v) of the first pixel in the picture.
        size: width and height of the picture [px].
        hidden: where nothing is known; None: nowhere.
    """

    surely: NDArray[np.float32]
    perhaps: NDArray[np.float32]
    dark: NDArray[np.float32]
    depth: float
    light: NDArray[np.float32]
    origin: tuple[float, float]
    size: tuple[int, int]
    hidden: NDArray[np.bool_] | None = None

    def hidden_where(self, hidden: NDArray[np.bool_]) -> SteelMap:
        """Return the map with nothing known where something hides the needle, shape (rows, columns)."""
        if not hidden.any():
            return self
        surely, perhaps = self.surely.copy(), self.perhaps.copy()
        surely[hidden], perhaps[hidden] = 0.0, 1.0
        hidden = hidden if self.hidden is None else self.hidden | hidden
        return replace(self, surely=surely, perhaps=perhaps, hidden=hidden)

    def share_hidden(self, points: np.ndarray) -> float:
        """Return which share of some points, in the map's own pixels, is hidden."""
        if self.hidden is None:
            return 0.0
        rows, columns = self.hidden.shape
        u, v = np.round(points).astype(int).T
        return float(self.hidden[v.clip(0, rows - 1), u.clip(0, columns - 1)].mean())

    def is_glaring(self, points: np.ndarray) -> bool:
        """Say whether the lamp is reflected within a few pixels of points, in the map's own pixels, shape (m, 2)."""
        rows, columns = self.light.shape
        reach = np.arange(-GLARE_REACH_PX, GLARE_REACH_PX + 1)
        u = np.round(points[:, :1]).astype(int) + reach
        v = np.round(points[:, 1:]).astype(int) + reach
        near = self.light[v.clip(0, rows - 1)[:, :, None], u.clip(0, columns - 1)[:, None, :]]
        return float(near.max()) > GLARE

    def unknown_in_glare(self) -> SteelMap:
        """Return the map in which steel may be anywhere that the lamp is reflected, and at the reflection's edge."""
        glare = (self.light > GLARE).astype(np.uint8)
        size = 2 * GLARE_REACH_PX + 1
        covered = cv2.dilate(glare, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))) > 0
        return replace(self, perhaps=np.where(covered, np.float32(1.0), self.perhaps)) if covered.any() else self

    @property
    def box(self) -> tuple[slice, slice]:
        """Rows and columns of the picture."""
        (left, top), (rows, columns) = (round(value) for value in self.origin), self.surely.shape
        return slice(top, top + rows), slice(left, left + columns)

    @staticmethod
    def around(points: np.ndarray, brightest: Layer, darkest: Layer, factor: int, wall: Wall) -> SteelMap:
        """Return the map around some points.

        Args:
            points: of the dark thing, shape (m, 2) [px].
            brightest: see `Picture`.
            darkest: see there.
            factor: see there.
            wall: of the dish.
        """
        rows, columns = brightest.pixels.shape
        left, top = np.maximum(points.min(axis=0) - AROUND_PX, 0.0).astype(int)
        right, bottom = np.minimum(points.max(axis=0) + AROUND_PX, (columns, rows)).astype(int)
        box = slice(top, bottom), slice(left, right)
        dark = _darkness(brightest, box, factor, wall)
        u, v = np.round(points - (left, top)).astype(int).T
        own = dark[v.clip(0, len(dark) - 1), u.clip(0, dark.shape[1] - 1)]
        rank = round(0.9 * (len(own) - 1))
        depth = float(np.partition(own, rank)[rank])
        surely = _share(dark, depth)
        perhaps = surely if darkest is brightest else _share(_darkness(darkest, box, factor, wall), depth)
        light = np.asarray(cv2.blur(-dark, (3, 3)), dtype=np.float32)
        return SteelMap(surely, perhaps, dark, depth, light, (float(left), float(top)), (columns, rows))


def _darkness(channel: Layer, box: tuple[slice, slice], factor: int, wall: Wall) -> NDArray[np.float32]:
    """Return 1 - I / F of some rows and columns."""
    floor = np.maximum(wall.floor(channel, factor, box), 1).astype(np.float32)
    return np.asarray(1.0 - channel.pixels[box] / floor)


def _share(dark: NDArray[np.float32], depth: float) -> NDArray[np.float32]:
    share = (dark / max(depth, 1e-3) - SHADOW) / (STEEL - SHADOW)
    return np.asarray(np.clip(share, 0.0, 1.0), dtype=np.float32)
