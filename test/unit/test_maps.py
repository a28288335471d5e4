from dataclasses import replace

from builders import random_map
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from wire import assert_same
import yaml

from landmark_nav.calibration import Calibration, DEFAULT_SIGMAS, NAMES
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.walls import Wall
from landmark_nav.storage.maps import calibration_entry, load_map, save_map
from landmark_nav.types import PoseEstimate

WALLS = tuple(
    Wall(name, (0.1, 0.2), (1 / 3, 2e-7), 2.5) for name in ('on', 'north', '1', 'östlich: «a»')
)


def make_map(seed=0, count=3, factors=4):
    place = PoseEstimate(1_000_000_000_123, np.array([1.0, 2.0, 1 / 3]), 1e-7 * np.eye(3))
    given = {'panorama_poses': (place,), 'provenance': {'bag': 'a: b', 'rooms': '12'}}
    return random_map(seed, count, factors, WALLS, **given)


@settings(max_examples=15)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 6), factors=st.integers(0, 9))
def test_a_map_comes_back_bit_by_bit(tmp_path_factory, seed, count, factors):
    saved = make_map(seed, count, factors)
    folder = tmp_path_factory.mktemp('maps') / 'map'
    save_map(saved, folder)
    assert_same(load_map(folder), saved)


def test_a_map_is_replaced_as_a_whole_and_what_the_user_keeps_beside_it_stays(tmp_path):
    folder = tmp_path / 'map'
    save_map(make_map(count=5), folder)
    (folder / 'notes.txt').write_text('mine')
    (folder / 'panorama_4.png').write_text('of the old map')
    save_map(make_map(count=1), folder)
    assert len(load_map(folder).landmarks) == 1
    assert len(list((folder / 'patches').iterdir())) == 1
    assert (folder / 'notes.txt').read_text() == 'mine'
    assert not (folder / 'panorama_4.png').exists()
    assert [p.name for p in tmp_path.iterdir()] == ['map']


def test_folders_that_are_no_maps_are_not_touched(tmp_path):
    (tmp_path / 'photo.png').write_text('precious')
    with pytest.raises(LandmarkNavError, match='other files'):
        save_map(make_map(), tmp_path)
    with pytest.raises(LandmarkNavError, match='is a file'):
        save_map(make_map(), tmp_path / 'photo.png')
    assert (tmp_path / 'photo.png').read_text() == 'precious'


class _WithoutAliases(yaml.SafeDumper):
    def ignore_aliases(self, data):
        return True


def edited(tmp_path, edit):
    folder = tmp_path / 'map'
    save_map(make_map(), folder)
    path = folder / 'map.yaml'
    document = yaml.safe_load(path.read_text())
    edit(document)
    path.write_text(yaml.dump(document, Dumper=_WithoutAliases))
    return folder


def first(key, value):
    return lambda document: document['landmarks'][0].__setitem__(key, value)


def of_calibration(spoil):
    def edit(document):
        document['calibration'] = calibration_entry(Calibration.of_mount(PanTiltMount()))
        spoil(document['calibration'])

    return edit


@pytest.mark.parametrize(
    ('edit', 'match'),
    [
        (lambda d: d.update(schema_version=3), 'schema version 3.*reads 2.*update landmark_nav'),
        (lambda d: d.update(schema_version='0.9'), r"schema version '0\.9'.*learn the map again"),
        (lambda d: d.pop('schema_version'), 'schema_version is missing'),
        (lambda d: d.pop('landmarks'), 'landmarks is missing'),
        (lambda d: d['landmarks'][1].update(id=0), 'id 0 is there twice'),
        (
            first('position', [1.0, float('nan'), 0.0]),
            r'landmarks\[0\] \(id 0\): position.*finite',
        ),
        (first('position', 'here'), 'position is .*not 3 numbers'),
        (first('covariance', [[1.0, 2, 0], [2, 1, 0], [0, 0, 1]]), 'no covariance'),
        (first('shared_loading', [[1e-9], [0.0], [0.0]]), 'shared factors'),
        (first('shared_loading', [[9.0] * 4] * 3), r'\(id 0\): covariance is less than what sha'),
        (first('covariance', [[0.0] * 3] * 3), r'\(id 0\): covariance is less .*exact place'),
        (first('normal', [0.0, 0.0, 1.0]), 'normal is not horizontal'),
        (first('views', [[1.0, 2.0]]), 'views is .*not n x 3 numbers'),
        (first('views', [[1.0, 2.0, 1.1]] * 3), r'map/views/000_3\.png: not there'),
        (first('size', [0.0, 1.0]), 'must be positive'),
        (first('id', True), 'not an integer'),
        (lambda d: d['walls'][0].pop('height'), r'walls\[0\]: height is missing'),
        (lambda d: d['panorama_poses'][0].update(pose=[0, 0]), r'panorama_poses\[0\]: pose'),
        (lambda d: d.update(provenance=['x']), 'provenance'),
        (lambda d: d.update(provenance={'scale_sigma': 'small'}), 'scale_sigma is .*small'),
        (lambda d: d.update(provenance={'scale_sigma': -0.1}), 'scale_sigma is'),
        (of_calibration(lambda entry: entry.pop('values')), 'calibration'),
        (of_calibration(lambda entry: entry.update(names=['axis_x'])), 'calibration'),
        (of_calibration(lambda entry: entry['covariance'][0].pop()), 'calibration'),
        (of_calibration(lambda e: e.update(shared_loading=[[1.0]] * len(NAMES))), 'calibration'),
    ],
)
def test_a_map_that_cannot_be_is_refused_in_one_line(tmp_path, edit, match):
    with pytest.raises(LandmarkNavError, match=match) as error:
        load_map(edited(tmp_path, edit))
    assert str(tmp_path) in str(error.value)
    assert '\n' not in str(error.value)


