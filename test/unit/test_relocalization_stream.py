"""Global localization from a stream of images and odometry."""

from __future__ import annotations

from dataclasses import replace
import pickle

import numpy as np
from place_scenes import assert_right, LENS, MAP, MOUNT, PANS, SCENE, sweep
import pytest
from scenes import draw_frame

from landmark_nav.geometry import se2
from landmark_nav.localization.relocalization import Relocalizer
from landmark_nav.types import OdometrySample, PoseEstimate, Refusal


def test_a_stream_gathers_views_until_they_suffice() -> None:
    relocalizer = Relocalizer(MAP, MOUNT)
    wheel = np.array([7.0, -3.0, 2.0])
    pose = np.array([1.7, 1.6, 0.1])
    outcomes: list[PoseEstimate | Refusal] = []
    for k in range(60):
        step = np.array([0.012, 0.0, 0.01])
        pose, wheel = se2.compose(pose, step), se2.compose(wheel, step)
        stamp = 50_000_000 * k
        relocalizer.add_odometry(OdometrySample(stamp, wheel))
        if k % 6 == 0:
            frame = draw_frame(SCENE, LENS, MOUNT, pose, 0.06 * k - 2.5, stamp_ns=stamp)
            outcomes.append(relocalizer.add_frame(frame))
        if isinstance(outcomes[-1], PoseEstimate):
            break
    assert isinstance(outcomes[0], Refusal)
    assert_right(outcomes[-1], pose.tolist())


def test_a_place_found_while_the_camera_turns_has_an_uncertain_heading() -> None:
    """Joint states that are late make all images agree on a wrong one."""
    relocalizer = Relocalizer(MAP, MOUNT)
    pose = np.array([2.4, 1.9, 0.4])
    relocalizer.add_odometry(OdometrySample(0, np.zeros(3)))
    relocalizer.add_odometry(OdometrySample(10**9, np.zeros(3)))
    rate, outcome = 1.5, Refusal('nothing seen yet')
    for k, frame in enumerate(sweep(SCENE, pose.tolist())):
        # It rested at first.
        outcome = relocalizer.add_frame(replace(frame, pan_rate_rad_s=rate if k else 0.0))
        if isinstance(outcome, PoseEstimate):
            break
    assert_right(outcome, pose.tolist())
    assert isinstance(outcome, PoseEstimate)
    sigma = np.sqrt(np.diag(outcome.covariance))
    assert sigma[2] == pytest.approx(0.1 * rate, rel=0.01)
    assert sigma[0] < 0.03


def test_a_frozen_camera_shows_nothing_new_at_any_pan() -> None:
    relocalizer = Relocalizer(MAP, MOUNT)
    frame, turned = sweep(SCENE, (2.4, 1.9, 0.4), PANS[:2])
    for k in range(2):
        relocalizer.add_odometry(OdometrySample(k * 10**8, np.zeros(3)))
    first = relocalizer.add_frame(frame)
    assert relocalizer.add_frame(replace(turned, image=frame.image)) is first
    assert relocalizer.add_frame(turned) is not first


def test_a_stream_without_images_does_not_grow() -> None:
    relocalizer = Relocalizer(MAP, MOUNT)
    sizes = []
    for k in range(4000):
        relocalizer.add_odometry(OdometrySample(k * 10**8, np.array([0.02 * k, 0.0, 0.0])))
        if k in (100, 3999):
            sizes.append(len(pickle.dumps(relocalizer)))
    assert sizes[1] < sizes[0] + 100
