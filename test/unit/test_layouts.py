"""Layouts of RViz, Foxglove and PlotJuggler against the topics and types that nodes publish."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
import xml.etree.ElementTree as ElementTree

import pytest
from rosbags.interfaces import Nodetype
from test_markers import MAP, POSE, view
import yaml

from landmark_nav.demo.scenario import RECORDED_TOPICS
from landmark_nav.messages import encode
from landmark_nav.messages.factory import default_typestore, rosbag_factory
from landmark_nav.storage.bags.definitions import TOPIC_TYPES
from landmark_nav.types import Triplet

CONFIG = Path(__file__).resolve().parents[2] / 'config'
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
        description: Any = dict(default_typestore().fielddefs[type_name][1])[field]
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