def test_names_of_files_that_are_not_utf_8_are_kept_readable(tmp_path):
    save_map(replace(make_map(), provenance={'bag': 'caf\udce9'}), tmp_path / 'map')
    assert load_map(tmp_path / 'map').provenance['bag'].startswith('caf')


def test_missing_parts_are_named(tmp_path):
    folder = tmp_path / 'hall'
    save_map(make_map(), tmp_path / '.hall.old-17')

    def refused(path, match):
        with pytest.raises(LandmarkNavError, match=match):
            load_map(path)

    refused(tmp_path / 'nowhere', 'no map there')
    refused(folder, r'no map there.*rename .*\.hall\.old-17')
    save_map(make_map(), folder)
    refused(folder / 'map.yaml', r'is a file: a map is a folder, .*hall perhaps')
    (folder / 'patches' / '007.png').unlink()
    refused(folder, r'007\.png: not there: the map is incomplete: copy it again')
    (folder / 'map.yaml').write_text('- a\n: b')
    refused(folder, 'not YAML')


def test_a_map_of_schema_1_is_read(tmp_path):
    def older(document):
        document['schema_version'] = 1
        for entry in document['landmarks']:
            entry.pop('views', None)

    old, given = load_map(edited(tmp_path, older)), Calibration.of_mount(PanTiltMount())
    assert old.calibration_from(given) is given
    assert [k.views for k in old.landmarks] == [(), (), ()]
    np.testing.assert_array_equal(old.landmarks[2].patch, make_map().landmarks[2].patch)


def test_a_quantity_that_an_older_map_lacks_has_its_default_sigma(tmp_path):
    rng = np.random.default_rng(4)
    root = 1e-3 * rng.normal(size=(len(NAMES), len(NAMES)))
    found = Calibration(root[0], root @ root.T, by_map=0.5 * root[:, :4])
    kept = [k for k, name in enumerate(NAMES) if name != 'distortion']
    older = {
        'names': [NAMES[k] for k in kept],
        'values': found.values[kept].tolist(),
        'covariance': found.covariance[np.ix_(kept, kept)].tolist(),
        'shared_loading': found.by_map[kept].tolist(),
    }
    loaded = load_map(edited(tmp_path, lambda document: document.update(calibration=older)))
    assert loaded.calibration['distortion'] == (0.0, DEFAULT_SIGMAS[NAMES.index('distortion')])
    np.testing.assert_array_equal(loaded.calibration.by_map[kept], found.by_map[kept])


def test_a_map_holds_the_calibration_of_its_learning(tmp_path):
    rng = np.random.default_rng(3)
    prior = Calibration.of_mount(PanTiltMount((0.1, 0.0, 1.2)))
    root = 1e-3 * rng.normal(size=(len(NAMES), len(NAMES)))
    found = Calibration(
        prior.values + 0.01, root @ root.T, by_map=0.5 * root[:, :4], intrinsics=rng.random(5)
    )
    learned = replace(make_map(factors=4), prior=prior, calibration=found)
    save_map(learned, tmp_path / 'map')
    loaded = load_map(tmp_path / 'map')
    for name in ('values', 'covariance', 'by_map', 'intrinsics'):
        np.testing.assert_array_equal(getattr(loaded.calibration, name), getattr(found, name))
    robot = Calibration.of_mount(PanTiltMount((0.1, 0.0, 1.2), base_frame='base'))
    known = loaded.calibration_from(robot)
    np.testing.assert_array_equal(known.values, found.values)
    assert known.mount.base_frame == 'base'
    # A robot.yaml that was changed since counts by itself.
    changed = robot.with_values(axis_x=0.12)
    assert loaded.calibration_from(changed) is changed
    # Nor is its lever better known in the unit of a map than that unit.
    scaled = replace(learned, provenance={'scale_sigma': '0.05'})
    assert scaled.calibration_from(changed)['axis_x'][1] > 0.05 * 0.12
