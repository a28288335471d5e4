"""What a bag says of where its sweeps were taken, if no paper does: poses given, or odometry."""

from __future__ import annotations

from collections.abc import Sequence

from landmark_nav.errors import LandmarkNavError
from landmark_nav.learning.sheets import SheetsConfig
from landmark_nav.localization import sweep_places
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.messages import decode
from landmark_nav.storage.bags import Bag
from landmark_nav.storage.bags.message_filter import MessageFilter
from landmark_nav.types import OdometrySample, PlaceChain, Sweep

__all__ = ['check_scale', 'known_places']


def check_scale(bag: Bag, sheets: SheetsConfig) -> None:
    """
    Check that something gives the scale of a map that is learned without a plan.

    Raises
    ------
    LandmarkNavError
        Nothing does.

    """
    posed = bag.find('sweep/pose') or bag.find('odom')
    if not (posed or sheets.has_papers or sheets.has_markers):
        raise LandmarkNavError(
            f'{bag.path}: nothing gives the scale: record odom, publish sweep/pose, hang sheets '
            '(--paper-size, --marker-size), or measure walls and papers (--room)'
        )


def known_places(
    bag: Bag, sweeps: Sequence[Sweep], config: OdometryNoiseConfig
) -> list[PlaceChain]:
    """
    Poses of sweeps by each source of a bag that has them, as of `sweep_places.known_places`.

    Raises
    ------
    LandmarkNavError
        One does not say where each was taken, or the robot moved in one of them.

    """
    spans = [(sweep.frames[0].stamp_ns, sweep.frames[-1].stamp_ns) for sweep in sweeps]
    given = [sweep.pose_map_base for sweep in sweeps]
    try:
        return sweep_places.known_places(given, spans, _odometry(bag), config)
    except LandmarkNavError as error:
        raise LandmarkNavError(f'{bag.path}: {error}') from error


def _odometry(bag: Bag) -> list[OdometrySample]:
    """Odometry of a bag, by time; none where it has none."""
    if not (topic := bag.find('odom')):
        return []
    messages = MessageFilter(bag, topic)
    read = (
        messages.take(lambda entry: decode.odometry(entry.message), entry)
        for entry in bag.messages([topic])
    )
    samples = sorted((s for s in read if s is not None), key=lambda s: s.stamp_ns)
    messages.report()
    return samples
