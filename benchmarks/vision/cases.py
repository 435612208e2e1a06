"""The classes of frames: each draws a case at random."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import Any

import cv2
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import KDTree

from benchmarks.vision.frames import (
    DISH_RADIUS,
    ROWS,
    SCALE,
    Case,
    Needle,
    dark_field,
    distorted,
    drawn_thread,
    lens_with,
    tilted,
)
from magnetosuture_thread.geometry.polyline import Points, arc_lengths, points_at
from magnetosuture_thread.rig.camera import STEEL_BGR, Cover, Lighting

Random = np.random.Generator
MakeCase = Callable[[Random], Case]

WITHIN = 0.0150  # m; of the dish's centre, in which a needle lies
CURVATURES = (-190.0, 0.0, 0.0, 0.0, 110.0, 190.0)  # 1/m
TURN_STEP = 0.05e-3  # m; between vertices of a thread
MAX_TRIES = 2000
FOLDS = ((0, 4), (4, 15), (15, 26), (26, 50))  # degrees from the heading
SIZES = {320: (320, 240), 640: (640, 480), 1280: (1280, 960), 1920: (1920, 1080)}
COLOURS = {"black": (38.0, 34.0, 34.0), "violet": (132.0, 78.0, 100.0)}
WIDTHS_PX = (0.5, 1.0, 2.0, 4.0, 6.0)
COVER_BGR = ((168.0, 176.0, 205.0), (60.0, 58.0, 55.0), (210.0, 205.0, 200.0))
CLEARANCE = 1.2e-3  # m; of covers and of another thread from the needle and the thread's beginning
TURNS = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
BESIDE = (0.6e-3, 2.0e-3)  # m; from a thread to one that comes near without a crossing


def tried(make: Callable[..., Case | None]) -> Callable[..., Case]:
    """Return a function that draws a case at random, again and again until one fits into the dish."""

    def draw(*arguments: Any, **options: Any) -> Case:
        for _ in range(MAX_TRIES):
            if (case := make(*arguments, **options)) is not None:
                return case
        raise RuntimeError(f"no case of {make.__name__} fits into the dish")

    return draw


def unit_vector(angle: float) -> Points:
    """Return the unit vector at an angle [rad], shape (2,)."""
    return np.array([math.cos(angle), math.sin(angle)])


def random_lighting(random: Random) -> Lighting:
    """Return lighting and noise of a usual laboratory."""
    ranges = {"gain": (0.7, 1.05), "slope": (0.0, 3.0), "glare": (0.0, 1.0), "noise": (0.5, 2.0), "blur_px": (0.6, 1.0)}
    values: dict[str, Any] = {name: random.uniform(*bounds) for name, bounds in ranges.items()}
    return Lighting(**values)


def random_needle(random: Random, length: float = 0.007, within: float = WITHIN, width: float = 0.0004) -> Needle:
    """Return a needle that lies within a distance of the dish's centre [m]."""
    while True:
        tail, heading = random.uniform(-within, within, 2), random.uniform(-np.pi, np.pi)
        needle = Needle(tail, heading, float(random.choice(CURVATURES)), length, width)
        if np.linalg.norm(needle.axis(np.linspace(0.0, 1.0, 9))[0], axis=1).max() < within:
            return needle


def winding_line(random: Random, start: Points, angle: float, length: float, bends: float = 250.0) -> Points:
    """Return a line that begins at an angle, nearly straight, and then winds at random, shape (m, 2) [m]."""
    steps = max(4, round(length / TURN_STEP))
    knots = np.concatenate([[0.0], random.uniform(-bends, bends, 6)])
    turn = np.cumsum(np.interp(np.linspace(0.0, 1.0, steps), np.linspace(0.0, 1.0, 7), knots)) * length / steps
    walked = np.cumsum(length / steps * np.column_stack([np.cos(angle + turn), np.sin(angle + turn)]), axis=0)
    return np.vstack([start, start + walked])


def continued(random: Random, line: Points, length: float, bends: float = 250.0) -> Points:
    """Return a line that goes on from its end as `winding_line`, for so long [m]."""
    angle = math.atan2(*(line[-1] - line[-2])[::-1])
    return np.vstack([line, winding_line(random, line[-1], angle, length, bends)[1:]])


def is_inside(thread: Points) -> bool:
    """Return whether a line stays off the wall."""
    return bool(np.linalg.norm(thread, axis=1).max() < 0.0163)


