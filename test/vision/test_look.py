"""One frame alone: the sample frames, and rendered ones in other light."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.rig.camera import CameraScene, DishCamera, Lighting
from magnetosuture_thread.scene import Dish
from magnetosuture_thread.scene import Scene as DishScene
from magnetosuture_thread.thread_observation import PieceEnd, ThreadObservation, ThreadPiece
from magnetosuture_thread.vision.dish.tilt import Tilt
from magnetosuture_thread.vision.look import FoundDish, State, _in_dish, see_dish, tilted
from magnetosuture_thread.vision.needle.arc import Arc
from magnetosuture_thread.vision.needle.measured_needle import MeasuredNeedle
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import VisionTracker
from test.vision.scenes import (
    CURVATURES,
    NOWHERE,
    PIXEL,
    SCENE,
    VIEW,
    Pose,
    line_error,
    random_pose,
    random_thread,
    render,
)

SAMPLES = Path(__file__).parent / "samples"
TRACKER = VisionTracker(VisionTrackerSettings(), SCENE)
GIVEN_VIEW = VisionTracker(
    VisionTrackerSettings(dish_centre_px=VIEW.centre_px, metres_per_pixel=VIEW.metres_per_pixel), SCENE
)
LIGHTS = {
    "usual": Lighting(),
    "dark": Lighting(gain=0.5, slope=3.0, tint_bgr=(0.9, 0.95, 1.0)),
    "bright": Lighting(gain=1.2, slope=-3.0, glare=1.4, tint_bgr=(1.0, 0.97, 0.9)),
    "noisy": Lighting(noise=3.0),
    "blurred": Lighting(blur_px=1.2),
}


@pytest.mark.parametrize("given_view", [True, False])
def test_the_sample_frames_are_measured_to_half_a_pixel_and_a_degree(given_view: bool):
    truth = json.loads((SAMPLES / "truth.json").read_text())
    known = VisionTrackerSettings(dish_centre_px=(322.0, 238.0), metres_per_pixel=8e-5)
    tracker = VisionTracker(known if given_view else VisionTrackerSettings(), SCENE)
    tails, angles, tips, lines = [], [], [], []
    for frame in truth["frames"]:
        image = cv2.imread(str(SAMPLES / frame["file"]))
        assert image is not None
        seen = tracker.look(image)
        assert seen.state is State.TRACKED, seen.reason
        pose = Pose(VIEW.to_dish(np.array(frame["tail_px"])), frame["heading_rad"])
        apart, turned = pose.error(seen)
        tails.append(apart)
        angles.append(turned)
        tips.append(np.linalg.norm(VIEW.to_pixels(seen.tip) - frame["tip_px"]))
        lines.append(line_error(VIEW.to_pixels(seen.centreline), np.array(frame["thread_px"])))
    assert np.sqrt(np.mean(np.square(tails))) < 0.5
    assert np.degrees(np.sqrt(np.mean(np.square(angles)))) < 0.5
    assert np.sqrt(np.mean(np.square(tips))) < 1.0
    assert np.mean([mean for mean, _ in lines]) < 0.6
    assert min(share for _, share in lines) > 0.95


@pytest.mark.parametrize("curved", [False, True], ids=["straight", "curved"])
@pytest.mark.parametrize("light", LIGHTS)
def test_rendered_needles_are_measured_in_any_light(light: str, curved: bool):
    tails, angles, tips, lines, scaled = [], [], [], [], []
    for seed in range(4):
        random = np.random.default_rng(seed)
        pose = random_pose(random, curved=curved)
        thread = random_thread(random, pose)
        image = render(pose, thread, lighting=LIGHTS[light])
        seen = TRACKER.look(image)
        assert seen.reason == ""
        apart, turned = pose.error(seen)
        tails.append(apart)
        angles.append(turned)
        tips.append(np.linalg.norm(seen.tip - pose.at(1.0)) / PIXEL)
        lines.append(line_error(VIEW.to_pixels(seen.centreline), VIEW.to_pixels(thread)))
        assert seen.curvature == pytest.approx(pose.curvature, abs=15.0)
        assert 0.0 < seen.confidence <= 1.0
        known = GIVEN_VIEW.look(image)  # A view that is found leaves the camera's tilt unknown, and this one has none.
        error = np.array([*(known.tail - pose.tail), pose.error(known)[1]])
        scaled.append(error @ np.linalg.solve(known.covariance, error) / 3.0)
    assert np.sqrt(np.mean(np.square(tails))) < 0.5
    assert np.degrees(np.sqrt(np.mean(np.square(angles)))) < 1.0
    assert np.sqrt(np.mean(np.square(tips))) < 1.2
    assert np.mean([mean for mean, _ in lines]) < 1.0
    assert np.mean([share for _, share in lines]) > 0.95
    assert 0.05 < np.mean(scaled) < 5.0  # 1 for errors as large as the covariance says


def test_over_curvatures_lights_and_noise_tail_heading_and_thread_are_accurate():
    tails: list[float] = []
    angles: list[float] = []
    lines: list[tuple[float, float]] = []
    lost: list[str] = []
    for number, light in enumerate(LIGHTS.values()):
        for curvature in CURVATURES:
            random = np.random.default_rng(200 + number)
            drawn = random_pose(random, curved=False, within=0.0125)
            pose = Pose(drawn.tail, drawn.heading, curvature)
            thread = random_thread(random, pose)
            seen = TRACKER.look(render(pose, thread, seed=5 + number, lighting=light))
            if seen.reason:
                lost.append(seen.reason)
                continue
            apart, turned = pose.error(seen)
            tails.append(apart)
            angles.append(turned)
            lines.append(line_error(VIEW.to_pixels(seen.centreline), VIEW.to_pixels(thread)))
            assert np.sign(seen.curvature) == np.sign(curvature)
    assert min(CURVATURES) < 0.0 < max(CURVATURES)
    assert len(lost) <= 2, lost
    assert np.sqrt(np.mean(np.square(tails))) <= 0.5
    assert np.degrees(np.sqrt(np.mean(np.square(angles)))) <= 1.0
    assert np.mean([mean for mean, _ in lines]) <= 1.0
    assert np.mean([share for _, share in lines]) >= 0.95


def test_over_many_poses_the_covariance_is_about_right():
    """With a view that is given: one that is found leaves the camera's tilt unknown, and this camera has none."""
    scaled = []
    for seed in range(10):
        random = np.random.default_rng(100 + seed)
        pose = random_pose(random, curved=True)
        seen = GIVEN_VIEW.look(render(pose, random_thread(random, pose)))
        error = np.array([*(seen.tail - pose.tail), pose.error(seen)[1]])
        scaled.append(error @ np.linalg.solve(seen.covariance, error) / 3.0)
    assert 0.3 < np.mean(scaled) < 2.0


