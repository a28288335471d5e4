"""One file of parameters, for nodes and commands, with bounds."""

from typing import Any

from harness import BAGS
import pytest
import yaml

from landmark_nav.configuration import Configuration, load_configuration, READS
from landmark_nav.errors import LandmarkNavError
from landmark_nav.parameters import leaves
from landmark_nav.storage.robot_files import flat, shipped_config

ROBOT = BAGS / 'robot.yaml'
PLAIN = load_configuration(None, ROBOT)


def load(folder, text, *nodes, robot=ROBOT):
    path = folder / 'config.yaml'
    path.write_text(text)
    return load_configuration(path, robot, *(nodes or READS))


def for_all(parameters):
    return f'/**: {{ros__parameters: {{{parameters}}}}}'


def test_users_change_few_and_find_the_defaults_in_the_file():
    path = shipped_config('landmark_nav.yaml')
    assert load_configuration(path, ROBOT, *READS) == PLAIN
    (section,) = yaml.safe_load(path.read_text()).values()
    inside = section['ros__parameters']
    assert len(flat(inside)) <= 12


def test_parameters_are_few_and_described_and_all_have_a_reader():
    known = {name: (field, value) for name, field, value in leaves(Configuration())}
    assert len(known) <= 40
    for name, (field, value) in known.items():
        assert field.metadata['description'], name
        if isinstance(value, int | float) and not isinstance(value, bool):
            assert field.metadata['minimum'] <= value <= field.metadata['maximum'], name
    read = {wanted for names in READS.values() for wanted in names}
    assert all(name in read or any(name.startswith(f'{k}.') for k in read) for name in known)
    assert all(k in known or any(name.startswith(f'{k}.') for name in known) for k in read)


def test_what_is_named_changes_and_all_else_stays(tmp_path):
    config = load(tmp_path, for_all('estimator: {step_probability: 0}, capture.frames: 36'))
    assert config.estimator.step_probability == 0.0
    assert isinstance(config.estimator.step_probability, float)
    assert config.capture.frames == 36
    assert config.odometry == PLAIN.odometry
    assert config.estimator.history_s == PLAIN.estimator.history_s


@pytest.mark.parametrize('text', ['', '# estimator: 1\n', for_all(''), for_all('estimator: {}')])
def test_where_nothing_is_named_nothing_changes(tmp_path, text):
    assert load(tmp_path, text) == PLAIN


def test_a_file_for_other_nodes_alone_is_reported(tmp_path, caplog):
    load(tmp_path, 'odometry_fuson: {ros__parameters: {map_frame: own}}', 'odometry_fusion')
    assert 'odometry_fuson' in caplog.text


def test_a_file_of_the_last_release_is_taken_with_warnings(tmp_path, caplog):
    text = (
        'observation: {triplet: {max_range_m: 9.0, hysteresis: 0.1}}\n'
        'fusion: {mode: loose, map_memory_m: 4.0}\n'
        'world: {people: 4}\nodometry: {along_m_per_sqrt_m: 0.5, scale_sigma: 0.5}\n'
    )
    robot = tmp_path / 'robot.yaml'
    robot.write_text(ROBOT.read_text() + 'odometry: {scale_sigma: 0.25}\n')
    config = load(tmp_path, text, robot=robot)
    assert config.triplet.max_range_m == 9.0
    assert config.triplet.hysteresis == PLAIN.triplet.hysteresis
    assert config.estimator.correlation_length_m == 4.0
    # The robot's file goes before what is moved there.
    assert (config.odometry.along_m_per_sqrt_m, config.odometry.scale_sigma) == (0.5, 0.25)
    for named in ('ros__parameters', 'triplet.max_range_m', 'triplet.hysteresis', 'robot.yaml'):
        assert named in caplog.text
    assert all(len(record.getMessage()) < 200 + len(str(tmp_path)) for record in caplog.records)


@pytest.mark.parametrize(
    ('name', 'fact', 'value'),
    [
        ('capture: {pan_min_rad: -1.0}', 'capture.pan_min_rad', -1.0),
        ('pan_max_rad: 1.0', 'capture.pan_max_rad', 1.0),
        ('command: {speed_rad_s: 0.5}', 'triplet.pan_rate_rad_s', 0.5),
    ],
)
def test_facts_of_the_robot_still_come_from_where_they_were(tmp_path, name, fact, value):
    config: Any = load(tmp_path, for_all(name))
    section, field = fact.split('.')
    assert getattr(getattr(config, section), field) == value


@pytest.mark.parametrize(
    ('text', 'complaint'),
    [
        (for_all('fusion: 1'), "no parameter 'fusion'"),
        (for_all('capture: {fraems: 3}'), "no parameter 'capture.fraems': .* capture.frames"),
        (for_all('command: {type: x}'), 'parameter type .* take one of'),
        (for_all('estimator: 3'), 'estimator is a section'),
        (for_all('command: JointState'), 'command is a section'),
        (for_all('capture: {frames: soon}'), "frames is 'soon': take a whole number"),
        (for_all('capture: {frames: true}'), 'frames is True: take a whole number'),
        (for_all('capture: {frames: -1}'), 'frames is -1'),
        (for_all('look_around: {enabled: 1}'), 'take true or false'),
        ('/**: {ros__parameters: [1]}', 'not a mapping'),
        ('- fusion', 'holds no mapping'),
        ('pan_axis: {xyz: [0, 0, 1]}', 'this is a robot file: give it as --robot'),
    ],
)
def test_what_cannot_be_is_named(tmp_path, text, complaint):
    with pytest.raises(LandmarkNavError, match=rf'config\.yaml.*{complaint}'):
        load(tmp_path, text)
