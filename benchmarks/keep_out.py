"""Attack the promise that the needle's axis keeps `keep_out` from wall and shapes, in simulated time.

Random accepted parameters of the coil bridge, random scenes with sharp corners and narrow channels, straight and curved
needles, commands towards what is nearest, along it and at random, poses that come late by up to `pose_timeout`, and
a bridge that stalls while the coils hold their last currents. How the needle moves and how near it comes is computed
here anew, with complex numbers and shapely, by none of the code that is attacked.
"""

from __future__ import annotations

import argparse
import cmath
import contextlib
import copy
import math
import time
from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely

from magnetosuture_thread.coils.bridge import CoilBridge
from magnetosuture_thread.coils.drivers import DriverState
from magnetosuture_thread.coils.latch import ArmingLatch
from magnetosuture_thread.coils.settings import MAX_BLIND_DISTANCE, CoilBridgeSettings
from magnetosuture_thread.commands.command import Terminal
from magnetosuture_thread.geometry.obstacles import Disc, Polygon
from magnetosuture_thread.geometry.scene import Dish, Scene, SceneShape
from magnetosuture_thread.geometry.scene_files import shape_from_mapping
from magnetosuture_thread.settings.errors import ConfigurationError, InvalidInputError

TOLERANCE = 5e-6  # m; deeper is a violation
READY = DriverState(True)
SUBSTEP = 2e-5  # m of way between two looks at the clearance
KEEP_OUTS = ((5e-5, 3e-4), (3e-4, 1e-3))  # m
START = 100.0  # s; time of the first step


@dataclass
class Needle:
    """A needle as complex numbers: where its chord's middle is and which way its chord points."""

    length: float
    curvature: float
    middle: complex
    angle: float

    def __post_init__(self) -> None:
        """Lay its axis around the middle of its chord, along the real axis."""
        turn, straight = 1j * self.curvature, self.curvature == 0.0
        s = np.linspace(0.0, self.length, 2 if straight else 161)
        axis = s.astype(complex) if straight else (np.exp(turn * s) - 1.0) / turn
        self.chord = abs(axis[-1])
        self._tilt = cmath.phase(axis[-1])
        self.axis = (axis * cmath.exp(-1j * self._tilt)) - 0.5 * self.chord

    def moved(self, velocity: complex, duration: float) -> Needle:
        """Return the needle after it was driven along its chord and turned, as its own frame has it."""
        inside = velocity * cmath.exp(-1j * self.angle)
        turn = inside.imag / (0.5 * self.chord)
        way = inside.real * duration
        if abs(turn * duration) > 1e-7:
            way = inside.real * (cmath.exp(1j * turn * duration) - 1.0) / (1j * turn)
        moved = copy.copy(self)
        moved.middle = self.middle + way * cmath.exp(1j * self.angle)
        moved.angle = self.angle + turn * duration
        return moved

    def points(self) -> np.ndarray:
        """Return its axis, shape (m, 2) [m]."""
        z = self.middle + self.axis * cmath.exp(1j * self.angle)
        return np.column_stack([z.real, z.imag])

    def pose(self) -> tuple[np.ndarray, np.ndarray]:
        """Return tail and heading at the tail."""
        tail = self.middle - 0.5 * self.chord * cmath.exp(1j * self.angle)
        heading = cmath.exp(1j * (self.angle - self._tilt))
        return np.array([tail.real, tail.imag]), np.array([heading.real, heading.imag])


