"""The simulated rig: currents in, frames out; and its faults."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from magnetosuture_thread.bags.packing import Outputs, Stamp, packed_path, packed_pose_stamped, packed_wrench
from magnetosuture_thread.geometry.polyline import Points, Vector
from magnetosuture_thread.geometry.scene import Scene, find_collision
from magnetosuture_thread.rig.camera import Cover, DishCamera, Image
from magnetosuture_thread.rig.settings import COVERS, KINDS, Fault, RigSettings
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.errors import InvalidInputError, SolverError

RELEASE_TIME = 1.0  # s without currents asked for, after which a rig with a problem tries again


class FaultSchedule:
    """All faults of a run, and what those in force do to a frame.

    Args:
        faults: in any order; they may overlap.
        dish_diameter: [m]
        needle_length: [m]
        seed: of where glare, hand and tool lie.
    """

    def __init__(self, faults: Sequence[Fault], dish_diameter: float, needle_length: float, seed: int) -> None:
        self.faults, self.dish_diameter = tuple(faults), dish_diameter
        self._needle, self._seed = needle_length, seed

    def add(self, fault: Fault) -> None:
        """Take one more fault, and forget those that are over."""
        self.faults = (*(f for f in self.faults if f.start + f.duration > fault.start), fault)[-100:]

    def kinds(self, time: float) -> frozenset[str]:
        """Return the kinds in force at a time [s]."""
        return frozenset(fault.kind for fault in self.faults if fault.holds(time))

    def lifted(self, time: float) -> Vector:
        """Return by how much the needle has been carried out of the dish, shape (2,) [m]."""
        for fault in self.faults:
            if fault.kind == "needle_out" and fault.holds(time):
                # It is carried over the rim in 0.6 s.
                up, down = (min(1.0, left / 0.6) for left in (time - fault.start, fault.start + fault.duration - time))
                along, _ = _axes(self._random(fault).uniform(0.0, 2.0 * np.pi))
                return np.asarray(min(up, down) * 1.2 * self.dish_diameter * along)
        return np.zeros(2)

    def covers(self, time: float, tail: Points, tip: Points) -> tuple[Cover, ...]:
        """Return what lies between the dish and the camera.

        Glare, hand and tool lie on some place of the needle and move a little with every frame.

        Args:
            time: [s].
            tail: of the needle, shape (2,) [m].
            tip: shape (2,) [m].
        """
        return tuple(
            self._cover(fault, time, tail, tip) for fault in self.faults if fault.kind in COVERS and fault.holds(time)
        )

    def _cover(self, fault: Fault, time: float, tail: Points, tip: Points) -> Cover:
        random = self._random(fault)
        place = tail + random.uniform(0.0, 1.0) * (tip - tail)
        angle = random.uniform(0.0, 2.0 * np.pi)
        along, across = _axes(angle)
        if fault.kind == "glare":  # an ellipse, whose radius is 0.3 to 0.55 of the needle's length
            radius, turn = self._needle * random.uniform(0.3, 0.55), np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
            less = random.uniform(0.5, 1.0) * radius
            outline = place + radius * np.cos(turn)[:, None] * along + less * np.sin(turn)[:, None] * across
            return Cover(outline, (265.0, 265.0, 265.0), blur_px=4.0)
        # A strip that comes in from far away and ends, rounded, beyond the place.
        is_hand = fault.kind == "hand"
        width, along, across = (0.28 if is_hand else 0.07) * self.dish_diameter, -along, -across
        turn = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 24)
        sway = 0.03 * self.dish_diameter * np.sin(5.0 * (time - fault.start) + angle)
        end = place + 0.3 * width * along + sway * across
        cap = end + 0.5 * width * (np.cos(turn)[:, None] * along + np.sin(turn)[:, None] * across)
        back = end - 3.0 * self.dish_diameter * along
        outline = np.vstack([back - 0.5 * width * across, cap, back + 0.5 * width * across])
        bgr = (120.0, 145.0, 195.0) if is_hand else (115.0, 112.0, 108.0)  # skin, or steel
        return Cover(outline, bgr, blur_px=3.0 if is_hand else 1.5)

    def _random(self, fault: Fault) -> np.random.Generator:
        """Return chances that are a fault's own, whatever others there are."""
        return np.random.default_rng((self._seed, KINDS.index(fault.kind), round(1e6 * fault.start)))


def _axes(angle: float) -> tuple[Vector, Vector]:
    """Return the unit vectors along an angle [rad] and to its left."""
    return np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])


