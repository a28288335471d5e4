"""Launch files without ROS' launch, which is not among the wheels."""

import ast
import dataclasses
from pathlib import Path

import yaml

from landmark_nav.configuration import Configuration, READS

LAUNCH = Path(__file__).resolve().parents[2] / 'landmark_nav' / 'launch'


def tree(name):
    return ast.parse((LAUNCH / name).read_text(encoding='utf-8'))


def assigned(module, name):
    """Value of a literal that is assigned to `name`, type names as words."""
    for node in ast.walk(module):
        if isinstance(node, ast.Assign) and getattr(node.targets[0], 'id', '') == name:
            return ast.literal_eval(
                ast.unparse(node.value).replace(': int', ": 'int'").replace(': str', ": 'str'")
            )
    raise AssertionError(name)


def declared(module):
    return {
        ast.literal_eval(row.elts[0])
        for node in ast.walk(module)
        if isinstance(node, ast.comprehension) and isinstance(node.iter, ast.Tuple)
        for row in node.iter.elts
        if isinstance(row, ast.Tuple) and len(row.elts) == 3
    }


def test_bringup_gives_nodes_parameters_that_they_have():
    bringup = tree('bringup.launch.py')
    arguments = declared(bringup)
    nodes = assigned(bringup, 'NODES')
    assert len(nodes) == 6
    for name, taken in nodes.items():
        assert set(taken) <= set(READS[name]) & arguments


def test_simulation_gives_the_simulator_parameters_that_it_has():
    simulation = tree('simulation.launch.py')
    types = assigned(simulation, 'types')
    fields = {f.name: f.type for f in dataclasses.fields(Configuration)}
    assert types == {name: fields[name] for name in types}
    assert set(types) <= set(READS['room_simulator'])
    assert set(types) <= declared(simulation) | declared(tree('bringup.launch.py'))


def test_the_analyzers_of_diagnostics_name_nodes_and_their_work():
    file = LAUNCH.parents[1] / 'config' / 'diagnostic_aggregator.yaml'
    text = file.read_text(encoding='utf-8')
    parameters = yaml.safe_load(text)['/**']['ros__parameters']
    groups = [group for group in parameters.values() if isinstance(group, dict)]
    names = {name for group in groups for name in group['startswith']}
    assert names == set(assigned(tree('bringup.launch.py'), 'NODES'))
    nodes = LAUNCH.parent / 'nodes'
    for expected in (name for group in groups for name in group.get('expected', ())):
        node, _, work = expected.partition(': ')
        assert f"super().__init__('{node}', '{work}'" in (nodes / f'{node}.py').read_text()