def _is_clear(needle: Needle, thread: Points) -> bool:
    """Return whether a thread stays off its needle but for where it leaves."""
    later = thread[arc_lengths(thread) > 2e-3]
    return bool(needle.distances(later[::4]).min() > CLEARANCE)


def _crosses_itself(thread: Points) -> bool:
    """Return whether a thread crosses itself at a good angle, or comes near to itself."""
    line = thread[::6]
    apart = np.linalg.norm(line[:, None] - line[None], axis=2)
    near = np.abs(np.subtract.outer(np.arange(len(line)), np.arange(len(line)))) * 6 * TURN_STEP > 2.5e-3
    return bool((apart[near] < 0.7e-3).any())


def _is_simple(needle: Needle, line: Points) -> bool:
    return is_inside(line) and _is_clear(needle, line) and not _crosses_itself(line)


@tried
def usual_case(random: Random, length: float = 0.007, thread: float = 0.019, within: float = WITHIN) -> Case | None:
    """Return a needle with a thread that leaves backwards and crosses nothing."""
    needle = random_needle(random, length, within)
    line = winding_line(random, needle.tail, needle.heading + np.pi + random.normal(0.0, 0.4), thread)
    if _is_simple(needle, line):
        return Case(needle, line, lighting=random_lighting(random), quality=int(random.integers(80, 97)))
    return None


@tried
def _folded(low: float, high: float, length: float, random: Random) -> Case | None:
    """Return a thread that lies beside, under or over its needle, at an angle from the heading [degrees]."""
    needle = random_needle(random, length, width=random.uniform(0.28e-3, 0.42e-3))
    fold = math.radians(random.uniform(low, high)) * random.choice((-1.0, 1.0))
    how = str(random.choice(("under", "over", "beside")))
    along = random.uniform(0.6, 1.6) * length
    if how == "beside":  # It leaves backwards and turns around in a small bend.
        radius, side = random.uniform(0.2e-3, 0.5e-3), math.copysign(1.0, fold)
        turns = np.linspace(0.0, np.pi - abs(fold), 20)
        first = needle.heading + np.pi
        centre = needle.tail + radius * unit_vector(first - side * 0.5 * np.pi)
        begun = centre + radius * np.array([unit_vector(first + side * (0.5 * np.pi - turn)) for turn in turns])
        start, angle = begun[-1], needle.heading + fold
    else:
        begun, start, angle = needle.tail[None], needle.tail, needle.heading + fold
    straight = winding_line(random, start, angle, along, 60.0)
    line = np.vstack([begun, straight[1:]])
    line = continued(random, line, 0.019 - arc_lengths(line)[-1])
    beyond = line[arc_lengths(line) > 1.4 * length + 1e-3]
    if is_inside(line) and needle.distances(beyond[::4]).min() > 0.8e-3 and not _crosses_itself(line[20:]):
        width, labels = random.uniform(0.8, 1.6), {"fold": math.degrees(fold), "how": how}
        look: dict[str, Any] = {"lighting": random_lighting(random), "thread_over": how == "over"}
        return Case(needle, line, thread_px=width, labels=labels, **look)
    return None


@tried
def thread_with_loop(random: Random) -> Case | None:
    """Return a thread with a loop."""
    needle = random_needle(random)
    backwards = needle.heading + np.pi + random.normal(0.0, 0.3)
    first = winding_line(random, needle.tail, backwards, random.uniform(4e-3, 7e-3))
    angle = math.atan2(*(first[-1] - first[-2])[::-1])
    turn, radius = random.choice((-1.0, 1.0)), random.uniform(1.2e-3, 2.2e-3)
    turns = np.arange(0.0, random.uniform(1.7, 1.95) * np.pi, TURN_STEP / radius)
    steps = angle + turn * turns
    loop = first[-1] + np.cumsum(TURN_STEP * np.column_stack([np.cos(steps), np.sin(steps)]), axis=0)
    line = np.vstack([first, loop])
    line = np.vstack([line, winding_line(random, line[-1], float(steps[-1]), 0.026 - arc_lengths(line)[-1], 100.0)[1:]])
    own = line[::2]
    apart = np.linalg.norm(own[:, None] - own[None], axis=2)
    meets = np.triu(apart < 2.0 * TURN_STEP, 20).any()
    if is_inside(line) and _is_clear(needle, line) and meets:
        return Case(needle, line, lighting=random_lighting(random))
    return None


