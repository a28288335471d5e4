"""Parameters are declared from the dataclasses, checked, and read from YAML."""

import dataclasses
from importlib import import_module

from harness import BAGS
import pytest
from rclpy.parameter import Parameter

from landmark_nav.configuration import Configuration, READS
from landmark_nav.configuration import LIVE as LIVE_OF_NODES
from landmark_nav.errors import LandmarkNavError
from landmark_nav.parameters import Config, leaves, parameter
from landmark_nav.ros.health import Health, Level
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.ros.parameters import declare, follow, settle
from landmark_nav.storage.robot_files import shipped_config


@dataclasses.dataclass(frozen=True)
class Section(Config):
    rate_hz: float = parameter(5.0, 'how often', minimum=1.0, maximum=10.0)
    names: tuple[str, ...] = parameter(('a', 'b'), 'which')
    fixed: float = 1.0


@dataclasses.dataclass(frozen=True)
class Whole(Config):
    count: int = parameter(3, 'how many', minimum=1)
    kind: str = parameter('fast', 'how', choices=('fast', 'slow'))
    of_another: int = parameter(1, 'of another node', minimum=0)
    section: Section = dataclasses.field(default_factory=Section)

    def __post_init__(self):
        super().__post_init__()
        if self.kind == 'slow' and self.section.rate_hz > 8.0:
            raise LandmarkNavError('slow and rate_hz above 8 contradict each other')


LIVE = ('kind', 'section')


class ConfiguredNode(LandmarkNode):
    def __init__(self, config, names=('count', 'kind', 'section'), **options):
        super().__init__('configured', 'test', **options)
        self.robot = settle(self, config)
        self.config = declare(self, config, names, LIVE)
        self.close_with(follow(self, self.config, LIVE, self._take))

    def _take(self, config):
        self.config = config

    def health(self):
        return Health(Level.OK, 'fine')


@pytest.fixture
def context(graph):
    return graph.context


def test_description_range_and_default(context):
    node = ConfiguredNode(Whole(), context=context)
    assert node.config == Whole()
    assert not node.has_parameter('of_another')
    assert not node.has_parameter('section.fixed')
    rate = node.describe_parameter('section.rate_hz')
    assert (rate.description, rate.read_only) == ('how often [Hz]', False)
    assert node.describe_parameter('count').read_only
    limits = rate.floating_point_range[0]
    assert (limits.from_value, limits.to_value) == (1.0, 10.0)
    assert node.describe_parameter('count').integer_range[0].from_value == 1
    assert node.describe_parameter('kind').additional_constraints == 'one of fast, slow'
    changed = node.set_parameters([Parameter('count', value=4)])[0]
    assert not changed.successful


def test_what_is_live_may_be_set_and_what_it_may_not_be_is_refused(context):
    node = ConfiguredNode(Whole(), context=context)
    given = [Parameter('section.rate_hz', value=9.0), Parameter('section.names', value=['x'])]
    assert all(result.successful for result in node.set_parameters(given))
    assert node.config == Whole(section=Section(9.0, ('x',)))
    refused = {'count': (4, 'read-only'), 'kind': ('odd', 'fast, slow')}
    refused['section.rate_hz'] = 20.0, 'range'
    for name, (value, words) in refused.items():
        (result,) = node.set_parameters([Parameter(name, value=value)])
        assert not result.successful
        assert words in result.reason
    (result,) = node.set_parameters([Parameter('kind', value='slow')])
    assert 'contradict' in result.reason
    assert node.config.section.rate_hz == 9.0
    assert node.get_parameter('kind').value == 'fast'


@pytest.mark.parametrize(
    ('name', 'value', 'words'),
    [
        ('count', 0, 'count.*out of range'),
        ('section.rate_hz', 20.0, 'section.rate_hz.*out of range'),
        ('section.rate_hz', 2, 'section.rate_hz.*wrong type.*5.0'),
        ('kind', 'odd', 'kind.*fast, slow'),
    ],
)
def test_a_bad_value_is_named(context, name, value, words):
    overrides = [Parameter(name, value=value)]
    with pytest.raises(LandmarkNavError, match=words):
        ConfiguredNode(Whole(), context=context, parameter_overrides=overrides)


@pytest.mark.parametrize('name', sorted(READS))
def test_the_file_of_users_gives_the_defaults_of_every_node(name, context):
    arguments = ['--ros-args', '--params-file', str(shipped_config('landmark_nav.yaml'))]
    node = ConfiguredNode(Configuration(), READS[name], context=context, cli_args=arguments)
    assert node.config == Configuration()


SET = {
    'sweep_capture': ('capture.frames', 36),
    'landmark_learner': ('map_folder', 'elsewhere'),
    'triplet_selector': ('yield_s', 3.0),
    'triangulation_localizer': ('relocalization.search_s', 4.0),
    'odometry_fusion': ('correction_time_s', 2.0),
}


@pytest.mark.parametrize('name', sorted(LIVE_OF_NODES))
def test_each_node_takes_what_is_set_also_once_it_was_configured_anew(name, context):
    kind = getattr(
        import_module(f'landmark_nav.nodes.{name}'), name.title().replace('_', '') + 'Node'
    )
    robot = Parameter('robot_file', value=str(BAGS / 'robot.yaml'))
    node = kind(context=context, parameter_overrides=[robot])
    what, value = SET[name]
    for given in (value, value + value):
        (result,) = node.set_parameters([Parameter(what, value=given)])
        assert result.successful, result.reason
        configured = {key: now for key, _, now in leaves(node.config)}
        assert configured[what] == given
        node.trigger_deactivate()
        node.trigger_cleanup()
        node.trigger_configure()
        assert {key: now for key, _, now in leaves(node.config)} == configured
        node.trigger_activate()
    (result,) = node.set_parameters([Parameter('robot_file', value='x')])
    assert 'read-only' in result.reason
    node.destroy_node()
