"""The import rules of docs/architecture.md."""

import ast
from functools import cache
from importlib import import_module
from pathlib import Path

from ablation import DRIVING, LEARNING, SEARCHING
import pytest

PACKAGE = Path(__file__).resolve().parents[2] / 'landmark_nav'
MODULES = sorted(PACKAGE.rglob('*.py'))

# Part of the package -> the parts below it. Learning and localization do not know each other, and
# no stage knows files, ROS or the command line.
GROUND = {
    'arrays',
    'calibration',
    'errors',
    'geometry',
    'image_codec',
    'parameters',
    'quality',
    'types',
}
STAGES = {*GROUND, 'matching', 'learning', 'localization'}
FILES = {*GROUND, 'messages', 'storage'}
RUN = {'ros', 'signals', 'threads'}
BELOW = {
    'errors': set[str](),
    'parameters': {'errors'},
    'former_parameters': {'parameters'},
    'arrays': set(),
    'image_codec': {'errors'},
    'geometry': {'arrays', 'errors'},
    'quality': set(),
    'calibration': {'arrays', 'errors', 'geometry'},
    'types': {'arrays', 'calibration', 'errors', 'geometry', 'quality'},
    'matching': GROUND,
    'learning': {*GROUND, 'matching'},
    'localization': {*GROUND, 'matching'},
    'planning': STAGES,
    'messages': GROUND,
    'storage': {*GROUND, 'messages'},
    'configuration': {*STAGES, *FILES, 'former_parameters'},
    'simulation': FILES,
    'upkeep': {*GROUND, 'matching'},
    'diagnosis': {*STAGES, *FILES},
    'evaluation': {*STAGES, *FILES, 'planning'},
    'threads': set[str](),
    'signals': set[str](),
    'ros': {*FILES, 'former_parameters'},
    'nodes': {*STAGES, *FILES, 'configuration', 'simulation', *RUN},
    'demo': {*STAGES, *FILES, 'simulation', 'evaluation', 'ros', 'signals'},
    'batch': {*FILES, 'signals'},
    'cli': {
        *STAGES,
        *FILES,
        'configuration',
        'batch',
        'planning',
        'simulation',
        'evaluation',
        'upkeep',
        'demo',
        'diagnosis',
        *RUN,
    },
    'launch': set[str](),
    '__main__': {'cli', 'signals'},
}

ROS_PARTS = {'ros', 'nodes', 'launch'}
ROS_MODULES = {'rclpy', 'launch', 'launch_ros', 'ament_index_python', 'builtin_interfaces'}


def part(module):
    """Name of the package's part that a module belongs to."""
    return module.relative_to(PACKAGE).parts[0].removesuffix('.py')


@cache
def imports(module):
    """Full names of all modules imported anywhere in a file."""
    found = set()
    for node in ast.walk(ast.parse(module.read_text(encoding='utf-8'))):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{module}:{node.lineno}: a relative import'
            assert node.module is not None
            # `from landmark_nav import x` names a part, too.
            names = [f'{node.module}.{alias.name}' for alias in node.names]
            found.update(names if node.module == 'landmark_nav' else [node.module])
    return found


def is_ros(name):
    top = name.partition('.')[0]
    return top in ROS_MODULES or top.endswith(('_msgs', '_srvs'))


def test_imports_run_downward():
    """No module imports what lies above or beside its part."""
    wrong = {
        str(module): name
        for module in MODULES
        for name in imports(module)
        if name.startswith('landmark_nav.')
        and name.split('.')[1] not in {part(module), *BELOW.get(part(module), ())}
    }
    assert not wrong


def test_ros_stays_behind_its_door():
    outside = [module for module in MODULES if part(module) not in ROS_PARTS]
    assert not {str(m): name for m in outside for name in imports(m) if is_ros(name)}


def test_every_part_has_its_place():
    assert {part(module) for module in MODULES} - {'__init__'} <= set(BELOW)


def test_no_two_parts_lie_below_each_other():
    circles = [(a, b) for a in BELOW for b in BELOW[a] if a in BELOW[b] and a != b]
    assert not circles


@pytest.mark.parametrize(
    'target',
    [name for part in (LEARNING, DRIVING, SEARCHING) for row in part.values() for name in row],
)
def test_the_target_of_a_row_exists(target):
    module, name = target.split(':')
    kind, _, field = name.partition('.')
    owner = getattr(import_module(module), kind)
    assert not field or hasattr(owner(), field)
