"""Layouts of RViz, Foxglove and PlotJuggler, and what markers show in them."""

import json
from typing import Any
import xml.etree.ElementTree as ElementTree

from builders import bare_landmark, detections_of
from harness import REPOSITORY
import numpy as np
import pytest
from rosbags.interfaces import Nodetype
from wire import over_the_wire
import yaml

from landmark_nav.demo.scenario import RECORDED_TOPICS
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.geometry.walls import Wall
from landmark_nav.messages import encode
from landmark_nav.messages.factory import default_typestore, rosbag_factory
from landmark_nav.storage.bags.definitions import TOPIC_TYPES
from landmark_nav.types import LandmarkMap, PoseEstimate, Triplet

STORE = default_typestore()
CONFIG = REPOSITORY / 'config'
TYPES = {**TOPIC_TYPES, '/diagnostics': 'diagnostic_msgs/msg/DiagnosticArray'}
# What a display of RViz or a panel of Foxglove shows.
RVIZ = {
    'MarkerArray': 'visualization_msgs/msg/MarkerArray',
    'Path': 'nav_msgs/msg/Path',
    'Image': 'sensor_msgs/msg/CompressedImage',
    'SetInitialPose': 'geometry_msgs/msg/PoseWithCovarianceStamped',
}
FOXGLOVE_3D = {'visualization_msgs/msg/MarkerArray', 'nav_msgs/msg/Path'}


def rviz():
    text = (CONFIG / 'rviz' / 'landmark_nav.rviz').read_text(encoding='utf-8')
    return dict(yaml.safe_load(text)['Visualization Manager'])


def foxglove():
    return dict(json.loads((CONFIG / 'foxglove' / 'landmark_nav.json').read_text('utf-8')))


def plotjuggler():
    return ElementTree.parse(CONFIG / 'plotjuggler' / 'landmark_nav.xml').getroot()


def rviz_topics():
    """Class and topic of each display and tool that has one."""
    layout = rviz()
    for item in [*layout['Displays'], *layout['Tools']]:
        if 'Topic' in item:
            yield item['Class'].partition('/')[2], item['Topic']['Value']


def foxglove_topics():
    """Panel, topic and field of all that is shown."""
    for panel, config in foxglove()['configById'].items():
        kind = panel.partition('!')[0]
        yield from ((kind, topic, '') for topic in config.get('topics', ()))
        image = config.get('imageMode', {})
        yield from ((kind, image[key], '') for key in image if key.endswith('Topic'))
        for path in config.get('paths', ()):
            topic, _, fields = path['value'].partition('.')
            yield kind, topic, fields.replace('.', '/')
        if 'topicToRender' in config:
            yield kind, config['topicToRender'], ''


def curves():
    for curve in plotjuggler().iter('curve'):
        yield from (curve.attrib[key] for key in ('curve_x', 'curve_y') if key in curve.attrib)
        if 'curve_x' not in curve.attrib:
            yield curve.attrib['name']


def known(topic):
    """Type of an absolute topic."""
    return TYPES[topic] if topic in TYPES else TYPES[topic.removeprefix('/')]


def is_number(type_name, fields):
    """Whether the fields lead to a number in a message."""
    for number, field in enumerate(fields):
        description: Any = dict(STORE.fielddefs[type_name][1])[field]
        kind, content = description
        if kind == Nodetype.BASE:
            return number == len(fields) - 1 and content[0] != 'string'
        assert kind == Nodetype.NAME
        type_name = content
    return False


def test_rviz_shows_topics_of_the_types_that_its_displays_take():
    shown = list(rviz_topics())
    assert {kind for kind, _ in shown} == set(RVIZ)
    for kind, topic in shown:
        # Relative: RViz runs in the namespace of the nodes.
        assert TOPIC_TYPES[topic] == RVIZ[kind]


def test_rviz_shows_the_namespaces_that_the_markers_have():
    triplet = Triplet(0, MAP.ids[:3], *(MAP.positions[:3, 0],) * 2, POSE.covariance, 0.0)
    factory = rosbag_factory()
    made = {
        'landmarks/markers': encode.landmark_markers(factory, MAP, 0),
        'odometry_fusion/markers': encode.pose_markers(factory, POSE, POSE),
    }
    names = {topic: {m.ns for m in message.markers[1:]} for topic, message in made.items()}
    names['triangulation_localizer/markers'] = set(view([10], [0.0], triplet))
    shown = {
        item['Topic']['Value']: set(item['Namespaces'])
        for item in rviz()['Displays']
        if 'Namespaces' in item
    }
    assert shown == names


def test_foxglove_shows_topics_of_the_types_that_its_panels_take():
    shown = list(foxglove_topics())
    kinds = {kind for kind, *_ in shown}
    assert kinds == {'3D', 'Image', 'Plot', 'DiagnosticSummary'}
    for kind, topic, fields in shown:
        type_name = known(topic)
        if kind == '3D':
            assert type_name in FOXGLOVE_3D
        elif kind == 'Image':
            assert type_name.rpartition('/')[2] in {'CompressedImage', 'CameraInfo', 'MarkerArray'}
        elif kind == 'Plot':
            assert is_number(type_name, fields.split('/'))
        else:
            assert type_name == TYPES['/diagnostics']


