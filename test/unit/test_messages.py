"""Results of the stages survive encoding and decoding, or are refused by name."""

from copy import deepcopy
from dataclasses import replace

from builders import panorama_of, random_map, walls_of
import numpy as np
import pytest
from wire import assert_same, both, FACTORY, MOUNT, over_the_wire, STAMP

from landmark_nav.calibration import Calibration, NAMES
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import INTRINSICS
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.messages import decode, encode
from landmark_nav.messages.clouds import (
    DETECTIONS,
    EXPECTATION,
    GLOBAL_POSE,
    GlobalPose,
    LANDMARKS,
    pack_cloud,
    TRIPLET,
    unpack_cloud,
)
from landmark_nav.types import (
    Detections,
    JointSample,
    LandmarkMap,
    OdometrySample,
    PoseEstimate,
    Triplet,
)


@both
def test_joints_come_back_and_foreign_joints_are_none(deliver):
    sample = JointSample(STAMP, 1.25, -0.5)
    msg = encode.joint_state(FACTORY, sample, MOUNT)
    assert decode.joint_angles(deliver(msg), MOUNT) == (STAMP, sample.pan_rad, sample.tilt_rad)
    msg.name = ['wheel_left', 'wheel_right']
    assert decode.joint_angles(deliver(msg), MOUNT) == (STAMP, None, None)


def some_panorama():
    rng = np.random.default_rng(3)
    return panorama_of(
        rng.integers(0, 256, (40, 200, 3)).astype(np.uint8), Cylinder(200, 40, 31.0, 99.5, 19.0),
        stamp_ns=STAMP, mask=rng.random((40, 200)) > 0.3, center_map=np.array([1.0, 2.0, 1.1]),
        heading_rad=-2.0, covariance=np.diag([1.0, 2.0, 3.0, 4.0]) + 0.5,
    )  # fmt: skip


def calibrated_panorama():
    rng = np.random.default_rng(5)
    values, root = 0.1 * rng.random((len(NAMES),)), 0.01 * rng.normal(size=(len(NAMES),) * 2)
    return replace(
        some_panorama(),
        calibration=Calibration(values, root @ root.T, intrinsics=rng.random(INTRINSICS)),
        made_with=rng.random(len(NAMES)),
        by_calibration=rng.normal(size=(4, len(NAMES))),
    )


def some_map(count, factors):
    walls = walls_of([(0, 0), (5, 0), (5, 4)], ('south', 'ost-süd', 'diagonal'))
    return random_map(4, count, factors, walls, widest_px=300)


def learned_map(count, factors):
    """A map with all that learning found out."""
    rng, n = np.random.default_rng(6), len(NAMES)
    root = 1e-3 * rng.normal(size=(n, n))
    return replace(
        some_map(count, factors),
        provenance={'scale_sigma': '0.04'},
        prior=Calibration(root[1], np.diag(root[2] ** 2)),
        calibration=Calibration(
            root[0], root @ root.T, by_map=root[:, :factors], intrinsics=rng.random(INTRINSICS)
        ),
    )


RNG = np.random.default_rng(2)
COVARIANCE = np.diag([1.0, 2.0, 3.0]) + 0.1
JOINTS = tuple(JointSample(STAMP + k * 700_000_000, 0.1 * k, 0.01) for k in range(5))
ODOMETRY = OdometrySample(STAMP, np.array([1.0, -2.0, 3.0]), 0.2, -0.1)
POSE = PoseEstimate(STAMP, ODOMETRY.pose_odom_base, COVARIANCE)


