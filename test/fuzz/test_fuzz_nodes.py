"""Every topic of every node, with hostile messages: the node lives and takes no bad value in."""

from contextlib import ExitStack
from importlib import import_module
import os
from typing import Any

from bounds import FUZZ, time_limit
import corpus
from hostile import changed_message
from hypothesis import given, Phase, settings
from hypothesis import strategies as st
import pytest
import yaml

from landmark_nav.storage.bags.definitions import TOPIC_TYPES

pytest.importorskip('rclpy', reason='ROS 2 is not installed')

from rclpy.context import Context
from rclpy.parameter import Parameter

from landmark_nav.ros.topics import message_class, ros_factory

# Node -> its class and the parameters that it needs.
NODES: dict[str, tuple[str, dict[str, Any]]] = {
    'sweep_capture': ('SweepCaptureNode', {'robot_file': 'robot'}),
    'panorama_synthesizer': (
        'PanoramaSynthesizerNode',
        {'robot_file': 'robot', 'room_file': 'room'},
    ),
    'landmark_learner': ('LandmarkLearnerNode', {'room_file': 'room'}),
    'triplet_selector': ('TripletSelectorNode', {'robot_file': 'robot'}),
    'triangulation_localizer': ('TriangulationLocalizerNode', {'robot_file': 'robot'}),
    'odometry_fusion': ('OdometryFusionNode', {'robot_file': 'robot'}),
    'room_simulator': ('RoomSimulatorNode', {'robot_file': 'robot', 'room_file': 'room'}),
}
CASES = [(name, wanted) for name, (_, wanted) in sorted(NODES.items())]
UNMEASURED = {'robot_file': 'robot'}
CASES += [('landmark_learner', UNMEASURED), ('panorama_synthesizer', UNMEASURED)]
MESSAGES_A_NODE = 20


def as_ros(type_name, message):
    """Copy of a message in rclpy's classes."""
    made = message_class(type_name)()
    for name, kind in made.get_fields_and_field_types().items():
        value = getattr(message, name)
        inner = kind.removeprefix('sequence<').split('[')[0].split(',')[0].rstrip('>')
        if '/' in inner:
            full = inner.replace('/', '/msg/')
            if isinstance(value, list):
                setattr(made, name, [as_ros(full, entry) for entry in value])
            else:
                setattr(made, name, as_ros(full, value))
        elif kind.startswith('sequence') and not isinstance(value, list):
            setattr(made, name, getattr(ros_factory(type_name, **{name: value}), name))
        else:
            setattr(made, name, value)
    return made


@pytest.fixture(scope='module')
def context():
    made = Context()
    made.init(domain_id=10 + os.getpid() % 90)
    with pytest.MonkeyPatch.context() as patch:
        # Sweeps of hostile stamps would wait for frames that never come.
        patch.setattr('landmark_nav.nodes.recorded_sweeps._LATE_FRAMES_S', 0.0)
        yield made
    made.try_shutdown()


@pytest.fixture(scope='module')
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp('files')
    for name, document in (('robot', corpus.ROBOT_YAML), ('room', corpus.ROOM_YAML)):
        (folder / f'{name}.yaml').write_text(yaml.safe_dump(document), encoding='utf-8')
    return {name: str(folder / f'{name}.yaml') for name in ('robot', 'room')}


def callbacks(node):
    """What a node does with each topic that it reads, by the topic's name in the contract."""
    listened = {entry.topic_name.lstrip('/'): entry.callback for entry in node.subscriptions}
    return {topic: listened[topic] for topic in listened if topic in TOPIC_TYPES}


@pytest.mark.parametrize(('name', 'wanted'), CASES)
# Not shrunk: what a node did before can't be taken back.
@settings(FUZZ, max_examples=max(2, FUZZ.max_examples // MESSAGES_A_NODE), phases=[Phase.generate])
@given(data=st.data())
def test_hostile_topics(name, wanted, data, context, files):
    class_name, _ = NODES[name]
    parameters = [Parameter(key, value=files.get(value, value)) for key, value in wanted.items()]
    node_class = getattr(import_module(f'landmark_nav.nodes.{name}'), class_name)
    with ExitStack() as ending:
        node = node_class(context=context, parameter_overrides=parameters)
        ending.callback(node.destroy_node)
        ending.callback(node.end)
        heard = callbacks(node)
        for k in range(MESSAGES_A_NODE):
            stamp_ns = (10 + k) * corpus.SECOND_NS // 10
            messages = corpus.messages(ros_factory, stamp_ns)
            for topic, callback in heard.items():
                valid = messages[topic]
                if data.draw(st.booleans()):
                    changed = changed_message(TOPIC_TYPES[topic], valid)
                    valid = as_ros(TOPIC_TYPES[topic], data.draw(changed))
                with time_limit():
                    callback(valid, {})
            node._checked_health()
        assert not node.internal_errors