class World:
    """A scene as shapely sees it."""

    def __init__(self, scene: Scene) -> None:
        self.radius = scene.dish.radius
        geometries = [shape.geometry for shape in scene.shapes]
        self._discs = np.array([(*g.centre, g.radius) for g in geometries if isinstance(g, Disc)]).reshape(-1, 3)
        self._solids = [shapely.Polygon(g.outline, g.holes) for g in geometries if isinstance(g, Polygon)]
        self.centres = shapely.points(self._discs[:, :2]) if len(self._discs) else np.empty(0, object)

    def clearance(self, axes: list[np.ndarray]) -> float:
        """Return the least distance of an axis from wall and shapes [m]; 0 where it crosses one."""
        lines = shapely.linestrings(np.array(axes))
        least = self.radius - max(float(np.hypot(*axis.T).max()) for axis in axes)
        for solid in self._solids:
            least = min(least, float(shapely.distance(lines, solid).min()))
        for centre, disc in zip(self.centres, self._discs, strict=True):
            least = min(least, float(shapely.distance(lines, centre).min()) - disc[2])
        return least

    def nearest(self, axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the point of an axis that is nearest to anything, and the unit vector to that."""
        away = np.hypot(*axis.T)
        i = int(away.argmax())
        least, where, way = self.radius - away[i], axis[i], axis[i] / max(away[i], 1e-9)
        line = shapely.LineString(axis)
        for solid in (*self._solids, *(c.buffer(d[2]) for c, d in zip(self.centres, self._discs, strict=True))):
            distance = float(shapely.distance(line, solid))
            if distance < least and distance > 0.0:
                ends = shapely.get_coordinates(shapely.shortest_line(line, solid))
                least, where, way = distance, ends[0], (ends[1] - ends[0]) / distance
        return where, way


def random_settings(random: np.random.Generator) -> CoilBridgeSettings:
    """Return settings that the bridge accepts, over the whole of their range."""
    while True:
        length = float(random.uniform(0.001, 0.012))
        most = math.pi / length
        curvature = float(random.choice([0.0, random.uniform(-1.0, 1.0) * min(most, 600.0)]))
        rate = float(random.choice([10.0, 20.0, 50.0, 100.0, 200.0, 400.0], p=[0.2, 0.2, 0.2, 0.2, 0.15, 0.05]))
        width = float(random.uniform(1e-4, 5e-4))
        driver_timeout = float(random.choice([random.uniform(0.05, 1.0), 0.2, random.uniform(0.05, 0.2)]))
        hold = driver_timeout + 1.0 / rate
        try:
            return CoilBridgeSettings(
                rate=rate,
                driver_timeout=driver_timeout,
                command_timeout=min(1.0, max(4.0 / rate, float(random.uniform(0.05, 1.0)))),
                pose_timeout=min(1.0, max(4.0 / rate, float(random.uniform(0.05, 1.0)))),
                max_speed=float(min(0.5, random.choice([1.0, random.uniform(0.1, 1.0)]) * MAX_BLIND_DISTANCE / hold)),
                max_acceleration=float(10.0 ** random.uniform(-1.0, 2.0)),
                max_current_slew=float(10.0 ** random.uniform(2.0, 5.0)),
                max_current=float(random.uniform(2.0, 30.0)),
                keep_out=max(0.5 * width, float(random.choice([random.uniform(a, b) for a, b in KEEP_OUTS]))),
                approach_rate=float(min(rate, 10.0 ** random.uniform(-0.5, 2.5))),
                needle_length=length,
                needle_width=width,
                needle_curvature=curvature,
            )
        except ConfigurationError:
            continue


def random_scene(random: np.random.Generator) -> Scene:
    """Return a dish with sharp corners, discs, rings and narrow channels in it."""
    radius = float(random.uniform(0.008, 0.025))
    shapes: list[SceneShape] = []

    def add(**description: object) -> None:
        with contextlib.suppress(ConfigurationError):  # what bounds no area is left out
            shapes.append(shape_from_mapping(f"shape_{len(shapes)}", description))

    def add_polygon(corners: Any, angle: float, centre: np.ndarray) -> None:
        c, s = math.cos(angle), math.sin(angle)
        add(polygon={"outline": (np.array(corners) @ np.array([[c, s], [-s, c]]) + centre).tolist()})

    for _ in range(int(random.integers(0, 5))):
        kind = int(random.integers(0, 7))
        centre = 0.9 * radius * math.sqrt(random.uniform()) * _unit(random.uniform(-math.pi, math.pi))
        size, angle = float(random.uniform(0.05, 0.4)) * radius, float(random.uniform(-math.pi, math.pi))
        if kind == 0:
            add(disc={"center": centre.tolist(), "radius": 0.5 * size})
        elif kind == 1:  # a splinter
            add_polygon([(0.0, 0.0), (2.0 * size, 0.02 * size), (0.0, 0.1 * size)], angle, centre)
        elif kind == 2:  # a star
            count = int(random.integers(3, 9))
            radii, turn = np.tile([size, 0.35 * size], count), math.pi * np.arange(2 * count) / count
            add_polygon((radii * [np.cos(turn), np.sin(turn)]).T, angle, centre)
        elif kind == 3:
            inner = float(random.uniform(0.3, 0.8)) * radius
            add(annulus={"center": (0.3 * centre).tolist(), "inner_radius": inner, "outer_radius": 1.2 * inner})
        elif kind == 4:  # a channel
            gap, long, thick = float(random.uniform(5e-4, 3e-3)), 2.0 * size, 0.3 * size
            for side in (1.0, -1.0):
                low, high = sorted((0.5 * side * gap, 0.5 * side * (gap + 2.0 * thick)))
                add_polygon([(-long, low), (long, low), (long, high), (-long, high)], angle, 0.3 * centre)
        elif kind == 5:  # a U
            gap, thick = float(random.uniform(1e-3, 4e-3)), 0.2 * size
            x = [0.0, size, size, thick, thick, size, size, 0.0]
            y = [0.0, 0.0, thick, thick, thick + gap, thick + gap, 2.0 * thick + gap, 2.0 * thick + gap]
            add_polygon(np.column_stack([x, y]), angle, 0.5 * centre)
        else:  # rough
            turn = np.sort(random.uniform(-math.pi, math.pi, 40))
            radii = size * random.uniform(0.6, 1.0, 40)
            add_polygon((radii * [np.cos(turn), np.sin(turn)]).T, angle, centre)
    while True:
        try:
            return Scene(Dish(2.0 * radius, 0.003), tuple(shapes))
        except ConfigurationError:
            shapes.pop()


@dataclass
class Tally:
    """Counts of episodes, and how deep the needle came [m]."""

    seconds: float = 0.0
    steps: int = 0
    episodes: int = 0
    driven: int = 0
    pressed: int = 0
    stalls: int = 0
    faults: int = 0
    violations: int = 0
    deepest: float = -math.inf
    worst: list[dict[str, object]] = field(default_factory=list)

    def add(self, other: Tally) -> None:
        """Add what another tally has."""
        deepest = max(self.deepest, other.deepest)
        for name, value in vars(other).items():
            setattr(self, name, getattr(self, name) + value)
        self.deepest = deepest


def attack(seed: int, duration: float = 4.0) -> Tally:
    """Drive a needle for a while with random parameters in a random scene, all given by the seed."""
    random = np.random.default_rng(seed)
    tally = Tally(episodes=1)
    for _ in range(100):
        settings, scene = random_settings(random), random_scene(random)
        world = World(scene)
        needle = _start(random, settings, world)
        if needle is not None:
            break
    else:
        return tally
    try:
        bridge = CoilBridge(settings, ArmingLatch(), scene)
    except ConfigurationError:
        return tally
    bridge.latch.activate()
    bridge.arm(READY)
    period, now, end = 1.0 / settings.rate, START, START + duration
    pose_period = min(float(random.uniform(0.005, 0.1)), 0.3 * settings.pose_timeout)
    delay = float(random.uniform(0.0, 0.9)) * max(0.0, settings.pose_timeout - 3.0 * period - pose_period)
    waiting: deque[tuple[float, float, tuple[np.ndarray, np.ndarray]]] = deque()  # due, stamp and pose
    next_pose, number = now, 0

    def measure(measured: Needle, stamp: float) -> None:
        """Measure a pose that is true at its stamp and comes later, unless it would come before the last."""
        due = stamp + delay * float(random.uniform(0.5, 1.0))
        if not waiting or due >= waiting[-1][0]:
            waiting.append((due, stamp, measured.pose()))

    command, mode, until = np.zeros(2), 0, 0.0
    clearance = world.clearance([needle.points()])
    while now < end:
        if now >= next_pose:
            measure(needle, now)
            next_pose = now + pose_period
        while waiting and waiting[0][0] <= now:
            (_, stamp, (tail, heading)), number = waiting.popleft(), number + 1
            try:
                bridge.on_pose(tail, heading, stamp, number, now, now)
            except InvalidInputError as error:
                if "publishers" in str(error) or "finite" in str(error):
                    raise
        if now >= until:
            mode, until = int(random.integers(0, 6)), now + float(random.uniform(0.05, 1.0))
            speed = settings.max_speed * float(random.choice([1.0, 2.0, random.uniform()]))
            command = speed * _unit(random.uniform(-math.pi, math.pi))
        if mode in (1, 2, 3):
            command = _towards(needle, world, settings.max_speed, mode, random)
        elif mode == 4:
            command = settings.max_speed * _unit(random.uniform(-math.pi, math.pi))
        bridge.command("needle", command, now, tally.steps + 1, now, now)
        bridge.on_margins(now, True, 1.0, scene.version, now)
        outcome = bridge.step(now, now, READY)
        if bridge.latch.fault.startswith("needle does not follow"):  # after a stall nobody knows how it has moved
            tally.faults += 1
            bridge.reset(READY)
            bridge.arm(READY)
        elif bridge.latch.fault:
            raise AssertionError(f"seed {seed}: {bridge.latch.fault}")
        velocity = complex(*outcome.applied)
        tally.steps += 1
        tally.driven += abs(velocity) > 0.0
        gap, moving = _gap(random, settings, tally)
        way = abs(velocity) * moving * _swing(needle)
        if way > 0.0:
            if clearance - way < settings.keep_out:
                count = min(400, max(2, math.ceil(way / SUBSTEP)))
                axes = [needle.moved(velocity, moving * k / count).points() for k in range(1, count + 1)]
                tally.pressed += 1
                depth = settings.keep_out - world.clearance(axes)
                tally.deepest = max(tally.deepest, depth)
                if depth > TOLERANCE:
                    tally.violations += 1
                    tally.worst.append({"seed": seed, "time": now - START, "deeper": depth})
            while next_pose < now + moving:  # poses fall due within the motion too
                measure(needle.moved(velocity, next_pose - now), next_pose)
                next_pose += pose_period
            needle = needle.moved(velocity, moving)
            clearance = world.clearance([needle.points()])
        now += gap
        tally.seconds += gap
    return tally


def _gap(random: np.random.Generator, settings: CoilBridgeSettings, tally: Tally) -> tuple[float, float]:
    """Return the time to the next step, a stall now and then, and for how long of it the coils hold their currents."""
    period, certain = 1.0 / settings.rate, min(settings.command_timeout, settings.driver_timeout)
    gap = period
    if random.uniform() < 0.05:
        gap = max(period, float(random.choice([1.0, 1.5, random.uniform()])) * settings.driver_timeout)
        tally.stalls += 1
    if gap <= certain:
        return gap, gap
    # When nobody asks for currents, the coils stop at some time between both timeouts.
    stops = [certain, settings.driver_timeout, random.uniform(certain, settings.driver_timeout)]
    return gap, min(gap, float(random.choice(stops)))


def _swing(needle: Needle) -> float:
    """Return how many times faster than the tip a point of the needle can be."""
    return float(max(1.0, np.abs(needle.axis).max() / (0.5 * needle.chord)) * math.sqrt(2.0))


def _start(random: np.random.Generator, settings: CoilBridgeSettings, world: World) -> Needle | None:
    """Return a needle that keeps clear of everything; None if there is no room."""
    for _ in range(60):
        r, a = world.radius * math.sqrt(random.uniform()), random.uniform(-math.pi, math.pi)
        angle = float(random.uniform(-math.pi, math.pi))
        needle = Needle(settings.needle_length, settings.needle_curvature, cmath.rect(r, a), angle)
        if world.clearance([needle.points()]) > 1.2 * settings.keep_out + 0.01 * settings.needle_length:
            return needle
    return None


def _towards(needle: Needle, world: World, speed: float, mode: int, random: np.random.Generator) -> np.ndarray:
    """Return a tip velocity that takes the needle's nearest point towards what it is near to, or along it."""
    where, way = world.nearest(needle.points())
    if mode == 2:
        way = np.array([-way[1], way[0]]) * random.choice([-1.0, 1.0]) + 0.3 * way
    apart = (complex(*where) - needle.middle) * cmath.exp(-1j * needle.angle) / (0.5 * needle.chord)
    inside = complex(*way) * cmath.exp(-1j * needle.angle)
    pull = complex(inside.real, inside.imag * apart.real - inside.real * apart.imag)
    if mode == 3:
        pull = complex(pull.real + 0.5 * random.normal(), pull.imag)
    tip = pull * cmath.exp(1j * needle.angle)
    return speed * np.array([tip.real, tip.imag]) / max(abs(tip), 1e-9)


def _unit(angle: float) -> np.ndarray:
    return np.array([math.cos(angle), math.sin(angle)])


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--seconds", type=float, default=10_000.0, help="simulated time")
    parser.add_argument("--seed", type=int, default=0, help="of the first episode")


def run(options: argparse.Namespace, terminal: Terminal) -> tuple[dict[str, Any], bool]:
    """Attack the promise; return the figures and whether it was kept."""
    total, began = Tally(), time.process_time()
    with terminal.progress("keep-out") as advance:
        while total.seconds < options.seconds:
            total.add(attack(options.seed + total.episodes))
            advance(total.seconds / options.seconds)
    deepest = None if math.isinf(total.deepest) else total.deepest  # the needle was never near; JSON has no infinity
    terminal.log(
        f"{total.seconds:.0f} s in {total.episodes} episodes, {total.steps} steps, {total.stalls} stalls, "
        f"{total.faults} faults: {total.violations} violations beyond {1e6 * TOLERANCE:g} um, "
        f"deepest {1e6 * total.deepest:.4f} um"
    )
    figures = {**vars(total), "worst": total.worst[:20], "deepest": deepest}
    return {**figures, "cpu_seconds": time.process_time() - began}, not total.violations
