"""Parameters are declared from the dataclasses, checked, and read from YAML."""

from __future__ import annotations

from collections.abc import Iterator
import dataclasses
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not installed')

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.context import Context
from rclpy.parameter import Parameter
import yaml

from landmark_nav.errors import LandmarkNavError
from landmark_nav.nodes.describe import parameter_file
from landmark_nav.parameters import Config, parameter
from landmark_nav.ros.health import Health, Level
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.ros.parameters import misspelt
from landmark_nav.storage.config_files import shipped_config

NODES = [
    'bag_player',
    'landmark_learner',
    'odometry_fusion',
    'panorama_synthesizer',
    'room_simulator',
    'sweep_capture',
    'triangulation_localizer',
    'triplet_selector',
]


@dataclasses.dataclass(frozen=True)
class Section(Config):
    rate_hz: float = parameter(5.0, 'how often', minimum=1.0, maximum=10.0)
    names: tuple[str, ...] = parameter(('a', 'b'), 'which', formerly='words')


@dataclasses.dataclass(frozen=True)
class Whole(Config):
    count: int = parameter(3, 'how many', minimum=1)
    kind: str = parameter('fast', 'how', choices=('fast', 'slow'), formerly='sort')
    section: Section = dataclasses.field(default_factory=Section)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kind == 'slow' and self.section.rate_hz > 8.0:
            raise LandmarkNavError('slow and rate_hz above 8 contradict each other')


class ConfiguredNode(LandmarkNode):
    def __init__(self, config: type, **options: Any) -> None:
        super().__init__('configured', 'test', **options)
        self.config = self.configure(config)

    def health(self) -> Health:
        return Health(Level.OK, 'fine')


@pytest.fixture
def context(domain_id: int) -> Iterator[Context]:
    made = Context()
    made.init(domain_id=domain_id)
    yield made
    made.try_shutdown()


def test_description_range_and_default(context: Context) -> None:
    node = ConfiguredNode(Whole, context=context)
    assert node.config == Whole()
    rate = node.describe_parameter('section.rate_hz')
    assert (rate.description, rate.read_only) == ('how often', True)
    limits = rate.floating_point_range[0]
    assert (limits.from_value, limits.to_value) == (1.0, 10.0)
    assert node.describe_parameter('count').integer_range[0].from_value == 1
    assert node.describe_parameter('kind').additional_constraints == 'one of fast, slow'
    changed = node.set_parameters([Parameter('count', value=4)])[0]
    assert not changed.successful


def test_values_come_from_a_file(context: Context, tmp_path: Path) -> None:
    path = tmp_path / 'config.yaml'
    values = {'count': 7, 'section': {'rate_hz': 2.5, 'names': ['x']}}
    path.write_text(yaml.safe_dump({'/**': {'ros__parameters': values}}))
    arguments = ['--ros-args', '--params-file', str(path)]
    node = ConfiguredNode(Whole, context=context, cli_args=arguments)
    assert node.config == Whole(count=7, section=Section(2.5, ('x',)))


@pytest.mark.parametrize(
    ('name', 'value', 'words'),
    [
        ('count', 0, 'count.*out of range'),
        ('section.rate_hz', 20.0, 'section.rate_hz.*out of range'),
        ('section.rate_hz', 2, 'section.rate_hz.*wrong type.*5.0'),
        ('kind', 'odd', 'kind.*fast, slow'),
    ],
)
def test_a_bad_value_is_named(context: Context, name: str, value: Any, words: str) -> None:
    overrides = [Parameter(name, value=value)]
    with pytest.raises(LandmarkNavError, match=words):
        ConfiguredNode(Whole, context=context, parameter_overrides=overrides)


def test_a_name_that_nothing_has_is_reported_with_what_it_looks_like(context: Context) -> None:
    given = {
        'countt': 3,
        'section.rat_hz': 2.0,
        'of_another_node': 1,
        'kind': 'slow',
        'kinds': 'x',
    }
    overrides = [Parameter(name, value=value) for name, value in given.items()]
    node = ConfiguredNode(Whole, context=context, parameter_overrides=overrides)
    assert misspelt(node) == {'countt': 'count', 'section.rat_hz': 'section.rate_hz'}


def test_a_former_name_sets_the_parameter_unless_the_new_one_is_given(context: Context) -> None:
    overrides = [Parameter('sort', value='slow'), Parameter('section.words', value=['c'])]
    node = ConfiguredNode(Whole, context=context, parameter_overrides=overrides)
    assert node.config == Whole(kind='slow', section=Section(names=('c',)))
    assert misspelt(node) == {}
    both = [Parameter('sort', value='slow'), Parameter('kind', value='fast')]
    assert ConfiguredNode(Whole, context=context, parameter_overrides=both).config == Whole()


def test_a_former_name_is_checked_as_the_new_one(context: Context) -> None:
    with pytest.raises(LandmarkNavError, match='fast, slow'):
        ConfiguredNode(Whole, context=context, parameter_overrides=[Parameter('sort', value='no')])


def test_values_that_contradict_each_other(context: Context) -> None:
    overrides = [Parameter('kind', value='slow'), Parameter('section.rate_hz', value=9.0)]
    with pytest.raises(LandmarkNavError, match='contradict'):
        ConfiguredNode(Whole, context=context, parameter_overrides=overrides)


@pytest.mark.parametrize('name', NODES)
class TestNode:
    def test_file_holds_all_parameters(self, name: str) -> None:
        text = shipped_config(f'{name}.yaml').read_text()
        renew = f'python -m landmark_nav.nodes.describe {name} > config/{name}.yaml'
        assert text == parameter_file(name), renew

    def test_file_gives_the_defaults(self, name: str, context: Context) -> None:
        config = import_module(f'landmark_nav.nodes.{name}').Parameters
        arguments = ['--ros-args', '--params-file', str(shipped_config(f'{name}.yaml'))]
        node = ConfiguredNode(config, context=context, cli_args=arguments)
        assert node.config == config()

    def test_every_parameter_is_described(self, name: str, context: Context) -> None:
        config = import_module(f'landmark_nav.nodes.{name}').Parameters
        node = ConfiguredNode(config, context=context)
        own = [p for p in node.get_parameters_by_prefix('') if p not in ('use_sim_time',)]
        described: list[ParameterDescriptor] = node.describe_parameters(
            [p for p in own if not p.startswith(('start_type_description', 'qos_overrides'))]
        )
        assert described
        assert [d.name for d in described if not d.description or not d.read_only] == []
