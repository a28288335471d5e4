"""PointCloud2 <-> NumPy structured arrays."""

from __future__ import annotations

from dataclasses import dataclass
import re
from typing import Any

import numpy as np
import numpy.typing as npt

from landmark_nav.errors import LandmarkNavError
from landmark_nav.messages.factory import MessageFactory
from landmark_nav.types import PoseEstimate

# Bound of any length, angle, rate or variance; publishers use smaller values for "unknown".
MAX_VALUE = 1e12
# A field is ``name:type``, with ``*count`` for several values and ``[most]`` or ``[least,most]``
# for bounds; ``=attribute`` follows the name where the type of the package calls it otherwise.
_FIELD = re.compile(r'(\w+)(?:=(\w+))?:(\w+)(?:\*(\d+))?(?:\[(?:(.+),)?(.+)\])?')


class Layout:
    """
    Fields of the points of a topic, as written; other widths of the same kind are read too.

    Values of `common` fields are the same in all rows. `optional` fields are missing in older
    recordings, and are then read as zero. Lengths of `repeated` fields vary between messages, by
    multiples of their count; a missing one has length 0. `kinds`, `attributes` and `bounds` (least
    and greatest value) are by name of a field.
    """

    def __init__(
        self,
        topic: str,
        fields: str,
        *,
        optional: str = '',
        repeated: str = '',
        common: tuple[str, ...] = (),
    ) -> None:
        self.topic, self.common = topic, common
        self.kinds: dict[str, np.dtype[np.generic]] = {}
        self.attributes: dict[str, str] = {}
        self.bounds: dict[str, tuple[float, float]] = {}
        self._add(fields)
        self.optional = self._add(optional)
        self.fields = np.dtype(list(self.kinds.items()))
        self.repeated = self._add(repeated)

    def sized(self, **lengths: int) -> np.dtype[np.void]:
        """Type of a point with these lengths of the repeated fields; without those of length 0."""
        fixed = [(name, self.fields[name]) for name in self.fields.names or ()]
        return np.dtype(
            [*fixed, *((k, self.kinds[k].base, (n,)) for k, n in lengths.items() if n)]
        )

    def rows(self, value: Any, count: int, others: int = 0) -> npt.NDArray[np.void]:
        """
        Points (count + others,) with the attributes of a value; those that it lacks are zero.

        The last rows have only common values.
        """
        points = np.zeros(count + others, dtype=self.fields)
        for name in self.fields.names or ():
            given = getattr(value, self.attributes[name], None)
            if given is not None and np.size(given):
                target = points[name] if name in self.common else points[name][:count]
                target[...] = np.reshape(given, (-1, *self.fields[name].shape))
        return points

    def _add(self, text: str) -> tuple[str, ...]:
        """Add fields; return their names."""
        names = []
        for field in text.split():
            match = _FIELD.fullmatch(field)
            assert match is not None, field
            name, attribute, scalar, count, least, most = match.groups()
            limit = float(most or MAX_VALUE)
            self.kinds[name] = np.dtype((f'<{scalar}', (int(count),) if count else ()))
            self.attributes[name] = attribute or name
            self.bounds[name] = (float(least) if least else -limit, limit)
            names.append(name)
        return tuple(names)


# Bounds: coordinates of 2e7 m (half the circumference of the earth, more than any UTM coordinate),
# speeds of 1e3 m/s or rad/s, delays of 10 s, bearings of 1e4 rad (they may be unwrapped) with
# variances from 1e-14 rad^2, and normalised image coordinates of 1e3 (a ray 89.9 degrees from the
# optical axis).
#
# `point` and the `size` of the template are in normalised image coordinates by camera_info,
# `by_lens` its derivatives by focal scale, principal point and distortion, row by row; `below`
# the row of the pixel below the principal point, in focal lengths; a
# covariance of zero means that there is none. All rows repeat the joint delay that the node
# assumes; `near`, the pose of the base found in this image by a search within an uncertain prior,
# zero without a search; and the `intrinsics` of the camera, zero if unknown.
DETECTIONS = Layout(
    'detections',
    'id=ids:u4 bearing=bearing_rad:f8[1e4] bearing_variance=variance_rad2:f8[1e-14,1e12] score:f4 '
    'u:f4 v:f4',
    optional='point=points:f8*2[1e3] point_covariance:f8*4 size=sizes:f8*2[0,1e3] '
    'by_lens:f8*6[1e3] below:f8[1e3] joint_delay=joint_delay_s:f8[10] near:f8*3[2e7] '
    'intrinsics:f8*5[1e3]',
    common=('joint_delay', 'near', 'intrinsics'),
)

