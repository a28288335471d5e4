"""Reports of a node on its inputs: their publishers, what is missing, and what is wrong."""

from dataclasses import replace
import time
from typing import Any

from graph import Graph
import numpy as np
import pytest
import rclpy
from rclpy.context import Context
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.messages import decode, encode
from landmark_nav.ros.camera_frames import listen_for_joints
from landmark_nav.ros.health import Health, Level
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.ros.topics import message_class, ros_factory, TOPICS
from landmark_nav.types import JointSample, OdometrySample

NS, NOW_NS = 10**9, 1_700_000_000 * 10**9
MOUNT = PanTiltMount()


class Listener(LandmarkNode):
    """Decodes odometry and joint states, under a namespace, and keeps what came."""

    def __init__(self, **options):
        super().__init__('listener', 'test', namespace='/robot', **options)
        self.odometry: list[OdometrySample] = []
        self.joints: list[JointSample] = []
        self.fails = False
        self.listen('odom', self._on_odometry)
        listen_for_joints(self, MOUNT, self.joints.append, lambda stamp_ns, tilt_rad: None)

    def health(self):
        return Health(Level.DEGRADED if self.fails else Level.OK, 'listening')

    def _on_odometry(self, message):
        if self.fails:
            raise ZeroDivisionError('a bug')
        self.odometry.append(decode.odometry(message))


class Robot(Graph):
    """A listener and drivers."""

    def __init__(self, domain_id):
        super().__init__(domain_id)
        self.listener = self.add(Listener(context=self.context))

    def publisher(self, node, topic, kind=''):
        spec = TOPICS.get(topic.removeprefix('/robot/'))
        qos = spec.qos if spec is not None else 10
        made: Any = message_class(kind or TOPICS[topic.removeprefix('/robot/')].type_name)
        driver: Any = self.add(rclpy.create_node(node, context=self.context))
        return driver.create_publisher(made, topic, qos)

    def health(self):
        return self.listener._checked_health()

    def reports(self, words):
        return lambda: words in self.health().reason


@pytest.fixture
def graph(domain_id):
    made = Robot(domain_id)
    yield made
    made.close()


def odometry(stamp_ns, x=0.0):
    return encode.odometry(ros_factory, OdometrySample(stamp_ns, np.array([x, 0.0, 0.0])))


def joints(stamp_ns, *names):
    message = encode.joint_state(ros_factory, JointSample(stamp_ns, 0.1), MOUNT)
    message.name = list(names) or message.name
    return message


def reliability(of, value):
    name = f'qos_overrides./robot/odom.{of}.reliability'
    return {'parameter_overrides': [Parameter(name, value=value)]}


def test_reliability_is_overridden_and_a_publisher_that_does_not_suffice_is_named(graph):
    wheels = graph.publisher('wheels', '/robot/odom')
    strict = Listener(context=graph.context, **reliability('subscription', 'reliable'))
    strict.fails = True
    graph.add(strict)

    def publish():
        wheels.publish(odometry(NOW_NS))

    graph.until(lambda: bool(graph.listener.odometry), publish)
    assert 'quality of service that /wheels offers' in strict._checked_health().reason
    assert not strict.odometry
    driver = Listener(context=graph.context, **reliability('publisher', 'reliable'))
    graph.add(driver)
    wheels = driver.advertise('odom')
    strict.fails = False
    graph.until(lambda: bool(strict.odometry), publish)


def test_a_tilt_joint_that_no_message_has_is_named(graph):
    named = replace(MOUNT, has_tilt=True)
    listen_for_joints(graph.listener, named, lambda _: None, lambda stamp_ns, tilt_rad: None)
    unit = graph.publisher('unit', '/robot/joint_states')

    def publish():
        unit.publish(joints(time.time_ns(), MOUNT.pan_joint))

    graph.until(graph.reports(f'without {MOUNT.tilt_joint}'), publish)


@pytest.mark.parametrize('seconds', [0, 1])
def test_what_never_gets_its_other_half_makes_way_whatever_its_stamp(graph, seconds):
    """Also of a map that was loaded before the first ``/clock``, with stamps of 0."""
    came: list[Any] = []
    topics = ('panorama/image', 'panorama/pose')
    graph.listener.listen_together(topics, lambda *parts: came.append(parts))
    heard = {one.topic_name: one.callback for one in graph.listener.subscriptions}
    image, pose = (message_class(TOPICS[topic].type_name)() for topic in topics)
    for k in range(99):
        # By a clock that is ahead.
        image.header.stamp.sec = 5000 + k
        heard['/robot/panorama/image'](image, {})
    image.header.stamp.sec = pose.header.stamp.sec = seconds
    heard['/robot/panorama/image'](image, {})
    heard['/robot/panorama/pose'](pose, {})
    assert len(came) == 1


