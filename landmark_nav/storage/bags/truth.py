"""Ground truth of a bag: for figures alone, so that nothing wrong with it stops anything."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from landmark_nav.messages import decode
from landmark_nav.storage.bags.reader import Bag, BagMessage
from landmark_nav.types import PoseEstimate

__all__ = ['truth_decoder']

# What is compared with the truth, in order.
_BESIDE = (
    *('odom', 'joint_states', 'camera/image_raw', 'camera/image_raw/compressed'),
    *('sweep/image', 'sweep/image/compressed'),
)
# A transport delays less than this; of clocks that differ the difference stays within the last.
_OTHER_CLOCK_NS, _STEADY_NS = 500_000_000, 50_000_000


def truth_decoder(bag: Bag, topic: str) -> Callable[[BagMessage], PoseEstimate]:
    """
    Decoder of the messages of a topic with the ground truth.

    Where it was stamped by another clock than the sensors, which the times of recording show, its
    poses are moved to theirs, and the bag reports it.
    """
    shift_ns = _shift_ns(bag, topic)

    def pose(entry: BagMessage) -> PoseEstimate:
        truth = decode.pose_estimate(entry.message)
        return PoseEstimate(truth.stamp_ns + shift_ns, truth.pose, truth.covariance)

    return pose


def _shift_ns(bag: Bag, topic: str) -> int:
    names = (name for name in _BESIDE for name in bag.candidates(name)[:1])
    beside = next((name for name in names if name in bag.stamps_ns), None)
    if beside is None or topic not in bag.stamps_ns:
        return 0
    (log_ns, stamp_ns), (logged_ns, stamped_ns) = bag.stamps_ns[topic].T, bag.stamps_ns[beside].T
    near = np.clip(np.searchsorted(logged_ns, log_ns), 0, len(logged_ns) - 1)
    behind = (stamped_ns - logged_ns)[near] - (stamp_ns - log_ns)
    shift_ns = int(np.median(behind))
    spread_ns = float(np.median(np.abs(behind - shift_ns)))
    if abs(shift_ns) < _OTHER_CLOCK_NS or spread_ns > _STEADY_NS:
        return 0
    bag.inform(
        f'{topic} is on another clock, {-1e-9 * shift_ns:+.3f} s off that of {beside}: its errors '
        'are taken with that put right'
    )
    return shift_ns