@tried
def _crossing_needle(random: Random) -> Case | None:
    """Return a thread that comes back and crosses its needle, under or over it."""
    needle = random_needle(random, within=0.011)
    side, share = random.choice((-1.0, 1.0)), random.uniform(0.3, 0.75)
    at, along = (values[0] for values in needle.axis(np.array([share])))
    aside = side * np.array([-along[1], along[0]])
    way = math.cos(lean := random.uniform(-0.7, 0.7)) * aside + math.sin(lean) * along
    back = -unit_vector(needle.heading)
    out = needle.tail + 2.2e-3 * back
    begin, end = (needle.tail, needle.tail + 0.9e-3 * back, out - 1.2e-3 * aside), (at - 2.6e-3 * way, at)
    knots = np.array([*begin, *end, at + 2.6e-3 * way])
    lengths = arc_lengths(knots)  # a smooth line, cubic in the chord length, with vertices of equal distance
    line = CubicSpline(lengths, knots)(np.linspace(0.0, lengths[-1], 400))
    line = points_at(line, np.arange(0.0, arc_lengths(line)[-1], TURN_STEP))
    line = continued(random, line, random.uniform(6e-3, 9e-3), 150.0)
    after = line[(arc_lengths(line) > 1.5e-3)]
    near = needle.distances(after[::4])
    if is_inside(line) and (near < 0.5 * needle.width).sum() < 15 and near[-30:].min() > 1e-3:
        return Case(needle, line, lighting=random_lighting(random), thread_over=bool(random.random() < 0.5))
    return None


@tried
def _at_wall(end: str, random: Random) -> Case | None:
    """Return a straight needle whose tip, tail or side touches the wall, or nearly so."""
    length, width = 0.007, 0.0004
    angle, gap = random.uniform(-np.pi, np.pi), random.uniform(0.0, 0.4e-3)
    outward = unit_vector(angle)
    if end == "side":
        heading = angle + random.choice((-0.5, 0.5)) * np.pi
        distance = math.sqrt((DISH_RADIUS - gap - 0.5 * width) ** 2 - 0.25 * length**2)
        tail = distance * outward - 0.5 * length * unit_vector(heading)
    elif end == "tip":
        heading = angle + random.uniform(-0.8, 0.8)
        tail = (DISH_RADIUS - gap) * outward - length * unit_vector(heading)
    else:
        heading = angle + np.pi + random.uniform(-0.8, 0.8)
        tail = (DISH_RADIUS - gap - 0.5 * width) * outward
    needle = Needle(tail, heading, 0.0, length, width)
    inward = math.atan2(*-tail[::-1]) + random.normal(0.0, 0.4)
    line = winding_line(random, tail, inward if end == "tail" else heading + np.pi + random.normal(0.0, 0.3), 0.012)
    if is_inside(line[arc_lengths(line) > 3e-3]) and _is_clear(needle, line) and not _crosses_itself(line):
        return Case(needle, line, lighting=random_lighting(random), labels={"gap": gap})
    return None


def _image_width(columns: int, random: Random) -> Case:
    """Return the usual needle and thread in an image of another size; lens and sensor go with the pixels."""
    case = usual_case(random)
    width, height = SIZES[columns]
    return replace(case, size=(width, height), thread_px=0.975 * height / ROWS)


def _thread(colour: str, width_px: float, random: Random) -> Case:
    """Return a thread of a colour and a width in the image."""
    size = SIZES[int(random.choice((640, 640, 640, 1280, 1920)))]
    return replace(usual_case(random), size=size, thread_px=width_px, thread_bgr=COLOURS[colour])


@tried
def _covered(width: float, random: Random) -> Case | None:
    """Return a thread over which a post stands or an instrument lies, as wide as given [m]."""
    case = usual_case(random, thread=0.028)
    lengths = arc_lengths(case.thread)
    middle = random.uniform(3e-3 + 0.5 * width, 22e-3 - 0.5 * width)
    index = int(np.searchsorted(lengths, middle))
    at, along = case.thread[index], case.thread[index + 1] - case.thread[index - 1]
    colour = _colour(random)
    if random.random() < 0.5:
        outline, how = _post(at, width), "post"
    else:
        across = np.array([-along[1], along[0]]) / np.linalg.norm(along)
        across *= math.copysign(1.0, float(across @ at))  # towards the nearer wall
        outline, how = straight_strip(at - 2e-3 * across, across, 0.06, width), "instrument"
    return _below(replace(case, labels={"how": how}), [outline], [colour])