@pytest.mark.parametrize('curve', list(curves()))
def test_plotjuggler_draws_numbers_of_the_topics(curve):
    topic = max((t for t in TYPES if curve.startswith(f'/{t}/')), key=len)
    fields = curve.removeprefix(f'/{topic}/').split('/')
    if topic == 'joint_states':
        # By the names of the joints.
        assert fields[1] in {'position', 'velocity', 'effort'}
    else:
        assert is_number(TYPES[topic], fields)


def test_the_demo_records_all_that_is_shown():
    shown = {topic for kind, topic in rviz_topics() if kind != 'SetInitialPose'}
    shown |= {topic.removeprefix('/') for _, topic, _ in foxglove_topics()}
    shown |= {max((t for t in TYPES if c.startswith(f'/{t}/')), key=len) for c in curves()}
    assert shown <= {topic.removeprefix('/') for topic in RECORDED_TOPICS}


FACTORY = rosbag_factory()
ADD = 0
MOUNT = PanTiltMount(axis_xyz=(0.2, 0.1, 1.1), axis_rpy=(0.0, 0.0, 0.3))
CAMERA = CameraModel(640, 480, 500.0, 500.0, 320.0, 240.0)
POSITIONS = np.array([[4.0, 1.0, 1.5], [4.0, -1.0, 1.2], [3.0, 3.0, 1.8], [-2.0, 3.0, 1.0]])
POSE = PoseEstimate(5 * 10**9, np.array([0.5, -0.2, 0.4]), np.diag([0.04, 0.01, 1e-4]))
MAP = LandmarkMap(
    tuple(bare_landmark(10 + k, place, 1e-4 * np.eye(3)) for k, place in enumerate(POSITIONS)),
    walls=(Wall('w', (4.0, -2.0), (4.0, 3.0), 2.5),),
    panorama_poses=(POSE, POSE),
)


def drawn(message):
    """Markers by namespace, after a trip through a bag; those before are cleared first."""
    first, *rest = over_the_wire(message).markers
    assert first.action != ADD
    found: dict[str, list[Any]] = {}
    for marker in rest:
        assert marker.action == ADD
        assert marker.header.frame_id == 'map'
        found.setdefault(marker.ns, []).append(marker)
    keys = [(marker.ns, marker.id) for marker in rest]
    assert len(set(keys)) == len(keys)
    return found


def points(markers):
    (marker,) = markers
    return np.array([(p.x, p.y, p.z) for p in marker.points])


def view(ids, bearings, triplet):
    found = detections_of(POSE.stamp_ns, ids, bearings)
    return drawn(
        encode.view_markers(FACTORY, POSE, MAP, MOUNT, CAMERA, 0.2, found, triplet, 'map')
    )


def test_the_triplet_is_joined_to_the_axis_and_the_view_is_as_wide_as_the_cameras():
    triplet = Triplet(0, np.array([12, 10, 99]), np.zeros(3), np.zeros(3), np.eye(3), 0.0)
    found = view([], [], triplet)
    np.testing.assert_allclose(points(found['triplet'])[1::2], POSITIONS[[2, 0]])
    fan = points(found['field_of_view'])
    sides = fan[[1, -2], :2] - fan[0, :2]
    azimuths = np.arctan2(sides[:, 1], sides[:, 0])
    assert azimuths[1] - azimuths[0] == pytest.approx(2.0 * CAMERA.half_fov_rad)
    assert azimuths.mean() == pytest.approx(0.4 + 0.3 + 0.2)


def test_ellipses_are_three_sigma_and_the_protection_level():
    turned = np.array([[0.05, 0.02, 0.0], [0.02, 0.03, 0.0], [0.0, 0.0, 1e-4]])
    estimate = PoseEstimate(0, POSE.pose, turned)
    level = PoseEstimate(0, POSE.pose, 16.0 * turned)
    found = drawn(encode.pose_markers(FACTORY, estimate, level))
    for name, sigmas in (('three_sigma', 3.0), ('protection_level', 4.0)):
        off = points(found[name])[:, :2] - POSE.pose[:2]
        distance = np.sqrt(np.sum(off @ np.linalg.inv(turned[:2, :2]) * off, axis=1))
        np.testing.assert_allclose(distance, sigmas)
    assert 'protection_level' not in drawn(encode.pose_markers(FACTORY, estimate))


def test_a_map_shows_each_landmark_its_normal_its_number_and_the_sweeps():
    found = drawn(encode.landmark_markers(FACTORY, MAP, 7))
    normals = points(found['normals']).reshape(-1, 2, 3)
    np.testing.assert_allclose(normals[:, 0], POSITIONS)
    along = normals[:, 1] - normals[:, 0]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    np.testing.assert_allclose(along, MAP.normals)
    assert [marker.text for marker in found['numbers']] == ['10', '11', '12', '13']
    assert len(found['uncertainty']) == len(found['landmarks']) == len(POSITIONS)
    # An arrow and a word for each.
    assert len(found['sweeps']) == 4
    assert len(points(found['walls'])) == 6
    assert drawn(encode.landmark_markers(FACTORY, LandmarkMap(()), 7)) == {}