def test_a_larger_dish_with_a_faint_thread_is_tracked():
    view = DishView((644.0, 476.0), 0.15 / 875.0)
    camera = DishCamera(
        CameraScene(dish_diameter=0.15, needle_curvature=150.0, thread_diameter=66e-6), view, (1280, 960), 1
    )
    s = np.linspace(0.0, 0.15, 500)
    tail, angle = np.array([0.03, 0.01]), np.pi - 0.4 + 35.0 * s
    thread = np.vstack([tail, tail + np.cumsum(0.15 / 500 * np.column_stack([np.cos(angle), np.sin(angle)]), axis=0)])
    seen = VisionTracker(VisionTrackerSettings(thread_length=0.15), DishScene(Dish(0.15))).look(
        camera.render(tail, -0.4, thread)
    )
    assert seen.reason == ""
    assert np.linalg.norm(seen.tail - tail) < 1.0 * view.metres_per_pixel
    assert abs(np.arctan2(seen.heading[1], seen.heading[0]) + 0.4) < np.radians(2.0)
    mean, share = line_error(view.to_pixels(seen.centreline), view.to_pixels(thread))
    assert mean < 1.0
    assert share > 0.95


def test_without_a_dish_it_says_lost():
    seen = TRACKER.look(np.full((480, 640, 3), 120, np.uint8))
    assert (seen.state, seen.reason, seen.view) == (State.LOST, "no dish in the image", None)
    assert seen.tail.size == seen.heading.size == seen.centreline.size == seen.covariance.size == 0


def test_a_dish_of_another_size_than_the_scale_says_is_none():
    frame = render(Pose(np.zeros(2), 0.3))
    assert VisionTracker(VisionTrackerSettings(metres_per_pixel=8e-5), SCENE).look(frame).reason == ""
    assert (
        VisionTracker(VisionTrackerSettings(metres_per_pixel=9e-5), SCENE).look(frame).reason == "no dish in the image"
    )


def test_without_a_needle_it_says_lost():
    seen = TRACKER.look(render(Pose(np.array([0.5, 0.5]), 0.0)))
    assert (seen.state, seen.reason) == (State.LOST, "no needle in the dish")


def test_a_needle_without_a_thread_has_no_centreline():
    seen = TRACKER.look(render(Pose(np.zeros(2), 0.7), NOWHERE))
    assert seen.reason == ""
    assert len(seen.centreline) == 1


def test_grey_frames_of_another_size_are_taken():
    pose = Pose(np.zeros(2), 0.2)
    grey = cv2.resize(render(pose)[:, :, 1], (800, 600), interpolation=cv2.INTER_CUBIC)
    seen = TRACKER.look(grey)
    assert seen.reason == ""
    assert pose.is_right(seen)