def _below(
    case: Case, outlines: list[Points], colours: Iterable[tuple[float, float, float]], blur_px: float = 1.0
) -> Case | None:
    """Return a case below covers; None unless they keep off the needle and the thread's beginning."""
    axis, _ = case.needle.axis(np.linspace(0.0, 1.0, 40))
    keep = np.vstack([axis, case.thread[:20]])
    if all(depth_inside(outline, keep) < -CLEARANCE for outline in outlines):
        covers = tuple(Cover(*cover, blur_px) for cover in zip(outlines, colours, strict=True))
        return replace(case, hidden_by=covers)
    return None


def _post(at: Points, width: float) -> Points:
    return at + 0.5 * width * np.column_stack([np.cos(TURNS), np.sin(TURNS)])


def _colour(random: Random) -> tuple[float, float, float]:
    return COVER_BGR[int(random.integers(len(COVER_BGR)))]


def straight_strip(end: Points, way: Points, length: float, width: float) -> Points:
    """Return the outline of a strip that begins at `end` and runs along the unit vector `way`, shape (4, 2) [m]."""
    across = 0.5 * width * np.array([-way[1], way[0]])
    return np.vstack([end - across, end + across, end + length * way + across, end + length * way - across])


def depth_inside(outline: Points, points: Points) -> float:
    """Return how deep the deepest point lies in an outline, negative outside [m]."""
    ring = (outline * 1e6).astype(np.float32)
    return max(cv2.pointPolygonTest(ring, (float(x), float(y)), True) for x, y in points * 1e6) * 1e-6


@tried
def _second_needle(random: Random) -> Case | None:
    """Return a frame with a second needle, which has no thread."""
    case = usual_case(random)
    other = random_needle(random)
    axis, _ = other.axis(np.linspace(0.0, 1.0, 20))
    if case.needle.distances(axis).min() > 2e-3 and min(other.distances(case.thread[::4])) > 1.2e-3:
        return replace(case, beside=(other,))
    return None


def _tilted(degrees: float, random: Random) -> Case:
    return replace(usual_case(random), finish=(tilted(math.radians(degrees), random.uniform(-np.pi, np.pi)),))


def _saturated(random: Random) -> Case:
    case = usual_case(random)
    return replace(case, lighting=replace(case.lighting, gain=random.uniform(1.1, 1.6)))


def _distorted(told: bool, random: Random) -> Case:
    strength, case = random.uniform(-0.06, 0.06), usual_case(random)
    lens = lens_with(strength, case.size) if told else None
    return replace(case, finish=(distorted(strength),), lens=lens)


@tried
def _cut_dish(least: float, greatest: float, random: Random) -> Case | None:
    """Return a dish of which the frame shows a part, with all of needle and thread."""
    case = usual_case(random)
    distance = random.uniform(least, greatest) * DISH_RADIUS / SCALE
    u, v = distance * unit_vector(random.uniform(-np.pi, np.pi)) * (1.6, 1.0)
    moved = replace(case, shift=(float(u), float(v)))
    ends = case.needle.axis(np.linspace(0.0, 1.0, 9))[0]
    at = moved.view.to_pixels(np.vstack([ends, case.thread]))
    if at.min() > 25.0 and (at < np.array(moved.size) - 25.0).all():
        return moved
    return None


def _suture_needle(random: Random) -> Case:
    """Return a needle bent up to a half circle, of any usual length and width."""
    length, width = random.uniform(2e-3, 12e-3), float(random.choice((0.28e-3, 0.4e-3, 0.6e-3)))
    for _ in range(MAX_TRIES):
        needle = replace(random_needle(random, length, width=width), curvature=random.uniform(-np.pi, np.pi) / length)
        line = winding_line(random, needle.tail, needle.heading + np.pi + random.normal(0.0, 0.4), 0.015)
        axis, _ = needle.axis(np.linspace(0.0, 1.0, 20))
        if is_inside(axis) and _is_simple(needle, line):
            return Case(needle, line, lighting=random_lighting(random))
    raise RuntimeError("no thread fits into the dish")


