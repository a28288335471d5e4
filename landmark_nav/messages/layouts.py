"""Layouts on the wire: what each PointCloud2 topic carries, where covariances keep what."""

from __future__ import annotations

import numpy as np

__all__ = [
    'DETECTION',
    'DETECTION_DELAYS',
    'FOUND_PLACE',
    'JOINT_DELAY',
    'LANDMARK_FIELDS',
    'PLANAR',
    'TRIPLET',
    'UPRIGHT',
    'landmark_layout',
]

# Of x, y, heading and of x, y, z, heading in ROS' covariance of x, y, z, roll, pitch, yaw.
PLANAR = np.ix_([0, 1, 5], [0, 1, 5])
UPRIGHT = np.ix_([0, 1, 2, 5], [0, 1, 2, 5])

# By how much the stamps of the joints were taken to be late is the same in all rows: as the node
# was told, and as was measured beyond that.
DETECTION = np.dtype(
    [
        ('id', '<u4'),
        ('bearing', '<f8'),
        ('bearing_variance', '<f8'),
        ('score', '<f4'),
        ('u', '<f4'),
        ('v', '<f4'),
        ('joint_delay', '<f8'),
        ('pan_delay', '<f8'),
    ]
)
# Older recordings lack these.
DETECTION_DELAYS = ('joint_delay', 'pan_delay')

JOINT_DELAY = np.dtype([('delay', '<f8'), ('sigma', '<f8')])

# Covariance of the promised fix and the pan to turn to are the same in all three rows.
TRIPLET = np.dtype(
    [
        ('id', '<u4'),
        ('bearing', '<f8'),
        ('bearing_sigma', '<f8'),
        ('pan', '<f8'),
        ('covariance', '<f8', (9,)),
    ]
)

# Rows are landmarks; all but the first field is the same in all of them.
FOUND_PLACE = np.dtype(
    [
        ('id', '<u4'),
        ('pose', '<f8', (3,)),
        ('covariance', '<f8', (9,)),
        ('pan_rate', '<f8'),
        ('joint_delay', '<f8'),
        ('pan_delay', '<f8'),
    ]
)

# x, y, z must be float32: RViz draws no other point clouds.
LANDMARK_FIELDS: list[tuple[str, str] | tuple[str, str, tuple[int]]] = [
    ('id', '<u4'),
    ('x', '<f4'),
    ('y', '<f4'),
    ('z', '<f4'),
    ('normal_x', '<f4'),
    ('normal_y', '<f4'),
    ('normal_z', '<f4'),
    ('width', '<f4'),
    ('height', '<f4'),
    ('viewpoint_x', '<f4'),
    ('viewpoint_y', '<f4'),
    ('viewpoint_z', '<f4'),
    ('threshold', '<f4'),
    ('saliency', '<f4'),
    ('atlas_x', '<u4'),
    ('atlas_y', '<u4'),
    ('atlas_width', '<u4'),
    ('atlas_height', '<u4'),
    ('wall', '<i4'),
    ('covariance', '<f8', (9,)),
]


def landmark_layout(factors: int, walls: int, name_bytes: int, views: int) -> np.dtype[np.void]:
    """
    Return the layout of ``landmarks``.

    Beside its own values each row repeats what belongs to the map: the outline of the walls
    (start x, y, end x, y, height of each) and their names, so that the one topic suffices.
    What other panoramas show of a landmark lies in the atlas too: `viewpoints` (x, y, z of each)
    and `views` (x, y, width, height of each; 0 where a landmark has fewer).

    Parameters
    ----------
    factors : int
        Columns of the shared loading.
    walls : int
        Walls of the map.
    name_bytes : int
        Length of their names, joined by line feeds, in UTF-8.
    views : int
        The most other views that a landmark has.

    """
    sized = [
        ('shared_loading', '<f8', (3 * factors,)),
        ('walls', '<f8', (5 * walls,)),
        ('wall_names', 'u1', (name_bytes,)),
        ('viewpoints', '<f4', (3 * views,)),
        ('views', '<u4', (4 * views,)),
    ]
    return np.dtype([*LANDMARK_FIELDS, *(field for field in sized if field[2][0] > 0)])