@pytest.mark.parametrize("rotation", [0.5, -2.0])
def test_a_turned_camera_gives_the_same_pose_in_the_dish(rotation: float):
    pose = Pose(np.array([0.003, -0.002]), 0.8, 120.0)
    cosine, sine = np.cos(rotation), np.sin(rotation)
    turned = Pose(np.array([[cosine, -sine], [sine, cosine]]) @ pose.tail, pose.heading + rotation, pose.curvature)
    seen = VisionTracker(VisionTrackerSettings(camera_rotation=rotation), SCENE).look(render(turned))
    apart, angle = pose.error(seen)
    assert apart < 1.0
    assert abs(angle) < np.radians(1.5)
    assert np.linalg.norm(seen.tip - pose.at(1.0)) < 2.0 * PIXEL
    assert seen.curvature == pytest.approx(120.0, abs=15.0)


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((480, 640, 3), np.float32),
        np.zeros((480, 640, 4), np.uint8),
        np.zeros((10, 10, 3), np.uint8),
        np.zeros(7, np.uint8),
        np.zeros((0, 0, 3), np.uint8),
    ],
)
def test_what_is_no_image_is_refused(image: np.ndarray):
    with pytest.raises(InvalidInputError, match="image"):
        TRACKER.look(image)
    with pytest.raises(InvalidInputError, match="image"):
        VisionTracker(VisionTrackerSettings(), SCENE).track(image, 0.0)


def at_wall(end: str, gap: float, angle: float) -> tuple[np.ndarray, float]:
    """Return tail and heading of a needle whose tip, tail or side is so far from the wall [m]."""
    length, width, radius = 0.007, 0.0004, SCENE.dish.radius
    outward = np.array([np.cos(angle), np.sin(angle)])
    if end == "tip":
        return outward * (radius - gap - length), angle
    if end == "tail":
        return outward * (radius - gap - 0.5 * width), angle + np.pi
    heading = angle + 0.5 * np.pi
    along = np.array([np.cos(heading), np.sin(heading)])
    return outward * np.sqrt((radius - gap - 0.5 * width) ** 2 - 0.25 * length**2) - 0.5 * length * along, heading


@pytest.mark.parametrize("gap", [0.0, 1e-4, 3e-4])
@pytest.mark.parametrize("end", ["tip", "tail", "side"])
def test_a_needle_at_the_wall_is_found(camera: DishCamera, thread_arc, end: str, gap: float):
    """At once with an end at the wall; along it, where both ends may look alike, if it was seen on its way there."""
    way = np.arange(5e-4, 0.0, -1e-4) if end == "side" else np.empty(0)
    lost = followed = 0
    for angle in np.linspace(0.1, 6.2, 8):
        tracker = VisionTracker(VisionTrackerSettings(confirm_frames=1), SCENE)
        for index, apart in enumerate((*(gap + way), gap)):
            tail, heading = at_wall(end, apart, angle)
            away = heading + {"tip": np.pi, "tail": 1.4, "side": np.pi - 0.6}[end]  # into the dish
            thread = thread_arc(tail, away, 0.0, 0.008)
            seen = tracker.track(camera.render(tail, heading, thread), 0.1 * index)
        lost += seen.state is not State.TRACKED
        if seen.state is State.TRACKED:
            off, turned = Pose(tail, heading).error(seen)
            assert off < 1.0  # px
            assert abs(turned) < np.radians(1.0)
            if len(seen.centreline) > 1:  # where the thread leaves along the wall's normal it is not always seen
                assert line_error(VIEW.to_pixels(seen.centreline), VIEW.to_pixels(thread))[0] < 1.0
            followed += end != "tail" and line_error(VIEW.to_pixels(seen.centreline), VIEW.to_pixels(thread))[1] > 0.9
    assert end == "tail" or followed + lost == 8
    assert lost <= (end == "side" and gap == 0.0)  # as 1 of 240 others was


def test_a_wrong_scale_leaves_unknown_how_far_out_a_tail_is_and_nothing_else():
    outward, across = np.array([0.6, 0.8]), np.array([-0.8, 0.6])
    covariance = FoundDish(VIEW, scale_error=0.02).covariance(0.01 * outward, across, 0.0175)
    place = covariance[:2, :2]
    assert math.sqrt(outward @ place @ outward) == pytest.approx(0.02 * 0.01)
    np.testing.assert_allclose(place @ across, 0.0, atol=1e-15)
    np.testing.assert_allclose(covariance[2], 0.0, atol=1e-15)


def test_the_scale_is_known_only_where_it_is_given_and_the_dish_agrees():
    gray = render(Pose(np.zeros(2), 0.3))
    errors = {}
    for scale in (0.0, 8e-5, 8.4e-5):
        found = see_dish(gray, VisionTrackerSettings(metres_per_pixel=scale), 0.035)
        assert found is not None
        assert found.view.metres_per_pixel == pytest.approx(8e-5, rel=6e-3)
        errors[scale] = found.scale_error
    assert errors[8e-5] == 0.0 < errors[0.0] == errors[8.4e-5]


