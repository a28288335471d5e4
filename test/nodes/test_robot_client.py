"""The client of programs that control the nodes."""

from contextlib import contextmanager

from graph import Graph
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.ros.health import Health, Level
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.ros.robot_client import NodeStatus, RobotClient


class Counter(LandmarkNode):
    """Offers to count how often it was asked."""

    asked = 0

    def health(self):
        return Health(Level.OK, 'counting')

    def count(self):
        self.asked += 1
        return f'asked {self.asked} times'


@contextmanager
def counting(domain_id):
    graph = Graph(domain_id)
    node = graph.add(Counter('counter', 'test', context=graph.context, namespace='/deep/down'))
    node.offer('count', node.count)
    try:
        yield node, graph.executor
    finally:
        graph.close()


def test_nothing_is_asked_of_a_node_that_could_not_answer_yet(domain_id, monkeypatch):
    """Its answer would be lost, and asking twice would do twice what is asked for."""
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    with counting(domain_id) as (node, executor), RobotClient(domain_id, lambda: None) as client:
        with pytest.raises(LandmarkNavError, match='the node of /deep/down/count to know'):
            client.call('/deep/down/count', 2.0)
        for _ in range(20):
            executor.spin_once(timeout_sec=0.05)
        assert node.asked == 0

    with counting(domain_id) as (node, executor):
        # Spun between the client's own turns.
        with RobotClient(domain_id, lambda: executor.spin_once(timeout_sec=0.0)) as client:
            assert client.call('/deep/down/count', 10.0) == 'asked 1 times'
        assert node.asked == 1


@pytest.mark.parametrize('text', ['500', '-1', 'seven', '1e2', '9' * 400, '0x1'])
def test_a_domain_that_cannot_be_is_refused(text, monkeypatch):
    monkeypatch.setenv('ROS_DOMAIN_ID', text)
    with pytest.raises(LandmarkNavError, match='0 to 232') as refused:
        RobotClient()
    assert len(str(refused.value)) < 100


@pytest.mark.parametrize(
    ('namespace', 'name'), [('', 'deep/down/counter'), ('deep/down', 'counter')]
)
def test_names_are_seen_from_the_namespace_of_the_client(namespace, name, domain_id):
    with counting(domain_id) as (_, executor):
        spin = lambda: executor.spin_once(timeout_sec=0.0)  # noqa: E731
        with RobotClient(domain_id, spin, namespace=namespace) as client:
            client.wait(lambda: client.status_of(name).reason == 'counting', 20.0, 'its report')
            assert name not in client.unheard()


TWO_NODES = {
    'simulator': NodeStatus('OK', 'running'),
    'fusion': NodeStatus('LOST', 'no landmark was found, not one; ' * 20),
}


@pytest.mark.parametrize(
    ('heard', 'of', 'named'),
    [
        (TWO_NODES, '', 'fusion'),
        (TWO_NODES, 'simulator', 'simulator'),
        (TWO_NODES, 'localizer', 'localizer'),
        ({}, '', 'start them: landmark-nav up'),
    ],
)
def test_who_waits_in_vain_hears_of_one_node(heard, of, named, domain_id):
    with RobotClient(domain_id) as client:
        client.status.update(heard)
        with pytest.raises(LandmarkNavError, match=f'^waited .* for rain: .*{named}') as refused:
            client.wait(lambda: False, 0.0, 'rain', of)
    assert len(str(refused.value)) < 150
    assert not any(other in str(refused.value) for other in {*client.status} - {named})
