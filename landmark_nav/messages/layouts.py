"""Layouts on the wire: what each PointCloud2 topic carries, where covariances keep what."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from landmark_nav.types import PoseEstimate

# Of x, y, heading and of x, y, z, heading in ROS' covariance of x, y, z, roll, pitch, yaw.
PLANAR = np.ix_([0, 1, 5], [0, 1, 5])
UPRIGHT = np.ix_([0, 1, 2, 5], [0, 1, 2, 5])


@dataclass(frozen=True, eq=False)
class Layout:
    """
    What the points of a topic hold.

    Parameters
    ----------
    topic : str
        Its name.
    fields : dtype
        As it is written. Other widths of the same kind, integer or floating point, are read too.
    optional : tuple of str
        Fields that older recordings lack; they are read as zero then.
    repeated : mapping of str to (str, int)
        Further fields whose length differs from message to message, a multiple of the number:
        their types. Those that are not there have no length.
    """

    topic: str
    fields: np.dtype[np.void]
    optional: tuple[str, ...] = ()
    repeated: Mapping[str, tuple[str, int]] = field(default_factory=dict)

    def columns(self) -> Iterator[tuple[str, np.dtype[np.generic], int]]:
        """Name and type of each field, and of what its length is a multiple; 0: it is fixed."""
        for name in self.fields.names or ():
            yield name, self.fields[name], 0
        for name, (scalar, multiple) in self.repeated.items():
            yield name, np.dtype((scalar, (0,))), multiple

    def sized(self, **lengths: int) -> np.dtype[np.void]:
        """Type of a point in which the repeated fields are so long; without those of no length."""
        fixed = [(name, kind) for name, kind, multiple in self.columns() if not multiple]
        repeated = [(name, self.repeated[name][0], (n,)) for name, n in lengths.items() if n]
        return np.dtype([*fixed, *repeated])


# Image coordinates are normalised, as camera_info has it; a covariance of zero says that there are
# none. The same in all rows are by how much the stamps of the joints are taken to be late, as the
# node was configured, and the pose that the image itself shows, all zero if it was not sought.
DETECTIONS = Layout(
    'detections',
    np.dtype(
        [
            ('id', '<u4'),
            ('bearing', '<f8'),
            ('bearing_variance', '<f8'),
            ('score', '<f4'),
            ('u', '<f4'),
            ('v', '<f4'),
            ('joint_delay', '<f8'),
            ('point', '<f8', (2,)),
            ('point_covariance', '<f8', (4,)),
            ('near', '<f8', (3,)),
        ]
    ),
    optional=('joint_delay', 'point', 'point_covariance', 'near'),
)

# One point: camera pose, its covariance, speeds of the base, values and sigmas of the calibration.
EXPECTATION = Layout(
    'expectation',
    np.dtype(
        [
            ('pose', '<f8', (3,)),
            ('covariance', '<f8', (9,)),
            ('speeds', '<f8', (2,)),
            ('tilt_sigma', '<f8'),
            ('values', '<f8', (15,)),
            ('sigmas', '<f8', (15,)),
        ]
    ),
)

# Covariance of the promised fix and the pan to turn to are the same in all three rows.
TRIPLET = Layout(
    'triplet',
    np.dtype(
        [
            ('id', '<u4'),
            ('bearing', '<f8'),
            ('bearing_sigma', '<f8'),
            ('pan', '<f8'),
            ('covariance', '<f8', (9,)),
        ]
    ),
)

# Rows are landmarks; all but the first field is the same in all of them.
GLOBAL_POSE = Layout(
    'global_pose',
    np.dtype(
        [
            ('id', '<u4'),
            ('pose', '<f8', (3,)),
            ('covariance', '<f8', (9,)),
            ('pan_rate', '<f8'),
            ('joint_delay', '<f8'),
        ]
    ),
)

# x, y, z must be float32: RViz draws no other point clouds.
#
# Beside its own values each row repeats what belongs to the map: the outline of the walls
# (start x, y, end x, y, height of each) and their names, joined by line feeds, in UTF-8, so that
# the one topic suffices. What other panoramas show of a landmark lies in the atlas too:
# `viewpoints` (x, y, z of each) and `views` (x, y, width, height of each; 0 where a landmark has
# fewer than others).
LANDMARKS = Layout(
    'landmarks',
    np.dtype(
        [
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
    ),
    repeated={
        'shared_loading': ('<f8', 3),
        'walls': ('<f8', 5),
        'wall_names': ('u1', 1),
        'viewpoints': ('<f4', 3),
        'views': ('<u4', 4),
    },
)


@dataclass(frozen=True, eq=False)
class GlobalPose(PoseEstimate):
    """
    A pose that images gave, without any prior.

    It is the pose of the base at the last of them if its joint states are in time; `ids` (m,) are
    the landmarks it was found from. The rate of the pan there is `pan_rate_rad_s`, to the
    left; `joint_delay_s` is that of `Detections`.
    """

    ids: npt.NDArray[np.int64]
    pan_rate_rad_s: float = 0.0
    joint_delay_s: float = 0.0
