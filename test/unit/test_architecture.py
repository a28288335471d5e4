"""What docs/architecture.md promises about who imports whom."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[2] / 'landmark_nav'
MODULES = sorted(PACKAGE.rglob('*.py'))
MAX_LINES = 350

# Part of the package -> the parts below it. Learning and localization do not know each other, and
# no stage knows files, ROS or the command line.
GROUND = {'arrays', 'errors', 'parameters', 'geometry', 'quality', 'types'}
STAGES = {*GROUND, 'matching', 'learning', 'localization'}
FILES = {*GROUND, 'messages', 'storage'}
BELOW = {
    'errors': set[str](),
    'parameters': {'errors'},
    'arrays': set(),
    'geometry': {'arrays', 'errors'},
    'quality': set(),
    'types': {'arrays', 'errors', 'geometry', 'quality'},
    'matching': GROUND,
    'learning': {*GROUND, 'matching'},
    'localization': {*GROUND, 'matching'},
    'planning': STAGES,
    'messages': GROUND,
    'storage': {*GROUND, 'messages'},
    'simulation': FILES,
    'upkeep': {*GROUND, 'matching'},
    'evaluation': {*STAGES, *FILES, 'planning'},
    'ros': FILES,
    'nodes': {*STAGES, *FILES, 'simulation', 'ros'},
    'demo': {*STAGES, *FILES, 'simulation', 'evaluation'},
    'cli': {*STAGES, *FILES, 'planning', 'simulation', 'evaluation', 'upkeep', 'demo', 'ros'},
    'launch': set[str](),
    '__main__': {'cli'},
}

ROS_PARTS = {'ros', 'nodes', 'launch'}
ROS_MODULES = {'rclpy', 'launch', 'launch_ros', 'ament_index_python', 'builtin_interfaces'}


def part(module: Path) -> str:
    """Name of the package's part that a module belongs to."""
    return module.relative_to(PACKAGE).parts[0].removesuffix('.py')


def imports(module: Path) -> Iterator[str]:
    """Full names of all modules imported anywhere in a file."""
    for node in ast.walk(ast.parse(module.read_text(encoding='utf-8'))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{module}:{node.lineno}: a relative import'
            assert node.module is not None
            # `from landmark_nav import x` names a part, too.
            names = [f'{node.module}.{alias.name}' for alias in node.names]
            yield from names if node.module == 'landmark_nav' else [node.module]


def is_ros(name: str) -> bool:
    top = name.partition('.')[0]
    return top in ROS_MODULES or top.endswith(('_msgs', '_srvs'))


@pytest.mark.parametrize('module', MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
class TestModule:
    def test_imports_run_downward(self, module: Path) -> None:
        if module == PACKAGE / '__init__.py':
            assert not list(imports(module))
            return
        allowed = {*BELOW[part(module)], part(module)}
        used = {name.split('.')[1] for name in imports(module) if name.startswith('landmark_nav.')}
        assert used <= allowed, f'{used - allowed} lie above or beside {part(module)}'

    def test_ros_stays_behind_its_door(self, module: Path) -> None:
        if part(module) not in ROS_PARTS:
            assert not [name for name in imports(module) if is_ros(name)]

    def test_says_what_it_is_for(self, module: Path) -> None:
        assert ast.get_docstring(ast.parse(module.read_text(encoding='utf-8')))

    def test_is_one_thing(self, module: Path) -> None:
        assert len(module.read_text(encoding='utf-8').splitlines()) <= MAX_LINES


def test_every_part_has_its_place() -> None:
    assert {part(module) for module in MODULES} - {'__init__'} <= set(BELOW)


def test_no_two_parts_lie_below_each_other() -> None:
    circles = [(a, b) for a in BELOW for b in BELOW[a] if a in BELOW[b] and a != b]
    assert not circles