@tried
def _instrument_beside(random: Random) -> Case | None:
    """Return a frame with a dark instrument as wide as the needle, but longer, that lies in the dish."""
    case = usual_case(random)
    length, angle = random.uniform(1.4, 3.0) * case.needle.length, random.uniform(-np.pi, np.pi)
    outline = straight_strip(random.uniform(-0.012, 0.012, 2), unit_vector(angle), length, case.needle.width)
    axis, _ = case.needle.axis(np.linspace(0.0, 1.0, 40))
    if depth_inside(outline, np.vstack([axis, case.thread])) < -1.2e-3 and is_inside(outline):
        return replace(case, hidden_by=(Cover(outline, STEEL_BGR, 0.3),))
    return None


@tried
def _two_covers(random: Random) -> Case | None:
    """Return a thread below two posts."""
    case = usual_case(random, thread=0.028)
    widths, middles = random.uniform(2e-3, 5e-3, 2), (random.uniform(5e-3, 10e-3), random.uniform(16e-3, 22e-3))
    posts = [_post(points_at(case.thread, np.array([at]))[0], w) for at, w in zip(middles, widths, strict=True)]
    apart = np.linalg.norm(posts[0].mean(axis=0) - posts[1].mean(axis=0)) - 0.5 * widths.sum()
    return _below(case, posts, (_colour(random) for _ in posts)) if apart > 1e-3 else None


@tried
def _cover_end(random: Random) -> Case | None:
    """Return a thread whose free end lies below a post."""
    case = usual_case(random, thread=0.024)
    width = random.uniform(1.5e-3, 6e-3)
    at = case.thread[-1] + random.uniform(0.0, 0.3) * width * unit_vector(random.uniform(-np.pi, np.pi))
    return _below(case, [_post(at, width)], (_colour(random) for _ in range(1)))


@tried
def _cover_crossing(random: Random) -> Case | None:
    """Return a thread with a loop, whose crossing lies below a post."""
    case = thread_with_loop(random)
    line = case.thread
    apart = np.linalg.norm(line[:, None] - line[None], axis=2)
    apart[np.abs(np.subtract.outer(np.arange(len(line)), np.arange(len(line)))) < 60] = 1.0
    first, _ = np.unravel_index(int(np.argmin(apart)), apart.shape)
    post = _post(line[first], random.uniform(1.5e-3, 2.5e-3))
    return _below(case, [post], (_colour(random) for _ in range(1)))


@tried
def _glare_thread(random: Random) -> Case | None:
    """Return a thread a part of which the lamp's reflection outshines."""
    case = usual_case(random, thread=0.024)
    at = points_at(case.thread, np.array([random.uniform(5e-3, 19e-3)]))[0]
    axes, turn = random.uniform(0.5e-3, 2e-3, 2), random.uniform(0.0, np.pi)
    spot = axes * np.column_stack([np.cos(TURNS), np.sin(TURNS)])
    spot = at + spot @ np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
    return _below(case, [spot], [(262.0, 262.0, 262.0)], 2.0)


@tried
def _hand_instrument(random: Random) -> Case | None:
    """Return an instrument that a hand holds over the thread."""
    case = usual_case(random, thread=0.026)
    at = points_at(case.thread, np.array([random.uniform(6e-3, 20e-3)]))[0]
    outward = at / max(float(np.hypot(*at)), 1e-6)
    way = math.cos(lean := random.uniform(-0.8, 0.8)) * outward + math.sin(lean) * np.array([-outward[1], outward[0]])
    instrument = straight_strip(at - 2e-3 * way, way, 0.06, random.uniform(1.5e-3, 3e-3))
    hand = straight_strip(at + random.uniform(6e-3, 10e-3) * way, way, 0.06, random.uniform(8e-3, 14e-3))
    return _below(case, [instrument, hand], [(120.0, 118.0, 115.0), (150.0, 170.0, 225.0)])


def _through(random: Random, place: Points, direction: float) -> tuple[Points, int]:
    """Return another thread through a place in a direction, and the number of its vertex there."""
    back, on = (
        winding_line(random, place, direction + turn, 0.5 * random.uniform(12e-3, 22e-3), 200.0)
        for turn in (math.pi, 0)
    )
    return np.vstack([back[::-1], on[1:]]), len(back) - 1