# One point: pose of the base with its covariance, speeds of the base, values and sigmas of the
# calibration, and the `intrinsics` of the camera that they are for, zero if unknown.
EXPECTATION = Layout(
    'expectation',
    'pose:f8*3[2e7] covariance:f8*9 speeds:f8*2[1e3] tilt_sigma=tilt_sigma_rad:f8[0,100] '
    'values:f8*17[100] sigmas:f8*17[0,100]',
    optional='intrinsics:f8*5[1e3]',
)

# All three rows repeat the covariance of the predicted fix and the pan to turn to.
TRIPLET = Layout(
    'triplet',
    'id=ids:u4 bearing=bearing_rad:f8[1e4] bearing_sigma=sigma_rad:f8[0,1e12] pan=pan_rad:f8[1e4] '
    'covariance:f8*9',
    common=('pan', 'covariance'),
)

# One row for each landmark.
GLOBAL_POSE = Layout(
    'global_localization/pose',
    'id=ids:u4 pose:f8*3[2e7] covariance:f8*9 pan_rate=pan_rate_rad_s:f8[1e3] '
    'joint_delay=joint_delay_s:f8[10]',
    common=('pose', 'covariance', 'pan_rate', 'joint_delay'),
)

# x, y, z must be float32: RViz draws no other point clouds.
#
# Each row repeats the values of the map, so that one topic suffices: the walls (start x, y, end
# x, y, height of each) and their names in UTF-8, separated by line feeds. The atlas also holds the
# views of a landmark in other panoramas: `viewpoints` (x, y, z of each) and `views` (x, y, width,
# height of each in the atlas; 0 where a landmark has fewer than others). The values of `learned`
# are distributed over all rows, filled up with NaN: the sigma of the scale, and if known the
# calibration of ``robot.yaml`` at learning (values, sigmas) and by learning (values, covariance,
# intrinsics of the camera, covariance with the shared factors).
LANDMARKS = Layout(
    'landmarks',
    'id:u4 x:f4[2e7] y:f4 z:f4 normal_x:f4[1.001] normal_y:f4 normal_z:f4 width:f4[0,100] '
    'height:f4 viewpoint_x:f4[2e7] viewpoint_y:f4 viewpoint_z:f4 threshold:f4[1e3] saliency:f4 '
    'atlas_x:u4 atlas_y:u4 atlas_width:u4 atlas_height:u4 wall:i4 covariance:f8*9',
    repeated='shared_loading:f8*3[1e3] walls:f8*5[2e7] wall_names:u1*1 viewpoints:f4*3[2e7] '
    'views:u4*4 learned:f8*1[1e3]',
)


@dataclass(frozen=True, eq=False)
class GlobalPose(PoseEstimate):
    """
    Result of global localization: a pose from images without a prior.

    It is the pose of the base at the last image if its joint states are delayed by
    `joint_delay_s`. The covariance is for an exact mount: the fusion adds the errors of mount, pan
    and delay, with their correlations. `ids` (m,) are the landmarks it was computed from;
    `pan_rate_rad_s` is the rate of the pan at that image, positive to the left.
    """

    ids: npt.NDArray[np.int64]
    pan_rate_rad_s: float = 0.0
    joint_delay_s: float = 0.0


def bytes_array(data: Any) -> npt.NDArray[np.uint8]:
    """
    View a ``uint8[]`` field (ndarray, array.array, bytes or list) as an array (n,).

    Raises `LandmarkNavError`: the field does not hold bytes (a foreign definition of the message).
    """
    try:
        if isinstance(data, np.ndarray):
            return np.ascontiguousarray(data).reshape(-1).view(np.uint8)
        if isinstance(data, list | tuple):
            return np.array(data, dtype=np.uint8)
        return np.frombuffer(data, dtype=np.uint8)
    except (TypeError, ValueError, OverflowError):
        raise LandmarkNavError(
            f'the data of the message are {type(data).__name__}, not bytes: record it again'
        ) from None


# sensor_msgs/PointField datatype codes.
_CODES = {'i1': 1, 'u1': 2, 'i2': 3, 'u2': 4, 'i4': 5, 'u4': 6, 'f4': 7, 'f8': 8}
_TYPES = {code: name for name, code in _CODES.items()}
# Limits far above any map; the joint covariance of 5000 landmarks takes 800 MB.
_MAX_POINTS, _MAX_BYTES = 5000, 2**28


