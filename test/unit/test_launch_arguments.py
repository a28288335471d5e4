"""Launch files, which run here with recorders in the place of ROS' launch."""

from collections.abc import Iterable, Mapping
import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
import runpy
import sys
from types import ModuleType
from typing import Any, ClassVar

from harness import REPOSITORY
import pytest
import yaml

from landmark_nav.configuration import Configuration, READS

LAUNCH_FILES = sorted((REPOSITORY / 'landmark_nav' / 'launch').glob('*.launch.py'))


@dataclass
class Recorded:
    """Any object of launch: how it was made."""

    kind: str
    positional: tuple[Any, ...] = ()
    named: dict[str, Any] = field(default_factory=dict)

    @property
    def name(self):
        """As launch's own objects have it."""
        return self.argument(0, 'name')

    def argument(self, position, name):
        """What was given for one parameter, by its place or by its name."""
        given = self.positional[position : position + 1]
        return given[0] if given else self.named.get(name)


class Recorder(ModuleType):
    """A module of launch whose every class records how its objects are made."""

    __path__: ClassVar[list[str]] = []

    def __getattr__(self, kind):
        if kind.startswith('__'):
            raise AttributeError(kind)
        return lambda *positional, **named: Recorded(kind, positional, named)


@pytest.fixture(autouse=True)
def recorders(monkeypatch):
    for name in (
        *('launch', 'launch.actions', 'launch.conditions', 'launch.substitutions'),
        *('launch.launch_description_sources', 'launch_ros', 'launch_ros.actions'),
        *('launch_ros.parameter_descriptions', 'launch_ros.substitutions'),
    ):
        monkeypatch.setitem(sys.modules, name, Recorder(name))
    packages = ModuleType('ament_index_python.packages')
    # Launch files find each other below it, by their names alone here.
    packages.get_package_share_directory = lambda name: f'/share/{name}'
    monkeypatch.setitem(sys.modules, 'ament_index_python', Recorder('ament_index_python'))
    monkeypatch.setitem(sys.modules, packages.__name__, packages)


def described(path):
    """All objects of the description that a launch file returns."""
    return list(within(runpy.run_path(str(path))['generate_launch_description']()))


def within(value):
    if isinstance(value, Recorded):
        yield value
        yield from within(value.positional)
        yield from within(value.named)
    elif isinstance(value, Mapping):
        yield from within(list(value.items()))
    elif isinstance(value, Iterable) and not isinstance(value, str):
        for item in value:
            yield from within(item)


def declared(objects):
    """Argument -> whether it has a default."""
    return {
        item.argument(0, 'name'): item.named.get('default_value') is not None
        for item in objects
        if item.kind == 'DeclareLaunchArgument'
    }


def used(value):
    return {
        item.argument(0, 'variable_name')
        for item in within(value)
        if item.kind == 'LaunchConfiguration'
    }


def included(objects):
    """Files of this package that are included, and the arguments that each gets."""
    for item in objects:
        if item.kind != 'IncludeLaunchDescription':
            continue
        source = item.argument(0, 'launch_description_source')
        path = Path(source.positional[0] if isinstance(source, Recorded) else source)
        yield (
            REPOSITORY / 'landmark_nav' / 'launch' / path.name,
            dict(item.named.get('launch_arguments') or ()),
        )


@pytest.mark.parametrize('path', LAUNCH_FILES, ids=lambda path: path.name)
def test_every_declared_argument_is_used_and_every_used_one_declared(path):
    objects = described(path)
    assert used(objects) == set(declared(objects))


@pytest.mark.parametrize('path', LAUNCH_FILES, ids=lambda path: path.name)
def test_every_include_hands_on_all_arguments(path):
    objects = described(path)
    for other, given in included(objects):
        assert set(given) == set(declared(described(other))), other.name


@pytest.mark.parametrize('path', LAUNCH_FILES, ids=lambda path: path.name)
def test_nodes_are_executables_of_the_package_with_parameters_that_they_have(path):
    executables = {file.name for file in (REPOSITORY / 'resource' / 'executables').iterdir()}
    types = {field.name: field.type for field in dataclasses.fields(Configuration)}
    nodes = [item.named for item in described(path) if item.kind == 'Node']
    nodes = [node for node in nodes if node['package'] == 'landmark_nav']
    assert nodes
    for node in nodes:
        assert node['executable'] in executables
        _, given = node['parameters']
        read = READS.get(node['executable'], {name for names in READS.values() for name in names})
        assert set(given) <= {*read, 'autostart', 'use_sim_time'}
        for name, value in given.items():
            assert value.named['value_type'].__name__ == types.get(name, 'bool')


def test_the_analyzers_of_diagnostics_name_nodes_and_their_work():
    file = REPOSITORY / 'config' / 'diagnostic_aggregator.yaml'
    text = file.read_text(encoding='utf-8')
    parameters = yaml.safe_load(text)['/**']['ros__parameters']
    groups = [group for group in parameters.values() if isinstance(group, dict)]
    names = {name for group in groups for name in group['startswith']}
    (bringup,) = (path for path in LAUNCH_FILES if 'bringup' in path.name)
    assert names == set(runpy.run_path(str(bringup))['NODES'])
    nodes = REPOSITORY / 'landmark_nav' / 'nodes'
    for expected in (name for group in groups for name in group.get('expected', ())):
        node, _, work = expected.partition(': ')
        assert f"super().__init__('{node}', '{work}'" in (nodes / f'{node}.py').read_text()