def test_what_nobody_sends_is_named_in_full_with_what_could_be_it(graph, domain_id):
    graph.listener.fails = True
    health = graph.health()
    assert '/robot/odom (nobody publishes it' in health.reason
    assert '/robot/joint_states (nobody publishes it' in health.reason
    assert 'nobody publishes it' in health.values['/robot/odom']
    graph.publisher('wheels', '/wheels/odometry', 'nav_msgs/msg/Odometry')
    graph.until(
        graph.reports('/robot/odom (nobody publishes it; of its type there is /wheels'), int
    )
    # Two types of one topic are refused within a context.
    context = Context()
    context.init(domain_id=domain_id)
    other = rclpy.create_node('other', context=context)
    other.create_publisher(message_class('std_msgs/msg/String'), '/robot/joint_states', 10)
    graph.until(graph.reports('/other publishes it as std_msgs/msg/String'), int)
    other.destroy_node()
    context.try_shutdown()


def test_a_message_that_is_not_used_is_counted_with_who_sent_it(graph):
    wheels = graph.publisher('wheels', '/robot/odom')
    send = lambda: wheels.publish(odometry(NOW_NS, np.nan))  # noqa: E731
    graph.until(graph.reports('odom from /wheels dropped: odometry position'), send)
    graph.listener.fails = True
    bug = 'odom from /wheels dropped: internal error, please report it: ZeroDivisionError'
    graph.until(graph.reports(bug), lambda: wheels.publish(odometry(NOW_NS)))
    assert int(str(graph.health().values['dropped: odom'])) >= 2
    graph.listener.fails = False
    graph.until(
        lambda: bool(graph.listener.odometry), lambda: wheels.publish(odometry(NOW_NS, 1.0))
    )
    assert graph.listener.odometry[0].pose_odom_base[0] == 1.0


def test_a_pan_that_comes_no_more_is_reported_until_it_does(graph):
    unit = graph.publisher('unit', '/robot/joint_states')

    def send(*names):
        return lambda: unit.publish(joints(time.time_ns(), *names))

    graph.until(lambda: bool(graph.listener.joints), send())
    graph.until(graph.reports('pan_joint arrives no more'), send('wheel_left', 'wheel_right'))
    graph.until(lambda: 'arrives no more' not in graph.health().reason, send())


def test_two_that_send_the_same_stream_are_named_not_one_after_the_other(graph):
    one = graph.publisher('one', '/robot/odom')
    graph.until(lambda: bool(graph.listener.odometry), lambda: one.publish(odometry(NOW_NS, 1.0)))
    other = graph.publisher('other', '/robot/odom')
    graph.until(
        lambda: graph.listener.odometry[-1].pose_odom_base[0] == 2.0,
        lambda: other.publish(odometry(NOW_NS, 2.0)),
    )
    assert 'two publishers' not in graph.health().reason
    graph.until(
        graph.reports('/robot/odom comes from two publishers, /one and /other: stop one'),
        lambda: [publisher.publish(odometry(NOW_NS)) for publisher in (one, other)],
    )


@pytest.mark.parametrize('off_s', [-4990, 60, 1_700_000_000])
def test_a_stream_of_another_clock_is_named_with_its_offset(graph, off_s):
    wheels, unit = (
        graph.publisher('wheels', '/robot/odom'),
        graph.publisher('unit', '/robot/joint_states'),
    )

    def send(off_ns):
        stamp_ns = time.time_ns()
        wheels.publish(odometry(stamp_ns))
        unit.publish(joints(stamp_ns - off_ns))

    graph.until(lambda: bool(graph.listener.odometry and graph.listener.joints), lambda: send(0))
    assert 'stamped' not in graph.health().reason
    graph.until(graph.reports('/robot/joint_states is stamped '), lambda: send(off_s * NS))
    (words,) = [part for part in graph.health().reason.split('; ') if 'is stamped' in part]
    assert float(words.split()[3]) == pytest.approx(-off_s, abs=1.0)
    assert '/robot/odom' in words


def test_a_clock_that_does_not_come_is_reported(graph):
    reported = graph.reports('no time comes on /clock')
    for simulated in (True, False, True):
        graph.listener.set_parameters([Parameter('use_sim_time', value=simulated)])
        graph.until(lambda on=simulated: reported() is on)
    clock = graph.publisher('player', '/clock')
    tick = ros_factory('rosgraph_msgs/msg/Clock')
    # A time before 1970 is none, and ends nothing.
    for sec in (-1, 5):
        tick.clock.sec = sec
        graph.until(
            lambda: 'no time comes' not in graph.health().reason, lambda: clock.publish(tick)
        )
    graph.until(
        lambda: graph.listener.get_clock().now().nanoseconds == 5 * NS, lambda: clock.publish(tick)
    )


def test_a_service_that_fails_answers(graph):
    def refuse():
        raise LandmarkNavError('not now')

    def fail():
        raise KeyError('a bug')

    graph.listener.offer('refuse', refuse)
    graph.listener.offer('fail', fail)
    client_node = rclpy.create_node('client', context=graph.context)
    graph.add(client_node)
    answers = {}
    for name in ('refuse', 'fail'):
        client: Any = client_node.create_client(Trigger, f'/robot/{name}')
        graph.until(client.service_is_ready, int)
        future = client.call_async(Trigger.Request())
        graph.until(future.done, int)
        answers[name] = future.result()
    assert answers['refuse'].message == 'not now'
    assert 'KeyError' in answers['fail'].message
    assert not any(answer.success for answer in answers.values())
