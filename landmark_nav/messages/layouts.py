"""Layouts of messages: the fields of each PointCloud2 topic, the axes of covariances."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
import re

import numpy as np
import numpy.typing as npt

from landmark_nav.types import PoseEstimate

# Indices of (x, y, heading) and (x, y, z, heading) in ROS' covariance of (x, y, z, roll, pitch,
# yaw).
PLANAR = np.ix_([0, 1, 5], [0, 1, 5])
UPRIGHT = np.ix_([0, 1, 2, 5], [0, 1, 2, 5])


@dataclass(frozen=True, eq=False)
class Layout:
    """
    Fields of the points of a topic.

    Parameters
    ----------
    topic : str
        Name of the topic.
    fields : dtype
        Type of a point as written. Other widths of the same kind (integer, float) are read too.
    optional : tuple of str
        Fields that older recordings lack; they are then read as zero.
    repeated : mapping of str to (str, int)
        Element type of further fields, whose length varies between messages, and the number of
        which the length is a multiple. A missing field has length 0.
    """

    topic: str
    fields: np.dtype[np.void]
    optional: tuple[str, ...] = ()
    repeated: Mapping[str, tuple[str, int]] = field(default_factory=dict)

    def columns(self) -> Iterator[tuple[str, np.dtype[np.generic], int]]:
        """Name and type of each field, and the divisor of its length; 0: the length is fixed."""
        for name in self.fields.names or ():
            yield name, self.fields[name], 0
        for name, (scalar, multiple) in self.repeated.items():
            yield name, np.dtype((scalar, (0,))), multiple

    def sized(self, **lengths: int) -> np.dtype[np.void]:
        """Type of a point with these lengths of the repeated fields; without those of length 0."""
        fixed = [(name, kind) for name, kind, multiple in self.columns() if not multiple]
        repeated = [(name, self.repeated[name][0], (n,)) for name, n in lengths.items() if n]
        return np.dtype([*fixed, *repeated])


def _fields(text: str) -> np.dtype[np.void]:
    """Type of a point from words ``name:type`` and, for several values, ``name:type*count``."""
    fields = [re.split('[:*]', word) for word in text.split()]
    return np.dtype(
        [(name, f'<{kind}', *((int(count),) for count in more)) for name, kind, *more in fields]
    )


# `point` and the `size` of the template are in normalised image coordinates by camera_info; a
# covariance of zero means that there is none. All rows repeat the joint delay that the node
# assumes, and `near`: the pose of the base found in this image by a search within an uncertain
# prior, zero without a search.
DETECTIONS = Layout(
    'detections',
    _fields(
        'id:u4 bearing:f8 bearing_variance:f8 score:f4 u:f4 v:f4 joint_delay:f8 point:f8*2 '
        'point_covariance:f8*4 size:f8*2 near:f8*3'
    ),
    optional=('joint_delay', 'point', 'point_covariance', 'size', 'near'),
)

# One point: pose of the base with its covariance, speeds of the base, values and sigmas of the
# calibration.
EXPECTATION = Layout(
    'expectation',
    _fields('pose:f8*3 covariance:f8*9 speeds:f8*2 tilt_sigma:f8 values:f8*15 sigmas:f8*15'),
)

# All three rows repeat the covariance of the predicted fix and the pan to turn to.
TRIPLET = Layout('triplet', _fields('id:u4 bearing:f8 bearing_sigma:f8 pan:f8 covariance:f8*9'))

# One row for each landmark; all fields but `id` are repeated.
GLOBAL_POSE = Layout(
    'global_pose', _fields('id:u4 pose:f8*3 covariance:f8*9 pan_rate:f8 joint_delay:f8')
)

# x, y, z must be float32: RViz draws no other point clouds.
#
# Each row repeats the values of the map, so that one topic suffices: the walls (start x, y, end
# x, y, height of each) and their names in UTF-8, separated by line feeds. The atlas also holds the
# views of a landmark in other panoramas: `viewpoints` (x, y, z of each) and `views` (x, y, width,
# height of each in the atlas; 0 where a landmark has fewer than others).
LANDMARKS = Layout(
    'landmarks',
    _fields(
        'id:u4 x:f4 y:f4 z:f4 normal_x:f4 normal_y:f4 normal_z:f4 width:f4 height:f4 '
        'viewpoint_x:f4 viewpoint_y:f4 viewpoint_z:f4 threshold:f4 saliency:f4 atlas_x:u4 '
        'atlas_y:u4 atlas_width:u4 atlas_height:u4 wall:i4 covariance:f8*9'
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
    Result of global localization: a pose from images without a prior.

    It is the pose of the base at the last image if its joint states are delayed by
    `joint_delay_s`. `ids` (m,) are the landmarks it was computed from; `pan_rate_rad_s` is the
    rate of the pan at that image, positive to the left.
    """

    ids: npt.NDArray[np.int64]
    pan_rate_rad_s: float = 0.0
    joint_delay_s: float = 0.0
