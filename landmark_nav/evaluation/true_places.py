"""Ground truth of learning: where sweeps were taken."""

from __future__ import annotations

from landmark_nav.errors import LandmarkNavError
from landmark_nav.evaluation.tracks import PoseTrack
from landmark_nav.messages import decode
from landmark_nav.storage.bags import Bag
from landmark_nav.storage.bags.reader import MessageFilter
from landmark_nav.storage.bags.sensors import truth_decoder


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