@dataclass(frozen=True)
class RigFrame:
    """One frame and the truth of its moment.

    Attributes:
        time: since the start [s].
        image: BGR, shape (height, width, 3); None if the frame got lost, or is not rendered.
        lateness: how long it is held back before anybody gets it [s].
        stamp_delay: by which its stamp is later than `time` [s].
        tail: the needle's true tail, shape (2,) [m].
        heading: its true angle at the tail [rad].
        thread: the thread's true centreline from the tail on, shape (n + 1, 2) [m].
        pull: force of the thread upon the needle at its tail, shape (2,) [N].
        moment: of the thread upon the needle about its tail, counter-clockwise [N m].
        lost: whether it gets lost on the way from the camera.
        covers: what is between the dish and the camera.
        gain: of its exposure, 1 as usual.
    """

    time: float
    image: Image | None
    lateness: float
    tail: Vector
    heading: float
    thread: Vector
    pull: Vector
    moment: float
    lost: bool = False
    covers: tuple[Cover, ...] = ()
    gain: float = 1.0
    stamp_delay: float = 0.0


class Rig:
    """Needle and thread in the coils' field, under a camera. Time comes in as seconds since the start.

    Until the first current that is not zero the needle is held, as a thread that is bent at the start would pull it
    away; the thread moves meanwhile where `is_watched`, as a model of it predicts. A power stage that gets no new
    currents for `driver_timeout` switches off, as real ones do. The times of faults count from the first current that
    is not zero, so that they do not depend on how long the other nodes take to start.

    Where the mechanics find no next state, as of a needle that is wedged, the coils are off and everything stays where
    it is, until no currents have been asked for during `RELEASE_TIME` and then some are.

    Args:
        settings: of the rig.
        scene: in which needle and thread are.
        max_time: for which they move in one call at the most [s]; the rest of the time is lost.
        max_iterations: of Newton in one call, after which the rest of the time is lost.

    Attributes:
        scene: as it is now.
        time: up to which needle and thread have moved [s].
        currents: in force, shape (m,) [A].
        began: time of the first current that was not zero, inf before [s].
        problem: why everything stays where it is; empty if it does not.
        dynamics: needle and thread.
        is_watched: whether the thread moves before the first current; a node waits for a model that follows it.

    Raises:
        ConfigurationError: needle or thread would start in the wall or in a shape.
    """

    def __init__(
        self, settings: RigSettings, scene: Scene, *, max_time: float = math.inf, max_iterations: float = math.inf
    ) -> None:
        settings.check_scene(scene)
        self._settings, self.scene = settings, scene
        self.dynamics = settings.dynamics(scene)
        self._camera: DishCamera | None = None  # drawn when it is needed first, which takes a second
        faults = [Fault.parse(text) for text in settings.faults]
        self.faults = FaultSchedule(faults, scene.dish.diameter, settings.needle_length, settings.seed)
        self._random = np.random.default_rng(settings.seed + 1)
        self.time, self.began, self._applied_at = 0.0, math.inf, 0.0
        self.currents = np.zeros(len(settings.coil_angles))
        self._commands = deque[tuple[float, Vector]]()  # that are not in force yet, and from when on they are
        self._max_time, self._max_iterations = max_time, max_iterations
        # Simulated boards switch off by themselves, as their currents then say.
        self._timeout = settings.driver_timeout if settings.power_stage == "topic" else math.inf
        self.problem, self.is_watched = "", True
        self._asked_at = -math.inf  # last time that currents were asked for since the problem

    def warm_up(self) -> None:
        """Compile what a frame needs, on a temporary needle and thread.

        OpenCV gets one core for itself: the others belong to the nodes that are looked at.
        """
        cv2.setNumThreads(1)
        spare = self._settings.dynamics(self.scene)
        spare.step(self.currents, 1e-3)
        self.camera.render(spare.tail, spare.heading, spare.thread)

    @property
    def camera(self) -> DishCamera:
        """The camera over the dish as it is now."""
        if self._camera is None:
            self._camera = self._settings.camera(self.scene)
        return self._camera

    def set_scene(self, scene: Scene) -> None:
        """Put another dish and other shapes around needle and thread, which stay where they are.

        Raises:
            InvalidInputError: needle or thread would be in the wall or in a shape; nothing has changed.
        """
        if scene.version == self.scene.version:
            return
        # A thread around a post that stays may cut its edge by a chord, which is no reason to refuse.
        new = replace(scene, shapes=tuple(shape for shape in scene.shapes if shape not in self.scene.shapes))
        for name, points in {"needle": self.dynamics.body, "thread": self.dynamics.thread}.items():
            if what := find_collision(new, points, holes=False):
                raise InvalidInputError("scene", f"{what} where the {name} is", "shapes off needle and thread")
        camera = None if self._camera is None else self._settings.camera(scene)
        self.dynamics.set_surface(self._settings.surface(scene))
        self.scene, self._camera, self.faults.dish_diameter = scene, camera, scene.dish.diameter

    def apply(self, currents: Vector, time: float) -> None:
        """Set the coils' currents from a time on; until then the last ones are in force.

        Args:
            currents: of each coil, shape (m,) [A].
            time: since the start, to which `current_delay` is added [s].

        Raises:
            InvalidInputError: of the wrong number, or not finite.
        """
        if currents.shape != self.currents.shape or not np.all(np.isfinite(currents)):
            expected = f"{len(self.currents)} finite numbers [A]"
            raise InvalidInputError("rig/currents.current", currents.tolist(), expected)
        limit = self._settings.coil_max_current
        self._commands.append((time + self._settings.current_delay, np.clip(currents, -limit, limit)))
        self.advance(time)

    def _begin(self, currents: Vector, time: float) -> None:
        """Put currents in force at a time [s], up to which everything has moved."""
        if self.problem:
            if not np.any(currents):
                return
            waited, self._asked_at = self.time - self._asked_at, self.time
            if waited < RELEASE_TIME:
                return
            self.problem = ""
        if np.any(currents):
            self.began = min(self.began, self.time)
        self._set_currents(currents)
        self._applied_at = min(time, self.time)

    @property
    def held(self) -> bool:
        """Whether the needle is held where it is."""
        return self.began == math.inf or bool(self.problem)

    def advance(self, time: float) -> None:
        """Let needle and thread move up to a time since the start [s]; nothing happens for one that is past.

        Raises:
            SolverError: they have no next state; they stay where they are from now on.
        """
        while self._commands and self._commands[0][0] <= time:
            due, currents = self._commands.popleft()
            self._advance(due)
            self._begin(currents, due)
        self._advance(time)

    def _advance(self, time: float) -> None:
        """Move up to a time [s] under the currents that are in force."""
        if self.problem:
            self.time = max(self.time, time)
            return
        limit = self.time + self._max_time
        off_at = max(self.time, self._applied_at + self._timeout)
        try:
            if self.began == math.inf:  # what it has no time for is left out, as nothing else waits for the thread
                if (span := min(time, limit) - self.time) > 0.0 and self.is_watched:
                    self.dynamics.drive(self.dynamics.tail, self.dynamics.heading, span)
                self.time = max(self.time, time)
                return
            time = min(time, limit)
            if off_at < time:
                if not self._move(off_at):
                    return
                self.switch_off()
            self._move(time)
        except SolverError as error:
            self.problem, self._asked_at = str(error), self.time
            self.switch_off()
            raise

    def switch_off(self) -> None:
        """Set all currents to zero, but that of a stuck coil."""
        self._set_currents(np.zeros_like(self.currents))

    def _set_currents(self, currents: Vector) -> None:
        stuck = self.currents[:1] if "coil_stuck" in self.faults.kinds(self.running) else currents[:1]
        self.currents = np.concatenate([stuck, currents[1:]])

    def _move(self, time: float) -> bool:
        """Move up to a time [s]; return whether it was reached within the iterations."""
        span = time - self.time
        # ROS times resolve 1 ns; what is nearer to the rig's own time waits for the next call.
        if span < 1e-9:
            return True
        moved = self.dynamics.step(self.currents, span, self._max_iterations)
        self.time = time if moved >= span else self.time + moved
        return moved >= span

    @property
    def running(self) -> float:
        """Time since the first current that was not zero, -inf before [s]."""
        return self.time - self.began

    @property
    def status(self) -> str:
        """The state in words, for a person."""
        faults = ", ".join(sorted(self.faults.kinds(self.running)))
        text = "running" if self.running >= 0.0 else "the needle is held until the first current"
        return f"{text}, with {faults}" if faults else text

    def look(self, time: float, *, rendered: bool = True) -> RigFrame:
        """Take a frame at a time since the start [s].

        Args:
            time: of the frame.
            rendered: whether the picture is wanted too, which takes most of the time.
        """
        self.advance(time)
        dynamics, running, chance = self.dynamics, self.running, float(self._random.uniform())
        kinds, away = self.faults.kinds(running), self.faults.lifted(running)
        tail, thread = dynamics.tail + away, dynamics.thread + away
        truth = tail, dynamics.heading, thread, dynamics.thread_pull, dynamics.thread_moment
        lost = "camera_stopped" in kinds or ("dropped_frames" in kinds and chance < 0.5)
        gain = (0.3 if "dim" in kinds else 1.0) * (1.9 if "overexposed" in kinds else 1.0)
        covers, delay = self.faults.covers(running, tail, dynamics.tip + away), self._settings.stamp_delay
        lateness = delay + 0.12 * ("late_frames" in kinds)
        frame = RigFrame(self.time, None, lateness, *truth, lost, covers, gain, delay)
        return self.render(frame) if rendered else frame

    def render(self, frame: RigFrame) -> RigFrame:
        """Return a frame with its picture, where it does not get lost.

        It may be called by another worker than the rest, by one at a time.
        """
        if frame.lost:
            return frame
        image = self.camera.render(frame.tail, frame.heading, frame.thread, frame.covers, frame.gain)
        return replace(frame, image=image)


def ground_truth_outputs(stamp: Stamp, frame: RigFrame) -> Outputs:
    """Yield the ground truth as messages: needle, thread, and how the thread pulls."""
    yield interface.GROUND_TRUTH_NEEDLE, packed_pose_stamped(stamp, frame.tail, frame.heading)
    yield interface.GROUND_TRUTH_THREAD, packed_path(stamp, frame.thread)
    yield interface.GROUND_TRUTH_PULL, packed_wrench(stamp, frame.pull, frame.moment)
