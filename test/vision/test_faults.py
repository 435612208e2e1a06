"""Whatever happens before the camera: the pose is right, or there is none."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from magnetosuture_thread.rig.camera import Cover
from magnetosuture_thread.vision.dish import NO_DISH
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import State, VisionTracker
from test.vision.scenes import PIXEL, SCENE, Pose, blob, finger, random_pose, random_thread, render

pytestmark = pytest.mark.slow

TRACKER = VisionTracker(VisionTrackerSettings(), SCENE)
WHITE = (255.0, 255.0, 255.0)
COLOURS = {
    "dark": (30.0, 32.0, 34.0),
    "grey": (125.0, 125.0, 125.0),
    "pale": (175.0, 180.0, 178.0),
    "skin": (120.0, 150.0, 205.0),
    "glove": (150.0, 110.0, 60.0),
}


def check(pose: Pose, frame: np.ndarray) -> str:
    """Look at a frame; fail on a wrong pose, return why there is none."""
    seen = TRACKER.look(frame)
    assert seen.reason or pose.is_right(seen), f"off by {pose.error(seen)}"
    return seen.reason


@pytest.mark.parametrize("opacity", [1.0, 0.6, 0.1])
@pytest.mark.parametrize("share", [-0.02, 0.03, 0.3, 0.6, 0.9, 1.0])
def test_glare_over_a_part_of_the_needle(share: float, opacity: float):
    for seed in range(2):
        pose = random_pose(np.random.default_rng(seed), curved=seed > 0)
        for radius in (0.0003, 0.0008):
            for noise in range(5):
                cover = blob(pose.at(share), radius, WHITE, opacity)
                reason = check(pose, render(pose, seed=noise, covers=(cover,)))
                assert not reason or opacity > 0.1
    assert check(pose, render(pose, covers=(blob(pose.at(0.5), 0.0008, WHITE, 1.0),)))


@pytest.mark.parametrize("colour", COLOURS)
def test_a_hand_or_a_tool_over_or_against_the_needle(colour: str):
    random = np.random.default_rng(7)
    reasons = {}
    for width in (0.0004, 0.0012, 0.006):
        for share in (0.0, 0.25, 0.6, 0.97):
            pose = random_pose(random, curved=share > 0.5)
            end = pose.at(share) + random.normal(0.0, 3.0, 2) * PIXEL
            cover = finger(end, random.uniform(-np.pi, np.pi), width, COLOURS[colour])
            reasons[width, share] = check(pose, render(pose, random_thread(random, pose), covers=(cover,)))
    assert reasons[0.006, 0.25]  # half of the needle is hidden
    assert reasons[0.006, 0.6]


@pytest.mark.parametrize("behind", [True, False], ids=["tail", "tip"])
@pytest.mark.parametrize("colour", ["dark", "grey", "skin"])
def test_a_tool_that_prolongs_or_shortens_the_needle(colour: str, behind: bool):
    pose = Pose(np.array([-0.002, 0.001]), 0.6)
    angle = pose.heading + np.pi if behind else pose.heading
    for over in (-6.0, 0.0, 4.0, 8.0, 20.0):
        along = -np.array([np.cos(angle), np.sin(angle)])
        end = pose.at(0.0 if behind else 1.0) + over * PIXEL * along
        check(pose, render(pose, covers=(finger(end, angle, 0.0005, COLOURS[colour]),)))


@pytest.mark.parametrize("gain", [0.0, 0.03, 0.2, 0.5, 1.3, 1.7, 3.0])
def test_exposure(gain: float):
    pose = Pose(np.array([0.003, -0.002]), 2.5, 200.0)
    reason = check(pose, render(pose, gain=gain))
    assert not reason or not 0.2 <= gain <= 1.3


@pytest.mark.parametrize("length", [2, 5, 9, 17])
@pytest.mark.parametrize("angle", [0.0, 0.8, 1.57])
def test_motion_blur(length: int, angle: float):
    pose = Pose(np.array([0.001, 0.002]), 0.8)
    kernel = np.zeros((19, 19), np.float32)
    ends_px = [(9 + sign * 0.5 * length * np.array([np.cos(angle), -np.sin(angle)])) for sign in (-1, 1)]
    first, last = (np.round(16.0 * end).astype(int).tolist() for end in ends_px)
    cv2.line(kernel, first, last, 1.0, 1, cv2.LINE_AA, 4)
    reason = check(pose, cv2.filter2D(render(pose), -1, kernel / kernel.sum()))
    assert not reason or length > 5
    assert reason or length < 17


def test_over_many_frames_with_faults_no_pose_is_wrong_and_without_them_few_are_missing():
    random = np.random.default_rng(23)
    wrong, given = [], {"clean": 0, "glare": 0, "finger": 0, "exposure": 0}
    for index in range(120):
        fault = tuple(given)[index % 4]
        pose = random_pose(random, curved=index % 8 > 3)
        covers_over: tuple[Cover, ...] = ()
        gain = float(random.uniform(0.1, 2.5)) if fault == "exposure" else 1.0
        place = pose.at(random.uniform(-0.2, 1.2)) + random.normal(0.0, 5.0, 2) * PIXEL
        if fault == "glare":
            covers_over = (blob(place, random.uniform(1e-4, 1.5e-3), WHITE, random.uniform(0.1, 1.0)),)
        elif fault == "finger":
            colour = COLOURS[str(random.choice(list(COLOURS)))]
            covers_over = (finger(place, random.uniform(-np.pi, np.pi), random.uniform(4e-4, 6e-3), colour),)
        seen = TRACKER.look(render(pose, random_thread(random, pose), covers=covers_over, gain=gain))
        given[fault] += not seen.reason
        if not seen.reason and not pose.is_right(seen):
            wrong.append((index, fault, pose.error(seen)))
    assert wrong == []
    assert given["clean"] >= 29
    assert min(given.values()) >= 5


def test_a_needle_that_leaves_over_the_rim():
    for distance in np.arange(0.008, 0.026, 0.0013):
        pose = Pose(distance * np.array([0.8, 0.6]), np.arctan2(0.6, 0.8))
        reason = check(pose, render(pose))
        assert reason or distance < 0.0107  # with its tip in the rim's blurred edge
    assert check(Pose(np.array([0.5, 0.5]), 0.0), render(Pose(np.array([0.5, 0.5]), 0.0)))


def test_of_two_needles_the_one_with_a_thread_is_taken_and_none_if_both_have_one():
    one, other = Pose(np.array([0.002, 0.006]), 0.4), Pose(np.array([-0.004, -0.007]), 0.4)
    threads = [each.tail - np.linspace(0.0, 0.01, 40)[:, None] * np.array([1.0, 0.1]) for each in (one, other)]
    with_thread = render(one, threads[0])
    assert check(one, np.minimum(with_thread, render(other))) == ""
    assert TRACKER.look(np.minimum(with_thread, render(other, threads[1]))).reason.startswith("2 needles in the dish")


def something_else(kind: str) -> np.ndarray:
    """Return a picture in which there is no dish."""
    if kind == "noise":
        return np.random.default_rng(3).integers(0, 255, (480, 640, 3)).astype(np.uint8)
    picture = np.full((480, 640, 3), 0 if kind == "black" else 190, np.uint8)
    if kind == "face":
        cv2.ellipse(picture, (320, 240), (130, 180), 0, 0, 360, (140, 165, 215), -1)
    return picture


@pytest.mark.parametrize("kind", ["black", "noise", "face"])
def test_a_video_of_something_else_is_lost_with_its_reason_and_the_needle_is_back_with_the_dish(kind: str):
    pose = Pose(np.array([0.003, -0.002]), 0.4)
    frame, other = render(pose, random_thread(np.random.default_rng(1), pose)), something_else(kind)
    assert VisionTracker(VisionTrackerSettings(), SCENE).look(other).reason == NO_DISH
    tracker = VisionTracker(VisionTrackerSettings(), SCENE)
    states = [tracker.track(frame, 0.02 * index).state for index in range(4)]
    assert states[-1] is State.TRACKED
    for index in range(4, 12):
        seen = tracker.track(other, 0.02 * index)
        assert seen.state is State.LOST
        assert seen.reason.startswith("too little of the dish is seen")
    back = tracker.track(frame, 0.24)
    assert back.state is State.TRACKED
    assert pose.is_right(back)


def test_a_bumped_camera_is_tracked_again_once_its_view_and_the_needle_agree_in_three_frames_each():
    pose = Pose(np.array([0.003, -0.002]), 0.4)
    frame = render(pose)
    moved = cv2.warpAffine(
        frame, np.array([[1.0, 0.0, 9.0], [0.0, 1.0, -6.0]]), (640, 480), borderMode=cv2.BORDER_REPLICATE
    )
    tracker = VisionTracker(VisionTrackerSettings(), SCENE)
    for index in range(4):
        tracker.track(frame, 0.02 * index)
    seen = [tracker.track(moved, 0.1 + 0.02 * index) for index in range(5)]
    assert [each.reason for each in seen[:2]] == ["the dish is not where it was"] * 2
    assert seen[4].state is State.TRACKED
    assert pose.is_right(seen[4])