def detections(count):
    return Detections(
        STAMP, np.arange(count) + 7, RNG.normal(size=count), RNG.random(count) + 0.1,
        RNG.random(count), 500 * RNG.random((count, 2)), np.array([50, 60])[: count // 2],
        joint_delay_s=0.04 if count else 0.0, intrinsics=np.ones(INTRINSICS) if count else None,
        points=RNG.normal(size=(count, 2)), point_covariance=np.tile(np.eye(2), (count, 1, 1)),
        sizes=RNG.random((count, 2)), below=RNG.normal(size=count),
        by_lens=RNG.normal(size=(count, 2, 3)) if count else None,
    )  # fmt: skip


@both
@pytest.mark.parametrize(
    ('sent', 'write', 'read'),
    [
        (JOINTS, encode.sweep_trajectory, decode.sweep_trajectory),
        (ODOMETRY, encode.odometry, decode.odometry),
        (POSE, encode.pose, decode.pose_estimate),
        (detections(0), encode.detections, decode.detections),
        (detections(4), encode.detections, decode.detections),
        (
            GlobalPose(STAMP, POSE.pose, COVARIANCE, np.array([4, 8, 15]), 0.7, 0.04),
            encode.global_pose,
            decode.global_pose,
        ),
        (
            Triplet(STAMP, np.array([3, 9, 1]), *RNG.random((2, 3)), 1e-4 * COVARIANCE, 0.4),
            encode.triplet,
            decode.triplet,
        ),
        (some_panorama(), encode.panorama, decode.panorama),
        (calibrated_panorama(), encode.panorama, decode.panorama),
        (some_map(7, 6), encode.landmark_map, decode.landmark_map),
        (some_map(1, 0), encode.landmark_map, decode.landmark_map),
        (learned_map(7, 6), encode.landmark_map, decode.landmark_map),
        (learned_map(1, 2), encode.landmark_map, decode.landmark_map),
        (LandmarkMap(()), encode.landmark_map, decode.landmark_map),
    ],
    ids=lambda value: getattr(value, '__name__', type(value).__name__),
)
def test_what_is_sent_comes_back(deliver, sent, write, read):
    mount = (MOUNT,) if write is encode.sweep_trajectory else ()
    stamp = (STAMP,) if write is encode.landmark_map else ()
    messages = write(FACTORY, sent, *mount, *stamp)
    messages = messages if isinstance(messages, tuple) else (messages,)
    if write is encode.landmark_map:
        *messages, markers = messages
        over_the_wire(markers)
    # Positions in images and views travel as four bytes.
    assert_same(read(*map(deliver, messages), *mount), sent, rtol=1e-6)


def test_factory_refuses_fields_that_do_not_exist():
    with pytest.raises(TypeError, match='colour'):
        FACTORY('sensor_msgs/msg/Image', colour=1)


LAYOUTS = {
    layout.topic: layout for layout in (DETECTIONS, EXPECTATION, GLOBAL_POSE, LANDMARKS, TRIPLET)
}
HEAD = encode.header(FACTORY, STAMP, 'map')
INTEGERS, FLOATS = ('i1', 'u1', 'i2', 'u2', 'i4', 'u4'), ('f4', 'f8')
NOT_NUMBERS = (np.nan, np.inf, -np.inf, 1e300)


def described(layout, **changed):
    """Fields of a cloud as a list that `np.dtype` takes, some of them changed."""
    kinds = {name: changed.get(name, layout.fields[name]) for name in layout.fields.names}
    return [(name, kind) for name, kind in kinds.items() if kind is not None]


def cloud(layout, points=3, **changed):
    rows = np.zeros(points, dtype=described(layout, **changed))
    if 'id' in rows.dtype.names and rows['id'].ndim == 1:
        rows['id'] = range(points)
    return pack_cloud(FACTORY, HEAD, rows)


every_field = pytest.mark.parametrize(
    ('topic', 'name'),
    [(topic, name) for topic, layout in LAYOUTS.items() for name in layout.fields.names],
)


@every_field
def test_a_field_of_another_kind_count_or_place_is_refused_by_name(topic, name):
    layout = LAYOUTS[topic]
    kind = layout.fields[name]
    count = int(np.prod(kind.shape))
    other = 'f4' if kind.base.kind in 'ui' else 'u4'
    for wrong in ((other, kind.shape), (kind.base, (count + 1,)), (kind.base, (2 * count + 5,))):
        with pytest.raises(LandmarkNavError, match=f'field {name} is'):
            unpack_cloud(cloud(layout, **{name: wrong}), layout)
    for attribute, value in (('offset', 10**6), ('count', 2**32 - 1), ('datatype', 77)):
        msg = cloud(layout)
        (field,) = (f for f in msg.fields if f.name == name)
        setattr(field, attribute, value)
        with pytest.raises(LandmarkNavError, match=f'field {name} is'):
            unpack_cloud(msg, layout)
    if name not in layout.optional:
        with pytest.raises(LandmarkNavError, match=f'lacks the field {name}'):
            unpack_cloud(cloud(layout, **{name: None}), layout)


@every_field
def test_a_field_of_another_width_or_byte_order_is_read(topic, name):
    layout = LAYOUTS[topic]
    kind = layout.fields[name]
    widths = INTEGERS if kind.base.kind in 'ui' else FLOATS
    for width in widths:
        rows = np.zeros(2, dtype=described(layout, **{name: (width, kind.shape)}))
        rows[name] = 7
        again = unpack_cloud(pack_cloud(FACTORY, HEAD, rows), layout)
        np.testing.assert_array_equal(again[name], np.full((2, *kind.shape), 7))
    big = rows.astype(rows.dtype.newbyteorder('>'))
    msg = pack_cloud(FACTORY, HEAD, rows)
    msg.is_bigendian, msg.data = True, np.frombuffer(big.tobytes(), np.uint8)
    np.testing.assert_array_equal(unpack_cloud(msg, layout)[name], again[name])


@pytest.mark.parametrize('layout', LAYOUTS.values(), ids=LAYOUTS)
def test_absurd_sizes_are_refused_before_memory_is_taken(layout):
    for width, height, step, row_step in (
        (2**32 - 1, 2**32 - 1, 0, 0),
        (2**32 - 1, 1, 0, 0),
        (1, 1, 2**32 - 1, 2**32 - 1),
        (0, 0, 2**32 - 1, 0),
        (10**7, 1, 0, 0),
    ):
        msg = cloud(layout)
        msg.width, msg.height, msg.point_step, msg.row_step = width, height, step, row_step
        with pytest.raises(LandmarkNavError, match=f'point cloud of {layout.topic}'):
            unpack_cloud(msg, layout)
    msg = pack_cloud(FACTORY, HEAD, np.zeros(20_000, dtype=layout.fields))
    with pytest.raises(LandmarkNavError, match='more than any map'):
        unpack_cloud(msg, layout)
    msg = cloud(layout)
    msg.fields = [*msg.fields, msg.fields[0]]
    with pytest.raises(LandmarkNavError, match='two fields of one name'):
        unpack_cloud(msg, layout)


def values(layout, points=3, **changed):
    rows = np.zeros(points, dtype=layout.fields)
    for name, value in ({'id': range(points), 'bearing_variance': 1e-5} | changed).items():
        if name in layout.fields.names:
            rows[name] = value
    return pack_cloud(FACTORY, HEAD, rows)


def expectation(msg):
    return decode.expectation(msg, MOUNT)


SKEW = [1.0, 0.0, 0.5, 0.0, 1.0, 0.0, -0.5, 0.0, 1.0]
BEYOND_ONE = [1.0, 2.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0, 1.0]
NEGATIVE = [1e4, 0.0, 0.0, 0.0, 1e4, 0.0, 0.0, 0.0, -1e-9]
NO_COVARIANCE = [*([value] * 9 for value in NOT_NUMBERS), SKEW, BEYOND_ONE, NEGATIVE]


@pytest.mark.parametrize(
    ('decoder', 'layout', 'points', 'name', 'wrong'),
    [
        (decode.detections, DETECTIONS, 3, 'bearing', [*NOT_NUMBERS, 1e7]),
        (decode.detections, DETECTIONS, 3, 'bearing_variance', [*NOT_NUMBERS, -1.0, 0.0]),
        (decode.detections, DETECTIONS, 3, 'score', [np.nan, np.inf]),
        (decode.detections, DETECTIONS, 3, 'u', [np.nan, np.inf]),
        (decode.detections, DETECTIONS, 3, 'joint_delay', [*NOT_NUMBERS, 60.0]),
        (decode.detections, DETECTIONS, 3, 'point', [[v, 0.0] for v in NOT_NUMBERS]),
        (decode.detections, DETECTIONS, 3, 'point_covariance', [[1.0, 2.0, 2.0, 1.0]]),
        (decode.detections, DETECTIONS, 3, 'near', [[v, 0.0, 0.0] for v in NOT_NUMBERS]),
        (expectation, EXPECTATION, 1, 'pose', NOT_NUMBERS),
        (expectation, EXPECTATION, 1, 'covariance', NO_COVARIANCE),
        (expectation, EXPECTATION, 1, 'speeds', NOT_NUMBERS),
        (expectation, EXPECTATION, 1, 'tilt_sigma', [*NOT_NUMBERS, -1.0]),
        (expectation, EXPECTATION, 1, 'values', NOT_NUMBERS),
        (expectation, EXPECTATION, 1, 'sigmas', [*NOT_NUMBERS, -1.0]),
        (decode.triplet, TRIPLET, 3, 'bearing', NOT_NUMBERS),
        (decode.triplet, TRIPLET, 3, 'bearing_sigma', [*NOT_NUMBERS, -1.0]),
        (decode.triplet, TRIPLET, 3, 'pan', NOT_NUMBERS),
        (decode.triplet, TRIPLET, 3, 'id', [5]),
        (decode.triplet, TRIPLET, 3, 'covariance', NO_COVARIANCE),
        (decode.global_pose, GLOBAL_POSE, 3, 'pose', [*NOT_NUMBERS, 1e9]),
        (decode.global_pose, GLOBAL_POSE, 3, 'id', [5]),
        (decode.global_pose, GLOBAL_POSE, 3, 'pan_rate', NOT_NUMBERS),
        (decode.global_pose, GLOBAL_POSE, 3, 'joint_delay', NOT_NUMBERS),
        (decode.global_pose, GLOBAL_POSE, 3, 'covariance', NO_COVARIANCE),
    ],
)
def test_values_that_can_not_be_are_refused(decoder, layout, points, name, wrong):
    decoder(values(layout, points))
    for value in wrong:
        with pytest.raises(LandmarkNavError) as refused:
            decoder(values(layout, points, **{name: value}))
        assert len(str(refused.value)) < 200
        assert '\n' not in str(refused.value)


def test_what_is_not_estimated_is_unknown_and_both_ways_to_report_it_are_read():
    covariance = np.diag([1e-4, 2e-4, 3e-5])
    estimate = PoseEstimate(STAMP, np.array([1.0, 2.0, 0.3]), covariance)
    for msg in (
        encode.pose(FACTORY, estimate),
        encode.odometry(FACTORY, OdometrySample(STAMP, estimate.pose), covariance),
    ):
        variances = np.diag(np.reshape(msg.pose.covariance, (6, 6)))
        np.testing.assert_array_equal(variances[[0, 1, 5]], np.diag(covariance))
        assert (variances[[2, 3, 4]] >= 1e6).all()
        for unknown in (0.0, 1e6, np.finfo(np.float64).max):
            msg.pose.covariance[[14, 21, 28]] = unknown
            read = decode.pose_estimate(over_the_wire(msg))
            np.testing.assert_array_equal(read.covariance, covariance)
    # Wheels show nothing of their errors here.
    wheels = encode.odometry(FACTORY, OdometrySample(STAMP, estimate.pose))
    for full in (wheels.pose.covariance, wheels.twist.covariance):
        assert (np.diag(np.reshape(full, (6, 6))) >= 1e6).all()


@pytest.mark.parametrize('wrong', NO_COVARIANCE)
def test_poses_without_a_covariance_are_refused(wrong):
    estimate = PoseEstimate(STAMP, np.zeros(3), np.reshape(wrong, (3, 3)))
    with pytest.raises(LandmarkNavError, match='pose covariance'):
        decode.pose_estimate(encode.pose(FACTORY, estimate))


def landmarks(**changed):
    """Messages of a map in which one landmark is changed."""
    first, *others = some_map(5, 2).landmarks
    members = (replace(first, **changed), *others)
    return encode.landmark_map(FACTORY, replace(some_map(5, 2), landmarks=members), STAMP)[:2]


@pytest.mark.parametrize(
    ('name', 'wrong'),
    [
        ('id', 7),
        *(('position', np.array([x, 0.0, 0.0])) for x in (np.nan, 1e30)),
        *(('normal', np.array([0.0, 0.0, z])) for z in (0.0, 1.0)),
        *(('width_m', -1.0), ('width_m', 1e6), ('height_m', 0.0), ('threshold', np.nan)),
        *(('covariance', -np.eye(3)), ('covariance', 1e-12 * np.eye(3))),
        ('shared_loading', np.full((3, 2), 1e200)),
    ],
)
def test_a_landmark_that_can_not_be_is_refused(name, wrong):
    decode.landmark_map(*landmarks())
    with pytest.raises(LandmarkNavError) as refused:
        decode.landmark_map(*landmarks(**{name: wrong}))
    assert len(str(refused.value)) < 200


def rows_of(msg):
    """Rows of ``landmarks``, which may be changed."""
    kinds = unpack_cloud(msg, LANDMARKS).dtype
    lengths = {name: kinds[name].shape[0] for name in LANDMARKS.repeated}
    return np.frombuffer(msg.data.tobytes(), LANDMARKS.sized(**lengths)).copy()


@pytest.mark.parametrize(
    ('at', 'value'),
    [(0, np.inf), (1, np.nan), (40, 1e300), (1 + 3 * len(NAMES), -1.0), (-1, 500.0)],
)
def test_what_learning_can_not_have_found_is_refused(at, value):
    msg, atlas, _ = encode.landmark_map(FACTORY, learned_map(7, 6), STAMP)
    rows = rows_of(msg)
    flat = rows['learned'].ravel()
    flat[np.flatnonzero(np.isfinite(flat))[at]] = value
    rows['learned'] = flat.reshape(rows['learned'].shape)
    with pytest.raises(LandmarkNavError) as refused:
        decode.landmark_map(pack_cloud(FACTORY, HEAD, rows), atlas)
    assert len(str(refused.value)) < 200


TRAJECTORY = (encode.sweep_trajectory(FACTORY, JOINTS, MOUNT),)
PANORAMA = encode.panorama(FACTORY, calibrated_panorama())
MAP = encode.landmark_map(FACTORY, some_map(3, 2), STAMP)[:2]
LATER = encode.header(FACTORY, STAMP + 1, 'map')
ANGLES = (encode.joint_state(FACTORY, JointSample(STAMP, 0.1), MOUNT),)
TILT_ALONE = deepcopy(ANGLES)
TILT_ALONE[0].name = [MOUNT.tilt_joint, 'wheel_left']
PLACE = (values(GLOBAL_POSE),)
NOT_ANGLES = [['a', 'b'], [None, None], [np.nan, 0.0], [1e300, 0.0], []]


def joint_angles(msg):
    return decode.joint_angles(msg, MOUNT)


@pytest.mark.parametrize(
    ('read', 'sent', 'field', 'wrong', 'match'),
    [
        (
            lambda msg: decode.sweep_trajectory(msg, MOUNT),
            *(TRAJECTORY, '0.points.1.time_from_start.sec', [-5], 'time_from_start'),
        ),
        (joint_angles, ANGLES, '0.position', NOT_ANGLES, 'joint_states position'),
        (joint_angles, TILT_ALONE, '0.position', NOT_ANGLES, 'joint_states position'),
        (joint_angles, ANGLES, '0.name', [[MOUNT.pan_joint] * 2], 'twice'),
        (decode.odometry, (encode.odometry(FACTORY, ODOMETRY),), '0.header.stamp.sec',
         [-1, 'now', np.nan], ''),
        (decode.odometry, (encode.odometry(FACTORY, ODOMETRY),), '0.header.stamp.nanosec',
         [2 * 10**9], ''),
        (decode.global_pose, PLACE, '0.width', [0], 'names no landmark'),
        (decode.landmark_map, MAP, '1.header', [LATER], 'different maps'),
        (decode.panorama, PANORAMA, '2.header', [LATER], 'comes with'),
        (decode.panorama, PANORAMA, '1.distortion_model', ['plumb_bob'], 'plumb_bob'),
        (decode.panorama, PANORAMA, '1.width', [2**32 - 1, 0], ''),
        (decode.panorama, PANORAMA, '1.height', [2**32 - 1], ''),
        (decode.panorama, PANORAMA, '1.k',
         [np.full(9, np.nan), np.full(9, 1e300), np.zeros(9), np.zeros(4)], ''),
        (decode.panorama, PANORAMA, '1.d',
         [np.zeros(5), np.full_like(PANORAMA[1].d, np.nan), -np.abs(PANORAMA[1].d)], ''),
    ],
)  # fmt: skip
def test_a_field_that_can_not_be_is_refused(read, sent, field, wrong, match):
    read(*sent)
    part, *way, name = field.split('.')
    for value in wrong:
        messages = deepcopy(sent)
        holder = messages[int(part)]
        for step in way:
            holder = holder[int(step)] if step.isdigit() else getattr(holder, step)
        setattr(holder, name, value)
        with pytest.raises(LandmarkNavError, match=match) as refused:
            read(*messages)
        assert len(str(refused.value)) < 200