def test_a_covariance_in_the_image_is_that_of_what_it_moves_in_the_dish():
    """By differences: the needle is moved along and aside of its axis and turned, and looked at in the dish."""
    view = DishView((322.0, 238.0), 8e-5, rotation=0.4)
    arc = Arc(np.array([350.0, 200.0]), 0.7, 0.0)
    along, aside = np.array([math.cos(0.7), math.sin(0.7)]), np.array([-math.sin(0.7), math.cos(0.7)])
    covariance = np.array([[0.04, 0.01, 0.0], [0.01, 0.09, 0.003], [0.0, 0.003, 0.0004]])
    needle = MeasuredNeedle(arc, 87.0, 5.0, covariance=covariance)

    def pose(arc: Arc) -> np.ndarray:
        moved = replace(needle, arc=arc)
        heading = view.directions_to_dish(moved.direction_px)
        return np.array([*view.to_dish(moved.tail_edge_px), math.atan2(heading[1], heading[0])])

    step = 1e-4
    changed = [replace(arc, start=arc.start + step * way) for way in (along, aside)] + [replace(arc, angle=0.7 + step)]
    moves = np.column_stack([(pose(each) - pose(arc)) / step for each in changed])
    np.testing.assert_allclose(_in_dish(needle, view), moves @ covariance @ moves.T, rtol=1e-3, atol=1e-16)


def test_under_a_tilted_camera_pieces_of_thread_are_as_unsure_as_the_view_is_at_their_farthest_point():
    points = np.array([[0.002, 0.001], [0.006, 0.009], [0.004, 0.003]])
    piece = ThreadPiece(points, np.array([3e-5, 4e-5, 5e-5]), PieceEnd.TAIL, PieceEnd.FREE, (0.0, 0.0), True, 1.0)
    seen = replace(TRACKER.look(render(Pose(np.zeros(2), 0.3))), observation=ThreadObservation((piece,)))
    dish = FoundDish(VIEW, tilt=Tilt(0.2, 0.4))
    track = tilted(seen, dish, 0.0175)
    assert track.warning == "the camera is tilted by 11 degrees"
    (less_sure,) = track.observation.pieces
    assert dish.tilt is not None
    unsure = dish.tilt.covariance(points[1], np.array([1.0, 0.0]), 0.0175)[:2, :2]
    ways = np.column_stack([np.cos(turns := np.linspace(0.0, np.pi, 2000)), np.sin(turns)])
    greatest = np.einsum("ki,ij,kj->k", ways, unsure, ways).max()
    np.testing.assert_allclose(less_sure.deviation**2, piece.deviation**2 + greatest, rtol=1e-5)


def test_a_dark_frame_is_taken_for_a_negative_only_where_its_negative_shows_the_dish():
    settings = VisionTrackerSettings(dish_centre_px=VIEW.centre_px, metres_per_pixel=VIEW.metres_per_pixel)
    frame = render(Pose(np.zeros(2), 0.3))
    for image, negative in ((frame, False), (255 - frame, True), (np.full_like(frame, 40), False)):
        found = see_dish(image, settings, 0.035)
        assert found is not None
        assert found.dark_field == negative


def test_a_scale_that_is_not_given_makes_a_thread_less_sure_across_it_the_farther_out_it_is():
    """An error s of the scale moves a point p by s p, and across a thread with the tangent t by s |p x t|."""
    pose = Pose(np.array([0.012, -0.004]), -1.5)
    frame = render(pose, pose.tail + np.linspace(0.0, 0.011, 60)[:, None] * np.array([0.05, 1.0]))
    (given, *_), (found, *_) = (tracker.look(frame).observation.pieces for tracker in (GIVEN_VIEW, TRACKER))
    along = np.diff(found.points, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.abs(found.points[1:, 0] * along[:, 1] - found.points[1:, 1] * along[:, 0])
    more = np.mean(found.deviation**2) - np.mean(given.deviation**2)
    assert more == pytest.approx(np.mean((0.001 * across) ** 2), rel=0.1)


@pytest.mark.parametrize(("scale", "factor"), [(0.0, 1), (2e-5, 4), (1e-6, 7)])
def test_frames_are_shrunk_until_the_needle_is_five_pixels_wide_or_the_frame_small(scale: float, factor: int):
    """By the scale that is given: 0.4 mm are then 20 px, and 400 px of a frame of 480 rows, of which 64 are left."""
    assert VisionTrackerSettings(needle_width=4e-4, metres_per_pixel=scale).working_factor((480, 640), 0.035) == factor