def pack_cloud(
    factory: MessageFactory, header: Any, points: npt.NDArray[np.void], dense: bool = True
) -> Any:
    """
    Build a PointCloud2 out of points (n,) of little-endian scalars or one-dimensional sub-arrays.

    `dense`: all points are valid, none holds NaN.
    """
    layout: Any = points.dtype.fields or {}
    fields = [
        factory(
            'sensor_msgs/msg/PointField',
            name=name,
            offset=int(offset),
            datatype=_CODES[kind.base.str[1:]],
            count=int(np.prod(kind.shape)),
        )
        for name, (kind, offset, *_) in layout.items()
    ]
    size = points.dtype.itemsize
    return factory(
        'sensor_msgs/msg/PointCloud2',
        header=header,
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=size,
        row_step=size * len(points),
        data=np.frombuffer(points.tobytes(), dtype=np.uint8),
        is_dense=dense,
    )


def unpack_cloud(msg: Any, layout: Layout) -> npt.NDArray[np.void]:
    """
    Read the points of a PointCloud2 as a structured array, (n,), of float64 and int64.

    The result has exactly the fields of the layout. Their order, width and byte order in the
    message are free.

    Raises `LandmarkNavError`: a field is missing, has another type or count, or lies outside its
    point; or the sizes contradict each other or the length of the data.
    """
    where = f'point cloud of {layout.topic}'
    height, width, step = int(msg.height), int(msg.width), int(msg.point_step)
    row_step, data = int(msg.row_step), bytes_array(msg.data)
    if row_step < width * step or len(data) < height * row_step:
        raise LandmarkNavError(
            f'{where}: {width} x {height} points of {step} bytes in rows of {row_step} are more '
            f'than its {len(data)} bytes: its publisher is broken'
        )
    sent = _types_sent(msg, layout, where)
    # 64 bits hold every value that a field of a point cloud can have.
    wide = []
    for name, kind in layout.kinds.items():
        missing = (0,) if name in layout.repeated else kind.shape
        shape = sent[name][0].shape if name in sent else missing
        wide.append((name, 'f8' if kind.base.kind == 'f' else 'i8', shape))
    count, size = width * height, sum(8 * int(np.prod(shape)) for _, _, shape in wide)
    if count > _MAX_POINTS or max(1, count) * max(step, size) > _MAX_BYTES:
        raise LandmarkNavError(
            f'{where} has {count} points of {step} bytes, more than any map: fix its publisher'
        )
    points = np.zeros(count, dtype=wide)
    if count:
        kinds, offsets = zip(*sent.values(), strict=True)
        as_sent = np.dtype(
            {'names': list(sent), 'formats': kinds, 'offsets': offsets, 'itemsize': step}
        )
        rows = data[: height * row_step].reshape(height, row_step)[:, : width * step]
        raw = np.ascontiguousarray(rows).reshape(-1).view(as_sent)
        # NumPy warns when it widens a signalling NaN.
        with np.errstate(invalid='ignore'):
            for name in sent:
                points[name] = raw[name]
    return points


def _types_sent(
    msg: Any, layout: Layout, where: str
) -> dict[str, tuple[np.dtype[np.generic], int]]:
    """Type and offset in the message of each field of a layout that it has; all are checked."""
    order = '>' if msg.is_bigendian else '<'
    given = {str(f.name): f for f in msg.fields}
    if len(given) < len(msg.fields):
        raise LandmarkNavError(f'{where} has two fields of one name: its publisher is broken')
    sent: dict[str, tuple[np.dtype[np.generic], int]] = {}
    for name, kind in layout.kinds.items():
        if name not in given:
            if name not in (*layout.optional, *layout.repeated):
                raise LandmarkNavError(
                    f'{where} lacks the field {name} (it has {", ".join(given)!r:.60}): '
                    'publish it from landmark_nav'
                )
            continue
        # Some publishers leave the count of a scalar at 0.
        count, offset = max(1, int(given[name].count)), int(given[name].offset)
        scalar = np.dtype(order + _TYPES.get(int(given[name].datatype), 'V0'))
        wanted = int(np.prod(kind.shape))
        if (
            (scalar.kind == 'f') != (kind.base.kind == 'f')
            or not scalar.itemsize
            or (count % wanted if name in layout.repeated else count != wanted)
            or offset + count * scalar.itemsize > min(int(msg.point_step), _MAX_BYTES)
        ):
            raise LandmarkNavError(
                f'{where}: field {name} is {count} of type {scalar.name} at byte {offset} of '
                f'{msg.point_step}, not {wanted} of {kind.base.name}: publish it from landmark_nav'
            )
        sent[name] = np.dtype((scalar, (count,) if kind.shape else ())), offset
    return sent
