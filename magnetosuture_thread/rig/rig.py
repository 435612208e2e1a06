"""The simulated rig: currents in, frames out."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.bags.cdr import Stamp
from magnetosuture_thread.bags.packing import Outputs, packed_path, packed_pose_stamped, packed_wrench
from magnetosuture_thread.geometry.scene import Scene, find_collision
from magnetosuture_thread.rig.camera import Cover, DishCamera, Image
from magnetosuture_thread.rig.faults import COIL_STUCK
from magnetosuture_thread.rig.settings import RigSettings
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.errors import InvalidInputError, SolverError

Vector = NDArray[np.float64]

RELEASE_TIME = 1.0  # s without currents asked for, after which a rig with a problem tries again


@dataclass(frozen=True)
class RigFrame:
    """One frame and the truth of its moment.

    Attributes:
        time: since the start [s].
        image: BGR, shape (height, width, 3); None if the frame got lost, or is not rendered.
        lateness: how long it is held back before anybody gets it [s].
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
        is_watched: whether the thread moves before the first current; a node waits for a model that follows it.

    Raises:
        ConfigurationError: needle or thread would start in the wall or in a shape.
    """

    def __init__(
        self, settings: RigSettings, scene: Scene, *, max_time: float = math.inf, max_iterations: float = math.inf
    ) -> None:
        settings.check_scene(scene)
        self._settings, self.scene = settings, scene
        self._dynamics = settings.dynamics(scene)
        self._camera: DishCamera | None = None  # drawn when it is needed first, which takes a second
        self.faults = settings.schedule(scene)
        self._random = np.random.default_rng(settings.seed + 1)
        self.time = 0.0
        self.began = math.inf
        self.currents = np.zeros(len(settings.coil_angles))
        self._applied_at = 0.0
        self._max_time, self._max_iterations = max_time, max_iterations
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
        for name, points in {"needle": self._dynamics.body, "thread": self._dynamics.thread}.items():
            if what := find_collision(new, points, holes=False):
                raise InvalidInputError("scene", f"{what} where the {name} is", "shapes off needle and thread")
        camera = None if self._camera is None else self._settings.camera(scene)
        self._dynamics.set_surface(self._settings.surface(scene))
        self.scene, self._camera = scene, camera
        self.faults.set_dish(scene.dish.diameter)

    def apply(self, currents: Vector, time: float) -> None:
        """Set the coils' currents from a time on; until then the last ones are in force.

        Args:
            currents: of each coil, shape (m,) [A].
            time: since the start [s].

        Raises:
            InvalidInputError: of the wrong number, or not finite.
        """
        if currents.shape != self.currents.shape or not np.all(np.isfinite(currents)):
            expected = f"{len(self.currents)} finite numbers [A]"
            raise InvalidInputError("rig/currents.current", currents.tolist(), expected)
        self.advance(time)
        limit = self._settings.coil_max_current
        currents = np.minimum(np.maximum(currents, -limit), limit)
        if self.problem:
            if not np.any(currents):
                return
            waited, self._asked_at = self.time - self._asked_at, self.time
            if waited < RELEASE_TIME:
                return
            self.problem = ""
        if np.any(currents):
            self.began = min(self.began, self.time)
        stuck = self.currents[0]
        self.currents = currents.copy()
        if COIL_STUCK in self.faults.kinds(self.running):
            self.currents[0] = stuck
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
        if self.problem:
            self.time = max(self.time, time)
            return
        limit = self.time + self._max_time
        off_at = max(self.time, self._applied_at + self._settings.driver_timeout)
        try:
            if self.began == math.inf:  # what it has no time for is left out, as nothing else waits for the thread
                self._hold(min(time, limit) - self.time)
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
        stuck = self.currents[0] if COIL_STUCK in self.faults.kinds(self.running) else 0.0
        self.currents = np.zeros_like(self.currents)
        self.currents[0] = stuck

    def _hold(self, span: float) -> None:
        """Let the thread alone move for a time [s], if somebody watches."""
        if span > 0.0 and self.is_watched:
            self._dynamics.drive(self._dynamics.tail, self._dynamics.heading, span)

    def _move(self, time: float) -> bool:
        """Move up to a time [s]; return whether it was reached within the iterations."""
        span = time - self.time
        # ROS times resolve 1 ns; what is nearer to the rig's own time waits for the next call.
        if span < 1e-9:
            return True
        moved = self._dynamics.step(self.currents, span, self._max_iterations)
        self.time = time if moved >= span else self.time + moved
        return moved >= span

    @property
    def running(self) -> float:
        """Time since the first current that was not zero, -inf before [s]."""
        return self.time - self.began

    @property
    def status(self) -> str:
        """What goes on, for a person."""
        faults = ", ".join(sorted(self.faults.kinds(self.running)))
        text = "running" if self.running >= 0.0 else "the needle is held until the first current"
        return f"{text}, with {faults}" if faults else text

    @property
    def tension(self) -> Vector:
        """Tension of each segment of the thread, shape (n,) [N]."""
        return self._dynamics.tension

    @property
    def thread_pull(self) -> Vector:
        """Force of the thread on the needle, at the tail, shape (2,) [N]."""
        return self._dynamics.thread_pull

    def look(self, time: float, *, rendered: bool = True) -> RigFrame:
        """Take a frame at a time since the start [s].

        Args:
            time: of the frame.
            rendered: whether the picture is wanted too, which takes most of the time.
        """
        self.advance(time)
        faults, dynamics, running = self.faults, self._dynamics, self.running
        away = faults.lifted(running)
        tail, thread = dynamics.tail + away, dynamics.thread + away
        lost = faults.drops(running, float(self._random.uniform()))
        covers = faults.covers(running, tail, dynamics.tip + away)
        truth = tail, dynamics.heading, thread, dynamics.thread_pull, dynamics.thread_moment
        frame = RigFrame(self.time, None, faults.lateness(running), *truth, lost, covers, faults.gain(running))
        return self.render(frame) if rendered else frame

    def render(self, frame: RigFrame) -> RigFrame:
        """Return a frame with its picture, where it does not get lost.

        It may be called in another thread than the rest, by one at a time.
        """
        if frame.lost:
            return frame
        image = self.camera.render(frame.tail, frame.heading, frame.thread, frame.covers, frame.gain)
        return replace(frame, image=image)


def ground_truth_outputs(stamp: Stamp, frame: RigFrame) -> Outputs:
    """Give where needle and thread of a simulation are, and how the thread pulls."""
    yield interface.GROUND_TRUTH_NEEDLE, packed_pose_stamped(stamp, frame.tail, frame.heading)
    yield interface.GROUND_TRUTH_THREAD, packed_path(stamp, frame.thread)
    yield interface.GROUND_TRUTH_PULL, packed_wrench(stamp, frame.pull, frame.moment)