def _with(case: Case, other: Points, labels: dict[str, float]) -> Case | None:
    """Return a case with another thread; None unless that stays in the dish and off the needle."""
    if not is_inside(other) or case.needle.distances(other[::4]).min() < CLEARANCE:
        return None
    width = case.thread_px * case.view.metres_per_pixel
    return replace(case, hidden_by=(drawn_thread(other, width, case.thread_bgr),), labels=labels)


def _place_of_crossing(random: Random, case: Case) -> tuple[Points, float]:
    """Return a place on a thread and its direction there [rad]."""
    at = int(np.searchsorted(arc_lengths(case.thread), random.uniform(3e-3, 15e-3)))
    along = case.thread[at + 1] - case.thread[at - 1]
    return case.thread[at], math.atan2(along[1], along[0])


@tried
def _crossed(low: float, high: float, random: Random) -> Case | None:
    """Return the usual frame with another thread that crosses the needle's once, at an angle of some degrees."""
    case = usual_case(random)
    place, direction = _place_of_crossing(random, case)
    angle = math.radians(random.uniform(low, high)) * random.choice((-1.0, 1.0))
    other, middle = _through(random, place, direction + angle)
    apart = KDTree(case.thread[::4]).query(other)[0]
    near = np.flatnonzero((apart < 0.5e-3) & (np.abs(np.arange(len(other)) - middle) > 4))
    # Nowhere near but where it crosses: as long as two lines at that angle are.
    at = arc_lengths(other)
    again = np.abs(at[near] - at[middle]) > 0.8e-3 / math.sin(abs(angle))
    return None if again.any() else _with(case, other, {"angle": math.degrees(angle)})


@tried
def _beside(random: Random) -> Case | None:
    """Return the usual frame with another thread that runs beside the needle's for a while and does not touch it."""
    case = usual_case(random)
    place, direction = _place_of_crossing(random, case)
    side = random.choice((-1.0, 1.0)) * random.uniform(*BESIDE)
    other, _ = _through(random, place + side * unit_vector(direction + 0.5 * math.pi), direction)
    clear = float(np.min(KDTree(case.thread[::4]).query(other)[0])) > 0.9 * BESIDE[0]
    return _with(case, other, {"distance": abs(side)}) if clear else None


def _length_off(share: float, random: Random) -> Case:
    """Return the usual frame, and a length of the needle that is set wrong by a share."""
    return replace(usual_case(random), length_error=share * random.choice((-1.0, 1.0)))


CLASSES: dict[str, MakeCase] = {
    "usual": usual_case,
    **{
        f"fold_{low}_{high}_{mm:g}mm": partial(_folded, low, high, 1e-3 * mm)
        for mm in (2.5, 7.0)
        for low, high in FOLDS
    },
    "crossing_itself": thread_with_loop,
    "crossing_needle": _crossing_needle,
    **{f"wall_{end}": partial(_at_wall, end) for end in ("tip", "tail", "side")},
    **{f"width_{columns}": partial(_image_width, columns) for columns in SIZES},
    **{f"thread_{colour}_{px:g}px": partial(_thread, colour, px) for colour in COLOURS for px in WIDTHS_PX},
    **{f"cover_{mm:g}mm": partial(_covered, 1e-3 * mm) for mm in (1.5, 3.0, 6.0, 10.0)},
    "second_needle": _second_needle,
    **{f"tilt_{angle}deg": partial(_tilted, float(angle)) for angle in (3, 6, 10)},
    "saturated": _saturated,
    "dark_field": lambda random: replace(usual_case(random), finish=(dark_field,)),
    "blunt_rod": lambda random: replace(usual_case(random), rod=True),
    "distortion": partial(_distorted, True),
    "distortion_untold": partial(_distorted, False),
    "cut_dish": partial(_cut_dish, 0.1, 0.55),
    "cut_dish_far": partial(_cut_dish, 0.55, 0.9),
    **{f"length_off_{percent}": partial(_length_off, 0.01 * percent) for percent in (2, 5, 10)},
    "suture_needle": _suture_needle,
    "instrument_beside": _instrument_beside,
    "two_covers": _two_covers,
    "cover_end": _cover_end,
    "cover_crossing": _cover_crossing,
    "glare_thread": _glare_thread,
    "hand_instrument": _hand_instrument,
    "second_thread": partial(_crossed, 30.0, 90.0),
    "second_thread_shallow": partial(_crossed, 10.0, 30.0),
    "second_thread_beside": _beside,
}
