"""Ground truth of learning: where sweeps were taken, and where landmarks then really are."""

from __future__ import annotations

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.evaluation.tracks import PoseTrack
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.learning.pipeline import LearningResult
from landmark_nav.messages import decode
from landmark_nav.storage.bags import Bag
from landmark_nav.storage.bags.reader import MessageFilter
from landmark_nav.storage.bags.sensors import truth_decoder
from landmark_nav.types import FloatArray, Landmark


def truth_of_bag(bag: Bag) -> PoseTrack:
    """Ground truth of a bag; empty where it has none."""
    topic = bag.find('ground_truth/odom')
    if topic is None:
        return PoseTrack.of(())
    message_filter, decoder = MessageFilter(bag, topic, needed=False), truth_decoder(bag, topic)
    poses = [message_filter.take(decoder, entry) for entry in bag.messages([topic])]
    message_filter.report()
    return PoseTrack.of((pose.stamp_ns, pose.pose) for pose in poses if pose is not None)


def check_truth_frame(bag: Bag, frame: str) -> None:
    """Warn where the ground truth of a bag is given in another frame than `frame`."""
    topic = bag.find('ground_truth/odom')
    first = next(bag.messages([topic]), None) if topic else None
    try:
        found = '' if first is None else str(first.message.header.frame_id)
    except LandmarkNavError:
        return  # its errors are reported where it is read
    if found and not decode.same_frame(found, frame):
        bag.warn(
            f'{bag.path}: {topic} is in frame {found}, the map in {frame}: errors are right only '
            'where both are the same'
        )


def true_places(result: LearningResult, true_poses: FloatArray, mount: PanTiltMount) -> FloatArray:
    """
    Where the true rays to the patches of the landmarks end.

    A patch is as far off its wall as its landmark, so that the two differ along the wall alone:
    posters hang a finger's breadth before it, nobody knows how far.

    Parameters
    ----------
    true_poses : ndarray, shape (k, 3)
        Of the base, one a panorama.

    Returns
    -------
    ndarray, shape (n, 2)
        In the order of the map.

    """
    truth = np.zeros((len(result.map.landmarks), 2))
    for pose, panorama, candidates, outcomes in zip(
        true_poses, result.panoramas, result.candidates, result.outcomes, strict=True
    ):
        axis = mount.axis_pose_map(pose)[:2]
        for candidate, outcome in zip(candidates, outcomes, strict=True):
            if isinstance(outcome, Landmark):
                azimuth = float(panorama.cylinder.azimuth_rad(candidate.column)) + pose[2]
                ray, normal = np.array([np.cos(azimuth), np.sin(azimuth)]), outcome.normal[:2]
                reach = (outcome.position[:2] - axis) @ normal / (ray @ normal)
                place = axis + reach * ray
                truth[result.map.indices(np.array([outcome.id]))[0]] = place
    return truth
