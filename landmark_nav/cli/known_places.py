"""What a bag says of where its sweeps were taken, if no paper does: poses given, or odometry."""

from __future__ import annotations

from collections.abc import Sequence

from landmark_nav.errors import LandmarkNavError
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.localization.sweep_places import given_places, places_by_odometry
from landmark_nav.messages import decode
from landmark_nav.storage.bags import Bag
from landmark_nav.storage.bags.message_filter import MessageFilter
from landmark_nav.types import OdometrySample, PlaceChain, Sweep

__all__ = ['known_places', 'scale_source']


def scale_source(bag: Bag) -> str:
    """
    Name what gives the scale of a map that is learned without a plan.

    Raises
    ------
    LandmarkNavError
        Nothing does.

    """
    for topic in ('sweep/pose', 'odom'):
        if bag.find(topic):
            return topic
    raise LandmarkNavError(
        f'{bag.path}: nothing gives the scale: record odom from sweep to sweep, publish '
        'sweep/pose, or measure walls and papers and give --room'
    )


def known_places(bag: Bag, sweeps: Sequence[Sweep], config: OdometryNoiseConfig) -> PlaceChain:
    """
    Poses of sweeps as `scale_source` gives them.

    Raises
    ------
    LandmarkNavError
        It does not say where each was taken, or the robot moved in one of them.

    """
    samples = [] if scale_source(bag) == 'sweep/pose' else _odometry(bag)
    try:
        if not samples:
            return given_places([sweep.pose_map_base for sweep in sweeps])
        spans = [(sweep.frames[0].stamp_ns, sweep.frames[-1].stamp_ns) for sweep in sweeps]
        return places_by_odometry(spans, samples, config)
    except LandmarkNavError as error:
        raise LandmarkNavError(f'{bag.path}: {error}') from error


def _odometry(bag: Bag) -> list[OdometrySample]:
    """Odometry of a bag, by time."""
    topic = bag.require('odom')
    messages = MessageFilter(bag, topic)
    read = (
        messages.take(lambda entry: decode.odometry(entry.message), entry)
        for entry in bag.messages([topic])
    )
    samples = sorted((s for s in read if s is not None), key=lambda s: s.stamp_ns)
    messages.report()
    return samples
